"""The page of a study under results/: comparison with the paper, summary, break-even, figures.

vibench run paper-obstacle && python results/scripts/study.py runs/paper-obstacle results/paper-obstacle
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
from page import CERTIFIED, SECONDS, Page, alternative, escaped, made_by, origin, read, start, write_figure

from vibench.report import figures
from vibench.report.figures.style import caption_of, styled
from vibench.results import formats
from vibench.results.ranking import relative_bounds
from vibench.results.read import read_table, results_file
from vibench_problems.paper.evidence import SOLVER, Evidence
from vibench_problems.paper.tables import columns

PAPER = ("paper-obstacle", "paper-hertz")
"""Studies of the tables of the paper."""

TABLES = ("cells", "thresholds", "disagreements")
"""Tables written beside the page. Those of all queries and histories take megabytes and stay in the run folder."""

FIGURES = {
    "benefit": ("answer",),
    "hertz-quadrature": ("answer",),
    "solvers": ("solvers",),
}
"""Kinds of figures on the page of a study."""


REPEATED = {"benefit": " --repeats 3"} | dict.fromkeys(PAPER, " --repeats 3")
"""Options of the runs whose seconds README and other pages quote: three cold processes, and offline phases."""


def main(run: str, target: str) -> None:
    path, name, cells = results_file(run), Path(target).name, read(run, "cells")
    shutil.rmtree(target, ignore_errors=True)
    page = Page(
        target,
        name,
        made_by("study", name, name, options=REPEATED.get(name, "")),
        SECONDS,
        f"`vibench run {name}` leaves the tables of all queries and histories under `runs/{name}/tables` and all "
        f"figures under `runs/{name}/figures`.",
        machine=origin(cells),
    )
    if name in PAPER:
        ((_, data),) = figures.problem_tables(path)
        evidence = Evidence(data)
        page.section(
            f"Comparison with Table {evidence.paper.table} of Niakh, Drouet, Ehrlacher and Ern (2022), δ_PGA = "
            f"{evidence.paper.tight:g}",
            comparison(evidence),
            f"Columns of vibench: {SOLVER}, full assembly; break-even by the paper's formula, with its 95 % interval.",
        )
    page.section("All cells", *outcomes(cells), formats.summary(cells))
    of_enrichments = read_table(path, "thresholds").dropna(subset="cell_a")
    if len(of_enrichments):
        page.section("Break-even of fixed enrichments", formats.break_even_table(of_enrichments))
    page.section("Figures", *dict(sorted(drawn(path, page.folder))).values())
    written = {table: frame for table in TABLES if len(frame := read(run, table))}
    if (cells["assembly"] == CERTIFIED).any():
        written["bounds"] = bounds(cells, read(run, "queries"))
    page.add(f"Full tables: {', '.join(page.link(table, frame) for table, frame in written.items())}.")
    page.write()


def bounds(cells: pd.DataFrame, queries: pd.DataFrame) -> pd.DataFrame:
    """Of every certified model the mean relative errors and bounds at online cost over its ok queries; violations."""
    fine = queries[(queries["status"] == "ok") & queries["cell"].isin(cells["cell"][cells["assembly"] == CERTIFIED])]
    relative = relative_bounds(fine)
    columns = {f"bound_{name}_mean": relative[name] for name in relative}
    columns |= {f"error_{name}_mean": fine[f"error_{name}"] for name in relative}
    found = pd.DataFrame(columns).groupby(fine["cell"]).mean()
    of_cell = fine.groupby("cell")
    found["queries"], found["violations"] = of_cell.size(), of_cell["bound_online_violated"].sum()
    return found.reset_index()


def outcomes(cells: pd.DataFrame) -> tuple[str, str]:
    """How many cells there are, and a line for every solver and status of those that are not ok."""
    lines = [
        f"- {solver}: {len(group)} cells {status}, in which {int((group['queries'] - group['queries_ok']).sum())} of "
        f"{int(group['queries'].sum())} queries are not ok"
        for (solver, status), group in cells[cells["status"] != "ok"].groupby(["solver", "status"])
    ]
    fine = f"{len(cells)} cells, {int((cells['status'] == 'ok').sum())} with every query ok"
    return f"{fine}{'; the others:' if lines else '.'}", "\n".join(lines)


def drawn(path: Path, folder: Path) -> Iterator[tuple[str, str]]:
    """Draw the figures of the page; returns the name of each, and the picture with its caption."""
    kinds = FIGURES.get(folder.name, ("answer", "convergence"))
    with styled():
        for name, draw, data in figures.drawings(figures.problem_tables(path), kinds):
            if (figure := draw(data)) is not None:
                file = write_figure(figure, folder, name)
                yield name, f"![{alternative(figure, name)}]({file.name})\n\n{escaped(caption_of(figure))}"


def comparison(evidence: Evidence) -> pd.DataFrame:
    """One row per pair of dimensions: dimensions, seconds and break-even, of the paper and of vibench."""
    rows = []
    for column in columns(evidence):
        pair, on, off = column.pair, column.on, column.off
        break_even = formats.break_even_table(column.break_even.to_frame().T).iloc[0]
        rows.append(
            {
                "prescribed": ", ".join(f"{key} = {value:g}" for key, value in pair.prescribed.items()),
                "(N, R)": pair.name,
                "(N, R), vibench": f"({on['N']:.0f}, {on['R']:.0f})",
                "offline on / off [s]": f"{pair.offline[0]:.0f} / {pair.offline[1]:.0f}",
                "vibench [s]": f"{on['offline_s']:.1f} / {off['offline_s']:.1f}",
                "query on / off [s]": f"{pair.online[0]:g} / {pair.online[1]:g}",
                "vibench [ms]": f"{1e3 * on['online_s']:.1f} / {1e3 * off['online_s']:.1f}",
                "break-even": pair.threshold,
                "break-even, vibench": break_even["break-even"],
                "interval": break_even["interval"],
            }
        )
    return pd.DataFrame(rows)


if __name__ == "__main__":
    start(main)
