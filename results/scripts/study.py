"""The page of a study under results/: the question that it answers, a short table, a picture.

vibench run paper-obstacle && python results/scripts/study.py runs/paper-obstacle results/paper-obstacle
"""

from __future__ import annotations

import shutil
import statistics
from collections.abc import Callable
from pathlib import Path

import pandas as pd
from page import CERTIFIED, SECONDS, Page, made_by, origin, read, span, start

from vibench.report import figures
from vibench.report.figures.style import styled
from vibench.results import formats
from vibench.results.break_even import HIGH_FIDELITY, Meaning
from vibench.results.ranking import relative_bounds
from vibench.results.read import results_file
from vibench_problems.paper.evidence import SOLVER, Evidence
from vibench_problems.paper.published import HERTZ
from vibench_problems.paper.tables import columns

TABLES = {
    "cells": "every cell, with all columns",
    "thresholds": "break-even of all pairs of cells that differ in their enrichment, assembly or formulation alone",
    "disagreements": "queries to which solvers give different answers",
}
"""Tables written beside the page. Those of all queries and histories take megabytes and stay in the run folder."""

FIGURES = {
    "hertz-quadrature": ("exact-answer",), "solvers": ("obstacle-solvers",),
    "paper-obstacle": ("obstacle-answer", "obstacle-convergence"),
}  # fmt: skip
"""The pictures of a page, if they are not the answer sheet of its first problem."""

REPEATED = dict.fromkeys(("benefit", "paper-obstacle", "paper-hertz"), " --repeats 3")
"""Options of the runs whose seconds README and other pages quote: three cold processes, and offline phases."""

Found = tuple[str, pd.DataFrame, str]
"""The answer, a table, and how to read it."""


def paper(run: str) -> Found:
    """Dimensions and break-even beside those of the table of the paper."""
    ((_, data),) = figures.problem_tables(results_file(run))
    evidence = Evidence(data)
    table = comparison(evidence)
    published = table["break-even"]
    pays = [float(one.removeprefix("from ")) for one in table["break-even, vibench"] if one != "never"]
    when = f"pays from about {statistics.median(pays):.0f} queries on" if pays else "never pays"
    sizes = table[["(N, R)", "(N, R), vibench"]].map(lambda text: [int(one) for one in text.strip("()").split(", ")])
    apart = [abs(b / a - 1.0) for theirs, ours in sizes.to_numpy() for a, b in zip(theirs, ours, strict=True)]
    prescribed = "N and R are prescribed as published"
    same = f"N and R differ from the published ones by at most {100 * max(apart):.0f} %" if max(apart) else prescribed
    return (
        f"{same}. With full assembly, as in the "
        f"paper, enriching offline {when} against online supremizers; there it pays from {published.min()} to "
        f"{published.max()} queries on.",
        table,
        f"Table {evidence.paper.table} of Niakh, Drouet, Ehrlacher and Ern (2022), δ_PGA = {evidence.paper.tight:g}. "
        f"Columns of vibench are by {SOLVER}, break-even is by the paper's formula, with its 95 % interval.",
    )


def benefit(run: str) -> Found:
    """Gains over the next full solution by problem and assembly, and those of offline enrichment."""
    every = read(run, "thresholds")
    rows = []
    for (problem, assembly), mine in every.groupby(["problem", "assembly_b"]):
        full = mine[mine["primal_a"] == HIGH_FIDELITY]
        pairs = mine[(mine["primal_a"] == "online-supremizers") & (mine["assembly_a"] == assembly)]
        pairs = pairs[pairs["primal_b"] == "offline-pga"]
        pays = full[full["meaning"] == Meaning.FROM]
        rows.append({
            "problem": problem, "assembly": assembly, "models": len(full), "gain": span(full["gain"]),
            "pay from [queries]": span(pays["benefit_threshold"]), "undecided or never": len(full) - len(pays),
            "gain of enriching offline": span(pairs["gain"]) if len(pairs) else "–",
        })  # fmt: skip
    table = pd.DataFrame(rows)
    reduced = every[(every["primal_a"] == HIGH_FIDELITY) & (every["assembly_b"] == "reduced")].groupby("problem")
    gains = " and ".join(f"{gain.median():.0f} on {problem}" for problem, gain in reduced["gain"])
    return (
        f"A query in reduced assembly is faster than the next full solution by a median factor of {gains}. With full "
        "assembly most of that is lost, with C programs it grows.",
        table,
        "The gain divides the seconds of the next high-fidelity solution by the seconds of a query. The last column "
        "compares a query after offline PGA with one that computes supremizers, in the same assembly.",
    )


