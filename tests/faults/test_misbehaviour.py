"""Problems and QP solvers of a third party that misbehave in every way, by the command."""

import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from running import Vibench, rows, run_wire
from samples import wire_study, write_study

from vibench.provenance import solver_version

BAD_PROBLEMS: Mapping[str, tuple[set[str], str]] = {
    "wire-raises": ({"error"}, "]: ArithmeticError: the wire snapped"),
    "wire-broken": ({"error"}, "in high-fidelity solutions: the problem 'wire-broken' raised OSError: no wire "),
    "wire-hungry": ({"error"}, "out of memory: the limit is memory_gib = 8"),
    "wire-sleeps": ({"timeout"}, "in high-fidelity solutions: stopped after cell_seconds = 20 s"),
    "wire-exits": ({"crashed"}, "in high-fidelity solutions: the worker process died with exit code 3"),
    "wire-segfaults": ({"crashed"}, "in high-fidelity solutions: the worker process died with signal SIGSEGV"),
    "wire-infeasible": ({"error"}, "]: rows 3 and 9 of B are opposite, and no u satisfies both of their bounds g"),
}
BAD_SOLVERS: Mapping[str, tuple[set[str], str]] = {
    "raises": ({"failed"}, "the solver returned nothing: RuntimeError: the solver gave in"),
    "nothing": ({"error"}, "NumericalError: the solver returned a NoneType, expected a QPSolution"),
    "gives-up": ({"failed"}, "the solver returned nothing: gave up"), "nan": ({"nonfinite"}, "not finite"),
    "wrong": ({"inaccurate"}, "residual"), "wrong-length": ({"error"}, "3 of 3 queries"),
    "dies": ({"crashed"}, "exit code 7"), "segfaults": ({"crashed"}, "died with signal SIGSEGV"),
    "hangs": ({"timeout"}, "stopped after query_seconds = 3 s"),
    "hungry": ({"error"}, "out of memory: the limit is memory_gib = 8"), "leaves": ({"error"}, "SystemExit: 3"),
    # Where its distribution is installed the broken module is the reason.
    "ecos": ({"unavailable"}, f"'ecos' {'cannot be imported: ' if solver_version('ecos') else 'is not installed: '}"),
}  # fmt: skip
FINE: Mapping[str, list[str]] = {
    "problem": ["wire", "wire-chatty"], "dual": ["cpg"], "primal": ["decorrelated", "enrichment-counts"],
    "solver": ["piqp", "careful", "counts", "chatty"],
}  # fmt: skip


@dataclass(frozen=True)
class Run:
    folders: list[Path]
    done: list[subprocess.CompletedProcess[str]]

    def rows(self, table: str = "cells") -> list[dict[str, Any]]:
        return [row for folder in self.folders for row in rows(folder, table)]


