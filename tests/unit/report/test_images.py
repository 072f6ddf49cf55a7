"""The pictures of a report, and the processes that draw them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vibench.report.figures import OF_DUAL, OF_PROBLEM, convergence, drawings, processes, render
from vibench.report.figures.data import problem_tables
from vibench.report.html import tasks_of
from vibench.report.plots import image_of
from vibench.results.sqlite import FILE


def test_several_processes_draw_the_same_pictures_in_the_same_order(quick_run: Path) -> None:
    """Also those that read tables which are not sent to other processes."""
    name, data = next(iter(problem_tables(quick_run / FILE)))
    tasks = [task for task in tasks_of(name, data) if task[0].endswith(("errors", "shares", "outputs", "-inf-sup"))]
    alone = render(tasks, image_of)
    with processes(2) as pool:
        together = render(tasks, image_of, pool)
    assert [len(pages) for pages in alone] == [1] * 4
    assert alone == together


def test_figures_read_histories_if_and_only_if_they_are_listed(quick_run: Path) -> None:
    """Those that are not listed are drawn by other processes, which have none."""
    reading = set()
    for _, draw, data in drawings(quick_run / FILE):
        if draw in {*OF_PROBLEM.values(), *OF_DUAL.values()}:
            try:
                list(draw(replace(data, histories=None)))
            except TypeError:  # None has no rows
                reading.add(draw)
    every = (*OF_PROBLEM.values(), *OF_DUAL.values())
    assert reading == {draw for draw in every if draw.__module__ == convergence.__name__}
