"""Processes that end with their parent, however it dies: twelve kinds of death, and four of processes."""

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import fake_stages

from vibench.guardian import new_environment

ORPHANS = """
import os, resource, signal, subprocess, sys, time
from pathlib import Path
from vibench.benchmarks import run_pytest
from vibench.execution.supervisor import Job, Supervisor
from vibench.guardian import MARK, guarded
from vibench.packs.meshes import read_mesh

here = Path(sys.argv[1])
sys.path.append(sys.argv[2])
from fake_stages import Whole
os.environ["TESTS_ORPHAN"] = str(here)
killed = [signal.SIGTERM, signal.SIGKILL, signal.SIGHUP, signal.SIGINT, signal.SIGABRT, signal.SIGSEGV]
ends = {
    "exit": lambda: os._exit(1), "sys.exit": sys.exit, "exception": lambda: 1 / 0,
    "exec": lambda: os.execv("/bin/true", ["true"]),
    "worker": lambda: Supervisor().run(Job(str(here), Whole("hang"), 600.0, 600.0, 8.0)),
    "mesh": lambda: read_mesh(here / "pipe.msh", 2**30, 600),
    "benchmarks": lambda: run_pytest(["--plugin", "obstacle"]),
    **{number.name: lambda number=number: os.kill(os.getpid(), number) for number in killed},
}
running = [ends[name] for name in ("worker", "mesh", "benchmarks")]
os.mkfifo(here / "pipe.msh")
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
for number in (signal.SIGINT, signal.SIGHUP):
    signal.signal(number, signal.SIG_DFL)
os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
parents = {}
for name, end in ends.items():
    if parent := os.fork():
        parents[parent] = name
        continue
    os.setpgid(0, 0)
    signal.alarm(2 if ends[name] in running else 600)
    if ends[name] not in running:
        environment = {**os.environ, MARK: name, "PYTHONPATH": os.pathsep.join(sys.path)}
        subprocess.Popen(**guarded("holding", str(here / name), environment=environment), stdout=subprocess.DEVNULL)
        while not (here / name).exists():
            time.sleep(0.01)
    end()
for _ in ends:
    pid, status = os.wait()
    print(parents[pid], os.waitstatus_to_exitcode(status))
"""

HOLDING = """
import ctypes, os, subprocess, sys
subprocess.run(["sh", "-c", "setsid sleep 3600 >/dev/null 2>&1 &"], check=True)
open(sys.argv[1], "w").close()
ctypes.PyDLL(None).sleep(3600)
"""


def test_nothing_outlives_its_parent_however_it_dies(tmp_path: Path) -> None:
    (tmp_path / "orphans.py").write_text(ORPHANS)
    (tmp_path / "holding.py").write_text(HOLDING)
    command = [sys.executable, str(tmp_path / "orphans.py"), str(tmp_path), str(Path(fake_stages.__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert dict(line.split() for line in done.stdout.splitlines()) == {
        "exit": "1", "sys.exit": "0", "exception": "1", "exec": "0",
        "worker": "-14", "mesh": "-14", "benchmarks": "-14", "SIGTERM": "-15",
        "SIGKILL": "-9", "SIGHUP": "-1", "SIGINT": "-2", "SIGABRT": "-6", "SIGSEGV": "-11",
    }  # fmt: skip
    deadline, left = time.monotonic() + 10.0, {""}
    while left and time.monotonic() < deadline:
        time.sleep(0.1)
        left = set(orphans(f"TESTS_ORPHAN={tmp_path}".encode()))
    assert left == set()


def orphans(entry: bytes) -> Iterator[str]:
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if entry in (folder / "environ").read_bytes().split(b"\0"):
                yield (folder / "cmdline").read_text().replace("\0", " ")


def test_new_processes_have_one_thread() -> None:
    code = "import numpy, threadpoolctl; print({x['num_threads'] for x in threadpoolctl.threadpool_info()})"
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True, env=new_environment())
    assert done.stdout.strip() == b"{1}"
