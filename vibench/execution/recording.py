"""The folder of a run, which one run at a time writes into, and what it writes into the results file there."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from vibench import provenance
from vibench.errors import RequestError
from vibench.execution.supervisor import OUT_OF_MEMORY
from vibench.files import locked
from vibench.guardian import ONE_THREAD
from vibench.model.certificates.base import Guarantee
from vibench.plugins.plugin import Plugin
from vibench.qp.status import Status
from vibench.results.database import ResultsDatabase
from vibench.results.pictures import picture_rows
from vibench.results.schema import KEYS
from vibench.results.show import exported_files
from vibench.results.sqlite import FILE, DamagedResultsError, damaged, read_meta, set_aside, study_of
from vibench.stages.artefacts import History, Store
from vibench.stages.base import Row, Stage, value_of
from vibench.stages.calibration import CalibrationStage
from vibench.stages.cell_queries import CellRows
from vibench.stages.pictures import PictureStage
from vibench.stages.timing_rounds import TimedRound, seconds_of_cell, seconds_of_queries
from vibench.study.cells import NO_SUCH_AXIS, Axes, Cell, digest
from vibench.study.parameter_sets import ParameterSet
from vibench.study.spec import Limits, Study

# Files of a run folder: the output of plugins and solvers, and the report of `vibench report`.
LOG, REPORT = "workers.log", "report.html"


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Lock a run folder; a `RequestError` if it is none, cannot be written, or is locked by another run."""
    try:
        if folder.exists() and not folder.is_dir():
            raise RequestError(f"output folder '{folder}' is a file")
        ours = {".lock", damaged(folder / FILE).name, f"{damaged(folder / FILE).name}-wal"}
        if folder.is_dir() and not (folder / FILE).exists() and {path.name for path in folder.iterdir()} - ours:
            raise RequestError(f"output folder '{folder}' is not empty and holds no {FILE}; choose another with --out")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"output folder '{folder}' cannot be written: {error.strerror}") from None
    with locked(folder / ".lock", busy=f"another run writes into '{folder}'"):
        yield


def clear(folder: Path, study: str, note: Callable[[str], None]) -> None:
    """Remove the tables, log and report of an earlier run of a study; refuse the folder of another study."""
    # Other files stay: a user may keep notes there, and figures are removed when they are drawn anew. A results file
    # that cannot be read is kept under another name, which is passed to `note`. Raises a `RequestError` if the folder
    # holds results of another study.
    path = folder / FILE
    try:
        meta = read_meta(path) if path.is_file() else {}
    except DamagedResultsError as error:
        set_aside(path)
        note(f"{error}; it is kept as '{damaged(path)}'")
        meta = {}
    there = study_of(path, meta).get("name") if meta else study
    if there != study:
        raise RequestError(f"'{folder}' holds results of the study '{there}'; --fresh removes only '{study}'")
    for name in (LOG, REPORT, *(f"tables/{file}" for file in exported_files())):
        (folder / name).unlink(missing_ok=True)


def ended_by_smaller_limits(database: ResultsDatabase, limits: Limits) -> set[str]:
    """Keys of the cells that ended, or had a query that ended, at a limit of their study that is larger now."""
    known = {study: json.loads(text) for study, text in database.kept("limits of ").items()}
    ended = set()
    for cell, study, status, reason in database.ends():
        raised = {name for name, value in limits.model_dump().items() if value > known.get(study, {}).get(name, value)}
        late = status == Status.TIMEOUT and raised & {"query_seconds", "cell_seconds"}
        if late or (OUT_OF_MEMORY in reason and "memory_gib" in raised):
            ended.add(cell)
    return ended


