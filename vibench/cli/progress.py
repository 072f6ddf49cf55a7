"""Progress of a run: a bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from vibench.stages.base import Stage
from vibench.stages.cell_queries import QueriesStage
from vibench.stages.snapshots import CHUNKS, HighFidelity
from vibench.study.cells import Cell


class TimeLeft:
    """Estimate of the seconds left from the mean wall seconds of the stages of each sort done so far."""

    def __init__(self, pending: Sequence[Stage], jobs: int) -> None:
        self._left = Counter(_sort(stage) for stage in pending)
        self._done: dict[str, list[float]] = {}
        self._jobs = jobs

    def done(self, stage: Stage, wall: float) -> None:
        """Count a finished stage."""
        self._left[_sort(stage)] -= 1
        self._done.setdefault(_sort(stage), []).append(wall)

    def seconds(self) -> float | None:
        """Seconds left, `None` before there is anything to judge by."""
        if not self._done:
            return None
        every = [wall for walls in self._done.values() for wall in walls]
        overall = sum(every) / len(every)
        total = 0.0
        for sort, count in self._left.items():
            walls = self._done.get(sort)
            total += max(count, 0) * (sum(walls) / len(walls) if walls else overall)
        return total / self._jobs


def _sort(stage: Stage) -> str:
    return f"{type(stage).__name__} {stage.solver}" if isinstance(stage, QueriesStage) else type(stage).__name__


def duration(seconds: float) -> str:
    """A duration in words: "40 s", "3 min", "1 h 20 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


class Report:
    """Tells a person how a run goes on; the observer of `runner.run_study`."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._left = TimeLeft([], 1)
        self._cells = self._total = self._chunks = self._all_chunks = 0
        self._start = time.perf_counter()
        self._bar: Progress | None = None

    def __enter__(self) -> Report:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def start(self, cells: int, pending: Sequence[Stage], unavailable: int, workers: int) -> None:
        """Say what is to be done; cells whose solver is not installed get their row without it."""
        self._left = TimeLeft(pending, max(workers, 1))
        todo = sum(isinstance(stage, QueriesStage) for stage in pending)
        self._all_chunks = sum(isinstance(stage, HighFidelity) for stage in pending)
        self._total = todo + unavailable
        self._console.print(
            f"{cells} cells, {todo} to run, {len(pending)} stages"
            + f" on {workers} worker{'s' * (workers != 1)}" * (workers > 0)
        )
        if self._console.is_terminal and pending:
            columns = ("[progress.description]{task.description}", BarColumn(), MofNCompleteColumn())
            self._bar = Progress(
                *columns, TimeElapsedColumn(), TextColumn("{task.fields[left]}"), console=self._console
            )
            self._task = self._bar.add_task("stages", total=len(pending), left="")
            self._bar.start()

    def stage(self, stage: Stage, wall: float) -> None:
        """A stage is done."""
        self._left.done(stage, wall)
        if self._bar is not None:
            self._bar.update(self._task, advance=1, left=self._left_text())
        elif isinstance(stage, HighFidelity):
            self._chunks += 1
            if self._chunks % CHUNKS == 0 or self._chunks == self._all_chunks:
                self._console.print(
                    f"high-fidelity solutions: {self._chunks} of {self._all_chunks} parts{self._left_text(', ')}"
                )

    def cell(self, cell: Cell, row: Mapping[str, Any]) -> None:
        """A cell has its row."""
        self._cells += 1
        reason = f" ({row['reason']})" if row["reason"] else ""
        if self._bar is None or row["reason"]:
            self._console.print(
                f"[{self._cells}/{self._total}] {row['status']}: {cell}{reason}{self._left_text(', ')}",
                markup=False,
                highlight=False,
                soft_wrap=True,
            )

    def _left_text(self, before: str = "") -> str:
        seconds = self._left.seconds()
        return "" if seconds is None or seconds < 1.0 else f"{before}about {duration(seconds)} left"
