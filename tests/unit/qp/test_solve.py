from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import qpsolvers
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import exact, spd

from vibench import NumericalError, QPSolution, Status, VariationalInequality
from vibench.qp import solve, verification
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import DIRECT, installed_solvers, solve_qp
from vibench.text import LONGEST

seeds = st.integers(0, 10_000)


def program(seed: int, n: int = 6, m: int = 4, sizes: tuple[int, int] = (-4, 4)) -> VariationalInequality:
    rng = np.random.default_rng(seed)
    B = rng.standard_normal((m, n)) * 10.0 ** rng.integers(*sizes, (m, 1))
    g = B @ rng.standard_normal(n) * 0.1 + np.abs(B).sum(axis=1) * 0.05
    return VariationalInequality(spd(n, rng), 1e-3 * rng.standard_normal(n) * 50.0, B, g)


def pressed(seed: int) -> VariationalInequality:
    vi = program(seed)
    return replace(vi, f=100.0 * vi.f)


def test_programs_sparse_or_without_unknowns_or_constraints_are_solved() -> None:
    for bound, status in ((1.0, "ok"), (-1.0, "infeasible")):
        vi = VariationalInequality(np.zeros((0, 0)), np.zeros(0), np.zeros((1, 0)), np.array([bound]))
        assert verification.verify(vi, solve_qp(vi, "osqp", 1e-8), 1e-8)[0] == status
    vi = program(3)
    sparse = VariationalInequality(sp.csc_array(vi.A), vi.f, sp.csr_array(vi.B), vi.g)
    answer = solve_qp(sparse, "piqp", 1e-9)
    assert np.allclose(answer.x, exact(vi)[0], atol=1e-7)
    assert verification.kkt_residuals(sparse, answer.x, answer.alpha).worst <= 1e-9


@pytest.mark.parametrize("solver", [*installed_solvers(), "own"])
@pytest.mark.parametrize("kind", ["none", "far"])
def test_programs_without_constraints_are_solved_for_every_solver(solver: str, kind: str) -> None:
    """Far constraints are left out at first, and none may be left."""
    A, f = spd(4, np.random.default_rng(0)), np.arange(4.0)
    B, g = (np.zeros((0, 4)), np.zeros(0)) if kind == "none" else (np.ones((2, 4)), np.full(2, 1e30))
    x = np.linalg.solve(A, f)
    own = {"own": lambda program, accuracy: pytest.fail("there is nothing to solve for a solver")}
    for vi in (VariationalInequality(A, f, B, g), VariationalInequality(sp.csc_array(A), f, sp.csr_array(B), g)):
        for factor in (None, np.linalg.cholesky(A)):
            answer = solve_qp(vi, solver, 1e-8, own, factor if isinstance(vi.A, np.ndarray) else None)
            assert verification.verify(vi, answer, 1e-12)[0] is Status.OK
            np.testing.assert_allclose(answer.x, x, rtol=1e-13)
            np.testing.assert_array_equal(answer.alpha, np.zeros(len(g)))
    indefinite = VariationalInequality(-A, f, B[:0], g[:0])
    assert solve_qp(indefinite, solver, 1e-8, own).x is None


