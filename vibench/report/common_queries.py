"""Errors compared on the queries that all solved: means over ok queries flatter whoever fails at the hard ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from vibench.qp.status import Status
from vibench.results.schema import KEYS
from vibench.study.cells import COMPILED

FEWEST = 0.5
"""Who solved a smaller share of the queries is not compared: it would leave the others too few of them."""

MEANS: Mapping[str, str] = {"error_u_mean": "error_u", "error_lambda_mean": "error_lambda"}
"""Columns of a cell that are means over queries, and the column of a query that they are means of."""

WAY = ["solver", "accuracy"]

PROGRAM = [*(name for name in KEYS if name not in ("problem", "problem_options", *WAY)), "query"]
"""Columns that identify a quadratic program of a problem, which every solver solves at every accuracy."""


@dataclass(frozen=True)
class Comparable:
    """Cells of one problem whose errors can be compared."""

    cells: pd.DataFrame
    """Cells with enough ok queries; their means of errors are over the common ones."""
    common: int
    """Number of queries that are ok in all of them."""
    asked: int

    @property
    def over(self) -> str:
        """What the means are over, as the end of a sentence; "" where that is every query."""
        return "" if self.common == self.asked else f" over the {self.common} of {self.asked} queries that all solved"


def on_common_queries(cells: pd.DataFrame, queries: pd.DataFrame) -> Comparable:
    """The cells without those that have fewer than half of their queries ok, with means over what is ok in all.

    Both are rows of these tables, of one problem; queries of other cells are ignored.
    """
    ok = queries[(queries["status"] == Status.OK) & queries["cell"].isin(cells["cell"])]
    solved = cells["cell"].map(ok.groupby("cell").size()).fillna(0)
    kept = cells[(solved > 0) & (solved >= FEWEST * cells["queries"])]
    ok = ok[ok["cell"].isin(kept["cell"])]
    by = ok.groupby("query")["cell"].nunique()
    common = by.index[by == len(kept)]
    means = ok[ok["query"].isin(common)].groupby("cell")[list(MEANS.values())].mean()
    compared = kept.assign(**{column: kept["cell"].map(means[name]) for column, name in MEANS.items()})
    return Comparable(compared, len(common), int(kept["queries"].max()) if len(kept) else 0)


def common_programs(queries: pd.DataFrame) -> pd.DataFrame:
    """Rows of the programs of one problem that are ok with every solver at every accuracy.

    Solvers that have fewer than half of their programs ok at an accuracy are left out there.
    """
    queries = of_solvers(queries)
    fine = queries[queries["status"] == Status.OK]
    solved, asked = fine.groupby(WAY).size(), queries.groupby(WAY).size()
    compared = solved.index[solved >= FEWEST * asked.reindex(solved.index)]
    fine = fine[pd.MultiIndex.from_frame(fine[WAY]).isin(compared)]
    ways = fine.groupby(PROGRAM, dropna=False)["solver"].transform("size")
    return fine[ways == len(compared)]


def of_solvers(queries: pd.DataFrame) -> pd.DataFrame:
    """Rows of the queries that a QP solver answered, and no compiled program, which a solver lends its name."""
    return queries[queries["assembly"] != COMPILED]
