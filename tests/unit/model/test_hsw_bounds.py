from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying, space

from vibench.highfidelity import active_set
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.model.hsw_bounds import HSWBounds, hsw_bounds
from vibench.stability.coercivity import Constant, Stability, coercivity_and_continuity
from vibench.stability.infsup import InfSup, inf_sup_full, nodal_cone

PROBLEM = Varying()


def bound(
    problem: Problem, vi: VariationalInequality, known: Stability, u: np.ndarray, lam: np.ndarray
) -> HSWBounds | None:
    """The bounds of one solution."""
    (found,) = hsw_bounds(problem, [vi], [known], u[:, None], lam[:, None])
    return found


def stability(mu: np.ndarray) -> Stability:
    vi = PROBLEM.assemble(mu)
    inf_sup = inf_sup_full(PROBLEM.V, vi.B, nodal_cone(PROBLEM.W))
    return Stability(inf_sup, *coercivity_and_continuity(vi.A, PROBLEM.V), Constant(0.0, True))


def by_hand(beta: float, alpha: float, gamma: float) -> Stability:
    known = Constant(beta, True)
    return Stability(InfSup(beta, beta, beta, ""), Constant(alpha, True), Constant(gamma, True), known)


@given(st.integers(0, 10_000), st.floats(0.0, 1.0), st.sampled_from([1e-6, 1e-3, 1e-1, 10.0]))
def test_no_error_is_above_its_bound(seed: int, angle: float, size: float) -> None:
    """Whatever u is, and whatever λ ≥ 0: the bounds ask for nothing else."""
    mu, rng = np.array([angle]), np.random.default_rng(seed)
    vi = PROBLEM.assemble(mu)
    exact = active_set.solve_high_fidelity(vi)
    u = exact.u + size * rng.standard_normal(len(exact.u)) * np.abs(exact.u).max()
    lam = np.maximum(exact.lam + size * rng.standard_normal(len(exact.lam)) * exact.lam.max(), 0.0)
    found = bound(PROBLEM, vi, stability(mu), u, lam)
    assert found is not None
    assert found.u >= float(PROBLEM.V.norm(u - exact.u))
    assert found.lam >= float(PROBLEM.W.norm(lam - exact.lam))


def test_the_bounds_vanish_with_the_error() -> None:
    mu = np.array([0.4])
    vi = PROBLEM.assemble(mu)
    exact = active_set.solve_high_fidelity(vi)
    found = bound(PROBLEM, vi, stability(mu), exact.u, exact.lam)
    assert found is not None
    assert found.u < 1e-5 * float(PROBLEM.V.norm(exact.u))
    # off the solution along a direction of V with λ kept and no penetration, the bound is residual over coercivity
    known, free = stability(mu), np.zeros_like(exact.lam)
    u = active_set.solve_high_fidelity(type(vi)(vi.A, vi.f, vi.B, vi.g + 10.0)).u  # no contact
    found = bound(PROBLEM, type(vi)(vi.A, 2.0 * vi.f, vi.B, vi.g + 10.0), known, u, free)
    assert found is not None
    assert found.u == pytest.approx(float(np.linalg.norm(PROBLEM.V.whiten_functional(vi.f))) / known.coercivity.value)


def test_each_constant_enters_where_the_derivation_says() -> None:
    """One dimension, one constraint u ≤ 0 (b = 1), f = 1: u = 0 and λ = 1; worked out by hand."""
    V = W = space(1)
    x = float(V.matrix.toarray()[0, 0])

    class Scalar(Varying):
        def __init__(self) -> None:
            self.V, self.W = V, W

    vi = type(PROBLEM.assemble(np.zeros(1)))(
        sp.csc_array([[2.0]]), np.array([1.0]), sp.csr_array([[1.0]]), np.array([0.0])
    )
    alpha, gamma, beta = 2.0 / x, 2.0 / x, 1.0 / x
    u, lam = np.array([0.1]), np.array([0.5])
    found = bound(Scalar(), vi, by_hand(beta, alpha, gamma), u, lam)
    residual, penetration = abs(1.0 - 2.0 * 0.1 - 0.5) / np.sqrt(x), 0.1 / np.sqrt(x)
    mismatch = 0.1 * 0.5  # ⟨π, λ⟩, and −sᵀλ is negative
    c1 = (residual + penetration * gamma / beta) / (2.0 * alpha)
    expected = c1 + np.sqrt(c1**2 + (penetration * residual / beta + mismatch) / alpha)
    assert found is not None
    assert found.u == pytest.approx(expected)
    assert found.lam == pytest.approx((residual + gamma * expected) / beta)
    inside = bound(Scalar(), vi, by_hand(beta, alpha, gamma), -u, lam)
    residual, mismatch = abs(1.0 + 2.0 * 0.1 - 0.5) / np.sqrt(x), 0.1 * 0.5  # π = 0, −sᵀλ = 0.05
    c1 = residual / (2.0 * alpha)
    assert inside is not None
    assert inside.u == pytest.approx(c1 + np.sqrt(c1**2 + mismatch / alpha))


def test_nothing_is_certified_without_stability_or_outside_the_cone() -> None:
    mu = np.array([0.2])
    vi, known = PROBLEM.assemble(mu), stability(mu)
    exact = active_set.solve_high_fidelity(vi)
    unstable = replace(known, inf_sup=InfSup(0.0, 0.0, 0.1, ""))
    found = bound(PROBLEM, vi, unstable, exact.u, exact.lam)
    assert found is not None
    assert (found.u, found.lam) == (np.inf, np.inf)
    assert bound(PROBLEM, vi, known, exact.u, exact.lam - 1e-3) is None
