"""The quantities of interest of the built-in problems: equilibrium of forces, areas in closed form."""

import numpy as np
import pytest

from vibench import Array, HighFidelitySolver, Problem, create


def value(problem: Problem, name: str, mu: Array, u: Array, lam: Array) -> float:
    (output,) = (one for one in problem.outputs if one.name == name)
    return float(output.values(mu[None], u[:, None], lam[:, None])[0])


@pytest.mark.parametrize("options", [{}, {"approach": "parameter"}])
def test_the_contact_force_of_the_discs_is_what_the_flats_exert(options: dict[str, str]) -> None:
    problem = create("problem", "hertz", {"resolution": "coarse"} | options)
    for mu in problem.training_set()[[0, 40, -1]]:
        found = HighFidelitySolver(problem).solve(mu)
        force = value(problem, "contact force", mu, found.u, found.lam)
        assert force == pytest.approx(sum(problem.resultants(mu, found.u)), rel=1e-8)
        middle = problem.points(mu)[0][0, problem.slave.zone[1::2]]  # of every macro-edge, shorter than its arc
        width = value(problem, "contact half-width", mu, found.u, found.lam)
        assert width == pytest.approx(middle[found.lam > 0.0].max(), abs=problem.macro_lengths.max())


def test_the_indentation_is_the_way_of_the_apex_less_that_of_the_flat() -> None:
    problem = create("problem", "hertz", {"resolution": "coarse"})
    mu = problem.training_set()[30]
    found = HighFidelitySolver(problem).solve(mu)
    moved = problem.displacement(mu, found.u)[1]
    way = moved[problem.slave.zone[0]] - moved[problem.slave.flat].mean()
    assert value(problem, "indentation", mu, found.u, found.lam) == pytest.approx(way, rel=1e-12)
    assert way > 0.0  # the apex is pushed up, towards the flat


@pytest.mark.parametrize("mu", [[1.0, 0.0, 0.0], [0.8, 0.05, -0.02], [1.2, 0.0, 0.05]])
def test_force_and_area_of_a_uniform_pressure_on_the_disc_of_the_obstacle(mu: list[float]) -> None:
    problem = create("problem", "obstacle", {"resolution": "medium"})
    where, area = np.array(mu), np.pi * (0.2 * mu[0]) ** 2
    u, lam = np.zeros(problem.V.dim), np.full(problem.W.dim, 3.0)
    assert value(problem, "contact area", where, u, lam) == pytest.approx(area, rel=0.01)  # a polygon
    exact = 3.0 * value(problem, "contact area", where, u, lam)
    assert value(problem, "contact force", where, u, lam) == pytest.approx(exact, rel=1e-12)
    assert value(problem, "contact area", where, u, 0.0 * lam) == 0.0


def test_the_forces_on_the_membrane_are_in_equilibrium() -> None:
    """∫ ∇u·∇v = ∫ f v + ∫ λ v for v = 1 − u₀, where u₀ ∈ V is 1 on the disc: the edge carries the rest."""
    problem = create("problem", "obstacle", {"resolution": "coarse"})
    mu = np.array([1.1, 0.02, -0.03])
    found, vi = HighFidelitySolver(problem).solve(mu), problem.assemble(mu)
    inside = np.zeros(problem.V.dim)
    inside[problem.contact_dofs] = 1.0
    pressed = inside @ (vi.A @ found.u - vi.f)
    assert value(problem, "contact force", mu, found.u, found.lam) == pytest.approx(pressed, rel=1e-8)


SENSORS = {
    ("obstacle", "deflection"): (0.35, 0.0), ("obstacle", "left deflection"): (-0.35, 0.0),
    ("obstacle", "lower deflection"): (0.0, -0.35), ("radial-obstacle", "inner deflection"): (0.25, 0.0),
    ("radial-obstacle", "middle deflection"): (0.55, 0.0), ("radial-obstacle", "outer deflection"): (0.8, 0.0),
}  # fmt: skip


@pytest.mark.parametrize(("sensor", "place"), SENSORS.items(), ids=str)
def test_a_deflection_is_that_of_the_nearest_node(sensor: tuple[str, str], place: tuple[float, float]) -> None:
    problem = create("problem", sensor[0], {"resolution": "medium"})
    nodes, mu = problem.mesh.p[:, problem.free], problem.parameters.lower
    x, y = (value(problem, sensor[1], mu, coordinates, np.zeros(problem.W.dim)) for coordinates in nodes)
    assert np.hypot(x - place[0], y - place[1]) < 0.03
