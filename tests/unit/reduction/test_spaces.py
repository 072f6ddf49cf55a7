from collections.abc import Iterator
from itertools import islice
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.sparse as sp
from fake_plugins import Wire
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying, space
from scipy.optimize import nnls

from vibench import Array, ContactLoads, NumericalError, Offline, ReducedSet, RequestError, Stop, Study, no_free, pod
from vibench.reduction import Cubature, cubature, supremizers
from vibench.reduction.nested import NestedStrategy, Step, grow_through
from vibench.stages.artefacts import dumps, loads
from vibench.study.matrix import expand


def test_a_supremizer_attains_its_own_norm() -> None:
    problem = Varying()
    B = problem.assemble(np.array([0.4])).B
    eta = np.random.default_rng(0).random((8, 3))
    T = supremizers.supremizers(problem.V, B, eta)
    assert np.allclose(np.diag(T.T @ (B.T @ eta)), problem.V.norm(T) ** 2)  # b(Tη, η) = ‖Tη‖², equation (19)
    v = np.random.default_rng(1).standard_normal(30)
    assert np.all(v @ (B.T @ eta) <= problem.V.norm(v) * problem.V.norm(T) * (1.0 + 1e-12))


@pytest.mark.parametrize("count", [1, 5], ids=["spanned", "contact"])
def test_coordinates_are_an_isometry_that_leads_back_to_the_supremizers(count: int) -> None:
    problem = Varying()
    matrices = [problem.assemble(mu).B for mu in problem.training_set()]
    basis = problem.V.orthonormalise(np.random.default_rng(0).standard_normal((30, 4)))
    eta = np.random.default_rng(1).random((8, count))
    space, found = supremizers.supremizer_coordinates(problem.V, basis, matrices, eta)
    assert isinstance(space, supremizers.SpannedCoordinates if count == 1 else supremizers.ContactCoordinates)
    assert np.allclose(space.plain.T @ space.plain, np.eye(4), atol=1e-12)
    assert np.allclose(space.vectors(space.plain), basis, atol=1e-11)
    assert np.array_equal(loads(dumps(space)).vectors(space.plain), space.vectors(space.plain))
    for B, coordinates in zip(matrices, found, strict=True):
        direct = supremizers.supremizers(problem.V, B, eta)
        assert np.allclose(space.vectors(coordinates), direct, atol=1e-11)
        assert np.allclose(coordinates.T @ coordinates, problem.V.gram(direct, direct), atol=1e-11)
        assert np.allclose(space.plain.T @ coordinates, problem.V.gram(basis, direct), atol=1e-11)


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_vectors_that_depend_on_each_other_have_coordinates_in_an_orthonormal_basis_too(rank: int) -> None:
    V, rng = space(9), np.random.default_rng(rank)
    basis = V.orthonormalise(rng.standard_normal((9, 3)))
    some = rng.standard_normal((9, rank))
    vectors = np.hstack([some, basis @ rng.random((3, 1)), some @ rng.random((rank, 2)), rng.standard_normal((9, 2))])
    found = supremizers.SpannedCoordinates(V, basis, vectors)
    assert np.allclose(found.vectors(found.represented), vectors, atol=1e-12)
    assert np.allclose(found.vectors(found.plain), basis, atol=1e-12)
    everything = found.vectors(np.eye(found.plain.shape[0]))
    assert np.allclose(V.gram(everything, everything), np.eye(found.plain.shape[0]), atol=1e-12)


def test_proportional_matrices_are_recognised_and_others_are_not() -> None:
    B = sp.csr_array(np.random.default_rng(0).random((3, 4)))
    assert np.isclose(supremizers.proportionality(-2.5 * B, B), -2.5, rtol=1e-14)
    other = B.copy()
    other.data[0] *= 1.0 + 1e-9
    assert supremizers.proportionality(other, B) is None
    assert supremizers.proportionality(0.0 * B, B) is None
    matrices = [B, other, 3.0 * B, 2.0 * other]
    classes = supremizers.constraint_classes(matrices)
    assert classes.members.tolist() == [0, 1, 0, 1]
    assert np.allclose(classes.factors, [1.0, 1.0, 3.0, 2.0])
    for matrix, factor, member in zip(matrices, classes.factors, classes.members, strict=True):
        assert np.allclose((factor * classes.representatives[member]).toarray(), matrix.toarray())


@pytest.mark.parametrize("reach", [3, 5, None])
@pytest.mark.parametrize("dependent", [False, True])
def test_coordinates_of_varying_loads_are_those_of_their_supremizers(reach: int | None, dependent: bool) -> None:
    V, rng, dofs = space(16), np.random.default_rng(3), np.arange(5, 15)
    basis = V.orthonormalise(rng.standard_normal((16, 3)))
    fixed = np.zeros((10, 4))
    fixed[:4, 1:] = rng.random((4, 3))  # the first multiplier has no fixed load
    if dependent:
        fixed[:, 3] = fixed[:, 1] - 2.0 * fixed[:, 2]
    coordinates = supremizers.LoadCoordinates(V, basis, dofs, ContactLoads(fixed, lambda _: (fixed, fixed), 4, reach))
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


