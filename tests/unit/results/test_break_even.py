"""Benefit thresholds: the paper's, their four meanings, and which cells are compared."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from samples import cell_row

from vibench.results.break_even import BreakEven, Meaning, break_even, break_even_rows
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
    times = {"offline_s": 10.0, "online_s": 0.1, "hf_setup_s": 4.0, "hf_s": 2.0}
    return cell_row(f"{primal} {columns}", primal=primal, enrichment_kind=kind, **(times | columns))


def pairs(rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
    return [(row["primal_a"], row["primal_b"]) for row in rows]


EVERY = [cell("none", "none"), cell("varying", "per-parameter", online_s=0.5), cell("fixed", "fixed", offline_s=30.0)]


def test_every_strategy_is_compared_with_the_high_fidelity_model() -> None:
    rows = [row for row in break_even_rows(EVERY) if row["primal_a"] == "high-fidelity"]
    assert [row["primal_b"] for row in rows] == ["none", "varying", "fixed"]
    for row in rows:
        assert (row["offline_a_s"], row["online_a_s"], row["primal_tol_a"]) == (4.0, 2.0, None)
    assert rows[0]["benefit_threshold"] == pytest.approx((10.0 - 4.0) / (2.0 - 0.1))
    assert rows[0]["meaning"] == "from"


def test_per_parameter_enrichments_are_compared_with_fixed_ones() -> None:
    (row,) = [row for row in break_even_rows(EVERY) if row["primal_a"] != "high-fidelity"]
    assert (row["primal_a"], row["primal_b"]) == ("varying", "fixed")
    assert [row[name] for name in ("offline_a_s", "online_a_s", "offline_b_s", "online_b_s")] == [10.0, 0.5, 30.0, 0.1]
    assert row["benefit_threshold"] == pytest.approx((30.0 - 10.0) / (0.5 - 0.1))


def test_every_pair_of_kinds_is_compared() -> None:
    cells = [cell(f"v{k}", "per-parameter") for k in range(2)]
    cells += [cell("f", "fixed", primal_tol=tolerance) for tolerance in (0.5, 0.1, 0.01)]
    rows = [row for row in break_even_rows(cells) if row["primal_a"] != "high-fidelity"]
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
    assert ("varying", "fixed") not in pairs(break_even_rows(cells))


def test_another_assembly_may_be_compared() -> None:
    cells = [cell("varying", "per-parameter", assembly="full"), cell("fixed", "fixed", assembly="reduced")]
    (row,) = [row for row in break_even_rows(cells) if row["primal_a"] == "varying"]
    assert (row["assembly_a"], row["assembly_b"]) == ("full", "reduced")


def test_seconds_of_two_machines_are_not_compared() -> None:
    cells = [cell("varying", "per-parameter", machine="here"), cell("fixed", "fixed", machine="there")]
    assert ("varying", "fixed") not in pairs(break_even_rows(cells))


def test_cells_without_an_answer_are_left_out() -> None:
    cells = [
        cell("varying", "per-parameter", online_s=None),
        cell("fixed", "fixed"),
        cell("fixed", "fixed", online_s=None),
    ]
    assert pairs(break_even_rows(cells)) == [("high-fidelity", "fixed")]


def test_rows_fit_the_table() -> None:
    for row in break_even_rows(EVERY):
        assert set(row) == set(THRESHOLDS)


def test_nothing_comes_of_nothing() -> None:
    assert break_even_rows([]) == []
