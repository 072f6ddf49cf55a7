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


Handler = Callable[[int, FrameType | None], object] | int | None


class Interrupted(Exception):  # noqa: N818  what happened is no error
    """Ctrl-C has ended a command."""


def interruptible(command: Callable[..., None]) -> Callable[..., None]:
    """A command that raises `Interrupted` in place of `KeyboardInterrupt`, which Typer would end without a word."""

    @functools.wraps(command)
    def wrapped(*arguments: object, **options: object) -> None:
        try:
            with _raising():
                command(*arguments, **options)
        except KeyboardInterrupt:
            raise Interrupted from None

    return wrapped


@contextlib.contextmanager
def interrupted_at_once() -> Iterator[None]:
    """Block in which Ctrl-C ends the process with a line; where it is ignored, it remains so.

    A `KeyboardInterrupt` that is raised in the import of an extension module may become an `ImportError`, or be lost;
    outside of all commands nobody catches it.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is signal.SIG_IGN:
        yield
        return
    with _handled(_leave, before):
        yield


@contextlib.contextmanager
def _raising() -> Iterator[None]:
    """Block within `interrupted_at_once` in which Ctrl-C raises `KeyboardInterrupt` all the same."""
    if signal.getsignal(signal.SIGINT) is not _leave:
        yield
        return
    with _handled(signal.default_int_handler, _leave):
        yield


@contextlib.contextmanager
def _handled(handler: Handler, before: Handler) -> Iterator[None]:
    """Block with a handler of Ctrl-C; the one of before comes back unless the block has set another, for good."""
    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is handler:
            signal.signal(signal.SIGINT, before)


def _leave(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  the signature of a handler
    sys.stdout.flush()
    os.write(2, b"vibench: interrupted\n")
    os._exit(INTERRUPTED)
