"""Ctrl-C: it ends a command with one line, and at once while that only imports."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C has ended."""


class Interrupted(Exception):  # noqa: N818  what happened is no error
    """Ctrl-C has ended a command."""


def interruptible(command: Callable[..., None]) -> Callable[..., None]:
    """A command that raises `Interrupted` in place of `KeyboardInterrupt`, which Typer would end without a word."""

    @functools.wraps(command)
    def wrapped(*arguments: object, **options: object) -> None:
        try:
            command(*arguments, **options)
        except KeyboardInterrupt:
            raise Interrupted from None

    return wrapped


@contextlib.contextmanager
def interrupted_at_once() -> Iterator[None]:
    """Block in which Ctrl-C ends the process with a line.

    A `KeyboardInterrupt` that is raised in the import of an extension module may become an `ImportError`, or be lost.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _leave(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  the signature of a handler
    sys.stdout.flush()
    os.write(2, b"vibench: interrupted\n")
    os._exit(INTERRUPTED)
