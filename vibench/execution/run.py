"""Running a study: stages run in worker processes and are shared by cells; every cell gets a row."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence, Set
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from vibench import interrupts, provenance
from vibench.errors import ExecutorError, RequestError, StorageError, VibenchError, in_a_line
from vibench.execution.executors import Dask, Executor, Local
from vibench.execution.graph import Graph
from vibench.execution.isolated import recall_reads, watch_first_use
from vibench.execution.recording import LOG, ResultWriter, claimed, clear, ended_by_smaller_limits, labels_of, refute
from vibench.execution.supervisor import Job, Supervisor
from vibench.execution.timing_plan import OfflinePlan, TimingPlan
from vibench.linalg.factorisations import DEFAULT, implementation
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import find, registered
from vibench.provenance import solver_distribution
from vibench.qp.solve import installed_solvers, load_qpsolvers
from vibench.qp.status import Status
from vibench.results.break_even import break_even_rows
from vibench.results.consistency import disagreement_rows
from vibench.results.database import ResultsDatabase
from vibench.stages.artefacts import Store, usable_store
from vibench.stages.base import Done, Failed, Stage, Unstored
from vibench.stages.calibration import CalibrationStage
from vibench.stages.cell_queries import CellQueries, CellRows, cell_queries
from vibench.stages.pictures import PictureStage
from vibench.stages.timing_rounds import QUERY_SUBSETS, TimingRounds
from vibench.study.cells import Cell
from vibench.study.matrix import expand
from vibench.study.spec import Study
from vibench.text import shown


@dataclass(frozen=True)
class Agenda:
    """Numbers of cells in the matrix, to run and not available here, the stages of the others, and worker processes."""

    cells: int
    to_run: int
    unavailable: int
    stages: Sequence[Stage]
    workers: int


class Observer:
    """Callbacks of a run, which do nothing here; `wall` are the wall seconds of a stage."""

    def note(self, line: str) -> None:
        """Show a line that the user should know."""

    def start(self, agenda: Agenda) -> None:
        """Called when the run begins."""

    def begin(self, stage: Stage) -> None:
        """Called when a stage begins."""

    def fractions_done(self, running: Sequence[tuple[Stage, float]]) -> None:
        """Called often, with the running stages and the fractions of them that are known to be done."""

    def stage(self, stage: Stage, wall: float) -> None:
        """Called when a stage is done."""

    def plan(self, stage: Stage) -> None:
        """Called when a stage is added to the agenda."""

    def cell(self, cell: Cell, row: Mapping[str, Any]) -> None:
        """Called when a cell has its row."""


@dataclass(frozen=True)
class RunResult:
    """Rows of all cells after a run, how many are missing, whether it was interrupted, and cells with damaged rows."""

    rows: tuple[dict[str, Any], ...]
    missing: int
    interrupted: bool
    damaged: tuple[str, ...] = ()


def identity(study: Study) -> dict[str, Any]:
    """The settings that all numbers of a study depend on; a run folder holds results of one identity only."""
    validation: Any = study.validation
    if not isinstance(validation, int):
        plugin = validation.plugin(PluginKind.SAMPLING)
        validation = {"name": plugin.name, "options": json.loads(plugin.options)}
    return {"name": study.name, "seed": study.seed, "validation": validation}


@dataclass(frozen=True)
class Options:
    """How a study is run; only times depend on it.

    `jobs` are worker processes, 0 for one per core. `fresh` removes earlier results and computes all artefacts again,
    `retry` repeats cells that did not end ok. The `executor` is "local" or "dask", the `scheduler` the address of one
    of dask, `None` for a cluster on this machine. `repeats` is the minimal number of cold processes in which seconds
    are measured, 0 for as many as decide the comparisons.

    Raises a `RequestError` for too many worker processes or repeats.
    """

    jobs: int
    fresh: bool
    retry: bool
    executor: str
    scheduler: str | None
    repeats: int

    def __post_init__(self) -> None:
        if not 0 <= self.repeats <= 100:
            raise RequestError(f"repeats is {shown(self.repeats)}, expected 0 to 100 processes")
        # More than one process per core makes a run slower, and thousands stop the machine.
        most = 16 * provenance.cores()
        if not 0 <= self.jobs <= most:
            what = f"at most {most} worker processes, 16 per core, or 0 for one per core"
            raise RequestError(f"jobs is {shown(self.jobs)}, expected {what}")

    @property
    def workers(self) -> int:
        return self.jobs or provenance.cores()


def run_study(study: Study, folder: Path, observer: Observer, options: Options) -> RunResult:
    """Run the missing cells of a study and write every result into its folder, beside earlier ones of this study."""
    # Raises a `RequestError` if the folder, the store or the executor cannot be used, a `StorageError` if nothing can
    # be written; earlier results are kept.
    cells, store = expand(study), usable_store()
    with claimed(folder), store.used():
        with closing(Supervisor(folder / LOG)) as supervisor:
            limits: Any = {"supervisor": supervisor, "seconds": study.limits.cell_seconds}
            watch = partial(watch_first_use, note=observer.note, **limits)
            if recall_reads((one for cell in cells for one in cell.plugins if one.is_given), store, watch):
                cells = expand(study)
        if options.fresh:
            clear(folder, study.name, observer.note)
        database = ResultsDatabase(folder, identity(study), anew=options.fresh)
        try:
            repeated, finished = ended_by_smaller_limits(database, study.limits), database.finished()
            repeated |= _no_longer_missing(database, cells)
            if options.retry:
                repeated |= {key for key, (status, _) in finished.items() if status != Status.OK}
            kept = {key: code for key, (_, code) in finished.items() if key not in repeated}
            todo = [cell for cell in cells if kept.get(cell.key) != cell.code]
            writer = ResultWriter(study, database, labels_of(cells))
            database.keep(f"limits of {writer.study_hash}", study.limits.model_dump_json())
            interrupted = _Run(study, folder, store, writer, observer, options).execute(cells, todo)
            refute(database)
            everything = list(database.rows("cells"))
            # Both tables compare cells of the whole file, those of earlier runs included.
            database.replace("thresholds", break_even_rows(everything, database.rows("timings")))
            database.replace("disagreements", disagreement_rows(everything, database.fine_solutions))
        finally:
            database.close()
    keys = {cell.key for cell in cells}
    rows = tuple(row for row in everything if row["cell"] in keys)
    return RunResult(rows, len(cells) - len(rows), interrupted, database.damaged)


@dataclass
class _Run:
    """One execution of a study: the graph of its stages, and the recording of their results."""

    study: Study
    folder: Path
    store: Store
    writer: ResultWriter
    observer: Observer
    options: Options
    graph: Graph = field(default_factory=Graph)
    # Several cells may get their rows from one goal, by its key.
    cells: dict[str, list[Cell]] = field(default_factory=dict)
    # The dispensable stages that failed, by key.
    lost: dict[str, Failed] = field(default_factory=dict)
    timing: TimingPlan = field(init=False)
    offline: OfflinePlan = field(init=False)
    machines: Set[str] = frozenset()

    def execute(self, cells: Sequence[Cell], todo: Sequence[Cell]) -> bool:
        """Run some cells of the matrix, and time those that have no seconds; returns whether Ctrl-C ended it."""
        reasons = {cell.key: reason for cell in cells if (reason := unavailable(cell))}
        goals = {cell: cell_queries(cell, self.study.limits.query_seconds) for cell in cells if cell.key not in reasons}
        runnable = [cell for cell in todo if cell in goals]
        rounds, fewest = self.study.timing_rounds, self.study.timing_rounds_min
        requested = QUERY_SUBSETS * self.options.repeats
        share = self.study.timing_budget
        self.timing = TimingPlan(goals, max(rounds, requested), self.writer, max(fewest, requested), share)
        self.offline = OfflinePlan(self.store, self.writer, max(self.options.repeats - 1, 0))
        untimed = self.timing.start(runnable)
        uncalibrated = self.writer.uncalibrated()
        waiting = [cell for cell in goals if cell.key in uncalibrated and cell not in runnable]
        workers: Executor | None = None
        interrupted = False
        try:
            if runnable or untimed or waiting:
                dask, count, log = self.options.executor == "dask", self.options.workers, self.folder / LOG
                workers = Dask(self.options.scheduler, count, self.store.folder) if dask else Local(count, log)
                self.machines = workers.machines
            # One training set of a problem is drawn, the first one.
            pictured: dict[Plugin, Stage] = {
                one.problem: PictureStage(one.problem, one.training) for one in cells[::-1]
            }
            for cell in runnable:
                self.cells.setdefault(goals[cell].key, []).append(cell)
                for stage in (goals[cell], pictured[cell.problem]):
                    self.graph.add_goal(stage, self._is_available)
            for group in untimed:
                self._time(group, plan=False)
            for cell in waiting:
                self._calibrate(cell, goals[cell], plan=False)
            slots = workers.slots if workers is not None else 0
            left_out = [cell for cell in todo if cell.key in reasons]
            self.observer.start(Agenda(len(cells), len(todo), len(left_out), [*self.graph.stages.values()], slots))
            for cell in left_out:
                self._fail_cell(cell, Failed(Status.UNAVAILABLE, reasons[cell.key]))
            if workers is not None:
                self._loop(workers)
        except KeyboardInterrupt:
            # Another Ctrl-C must not leave the results incomplete.
            interrupts.ignore()
            interrupted = True
        finally:
            if workers is not None:
                workers.close()
        self.offline.finish()
        return interrupted

    def _is_available(self, stage: Stage) -> bool:
        """Whether the artefact of a stage can be reused; its histories are recorded if so."""
        # Seconds of different machines are not comparable: an artefact of another machine is computed again.
        if self.options.fresh or not stage.stored:
            return False
        artefact = self.store.get(stage.key)
        if artefact is None or artefact.machine not in self.machines:
            return False
        self.offline.note(stage, artefact.seconds, 0.0)
        self.timing.note(stage, artefact.seconds)
        self.writer.stage(stage, artefact.histories, self.store)
        return True

    def _loop(self, workers: Executor) -> None:
        running: dict[Future[Any], Stage] = {}
        limits = self.study.limits
        while self.graph.waiting or running or self._time_further(workers.slots):
            for stage in self.graph.begin(workers.slots - len(running)):
                cell_seconds = stage.weight * limits.cell_seconds
                folder, lost = str(self.store.folder), dict(self.lost)
                job = Job(folder, stage, limits.query_seconds, cell_seconds, limits.memory_gib, lost)
                self.observer.begin(stage)
                running[workers.submit(job)] = stage
            if not running:
                waiting = f"{len(self.graph.waiting)} stages wait for inputs that are not running"
                raise ExecutorError(f"{waiting}: this is a bug in vibench")
            # Wake up now and then: an executor that was lost completes nothing.
            done, _ = wait(running, timeout=5.0, return_when=FIRST_COMPLETED)
            workers.check()
            fractions = workers.fractions_done()
            self.observer.fractions_done([(stage, fractions.get(stage.key, 0.0)) for stage in running.values()])
            for future in done:
                self._finish(running.pop(future), _outcome(future))

    def _finish(self, stage: Stage, outcome: Done | Failed) -> None:
        """Record the end of a stage; if it failed, every cell that needs it gets a row with the reason."""
        if isinstance(outcome, Failed) and stage.dispensable:
            self.lost[stage.key] = outcome
            self.graph.done(stage)
            return
        if isinstance(outcome, Failed):
            # The last stage of a cell has no name that a user knows.
            reason = outcome.reason if stage.key in self.cells else f"in {stage.label}: {outcome.reason}"
            if isinstance(stage, CalibrationStage):
                self.writer.calibrations(stage, [{"reason": outcome.reason}])
            if isinstance(stage, PictureStage):
                self.writer.pictures(stage, [{"reason": outcome.reason}])
            self._timed(stage, outcome)
            for goal in self.graph.lost(stage):
                for cell in self.cells.get(goal.key, ()):
                    self._fail_cell(cell, Failed(outcome.status, reason))
                    self._ended(cell)
            return
        self.observer.stage(stage, outcome.spent.wall)
        self.timing.note(stage, outcome.spent)
        self.graph.done(stage)
        if stage.stored:
            self.offline.note(stage, outcome.seconds, outcome.spent.wall)
            self.writer.stage(stage, outcome.histories, self.store)
        else:
            self._timed(stage, outcome.value)
        for cell in self.cells.get(stage.key, ()):
            self.observer.cell(cell, self.writer.cell(cell, outcome.value))
            if self.study.task:
                self._calibrate(cell, stage)
            self._ended(cell)

    def _calibrate(self, cell: Cell, queries: Stage, *, plan: bool = True) -> None:
        """Plan the chains of a cell that has its row."""
        assert isinstance(queries, CellQueries)  # the goal of a cell
        calibration = CalibrationStage(queries, cell.key)
        self.graph.add_goal(calibration, self._is_available)
        if plan and calibration.key in self.graph.waiting:
            self.observer.plan(calibration)

    def _ended(self, cell: Cell) -> None:
        if (group := self.timing.ended(cell)) is not None:
            self._time(group)

    def _time(self, group: TimingRounds, *, plan: bool = True) -> None:
        """Plan the first block of a group's rounds, and before it repeats of the offline stages of its cells."""
        # Plan the group first: the inputs of a stage register their seconds with the offline plan then.
        self.graph.add_goal(group, self._is_available)
        for stage in (group, *self.offline.repeats(self.timing.members(group))):
            self.graph.add_goal(stage, self._is_available)
            if plan and stage.key in self.graph.waiting:
                self.observer.plan(stage)

    def _timed(self, stage: Stage, outcome: Any) -> None:
        if (following := self.timing.record(stage, outcome)) is not None:
            self._plan(following)

    def _time_further(self, count: int) -> bool:
        """Plan rounds beyond the minimal ones, at most `count` blocks; returns whether there are any."""
        blocks = self.timing.further(count)
        for block in blocks:
            self._plan(block)
        return bool(blocks)

    def _plan(self, block: TimingRounds) -> None:
        self.graph.add_goal(block, self._is_available)
        self.observer.plan(block)

    def _fail_cell(self, cell: Cell, failed: Failed) -> None:
        ended = {"status": failed.status.value, "reason": failed.reason}
        row = ended | {"queries": cell.validation.count, "queries_ok": 0}
        self.observer.cell(cell, self.writer.cell(cell, CellRows(row, ())))


