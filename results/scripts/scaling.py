"""Growth of seconds and memory of every stage: over the mesh at fixed N and R, and over R at the paper's mesh.

taskset -c 1 python results/scripts/scaling.py results/scaling

Every problem and mesh is measured in a process of its own, on one thread. Memory is the peak resident set while a stage
runs and includes what earlier stages hold; seconds of queries are medians.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # before NumPy is imported
    from vibench.guardian import ONE_THREAD

    os.environ.update(ONE_THREAD)

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from page import SECONDS, Page, made_by, start

from vibench import Reduction, Stop, create, provenance, solve_qp
from vibench.linalg.factorisations import IMPLEMENTATIONS
from vibench.report.figures.style import Looks, Series, Sheet, plot, styled
from vibench.timing import median_seconds, timed

ACCURACY = 1e-10
QUERIES = 8
SEED = 2022
STEPS = {
    "snapshots": "snapshots", "POD": "pod", "mCPG": "cone", "PGA": "enrichment", "affine decomposition": "members",
    "reduction": "operators",
}  # fmt: skip
"""Stages of the offline phase, and the steps of a reduction that they are."""

UNTIMED = {"PGA": "offline", "reduction": "projection"}
"""Steps that are no part of a stage and have to be there before it."""

OFFLINE = ("mesh and forms", *STEPS)
DRAWN = ("snapshots", "PGA", "query, full", "query, reduced")
"""Curves of the picture."""


@dataclass(frozen=True)
class Case:
    """Numbers of nodes of one problem, and N, R and δ_PGA, which are fixed over the meshes."""

    nodes: tuple[int | str, ...]
    N: int
    R: int
    delta: float


CASES = {
    "obstacle": Case((400, 1200, "paper", "fine", 30_000, 60_000), 14, 43, 1e-3),
    "hertz": Case((300, 1000, 3000, "paper", "fine", 30_000), 20, 12, 0.3),  # 300 nodes: 21 snapshots are independent
}
FACTORISED = ("hertz", (3000, "paper", "fine", 30_000))
"""A problem and its numbers of nodes at which the factorisations are compared, those that are installed."""

COMPARED = ("mesh and forms", "snapshots", "POD", "mCPG", "PGA")
"""Stages up to the last one of that comparison."""

SIZES = (10, 20, 40, 60, 80)
"""R at the paper's mesh."""


def measure(
    name: str, nodes: int | str, R: int, delta: float, N: int, factorisation: str = ""
) -> Iterator[dict[str, Any]]:
    """Rows of one problem and mesh: stage, seconds, peak memory; with a factorisation those of `COMPARED` alone."""
    about: dict[str, Any] = {"problem": name, "R": R, "N": N}
    options: dict[str, Any] = {"resolution": nodes}
    if factorisation:
        about["factorisation"] = options["factorisation"] = factorisation

    def row(stage: str, work: Callable[[], Any], repeated: bool = False) -> tuple[Any, dict[str, Any]]:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
        result, seconds = (median_seconds if repeated else timed)(work)
        return result, about | {"stage": stage, "seconds": seconds.cpu, "memory_mib": _peak_memory()}

    problem, measured = row("mesh and forms", lambda: create("problem", name, options))
    about |= {"n": problem.V.dim, "m": problem.W.dim}
    yield measured | about
    strategies = create("dual strategy", "mcpg"), create("primal strategy", "offline-pga")
    reduction = Reduction(problem, *strategies, Stop(size=N), Stop(size=R), delta, assembly="reduced")
    for stage, step in STEPS.items():
        if factorisation and stage not in COMPARED:
            return
        getattr(reduction, UNTIMED.get(stage, "problem"))
        result, measured = row(stage, lambda: getattr(reduction, step))  # noqa: B023  called at once
        yield measured | ({"added": result.vectors.shape[1]} if stage == "PGA" else {})
    full, online = reduction.projection, reduction.assembled
    for mu in problem.validation_set(QUERIES, SEED):
        reduced = online.assemble(mu)
        for stage, model in (("query, full", full), ("query, reduced", online)):
            yield row(stage, lambda: _solve(model.assemble(mu)), repeated=True)[1]  # noqa: B023  called at once
        yield row("QP solution", lambda: _solve(reduced), repeated=True)[1]  # noqa: B023


def _solve(reduced: Any) -> Any:
    return solve_qp(reduced.program, "piqp", ACCURACY, factor=reduced.factor)


def _peak_memory() -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024.0


def all_rows() -> Iterator[dict[str, Any]]:
    """Every measurement, each mesh in a process of its own."""
    for name, case in CASES.items():
        for nodes in case.nodes:
            yield from _in_a_process("mesh", name, nodes, case.R, case.delta, case.N)
        for R in SIZES:
            yield from _in_a_process("R", name, "paper", R, case.delta, case.N)
    name, meshes = FACTORISED
    case = CASES[name]
    for one in IMPLEMENTATIONS.values():
        # Multigrid is for scalar fields.
        for nodes in meshes if one.is_installed and not one.is_iterative else ():
            yield from _in_a_process("factorisation", name, nodes, case.R, case.delta, case.N, one.name)


