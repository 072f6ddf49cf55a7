from __future__ import annotations

import re
import shutil
import sqlite3
from pathlib import Path
from unittest.mock import Mock

import pytest
from running import PATIENCE, Main, Register, Vibench, by_solver, refused, started
from samples import wire_study, write_study

from vibench import Enrichment, Kind, Offline, PrimalStrategy, RequestError
from vibench.cli import doctor
from vibench.provenance import cores, solver_version
from vibench.results.database import ResultsDatabase


def test_too_many_jobs_or_too_few_files_are_said(main: Main, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = write_study(tmp_path, wire_study(problem=["obstacle"]))
    line = refused(main("run", study, "--jobs", "1000000000"), "jobs is 1000000000")
    assert f"expected at most {16 * cores()} worker processes" in line
    assert list(Path.cwd().iterdir()) == []
    with pytest.MonkeyPatch.context() as patch:
        unable = Mock(side_effect=sqlite3.OperationalError("unable to open database file"))
        patch.setattr("vibench.results.database.sqlite3.connect", unable)
        patch.setattr("vibench.results.database.resource.getrlimit", lambda _: (7, 7))
        with pytest.raises(RequestError, match=r"this process may open only 7 files \(`ulimit -n`\)"):
            ResultsDatabase(tmp_path / "out", {})
    study = write_study(tmp_path, wire_study(problem=["obstacle"]))
    monkeypatch.setattr("vibench.execution.executors.resource.getrlimit", lambda _: (32, 32))
    remedy = "raise it (`ulimit -n 96`), ask for fewer --jobs, or use the executor 'local'"
    line = f"the executor 'dask' needs 96 open files, the limit is 32: {remedy}\n"
    assert refused(main("run", study, "--executor", "dask", "--jobs", "2")) == f"vibench: {line}"


@pytest.mark.long
@pytest.mark.skipif(solver_version("ecos") != "", reason="ecos is installed")
def test_a_run_does_not_depend_on_asserts_letters_of_an_encoding_nor_folders_called_like_a_library(
    command: str, plugins_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `python -O` (classes were registered inside an assert), for a log of a batch system, without δ and ….

    `PYTHONPATH=FOLDER:$PYTHONPATH` has an empty entry, the working directory, where the variable was not set.
    """
    for name, value in {"PYTHONOPTIMIZE": "1", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "LC_ALL": "C"}.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "ecos").mkdir()  # can be imported
    (tmp_path / "piqp").mkdir()
    (tmp_path / "piqp" / "__init__.py").write_text("raise OSError('not the solver')")
    write_study(tmp_path, wire_study(solvers=["piqp", "ecos", "careful"]))
    run = [command, "run", "study.toml", "--jobs", "1", "--no-figures"]
    with started(run, tmp_path, Path(f"{plugins_folder}:")) as process:
        printed, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, errors) == (0, "")
    assert "[3/3] ok: wire" in printed
    found = {solver: row["status"] for solver, row in by_solver(tmp_path / "runs" / "wire").items()}
    assert found == {"piqp": "ok", "careful": "ok", "ecos": "unavailable"}


def test_unreadable_entry_points_cost_their_own(
    vibench: Vibench, plugins_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    shutil.copytree(plugins_folder, site)
    for name, content in (
        ("bytes", b"\xff\xfe[vibench.problems]\n"), ("words", b"[vibench.problems]\nno entry\n"),
        ("groups", b"".join(b"[vibench.%s]\nmine = a:B\n" % name for name in (b"study", b"formulation", b"problem"))),
    ):  # fmt: skip
        information = site / f"{name}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_bytes(content)
    listed = vibench(tmp_path, "list", "problems", plugins=site)
    assert (listed.returncode, listed.stderr) == (0, "")
    assert " wire " in listed.stdout
    reasons = {line.partition(":")[0]: line for line in listed.stdout.splitlines() if ": its " in line}
    assert "UnicodeDecodeError" in reasons["bytes"]
    assert "TypeError" in reasons["words"]
    assert "'mine' is not used: no group" in reasons["groups"]
    assert "did you mean 'vibench.formulations'?" in reasons["groups"]
    done = vibench(tmp_path, "run", write_study(tmp_path, wire_study()), "--dry-run", plugins=site)
    assert (done.returncode, done.stderr) == (0, "")
    monkeypatch.setattr(doctor, "unreadable", lambda: {"words": "unreadable"})
    assert doctor.Diagnosis("words", "unreadable", doctor.Health.BROKEN) in list(doctor.check_plugins())


def test_a_plugin_whose_annotations_name_nothing_is_listed_with_the_reason(main: Main, register: Register) -> None:
    register(
        ("vibench.primal_strategies", "nameless", f"{__name__}:Nameless"),
        ("vibench.primal_strategies", "fine", "vibench_strategies.decorrelated:Decorrelated"),
    )
    code, out, err = main("list", "primal")
    assert (code, err) == (0, "")
    assert "have annotations that fail: NameError: name 'Nothing' is not defined" in " ".join(out.split())
    assert re.search("^fine ", out, re.MULTILINE)


class Nameless(PrimalStrategy):
    def __init__(self, option: Nothing = 1) -> None:  # type: ignore[name-defined] # noqa: F821
        pass

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        return Enrichment(Kind.NONE)