@pytest.fixture(scope="module")
def run(vibench: Vibench, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Matrices in which almost everything goes wrong: of problems and of solvers."""
    folder = tmp_path_factory.mktemp("misbehaviour")
    limits = {"cell_seconds": 20.0, "query_seconds": 3.0}  # a busy machine may take seconds for what is fine
    studies = [
        {"problem": [*FINE["problem"], *BAD_PROBLEMS], "dual": FINE["dual"], "primal": FINE["primal"],
         "solvers": FINE["solver"]},
        {"solvers": [*FINE["solver"], *BAD_SOLVERS]},
    ]  # fmt: skip
    found = Run([], [])
    for number, study in enumerate(studies):
        path = write_study(folder, wire_study(limits=limits, timing_rounds=2, **study), f"{number}.toml")
        found.done.append(vibench(folder, "run", path, "--jobs", "2", "--out", str(number)))
        found.folders.append(folder / str(number))
    return found


@pytest.fixture(scope="module")
def cells(run: Run) -> pd.DataFrame:
    found = pd.DataFrame(run.rows()).set_index(["problem", "dual", "primal", "solver"])
    return found[~found.index.duplicated()].sort_index()


@pytest.mark.long
def test_every_cell_has_a_row_with_a_reason_of_one_line_and_its_origin(cells: pd.DataFrame, run: Run) -> None:
    problems = ([*FINE["problem"], *BAD_PROBLEMS], FINE["dual"], FINE["primal"], FINE["solver"])
    solvers = (["wire"], FINE["dual"], ["decorrelated"], [*FINE["solver"], *BAD_SOLVERS])
    expected = {cell for axes in (problems, solvers) for cell in product(*axes)}
    assert sorted(cells.index) == sorted(expected)
    assert [(one.returncode, one.stderr) for one in run.done] == [(0, "")] * 2
    reasons = [*cells["reason"], *(row["reason"] for row in run.rows("queries"))]
    assert [reason for reason in reasons if "\n" in reason] == []
    assert all(cells["reason"][cells["status"] != "ok"])
    for name in ("seed", "study_hash", "code", "machine", "threads", "versions"):
        assert cells[name].notna().all(), name
        assert (cells[name] != "").all(), name


@pytest.mark.long
def test_tables_progress_and_logs_have_what_happened(run: Run) -> None:
    outputs = [one.stdout for one in run.done]
    for folder, printed in zip(run.folders, outputs, strict=True):
        counted = [(int(k), int(n)) for k, n in re.findall(r"^\[(\d+)/(\d+)\]", printed, re.MULTILINE)]
        statuses = [row["status"] for row in rows(folder)]
        count, fine = len(statuses), statuses.count("ok")
        assert counted == sorted(counted)
        assert len(set(counted)) == len(counted) > 5
        assert {n for _, n in counted} == {count}
        assert f"{count} cells, {fine} ok, {count - fine} not ok" in printed
        for status in set(statuses) - {"ok"}:
            assert re.search(rf"\b{status}: ", "".join(outputs))  # ten reasons of a run have a line
        assert len(pd.read_csv(folder / "tables" / "cells.csv")) == count
        assert len((folder / "tables" / "summary.md").read_text(encoding="utf-8").splitlines()) == count + 2
        assert len(pd.read_csv(folder / "tables" / "queries.csv")) == len(rows(folder, "queries"))
    queries = pd.DataFrame(rows(run.folders[1], "queries"))
    solvers = {*FINE["solver"], "raises", "nothing", "gives-up", "nan", "wrong"}
    assert solvers <= set(queries["solver"])
    assert set(queries.groupby("cell")["query"].apply(tuple)) == {(0, 1, 2)}
    assert set(queries[queries["solver"] == "raises"]["status"]) == {"failed"}
    assert queries["mu_1"].between(4.0, 8.0).all()
    counts = [row["iterations"] for row in run.rows("queries") if row["solver"] == "counts"]
    assert counts
    assert set(counts) == {3}
    known = [row for row in rows(run.folders[0], "histories") if row["quantity"] == "steps"]
    assert [row["value"] for row in known if row["problem"] == "wire"] == [0, 1, 2]
    assert not any(words in printed for printed in outputs for words in ("past Python", "the last words"))
    logs = [(folder / "workers.log").read_text() for folder in run.folders]
    said = (
        "assembling [", "careful", "written past Python", "solving", "solving past Python", "Fatal Python error: Seg",
    )  # fmt: skip
    assert [words for words in said if words not in logs[0]] == []
    assert all("the last words" in log for log in logs)  # printed by what crashed right after


@pytest.mark.long
def test_a_plugin_that_misbehaves_costs_its_cells_alone_and_is_named(cells: pd.DataFrame) -> None:
    fine = cells.loc[list(pd.MultiIndex.from_product(FINE.values()))]
    assert set(fine["status"]) == {"ok"}
    assert set(fine["queries_ok"]) == {3}
    assert set(fine["reason"]) == {""}
    for plugin, (statuses, reason) in {**BAD_PROBLEMS, **BAD_SOLVERS}.items():
        mine = cells.xs(plugin, level="problem" if plugin in BAD_PROBLEMS else "solver")
        assert set(mine["status"]) == statuses, plugin
        assert all(reason in found for found in mine["reason"]), plugin
        if plugin in BAD_SOLVERS:
            assert set(mine["queries_ok"]) == {0}
            assert mine["online_s"].isna().all()


@pytest.mark.long
def test_a_large_problem_that_finds_no_memory_costs_its_cell_alone(vibench: Vibench, tmp_path: Path) -> None:
    """Not one allocation of a plugin that takes it all: those of libraries, under a limit that suffices for others."""
    large = {"name": "hertz3d", "options": {"resolution": "coarse"}}
    tolerances, limits = [{"N": [2], "R": [2]}], {"memory_gib": 0.8}
    study = wire_study(problem=["radial-obstacle", large], tolerances=tolerances, limits=limits, validation=2)
    _, (other, row) = run_wire(vibench, tmp_path, study=study)
    assert (other["status"], row["status"]) == ("ok", "error")
    assert row["reason"] == "in high-fidelity solutions: out of memory: the limit is memory_gib = 0.8"


def test_queries_that_went_well_before_the_solver_died_are_kept(vibench: Vibench, tmp_path: Path) -> None:
    study = wire_study(solvers=["dies-sometimes", "piqp"], tolerances=[{"N": [3], "dual": [1e-2]}])
    done = vibench(tmp_path, "run", write_study(tmp_path, study), "--jobs", "1", "--out", "out")
    assert (done.returncode, done.stderr) == (0, "")
    cell, other = rows(tmp_path / "out")
    assert (cell["status"], cell["queries_ok"]) == ("crashed", 1)
    assert cell["reason"].startswith("2 of 3 queries, first mu=(4.343): the worker process died with signal SIGKILL")
    lost, kept = [[q for q in rows(tmp_path / "out", "queries") if q["cell"] == c["cell"]] for c in (cell, other)]
    assert [query["status"] for query in lost] == ["crashed", "crashed", "ok"]
    assert lost[2]["error_u"] == pytest.approx(kept[2]["error_u"])
    for query, reference in zip(lost, kept, strict=True):
        for name in ("mu_1", "hf_s", "beta_span", "beta_full_cone_lower", "beta_hf_span", "beta_bounds"):
            assert query[name] == reference[name]
