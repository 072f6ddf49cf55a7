"""Running the benchmarks in pytest processes of their own, on one thread, followed line by line."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vibench.benchmarks.passes import Entry, is_slow, together
from vibench.errors import VibenchError
from vibench.execution.supervisor import manner_of_death
from vibench.text import one_line
from vibench.timing import ONE_THREAD

NEEDED = ("pytest", "pytest_benchmark")
"""Packages of the extra `bench`."""


@dataclass(frozen=True)
class Request:
    """What to time.

    Attributes
    ----------
    chosen
        Names of plugins by the word for their kind (`registry.WORDS`); all that are registered if empty.
    resolutions
        Names or numbers of nodes, at which problems are timed that know them.
    study
        Study whose strategies complete what is timed.
    seconds
        Seconds for each benchmark, about.
    """

    chosen: Mapping[str, Sequence[str]]
    resolutions: Sequence[str] = ("coarse",)
    study: str = "quick"
    seconds: float = 1.0


@dataclass
class Outcome:
    """What came of the benchmarks: the file of pytest-benchmark, and why some failed or were left out."""

    content: bytes
    failed: Mapping[str, str]
    skipped: Mapping[str, str]


def check_installed() -> None:
    """Refuse to go on without pytest-benchmark.

    Raises
    ------
    VibenchError
        If it is not installed; the message has the command that installs it.
    """
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        names = " and ".join(name.replace("_", "-") for name in missing)
        raise VibenchError(f"`vibench bench` needs {names}: pip install 'vibench[bench]'")


def run(request: Request, show: Callable[[str], None]) -> Outcome:
    """Run the benchmarks, each told to `show` in a line when it ends.

    One that ends its process has failed; those after it are run in another process.

    Raises
    ------
    VibenchError
        If pytest-benchmark is not installed, or a process ends before any benchmark begins.
    """
    check_installed()
    followed = _Followed(show)
    with tempfile.TemporaryDirectory(prefix="vibench-") as scratch:
        while not followed.finished:
            code = _one_process(request, Path(scratch), followed)
            if not (followed.finished or followed.running):
                last = (Path(scratch) / LOG).read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
                why = one_line(": ".join(["", *last]))
                raise VibenchError(f"the process of the benchmarks died with {manner_of_death(code)}{why}")
            if not followed.finished:
                followed.lose(f"its process died with {manner_of_death(code)}")
    return followed.outcome()


LOG = "log.txt"
"""File for what benchmarks print."""


def _one_process(request: Request, scratch: Path, followed: _Followed) -> int:
    """Run the benchmarks that are left in a process; returns its exit code."""
    reading, writing = os.pipe()
    with (scratch / LOG).open("wb") as printed, os.fdopen(reading, encoding="utf-8") as lines:
        command = _command(request, followed.had, scratch, writing)
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
        process = subprocess.Popen(
            command, stdout=printed, stderr=printed, stdin=subprocess.DEVNULL, pass_fds=(writing,),
            env=environment | ONE_THREAD,
        )  # fmt: skip
        os.close(writing)
        try:
            followed.begin()
            for line in lines:
                if line.endswith("\n"):  # a process that dies may leave half a line
                    followed.take(json.loads(line))
            return process.wait()
        finally:
            process.kill()
            process.wait()


def _command(request: Request, had: Mapping[str, int], scratch: Path, progress: int) -> list[str]:
    """Pytest without any configuration but ours, and without its own output."""
    return [
        sys.executable, "-m", "pytest", str(Path(__file__).parent), "-p", "vibench.benchmarks.plugin", "--noconftest",
        "-c", os.devnull, f"--rootdir={scratch}", f"--basetemp={scratch / 'temp'}", "-o", "python_files=bench_*.py",
        "-p", "no:cacheprovider", "-p", "no:terminal", "-p", "no:xdist", "-p", "no:randomly",
        f"--benchmark-max-time={request.seconds:g}", f"--had={json.dumps(had)}",
        f"--chosen={json.dumps({kind: list(names) for kind, names in request.chosen.items()})}",
        f"--resolutions={','.join(request.resolutions)}", f"--study={request.study}", f"--progress={progress}",
    ]  # fmt: skip


class _Followed:
    """What the processes report: every benchmark by name in the first pass, then how far the others are.

    Attributes
    ----------
    had
        Passes that every benchmark has had, by name; all of them for one that needs no other.
    running
        The benchmark that the process began last.
    finished
        Whether all had their turn.
    """

    def __init__(self, show: Callable[[str], None]) -> None:
        self.had = Counter[str]()
        self.running, self.finished = "", False
        self._show = show
        self._stopped = ""
        self._count, self._passes, self._shown = 0, 1, 1
        self._file: dict[str, Any] = {}
        self._timed: list[Entry] = []
        self._failed: dict[str, str] = {}
        self._skipped: dict[str, str] = {}

    def begin(self) -> None:
        """A process begins."""
        self.running, self._stopped = "", ""

    def take(self, report: Mapping[str, Any]) -> None:
        """Note a line of the process."""
        if "count" in report:
            self._count, self._passes, self._file = report["count"], report["passes"], report["file"]
        elif "begun" in report:
            self.running = report["begun"]
        elif "timed" in report:
            self._timed.append(report["timed"])
            if is_slow(report["timed"]):
                self.had[self.running] = self._passes
        elif "stopped" in report:
            self._stopped = report["stopped"]
        elif "finished" in report:
            self.finished = True
        else:
            self._ended(report["name"], report["outcome"], one_line(report["reason"]))

    def lose(self, reason: str) -> None:
        """The process ended while a benchmark was running: it failed, for a reason unless the process has told one."""
        self._ended(self.running, "failed", self._stopped or reason)

    def _ended(self, name: str, outcome: str, reason: str) -> None:
        new = name not in self.had
        self.had[name] = self.had[name] + 1 if outcome == "passed" else self._passes
        if outcome == "skipped":
            self._skipped[name] = reason
        elif outcome == "failed":
            self._failed[name] = reason
            self._show(f"[{len(self.had)}/{self._count}] failed: {name}: {reason}")
        elif new:
            self._show(f"[{len(self.had)}/{self._count}] {name}")
        elif self.had[name] > self._shown:
            self._shown = self.had[name]
            self._show(f"pass {self._shown} of {self._passes}")

    def outcome(self) -> Outcome:
        """What came of the benchmarks."""
        content = {**self._file, "benchmarks": together(self._timed)}
        return Outcome(json.dumps(content, indent=4).encode(), self._failed, self._skipped)
