import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from other_problems import Put
from skfem import Basis, ElementTriP1, MeshTri
from skfem.models.poisson import laplace, unit_load

from vibench.interfaces.problem import Problem
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle
from vibench_problems.p1_entries import LoadEntries, StiffnessEntries

OBSTACLE = Obstacle(200)
seeds = st.integers(0, 10_000)

TRIANGLE = np.array([[[0.0, 4.0, 0.0], [0.0, 0.0, 3.0]], [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
"""By weight: a triangle with legs 4 and 3, and what makes the legs longer by 1."""


def parameters(problem: Problem, seed: int) -> np.ndarray:
    return problem.parameters.sample(1, seed)[0]


@given(seeds, st.sampled_from([0, 1, 20, 5000]))
def test_entries_of_the_obstacle_are_those_of_what_is_assembled(seed: int, count: int) -> None:
    """Some entries or nearly all, several of them twice, diagonal ones and those at the boundary among them."""
    rng, A = np.random.default_rng(seed), OBSTACLE.assemble(OBSTACLE.training_set()[0]).A.tocoo()
    chosen, diagonal = rng.integers(A.nnz, size=count), np.arange(seed % 7, seed % 7 + 3)
    rows, columns = (np.append(places[chosen], diagonal) for places in A.coords)
    of_f = rng.integers(OBSTACLE.V.dim, size=count), np.zeros(count, dtype=np.intp)
    wanted = {"A": (rows, columns), "f": of_f}
    sample = OBSTACLE.sampler(wanted)
    for mu in OBSTACLE.parameters.sample(2, seed):
        found, vi = sample(mu), OBSTACLE.assemble(mu)
        assert set(found) == set(wanted)
        for name, (rows, columns) in wanted.items():
            member = getattr(vi, name)
            exact = member[rows] if member.ndim == 1 else member.toarray()[rows, columns]
            assert np.allclose(found[name], exact, rtol=1e-11, atol=1e-14)


@given(seeds)
def test_forms_of_the_obstacle_are_those_of_a_finite_element_library(seed: int) -> None:
    mu = parameters(OBSTACLE, seed)
    vi, basis = OBSTACLE.assemble(mu), Basis(MeshTri(OBSTACLE.points(mu), OBSTACLE.mesh.t), ElementTriP1())
    free = OBSTACLE.free
    assert abs(vi.A - laplace.assemble(basis)[free][:, free]).max() < 1e-13 * abs(vi.A).max()
    assert np.allclose(vi.f, -unit_load.assemble(basis)[free], rtol=1e-13, atol=0.0)
    assert vi.A.has_canonical_format


@pytest.mark.parametrize("names", [("A",), ("f",), ("A", "f"), ()])
def test_only_what_is_wanted_is_evaluated(names: tuple[str, ...]) -> None:
    places = np.array([3, 5]), np.array([3, 5])
    sample = OBSTACLE.sampler(dict.fromkeys(names, places))
    assert sorted(sample(parameters(OBSTACLE, 0))) == sorted(names)


def test_options_of_the_obstacle_are_in_the_entries() -> None:
    mu, places = np.array([1.1, 0.02, -0.03]), (np.arange(6), np.zeros(6, np.intp))
    one, two = (Obstacle(200, load=load, obstacle=load) for load in (-1.0, -3.0))
    assert np.allclose(two.sampler({"f": places})(mu)["f"], 3.0 * one.sampler({"f": places})(mu)["f"], rtol=1e-14)
    assert np.allclose(two.affine["g"].at(mu), 3.0 * one.affine["g"].at(mu), rtol=1e-14)


@given(seeds)
def test_declared_sums_of_the_obstacle_are_what_is_assembled(seed: int) -> None:
    mu = parameters(OBSTACLE, seed)
    vi = OBSTACLE.assemble(mu)
    assert abs(OBSTACLE.affine["B"].at(mu) - vi.B).max() <= 1e-15 * abs(vi.B).max()
    assert np.allclose(OBSTACLE.affine["g"].at(mu), vi.g, rtol=1e-14)


@pytest.mark.parametrize("weights", [(1.0, 0.0), (1.0, 0.5), (2.0, -1.0)])
def test_a_right_triangle_by_hand(weights: tuple[float, float]) -> None:
    """With legs a along x and b along y: ∇φ of the node at the right angle is −(1/a, 1/b), area ab/2."""
    triangles, (a, b) = np.array([[0], [1], [2]]), weights @ np.array([[4.0, 3.0], [1.0, 1.0]])
    exact = 0.5 * np.array([
        [b / a + a / b, -b / a, -a / b],
        [-b / a, b / a, 0.0],
        [-a / b, 0.0, a / b],
    ])  # fmt: skip
    rows, columns = np.indices((3, 3)).reshape(2, -1)
    for order in ([0, 1, 2], [1, 2, 0], [0, 2, 1]):  # the last is clockwise
        found = StiffnessEntries(TRIANGLE, triangles[order], rows, columns)(np.array(weights))
        assert np.allclose(found.reshape(3, 3), exact)
        assert np.allclose(LoadEntries(TRIANGLE, triangles[order], np.arange(3))(np.array(weights)), a * b / 6.0)


def test_what_has_no_contact_says_so() -> None:
    problem, mu = Put(cells=20), np.array([0.3, 0.06])
    assert not problem.has_contact
    assert problem.contact(mu) is None
    (B, g), vi = problem.constraint(mu), problem.assemble(mu)
    assert abs(B - vi.B).max() == 0.0
    assert np.array_equal(g, vi.g)


def test_entries_of_a_problem_that_only_declares_them_are_refused() -> None:
    with pytest.raises(NotImplementedError, match=r"Hertz declares \[\] and has no sampler"):
        Hertz("coarse").sampler({"A": (np.zeros(1, np.intp), np.zeros(1, np.intp))})
