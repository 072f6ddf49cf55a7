import itertools
import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial.legendre import leggauss

from vibench import Array, HighFidelitySolution, HighFidelitySolver, InnerProduct, Stop, pod, solve_high_fidelity
from vibench_problems.american_put import DEGREE, Put, PutSolution, load_coefficients

CARR = np.array([0.03, 0.15, 1.0])
PERPETUAL = CARR[:2]


def price(problem: Put, mu: Array, found: HighFidelitySolution) -> float:
    return float(problem.outputs[0].values(mu[None], found.u[:, None], found.lam[:, None])[0])


@given(st.floats(0.01, 0.1), st.floats(0.1, 0.5), st.one_of(st.just(math.inf), st.floats(0.05, 10.0)))
def test_the_closed_form_solves_the_inequality(rate: float, volatility: float, maturity: float) -> None:
    exact, step = PutSolution(rate, volatility, maturity), 1e-4
    k, tau, edge = exact.k, 2.0 / (volatility**2 * maturity), math.log(exact.boundary)
    assert exact.boundary < 1.0
    held, above = np.linspace(edge, -2 * step, 60)[2:-1], np.linspace(2 * step, 1.0, 60)
    for x, load in ((held, -k), (above, 0.0)):  # −u″ − (k − 1)u′ + (k + τ)u
        less, u, more = (exact.excess(x + s) for s in (-step, 0.0, step))
        terms = -(more - 2.0 * u + less) / step**2, -(k - 1.0) * (more - less) / (2.0 * step), (k + tau) * u
        size = max(float(np.abs(term).max()) for term in terms) + k
        assert np.abs(sum(terms) - load).max() < 1e-4 * size
    assert np.all(exact.excess(held) >= 0.0)
    near = exact.excess(np.array([edge - step, edge, edge + step, edge + 2.0 * step]))  # u = u′ = 0
    assert np.all(np.abs(near) < 10.0 * (k + tau + 1.0) * step**2)
    slopes = np.diff(exact.excess(np.array([-step, 0.0, step]))) / step
    assert slopes[1] - slopes[0] == pytest.approx(-1.0, abs=20.0 * (exact.c + 1.0 + k) * step)


def test_known_prices() -> None:
    """Carr's first approximation; Merton's price of the perpetual put, which long maturities approach."""
    assert 100.0 * float(PutSolution(*CARR).price(np.array(1.0))) == pytest.approx(4.110958, abs=5e-7)
    k, spot = 2.0 * 0.03 / 0.15**2, np.array([0.5, 0.8, 1.0, 1.7])
    perpetual, edge = PutSolution(*PERPETUAL), k / (1.0 + k)
    assert perpetual.boundary == pytest.approx(edge)
    assert np.allclose(perpetual.price(spot), np.where(spot < edge, 1.0 - spot, (1.0 - edge) * (spot / edge) ** -k))
    assert np.allclose(PutSolution(*PERPETUAL, 1e9).price(spot), perpetual.price(spot), atol=1e-6)


def test_prices_and_exercise_boundaries_on_the_meshes_of_studies() -> None:
    """In units of a strike of 100; nodes quantise the boundary."""
    problem = Put("paper")
    found = HighFidelitySolver(problem).solve(CARR)
    assert problem.V.dim == 2400
    assert 100.0 * price(problem, CARR, found) == pytest.approx(4.110958, abs=6e-5)
    problem = Put("fine", perpetual=True)
    found, exact = HighFidelitySolver(problem).solve(PERPETUAL), problem.exact(PERPETUAL)
    assert problem.V.dim == 4000
    assert 100.0 * abs(price(problem, PERPETUAL, found) - float(exact.price(np.array(1.0)))) < 3e-6
    assert abs(problem.boundary(found.lam) - exact.boundary) < 5e-4


@pytest.mark.parametrize("perpetual", [False, True])
def test_the_excess_converges_with_order_two(perpetual: bool) -> None:
    """The constant depends on where the exercise boundary is between two nodes."""
    mu = PERPETUAL if perpetual else CARR
    for n in (100, 200, 400, 1600):
        problem = Put(n, perpetual)
        exact, found = problem.exact(mu), HighFidelitySolver(problem).solve(mu)
        error = float(np.abs(found.u - np.exp(exact.a * problem.x) * exact.excess(problem.x)).max())
        assert 0.05 < error * n**2 < 1.5
        assert abs(math.log(problem.boundary(found.lam) / exact.boundary)) < 4.0 / n


