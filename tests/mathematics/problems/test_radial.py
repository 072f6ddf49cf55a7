import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerics import fitted_rate
from skfem import Basis, ElementTriP1
from skfem.models.poisson import laplace, mass

from vibench.highfidelity import active_set
from vibench_problems.radial import Radial, RadialSolution

MUS = [np.array(mu) for mu in ((0.14, 0.25), (0.155, 0.0), (0.17, 0.1), (0.2, 0.2))]


@given(st.floats(0.14, 0.2), st.floats(0.0, 0.25))
def test_the_closed_form_solves_the_obstacle_problem(height: float, curvature: float) -> None:
    exact = RadialSolution(height, curvature)
    rho, step = exact.contact_radius, 1e-4
    assert 0.1 < rho < 0.5
    assert float(exact.u(np.array(1.0))) == pytest.approx(0.0, abs=1e-15)
    edge = np.array([rho * (1.0 - 1e-12), rho * (1.0 + 1e-12)])
    for function in (exact.u, exact.slope):
        assert np.ptp(function(edge)) < 1e-10
    r = np.concatenate([np.linspace(0.01, rho - 0.01, 40), np.linspace(rho + 0.01, 0.99, 40)])
    slope = (exact.u(r + step) - exact.u(r - step)) / (2.0 * step)
    assert np.allclose(slope, exact.slope(r), atol=1e-5)
    flux = ((r + step) * exact.slope(r + step) - (r - step) * exact.slope(r - step)) / (2.0 * step * r)
    assert np.allclose(-flux + 1.0, exact.lam(r), atol=1e-5)  # −Δu = −1 + λ
    assert np.all(exact.u(r) >= -height - curvature * r**2 - 1e-14)


@pytest.mark.parametrize(("resolution", "nodes"), [("coarse", 397), ("paper", 3571), (1200, 1201)])
def test_sizes(resolution: str | int, nodes: int) -> None:
    problem = Radial(resolution)  # type: ignore[arg-type]
    assert abs(problem.mesh.p.shape[1] / nodes - 1.0) < 0.15
    assert np.linalg.norm(problem.mesh.p[:, problem.disc_nodes], axis=0).max() <= 0.5 + 1e-12


def test_the_errors_are_zero_for_the_exact_solution_and_known_for_nothing() -> None:
    problem, mu = Radial(2000), MUS[2]
    exact = problem.exact(mu)
    r = np.linalg.norm(problem.mesh.p, axis=0)
    near = problem.errors(mu, exact.u(r)[problem.free], exact.lam(r)[problem.disc_nodes])
    assert near[0] < 0.05
    assert near[1] < 0.4  # λ jumps, its interpolant does not
    nothing = problem.errors(mu, np.zeros(problem.V.dim), np.zeros(problem.W.dim))
    assert nothing == pytest.approx((1.0, 1.0))
    assert problem.length == 1.0
    u = np.sin(3.0 * problem.mesh.p[0])[problem.free]
    laplacian, full = (form.assemble(Basis(problem.mesh, ElementTriP1())) for form in (laplace, mass))
    field = np.zeros(len(r))
    field[problem.free] = u
    assert float(problem.V.norm(u)) == pytest.approx(np.sqrt(field @ (laplacian + full) @ field))


def test_displacement_and_multiplier_converge_to_the_closed_form_at_the_known_rates() -> None:
    """Order 1 for u in V, ½ for λ in L², over three levels; the contact radius and the load it carries too."""
    spacing, in_v, in_w, radii = [], [], [], []
    for rings in (8, 16, 32):
        problem = Radial(3 * rings**2)
        solver, found = active_set.HighFidelitySolver(problem), []
        for mu in MUS:
            solution = solver.solve(mu)
            assert solution.fallback == ""
            radius = problem.contact_radius(solution.lam) / problem.exact(mu).contact_radius - 1.0
            found.append((*problem.errors(mu, solution.u, solution.lam), abs(radius)))
        errors = np.mean(found, axis=0)
        spacing.append(1.0 / rings)
        for history, error in zip((in_v, in_w, radii), errors, strict=True):
            history.append(float(error))
    assert 0.97 <= fitted_rate(spacing, in_v) <= 1.03
    assert 0.45 <= fitted_rate(spacing, in_w) <= 0.65
    assert in_v[-1] < 0.02
    assert radii[-1] < 0.01
