"""The best cells of a run: the fastest query at every accuracy that is reached, problem by problem."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from vibench.qp.status import Status
from vibench.results.columns import CELLS, REAL, Column

BAND = "error_below"
"""Column of the accuracy: a power of ten that the mean errors of u and λ do not exceed."""

HEADINGS: Mapping[str, Column] = {
    **CELLS,
    BAND: Column(REAL, "1", "Power of ten that the mean errors of u and λ do not exceed.", "error ≤", 1),
}


def fastest(cells: pd.DataFrame) -> pd.DataFrame:
    """For every problem and power of ten, the timed cell with the fastest query whose mean errors do not exceed it.

    Cells with a query that is not ok take no part. A band whose cell is that of the next smaller one is left out.
    """
    errors = cells[["error_u_mean", "error_lambda_mean"]].max(axis=1, skipna=True)
    known = cells.assign(error=errors)[(cells["status"] == Status.OK) & cells["online_s"].notna() & errors.notna()]
    rows = [row for _, mine in known.groupby(["problem", "problem_options"], dropna=False) for row in _bands(mine)]
    columns = ["problem", BAND, *cells.columns.drop("problem")]
    return pd.DataFrame(rows, columns=columns).astype({**cells.dtypes, BAND: float}).reset_index(drop=True)


def _bands(cells: pd.DataFrame) -> Iterator[pd.Series]:
    """The fastest cells of one problem, from the largest error to the smallest."""
    digits = np.ceil(np.log10(cells["error"].clip(lower=np.finfo(float).tiny)))
    found = [(band, cells.loc[cells.loc[digits <= band, "online_s"].idxmin()]) for band in sorted(set(digits))[::-1]]
    for k, (band, cell) in enumerate(found):
        if k + 1 == len(found) or found[k + 1][1]["cell"] != cell["cell"]:
            yield pd.concat([cell.drop("error"), pd.Series({BAND: 10.0**band})])