seeds = st.integers(0, 10_000)


def tail(snapshots: np.ndarray, basis: np.ndarray, X) -> float:
    rest = snapshots - basis @ X.gram(basis, snapshots)
    return float(np.sqrt((X.norm(rest) ** 2).sum() / (X.norm(snapshots) ** 2).sum()))


@given(seeds)
def test_errors_are_the_tails_of_the_nested_bases_and_no_other_basis_does_better(seed: int) -> None:
    X, rng = space(12, seed), np.random.default_rng(seed)
    snapshots = rng.standard_normal((12, 6)) * 10.0 ** -np.arange(6.0)
    found = pod(snapshots, X, Stop(size=6))
    assert np.allclose(X.gram(found.basis, found.basis), np.eye(6), atol=1e-12)
    for k in range(7):
        assert np.isclose(tail(snapshots, found.basis[:, :k], X), found.errors[k], rtol=1e-6, atol=1e-12)
    snapshots = rng.standard_normal((12, 5))
    other = X.orthonormalise(snapshots @ rng.standard_normal((5, 2)))
    assert tail(snapshots, pod(snapshots, X, Stop(size=2)).basis, X) <= tail(snapshots, other, X) + 1e-12
    # the same basis whatever the signs of the snapshots
    one, two = (pod(sign * snapshots, X, Stop(size=3)).basis for sign in (1.0, -1.0))
    assert np.allclose(one, two, atol=1e-12)


@given(seeds, st.integers(1, 6), st.integers(0, 3), st.floats(1e-14, 1e-6))
def test_copies_and_near_copies_add_nothing(seed: int, count: int, copies: int, near: float) -> None:
    X = space(10, seed)
    rng = np.random.default_rng(seed)
    single = rng.standard_normal((10, count))
    repeated = single[:, rng.integers(count, size=copies)] * (1.0 + near * rng.standard_normal((10, copies)))
    found = pod(np.hstack([single, repeated]), X, Stop(tolerance=1e-4)).basis
    assert found.shape[1] <= count
    assert np.allclose(X.gram(found, found), np.eye(found.shape[1]), atol=1e-12)
    if count == 1:
        assert np.isclose(abs(X.gram(found, single)[0, 0]), X.norm(single)[0], rtol=1e-6)


def test_the_smallest_size_of_a_tolerance_is_taken_and_none_above_the_rank() -> None:
    X = space(8)
    q = X.orthonormalise(np.random.default_rng(0).standard_normal((8, 4)))
    for tolerance, size in ((0.5, 1), (1e-3, 2), (1e-5, 3), (1e-7, 4)):
        assert pod(q * np.array([1.0, 1e-2, 1e-4, 1e-6]), X, Stop(tolerance=tolerance)).basis.shape[1] == size
    errors = pod(q[:, :3] * np.array([1.0, 1e-5, 1e-10]), X, Stop(size=3)).errors
    assert np.isclose(errors[2], 1e-10, rtol=1e-4)  # eigenvalues of the Gram matrix would floor at 1e-8
    X = space(6)
    snapshots = np.outer(np.arange(1.0, 7.0), [1.0, 2.0, 3.0])
    assert pod(snapshots, X, Stop(tolerance=1e-9)).basis.shape[1] == 1
    with pytest.raises(NumericalError, match=r"size 2: the 3 snapshots have rank 1"):
        pod(snapshots, X, Stop(size=2))
    for nothing in (np.zeros((6, 0)), np.zeros((6, 3))):
        assert pod(nothing, X, Stop(tolerance=0.1)).basis.shape == (6, 0)


class UnitVectors(NestedStrategy):
    """Adds unit vectors; after k of them the error is 1 / (k + 1)."""

    def steps(self, offline: Offline) -> Iterator[Step]:
        unit, errors = np.eye(offline.problem.V.dim), []
        for count in range(5):
            errors.append(1.0 / (count + 1))
            yield Step(count, errors[-1], lambda first, count=count: unit[:, first:count], {"error": errors})
        raise NumericalError("four are all there are")


@pytest.fixture
def offline() -> Offline:
    problem = Wire()
    cone = ReducedSet(np.zeros((problem.W.dim, 0)), np.ones(1), no_free(0))
    return Offline(problem, np.zeros((problem.V.dim, 0)), cone, cone.generators, problem.training_set())


