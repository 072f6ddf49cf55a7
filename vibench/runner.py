"""Running a study: stages in worker processes, shared by the cells that need them, every cell ending in a row."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import signal
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Protocol

from pebble import ProcessExpired, ProcessPool

from vibench import plugins, provenance, qp
from vibench.agreement import disagreement_rows
from vibench.assembly import AssemblyStage
from vibench.errors import RequestError
from vibench.journal import FILE, Journal, read_meta, study_of
from vibench.matrix import Cell, digest, expand
from vibench.naming import HistoryNames, cell_columns
from vibench.qp import Status
from vibench.queries import CellRows, QueriesStage
from vibench.stage import Stage
from vibench.stages import enrichment_stage
from vibench.store import ARTEFACTS, History, Store
from vibench.study import Study
from vibench.thresholds import threshold_rows
from vibench.timing import one_thread
from vibench.worker import Done, Failed, initialise, perform


class Observer(Protocol):
    """Who is told how a run goes on."""

    def start(self, cells: int, pending: Sequence[Stage], unavailable: int) -> None:
        """The matrix has so many cells; these stages have to be run, so many cells have a solver that is not there."""

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
    assembly = AssemblyStage(enrichment_stage(cell), cell.assembly, cell.validation, cell.seed)
    return QueriesStage(assembly, cell.solver, cell.accuracy, study.limits.query_seconds)


def run_study(
    study: Study, folder: Path, observer: Observer, *, jobs: int = 1, fresh: bool = False, retry: bool = False
) -> Outcome:
    """Run what is missing of a study's matrix and write every result into its folder.

    Parameters
    ----------
    study
        The checked study.
    folder
        Run folder; earlier results of the same study are continued.
    observer
        Told about progress.
    jobs
        Worker processes; their number changes no result.
    fresh
        Begin from nothing: earlier results and artefacts of this study are removed.
    retry
        Also redo cells that did not end ok.

    Raises
    ------
    RequestError
        If the folder cannot be used.
    """
    cells = expand(study)
    cleared = fresh and _clear(folder, study)
    journal = Journal(folder, identity(study), ours=cleared)
    try:
        finished = journal.finished()
        todo = [cell for cell in cells if _to_do(cell, finished, retry)]
        run = _Run(study, folder, journal, observer, HistoryNames(cells), len(cells))
        interrupted = run.execute(todo, jobs)
        keys = {cell.key for cell in cells}
        rows = tuple(row for row in journal.rows("cells") if row["cell"] in keys)
        everything = journal.rows("cells")
        journal.replace("thresholds", threshold_rows(everything))
        journal.replace(
            "disagreements", disagreement_rows(everything, journal.rows("queries"), journal.rows("solutions"))
        )
    finally:
        journal.close()
    return Outcome(rows, len(cells) - len(rows), interrupted)


def _to_do(cell: Cell, finished: Mapping[str, tuple[str, str]], retry: bool) -> bool:
    status, code = finished.get(cell.key, (None, None))
    if status is None or code != cell.code:
        return True
    return retry and status != Status.OK


def _clear(folder: Path, study: Study) -> bool:
    """Remove a study's earlier results, never those of a study with another name; whether there were any."""
    path = folder / FILE
    if not path.is_file():
        return False
    meta = read_meta(path)
    there = study_of(path, meta).get("name") if meta else study.name
    if there != study.name:
        raise RequestError(f"'{folder}' holds results of the study '{there}'; --fresh removes only '{study.name}'")
    for file in folder.glob(f"{FILE}*"):
        file.unlink()
    for name in (ARTEFACTS, "tables", "figures"):
        shutil.rmtree(folder / name, ignore_errors=True)
    return True


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C waits; processes started meanwhile never see it, for they inherit what is blocked."""
    resource_tracker.ensure_running()  # whose start unblocks the signal
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@dataclass
class _Run:
    """One execution: which stages wait for which, and what to write when they end."""

    study: Study
    folder: Path
    journal: Journal
    observer: Observer
    names: HistoryNames
    cell_count: int
    waiting: dict[str, set[str]] = field(default_factory=dict)
    stages: dict[str, Stage] = field(default_factory=dict)
    reused: set[str] = field(default_factory=set)
    cells: dict[str, list[Cell]] = field(default_factory=dict)

    def execute(self, todo: Sequence[Cell], jobs: int) -> bool:
        """Run the cells; returns whether Ctrl-C ended it."""
        available = set(qp.installed_solvers(plugins.names("QP solver")))
        store = Store(self.folder / ARTEFACTS)
        self.folder.joinpath(ARTEFACTS).mkdir(exist_ok=True)
        for cell in todo:
            if cell.solver in available:
                stage = queries_stage(cell, self.study)
                self.cells.setdefault(stage.key, []).append(cell)
                self._add(stage, store)
        unavailable = [cell for cell in todo if cell.solver not in available]
        self.observer.start(self.cell_count, list(self.stages.values()), len(unavailable))
        for cell in unavailable:
            self._fail_cell(cell, Status.UNAVAILABLE, f"the QP solver '{cell.solver}' is not installed")
        if not self.stages:
            return False
        with one_thread():
            context = multiprocessing.get_context("spawn")
            with _interrupts_held():
                pool = ProcessPool(max_workers=jobs, context=context, initializer=initialise)
                started = pool.active  # asking starts the pool
            try:
                assert started
                self._loop(pool, jobs)
            except KeyboardInterrupt:
                return True
            finally:
                pool.stop()  # type: ignore[no-untyped-call]
                pool.join()
        return False

    def _add(self, stage: Stage, store: Store) -> bool:
        """Plan a stage and what it needs; `True` if it has to be run, `False` if its artefact is there."""
        if stage.key in self.stages:
            return True
        if stage.key in self.reused:
            return False
        artefact = None if isinstance(stage, QueriesStage) else store.get(stage.key)
        if artefact is not None:
            self._write_histories(stage, artefact.histories)
            self.reused.add(stage.key)
            return False
        needed = {needed.key for needed in stage.inputs() if self._add(needed, store)}
        self.stages[stage.key] = stage
        self.waiting[stage.key] = needed
        return True

    def _loop(self, pool: ProcessPool, jobs: int) -> None:
        running: dict[Future[Any], Stage] = {}
        limits = self.study.limits
        while self.waiting or running:
            ready = [key for key, needed in self.waiting.items() if not needed]
            for key in ready[: jobs - len(running)]:
                del self.waiting[key]
                stage = self.stages[key]
                arguments = [str(self.folder / ARTEFACTS), stage, limits.memory_gib]
                running[pool.schedule(perform, args=arguments, timeout=limits.cell_seconds)] = stage
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                self._finish(running.pop(future), self._outcome(future))

    def _outcome(self, future: Future[Any]) -> Done | Failed:
        try:
            result = future.result()
        except TimeoutError:
            return Failed(Status.TIMEOUT, f"stopped after cell_seconds = {self.study.limits.cell_seconds:g} s")
        except ProcessExpired as error:
            return Failed(Status.CRASHED, f"the worker process died with exit code {error.exitcode}")
        assert isinstance(result, Done | Failed)  # what `perform` returns
        return result

    def _finish(self, stage: Stage, outcome: Done | Failed) -> None:
        if isinstance(outcome, Failed):
            self._fail(stage, outcome)
            return
        self.observer.stage(stage, outcome.wall)
        if isinstance(stage, QueriesStage):
            for cell in self.cells[stage.key]:
                self._write(cell, outcome.value)
        else:
            self._write_histories(stage, outcome.histories)
        for needed in self.waiting.values():
            needed.discard(stage.key)

    def _fail(self, stage: Stage, failed: Failed) -> None:
        """Give a row to every cell that needs a stage that failed, and drop what would have followed."""
        if isinstance(stage, QueriesStage):
            for cell in self.cells[stage.key]:
                self._fail_cell(cell, failed.status, failed.reason)
            return
        name = type(stage).__name__.removesuffix("Stage").lower()
        reason = failed.reason if failed.reason.startswith("in ") else f"in {name}: {failed.reason}"
        for key in [key for key, needed in self.waiting.items() if stage.key in needed]:
            if key in self.waiting:
                del self.waiting[key]
                self._fail(self.stages[key], Failed(failed.status, reason))

    def _fail_cell(self, cell: Cell, status: Status, reason: str) -> None:
        row = {"status": status.value, "reason": reason, "queries": cell.validation, "queries_ok": 0}
        self._write(cell, CellRows(row, ()))

    def _write(self, cell: Cell, found: CellRows) -> None:
        keys = cell_columns(cell)
        row = {"cell": cell.key, **keys, **found.cell, **self._provenance(cell)}
        queries = [{"cell": cell.key, **keys, "query": k, **query} for k, query in enumerate(found.queries)]
        self.journal.write_cell(row, queries, [{"cell": cell.key, **solution} for solution in found.solutions])
        self.observer.cell(cell, row)

    def _provenance(self, cell: Cell) -> dict[str, Any]:
        return {
            "seed": cell.seed,
            "study_hash": digest(self.study.model_dump(mode="json")),
            "code": cell.code,
            "machine": provenance.machine(),
            "threads": 1,
            "versions": json.dumps(provenance.versions(cell.solver), sort_keys=True),
            "definition": cell.definition,
        }

    def _write_histories(self, stage: Stage, histories: Iterable[History]) -> None:
        keys = self.names.columns(stage)
        rows = []
        for history in histories:
            first = history.key.get("first_step", 0)
            named = {name: value for name, value in history.key.items() if name != "first_step"}
            rows += [
                {"artefact": stage.key, **named, **keys, "quantity": history.quantity, "step": first + k, "value": v}
                for k, v in enumerate(history.values)
            ]
        if rows:
            self.journal.write_histories(stage.key, rows)
