import importlib.util
import json
import math
import os
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from forking import run_command
from outputs import clean
from running import Main, Register, refused
from samples import install_fakes

from vibench import RequestError, benchmarks
from vibench.benchmarks.plugin import PASSES, how_often

REGISTERED = """\
[vibench.problems]
wire = fake_plugins:Wire
wire-broken = fake_plugins:Broken
[vibench.dual_strategies]
cone-raises = fake_plugins:RaisingCone
cone-exits = fake_plugins:ExitingCone
cone-interrupts = fake_plugins:InterruptingCone
[vibench.primal_strategies]
enrichment-counts = fake_plugins:CountingEnrichment
[vibench.qp_solvers]
careful = fake_plugins:careful
lost = no_such_module:solve
"""


@dataclass(frozen=True)
class Timed:
    """Exit code, output, errors and file of the benchmarks of a package that is installed, and known to nobody."""

    code: int
    out: str
    err: str
    file: dict[str, Any]

    @property
    def benchmarks(self) -> dict[str, dict[str, Any]]:
        return {entry["name"].removeprefix("test_"): entry for entry in self.file["benchmarks"]}


@pytest.fixture(scope="module")
def third_party(tmp_path_factory: pytest.TempPathFactory) -> Timed:
    """The benchmarks of two problems and two solvers, and one dual strategy that fails."""
    folder = tmp_path_factory.mktemp("third-party")
    site = install_fakes(folder / "site")
    (site / "fake_plugins-1.0.dist-info" / "entry_points.txt").write_text(REGISTERED)
    plugins = [
        "wire", "wire-broken", "careful", "lost", "cone-raises", "cone-exits", "cone-interrupts", "mcpg", *PRIMALS,
    ]  # fmt: skip
    options = ["--seconds", "0.001", "--out", str(folder / "file.json")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "80")
        done = run_command(["bench", *plugins, *options], folder, site, 120.0)
    assert done.returncode in {0, 1}, done.stdout + done.stderr
    return Timed(done.returncode, done.stdout, done.stderr, json.loads((folder / "file.json").read_text("utf-8")))


PRIMALS = ("decorrelated", "offline-pga", "enrichment-counts")


@pytest.mark.long
def test_what_is_only_registered_is_timed_in_every_stage_beside_what_was_reached(third_party: Timed) -> None:
    stages = ("high_fidelity_solution", "high_fidelity_sweep", "pod", "separation")
    expected = {f"{stage}[wire]" for stage in stages} | {"cone[wire-mcpg]"}
    primals = ("decorrelated", "offline-pga-0.5", "offline-pga-0.1", "enrichment-counts")
    expected |= {f"{s}[wire-{primal}]" for s in ("enrichment", "assembly_in_full", "query") for primal in primals}
    assert expected <= set(third_party.benchmarks)
    assert all(entry["stats"]["median"] > 0.0 for entry in third_party.benchmarks.values())
    assert third_party.benchmarks["query[wire-decorrelated]"]["extra_info"]["n"] == 12
    duals = {entry["extra_info"]["axes"].get("dual") for entry in third_party.benchmarks.values()}
    solvers = {entry["extra_info"]["axes"].get("solver") for entry in third_party.benchmarks.values()}
    assert (duals, solvers) == ({None, "mcpg"}, {None, "careful"})  # only chosen plugins are timed
    assert set(third_party.file["machine_info"]["vibench"]) == {"machine", "libraries", "code"}
    assert {entry["options"]["timer"] for entry in third_party.benchmarks.values()} == {"process_time"}
    reached = {name: entry["extra_info"]["accuracy"] for name, entry in third_party.benchmarks.items()}
    assert all(figures and all(0.0 <= value < 2.0 for value in figures.values()) for figures in reached.values())
    assert reached["high_fidelity_sweep[wire]"].keys() == {"primal_residual", "dual_residual", "gap"}
    assert max(reached["high_fidelity_sweep[wire]"].values()) <= 1e-10
    assert reached["pod[wire]"]["tail"] <= 1e-3
    assert reached["cone[wire-mcpg]"]["projection_error"] <= 1e-2
    assert reached["enrichment[wire-decorrelated]"]["sigma"] > reached["enrichment[wire-offline-pga-0.1]"]["sigma"]
    assert reached["query[wire-offline-pga-0.1]"]["error_u"] < 1e-2
    info = third_party.benchmarks["solver[wire-N5-R5-careful-1e-10]"]["extra_info"]
    assert info["status"] == "ok"
    assert max(info["accuracy"].values()) <= 1e-10
    assert (info["N"], info["R"], info["form"]) == (3, 4, "primal")
    assert info["dimension"] >= 3
    assert "benchmarks left out: the snapshots of wire give N = " in third_party.err


