"""Dual sets: their geometry, the identity and bounds of error_bounds.py for all of them, solutions for intervals."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying, spd
from scipy.optimize import lsq_linear

from vibench import Array, InnerProduct, VariationalInequality, checked_assembly, solve_high_fidelity
from vibench.errors import NumericalError, RequestError, UnsupportedError
from vibench.highfidelity import active_set
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.dual_sets import RAYS, BlockKind, Blocks, DualSet
from vibench.model.bound_terms import BoundNote
from vibench.model.error_bounds import bound_errors_at, corrected_pair, find_correction
from vibench.model.errors import EnergyNorm
from vibench.stability.coercivity import Constant

Extended = np.longdouble


def mixed_set(rng: np.random.Generator) -> tuple[DualSet, int]:
    """Rays, intervals, discs and cones in rows of random order, and the number of rows."""
    order, blocks, first = rng.permutation(20), list[Blocks](), 0
    for kind, size in ((BlockKind.INTERVAL, 1), (BlockKind.DISC, 2), (BlockKind.CONE, 3)):
        count = int(rng.integers(0, 4))
        if count:
            rows = order[first : first + count * size].reshape(count, size)
            first += count * size
            radii = None if kind is BlockKind.CONE else 10.0 ** rng.uniform(-2.0, 2.0, count)
            blocks.append(Blocks(kind, rows.astype(np.intp), radii))
    return DualSet(tuple(blocks)), 20


@given(seed=st.integers(0, 2**31), scale=st.floats(1e-3, 1e3))
def test_projection_support_and_gauge_agree(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    K, m = mixed_set(rng)
    z, other = scale * rng.standard_normal((2, m))
    point = K.project(z)
    assert K.contains(point)
    assert np.allclose(K.project(point), point, rtol=1e-14, atol=0.0)
    # z − point is normal to K at the nearest point: it makes no sharp angle with any other point of K.
    assert (z - point) @ (K.project(other) - point) <= 1e-11 * scale**2 * m
    # The support of a normal is attained there, but for rows whose normal leaves its domain by round-off.
    slack = -(z - point)
    assert K.gap(point, slack) <= 1e-11 * (scale**2 * m)
    assert K.gap(K.project(other), slack) >= K.gap(point, slack) - 1e-11 * scale**2 * m
    assert K.gauge(0.5 * point) <= 0.5 * max(K.gauge(point), 1e-300) * (1.0 + 1e-14)


def test_values_by_hand() -> None:
    disc, cone = Blocks(BlockKind.DISC, np.array([[1, 2]]), np.array([2.0])), Blocks(BlockKind.CONE, np.array([[3, 4]]))
    K = DualSet((disc, cone, Blocks(BlockKind.INTERVAL, np.array([[5]]), np.array([0.5]))))
    assert K.support(np.array([-1.0, 3.0, 4.0, 1.0, -1.0, -2.0])) == 2.0 * 5.0 + 0.5 * 2.0
    assert K.support(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])) == np.inf
    assert K.support(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])) == np.inf
    assert K.gauge(np.array([7.0, 0.0, 1.0, 1.0, 1.0, 0.0])) == 0.5
    assert K.gauge(np.array([-1e-300, 0.0, 0.0, 0.0, 0.0, 0.0])) == np.inf
    assert K.project(np.array([-1.0, 3.0, 4.0, 2.0, 0.0, 7.0])).tolist() == pytest.approx([0, 1.2, 1.6, 1, 1, 0.5])
    assert K.free(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.5])).tolist() == [True, False, False, False, False, False]
    assert K.of(np.array([0, 3, 4, 5])).names() == "cones and intervals"
    assert K.of(np.array([3, 4])) == DualSet((Blocks(BlockKind.CONE, np.array([[0, 1]])),)) != K


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda: Blocks(BlockKind.RAY, np.array([[0]])), "rows in no block are rays"),
        (lambda: Blocks(BlockKind.INTERVAL, np.array([[0]])), "intervals and discs have radii"),
        (lambda: Blocks(BlockKind.INTERVAL, np.array([[0]]), np.zeros(1)), "a radius is not positive and finite"),
        (lambda: Blocks(BlockKind.INTERVAL, np.array([[0, 1]]), np.ones(1)), "intervals have one row, not 2"),
        (lambda: Blocks(BlockKind.CONE, np.array([[0]])), "cones have two rows or more, not 1"),
        (lambda: DualSet((DualSet.intervals(np.array([1]), 1.0).blocks[0],) * 2), "in two blocks"),
    ],
)
def test_blocks_that_make_no_set_are_refused(made: object, says: str) -> None:
    with pytest.raises(RequestError, match=says):
        made()  # type: ignore[operator]


def exactly_solved(rng: np.random.Generator) -> tuple[VariationalInequality, Array, Array]:
    """A dense inequality in extended precision, and its u and λ: B u − g is a normal of K at λ."""
    K, m = mixed_set(rng)
    n = m + int(rng.integers(0, 4))
    z, u = (10.0 ** rng.uniform(-2.0, 2.0) * rng.standard_normal(k).astype(Extended) for k in (m, n))
    lam = K.project(z)
    A, B = spd(n, rng).astype(Extended), rng.standard_normal((m, n)).astype(Extended)
    return VariationalInequality(A, A @ u + B.T @ lam, B, B @ u - (z - lam), K=K), u, lam


def identity_and_bounds(seed: int) -> None:
    """(i') exactly, and (ii) with a w from a point of the domain of σ_K, and with w = 0 where that is one."""
    rng = np.random.default_rng(seed)
    vi, u, lam = exactly_solved(rng)
    K, A, B = vi.K, vi.A, vi.B
    u_N = u + 10.0 ** rng.uniform(-4.0, 1.0) * rng.standard_normal(len(u))
    lam_N = K.project(lam + 10.0 ** rng.uniform(-4.0, 1.0) * rng.standard_normal(len(lam)))
    e, epsilon, s, s_exact = u - u_N, lam - lam_N, B @ u_N - vi.g, B @ u - vi.g
    r = vi.f - A @ u_N - B.T @ lam_N
    energy = np.linalg.inv(A.astype(float)).astype(Extended)
    energy = energy @ (2.0 * np.eye(len(A)) - A @ energy)  # one step of Newton's method for the inverse
    rho2, force = r @ energy @ r, B.T @ epsilon
    left = e @ A @ e + force @ energy @ force + 2.0 * (lam @ s_exact - lam_N @ s_exact)
    right = rho2 + 2.0 * lam @ s - 2.0 * lam_N @ s
    size = rho2 + 2.0 * (np.abs(lam) + np.abs(lam_N)) @ (np.abs(s) + np.abs(s_exact))
    assert abs(left - right) <= 1e-13 * size
    # y = s − B w is a normal of K, where σ_K is finite.
    z = rng.standard_normal(len(s))
    y = z - K.project(z)
    w = np.linalg.lstsq(B.astype(float), (s - y).astype(float), rcond=None)[0]
    bounds = [w, *([np.zeros(len(u))] if not K.rays(len(s)).any() and BlockKind.CONE not in K.kinds else [])]
    for one in bounds:
        kappa = K.gap(lam_N, B @ one - s) + 1e-12 * size
        assert e @ A @ e <= (rho2 + one @ A @ one + 2.0 * kappa) * (1.0 + 1e-12)


@pytest.mark.parametrize("seeds", [range(100), pytest.param(range(10_000), marks=pytest.mark.long)])
def test_identity_and_bounds_for_any_product_of_blocks(seeds: range) -> None:
    for seed in seeds:
        identity_and_bounds(seed)


def small(seed: int) -> VariationalInequality:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 20))
    m = int(rng.integers(1, n))
    bounded = np.flatnonzero(rng.random(m) < rng.choice([0.3, 1.0]))
    K = DualSet.intervals(bounded, 10.0 ** rng.uniform(-2.0, 2.0, len(bounded)))
    f = 10.0 ** rng.uniform(-2.0, 2.0) * rng.standard_normal(n)
    g = 10.0 ** rng.uniform(-2.0, 1.0) * rng.standard_normal(m)
    return VariationalInequality(sp.csr_array(spd(n, rng, 100.0)), f, sp.csr_array(rng.standard_normal((m, n))), g, K=K)


