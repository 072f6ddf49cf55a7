from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import example, given
from hypothesis import strategies as st
from numerics import exact, spd

from vibench import VariationalInequality
from vibench.model.certificates.contact_correction import ContactCompliance
from vibench.model.certificates.prepared_correction import constant_unknowns, prepare_corrections

K, M, D = 9, 6, 3
FLAT = np.zeros((K, D))
BODIES = np.equal.outer(np.arange(K) < 7, np.arange(K) < 7)
"""Two bodies: the first seven unknowns, and the others."""


def compliance(rng: np.random.Generator, two: bool) -> np.ndarray:
    C = np.linalg.inv(spd(K, rng, 100.0) * (BODIES if two else 1.0))
    return 0.5 * (C + C.T)


def prepared(B: np.ndarray, C: np.ndarray, basis: np.ndarray = FLAT, scaled: bool = True, rows: Any = None) -> Any:
    """The directions are the functionals themselves."""
    rows, on = np.ones(len(B), bool) if rows is None else rows, ContactCompliance(C, np.arange(len(C)), 0.0)
    return prepare_corrections(sp.csr_array(B), scaled, on, rows, basis, np.eye(len(C)))


@given(
    st.integers(0, 10_000), st.booleans(), st.sampled_from([0.0, 0.1, 3.0]), st.sampled_from([1e-6, 1.0]),
    st.sampled_from([1.0, 2.5]),
)  # fmt: skip
@example(838, False, 0.0, 1e-6, 1.0)  # exchanging all wrong signs at once cycles
def test_corrections_are_exactly_feasible_and_best(
    seed: int, scaled: bool, pressure: float, violation: float, gamma: float
) -> None:
    """Where B is scaled, the best of all; where one body moves, the best of those that load the other one alone."""
    rng = np.random.default_rng(seed)
    C, B0 = compliance(rng, two=not scaled), rng.standard_normal((M, K))
    factor = float(rng.choice([-0.7, 1.3])) if scaled else 1.0
    B0[:, 7:] *= scaled
    B = factor * B0 if scaled else B0 + np.where(np.arange(K) < 7, 0.0, rng.standard_normal((M, K)))
    basis, y = rng.standard_normal((K, D)), rng.standard_normal(D)
    lam = np.maximum(rng.standard_normal(M), 0.0) * pressure
    g = B @ (basis @ y) - violation * rng.uniform(-1.0, 0.5, M)
    corrections = prepared(B0, C, basis, scaled)
    load, norm, kappa, _ = corrections.correction(factor if scaled else sp.csr_array(B), g, np.abs(g), y, lam, gamma)
    w, u = fractions(C) @ fractions(load), fractions(basis) @ fractions(y)
    slack = fractions(B) @ (w - u) + fractions(g)
    unit = Fraction(1e-14 * float((np.abs(B) @ np.abs(C) @ np.abs(load)).max()))  # `load` itself is rounded
    assert min(slack) >= -unit
    values, s = C @ load, B @ (basis @ y) - g
    assert norm == pytest.approx(float(np.sqrt(load @ values)), rel=1e-6, abs=1e-12)
    assert kappa == pytest.approx(float(lam @ (B @ values - s)), abs=1e-9 * (1.0 + lam.sum()))
    part = slice(0, K if scaled else 7)
    A, rows = gamma * np.linalg.inv(C[part, part]), B[:, part]
    if np.linalg.cond(rows @ rows.T) > 1e5:
        return
    best, _ = exact(VariationalInequality(0.5 * (A + A.T), -rows.T @ lam, -rows, -s))
    least = 0.5 * best @ A @ best + lam @ (rows @ best - s)
    allowed = 1e-5 * (gamma * norm**2 + lam @ np.abs(s)) + 1e-12 * (1.0 + lam.sum())
    assert 0.5 * gamma * norm**2 + kappa <= least + allowed


