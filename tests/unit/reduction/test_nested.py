"""One growth serves every tolerance it passes: same vectors and histories, seconds of each its own."""

from collections.abc import Mapping

import numpy as np
import pytest
from fake_plugins import Wire

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.strategies import Cone, Offline, no_free
from vibench.reduction.nested import Growth, NestedStrategy, grow_through
from vibench.study.cells import expand
from vibench.study.spec import Study


class Axes(NestedStrategy):
    """Adds unit vectors; after k of them the error is 1 / (k + 1)."""

    def begin(self, offline: Offline) -> "Counted":
        return Counted(offline)


class Counted(Growth):
    def __init__(self, offline: Offline) -> None:
        self._V, self._count, self.made = offline.problem.V, 0, []

    @property
    def count(self) -> int:
        return self._count

    def reached(self, tolerance: float) -> bool:
        return 1.0 / (self._count + 1) <= tolerance

    def grow(self) -> None:
        if self._count == 4:
            raise NumericalError("four are all there are")
        self._count += 1

    def vectors(self, first: int) -> Array:
        self.made.append(self._count - first)
        return np.eye(self._V.dim)[:, first : self._count]

    def history(self) -> Mapping[str, Array]:
        return {"error": 1.0 / np.arange(1, self._count + 2)}


@pytest.fixture
def offline() -> Offline:
    problem = Wire()
    cone = Cone(np.zeros((problem.W.dim, 0)), np.ones(1), no_free(0))
    return Offline(problem, np.zeros((problem.V.dim, 0)), cone, cone.generators, problem.training_set())


def test_every_tolerance_gets_what_building_for_it_alone_gives(offline: Offline) -> None:
    grown = grow_through(Axes(), offline, [0.25, 1.0, 0.5])
    for tolerance, count in ((1.0, 0), (0.5, 1), (0.25, 3)):
        enrichment, _ = grown.at(tolerance)
        alone = Axes().build(offline, tolerance)
        assert enrichment.vectors.shape[1] == count
        assert np.array_equal(enrichment.vectors, alone.vectors)
        assert np.array_equal(enrichment.history["error"], alone.history["error"])
    seconds = [grown.at(tolerance)[1].wall for tolerance in (1.0, 0.5, 0.25)]
    assert seconds == sorted(seconds)
    assert seconds[0] < seconds[-1]


def test_a_tolerance_beyond_reach_costs_no_other(offline: Offline) -> None:
    grown = grow_through(Axes(), offline, [0.5, 0.1])
    assert grown.at(0.5)[0].vectors.shape[1] == 1
    with pytest.raises(NumericalError, match=r"tolerance 0\.1 is not reached: four are all there are"):
        grown.at(0.1)


def test_a_nested_strategy_needs_a_tolerance(offline: Offline) -> None:
    with pytest.raises(ValueError, match="Axes needs a tolerance"):
        Axes().build(offline, None)


def test_cells_of_a_nested_strategy_know_its_tolerances_and_keep_their_identity() -> None:
    def cells(*tolerances: float) -> dict[float | None, tuple[str, tuple[float, ...]]]:
        table = {"pod": [0.1], "dual": [0.1], "primal": {"offline-pga": list(tolerances)}}
        study = Study.model_validate({
            "name": "some", "validation": 3, "problem": ["obstacle"], "dual": ["cpg"], "solvers": ["piqp"],
            "primal": ["offline-pga", "decorrelated"], "tolerances": [table],
        })  # fmt: skip
        return {cell.primal_tol: (cell.key, cell.along) for cell in expand(study)}

    few, many = cells(0.3), cells(0.3, 0.6)
    assert few[0.3] == (many[0.3][0], (0.3,))
    assert many[0.6][1] == many[0.3][1] == (0.6, 0.3)
    assert many[None][1] == ()
