"""Which cells are timed together, when, and for how long: until their comparisons are decided."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from vibench.execution.result_writer import ResultWriter
from vibench.results.break_even import FEWEST_ROUNDS, Comparison, Meaning, compared
from vibench.results.paired_timing import FEWEST_BLOCKS, PairedTiming
from vibench.rounds.timed_seconds import TimedCell, TimedRound
from vibench.rounds.timing_rounds import SHARE, TimingRounds, block_rows
from vibench.stages.base import Failed, Row, Stage
from vibench.stages.judging.cell_goal import CellGoal
from vibench.study.cells import Cell

STOPPING_TAIL = 0.005
"""Probability on each side at which a comparison is decided while rounds go on: those that are looked at several times
are decided at 5 % only if each look is stricter (Pocock 1977)."""

HOPELESS = 2.0
"""Rounds end where a decision would take this multiple of those that are allowed."""


@dataclass
class _Group:
    """Cells that are timed together, and what was measured so far, by the key of a goal."""

    members: dict[Cell, CellGoal]
    queries: dict[str, tuple[int, ...]]
    rows: dict[str, list[Row]] = field(default_factory=dict)
    rounds: dict[str, list[TimedRound]] = field(default_factory=dict)
    machines: dict[str, set[str]] = field(default_factory=dict)
    lost: dict[str, tuple[int, str]] = field(default_factory=dict)
    """How many rounds of a goal are missing, and why the first one is."""
    blocks: int = 0
    first: int = 0
    """Number of the rounds so far."""


@dataclass
class TimingPlan:
    """The groups of a run, each of the cells that break-even compares: of one problem, cone and pair of tolerances.

    A group is timed whole, even where only some of its cells are new: seconds of different runs are not compared. It is
    timed in blocks of rounds, of which the next one is planned when the one before has ended; a cell whose comparisons
    are decided takes no part any more.

    Attributes
    ----------
    goals
        The last stages of the cells that can be timed here, by cell.
    rounds
        Most rounds.
    writer
        Knows which cells have rows and seconds already.
    fewest
        Rounds that every cell gets, if so many are allowed.
    """

    goals: Mapping[Cell, CellGoal]
    rounds: int
    writer: ResultWriter
    fewest: int = 0
    paired: PairedTiming = field(default_factory=PairedTiming)
    """All that was measured so far: the scatter of a cell's few blocks is judged together with that of others."""
    _groups: dict[tuple[object, ...], list[Cell]] = field(default_factory=dict)
    _open: dict[tuple[object, ...], set[Cell]] = field(default_factory=dict)
    _planned: dict[str, _Group] = field(default_factory=dict)
    _session: int = 0

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
        return [stage for group in complete if (stage := self._begin(group)) is not None]

    def ended(self, cell: Cell) -> TimingRounds | None:
        """Note that a cell has its row; the stage of its group if it was the last one."""
        group = _group(cell)
        self._open[group].discard(cell)
        return None if self._open[group] else self._begin(group)

    def members(self, stage: TimingRounds) -> Iterable[tuple[Cell, CellGoal]]:
        """The cells of the group of a planned stage, with their goals."""
        return self._planned[stage.key].members.items()

    def _begin(self, group: tuple[object, ...]) -> TimingRounds | None:
        rows = {cell: self.writer.database.cell(cell.key) for cell in self._groups[group]}
        members = {cell: self.goals[cell] for cell, row in rows.items() if row is not None and row["queries_ok"]}
        if all(row["timing_rounds"] == self.rounds for cell in members if (row := rows[cell]) is not None):
            return None
        fine = {goal.key: self.writer.database.fine_queries(cell.key) for cell, goal in members.items()}
        return self._block(_Group(members, fine), self._session, members.values())

    def _block(self, group: _Group, session: int, goals: Iterable[CellGoal]) -> TimingRounds:
        """The next block of a group, of some of its goals."""
        # Cells that differ in their labels alone have one goal.
        mine = tuple({goal.key: goal for goal in goals}.values())
        rounds = block_sizes(self.rounds)[group.blocks]
        stage = TimingRounds(mine, tuple(group.queries[goal.key] for goal in mine), rounds, group.first, session)
        self._planned[stage.key] = group
        self._session = max(self._session, session)
        return stage

    def record(self, stage: Stage, outcome: tuple[TimedCell, ...] | Failed) -> TimingRounds | None:
        """Write the seconds of a block, or why there are none; returns the next one of its group, if there is any.

        A stage that is not of this plan is ignored.
        """
        if not isinstance(stage, TimingRounds):
            return None
        group = self._planned.pop(stage.key)
        if isinstance(outcome, Failed):
            lost = TimedCell({}, "", stage.rounds, outcome.reason)
            outcome = (lost,) * len(stage.cells)
        for goal, rows, timed in zip(stage.cells, block_rows(stage, outcome), outcome, strict=True):
            self._note(group, goal.key, rows, timed)
        group.blocks += 1
        group.first += stage.rounds
        timed_here = {goal.key for goal in stage.cells}
        for cell, goal in group.members.items():
            if goal.key in timed_here:  # nothing is new of others
                self._write(group, cell, goal)
                self.paired.add(cell.key, group.rows[goal.key])
        timed_now = {goal.key for goal, timed in zip(stage.cells, outcome, strict=True) if timed.rounds}
        following = [goal for goal in self._undecided(group) if goal.key in timed_now]
        if following and group.blocks < len(block_sizes(self.rounds)):
            return self._block(group, stage.session + 1, following)
        for cell in group.members:
            self.writer.timed(cell, self.rounds)
        return None

    def _note(self, group: _Group, goal: str, rows: list[Row], timed: TimedCell) -> None:
        group.rows.setdefault(goal, []).extend(rows)
        group.rounds.setdefault(goal, []).extend(timed.rounds.values())
        group.machines.setdefault(goal, set()).update({timed.machine} if timed.rounds else ())
        count, reason = group.lost.get(goal, (0, ""))
        group.lost[goal] = count + timed.lost, reason or timed.reason

    def _write(self, group: _Group, cell: Cell, goal: CellGoal) -> None:
        count, reason = group.lost[goal.key]
        rows, rounds = group.rows[goal.key], group.rounds[goal.key]
        everything = len(rows) + count
        lost = f"{'all' if count == everything else f'{count} of {everything}'} rounds: {reason}" if count else ""
        self.writer.seconds(cell, rows, rounds, group.machines[goal.key], lost)

    def _undecided(self, group: _Group) -> list[CellGoal]:
        """The goals that further rounds may decide a comparison of."""
        if group.first < min(max(self.fewest, FEWEST_ROUNDS), self.rounds) or group.blocks < FEWEST_BLOCKS:
            return list(group.members.values())
        cells = {cell.key: goal for cell, goal in group.members.items()}
        rows = [row for key in cells if (row := self.writer.database.cell(key)) is not None]
        undecided: dict[str, CellGoal] = {}
        for one in compared(rows, self.paired, STOPPING_TAIL):
            if one.result.meaning is Meaning.UNDECIDED and self._would_help(one, group.first):
                both = [one.b["cell"]] if one.a is None else [one.a["cell"], one.b["cell"]]
                undecided |= {key: cells[key] for key in both}
        return list(undecided.values())

    def _would_help(self, one: Comparison, done: int) -> bool:
        """Whether it is seconds of queries that leave a comparison undecided, and rounds may still decide it."""
        more = one.result.rounds
        return one.gain is None or (more is not None and done + more <= HOPELESS * self.rounds)


def block_sizes(rounds: int) -> list[int]:
    """Numbers of rounds of the blocks of so many: a pass over all queries, or less where rounds are few."""
    blocks = 1 if rounds < FEWEST_ROUNDS else max(FEWEST_BLOCKS, rounds // SHARE)
    return [rounds // blocks + (k < rounds % blocks) for k in range(blocks)]


def _group(cell: Cell) -> tuple[object, ...]:
    return cell.problem, cell.training, cell.validation, cell.dual, cell.pod, cell.cone
