"""Which cells a larger limit of the study runs again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from vibench.execution.jobs import OUT_OF_MEMORY
from vibench.execution.raised_limits import ended_by_smaller_limits, keep_limits
from vibench.results.database import ResultsDatabase
from vibench.study.spec import Limits

BEFORE = Limits(query_seconds=20.0, cell_seconds=600.0, memory_gib=8.0)

ENDS: dict[str, tuple[str, str, str]] = {
    "done": ("before", "ok", ""),
    "slow": ("before", "timeout", "in cone: stopped after cell_seconds = 600 s"),
    "large": ("before", "error", f"in POD: {OUT_OF_MEMORY} = 8"),
    "wrong": ("before", "error", "ArithmeticError: no pivot"),
    "long ago": ("a study without known limits", "timeout", "stopped after query_seconds = 1 s"),
}
"""Study, status and reason of cells by their keys."""


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ResultsDatabase]:
    """Ends of cells of a study with the limits `BEFORE`, among them one that crashed after a query took too long."""
    found = ResultsDatabase(tmp_path, {"name": "ends", "seed": 0, "validation": 2})
    for cell, (study, status, reason) in ENDS.items():
        found.write_cell({"cell": cell, "study_hash": study, "status": status, "reason": reason}, [])
    queries: list[dict[str, Any]] = [{"cell": "both", "query": k, "status": s} for k, s in enumerate(("timeout", "ok"))]
    found.write_cell({"cell": "both", "study_hash": "before", "status": "crashed"}, queries)
    keep_limits(found, "before", BEFORE)
    yield found
    found.close()


@pytest.mark.parametrize(
    ("changed", "again"),
    [
        ({}, set()),
        ({"query_seconds": 1.0, "cell_seconds": 1.0, "memory_gib": 1.0}, set()),
        ({"query_seconds": 21.0}, {"slow", "both"}),
        ({"cell_seconds": 601.0}, {"slow", "both"}),
        ({"memory_gib": 9.0, "query_seconds": 1.0}, {"large"}),
        ({"memory_gib": 9.0, "cell_seconds": 601.0}, {"slow", "both", "large"}),
    ],
)
def test_cells_that_ended_by_a_limit_are_run_again_where_it_is_larger(
    database: ResultsDatabase, changed: dict[str, float], again: set[str]
) -> None:
    assert ended_by_smaller_limits(database, BEFORE.model_copy(update=changed)) == again


def test_limits_are_those_of_the_rows_and_not_of_the_last_study(database: ResultsDatabase) -> None:
    larger = BEFORE.model_copy(update={"cell_seconds": 700.0})
    keep_limits(database, "after", larger)
    database.write_cell({"cell": "slow", "study_hash": "after", "status": "timeout"}, [])
    assert ended_by_smaller_limits(database, larger) == {"both"}
    assert ended_by_smaller_limits(database, BEFORE) == set()
