"""Which offline stages are timed again, and what their seconds become."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from samples import SampleStore, carry_out

from vibench.execution.timing_plan import OfflinePlan
from vibench.results.break_even import SCATTER
from vibench.stages.assembly import ExactSolutions
from vibench.stages.base import Stage
from vibench.stages.cell_queries import CellQueries, cell_queries
from vibench.stages.timing_rounds import OfflineRepeat, offline_columns, scatter, sources
from vibench.study.matrix import expand, read_study
from vibench.timing import Seconds

ASKED = {"problem": ["hertz"], "dual": ["mcpg"], "primal": ["offline-pga"], "solvers": ["piqp"]}
(CELL,) = expand(read_study("quick", ASKED))
GOAL = cell_queries(CELL, 20.0)
STAGES = list({stage.key: stage for stage in sources(GOAL)}.values())


def spent(seconds: float) -> Seconds:
    return Seconds(seconds, seconds)


def plan_of(seconds: Mapping[str, float], requested: int = 0) -> tuple[OfflinePlan, list[OfflineRepeat]]:
    plan = OfflinePlan(None, SimpleNamespace(), requested)  # type: ignore[arg-type]
    for key, cpu in seconds.items():
        plan.note(next(stage for stage in STAGES if stage.key == key), spent(cpu), 1.5 * cpu)
    return plan, plan.repeats([(CELL, GOAL)])


def test_short_stages_are_repeated_within_the_budget_and_offline_alone() -> None:
    costs = dict(zip((stage.key for stage in STAGES), (0.5, 0.1, 2.0, 0.2, 0.3, 9.0, 0.1), strict=False))
    plan, repeats = plan_of(costs)
    paid = [costs[one.stage.key] for one in repeats]
    assert sum(paid) <= 0.3 * sum(costs.values())
    assert max(paid) <= 3.0
    firsts = [costs[one.stage.key] for one in repeats if one.number == 1]
    assert firsts == sorted(cost for cost in costs.values() if cost <= 3.0)
    assert plan.repeats([(CELL, GOAL)]) == []  # once is enough
    costs = {stage.key: 1.0 for stage in STAGES}
    _, repeats = plan_of(costs)
    plan = OfflinePlan(None, SimpleNamespace(), 0)  # type: ignore[arg-type]
    plan.note(ExactSolutions(GOAL.assembly), spent(100.0), 100.0)
    for stage in STAGES:
        plan.note(stage, spent(1.0), 1.0)
    assert plan.repeats([(CELL, GOAL)]) == repeats
    assert 0 < len(repeats) < 2 * len(STAGES)
    costs = dict.fromkeys((stage.key for stage in STAGES), 100.0)
    _, repeats = plan_of(costs, requested=3)
    assert sorted(one.number for one in repeats) == sorted([1, 2, 3] * len(STAGES))


def test_the_seconds_of_a_nested_enrichment_are_those_of_its_growth(tmp_path_factory: pytest.TempPathFactory) -> None:
    store = SampleStore(tmp_path_factory.mktemp("artefacts"))
    enrichment = GOAL.built.enrichment
    carry_out(enrichment, store)
    source, name = enrichment.measured_by
    repeat = OfflineRepeat(source, 1)
    store.put(repeat.key, (result := repeat.run(store)).value, result.seconds, ())
    first, again = store.get(enrichment.key), repeat.seconds(store, name)
    assert first is not None
    assert again is not None
    assert again.cpu == result.value[name][0] > 0.0
    assert repeat.seconds(store, name) == again
    assert OfflineRepeat(source, 2).seconds(store, name) is None


def test_medians_count_scatter_is_pooled_and_repeats_narrow_intervals() -> None:
    rng = np.random.default_rng(0)
    runs = [[spent(base * float(np.exp(0.3 * rng.standard_normal()))) for _ in range(3)] for base in [0.1, 1.0] * 300]
    assert scatter(runs) == pytest.approx(0.3, rel=0.05)
    assert scatter([[spent(1.0)]]) == SCATTER
    assert scatter([*runs, [spent(1e-5), spent(1e-3)]]) == scatter(runs)  # too short to say anything
    found = columns({"high-fidelity solutions": [1.0, 2.0, 9.0], "cone": [3.0, 5.0]})
    assert (found["offline_snapshots_s"], found["offline_cone_s"]) == (4 * 2.0 + 0.5, 4.0)
    assert found["offline_s"] == 12.5
    assert found["offline_repeats"] == 5

    def width(**runs: list[float]) -> float:
        found = columns({name.replace("_", " "): values for name, values in runs.items()})
        return float(np.log(found["offline_high_s"] / found["offline_low_s"]))

    once = width(cone=[1.0])
    assert once == pytest.approx(2.0 * 1.96 * 0.1)
    assert width(cone=[1.0] * 4) == pytest.approx(once / 2.0)
    assert width(cone=[1.0], POD=[1e-6] * 4) == pytest.approx(once, rel=1e-3)


def columns(runs_of: Mapping[str, list[float]], deviation: float = 0.1) -> dict[str, Any]:
    stages: dict[str, Stage] = {one.key: one for some in GOAL.offline_stages.values() for one in some}
    runs = {key: [spent(cpu) for cpu in runs_of.get(stage.label, [0.0])] for key, stage in stages.items()}
    return offline_columns(GOAL, 0.5, runs, deviation)


def test_seconds_of_cells_whose_artefacts_are_gone_stay_as_they_are() -> None:
    written: list[str] = []
    database = SimpleNamespace(cell=lambda _: {"hf_setup_s": 1.0}, write_columns=lambda key, _: written.append(key))
    writer = SimpleNamespace(database=database)
    for there in (False, True):
        artefact = SimpleNamespace(seconds=spent(1.0), value={"": [1.0, 1.0]}) if there else None
        plan = OfflinePlan(SimpleNamespace(get=lambda _, found=artefact: found), writer, 0)  # type: ignore[arg-type]
        plan.repeats([(CELL, GOAL)])
        plan._seconds = {}
        if there:
            plan._runs = lambda stage: [spent(1.0)]  # type: ignore[method-assign]
        plan.finish()
    assert written == [CELL.key]
    assert isinstance(GOAL, CellQueries)
