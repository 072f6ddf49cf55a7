"""Diamonds by hand, and the bounds of an inequality with them, solved without vibench."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from vibench import Array, DualSet, UnsupportedError, VariationalInequality, solve_high_fidelity
from vibench.qp import kkt_residuals
from vibench_rope.diamonds import Diamonds


def test_nearest_points_support_and_gauge() -> None:
    K = DualSet((Diamonds(np.array([[0, 1], [2, 3]]), np.array([1.0, 2.0])),))
    corner_and_edge = K.project(np.array([5.0, 0.5, -2.0, 1.0]))
    assert np.allclose(corner_and_edge, [1.0, 0.0, -1.5, 0.5], rtol=1e-15)
    assert K.contains(corner_and_edge)
    assert np.allclose(K.project(0.2 * corner_and_edge), 0.2 * corner_and_edge, rtol=1e-15)
    assert K.support(np.array([0.5, -3.0, 1.0, 0.0])) == 3.0 + 2.0
    assert K.gauge(np.array([0.25, -0.25, 0.0, 3.0])) == 1.5
    rng = np.random.default_rng(1)
    for z, other in rng.standard_normal((200, 2, 4)) * 3.0:
        # What is left at the nearest point makes no sharp angle with any other point of the set.
        assert (z - K.project(z)) @ (K.project(other) - K.project(z)) <= 1e-14


def solved(vi: VariationalInequality) -> tuple[Array, Array]:
    """The solution by a projected gradient of the dual problem."""
    inverse = np.linalg.inv(vi.A.toarray())
    B = vi.B.toarray()
    S, q = B @ inverse @ B.T, B @ inverse @ vi.f - vi.g
    lam, step = np.zeros(len(q)), 1.0 / np.linalg.norm(S, 2)
    for _ in range(2_000):
        lam = vi.K.project(lam + step * (q - S @ lam))
    return inverse @ (vi.f - B.T @ lam), lam


@pytest.mark.parametrize("seed", range(2))
def test_residuals_and_bounds_know_them_and_solvers_say_that_they_do_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = 9, 6
    A = sp.csr_array(np.diag(rng.uniform(1.0, 3.0, n)) + 0.1)
    K = DualSet((Diamonds(np.array([[0, 3], [1, 2]]), np.array([0.5, 1.0])),))
    B, f, g = sp.csr_array(rng.standard_normal((m, n))), 3.0 * rng.standard_normal(n), rng.random(m)
    vi = VariationalInequality(A, f, B, g, K=K)
    u, lam = solved(vi)
    assert K.gauge(lam) == pytest.approx(1.0)
    assert kkt_residuals(vi, u, lam).worst < 1e-9
    # Of anything near the solution, ‖u − u_N‖²_A ≤ ‖r‖²_{A⁻¹} + 2κ with κ = σ_K(B u_N − g) − λ_Nᵀ(B u_N − g).
    near, multiplier = u + 0.05 * rng.standard_normal(n), K.project(0.95 * lam)
    r, error = vi.f - A @ near - B.T @ multiplier, near - u
    bound = np.sqrt(r @ np.linalg.solve(A.toarray(), r) + 2.0 * K.gap(multiplier, vi.g - B @ near))
    assert np.sqrt(error @ (A @ error)) <= bound < 20.0 * np.sqrt(error @ (A @ error))
    with pytest.raises(UnsupportedError, match="K has other sets"):
        solve_high_fidelity(vi)
