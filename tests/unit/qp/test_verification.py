from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import exact, spd

from vibench import NumericalError, Status, VariationalInequality
from vibench.qp.solve import installed_solvers, solve_qp
from vibench.qp.verification import QPSolution, Residuals, infeasibility_certificate, kkt_residuals, verify

seeds = st.integers(0, 10_000)
NAMES = ("primal", "dual", "gap")


def program(seed: int, load: float = 1.0) -> VariationalInequality:
    """Six unknowns and four constraints, some of which are active."""
    rng = np.random.default_rng(seed)
    B = rng.standard_normal((4, 6))
    return VariationalInequality(spd(6, rng), load * rng.standard_normal(6), B, 0.2 * rng.standard_normal(4) - 0.05)


def answer(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """An inexact solution, whose residuals are all of the same size."""
    rng = np.random.default_rng(seed + 1)
    x, alpha = exact(program(seed))
    return x + 1e-3 * rng.standard_normal(6), np.maximum(alpha + 1e-3 * rng.standard_normal(4), 0.0)


def same(one: Residuals, other: Residuals) -> None:
    for name in NAMES:
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6, abs=1e-12), name


def test_residuals_are_those_defined_and_hide_neither_nan_nor_indefinite_matrices() -> None:
    vi = VariationalInequality(A=np.diag([4.0, 1.0]), f=np.array([4.0, 1.0]), B=np.array([[2.0, 0.0]]), g=np.ones(1))
    x, alpha = np.array([0.75, 1.0]), np.array([0.25])
    energy = 1.0  # B u₀ − g = 1, and B A⁻¹ Bᵀ = 1: more than ‖Bᵀα‖ = 0.25
    found = kkt_residuals(vi, x, alpha)
    assert found.primal == pytest.approx(0.5 / 1.0 / energy)  # B A⁻¹ Bᵀ = 1
    assert found.dual == pytest.approx(abs(4.0 - 3.0 - 0.5) / 2.0 / energy)
    assert found.gap == pytest.approx(0.25 * 0.5 / energy**2)
    assert found.worst == max(found.primal, found.dual, found.gap)
    empty = VariationalInequality(np.zeros((0, 0)), np.zeros(0), np.zeros((1, 0)), np.ones(1))
    assert kkt_residuals(empty, np.zeros(0), np.zeros(1)).worst == 0.0
    assert not kkt_residuals(program(0), np.full(6, np.nan), np.zeros(4)).worst <= 1.0
    with pytest.raises(NumericalError, match="A is not positive definite"):
        kkt_residuals(replace(program(0), A=-np.eye(6)), np.ones(6), np.zeros(4))
    x, alpha = exact(program(3))
    status, reason, _ = verify(program(3), QPSolution(x, alpha - 1e-12, "solved"), 1e-6)
    assert (status, reason) == (Status.FAILED, "the solution has negative multipliers: solved")


@given(seeds, st.integers(-9, 9), st.integers(-9, 9), st.booleans())
def test_units_rows_and_bases_change_nothing(seed: int, length: int, force: int, loaded: bool) -> None:
    vi, (x, alpha) = program(seed, float(loaded)), answer(seed)
    here, rng = kkt_residuals(vi, x, alpha), np.random.default_rng(seed)
    m, n = 10.0**length, 10.0**force
    scaled = VariationalInequality(n / m * vi.A, n * vi.f, vi.B, m * vi.g)
    same(kkt_residuals(scaled, m * x, n * alpha), here)
    rows = 10.0 ** rng.uniform(-8, 8, 4)
    same(kkt_residuals(replace(vi, B=rows[:, None] * vi.B, g=rows * vi.g), x, alpha / rows), here)
    T = np.linalg.qr(rng.standard_normal((6, 6)))[0] * 10.0 ** rng.uniform(-2, 2, 6)
    moved = VariationalInequality(T.T @ vi.A @ T, T.T @ vi.f, vi.B @ T, vi.g)
    same(kkt_residuals(moved, np.linalg.solve(T, x), alpha), here)


