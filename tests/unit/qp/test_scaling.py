from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import exact, spd
from samples import SOLVERS_OF_TESTS

from vibench import MEMBERS, ParameterBox, QPSolution, Status, VariationalInequality, solve_qp
from vibench.qp import scaling, verification
from vibench.qp.scaling import near_rows, row_norms, units_of
from vibench.stages.query import ProgramQuery

seeds = st.integers(0, 10_000)
exponents = st.integers(-12, 12)
LOADS = {"load": 1.0, "no load": 0.0, "round-off": 1e-15}


def indentation(seed: int, length: int = 0, modulus: int = 0, load=0.0, closed=0.3) -> VariationalInequality:
    """A program driven by its constraints, the largest of which x = 0 violates by the fraction `closed` of max g."""
    rng = np.random.default_rng(seed)
    B = rng.standard_normal((4, 6)) * 10.0 ** rng.integers(-3, 3, (4, 1))
    gaps = np.array([-closed, 1.0, 0.5 * rng.random() - closed, rng.random()])
    A, f = 10.0**modulus * spd(6, rng), load * 10.0 ** (modulus + length) * rng.standard_normal(6)
    return VariationalInequality(A, f, B, 10.0**length * gaps * np.linalg.norm(B, axis=1))


@given(seeds, exponents, exponents, st.sampled_from(sorted(LOADS)))
def test_scaling_back_is_exact(seed: int, length: int, modulus: int, load: str) -> None:
    """Members, objective and constraints are those of the program; a solution there and back is what it was."""
    vi = indentation(seed, length, modulus, LOADS[load])
    units, rng = units_of(vi), np.random.default_rng(seed)
    scaled = units.scaled(vi)
    y, beta = rng.standard_normal(6), rng.random(4)
    x, alpha = units.back(y, beta)
    assert np.allclose(scaled.B @ y - scaled.g, (vi.B @ x - vi.g) / (units.rows * units.length), rtol=1e-12, atol=1e-12)
    forces = scaled.A @ y - scaled.f + scaled.B.T @ beta
    assert np.allclose(forces, (vi.A @ x - vi.f + vi.B.T @ alpha) / units.force, rtol=1e-12, atol=1e-9)
    assert np.allclose(np.concatenate(units.to(x, alpha)), np.concatenate([y, beta]), rtol=1e-14)
    assert np.allclose(np.linalg.norm(scaled.B, axis=1), 1.0)


@given(seeds, st.integers(1, 6), st.booleans())
def test_a_dual_program_is_scaled_as_any_other(seed: int, count: int, loaded: bool) -> None:
    rng = np.random.default_rng(seed)
    dual = VariationalInequality(spd(count, rng), rng.standard_normal(count), -np.eye(count), np.zeros(count))
    units = scaling.units_of_dual(dual, loaded)
    for name in MEMBERS:
        assert np.array_equal(getattr(units.scaled_dual(dual), name), getattr(units.scaled(dual), name)), name


@pytest.mark.parametrize("load", sorted(LOADS))
@given(seed=seeds, length=exponents, modulus=exponents)
def test_the_scaled_program_knows_no_units(load: str, seed: int, length: int, modulus: int) -> None:
    one, other = indentation(seed, load=LOADS[load]), indentation(seed, length, modulus, LOADS[load])
    here, there = units_of(one).scaled(one), units_of(other).scaled(other)
    for name in MEMBERS:
        assert np.allclose(getattr(there, name), getattr(here, name), rtol=1e-9, atol=1e-12), name
    assert np.abs(here.f).max() == pytest.approx(1.0) or load != "load"
    driven = scaling.drive(other, row_norms(other.B))
    assert driven.loaded == (load == "load")
    if not driven.loaded:
        assert driven.length == pytest.approx(0.3 * 10.0**length)  # the depth of what is violated, not the farthest gap
        assert driven.force == pytest.approx(0.3 * 10.0 ** (length + modulus) * scaling.stiffness(one.A))


