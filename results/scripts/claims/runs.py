"""What the claims need of a run: cells, queries and histories of PIQP in full, and the columns of a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from study import DUAL, PAPER, SOLVER, Published

from vibench.arrays import Array
from vibench.results import tables

LOOSE = {"paper-obstacle": (0.5, 0.6, 0.95), "paper-hertz": (0.5, 0.6, 0.4)}
"""Looser δ_PGA of the columns (captions of Figures 8 and 15)."""


@dataclass(frozen=True)
class Pair:
    """One column of Table 1 or 2: the paper's numbers, our cells of mcpg, and the break-even between two of them.

    Attributes
    ----------
    paper
        The published column.
    plain, online, offline, loose
        Cells without enrichment, with online supremizers, with PGA at the tight and at the looser tolerance.
    break_even
        Row of the thresholds that compares `online` with `offline`.
    """

    paper: Published
    plain: pd.Series
    online: pd.Series
    offline: pd.Series
    loose: pd.Series
    break_even: pd.Series

    @property
    def name(self) -> str:
        """(N, R) of the paper."""
        return "({}, {})".format(*self.paper.size)

    @property
    def ours(self) -> str:
        """(N, R) here."""
        return f"({self.plain['N']:.0f}, {self.plain['R']:.0f})"

    def dimension(self, cell: str) -> int:
        """Primal dimension of one of the cells, enrichment included."""
        chosen = getattr(self, cell)
        return int(chosen["N"] + chosen["enrichment"])

    @property
    def saving(self) -> float:
        """Seconds that a query saves with the offline enrichment."""
        return float(self.online["online_s"] - self.offline["online_s"])


@dataclass(frozen=True)
class Run:
    """Tables of the run of one of the paper's studies."""

    study: str
    cells: pd.DataFrame
    queries: pd.DataFrame
    histories: pd.DataFrame
    thresholds: pd.DataFrame

    @classmethod
    def read(cls, folder: str) -> Run:
        """Read a run; refuse one of another study."""
        path = tables.results_file(folder)
        cells, queries = (
            frame[(frame["solver"] == SOLVER) & (frame["assembly"] == "full")].copy()
            for frame in (tables.in_order(tables.read(path, name)) for name in ("cells", "queries"))
        )
        study = f"paper-{cells['problem'].iloc[0]}"
        if study not in PAPER:
            raise ValueError(f"'{folder}' is not a run of {' or '.join(PAPER)}")
        return cls(study, cells, queries, tables.read(path, "histories"), tables.read(path, "thresholds"))

    def pairs(self) -> list[Pair]:
        """The columns of the table of the paper."""
        _, tight, columns = PAPER[self.study]
        return [self._pair(column, tight, loose) for column, loose in zip(columns, LOOSE[self.study], strict=True)]

    def _pair(self, column: Published, tight: float, loose: float) -> Pair:
        mine = self.cells[self.cells["dual"] == DUAL]
        mine = mine[np.logical_and.reduce([mine[key] == value for key, value in column.prescribed.items()])]
        kinds = mine.set_index("enrichment_kind", drop=False)
        online, offline = kinds.loc["per-parameter"], mine[mine["primal_tol"] == tight].iloc[0]
        compared = (self.thresholds["cell_a"] == online["cell"]) & (self.thresholds["cell_b"] == offline["cell"])
        return Pair(
            column,
            kinds.loc["none"],
            online,
            offline,
            mine[mine["primal_tol"] == loose].iloc[0],
            self.thresholds[compared].iloc[0],
        )

    def constants(self, cell: pd.Series, name: str) -> Array:
        """An inf-sup column of the queries of a cell, in the order of the validation parameters."""
        mine = self.queries[self.queries["cell"] == cell["cell"]].sort_values("query")
        return mine[name].to_numpy(float)

    def constants_by_cell(self, kind: str, name: str, dual: str = DUAL) -> Array:
        """The same of all cells of one kind of enrichment, one after the other."""
        chosen = self.cells[(self.cells["dual"] == dual) & (self.cells["enrichment_kind"] == kind)]
        return np.concatenate([self.constants(cell, name) for _, cell in chosen.iterrows()])

    def curve(self, stage: str, quantity: str, dual: str | None = None) -> dict[int, float]:
        """The longest history of a quantity, value by step."""
        chosen = self.histories[(self.histories["stage"] == stage) & (self.histories["quantity"] == quantity)]
        if dual is not None:
            chosen = chosen[chosen["dual"] == dual]
        longest = chosen.groupby("artefact")["step"].max().idxmax()
        return _by_step(chosen[chosen["artefact"] == longest])

    def enrichment(self, cell: pd.Series, quantity: str) -> dict[int, float]:
        """History of a quantity of the enrichment of a cell."""
        keys = ("dual", "primal", "primal_tol", "pod_tol", "pod_size", "dual_tol", "dual_size")
        chosen = self.histories[(self.histories["stage"] == "enrichment") & (self.histories["quantity"] == quantity)]
        for key in keys:
            chosen = chosen[chosen[key].isna() if pd.isna(cell[key]) else chosen[key] == cell[key]]
        return _by_step(chosen)

    def diagnostics(self, quantity: str) -> Iterator[float]:
        """A diagnostic of the problem at every training and validation parameter."""
        yield from self.histories[self.histories["quantity"] == quantity]["value"]

    @property
    def machine(self) -> str:
        """The machines that measured the seconds."""
        return ", ".join(sorted(set(self.cells["machine"])))

    @property
    def disturbed(self) -> int:
        """Cells of the columns whose seconds were measured beside other programs."""
        return sum(cell["disturbed"] == 1 for pair in self.pairs() for cell in (pair.online, pair.offline))


def _by_step(rows: pd.DataFrame) -> dict[int, float]:
    ordered = rows.sort_values("step")
    return dict(zip(ordered["step"].astype(int), ordered["value"].astype(float), strict=True))


def reached(curve: dict[int, float], tolerance: float) -> int:
    """First step at which a history is at most a tolerance."""
    return next(step for step, value in curve.items() if value <= tolerance)
