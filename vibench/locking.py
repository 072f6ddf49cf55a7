"""Locks between processes: a file that somebody holds, and who."""

from __future__ import annotations

import contextlib
import fcntl
import os
import platform
from collections.abc import Iterator
from pathlib import Path

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
            raise RequestError(f"{busy}{_holder(file.read())}") from None
        if not shared:
            file.truncate(0)
            with contextlib.suppress(OSError):  # a full disk: the lock holds, nameless
                file.write(f"process {os.getpid()} on {platform.node()}")
                file.flush()
        yield


def _holder(text: str) -> str:
    return f" ({text})" if text else ""
