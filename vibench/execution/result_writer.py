"""What a run writes into its results file: rows of cells, histories and pictures, with keys and provenance."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from vibench import provenance
from vibench.plugins.plugin import Plugin
from vibench.results.database import ResultsDatabase
from vibench.results.schema import KEYS
from vibench.rounds.timed_seconds import TimedRound, seconds_of_cell, seconds_of_queries
from vibench.stages.base import Row, Stage, value_of
from vibench.stages.judging.cell_goal import CellRows
from vibench.storage.artefacts import History, Store
from vibench.study.cells import NO_SUCH_AXIS, Axes, Cell, digest
from vibench.study.parameter_sets import ParameterSet
from vibench.study.spec import Study


@dataclass(frozen=True)
class ResultWriter:
    """Writes the results of the stages of a study; `labels` are the names of its plugins in the results."""

    study: Study
    database: ResultsDatabase
    labels: Mapping[Plugin, str]

    @cached_property
    def study_hash(self) -> str:
        """What the rows name the study by."""
        return digest(self.study.model_dump(mode="json"))

    def cell(self, cell: Cell, rows: CellRows) -> Row:
        """Write the rows of a cell; returns its own as it is stored."""
        keys = cell_columns(cell)
        row = {"cell": cell.key, **keys, "machine": provenance.machine(), **rows.cell}
        row |= {
            "seed": cell.validation.seed,
            **_set_columns(cell.validation),
            "study_hash": self.study_hash,
            "code": cell.code,
            "threads": 1,
            "versions": json.dumps(provenance.versions(cell.solver), sort_keys=True),
            "definition": cell.definition,
        }
        queries = [{"cell": cell.key, **keys, "query": k, **query} for k, query in enumerate(rows.queries)]
        solutions = [{"cell": cell.key, **solution} for solution in rows.solutions]
        outputs = [{"cell": cell.key, **keys, **output} for output in rows.outputs]
        return self.database.write_cell(row, queries, solutions, outputs, rows.parameters)

    def seconds(
        self,
        cell: Cell,
        rows: Sequence[Row],
        rounds: Sequence[TimedRound],
        machines: Set[str],
        lost: str,
    ) -> None:
        """Write the seconds of a cell that has its rows, of which there may be more; see `timed`."""
        row = self.database.cell(cell.key)
        assert row is not None  # cells are timed when they have their rows
        own = seconds_of_cell(rows) | {"timing_rounds": None, "timed_rounds": len(rows), "timing_reason": lost}
        if rows:
            own["machine"] = "; ".join(sorted({*row["machine"].split("; "), *machines}))
        keys = {"cell": cell.key, **cell_columns(cell)}
        self.database.write_seconds(cell.key, own, seconds_of_queries(rounds), [keys | row for row in rows])

    def timed(self, cell: Cell, asked: int) -> None:
        """Note that a cell has all of its seconds, of at most so many rounds."""
        self.database.write_columns(cell.key, {"timing_rounds": asked})

    def offline(self, cell: Cell, columns: Row) -> None:
        """Write the offline columns of a cell that has its rows."""
        self.database.write_columns(cell.key, columns)

    def stage(self, stage: Stage, histories: Iterable[History], store: Store) -> None:
        """Write the histories and rows of a stage whose value is stored."""
        keys, rows = axis_columns(stage.axes, self.labels), []
        for history in histories:
            named = {"artefact": stage.key, "stage": history.stage, **keys, "quantity": history.quantity}
            rows.append([named | {"step": history.first_step + k, "value": v} for k, v in enumerate(history.values)])
        if rows:
            self.database.write_histories(rows, partial=stage.partial)
        if type(stage).rows is not Stage.rows:  # artefacts are large: read only if rows are made of them
            self._tables(stage, stage.rows(value_of(store, stage)))

    def failure(self, stage: Stage, reason: str) -> None:
        """Write the rows of a stage that failed; those of the cells that need it are written separately."""
        self._tables(stage, stage.failure_rows(reason))

    def _tables(self, stage: Stage, tables: Mapping[str, Sequence[Row]]) -> None:
        keys = axis_columns(stage.axes, self.labels)
        for table, rows in tables.items():
            self.database.replace(table, [keys | row for row in rows], **keys)


def cell_columns(cell: Cell) -> dict[str, Any]:
    """The key columns of a cell."""
    without: dict[str, Any] = {}
    for name, plugin in (("dual", cell.dual), ("primal", cell.primal)):
        without |= {name: NO_SUCH_AXIS, f"{name}_options": "{}"} if plugin is None else {}
    how = {"formulation": cell.formulation_label, "formulation_options": "{}"}
    if cell.formulation is not None:
        how["formulation_options"] = cell.formulation.options
    solved = {"solver": cell.solver or NO_SUCH_AXIS, "accuracy": cell.accuracy, "assembly": cell.assembly}
    columns = axis_columns(cell.axes, labels_of([cell])) | without | how | solved | {"correction": cell.correction}
    return {name: columns.get(name) for name in KEYS}


def labels_of(cells: Iterable[Cell]) -> dict[Plugin, str]:
    """The names of a study's plugins in its results: their labels in the first cell that has them."""
    labels: dict[Plugin, str] = {}
    for cell in cells:
        for plugin, label in zip((cell.problem, cell.dual, cell.primal), cell.labels, strict=True):
            if plugin is not None:
                labels.setdefault(plugin, label)
    return labels


def _set_columns(parameters: ParameterSet) -> dict[str, Any]:
    """Label and options of a parameter set."""
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
