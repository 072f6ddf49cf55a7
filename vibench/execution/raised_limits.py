"""Cells that ended by a limit of their study which is larger now: these are run again."""

from __future__ import annotations

import json

from vibench.execution.jobs import OUT_OF_MEMORY
from vibench.qp.status import Status
from vibench.results.database import ResultsDatabase
from vibench.study.spec import Limits

SECONDS = {"query_seconds", "cell_seconds"}
"""Limits that end with the status `timeout`."""

LIMITS = "limits of "
"""Beginning of the keys of `meta` under which the limits of a study are, by its hash."""


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
