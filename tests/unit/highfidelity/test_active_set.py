import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying, exact, spd
from scipy.spatial import KDTree

from vibench import Array, HighFidelitySolver, NestedStart, Reduction, Stop, create, solve_high_fidelity
from vibench.errors import NumericalError
from vibench.highfidelity import active_set, kkt_systems
from vibench.highfidelity.kkt_systems import CondensedStiffness, MultigridStiffness
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.factorisations import IMPLEMENTATIONS
from vibench.linalg.multigrid import NullSpaceSolver
from vibench.linalg.schur_complement import EliminationPattern
from vibench.qp import kkt_residuals
from vibench.reduction.pod import pod
from vibench_problems import obstacle
from vibench_problems.obstacle import Obstacle

NEEDS_PYAMG = pytest.mark.skipif(not IMPLEMENTATIONS["multigrid"].is_installed, reason="needs pyamg")
MADE = pytest.mark.parametrize("made", [CondensedStiffness, pytest.param(MultigridStiffness, marks=NEEDS_PYAMG)])


def string(n: int, gap: float, load: float = 1.0) -> VariationalInequality:
    """−u″ = −load on (0, 1), u ≥ −gap, with lumped constraints on every inner node."""
    h = 1.0 / (n + 1)
    A = sp.diags_array([2.0 * np.ones(n), -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1]) / h
    B = -h * sp.eye_array(n, format="csr")
    return VariationalInequality(sp.csc_array(A), -load * h * np.ones(n), B, h * gap * np.ones(n))


def test_the_string_on_a_table_against_its_closed_form() -> None:
    """Contact from s on with s = √(2 gap/load); u = −gap + load (s − x)²/2 before; the multiplier is the load."""
    gap, load, n = 0.02, 1.0, 999
    solution = active_set.solve_high_fidelity(string(n, gap, load))
    s, x = np.sqrt(2.0 * gap / load), np.linspace(0.0, 1.0, n + 2)[1:-1]
    nearest = np.minimum(x, 1.0 - x)
    exact_u = np.where(nearest < s, -gap + 0.5 * load * (s - nearest) ** 2, -gap)
    assert np.abs(solution.u - exact_u).max() < 2e-6
    inside = nearest > s + 2e-3
    assert np.allclose(solution.lam[inside], load, rtol=1e-8)
    assert np.all(solution.lam[nearest < s - 2e-3] == 0.0)


