"""The folder of a run: what lies in it, that one run at a time writes into it, and what a fresh run removes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from vibench.errors import RequestError
from vibench.files import locked
from vibench.results.sqlite.reading import (
    DAMAGED,
    FILE,
    WRITE_AHEAD_LOG,
    DamagedResultsError,
    read_meta,
    set_aside,
    study_of,
)
from vibench.results.tables import EXPORTED

LOCK = ".lock"
"""Lock file, held during a run."""

LOG = "workers.log"
"""File for the output of plugins and solvers."""

REPORT = "report.html"
"""File that `vibench report` writes unless told otherwise."""


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
