"""Generators that may be used with either sign, from the cone to the rows of a run."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numerics import Varying, space

from vibench import Enrichment, Kind, ReducedSet, Status, VariationalInequality, solve_qp
from vibench.highfidelity import active_set
from vibench.model.galerkin import ReducedModel
from vibench.qp import kkt_residuals, verify
from vibench.reduction.cones import orthogonality, project_on_cone
from vibench.stability.infsup import cone_basis, inf_sup

seeds = st.integers(0, 10_000)


def model(free: list[bool]) -> tuple[ReducedModel, ReducedSet]:
    problem = Varying(count=4)
    solved = [active_set.solve_high_fidelity(problem.assemble(mu)) for mu in problem.training_set()]
    chi = np.column_stack([s.lam for s in solved])
    cone = ReducedSet(chi / problem.W.norm(chi), np.ones(5), np.array(free))
    basis = problem.V.orthonormalise(np.column_stack([s.u for s in solved]))
    span = cone_basis(cone.generators, problem.W, cone.free).span
    return ReducedModel(problem, basis, Enrichment(Kind.PER_PARAMETER, eta=span), cone.rays, span), cone


def test_free_generators_stand_among_the_rays_with_both_signs() -> None:
    cone = model([False, True, False, True])[1]
    assert np.array_equal(cone.rays[:, :4], cone.generators)
    assert np.array_equal(cone.rays[:, 4:], -cone.generators[:, [1, 3]])
    assert cone.size == 4
    assert [one.kind for one in (cone, model([True] * 4)[1], replace(cone, gauges=np.ones(4)))] == [
        "cone", "section", "hull",
    ]  # fmt: skip


@pytest.mark.parametrize("solver", ["piqp", "proxqp", "osqp"])
@pytest.mark.parametrize("free", [[True] * 4, [False, True, True, False]], ids=["all", "some"])
def test_their_constraints_are_equalities_and_their_multipliers_have_any_sign(solver: str, free: list[bool]) -> None:
    """The optimality conditions of the program with equalities, which determine its solution."""
    reduced, cone = model(free)
    pulling = False
    for mu in (0.1, 0.45, 0.8):
        vi = reduced.problem.assemble(np.array([mu]))
        query = reduced.reduce(vi)
        answer = solve_qp(query.program, solver, 1e-9)
        # Beside a loaded tie the contact is small, and OSQP leaves a gap of 6e-9 of it.
        assert verify(query.program, answer, 1e-8)[0] is Status.OK
        Z, lam = query.basis, reduced.generators @ answer.alpha
        gap = cone.generators.T @ (vi.B @ (Z @ answer.x) - vi.g)
        own = np.linalg.lstsq(cone.generators, lam, rcond=None)[0]
        scale = float(np.abs(cone.generators.T @ vi.g).max())
        assert np.abs(gap[cone.free]).max() <= 1e-7 * scale
        assert gap[~cone.free].max(initial=0.0) <= 1e-7 * scale
        assert own[~cone.free].min(initial=0.0) >= -1e-6 * np.abs(own).max()
        assert np.abs(Z.T @ (vi.A @ (Z @ answer.x) + vi.B.T @ lam - vi.f)).max() <= 1e-6 * np.abs(Z.T @ vi.f).max()
        assert np.abs(own[~cone.free] * gap[~cone.free]).max(initial=0.0) <= 1e-6 * scale * np.abs(own).max()
        pulling |= bool(np.any(own[cone.free] < -1e-3 * np.abs(own).max()))
    assert pulling or not all(free)


def test_with_all_of_them_free_the_program_is_a_linear_system() -> None:
    query = model([True] * 4)[0].assemble(np.array([0.3]))
    A, f, B, g = (getattr(query.program, name) for name in ("A", "f", "B", "g"))
    system = np.block([[A, B[:4].T], [B[:4], np.zeros((4, 4))]])
    exact = np.linalg.solve(system, np.concatenate([f, g[:4]]))
    answer = solve_qp(query.program, "piqp", 1e-10)
    assert np.allclose(answer.x, exact[: len(f)], atol=1e-8 * np.abs(exact[: len(f)]).max())
    assert np.allclose(answer.alpha[:4] - answer.alpha[4:], exact[len(f) :], atol=1e-6 * np.abs(exact[len(f) :]).max())
    rays = np.concatenate([np.maximum(exact[len(f) :], 0.0), np.maximum(-exact[len(f) :], 0.0)])
    assert kkt_residuals(VariationalInequality(A, f, B, g), exact[: len(f)], rays).worst < 1e-10


@given(seeds)
@example(535)  # the two are equal but for round-off
@settings(max_examples=10)
def test_the_constant_of_a_cone_with_free_generators_is_between_span_and_ordinary_cone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    W, chi = space(6, seed), rng.random((6, 4))
    chi /= W.norm(chi)
    images, free = rng.standard_normal((7, 6)) @ chi, np.array([True, False, True, False])
    ordinary, mixed, unsigned = (cone_basis(chi, W, mask) for mask in (None, free, np.ones(4, dtype=bool)))
    on_span = images @ np.linalg.lstsq(chi, mixed.span, rcond=None)[0]
    plain, some, every = (inf_sup(on_span, images, cone) for cone in (ordinary, mixed, unsigned))
    assert every.cone_lower == every.cone_upper == every.span == plain.span
    assert every.sharp == "span/span"
    assert some.sharp.startswith("span/")
    alpha = rng.standard_normal((4, 2000))
    alpha[~free] = np.abs(alpha[~free])
    sampled = np.linalg.norm(images @ alpha, axis=0) / W.norm(chi @ alpha)
    assert some.cone_lower <= sampled.min() * (1.0 + 1e-9)
    assert some.cone_lower <= some.cone_upper == plain.cone_upper


def test_orthogonality_is_the_distance_from_a_cone_that_has_free_generators() -> None:
    W, chi = space(5), np.random.default_rng(1).standard_normal((5, 3))
    chi /= W.norm(chi)
    values = orthogonality(chi, W, np.array([True, False, False]))
    assert np.isclose(values[1], np.sqrt(1.0 - W.gram(chi, chi)[0, 1] ** 2))
    two = np.column_stack([chi[:, :2], -chi[:, 0]])
    assert np.isclose(values[2], project_on_cone(two, chi[:, 2], W).distance)
    assert values[1] < orthogonality(-chi * np.sign(W.gram(chi, chi)[0, 1]), W)[1] + 1e-12