def _in_a_process(over: str, *arguments: Any) -> Iterator[dict[str, Any]]:
    command = [sys.executable, __file__, "--one", json.dumps(arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{arguments}: {done.stderr}")
    print(*arguments, file=sys.stderr, flush=True)
    yield from ({"over": over} | json.loads(line) for line in done.stdout.splitlines())


def table(rows: pd.DataFrame, what: str) -> pd.DataFrame:
    """One line per problem and stage, one column per size, and the exponents between neighbouring sizes."""
    lines = []
    for (name, stage), group in rows.groupby(["problem", "stage"], sort=False):
        size = "R" if group["over"].iloc[0] == "R" else "n"
        points = group.groupby(size)[what].median()
        values = {f"{size} = {k}": value for k, value in points.items()}
        lines.append(
            {"problem": name, "stage": stage, **values, "exponents": ", ".join(map("{:.1f}".format, slopes(points)))}
        )
    return pd.DataFrame(lines)


def slopes(points: pd.Series) -> list[float]:
    """Local slopes in logarithmic axes, from every size to the next one.

    One slope through all points would mix the constant overhead of small sizes with the growth of large ones.
    """
    return list(np.diff(np.log(points.to_numpy())) / np.diff(np.log(points.index.to_numpy(float))))


def draw(rows: pd.DataFrame) -> Figure:
    """Seconds over the number of unknowns, logarithmic: a panel for every problem."""
    names = list(rows["problem"].unique())
    sheet, looks = Sheet(1, len(names), "CPU seconds over the number of unknowns"), Looks(map(Series, DRAWN))
    for panel, name in zip(sheet.panels, names, strict=True):
        for stage in DRAWN:
            mine = rows[(rows["problem"] == name) & (rows["stage"] == stage)].groupby("n")["seconds"].median()
            plot(panel, mine.index, mine, looks[Series(stage)], stage)
        panel.set(xscale="log", yscale="log", title=name, xlabel="unknowns", ylabel="seconds")
    return sheet.finish("CPU seconds over the number of unknowns, of all snapshots and of single queries.")


def main(target: str) -> None:
    rows = pd.DataFrame(all_rows())
    rows["n"] = rows["n"].fillna(rows.groupby(["over", "problem", "R"])["n"].ffill())
    versions = ", ".join(f"{name} {text}" for name, text in provenance.versions("piqp").items())
    write_page(rows.assign(machine=f"{provenance.machine()}; {versions}"), target)


def write_page(rows: pd.DataFrame, target: str) -> None:
    """Figures and tables of the measurements."""
    cases = "; ".join(f"{name}: N = {case.N}, R = {case.R}, δ_PGA = {case.delta:g}" for name, case in CASES.items())
    page = Page(
        target,
        "How do seconds and memory grow?",
        f"taskset -c 1 {made_by('scaling', 'scaling')}",
        SECONDS,
        "Exponents are the slopes in logarithmic axes from every size to the next one: the first ones show constant "
        f"costs, the last one the growth of large sizes. {cases}; mCPG; queries by PIQP at accuracy {ACCURACY:g}.",
        machine=rows["machine"].iloc[0],
    )
    over_mesh = rows[rows["over"] == "mesh"]
    grown = table(over_mesh[over_mesh["stage"].isin(DRAWN)], "seconds")[["problem", "stage", "exponents"]]
    last = grown.set_index(["stage", "problem"])["exponents"].str.split(", ").str[-1].astype(float)
    assert (last["query, reduced"].abs() < 0.5).all()
    page.answer(
        "A reduced query does not grow with the mesh. Towards the largest one, of "
        f"{over_mesh['n'].max():,.0f} unknowns, exponents of snapshots are at most {last['snapshots'].max()}, of "
        f"queries in full assembly {last['query, full'].max()}.",
        grown,
    )
    with styled():
        page.draw("over-n", draw(over_mesh))
    for over, about in (("mesh", "over the mesh"), ("R", "over the number of generators, on the paper's mesh")):
        chosen = rows[rows["over"] == over]
        page.file(f"seconds-{over}", f"seconds of every stage {about}", table(chosen, "seconds"))
        offline = chosen[chosen["stage"].isin(OFFLINE)]
        page.file(f"memory-{over}", f"peak memory in MiB {about}", table(offline, "memory_mib"))
    compared = rows[(rows["over"] == "factorisation") & rows["stage"].isin(("snapshots", "PGA"))]
    if len(compared):
        by_name = [table(group, "seconds").assign(factorisation=name)
                   for name, group in compared.groupby("factorisation", sort=False)]  # fmt: skip
        page.file("factorisations", f"seconds on {FACTORISED[0]} by the library that factorises", pd.concat(by_name))
    page.file("rows", "all measurements", rows)
    page.write()


if __name__ == "__main__":
    start(main)
