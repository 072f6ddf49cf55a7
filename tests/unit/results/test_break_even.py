from collections.abc import Callable, Iterable, Mapping
from itertools import product
from typing import Any

import numpy as np
import pytest
from counting import growth
from hypothesis import assume, given
from hypothesis import strategies as st
from samples import cell_row

from vibench.results import paired_timing
from vibench.results.break_even import BreakEven, Meaning, break_even, break_even_rows
from vibench.results.schema import STORED
from vibench.timing import FEWEST_ROUNDS

OTHER_RUNS = float(np.exp(1.96 * paired_timing.CONDITIONS))
"""Half the width of the interval of a ratio that all rounds of a run agree on, as a factor."""

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


def test_the_thresholds_of_the_paper_and_their_meanings() -> None:
    for case, (offline_a, online_a, offline_b, online_b, printed) in PAPER.items():
        assert str(break_even(offline_a, online_a, offline_b, online_b)) == f"from {printed}", case
    for seconds, number, meaning in (
        ((1.0, 0.5, 3.0, 0.25), 8.0, Meaning.FROM), ((3.0, 0.25, 1.0, 0.5), 8.0, Meaning.UNTIL),
        ((1.0, 0.25, 3.0, 0.5), None, Meaning.NEVER), ((3.0, 0.5, 1.0, 0.25), None, Meaning.AT_ONCE),
        ((1.0, 0.5, 3.0, 0.5), None, Meaning.NEVER), ((1.0, 0.25, 1.0, 0.5), None, Meaning.NEVER),
        ((3.0, 0.5, 1.0, 0.5), None, Meaning.AT_ONCE), ((1.0, 0.5, 1.0, 0.25), None, Meaning.AT_ONCE),
        ((1.0, 0.5, 1.0, 0.5), None, Meaning.AT_ONCE),
    ):  # fmt: skip
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


def cell(primal: str, kind: str, **columns: Any) -> dict[str, Any]:
    times = {"offline_s": 10.0, "online_s": 0.1, "hf_setup_s": 4.0, "hf_s": 2.0}
    times |= {"offline_snapshots_s": 6.0, "offline_pod_s": 1.0, "offline_cone_s": 1.0}
    times |= {"offline_enrichment_s": 0.0, "offline_assembly_s": 0.0}
    times |= {"offline_low_s": 10.0, "offline_high_s": 10.0}
    if "offline_s" in columns:
        columns = {"offline_low_s": columns["offline_s"], "offline_high_s": columns["offline_s"]} | columns
    return cell_row(f"{primal} {columns}", primal=primal, enrichment_kind=kind, **(times | columns))


def rounds(cells: Iterable[Mapping[str, Any]], count: int = 12) -> list[dict[str, Any]]:
    """Rounds without any noise, in blocks of four."""
    return [
        {"cell": cell["cell"], "round": k, "block": f"block {k // 4}", "pace": 1.0}
        | {"total_s": cell["online_s"], "hf_s": cell["hf_s"]}
        for cell in cells
        if cell["online_s"] is not None
        for k in range(count)
    ]  # fmt: skip


