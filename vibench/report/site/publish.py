"""A static site of some runs: pages and data with relative links, for any host of files and for none."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from vibench.files import TEMPORARY
from vibench.provenance import distribution_version
from vibench.report import html
from vibench.report.comparison.compare import Comparison, compare
from vibench.report.comparison.runs import compared_runs
from vibench.report.site import folder
from vibench.report.site.citation import Citation, requirements
from vibench.report.site.identifying import cleaned, left
from vibench.report.site.published_run import FILTERED, SHOWN_CELLS, PublishedRun, folder_names
from vibench.results import formats
from vibench.results.paired_timing import PairedTiming
from vibench.results.ranking import Criterion, Standings, leaderboard
from vibench.results.read import in_order, read_table, whole_numbers
from vibench.results.sqlite import FILE, open_read_only

TABLES = ("cells", "thresholds", "disagreements")
"""Tables that are published as CSV, too; all of them are in the results file."""

LIMIT = 1.25
"""Factor of the comparisons on a site."""

MOST_CHANGES = 500
"""Changes that a page lists; the CSV beside it has all."""


def publish(
    paths: Sequence[Path],
    site: Path,
    citation: Citation,
    notes: Mapping[Path, str] | None = None,
    *,
    figures: bool = True,
    ask: Callable[[Iterator[str]], None] = lambda _: None,
) -> Path:
    """Write the site of some results files; the same files give the same site.

    The folder is new, empty, or one that was written by this function, whose files are replaced. Notes are remarks on
    results files, which stand on the pages of their runs; with `figures` reports have pictures. Paths, the user's name
    and that of the host are taken out; `ask` gets lines on what could still identify somebody, before anything is
    written.

    Returns the first page. Raises a `RequestError` if a results file cannot be read, or the folder holds files of
    others or cannot be written.
    """
    folder.check(site)
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as scratch:
        copies = [Path(scratch, name, FILE) for name in _names(paths)]
        for path, copy in zip(paths, copies, strict=True):
            cleaned(path, copy)
        runs = compared_runs(copies)
        names = [run.name for run in runs]
        ask(left(copies, names, citation.authors))
        published = [
            PublishedRun(run, own, (notes or {}).get(path, ""))
            for run, path, own in zip(runs, paths, folder_names(names), strict=True)
        ]
        folder.write(site, lambda new: _fill(new, published, citation, figures=figures))
    return site / folder.FIRST_PAGE


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of runs, all different: the last folder or the file, without the folders before it, which could tell."""
    names: list[str] = []
    for path in paths:
        name = path.absolute().parent.name if path.name == FILE else path.stem
        count = 1 + sum(one.rpartition(" (")[0] == name or one == name for one in names)
        names.append(name if count == 1 else f"{name} ({count})")
    return names


def _fill(site: Path, runs: Sequence[PublishedRun], citation: Citation, *, figures: bool) -> None:
    """Write all files of the site."""
    pages = _Pages(citation)
    comparisons = {study: compare([run.run.path for run in group], LIMIT) for study, group in _comparable(runs)}
    for run in runs:
        _write_run(site / "runs" / run.folder, run, pages, figures)
    links = {run.run.name: f"runs/{run.folder}/index.html" for run in runs}
    pages.write(site / "leaderboard.html", "leaderboard", "", boards=list(_boards(runs)), links=links, way=html.way)
    sections = [_section(site, number, *item) for number, item in enumerate(comparisons.items(), start=1)]
    pages.write(site / "comparison.html", "comparison", "", sections=sections, limit=LIMIT)
    filters = {name: sorted({value for run in runs for value in run.values[name]}) for name in FILTERED}
    pages.write(site / folder.FIRST_PAGE, "index", "", runs=runs, filters=filters)
    _write(site / "CITATION.cff", citation.cff())
    _write(site / "citation.bib", citation.bibtex())


def _write_run(own: Path, run: PublishedRun, pages: _Pages, figures: bool) -> None:
    """Write the folder of one run: its page and report, its data, and what installs its versions."""
    (own / "tables").mkdir(parents=True)
    with open_read_only(run.run.path) as db:
        db.execute("VACUUM INTO ?", (str((own / FILE).absolute()),))
    _write(own / "report.html", html.page(run.run.path, figures=figures))
    for name in TABLES:
        rows = whole_numbers(in_order(read_table(run.run.path, name)))
        _write(own / "tables" / f"{name}.csv", formats.to_csv(rows))
    _write(own / "requirements.txt", requirements(run.run.versions, run.code))
    _write(own / "provenance.json", json.dumps(run.provenance, indent=1, ensure_ascii=True, sort_keys=True) + "\n")
    pages.write(own / "index.html", "run", "../../", run=run, cells=run.cells(), columns=SHOWN_CELLS, tables=TABLES)


def _comparable(runs: Sequence[PublishedRun]) -> Iterator[tuple[str, list[PublishedRun]]]:
    """Runs that have cells in common with the first one of their study, by the study's name."""
    by_study: dict[str, list[PublishedRun]] = {}
    for run in runs:
        by_study.setdefault(str(run.run.identity["study"]), []).append(run)
    for study, group in by_study.items():
        first = group[0].run.cells.keys()
        comparable = [run for run in group if run.run.cells.keys() & first]
        if len(comparable) > 1:
            yield study, comparable


def _boards(runs: Sequence[PublishedRun]) -> Iterator[tuple[PublishedRun, tuple[Standings, ...]]]:
    """The leaderboard of every run: seconds of other runs may have come from a busier machine, or other parameters."""
    for run in runs:
        cells, timings = (read_table(run.run.path, name) for name in ("cells", "timings"))
        yield run, leaderboard(in_order(cells), PairedTiming(timings.to_dict("records")))


def _section(site: Path, number: int, study: str, comparison: Comparison) -> dict[str, Any]:
    """What the page of comparisons says of the runs of one study; their changes are a file, too."""
    file = f"comparison-{number}.csv"
    _write(site / file, formats.to_csv(comparison.changes))
    frames = {
        "runs": comparison.by_run,
        "cells by column": comparison.by_column,
        "changes": comparison.changes.head(MOST_CHANGES),
    }
    return {"study": study, "file": file, "notes": comparison.notes, "count": len(comparison.changes), "tables": frames}


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


class _Pages:
    """The templates, with what all pages show."""

    def __init__(self, citation: Citation) -> None:
        self._environment = html.environment("templates/site")
        self._environment.filters["number"] = formats.cell_text
        self._shared = {
            "citation": citation,
            "vibench": distribution_version("vibench"),
            "criteria": list(Criterion),
        }

    def write(self, path: Path, name: str, root: str, **content: Any) -> None:
        """Write a page of the template of that name; `root` leads from it to the folder of the site."""
        template = self._environment.get_template(f"{name}.html.j2")
        _write(path, template.render(**self._shared, **content, root=root, page=name))
