"""Files that tests write are not waited for: no test is about a machine that loses its power."""

import os
import sqlite3

from vibench.results import database
from vibench.results.sqlite import Digests


class Unsynced(Digests):
    """What a results file makes of its connection, before the first statement."""

    def __init__(self, db: sqlite3.Connection) -> None:
        db.execute("PRAGMA synchronous=OFF")
        super().__init__(db)


def leave_syncing_to_the_system() -> None:
    """Let the system write files when it likes, in this process and in those that are forked from it."""
    os.fsync = lambda _: None
    database.Digests = Unsynced  # type: ignore[misc]
