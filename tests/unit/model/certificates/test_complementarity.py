from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vibench.model.certificates import contact_correction as complementarity
from vibench.model.certificates.contact_correction import complementary, descent


def by_enumeration(M: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """ν of the set of released unknowns for which signs are right, or least wrong: round-off decides ties."""
    best, least = fixed, np.inf
    for chosen in product([False, True], repeat=len(fixed)):
        rows, v = np.flatnonzero(chosen), np.zeros(len(fixed))
        v[rows] = np.linalg.solve(M[np.ix_(rows, rows)], -fixed[rows])
        nu = fixed + M @ v
        nu[rows] = 0.0
        wrong = max(np.max(-v * np.sqrt(np.diag(M))), np.max(-nu / np.sqrt(np.diag(M))))
        if wrong < least:
            best, least = nu, wrong
    return best


def problem(seed: int, size: int, condition: float, ties: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((size, size)))[0]
    M = Q @ np.diag(np.geomspace(1.0, condition, size)) @ Q.T
    fixed = rng.standard_normal(size)
    if ties:  # ν = v = 0 in some
        v = np.where(rng.random(size) < 0.3, rng.random(size), 0.0)
        fixed = np.where((v == 0.0) & (rng.random(size) < 0.4), rng.random(size), 0.0) - M @ v
    return 0.5 * (M + M.T), fixed, rng.random(size) < 0.5


@given(st.integers(0, 100_000), st.integers(1, 7), st.sampled_from([1.0, 1e2, 1e4]), st.booleans())
@settings(max_examples=40)
@example(0, 1, 1.0, True)
def test_the_solution_is_that_of_an_enumeration(seed: int, size: int, condition: float, ties: bool) -> None:
    M, fixed, start = problem(seed, size, condition, ties)
    nu, expected = complementary(fixed, lambda rows: M[rows], start), by_enumeration(M, fixed)
    assert nu == pytest.approx(expected, abs=1e-9 * condition * (1.0 + np.abs(fixed).max()))


@given(st.integers(0, 100_000), st.integers(1, 60), st.sampled_from([1e1, 1e5, 1e9]), st.booleans(), st.booleans())
@settings(max_examples=40)
def test_it_ends_with_the_right_signs(seed: int, size: int, condition: float, ties: bool, first: bool) -> None:
    """ν = ν₀ + M v: signs and complementarity, with both methods and condition numbers up to the largest there are."""
    M, fixed, start = problem(seed, size, condition, ties)
    nu = complementary(fixed, lambda rows: M[rows], start) if first else fixed + descent(M, fixed)
    v = np.linalg.solve(M, nu - fixed)
    reach = 1e-14 * condition * (1.0 + np.abs(v).max())
    assert np.min(v) >= -reach
    assert np.min(nu) >= -1e-12 * (np.abs(fixed).max() + condition * np.abs(v).max())
    assert np.max(np.minimum(nu, v)) <= reach


@pytest.mark.parametrize(
    "seeds", [(859, 1029, 1057, 1113, 1218, 2131), pytest.param(range(3000), marks=pytest.mark.long)]
)
def test_where_exchanging_all_cycles_a_solution_is_found(seeds: Sequence[int], monkeypatch: pytest.MonkeyPatch) -> None:
    cycled = []
    monkeypatch.setattr(complementarity, "descent", lambda M, fixed: cycled.append((M, fixed)) or fixed)
    for seed in seeds:
        M, fixed, start = problem(seed, 4, 1e3, False)
        complementary(fixed, lambda rows, M=M: M[rows], start)
    monkeypatch.undo()
    assert len(cycled) >= 3
    for M, fixed in cycled:
        nu = complementary(fixed, lambda rows, M=M: M[rows], np.zeros(4, bool))
        assert nu == pytest.approx(by_enumeration(M, fixed), abs=1e-7)


def test_round_off_in_place_of_signs_leaves_the_method_of_descent_at_the_solution() -> None:
    """40 % of the unknowns have ν = v = 0: SciPy's nonnegative least squares are wrong by 6e-4 here."""
    M, fixed, _ = problem(39, 39, 10.0, True)
    unit = 1.0 / np.sqrt(M.diagonal())
    nu = fixed + unit**-1 * descent(M * np.outer(unit, unit), unit * fixed)
    assert np.min(nu) >= -1e-14
    # a singular matrix has a solution all the same
    assert list(complementary(-np.ones(2), np.ones((2, 2)).__getitem__, np.ones(2, bool))) == [0.0, 0.0]
