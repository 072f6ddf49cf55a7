"""The leaderboard of a run: who answers a query fastest, costs least offline and errs least, within a stated error."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import pandas as pd

from vibench.results.best import bands, excluded
from vibench.results.error_measures import errors_of_solution


class Criterion(StrEnum):
    """What is the smallest of the winner; its column of the cells table, but for the error, stands in `COLUMNS`."""

    QUERY = "fastest query"
    OFFLINE = "fewest offline seconds"
    ERROR = "smallest error"


COLUMNS: Mapping[Criterion, str] = {
    Criterion.QUERY: "online_s",
    Criterion.OFFLINE: "offline_s",
    Criterion.ERROR: "largest_mean_error",
}
"""What is compared: CPU seconds of a query, CPU seconds offline, the larger of the mean relative errors of u and λ."""


@dataclass(frozen=True)
class Winner:
    """A cell with the smallest value among the cells of its problem whose mean errors are within a band.

    Attributes
    ----------
    value
        What is compared, as `COLUMNS` says: seconds, or a relative error.
    cell
        The whole row of the cells table, its key under "cell".
    """

    criterion: Criterion
    value: float
    cell: Mapping[str, Any]


@dataclass(frozen=True)
class Band:
    """The winners among the cells whose mean errors of u and λ are both at most `error`, a power of ten.

    Attributes
    ----------
    cells
        Number of cells that the band has.
    """

    error: float
    cells: int
    winners: tuple[Winner, ...]

    def winner(self, criterion: Criterion) -> Winner | None:
        """Who wins by a criterion; `None` where no cell of the band has a value of it."""
        return next((one for one in self.winners if one.criterion is criterion), None)


@dataclass(frozen=True)
class Standings:
    """The leaderboard of one problem: its bands from the largest error to the smallest that is reached.

    Attributes
    ----------
    problem, options
        Label of the problem and its options as JSON, as the cells table has them.
    cells, incomplete, unstable, loose, inexact
        Number of its cells, and of those that take no part: since a query is not ok; since the inf-sup constant β over
        the span vanishes at a parameter, so that the multiplier is not unique there; since the QP solver makes too
        large a share of the error; and since a mean error is above `best.LARGEST_BAND` or unknown.
    """

    problem: str
    options: str
    bands: tuple[Band, ...]
    cells: int
    incomplete: int
    unstable: int
    loose: int
    inexact: int


def leaderboard(cells: pd.DataFrame) -> tuple[Standings, ...]:
    """The winners of every problem in every band of accuracy, in the order of the cells.

    Parameters
    ----------
    cells
        Rows of the cells table: of one run, or of several that one machine measured, since seconds are compared.

    Returns
    -------
    :
        One leaderboard per problem and options of it; without bands where no cell takes part. Of equal values the
        first cell wins. A band in which the same cells win as in the next smaller one is left out.
    """
    groups = cells.groupby(["problem", "problem_options"], dropna=False, sort=False)
    return tuple(_standings(str(problem), str(options), mine) for (problem, options), mine in groups)


def _standings(problem: str, options: str, cells: pd.DataFrame) -> Standings:
    without, errors = excluded(cells), errors_of_solution(cells)
    rows = cells.assign(**{COLUMNS[Criterion.ERROR]: errors})[~without.any(axis=1)]
    reached = tuple(
        Band(error, len(mine), tuple(_winners(cells, rows, smallest)))
        for error, mine, smallest in bands(rows, errors[rows.index], COLUMNS.values())
    )
    counts = {str(reason): int(count) for reason, count in without.sum().items()}
    return Standings(problem, options, reached, len(cells), **counts)


def _winners(cells: pd.DataFrame, rows: pd.DataFrame, smallest: Mapping[str, Any]) -> Iterator[Winner]:
    for criterion, column in COLUMNS.items():
        if column in smallest:
            yield Winner(criterion, float(rows.at[smallest[column], column]), cells.loc[smallest[column]])
