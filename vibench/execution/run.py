"""Running a study: stages in worker processes, shared by the cells that need them, every cell ending in a row."""

from __future__ import annotations

import shutil
import signal
import threading
from collections.abc import Mapping, Sequence, Set
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from vibench.errors import RequestError, StorageError, VibenchError, in_a_line
from vibench.execution.dask import Dask
from vibench.execution.executors import Executor, Local
from vibench.execution.graph import Plan
from vibench.execution.recorder import Recorder
from vibench.execution.row_keys import HistoryNames
from vibench.execution.supervisor import Job
from vibench.qp.solve import installed_solvers
from vibench.qp.status import Status
from vibench.results.break_even import break_even_rows
from vibench.results.database import FILE, ResultsDatabase, claimed, read_meta, study_of
from vibench.results.solver_agreement import disagreement_rows
from vibench.stages.artefacts import Store, usable_store
from vibench.stages.assembly import assembly_stage
from vibench.stages.base import Done, Failed, PiecewiseStage, Stage, Unstored
from vibench.stages.cell_queries import CellRows, QueriesStage
from vibench.stages.pictures import PictureStage
from vibench.study import registry
from vibench.study.cells import Cell, expand
from vibench.study.spec import Study

LOOK = 5.0
"""Seconds between two looks at whether the executor is still there."""

REPORT = "report.html"
"""File in the run folder that `vibench report` writes unless told otherwise."""

LOG = "workers.log"
"""File in the run folder that takes what plugins and solvers print."""


class Observer(Protocol):
    """Who is told how a run goes on."""

    def start(self, cells: int, pending: Sequence[Stage], unavailable: int, workers: int) -> None:
        """Of so many cells these stages have to be run, on so many workers; so many have a solver that is not there."""

    def stage(self, stage: Stage, wall: float) -> None:
        """A stage is done, after so many wall seconds."""

    def cell(self, cell: Cell, row: Mapping[str, Any]) -> None:
        """A cell has its row."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended: rows of all cells of the matrix, and whether it was interrupted."""

    rows: tuple[dict[str, Any], ...]
    missing: int
    interrupted: bool


def identity(study: Study) -> dict[str, Any]:
    """What all numbers of a study depend on; results of another identity do not go into the same folder."""
    return {"name": study.name, "seed": study.seed, "validation": study.validation, "accuracy": study.accuracy}


def queries_stage(cell: Cell, study: Study) -> QueriesStage:
    """The last stage of a cell; its inputs lead to all others."""
    return QueriesStage(assembly_stage(cell), cell.solver, cell.accuracy, study.limits.query_seconds, cell.warm_start)


@dataclass(frozen=True)
class Options:
    """How a study is run; none of it changes a number besides times.

    Attributes
    ----------
    jobs
        Worker processes.
    fresh
        Begin from nothing: earlier results of this study are removed, artefacts are made anew.
    retry
        Also redo cells that did not end ok.
    executor
        "local" or "dask".
    scheduler
        Address of a dask scheduler; `None` for a cluster on this machine.
    """

    jobs: int = 1
    fresh: bool = False
    retry: bool = False
    executor: str = "local"
    scheduler: str | None = None


def run_study(study: Study, folder: Path, observer: Observer, options: Options = Options()) -> Outcome:
    """Run what is missing of a study's matrix and write every result into its folder.

    Parameters
    ----------
    study
        The checked study.
    folder
        Run folder; earlier results of the same study are continued.
    observer
        Told about progress.
    options
        How to run it.

    Raises
    ------
    RequestError
        If the folder, the store of artefacts or the executor cannot be used.
    StorageError
        If something cannot be written; what was written before is kept.
    """
    cells, store = expand(study), usable_store()
    with claimed(folder), store.used():
        if options.fresh:
            _clear(folder, study)
        journal = ResultsDatabase(folder, identity(study), anew=options.fresh)
        try:
            finished = journal.finished()
            todo = [cell for cell in cells if _to_do(cell, finished, options.retry)]
            recorder = Recorder(study, journal, HistoryNames(cells))
            run = _Run(study, folder, store, recorder, observer, len(cells), options)
            interrupted = run.execute(todo)
            keys = {cell.key for cell in cells}
            everything = journal.rows("cells")
            journal.replace("thresholds", break_even_rows(everything))
            journal.replace(
                "disagreements", disagreement_rows(everything, journal.rows("queries"), journal.rows("solutions"))
            )
        finally:
            journal.close()
    rows = tuple(row for row in everything if row["cell"] in keys)
    return Outcome(rows, len(cells) - len(rows), interrupted)


def _to_do(cell: Cell, finished: Mapping[str, tuple[str, str]], retry: bool) -> bool:
    status, code = finished.get(cell.key, (None, None))
    if status is None or code != cell.code:
        return True
    return retry and status != Status.OK


