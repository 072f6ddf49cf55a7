"""Benefit thresholds: the paper's, their four meanings, and which cells are compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import pytest
from counting import growth
from hypothesis import assume, given
from hypothesis import strategies as st
from samples import cell_row

from vibench.results.break_even import FEWEST_ROUNDS, BreakEven, Meaning, break_even, break_even_rows
from vibench.results.columns import THRESHOLDS

PAPER = {
    # (N, R): offline and online seconds of the online and of the offline enrichment, benefit threshold
    "obstacle (19, 50)": (1112, 14, 2296, 2.4, 102),
    "obstacle (51, 70)": (1193, 17, 2395, 2.5, 83),
    "obstacle (89, 50)": (1272, 14, 1884, 2.3, 52),
    "Hertz (3, 12)": (8490, 75, 18098, 18, 169),
    "Hertz (46, 70)": (10889, 162, 19750, 20, 62),
    "Hertz (46, 12)": (10874, 78, 18312, 19, 126),
}
"""Tables 1 and 2 of Niakh, Drouet, Ehrlacher and Ern (2022); the online seconds they print are those of one query."""


@pytest.mark.parametrize("case", PAPER)
def test_the_thresholds_of_the_paper(case: str) -> None:
    offline_a, online_a, offline_b, online_b, printed = PAPER[case]
    found = break_even(offline_a, online_a, offline_b, online_b)
    assert found.number is not None
    assert round(found.number) == printed
    assert str(found) == f"from {printed}"


@pytest.mark.parametrize(
    ("seconds", "number", "meaning"),
    [
        ((1.0, 0.5, 3.0, 0.25), 8.0, Meaning.FROM),
        ((3.0, 0.25, 1.0, 0.5), 8.0, Meaning.UNTIL),
        ((1.0, 0.25, 3.0, 0.5), None, Meaning.NEVER),
        ((3.0, 0.5, 1.0, 0.25), None, Meaning.AT_ONCE),
        ((1.0, 0.5, 3.0, 0.5), None, Meaning.NEVER),
        ((1.0, 0.25, 1.0, 0.5), None, Meaning.NEVER),
        ((3.0, 0.5, 1.0, 0.5), None, Meaning.AT_ONCE),
        ((1.0, 0.5, 1.0, 0.25), None, Meaning.AT_ONCE),
        ((1.0, 0.5, 1.0, 0.5), None, Meaning.AT_ONCE),
    ],
)
def test_the_meaning_of_a_threshold(seconds: tuple[float, ...], number: float | None, meaning: Meaning) -> None:
    found = break_even(*seconds)
    assert found == BreakEven(number, meaning)
    assert str(found) == (meaning.value if number is None else f"{meaning.value} {number:.0f}")


seconds = st.floats(1e-3, 1e5)


@given(seconds, seconds, seconds, seconds)
def test_beyond_the_threshold_the_totals_change_sides(off_a: float, on_a: float, off_b: float, on_b: float) -> None:
    assume(all(abs(x - y) > 1e-6 * x for x, y in ((off_a, off_b), (on_a, on_b))))  # differences beyond round-off
    found = break_even(off_a, on_a, off_b, on_b)

    def advantage(queries: float) -> float:
        return (off_a + queries * on_a) - (off_b + queries * on_b)

    if found.number is None:
        sign = 1.0 if found.meaning is Meaning.AT_ONCE else -1.0
        assert all(sign * advantage(queries) >= 0.0 for queries in (0.0, 1.0, 1e6))
        return
    assert found.number > 0.0
    sign = 1.0 if found.meaning is Meaning.FROM else -1.0
    assert sign * advantage(1.01 * found.number) > 0.0
    assert sign * advantage(0.99 * found.number) < 0.0


@given(seconds, seconds, seconds, seconds)
def test_the_two_ways_exchanged_turn_from_into_until(off_a: float, on_a: float, off_b: float, on_b: float) -> None:
    assume((off_a, on_a) != (off_b, on_b))
    one, other = break_even(off_a, on_a, off_b, on_b), break_even(off_b, on_b, off_a, on_a)
    opposite = {Meaning.FROM: Meaning.UNTIL, Meaning.NEVER: Meaning.AT_ONCE}
    opposite |= {second: first for first, second in opposite.items()}
    assert other.meaning is opposite[one.meaning]
    assert other.number == one.number


def cell(primal: str, kind: str, **columns: Any) -> dict[str, Any]:
    times = {"offline_s": 10.0, "online_s": 0.1, "hf_setup_s": 4.0, "hf_s": 2.0, "hf_low_s": 1.9, "hf_high_s": 2.1}
    times |= {"offline_snapshots_s": 6.0, "offline_pod_s": 1.0, "offline_cone_s": 1.0}
    return cell_row(f"{primal} {columns}", primal=primal, enrichment_kind=kind, **(times | columns))


def rounds(cells: Iterable[Mapping[str, Any]], count: int = 12, slow: float = 1.0) -> list[dict[str, Any]]:
    """Rounds without any noise; in the last one the machine is slower by a factor."""
    return [
        {"cell": cell["cell"], "round": k, "total_s": cell["online_s"] * factor, "slowdown": factor}
        for cell in cells
        if cell["online_s"] is not None
        for k, factor in enumerate([1.0] * (count - 1) + [slow])
    ]


def compared(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return list(break_even_rows(cells, rounds(cells)))


def test_a_cell_costs_the_same_however_many_there_are() -> None:
    def run(groups: int) -> Callable[[], object]:
        cells = [
            cell(*kinds, pod_tol=0.1 / (k + 1)) for k in range(groups) for kinds in (("a", "fixed"), ("b", "none"))
        ]
        timings = rounds(cells, FEWEST_ROUNDS)
        return lambda: list(break_even_rows(cells, timings))

    assert growth(run, 10) < 1.1


def pairs(rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
    return [(row["primal_a"], row["primal_b"]) for row in rows]


EVERY = [cell("none", "none"), cell("varying", "per-parameter", online_s=0.5), cell("fixed", "fixed", offline_s=30.0)]


def test_every_strategy_is_compared_with_the_high_fidelity_model() -> None:
    rows = [row for row in compared(EVERY) if row["primal_a"] == "high-fidelity"]
    assert [row["primal_b"] for row in rows] == ["none", "varying", "fixed"]
    for row in rows:
        assert (row["offline_a_s"], row["online_a_s"], row["primal_tol_a"]) == (4.0, 2.0, None)
    assert rows[0]["benefit_threshold"] == pytest.approx((10.0 - 4.0) / (2.0 - 0.1))
    assert rows[0]["meaning"] == "from"


def test_per_parameter_enrichments_are_compared_with_fixed_ones() -> None:
    (row,) = [row for row in compared(EVERY) if row["primal_a"] != "high-fidelity"]
    assert (row["primal_a"], row["primal_b"]) == ("varying", "fixed")
    assert [row[name] for name in ("offline_a_s", "online_a_s", "offline_b_s", "online_b_s")] == [10.0, 0.5, 30.0, 0.1]
    assert row["benefit_threshold"] == pytest.approx((30.0 - 10.0) / (0.5 - 0.1))


def test_every_pair_of_kinds_is_compared() -> None:
    cells = [cell(f"v{k}", "per-parameter") for k in range(2)]
    cells += [cell("f", "fixed", primal_tol=tolerance) for tolerance in (0.5, 0.1, 0.01)]
    rows = [row for row in compared(cells) if row["primal_a"] != "high-fidelity"]
    assert len(rows) == 2 * 3
    assert {(row["primal_a"], row["primal_tol_b"]) for row in rows} == {
        (name, tolerance) for name in ("v0", "v1") for tolerance in (0.5, 0.1, 0.01)
    }


SHARED: Mapping[str, Any] = {
    "problem": "other", "problem_options": "other", "dual": "other", "dual_options": "other", "solver": "other",
    "pod_tol": 0.25, "pod_size": 8, "dual_tol": 0.25, "dual_size": None,
}  # fmt: skip


@pytest.mark.parametrize("column", SHARED)
def test_only_like_is_compared_with_like(column: str) -> None:
    cells = [cell("varying", "per-parameter"), cell("fixed", "fixed", **{column: SHARED[column]})]
    assert ("varying", "fixed") not in pairs(compared(cells))


def test_another_assembly_may_be_compared() -> None:
    cells = [cell("varying", "per-parameter", assembly="full"), cell("fixed", "fixed", assembly="reduced")]
    (row,) = [row for row in compared(cells) if row["primal_a"] == "varying"]
    assert (row["assembly_a"], row["assembly_b"]) == ("full", "reduced")


def test_seconds_of_two_machines_are_not_compared() -> None:
    cells = [cell("varying", "per-parameter", machine="here"), cell("fixed", "fixed", machine="there")]
    assert ("varying", "fixed") not in pairs(compared(cells))


def test_cells_without_an_answer_are_left_out() -> None:
    cells = [
        cell("varying", "per-parameter", online_s=None),
        cell("fixed", "fixed"),
        cell("fixed", "fixed", online_s=None),
    ]
    assert pairs(compared(cells)) == [("high-fidelity", "fixed")]


def test_rows_fit_the_table() -> None:
    for row in compared(EVERY):
        assert set(row) == set(THRESHOLDS)


def test_nothing_comes_of_nothing() -> None:
    assert compared([]) == []


def the_one(cells: list[dict[str, Any]], timings: list[dict[str, Any]]) -> dict[str, Any]:
    """The comparison of the two cells with each other."""
    (row,) = [row for row in break_even_rows(cells, timings) if row["primal_a"] != "high-fidelity"]
    return row


def noisy(a: float, b: float, noise: float, count: int = 12, seed: int = 0) -> dict[str, Any]:
    """Comparison of two cells of so many seconds per query, measured with noise that differs from round to round."""
    cells = [cell("varying", "per-parameter", online_s=a), cell("fixed", "fixed", online_s=b, offline_s=12.0)]
    rng, timings = np.random.default_rng(seed), rounds(cells, count)
    for row in timings:
        row["total_s"] *= 1.0 + noise * rng.standard_normal()
    for one in cells:
        one["online_s"] = float(np.median([row["total_s"] for row in timings if row["cell"] == one["cell"]]))
    return the_one(cells, timings)


def test_a_difference_within_the_noise_is_undecided() -> None:
    """Both signs occur among the resamples: neither "from" nor "never" would repeat itself in another run."""
    row = noisy(0.100, 0.099, noise=0.1)
    assert (row["meaning"], row["benefit_threshold"], row["threshold_high"]) == ("undecided", None, None)
    assert row["threshold_low"] > 0.0
    assert noisy(0.200, 0.100, noise=0.1)["meaning"] == "from"
    assert noisy(0.100, 0.200, noise=0.1)["meaning"] == "never"


def test_an_interval_contains_the_truth_about_as_often_as_it_says() -> None:
    """Two runs agree then: of 60, the true number lies in at least nine tenths of the intervals."""
    true = (12.0 - 10.0) / (0.2 - 0.1)
    found = [noisy(0.2, 0.1, noise=0.1, seed=seed) for seed in range(60)]
    assert {row["meaning"] for row in found} == {"from"}
    assert sum(row["threshold_low"] <= true <= row["threshold_high"] for row in found) >= 54


def test_what_disturbs_a_round_disturbs_both_models() -> None:
    """A round in which everything takes thrice as long widens an interval of paired rounds as little as it can."""
    cells = [cell("varying", "per-parameter", online_s=0.101), cell("fixed", "fixed", online_s=0.100, offline_s=12.0)]
    timings = rounds(cells)
    for row in timings:
        row["total_s"] *= 1.0 + row["round"] / 4.0
    for one in cells:
        one["online_s"] = float(np.median([row["total_s"] for row in timings if row["cell"] == one["cell"]]))
    row = the_one(cells, timings)
    assert row["meaning"] == "from"
    assert row["threshold_low"] < row["benefit_threshold"] < row["threshold_high"]


@pytest.mark.parametrize(("count", "meaning"), [(1, "undecided"), (5, "undecided"), (6, "from")])
def test_fewer_than_six_rounds_decide_nothing(count: int, meaning: str) -> None:
    row = noisy(0.2, 0.1, noise=0.0, count=count)
    assert row["meaning"] == meaning
    assert (row["benefit_threshold"] is None) == (meaning == "undecided")


def test_offline_seconds_are_as_uncertain_as_the_machine_was_unsteady() -> None:
    """They are measured once: that the machine was at times slower by half widens the interval by as much."""
    cells = [cell("varying", "per-parameter", online_s=0.2), cell("fixed", "fixed", offline_s=12.0)]
    steady, unsteady = (the_one(cells, rounds(cells, slow=slow)) for slow in (1.0, 1.5))
    assert steady["threshold_low"] == steady["threshold_high"] == pytest.approx(20.0)
    # 8 s are shared; the other 4 s of the one and 2 s of the other may each have been measured at the other speed.
    ends = (1.0 * 4.0 - 1.5 * 2.0) / 0.1, (1.5 * 4.0 - 1.0 * 2.0) / 0.1
    assert (unsteady["threshold_low"], unsteady["threshold_high"]) == pytest.approx(ends)


def test_shared_offline_phases_cancel() -> None:
    cells = [cell("varying", "per-parameter", online_s=0.2), cell("fixed", "fixed", offline_s=10.001)]
    row = the_one(cells, rounds(cells, slow=1.5))
    assert row["meaning"] in ("from", "undecided")
    alone = [{**one, "offline_s": one["offline_s"] - 2.0} for one in cells]  # nothing but what they share, and a bit
    assert the_one(alone, rounds(cells, slow=1.5))["meaning"] == "from"


def test_the_high_fidelity_model_is_as_uncertain_as_its_own_interval() -> None:
    close = {"online_s": 1.95}
    sharp = cell("none", "none", **close, hf_low_s=1.999, hf_high_s=2.001)
    wide = cell("none", "none", **close, hf_low_s=1.8, hf_high_s=2.2)
    assert [compared([one])[0]["meaning"] for one in (sharp, wide)] == ["from", "undecided"]


def test_cells_are_named() -> None:
    rows = compared(EVERY)
    keys = {one["primal"]: one["cell"] for one in EVERY}
    assert all(row["cell_b"] == keys[row["primal_b"]] for row in rows)
    assert {row["cell_a"] for row in rows} == {None, keys["varying"]}


@pytest.mark.parametrize(
    ("other", "overlap"),
    [
        (BreakEven(120.0, Meaning.FROM, 110.0, 130.0), True),
        (BreakEven(140.0, Meaning.FROM, 131.0, 150.0), False),
        (BreakEven(120.0, Meaning.UNTIL, 110.0, 130.0), False),
        (BreakEven(None, Meaning.UNDECIDED, 110.0, None), False),
    ],
)
def test_intervals_overlap_where_they_have_a_number_in_common(other: BreakEven, overlap: bool) -> None:
    one = BreakEven(115.0, Meaning.FROM, 100.0, 130.5)
    assert one.overlaps(other) is overlap
    assert other.overlaps(one) is overlap
