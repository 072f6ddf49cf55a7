"""The fastest query at every error that is reached."""

from __future__ import annotations

from samples import cells_of, row_of

from vibench.results import formats
from vibench.results.ranking import fastest, fastest_columns


def test_every_error_that_is_reached_has_its_fastest_cell() -> None:
    found = fastest(
        cells_of(row_of("a", 0.05, 0.1), row_of("b", 0.06, 0.2), row_of("c", 0.004, 0.3), row_of("d", 0.003, 0.25))
    )
    assert list(zip(found["cell"], found["error_below"], strict=True)) == [("a", 0.1), ("d", 0.01)]


def test_an_exact_cell_that_is_the_fastest_stands_alone() -> None:
    assert list(fastest(cells_of(row_of("a", 0.05, 0.2), row_of("b", 1e-5, 0.1)))["cell"]) == ["b"]


def test_cells_that_no_leaderboard_names_take_no_part() -> None:
    others = (
        row_of("b", 1e-5, 0.1, status="inaccurate"), row_of("c", 1e-5, None), row_of("d", None, 0.1, error_u_mean=None),
        row_of("f", 1e-5, 0.1, solver_share_mean=0.5),
        row_of("g", 0.11, 0.01),
    )  # fmt: skip
    assert list(fastest(cells_of(row_of("a", 0.05, 0.2), *others))["cell"]) == ["a"]
    assert fastest(cells_of(*others)).empty
    assert fastest(cells_of()).empty


def test_problems_are_apart_and_an_error_of_zero_is_one() -> None:
    found = fastest(cells_of(row_of("a", 0.05, 0.1), row_of("b", 0.0, 0.2, problem="zero", error_u_mean=0.0)))
    assert list(found["cell"]) == ["a", "b"]
    assert "error ≤" in formats.under_headings(found, ["problem", "error_below"], fastest_columns())
