"""What a run found: sentences computed from its results file, none without data that support it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from vibench.interfaces.strategies import Kind
from vibench.model.errors import UNMEASURABLE
from vibench.qp.status import Status
from vibench.report.common_queries import FEWEST, MEANS, WAY, Comparable, common_programs, on_common_queries
from vibench.report.figures.data import (
    PRIMAL,
    SOLVER_SHARE,
    Data,
    best_solver,
    by_dimensions,
    label,
    problems,
    solved_too_loosely,
)
from vibench.results import invariants, tables
from vibench.results.solver_agreement import sentence
from vibench.stability.infsup import VANISHES

SHARE_ATOL = 1e-8
"""Shares of an inf-sup constant that differ by less are equal up to round-off."""


def findings(path: Path) -> dict[str, list[str]]:
    """Sentences on completeness, stability, errors, costs and solvers by subject, "" for the whole run."""
    found = defaultdict(list, {"": list(_whole_run(path))})
    for name, data in problems(path):
        for title, cells in by_dimensions(best_solver(data.cells)):
            compared = on_common_queries(cells, data.queries)
            found[f"{name}, {title}"] += [*_stability(cells, compared), *_costs(cells, data.thresholds)]
        found[f"{name}, enrichments"] += _off_training(data)
        found[f"{name}, zero solutions"] += _zero_solutions(data)
        found[f"{name}, solvers"] += _solvers(data)
    return {subject: sentences for subject, sentences in found.items() if sentences}


def _whole_run(path: Path) -> Iterator[str]:
    cells, queries = tables.read(path, "cells"), tables.read(path, "queries")
    ok = int((cells["status"] == Status.OK).sum())
    count, accurate = (int(cells[name].fillna(0).sum()) for name in ("queries", "queries_ok"))
    yield (
        f"{len(cells)} cells, {ok} with every query ok; {accurate} of {count} queries meet the prescribed accuracy in "
        "their recomputed KKT residuals."
    )
    violated = invariants.violations(queries, cells.set_index("cell")["enrichment_kind"]) if len(queries) else []
    if violated:
        yield f"{len(violated)} invariants of the inf-sup constants and the error bounds are violated: {violated[0]}."
    elif len(queries):
        yield f"The invariants of the inf-sup constants and the error bounds hold in all {len(queries)} queries."
    agreement = sentence(tables.read(path, "disagreements"))
    yield f"{agreement[:1].upper()}{agreement[1:]}."
    if loose := int(solved_too_loosely(cells).sum()):
        yield (
            f"{loose} cells are not compared with others: their QP solver makes {100.0 * SOLVER_SHARE:.0f} % or more "
            "of an error (column `solver_share_mean`). A smaller `accuracy` would help."
        )
    if few := int((cells["queries_ok"] < FEWEST * cells["queries"]).sum()):
        yield f"{few} cells have fewer than half of their queries ok: their errors are not compared with others."
    if disturbed := int((cells["disturbed"] == 1).sum()):
        yield f"{disturbed} cells were timed while other processes slowed the machine down (column `disturbed`)."


def _stability(cells: pd.DataFrame, compared: Comparable) -> Iterator[str]:
    """Effect of the enrichments on the inf-sup constant over the span and on the error of the multiplier."""
    for row in cells[cells["enrichment_kind"] == Kind.NONE].head(1).itertuples():
        if np.isfinite(row.beta_span_min):
            value = "zero" if row.beta_span_min < VANISHES else f"{row.beta_span_min:.3g}"
            yield (
                f"Without enrichment, min β over the span is {value} and min β over the cone at least "
                f"{row.beta_cone_lower_min:.3g}{_mean_error(row.cell, compared)}."
            )
    fixed = cells[(cells["enrichment_kind"] == Kind.FIXED) & np.isfinite(cells["beta_span_min"])]
    for row in fixed.drop_duplicates(PRIMAL).itertuples():
        yield (
            f"{label(row.primal, row.primal_tol)} adds {row.enrichment:.0f} vectors, with which min β over the span is "
            f"{row.beta_span_min:.3g}, at every validation parameter at least {100.0 * row.share_validation:.0f} % of "
            f"the constant of the whole of V{_mean_error(row.cell, compared)}."
        )


def _mean_error(cell: str, compared: Comparable) -> str:
    """The mean error of λ of a cell over the queries that the cells it is compared with solved, too; "" without one."""
    found = compared.cells.set_index("cell")["error_lambda_mean"].get(cell)
    return "" if found is None or pd.isna(found) else f"; the mean error of λ is {found:.3g}{compared.over}"


def _off_training(data: Data) -> Iterator[str]:
    """Whether the share of the inf-sup constant that holds on the training set holds off it."""
    fixed = data.cells[data.cells["share_training"].notna()].drop_duplicates([*PRIMAL, "dual", "pair"])
    lost = fixed["share_training"] - fixed["share_validation"]
    if lost.max() > SHARE_ATOL:
        worst = fixed.loc[lost.idxmax()]
        yield (
            f"The share of β over the span in that of the whole of V is smaller at validation parameters than at "
            f"training parameters in {(lost > SHARE_ATOL).sum()} of {len(fixed)} fixed enrichments, at worst "
            f"{worst['share_validation']:.3f} against {worst['share_training']:.3f} "
            f"({label(worst['primal'], worst['primal_tol'])}, {worst['dual']})."
        )
    bounded = fixed[fixed["share_guaranteed"].notna()]
    broken = bounded[bounded["share_validation"] < bounded["share_guaranteed"] - SHARE_ATOL]
    if len(bounded):
        yield (
            f"√(1 − σ²), which bounds this share at training parameters, is not reached at a validation parameter in "
            f"{len(broken)} of {len(bounded)} fixed enrichments that record σ."
        )


def _zero_solutions(data: Data) -> Iterator[str]:
    """Queries that have no relative error since the high-fidelity u or λ is zero, and how large the reduced one is."""
    for name, symbol in (("u", "u"), ("lambda", "λ")):
        zero = data.queries[data.queries[f"zero_{name}"] == 1]
        if zero.empty:
            continue
        yield (
            f"{symbol} is zero, at most {UNMEASURABLE:g} of the largest of the training set, at "
            f"{zero['query'].nunique()} of {data.queries['query'].nunique()} validation parameters: it has no relative "
            "error there, and means are over the other queries."
        )
        answered = zero[zero["status"] == Status.OK]
        if len(answered):
            scaled = answered[f"error_{name}_scaled"]
            worst = answered.loc[scaled.idxmax()]
            yield (
                f"The reduced {symbol} is at most {scaled.max():.2g} of the largest of the training set there "
                f"({label(worst['primal'], worst['primal_tol'], worst['assembly'])}, {worst['dual']}, "
                f"{worst['solver']}), in the median {scaled.median():.2g}."
            )


def _costs(cells: pd.DataFrame, thresholds: pd.DataFrame) -> Iterator[str]:
    """The fastest query among cells whose queries are all ok, and the break-even of its cell."""
    timed = cells[cells["online_s"].notna() & (cells["queries_ok"] == cells["queries"])]
    if timed.empty:
        return
    row = timed.loc[timed["online_s"].idxmin()]
    name = label(row["primal"], row["primal_tol"], row["assembly"])
    yield (
        f"The fastest query is that of {name}: {1e3 * row['online_s']:.3g} ms, of which the QP solver takes "
        f"{1e3 * row['online_solve_s']:.3g} ms; a high-fidelity solution takes {1e3 * row['hf_s']:.3g} ms "
        f"after a set-up of {1e3 * row['hf_setup_s']:.3g} ms."
    )
    against = thresholds[(thresholds["cell_b"] == row["cell"]) & thresholds["cell_a"].isna()]
    for found in against.itertuples():
        number = "" if pd.isna(found.benefit_threshold) else f" {math.ceil(found.benefit_threshold)} queries"
        interval = tables.interval(found.threshold_low, found.threshold_high)
        within = f", 95 % interval {interval}" if interval else ""
        yield f"Break-even of {name} against high-fidelity solutions: {found.meaning}{number}{within}."


def _solvers(data: Data) -> Iterator[str]:
    """Number of the programs that each solver solved, at each accuracy; median time and mean errors on common ones."""
    several = data.cells["accuracy"].nunique() > 1
    solved = data.queries[data.queries["status"] == Status.OK].groupby(WAY).size()
    shared = dict(iter(common_programs(data.queries).groupby(WAY)))
    common, errors = max(map(len, shared.values()), default=0), list[str]()
    for way, cells in data.cells.groupby(WAY, sort=False):
        solver = "{} at {:g}".format(*way) if several else way[0]
        asked, median = int(cells["queries"].fillna(0).sum()), ""
        if way in shared:
            over = f" over the {common} programs that all solved" if common < asked else ""
            median = f", with a median of {1e3 * shared[way]['solve_s'].median():.3g} ms{over}"
            errors.append(f"{solver} {' and '.join(f'{shared[way][name].mean():.3g}' for name in MEANS.values())}")
        yield f"{solver} solved {solved.get(way, 0)} of {asked} programs{median}."
    if len(errors) > 1 and common < solved.max():
        yield f"Mean errors of u and λ over these {common} programs: {'; '.join(errors)}."
