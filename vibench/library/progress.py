"""Progress of a run: a bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from time import monotonic
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from vibench.execution.run import Agenda, Observer
from vibench.plugins.kinds import PluginKind
from vibench.qp.status import Status
from vibench.stages.base import Stage
from vibench.study.cells import Cell
from vibench.text import new_console, print_line, printable

# Stages of one problem that take about as long: its name and options, and `Stage.kind_of_work`.
_Sort = tuple[str, str]


class _Running:
    """A running stage: when it began, and the first and the last (fraction, seconds) that it reported."""

    def __init__(self, sort: _Sort) -> None:
        self.sort, self.began = sort, monotonic()
        self.first = self.last = (0.0, 0.0)

    def note(self, fraction: float, now: float) -> None:
        if fraction > self.last[0]:
            self.last = fraction, now - self.began
            self.first = self.first if self.first[0] else self.last

    @property
    def seconds(self) -> float:
        """Seconds of all of it, without the set-up, which the first fraction includes, if there is another one."""
        (fraction, seconds), (before, setup) = self.last, self.first if self.last != self.first else (0.0, 0.0)
        return (seconds - setup) / (fraction - before)


class TimeLeft:
    """Estimate of the seconds left from the mean wall seconds of the stages of each sort done so far."""

    # A stage that reports its fractions counts before its end. Sorts without any finished stage take as long as their
    # `effort` says, at the pace of the other sorts of the same problem.

    def __init__(self, pending: Sequence[Stage], jobs: int) -> None:
        self._jobs = jobs
        self._planned, self._left, self._done = Counter[_Sort](), Counter[_Sort](), Counter[_Sort]()
        self._effort, self._wall = defaultdict[_Sort, float](float), defaultdict[_Sort, float](float)
        self._running: dict[str, _Running] = {}
        for stage in pending:
            self.add(stage)

    def add(self, stage: Stage) -> None:
        """Count a stage that is planned."""
        sort = _sort(stage)
        self._planned[sort] += 1
        self._left[sort] += 1
        self._effort[sort] += stage.effort

    def begin(self, stage: Stage) -> None:
        """Note when a stage begins."""
        self._running[stage.key] = _Running(_sort(stage))

    def fractions_done(self, done: Sequence[tuple[Stage, float]]) -> float:
        """Note the fractions of the running stages; returns the longest time that one with a known pace has taken."""
        now, began = monotonic(), self._running
        # Stages that have failed are no longer among those that run.
        self._running = {stage.key: began[stage.key] for stage, _ in done}
        for stage, fraction in done:
            self._running[stage.key].note(fraction, now)
        return max((now - one.began for one in self._running.values() if one.last != one.first), default=0.0)

    def done(self, stage: Stage, wall: float) -> None:
        """Count a finished stage."""
        self._running.pop(stage.key, None)
        sort = _sort(stage)
        self._left[sort] -= 1
        self._done[sort] += 1
        self._wall[sort] += wall

    def seconds(self) -> float | None:
        """Seconds left, `None` before there is anything to judge by."""
        # Stages of one sort take about as long; a running one adds its own pace where none is finished.
        means = {sort: self._wall[sort] / count for sort, count in self._done.items()}
        telling = [one for one in self._running.values() if one.last[0]]
        for one in telling:
            means.setdefault(one.sort, one.seconds)
        if not means:
            return None
        paces = {problem: self._pace(means, problem) for problem in {sort[0] for sort in self._left}}
        expected = {sort: paces[sort[0]] * self._effort[sort] / max(self._planned[sort], 1) for sort in self._left}
        # A stage may be done twice, after a worker was lost.
        left = sum(max(count, 0) * means.get(sort, expected[sort]) for sort, count in self._left.items())
        return max(0.0, left - sum(one.last[0] * means[one.sort] for one in telling)) / self._jobs

    def _pace(self, means: Mapping[_Sort, float], problem: str) -> float:
        """Seconds per unit of effort, from the seen sorts of a problem, or of all if there are none."""
        seen = [sort for sort in means if sort[0] == problem] or list(means)
        wall = sum(means[sort] * self._planned[sort] for sort in seen)
        return wall / max(sum(self._effort[sort] for sort in seen), 1.0)


def _sort(stage: Stage) -> _Sort:
    problems = (f"{one.name} {one.options}" for one in stage.plugins if one.kind is PluginKind.PROBLEM)
    return next(problems, ""), stage.kind_of_work


def duration(seconds: float) -> str:
    """A duration in words: "40 s", "3 min", "1 h 20 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


