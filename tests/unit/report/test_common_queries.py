"""Errors compared on common queries: as by hand, and the same for cells that solved everything."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibench.report.figures.data import on_common_queries

QUERIES = 6
solved_by_cell = st.lists(st.sets(st.integers(0, QUERIES - 1)), min_size=1, max_size=5)


def tables(solved: list[set[int]], zero: set[int]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Cells named by numbers, the k-th of which solved these queries; the error of query q is q + 1 + 10 k."""
    cells = pd.DataFrame({"cell": [str(k) for k in range(len(solved))], "queries": QUERIES, "error_u_mean": -1.0})
    rows = [
        {"cell": str(k), "query": q, "status": "ok" if q in mine else "inaccurate", "error_u": q + 1.0 + 10.0 * k}
        | {"error_lambda": None if q in zero else 2.0 * q}
        for k, mine in enumerate(solved)
        for q in range(QUERIES)
    ]
    return cells.assign(error_lambda_mean=-1.0), pd.DataFrame(rows).astype({"error_lambda": float})


@given(solved_by_cell, st.sets(st.integers(0, QUERIES - 1)))
def test_means_are_over_the_queries_that_all_compared_cells_solved(solved: list[set[int]], zero: set[int]) -> None:
    found = on_common_queries(*tables(solved, zero))
    kept = [k for k, mine in enumerate(solved) if len(mine) >= 0.5 * QUERIES]
    common = set.intersection(*(solved[k] for k in kept)) if kept else set()
    assert list(found["cell"]) == [str(k) for k in kept]
    for k, row in zip(kept, found.itertuples(), strict=True):
        for mean, errors in (
            (row.error_u_mean, [q + 1.0 + 10.0 * k for q in common]),
            (row.error_lambda_mean, [2.0 * q for q in common - zero]),
        ):
            assert mean == pytest.approx(np.mean(errors)) if errors else np.isnan(mean)
