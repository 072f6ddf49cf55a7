"""Sources, other files and environment variables that a class given in Python reads while it is made and first used.

Neither its code nor its state tells what a method imports or opens, so that it is watched once, in a process of its
own. Whoever uses the class again compares the states of what it has read.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import sysconfig
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

from vibench.files import file_digest
from vibench.process import put_back

# Files read and files written by each work that this process has watched, the current one last.
_watched: list[tuple[set[str], set[str]]] = []


def reads_of(work: Callable[[], Any]) -> dict[str, str]:
    """States of the files, and of the environment variables "$NAME", that own code reads during the work."""
    # Hooks stay until the process ends.
    if not _watched:
        sys.addaudithook(_opened)
        os.environ.__class__ = _Environment
    _watched.append((set(), set()))
    # The stage that does the same says what a plugin raises.
    with contextlib.suppress(Exception, SystemExit), put_back():
        work()
    read, written = _watched[-1]
    files = {name: file for name, one in sys.modules.items() if (file := getattr(one, "__file__", None))}
    for name in [name for name, file in files.items() if is_own(file)]:
        read.add(files[name])
        # The next work imports it again if it needs it.
        del sys.modules[name]
    return states(sorted(read - written))


def _opened(event: str, given: tuple[Any, ...]) -> None:
    if event == "open" and isinstance(given[0], str | bytes | os.PathLike) and _is_for_own_code():
        writes = {*"wax+"} & {*(given[1] or "")} or given[2] & (os.O_WRONLY | os.O_RDWR)
        _watched[-1][bool(writes)].add(os.path.abspath(os.fsdecode(given[0])))  # noqa: PTH100


class _Environment(type(os.environ)):  # type: ignore[misc]
    def __getitem__(self, name: str) -> Any:
        if _is_for_own_code(direct=True):
            _watched[-1][0].add(f"${name}")
        return super().__getitem__(name)


def _is_for_own_code(*, direct: bool = False) -> bool:
    """Whether own code asks, by itself where this has to be `direct`, and not the import of a library."""
    caller = sys._getframe(2)
    while caller is not None and not caller.f_code.co_filename.startswith("<frozen importlib"):
        own, frozen = is_own(caller.f_code.co_filename), caller.f_code.co_filename.startswith("<frozen")
        if not frozen and (own or direct):
            return own
        caller = caller.f_back  # type: ignore[assignment]
    return False


@cache
def is_own(file: str) -> bool:
    """Whether a file belongs neither to Python, nor to vibench, nor to an installed library."""
    path, installed = Path(file), {"site-packages", "dist-packages"}
    folders = (sysconfig.get_path("stdlib"), Path(__file__).parents[1])
    return not any(path.is_relative_to(one) for one in folders) and installed.isdisjoint(path.parts)


def states(names: Iterable[str]) -> dict[str, str]:
    """Digests of files and of environment variables "$NAME", "" for what there is not."""
    return {name: _state(name) for name in names}


def _state(name: str) -> str:
    if name.startswith("$"):
        return hashlib.sha256(os.environb[key]).hexdigest() if (key := name[1:].encode()) in os.environb else ""
    # What is no file may have no end.
    try:
        return file_digest(Path(name)).hex() if Path(name).is_file() else ""
    except OSError:
        return ""
