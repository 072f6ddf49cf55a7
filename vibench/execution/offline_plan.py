"""Which offline stages are timed more than once, and what the offline seconds of cells are then."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from vibench.execution.result_writer import ResultWriter
from vibench.rounds.offline_repeats import OfflineRepeat, offline_columns, scatter, sources
from vibench.stages.base import Stage
from vibench.stages.judging.cell_goal import CellGoal
from vibench.storage.artefacts import Store
from vibench.study.cells import Cell
from vibench.timing import Seconds

REPEATS = 2
"""How often a short stage is timed again."""

SHORT = 3.0
"""CPU seconds of a stage above which it is timed once, unless repeats are asked for: its scatter is that of others."""

BUDGET = 0.3
"""Share of the seconds of the offline stages of a run that repeats may take."""


@dataclass
class OfflinePlan:
    """Repeats of the offline stages of a run: short ones within a budget, or all of them so many times.

    Attributes
    ----------
    store
        Has their artefacts.
    writer
        Knows which cells have rows.
    asked
        Repeats of every stage, whatever they cost; 0 for what the budget allows.
    """

    store: Store
    writer: ResultWriter
    asked: int = 0
    _seconds: dict[str, Seconds] = field(default_factory=dict)
    """What stages took, by key."""
    _costs: dict[str, float] = field(default_factory=dict)
    """What it takes to run the stage again, by key."""
    _sources: set[str] = field(default_factory=set)
    """The offline stages among them, which share the budget: what judges answers takes many times their seconds."""
    _planned: set[str] = field(default_factory=set)
    _spent: float = 0.0
    _cells: dict[Cell, CellGoal] = field(default_factory=dict)

    def note(self, stage: Stage, seconds: Seconds, wall: float = 0.0) -> None:
        """Take note of a stage that was run, in so many wall seconds, or whose artefact is there."""
        self._seconds[stage.key] = seconds
        self._costs[stage.key] = seconds.cpu or wall

    def repeats(self, cells: Iterable[tuple[Cell, CellGoal]]) -> list[OfflineRepeat]:
        """The repeats to be run for some cells that have their rows, the cheapest first."""
        mine = dict(cells)
        self._cells |= mine
        stages = {stage.key: stage for goal in mine.values() for stage in sources(goal)}
        self._sources |= stages.keys() & self._costs.keys()
        known = sorted((key for key in stages if key in self._costs), key=self._costs.__getitem__)
        planned = []
        for number in range(1, (self.asked or REPEATS) + 1):
            for key in known:
                repeat = OfflineRepeat(stages[key], number)
                if repeat.key not in self._planned and self._afford(self._costs[key]):
                    self._planned.add(repeat.key)
                    planned.append(repeat)
        return planned

    def _afford(self, cost: float) -> bool:
        if not self.asked and (cost > SHORT or self._spent + cost > BUDGET * self._offline_costs):
            return False
        self._spent += cost
        return True

    @property
    def _offline_costs(self) -> float:
        return sum(self._costs[key] for key in self._sources)

    def finish(self) -> None:
        """Write the offline columns of the cells whose repeats were planned."""
        stages = {one.key: one for goal in self._cells.values() for some in goal.offline.values() for one in some}
        runs = {key: self._runs(stage) for key, stage in stages.items()}
        known = {key: some for key, some in runs.items() if some}
        deviation = scatter(known.values())
        for cell, goal in self._cells.items():
            row = self.writer.database.cell(cell.key)
            if row is not None and all(one.key in known for some in goal.offline.values() for one in some):
                self.writer.offline(cell, offline_columns(goal, row["hf_setup_s"], known, deviation))

    def _runs(self, stage: Stage) -> list[Seconds]:
        """The seconds of a stage when it was first run, and in its repeats; none where its artefact is gone."""
        if stage.key not in self._seconds:
            artefact = self.store.get(stage.key)
            if artefact is None:
                return []
            self._seconds[stage.key] = artefact.seconds
        source, name = stage.measured_by
        numbers = range(1, (self.asked or REPEATS) + 1)
        repeated = (OfflineRepeat(source, number).seconds(self.store, name) for number in numbers)
        return [self._seconds[stage.key], *(seconds for seconds in repeated if seconds is not None)]
