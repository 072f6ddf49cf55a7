"""The page of a study under results/: comparison with the paper, summary, break-even, figures.

vibench run paper-obstacle && python results/scripts/study.py runs/paper-obstacle results/paper-obstacle
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from page import SECONDS, Page, machines, made_by, read, start, versions, write_figure

from vibench.report import figures
from vibench.report.figures.style import styled
from vibench.results import tables


@dataclass(frozen=True)
class Published:
    """One column of a table of the paper: online (on) and offline (off) enrichment for one pair of dimensions.

    Attributes
    ----------
    prescribed
        Tolerances or sizes of the cells to compare with.
    size
        (N, R) of the paper.
    offline, online
        Seconds of the offline phase and of one query, on and off.
    threshold
        Break-even: the number of queries from which the offline enrichment is cheaper in total.
    """

    prescribed: dict[str, float]
    size: tuple[int, int]
    offline: tuple[float, float]
    online: tuple[float, float]
    threshold: int


PAPER = {
    "paper-obstacle": (
        "Comparison with Table 1 of Niakh, Drouet, Ehrlacher and Ern (2022), δ_PGA = 1e-3",
        1e-3,
        (
            Published({"pod_tol": 1e-3, "dual_tol": 1e-2}, (19, 50), (1112.0, 2296.0), (14.0, 2.4), 102),
            Published({"pod_tol": 1e-4, "dual_tol": 1e-3}, (51, 70), (1193.0, 2395.0), (17.0, 2.5), 83),
            Published({"pod_tol": 1e-6, "dual_tol": 1e-2}, (89, 50), (1272.0, 1884.0), (14.0, 2.3), 52),
        ),
    ),
    "paper-hertz": (
        "Comparison with Table 2 of Niakh, Drouet, Ehrlacher and Ern (2022), δ_PGA = 0.3",
        0.3,
        (
            Published({"pod_size": 3, "dual_size": 12}, (3, 12), (8490.0, 18098.0), (75.0, 18.0), 169),
            Published({"pod_size": 46, "dual_size": 70}, (46, 70), (10889.0, 19750.0), (162.0, 20.0), 62),
            Published({"pod_size": 46, "dual_size": 12}, (46, 12), (10874.0, 18312.0), (78.0, 19.0), 126),
        ),
    ),
}
"""Tables of the paper: title, δ_PGA of the offline enrichment, columns; seconds on its authors' machine."""

DUAL = "mcpg"
SOLVER = "piqp"
"""Cone and solver of the cells compared with the paper; the solver is the one with the fewest unsolved queries."""

TABLES = ("cells", "thresholds", "disagreements")
"""Tables written beside the page. Those of all queries and histories take megabytes and stay in the run folder."""

FIGURES = {
    "benefit": ("total-cost", "work-precision", "inf-sup"),
    "hertz-quadrature": ("solutions", "errors"),
    "solvers": ("solvers", "precision"),
}
"""Kinds of figures on the page of a study; all of them on other pages."""


def main(run: str, target: str) -> None:
    path, name, cells = tables.results_file(run), Path(target).name, read(run, "cells")
    shutil.rmtree(target, ignore_errors=True)
    page = Page(
        target,
        name,
        made_by("study", name, name),
        SECONDS,
        f"`vibench run {name}` leaves the tables of all queries and histories under `runs/{name}/tables` and all "
        f"figures under `runs/{name}/figures`.",
        machine=f"{machines(cells)}; {versions(cells)}",
    )
    if name in PAPER:
        page.section(
            PAPER[name][0],
            comparison(path, name),
            f"Columns of vibench: {SOLVER}, full assembly; break-even by the paper's formula, with the 95 % interval "
            "from resampled rounds of timing.",
        )
    page.section("All cells", *outcomes(cells), tables.summary(cells))
    of_enrichments = tables.read(path, "thresholds").dropna(subset="cell_a")
    if len(of_enrichments):
        page.section("Break-even of fixed enrichments", tables.benefits(of_enrichments))
    page.section("Figures", "\n".join(f"![{file.stem}]({file.name})" for file in sorted(drawn(path, page.folder))))
    written = {table: frame for table in TABLES if len(frame := read(run, table))}
    page.add(f"Full tables: {', '.join(page.link(table, frame) for table, frame in written.items())}.")
    page.write()


def outcomes(cells: pd.DataFrame) -> tuple[str, str]:
    """How many cells there are, and a line for every solver and status of those that are not ok."""
    lines = [
        f"- {solver}: {len(group)} cells {status}, in which {int((group['queries'] - group['queries_ok']).sum())} of "
        f"{int(group['queries'].sum())} queries are not ok"
        for (solver, status), group in cells[cells["status"] != "ok"].groupby(["solver", "status"])
    ]
    fine = f"{len(cells)} cells, {int((cells['status'] == 'ok').sum())} with every query ok"
    return f"{fine}{'; the others:' if lines else '.'}", "\n".join(lines)


def drawn(path: Path, folder: Path) -> Iterator[Path]:
    """Draw the figures of the page."""
    kinds = FIGURES.get(folder.name, "")
    with styled():
        for task in figures.drawings(path):
            pages = figures.pages_of(task) if task[0].endswith(kinds) else ()
            yield from (write_figure(figure, folder, name) for name, figure in pages if name.endswith(kinds))


def comparison(path: Path, name: str) -> pd.DataFrame:
    """One row per pair of dimensions: dimensions, seconds and break-even, of the paper and of vibench."""
    _, tight, columns = PAPER[name]
    cells, thresholds = tables.read(path, "cells"), tables.read(path, "thresholds")
    chosen = cells[(cells["solver"] == SOLVER) & (cells["dual"] == DUAL)]
    rows = []
    for column in columns:
        pair = chosen[np.logical_and.reduce([chosen[key] == value for key, value in column.prescribed.items()])]
        on = pair[pair["enrichment_kind"] == "per-parameter"].iloc[0]
        off = pair[pair["primal_tol"] == tight].iloc[0]
        between = (thresholds["cell_a"] == on["cell"]) & (thresholds["cell_b"] == off["cell"])
        found = tables.benefits(thresholds[between]).iloc[0]
        rows.append(
            {
                "prescribed": ", ".join(f"{key} = {value:g}" for key, value in column.prescribed.items()),
                "(N, R)": f"({column.size[0]}, {column.size[1]})",
                "(N, R), vibench": f"({on['N']:.0f}, {on['R']:.0f})",
                "offline on / off [s]": f"{column.offline[0]:.0f} / {column.offline[1]:.0f}",
                "vibench [s]": f"{on['offline_s']:.1f} / {off['offline_s']:.1f}",
                "query on / off [s]": f"{column.online[0]:g} / {column.online[1]:g}",
                "vibench [ms]": f"{1e3 * on['online_s']:.1f} / {1e3 * off['online_s']:.1f}",
                "break-even": column.threshold,
                "break-even, vibench": found["break-even"],
                "interval": found["interval"],
            }
        )
    return pd.DataFrame(rows)


if __name__ == "__main__":
    start(main)
