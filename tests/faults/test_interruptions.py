import contextlib
import os
import shutil
import signal
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fake_plugins import Wire
from forking import forked
from running import PATIENCE, Main, Vibench, read_until, rows, run_wire, started, without_seconds, workers
from samples import ROUNDS, wire_study, write_study

import vibench
from vibench.execution.run import Observer, Options, run_study
from vibench.results import read
from vibench.results.database import ResultsDatabase
from vibench.stages.artefacts import Store
from vibench.study.cells import Cell

RUN = ("run", "study.toml", "--jobs", "2", "--no-figures")


@pytest.fixture
def waiting(tmp_path: Path) -> Path:
    """Folder of a study of two cells; the second waits for a file "go on" there."""
    waits = {"name": "cone-waits", "options": {"file": str(tmp_path / "go on")}}
    write_study(tmp_path, wire_study(dual=["cpg", waits]))
    return tmp_path


@pytest.mark.parametrize(
    ("kill", "code"),
    [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 130, marks=pytest.mark.long), (signal.SIGKILL, -9)],
)
def test_a_run_resumes(kill: signal.Signals, code: int, plugins_folder: Path, vibench: Vibench, waiting: Path) -> None:
    with forked(RUN, waiting, plugins_folder) as process:
        read_until(process, "[1/2] ok")
        os.killpg(process.pid, kill)  # the workers too, as a terminal does
        out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == code
    assert err == ""
    folder = waiting / "runs" / "wire"
    before = rows(folder)
    assert [row["dual"] for row in before] == ["cpg"]
    if kill is not signal.SIGKILL:
        assert "interrupted: 1 cells have no row yet; the same command resumes the run" in out
        assert len(pd.read_csv(folder / "tables" / "cells.csv")) == 1

    (waiting / "go on").touch()
    printed, after = run_wire(vibench, waiting)
    assert "2 cells, 1 to run" in printed
    assert without_seconds(after[0]) == without_seconds(before[0])
    assert all(row["online_s"] > 0.0 and row["timing_rounds"] == ROUNDS for row in after)
    assert [(row["dual"], row["status"]) for row in after] == [("cpg", "ok"), ("cone-waits", "ok")]
    assert len(rows(folder, "queries")) == 6


class Watch(Observer):
    """Interrupts a run as soon as a number of cells have their rows."""

    def __init__(self, last: int) -> None:
        self.cells, self.last = list[str](), last

    def cell(self, cell: Cell, row: Mapping[str, Any]) -> None:
        self.cells.append(cell.key)
        if len(self.cells) == self.last:
            raise KeyboardInterrupt


