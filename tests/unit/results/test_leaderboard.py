"""The leaderboard: who wins is found by brute force, and what does not count is counted."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import cells_of, row_of

from vibench.results.ranking import COMPARED, LARGEST_BAND, Criterion, Standings, leaderboard


def won(standings: Standings, criterion: Criterion) -> list[tuple[float, str]]:
    found = [(band.error, band.winner(criterion)) for band in standings.bands]
    return [(error, str(winner.cell["cell"])) for error, winner in found if winner is not None]


def test_the_fastest_query_is_named_for_every_band() -> None:
    (found,) = leaderboard(
        cells_of(
            row_of("a", 0.05, 1.0),
            row_of("b", 0.06, 2.0),
            row_of("c", 4e-3, 3.0),
            row_of("d", 3e-3, 2.5),
        )
    )
    assert won(found, Criterion.QUERY) == [(0.1, "a"), (0.01, "d")]
    assert [band.cells for band in found.bands] == [4, 2]
    assert won(found, Criterion.ERROR) == [(0.1, "d"), (0.01, "d")]


def test_a_model_that_is_unstable_and_ten_per_cent_off_wins_nothing() -> None:
    """However fast it is; nor does one that is only unstable, or only above the largest band."""
    wrong = row_of("wrong", 0.1, 1e-6, beta_span_min=0.0, offline_s=1e-3)
    unstable = row_of("unstable", 1e-8, 1e-6, beta_span_min=1e-17, offline_s=1e-3)
    inexact = row_of("inexact", 0.11, 1e-6, offline_s=1e-3)
    (found,) = leaderboard(cells_of(wrong, row_of("right", 0.1, 1.0), unstable, inexact))
    assert {name for criterion in Criterion for _, name in won(found, criterion)} == {"right"}
    assert (found.cells, found.unstable, found.inexact, found.incomplete) == (4, 2, 1, 0)


def test_what_is_not_ok_or_solved_too_loosely_takes_no_part() -> None:
    (found,) = leaderboard(
        cells_of(
            row_of("failed", 1e-9, 1e-9, status="inaccurate"),
            row_of("loose", 1e-3, 1e-9, solver_share_mean=0.5),
            row_of("interpolated", 1e-3, 1e-9, assembly_share_mean=0.5),
            row_of("unknown", None, 1e-9, error_u_mean=None),
            row_of("untimed", 1e-4, None),
        )
    )
    assert won(found, Criterion.QUERY) == []
    assert won(found, Criterion.ERROR) == [(1e-4, "untimed")]
    assert (found.incomplete, found.loose, found.interpolated, found.inexact) == (1, 1, 1, 1)


def test_constants_that_were_not_computed_exclude_nobody() -> None:
    (found,) = leaderboard(cells_of(row_of("a", 1e-3, 1.0, beta_span_min=None)))
    assert won(found, Criterion.QUERY) == [(1e-3, "a")]


def test_problems_are_apart_and_an_empty_table_has_none() -> None:
    found = leaderboard(
        cells_of(
            row_of("a", 0.05, 2.0),
            row_of("b", 0.05, 1.0, problem="bar"),
            row_of("c", 0.5, 1.0, problem="c"),
        )
    )
    assert [(one.problem, won(one, Criterion.QUERY)) for one in found] == [
        ("box", [(0.1, "a")]),
        ("bar", [(0.1, "b")]),
        ("c", []),
    ]
    assert leaderboard(cells_of()) == ()


some = st.floats(1e-6, 1.0)


@settings(max_examples=50)
@given(st.lists(st.tuples(some, some, some, st.sampled_from([0.0, 0.3])), min_size=1, max_size=8))
def test_nobody_in_a_band_is_better_than_its_winner(found: list[tuple[float, float, float, float]]) -> None:
    rows = [
        row_of(str(k), error, online, offline_s=offline, beta_span_min=beta)
        for k, (error, online, offline, beta) in enumerate(found)
    ]
    (standings,) = leaderboard(cells_of(*rows))
    for band in standings.bands:
        mine = [one for one in found if one[0] <= band.error * (1 + 1e-12) and one[3] > 0.0]
        assert len(mine) == band.cells
        for criterion, place in ((Criterion.ERROR, 0), (Criterion.QUERY, 1), (Criterion.OFFLINE, 2)):
            winner = band.winner(criterion)
            assert winner is not None
            assert winner.value == pytest.approx(min(one[place] for one in mine))
            assert found[int(winner.cell["cell"])][place] == winner.value
        assert band.error <= LARGEST_BAND * (1 + 1e-12)
    taken = [one for one in found if one[0] <= LARGEST_BAND and one[3] > 0.0]
    assert bool(standings.bands) == bool(taken)
    assert set(COMPARED) == set(Criterion)
