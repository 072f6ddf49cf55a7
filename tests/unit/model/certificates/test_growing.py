"""The model that adaptive trainings grow with: its bounds hold, and are nothing where a solution is known."""

from collections.abc import Callable

import numpy as np
import pytest
from buffered import buffered
from cachetools import LRUCache
from numerics import Tied, Varying

from vibench import Array, Problem, VariationalInequality, create, project_on_cone
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces.validation import ReferenceAssembly
from vibench.linalg.cholesky import SparseCholesky
from vibench.model.certificates.greedy import GreedyTrainer, IncrementalModel
from vibench.reduction import subtract_cone_component
from vibench_problems.obstacle import Obstacle

PROBLEMS = {"B and A vary": Varying, "A is constant": lambda: create("problem", "hertz", {"resolution": 300})}


def grown(problem: Problem, mus: Array) -> tuple[HighFidelitySolver, IncrementalModel]:
    solver = HighFidelitySolver(problem)
    model = IncrementalModel(problem, solver)
    for mu in mus:
        vi = problem.assemble(mu).copy()
        model.add(vi, solver.solve_assembled(mu, vi))
    return solver, model


@pytest.mark.parametrize("make", [*PROBLEMS.values(), Tied], ids=[*PROBLEMS, "equalities"])
def test_bounds_hold_everywhere_and_vanish_at_the_solutions(make: Callable[[], Problem]) -> None:
    problem = make()
    solved = problem.parameters.sample(4, 1)
    solver, model = grown(problem, np.vstack([solved, solved[:1]]))  # one of them twice
    assert max(model.bound(mu) for mu in solved) < 1e-5
    unseen = problem.parameters.sample(10, 2)
    for mu in unseen:
        vi, found = problem.assemble(mu).copy(), solver.solve(mu)
        reduced, bound = model.solution(vi), model.bound(mu)
        u, lam = reduced
        inverse = SparseCholesky(vi.A, "A")
        e, r = found.u - u, vi.B.T @ (found.lam - lam)
        pressed = vi.B.T @ lam
        assert np.sqrt(e @ (vi.A @ e)) <= bound * np.sqrt(u @ (vi.A @ u)) * (1.0 + 1e-6)
        assert np.sqrt(r @ inverse.solve(r)) <= bound * np.sqrt(pressed @ inverse.solve(pressed)) * (1.0 + 1e-6)
    assert max(model.bound(mu) for mu in unseen) > 1e-4  # there is something to bound


@pytest.mark.parametrize("case", PROBLEMS)
def test_the_cone_has_every_multiplier_and_grows_by_what_it_lacks(case: str) -> None:
    problem: Problem = PROBLEMS[case]()
    mus, W = problem.parameters.sample(5, 1), problem.W
    solver, model = grown(problem, mus)
    found = [solver.solve(mu) for mu in mus]
    chi, snapshots = model.generators, np.column_stack([one.lam for one in found])
    assert chi.min() >= 0.0
    np.testing.assert_allclose(W.norm(chi), 1.0)
    for k, lam in enumerate(snapshots.T):
        assert project_on_cone(chi, lam, W).distance <= 1e-7 * W.norm(lam)
        rest, _ = subtract_cone_component(lam, chi[:, :k], W)
        np.testing.assert_allclose(chi[:, k], rest / W.norm(rest), atol=1e-6 * chi.max())
    size = chi.shape[1]
    model.add(problem.assemble(mus[-1]).copy(), found[-1])  # it has that one
    assert model.generators.shape[1] == size


@pytest.mark.parametrize(("name", "resolution", "share"), [("hertz", 300, 1e-4), ("obstacle", 200, 0.2)])
def test_estimates_are_about_what_bounds_are(name: str, resolution: int, share: float) -> None:
    """At the cost of the contact; where A is constant they are the same."""
    problem = create("problem", name, {"resolution": resolution})
    _, model = grown(problem, problem.parameters.sample(4, 1))
    for mu in problem.parameters.sample(10, 2):
        assert model.estimate(mu) == pytest.approx(model.bound(mu), rel=share)


def test_estimates_are_bounds_where_no_stiffness_and_no_load_vary_unless_round_off_decides() -> None:
    """The cost of the mesh is paid for residuals of which the sum of squares says nothing."""
    problem = create("problem", "hertz", {"resolution": 300})
    solved = problem.parameters.sample(4, 1)
    _, model = grown(problem, solved)
    unseen = problem.parameters.sample(20, 2)
    cheap, is_bound = [model.bound(mu) for mu in unseen], [model._estimates.estimate(mu).is_bound for mu in unseen]
    assert np.mean(is_bound) > 0.8
    assert not any(model._estimates.estimate(mu).is_bound for mu in solved)
    assert all(model.bound(mu) < 1e-5 for mu in solved)
    model._estimates.may_be_bounds, model._last = False, None
    np.testing.assert_allclose(cheap, [model.bound(mu) for mu in unseen], rtol=1e-6)


