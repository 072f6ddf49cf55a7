"""What a run found, in sentences computed from its results file; whatever the tables do not support is not said."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from vibench.interfaces.strategies import Kind
from vibench.qp.status import Status
from vibench.report.figures.data import Data, best_solver, label, pair_title, pairs, problems
from vibench.results import invariants, tables
from vibench.results.break_even import HIGH_FIDELITY
from vibench.results.solver_agreement import sentence
from vibench.stability.infsup import VANISHES


@dataclass(frozen=True)
class Finding:
    """A sentence and what it is about, "" for the run as a whole."""

    about: str
    text: str


def findings(path: Path) -> list[Finding]:
    """Sentences on completeness, stability, errors, costs and solvers, in this order."""
    cells, queries = tables.read(path, "cells"), tables.read(path, "queries")
    said = [Finding("", text) for text in (_complete(cells), *_checks(path, cells, queries))]
    for name, data in problems(path):
        known = best_solver(data.cells)
        if len(known):
            for pair, of_pair in pairs(known):
                for dual, group in of_pair.groupby("dual", sort=False):
                    where = f"{name}, {dual}, {pair_title(pair, group)}"
                    said += [Finding(where, text) for text in (*_stability(group), *_costs(group, data))]
        said += [Finding(f"{name}, solvers", text) for text in _solvers(data)]
    return said


def _complete(cells: pd.DataFrame) -> str:
    fine = int((cells["status"] == Status.OK).sum())
    asked, answered = int(cells["queries"].fillna(0).sum()), int(cells["queries_ok"].fillna(0).sum())
    return (
        f"{len(cells)} cells, {fine} with every query ok; {answered} of {asked} queries were answered to the accuracy "
        "asked for, by residuals that the benchmark computed."
    )


def _checks(path: Path, cells: pd.DataFrame, queries: pd.DataFrame) -> Iterator[str]:
    kinds = cells.set_index("cell")["enrichment_kind"]
    broken = invariants.violations(queries, kinds) if len(queries) else []
    if broken:
        yield f"Invariants of the constants and the error bounds are violated {len(broken)} times: {broken[0]}."
    elif len(queries):
        yield f"The invariants of the constants and the error bounds hold in all {len(queries)} queries."
    agreed = sentence(tables.read(path, "disagreements"))
    yield f"{agreed[:1].upper()}{agreed[1:]}."
    disturbed = int((cells["disturbed"] == 1).sum())
    if disturbed:
        yield f"{disturbed} cells were measured while the machine was busy with something else; they are marked."


def _stability(group: pd.DataFrame) -> Iterator[str]:
    """What enrichments do for the inf-sup constant over the span, and for the error of the multiplier."""
    plain = group[group["enrichment_kind"] == Kind.NONE]
    online = group[group["enrichment_kind"] == Kind.PER_PARAMETER].dropna(subset=["beta_span_min"])
    if len(plain) and np.isfinite(plain["beta_span_min"].iloc[0]):
        row = plain.iloc[0]
        zero = row["beta_span_min"] < VANISHES
        value = "is zero" if zero else f"is {row['beta_span_min']:.3g}"
        yield (
            f"Without enrichment min β over the span {value}, over the cone at least {row['beta_cone_lower_min']:.3g}; "
            f"the mean error of λ is {row['error_lambda_mean']:.3g}."
        )
    fixed = group[(group["enrichment_kind"] == Kind.FIXED) & np.isfinite(group["beta_span_min"])]
    for row in _one_assembly(fixed).itertuples():
        reached = ""
        if len(online) and VANISHES < online["beta_span_min"].iloc[0] < np.inf:
            best = online.iloc[0]
            share = 100.0 * row.beta_span_min / best["beta_span_min"]
            reached = f", {share:.0f} % of what {best['primal']} reach with {best['enrichment']:.0f}"
        yield (
            f"{label(row.primal, row.primal_tol)} adds {row.enrichment:.0f} vectors and reaches min β "
            f"{row.beta_span_min:.3g} over the span{reached}; the mean error of λ is {row.error_lambda_mean:.3g}."
        )


def _one_assembly(cells: pd.DataFrame) -> pd.DataFrame:
    return cells.drop_duplicates(["primal", "primal_options", "primal_tol"])


def _costs(group: pd.DataFrame, data: Data) -> Iterator[str]:
    """The quickest queries of a cell without failures, and from how many of them on it pays."""
    timed = group[group["online_s"].notna() & (group["queries_ok"] == group["queries"])]
    if timed.empty:
        return
    row = timed.loc[timed["online_s"].idxmin()]
    name = label(row["primal"], row["primal_tol"], row["assembly"])
    yield (
        f"The quickest query is that of {name}: {1e3 * row['online_s']:.3g} ms, of which "
        f"{1e3 * row['online_solve_s']:.3g} ms are the quadratic program; "
        f"a high-fidelity solution takes {1e3 * row['hf_s']:.3g} ms."
    )
    against = data.thresholds[
        (data.thresholds["solver"] == row["solver"])
        & (data.thresholds["dual"] == row["dual"])
        & (data.thresholds["primal_a"] == HIGH_FIDELITY)
        & (data.thresholds["primal_b"] == row["primal"])
        & (data.thresholds["assembly_b"] == row["assembly"])
        & (data.thresholds["offline_b_s"] == row["offline_s"])
    ]
    for threshold in against.head(1).itertuples():
        number = "" if pd.isna(threshold.benefit_threshold) else f" {math.ceil(threshold.benefit_threshold)} queries"
        yield f"Against high-fidelity solutions {name} pays {threshold.meaning}{number}."


def _solvers(data: Data) -> Iterator[str]:
    """Who solved how much, and how fast."""
    for solver, cells in data.cells.groupby("solver", sort=False):
        queries = data.queries[(data.queries["solver"] == solver) & (data.queries["status"] == Status.OK)]
        median = f", in {1e3 * queries['solve_s'].median():.3g} ms at the median" if len(queries) else ""
        yield f"{solver} answered {len(queries)} of {cells['queries'].fillna(0).sum():.0f} queries{median}."
