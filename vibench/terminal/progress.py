"""Progress of a run: a bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from vibench.execution.run import Agenda, Observer
from vibench.stages.base import Stage
from vibench.study.cells import Cell
from vibench.terminal.console import print_line

LINE_EVERY = 4
"""Parts of a stage that share one line of progress."""


class TimeLeft:
    """Estimate of the seconds left from the mean wall seconds of the stages of each sort done so far."""

    def __init__(self, pending: Sequence[Stage], jobs: int) -> None:
        self._left = Counter(stage.sort for stage in pending)
        self._done: dict[str, list[float]] = {}
        self._jobs = jobs

    def add(self, stage: Stage) -> None:
        """Count a stage that was planned later."""
        self._left[stage.sort] += 1

    def done(self, stage: Stage, wall: float) -> None:
        """Count a finished stage."""
        self._left[stage.sort] -= 1
        self._done.setdefault(stage.sort, []).append(wall)

    def seconds(self) -> float | None:
        """Seconds left, `None` before there is anything to judge by."""
        if not self._done:
            return None
        every = [wall for walls in self._done.values() for wall in walls]
        left = (max(count, 0) * fmean(self._done.get(sort, every)) for sort, count in self._left.items())
        return sum(left) / self._jobs


def duration(seconds: float) -> str:
    """A duration in words: "40 s", "3 min", "1 h 20 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


class ProgressDisplay(Observer):
    """Shows the progress of a run: a bar on a terminal, lines elsewhere; the observer of `run_study`."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._left = TimeLeft([], 1)
        self._cells = self._total = 0
        self._parts: Counter[str] = Counter()
        self._done: Counter[str] = Counter()
        self._bar: Progress | None = None

    def __enter__(self) -> ProgressDisplay:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def note(self, line: str) -> None:
        """Say something the user should know."""
        print_line(self._console, line)

    def start(self, agenda: Agenda) -> None:
        """Say what is to be done; cells that are unavailable here get their row without it."""
        self._left = TimeLeft(agenda.stages, max(agenda.workers, 1))
        self._parts = Counter(stage.label for stage in agenda.stages if stage.partial)
        self._total = agenda.to_run
        workers = f" on {agenda.workers} worker{'s' * (agenda.workers != 1)}" * (agenda.workers > 0)
        to_run = agenda.to_run - agenda.unavailable
        print_line(self._console, f"{agenda.cells} cells, {to_run} to run, {len(agenda.stages)} stages{workers}")
        if self._console.is_terminal and agenda.stages:
            columns = ("[progress.description]{task.description}", BarColumn(), MofNCompleteColumn())
            self._bar = Progress(
                *columns, TimeElapsedColumn(), TextColumn("{task.fields[left]}"), console=self._console
            )
            self._task = self._bar.add_task("stages", total=len(agenda.stages), left="")
            self._bar.start()

    def stage(self, stage: Stage, wall: float) -> None:
        """A stage is done."""
        self._left.done(stage, wall)
        if self._bar is not None:
            self._bar.update(self._task, advance=1, left=self._left_text())
        elif stage.partial:  # the first stages of a run, which take long before a cell has its row
            self._done[stage.label] += 1
            done, parts = self._done[stage.label], self._parts[stage.label]
            if done % LINE_EVERY == 0 or done == parts:
                print_line(self._console, f"{stage.label}: {done} of {parts} parts{self._left_text(', ')}")

    def plan(self, stage: Stage) -> None:
        """A stage was added: the timing of cells that have their rows."""
        self._left.add(stage)
        if self._bar is not None:
            self._bar.update(self._task, total=(self._bar.tasks[0].total or 0) + 1)

    def cell(self, cell: Cell, row: Mapping[str, Any]) -> None:
        """A cell has its row."""
        self._cells += 1
        reason = f" ({row['reason']})" if row["reason"] else ""
        if self._bar is None or row["reason"]:
            line = f"[{self._cells}/{self._total}] {row['status']}: {cell}{reason}"
            print_line(self._console, line + self._left_text(", "))

    def _left_text(self, before: str = "") -> str:
        seconds = self._left.seconds()
        return "" if seconds is None or seconds < 1.0 else f"{before}about {duration(seconds)} left"