@pytest.mark.parametrize("seeds", [range(40), pytest.param(range(40, 150), marks=pytest.mark.long)], ids=str)
@pytest.mark.parametrize("condition", [1e2, 1e5])
def test_where_rows_are_independent_there_is_always_a_correction(condition: float, seeds: range) -> None:
    """S₀ has no sign structure: in about one case of ten, exchanging all wrong signs at once cycles."""
    size, rows = 30, 24
    for seed in seeds:
        rng = np.random.default_rng(seed)
        C, B = np.linalg.inv(spd(size, rng, condition)), rng.standard_normal((rows, size))
        everything = prepared(B, 0.5 * (C + C.T), rng.standard_normal((size, D)))
        y, lam = rng.standard_normal(D), np.maximum(rng.standard_normal(rows), 0.0) * rng.choice([0.0, 1.0])
        g = everything.basis @ y - rng.uniform(-1.0, 0.5, rows)
        found = everything.correction(1.0, g, np.abs(g), y, lam, 1.0)
        assert np.all(B @ (C @ found[0]) >= everything.basis @ y - g)


def fractions(array: np.ndarray) -> np.ndarray:
    return np.vectorize(Fraction, otypes=[object])(array)


def membrane() -> tuple[np.ndarray, np.ndarray]:
    """A chain of K unknowns, and the constraints −w ≥ s of the first M."""
    chain = 2.0 * np.eye(K) - np.eye(K, k=1) - np.eye(K, k=-1)
    return np.linalg.inv(chain), -np.eye(M, K)


def test_there_is_no_prepared_correction_where_rows_beyond_those_that_are_prepared_stay_violated() -> None:
    C, B = membrane()
    few, zero = np.arange(M) < 4, np.zeros(D)
    corrections = prepared(B, C, rows=few)
    lam, violated = np.where(few, 1.0, 0.0), np.full(M, -1.0)
    assert corrections.correction(1.0, violated, np.ones(M), zero, lam, 1.0) is None
    violated[4:] = 0.0  # w of the first rows lifts these, too
    found = corrections.correction(1.0, violated, np.ones(M), zero, lam, 1.0)
    assert np.all(B @ (C @ found[0]) >= -violated)


def test_rows_without_pressure_are_not_held_where_they_are() -> None:
    """Their multiplier is zero and w leaves s behind: one row pushes, the others follow."""
    C, B = membrane()
    corrections, g = prepared(B, C), np.where(np.arange(M) == 2, -1.0, 1.0)
    load, _, kappa, _ = corrections.correction(1.0, g, np.abs(g), np.zeros(D), np.eye(M)[2], 1.0)
    assert load == pytest.approx(np.eye(K)[2] * load[2])
    assert (C @ load)[2] == pytest.approx(-1.0)
    assert kappa == pytest.approx(0.0, abs=1e-12)
    # more round-off in g asks for more
    raised = []
    for size in (1.0, 1e12):
        found = corrections.correction(1.0, np.full(M, -1.0), np.full(M, size), np.zeros(D), np.ones(M), 1.0)
        raised.append(B @ (C @ found[0]))
    assert np.all(raised[1] >= raised[0] + 1e12 * np.finfo(float).eps)


def test_dependent_rows_have_no_prepared_corrections_nor_has_a_factor_of_zero_one() -> None:
    C, B = membrane()
    assert prepared(B, C).correction(0.0, np.ones(M), np.ones(M), np.zeros(D), np.zeros(M), 1.0) is None
    B[3] = 2.0 * B[0]
    assert prepared(B, C) is prepared(B, C, rows=np.zeros(M, bool)) is None
    assert prepared(B, C, rows=np.arange(M) != 3) is not None


def test_bodies_carry_corrections_where_the_constraint_is_the_same_everywhere() -> None:
    rng = np.random.default_rng(0)
    C, B = compliance(rng, two=True), rng.standard_normal((M, K))
    other = B.copy()
    other[2, 8] += 1e-14
    assert constant_unknowns(C, [sp.csr_array(B), sp.csr_array(B)]).all()
    assert list(np.flatnonzero(constant_unknowns(C, [sp.csr_array(B), sp.csr_array(other)]))) == list(range(7))
    coupled = compliance(rng, two=False)
    assert not constant_unknowns(coupled, [sp.csr_array(B), sp.csr_array(other)]).any()
