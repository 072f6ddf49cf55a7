"""One growth serves every tolerance it passes: same vectors and histories, seconds of each its own."""

from collections.abc import Iterator

import numpy as np
import pytest
from fake_plugins import Wire

from vibench.errors import NumericalError
from vibench.interfaces.strategies import Cone, Offline, no_free
from vibench.reduction.nested import NestedStrategy, Step, grow_through
from vibench.study.matrix import expand
from vibench.study.spec import Study


class UnitVectors(NestedStrategy):
    """Adds unit vectors; after k of them the error is 1 / (k + 1)."""

    def steps(self, offline: Offline) -> Iterator[Step]:
        unit, errors = np.eye(offline.problem.V.dim), []
        for count in range(5):
            errors.append(1.0 / (count + 1))
            yield Step(count, errors[-1], lambda first, count=count: unit[:, first:count], {"error": errors})
        raise NumericalError("four are all there are")


class Ends(UnitVectors):
    """Just ends where it has no further vector."""

    def steps(self, offline: Offline) -> Iterator[Step]:
        yield next(super().steps(offline))


class Fails(UnitVectors):
    """Fails before there is an enrichment at all."""

    def steps(self, offline: Offline) -> Iterator[Step]:
        raise NumericalError("no space to begin with")
        yield


@pytest.fixture
def offline() -> Offline:
    problem = Wire()
    cone = Cone(np.zeros((problem.W.dim, 0)), np.ones(1), no_free(0))
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
    with pytest.raises(NumericalError, match=r"tolerance 0\.1 is not reached: the strategy has no further vector"):
        Ends().build(offline, 0.1)
    assert Ends().build(offline, 1.0).vectors.shape[1] == 0
    with pytest.raises(NumericalError, match=r"^no space to begin with$"):
        grow_through(Fails(), offline, [1.0])
    with pytest.raises(ValueError, match="UnitVectors needs a tolerance"):
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
