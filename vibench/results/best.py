"""The best cells of a run: which take part in a comparison, and the fastest query at every accuracy that is reached."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from vibench.qp.status import Status
from vibench.results.columns import CELLS, REAL, Column
from vibench.results.error_measures import errors_of_solution
from vibench.stability.infsup import VANISHES

LARGEST_BAND = 0.1
"""Mean errors above this are no answer: such cells win nothing, however fast they are."""

SOLVER_SHARE = 0.1
"""Cells whose QP solver makes a larger share of an error are not compared: the solver, not the strategy, decides."""

NO_BEST_CELL = (
    "no cell takes part in the comparison: one that does has every query ok, β over the span above zero at every "
    f"parameter, mean errors of at most {100.0 * LARGEST_BAND:g} %, and less than {100.0 * SOLVER_SHARE:g} % of an "
    "error made by the QP solver"
)
"""Why a run may have no best cell."""

BAND = "error_below"
"""Column of the accuracy: a power of ten that the mean errors of u and λ do not exceed."""

HEADINGS: Mapping[str, Column] = {
    **CELLS,
    BAND: Column(
        REAL,
        "1",
        "Power of ten that the mean errors, of u and λ unless told, do not exceed.",
        "error ≤",
        1,
    ),
}


def excluded(cells: pd.DataFrame, errors: pd.Series | None = None) -> pd.DataFrame:
    """Whether a row of the cells table takes no part, for each reason; a row has the first reason that holds.

    A query is not ok (`incomplete`); the inf-sup constant β over the span vanishes at a parameter, so that the
    multiplier is not unique there (`unstable`); the QP solver makes too large a share of the error (`loose`); a mean
    error is above `LARGEST_BAND`, or none is known (`inexact`). `errors` are those of the cells by another measure than
    the larger one of u and λ.
    """
    reasons = {
        "incomplete": cells["status"] != Status.OK,
        "unstable": cells["beta_span_min"].astype(float) < VANISHES,
        "loose": solved_too_loosely(cells),
        "inexact": ~((errors_of_solution(cells) if errors is None else errors) <= LARGEST_BAND),
    }
    found = pd.DataFrame(reasons, index=cells.index).astype(bool)
    earlier = found.astype(int).cumsum(axis=1).shift(1, axis=1, fill_value=0) > 0
    return found & ~earlier


def eligible(cells: pd.DataFrame) -> pd.Series:
    """Which rows of the cells table take part in a comparison; `excluded` says why the others do not."""
    return ~excluded(cells).any(axis=1)


def solved_too_loosely(cells: pd.DataFrame) -> pd.Series:
    """Which cells are left out where strategies are compared."""
    return cells["solver_share_mean"].astype(float) >= SOLVER_SHARE


def fastest(cells: pd.DataFrame, errors: pd.Series | None = None) -> pd.DataFrame:
    """For every problem and power of ten, the timed cell with the fastest query whose mean errors do not exceed it.

    Cells that are not `eligible` take no part, as in the leaderboard of a report. A band whose cell is that of the next
    smaller one is left out. `errors` are those of the cells by another measure, in their rows or in more.
    """
    measured = errors_of_solution(cells) if errors is None else errors.reindex(cells.index)
    fine = ~excluded(cells, measured).any(axis=1) & cells["online_s"].notna()
    rows = [
        pd.concat([mine.loc[fastest_of["online_s"]], pd.Series({BAND: error})])
        for _, mine in cells[fine].groupby(["problem", "problem_options"], dropna=False)
        for error, _, fastest_of in bands(mine, measured[mine.index], ["online_s"])
    ]
    columns = ["problem", BAND, *cells.columns.drop("problem")]
    return pd.DataFrame(rows, columns=columns).astype({**cells.dtypes, BAND: float}).reset_index(drop=True)


def bands(
    cells: pd.DataFrame, errors: pd.Series, columns: Collection[str]
) -> Iterator[tuple[float, pd.DataFrame, dict[str, Any]]]:
    """The bands of accuracy that the cells of one problem reach, from the largest error to the smallest.

    Yields the power of ten that the errors in the band do not exceed, its cells, and by each of the columns of which it
    has a value the index of the smallest one, of equal ones the first. A band in which the same cells have these as in
    the next smaller one is left out.
    """
    exponents = np.log10(errors.clip(lower=np.finfo(float).tiny))
    digits = np.ceil(exponents - 1e-12)  # by round-off the logarithm of 1e-3 may be above -3
    smaller: dict[str, Any] | None = None
    reached = list[tuple[float, pd.DataFrame, dict[str, Any]]]()
    for digit in sorted(set(digits)):
        mine = cells[digits <= digit]
        smallest = {name: mine[name].astype(float).idxmin() for name in columns if mine[name].notna().any()}
        keys = {name: mine.at[index, "cell"] for name, index in smallest.items()}
        if keys != smaller:
            reached.append((10.0**digit, mine, smallest))
        smaller = keys
    yield from reversed(reached)