@pytest.mark.long
def test_a_thousand_cells_are_resumed_beside_a_thousand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As above for two. Artefacts read and transactions written are counted: a clock would measure the machine."""
    accuracies, counts = np.geomspace(1e-4, 1e-9, 1000).tolist(), Counter[str]()
    problem, tolerances = {"name": Wire, "options": {"nodes": 4}}, [{"pod": [1e-1, 1e-3], "dual": [1e-1]}]
    axes = wire_study(problem=[problem], tolerances=tolerances, accuracy=accuracies, validation=1, timing_rounds=1)
    study = vibench.Study(**axes)
    for kind, name in ((Store, "get"), (Store, "put"), (ResultsDatabase, "_writing")):
        plain = getattr(kind, name)
        monkeypatch.setattr(kind, name, lambda *a, _=(plain, name), **b: counts.update([_[1]]) or _[0](*a, **b))
    spent, watches = [], (Watch(1000), Watch(1000))
    for watch, missing in zip(watches, (1000, 0), strict=True):
        counts.clear()
        result = run_study(study, tmp_path / "run", watch, Options(2, False, False, "local", None, 1))
        assert (result.interrupted, result.missing, len(result.rows)) == (True, missing, 2000 - missing)
        spent.append(counts.total())
    assert len({*watches[0].cells, *watches[1].cells}) == 2000
    assert np.all(np.array(spent) < [1200, 2400])


def test_workers_do_not_see_ctrl_c(command: str, plugins_folder: Path, tmp_path: Path) -> None:
    """A terminal tells the group of the command; workers are in others from their first moment."""
    write_study(tmp_path, wire_study(problem=["wire-raises"]))
    groups: dict[int, int] = {}  # of each worker: how many there are in turn depends on how busy the machine is
    with started([command, *RUN], tmp_path, plugins_folder) as process:
        while process.poll() is None:
            for worker in workers(process.pid):
                with contextlib.suppress(ProcessLookupError):
                    groups[worker] = os.getpgid(worker)
            time.sleep(0.005)
        _, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (0, "")
    assert groups
    assert all(group == worker for worker, group in groups.items())


def test_a_second_interrupt_changes_nothing(plugins_folder: Path, waiting: Path) -> None:
    """Under --fresh the same command would begin anew, and says so."""
    with forked([*RUN, "--fresh"], waiting, plugins_folder) as process:
        read_until(process, "[1/2] ok")
        for _ in range(20):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
            time.sleep(0.01)
        out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (130, "")
    assert "interrupted: 1 cells have no row yet; the same command without --fresh resumes the run" in out
    assert len(rows(waiting / "runs" / "wire")) == 1


def test_two_runs_do_not_write_into_one_folder(plugins_folder: Path, vibench: Vibench, waiting: Path) -> None:
    with forked(RUN, waiting, plugins_folder) as process:
        read_until(process, "[1/2] ok")
        for options in ((), ("--fresh",)):
            second = vibench(waiting, "run", "study.toml", *options)
            assert second.returncode == 2
            assert f"another run writes into 'runs/wire' (process {process.pid} on" in second.stderr
        refused = vibench(waiting, "clean", "--yes")
        assert refused.returncode == 2
        assert "a run uses the artefacts in" in refused.stderr
        (waiting / "go on").touch()
        out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (0, "")
    assert "2 cells, all ok" in out


@pytest.mark.parametrize("swapped", [pytest.param(False, marks=pytest.mark.long), True], ids=["removed", "swapped"])
def test_a_run_whose_folder_is_gone_ends(swapped: bool, plugins_folder: Path, vibench: Vibench, waiting: Path) -> None:
    """At the next commit; what was computed is in the store of artefacts, from which the next run takes it."""
    folder = waiting / "runs" / "wire"
    with forked(RUN, waiting, plugins_folder) as process:
        read_until(process, "[1/2] ok")
        folder.rename(waiting / "elsewhere")
        if swapped:
            shutil.copytree(waiting / "elsewhere", folder)
        (waiting / "go on").touch()
        out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "removed or replaced during the run; the same command runs its cells again" in err
    assert err.endswith("with the artefacts that are stored\n")
    assert err.count("\n") == 1
    assert "results:" not in out
    assert [row["dual"] for row in rows(waiting / "elsewhere")] == ["cpg"]
    shutil.rmtree(folder, ignore_errors=True)
    printed, after = run_wire(vibench, waiting)
    assert "2 cells, 2 to run" in printed
    assert "high-fidelity solutions" not in printed
    assert [row["status"] for row in after] == ["ok", "ok"]


INTERRUPTED = """
import os, signal, sys

class After:
    def find_spec(self, name, path=None, target=None):
        module = sys.modules.get(os.environ["INTERRUPTED_AFTER"])
        if module is not None and not module.__spec__._initializing:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, After())
"""
"""What Python runs before a command that gets Ctrl-C at the first import after that of a module."""


@pytest.mark.parametrize("module", ["typer", "numpy", pytest.param("vibench.execution.run", marks=pytest.mark.long)])
def test_an_interrupt_among_the_imports_ends_the_command_with_a_line(
    module: str, command: str, plugins_folder: Path, waiting: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It interrupts itself: a signal from here would come too late where this process has to wait for its turn."""
    monkeypatch.setenv("INTERRUPTED_AFTER", module)
    (waiting / "first").mkdir()
    (waiting / "first" / "sitecustomize.py").write_text(INTERRUPTED)
    (waiting / "go on").touch()  # a run that misses the signal comes to its end
    path = Path(os.pathsep.join(map(str, (waiting / "first", plugins_folder))))
    with started([command, "run", "study.toml", "--no-figures"], waiting, path) as process:
        out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out, err) == (130, "", "vibench: interrupted\n")
    assert not (waiting / "runs").exists()


def test_an_interrupt_ends_any_command_with_a_line(main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(read, "results_file", interrupted)
    assert main("show", "quick") == (130, "", "vibench: interrupted\n")