@pytest.mark.parametrize("error", [ValueError("no rows"), qpsolvers.exceptions.ProblemError("not convex"), KeyError(1)])
def test_what_a_solver_raises_is_its_status(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def raising(*given: Any, **settings: Any) -> Any:
        raise error

    monkeypatch.setattr(qpsolvers, "solve_problem", raising)
    monkeypatch.setitem(DIRECT, "piqp", raising)  # type: ignore[misc]
    vi, reason = pressed(0), f"{type(error).__name__}: "
    for solver in ("osqp", "piqp", "own"):
        answer = solve_qp(vi, solver, 1e-8, {"own": raising})
        assert answer.x is None
        assert answer.solver_status.startswith(reason)
        status, why, _ = verification.verify(vi, answer, 1e-8)
        assert (status, why.startswith(f"the solver returned nothing: {reason}")) == (Status.FAILED, True)
    error = MemoryError()
    with pytest.raises(MemoryError):
        solve_qp(vi, "own", 1e-8, {"own": raising})


@pytest.mark.parametrize("solver", ["daqp", "piqp", "proxqp", "osqp"])
def test_required_solvers_reach_the_accuracy_of_primal_and_dual_programs(solver: str) -> None:
    for accuracy, seed in product((1e-5, 1e-7), range(30)):
        vi = program(seed)
        if abs(vi.f @ exact(vi)[0]) < 0.05 * np.abs(vi.f).max():
            continue  # the energy nearly vanishes, so a relative gap asks for more than the accuracy
        answer = solve_qp(vi, solver, accuracy)
        status, reason, found = verification.verify(vi, answer, accuracy)
        assert status is Status.OK, (seed, reason)
        assert found.worst <= accuracy
        assert (answer.iterations is None) is not answer.alpha.any()  # without contact there is nothing to solve
        x, _ = exact(vi)
        assert np.allclose(answer.x, x, atol=200.0 * accuracy * (1.0 + np.abs(x).max()))
    for seed in range(30):
        vi = program(seed)
        primal, dual = (solve_qp(vi, solver, 1e-9, factor=L) for L in (None, np.linalg.cholesky(vi.A)))
        assert verification.verify(vi, primal, 1e-8)[0] is Status.OK
        assert verification.verify(vi, dual, 1e-8)[:2] == (Status.OK, ""), seed
        assert np.allclose(dual.x, exact(vi)[0], atol=1e-6 * max(1.0, np.abs(primal.x).max()))


@given(seeds, st.integers(1, 7), st.integers(0, 5))
def test_with_a_factor_of_a_the_dual_is_solved_and_gives_the_same_solution(seed: int, n: int, m: int) -> None:
    vi = program(seed, n, m, sizes=(0, 1))
    asked, factor = list[int](), np.linalg.cholesky(vi.A)
    watched = {"watched": lambda scaled, accuracy: asked.append(len(scaled.f)) or solve_qp(scaled, "piqp", accuracy)}
    primal, dual = (solve_qp(vi, "watched", 1e-10, watched, L) for L in (None, factor))
    # The dual has as many unknowns as there are constraints; where none acts there is nothing to solve.
    assert asked == ([n, m] if primal.alpha.any() else [])
    assert np.allclose(dual.x, primal.x, atol=1e-6 * max(1e-3, np.abs(primal.x).max()))
    assert np.all(dual.alpha >= 0.0)
    assert np.allclose(vi.B.T @ dual.alpha, vi.B.T @ primal.alpha, atol=1e-5 * max(1e-3, np.abs(vi.f).max()))
    if m <= n:  # only then are they unique
        assert np.allclose(dual.alpha, primal.alpha, atol=1e-4 * max(1e-3, np.abs(primal.alpha).max(initial=0.0)))
    assert verification.kkt_residuals(vi, dual.x, dual.alpha).dual <= 1e-12  # x is made from α, whatever the solver did


def test_negative_multipliers_missing_answers_and_nan_are_reported() -> None:
    vi = VariationalInequality(np.diag([2.0, 3.0]), np.array([2.0, 3.0]), np.eye(2), np.array([0.5, 2.0]))
    wrong = {"wrong": lambda *_: QPSolution(np.array([1.0, -0.1]), np.zeros(2), "solved", 4)}
    answer = solve_qp(vi, "wrong", 1e-7, wrong, np.diag(np.sqrt([2.0, 3.0])))  # of the dual program
    assert answer.alpha[0] > 0.0 == answer.alpha[1]
    assert np.allclose(answer.x, [1.0 - answer.alpha[0] / 2.0, 1.0])
    assert np.isclose(answer.negative, 0.1 * answer.alpha[0])
    assert (answer.solver_status, answer.iterations) == ("solved", 4)
    vi = VariationalInequality(np.eye(2), np.ones(2), np.eye(2), np.array([0.5, 0.5]))
    wrong = {"wrong": lambda *_: QPSolution(np.array([0.5, 0.5]), np.array([0.5, -0.1]), "solved")}
    answer = solve_qp(vi, "wrong", 1e-7, wrong)
    # The program of x − A⁻¹f without load, whose unit of force is a thousandth of what the constraints prescribe.
    assert np.allclose(answer.alpha, [0.5 * 0.5e-3, 0.0])
    assert np.isclose(answer.negative, 0.1 * 0.5e-3)
    assert "multipliers down to -5e-05" in verification.verify(vi, answer, 1e-7)[1]
    vi = pressed(3)
    answer = solve_qp(vi, "no", 1e-7, {"no": lambda *_: QPSolution(None, None, "gave up")}, np.linalg.cholesky(vi.A))
    assert (answer.x, answer.alpha, answer.solver_status) == (None, None, "gave up")
    assert verification.verify(vi, answer, 1e-7)[0] is Status.FAILED
    x, alpha = exact(vi)
    x[0] = np.nan
    assert verification.verify(vi, QPSolution(x, alpha, "solved"), 1e-7)[0] is Status.NONFINITE


def test_residuals_and_certificates_of_our_own_decide_the_status() -> None:
    """The program, min x² − load·x subject to x ≤ 1, has a solution: nothing here is infeasible."""
    infeasible, nothing = programs()[-1], QPSolution(None, None, "infeasible, I say")
    alpha = verification.infeasibility_certificate(infeasible)
    assert np.all(alpha >= 0.0)
    assert np.allclose(infeasible.B.T @ alpha, 0.0)
    assert infeasible.g @ alpha < 0.0
    assert verification.infeasibility_certificate(program(0)) is None
    assert verification.verify(infeasible, nothing, 1e-7)[0] is Status.INFEASIBLE
    status, reason, found = verification.verify(program(0), nothing, 1e-7)
    assert (status, found) == (Status.FAILED, None)
    assert "infeasible, I say" in reason
    for load, x, alpha, name in ((2.0, 0.5, 1.0, "gap"), (6.0, 3.0, 0.0, "primal")):
        vi = VariationalInequality(A=np.array([[2.0]]), f=np.array([load]), B=np.array([[1.0]]), g=np.ones(1))
        status, reason, found = verification.verify(vi, QPSolution(np.array([x]), np.array([alpha]), "solved"), 1e-6)
        assert status is Status.INACCURATE
        assert reason.startswith(f"{name} residual")
        assert "above 1e-06" in reason
        assert "solved" in reason
        assert [key for key in ("primal", "dual", "gap") if getattr(found, key) > 0.0] == [name]


def test_a_registered_solver_sees_scaled_data_and_its_answer_is_scaled_back() -> None:
    vi, seen = pressed(3), list[VariationalInequality]()
    brute = {"brute": lambda scaled, _: seen.append(scaled) or QPSolution(*exact(scaled), "found")}
    answer = solve_qp(vi, "brute", 1e-9, brute)
    assert np.allclose(np.linalg.norm(seen[0].B, axis=1), 1.0)
    assert not seen[0].f.any()  # in x − A⁻¹f the load is gone
    assert np.isclose(seen[0].g.min(), -1.0)
    assert verification.kkt_residuals(vi, answer.x, answer.alpha).worst < 1e-9


def answered(status: Any, iterations: Any) -> QPSolution:
    """What a solver answers that says this of itself."""
    vi = pressed(4)
    return solve_qp(vi, "odd", 1e-7, {"odd": lambda scaled, _: QPSolution(*exact(scaled), status, iterations)})


def test_a_status_is_one_short_printable_line_and_numbers_of_iterations_are_whole_or_left_out() -> None:
    """The solution is judged all the same."""
    for status in ("", "solved", "\n\r\x1b[31m\u2028\ud800\0", "é🙂", *map(chr, range(0x20, 0x10000, 0x1357))):
        for said in (status, 4000 * status):
            found = answered(said, 3).solver_status
            assert found.isprintable()
            assert len(found) <= LONGEST
    for number in (0, 7, np.int64(7), np.uint8(7), 2**63 - 1):
        found = answered("solved", number).iterations
        assert (type(found), found) == (int, number)
    for number in (2**80, 2**63, -1, -(2**70), np.uint64(2**63), 2.5, np.nan, np.inf, "7", [7], None):
        answer = answered("solved", number)
        assert answer.iterations is None
        assert answer.x is not None
    with pytest.raises(NumericalError, match="reports the status None; expected a text"):
        answered(None, 3)


def programs() -> list[VariationalInequality]:
    """Feasible ones of several sizes, one without constraints that act, and one that no point satisfies."""
    rng, found = np.random.default_rng(5), []
    for n, m in ((1, 1), (3, 7), (12, 12), (30, 9)):
        B = rng.standard_normal((m, n))
        found.append(VariationalInequality(spd(n, rng), rng.standard_normal(n), B, 0.1 * rng.random(m)))
    slack = replace(found[1], g=found[1].g + 100.0)
    empty = VariationalInequality(np.eye(2), np.ones(2), np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([-1.0, -1.0]))
    return [*found, slack, empty]


def test_a_least_distance_problem_is_solved_to_round_off_from_any_start_and_needs_a_definite_matrix() -> None:
    for vi in programs()[:-1]:
        cold, factor = solve_qp(vi, "daqp", 1e-9), np.linalg.cholesky(vi.A)
        for more in ({"factor": factor}, {"factor": np.asfortranarray(factor)}, {"start": cold}):
            answer = solve_qp(vi, "daqp", 1e-9, **more)
            assert np.allclose(answer.x, cold.x, rtol=1e-12)
            assert verification.kkt_residuals(vi, answer.x, answer.alpha).worst <= 1e-14
        if cold.alpha.any():
            assert answer.iterations < cold.iterations  # it starts from its own active set
    soft = VariationalInequality(np.diag([1.0, 1e-13]), np.ones(2), np.eye(2), np.full(2, 0.5))
    soft.A[0, 1] = soft.A[1, 0] = 1e-7  # of the second pivot nothing is left
    assert np.allclose(solve_qp(soft, "daqp", 1e-9).x, 0.5, atol=1e-3)
    assert solve_qp(programs()[-1], "daqp", 1e-9).solver_status == "not found: exit flag -1"


@pytest.mark.parametrize("solver", DIRECT)
def test_a_direct_call_is_the_call_of_qpsolvers(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def answers() -> list[QPSolution]:
        cold = [solve.solve_qp(vi, solver, 1e-9) for vi in programs()]
        return cold + [solve.solve_qp(vi, solver, 1e-9, factor=np.linalg.cholesky(vi.A)) for vi in programs()]

    def exactly(answer: QPSolution) -> tuple[object, ...]:
        bits = [None if values is None else values.tobytes() for values in (answer.x, answer.alpha)]
        return (*bits, answer.solver_status, answer.iterations, answer.negative)

    direct = [exactly(answer) for answer in answers()]
    # an answer depends on nothing that was solved before
    again = [exactly(solve.solve_qp(vi, solver, 1e-9)) for vi in reversed(programs())]
    assert again[::-1] == direct[: len(again)]
    monkeypatch.setattr(solve, "DIRECT", {})
    assert [exactly(answer) for answer in answers()] == direct


def test_multipliers_of_the_dual_program_are_bounds_and_constraints_are_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    told, piqp, vi = list[bool](), DIRECT["piqp"], programs()[1]
    watched = lambda program, bounds, **settings: told.append(bounds) or piqp(program, bounds, **settings)  # noqa: E731
    monkeypatch.setattr(solve, "DIRECT", {"piqp": watched})
    for factor in (None, np.linalg.cholesky(vi.A)):
        solve.solve_qp(vi, "piqp", 1e-9, factor=factor)
    assert told == [False, True]


@pytest.mark.parametrize("solver", DIRECT)
def test_bounds_give_what_rows_give(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for vi in programs()[:-1]:
        found = []
        for settings in (SETTINGS[solver], replace(SETTINGS[solver], bounds=False)):
            monkeypatch.setattr(solve, "SETTINGS", {solver: settings})
            found.append(solve.solve_qp(vi, solver, 1e-10, factor=np.linalg.cholesky(vi.A)))
        assert np.allclose(found[0].x, found[1].x, rtol=0.0, atol=1e-8)
        assert np.allclose(found[0].alpha, found[1].alpha, rtol=0.0, atol=1e-8)


def test_reports_are_found_and_a_tighter_accuracy_never_asks_for_less() -> None:
    order = [Status.OK, Status.INACCURATE, Status.FAILED, Status.CRASHED, Status.UNAVAILABLE]
    assert sorted(order[2:] + order[:2], key=lambda status: status.severity) == order
    for settings in SETTINGS.values():
        loose, tight = settings.at(1e-4), settings.at(1e-8)
        assert loose.keys() == tight.keys()
        for key, value in tight.items():
            if isinstance(value, float) and not isinstance(loose[key], bool):
                assert value <= loose[key]
    info = SimpleNamespace(status="fine", iter=np.array([7, 0]))
    solution = SimpleNamespace(extras={"info": info, "iterations": np.array([7, 0])}, found=True)
    assert SETTINGS["osqp"].report(solution) == ("fine", 7)
    assert SETTINGS["quadprog"].report(solution) == ("found", 7)
    assert SETTINGS["highs"].report(SimpleNamespace(extras={}, found=False)) == ("not found", None)


@pytest.mark.parametrize("solver", sorted(set(SETTINGS) & set(installed_solvers())))
def test_settings_are_words_the_installed_solver_understands(solver: str) -> None:
    answer = solve_qp(VariationalInequality(np.eye(2), np.ones(2), np.ones((1, 2)), np.ones(1)), solver, 1e-6)
    assert np.allclose(np.append(answer.x, answer.alpha), 0.5, atol=1e-4)
    assert answer.solver_status
