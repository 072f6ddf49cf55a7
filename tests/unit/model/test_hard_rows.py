"""Rows that are dependent, nearly so, equalities, or in any units, against solutions of 100 digits."""

import numpy as np
import pytest
import scipy.sparse as sp
from decimals import difference, exact_decimal
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench import InnerProduct, VariationalInequality, solve_high_fidelity
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.model.bound_terms import BoundNote, Equalities
from vibench.model.error_bounds import bound_errors_at, corrected_pair
from vibench.model.errors import EnergyNorm
from vibench.stability.coercivity import Constant

KINDS = ["plain", "opposite", "dependent", "nearly dependent", "copies", "opposite copies", "opposite dependent"]


def hard(kind: str, seed: int) -> VariationalInequality:
    """A random inequality with rows of one kind, scaled by powers of two between 1e-8 and 1e8."""
    rng, n = np.random.default_rng(seed), 8
    A, f = spd(n, rng, 10.0 ** rng.uniform(0.0, 4.0)), rng.standard_normal(n)
    free, B = np.linalg.solve(A, f), rng.standard_normal((4, n))
    g = B @ free - rng.uniform(-0.5, 1.0, 4) * np.linalg.norm(free)
    if "opposite" in kind:
        B, g = np.vstack([B, -B[:2]]), np.append(g, -g[:2])
    if "nearly" in kind:
        B = np.vstack([B, B[2] + 1e-8 * rng.standard_normal(n)])
        g = np.append(g, B[-1] @ free - (B[2] @ free - g[2]))
    elif "dependent" in kind:
        sums = rng.uniform(0.2, 1.0, 2)
        B, g = np.vstack([B, sums @ B[2:4], B[2]]), np.append(g, [sums @ g[2:4], g[2]])
    if "copies" in kind:
        B, g = np.vstack([B, B, B[:2]]), np.concatenate([g, g, g[:2]])
    scale = 2.0 ** np.round(rng.uniform(-27.0, 27.0, len(g)))
    return VariationalInequality(sp.csc_array(A), f, sp.csr_array(scale[:, None] * B), scale * g)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(5))
def test_solutions_are_right_and_bounds_exist_and_hold(kind: str, seed: int) -> None:
    vi, rng = hard(kind, seed), np.random.default_rng(seed)
    solution = solve_high_fidelity(vi)
    u, lam = exact_decimal(vi, solution.lam > 0.0)
    norm = EnergyNorm(vi.A, CondensedStiffness(vi.A))
    exact_u, exact_lam = np.asarray(u, float), np.asarray(lam, float)
    size = norm.norm(exact_u) + norm.dual_norm(vi.B.T @ exact_lam)
    assert norm.norm(difference(u, solution.u)) <= 1e-12 * size
    share = 10.0 ** rng.uniform(-8.0, 0.0)
    u_N = exact_u + share * np.linalg.norm(exact_u) * rng.standard_normal(len(u))
    lengths = np.linalg.norm(vi.B.toarray(), axis=1)
    lam_N = np.maximum(exact_lam * (1.0 + share * rng.standard_normal(len(lam))), 0.0)
    spread = share * np.max(exact_lam * lengths) / lengths
    lam_N += spread * rng.uniform(0.0, 1.0, len(lam)) * (rng.random(len(lam)) < 0.3)
    pair = corrected_pair(vi, norm, u_N, lam_N)
    for v, nu in ((u_N, lam_N), (pair.u, pair.lam)):
        found = bound_errors_at(InnerProduct(vi.A), vi, norm, Constant(1.0, True), Constant(0.0, True), v, nu)
        assert found.note == BoundNote.NOT_UNIQUE
        errors = norm.norm(difference(u, v)), norm.dual_norm(vi.B.T @ difference(lam, nu))
        assert errors[0] <= found.u_energy + 1e-13 * size
        assert errors[1] <= found.lambda_natural + 1e-13 * size
        # what the identity bounds is the sum of both, and of this
        together = sum(error**2 for error in errors) + 2.0 * nu @ np.maximum(vi.g - vi.B @ exact_u, 0.0)
        assert found.u_energy <= 10.0 * np.sqrt(together) + 1e-6 * size


@given(st.integers(0, 10_000), st.booleans(), st.sampled_from([1.0, 1e-8]))
def test_what_holds_equalities_is_within_its_distance_and_reach(seed: int, dependent: bool, apart: float) -> None:
    rng = np.random.default_rng(seed)
    X, B, lengths = spd(7, rng, 100.0), rng.standard_normal((6, 7)), 10.0 ** rng.uniform(-8.0, 8.0, 6)
    B[1] = B[0] + apart * rng.standard_normal(7)
    if dependent:
        B[2] = rng.standard_normal(2) @ B[:2]
    B *= lengths[:, None]
    F = np.linalg.cholesky(X).T
    K, unwhiten = np.linalg.solve(F.T, B[:3].T), lambda y: np.linalg.solve(F, y)
    held = Equalities.from_rows(K, unwhiten, B)
    assert len(held.chosen) == (2 if dependent else 3)
    wanted = B[:3] @ rng.standard_normal(7)  # consistent
    d = held.step(wanted)
    np.testing.assert_allclose(B[:3] @ d / lengths[:3], wanted / lengths[:3], rtol=0.0, atol=1e-6)
    eta = held.distance(np.abs(wanted))
    assert np.sqrt(d @ X @ d) <= eta
    assert np.all(np.abs(B @ d) <= held.reach * eta * (1.0 + 1e-9))
    other = d + unwhiten(np.linalg.svd(K)[0][:, -1])  # holds them, too
    assert other @ X @ other >= d @ X @ d