@given(seeds, st.sampled_from([1e6, 1e20, np.inf]))
def test_far_rows_and_sparse_formats_change_nothing(seed: int, far: float) -> None:
    vi, (x, alpha) = program(seed), answer(seed)
    beside = replace(vi, B=np.vstack([vi.B, vi.B[:1]]), g=np.append(vi.g, far))
    same(kkt_residuals(beside, x, np.append(alpha, 0.0)), kkt_residuals(vi, x, alpha))
    same(kkt_residuals(replace(vi, A=sp.csr_array(vi.A), B=sp.csr_array(vi.B)), x, alpha), kkt_residuals(vi, x, alpha))


@given(seeds)
def test_they_bound_the_error_and_vanish_with_it(seed: int) -> None:
    """(ii) of the error bounds with the smallest w: ‖e‖²_A ≤ ρ² + ω² + 2 λᵀ(B w − s); ω is at least the primal one."""
    vi, (x, alpha), (u, lam) = program(seed), answer(seed), exact(program(seed))
    assert kkt_residuals(vi, u, lam).worst <= 1e-12
    found, e = kkt_residuals(vi, x, alpha), x - u
    energy = np.sqrt(u @ vi.A @ u + (vi.B.T @ lam) @ np.linalg.solve(vi.A, vi.B.T @ lam))
    assert found.worst >= 1e-3 * (e @ vi.A @ e) / energy**2


def test_small_units_far_gaps_missing_loads_and_ties_hide_no_error() -> None:
    """An absolute floor of the primal residual called the unconstrained solution ok."""
    vi = program(3)
    small = VariationalInequality(vi.A, 1e-9 * vi.f, vi.B, 1e-9 * vi.g)
    x = np.linalg.solve(small.A, small.f)
    assert np.any(small.B @ x > small.g)
    status, reason, _ = verify(small, QPSolution(x, np.zeros(4), "solved"), 1e-6)
    assert status is Status.INACCURATE
    assert reason.startswith("primal residual")
    for far in (2e5, 2e7, 1e20):
        vi = VariationalInequality(np.eye(2), np.zeros(2), np.eye(2), np.array([-1.0, far]))
        for depth, status in ((1.0, Status.OK), (0.9, Status.INACCURATE), (1.1, Status.INACCURATE)):
            answer = QPSolution(np.array([-depth, 0.0]), np.array([depth, 0.0]), "")
            assert verify(vi, answer, 1e-8)[0] is status
    vi = VariationalInequality(np.diag([4.0, 1.0]), np.zeros(2), np.eye(2), np.array([0.0, 1e20]))
    found = solve_qp(vi, "piqp", 1e-8)
    assert (found.x.tolist(), found.alpha.tolist()) == ([0.0, 0.0], [0.0, 0.0])
    assert kkt_residuals(vi, found.x, found.alpha).worst == 0.0
    assert kkt_residuals(vi, np.array([1e-9, 0.0]), np.zeros(2)).dual == pytest.approx(1.0)  # no other scale is there
    # contradictions are certified beside a far row
    B = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])
    for far in (1.0, 1e20, np.inf):
        vi = VariationalInequality(np.eye(2), np.zeros(2), B, np.array([-1.0, 0.5, far]))
        alpha = infeasibility_certificate(vi)
        assert np.allclose(B.T @ alpha, 0.0, atol=1e-9)
        assert alpha[:2] @ vi.g[:2] < 0.0
        assert infeasibility_certificate(replace(vi, g=np.array([-1.0, 1.5, far]))) is None
    # Opposite rows hold x₁ = 1e6; F is that of the contact of x₂ alone, 0.25/√1.
    B = np.array([[1.0, 0.0], [-2.0, 0.0], [0.0, 1.0]])
    vi = VariationalInequality(np.eye(2), np.array([0.0, 1.0]), B, np.array([1e6, -2e6, 0.75]))
    right, wrong = (QPSolution(np.array([1e6, x]), np.array([0.0, 5e5, 1.0 - x]), "") for x in (0.75, 1.0))
    assert verify(vi, right, 1e-8)[0] is Status.OK
    assert verify(vi, wrong, 1e-3)[0] is Status.INACCURATE
    assert kkt_residuals(vi, right.x, right.alpha).unit == pytest.approx(0.25)


