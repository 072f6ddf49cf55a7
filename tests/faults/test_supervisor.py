import contextlib
import itertools
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import forking
import pytest
from fake_stages import InItems, OfAPlugin, Whole
from running import PATIENCE

from vibench import Status
from vibench.execution import supervisor
from vibench.execution.supervisor import Begun, CurrentItem, Job, StoppedError, Supervisor
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import find
from vibench.stages.artefacts import Store
from vibench.stages.base import Done, Failed, Stage, Unstored

Run = Callable[..., "Done | Failed | Unstored"]


@pytest.fixture
def watcher() -> Iterator[Supervisor]:
    with contextlib.closing(Supervisor()) as made:
        yield made


@pytest.fixture(scope="module")
def shared() -> Iterator[Supervisor]:
    """One supervisor for most tests: after whatever a test did to its process, the next one is served."""
    with contextlib.closing(Supervisor()) as made:
        yield made


@pytest.fixture
def run(shared: Supervisor, tmp_path: Path) -> Run:
    def go(stage: Stage, query: float = 1.0, cell: float = 30.0) -> Done | Failed | Unstored:
        return shared.run(Job(str(tmp_path), stage, query, cell, 8.0))

    return go


def values(found: Done | Failed | Unstored) -> list[tuple[int, Any]]:
    """The number of each item with its process, or with how it failed."""
    assert isinstance(found, Done)
    return found.value


def test_a_stage_that_goes_well_is_stored_and_tells_its_progress(run: Run, shared: Supervisor, tmp_path: Path) -> None:
    for how, share in (("third", 1.0 / 3.0), ("fine", 0.0)):
        stage = Whole(how)
        assert isinstance(run(stage), Done)
        assert shared.fraction_done == (stage.key, share)
    found = Store(tmp_path).get(stage.key)
    assert found.value == "fine"