@given(st.integers(0, 10_000))
def test_every_solution_is_that_of_the_right_active_set(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vi = VariationalInequality(spd(7, rng), rng.standard_normal(7), rng.standard_normal((4, 7)), rng.random(4) * 0.2)
    sparse = VariationalInequality(sp.csc_array(vi.A), vi.f, sp.csr_array(vi.B), vi.g)
    found, (x, alpha) = active_set.solve_high_fidelity(sparse), exact(vi)
    assert np.allclose(found.u, x, atol=1e-8)
    assert np.allclose(found.lam, alpha, atol=1e-7)
    assert found.residuals.worst <= 1e-10


def test_kkt_conditions_hold_with_exact_zeros() -> None:
    problem = Varying()
    for mu in problem.training_set():
        found = active_set.solve_high_fidelity(vi := problem.assemble(mu))
        assert np.abs(vi.A @ found.u + vi.B.T @ found.lam - vi.f).max() <= 1e-10 * np.abs(vi.f).max()
        assert np.all(found.lam >= 0.0)
        gap = vi.B @ found.u - vi.g
        assert gap.max() <= 1e-10
        assert np.all((found.lam == 0.0) | (np.abs(gap) <= 1e-10))
        assert 0 < np.count_nonzero(found.lam) < 8


@MADE
def test_a_cycling_active_set_is_helped_and_the_help_is_recorded(monkeypatch: pytest.MonkeyPatch, made: type) -> None:
    vi = string(50, 0.02)
    alone, iterate = active_set.solve_high_fidelity(vi), active_set.active_set_iterations
    assert alone.fallback == ""
    cycles_at_first = iter([None])

    def iterates(*given: Any, **named: Any) -> Any:
        return next(cycles_at_first, iterate(*given, **named))

    monkeypatch.setattr(active_set, "active_set_iterations", iterates)
    helped = active_set.solve_high_fidelity(vi, made(vi.A))
    assert "cycled" in helped.fallback
    assert np.allclose(helped.u, alone.u, atol=1e-12)
    assert np.array_equal(helped.lam == 0.0, alone.lam == 0.0)


def test_no_active_constraint_all_active_and_what_is_infeasible() -> None:
    assert np.all(active_set.solve_high_fidelity(string(20, 10.0)).lam == 0.0)
    pressed = active_set.solve_high_fidelity(string(20, 0.0))
    assert np.allclose(pressed.lam, 1.0)
    assert np.abs(pressed.u).max() < 1e-15
    problem, mu = Varying(), np.array([0.5])
    vi = problem.assemble(mu)  # constraints that touch nothing leave a linear problem
    free = replace(vi, B=sp.csr_array(vi.B.shape), g=np.ones(len(vi.g)))
    found = active_set.HighFidelitySolver(problem).solve_assembled(mu, free)
    assert np.allclose(found.u, np.linalg.solve(vi.A.toarray(), vi.f))
    assert not found.lam.any()
    infeasible = replace(vi, B=sp.csr_array(sp.vstack([vi.B[:4], -vi.B[:4]])), g=-np.ones(8))
    problem.assemble = lambda mu: infeasible  # type: ignore[method-assign]
    with pytest.raises(NumericalError, match=r"^at mu = \[0.5\]: rows . and . of B are opposite, and no u satisfies"):
        active_set.HighFidelitySolver(problem).solve(mu)


ONE, SHIFTED, ANY = sp.eye_array(36, format="csr"), sp.eye_array(36, k=1, format="csr"), np.random.default_rng(0)
MANY, FEW = ANY.standard_normal((150, 36)), ANY.standard_normal((36, 9)) @ ANY.standard_normal((9, 36))
OPPOSITE, NONE = r"rows \d+ and \d+ of B are opposite", "no active set solves the high-fidelity problem; is it feasible"
SYSTEMS = [
    ([ONE, -ONE], -1.0, OPPOSITE), ([ONE, -ONE, 1e6 * ONE, -2.0 * ONE], -1.0, OPPOSITE), ([ONE, 1e6 * ONE], 0.1, ""),
    ([ONE, ONE + 1e-10 * SHIFTED], 0.1, ""), ([ONE, -ONE[:-1] - 1e-10 * SHIFTED[:-1]], -1.0, NONE),
    ([ONE, 0.0 * ONE], 0.1, ""), ([ONE, 0.0 * ONE], -0.1, "row 36 of B is zero"),
    ([ONE, ONE[:-1] + ONE[1:], ONE[:-1] - ONE[1:]], -0.1, ""),
    ([MANY], 0.1, ""), ([MANY], -1.0, NONE), ([FEW], -1.0, NONE), ([FEW, ONE], 0.1, ""),
]  # fmt: skip


@pytest.mark.parametrize(("rows", "bound", "reason"), SYSTEMS)
@pytest.mark.parametrize("whole", [True, False])
@MADE
def test_systems_that_cannot_be_regular_are_not_factorised(
    rows: list, bound: float, reason: str, whole: bool, made: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SuperLU took minutes for such systems, or destroyed the heap."""
    vi = replace(string(36, 0.0, -1.0), B=sp.csr_array(sp.vstack([sp.csr_array(part) for part in rows])))
    stiffness = made(vi.A, EliminationPattern.of_none(vi.A) if whole else None)
    vi, factorised, plain = replace(vi, g=np.full(vi.B.shape[0], bound)), [], kkt_systems.splu
    monkeypatch.setattr(kkt_systems, "splu", lambda matrix: factorised.append(matrix.shape[0]) or plain(matrix))
    if reason:
        with pytest.raises(NumericalError, match=reason):
            active_set.solve_high_fidelity(vi, stiffness)
    else:
        assert (vi.B @ active_set.solve_high_fidelity(vi, stiffness).u).max() <= bound + 1e-10
    assert max(factorised, default=0) <= 72
    assert len(factorised) < 15


@pytest.mark.parametrize("dense", [False, pytest.param(True, marks=pytest.mark.long)])
def test_four_times_as_many_rows_as_unknowns_are_solved_or_refused(dense: bool) -> None:
    """The sizes at which the interpreter aborted, or hung; in full matrices it takes ten seconds each."""
    vi, one = string(400, 0.0, 40.0), sp.eye_array(400, format="csr")
    with pytest.raises(NumericalError, match=OPPOSITE):
        active_set.solve_high_fidelity(replace(vi, B=sp.vstack([one, -one], format="csr"), g=-np.ones(800)))
    sparse = sp.vstack([one, -2.0 * one, one + sp.eye_array(400, k=1), one - sp.eye_array(400, k=1)])
    B = sp.csr_array(np.random.default_rng(0).standard_normal((1600, 400)) if dense else sparse)
    with pytest.raises(NumericalError, match=NONE if dense else OPPOSITE):
        active_set.solve_high_fidelity(replace(vi, B=B, g=-np.ones(1600)))
    found = active_set.solve_high_fidelity(replace(vi, B=B, g=(g := np.full(1600, 0.1))))
    room = g - B @ found.u
    assert room.min() >= -1e-12
    assert found.lam.min() >= 0.0
    assert found.lam.max() > 0.0
    assert abs(found.lam @ room) <= 1e-10 * found.lam.max()
    assert np.abs(vi.A @ found.u + B.T @ found.lam - vi.f).max() <= 1e-10 * np.abs(vi.f).max()


def test_a_contact_set_that_moves_node_by_node_is_followed_to_its_end() -> None:
    """A soft rope on hills, every node of which is constrained: after Haasdonk, Salomon and Wohlmuth (2012)."""
    half = 320
    step, nodes = 0.5 / half, 2 * half - 1
    x = step * np.arange(1, nodes + 1)
    difference = sp.diags_array([1.0, -1.0], offsets=[0, -1], shape=(nodes + 1, nodes)).tocsr()
    left, right = (part.T @ part / step for part in (difference[:half], difference[half:]))
    obstacle = -0.2 * (np.sin(np.pi * x) - np.sin(3.0 * np.pi * x)) - 0.5
    lumped = sp.diags_array(np.full(nodes, step)).tocsr()
    vi = VariationalInequality(0.05 * left + 0.15 * right, np.full(nodes, -step), -lumped, -step * obstacle)
    assert (found := active_set.solve_high_fidelity(vi)).iterations > 100
    assert found.fallback == ""
    assert np.all(found.u >= obstacle - 1e-12)


@pytest.mark.parametrize("fraction", [1.0, 1e-4, 1e-8])
@MADE
def test_a_string_in_contact_is_as_accurate_beside_a_loaded_one(fraction: float, made: type) -> None:
    """Its residuals are relative to what contact does, in x − A⁻¹f where round-off of the whole would hide them."""
    one = string(100, 0.03)
    alone, B = active_set.solve_high_fidelity(one), sp.csr_array(sp.hstack([one.B, 0.0 * one.B]))
    both = replace(one, A=sp.csr_array(sp.block_diag([one.A, one.A])), f=np.append(one.f, one.f / fraction), B=B)
    beside = active_set.solve_high_fidelity(both, made(both.A))
    assert beside.residuals.worst <= 1e-10
    assert beside.residuals.unit == pytest.approx(alone.residuals.unit, rel=1e-9)
    assert np.allclose(beside.lam, alone.lam, rtol=1e-9)
    assert kkt_residuals(both, beside.u, 2.0 * beside.lam).worst > 0.1


class Crooked(Varying):
    """The string with an A that is not symmetric, and does not depend on the parameter where it is `constant`."""

    def assemble(self, mu: Array) -> VariationalInequality:
        vi, first = super().assemble(mu), super().assemble(np.zeros(1))
        A = (first if "A" in self.constant else vi).A.tolil()
        A[0, 1] *= 1.001
        return replace(vi, A=sp.csc_array(A))


@pytest.mark.parametrize("constant", [frozenset(), frozenset({"A"})], ids=["varying", "constant"])
def test_an_unsymmetric_stiffness_is_refused(constant: frozenset[str], monkeypatch: pytest.MonkeyPatch) -> None:
    problem, mu = Crooked(), np.array([0.5])
    monkeypatch.setattr(Crooked, "constant", constant)
    with pytest.raises(NumericalError, match=r"^A is not symmetric"):
        solve_high_fidelity(problem.assemble(mu))
    with pytest.raises(NumericalError, match=r"^A at mu = \[0.5\] is not symmetric"):
        active_set.HighFidelitySolver(problem).solve(mu)
    given = create("dual strategy", "cpg"), create("primal strategy", "online-supremizers"), Stop(size=3), Stop(size=3)
    reduction, right = Reduction(problem, *given), Reduction(Varying(), *given)
    # Snapshots of another code say nothing of this A, which projections would symmetrise.
    for each in (reduction, reduction.given(snapshots=right.snapshots)):
        with pytest.raises(NumericalError, match=r"^A at mu = \[0.0\] is not symmetric"):
            each.model  # noqa: B018


def test_a_constant_stiffness_is_checked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    checked, check = [], active_set.check_symmetric
    monkeypatch.setattr(active_set, "check_symmetric", lambda A, name: checked.append(name) or check(A, name))
    for constant, count in ((frozenset[str](), 3), (frozenset({"A"}), 1)):
        problem = Crooked()
        monkeypatch.setattr(Crooked, "constant", constant)
        vi, solver = Varying().assemble(np.zeros(1)), active_set.HighFidelitySolver(problem)
        monkeypatch.setattr(problem, "assemble", lambda mu, vi=vi: vi)
        checked.clear()
        for mu in problem.parameters.grid(3):
            solver.solve(mu)
        assert len(checked) == count


@pytest.mark.parametrize(("n", "rows"), [(5, 3), (50, 1), (5000, 1)])
@pytest.mark.parametrize("condensing", [False, True])
def test_a_body_that_contact_alone_holds_is_called_singular(n: int, rows: int, condensing: bool) -> None:
    """Free springs above a table: of 5,000 the last pivot is positive by round-off."""
    springs = sp.diags_array([-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n))
    B = -sp.eye_array(n, format="csr")[-rows:]
    vi = VariationalInequality(sp.csr_array(n * springs.T @ springs), -np.ones(n) / n, B, np.zeros(rows))
    problem = Varying(n, rows)
    problem.assemble = lambda mu: vi  # type: ignore[method-assign]
    reason = "not positive definite: it is singular, constants are in its kernel: .*contact alone holds a body"
    with pytest.raises(NumericalError, match=f"^A is {reason}"):
        solve_high_fidelity(vi)
    with pytest.raises(NumericalError, match=rf"^A at mu = \[0.5\] is {reason}"):
        active_set.HighFidelitySolver(problem, condensing=condensing).solve(np.array([0.5]))


MU = np.array([1.1, 0.02, -0.03])


def places(problem: Obstacle) -> Array:
    return problem.mesh.p[:, problem.disc_nodes]


def test_coarser_meshes_save_iterations_and_change_no_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse, fine = Obstacle(700), Obstacle(2800)
    cold = HighFidelitySolver(fine).solve(MU)
    nested = NestedStart(coarse, places(coarse), places(fine))
    coarsely = HighFidelitySolver(coarse).solve(MU).lam > 0.0
    start, contact, spacing = coarsely[nested.nearest], cold.lam > 0.0, 1.1 / np.sqrt(coarse.nodes)
    for wrong, others in ((start & ~contact, contact), (~start & contact, ~contact)):  # near the edge of the contact
        distances, _ = KDTree(places(fine)[:, others].T).query(places(fine)[:, wrong].T)
        assert np.max(distances, initial=0.0) < 1.5 * spacing
    fine.start = lambda mu, nearest: nested  # type: ignore[method-assign]
    assert (found := HighFidelitySolver(fine).solve(MU)).iterations < 0.6 * cold.iterations
    assert found.fallback == ""
    assert np.array_equal(found.lam > 0.0, cold.lam > 0.0)
    assert np.allclose(found.u, cold.u, rtol=0.0, atol=1e-12)
    cold = HighFidelitySolver(Obstacle(1500)).solve(MU)
    monkeypatch.setattr(obstacle, "NESTED", 1000)
    problem = Obstacle(1500)
    first = (solver := HighFidelitySolver(problem)).solve(MU)
    assert first.iterations < cold.iterations
    assert np.allclose(first.u, cold.u, rtol=0.0, atol=1e-12)
    nearest = first.lam > 0.0
    assert problem.start(MU, nearest) is nearest
    assert solver.solve(MU).iterations == 1  # from its own contact set


@NEEDS_PYAMG
def test_by_multigrid_most_sets_are_solved_roughly_and_no_matrix_is_factorised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(obstacle, "NESTED", 1500)
    default, solve = Obstacle(1600, ceiling=0.012), NullSpaceSolver.__call__
    problem = create("problem", "obstacle", {"resolution": 1600, "ceiling": 0.012, "factorisation": "multigrid"})
    problem.V.__dict__["_factor"] = None
    (solver, exact), shares, V = map(HighFidelitySolver, (problem, default)), list[float](), default.V
    monkeypatch.setattr(NullSpaceSolver, "__call__", lambda self, *a: (solve(self, *a), shares.append(self._share))[0])
    for mu in problem.parameters.sample(2, 0):
        found, expected = solver.solve(mu), exact.solve(mu)
        assert V.norm(found.u - expected.u) <= 1e-9 * V.norm(expected.u)
        assert np.array_equal(found.lam > 0.0, expected.lam > 0.0)
    assert sum(share > 1e-9 for share in shares) >= len(shares) / 2
    assert solver._coarse._problem.factorisation == "multigrid"
    assert isinstance(problem.start(mu, found.lam > 0.0), NestedStart)  # although there is a nearest set
    force = (A := problem.assemble(mu).A) @ found.u
    assert solver._stiffness.dual_norms(force[:, None]) == pytest.approx(np.sqrt(found.u @ A @ found.u), rel=1e-3)
    snapshots = np.random.default_rng(0).standard_normal((V.dim, 6)) * 10.0 ** -np.arange(6)
    ours, theirs = (pod(snapshots, X, Stop(size=5)) for X in (problem.V, V))
    assert np.allclose(ours.errors, theirs.errors, rtol=1e-10)
    assert np.allclose(np.abs(V.gram(ours.basis, theirs.basis)), np.eye(5), atol=1e-10)
    assert np.allclose(problem.V.norm(snapshots), V.norm(snapshots), rtol=1e-12)


def test_a_start_depends_on_the_parameter_alone_and_can_be_copied_after_use() -> None:
    coarse, fine = Obstacle(300), Obstacle(700)
    nested = NestedStart(coarse, places(coarse), places(fine))
    fine.start = lambda mu, nearest: nested  # type: ignore[method-assign]
    solver, other = HighFidelitySolver(fine), HighFidelitySolver(fine)
    first = solver.solve(MU).iterations
    other.solve(fine.parameters.lower)
    assert other.solve(MU).iterations == solver.solve(MU).iterations == first
    assert np.array_equal(pickle.loads(pickle.dumps(nested)).nearest, nested.nearest)


def test_a_start_of_the_wrong_kind_is_named() -> None:
    problem = Obstacle(400)
    for start in (np.zeros(3, bool), np.zeros(problem.W.dim)):  # too short, not of booleans
        problem.start = lambda mu, nearest, start=start: start  # type: ignore[method-assign]
        expected = rf"start returns .*; expected truth values \({problem.W.dim},\), a NestedStart, or None"
        with pytest.raises(NumericalError, match=expected):
            HighFidelitySolver(problem).solve(MU)
