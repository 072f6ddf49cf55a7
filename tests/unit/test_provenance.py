import importlib.metadata
import os
import platform
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

import vibench
from vibench import provenance
from vibench.provenance import core_code, cores, distribution_version, machine, solver_version, source_hash, versions


def test_memory_is_what_control_groups_allow(tmp_path: Path) -> None:
    for groups, file, limit in (
        ("0::/\n", "memory.max", "123456789\n"),
        ("0::/user/one.scope\n", "user/memory.max", "123456789\n"),
        ("3:cpu,memory:/docker/ab\n1:cpu:/x\n0::/\n", "memory/docker/ab/memory.limit_in_bytes", "123456789\n"),
        ("3:memory:/docker/ab\n", "memory/memory.limit_in_bytes", "123456789\n"),
    ):
        (tmp_path / "groups").write_text(groups)
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        machine = provenance.memory(tmp_path / "groups", tmp_path)
        assert machine == os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        for text, expected in ((limit, 123456789), ("max\n", machine), (f"{2**63 - 4096}\n", machine)):
            (tmp_path / file).write_text(text)
            assert provenance.memory(tmp_path / "groups", tmp_path) == expected


def test_the_processor_has_its_model_and_caches_and_the_machine_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    text = machine()
    assert f"{cores()} cores" in text
    assert "GiB" in text
    assert platform.system() in text
    assert platform.machine() in text
    assert "\n" not in text
    monkeypatch.setattr(provenance.Path, "is_file", lambda _: False)
    text = machine.__wrapped__()
    assert text.split(",")[0].strip() in (platform.processor(), platform.machine())


def test_the_processor_has_its_model_and_the_sizes_of_its_caches_of_data(tmp_path: Path) -> None:
    info = tmp_path / "cpuinfo"
    core = "processor\t: {}\ncpu family\t: 26\nmodel\t\t: 2\nmodel name\t: AMD EPYC\nflags\t\t: fpu: all\n"
    info.write_text("\n".join(core.format(k) for k in range(2)))
    assert provenance.processor(info) == "AMD EPYC (family 26 model 2)"
    info.write_text("processor\t: 0\nmodel name\t: Neoverse-N1\n")
    assert provenance.processor(info) == "Neoverse-N1"
    for k, (level, kind, size) in enumerate([(1, "Data", "48K"), (1, "Instruction", "32K"), (2, "Unified", "1024K")]):
        (tmp_path / f"index{k}").mkdir()
        for name, value in {"level": level, "type": kind, "size": size}.items():
            (tmp_path / f"index{k}" / name).write_text(f"{value}\n")
    (tmp_path / "index9").mkdir()  # without files: the system does not say
    assert provenance.caches(tmp_path) == ["L1 48K", "L2 1024K"]
    assert provenance.caches(tmp_path / "none") == []


def test_versions_are_those_installed() -> None:
    found = versions("piqp")
    for name in ("numpy", "scipy", "qpsolvers", "vibench", "piqp"):
        assert found[name].partition(" at ")[0] == importlib.metadata.version(name)
    assert (found["python"], found["protocol"]) == (platform.python_version(), provenance.PROTOCOL)
    assert distribution_version("no-such-distribution") == solver_version("no-such-solver") == ""
    assert solver_version("proxqp") == importlib.metadata.version("proxsuite")


CHANGES: dict[str, Callable[[Path], object]] = {
    "edited": lambda folder: (folder / "a.py").write_text("x = 2\n"),
    "added": lambda folder: (folder / "c.py").write_text(""),
    "removed": lambda folder: (folder / "b.py").unlink(),
    "renamed": lambda folder: (folder / "b.py").rename(folder / "c.py"),
    "moved": lambda folder: [(folder / "a.py").write_text("x = 1\ny = 2\n"), (folder / "b.py").write_text("")],
    "another file": lambda folder: (folder / "notes.txt").write_text("x"),
    "compiled": lambda folder: [(folder / "__pycache__").mkdir(), (folder / "__pycache__" / "a.pyc").write_bytes(b"x")],
}


def test_the_hash_changes_with_the_sources_and_with_nothing_else(tmp_path: Path) -> None:
    hashes = set()
    for name, change in CHANGES.items():
        (folder := tmp_path / name).mkdir()
        (folder / "a.py").write_text("x = 1\n")
        (folder / "b.py").write_text("y = 2\n")
        hashes.add(before := source_hash(folder))
        change(folder)
        assert (source_hash(folder) == before) == (name in ("another file", "compiled")), name
    assert len(hashes) == 1  # wherever the sources are


def test_the_code_of_the_core_is_its_version_and_a_source_hash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = shutil.copytree(Path(str(vibench.__file__)).parent, tmp_path / "vibench")
    monkeypatch.setattr(provenance, "__file__", str(copy / "provenance.py"))
    before = core_code.__wrapped__()  # without its cache
    assert before.partition(" ")[0] == importlib.metadata.version("vibench")
    with (copy / "linalg" / "inner_product.py").open("a", encoding="utf-8") as source:
        source.write("\n# another line\n")
    assert core_code.__wrapped__() != before


def test_versions_name_the_commit_of_a_checkout_and_whether_it_was_changed(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b", *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    def found() -> str:
        provenance.commit.cache_clear()
        return provenance.commit(tmp_path)

    assert found() == ""
    git("init", "-q")
    (tmp_path / "a.py").write_text("a = 1\n")
    (tmp_path / "page.md").write_text("1\n")
    git("add", "a.py", "page.md")
    git("commit", "-q", "-m", "a")
    commit = git("rev-parse", "HEAD")[:10]
    assert found() == commit
    (tmp_path / "page.md").write_text("2\n")
    assert found() == commit
    (tmp_path / "a.py").write_text("a = 2\n")
    assert found() == commit + "+"
    shutil.rmtree(tmp_path / ".git")
    (tmp_path / ".git").write_text("no repository")
    assert found() == ""
