"""The pictures of a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vibench.report.figures import OF_DUAL, OF_HISTORIES, OF_PROBLEM, drawings, for_report
from vibench.report.figures.data import problems
from vibench.report.page.stills import helpers, stills
from vibench.results.sqlite.reading import FILE


def test_several_processes_draw_the_same_pictures_in_the_same_order(quick_run: Path) -> None:
    """Also those that read tables which are not sent to other processes."""
    known = [one for name, data in problems(quick_run / FILE) for one in for_report(name, data, data.duals[:1])][:14]
    alone = stills(known)
    with helpers(2) as others:
        together = stills(known, others)
    assert [one.name for one in alone[0]] == [one.name for one in together[0]]
    assert alone == together


def test_figures_read_histories_if_and_only_if_they_are_listed(quick_run: Path) -> None:
    """Those that are not listed are drawn by other processes, which have none."""
    reading = set()
    for _, draw, data in drawings(quick_run / FILE):
        if draw in {*OF_PROBLEM.values(), *OF_DUAL.values()}:
            try:
                draw(replace(data, histories=None))
            except TypeError:  # None has no rows
                reading.add(draw)
    assert reading == OF_HISTORIES
