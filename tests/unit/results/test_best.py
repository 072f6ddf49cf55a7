"""The fastest query at every error that is reached."""

from __future__ import annotations

from typing import Any

import pandas as pd
from samples import cell_row

from vibench.results import tables
from vibench.results.best import BAND, HEADINGS, fastest
from vibench.results.columns import CELLS


def cells(*rows: dict[str, Any]) -> pd.DataFrame:
    common = {
        "problem": "box",
        "problem_options": "{}",
        "status": "ok",
        "beta_span_min": 0.1,
        "solver_share_mean": 1e-6,
    }
    return pd.DataFrame([cell_row(**common | row) for row in rows], columns=list(CELLS))


def row(cell: str, error: float | None, online: float | None, **more: Any) -> dict[str, Any]:
    return {"cell": cell, "error_u_mean": 1e-9, "error_lambda_mean": error, "online_s": online, **more}


def test_every_error_that_is_reached_has_its_fastest_cell() -> None:
    found = fastest(cells(row("a", 0.05, 1.0), row("b", 0.06, 2.0), row("c", 0.004, 3.0), row("d", 0.003, 2.5)))
    assert list(zip(found["cell"], found[BAND], strict=True)) == [("a", 0.1), ("d", 0.01)]


def test_an_exact_cell_that_is_the_fastest_stands_alone() -> None:
    assert list(fastest(cells(row("a", 0.05, 2.0), row("b", 1e-5, 1.0)))["cell"]) == ["b"]


def test_cells_that_no_leaderboard_names_take_no_part() -> None:
    others = (
        row("b", 1e-5, 0.1, status="inaccurate"), row("c", 1e-5, None), row("d", None, 0.1, error_u_mean=None),
        row("e", 1e-5, 0.1, beta_span_min=0.0), row("f", 1e-5, 0.1, solver_share_mean=0.5), row("g", 0.11, 0.1),
    )  # fmt: skip
    assert list(fastest(cells(row("a", 0.05, 2.0), *others))["cell"]) == ["a"]
    assert fastest(cells(*others)).empty
    assert fastest(cells()).empty


def test_problems_are_apart_and_an_error_of_zero_is_one() -> None:
    found = fastest(cells(row("a", 0.05, 1.0), row("b", 0.0, 2.0, problem="zero", error_u_mean=0.0)))
    assert list(found["cell"]) == ["a", "b"]
    assert "error ≤" in tables.under_headings(found, ["problem", BAND], HEADINGS)