@given(seeds, st.floats(1.0, 1e12))
def test_far_constraints_have_no_part_in_the_units(seed: int, far: float) -> None:
    vi = indentation(seed)
    row = np.append(vi.g, far * np.linalg.norm(vi.B[0]))
    beside = VariationalInequality(vi.A, vi.f, np.vstack([vi.B, vi.B[:1]]), row)
    assert (units_of(beside).length, units_of(beside).force) == (units_of(vi).length, units_of(vi).force)
    assert near_rows(beside)[-1] == (far <= 0.3e4)
    # nor do they turn a load into none
    loaded = VariationalInequality(np.eye(1), np.ones(1), np.ones((1, 1)), np.full(1, 1e15))
    assert scaling.drive(loaded, np.ones(1)).loaded
    assert verification.kkt_residuals(loaded, np.full(1, 0.5), np.zeros(1)).dual == 1.0


def test_sparse_and_zero_data_have_units_too() -> None:
    vi = indentation(5, 2, 3)
    sparse = VariationalInequality(sp.csc_array(vi.A), vi.f, sp.csr_array(vi.B), vi.g)
    one, other = units_of(vi), units_of(sparse)
    assert (one.length, one.force) == (pytest.approx(other.length), pytest.approx(other.force))
    assert np.allclose(other.scaled(sparse).B.toarray(), one.scaled(vi).B)
    assert np.allclose(other.scaled(sparse).A.toarray(), one.scaled(vi).A)
    nothing = VariationalInequality(*map(np.zeros, ((2, 2), 2, (1, 2), 1)))
    unconstrained = VariationalInequality(np.eye(2), np.zeros(2), np.zeros((0, 2)), np.zeros(0))
    for vi in (nothing, unconstrained):
        units = units_of(vi)
        assert (units.length, units.force > 0.0) == (1.0, True)
        assert np.all(np.isfinite(units.scaled(vi).A))
    assert verification.kkt_residuals(unconstrained, np.zeros(2), np.zeros(0)).worst == 0.0
    dual = VariationalInequality(np.eye(1), np.zeros(1), -np.eye(1), np.zeros(1))
    assert all(scaling.units_of_dual(dual, loaded).length > 0.0 for loaded in (True, False))


def solved(vi: VariationalInequality, solver: str, form: str) -> QPSolution:
    """The solution of the primal or the dual program, which is ok."""
    answer = solve_qp(vi, solver, 1e-8, factor=np.linalg.cholesky(vi.A) if form == "dual" else None)
    status, reason, _ = verification.verify(vi, answer, 1e-8)
    assert status is Status.OK, reason
    return answer


@pytest.mark.parametrize("solver", SOLVERS_OF_TESTS)
@pytest.mark.parametrize("form", ["primal", "dual"])
def test_a_program_without_load_is_solved_to_the_accuracy_asked_for(solver: str, form: str) -> None:
    """An indentation by micrometres into steel as well as by kilometres into foam."""
    for (length, modulus), seed in product([(0, 0), (-2, 0), (-6, 11), (4, -6)], range(10)):
        vi = indentation(seed, length, modulus)
        answer = solved(vi, solver, form)
        x, alpha = exact(indentation(seed))  # where brute force knows what is zero
        assert np.allclose(answer.x, 10.0**length * x, rtol=0.0, atol=1e-5 * 10.0**length)
        force = 10.0 ** (length + modulus)
        assert np.allclose(vi.B.T @ answer.alpha, force * (vi.B.T @ alpha), rtol=0.0, atol=1e-4 * force)


@pytest.mark.parametrize("solver", ["daqp", "piqp", "proxqp", "osqp"])
@pytest.mark.parametrize("form", ["primal", "dual"])
def test_without_load_and_contact_or_nearly_so_a_solution_is_ok(solver: str, form: str) -> None:
    """The x and α are zero, or small beside g: residuals relative to them would be those of round-off."""
    for closed, seed in product([0.0, 1e-9, 1e-6, 1e-3], range(10)):
        vi = indentation(seed, closed=closed)
        solved(replace(vi, g=np.abs(vi.g)) if closed == 0.0 else vi, solver, form)


