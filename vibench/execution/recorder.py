"""What a run leaves in its results file: rows of cells, histories and pictures, with where they come from."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from vibench import provenance
from vibench.execution.row_keys import HistoryNames, cell_columns
from vibench.results import pictures
from vibench.results.database import ResultsDatabase
from vibench.stages.artefacts import History, Store
from vibench.stages.base import Stage, value_of
from vibench.stages.cell_queries import CellRows
from vibench.stages.pictures import PictureStage
from vibench.stages.snapshots import HighFidelity
from vibench.study.cells import Cell, digest
from vibench.study.spec import Study


@dataclass(frozen=True)
class Recorder:
    """Writes what the stages of a study give."""

    study: Study
    journal: ResultsDatabase
    names: HistoryNames

    def cell(self, cell: Cell, found: CellRows) -> dict[str, Any]:
        """Write the rows of a cell; gives its own."""
        keys = cell_columns(cell)
        row = {"cell": cell.key, **keys, "machine": provenance.machine(), **found.cell, **self._provenance(cell)}
        queries = [{"cell": cell.key, **keys, "query": k, **query} for k, query in enumerate(found.queries)]
        self.journal.write_cell(row, queries, [{"cell": cell.key, **solution} for solution in found.solutions])
        return row

    def stage(self, stage: Stage, histories: Iterable[History], store: Store) -> None:
        """Write what is to be kept of any other stage."""
        self._histories(stage, histories)
        if isinstance(stage, PictureStage):
            self.journal.write_pictures(pictures.rows(self.names.columns(stage), value_of(store, stage)))

    def no_picture(self, stage: PictureStage, reason: str) -> None:
        """Write why there is no picture of a problem."""
        self.journal.write_pictures(pictures.missing(self.names.columns(stage), reason))

    def _provenance(self, cell: Cell) -> dict[str, Any]:
        return {
            "seed": cell.seed,
            "study_hash": digest(self.study.model_dump(mode="json")),
            "code": cell.code,
            "threads": 1,
            "versions": json.dumps(provenance.versions(cell.solver), sort_keys=True),
            "definition": cell.definition,
        }

    def _histories(self, stage: Stage, histories: Iterable[History]) -> None:
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
            self.journal.write_histories(stage.key, rows, parts=isinstance(stage, HighFidelity))