@pytest.mark.long
def test_failures_have_reasons_passes_are_put_together_and_tables_fit(third_party: Timed) -> None:
    assert third_party.code == 1
    for name, reason in (
        ("pod[wire-broken]", "no wire in stock"),
        ("query[wire-broken-decorrelated]", "no wire in stock"),
        ("cone[wire-cone-raises]", "no generator found"),
        ("cone[wire-cone-exits]", "the worker process died with exit code 3"),
        ("cone[wire-cone-interrupts]", "KeyboardInterrupt"),
        ("solver[wire-N5-R5-lost-1e-06]", "no_such_module"),
    ):
        failed = (line for line in third_party.err.splitlines() if f" failed: {name}: " in line)
        assert any(reason in line for line in failed), name
        assert name not in third_party.benchmarks
    several = {name: entry["extra_info"]["passes"] for name, entry in third_party.benchmarks.items()}
    assert {len(passes) for passes in several.values()} <= {1, PASSES}
    assert len(several["enrichment[wire-decorrelated]"]) == PASSES
    for name, passes in several.items():
        stats = third_party.benchmarks[name]["stats"]
        assert sum(one["rounds"] for one in passes) == stats["rounds"] == len(stats["data"])
        assert min(one["q1"] for one in passes) <= stats["median"] <= max(one["q3"] for one in passes)
        assert stats["median"] == pytest.approx(statistics.median(stats["data"]))
        assert all(one["calibration_s"] > 0.0 for one in passes)
    lines = third_party.out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "POD" in lines
    failed = sum(" failed: " in line for line in third_party.err.splitlines())
    assert f"{len(third_party.benchmarks)} benchmarks, {failed} failed; times are CPU times" in lines[-1]
    assert sum(line.startswith(("decorrelated", "offline-pga")) for line in lines) == 3 * 3


