"""Progress of a run: a bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from vibench.execution.run import Agenda, Observer
from vibench.plugins.kinds import PROBLEM
from vibench.plugins.plugin import Plugin
from vibench.qp.status import Status
from vibench.stages.base import Stage
from vibench.study.cells import Cell
from vibench.text import new_console, print_line, printable

LINE_EVERY = 4
"""Parts of a stage that share one line of progress."""

CELL_LINES = 25
"""Lines about ok cells where there is no terminal: of larger runs, some cells have one."""

REASONS = 10
"""Reasons for which cells are not ok that are printed."""

ALIKE = 3
"""Lines about cells that are not ok for reasons that differ in their numbers alone."""


FIRST_SECONDS = 20.0
"""A line says how long the run will take when a stage has taken so long, its pace is known, and none is done."""


_Sort = tuple[Plugin | None, str]
"""Stages of one problem that take about as long: the problem, and `Stage.sort`."""


@dataclass
class _Count:
    """What is known of the stages of one sort: how many were planned, are left and are done, and wall seconds."""

    effort: float = 0.0
    planned: int = 0
    left: int = 0
    done: int = 0
    wall: float = 0.0


@dataclass
class _Running:
    """A running stage: when it began, and the shares of it (share, seconds) that were seen to be done."""

    sort: _Sort
    began: float
    first: tuple[float, float] = (0.0, 0.0)
    last: tuple[float, float] = (0.0, 0.0)

    def note(self, share: float, now: float) -> None:
        """It tells this share."""
        if share > self.last[0]:
            self.last = share, now - self.began
            self.first = self.first if self.first[0] else self.last

    @property
    def tells_more(self) -> bool:
        """Whether two shares are known: the first one has the set-up."""
        return self.last != self.first

    @property
    def seconds(self) -> float:
        """How long it takes but for the set-up, if that is told apart; there is a share."""
        (share, seconds), (before, setup) = self.last, self.first if self.tells_more else (0.0, 0.0)
        return (seconds - setup) / (share - before)


class TimeLeft:
    """Estimate of the seconds left from the mean wall seconds of the stages of each sort done so far.

    A stage that tells which share of it is done counts before its end, too. How long stages of a sort take that has not
    been seen follows from their `effort`, and from what those of the others of the same problem take.
    """

    def __init__(self, pending: Sequence[Stage], jobs: int) -> None:
        self._sorts: defaultdict[_Sort, _Count] = defaultdict(_Count)
        self._running: dict[str, _Running] = {}
        self._jobs = jobs
        for stage in pending:
            self.add(stage)

    def add(self, stage: Stage) -> None:
        """Count a stage that is planned."""
        count = self._sorts[_sort(stage)]
        count.planned += 1
        count.left += 1
        count.effort += stage.effort

    def begin(self, stage: Stage) -> None:
        """Note when a stage begins."""
        self._running[stage.key] = _Running(_sort(stage), monotonic())

    def fractions_done(self, done: Sequence[tuple[Stage, float]]) -> float:
        """Note which shares of the running stages are done.

        Returns how long the longest one of those has taken whose pace is known.
        """
        now, began = monotonic(), self._running
        self._running = {stage.key: began[stage.key] for stage, _ in done}  # without those that have failed
        for stage, share in done:
            self._running[stage.key].note(share, now)
        return max((now - one.began for one in self._running.values() if one.tells_more), default=0.0)

    def done(self, stage: Stage, wall: float) -> None:
        """Count a finished stage."""
        self._running.pop(stage.key, None)
        count = self._sorts[_sort(stage)]
        count.left -= 1
        count.done += 1
        count.wall += wall

    def seconds(self) -> float | None:
        """Seconds left, `None` before there is anything to judge by."""
        means = {sort: count.wall / count.done for sort, count in self._sorts.items() if count.done}
        telling = [one for one in self._running.values() if one.last[0]]
        for one in telling:
            means.setdefault(one.sort, one.seconds)
        if not means:
            return None
        paces = {problem: self._pace(means, problem) for problem, _ in self._sorts}
        left = 0.0
        for sort, count in self._sorts.items():
            expected = paces[sort[0]] * count.effort / max(count.planned, 1)
            left += max(count.left, 0) * means.get(sort, expected)
        return max(0.0, left - sum(one.last[0] * means[one.sort] for one in telling)) / self._jobs

    def _pace(self, means: Mapping[_Sort, float], problem: Plugin | None) -> float:
        """Seconds of what takes as long as a high-fidelity solution, by the seen stages of a problem, or of all."""
        seen = [sort for sort in means if sort[0] == problem] or list(means)
        wall = sum(means[sort] * self._sorts[sort].planned for sort in seen)
        return wall / max(sum(self._sorts[sort].effort for sort in seen), 1.0)


def _sort(stage: Stage) -> _Sort:
    return next((plugin for plugin in stage.plugins if plugin.kind is PROBLEM), None), stage.sort


def duration(seconds: float) -> str:
    """A duration in words: "40 s", "3 min", "1 h 20 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def progress_bar(console: Console) -> Progress:
    """A bar that fits 80 columns: what is being done, how much of it is done, and the time left."""
    bar = BarColumn(bar_width=16)
    what, left = (TextColumn(text, markup=False) for text in ("{task.description}", "{task.fields[left]}"))
    return Progress(what, bar, MofNCompleteColumn(), TimeElapsedColumn(), left, console=console)


