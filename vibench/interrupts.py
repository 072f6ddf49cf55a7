"""Ctrl-C, and SIGTERM: how they end a command and a run, and how processes that these start ignore the first."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

Handler = Callable[[int, FrameType | None], object] | int | None


class Interrupted(Exception):  # noqa: N818  what happened is no error
    """Ctrl-C or SIGTERM has ended a command."""


def interruptible(command: Callable[..., None]) -> Callable[..., None]:
    """A command that raises `Interrupted` at Ctrl-C, where Typer would exit silently, and at SIGTERM."""

    @functools.wraps(command)
    def wrapped(*arguments: object, **options: object) -> None:
        raising = signal.getsignal(signal.SIGINT) is _leave
        try:
            with (
                _handled(signal.default_int_handler) if raising else contextlib.nullcontext(),
                _handled(signal.default_int_handler, signal.SIGTERM),
            ):
                command(*arguments, **options)
        except KeyboardInterrupt:
            raise Interrupted from None

    return wrapped


@contextlib.contextmanager
def interrupted_at_once() -> Iterator[None]:
    """End the process with a line at Ctrl-C inside the block, unless Ctrl-C is ignored.

    A `KeyboardInterrupt` in the import of an extension module may become an `ImportError`, or be lost; outside of all
    commands nobody catches it.
    """
    with _handled(_leave):
        yield


def ignore() -> None:
    """Ignore Ctrl-C from now on."""
    _set(signal.SIG_IGN)


@contextlib.contextmanager
def restored() -> Iterator[None]:
    """Restore the handler of Ctrl-C after the block."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        _set(before)


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Block Ctrl-C: processes that are started inside inherit this and never receive it."""
    from multiprocessing import resource_tracker  # noqa: PLC0415  most commands start no processes

    # Start the tracker now: its start would unblock SIGINT.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _handled(handler: Handler, number: int = signal.SIGINT) -> Iterator[None]:
    """Handle a signal inside the block unless it is ignored; the handler before returns if no other one is set."""
    before = signal.getsignal(number)
    if before is not signal.SIG_IGN:
        _set(handler, number)
    try:
        yield
    finally:
        if signal.getsignal(number) is handler:
            _set(before, number)


def _set(handler: Handler, number: int = signal.SIGINT) -> None:
    # Only the main thread can set handlers.
    if threading.current_thread() is threading.main_thread():
        signal.signal(number, handler)


def _leave(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  the signature of a handler
    sys.stdout.flush()
    os.write(2, b"vibench: interrupted\n")
    # No handlers at exit: the interpreter may be in the middle of an import.
    os._exit(130)
