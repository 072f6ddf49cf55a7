from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import exact, spd
from scipy.optimize import lsq_linear

from vibench import Contact, DualSet, VariationalInequality
from vibench.model.certificates import contact_correction
from vibench.model.certificates.contact_correction import ContactCompliance, ContactCorrection, find_contact_correction

K, M = 7, 6
EVERY = np.arange(K)
Program = tuple[np.ndarray, Contact, np.ndarray, np.ndarray, float]


@st.composite
def programs(draw: st.DrawFn) -> Program:
    """C, B and g, u_N and λ ≥ 0 with zeros, γ; rows may be the same, and u_N is feasible in some of them."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    B = rng.standard_normal((M, K)) * (rng.random((M, K)) < 0.7)
    if draw(st.booleans()):
        B[3] = 2.0 * B[0]
    u, lam = rng.standard_normal(K), np.maximum(rng.standard_normal(M), 0.0) * draw(st.sampled_from([0.0, 0.1, 3.0]))
    g = B @ u - draw(st.sampled_from([1e-6, 1.0])) * rng.uniform(-1.0, 0.5, M)
    B[np.abs(B).sum(axis=1) == 0.0, 0] = 1.0
    return np.linalg.inv(spd(K, rng, 100.0)), Contact(sp.csr_array(B), g), u, lam, draw(st.sampled_from([1.0, 2.5]))


def corrected(given: Program, near: np.ndarray = EVERY) -> ContactCorrection | None:
    C, contact, u, lam, gamma = given
    return find_contact_correction(ContactCompliance(C, near, 0.0), contact, u, np.zeros(K), lam, gamma)


@given(programs(), st.sampled_from([1e-3, 0.3, 10.0]))
def test_corrections_for_intervals_are_the_best_ones_and_no_w_violates_anything(given: Program, radius: float) -> None:
    C, contact, u, lam, gamma = given
    bounded = DualSet.intervals(np.arange(M), radius)
    lam, compliance = bounded.project(lam - 0.5), ContactCompliance(C, EVERY, 0.0)
    found = contact_correction.bounded_correction(compliance, contact, u, np.zeros(K), lam, gamma, bounded)
    B, s, w = contact.B.toarray(), contact.B @ u - contact.g, C @ found.load
    assert found.kappa >= bounded.support(s - B @ w) - lam @ (s - B @ w) - 1e-14 * np.abs(s).sum() * radius
    assert found.norm == pytest.approx(float(np.sqrt(w @ np.linalg.solve(C, w))), rel=1e-6, abs=1e-12)
    if np.linalg.cond(B @ B.T) > 1e6:  # active sets of dependent rows may cycle: w = 0 is no less a correction
        return
    # ½ dᵀS d − sᵀd over the box, as least squares
    L = np.linalg.cholesky(B @ C @ B.T / gamma)
    best = lsq_linear(L.T, np.linalg.solve(L, s), (-radius - lam - 1e-14, radius - lam + 1e-14), tol=1e-14).x
    assert found.nu is not None
    least, own = (0.5 * np.sum((L.T @ d) ** 2) - s @ d for d in (best, found.nu - lam))
    assert own <= least + 1e-9 * np.abs(s).sum() * radius
    assert found.gap <= (1e-9 * np.abs(s).sum() + 1e-13) * (1.0 + radius)


def values(C: np.ndarray, found: ContactCorrection) -> np.ndarray:
    load = np.zeros(K)
    load[found.unknowns] = found.load
    return np.asarray(C @ load)


@given(programs())
def test_corrections_are_feasible_also_in_exact_arithmetic_and_close_to_the_best_one(given: Program) -> None:
    C, contact, u, lam, gamma = given
    found = corrected(given)
    if found is None:  # opposite rows: round-off decides
        return
    w = values(C, found)
    for row, g in zip(contact.B.toarray(), contact.g, strict=True):
        slack = sum(Fraction(b) * (Fraction(x) - Fraction(v)) for b, x, v in zip(row, w, u, strict=True))
        assert slack + Fraction(g) >= 0
    s = contact.B @ u - contact.g
    assert found.norm == pytest.approx(float(np.sqrt(w @ np.linalg.solve(C, w))), rel=1e-6, abs=1e-12)
    assert found.kappa == pytest.approx(float(lam @ (contact.B @ w - s)), abs=1e-12 * (1.0 + lam.sum()))
    B, A = contact.B.toarray(), gamma * np.linalg.inv(C)
    if np.linalg.cond(B @ B.T) > 1e6:  # the active set method need not find the best one among dependent rows
        return
    best, _ = exact(VariationalInequality(0.5 * (A + A.T), -B.T @ lam, -B, -s))
    least = 0.5 * best @ A @ best + lam @ (B @ best - s)
    scale = gamma * found.norm**2 + lam @ np.abs(s) + 1e-12
    raised = 1e-13 * float(lam @ (np.abs(B) @ np.abs(u) + np.abs(contact.g)))  # s is raised above its round-off
    assert 0.5 * gamma * found.norm**2 + found.kappa <= least + 1e-5 * scale + raised


def test_no_random_program_is_without_a_correction(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no method ends, the feasibility of the last correction decides: what is left is ν for v = 0."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        B = rng.standard_normal((M, K))
        u, lam = rng.standard_normal(K), np.maximum(rng.standard_normal(M), 0.0)
        contact = Contact(sp.csr_array(B), B @ u - rng.uniform(-1.0, 0.5, M))
        given = np.linalg.inv(spd(K, rng, 100.0)), contact, u, lam, 1.0
        assert corrected(given) is not None
        with monkeypatch.context() as patch:
            patch.setattr(contact_correction, "complementary", lambda fixed, *_: fixed)
            found = corrected((*given[:3], np.zeros(M), 1.0))
        assert found is None or np.all(B @ values(given[0], found) >= B @ u - contact.g)


def chain(far: float) -> Program:
    """Two rows on two unknowns each, coupled by C; the first one is violated by 1."""
    C = np.eye(K) + 0.5
    B = sp.csr_array(np.array([[-1.0, -1.0, 0, 0, 0, 0, 0], [0, 0, 0, -1.0, 1.0, 0, 0]]))
    return C, Contact(B, np.array([-1.0, far])), np.zeros(K), np.array([1.0, 0.0]), 1.0


def test_rows_far_from_the_contact_are_evaluated_where_the_inequality_of_cauchy_and_schwarz_is_not_enough() -> None:
    away = corrected(chain(far=10.0), near=np.array([0, 1]))
    assert list(away.unknowns) == [0, 1]
    close = corrected(chain(far=-0.5), near=np.array([0, 1]))
    assert len(close.unknowns) == K
    C, contact, *_ = chain(far=-0.5)
    assert np.all(contact.B @ values(C, close) >= -contact.g)


def test_nothing_is_lifted_where_nothing_is_violated_and_a_larger_uncertainty_of_u_asks_for_more() -> None:
    C, contact, u, lam, gamma = chain(far=10.0)
    found = corrected((C, Contact(contact.B, np.ones(2)), u, np.zeros(2), gamma))
    assert (found.norm, found.kappa) == (0.0, 0.0)
    plain, careful = (
        find_contact_correction(ContactCompliance(C, np.arange(K), 0.0), contact, u, np.full(K, size), lam, gamma)
        for size in (0.0, 0.1)
    )
    assert np.all((contact.B @ values(C, careful))[:1] >= (contact.B @ values(C, plain))[:1] + 0.2)


def test_multipliers_of_rows_with_much_slack_take_part() -> None:
    """λ of 1e-2 on a row with a slack of 10 pulls w away from it: ν is zero there."""
    C, contact, u, lam, gamma = chain(far=10.0)
    lam = lam + np.array([0.0, 0.01])
    found = corrected((C, contact, u, lam, gamma))
    B = contact.B.toarray()
    load = np.zeros(K)
    load[found.unknowns] = found.load
    assert load == pytest.approx(B.T @ np.array([load[0] / B[0, 0], -0.01]), abs=1e-12)


def test_a_multiplier_belongs_to_the_correction_or_is_none() -> None:
    """Of dependent rows that couple unknowns on a soft support, S is known by round-off alone."""
    known = []
    for seed in range(60):
        rng, B = np.random.default_rng(seed), np.zeros((9, 12))
        factor = rng.standard_normal((12, 12))
        for row in B:
            row[rng.choice(12, 2, replace=False)] = 1.0, -1.0
        B = np.vstack([B, 1.3 * B[:4], B[:2] + B[2:4]])
        C, contact = factor @ factor.T / 12 + 1e5, Contact(sp.csr_array(B), rng.standard_normal(15))
        u, lam = rng.standard_normal(12), np.where(rng.random(15) < 0.5, 3.0 * rng.random(15), 0.0)
        found = find_contact_correction(ContactCompliance(C, np.arange(12), 0.0), contact, u, np.zeros(12), lam, 1.0)
        known.append(found is not None and found.nu is not None)
        if found is not None and found.nu is not None:
            w = C @ (B.T @ (found.nu - lam))
            assert found.nu.min() >= 0.0
            assert np.min(B @ w - (B @ u - contact.g)) >= -1e-6
    assert {True, False} == set(known)
