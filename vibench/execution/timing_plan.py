"""Which cells are timed together, and when: once all cells of a group have their rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from vibench.execution.result_writer import ResultWriter
from vibench.stages.base import Failed, Stage
from vibench.stages.cell_queries import CellQueries
from vibench.stages.timing_rounds import TimedCell, TimingRounds
from vibench.study.cells import Cell


@dataclass
class TimingPlan:
    """The groups of a run, each of the cells that break-even compares: of one problem, cone and pair of tolerances.

    A group is timed whole, even where only some of its cells are new: seconds of different runs are not compared.

    Attributes
    ----------
    goals
        The last stages of the cells that can be timed here, by cell.
    rounds
        Rounds that the study asks for.
    writer
        Knows which cells have rows and seconds already.
    """

    goals: Mapping[Cell, CellQueries]
    rounds: int
    writer: ResultWriter
    _groups: dict[tuple[object, ...], list[Cell]] = field(default_factory=dict)
    _open: dict[tuple[object, ...], set[Cell]] = field(default_factory=dict)
    _planned: dict[str, list[Cell]] = field(default_factory=dict)

    def start(self, todo: Iterable[Cell]) -> list[TimingRounds]:
        """Note which cells will get new rows.

        Returns
        -------
        list
            The stages of the groups that wait for none of them, and have cells without seconds.
        """
        waiting = set(todo)
        for cell in self.goals:
            self._groups.setdefault(_group(cell), []).append(cell)
        self._open = {group: waiting.intersection(cells) for group, cells in self._groups.items()}
        complete = [group for group, left in self._open.items() if not left]
        return [stage for group in complete if (stage := self._stage(group)) is not None]

    def ended(self, cell: Cell) -> TimingRounds | None:
        """Note that a cell has its row; the stage of its group if it was the last one."""
        group = _group(cell)
        self._open[group].discard(cell)
        return None if self._open[group] else self._stage(group)

    def _stage(self, group: tuple[object, ...]) -> TimingRounds | None:
        rows = {cell: self.writer.database.cell(cell.key) for cell in self._groups[group]}
        members = {cell: row for cell, row in rows.items() if row is not None and row["queries_ok"]}
        if all(row["timing_rounds"] == self.rounds for row in members.values()):
            return None
        # Cells that differ in their labels alone have one goal.
        fine = {self.goals[cell]: self.writer.database.fine_queries(cell.key) for cell in members}
        stage = TimingRounds(tuple(fine), tuple(fine.values()), self.rounds)
        self._planned[stage.key] = list(members)
        return stage

    def record(self, stage: Stage, outcome: tuple[TimedCell, ...] | Failed) -> None:
        """Write the seconds of a group, or why there are none; a stage that is not of this plan is ignored."""
        if not isinstance(stage, TimingRounds):
            return
        if isinstance(outcome, Failed):
            outcome = (TimedCell((), "", f"all rounds: {outcome.reason}"),) * len(stage.cells)
        # By key: comparing two stages compares all that they depend on.
        timed = dict(zip((one.key for one in stage.cells), outcome, strict=True))
        for cell in self._planned.pop(stage.key):
            self.writer.seconds(cell, timed[self.goals[cell].key], self.rounds)


def _group(cell: Cell) -> tuple[object, ...]:
    return cell.problem, cell.training, cell.validation, cell.dual, cell.pod, cell.cone
