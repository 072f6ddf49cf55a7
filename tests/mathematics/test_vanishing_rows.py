"""Zero rows of B, at every parameter or at some: they constrain nothing, or nothing satisfies them."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd
from samples import pga_reduction
from vanishing import BOX, DOFS, Base, Declared, OnContact, Vanishing, share

from vibench import Contact, HighFidelitySolver, NumericalError, VariationalInequality, solve_high_fidelity
from vibench.interfaces.absent_rows import settled_bounds, zero_rows
from vibench.model.affine import Evaluation, affine_decomposition
from vibench.offline.assemblies import Assemblies
from vibench.qp import verify
from vibench.qp.solve import installed_solvers, solve_qp
from vibench.stability.infsup import inf_sup_full, nodal_cone


@given(st.integers(0, 10_000))
def test_solutions_are_those_without_the_rows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    zero, A = rng.random(7) < 0.4, sp.csr_array(spd(5, rng))
    B, g = rng.standard_normal((7, 5)), rng.random(7) * 0.3
    B[zero] = 0.0
    stored = sp.csr_array(B) + 0.0 * sp.csr_array(np.ones((7, 5)))
    f = rng.standard_normal(5)
    found = solve_high_fidelity(VariationalInequality(A, f, sp.csr_array(stored), g))
    alone = solve_high_fidelity(VariationalInequality(A, f, sp.csr_array(B[~zero]), g[~zero]))
    np.testing.assert_allclose(found.u, alone.u, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(found.lam[~zero], alone.lam, rtol=0.0, atol=1e-9)
    assert not found.lam[zero].any()


@pytest.mark.parametrize("solver", installed_solvers())
def test_qp_solvers_leave_zero_rows_out(solver: str) -> None:
    """With g = 0 they have no interior, which some solvers need."""
    B = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    program = VariationalInequality(np.diag([2.0, 1.0, 3.0]), np.ones(3), B, np.array([0.0, 0.5, 2.0]))
    alone = replace(program, B=B[1:2], g=program.g[1:2])
    for factor in (None, np.sqrt(program.A)):
        found, same = (solve_qp(one, solver, 1e-9, factor=factor) for one in (program, alone))
        np.testing.assert_array_equal(found.alpha[[0, 2]], 0.0)
        np.testing.assert_array_equal(found.x, same.x)
    assert verify(replace(program, g=np.array([-1.0, 0.5, 2.0])), found, 1e-9)[0] == "infeasible"


@pytest.mark.parametrize("kind", [Vanishing, OnContact, Declared])
@pytest.mark.parametrize("assembly", ["full", "reduced"])
def test_a_row_that_vanishes_in_half_of_the_box_is_solved_reduced_and_bounded(kind: type[Base], assembly: str) -> None:
    problem = kind()
    bounds = assembly == "reduced" and kind is not Vanishing
    model = pga_reduction(problem, 1e-3, assembly=assembly, bounds=bounds).model
    for mu in BOX.sample(6, 1):
        exact, found = model.high_fidelity(mu), model.solve(mu)
        assert found.status == "ok"
        assert share(mu) > 0.0 or exact.lam[4] == 0.0
        away, forces = found.u - exact.u, problem.assemble(mu).B.T @ (found.lam - exact.lam)
        error = np.sqrt(away @ (problem.A @ away)), np.sqrt(forces @ problem.V.riesz(forces))
        full = found.error_bounds
        for bound in (full, found.bound) if bounds else (full,):
            assert error[0] <= bound.u_energy * (1.0 + 1e-8) + 1e-9
            assert error[1] <= bound.lambda_natural * (1.0 + 1e-8) + 1e-9
            assert bound.u_energy < 0.2 * np.sqrt(exact.u @ (problem.A @ exact.u))
        # Any multiplier of a zero row exerts no force: no bound in W follows.
        assert np.isfinite(full.lam) == (share(mu) > 0.0)


def test_constants_vanish_where_a_row_does_and_follow_unknowns_that_are_touched_later() -> None:
    problem = Vanishing()
    vanished, touched = np.array([1.5, -0.5]), np.array([1.5, 0.5])
    cache = Assemblies(problem)
    assert cache.energy_inf_sup_at(vanished).value == 0.0
    exact = Assemblies(problem).energy_inf_sup_at(touched).value
    assert cache.energy_inf_sup_at(touched).value == pytest.approx(exact, rel=1e-12)
    cone = nodal_cone(problem.W)
    assert inf_sup_full(problem.V, problem.assemble(vanished).B, cone).span == 0.0
    assert inf_sup_full(problem.V, problem.assemble(touched).B, cone).span > 0.1


def test_rows_that_vanish_at_some_parameters_are_not_interpolated() -> None:
    problem = Vanishing()
    problem.entrywise = frozenset({"B", "g", "f"})  # type: ignore[misc]
    members = affine_decomposition(problem, problem.training_set(), 1e-6)
    for name in ("B", "g"):
        assert members[name].way is Evaluation.FULL
        assert members[name].reason == "row 4 of B is zero at some parameters and not at others"
    assert affine_decomposition(OnContact(), problem.training_set(), 1e-6)["B"].way is Evaluation.CONTACT


def test_a_zero_row_below_its_bound_is_infeasible_and_named() -> None:
    problem, mu = Vanishing(bound=-0.25), np.array([1.5, -0.5])
    HighFidelitySolver(problem).solve(np.array([1.5, 0.5]))
    reason = r"row 4 of B is zero and g is -0.25 there: no u satisfies 0 ≤ -0.25"
    with pytest.raises(NumericalError, match=rf"^at mu = \[1.5, -0.5\]: {reason}$"):
        HighFidelitySolver(problem).solve(mu)
    with pytest.raises(NumericalError, match=f"^{reason}$"):
        solve_high_fidelity(problem.assemble(mu))
    with pytest.raises(NumericalError, match=f"^{reason}$"):
        OnContact(bound=-0.25).contact(mu)


def test_zero_rows_of_every_storage_and_round_off_of_a_lift_in_their_bounds() -> None:
    B, g = sp.csr_array(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])), np.array([-1e-17, 0.3, -0.5])
    assert settled_bounds(B, g).tolist() == [0.0, 0.3, -0.5]
    assert Contact(B, g).g.tolist() == [0.0, 0.3, -0.5]
    assert solve_high_fidelity(VariationalInequality(sp.eye_array(2, format="csr"), np.ones(2), B, g)).lam[0] == 0.0
    dense = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    cancelling = sp.csr_array((np.array([1.0, -1.0, 1.0]), np.array([0, 0, 0]), np.array([0, 2, 3, 3])), (3, 2))
    explicit = sp.csr_array((np.array([0.0, 1.0]), np.array([1, 0]), np.array([0, 1, 2, 2])), (3, 2))
    for B in (dense, sp.csr_array(dense), sp.csc_array(dense), sp.coo_array(dense), cancelling, explicit):
        assert zero_rows(B).tolist() == [True, False, True]
    assert len(DOFS) == 10
