"""The fastest query at every error that is reached."""

from __future__ import annotations

from samples import cells_of, row_of

from vibench.results import tables
from vibench.results.ranking import BAND, HEADINGS, fastest


def test_every_error_that_is_reached_has_its_fastest_cell() -> None:
    found = fastest(
        cells_of(
            row_of("a", 0.05, 1.0),
            row_of("b", 0.06, 2.0),
            row_of("c", 0.004, 3.0),
            row_of("d", 0.003, 2.5),
        )
    )
    assert list(zip(found["cell"], found[BAND], strict=True)) == [("a", 0.1), ("d", 0.01)]


def test_an_exact_cell_that_is_the_fastest_stands_alone() -> None:
    assert list(fastest(cells_of(row_of("a", 0.05, 2.0), row_of("b", 1e-5, 1.0)))["cell"]) == ["b"]


def test_cells_that_no_leaderboard_names_take_no_part() -> None:
    others = (
        row_of("b", 1e-5, 0.1, status="inaccurate"), row_of("c", 1e-5, None), row_of("d", None, 0.1, error_u_mean=None),
        row_of("e", 1e-5, 0.1, beta_span_min=0.0), row_of("f", 1e-5, 0.1, solver_share_mean=0.5),
        row_of("g", 0.11, 0.1),
    )  # fmt: skip
    assert list(fastest(cells_of(row_of("a", 0.05, 2.0), *others))["cell"]) == ["a"]
    assert fastest(cells_of(*others)).empty
    assert fastest(cells_of()).empty


def test_problems_are_apart_and_an_error_of_zero_is_one() -> None:
    found = fastest(cells_of(row_of("a", 0.05, 1.0), row_of("b", 0.0, 2.0, problem="zero", error_u_mean=0.0)))
    assert list(found["cell"]) == ["a", "b"]
    assert "error ≤" in tables.under_headings(found, ["problem", BAND], HEADINGS)
