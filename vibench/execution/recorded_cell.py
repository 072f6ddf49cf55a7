"""A recorded cell and its reduced model, loaded from artefacts, or computed again where these are missing."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.execution.graph import Graph
from vibench.execution.isolated import recall_reads
from vibench.execution.supervisor import Job, Supervisor
from vibench.interfaces.problem import VariationalInequality
from vibench.offline.models import Model
from vibench.plugins.plugin import Plugin
from vibench.results.read import read_table, results_file
from vibench.results.selection import key_of
from vibench.results.sqlite import read_meta, read_rows, study_of
from vibench.stages.artefacts import Store, usable_store
from vibench.stages.base import Done, Stage
from vibench.stages.cell_queries import cell_queries
from vibench.study.cells import Cell
from vibench.study.matrix import study_of_cell
from vibench.study.spec import Study


@dataclass(frozen=True)
class RecordedCell:
    """One row of the cells table of a results file, and the reduced model that it was computed with.

    `places` are the paths of files and folders of its plugins, by their names in results, where these were moved.
    """

    path: Path
    row: Mapping[str, Any]
    places: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def cell(self) -> Cell:
        cell = Cell.from_definition(self.row["definition"], self.places)
        given = [one for one in cell.plugins if one.is_given]
        known = bool(given) and recall_reads(given, usable_store())
        return Cell.from_definition(self.row["definition"], self.places) if known else cell

    @cached_property
    def model(self) -> Model:
        """The model, with its bounds; raises a `RequestError` if other code computed the row."""
        if self.cell.code != self.row["code"]:
            others = "by other code, with another version of its solver, or from files that were changed since"
            raise RequestError(f"cell {self.row['cell']} was computed {others}; run its study again")
        return replace(cell_model(self.cell), row=self.row)

    @cached_property
    def parameters(self) -> Array:
        return self.cell.validation.of(self.model.problem)

    def program(self, query: int) -> VariationalInequality:
        """The reduced quadratic program of one query, exactly as it was solved."""
        return self.model.reduced.assemble(self.parameters[query]).program

    def rows(self, table: str) -> dict[int, dict[str, Any]]:
        names, rows = read_rows(self.path, table, (self.row["cell"],))
        return {int(row["query"]): row for row in (dict(zip(names, row, strict=True)) for row in rows)}


def cell_model(cell: Cell) -> Model:
    """The model of a cell, with its bounds; stages without artefacts are run."""
    store, queries = usable_store(), cell_queries(cell, query_seconds=1e6)
    certificate, built = queries.certificate, queries.built
    _provide((*built.model_inputs, *(() if certificate is None else (certificate.base, certificate))), store)
    return queries.bounded_model(store)


def _provide(stages: Iterable[Stage], store: Store) -> None:
    """Run stages without artefacts, and their inputs, in a supervised process; a `RequestError` if one fails."""
    graph = Graph()
    for stage in stages:
        graph.add_goal(stage, lambda needed: store.get(needed.key) is not None)
    with closing(Supervisor()) as supervisor, store.used():
        # In the order of the plan inputs come first.
        for stage in graph.stages.values():
            # The stages succeeded before: these limits (seconds, seconds, GiB) only need to be large.
            outcome = supervisor.run(Job(str(store.folder), stage, 1e6, 1e6, 1e6))
            if not isinstance(outcome, Done):
                raise RequestError(f"{stage.label}, a stage of the cell, failed when run again: {outcome.reason}")


def _rows(run: str) -> tuple[Path, list[dict[str, Any]]]:
    path = results_file(run)
    rows = [{str(name): value for name, value in row.items()} for row in read_table(path, "cells").to_dict("records")]
    for row in rows:
        # Keys name files: one from a stranger's results file must not lead elsewhere.
        if not re.fullmatch(r"[0-9a-f]{16}", str(row["cell"])):
            raise RequestError(f"'{path}' has a cell named {str(row['cell'])[:60]!a}, expected 16 hexadecimal digits")
    return path, rows


def recorded_cells(run: str, places: Mapping[str, str] = {}) -> list[RecordedCell]:
    """All cells with quadratic programs of a run; a `RequestError` if there is no such run."""
    path, rows = _rows(run)
    return [RecordedCell(path, row, places) for row in rows if row["model"] and _has_program(row["definition"])]


def _has_program(definition: str) -> bool:
    # Before all formulations were plugins, cells without one had programs.
    recorded = json.loads(definition).get("formulation")
    if recorded is None:
        return True
    plugin = Plugin(**recorded).registered
    return bool(plugin.entries and not plugin.conflict and plugin.load().has_program)


def recorded_cell(run: str, cell: str, places: Mapping[str, str] = {}) -> RecordedCell:
    """One cell with a reduced model, by a unique prefix of its key; a `RequestError` if there is none or several."""
    recorded = _matching(run, cell, places)
    if not recorded.row["model"]:
        raise RequestError(f"cell {recorded.row['cell']} has no reduced model: {recorded.row['reason']}")
    return recorded


def recorded_study(run: str, cell: str, places: Mapping[str, str] = {}) -> Study:
    """The study of one cell of a run alone; a `RequestError` if its plugins are others here, or the prefix is wrong."""
    recorded = _matching(run, cell, places)
    name = str(study_of(recorded.path, read_meta(recorded.path)).get("name"))
    rounds = recorded.row["timing_rounds"]
    settings = {} if pd.isna(rounds) else {"timing_rounds": int(rounds)}
    try:
        definition = recorded.cell
    # The file may come from a stranger, who may have written anything.
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        what = f"the definition of cell {recorded.row['cell']} cannot be read"
        raise RequestError(f"'{recorded.path}': {what}") from error
    return study_of_cell(definition, name, **settings)


def _matching(run: str, cell: str, places: Mapping[str, str]) -> RecordedCell:
    path, rows = _rows(run)
    by_key = {str(row["cell"]): row for row in rows}
    return RecordedCell(path, by_key[key_of(cell, by_key, run)], places)