def with_a_loaded_body(seed: int, fraction: float) -> tuple[VariationalInequality, np.ndarray, float]:
    """A body in contact beside a loaded one without constraints, in a common basis; λ, and the F of contact.

    F is the given fraction of the energy of the loaded body.
    """
    rng = np.random.default_rng(seed)
    one, other = program(seed), spd(6, rng)
    _, lam = exact(one)
    F = float(np.linalg.norm(np.linalg.solve(np.linalg.cholesky(one.A), one.B.T @ lam)))
    load = rng.standard_normal(6)
    load *= F / fraction / np.sqrt(load @ np.linalg.solve(other, load))
    Q = np.linalg.qr(rng.standard_normal((12, 12)))[0]
    A = Q @ scipy.linalg.block_diag(one.A, other) @ Q.T
    vi = VariationalInequality(A, Q @ np.concatenate([one.f, load]), np.hstack([one.B, np.zeros((4, 6))]) @ Q.T, one.g)
    return vi, lam, F


def natural_error(vi: VariationalInequality, alpha: np.ndarray, lam: np.ndarray) -> float:
    """‖Bᵀ(λ − α)‖ in A⁻¹."""
    return float(np.linalg.norm(np.linalg.solve(np.linalg.cholesky(vi.A), vi.B.T @ (alpha - lam))))


@given(seeds, st.sampled_from([1e-2, 1e-4, 1e-10]))
def test_a_loaded_body_beside_the_one_in_contact_hides_no_error(seed: int, fraction: float) -> None:
    """Relative to the energy of both bodies, twice λ and no contact at all were ok."""
    vi, lam, F = with_a_loaded_body(seed, fraction)
    if not F > 0.0:
        return
    free = np.linalg.solve(vi.A, vi.f)
    for wrong in (0.0, 0.5, 0.9, 1.1, 2.0):
        x = free - np.linalg.solve(vi.A, vi.B.T @ (wrong * lam))
        assert verify(vi, QPSolution(x, wrong * lam, ""), 1e-3)[0] is Status.INACCURATE, wrong
    # In a common basis the data themselves leave the round-off of the whole over that of the contact open.
    accuracy = max(1e-12, 1e-14 / fraction)
    assert kkt_residuals(vi, free - np.linalg.solve(vi.A, vi.B.T @ lam), lam, accuracy=accuracy).worst <= accuracy
    alone = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(vi.A), vi.B.T @ lam))
    assert kkt_residuals(vi, x, lam).unit == pytest.approx(alone, rel=1e-5)


@pytest.mark.parametrize("solver", ["piqp", "daqp", "clarabel", "cvxopt", "osqp"])
@pytest.mark.parametrize("accuracy", [1e-6, 1e-9])
@pytest.mark.parametrize("count", [7, pytest.param(600, marks=pytest.mark.long)])
def test_what_is_ok_is_accurate_relative_to_the_contact(solver: str, accuracy: float, count: int) -> None:
    """With E = √(ε² + 2ε(1 + π)) the natural error of λ is at most F·E/(1 − E), F from all to 1e-6 of the energy."""
    if solver not in installed_solvers():
        pytest.skip(f"{solver} is of the extra `solvers`")
    ok = 0
    for seed in range(count):
        vi, lam, F = with_a_loaded_body(seed, 10.0 ** (-6 * (seed % 7) / 6))
        for factor in (None, np.linalg.cholesky(vi.A)):
            found = solve_qp(vi, solver, accuracy, factor=factor)
            if verify(vi, found, accuracy)[0] is Status.OK:
                lengths = np.sqrt(np.einsum("ij,ji->i", vi.B, np.linalg.solve(vi.A, vi.B.T)))
                pi = float(lam @ lengths) / F if F else 0.0
                E, ok = np.sqrt(accuracy**2 + 2.0 * accuracy * (1.0 + pi)), ok + 1
                assert natural_error(vi, found.alpha, lam) <= F * E / (1.0 - E), seed
    assert ok >= 0.95 * 2 * count
