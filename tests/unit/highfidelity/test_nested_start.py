import pickle

import numpy as np
import pytest
from scipy.spatial import KDTree

from vibench import HighFidelitySolver, NestedStart
from vibench.arrays import Array, Mask
from vibench.errors import NumericalError
from vibench_problems import obstacle
from vibench_problems.obstacle import Obstacle

MU = np.array([1.1, 0.02, -0.03])


def places(problem: Obstacle) -> Array:
    return problem.mesh.p[:, problem.disc_nodes]


def test_coarser_meshes_save_iterations_and_change_no_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse, fine = Obstacle(700), Obstacle(2800)
    cold = HighFidelitySolver(fine).solve(MU)
    nested = NestedStart(coarse, places(coarse), places(fine))
    coarsely = HighFidelitySolver(coarse).solve(MU).lam > 0.0
    start, contact, spacing = coarsely[nested.nearest], cold.lam > 0.0, 1.1 / np.sqrt(coarse.nodes)
    for wrong, others in ((start & ~contact, contact), (~start & contact, ~contact)):  # near the edge of the contact
        distances, _ = KDTree(places(fine)[:, others].T).query(places(fine)[:, wrong].T)
        assert np.max(distances, initial=0.0) < 1.5 * spacing
    fine.start = lambda mu, nearest: nested  # type: ignore[method-assign]
    found = HighFidelitySolver(fine).solve(MU)
    assert found.iterations < 0.6 * cold.iterations
    assert found.fallback == ""
    assert np.array_equal(found.lam > 0.0, cold.lam > 0.0)
    assert np.allclose(found.u, cold.u, rtol=0.0, atol=1e-12)
    cold = HighFidelitySolver(Obstacle(1500)).solve(MU)
    monkeypatch.setattr(obstacle, "NESTED", 1000)
    problem = Obstacle(1500)
    solver = HighFidelitySolver(problem)
    first = solver.solve(MU)
    assert first.iterations < cold.iterations
    assert np.allclose(first.u, cold.u, rtol=0.0, atol=1e-12)
    nearest = first.lam > 0.0
    assert problem.start(MU, nearest) is nearest
    assert solver.solve(MU).iterations == 1  # from its own contact set


def test_a_start_depends_on_the_parameter_alone_and_can_be_copied_after_use() -> None:
    coarse, fine = Obstacle(300), Obstacle(700)
    nested = NestedStart(coarse, places(coarse), places(fine))
    fine.start = lambda mu, nearest: nested  # type: ignore[method-assign]
    solver, other = HighFidelitySolver(fine), HighFidelitySolver(fine)
    first = solver.solve(MU).iterations
    other.solve(fine.parameters.lower)
    assert other.solve(MU).iterations == solver.solve(MU).iterations == first
    assert np.array_equal(pickle.loads(pickle.dumps(nested)).nearest, nested.nearest)


@pytest.mark.parametrize("start", [np.zeros(3, bool), np.zeros(100)], ids=["too short", "not of booleans"])
def test_a_start_of_the_wrong_kind_is_named(start: Mask) -> None:
    problem = Obstacle(400)
    problem.start = lambda mu, nearest: start  # type: ignore[method-assign]
    expected = rf"start returns .*; expected \({problem.W.dim},\) and bool, a NestedStart, or None"
    with pytest.raises(NumericalError, match=expected):
        HighFidelitySolver(problem).solve(MU)