@pytest.mark.parametrize("rewritten", [False, True])
def test_a_solution_starts_from_what_a_bound_has_left_only_at_its_parameter(rewritten: bool) -> None:
    obstacle = Obstacle(160)
    problem = buffered(Obstacle)(160) if rewritten else obstacle
    trainer = GreedyTrainer(problem, ReferenceAssembly(problem))
    first, *others, last = problem.parameters.sample(8, 5)
    trainer.solve(first)
    for mu in others:
        estimate, bound = trainer.estimate(mu), trainer.bound(mu)
        assert estimate == pytest.approx(bound, rel=0.3)
        trainer.solve(mu)
    fresh = IncrementalModel(problem, HighFidelitySolver(problem))
    for one in trainer.solved:
        fresh.add(obstacle.assemble(one.mu), one.solution)
    bound = trainer.bound(last)
    assert bound == pytest.approx(fresh.bound(last), rel=1e-6)  # the one with what an estimate left, one without
    trainer.estimate(last)
    assert trainer.bound(last) == pytest.approx(bound, rel=1e-6)
    trainer.estimate(others[0])  # another assembly
    trainer.solve(last)
    solver = HighFidelitySolver(obstacle)
    for one in trainer.solved:
        exact = solver.solve(one.mu)
        np.testing.assert_allclose(one.solution.u, exact.u, atol=1e-9 * np.abs(exact.u).max())
        np.testing.assert_allclose(one.solution.lam, exact.lam, atol=1e-8 * np.abs(exact.lam).max())


@pytest.mark.parametrize("kept", [1000, 2])
def test_what_is_kept_of_a_candidate_changes_no_estimate(kept: int) -> None:
    """Estimates of a model that grows under its candidates are those of one that sees them for the first time."""
    problem = create("problem", "obstacle", {"resolution": 160})
    solver, candidates = HighFidelitySolver(problem), problem.parameters.sample(6, 4)
    growing, solved = IncrementalModel(problem, solver), list[tuple[VariationalInequality, HighFidelitySolution]]()
    for mu in problem.parameters.sample(5, 1):
        vi = problem.assemble(mu).copy()
        solved.append((vi, solver.solve(mu)))
        growing.add(*solved[-1])
        if len(solved) == 1:
            growing._estimates._projected = LRUCache(kept)
        fresh = IncrementalModel(problem, solver)
        for one in solved:
            fresh.add(*one)
        again = [growing.estimate(mu) for mu in candidates]
        np.testing.assert_allclose(again, [fresh.estimate(mu) for mu in candidates], rtol=1e-8)
    assert len(growing._estimates._projected) == min(kept, len(candidates))


def test_what_chooses_follows_large_errors_of_the_multiplier() -> None:
    """In the norm of A⁻¹ they are eight times smaller here."""
    problem = Varying()
    (solver, model), W = grown(problem, problem.parameters.sample(5, 1)), problem.W
    mus = problem.parameters.sample(10, 2)
    found = [(model.solution(problem.assemble(mu).copy()), solver.solve(mu)) for mu in mus]
    errors = np.array([W.norm(exact.lam - one[1]) / W.norm(one[1]) for one, exact in found if one is not None])
    assert len(errors) == len(mus)
    large = errors > 0.5 * errors.max()
    assert all(model.bound(mu) > 0.8 * error for mu, error in zip(mus[large], errors[large], strict=True))


def test_a_model_without_contact_has_bounds_of_u_alone() -> None:
    """A string that touches nothing in its solutions so far: λ_N = 0, and the bound is infinite or that of u."""
    problem = Varying()
    solver, mu = HighFidelitySolver(problem), np.array([0.5])
    vi = problem.assemble(mu)
    free = vi.__class__(vi.A, 1e-6 * vi.f, vi.B, vi.g)  # a load too small for contact
    model = IncrementalModel(problem, solver)
    model.add(free, solver.solve_assembled(mu, free))
    reduced = model.solution(vi)
    assert reduced[1].max(initial=0.0) == 0.0
    assert 0.0 < model.bound(mu) < np.inf


def test_a_trainer_counts_bounds_and_seconds() -> None:
    problem = Varying()
    trainer = GreedyTrainer(problem, ReferenceAssembly(problem))
    given = np.array([0.5])
    trainer.solve(given)
    given[0] = 7.0  # what is kept is a copy
    assert trainer.estimate(np.array([0.9])) is None  # without contact unknowns there are none
    first = trainer.bound(np.array([0.9]))
    trainer.solve(np.array([0.9]), first)
    assert [(one.mu.tolist(), one.evaluated) for one in trainer.solved] == [([0.5], 0), ([0.9], 1)]
    assert np.isnan(trainer.solved[0].bound)
    assert trainer.solved[1].bound == first
    assert trainer.bound(np.array([0.9])) < 1e-5 < first
    assert trainer.selecting.cpu > 0.0
    exact = HighFidelitySolver(problem).solve(np.array([0.9]))
    np.testing.assert_allclose(trainer.solved[1].solution.u, exact.u, rtol=1e-10)
