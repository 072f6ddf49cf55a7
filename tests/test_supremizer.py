from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from numerics import Varying
from vibench.linalg import orthonormal_range
from vibench.supremizer import SupremizerCoordinates, constraint_classes, proportionality, supremizers


def test_a_supremizer_attains_its_own_norm() -> None:
    problem = Varying()
    B = problem.assemble(np.array([0.4])).B
    eta = np.random.default_rng(0).random((8, 3))
    T = supremizers(problem.V, B, eta)
    assert np.allclose(np.diag(T.T @ (B.T @ eta)), problem.V.norm(T) ** 2)  # b(Tη, η) = ‖Tη‖², equation (19)
    v = np.random.default_rng(1).standard_normal(30)
    assert np.all(v @ (B.T @ eta) <= problem.V.norm(v) * problem.V.norm(T) * (1.0 + 1e-12))


def test_coordinates_are_an_isometry_that_leads_back_to_the_supremizers() -> None:
    problem = Varying()
    matrices = [problem.assemble(mu).B for mu in problem.training_set()]
    basis = problem.V.orthonormalise(np.random.default_rng(0).standard_normal((30, 4)))
    space = SupremizerCoordinates(problem.V, basis, matrices)
    eta = np.random.default_rng(1).random((8, 5))
    for B in matrices:
        direct, coordinates = supremizers(problem.V, B, eta), space.supremizers(B, eta)
        assert np.allclose(space.vectors(coordinates), direct, atol=1e-11)
        assert np.allclose(coordinates.T @ coordinates, problem.V.gram(direct, direct), atol=1e-11)
        assert np.allclose(coordinates[:4], problem.V.gram(basis, direct), atol=1e-11)
    assert np.allclose(space.vectors(space.plain), basis, atol=1e-11)
    assert orthonormal_range(space.supremizers(matrices[0], np.eye(8))).shape[1] == 8


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
