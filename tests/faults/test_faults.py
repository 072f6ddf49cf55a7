import contextlib
import os
import random
import signal
import sqlite3
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from forking import forked
from running import Vibench, assert_same_numbers, rows, without_seconds
from samples import wire_study, write_study

from vibench.results.sqlite import FILE

WIRES = [{"name": "wire", "label": f"{nodes}", "options": {"nodes": nodes}} for nodes in (20, 40)]
LONG = wire_study(
    problem=WIRES, timing_rounds=2, dual=["cpg", "mcpg"], primal=["decorrelated", "online-supremizers", "offline-pga"],
    solvers=["piqp", "osqp", "gives-up"],
    tolerances=[{"pod": [1e-2, 1e-3], "dual": [1e-2], "primal": {"offline-pga": [0.5, 0.1]}}],
)  # fmt: skip
SHORT = LONG | {
    "problem": WIRES[:1], "dual": ["mcpg"],
    "tolerances": [{"pod": [1e-2], "dual": [1e-2], "primal": {"offline-pga": [0.5]}}],
}  # fmt: skip
STUDIES = {"long": LONG, "short": SHORT}

OPTIONS = ("run", "study.toml", "--jobs", "2", "--out", "out")
ALONE = ("--jobs", "1")
"""The number of jobs changes no result: runs that nothing happens to do with one process."""


@dataclass(frozen=True)
class Undisturbed:
    folder: Path
    seconds: float


@pytest.fixture(scope="module")
def undisturbed(vibench: Vibench, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Undisturbed]:
    @cache
    def run(length: str) -> Undisturbed:
        folder, start = tmp_path_factory.mktemp("undisturbed"), time.monotonic()
        write_study(folder, STUDIES[length])
        assert vibench(folder, *OPTIONS, *ALONE).returncode == 0
        assert len(rows(folder / "out")) == {"long": 2 * 2 * 4 * 3 * 2, "short": 3 * 3}[length]
        return Undisturbed(folder / "out", time.monotonic() - start)

    return run


@pytest.fixture
def place(length: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VIBENCH_CACHE", str(tmp_path / "cache"))
    write_study(tmp_path, STUDIES[length])
    return tmp_path


def seen(folder: Path) -> dict[str, dict[str, Any]]:
    """The cells that have a row, without their seconds, which a later run measures for whole groups of cells.

    None where a run did not come so far as to make the table.
    """
    with contextlib.suppress(sqlite3.OperationalError):
        return {row["cell"]: without_seconds(row) for row in rows(folder)} if (folder / FILE).is_file() else {}
    return {}


def kill_at_random(arguments: list[str], place: Path, plugins: Path, rng: random.Random, within: float) -> bool:
    """Begin a run and kill it, or the group that it leads, within some seconds; `False` if it was quicker."""
    with forked(arguments, place, plugins) as process:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=within * rng.random())
        if process.returncode is not None:
            assert process.returncode == 0
            return False
        if rng.random() < 0.5:
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return True


@pytest.mark.long
@pytest.mark.parametrize(
    ("kills", "executor", "length"), [(2, "local", "short"), (50, "local", "long"), (50, "dask", "long")]
)
def test_a_run_that_is_killed_again_and_again_loses_and_doubles_nothing(
    kills: int, executor: str, length: str, undisturbed: Callable[[str], Undisturbed], plugins_folder: Path,
    vibench: Vibench, place: Path,
) -> None:  # fmt: skip
    rng, killed, number, at_work = random.Random(kills), 0, 0, 0
    whole = undisturbed(length)
    seconds = 0.8 * whole.seconds
    while killed < kills:
        number += 1
        out, known = f"out{number}", {}
        again = [*OPTIONS[:-1], out, "--executor", executor]
        while killed < kills and kill_at_random(again, place, plugins_folder, rng, seconds):
            killed += 1
            found = seen(place / out)
            assert {key: found.get(key) for key in known} == known  # not one that was there is gone, or another one
            at_work += len(found) > len(known)
            known = found
        done = vibench(place, *OPTIONS[:-1], out, *ALONE)
        assert (done.returncode, done.stderr) == (0, "")
        assert {key: seen(place / out)[key] for key in known} == known
        assert_same_numbers(whole.folder, place / out)
    assert at_work > 0 or kills < 10


@pytest.mark.long
@pytest.mark.parametrize(("kib", "length"), [*((kib, "long") for kib in (1, 12, 40, 100, 300)), (100, "short")])
def test_a_full_disk_stops_a_run_with_one_line_and_a_later_one_completes_it(
    kib: int, length: str, undisturbed: Callable[[str], Undisturbed], vibench: Vibench, place: Path
) -> None:
    full = vibench(place, *OPTIONS, file_kib=kib)
    assert full.returncode in (1, 2)
    assert full.stderr.startswith("vibench: ")
    assert "cannot be written" in full.stderr
    assert full.stderr.count("\n") == 1
    done = vibench(place, *OPTIONS, *ALONE)
    assert (done.returncode, done.stderr) == (0, "")
    assert_same_numbers(undisturbed(length).folder, place / "out")
