"""The leaderboard: who wins is found by brute force, and what does not count is counted."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import cells_of, row_of

from vibench.results.paired_timing import PairedTiming
from vibench.results.ranking import LARGEST_BAND, Criterion, Standings, leaderboard


def won(standings: Standings, criterion: Criterion) -> list[tuple[float, str]]:
    found = [(band.error, band.winner(criterion)) for band in standings.bands]
    return [(error, str(winner.cell["cell"])) for error, winner in found if winner is not None]


def test_the_fastest_query_is_named_for_every_band() -> None:
    rows = row_of("a", 0.05, 0.1), row_of("b", 0.06, 0.2), row_of("c", 4e-3, 0.3), row_of("d", 3e-3, 0.25)
    (found,) = leaderboard(cells_of(*rows))
    assert won(found, Criterion.QUERY) == [(0.1, "a"), (0.01, "d")]
    assert [band.cells for band in found.bands] == [4, 2]
    assert won(found, Criterion.ERROR) == [(0.1, "d"), (0.01, "d")]


def test_what_is_inexact_wins_nothing_and_what_is_unstable_is_marked() -> None:
    """β over the span may vanish at a parameter although λ is unique in the queries: their errors are what counts."""
    unstable = row_of("unstable", 1e-8, 1e-6, beta_span_min=1e-17, offline_s=1e-3)
    inexact = row_of("inexact", 0.11, 1e-7, offline_s=1e-4)
    (found,) = leaderboard(cells_of(row_of("right", 0.1, 0.4), unstable, inexact))
    assert {name for criterion in Criterion for _, name in won(found, criterion)} == {"unstable"}
    assert (found.cells, found.unstable, found.inexact, found.incomplete) == (3, 1, 1, 0)


def test_the_high_fidelity_model_wins_where_no_query_is_faster_and_paces_every_machine() -> None:
    (found,) = leaderboard(cells_of(row_of("a", 0.05, 0.4, hf_s=0.5), row_of("b", 1e-3, 0.6, hf_s=0.5)))
    assert won(found, Criterion.QUERY) == [(0.1, "a"), (1e-3, "")]
    winner = found.bands[-1].winner(Criterion.QUERY)
    assert winner is not None
    assert (winner.cell["primal"], winner.value) == ("high-fidelity", pytest.approx(0.5))
    (found,) = leaderboard(cells_of(row_of("a", 0.05, 0.3, hf_s=1.0), row_of("b", 0.05, 0.2, hf_s=0.5)))
    assert won(found, Criterion.QUERY) == [(0.1, "a")]


def test_whose_interval_contains_no_difference_shares_the_place() -> None:
    cells = cells_of(*(row_of(name, 0.05, online, hf_s=1.0) for name, online in (("a", 0.2), ("b", 0.201), ("c", 0.3))))
    rng, timings = np.random.default_rng(0), []
    for row in cells.to_dict("records"):
        for k in range(12):
            seconds = {"total_s": row["online_s"] * np.exp(0.02 * rng.standard_normal()), "hf_s": 1.0, "pace": 1.0}
            timings.append({"cell": row["cell"], "block": str(k // 3)} | seconds)
    (found,) = leaderboard(cells, PairedTiming(timings))
    ties = {one.criterion: one.ties for one in found.bands[0].winners}
    assert ties[Criterion.QUERY] == ("b",)
    # errors are equal, and so are offline seconds, of which all phases are the same
    assert ties[Criterion.ERROR] == ties[Criterion.OFFLINE] == ("b", "c")
    (found,) = leaderboard(cells)
    assert found.bands[0].winners[0].ties == ()  # nothing is known of the rounds


def test_errors_that_differ_by_what_the_solver_makes_of_them_are_ties() -> None:
    parts = {"solver_error_u_max": 1e-9, "solver_error_lambda_max": 1e-5}
    rows = [row_of(name, error, 0.1, **parts) for name, error in (("a", 1.001e-2), ("b", 1e-2), ("c", 1.1e-2))]
    (found,) = leaderboard(cells_of(*rows))
    winner = found.bands[0].winner(Criterion.ERROR)
    assert winner is not None
    assert (winner.cell["cell"], winner.ties) == ("b", ("a",))


def test_what_is_not_ok_or_too_loose_takes_no_part_and_constants_exclude_nobody() -> None:
    (found,) = leaderboard(
        cells_of(
            row_of("failed", 1e-9, 1e-9, status="inaccurate"), row_of("loose", 1e-3, 1e-9, solver_share_mean=0.5),
            row_of("interpolated", 1e-3, 1e-9, assembly_share_mean=0.5),
            row_of("unknown", None, 1e-9, error_u_mean=None), row_of("untimed", 1e-4, None),
        )
    )  # fmt: skip
    assert won(found, Criterion.QUERY) == []
    assert won(found, Criterion.ERROR) == [(1e-4, "untimed")]
    assert (found.incomplete, found.loose, found.interpolated, found.inexact) == (1, 1, 1, 1)
    (found,) = leaderboard(cells_of(row_of("a", 1e-3, 0.1, beta_span_min=None)))
    assert won(found, Criterion.QUERY) == [(1e-3, "a")]


def test_problems_are_apart_and_an_empty_table_has_none() -> None:
    rows = row_of("a", 0.05, 0.2), row_of("b", 0.05, 0.1, problem="bar"), row_of("c", 0.5, 0.1, problem="c")
    found = leaderboard(cells_of(*rows))
    assert [(one.problem, won(one, Criterion.QUERY)) for one in found] == [
        ("box", [(0.1, "a")]), ("bar", [(0.1, "b")]), ("c", []),
    ]  # fmt: skip
    assert leaderboard(cells_of()) == ()


some = st.floats(1e-6, 0.49)
"""Numbers below the seconds of a high-fidelity solution, 0.5 in all rows."""


@settings(max_examples=50)
@given(st.lists(st.tuples(some, some, some, st.sampled_from([0.0, 0.3])), min_size=1, max_size=8))
def test_nobody_in_a_band_is_better_than_its_winner(found: list[tuple[float, float, float, float]]) -> None:
    rows = [
        row_of(str(k), error, online, offline_s=offline, beta_span_min=beta)
        for k, (error, online, offline, beta) in enumerate(found)
    ]
    (standings,) = leaderboard(cells_of(*rows))
    for band in standings.bands:
        mine = [one for one in found if one[0] <= band.error * (1 + 1e-12)]
        assert len(mine) == band.cells
        for criterion, place in ((Criterion.ERROR, 0), (Criterion.QUERY, 1), (Criterion.OFFLINE, 2)):
            winner = band.winner(criterion)
            assert winner is not None
            assert winner.value == pytest.approx(min(one[place] for one in mine))
            assert found[int(winner.cell["cell"])][place] == winner.value
        assert band.error <= LARGEST_BAND * (1 + 1e-12)
    taken = [one for one in found if one[0] <= LARGEST_BAND]
    assert bool(standings.bands) == bool(taken)
