"""The pictures of a report, and the processes that draw them."""

from __future__ import annotations

from pathlib import Path

from vibench.report.figures import processes, render
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