def test_every_tolerance_gets_what_building_for_it_alone_gives(offline: Offline) -> None:
    grown = grow_through(UnitVectors(), offline, [0.25, 1.0, 0.5])
    for tolerance, count in ((1.0, 0), (0.5, 1), (0.25, 3)):
        enrichment = grown.at(grown.milestone(tolerance))
        alone = UnitVectors().build(offline, tolerance)
        assert enrichment.vectors.shape[1] == count
        assert np.array_equal(enrichment.vectors, alone.vectors)
        assert np.array_equal(enrichment.history["error"], alone.history["error"])
    seconds = [grown.milestone(tolerance).seconds.wall for tolerance in (1.0, 0.5, 0.25)]
    assert seconds == sorted(seconds)
    assert seconds[0] < seconds[-1]


def test_a_tolerance_beyond_reach_costs_no_other_and_failures_are_named(offline: Offline) -> None:
    grown = grow_through(UnitVectors(), offline, [0.5, 0.1])
    assert grown.at(grown.milestone(0.5)).vectors.shape[1] == 1
    with pytest.raises(NumericalError, match=r"tolerance 0\.1 is not reached: four are all there are"):
        grown.milestone(0.1)
    ends = UnitVectors()  # just ends where it has no further vector
    ends.steps = lambda offline: islice(UnitVectors().steps(offline), 1)  # type: ignore[method-assign]
    with pytest.raises(NumericalError, match=r"tolerance 0\.1 is not reached: the strategy has no further vector"):
        ends.build(offline, 0.1)
    assert ends.build(offline, 1.0).vectors.shape[1] == 0
    failing = UnitVectors()
    failing.steps = Mock(side_effect=NumericalError("no space to begin with"))  # type: ignore[method-assign]
    with pytest.raises(NumericalError, match=r"^no space to begin with$"):
        grow_through(failing, offline, [1.0])
    with pytest.raises(RequestError, match="UnitVectors needs a tolerance"):
        UnitVectors().build(offline, None)


def test_cells_of_a_nested_strategy_know_its_tolerances_and_keep_their_identity() -> None:
    def cells(*tolerances: float) -> dict[float | None, tuple[str, tuple[float, ...]]]:
        table = {"pod": [0.1], "dual": [0.1], "primal": {"offline-pga": list(tolerances)}}
        study = Study.model_validate({
            "name": "some", "validation": 3, "problem": ["obstacle"], "dual": ["cpg"], "solvers": ["piqp"],
            "primal": ["offline-pga", "decorrelated"], "tolerances": [table],
        })  # fmt: skip
        return {cell.primal_tol: (cell.key, cell.nested_tolerances) for cell in expand(study)}

    few, many = cells(0.3), cells(0.3, 0.6)
    assert few[0.3] == (many[0.3][0], (0.3,))
    assert many[0.6][1] == many[0.3][1] == (0.6, 0.3)
    assert many[None][1] == ()


def test_cubatures_keep_their_tolerance_or_are_nonnegative_least_squares() -> None:
    rng = np.random.default_rng(0)
    conditions: Array = rng.standard_normal((12, 300)) + 1.0
    for tolerance in (1e-1, 1e-3, 1e-9):
        columns, weights = cubature(conditions, tolerance)
        assert len(columns) <= 12
        assert weights.min() > 0.0
        residual = conditions.sum(axis=1) - conditions[:, columns] @ weights
        assert np.linalg.norm(residual) <= tolerance * np.linalg.norm(conditions.sum(axis=1))
    assert np.array_equal(cubature(np.zeros((3, 4)), 0.1)[0], np.zeros(0))
    assert np.array_equal(cubature(conditions, 0.0)[1], np.ones(300))
    conditions = np.random.default_rng(1).standard_normal((40, 25))
    conditions[:, -1] = -3.0 * conditions[:, :5].sum(axis=1)  # weights of one are far from the least residual
    columns, weights = cubature(conditions, 1e-9)
    expected, _ = nnls(conditions, conditions.sum(axis=1))
    assert np.array_equal(columns, np.flatnonzero(expected > 1e-12))
    assert np.allclose(weights, expected[columns])


def test_few_sums_know_the_residual_of_many_conditions() -> None:
    rng, made = np.random.default_rng(2), Cubature(20, 200)
    # functions of 200 points that are sums of few, in 100 groups of 20 conditions: 2,000 in all
    few = rng.standard_normal((15, 200)) + 1.0
    groups: list[Array] = [rng.standard_normal((20, 15)) @ few for _ in range(100)]
    for conditions in groups:
        made.add(conditions, 1.0)
    made.add(np.zeros((20, 200)), 1.0)  # conditions of nothing are met by any columns
    columns, weights = made.columns(1e-2)
    assert len(columns) <= 15
    assert weights.min() > 0.0
    sums = [(conditions.sum(axis=1), conditions[:, columns] @ weights) for conditions in groups]
    left = [np.linalg.norm(whole - few) / np.linalg.norm(whole) for whole, few in sums]
    assert np.sqrt(np.mean(np.square(left))) <= 2e-2