def _no_longer_missing(database: ResultsDatabase, cells: Sequence[Cell]) -> set[str]:
    """Keys of the cells whose row says that something is not installed, which is by now."""
    lacked = {key for key, *_, reason in database.ends() if "not installed" in reason or "cannot be imported" in reason}
    return {cell.key for cell in cells if cell.key in lacked and not unavailable(cell)}


def unavailable(cell: Cell) -> str:
    """Reason why a cell cannot be run here: something is not installed, or a name is ambiguous; "" if none."""
    plugins = [plugin.registered for plugin in cell.plugins]
    for plugin in (*plugins, *([] if cell.solver is None else [find(PluginKind.SOLVER, cell.solver)])):
        if plugin.conflict:
            return plugin.conflict
    chosen = implementation(cell.problem.arguments.get("factorisation", DEFAULT))
    needs = [(str(plugin), plugin.missing) for plugin in plugins]
    needs += [] if chosen.is_installed else [(f"factorisation '{chosen.name}'", [chosen.distribution])]
    if chosen.is_installed and chosen.fault:
        return chosen.fault
    for name, missing in needs:
        if missing:
            what = f"the {name} needs {', '.join(missing)}, which is not installed"
            return f"{what}: `pip install {' '.join(missing)}`"
    if cell.solver is None or cell.solver in installed_solvers(registered(PluginKind.SOLVER)):
        return ""
    if fault := load_qpsolvers()[1].get(cell.solver) if provenance.solver_version(cell.solver) else "":
        return f"the QP solver '{cell.solver}' cannot be imported: {fault}"
    return f"the QP solver '{cell.solver}' is not installed: `pip install {solver_distribution(cell.solver)}`"


def _outcome(future: Future[Any]) -> Done | Failed:
    try:
        result = future.result()
    except VibenchError:
        raise
    except Exception as error:  # noqa: BLE001  a stage or a result that cannot be pickled
        return Failed(Status.ERROR, in_a_line(error))
    if isinstance(result, Unstored):
        raise StorageError(result.reason)
    assert isinstance(result, Done | Failed)  # what `Supervisor.run` returns
    return result