@pytest.mark.parametrize("perpetual", [False, True])
def test_the_stiffness_is_symmetric_positive_definite_in_the_whole_box(perpetual: bool) -> None:
    problem = Put("coarse", perpetual)
    box = problem.parameters
    for mu in itertools.product(*zip(box.lower, box.upper, strict=True)):
        InnerProduct(problem.assemble(np.array(mu)).A, "A")
        found = HighFidelitySolver(problem).solve(np.array(mu))
        assert 0 < np.count_nonzero(found.lam) < problem.W.dim
        assert abs(math.log(problem.boundary(found.lam) / problem.exact(np.array(mu)).boundary)) < 0.02


@pytest.mark.parametrize("mu", [[0.02, 0.35, 1.0], [0.031, 0.2, 0.5], [0.06, 0.15, 2.0]])
def test_the_expansion_of_the_load_is_exact_to_round_off(mu: list[float]) -> None:
    """∫ exp(a x) φ_i over x < 0, by ten Gauss points on every element."""
    problem = Put(60)
    exact, size, at = problem.exact(np.array(mu)), problem.x[1] - problem.x[0], leggauss(10)
    local = 0.5 * (at[0] + 1.0)
    starts = problem.x[problem.x < -0.5 * size]
    rising = size * np.exp(exact.a * (starts[:, None] + size * (local - 1.0))) @ (0.5 * at[1] * local)
    falling = size * np.exp(exact.a * (starts[:, None] + size * local)) @ (0.5 * at[1] * (1.0 - local))
    loads = np.zeros(problem.V.dim)
    loads[: len(starts)] = rising + falling
    loads[len(starts)] = size * np.exp(exact.a * size * (local - 1.0)) @ (0.5 * at[1] * local)
    at_strike = (np.abs(problem.x) < 0.5 * size).astype(float)
    assert np.allclose(problem.assemble(np.array(mu)).f, at_strike - exact.k * loads, rtol=0.0, atol=2e-15)
    assert len(load_coefficients(np.array(mu))) == DEGREE + 2


@pytest.mark.long
def test_iterations_do_not_grow_with_the_mesh_and_a_cold_start_ends_without_a_fallback() -> None:
    counts = [HighFidelitySolver(Put(n, perpetual=True)).solve(PERPETUAL).iterations for n in (400, 1600, 6400)]
    assert max(counts) <= 8
    problem = Put(1600, perpetual=True)
    cold = solve_high_fidelity(problem.assemble(PERPETUAL))
    assert cold.iterations > 100  # the boundary moves node by node
    assert cold.fallback == ""
    warm = HighFidelitySolver(problem).solve(PERPETUAL)
    assert np.allclose(cold.u, warm.u, rtol=0.0, atol=1e-13)
    assert np.array_equal(cold.lam > 0.0, warm.lam > 0.0)
    pickle.loads(pickle.dumps(problem))  # with the solvers of coarser meshes, which are not copied


@pytest.mark.long
def test_the_dual_is_hard() -> None:
    """Multipliers jump at the exercise boundary, which moves: no space of 60 dimensions has them to 1 %.

    Neither has a cone of 60 generators, which is in such a space; few modes suffice for u.
    """
    problem = Put("medium")
    solver = HighFidelitySolver(problem)
    found = [solver.solve(mu) for mu in problem.training_set()]
    lam, u = (np.column_stack([getattr(one, name) for one in found]) for name in ("lam", "u"))
    assert pod(lam, problem.W, Stop(tolerance=1e-2)).basis.shape[1] > 60
    assert pod(u, problem.V, Stop(tolerance=1e-2)).basis.shape[1] < 15


def test_a_boundary_below_the_mesh_is_refused_and_pictures_show_prices_over_shares() -> None:
    problem = Put("coarse")
    refused = problem.refuse(CARR, np.zeros(problem.V.dim), np.zeros(problem.W.dim))
    assert refused.startswith("the option is not exercised")
    assert problem.boundary(np.zeros(problem.W.dim)) == 0.0
    found = HighFidelitySolver(problem).solve(CARR)
    picture = problem.picture(CARR, found.u, found.lam)
    assert np.allclose(picture.values, problem.exact(CARR).price(picture.points[0]), atol=2e-4)
