"""Solvers that are called without qpsolvers give what they give through it, to the last bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numerics import spd

from vibench.interfaces.problem import VariationalInequality
from vibench.qp import solve
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import DIRECT, DirectSolution
from vibench.qp.verification import QPSolution


def programs() -> list[VariationalInequality]:
    """Feasible ones of several sizes, one without constraints that act, and one that no point satisfies."""
    rng, found = np.random.default_rng(5), []
    for n, m in ((1, 1), (3, 7), (12, 12), (30, 9)):
        B = rng.standard_normal((m, n))
        found.append(VariationalInequality(spd(n, rng), rng.standard_normal(n), B, 0.1 * rng.random(m)))
    slack = replace(found[1], g=found[1].g + 100.0)
    empty = VariationalInequality(np.eye(2), np.ones(2), np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([-1.0, -1.0]))
    return [*found, slack, empty]


@pytest.mark.parametrize("solver", sorted(set(DIRECT) & set(solve.installed_solvers())))
def test_a_direct_call_is_the_call_of_qpsolvers(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def answers() -> list[QPSolution]:
        cold = [solve.solve_qp(vi, solver, 1e-9) for vi in programs()]
        dual = [solve.solve_qp(vi, solver, 1e-9, factor=np.linalg.cholesky(vi.A)) for vi in programs()]
        warm = [solve.solve_qp(vi, solver, 1e-9, start=start) for vi, start in zip(programs(), cold, strict=True)]
        return cold + dual + warm

    direct = answers()
    monkeypatch.setattr(solve, "DIRECT", {})
    for ours, theirs in zip(direct, answers(), strict=True):
        assert (ours.solver_status, ours.iterations, ours.negative) == (
            theirs.solver_status,
            theirs.iterations,
            theirs.negative,
        )
        for one, other in ((ours.x, theirs.x), (ours.alpha, theirs.alpha)):
            assert (one is None) == (other is None)
            assert one is None or other is None or one.tobytes() == other.tobytes()


def test_multipliers_of_the_dual_program_are_bounds_and_constraints_are_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[bool] = []

    def piqp(program: VariationalInequality, bounds: bool, **settings: object) -> DirectSolution:
        told.append(bounds)
        return DIRECT["piqp"](program, bounds, **settings)

    monkeypatch.setattr(solve, "DIRECT", {"piqp": piqp})
    vi = programs()[1]
    for factor in (None, np.linalg.cholesky(vi.A)):
        solve.solve_qp(vi, "piqp", 1e-9, factor=factor)
    assert told == [False, True]


@pytest.mark.parametrize("solver", sorted(set(DIRECT) & set(solve.installed_solvers())))
def test_bounds_give_what_rows_give(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def answers() -> list[QPSolution]:
        return [solve.solve_qp(vi, solver, 1e-10, factor=np.linalg.cholesky(vi.A)) for vi in programs()[:-1]]

    bounds = answers()
    monkeypatch.setattr(solve, "SETTINGS", {solver: replace(SETTINGS[solver], bounds=False)})
    for one, other in zip(bounds, answers(), strict=True):
        assert one.x is not None
        assert one.alpha is not None
        assert np.allclose(one.x, other.x, rtol=0.0, atol=1e-8)
        assert np.allclose(one.alpha, other.alpha, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("solver", sorted(set(DIRECT) & set(solve.installed_solvers())))
def test_an_answer_depends_on_nothing_that_was_solved_before(solver: str) -> None:
    of_program = [solve.solve_qp(vi, solver, 1e-9) for vi in programs()]
    for vi, first in reversed(list(zip(programs(), of_program, strict=True))):
        again = solve.solve_qp(vi, solver, 1e-9)
        assert (again.x is None) == (first.x is None)
        assert again.x is None or first.x is None or again.x.tobytes() == first.x.tobytes()
