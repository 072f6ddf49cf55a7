"""The pictures of a report."""

from __future__ import annotations

from pathlib import Path

from vibench.report.figures import for_report
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
