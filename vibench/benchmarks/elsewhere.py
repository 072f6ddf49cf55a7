"""Running the benchmarks in a pytest process of their own, on one thread, followed line by line."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vibench.errors import VibenchError
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

    content: bytes = b""
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


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

    Raises
    ------
    VibenchError
        If pytest-benchmark is not installed, or the process ends otherwise than at the end of the benchmarks.
    """
    check_installed()
    with tempfile.TemporaryDirectory(prefix="vibench-") as scratch:
        file, log = Path(scratch) / "benchmarks.json", Path(scratch) / "log.txt"
        reading, writing = os.pipe()
        with log.open("wb") as printed, os.fdopen(reading, encoding="utf-8") as lines:
            command = _command(request, file, Path(scratch), writing)
            environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
            process = subprocess.Popen(
                command, stdout=printed, stderr=printed, stdin=subprocess.DEVNULL, pass_fds=(writing,),
                env=environment | ONE_THREAD,
            )  # fmt: skip
            os.close(writing)
            try:
                outcome = _followed(map(json.loads, lines), show)
                code = process.wait()
            finally:
                process.kill()
                process.wait()
        if code not in (0, 1, 5) or not (code == 5 or file.is_file()):
            last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
            raise VibenchError(f"the benchmarks ended with exit code {code}: {one_line(' '.join(last))}")
        outcome.content = file.read_bytes() if file.is_file() else b""
        return outcome


def _command(request: Request, file: Path, scratch: Path, progress: int) -> list[str]:
    """Pytest without any configuration but ours, and without its own output."""
    return [
        sys.executable, "-m", "pytest", str(Path(__file__).parent), "-p", "vibench.benchmarks.plugin", "--noconftest",
        "-c", os.devnull, f"--rootdir={scratch}", f"--basetemp={scratch / 'temp'}", "-o", "python_files=bench_*.py",
        "-p", "no:cacheprovider", "-p", "no:terminal", "-p", "no:xdist", "-p", "no:randomly",
        f"--benchmark-json={file}", f"--benchmark-max-time={request.seconds:g}",
        f"--chosen={json.dumps({kind: list(names) for kind, names in request.chosen.items()})}",
        f"--resolutions={','.join(request.resolutions)}", f"--study={request.study}", f"--progress={progress}",
    ]  # fmt: skip


def _followed(reports: Any, show: Callable[[str], None]) -> Outcome:
    """What the process reports: every benchmark by name in the first pass, then how far the others are."""
    outcome, count, passes, ended = Outcome(), 0, 1, Counter[str]()
    for report in reports:
        if "count" in report:
            count, passes = report["count"], report["passes"]
            continue
        name, reason = report["name"], one_line(report["reason"])
        number = ended[name]
        ended[name] += 1
        if report["outcome"] == "skipped":
            outcome.skipped[name] = reason
        elif report["outcome"] == "failed":
            outcome.failed[name] = reason
            show(f"[{len(ended)}/{count}] failed: {name}: {reason}")
        elif number == 0:
            show(f"[{len(ended)}/{count}] {name}")
        elif max(ended.values()) == ended[name] and sum(times > number for times in ended.values()) == 1:
            show(f"pass {number + 1} of {passes}")
    return outcome
