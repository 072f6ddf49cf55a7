"""Rows with an infinite g constrain nothing: everything is as without them, or with g = 1e20."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from numerics import Varying
from samples import pga_reduction

from vibench import AffineProblem, Array, InnerProduct, NumericalError, ParameterBox, Sampler, VariationalInequality
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.validation import checked_assembly
from vibench.model.affine import Evaluation, affine_decomposition
from vibench.qp.solve import installed_solvers, solve_qp

INFINITE, FAR, REMOVED = float("inf"), 1e20, 0.0


class Partly(Varying):
    """The string with three rows that ask for more than is possible, and have the bound `absent`, or are removed."""

    constant = frozenset({"f", "B"})
    entrywise = frozenset({"A", "g"})

    def __init__(self, absent: float, sometimes: bool = False) -> None:
        super().__init__(m=8)
        self._absent, self._sometimes = absent, sometimes
        if absent != REMOVED:
            self.W = InnerProduct(sp.block_diag([self.W.matrix, np.eye(3) / 24.0]))

    def assemble(self, mu: Array) -> VariationalInequality:
        vi, at = super().assemble(np.zeros(1)), super().assemble(mu)
        vi = VariationalInequality(at.A, vi.f, vi.B, vi.g * (1.0 + 0.3 * mu[0]))
        if self._absent == REMOVED:
            return vi
        B = sp.vstack([vi.B, np.ones((3, 30)) * [[1.0], [-1.0], [0.5]]], format="csr")
        g = np.append(vi.g, 3 * [self._absent])
        if self._sometimes and mu[0] < 0.5:
            g[-1] = 1e3
        return VariationalInequality(vi.A, vi.f, B, g)

    def sampler(self, wanted: Mapping[str, tuple[Array, Array]]) -> Sampler:
        at = self.assemble
        return lambda mu: {"A": at(mu).A.toarray()[wanted["A"]], "g": at(mu).g[wanted["g"][0]]}


class Declared(AffineProblem):
    """A membrane of springs, whose last unknown has no obstacle."""

    parameters = ParameterBox(("load",), np.array([1.0]), np.array([2.0]), ("1",))

    def __init__(self, absent: float) -> None:
        n = 30
        A = sp.diags_array([2.1 * np.ones(n), -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1], format="csr")
        B, g = -sp.eye_array(n, format="csr")[8:20], 0.3 * np.ones(12)
        g[-4:] = absent
        kept = g != REMOVED
        finite, infinite = np.where(g == 0.3, g, 0.0), np.where(g == 0.3, 0.0, g)
        self.V, self.W = InnerProduct(A), InnerProduct(sp.eye_array(np.count_nonzero(kept)))
        g = [("1 + load", finite[kept]), (1.0, infinite[kept])]
        self.declare(A=A, f=[("load", -np.ones(n))], B=sp.csr_array(B[kept]), g=g)

    def training_set(self) -> Array:
        return self.parameters.grid(6)


@pytest.mark.parametrize("absent", [INFINITE, FAR])
@pytest.mark.parametrize("assembly", ["full", "reduced"])
def test_solutions_and_reduced_ones_are_those_without_the_rows(absent: float, assembly: str) -> None:
    problem, without = Partly(absent), Partly(REMOVED)
    models = [pga_reduction(each, 1e-3, assembly=assembly).model for each in (problem, without)]
    for mu in problem.parameters.sample(5, 3):
        exact, expected = (HighFidelitySolver(each).solve(mu) for each in (problem, without))
        np.testing.assert_allclose(exact.u, expected.u, rtol=0.0, atol=1e-10 * np.abs(expected.u).max())
        np.testing.assert_allclose(exact.lam, np.append(expected.lam, 3 * [0.0]), rtol=0.0, atol=1e-10)
        found, same = (model.solve(mu) for model in models)
        assert (found.status, same.status) == ("ok", "ok")
        np.testing.assert_allclose(found.u, same.u, rtol=0.0, atol=1e-6 * np.abs(same.u).max())
        np.testing.assert_array_equal(found.lam[-3:], 0.0)
        bounds = [(one.u_energy, one.lambda_natural) for one in (found.error_bounds, same.error_bounds)]
        assert bounds[0] == pytest.approx(bounds[1], rel=1e-4, abs=1e-8)


@pytest.mark.parametrize("absent", [INFINITE, FAR])
def test_certificates_are_those_without_the_rows(absent: float) -> None:
    models = [pga_reduction(Declared(r), 1e-3, assembly="reduced", bounds=True).model for r in (absent, REMOVED)]
    for mu in Declared.parameters.sample(5, 3):
        found, same = (model.solve(mu) for model in models)
        np.testing.assert_allclose(found.u, same.u, rtol=0.0, atol=1e-9)
        assert found.bound.u_energy == pytest.approx(same.bound.u_energy, rel=1e-3, abs=1e-8)
        assert found.bound.guarantee == same.bound.guarantee


def test_rows_that_are_absent_at_some_parameters_are_not_interpolated_and_generators_on_them_not_used_there() -> None:
    problem = Partly(INFINITE, sometimes=True)
    member = affine_decomposition(problem, problem.training_set(), 1e-6)["g"]
    assert member.way is Evaluation.FULL
    assert member.reason == "row 10 of g is infinite at some parameters and not at others"
    model = pga_reduction(problem, 1e-3, assembly="reduced").model
    for mu in problem.parameters.sample(5, 3):
        found = model.solve(mu)
        assert found.status == "ok"
        assert mu[0] < 0.5 or found.lam[-1] == 0.0
    always = affine_decomposition(Partly(INFINITE), problem.training_set(), 1e-6)["g"]
    assert always.way is Evaluation.INTERPOLATED


@pytest.mark.parametrize("solver", installed_solvers())
def test_qp_solvers_leave_absent_rows_out(solver: str) -> None:
    B, g = np.array([[1.0, 1.0, 0.0], [-5.0, 0.0, 1.0]]), np.array([0.5, np.inf])
    program = VariationalInequality(np.diag([2.0, 1.0, 3.0]), np.ones(3), B, g)
    alone = replace(program, B=B[:1], g=g[:1])
    found, same = solve_qp(program, solver, 1e-9), solve_qp(alone, solver, 1e-9)
    np.testing.assert_allclose(found.x, same.x, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(found.alpha, [same.alpha[0], 0.0], rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("wrong", [float("nan"), -float("inf")])
def test_what_is_no_bound_is_refused(wrong: float) -> None:
    with pytest.raises(NumericalError, match=r"g has entries that are not finite at mu = \[0.5\]; \+inf, which means"):
        checked_assembly(Partly(wrong), np.array([0.5]))
