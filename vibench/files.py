"""Files that are written whole or not at all, never through a link in their place, and locks that name their holder."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import platform
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import TextIO

from vibench.errors import RequestError

# Prefix of the names of temporary files and folders.
TEMPORARY = "vibench-"


def write_atomically(path: Path, content: bytes | Iterable[bytes], *, durable: bool = False) -> None:
    """Write a file under a random name in the same folder and rename it; a link under its name is replaced.

    `durable` content is on the disk when the function returns. Raises an `OSError` if it cannot be written; nothing is
    left behind.
    """
    # The name of a device, as /dev/null, would be that of an ordinary file from then on.
    if os.path.lexists(path) and stat.S_IFMT(path.lstat().st_mode) not in {stat.S_IFREG, stat.S_IFDIR, stat.S_IFLNK}:
        raise OSError(errno.EINVAL, "it is no regular file")
    part = path.parent / f"{TEMPORARY}{secrets.token_hex(8)}.part"
    # Permissions follow the user's mask.
    handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            file.writelines([content] if isinstance(content, bytes) else content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def scratch(parent: Path | None = None) -> Iterator[Path]:
    """A new folder in another one, or that of temporary files, without those that killed processes left there."""
    with contextlib.ExitStack() as stack:
        own = Path(stack.enter_context(tempfile.TemporaryDirectory(".part", TEMPORARY, parent)))
        # Living processes hold their folders; where a file system has no locks, all others stay.
        for folder in (own, *(set(own.parent.glob(f"{TEMPORARY}*.part")) - {own})):
            with contextlib.suppress(OSError):
                handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
                stack.callback(os.close, handle)
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if folder != own:
                    shutil.rmtree(folder)
        yield own


@contextlib.contextmanager
def writing(target: Path) -> Iterator[None]:
    """Turn an `OSError` in the block into a `RequestError`: `target` cannot be written."""
    try:
        yield
    except OSError as error:
        raise RequestError(f"'{target}' cannot be written: {error.strerror or error}") from None


def file_digest(path: Path) -> bytes:
    """The SHA-256 of a file; raises an `OSError` if it cannot be read."""
    state = path.stat()
    return _digest_of(path, state.st_size, state.st_mtime_ns, state.st_ino)


# Cached: a run computes the key of its problem in every process, and data may be large.
@lru_cache(maxsize=10_000)
def _digest_of(path: Path, size: int, changed: int, inode: int) -> bytes:  # noqa: ARG001  the state is part of the key
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def read_regular(path: Path) -> bytes:
    """The content of a regular file; raises an `OSError` if it is none, or cannot be read."""
    # A pipe or a device in its place would block here, or have no end.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file")
        return file.read()


@contextlib.contextmanager
def locked(path: Path, *, busy: str, shared: bool = False) -> Iterator[None]:
    """Hold a lock file, which is created and never deleted; the system releases it when the process ends.

    Several processes may hold a `shared` lock. Raises a `RequestError`, with the text `busy` and the holder if another
    process holds the lock, or if the file cannot be written.
    """
    try:
        # Refuse symbolic links, which would lock, and overwrite, the file of somebody else.
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        file = os.fdopen(os.open(path, flags, 0o666), "r+", encoding="utf-8")
    except OSError as error:
        if path.is_symlink():
            raise RequestError(f"'{path}' is a symbolic link, expected a lock file of vibench") from None
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
    """Write the holder into the lock file; on a full disk the lock is valid without it."""
    with contextlib.suppress(OSError):
        file.seek(0)
        file.truncate()
        file.write(holder)
        file.flush()