def test_tests_fork_whatever_the_seed(watcher: Supervisor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With new interpreters the suite would take the same steps, in much longer."""
    monkeypatch.setenv("PYTHONHASHSEED", "6640")
    monkeypatch.setattr(forking, "start_new_worker", None)
    assert isinstance(watcher.run(Job(str(tmp_path), Whole("fine"), 1.0, 30.0, 8.0)), Done)


def test_processes_are_kept_and_answer_once(run: Run) -> None:
    processes = {run(InItems(("fine",) * k)).value[0][1] for k in (1, 2, 3)}
    assert len(processes) == 1
    assert os.getpid() not in processes
    for _ in range(3):
        found = values(run(InItems(("fine", "fork", "fine"))))
        assert len({process for _, process in found}) == 1


@pytest.mark.parametrize("how", ["sleep", "hang"])
def test_an_item_beyond_its_limit_costs_itself(run: Run, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor._JobState, "grace", 0.1)
    found = values(run(InItems(("fine", how, "fine", "fine")), query=1.5))
    assert [number for number, _ in found] == [0, 1, 2, 3]
    assert found[1][1] == Failed(Status.TIMEOUT, "stopped after query_seconds = 1.5 s")
    assert all(isinstance(process, int) for number, process in found if number != 1)


@pytest.mark.usefixtures("new_workers")
def test_what_items_start_or_kill_ends_and_costs_themselves(watcher: Supervisor, tmp_path: Path, run: Run) -> None:
    started = {kind: unique() for kind in ("child", "daemon")}
    items = InItems(tuple(f"{kind} {seconds}" for kind, seconds in started.items()))
    assert isinstance(watcher.run(Job(str(tmp_path), items, 1.0, 30.0, 8.0)), Done)
    for seconds in started.values():
        while not sleepers(seconds):  # a process that has just begun has no name yet
            time.sleep(0.01)
    watcher.close()
    assert not any(map(sleepers, started.values()))
    seconds = unique()
    found = values(run(InItems((f"daemon {seconds}", "exit", "fine"))))
    assert [isinstance(value, Failed) for _, value in found] == [False, True, False]
    assert not sleepers(seconds)
    found = values(run(InItems(("exit", "fine", "segfault", "fine"))))
    for number, words in ((0, "exit code 5"), (2, "signal SIGSEGV")):
        assert found[number][1] == Failed(Status.CRASHED, f"the worker process died with {words}")
    assert found[1][1] != found[3][1]  # each death takes another process


@pytest.mark.long
def test_items_beyond_the_limit_of_the_cell_cost_themselves(run: Run) -> None:
    found = values(run(InItems(("interrupt", "fine", "fine"), unlimited=("", "exit", ""))))
    assert [isinstance(value, Failed) for _, value in found] == [True, True, False]
    assert found[0][1].status is Status.ERROR
    assert "KeyboardInterrupt" in found[0][1].reason
    found = values(run(InItems(("fine", "fine", "sleep", "fine")), query=60.0, cell=2.0))
    assert [isinstance(value, Failed) for _, value in found] == [False, False, True, True]
    assert found[3][1] == Failed(Status.TIMEOUT, "stopped after cell_seconds = 2 s")
    found = values(run(InItems(("moment",) * 400), cell=2.0))
    lost = [value for _, value in found if isinstance(value, Failed)]
    assert 300 < len(lost) < 400
    assert set(lost) == {Failed(Status.TIMEOUT, "stopped after cell_seconds = 2 s")}
    found = values(run(InItems(("fine", "sleep", "exit", "fine")), query=600.0, cell=1.0))
    assert {value.status for _, value in found[1:]} == {Status.TIMEOUT}


@pytest.mark.long
def test_memory_or_steps_that_are_not_of_an_item_cost_the_stage(run: Run) -> None:
    found = values(run(InItems(("fine", "hunger", "fine"))))
    assert found[1][1] == Failed(Status.ERROR, "out of memory: the limit is memory_gib = 8")
    assert found[0][1] != found[2][1]
    starved = run(Whole("hunger"))
    assert isinstance(starved, Failed)
    assert "out of memory" in starved.reason
    assert isinstance(run(Whole("fine")), Done)
    statuses = {"sleep": Status.TIMEOUT, "exit": Status.CRASHED, "interrupt": Status.ERROR}
    for how, status in (*statuses.items(), ("hang", Status.TIMEOUT), ("segfault", Status.CRASHED)):
        items = (InItems(("fine",), at_begin=how), InItems(("fine",), at_end=how)) if how in statuses else ()
        for stage in (*items, Whole(how)):
            found = run(stage, cell=0.5 if status is Status.TIMEOUT else 30.0)
            assert isinstance(found, Failed)
            assert found.status is status
        assert isinstance(run(Whole("fine")), Done)  # the next one has a new process


def unique() -> int:
    """A number of seconds by which a test knows its own `sleep`."""
    return 10**6 + random.randrange(10**9)


def sleepers(seconds: int) -> list[str]:
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            found += [str(path)] if path.read_bytes() == f"sleep\0{seconds}\0".encode() else []
    return found


def test_a_plugin_or_vibench_not_planned_with_is_refused(run: Run, watcher: Supervisor, tmp_path: Path) -> None:
    """Its result would be stored under the hash of the other."""
    known = Plugin("problem", "obstacle", "{}", find(PluginKind.PROBLEM, "obstacle").code)
    assert isinstance(run(OfAPlugin(OfAPlugin(problem=known))), Done)
    other = replace(known, code="older")
    found = run(OfAPlugin(OfAPlugin(problem=other)))
    assert isinstance(found, Failed)
    assert found.reason == "the problem 'obstacle' was changed since the run began; run the study again"
    found = watcher.run(replace(Job(str(tmp_path), Whole("fine"), 1.0, 30.0, 8.0), code="older"))
    assert isinstance(found, Failed)
    assert "vibench or one of the libraries was changed" in found.reason


def test_suspended_runs_are_not_late_limits_begin_with_work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    state = supervisor._JobState(Job(str(tmp_path), Whole("fine"), 1.0, 30.0, 8.0))
    state.update(Begun())
    now = time.monotonic()
    monkeypatch.setattr(supervisor.time, "monotonic", lambda: now + 3600.0)
    state.tick(30.0)
    assert 0.0 < state.seconds <= 1.0
    # None of the time counts in which a process starts and imports: here three times what the work may take.
    state = supervisor._JobState(Job(str(tmp_path), Whole("fine"), 1.0, 30.0, 8.0))
    seconds = itertools.count(time.monotonic())
    monkeypatch.setattr(supervisor.time, "monotonic", lambda: next(seconds))
    for _ in range(90):
        state.tick(30.0)
    state.update(Begun())
    for _ in range(30):
        state.tick(30.0)
    with pytest.raises(supervisor._WorkerLostError) as lost:
        state.tick(30.0)
    assert lost.value.failed == Failed(Status.TIMEOUT, "stopped after cell_seconds = 30 s")


@pytest.mark.usefixtures("new_workers")
def test_a_process_not_begun_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor._JobState, "start_seconds", 0.1)
    with contextlib.closing(Supervisor(environment={"PYTHONHASHSEED": "7"})) as of_interpreters:
        found = of_interpreters.run(Job(str(tmp_path), Whole("fine"), 1.0, 30.0, 8.0))
    assert found == Failed(Status.CRASHED, "no worker process began within 0.1 s")


def test_talkative_jobs_stop_and_disks_are_not_the_fault_of_stages(watcher: Supervisor, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    found = watcher.run(Job(str(tmp_path / "file"), Whole("fine"), 1.0, 30.0, 8.0))
    assert isinstance(found, Unstored)
    assert "cannot be written" in found.reason
    job = Job(str(tmp_path), InItems(("moment",) * 2000), 60.0, 600.0, 8.0)

    def stop_at_the_first_item() -> None:
        while watcher._state is None or not watcher._state.progress.done:
            time.sleep(0.01)
        watcher.stop()

    threading.Thread(target=stop_at_the_first_item, daemon=True).start()
    with pytest.raises(StoppedError):  # long before its limits, which are ten minutes away
        watcher.run(job)


def test_a_keeper_that_is_closed_stops_at_once_and_leaves_nobody(watcher: Supervisor, tmp_path: Path) -> None:
    diary = tmp_path / "diary"
    job = Job(str(tmp_path), Whole("hang", str(diary)), 1.0, 600.0, 8.0)
    stopped: list[bool] = []

    def work() -> None:
        with pytest.raises(StoppedError):
            watcher.run(job)
        stopped.append(True)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    while not (diary.exists() and diary.read_text().endswith("\n")):
        assert thread.is_alive()
        time.sleep(0.05)
    worker = int(diary.read_text().split()[0])
    watcher.close()
    thread.join(timeout=PATIENCE)
    assert stopped == [True]
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


def test_an_operation_that_raised_has_no_limit(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor._JobState, "grace", 0.1)
    found = values(run(InItems(("fine", "interrupt"), at_end=f"linger {tmp_path / 'diary'}"), query=1.0))
    assert found[1][1].status is Status.ERROR
    assert (tmp_path / "diary").read_text() == "begun\n"  # by one process, none was stopped and replaced


def test_the_current_item_is_what_the_worker_noted_last(tmp_path: Path) -> None:
    with (tmp_path / "shared").open("w+b") as file:
        file.truncate(8)
        worker, watcher = CurrentItem(file.fileno()), CurrentItem(file.fileno())
    assert watcher.read() == (0, None, False)
    noted = [(0, False), (0, True), (2**31 - 1, True), (7, False)]
    for changes, (number, limited) in enumerate(noted, 1):
        worker.enter(number, limited=limited)
        assert watcher.read() == (changes, number, limited)
    worker.leave()
    assert watcher.read() == (0, None, False)
