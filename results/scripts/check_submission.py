"""Checks a site that `vibench publish` wrote, as it comes with a submission of results: what it misses, line by line.

python results/scripts/check_submission.py SITE

Everything is read as data; nothing that the site contains is run. The exit code is 1 if anything is missing or wrong.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
from page import start

from vibench.errors import VibenchError
from vibench.provenance import PROTOCOL
from vibench.qp.status import Status
from vibench.report.differences import ComparedRun
from vibench.results import consistency
from vibench.results.read import read_table
from vibench.results.sqlite import FILE

FILES = ("index.html", "CITATION.cff", "citation.bib")
OF_RUN = (FILE, "provenance.json", "requirements.txt", "index.html")
"""Files of a site, and of each of its runs."""


def main(site: str) -> None:
    lines = list(faults(Path(site)))
    for line in lines:
        print(line)
    if lines:
        sys.exit(1)
    print(f"{site}: nothing is missing")


def faults(site: Path) -> Iterator[str]:
    """A line for everything that is missing or wrong."""
    yield from (f"{name} is missing" for name in FILES if not (site / name).is_file())
    folders = sorted(path for path in (site / "runs").glob("*") if path.is_dir())
    if not folders:
        yield "there are no runs in the folder runs"
    for folder in folders:
        yield from (f"{folder.name}: {line}" for line in of_run(folder))


def of_run(folder: Path) -> Iterator[str]:
    """What is wrong with one run."""
    missing = [name for name in OF_RUN if not (folder / name).is_file()]
    yield from (f"{name} is missing" for name in missing)
    if FILE in missing:
        return
    try:
        run = ComparedRun(folder / FILE, folder.name)
        cells, queries = read_table(folder / FILE, "cells"), read_table(folder / FILE, "queries")
    except (VibenchError, OSError) as error:
        yield f"{FILE}: {error}"
        return
    yield from of_cells(cells)
    yield from of_queries(queries, cells.set_index("cell")["enrichment_kind"])
    if "provenance.json" not in missing:
        yield from of_provenance(folder / "provenance.json", run)
    yield from of_tables(folder, cells)


def of_cells(cells: pd.DataFrame) -> Iterator[str]:
    """Machine, versions, code and rounds of the cells."""
    if not len(cells):
        yield "it has no cells"
    measured = cells[cells["status"] != Status.UNAVAILABLE]
    for name in ("machine", "versions", "code", "definition", "seed"):
        if measured[name].isna().any():
            yield f"{int(measured[name].isna().sum())} cells have no {name}"
    protocols = {json.loads(text).get("protocol", "none") for text in measured["versions"].dropna()}
    if protocols - {PROTOCOL}:
        yield f"it was measured by protocol {', '.join(sorted(protocols))}, expected {PROTOCOL}"
    ok = measured[measured["status"] == Status.OK]
    if (ok["timing_rounds"].fillna(0) == 0).any():
        yield f"{int((ok['timing_rounds'].fillna(0) == 0).sum())} cells that are ok were never timed"


def of_queries(queries: pd.DataFrame, kinds: pd.Series) -> Iterator[str]:
    """Residuals of what is ok, and the invariants of the constants and the error bounds."""
    ok = queries[queries["status"] == Status.OK]
    for name in ("primal_residual", "dual_residual", "gap"):
        above = ok[~(ok[name] <= ok["accuracy"])]
        if len(above):
            yield f"{len(above)} queries are ok with a {name} above the accuracy"
    yield from map(str, consistency.violations(queries, kinds))


def of_provenance(path: Path, run: ComparedRun) -> Iterator[str]:
    """Whether the provenance for programs is that of the results file."""
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        yield f"{path.name}: {error}"
        return
    if said.get("versions") != run.versions:
        yield f"{path.name} has other versions than {FILE}"


def of_tables(folder: Path, cells: pd.DataFrame) -> Iterator[str]:
    """Whether the numbers of the CSV of cells are those of the results file."""
    path = folder / "tables" / "cells.csv"
    if not path.is_file():
        yield "tables/cells.csv is missing"
        return
    written = pd.read_csv(path).set_index("cell")
    if set(written.index) != set(cells["cell"]):
        yield "tables/cells.csv has other cells than the results file"
        return
    stored = cells.set_index("cell").loc[written.index]
    for name in stored.select_dtypes("number").columns.intersection(written.columns):
        pairs = zip(written[name], stored[name], strict=True)
        if not all(_equal(one, other) for one, other in pairs):
            yield f"tables/cells.csv has other values of {name} than the results file"


def _equal(one: float, other: float) -> bool:
    missing = pd.isna(one), pd.isna(other)
    return all(missing) if any(missing) else math.isclose(float(one), float(other), rel_tol=1e-5)


if __name__ == "__main__":
    start(main)