class _Display:
    """A bar on a terminal, lines elsewhere; the bar is stopped at the end of a `with` statement."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or new_console()
        self._bar: Progress | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _draw(self, task: str, total: int | None) -> None:
        if self._console.is_terminal:
            # A bar of 16 columns leaves room in 80 for the longest label and the time left.
            bar = BarColumn(bar_width=16)
            what, left = (TextColumn(text, markup=False) for text in ("{task.description}", "{task.fields[left]}"))
            self._bar = Progress(what, bar, MofNCompleteColumn(), TimeElapsedColumn(), left, console=self._console)
            self._task = self._bar.add_task(task, total=total, left="")
            self._bar.start()

    def _update(self, **changes: Any) -> bool:
        """Change the bar; returns whether there is one."""
        if self._bar is not None:
            self._bar.update(self._task, **changes)
        return self._bar is not None


class DrawingDisplay(_Display):
    """The name of the figure that is being drawn: in a bar on a terminal, one line for all elsewhere."""

    def __enter__(self) -> Self:
        self._draw("figures", None)
        if self._bar is None:
            print_line(self._console, "figures …")
        return self

    def show(self, name: str, done: int, count: int) -> None:
        """Name the figure that is being drawn; `done` of `count` are there."""
        self._update(completed=done, total=count, left=printable(name))


class ProgressDisplay(_Display, Observer):
    """Progress of a run: a bar on a terminal, lines elsewhere; the observer of `run_study`."""

    def __init__(self, console: Console | None = None) -> None:
        super().__init__(console)
        self._left = TimeLeft([], 1)
        self._cells = self._total = 0
        self._parts, self._done = Counter[str](), Counter[str]()
        self._failures = Counter[tuple[str, str]]()
        self._begun: set[str] = set()
        self._none_can_run = self._has_estimated = False

    def note(self, line: str) -> None:
        """Print a line that the user should know."""
        print_line(self._console, line)

    def start(self, agenda: Agenda) -> None:
        """Print the numbers of cells and stages; cells that are unavailable here get their row without a stage."""
        self._left = TimeLeft(agenda.stages, max(agenda.workers, 1))
        self._parts = Counter(stage.label for stage in agenda.stages if stage.partial)
        self._total = agenda.to_run
        # The command ends with the reason if no cell can run.
        self._none_can_run = agenda.unavailable == agenda.cells
        workers = f" on {agenda.workers} worker{'s' * (agenda.workers != 1)}" * (agenda.workers > 0)
        to_run = agenda.to_run - agenda.unavailable
        self.note(f"{agenda.cells} cells, {to_run} to run, {len(agenda.stages)} stages{workers}")
        if agenda.stages:
            self._draw("stages", len(agenda.stages))

    def begin(self, stage: Stage) -> None:
        """Name a stage that begins: the bar names every one, lines each label once."""
        self._left.begin(stage)
        if not self._update(description=stage.label) and stage.label not in self._begun:
            self._begun.add(stage.label)
            self.note(f"{stage.label} …")

    def fractions_done(self, done: Sequence[tuple[Stage, float]]) -> None:
        """Show the time left; without a bar in one line, when a stage has taken 20 s before any is done."""
        longest = self._left.fractions_done(done)
        if not self._update(left=self._left_text()) and longest > 20.0 and not self._has_estimated:
            stage, fraction = max(done, key=lambda one: one[1])
            self._has_estimated = True
            self.note(f"{stage.label}: {fraction:.0%} of one part{self._left_text(', ')}")

    def stage(self, stage: Stage, wall: float) -> None:
        """Count a stage that is done."""
        self._has_estimated = True
        self._left.done(stage, wall)
        # The first stages of a run are many parts, and take long before a cell has its row: every fourth has a line.
        if not self._update(advance=1, left=self._left_text()) and stage.partial:
            self._done[stage.label] += 1
            done, parts = self._done[stage.label], self._parts[stage.label]
            if done % 4 == 0 or done == parts:
                self.note(f"{stage.label}: {done} of {parts} parts{self._left_text(', ')}")

    def plan(self, stage: Stage) -> None:
        """Count a stage that was added: the timing of cells that have their rows."""
        self._left.add(stage)
        if self._bar is not None:
            self._update(total=(self._bar.tasks[0].total or 0) + 1)

    def cell(self, cell: Cell, row: Mapping[str, Any]) -> None:
        """Print some of the cells that have their row, and the first ones that are not ok for a reason."""
        self._cells += 1
        count = f"[{self._cells}/{self._total}]"
        if row["reason"]:
            kind = kind_of_failure(row)
            self._failures[kind] += 1
            if row["status"] == Status.UNAVAILABLE:
                if self._failures[kind] == 1 and not self._none_can_run:
                    self.note(f"{row['status']}: {row['reason']}")
            # Three cells for each of ten reasons are enough to see what is wrong while the run goes on.
            elif self._failures[kind] <= 3 and len(self._failures) <= 10:
                self.note(f"{count} {row['status']}: {cell} ({row['reason']})")
                if self._failures[kind] == 3:
                    self.note("others like these are counted at the end")
        # Without a bar about 25 cells of a run have a line, and the last one.
        elif self._bar is None and (self._cells % -(-self._total // 25) == 0 or self._cells == self._total):
            self.note(f"{count} {row['status']}: {cell}{self._left_text(', ')}")

    def _left_text(self, before: str = "") -> str:
        seconds = self._left.seconds()
        return "" if seconds is None or seconds < 1.0 else f"{before}about {duration(seconds)} left"


def kind_of_failure(row: Mapping[str, Any]) -> tuple[str, str]:
    """Status and reason of a cell without the numbers in it."""
    return row["status"], re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", row["reason"] or "")
