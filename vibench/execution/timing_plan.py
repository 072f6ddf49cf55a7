"""Which offline stages are repeated, and which cells are timed together until their comparisons are decided."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from operator import itemgetter

from vibench.execution.recording import ResultWriter
from vibench.results.break_even import Meaning, compared, scatter
from vibench.results.paired_timing import PairedTiming
from vibench.stages import timing_rounds
from vibench.stages.artefacts import Store
from vibench.stages.base import Failed, Row, Stage
from vibench.stages.cell_queries import CellQueries
from vibench.stages.timing_rounds import OfflineRepeat, TimedCell, TimedRound, TimingRounds
from vibench.study.cells import Cell
from vibench.timing import FEWEST_ROUNDS, Seconds


class OfflinePlan:
    """Repeats of the offline stages of a run: of all as often as `requested`, or two of short ones within a budget."""

    def __init__(self, store: Store, writer: ResultWriter, requested: int) -> None:
        self._store, self._writer, self._requested = store, writer, requested
        self._numbers = range(1, (requested or 2) + 1)
        # Seconds of the first run of a stage, and what a repeat costs, by its key.
        self._seconds: dict[str, Seconds] = {}
        self._costs: dict[str, float] = {}
        # Only offline stages pay for repeats: the assessment of queries takes many times their seconds.
        self._sources: set[str] = set()
        self._planned: set[str] = set()
        self._spent = 0.0
        self._cells: dict[Cell, CellQueries] = {}

    def note(self, stage: Stage, seconds: Seconds, wall: float) -> None:
        """Register a stage that has run, with its wall seconds, or whose artefact was reused."""
        self._seconds[stage.key] = seconds
        self._costs[stage.key] = seconds.cpu or wall

    def repeats(self, cells: Iterable[tuple[Cell, CellQueries]]) -> list[OfflineRepeat]:
        """The repeats to run for some cells that have their rows, the cheapest first."""
        mine = dict(cells)
        self._cells |= mine
        stages = {stage.key: stage for goal in mine.values() for stage in timing_rounds.sources(goal)}
        self._sources |= stages.keys() & self._costs.keys()
        # Begin with the cheapest: the same budget then repeats most stages.
        known = sorted((key for key in stages if key in self._costs), key=self._costs.__getitem__)
        # Repeats may take 30 % of the offline seconds of a run.
        planned, budget = [], 0.3 * sum(self._costs[key] for key in self._sources)
        for number in self._numbers:
            for key in known:
                repeat = OfflineRepeat(stages[key], number)
                cost = self._costs[key]
                # The scatter of a stage above 3 s is that of the others.
                affordable = self._requested or (cost <= 3.0 and self._spent + cost <= budget)
                if repeat.key not in self._planned and affordable:
                    self._planned.add(repeat.key)
                    planned.append(repeat)
                    self._spent += cost
        return planned

    def finish(self) -> None:
        phases = [some for goal in self._cells.values() for some in goal.offline_stages.values()]
        stages = {one.key: one for some in phases for one in some}
        known = {key: runs for key, stage in stages.items() if (runs := self._runs(stage))}
        deviation = scatter(known.values())
        for cell, goal in self._cells.items():
            row = self._writer.database.cell(cell.key)
            if row is not None and all(one.key in known for some in goal.offline_stages.values() for one in some):
                columns = timing_rounds.offline_columns(goal, row["hf_setup_s"], known, deviation)
                self._writer.database.write_columns(cell.key, columns)

    def _runs(self, stage: Stage) -> list[Seconds]:
        """The seconds of the first run of a stage and of its repeats; none where its artefact is gone."""
        if stage.key not in self._seconds:
            artefact = self._store.get(stage.key)
            if artefact is None:
                return []
            self._seconds[stage.key] = artefact.seconds
        source, name = stage.measured_by
        repeated = (OfflineRepeat(source, number).seconds(self._store, name) for number in self._numbers)
        return [self._seconds[stage.key], *(seconds for seconds in repeated if seconds is not None)]


class _Group:
    """Cells that are timed together, and their measurements so far, by the key of a goal."""

    def __init__(self, members: dict[Cell, CellQueries], queries: dict[str, tuple[int, ...]]) -> None:
        self.members, self.queries = members, queries
        self.rows: dict[str, list[Row]] = defaultdict(list)
        self.rounds: dict[str, list[TimedRound]] = defaultdict(list)
        self.machines: dict[str, set[str]] = defaultdict(set)
        self.failures: dict[str, list[Failed]] = defaultdict(list)
        # Numbers of the next block and of the next round, and the session of the last block.
        self.blocks = self.first = self.session = 0
        # CPU seconds of a round of one cell, in the last block.
        self.seconds = 0.0
        # The comparisons that the minimal rounds and later blocks have left undecided, `None` before.
        self.undecided: set[tuple[str, ...]] | None = None


class TimingPlan:
    """The groups of a run: the cells that break-even compares, of one problem, cone and pair of tolerances.

    A group is timed whole, even where only some of its cells are new: seconds of different runs are not comparable.
    Every cell gets the minimal rounds. Groups with undecided comparisons get further blocks when all else is done, that
    with the nearest decision first, until these have taken their share of the seconds of a run.

    `goals` are the last stages of the cells that can be timed here, `rounds` is the upper limit of rounds, `fewest` the
    number of rounds of every cell if the limit allows them, `share` the fraction of all other CPU seconds that further
    rounds may take.
    """

    def __init__(
        self, goals: Mapping[Cell, CellQueries], rounds: int, writer: ResultWriter, fewest: int, share: float
    ) -> None:
        self._goals, self._rounds, self._writer, self._fewest = goals, rounds, writer, fewest
        self._share = share
        # CPU seconds of further rounds and of all else so far.
        self._spent = self._others = 0.0
        # The groups that further rounds may decide: the seconds to the nearest decision, and the cells to be timed.
        self._held: list[tuple[float, _Group, list[CellQueries]]] = []
        # All measurements so far: the scatter of the few blocks of a cell is pooled with that of other cells.
        self._paired = PairedTiming()
        self._groups: dict[tuple[object, ...], list[Cell]] = {}
        self._open: dict[tuple[object, ...], set[Cell]] = {}
        self._planned: dict[str, _Group] = {}
        self._session = 0

    def start(self, todo: Iterable[Cell]) -> list[TimingRounds]:
        """Register the cells that will get new rows; returns stages of groups that wait for none but lack seconds."""
        waiting = set(todo)
        for cell in self._goals:
            self._groups.setdefault(_group(cell), []).append(cell)
        self._open = {group: waiting.intersection(cells) for group, cells in self._groups.items()}
        complete = [group for group, left in self._open.items() if not left]
        return [stage for group in complete if (stage := self._begin(group)) is not None]

    def ended(self, cell: Cell) -> TimingRounds | None:
        """The stage of the group of a cell that has got its row, if the group waited for this cell alone."""
        group = _group(cell)
        self._open[group].discard(cell)
        return None if self._open[group] else self._begin(group)

    def members(self, stage: TimingRounds) -> Iterable[tuple[Cell, CellQueries]]:
        return self._planned[stage.key].members.items()

    def _begin(self, group: tuple[object, ...]) -> TimingRounds | None:
        rows = {cell: self._writer.database.cell(cell.key) for cell in self._groups[group]}
        members = {cell: self._goals[cell] for cell, row in rows.items() if row is not None and row["queries_ok"]}
        if all(row["timing_rounds"] == self._rounds for cell in members if (row := rows[cell]) is not None):
            return None
        fine = {goal.key: self._writer.database.fine_queries(cell.key) for cell, goal in members.items()}
        return self._block(_Group(members, fine), self._session, members.values())

    def note(self, stage: Stage, spent: Seconds) -> None:
        """Register the seconds of a stage that has run, or whose artefact was reused."""
        if isinstance(stage, TimingRounds):
            group = self._planned[stage.key]
            group.seconds = spent.cpu / stage.items
            if group.undecided is not None:
                self._spent += spent.cpu
                return
        self._others += spent.cpu

    def further(self, count: int) -> list[TimingRounds]:
        """Blocks beyond the minimal rounds within the budget, at most `count`: those of the nearest decisions."""
        blocks, left = list[TimingRounds](), self._share * self._others - self._spent
        for held in sorted(self._held, key=itemgetter(0)):
            _, group, goals = held
            cost = group.seconds * len(goals) * block_sizes(self._rounds)[group.blocks]
            if len(blocks) < count and cost <= left:
                left -= cost
                self._held.remove(held)
                # Processes of this session may have timed the group before; those of the next one have not.
                blocks.append(self._block(group, self._session + (group.session == self._session), goals))
        return blocks

    def _block(self, group: _Group, session: int, goals: Iterable[CellQueries]) -> TimingRounds:
        # Cells that differ only in their labels share one goal.
        mine = tuple({goal.key: goal for goal in goals}.values())
        rounds = block_sizes(self._rounds)[group.blocks]
        stage = TimingRounds(mine, tuple(group.queries[goal.key] for goal in mine), rounds, group.first, session)
        self._planned[stage.key] = group
        self._session, group.session = max(self._session, session), session
        return stage

    def record(self, stage: Stage, outcome: tuple[TimedCell, ...] | Failed) -> TimingRounds | None:
        """Write the seconds of a block, or why there are none; returns the next of the minimal rounds, if any."""
        # A stage that is not of this plan is ignored.
        if not isinstance(stage, TimingRounds):
            return None
        group = self._planned.pop(stage.key)
        if isinstance(outcome, Failed):
            outcome = (TimedCell({}, "", (outcome,) * stage.rounds),) * len(stage.cells)
        for goal, rows, timed in zip(stage.cells, timing_rounds.block_rows(stage, outcome), outcome, strict=True):
            group.rows[goal.key] += rows
            group.rounds[goal.key] += timed.rounds.values()
            group.machines[goal.key] |= {timed.machine} if timed.rounds else set()
            group.failures[goal.key] += timed.failures
        group.blocks += 1
        group.first += stage.rounds
        timed_here = {goal.key for goal in stage.cells}
        for cell, goal in group.members.items():
            # Other cells have no new seconds.
            if goal.key in timed_here:
                rows, rounds, failures = group.rows[goal.key], group.rounds[goal.key], group.failures[goal.key]
                count, everything = len(failures), len(rows) + len(failures)
                missing = "all" if count == everything else f"{count} of {everything}"
                lost = f"{missing} rounds: {failures[0].reason}" if failures else ""
                self._writer.seconds(cell, rows, rounds, group.machines[goal.key], lost)
                self._paired.add(cell.key, rows)
        # A goal without a single round in this block would fail again.
        timed_now = {goal.key for goal, timed in zip(stage.cells, outcome, strict=True) if timed.rounds}
        if timed_now and group.blocks < len(block_sizes(self._rounds)):
            if group.first < min(max(self._fewest, FEWEST_ROUNDS), self._rounds) or group.blocks < 2:
                following = [goal for goal in group.members.values() if goal.key in timed_now]
                return self._block(group, stage.session + 1, following)
            distance, undecided = self._undecided(group)
            if following := [goal for goal in undecided if goal.key in timed_now]:
                self._held.append((distance * len(following) * group.seconds, group, following))
        # A group is complete without further rounds: a run that was interrupted amid these times none again.
        for cell in group.members:
            self._writer.database.write_columns(cell.key, {"timing_rounds": self._rounds})
        return None

    def _undecided(self, group: _Group) -> tuple[int, list[CellQueries]]:
        """How many rounds the nearest decision is away, and the goals with comparisons that rounds may decide."""
        cells = {cell.key: goal for cell, goal in group.members.items()}
        rows = [row for key in cells if (row := self._writer.database.cell(key)) is not None]
        chosen, nearest, undecided = dict[str, CellQueries](), self._rounds, set[tuple[str, ...]]()
        # A comparison that is tested after every block reaches 5 % only if each test is stricter. The first one spends
        # half of that, since few comparisons need another (Lan and DeMets 1983).
        for one in compared(rows, self._paired, tail=0.0125 if group.undecided is None else 0.005):
            pair = (one.b["cell"],) if one.a is None else (one.a["cell"], one.b["cell"])
            # Only the seconds of queries, and no offline ones, may be decided by more rounds; their number is an
            # estimate, for which twice the limit allows.
            more = one.result.rounds
            would_help = one.gain is None or (more is not None and group.first + more <= 2.0 * self._rounds)
            was_decided = group.undecided is not None and pair not in group.undecided
            if one.result.meaning is Meaning.UNDECIDED and would_help and not was_decided:
                undecided.add(pair)
                chosen |= {key: cells[key] for key in pair}
                nearest = min(nearest, more or 0)
        group.undecided = undecided
        return nearest, list(chosen.values())


def block_sizes(rounds: int) -> list[int]:
    """Numbers of rounds of the blocks of `rounds`: a pass over all queries, or less where rounds are few."""
    blocks = 1 if rounds < FEWEST_ROUNDS else max(2, rounds // timing_rounds.QUERY_SUBSETS)
    return [rounds // blocks + (k < rounds % blocks) for k in range(blocks)]


def _group(cell: Cell) -> tuple[object, ...]:
    return cell.problem, cell.training, cell.validation, cell.dual, cell.pod, cell.cone