@pytest.mark.long  # beside four busy processes the honest benchmark takes more than its three seconds, too
def test_a_benchmark_that_hangs_costs_itself_and_where_all_fail_there_is_a_file_of_none(tmp_path: Path) -> None:
    """In tests of pytest that somebody runs without the command."""
    path = os.pathsep.join([str(install_fakes(tmp_path / "site")), *filter(None, sys.path)])
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "short.toml").write_text(SHORT)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist"]
    command += ["-p", "vibench.benchmarks.plugin", "--pyargs", "vibench.benchmarks.stages", "--seconds=0.001"]
    command += ["--study=short.toml", "-k", "high_fidelity_solution", "--plugin=wire-sleeps"]
    settings: Any = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": path}, "text": True}
    settings |= {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    both = [["--plugin=wire", "--benchmark-json=both.json"], ["--benchmark-json=none.json"]]
    running = [subprocess.Popen([*command, *more], **settings) for more in both]
    expected = {"both": ["test_high_fidelity_solution[wire]"], "none": []}
    for process, (file, names) in zip(running, expected.items(), strict=True):
        out, _ = process.communicate()
        assert process.returncode == 1, out
        assert " 1 failed" in out
        content = json.loads((tmp_path / f"{file}.json").read_text())
        assert content["failed"] == {"high_fidelity_solution[wire-sleeps]": "stopped after 3 s"}
        assert [entry["name"] for entry in content["benchmarks"]] == names
        assert ("test_high_fidelity_solution[wire]" in out) == bool(names)  # the table of pytest-benchmark


SHORT = """
name = "short"
validation = 2
problem = ["obstacle"]
dual = ["cpg"]
primal = ["decorrelated"]
solvers = ["piqp"]
limits = { cell_seconds = 3.0 }

[[tolerances]]
pod = [1e-3]
dual = [1e-2]
"""


def test_plugins_are_chosen_by_the_names_of_lists(register: Register) -> None:
    assert benchmarks.chosen_plugins(["obstacle", "piqp", "dual:mcpg"]) == {
        "problem": ["obstacle"], "solver": ["piqp"], "dual": ["mcpg"],
    }  # fmt: skip
    for name, words in (
        ("obstacel", "did you mean 'obstacle'"), ("dual:obstacle", "no dual strategy is called 'obstacle'"),
        ("pack", "needs options"), ("thing:x", "no plugin is called 'x'"),
    ):  # fmt: skip
        with pytest.raises(RequestError, match=words):
            benchmarks.chosen_plugins([name])
    register(*((f"vibench.{group}", "same", "fake_plugins:Wire") for group in ("problems", "dual_strategies")))
    with pytest.raises(RequestError, match="say problem:same or dual:same"):
        benchmarks.chosen_plugins(["same"])


def test_wrong_requests_are_refused_in_a_line(main: Main, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused(main("bench", "obstacle", "--resolution", "huge"), "no problem has the resolution 'huge'")
    refused(main("bench", "obstacle", "--study", "quik"), "did you mean 'quick'")
    refused(main("bench", "obstacle", "--out", str(tmp_path / "no" / "file.json")), "is not a folder")
    refused(main("bench", "--read", str(tmp_path / "file.json")), "cannot be read")
    good = written(tmp_path / "good.json", entry("a", 1.0, SAME))
    refused(main("bench", "obstacle", "--read", good), "leave out the plugins")
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pytest_benchmark" else found(name))
    code, out, err = main("bench", "obstacle")
    assert (code, out) == (1, "")
    assert err == "vibench: `vibench bench` needs pytest-benchmark: pip install 'vibench[bench]'\n"


def test_what_is_quick_is_repeated_and_what_is_slow_is_not() -> None:
    for seconds, budget, together, expected in (
        (1e-5, 1.0, 1, (30, 200)), (1e-5, 1.0, 8, (30, 200)), (3e-4, 1.0, 8, (30, 8)), (0.02, 1.0, 8, (6, 8)),
        (0.4, 1.0, 1, (2, 1)), (0.4, 1.0, 8, (2, 1)), (4.0, 1.0, 1, (1, 1)), (0.0, 1.0, 1, (30, 20000)),
    ):  # fmt: skip
        assert how_often(seconds, budget, together) == expected


def entry(
    name: str,
    seconds: float,
    accuracy: Mapping[str, float | None],
    *,
    iqr: float = 0.0,
    calibration: float = 1.0,
    rounds: int = 9,
    more: Sequence[tuple[float, float]] = (),
    **extra: str,
) -> dict[str, Any]:
    stats = {"median": seconds, "q1": seconds - iqr / 2, "q3": seconds + iqr / 2, "rounds": rounds}
    passes = [stats | {"calibration_s": calibration}, *({"q1": q1, "q3": q3} for q1, q3 in more)]
    info = {"accuracy": accuracy, "passes": passes, **extra}
    return {"fullname": f"benchmarks/bench_stages.py::test_{name}", "stats": stats, "extra_info": info}


def written(path: Path, *entries: Mapping[str, Any], machine: str = "one core") -> str:
    content = {"benchmarks": entries, "machine_info": {"vibench": {"machine": machine, "libraries": "", "code": ""}}}
    path.write_text(json.dumps(content), encoding="utf-8")
    return str(path)


Pair = tuple[dict[str, Any], dict[str, Any]]
SAME = {"error_u": 1e-3, "gap": 1e-12}
BEFORE = entry("x", 1.0, SAME)
COMPARED: Mapping[str, tuple[Pair, str]] = {
    "the same": ((BEFORE, BEFORE), ""),
    "quicker and better": ((BEFORE, entry("x", 0.1, {"error_u": 1e-6, "gap": 0.0})), "faster"),
    "within the limit": ((BEFORE, entry("x", 1.24, SAME)), ""),
    "slower": ((BEFORE, entry("x", 1.26, SAME)), "slower"),
    "within the quartiles": ((entry("x", 1.0, SAME, iqr=0.4), entry("x", 1.5, SAME, iqr=0.7)), ""),
    "beyond the quartiles": ((entry("x", 1.0, SAME, iqr=0.4), entry("x", 1.5, SAME, iqr=0.5)), "slower"),
    "within the quartiles of another pass": (
        (entry("x", 1.0, SAME, more=[(1.0, 1.4)]), entry("x", 1.5, SAME, more=[(1.39, 1.4)])), "",
    ),
    "beyond the quartiles of all passes": (
        (entry("x", 1.0, SAME, more=[(1.0, 1.4)]), entry("x", 1.5, SAME, more=[(1.41, 1.5)])), "slower",
    ),
    "timed once": ((entry("x", 1.0, SAME, rounds=1), entry("x", 1.5, SAME)), ""),
    "timed once, much slower": ((BEFORE, entry("x", 1.6, SAME, rounds=1)), "slower"),
    "by less than 10 µs": ((entry("x", 1e-6, SAME), entry("x", 10.9e-6, SAME)), ""),
    "by more than 10 µs": ((entry("x", 1e-6, SAME), entry("x", 11.1e-6, SAME)), "slower"),
    "on a slower machine": ((BEFORE, entry("x", 2.4, SAME, calibration=2.0)), ""),
    "on a slower machine, and slower": ((BEFORE, entry("x", 2.6, SAME, calibration=2.0)), "slower"),
    "on a faster machine": ((BEFORE, entry("x", 1.1, SAME, calibration=0.5)), ""),
    "one figure worse": ((BEFORE, entry("x", 1.0, SAME | {"gap": 2e-9})), "less accurate"),
    "worse below what counts": ((BEFORE, entry("x", 1.0, SAME | {"gap": 0.9e-9})), ""),
    "worse by less than ten": ((BEFORE, entry("x", 1.0, SAME | {"error_u": 9e-3})), ""),
    "both": ((BEFORE, entry("x", 2.0, SAME | {"error_u": 0.1})), "slower, less accurate"),
    "faster and wrong": ((BEFORE, entry("x", 0.5, SAME | {"error_u": 0.1})), "faster, less accurate"),
    "no longer finite": ((BEFORE, entry("x", 1.0, SAME | {"gap": None})), "less accurate"),
    "no longer there": ((BEFORE, entry("x", 1.0, {"gap": 1e-12})), "less accurate"),
    "finite at last": ((entry("x", 1.0, {"gap": None}), entry("x", 1.0, {"gap": 1.0})), ""),
    "solved no more": (
        (entry("x", 1.0, SAME, status="ok"), entry("x", 1.0, SAME, status="inaccurate")), "ok, now inaccurate",
    ),
    "solved at last": ((entry("x", 1.0, SAME, status="failed"), entry("x", 1.0, SAME, status="ok")), ""),
}  # fmt: skip


def test_what_got_worse_is_said_and_told_by_the_exit_code(tmp_path: Path, main: Main) -> None:
    for name, (pair, verdict) in COMPARED.items():
        before, after = (written(tmp_path / f"{k}.json", some) for k, some in enumerate(pair))
        worse = verdict not in ("", "faster")
        code, out, _ = main("bench", "--read", after, "--against", before)
        assert code == int(worse), name
        assert out.splitlines()[-1].startswith("1 benchmarks in both files, median of the ratios ")
        assert out.splitlines()[-1].endswith(f"; {int(worse)} worse (limit 1.25)")
        (row,) = json.loads(main("bench", "--read", after, "--against", before, "--format", "json")[1])
        assert row["verdict"] == verdict, name
        assert row["ratio"] == pytest.approx(pair[1]["stats"]["median"] / pair[0]["stats"]["median"])


def test_a_row_has_the_figure_that_changed_most_and_what_differs_is_said(tmp_path: Path, main: Main) -> None:
    before = written(tmp_path / "before.json", entry("pod[rope]", 2e-3, SAME))
    after = written(tmp_path / "after.json", entry("pod[rope]", 3e-3, SAME | {"gap": 4e-9}))
    code, out, _ = main("bench", "--read", after, "--against", before, "--limit", "2")
    assert code == 1
    assert {"2", "3", "1.5", "gap", "1e-12", "4e-09", "less"} <= set(out.split())
    before = written(tmp_path / "before.json", entry("a", 1.0, SAME), entry("b", 1.0, SAME))
    after = written(tmp_path / "after.json", entry("b", 1.0, SAME), entry("c", 1.0, SAME), machine="two cores")
    code, out, _ = main("bench", "--read", after, "--against", before)
    assert code == 0
    assert {"new: c", "gone: a", "machine before: one core", "machine after:  two cores"} <= set(out.splitlines())
    other = written(tmp_path / "other.json", entry("d", 1.0, SAME))
    code, out, _ = main("bench", "--read", after, "--against", other)
    assert code == 0
    assert "0 benchmarks in both files; 0 worse" in out


def test_texts_of_a_file_are_data(tmp_path: Path, main: Main) -> None:
    path = written(tmp_path / "a.json", entry("a\x1b[31m\n", 1.0, {"b\x07": 1.0}, status="\x1b[2J"), machine="\x1b]0;")
    other = written(tmp_path / "b.json", entry("a\x1b[31m\n", 1.0, {"b\x07": 1.0}))
    for form in ("terminal", "csv", "json", "markdown"):
        assert clean(main("bench", "--read", path, "--against", other, "--format", form)[1])


def test_a_file_of_something_else_is_refused_in_a_line(tmp_path: Path, main: Main) -> None:
    good, other = written(tmp_path / "good.json", entry("a", 1.0, SAME)), tmp_path / "other.json"
    contents = ["", "[]", "{}", '{"benchmarks": [{}], "machine_info": {}}']
    # numbers that no clock gives
    for field, value in ("rounds", math.inf), ("median", 10**400), ("median", -1.0), ("q1", math.nan), ("q3", math.inf):
        odd = entry("a", 1.0, SAME)
        odd["stats"][field] = value
        contents.append(json.dumps({"benchmarks": [odd], "machine_info": {}}))
    for content in contents:
        other.write_text(content)
        for arguments in (["--read", good, "--against", str(other)], ["--read", str(other)]):
            refused(main("bench", *arguments), "cannot be read as a file of pytest-benchmark")
    refused(main("bench", "--read", str(tmp_path / "missing.json")), "cannot be read as a file of pytest-benchmark")
    twice = written(tmp_path / "twice.json", entry("a", 1.0, SAME), entry("a", 2.0, SAME))
    refused(main("bench", "--read", twice), "it has 'a' twice")
