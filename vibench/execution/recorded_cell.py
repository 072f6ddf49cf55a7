"""A recorded cell brought back to life: its reduced model, from artefacts, or made again where they are gone."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.execution.supervisor import Job, Supervisor
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.validation import validation_parameters
from vibench.results import tables
from vibench.results.tables import results_file
from vibench.stages.artefacts import Store, usable_store
from vibench.stages.assembly import Model, assembly_stage
from vibench.stages.base import Done, Stage
from vibench.study.cells import Cell

UNLIMITED = (1e6, 1e6, 1e6)
"""Limits of stages that are made again: they went well before."""


@dataclass(frozen=True)
class RecordedCell:
    """One row of the cells table, and what leads from it to its reduced model.

    Attributes
    ----------
    path
        The results file.
    row
        The row.
    """

    path: Path
    row: Mapping[str, Any]

    @cached_property
    def cell(self) -> Cell:
        """What the study asked for."""
        return Cell.from_definition(self.row["definition"])

    @cached_property
    def model(self) -> Model:
        """The reduced model; stages whose artefacts are gone are run again.

        Raises
        ------
        RequestError
            If the row was made by other code: the model of today would be another one.
        """
        if self.cell.code != self.row["code"]:
            raise RequestError(
                f"cell {self.row['cell']} was computed by other code, or with another version of its solver; "
                "run its study again"
            )
        store, assembly = usable_store(), assembly_stage(self.cell)
        for stage in assembly.model_inputs:
            _provide(stage, store)
        return assembly.model(store)[0]

    @cached_property
    def parameters(self) -> Array:
        """The validation parameters (queries×d)."""
        return validation_parameters(self.model.problem, self.cell.validation, self.cell.seed)

    def program(self, query: int) -> VariationalInequality:
        """The reduced quadratic program of one query, exactly as it was solved."""
        return self.model.assemble(self.parameters[query]).program

    def rows(self, table: str) -> dict[int, dict[str, Any]]:
        """The cell's rows of the queries or the solutions table, by query."""
        with closing(sqlite3.connect(self.path)) as db:
            cursor = db.execute(f"SELECT * FROM {table} WHERE cell = ?", (self.row["cell"],))
            names = [column[0] for column in cursor.description]
            found = [dict(zip(names, row, strict=True)) for row in cursor]
        return {int(row["query"]): row for row in found}


def _provide(stage: Stage, store: Store) -> None:
    """Make sure that the artefact of a stage is in the store, made as a run would make it.

    Raises
    ------
    RequestError
        If it cannot be made.
    """
    missing: dict[str, Stage] = {}
    _collect(stage, store, missing)
    keeper = Supervisor()
    try:
        with store.used():
            for needed in missing.values():
                outcome = keeper.run(Job(str(store.folder), needed, *UNLIMITED))
                if not isinstance(outcome, Done):
                    raise RequestError(f"what the cell needs cannot be made again: {outcome.reason}")
    finally:
        keeper.close()


def _collect(stage: Stage, store: Store, missing: dict[str, Stage]) -> None:
    """Add a stage and what it needs, if they are not in the store, in the order in which they are to be run."""
    if stage.key not in missing and store.get(stage.key) is None:
        for needed in stage.inputs():
            _collect(needed, store, missing)
        missing[stage.key] = stage


def recorded_cells(run: str) -> list[RecordedCell]:
    """All cells of a run that have a reduced model.

    Raises
    ------
    RequestError
        If there is no such run.
    """
    path = results_file(run)
    rows = tables.read(path, "cells").to_dict("records")
    return [RecordedCell(path, row) for row in rows if row["model"]]


def recorded_cell(run: str, cell: str) -> RecordedCell:
    """One cell of a run, by its key or by as much of its beginning as no other has.

    Raises
    ------
    RequestError
        If no cell, or more than one, begins like that, or the cell failed before it had a reduced model.
    """
    path = results_file(run)
    rows = tables.read(path, "cells").to_dict("records")
    matching = [row for row in rows if str(row["cell"]).startswith(cell)]
    if len(matching) != 1:
        known = "the column 'cell' of `vibench show RUN --table cells` lists them"
        raise RequestError(f"{len(matching)} cells of '{run}' begin with '{cell}', expected one; {known}")
    if not matching[0]["model"]:
        raise RequestError(f"cell {matching[0]['cell']} has no reduced model: {matching[0]['reason']}")
    return RecordedCell(path, matching[0])


def load(run: str, cell: str) -> Model:
    """The reduced model of a row of a run, ready for queries.

    Parameters
    ----------
    run
        Run folder, or name of a study run before.
    cell
        Key of the cell, or its beginning.

    Raises
    ------
    RequestError
        If there is no such run or cell, or other code computed it.
    """
    return recorded_cell(run, cell).model
