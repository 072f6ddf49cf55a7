from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerics import fitted_rate
from skfem import Basis, BilinearForm, ElementTriP1
from skfem.helpers import dot, grad

from vibench import HighFidelitySolver, Reduction, Stop, solve_high_fidelity
from vibench_problems.bearing import Bearing, SommerfeldSolution
from vibench_strategies.mcpg import ModifiedCPG
from vibench_strategies.offline_pga import OfflinePGA


@given(st.floats(0.02, 0.95))
def test_the_closed_form_solves_reynolds_equation_up_to_the_rupture(eccentricity: float) -> None:
    exact = SommerfeldSolution(eccentricity)
    last, step = exact.rupture, 1e-5
    assert np.pi < last < 2.0 * np.pi
    theta = np.linspace(0.05, last - 1e-3, 200)
    p, (before, after) = exact.pressure(theta), (exact.pressure(theta + s) for s in (-step, step))
    flux = (1.0 + eccentricity * np.cos(theta)) ** 3 * (after - before) / (2.0 * step)  # h³p′ = h − h*
    expected = eccentricity * (np.cos(theta) - np.cos(last))
    assert np.all(p >= -1e-12 * p.max())
    assert np.allclose(flux, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max() + 1e-8)
    assert float(exact.pressure(np.array(0.0))) == 0.0
    near = last - 1e-6
    assert float(exact.pressure(np.array(near))) <= 1e-9 * p.max()  # p = p′ = 0
    assert np.all(exact.pressure(np.linspace(last + 1e-6, 2.0 * np.pi, 50)) == 0.0)


def test_sealed_ends_give_the_closed_form_with_order_two_at_any_aspect_ratio() -> None:
    """Also the place of the rupture, to the length of a cell; the pressure is constant along the axis."""
    spacing, errors = [], []
    for rows in (8, 16, 32):
        problem = Bearing(5 * rows**2, ends="sealed")
        assert problem.V.dim == (5 * rows - 1) * (rows + 1)
        (theta, zeta), solver, worst = problem.mesh.p[:, problem.free], HighFidelitySolver(problem), 0.0
        order = np.lexsort((zeta, theta))
        for mu in (np.array([0.2, 0.5]), np.array([0.6, 1.5])):
            exact, found = problem.exact(mu), solver.solve(mu)
            p = exact.pressure(theta)
            worst = max(worst, float(np.abs(found.u - p).max() / p.max()))
            assert abs(theta[found.lam > 0.0].min() - exact.rupture) < 1.5 * 2.0 * np.pi / (5 * rows)
            along = found.u[order].reshape(5 * rows - 1, rows + 1)
            assert np.ptp(along, axis=1).max() < 2.0 * p.max() / rows**2
        spacing.append(1.0 / rows)
        errors.append(worst)
    assert 1.7 <= fitted_rate(spacing, errors) <= 2.4
    assert errors[-1] < 1e-3


def test_a_short_bearing_has_the_pressure_of_ocvirk() -> None:
    """p → (L/D)² (1 − ζ²) ε sin θ / (2h³) where that is positive, as L/D → 0."""
    problem, e, ratio = Bearing("paper"), 0.5, 0.02
    found = solve_high_fidelity(problem.assemble(np.array([e, ratio])))
    theta, zeta = problem.mesh.p[:, problem.free]
    short = ratio**2 * (1.0 - zeta**2) * e * np.maximum(np.sin(theta), 0.0) / (2.0 * (1.0 + e * np.cos(theta)) ** 3)
    assert np.abs(found.u - short).max() < 0.01 * short.max()


def test_the_eight_terms_are_the_whole_of_the_conductance() -> None:
    problem, (e, ratio) = Bearing("coarse"), (0.7, 0.8)

    @BilinearForm
    def conductance(p, v, w):
        scaled = [grad(p)[0], grad(p)[1] / ratio**2]
        return (1.0 + e * np.cos(w.x[0])) ** 3 * dot(scaled, grad(v))

    A = conductance.assemble(Basis(problem.mesh, ElementTriP1(), intorder=6))[problem.free][:, problem.free]
    assert len(problem.affine["A"].terms) == 8
    assert len(problem.affine["f"].terms) == 1
    assert problem.constant == {"B", "g"}
    assert abs(problem.assemble(np.array([e, ratio])).A - A).max() < 1e-13 * abs(A).max()


def test_the_film_pushes_the_shaft_back_and_aside_and_cavitates_where_it_widens() -> None:
    problem, mu = Bearing("coarse"), np.array([0.6, 1.0])
    found = HighFidelitySolver(problem).solve(mu)
    back, aside, share = (float(of.values(mu[None], found.u[:, None], found.lam[:, None])[0]) for of in problem.outputs)
    assert back < 0.0 < aside
    assert 0.25 < share < 0.5
    (theta, zeta), widening = problem.mesh.p[:, problem.free], found.lam > 0.0
    assert theta[widening].min() > np.pi
    # λ = −h′ where the film has ruptured; at ζ = 0 nodes have triangles on one side only
    inside = widening & (theta > 4.4) & (zeta > 0.0)
    assert np.allclose(found.lam[inside], -mu[0] * np.sin(theta[inside]), rtol=0.01)


@pytest.mark.long
def test_few_modes_and_generators_suffice_and_reduced_assembly_is_exact() -> None:
    stops = Stop(tolerance=1e-3), Stop(tolerance=5e-2)
    reduction = Reduction(Bearing("paper"), ModifiedCPG(), OfflinePGA(), *stops, tolerance=0.1, assembly="reduced")
    problem, lam, errors = reduction.problem, reduction.snapshots.lam, reduction.pod.errors
    assert (problem.V.dim, problem.W.dim, lam.shape[1]) == (2856, 2856, 60)
    assert [int(np.argmax(errors <= tolerance)) for tolerance in (1e-2, 1e-3, 1e-4)] == [7, 16, 30]
    sizes = [ModifiedCPG().reduce(lam, problem.W, Stop(tolerance=tolerance)).size for tolerance in (1e-1, 5e-2, 1e-2)]
    assert sizes == [1, 3, 13]
    steps = {name: getattr(reduction, name) for name in ("snapshots", "pod", "cone", "enrichment")}
    full, mu = replace(reduction, assembly="full").given(**steps), np.array([0.55, 1.2])
    one, other = reduction.model.solve(mu), full.model.solve(mu)
    assert np.allclose(one.u, other.u, rtol=0.0, atol=1e-9 * np.abs(other.u).max())
    assert np.allclose(one.lam, other.lam, rtol=0.0, atol=1e-7 * np.abs(other.lam).max())