def quadrature(run: str) -> Found:
    """Dimensions of every variant of the contact quadrature and the master mesh."""
    cells = read(run, "cells")
    sizes = cells.set_index(["problem", "dual", "dual_tol"])
    tight, loose = cells["dual_tol"].min(), cells["dual_tol"].max()
    table = pd.DataFrame({
        f"N, δ_POD = {tight:g}": sizes["N"].xs(("mcpg", tight), level=("dual", "dual_tol")),
        **{f"R of {dual}, δ = {tol:g}": sizes["R"].xs((dual, tol), level=("dual", "dual_tol"))
           for tol in (loose, tight) for dual in ("cpg", "mcpg")},
    }).rename_axis("variant").reset_index()  # fmt: skip
    modes, generators = table.iloc[:, 1], table[f"R of mcpg, δ = {loose:g}"]
    exact = table["variant"].str.startswith("exact")
    assert modes[exact].nunique() == generators[exact].nunique() == 1
    return (
        f"Much: N goes from {modes.min()} to {modes.max()}. R of mCPG goes from {generators.min()} to "
        f"{generators.max()}. With exact integration both are the same on all meshes.",
        table,
        f"The paper has N = {HERTZ.modes[tight]} and, with mCPG, R = {HERTZ.generators[loose]}. `ratio` "
        "is the fineness of the master surface.",
    )


def solvers(run: str) -> Found:
    """Seconds of a program and failures of every solver at the highest accuracy."""
    cells = read(run, "cells")
    best = cells[cells["accuracy"] == cells["accuracy"].min()]
    rows = []
    for solver, mine in best.groupby("solver"):
        row: dict[str, object] = {"solver": solver}
        for problem, own in mine.groupby("problem"):
            row[f"{problem} [ms]"] = 1e3 * own["online_solve_s"].median()
            row[f"{problem}, ok"] = f"{own['queries_ok'].sum()} of {own['queries'].sum()}"
        rows.append(row)
    seconds = [f"{problem} [ms]" for problem in sorted(best["problem"].unique())]
    table = pd.DataFrame(rows).sort_values(seconds[0])
    whole = best.groupby("solver")[["queries", "queries_ok"]].sum()
    reliable = sorted(whole.index[whole["queries"] == whole["queries_ok"]])
    first, second = (table[table["solver"].isin(reliable)].iloc[k] for k in (0, 1))
    factor = (second[seconds].astype(float) / first[seconds].astype(float)).mean()
    assert (table[seconds].min() == first[seconds]).all()
    return (
        f"`{first['solver']}` is the fastest at the highest accuracy, on both problems. The next one that never fails, "
        f"`{second['solver']}`, takes {factor:.1f} times its seconds. Every query is ok by {', '.join(reliable)}.",
        table,
        "Medians over the models of the seconds of a program, without assembly, and queries that are ok.",
    )


PAGES: dict[str, tuple[str, Callable[[str], Found]]] = {
    "paper-obstacle": ("Does the obstacle problem of the paper come out as published?", paper),
    "paper-hertz": ("Does Hertz contact come out as published?", paper),
    "benefit": ("From how many queries do reduced models pay?", benefit),
    "hertz-quadrature": ("Do dimensions of Hertz contact depend on the contact quadrature?", quadrature),
    "solvers": ("Which QP solver?", solvers),
}
"""Question and answer of each study."""


def main(run: str, target: str) -> None:
    path, name, cells = results_file(run), Path(target).name, read(run, "cells")
    shutil.rmtree(target, ignore_errors=True)
    question, answer = PAGES[name]
    page = Page(
        target,
        question,
        made_by("study", name, name, options=REPEATED.get(name, "")),
        SECONDS,
        f"{len(cells)} cells, {int((cells['status'] == 'ok').sum())} with every query ok. `vibench run {name}` leaves "
        f"the tables of all queries and histories under `runs/{name}/tables` and all figures under "
        f"`runs/{name}/figures`.",
        machine=origin(cells),
    )
    page.answer(*answer(run))
    wanted = FIGURES.get(name, (f"{cells['problem'].iloc[0]}-answer",))
    kinds = {one.rpartition("-")[2] for one in wanted}
    with styled():
        for drawing, draw, data in figures.drawings(figures.problem_tables(path), kinds):
            if drawing in wanted and (figure := draw(data)) is not None:
                page.draw(drawing, figure)
    for table, about in TABLES.items():
        if len(frame := read(run, table)):
            page.file(table, about, frame)
    if (cells["assembly"] == CERTIFIED).any():
        page.file(
            "bounds", "mean errors and bounds of certified models, and violations", bounds(cells, read(run, "queries"))
        )
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
