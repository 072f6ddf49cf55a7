"""A run on a dask cluster of which one worker dies, and another one comes late: rows as locally."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest
from distributed import Client
from running import Vibench, assert_same_numbers, read_until, started
from samples import wire_study, write_study

pytestmark = pytest.mark.long

SECONDS = 300.0
"""Longest wait for what happens in another process."""


def until(holds: Callable[[], object]) -> None:
    """Wait until something holds."""
    end = time.monotonic() + SECONDS
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def stop(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and what it started."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)


@contextmanager
def scheduled(folder: Path, plugins: Path) -> Iterator[tuple[str, Callable[[], subprocess.Popen[bytes]]]]:
    """The address of a scheduler, and a function that starts a worker in a process of its own; all are killed."""
    environment = os.environ | {"PYTHONPATH": str(plugins), "OMP_NUM_THREADS": "1"}
    folder.mkdir(parents=True)
    file, log = folder / "scheduler.json", (folder / "log").open("wb")

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{arguments[0]}", *arguments[1:], "--host", "127.0.0.1"]
        command += ["--scheduler-file", str(file), "--no-dashboard"]
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True)
        stack.callback(process.wait)
        stack.callback(stop, process)
        return process

    with ExitStack() as stack:
        stack.enter_context(log)
        start("dask_scheduler", "--port", "0")
        until(file.exists)
        yield (
            str(json.loads(file.read_text())["address"]),
            partial(start, "dask_worker", "--nthreads", "1", "--no-nanny"),
        )


def arrived(address: str) -> int:
    """Number of workers that a scheduler has."""
    with Client(address, timeout="30s", set_as_default=False) as client:
        return len(client.scheduler_info(n_workers=-1)["workers"])


def test_a_late_worker_does_what_one_that_dies_leaves(
    command: str, plugins_folder: Path, vibench: Vibench, tmp_path: Path
) -> None:
    """Two of four cells wait for the file "go on"."""
    go_on = tmp_path / "go on"
    waits = {"name": "cone-waits", "options": {"file": str(go_on)}}
    path = write_study(tmp_path, wire_study(dual=["cpg", waits], solvers=["piqp", "proxqp"]))
    go_on.touch()
    # the artefacts are removed, of which the cluster would make no others
    done = vibench(tmp_path, "run", path, "--jobs", "2", "--out", "local")
    assert (done.returncode, done.stderr) == (0, "")
    go_on.unlink()
    with scheduled(tmp_path / "cluster", plugins_folder) as (address, start_worker):
        first = start_worker()
        until(lambda: arrived(address) == 1)
        options = ["run", path, "--executor", "dask", "--scheduler", address, "--out", "dask"]
        with started([command, *options], tmp_path, plugins_folder) as process:
            read_until(process, "[2/4] ok")
            start_worker()
            until(lambda: arrived(address) == 2)
            stop(first)
            go_on.touch()
            _, err = process.communicate(timeout=SECONDS)
            assert process.returncode == 0, err
            assert all("the connection is not authenticated" in line for line in err.splitlines())
    assert_same_numbers(tmp_path / "local", tmp_path / "dask")