class DrawingDisplay:
    """Shows which figure is being drawn: a bar on a terminal, one line elsewhere."""

    def __init__(self, console: Console | None = None) -> None:
        console = console or new_console()
        self._bar = progress_bar(console) if console.is_terminal else None
        if self._bar is None:
            print_line(console, "figures …")
        else:
            self._task = self._bar.add_task("figures", total=None, left="")

    def __enter__(self) -> DrawingDisplay:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, name: str, done: int, count: int) -> None:
        """A figure is being drawn; `done` of `count` are there."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=count, left=printable(name))


class ProgressDisplay(Observer):
    """Shows the progress of a run: a bar on a terminal, lines elsewhere; the observer of `run_study`."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or new_console()
        self._left = TimeLeft([], 1)
        self._cells = self._total = 0
        self._parts: Counter[str] = Counter()
        self._done: Counter[str] = Counter()
        self._failures: Counter[tuple[str, str]] = Counter()
        self._begun: set[str] = set()
        self._none_can_run = self._has_estimated = False
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
        self._none_can_run = agenda.unavailable == agenda.cells  # the command ends with the reason
        workers = f" on {agenda.workers} worker{'s' * (agenda.workers != 1)}" * (agenda.workers > 0)
        to_run = agenda.to_run - agenda.unavailable
        print_line(self._console, f"{agenda.cells} cells, {to_run} to run, {len(agenda.stages)} stages{workers}")
        if self._console.is_terminal and agenda.stages:
            self._bar = progress_bar(self._console)
            self._task = self._bar.add_task("stages", total=len(agenda.stages), left="")
            self._bar.start()

    def begin(self, stage: Stage) -> None:
        """A stage begins: the bar names it, lines name each sort once."""
        self._left.begin(stage)
        if self._bar is not None:
            self._bar.update(self._task, description=stage.label)
        elif stage.label not in self._begun:
            self._begun.add(stage.label)
            print_line(self._console, f"{stage.label} …")

    def fractions_done(self, done: Sequence[tuple[Stage, float]]) -> None:
        """Shares of running stages: the bar has the time left from the first one on, and so does one line."""
        longest = self._left.fractions_done(done)
        if self._bar is not None:
            self._bar.update(self._task, left=self._left_text())
        elif longest > FIRST_SECONDS and not self._has_estimated:
            stage, share = max(done, key=lambda one: one[1])
            self._has_estimated = True
            print_line(self._console, f"{stage.label}: {share:.0%} of one part{self._left_text(', ')}")

    def stage(self, stage: Stage, wall: float) -> None:
        """A stage is done."""
        self._has_estimated = True
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
        """A cell has its row: said of some cells, and of the first ones that are not ok for a reason."""
        self._cells += 1
        count = f"[{self._cells}/{self._total}]"
        if row["reason"]:
            kind = kind_of_failure(row)
            self._failures[kind] += 1
            if row["status"] == Status.UNAVAILABLE:
                if self._failures[kind] == 1 and not self._none_can_run:
                    print_line(self._console, f"{row['status']}: {row['reason']}")
            elif self._failures[kind] <= ALIKE and len(self._failures) <= REASONS:
                print_line(self._console, f"{count} {row['status']}: {cell} ({row['reason']})")
                if self._failures[kind] == ALIKE:
                    print_line(self._console, "others like these are counted at the end")
        elif self._bar is None and (self._cells % -(-self._total // CELL_LINES) == 0 or self._cells == self._total):
            print_line(self._console, f"{count} {row['status']}: {cell}{self._left_text(', ')}")

    def _left_text(self, before: str = "") -> str:
        seconds = self._left.seconds()
        return "" if seconds is None or seconds < 1.0 else f"{before}about {duration(seconds)} left"


def kind_of_failure(row: Mapping[str, Any]) -> tuple[str, str]:
    """Status and reason of a cell without the numbers in it."""
    return row["status"], re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", row["reason"] or "")
