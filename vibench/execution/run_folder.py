"""The folder of a run: one run at a time writes into it, a fresh run removes, larger limits run cells again."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path

from vibench.errors import RequestError
from vibench.execution.jobs import OUT_OF_MEMORY
from vibench.files import locked
from vibench.qp.status import Status
from vibench.results.database import ResultsDatabase
from vibench.results.show import EXPORTED
from vibench.results.sqlite import (
    DAMAGED,
    FILE,
    WRITE_AHEAD_LOG,
    DamagedResultsError,
    read_meta,
    set_aside,
    study_of,
)
from vibench.study.spec import Limits

LOCK = ".lock"
"""Lock file, held during a run."""

LOG = "workers.log"
"""File for the output of plugins and solvers."""

REPORT = "report.html"
"""File that `vibench report` writes unless told otherwise."""


SECONDS = {"query_seconds", "cell_seconds"}
"""Limits that end with the status `timeout`."""

LIMITS = "limits of "
"""Beginning of the keys of `meta` under which the limits of a study are, by its hash."""


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Lock a run folder, which is created if it does not exist.

    Raises
    ------
    RequestError
        If the folder is a file, holds files but no results file, cannot be written, or is locked by another run.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise RequestError(f"output folder '{folder}' is a file")
        ours = {LOCK, FILE + DAMAGED, FILE + DAMAGED + WRITE_AHEAD_LOG}
        if folder.is_dir() and not (folder / FILE).exists() and {path.name for path in folder.iterdir()} - ours:
            raise RequestError(f"output folder '{folder}' is not empty and holds no {FILE}; choose another with --out")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"output folder '{folder}' cannot be written: {error.strerror}") from None
    with locked(folder / LOCK, busy=f"another run writes into '{folder}'"):
        yield


def clear(folder: Path, study: str, note: Callable[[str], None]) -> None:
    """Remove the tables, log and report of an earlier run of a study; refuse the folder of another study.

    Nothing else: a user may keep notes beside them. Figures are removed when they are drawn anew. A results file that
    cannot be read is kept under another name, of which `note` is told.

    Raises
    ------
    RequestError
        If the folder holds results of another study.
    """
    path = folder / FILE
    try:
        meta = read_meta(path) if path.is_file() else {}
    except DamagedResultsError as error:
        set_aside(path)
        note(f"{error}; it is kept as '{path}{DAMAGED}'")
        meta = {}
    there = study_of(path, meta).get("name") if meta else study
    if there != study:
        raise RequestError(f"'{folder}' holds results of the study '{there}'; --fresh removes only '{study}'")
    for name in (LOG, REPORT, *(f"tables/{file}" for file in EXPORTED)):
        (folder / name).unlink(missing_ok=True)


def ended_by_smaller_limits(database: ResultsDatabase, limits: Limits) -> set[str]:
    """Keys of the cells that a limit ended, or a query of which, where that limit was smaller than it is now.

    Rows name the study that they are of by its hash; of a hash without known limits none is said to be raised.
    """
    known = {study: json.loads(text) for study, text in database.kept(LIMITS).items()}
    found = set()
    for cell, study, status, reason in database.ends():
        raised = {name for name, value in limits.model_dump().items() if value > known.get(study, {}).get(name, value)}
        if (status == Status.TIMEOUT and raised & SECONDS) or (OUT_OF_MEMORY in reason and "memory_gib" in raised):
            found.add(cell)
    return found


def keep_limits(database: ResultsDatabase, study: str, limits: Limits) -> None:
    """Keep the limits of the study with this hash in its results file."""
    database.keep(LIMITS + study, limits.model_dump_json())