def _clear(folder: Path, study: Study) -> None:
    """Remove what follows from a study's earlier results, never of those of a study with another name."""
    path = folder / FILE
    meta = read_meta(path) if path.is_file() else {}
    there = study_of(path, meta).get("name") if meta else study.name
    if there != study.name:
        raise RequestError(f"'{folder}' holds results of the study '{there}'; --fresh removes only '{study.name}'")
    for name in ("tables", "figures"):
        shutil.rmtree(folder / name, ignore_errors=True)
    for name in (LOG, REPORT):
        (folder / name).unlink(missing_ok=True)


@dataclass
class _Run:
    """One execution: which stages wait for which, and what to write when they end."""

    study: Study
    folder: Path
    store: Store
    recorder: Recorder
    observer: Observer
    cell_count: int
    options: Options
    plan: Plan = field(default_factory=Plan)
    cells: dict[str, list[Cell]] = field(default_factory=dict)

    def execute(self, todo: Sequence[Cell]) -> bool:
        """Run the cells; returns whether Ctrl-C ended it."""
        available = set(installed_solvers(registry.names("QP solver")))
        unavailable = [cell for cell in todo if cell.solver not in available]
        runnable = [cell for cell in todo if cell.solver in available]
        workers: Executor | None = None
        try:
            workers = self._workers() if runnable else None
            for cell in runnable:
                assert workers is not None
                stage = queries_stage(cell, self.study)
                self.cells.setdefault(stage.key, []).append(cell)
                for goal in (stage, PictureStage(cell.problem)):
                    self.plan.add_goal(goal, partial(self._is_there, workers.machines))
            slots = workers.slots if workers is not None else 0
            self.observer.start(self.cell_count, list(self.plan.stages.values()), len(unavailable), slots)
            for cell in unavailable:
                self._fail_cell(cell, Status.UNAVAILABLE, f"the QP solver '{cell.solver}' is not installed")
            if workers is not None:
                self._loop(workers)
        except KeyboardInterrupt:
            _deaf()
            return True
        finally:
            if workers is not None:
                workers.close()
        return False

    def _workers(self) -> Executor:
        options = self.options
        log = self.folder / LOG
        if options.executor == "dask":
            return Dask(options.scheduler, options.jobs, self.store.folder)
        return Local(options.jobs, log)

    def _is_there(self, machines: Set[str], stage: Stage) -> bool:
        """Whether a stage's artefact can be reused; its histories are written if so.

        Seconds count only where they were measured: an artefact of another machine is made anew.
        """
        if self.options.fresh or isinstance(stage, PiecewiseStage):
            return False
        artefact = self.store.get(stage.key)
        if artefact is None or artefact.machine not in machines:
            return False
        self.recorder.stage(stage, artefact.histories, self.store)
        return True

    def _loop(self, workers: Executor) -> None:
        running: dict[Future[Any], Stage] = {}
        limits = self.study.limits
        while self.plan.waiting or running:
            for stage in self.plan.begin(workers.slots - len(running)):
                job = Job(str(self.store.folder), stage, limits.query_seconds, limits.cell_seconds, limits.memory_gib)
                running[workers.submit(job)] = stage
            done, _ = wait(running, timeout=LOOK, return_when=FIRST_COMPLETED)
            workers.check()
            for future in done:
                self._finish(running.pop(future), _outcome(future))

    def _finish(self, stage: Stage, outcome: Done | Failed) -> None:
        if isinstance(outcome, Failed):
            self._fail(stage, outcome)
            return
        self.observer.stage(stage, outcome.wall)
        if isinstance(stage, QueriesStage):
            for cell in self.cells[stage.key]:
                self.observer.cell(cell, self.recorder.cell(cell, outcome.value))
        else:
            self.recorder.stage(stage, outcome.histories, self.store)
        self.plan.done(stage)

    def _fail(self, stage: Stage, failed: Failed) -> None:
        """Give a row to every cell that needs a stage that failed."""
        if isinstance(stage, PictureStage):
            self.recorder.no_picture(stage, failed.reason)
            self.plan.done(stage)
            return
        if isinstance(stage, QueriesStage):
            without, reason = [stage], failed.reason
        else:
            without = [goal for goal in self.plan.lost(stage) if isinstance(goal, QueriesStage)]
            reason = f"in {type(stage).__name__.removesuffix('Stage').lower()}: {failed.reason}"
        for goal in without:
            for cell in self.cells[goal.key]:
                self._fail_cell(cell, failed.status, reason)

    def _fail_cell(self, cell: Cell, status: Status, reason: str) -> None:
        row = {"status": status.value, "reason": reason, "queries": cell.validation, "queries_ok": 0}
        self.observer.cell(cell, self.recorder.cell(cell, CellRows(row, ())))


def _outcome(future: Future[Any]) -> Done | Failed:
    try:
        result = future.result()
    except VibenchError:
        raise
    except Exception as error:  # noqa: BLE001  a stage or a result that does not travel between processes
        return Failed(Status.ERROR, in_a_line(error))
    if isinstance(result, Unstored):
        raise StorageError(result.reason)
    assert isinstance(result, Done | Failed)  # what `Keeper.run` returns
    return result


def _deaf() -> None:
    """From now on Ctrl-C is not heard: the bookkeeping is finished, then the process ends."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