def multipliers(vi: VariationalInequality) -> Array:
    L = np.linalg.cholesky(vi.A.toarray())
    Y = np.linalg.solve(L, vi.B.toarray().T)
    target = np.linalg.solve(L, vi.f) - np.linalg.lstsq(Y.T, vi.g, rcond=None)[0]
    radii = vi.K.radii(len(vi.g))
    limits = np.where(np.isfinite(radii), -radii, 0.0), radii
    return np.asarray(lsq_linear(Y, target, limits, method="bvls", tol=1e-15, max_iter=1000).x)


def check_solution_and_bounds(seed: int) -> None:
    vi, rng = small(seed), np.random.default_rng(seed)
    solution, size = solve_high_fidelity(vi), float(np.abs(multipliers(vi)).max())
    assert np.allclose(solution.lam, multipliers(vi), rtol=0.0, atol=1e-8 * size)
    assert vi.K.contains(solution.lam)
    energy, n = EnergyNorm(vi.A, CondensedStiffness(vi.A)), len(vi.f)
    share = 10.0 ** rng.uniform(-6.0, 0.0)
    u = solution.u + share * np.abs(solution.u).max() * rng.standard_normal(n)
    lam = vi.K.project(solution.lam + share * size * rng.standard_normal(len(vi.g)))
    pair = corrected_pair(vi, energy, u, lam)
    assert vi.K.contains(pair.lam)
    V, alpha = InnerProduct(sp.csr_array(sp.eye_array(n))), Constant(0.999, proved=True)
    for one, its in ((u, lam), (pair.u, pair.lam)):
        bounds = bound_errors_at(V, vi, energy, alpha, Constant(0.0, proved=True), one, its)
        e, force = solution.u - one, vi.B.T @ (solution.lam - its)
        round_off = 1e-9 * energy.norm(solution.u)
        assert energy.norm(e) <= bounds.u_energy + round_off
        assert np.sqrt(force @ np.linalg.solve(vi.A.toarray(), force)) <= bounds.lambda_natural + round_off


