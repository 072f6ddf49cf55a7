"""Locks between processes: a file that somebody holds, and who."""

from __future__ import annotations

import contextlib
import fcntl
import os
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from vibench.errors import RequestError


@contextlib.contextmanager
def locked(path: Path, *, busy: str, shared: bool = False) -> Iterator[None]:
    """Hold a lock file; the system releases it when the process ends, however it does.

    Parameters
    ----------
    path
        The file; made if it does not exist, in a folder that does, and left behind.
    busy
        What it means that somebody else holds it.
    shared
        Whether others may hold it at the same time, if they do not mind either.

    Raises
    ------
    RequestError
        If somebody else holds it, saying who, or if the file cannot be written.
    """
    try:
        file = path.open("a+", encoding="utf-8")
    except OSError as error:
        raise RequestError(f"'{path}' cannot be written: {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read()
            raise RequestError(f"{busy} ({holder})" if holder else busy) from None
        except OSError as error:
            raise RequestError(f"'{path}' cannot be locked: {error.strerror}") from None
        _note(file, "" if shared else f"process {os.getpid()} on {platform.node()}")
        try:
            yield
        finally:
            if not shared:
                _note(file, "")


def _note(file: TextIO, holder: str) -> None:
    """Write down who holds a lock; on a full disk it holds all the same."""
    with contextlib.suppress(OSError):
        file.truncate(0)
        file.write(holder)
        file.flush()
