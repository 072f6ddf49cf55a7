from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vibench.reduction.cones import TIE, LazyMaximum


def plain(values: np.ndarray, excluded: set[int]) -> int:
    """What evaluating everything chooses."""
    kept = np.array([-np.inf if k in excluded else v for k, v in enumerate(values)])
    return int(np.flatnonzero(kept >= kept.max() - TIE)[0])


@given(st.integers(0, 10_000), st.integers(2, 12), st.booleans())
def test_lazy_choices_are_those_of_the_plain_maximum(seed: int, count: int, exclude: bool) -> None:
    rng = np.random.default_rng(seed)
    values = np.round(rng.random(count), 1)  # many ties
    values /= max(values.max(), 0.1)
    lazy, excluded = LazyMaximum(values), set()
    for _ in range(count - 1):
        values = values * np.where(rng.random(count) < 0.5, 1.0, np.round(rng.random(count), 1))
        best, value = lazy.next(lambda p: float(values[p]))  # noqa: B023  called at once
        assert best == plain(values, excluded)
        assert value == max(v for k, v in enumerate(values) if k not in excluded)
        if exclude:
            lazy.exclude(best)
            excluded.add(best)


def test_ties_within_round_off_go_to_the_smallest_index() -> None:
    values = np.array([0.5, 1.0 - 1e-10, 1.0])
    assert LazyMaximum(values).next(lambda p: float(values[p])) == (1, 1.0)


def test_only_bounds_that_reach_the_maximum_are_evaluated() -> None:
    lazy = LazyMaximum(np.array([1.0, 0.9, 0.1, 0.05]))
    asked = []

    def evaluate(p: int) -> float:
        asked.append(p)
        return [0.5, 0.6, 0.1, 0.05][p]

    assert lazy.next(evaluate) == (1, 0.6)
    assert sorted(asked) == [0, 1]
    assert lazy.evaluations == 2
