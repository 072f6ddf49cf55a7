"""A matrix of plugins of a third party that misbehave in every way."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from running import Vibench, rows
from samples import wire_study, write_study

from vibench.provenance import solver_version

BAD_PROBLEMS: Mapping[str, tuple[set[str], str]] = {
    "wire-raises": ({"error"}, "]: ArithmeticError: the wire snapped"),
    "wire-nan": ({"error"}, "in high-fidelity solutions: f has entries that are not finite at mu = ["),
    "wire-shape": ({"error"}, "in high-fidelity solutions: g has shape (11,) at mu = ["),
    "wire-indefinite": ({"error"}, "not positive definite"),
    "wire-broken": ({"error"}, "in high-fidelity solutions: the problem 'wire-broken' raised OSError: no wire "),
    "wire-hungry": ({"error"}, "out of memory: the limit is memory_gib = 8"),
    "wire-sleeps": ({"timeout"}, "in high-fidelity solutions: stopped after cell_seconds = 20 s"),
    "wire-exits": ({"crashed"}, "in high-fidelity solutions: the worker process died with exit code 3"),
    "wire-segfaults": ({"crashed"}, "in high-fidelity solutions: the worker process died with signal SIGSEGV"),
    "wire-infeasible": ({"error"}, "]: rows 3 and 9 of B are opposite, and no u satisfies both of their bounds g"),
    "wire-crooked": ({"error"}, "in high-fidelity solutions: X_V is not positive definite"),
}
BAD_DUALS: Mapping[str, tuple[set[str], str]] = {
    "cone-raises": ({"error"}, "in cone: the dual strategy 'cone-raises' raised LookupError: no generator found"),
    "cone-waits": ({"timeout"}, "in cone: stopped after cell_seconds = 20 s"),
    "cone-nan": ({"error"}, "in cone: generators of Cone has an entry that is not finite, first at [0, 0]"),
    "cone-shape": ({"error"}, "in cone: `generators` of the cone has shape (11, 2), expected (12, count)"),
    "cone-negative": ({"error"}, "in cone: a generator has the negative coefficient -"),
    "cone-long": ({"error"}, "in cone: the generators do not all have unit norm in W"),
    "cone-nothing": ({"error"}, "in cone: the dual strategy returned a NoneType, expected a Cone"),
}
BAD_PRIMALS: Mapping[str, tuple[set[str], str]] = {
    "enrichment-raises": ({"error"}, "in enrichment: the primal strategy 'enrichment-raises' raised LookupError: no"),
    "enrichment-nan": ({"error"}, "in enrichment: vectors of Enrichment has an entry that is not finite, first"),
    "enrichment-shape": ({"error"}, "in enrichment: `vectors` of the enrichment has shape (11, 1), expected (12, cou"),
    "enrichment-long": ({"error"}, "in enrichment: the vectors of the enrichment are not orthonormal in V"),
    "enrichment-supply": ({"error"}, "in assembly: the supply of the enrichment has shape (12,), expected (12, count)"),
    "enrichment-writes": ({"error"}, "in enrichment: the primal strategy 'enrichment-bad' raised ValueError: assignme"),
    "enrichment-nothing": ({"error"}, "in enrichment: the primal strategy returned a NoneType, expected an Enrichm"),
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
    codes: list[int]
    printed: list[str]
    errors: list[str]

    def rows(self, table: str = "cells") -> list[dict[str, Any]]:
        return [row for folder in self.folders for row in rows(folder, table)]


def bad(name: str, plugin: str) -> dict[str, Any]:
    return {"name": plugin, "label": name, "options": {"how": name.rpartition("-")[2]}}


@pytest.fixture(scope="module")
def run(vibench: Vibench, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Matrices in which almost everything goes wrong: of problems, of solvers and of strategies."""
    folder = tmp_path_factory.mktemp("misbehaviour")
    waits = {"name": "cone-waits", "options": {"file": str(folder / "never")}}
    duals = [bad(name, "cone-bad") for name in list(BAD_DUALS)[2:]]
    primals = [bad(name, "enrichment-bad") for name in list(BAD_PRIMALS)[1:]]
    limits = {"cell_seconds": 20.0, "query_seconds": 3.0}  # a busy machine may take seconds for what is fine
    studies = [
        {"problem": [*FINE["problem"], *BAD_PROBLEMS], "dual": FINE["dual"], "primal": FINE["primal"],
         "solvers": FINE["solver"]},
        {"solvers": [*FINE["solver"], *BAD_SOLVERS]},
        {"dual": [*FINE["dual"], "cone-raises", waits, *duals],
         "primal": ["decorrelated", "enrichment-raises", *primals]},
    ]  # fmt: skip
    found = Run([], [], [], [])
    for number, study in enumerate(studies):
        path = write_study(folder, wire_study(limits=limits, timing_rounds=2, **study), f"{number}.toml")
        done = vibench(folder, "run", path, "--jobs", "2", "--out", str(number))
        found.folders.append(folder / str(number))
        found.codes.append(done.returncode)
        found.printed.append(done.stdout)
        found.errors.append(done.stderr)
    return found


