import itertools

import numpy as np
import pytest
from samples import SampleStore, mixed_cell, store_of

from vibench import Stop
from vibench.plugins.plugin import Plugin
from vibench.stability.infsup import InfSup, inf_sup_full, inf_sup_on
from vibench.stages.base import value_of
from vibench.stages.cell_queries import CellQueries
from vibench.study.parameter_sets import ParameterSet

PROBLEMS = {
    "obstacle": Plugin("problem", "obstacle", '{"resolution": 200}', "test"),
    "hertz": Plugin("problem", "hertz", '{"resolution": 300}', "test"),
}
PRIMALS = {"decorrelated": None, "online-supremizers": None, "offline-pga": 0.6}
COUNT = 5
EVERY = pytest.mark.parametrize("problem", list(PROBLEMS))


def cell(problem: str, primal: str) -> CellQueries:
    kinds = Stop(size=4), "mcpg", Stop(size=6), primal, ParameterSet("validation", COUNT, 3)
    return mixed_cell(PROBLEMS[problem], *kinds, tolerance=PRIMALS[primal])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    """A store with the constants of every pair of a problem and a primal strategy."""
    cells = itertools.starmap(cell, itertools.product(PROBLEMS, PRIMALS))
    return store_of(tmp_path_factory.mktemp("constants"), (stage for one in cells for stage in one.constants))


def constants(store: SampleStore, problem: str, primal: str) -> list[list[InfSup]]:
    return [value_of(store, stage) for stage in cell(problem, primal).constants]


def agrees(one: InfSup, other: InfSup) -> bool:
    """Equal up to round-off; intervals may be certified by other bounds."""
    return bool(
        np.isclose(one.span, other.span, rtol=1e-8, atol=1e-12)
        and one.cone_lower <= other.cone_upper * (1.0 + 1e-6)
        and other.cone_lower <= one.cone_upper * (1.0 + 1e-6)
    )


@EVERY
@pytest.mark.parametrize("primal", list(PRIMALS))
def test_constants_grow_with_the_space_at_every_parameter(store: SampleStore, problem: str, primal: str) -> None:
    for own, full, plain in zip(*constants(store, problem, primal), strict=True):
        for larger, smaller in ((full, own), (own, plain)):
            assert larger.span >= smaller.span * (1.0 - 1e-8) - 1e-12
            assert larger.cone_upper >= smaller.cone_lower * (1.0 - 1e-8)
        for each in (own, full, plain):
            assert each.span <= each.cone_upper * (1.0 + 1e-8)
            assert each.cone_lower <= each.cone_upper
        assert full.span > 0.0
        assert plain.span == 0.0  # four modes for six generators
    stage = cell(problem, primal).built.enrichment
    model, basis = stage.reduction(store).projection, value_of(store, stage.pod).basis
    cone = value_of(store, stage.cone).prepared
    found = constants(store, problem, primal)
    mus = model.problem.validation_set(COUNT, 3)
    assert [len(values) for values in found] == [COUNT] * 3
    for mu, own, full, plain in zip(mus, *found, strict=True):
        vi = model.problem.assemble(mu)
        assert agrees(own, inf_sup_on(model.primal_basis(vi), vi.B, cone))
        assert agrees(full, inf_sup_full(model.problem.V, vi.B, cone))
        assert agrees(plain, inf_sup_on(basis, vi.B, cone))


@EVERY
def test_the_kinds_of_enrichment_reach_what_they_are_for(store: SampleStore, problem: str) -> None:
    own, full, plain = constants(store, problem, "decorrelated")
    assert all(agrees(a, b) for a, b in zip(own, plain, strict=True))
    own, full, _ = constants(store, problem, "online-supremizers")
    assert all(agrees(a, b) for a, b in zip(own, full, strict=True))
    own, full, plain = constants(store, problem, "offline-pga")
    for a, b, c in zip(own, full, plain, strict=True):
        assert c.span < a.span < b.span
        assert a.span >= 0.7 * b.span  # √(1 − 0.6²) = 0.8 at training parameters
    own, full, plain = cell("hertz", "decorrelated").constants
    other_own, other_full, other_plain = cell("hertz", "offline-pga").constants
    assert own.key != other_own.key
    assert (full.key, plain.key) == (other_full.key, other_plain.key)
    assert len({own.key, full.key, plain.key, cell("obstacle", "decorrelated").constants[1].key}) == 4
