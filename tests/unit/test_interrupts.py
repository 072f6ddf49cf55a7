"""What Ctrl-C does outside of commands, in them, and where it was ignored; with signals: tests/faults."""

import os
import signal
from collections.abc import Iterator
from functools import partial

import pytest

from vibench.interrupts import Interrupted, interrupted_at_once, interruptible


@pytest.fixture(autouse=True)
def handler() -> Iterator[object]:
    """The handler of Ctrl-C that Python starts with; the one of the test process comes back."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def now() -> object:
    return signal.getsignal(signal.SIGINT)


def test_commands_catch_raise_or_ignore_what_ends_the_process_outside(handler: object) -> None:
    """As in a script that runs a command in the background."""
    seen = []
    with interrupted_at_once():
        outside = now()
        interruptible(lambda: seen.append(now()))()
        assert now() is outside
    assert outside is not handler
    assert seen == [handler]
    assert now() is handler
    for number in (signal.SIGINT, signal.SIGTERM):
        with interrupted_at_once(), pytest.raises(Interrupted):
            interruptible(partial(os.kill, os.getpid(), number))()
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    with interrupted_at_once():
        interruptible(lambda: signal.signal(signal.SIGINT, signal.SIG_IGN))()  # type: ignore[arg-type, return-value]
        assert now() is signal.SIG_IGN
    assert now() is signal.SIG_IGN
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    interruptible(partial(os.kill, os.getpid(), signal.SIGTERM))()
    signal.signal(signal.SIGTERM, before)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interrupted_at_once():
        interruptible(lambda: os.kill(os.getpid(), signal.SIGINT))()
        assert now() is signal.SIG_IGN
