"""Problems that write every result into the same arrays have the numbers of those which do not."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import pytest
from broken_problems import Declared
from buffered import buffered
from numerics import Varying
from running import without_seconds
from samples import SampleStore, carry_out, mixed_cell

from vibench import Problem, Stop
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import find
from vibench.stages.base import Row, value_of
from vibench.stages.cell_queries import CellQueries
from vibench.stages.pictures import PictureStage
from vibench.study.parameter_sets import ParameterSet

OBSTACLE = find(PluginKind.PROBLEM, "obstacle").load()
PROBLEMS: Mapping[str, Callable[[], Problem]] = {
    "wire": Declared, "wire, buffered": buffered(Declared), "string": Varying, "string, buffered": buffered(Varying),
    "obstacle": partial(OBSTACLE, 150), "obstacle, buffered": partial(buffered(OBSTACLE), 150),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    create = Plugin.create
    monkeypatch.setattr(Plugin, "create", lambda one: PROBLEMS[one.name]() if one.kind == "problem" else create(one))


def problem(name: str) -> Plugin:
    return Plugin("problem", name, "{}", "of this module")


def cell(name: str, primal: str, interpolation: float | None) -> CellQueries:
    kinds = Stop(size=2), "cpg", Stop(size=2), primal, ParameterSet("validation", 4, 1)
    return mixed_cell(problem(name), *kinds, interpolation=interpolation)


def rows(stage: CellQueries, store: SampleStore) -> list[Row]:
    carry_out(stage, store)
    found = value_of(store, stage)
    return [without_seconds(row) for row in (found.cell | {"model": ""}, *found.queries)]


@pytest.mark.parametrize("primal", ["decorrelated", "online-supremizers"])
@pytest.mark.parametrize("interpolation", [None, 1e-6], ids=["full", "reduced"])
@pytest.mark.parametrize("kind", ["wire", "string", pytest.param("obstacle", marks=pytest.mark.long)])
def test_reused_arrays_keep_numbers(kind: str, primal: str, interpolation: float | None, store: SampleStore) -> None:
    plain, other = (rows(cell(name, primal, interpolation), store) for name in (kind, f"{kind}, buffered"))
    assert plain[0]["status"] == "ok"
    for one, same in zip(plain, other, strict=True):
        assert one.keys() == same.keys()
        for name, value in one.items():
            # Sums are rounded as arrays lie in memory.
            expected = pytest.approx(value, rel=1e-6, abs=1e-7) if isinstance(value, float) else value
            assert same[name] == expected, name


def test_arrays_that_are_used_again_change_no_picture(store: SampleStore) -> None:
    drawn = []
    for name in ("wire", "wire, buffered"):
        carry_out(stage := PictureStage(problem(name)), store)
        drawn.append(value_of(store, stage))
    for (title, plain), (same, other) in zip(*drawn, strict=True):
        assert title == same
        for array in ("points", "triangles", "values", "positions", "multiplier"):
            assert np.array_equal(getattr(plain, array), getattr(other, array))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    return SampleStore(tmp_path_factory.mktemp("artefacts"))