@pytest.fixture(scope="module")
def cells(run: Run) -> pd.DataFrame:
    found = pd.DataFrame(run.rows()).set_index(["problem", "dual", "primal", "solver"])
    return found[~found.index.duplicated()].sort_index()


def test_every_cell_has_a_row_with_a_reason_of_one_line_and_its_origin(cells: pd.DataFrame, run: Run) -> None:
    problems = ([*FINE["problem"], *BAD_PROBLEMS], FINE["dual"], FINE["primal"], FINE["solver"])
    solvers = (["wire"], FINE["dual"], ["decorrelated"], [*FINE["solver"], *BAD_SOLVERS])
    strategies = (["wire"], [*FINE["dual"], *BAD_DUALS], ["decorrelated", *BAD_PRIMALS], ["piqp"])
    expected = {cell for axes in (problems, solvers, strategies) for cell in product(*axes)}
    assert sorted(cells.index) == sorted(expected)
    assert (run.codes, run.errors) == ([0, 0, 0], ["", "", ""])
    reasons = [*cells["reason"], *(row["reason"] for row in run.rows("queries"))]
    assert [reason for reason in reasons if "\n" in reason] == []
    assert all(cells["reason"][cells["status"] != "ok"])
    for name in ("seed", "study_hash", "code", "machine", "threads", "versions"):
        assert cells[name].notna().all(), name
        assert (cells[name] != "").all(), name


def test_tables_progress_and_logs_have_what_happened(run: Run) -> None:
    for folder, printed in zip(run.folders, run.printed, strict=True):
        counted = [(int(k), int(n)) for k, n in re.findall(r"^\[(\d+)/(\d+)\]", printed, re.MULTILINE)]
        statuses = [row["status"] for row in rows(folder)]
        count, fine = len(statuses), statuses.count("ok")
        assert counted == sorted(counted)
        assert len(set(counted)) == len(counted) > 5
        assert {n for _, n in counted} == {count}
        assert f"{count} cells, {fine} ok, {count - fine} not ok" in printed
        for status in set(statuses) - {"ok"}:
            assert re.search(rf"\b{status}: ", "".join(run.printed))  # ten reasons of a run have a line
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
    assert not any(words in printed for printed in run.printed for words in ("past Python", "the last words"))
    logs = [(folder / "workers.log").read_text() for folder in run.folders[:2]]
    said = (
        "assembling [", "careful", "written past Python", "solving", "solving past Python", "Fatal Python error: Seg",
    )  # fmt: skip
    assert [words for words in said if words not in logs[0]] == []
    assert all("the last words" in log for log in logs)  # printed by what crashed right after


def test_a_plugin_that_misbehaves_costs_its_cells_alone_and_is_named(cells: pd.DataFrame) -> None:
    fine = cells.loc[list(pd.MultiIndex.from_product(FINE.values()))]
    assert set(fine["status"]) == {"ok"}
    assert set(fine["queries_ok"]) == {3}
    assert set(fine["reason"]) == {""}
    good = {"problem": "wire", "dual": "cpg", "primal": "decorrelated"}
    bad_plugins = {"problem": BAD_PROBLEMS, "dual": BAD_DUALS, "primal": BAD_PRIMALS, "solver": BAD_SOLVERS}
    for axis, of_axis in bad_plugins.items():
        others = {name: value for name, value in good.items() if name != axis and (axis, name) != ("dual", "primal")}
        for plugin, (statuses, reason) in of_axis.items():
            mine = cells.xs((plugin, *others.values()), level=(axis, *others))
            if axis != "solver":
                mine = mine.loc[mine.index.get_level_values("solver") != "ecos"]
            assert set(mine["status"]) == statuses, plugin
            begins = axis in ("dual", "primal")
            assert all(found.startswith(reason) if begins else reason in found for found in mine["reason"]), plugin
            if axis == "solver":
                assert set(mine["queries_ok"]) == {0}
                assert mine["online_s"].isna().all()
    assert set(cells.xs("ecos", level="solver")["status"]) == {"unavailable"}
    for problem, dual, primal, check in (
        ("wire-nan", "cpg", "decorrelated", "problem:wire-nan"),
        ("wire-indefinite", "cpg", "decorrelated", "problem:wire-indefinite"),
        ("wire-crooked", "cpg", "decorrelated", "problem:wire-crooked"),
        ("wire", "cone-negative", "decorrelated", "dual:cone-bad --option=how=negative"),
        ("wire", "cpg", "enrichment-long", "primal:enrichment-bad --option=how=long"),
    ):
        assert cells.loc[(problem, dual, primal, "piqp"), "reason"].endswith(f"; run `vibench check {check}`")


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