def test_a_constraint_that_was_left_out_is_brought_back_where_it_matters() -> None:
    """A load that a soft direction turns into a way of 5e4 lengths of the first step."""
    vi = VariationalInequality(np.diag([1.0, 1e-6]), np.array([1.0, 5e-2]), np.array([[0.0, 1.0]]), np.array([2e4]))
    assert not near_rows(vi).any()
    for factor in (None, np.sqrt(vi.A)):
        answer = solve_qp(vi, "piqp", 1e-10, factor=factor)
        assert np.allclose(answer.x, [1.0, 2e4], rtol=1e-6)
        assert np.allclose(answer.alpha, 5e-2 - 2e-2, rtol=1e-6)
    vi = indentation(0)  # half an answer is none
    for x, alpha in ((None, np.zeros(4)), (np.zeros(6), None)):
        answer = solve_qp(vi, "half", 1e-8, {"half": lambda *_, x=x, alpha=alpha: QPSolution(x, alpha, "solved")})
        assert (answer.x, answer.alpha) == (None, None)
        assert verification.verify(vi, answer, 1e-8)[0] is Status.FAILED


@pytest.mark.parametrize("solver", ["daqp", "proxqp", "osqp"])
@pytest.mark.parametrize("form", ["primal", "dual"])
def test_a_start_without_load_is_in_the_same_units(solver: str, form: str) -> None:
    vi = indentation(2, -3, 6)
    cold = solved(vi, solver, form)
    warm = solve_qp(vi, solver, 1e-8, factor=np.linalg.cholesky(vi.A) if form == "dual" else None, start=cold)
    assert verification.verify(vi, warm, 1e-8)[0] is Status.OK
    assert warm.iterations <= cold.iterations


@given(st.integers(1, 6), st.integers(0, 5), st.sampled_from([1e-4, 1e-7, 1e-10]), st.integers(0, 2**32))
def test_in_other_units_it_is_the_same_program(n: int, m: int, accuracy: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, B, g = rng.standard_normal((2 * n, n)), rng.standard_normal((m, n)), rng.random(m)
    A = root.T @ root
    program = VariationalInequality(A, rng.standard_normal(n), np.vstack([B, -B]), np.hstack([g, -g]))
    d, again, other = (scaling.random_units(n, accuracy, seed, k) for k in (1, 1, 2))
    assert np.array_equal(d, again)
    assert not np.array_equal(d, other)
    assert 0.0 < np.abs(d - 1.0).max() <= 1e3 * accuracy
    scaled = scaling.in_units(program, d)
    assert np.array_equal(scaled.A, scaled.A.T)
    assert np.array_equal(scaled.B[:m], -scaled.B[m:])
    x = rng.standard_normal(n)
    assert np.allclose(scaled.A @ x, d * (A @ (d * x)), rtol=1e-12, atol=1e-12)
    assert np.allclose(scaled.B @ x, program.B @ (d * x), rtol=1e-12, atol=1e-12)
    assert scaled.f @ x == pytest.approx(program.f @ (d * x), abs=1e-12)
    assert np.array_equal(scaled.g, program.g)
    repeated = ProgramQuery(program, np.linalg.cholesky(A), "piqp", accuracy).repeated(seed)
    assert np.array_equal(repeated.factor, np.tril(repeated.factor))
    assert np.allclose(repeated.factor @ repeated.factor.T, repeated.program.A, rtol=1e-12, atol=1e-12)


@given(st.integers(0, 2**32), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_parameter_nearby_is_in_the_box(seed: int, one: float, other: float) -> None:
    box = ParameterBox(("a", "b"), np.array([-1.0, 1e6]), np.array([0.0, 3e6]), ("1", "1"))
    mu = box.lower + np.array([one, other]) * (box.upper - box.lower)
    found = scaling.nearby(box, mu, seed)
    assert np.all(box.lower <= found)
    assert np.all(found <= box.upper)
    assert not np.array_equal(found, mu)
    assert np.allclose(found, mu, rtol=1e-9, atol=1e-9)