@dataclass(frozen=True)
class ResultWriter:
    """Writes the results of the stages of a study, where plugins go by their `labels`."""

    study: Study
    database: ResultsDatabase
    labels: Mapping[Plugin, str]

    @cached_property
    def study_hash(self) -> str:
        return digest(self.study.model_dump(mode="json"))

    def cell(self, cell: Cell, rows: CellRows) -> Row:
        """Write the rows of a cell; returns its row of the cells table as stored."""
        keys = cell_columns(cell)
        row = {"cell": cell.key, **keys, "machine": provenance.machine(), **rows.cell}
        row |= {
            "seed": cell.validation.seed, **_set_columns(cell.validation), "study_hash": self.study_hash,
            "code": cell.code, "threads": int(ONE_THREAD["OMP_NUM_THREADS"]), "definition": cell.definition,
            "versions": json.dumps(provenance.versions(cell.solver), sort_keys=True),
        }  # fmt: skip
        queries = [{"cell": cell.key, **keys, "query": k, **query} for k, query in enumerate(rows.queries)]
        solutions = [{"cell": cell.key, **solution} for solution in rows.solutions]
        outputs = [{"cell": cell.key, **keys, **output} for output in rows.outputs]
        return self.database.write_cell(row, queries, solutions, outputs, rows.parameters)

    def seconds(self, cell: Cell, rows: list[Row], rounds: Sequence[TimedRound], machines: Set[str], lost: str) -> None:
        """Write the seconds of a cell that has its rows; more may follow until it has the column `timing_rounds`."""
        row = self.database.cell(cell.key)
        assert row is not None  # cells are timed only when they have their rows
        own = seconds_of_cell(rows) | {"timing_rounds": None, "timed_rounds": len(rows), "timing_reason": lost}
        if rows:
            own["machine"] = "; ".join(sorted({*row["machine"].split("; "), *machines}))
        keys = {"cell": cell.key, **cell_columns(cell)}
        self.database.write_seconds(cell.key, own, seconds_of_queries(rounds), [keys | row for row in rows])

    def stage(self, stage: Stage, histories: Iterable[History], store: Store) -> None:
        """Write the histories and rows of a stage whose value is stored."""
        keys, rows = axis_columns(stage.axes, self.labels), []
        for history in histories:
            named = {"artefact": stage.key, "stage": history.stage, **keys, "quantity": history.quantity}
            rows.append([named | {"step": history.first_step + k, "value": v} for k, v in enumerate(history.values)])
        if rows:
            self.database.write_histories(rows, partial=stage.partial)
        if isinstance(stage, CalibrationStage):
            self.calibrations(stage, value_of(store, stage))
        if isinstance(stage, PictureStage):
            self.pictures(stage, picture_rows(value_of(store, stage)))

    def calibrations(self, stage: CalibrationStage, rows: Iterable[Row]) -> None:
        """Write the chains of a cell that has its row, or the reason why there are none."""
        row = self.database.cell(stage.cell)
        assert row is not None  # cells are calibrated only when they have their rows
        keys = {"cell": stage.cell, **{name: row[name] for name in KEYS}}
        self.database.replace("calibrations", [keys | one for one in rows], cell=stage.cell)

    def uncalibrated(self) -> set[str]:
        """Keys of the ok cells without chains, in a study with this task."""
        if not self.study.task:
            return set()
        fine = {key for key, (status, _) in self.database.finished().items() if status == Status.OK}
        return fine - {row["cell"] for row in self.database.rows("calibrations")}

    def pictures(self, stage: PictureStage, rows: Iterable[Row]) -> None:
        """Write the pictures of a problem, or the reason why there are none."""
        keys = axis_columns(stage.axes, self.labels)
        self.database.replace("pictures", [keys | {"number": k} | row for k, row in enumerate(rows)], **keys)


def refute(database: ResultsDatabase) -> None:
    """Give cells with bounds the status of a cell of their problem whose bound was refuted: they rest on the same."""
    rows = [row for row in database.rows("cells") if row["bounds"]]
    known = {(row["problem"], row["problem_options"]): row for row in reversed(rows) if row["status"] == Status.REFUTED}
    for row in rows:
        if (first := known.get((row["problem"], row["problem_options"]))) is None:
            continue
        # No table calls a refuted bound certified.
        for table in ("cells", "queries"):
            database.write_columns(row["cell"], {"certificate": Guarantee.REFUTED.value}, table)
        if row["status"] == Status.OK:
            reason = f"as the bounds of cell {first['cell']}: {first['reason']}"
            database.write_columns(row["cell"], {"status": Status.REFUTED.value, "reason": reason})


def cell_columns(cell: Cell) -> dict[str, Any]:
    without = {"dual": NO_SUCH_AXIS, "dual_options": "{}", "primal": NO_SUCH_AXIS, "primal_options": "{}"}
    columns = without | axis_columns(cell.axes, labels_of([cell])) | {
        "formulation": cell.formulation_label, "formulation_options": cell.formulation.options,
        "solver": cell.solver or NO_SUCH_AXIS, "accuracy": cell.accuracy, "assembly": cell.assembly,
        "bounds": int(cell.bounds), "correction": cell.correction,
    }  # fmt: skip
    return {name: columns.get(name) for name in KEYS}


def labels_of(cells: Iterable[Cell]) -> dict[Plugin, str]:
    """Labels of the plugins of a study: those of the first cell with a plugin."""
    labels: dict[Plugin, str] = {}
    for cell in cells:
        for plugin, label in zip((cell.problem, cell.dual, cell.primal), cell.labels, strict=True):
            if plugin is not None:
                labels.setdefault(plugin, label)
    return labels


def _set_columns(parameters: ParameterSet) -> dict[str, Any]:
    return {parameters.role: parameters.label, f"{parameters.role}_options": parameters.options}


def axis_columns(axes: Axes, labels: Mapping[Plugin, str]) -> dict[str, Any]:
    """The key columns of some axes; unset axes have none."""
    columns: dict[str, Any] = {}
    if axes.problem is not None:
        columns |= {"problem": labels[axes.problem], "problem_options": axes.problem.options}
    if axes.training is not None:
        columns |= _set_columns(axes.training)
    for name, plugin in (("dual", axes.dual), ("primal", axes.primal)):
        if plugin is not None:
            columns |= {name: labels[plugin], f"{name}_options": plugin.options}
    for name, stop in (("pod", axes.pod), ("dual", axes.cone)):
        if stop is not None:
            columns |= {f"{name}_tol": stop.tolerance, f"{name}_size": stop.size}
    return columns if axes.primal is None else columns | {"primal_tol": axes.primal_tol}
