"""Writing files: whole or not at all, and never through what somebody else has put in their place."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

TEMPORARY = "vibench-"
"""How the names of temporary files begin; the rest is random."""

PART = ".part"
"""How they end."""


def write_atomically(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write a file under a random name in the same folder and rename it; a link under its name is replaced.

    `durable` content is on the disk when the function returns.

    Raises
    ------
    OSError
        If it cannot be written; nothing is left behind.
    """
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=TEMPORARY, suffix=PART)
    part = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def open_unlinked(path: Path) -> int:
    """Descriptor of a file for reading and writing, created if need be; symbolic links are refused.

    Raises
    ------
    OSError
        If it is a symbolic link, or cannot be opened.
    """
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
