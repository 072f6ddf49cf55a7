"""The benchmarks time whatever is registered and keep what it reached; two of their files are compared by both."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from samples import install_fakes

from benchmarks import compare
from benchmarks.measure import _how_often, plain

ROOT = Path(__file__).parents[2]


def test_the_usual_run_leaves_benchmarks_out(pytestconfig: pytest.Config) -> None:
    ignored = pytestconfig.hook.pytest_ignore_collect(
        collection_path=ROOT / "tests" / "benchmarks", config=pytestconfig
    )
    assert ignored


REGISTERED = """\
[vibench.problems]
wire = fake_plugins:Wire
wire-broken = fake_plugins:Broken
[vibench.dual_strategies]
cone-raises = fake_plugins:RaisingCone
[vibench.primal_strategies]
enrichment-counts = fake_plugins:CountingEnrichment
[vibench.qp_solvers]
careful = fake_plugins:careful
lost = no_such_module:solve
"""


@pytest.fixture(scope="module")
def third_party(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, str, dict[str, Any]]:
    """Exit code, output and file of the benchmarks of a package that is installed, and known to nobody."""
    folder = tmp_path_factory.mktemp("third-party")
    site = install_fakes(folder / "site")
    (site / "fake_plugins-1.0.dist-info" / "entry_points.txt").write_text(REGISTERED)
    asked = (
        "--problems wire,wire-broken,obstacle --resolutions coarse --solvers careful,lost --benchmark-max-time 0.001"
    )
    plain_output = "-p no:cacheprovider --tb=line -rf"
    command = [sys.executable, "-m", "pytest", "tests/benchmarks", *asked.split(), *plain_output.split()]
    command += ["-k", "wire or N5-R5", f"--basetemp={folder / 'temp'}", f"--benchmark-json={folder / 'file.json'}"]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    paths = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=clean | {"PYTHONPATH": paths, "COLUMNS": "500"},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode in {0, 1}, done.stdout + done.stderr
    return done.returncode, done.stdout, json.loads((folder / "file.json").read_text(encoding="utf-8"))


def test_a_problem_that_is_only_registered_is_timed_in_every_stage(third_party) -> None:
    timed = {entry["name"]: entry for entry in third_party[2]["benchmarks"]}
    expected = [f"{stage}[wire]" for stage in ("high_fidelity_solution", "high_fidelity_sweep", "pod", "separation")]
    expected += [f"cone[wire-{dual}]" for dual in ("cpg", "mcpg")]
    primals = ("decorrelated", "offline-pga-0.5", "offline-pga-0.1", "online-supremizers", "enrichment-counts")
    expected += [f"{s}[wire-{primal}]" for s in ("enrichment", "assembly_in_full", "query") for primal in primals]
    assert {f"test_{name}" for name in expected} <= set(timed)
    assert all(entry["stats"]["median"] > 0.0 for entry in timed.values())
    assert timed["test_query[wire-decorrelated]"]["extra_info"]["problem"] == "wire"


def test_what_was_reached_is_beside_every_time(third_party) -> None:
    reached = {entry["name"]: entry["extra_info"]["accuracy"] for entry in third_party[2]["benchmarks"]}
    assert all(figures and all(0.0 <= value < 2.0 for value in figures.values()) for figures in reached.values())
    assert reached["test_high_fidelity_sweep[wire]"].keys() == {"primal_residual", "dual_residual", "gap"}
    assert max(reached["test_high_fidelity_sweep[wire]"].values()) <= 1e-10
    assert reached["test_pod[wire]"]["tail"] <= 1e-3
    assert reached["test_cone[wire-mcpg]"]["projection_error"] <= 1e-2
    assert (
        reached["test_enrichment[wire-decorrelated]"]["sigma"]
        > reached["test_enrichment[wire-offline-pga-0.1]"]["sigma"]
    )
    assert reached["test_query[wire-online-supremizers]"]["error_u"] < 1e-2


def test_a_registered_solver_is_timed_on_reduced_programs(third_party) -> None:
    (entry,) = (
        e for e in third_party[2]["benchmarks"] if e["name"] == "test_solver[obstacle-medium-N5-R5-careful-1e-10]"
    )
    info = entry["extra_info"]
    assert info["status"] == "ok"
    assert max(info["accuracy"].values()) <= 1e-10
    assert (info["R"], info["N"], info["form"]) == (5, 5, "primal")
    assert info["dimension"] >= 10


def test_what_cannot_be_made_fails_with_its_reason_and_is_not_timed(third_party) -> None:
    code, output, file = third_party
    assert code == 1
    timed = " ".join(entry["name"] for entry in file["benchmarks"])
    for name, reason in (
        ("test_pod[wire-broken]", "no wire in stock"),
        ("test_query[wire-broken-decorrelated]", "no wire in stock"),
        ("test_cone[wire-cone-raises]", "no generator found"),
        ("test_solver[obstacle-medium-N5-R5-lost-1e-06]", "no_such_module"),
    ):
        assert any(name in line and reason in line for line in output.splitlines() if line.startswith("FAILED")), name
        assert name not in timed
    assert "ERROR" not in output


def test_the_file_says_where_it_was_measured(third_party) -> None:
    assert set(third_party[2]["machine_info"]["vibench"]) == {"machine", "libraries", "code"}
    assert {entry["options"]["timer"] for entry in third_party[2]["benchmarks"]} == {"process_time"}


@pytest.mark.parametrize(
    ("seconds", "budget", "together", "expected"),
    [(1e-5, 1.0, 1, (30, 200)), (1e-5, 1.0, 8, (30, 200)), (3e-4, 1.0, 8, (30, 8)), (0.02, 1.0, 8, (6, 8)),
     (0.4, 1.0, 1, (3, 1)), (0.4, 1.0, 8, (3, 1)), (4.0, 1.0, 1, (1, 1)), (0.0, 1.0, 1, (30, 20000))],
)  # fmt: skip
def test_what_is_quick_is_repeated_and_what_is_slow_is_not(seconds, budget, together, expected) -> None:
    assert _how_often(seconds, budget, together) == expected


def test_what_json_has_no_number_for_is_nothing() -> None:
    given = {"a": math.inf, "b": {"c": math.nan, "d": 2}, "e": "text", "f": None, "g": True}
    assert plain(given) == {"a": None, "b": {"c": None, "d": 2}, "e": "text", "f": None, "g": True}


def entry(name: str, seconds: float, accuracy: Mapping[str, float | None], **extra: str) -> dict[str, Any]:
    fullname = f"tests/benchmarks/bench_stages.py::test_{name}"
    return {"fullname": fullname, "stats": {"median": seconds}, "extra_info": {"accuracy": accuracy, **extra}}


def written(path: Path, *entries: Mapping[str, Any], machine: str = "one core") -> str:
    content = {"benchmarks": entries, "machine_info": {"vibench": {"machine": machine, "libraries": "", "code": ""}}}
    path.write_text(json.dumps(content), encoding="utf-8")
    return str(path)


Pair = tuple[dict[str, Any], dict[str, Any]]
SAME = {"error_u": 1e-3, "gap": 1e-12}
COMPARED: Mapping[str, tuple[Pair, str]] = {
    "the same": ((entry("x", 1.0, SAME), entry("x", 1.0, SAME)), ""),
    "quicker and better": ((entry("x", 1.0, SAME), entry("x", 0.1, {"error_u": 1e-6, "gap": 0.0})), ""),
    "within the limit": ((entry("x", 1.0, SAME), entry("x", 1.24, SAME)), ""),
    "slower": ((entry("x", 1.0, SAME), entry("x", 1.26, SAME)), "slower"),
    "one figure worse": ((entry("x", 1.0, SAME), entry("x", 1.0, SAME | {"gap": 2e-9})), "less accurate"),
    "worse below what counts": ((entry("x", 1.0, SAME), entry("x", 1.0, SAME | {"gap": 0.9e-9})), ""),
    "worse by less than ten": ((entry("x", 1.0, SAME), entry("x", 1.0, SAME | {"error_u": 9e-3})), ""),
    "both": ((entry("x", 1.0, SAME), entry("x", 2.0, SAME | {"error_u": 0.1})), "slower, less accurate"),
    "no longer finite": ((entry("x", 1.0, SAME), entry("x", 1.0, SAME | {"gap": None})), "less accurate"),
    "no longer there": ((entry("x", 1.0, SAME), entry("x", 1.0, {"gap": 1e-12})), "less accurate"),
    "finite at last": ((entry("x", 1.0, {"gap": None}), entry("x", 1.0, {"gap": 1.0})), ""),
    "solved no more": (
        (entry("x", 1.0, SAME, status="ok"), entry("x", 1.0, SAME, status="inaccurate")), "ok, now inaccurate",
    ),
    "solved at last": ((entry("x", 1.0, SAME, status="failed"), entry("x", 1.0, SAME, status="ok")), ""),
}  # fmt: skip


@pytest.mark.parametrize(("pair", "worse"), COMPARED.values(), ids=COMPARED)
def test_what_got_worse_is_said_and_told_by_the_exit_code(pair: Pair, worse: str, tmp_path: Path, capsys) -> None:
    files = [written(tmp_path / f"{k}.json", some) for k, some in enumerate(pair)]
    assert compare.main(files) == int(bool(worse))
    lines = capsys.readouterr().out.splitlines()
    assert ([line for line in lines if line.startswith("x: ")] == [f"x: {worse}"]) is bool(worse)
    assert f"1 benchmarks in both files, median of the ratios {pair[1]['stats']['median']:.3g}" in lines[-1]


def test_a_table_has_times_their_ratio_and_the_figure_that_changed_most(tmp_path: Path, capsys) -> None:
    before = written(tmp_path / "before.json", entry("pod[rope]", 2e-3, SAME))
    after = written(tmp_path / "after.json", entry("pod[rope]", 3e-3, SAME | {"gap": 4e-9}))
    assert compare.main([before, after, "--limit", "2"]) == 1
    row = [cell.strip() for cell in capsys.readouterr().out.splitlines()[2].strip("|").split("|")]
    assert row == ["pod[rope]", "2", "3", "1.5", "gap", "1e-12", "4e-09", "less accurate"]


def test_what_is_new_or_gone_and_machines_that_differ_are_said(tmp_path: Path, capsys) -> None:
    before = written(tmp_path / "before.json", entry("a", 1.0, SAME), entry("b", 1.0, SAME))
    after = written(tmp_path / "after.json", entry("b", 1.0, SAME), entry("c", 1.0, SAME), machine="two cores")
    assert compare.main([before, after]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {"new: c", "gone: a", "machine before: one core", "machine after:  two cores"} <= set(lines)


def test_files_that_have_nothing_in_common_are_not_worse(tmp_path: Path, capsys) -> None:
    files = [written(tmp_path / f"{name}.json", entry(name, 1.0, SAME)) for name in "ab"]
    assert compare.main(files) == 0
    assert "0 benchmarks in both files; 0 worse" in capsys.readouterr().out


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"benchmarks": [{}], "machine_info": {}}'])
def test_a_file_of_something_else_is_refused_in_a_line(content: str, tmp_path: Path, capsys) -> None:
    good, other = written(tmp_path / "good.json", entry("a", 1.0, SAME)), tmp_path / "other.json"
    other.write_text(content)
    for files in ([good, str(other)], [str(other), good], [good, str(tmp_path / "missing.json")]):
        assert compare.main(files) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("limit", ["0", "-1", "nan"])
def test_a_limit_that_nothing_can_keep_is_refused(limit: str, tmp_path: Path) -> None:
    file = written(tmp_path / "file.json", entry("a", 1.0, SAME))
    with pytest.raises(SystemExit) as caught:
        compare.main([file, file, "--limit", limit])
    assert caught.value.code == 2