def compared(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return list(break_even_rows(cells, rounds(cells)))


def test_a_cell_costs_the_same_however_many_there_are() -> None:
    def run(groups: int) -> Callable[[], object]:
        both = (("a", "fixed"), ("b", "none"))
        cells = [cell(*kinds, pod_tol=0.1 / (k + 1)) for k in range(groups) for kinds in both]
        timings = rounds(cells, FEWEST_ROUNDS)
        return lambda: list(break_even_rows(cells, timings))

    assert growth(run, 10) < 1.1


def pairs(rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
    return [(row["primal_a"], row["primal_b"]) for row in rows]


EVERY = [cell("none", "none"), cell("varying", "per-parameter", online_s=0.5), cell("fixed", "fixed", offline_s=30.0)]


def test_enrichments_are_compared_with_the_high_fidelity_model_and_pairs_of_their_kinds() -> None:
    rows = [row for row in compared(EVERY) if row["primal_a"] == "high-fidelity"]
    assert [row["primal_b"] for row in rows] == ["none", "varying", "fixed"]
    for row in rows:
        assert (row["offline_a_s"], row["online_a_s"], row["primal_tol_a"]) == (4.0, 2.0, None)
    assert rows[0]["benefit_threshold"] == pytest.approx((10.0 - 4.0) / (2.0 - 0.1))
    assert rows[0]["meaning"] == "from"
    (row,) = [row for row in compared(EVERY) if row["primal_a"] != "high-fidelity"]
    assert (row["primal_a"], row["primal_b"]) == ("varying", "fixed")
    assert [row[name] for name in ("offline_a_s", "online_a_s", "offline_b_s", "online_b_s")] == [10.0, 0.5, 30.0, 0.1]
    assert row["benefit_threshold"] == pytest.approx((30.0 - 10.0) / (0.5 - 0.1))
    cells = [cell(f"v{k}", "per-parameter") for k in range(2)]
    cells += [cell("f", "fixed", primal_tol=tolerance) for tolerance in (0.5, 0.1, 0.01)]
    rows = [row for row in compared(cells) if row["primal_a"] != "high-fidelity"]
    assert len(rows) == 2 * 3
    assert {(row["primal_a"], row["primal_tol_b"]) for row in rows} == {*product(("v0", "v1"), (0.5, 0.1, 0.01))}
    fixed, unanswered = cell("fixed", "fixed"), [cell("varying", "per-parameter", online_s=None)]
    assert pairs(compared([*unanswered, fixed, cell("fixed", "fixed", online_s=None)])) == [("high-fidelity", "fixed")]
    assert compared([]) == []
    rows = compared(EVERY)
    keys = {one["primal"]: one["cell"] for one in EVERY}
    assert all(row["cell_b"] == keys[row["primal_b"]] for row in rows)
    assert {row["cell_a"] for row in rows} == {None, keys["varying"]}
    assert all(set(row) == set(STORED["thresholds"]) for row in rows)


SHARED: Mapping[str, Any] = {
    "problem": "other", "problem_options": "other", "dual": "other", "dual_options": "other", "solver": "other",
    "pod_tol": 0.25, "pod_size": 8, "dual_tol": 0.25, "dual_size": None,
}  # fmt: skip


def test_only_like_is_compared_with_like_but_of_another_assembly() -> None:
    for column, other in {**SHARED, "machine": "there"}.items():
        cells = [cell("varying", "per-parameter", machine="here"), cell("fixed", "fixed", machine="here")]
        assert ("varying", "fixed") in pairs(compared(cells))
        assert ("varying", "fixed") not in pairs(compared([cells[0], cells[1] | {column: other}])), column
    cells = [cell("varying", "per-parameter", assembly="full"), cell("fixed", "fixed", assembly="reduced")]
    (row,) = [row for row in compared(cells) if row["primal_a"] == "varying"]
    assert (row["assembly_a"], row["assembly_b"]) == ("full", "reduced")


def of(formulation: str, **columns: Any) -> dict[str, Any]:
    """A cell of a formulation other than the mixed program, without an axis whose columns are given as blank."""
    return cell("fixed", "fixed", formulation=formulation, formulation_options=f'{{"of": "{formulation}"}}', **columns)


def of_formulations(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row["cell_a"] is not None and row["formulation_a"] != row["formulation_b"]]


def test_formulations_are_compared_with_mixed_programs_of_any_group_and_certified_with_certified() -> None:
    cells = [cell("fixed", "fixed"), of("penalty", offline_s=12.0, online_s=0.05), of("local", online_s=0.2)]
    rows = of_formulations(compared(cells))
    assert [(row["formulation_a"], row["formulation_b"]) for row in rows] == [("mixed", "penalty"), ("mixed", "local")]
    assert [(row["cell_a"], row["cell_b"]) for row in rows] == [(cells[0]["cell"], one["cell"]) for one in cells[1:]]
    assert rows[0]["benefit_threshold"] == pytest.approx((12.0 - 10.0) / (0.1 - 0.05))
    assert [row["meaning"] for row in rows] == ["from", "never"]
    assert {row["formulation_a"] for row in compared(cells) if row["cell_a"] is None} == {"mixed"}
    for column in ("problem", "training", "validation", "machine", "correction", "dual", "solver"):
        assert not of_formulations(compared([cells[0], of("penalty", **{column: "other"})])), column
    cells = [cell("fixed", "fixed", assembly="reduced", bounds=bounds) for bounds in (0, 1)]
    rows = of_formulations(compared([*cells, of("penalty", assembly="reduced"), of("local", bounds=1)]))
    assert [(row["bounds_a"], row["formulation_b"]) for row in rows] == [(0, "penalty"), (1, "local")]
    cells = [cell("fixed", "fixed"), cell("fixed", "none", formulation="f", online_s=0.05, offline_s=12.0) | NO_CONE]
    timings = rounds(cells)
    for row in timings:
        if row["cell"] == cells[1]["cell"]:  # timed later, on a machine of half the speed
            row |= {"block": f"later {row['block']}", "total_s": 2 * row["total_s"], "hf_s": 2 * row["hf_s"]}
    (row,) = of_formulations(list(break_even_rows(cells, timings)))
    assert row["gain"] == pytest.approx(2.0)
    assert (row["online_a_s"], row["online_b_s"]) == (pytest.approx(0.1), pytest.approx(0.05))
    assert row["benefit_threshold"] == pytest.approx((12.0 - 10.0) / (0.1 - 0.05))


NO_CONE: Mapping[str, Any] = {"dual": "–", "dual_options": "{}", "dual_tol": None, "dual_size": None}
NO_ENRICHMENT: Mapping[str, Any] = {"primal": "–", "primal_options": "{}", "primal_tol": None}
LACKING: Mapping[str, Mapping[str, Any]] = {
    "dual": NO_CONE, "primal": NO_ENRICHMENT, "pod": {"pod_tol": None, "pod_size": None}, "solver": {"solver": "–"},
    "accuracy": {"accuracy": None},
}  # fmt: skip


@pytest.mark.parametrize("axis", LACKING)
def test_a_formulation_is_compared_over_the_axes_that_it_lacks(axis: str) -> None:
    others: dict[str, Any] = {"dual": "other", "primal": "other", "pod_tol": 0.5, "solver": "other", "accuracy": 0.25}
    name = "pod_tol" if axis == "pod" else axis
    mixed = [cell("fixed", "fixed", pod_tol=0.1), cell("fixed", "fixed", pod_tol=0.1) | {name: others[name]}]
    lacking = cell("fixed", "none", pod_tol=0.1, formulation="f") | LACKING[axis]
    rows = of_formulations(compared([*mixed, lacking, cell("fixed", "none", pod_tol=0.1, formulation="g")]))
    assert [row["formulation_b"] for row in rows] == ["f", "f", "g"]
    if axis != "primal":  # which has a column for each side
        assert [row[name] for row in rows] == [one[name] for one in (*mixed, mixed[0])]
    assert [row["primal_a"] for row in rows] == [one["primal"] for one in (*mixed, mixed[0])]


def the_one(cells: list[dict[str, Any]], timings: list[dict[str, Any]]) -> dict[str, Any]:
    (row,) = [row for row in break_even_rows(cells, timings) if row["primal_a"] != "high-fidelity"]
    return row


def noisy(a: float, b: float, noise: float, count: int = 24, **of_b: Any) -> dict[str, Any]:
    """Comparison of two cells of so many seconds per query, measured with noise that differs from round to round."""
    cells = [cell("varying", "per-parameter", online_s=a), cell("fixed", "fixed", online_s=b, offline_s=12.0, **of_b)]
    rng, timings = np.random.default_rng(0), rounds(cells, count)
    for row in timings:
        row["total_s"] *= np.exp(noise * rng.standard_normal())
    return the_one(cells, timings)


def test_differences_within_the_noise_or_of_one_block_are_undecided() -> None:
    """Both signs are possible: neither "from" nor "never" would repeat itself in another run."""
    row = noisy(0.100, 0.092, noise=0.4)
    assert (row["meaning"], row["benefit_threshold"], row["threshold_high"]) == ("undecided", None, None)
    assert row["threshold_low"] > 0.0
    assert 24 < row["rounds_missing"] < 1e6 - 24
    for a, b, meaning in ((0.200, 0.100, "from"), (0.100, 0.200, "never")):
        decided = noisy(a, b, noise=0.1)
        assert (decided["meaning"], decided["rounds_missing"]) == (meaning, None)
    row = noisy(0.200, 0.100, noise=0.01, offline_low_s=4.0, offline_high_s=36.0)
    assert (row["meaning"], row["rounds_missing"]) == ("undecided", None)
    for count, meaning in ((1, "undecided"), (4, "undecided"), (8, "from")):  # a block has four rounds
        row = noisy(0.2, 0.1, noise=0.0, count=count)
        assert (row["meaning"], row["benefit_threshold"] is None) == (meaning, meaning == "undecided")
    row = noisy(0.200, 0.100, noise=0.05)
    dearer, faster = row["offline_b_s"] - row["offline_a_s"], row["online_a_s"] - row["online_b_s"]
    assert row["benefit_threshold"] == pytest.approx(dearer / faster)
    assert row["gain"] == pytest.approx(row["online_a_s"] / row["online_b_s"])
    assert row["gain_low"] < row["gain"] < row["gain_high"]
    assert row["threshold_low"] < row["benefit_threshold"] < row["threshold_high"]


def test_rounds_that_both_have_are_compared_whatever_disturbs_them() -> None:
    """Rounds in which everything takes up to four times as long leave the ratio as exact as it is."""
    cells = [cell("varying", "per-parameter", online_s=0.2), cell("fixed", "fixed", online_s=0.100, offline_s=12.0)]
    timings = rounds(cells)
    for row in timings:
        for name in ("total_s", "hf_s", "pace"):
            row[name] *= 1.0 + row["round"] / 4.0
    row = the_one(cells, timings)
    assert row["meaning"] == "from"
    assert (row["gain_low"], row["gain_high"]) == pytest.approx((2.0 / OTHER_RUNS, 2.0 * OTHER_RUNS), rel=1e-3)
    cells = [cell("varying", "per-parameter", online_s=0.101), cell("fixed", "fixed", online_s=0.100, offline_s=12.0)]
    timings = rounds(cells)
    for row in timings:
        row["total_s"] *= 1.0 + int(row["block"][-1])
    row = the_one(cells, timings)
    assert (row["gain_low"], row["gain_high"]) == pytest.approx((1.01 / OTHER_RUNS, 1.01 * OTHER_RUNS), rel=1e-3)
    assert (row["meaning"], row["benefit_threshold"], row["threshold_low"]) == ("as fast", None, None)
    # Whose comparisons are decided is timed no more; the machine may be another afterwards.
    cells = [cell("varying", "per-parameter", online_s=0.2), cell("fixed", "fixed", online_s=0.1, offline_s=12.0)]
    timings = [row for row in rounds(cells) if row["round"] < 8 or row["cell"] == cells[1]["cell"]]
    for row in timings:
        row["total_s"] *= 5.0 if row["round"] >= 8 else 1.0
    row = the_one(cells, timings)
    assert (row["online_a_s"], row["online_b_s"], row["gain"]) == pytest.approx((0.2, 0.1, 2.0))


def test_what_another_run_may_reverse_is_as_fast_and_intervals_overlap() -> None:
    """A gain whose interval lies between 1/1.25 and 1.25 is decided: no number of queries is claimed."""
    for gain, noise, meaning in (
        (1.0, 1e-3, "as fast"), (1.08, 1e-3, "as fast"), (1 / 1.08, 1e-3, "as fast"), (1.15, 1e-3, "from"),
        (1 / 1.15, 1e-3, "never"), (1.0, 0.4, "undecided"), (1.08, 0.4, "undecided"), (3.0, 0.4, "from"),
    ):  # fmt: skip
        row = noisy(0.1 * gain, 0.1, noise)
        assert row["meaning"] == meaning
        assert (row["rounds_missing"] is None) == (meaning != "undecided")
        within = max(1.0 / row["gain_low"], row["gain_high"]) <= 1.25
        assert within or meaning != "as fast"
        exchanged = {"from": "never", "never": "from"}
        assert noisy(0.1, 0.1 * gain, noise)["meaning"] == exchanged.get(meaning, meaning)
    one = BreakEven(115.0, Meaning.FROM, 100.0, 130.5)
    for other, overlap in (
        (BreakEven(120.0, Meaning.FROM, 110.0, 130.0), True), (BreakEven(140.0, Meaning.FROM, 131.0, 150.0), False),
        (BreakEven(120.0, Meaning.UNTIL, 110.0, 130.0), False),
        (BreakEven(None, Meaning.UNDECIDED, 110.0, None), False),
    ):  # fmt: skip
        assert one.overlaps(other) is overlap
        assert other.overlaps(one) is overlap


def test_offline_seconds_and_solutions_are_as_uncertain_as_they_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of those that both share nothing is uncertain."""
    cells = [cell("varying", "per-parameter", online_s=0.2), cell("fixed", "fixed", offline_s=12.0)]
    monkeypatch.setattr(paired_timing, "CONDITIONS", 0.0)
    steady = the_one(cells, rounds(cells))
    assert (steady["threshold_low"], steady["threshold_high"]) == (pytest.approx(20.0), pytest.approx(20.0))
    wide = [{**one, "offline_low_s": one["offline_s"] / 1.2, "offline_high_s": one["offline_s"] * 1.2} for one in cells]
    unsteady = the_one(wide, rounds(wide))
    # 8 s are shared; the other 4 s of the one and 2 s of the other deviate independently, with this spread.
    spread = np.hypot(4.0, 2.0) * np.log(1.2) / 1.96
    ends = (unsteady["threshold_low"], unsteady["threshold_high"])
    assert ends == pytest.approx(((2.0 - 1.96 * spread) / 0.1, (2.0 + 1.96 * spread) / 0.1), rel=0.1)
    spread = {"offline_low_s": 7.0, "offline_high_s": 9.0}
    cells = [cell("varying", "per-parameter", online_s=0.2), cell("fixed", "fixed")]
    alone = [{**one, **spread, "offline_s": 8.0} for one in cells]  # nothing but what they share
    alone[1]["offline_s"] += 1e-3
    row = the_one(alone, rounds(alone))
    assert row["meaning"] == "from"
    assert row["threshold_high"] == pytest.approx(row["threshold_low"], rel=0.3)
    close = [cell("none", "none", online_s=1.7)]
    meanings = []
    for noise in (1e-4, 0.4):
        rng, timings = np.random.default_rng(0), rounds(close)
        for row in timings:
            row["hf_s"] *= np.exp(noise * rng.standard_normal())
        meanings.append(next(break_even_rows(close, timings))["meaning"])
    assert meanings == ["from", "undecided"]
