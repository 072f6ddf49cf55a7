"""What a run, and its problem, have to say about the claims of the paper."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from vibench import Array, Problem, ReducedSet, Reduction, Stop, create
from vibench.report import ProblemTables
from vibench_problems.paper.published import PROBLEMS, Pair, Published

PLAIN, MODIFIED = "cpg", "mcpg"
"""The dual strategies of the paper."""

SOLVER = "piqp"
"""The solver whose queries are compared, if the run has it: the one with the fewest unsolved queries."""

VISIBLE = 1e-12
"""Smallest value that is drawn on a logarithmic axis: what is smaller is round-off."""

SIZES = ("pod_tol", "pod_size", "dual_tol", "dual_size")

History = dict[int, float]
"""Values by step."""


@dataclass(frozen=True)
class Evidence:
    """A run of one problem of the paper: assembly in full, one solver; and the problem itself."""

    tables: ProblemTables

    @property
    def paper(self) -> Published:
        """What is published of the problem."""
        return PROBLEMS[self.tables.problem_name]

    @cached_property
    def problem(self) -> Any:
        """The problem of the run."""
        return create("problem", self.tables.problem_name, self.tables.problem_options)

    @cached_property
    def reduction(self) -> Reduction:
        """The offline phase for the problem, with the cone of mCPG."""
        return reduction_of(self.problem)

    @cached_property
    def cells(self) -> pd.DataFrame:
        """One cell for every model, of either cone."""
        return self._of_solver(self.tables.cells)

    @cached_property
    def queries(self) -> pd.DataFrame:
        """The queries of the models with the cone of mCPG, one row for every model and parameter."""
        queries = self._of_solver(self.tables.queries)
        return queries[queries["dual"] == MODIFIED].drop_duplicates(["primal", "primal_tol", *SIZES, "query"])

    def _of_solver(self, rows: pd.DataFrame) -> pd.DataFrame:
        full = rows[rows["assembly"] == "full"]
        chosen = full[full["solver"] == SOLVER]
        return chosen if len(chosen) else full

    @cached_property
    def pairs(self) -> list[Pair]:
        """The pairs of the paper that the run has: without enrichment, online, and PGA at both tolerances."""
        return [pair for pair in self.paper.pairs if self._has(pair)]

    def _has(self, pair: Pair) -> bool:
        rows = _of_pair(pair, self.queries)
        tolerances = set(rows["primal_tol"][rows["enrichment_kind"] == "fixed"])
        kinds = set(rows["enrichment_kind"])
        return kinds >= {"none", "per-parameter"} and tolerances >= {self.paper.tight, pair.loose}

    def size(self, pair: Pair) -> tuple[int, int]:
        """(N, R) here."""
        first = _of_pair(pair, self.queries).iloc[0]
        return int(first["N"]), int(first["R"])

    def cell(self, pair: Pair, kind: str, tolerance: float | None = None) -> pd.Series:
        """The cell of a model of a pair: its kind of enrichment, and its tolerance if it has one."""
        return _of_kind(_of_pair(pair, self.cells[self.cells["dual"] == MODIFIED]), kind, tolerance).iloc[0]

    def constants(self, pair: Pair, kind: str, tolerance: float | None = None) -> pd.DataFrame:
        """Queries of a model of a pair, by number."""
        return _of_kind(_of_pair(pair, self.queries), kind, tolerance).sort_values("query").set_index("query")

    def loose(self, pair: Pair) -> pd.DataFrame:
        """Queries with PGA at the looser tolerance: they have all four constants."""
        return self.constants(pair, "fixed", pair.loose)

    def abscissa(self, rows: pd.DataFrame) -> tuple[pd.DataFrame, Array, str]:
        """Queries in the order of the only parameter, or of β_off if there are several; abscissae and their label."""
        if self.tables.problem_name == "hertz":
            ordered = rows.sort_values("mu_1")
            return ordered, ordered["mu_1"].to_numpy(float), "radius µ [m]"
        return rows.sort_values("beta_span"), np.arange(1.0, len(rows) + 1), "validation parameters, sorted by β_off"

    def history(self, stage: str, quantity: str = "error", dual: str | None = None) -> History:
        """The longest history of a POD or a cone; empty if there is none."""
        histories = self.tables.histories
        rows = histories[(histories["stage"] == stage) & (histories["quantity"] == quantity)]
        rows = rows if dual is None else rows[rows["dual"] == dual]
        if rows.empty:
            return {}
        return _by_step(rows[rows["artefact"] == rows.groupby("artefact")["step"].max().idxmax()])

    def growth(self, pair: Pair, quantity: str) -> History:
        """The history of PGA for a pair at the tight tolerance."""
        histories = self.tables.histories
        rows = histories[(histories["stage"] == "enrichment") & (histories["quantity"] == quantity)]
        rows = rows[(rows["dual"] == MODIFIED) & (rows["primal_tol"] == self.paper.tight)]
        return _by_step(_of_pair(pair, rows))


def _of_pair(pair: Pair, rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of a pair, by the tolerances or sizes that are prescribed for it."""
    wanted = [rows[column] == value for column, value in pair.prescribed.items()]
    return rows[np.logical_and.reduce([*wanted, *(rows[c].isna() for c in SIZES if c not in pair.prescribed)])]


def _of_kind(rows: pd.DataFrame, kind: str, tolerance: float | None) -> pd.DataFrame:
    rows = rows[rows["enrichment_kind"] == kind]
    return rows if tolerance is None else rows[rows["primal_tol"] == tolerance]


def _by_step(rows: pd.DataFrame) -> History:
    ordered = rows.sort_values("step")
    return dict(zip(ordered["step"].astype(int), ordered["value"].astype(float), strict=True))


def reached(history: History, tolerance: float) -> float:
    """First step at which a history is at most a tolerance; NaN if there is none."""
    return next((step for step, value in history.items() if value <= tolerance), np.nan)


def last(history: History) -> float:
    """Value at the last step; NaN of an empty history."""
    return history[max(history)] if history else np.nan


def reduction_of(problem: Problem) -> Reduction:
    """The offline phase for a problem, with the cone of mCPG and without enrichment, to the last snapshot."""
    return Reduction(problem, create("dual strategy", MODIFIED), None, Stop(tolerance=0.0), Stop(tolerance=0.0))


def stopped(reduction: Reduction, stop: Stop, dual: str = MODIFIED) -> ReducedSet:
    """The cone of the same snapshots with another end, or of another dual strategy."""
    other = replace(reduction, generators=stop, dual=create("dual strategy", dual))
    return other.given(snapshots=reduction.snapshots).cone


def for_log_axis(values: Any) -> Array:
    """Values for a logarithmic axis, without those that are zero up to round-off."""
    array = np.asarray(values, float)
    return np.where(array > VISIBLE, array, np.nan)
