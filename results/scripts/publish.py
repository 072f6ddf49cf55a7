"""Publish the results of this folder, and those of other machines, as a static site.

python results/scripts/publish.py SITE

The tables that the pages show are put into results files again: cells, break-even and disagreements, with the six
digits that are committed. Tables of all queries are not committed, so that reports have no figures of queries; on the
page of every run stands the command that makes them.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import pandas as pd
from page import start

from vibench.execution.recording import cell_columns
from vibench.model.bound_terms import CorrectionMode
from vibench.report.citation import Citation
from vibench.report.site import publish
from vibench.results.database import ResultsDatabase
from vibench.results.schema import KEYS, STORED, SqlType
from vibench.results.sqlite import FILE
from vibench.study.matrix import expand, read_study

RESULTS = Path(__file__).parents[1]
OTHERS = "machines/*/*/cells.csv"
"""Studies that were run on other machines, too."""

CITATION = Citation(
    "vibench: results of the reduced-order models of the paper and of the field",
    ("The vibench developers",),
    date="2026",
)


def main(site: str) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        tables = [table.parent for table in sorted(RESULTS.glob("*/cells.csv")) + sorted(RESULTS.glob(OTHERS))]
        files = {restore(folder, Path(scratch) / folder.relative_to(RESULTS)): folder for folder in tables}
        notes = {
            file: f"made of the tables in results/{folder.relative_to(RESULTS)}, with six digits and without queries; "
            f"`vibench run {folder.name}` makes all of it"
            for file, folder in files.items()
        }
        print(publish(list(files), Path(site), CITATION, notes))


def restore(tables: Path, folder: Path) -> Path:
    """Write a results file of committed tables into a folder; columns that were added after them are empty."""
    cells = rows(tables / "cells.csv")
    if "definition" not in cells[0]:  # left out of a large table: the study says the same
        definitions = {identity_of(cell_columns(cell)): cell.definition for cell in expand(read_study(tables.name))}
        cells = [row | {"definition": definitions[identity_of(row)]} for row in cells]
    identity = {"name": tables.name, "seed": int(cells[0]["seed"]), "validation": int(cells[0]["queries"])}
    database = ResultsDatabase(folder, identity)
    try:
        for row in cells:
            database.write_cell(stored("cells", row), ())
        for name in ("thresholds", "disagreements"):
            if (tables / f"{name}.csv").exists():
                database.replace(name, [stored(name, row) for row in rows(tables / f"{name}.csv")])
    finally:
        database.close()
    return folder / FILE


def identity_of(row: dict[str, Any]) -> tuple[str, ...]:
    """The values that tell a cell of a study from the others: keys of cells depend on the version of vibench."""
    values = (row.get(name) for name in KEYS if name not in {"cell", "bounds"} and not name.endswith("_options"))
    return tuple("" if value is None else f"{value:g}" if isinstance(value, float) else str(value) for value in values)


def rows(table: Path) -> list[dict[str, Any]]:
    """Rows of a CSV table; what is empty is missing, and a text such as a hash may look like a number."""
    texts = {name: str for name, column in STORED[table.stem].items() if column.kind == SqlType.TEXT}
    frame = pd.read_csv(table, keep_default_na=False, na_values=[""], dtype=texts)
    return [
        {str(name): None if pd.isna(value) else value for name, value in row.items()}
        for row in frame.to_dict("records")
    ]


def stored(table: str, row: dict[str, Any]) -> dict[str, Any]:
    """The columns of a row that the results file has; cells of before there were corrections have none."""
    uncorrected = {name: CorrectionMode.NONE for name in ("correction",) if name in STORED[table]}
    return uncorrected | {name: value for name, value in row.items() if name in STORED[table]}


if __name__ == "__main__":
    start(main)