@pytest.mark.parametrize("seeds", [range(40), pytest.param(range(10_000), marks=pytest.mark.long)])
def test_solutions_with_intervals_and_their_bounds(seeds: range) -> None:
    for seed in seeds:
        check_solution_and_bounds(seed)


@pytest.mark.parametrize("seed", range(5))
def test_rows_changed_one_by_one_lead_to_the_solution(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    vi = replace(small(seed), K=DualSet.intervals(np.arange(len(small(seed).g)), 0.3))
    alone, iterate = solve_high_fidelity(vi), active_set.active_set_iterations
    monkeypatch.setattr(
        active_set, "active_set_iterations",
        lambda *given, one_by_one=False: iterate(*given, one_by_one=True) if one_by_one else None,
    )  # fmt: skip
    helped = solve_high_fidelity(vi)
    assert helped.fallback == "the active set cycled; its rows were changed one by one"
    assert np.allclose(helped.lam, alone.lam, atol=1e-12)


def test_bounded_multipliers_have_a_bound_without_a_correction(monkeypatch: pytest.MonkeyPatch) -> None:
    vi = replace(small(0), K=DualSet.intervals(np.arange(len(small(0).g)), 1.0))
    energy, solution = EnergyNorm(vi.A, CondensedStiffness(vi.A)), solve_high_fidelity(vi)
    monkeypatch.setattr("vibench.model.error_bounds.active_set_iterations", lambda *_, **__: None)
    u, lam = 1.1 * solution.u, vi.K.project(0.9 * solution.lam)
    correction = find_correction(vi, energy, u, lam)
    assert not correction.w.any()
    V, alpha = InnerProduct(sp.csr_array(sp.eye_array(len(vi.f)))), Constant(0.999, proved=True)
    bounds = bound_errors_at(V, vi, energy, alpha, Constant(0.0, proved=True), u, lam)
    assert BoundNote.UNCORRECTED in bounds.note
    assert energy.norm(u - solution.u) <= bounds.u_energy < np.inf


def test_sets_without_active_sets_have_bounds_without_a_correction() -> None:
    rng = np.random.default_rng(3)
    K = DualSet((Blocks(BlockKind.DISC, np.array([[0, 1], [2, 3]]), np.array([0.5, 1.0])),))
    A, B = sp.csr_array(spd(8, rng)), sp.csr_array(rng.standard_normal((4, 8)))
    u, z = rng.standard_normal((2, 8))
    lam = K.project(3.0 * z[:4])
    vi = VariationalInequality(A, A @ u + B.T @ lam, B, B @ u - (3.0 * z[:4] - lam), K=K)
    energy, V = EnergyNorm(A, CondensedStiffness(A)), InnerProduct(sp.csr_array(sp.eye_array(8)))
    near, multiplier = u + 0.01 * z, K.project(0.99 * lam)
    alpha = Constant(float(np.linalg.eigvalsh(A.toarray())[0]) * 0.99, proved=True)
    bounds = bound_errors_at(V, vi, energy, alpha, Constant(0.0, proved=True), near, multiplier)
    assert BoundNote.UNCORRECTED in bounds.note
    assert energy.norm(near - u) <= bounds.u_energy < np.inf


def test_another_set_is_a_class_of_its_own() -> None:
    class Box(Blocks):
        def support(self, values: Array) -> Array:
            return np.asarray(np.abs(values[self.rows]).sum(axis=1))

        def gauge(self, lam: Array) -> Array:
            return np.asarray(np.abs(lam[self.rows]).max(axis=1))

        def project(self, values: Array) -> Array:
            return np.clip(values[self.rows], -1.0, 1.0)

    given = BlockKind.OTHER, np.array([[3, 1]]), np.array([np.sqrt(2.0)])
    K, intervals, y = (
        DualSet((Box(*given),)),
        DualSet.intervals(np.array([1, 3]), 1.0),
        np.array([-1.0, 2.0, 0.0, -3.0]),
    )
    for name in ("support", "gauge", "project", "contains"):
        assert np.array_equal(getattr(K, name)(y), getattr(intervals, name)(y))
    assert K.gap(K.project(y), -y) == intervals.gap(K.project(y), -y) == 0.0
    assert isinstance(K.of(np.array([1, 2, 3])).blocks[0], Box)
    assert DualSet((Blocks(BlockKind.DISC, *given[1:]),)) != K
    with pytest.raises(RequestError, match="another set is a class of its own"):
        Blocks(*given)


def test_what_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    vi, problem = small(1), Varying()
    disc = DualSet((Blocks(BlockKind.DISC, np.array([[0, 1]]), np.ones(1)),))
    with pytest.raises(UnsupportedError, match="the active set method knows rays and intervals; K has discs"):
        solve_high_fidelity(replace(vi, K=disc))
    absent = replace(vi, g=np.full(len(vi.g), np.inf), K=DualSet.intervals(np.array([0]), 1.0))
    with pytest.raises(NumericalError, match="g is infinite in row 0, whose multiplier has a bound"):
        solve_high_fidelity(absent)
    problem.K = DualSet.intervals(np.array([2]), 1.0)
    with pytest.raises(
        NumericalError, match=r"has rays as K, or other rows or radii of these; `problem.K` has intervals"
    ):
        checked_assembly(problem, np.array([0.5]))
    monkeypatch.setattr(problem, "assemble", lambda mu: replace(Varying().assemble(mu), K=problem.K))
    with pytest.raises(NumericalError, match=r"does not declare: blocks = \(BlockKind.INTERVAL,\)"):
        checked_assembly(problem, np.array([0.5]))
    assert RAYS.blocks == ()
