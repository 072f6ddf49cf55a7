import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from running import Vibench, assert_same_numbers, read_until, started
from samples import wire_study, write_study

pytestmark = pytest.mark.long

Workers = Callable[[int], list[subprocess.Popen[bytes]]]

SECONDS = 300.0
"""Longest wait for what happens in another process."""


def until(holds: Callable[[], object]) -> None:
    end = time.monotonic() + SECONDS
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


@contextmanager
def scheduled(folder: Path, plugins: Path) -> Iterator[tuple[str, subprocess.Popen[bytes], Workers]]:
    """The address and the process of a scheduler, and a function that starts workers of it in processes of their own.

    All are killed at the end.
    """
    environment = os.environ | {"PYTHONPATH": str(plugins), "OMP_NUM_THREADS": "1"}
    folder.mkdir(parents=True)
    file, log = folder / "scheduler.json", (folder / "log").open("wb")

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]]
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True)
        stack.callback(process.wait)
        stack.callback(stop, process)
        return process

    def workers(count: int) -> list[subprocess.Popen[bytes]]:
        options = ("--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", "--no-dashboard")
        return [start("dask_worker", *options, "--host", "127.0.0.1") for _ in range(count)]

    with ExitStack() as stack:
        stack.enter_context(log)
        scheduler = start(
            "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)
        )
        until(file.exists)
        yield str(json.loads(file.read_text())["address"]), scheduler, workers


@pytest.fixture
def waiting(tmp_path: Path, vibench: Vibench) -> str:
    """A study of four cells, of which two wait for the file "go on"; it was run here, which has its rows in "local"."""
    go_on = tmp_path / "go on"
    waits = {"name": "cone-waits", "options": {"file": str(go_on)}}
    path = write_study(tmp_path, wire_study(dual=["cpg", waits], solvers=["piqp", "proxqp"]))
    go_on.touch()
    here(vibench, tmp_path, path)
    go_on.unlink()
    return path


def here(vibench: Vibench, folder: Path, path: str) -> None:
    """Run a study on this machine; its artefacts are removed, of which the cluster would make no others."""
    done = vibench(folder, "run", path, "--jobs", "2", "--out", "local")
    assert (done.returncode, done.stderr) == (0, "")


def on(address: str, path: str) -> list[str]:
    return ["run", path, "--executor", "dask", "--scheduler", address, "--out", "dask"]


def ended(process: subprocess.Popen[str]) -> list[str]:
    """The lines of errors of a command that ends with exit code 0, but for that on the connection."""
    _, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 0, err
    return [line for line in err.splitlines() if "the connection is not authenticated" not in line]


def test_a_late_worker_does_what_a_dead_one_left(
    command: str, plugins_folder: Path, waiting: str, tmp_path: Path
) -> None:
    with scheduled(tmp_path / "cluster", plugins_folder) as (address, _, workers):
        (first,) = workers(1)
        until(lambda: arrived(address) == 1)
        with started([command, *on(address, waiting)], tmp_path, plugins_folder) as process:
            read_until(process, "[2/4] ok")
            workers(1)
            until(lambda: arrived(address) == 2)
            stop(first)
            (tmp_path / "go on").touch()
            assert ended(process) == []
    assert_same_numbers(tmp_path / "local", tmp_path / "dask")


def test_a_scheduler_that_disappears_ends_the_run_which_goes_on_here(
    command: str, plugins_folder: Path, waiting: str, vibench: Vibench, tmp_path: Path
) -> None:
    with scheduled(tmp_path / "cluster", plugins_folder) as (address, scheduler, workers):
        workers(2)
        until(lambda: arrived(address) == 2)
        with started([command, *on(address, waiting)], tmp_path, plugins_folder) as process:
            read_until(process, "[2/4] ok")
            stop(scheduler)
            _, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 1
    assert err.splitlines()[-1].startswith("vibench: the dask ")
    assert err.splitlines()[-1].endswith("run the same command again to continue")
    (tmp_path / "go on").touch()
    done = vibench(tmp_path, "run", waiting, "--jobs", "2", "--out", "dask")
    assert (done.returncode, done.stderr) == (0, "")
    assert_same_numbers(tmp_path / "local", tmp_path / "dask")


def stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)


def arrived(address: str) -> int:
    from distributed import Client  # noqa: PLC0415  an import of half a second, in every process that collects tests

    with Client(address, timeout="30s", set_as_default=False) as client:
        return len(client.scheduler_info(n_workers=-1)["workers"])
