"""Worker processes that a server forks: what they share, what they do not, and what is done without a server."""

import contextlib
import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from running import PATIENCE

from vibench.execution import forking
from vibench.execution.isolated import call_isolated
from vibench.execution.supervisor import Supervisor

pytestmark = pytest.mark.usefixtures("new_workers")


@pytest.fixture
def supervisor() -> Iterator[Supervisor]:
    with contextlib.closing(Supervisor()) as made:
        yield made


def seen(supervisor: Supervisor, *expressions: str, owner: str = "") -> list[Any]:
    """What a new process of a supervisor sees; its parent, and whether it is forked, come first."""
    supervisor._kill()
    values = f"os.getppid(), 'forking' in sys.orig_argv[3], {', '.join(expressions)}"
    look = f"(lambda os, sys, numpy: [{values}])(*map(__import__, ('os', 'sys', 'numpy')))"
    return list(call_isolated(eval, look, seconds=PATIENCE, supervisor=supervisor, owners=(owner,)))


def test_forked_processes_share_imports_alone(supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch) -> None:
    expressions = (
        "os.getpid()", "numpy.random.random()", "os.environ['TESTS_SEEN']", "len(os.listdir('/proc/self/task'))",
        "os.environ['VIBENCH_WORKER'] in open('/proc/self/environ').read()", "'vibench_problems' in sys.modules",
        "len(os.listdir('/proc/self/fd')) < 12",
    )  # fmt: skip
    found = [os.getpid()]
    for name in ("first", "second"):
        monkeypatch.setenv("TESTS_SEEN", name)
        server, is_forked, process, number, *others = seen(supervisor, *expressions)
        assert [is_forked, *others] == [True, name, 1, True, False, True]
        found += [server, process, number]
    # One server, but neither a process nor a random number twice.
    assert len(set(found)) == 6


def test_third_party_packages_have_new_interpreters(supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHONHASHSEED", raising=False)
    first, second = (seen(supervisor, "hash('a')", owner="someone") for _ in range(2))
    assert first[:2] == second[:2] == [os.getpid(), False]
    assert first[2] != second[2]
    with contextlib.closing(Supervisor(environment={"PYTHONHASHSEED": "7"})) as seeded:
        assert seen(seeded)[1] is False


def test_without_a_server_processes_are_new(supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch) -> None:
    os.kill(seen(supervisor)[0], signal.SIGKILL)
    assert supervisor._workers[frozenset()][1].wait(PATIENCE) == -signal.SIGKILL
    assert seen(supervisor)[:2] == [os.getpid(), False]
    forking._server.cache_clear()
    assert seen(supervisor)[1] is True
    monkeypatch.delattr(os, "pidfd_open")
    assert seen(supervisor)[1] is False
