"""Friction with a given bound: which models exist, and their errors and bounds at 1,000 unseen parameters.

vibench run friction --no-figures && vibench run ceiling --no-figures
python results/scripts/friction.py runs/friction runs/ceiling results/friction
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from page import SECONDS, Page, made_by, origin, read, start

from vibench import HighFidelitySolver, Model, open_run
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee
from vibench.offline.assemblies import Assemblies
from vibench.report.figures.style import Sheet, look_of, scatter, styled
from vibench.stages.assessment import is_violated

COUNT = 1000
"""Parameters that no model has seen."""

AXES = ["formulation", "dual"]


def answered(model: Model, mu: np.ndarray) -> tuple[Any, ...] | None:
    """The u, λ, bound and corrected λ of a model at mu; `None` without an answer."""
    assert model.certificate is not None
    if model.row["formulation"] == "mixed":
        solution = model.solve(mu, corrected=False)
        corrected = model.solve(mu, corrected=True).lam
        return None if solution.u is None else (solution.u, solution.lam, solution.bound, corrected)
    answer, _ = model.answered(mu, model.settings()[0])
    if answer.x is None:
        return None
    given = model.online.coordinates(mu, answer)
    bound, correction = model.certificate.certify(model.problem, mu, *given, CorrectionMode.FEASIBLE)
    return *model.pair(mu, answer), bound, None if correction is None else correction.nu


def unseen(run: str, cells: pd.DataFrame) -> pd.DataFrame:
    """Errors, bounds and effectivities of every model, a row for each model and parameter.

    Of the solvers of a model the first one is taken, if possible one that is ok: bounds hold for any answer.
    """
    ran = cells[cells["status"].isin(["ok", "inaccurate"])].sort_values("status", ascending=False, kind="stable")
    chosen = ran.drop_duplicates(["dual", "primal", "dual_size"]).sort_index()
    models = {row.cell: (row, open_run(run).model(row.cell)) for row in chosen.itertuples()}
    problem = next(model.problem for _, model in models.values())
    solver, kept, rows = HighFidelitySolver(problem), Assemblies(problem), []
    for mu in problem.parameters.sample(COUNT, 2027):
        exact, vi, energy = solver.solve(mu), kept.at(mu), kept.energy_at(mu)
        size = problem.V.norm(exact.u), problem.W.norm(exact.lam)
        for cell, model in models.values():
            row = {"dual": cell.dual, "primal": cell.primal, "R": int(cell.dual_size), "solver": cell.solver}
            row |= {"answered": 0}
            if (found := answered(model, mu)) is not None:
                u, lam, bound, nu = found
                errors = energy.norm(exact.u - u), energy.dual_norm(vi.B.T @ (exact.lam - lam))
                bounds = bound.u_energy, bound.lambda_natural
                row |= {"answered": 1, "bounded": int(bound.guarantee is not Guarantee.NONE)}
                row |= {"violated": int(is_violated(np.array(errors), np.array(bounds), energy.norm(exact.u)).any())}
                row |= {"error u": problem.V.norm(exact.u - u) / size[0]}
                row |= {"error λ": problem.W.norm(exact.lam - lam) / size[1]}
                row |= {"error λ, corrected": np.nan if nu is None else problem.W.norm(exact.lam - nu) / size[1]}
                for name, error, limit in zip("uλ", errors, bounds, strict=True):
                    row |= {f"absolute {name}": error, f"bound {name}": limit, f"effectivity {name}": limit / error}
            rows.append(row)
    return pd.DataFrame(rows)


def summary(found: pd.DataFrame) -> pd.DataFrame:
    """A row for every model: mean errors, and the least, median and largest effectivity."""
    groups = found.groupby(["dual", "primal", "R", "solver"], sort=False)
    table = groups[["answered", "bounded", "violated"]].sum().astype(int)
    table = table.join(groups[["error u", "error λ", "error λ, corrected"]].mean())
    for name in "uλ":
        of = groups[f"effectivity {name}"]
        for word, values in (("least", of.min()), ("median", of.median()), ("largest", of.max())):
            table[f"{word} effectivity of {name}"] = values
    return table.reset_index()


def figure(found: pd.DataFrame) -> Figure:
    """Bounds over errors of all answers; equal on the grey line."""
    names = {"u": "u in the energy norm", "λ": "λ in the natural norm"}
    sheet = Sheet(1, 2, "bounds against errors at 1,000 unseen parameters")
    for column, (name, norm) in enumerate(names.items()):
        panel = sheet.panel(0, column)
        # Every tenth parameter is shown.
        for dual, mine in found[found.index // len(found.groupby(["dual", "primal", "R"])) % 10 == 0].groupby("dual"):
            scatter(panel, mine[f"absolute {name}"], mine[f"bound {name}"], look_of(str(dual)), str(dual), markersize=2)
        ends = [found[f"absolute {name}"].min(), found[f"absolute {name}"].max()]
        panel.plot(ends, ends, color="0.6", linewidth=0.8, zorder=0)
        panel.set(xscale="log", yscale="log", xlabel=f"error of {norm}", ylabel="bound")
    return sheet.finish(
        "Certified bounds at online cost against the errors that they bound, of sections (pod-dual) and hulls "
        "(hull-greedy), every tenth parameter. On the grey line both are equal: no point may lie below it. "
        "Where models are exact to round-off, bounds are near its root."
    )


def matrix(cells: pd.DataFrame) -> pd.DataFrame:
    """Of every formulation and dual strategy how many cells there are, how many are ok, and why others are not."""
    rows = []
    for key, mine in cells.groupby(AXES, sort=False):
        fine, reasons = int((mine["status"] == "ok").sum()), list[str]()
        for (status, reason), those in mine[mine["status"] == "unavailable"].groupby(["status", "reason"], sort=False):
            reasons.append(f"{len(those)} {status}, {reason}")
        for solver, those in mine[mine["status"] == "inaccurate"].groupby("solver", sort=False):
            missed = int((those["queries"] - those["queries_ok"]).sum())
            reasons.append(f"{len(those)} inaccurate of {solver}, in {missed} of {int(those['queries'].sum())} queries")
        rows.append(dict(zip(AXES, key, strict=True)) | {"cells": len(mine), "ok": fine, "others": "; ".join(reasons)})
    return pd.DataFrame(rows)


def answer(table: pd.DataFrame) -> str:
    """The answer in two sentences, from the table of unseen parameters."""
    best = table.loc[table["error λ"].idxmin()]
    return (
        f"Yes: sections and hulls of the dual set have certified models. At {COUNT:,} unseen parameters "
        f"{int(table['violated'].sum())} of {int(table['bounded'].sum()):,} pairs of bounds are violated. The smallest "
        f"mean error of λ is {best['error λ']:.1g}, by {best['dual']} with {best['primal']}; correction leaves "
        f"{best['error λ, corrected']:.1g}."
    )


def main(run: str, ceiling: str, target: str) -> None:
    cells = read(run, "cells")
    found, between = unseen(run, cells), summary(unseen(ceiling, read(ceiling, "cells")))
    table = summary(found)
    made = made_by("friction", "friction", "friction", "ceiling", options=" --no-figures")
    page = Page(
        target, "Can friction with a given bound be reduced, with bounds?", made, SECONDS,
        "Means of relative errors, of u in V and of λ in W; parameters where friction is small count as others do. "
        "Answers are bounded whether they reach the accuracy or not.",
        machine=origin(cells),
    )  # fmt: skip
    shown = ["dual", "primal", "R", "error u", "error λ", "error λ, corrected"]
    page.answer(answer(table), table[[*shown, "median effectivity of u", "median effectivity of λ"]])
    with styled():
        page.draw("bounds", figure(found))
    page.file("unseen", f"the models at {COUNT} unseen parameters, with all effectivities", table)
    page.file(
        "ceiling",
        f"the same for a membrane between two obstacles, 0.01 m apart: {int(between['violated'].sum())} of "
        f"{int(between['bounded'].sum()):,} pairs of bounds are violated",
        between,
    )
    page.file(
        "combinations", "every formulation and cone, of three enrichments, two solvers and two sizes", matrix(cells)
    )
    page.file("cells", "every cell, with all columns", cells)
    page.write()


if __name__ == "__main__":
    start(main)
