import numpy as np
import pytest
import scipy.sparse as sp
from numerics import Varying, space

from vibench.errors import NumericalError
from vibench.interfaces.problem import ContactLoads
from vibench.reduction.supremizers import (
    ContactCoordinates,
    LoadCoordinates,
    SpannedCoordinates,
    constraint_classes,
    proportionality,
    supremizer_coordinates,
    supremizers,
)


def test_a_supremizer_attains_its_own_norm() -> None:
    problem = Varying()
    B = problem.assemble(np.array([0.4])).B
    eta = np.random.default_rng(0).random((8, 3))
    T = supremizers(problem.V, B, eta)
    assert np.allclose(np.diag(T.T @ (B.T @ eta)), problem.V.norm(T) ** 2)  # b(Tη, η) = ‖Tη‖², equation (19)
    v = np.random.default_rng(1).standard_normal(30)
    assert np.all(v @ (B.T @ eta) <= problem.V.norm(v) * problem.V.norm(T) * (1.0 + 1e-12))


@pytest.mark.parametrize("count", [1, 5], ids=["spanned", "contact"])
def test_coordinates_are_an_isometry_that_leads_back_to_the_supremizers(count: int) -> None:
    problem = Varying()
    matrices = [problem.assemble(mu).B for mu in problem.training_set()]
    basis = problem.V.orthonormalise(np.random.default_rng(0).standard_normal((30, 4)))
    eta = np.random.default_rng(1).random((8, count))
    space, found = supremizer_coordinates(problem.V, basis, matrices, eta)
    assert isinstance(space, SpannedCoordinates if count == 1 else ContactCoordinates)
    assert np.allclose(space.plain.T @ space.plain, np.eye(4), atol=1e-12)
    assert np.allclose(space.vectors(space.plain), basis, atol=1e-11)
    for B, coordinates in zip(matrices, found, strict=True):
        direct = supremizers(problem.V, B, eta)
        assert np.allclose(space.vectors(coordinates), direct, atol=1e-11)
        assert np.allclose(coordinates.T @ coordinates, problem.V.gram(direct, direct), atol=1e-11)
        assert np.allclose(space.plain.T @ coordinates, problem.V.gram(basis, direct), atol=1e-11)


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_vectors_that_depend_on_each_other_have_coordinates_in_an_orthonormal_basis_too(rank: int) -> None:
    V, rng = space(9), np.random.default_rng(rank)
    basis = V.orthonormalise(rng.standard_normal((9, 3)))
    some = rng.standard_normal((9, rank))
    vectors = np.hstack([some, basis @ rng.random((3, 1)), some @ rng.random((rank, 2)), rng.standard_normal((9, 2))])
    found = SpannedCoordinates(V, basis, vectors)
    assert np.allclose(found.vectors(found.represented), vectors, atol=1e-12)
    assert np.allclose(found.vectors(found.plain), basis, atol=1e-12)
    everything = found.vectors(np.eye(found.plain.shape[0]))
    assert np.allclose(V.gram(everything, everything), np.eye(found.plain.shape[0]), atol=1e-12)


def test_proportional_matrices_are_recognised_and_others_are_not() -> None:
    B = sp.csr_array(np.random.default_rng(0).random((3, 4)))
    assert np.isclose(proportionality(-2.5 * B, B), -2.5, rtol=1e-14)
    other = B.copy()
    other.data[0] *= 1.0 + 1e-9
    assert proportionality(other, B) is None
    assert proportionality(0.0 * B, B) is None
    classes = constraint_classes([B, other, 3.0 * B, 2.0 * other])
    assert classes.members.tolist() == [0, 1, 0, 1]
    assert np.allclose(classes.factors, [1.0, 1.0, 3.0, 2.0])
    for k, matrix in enumerate([B, other, 3.0 * B, 2.0 * other]):
        rebuilt = classes.factors[k] * classes.representatives[classes.members[k]]
        assert np.allclose(rebuilt.toarray(), matrix.toarray())


@pytest.mark.parametrize("reach", [3, 5, None])
@pytest.mark.parametrize("dependent", [False, True])
def test_coordinates_of_varying_loads_are_those_of_their_supremizers(reach: int | None, dependent: bool) -> None:
    V, rng, dofs = space(16), np.random.default_rng(3), np.arange(5, 15)
    basis = V.orthonormalise(rng.standard_normal((16, 3)))
    fixed = np.zeros((10, 4))
    fixed[:4, 1:] = rng.random((4, 3))  # the first multiplier has no fixed load
    if dependent:
        fixed[:, 3] = fixed[:, 1] - 2.0 * fixed[:, 2]
    coordinates = LoadCoordinates(V, basis, dofs, ContactLoads(fixed, lambda _: (fixed, fixed), 4, reach))
    assert np.allclose(coordinates.vectors(coordinates.plain), basis, atol=1e-12)
    everything = coordinates.vectors(np.eye(len(coordinates.plain)))
    assert np.allclose(V.gram(everything, everything), np.eye(len(coordinates.plain)), atol=1e-12)
    for j in range(7):
        varying, loads = rng.random((j, 4)), np.zeros((16, 4))
        if reach is not None and j > reach:
            with pytest.raises(NumericalError, match=f"contact loads reach {j} unknowns, {reach} were expected"):
                coordinates.supremizers(varying)
            continue
        loads[dofs] = fixed
        loads[dofs[4 : 4 + j]] += varying
        found = coordinates.supremizers(varying)
        assert np.allclose(coordinates.vectors(found), V.riesz(loads), atol=1e-12)
