"""Which model is the cheapest in total for a number of queries, from when on, at what error, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.results.columns import CELLS, Column, integer, real
from vibench.results.costs.break_even import DRAWS, TAIL, offline_draws, shared_offline
from vibench.results.costs.paired_seconds import Estimate, PairedSeconds
from vibench.results.costs.ranking import BAND, HEADINGS, errors_of_solution, excluded, model_row, reached_errors

CERTIFIED_BOUNDS: Mapping[str, str] = {"u_energy": "u", "lambda_natural": "λ"}
"""Errors that have bounds at online cost."""

COLUMNS: Mapping[str, Column] = {
    **HEADINGS,
    "total_s": real("s", "Offline seconds and those of the queries.", "total [s]", 24),
    "total_low_s": real(
        "s", "Lower end of the 95 % interval of this sum, in seconds of a high-fidelity solution as this run measured "
        "it; the sum of the high-fidelity model has none."
    ),
    "total_high_s": real("s", "Upper end of the interval of the total; a table shows both.", "interval [s]", 25),
    "certified_error": real(
        "1", "Mean over the queries of the larger bound of the relative errors of u and λ, in energy, at online cost, "
        "of this model; empty if no cell of the run has its certificate.", "certified error", 22,
    ),
    "cheapest_from": real("1", "Number of queries from which it is the cheapest.", "cheapest from", 26),
    "cheapest_until": real("1", "Number of queries until which it is; infinite if for ever.", "until", 27),
    "probability": real("1", "Share of draws of what other runs may measure in which it is the cheapest.", "sure", 28),
    "ties": integer(
        "Other models that may be as cheap: the 95 % interval of the difference to this one contains 0.", "ties", 29
    ),
}  # fmt: skip
"""Columns of the table: those of the cells, and what a number of queries adds to them."""

ADDED: Mapping[str, Column] = {name: column for name, column in COLUMNS.items() if name not in CELLS}
"""What it has beside those of the cells."""


OF_ONE_MODEL = ("model", "correction", "solver", "accuracy")
"""What cells have in common whose queries have the same solutions, with certificates or without."""


class Candidate(NamedTuple):
    """A model that competes: its row of the cells table, and its total costs."""

    row: Mapping[str, Any]
    offline: float
    online: float
    offline_draws: Array
    online_draws: Array

    @property
    def key(self) -> str | None:
        """Its cell; `None` of the high-fidelity model."""
        return self.row["cell"] or None


def cheapest(
    cells: pd.DataFrame,
    paired: PairedSeconds,
    queries: float,
    errors: pd.Series | None = None,
    within: float | None = None,
    certified: pd.Series | None = None,
) -> pd.DataFrame:
    """The model with the smallest total costs for a number of queries, for every problem and level of error.

    Parameters
    ----------
    cells
        Rows of the table of cells, of one machine.
    paired
        The rounds of these cells.
    queries
        Number of queries.
    errors
        Errors of the cells by another measure than the larger mean one of u and λ, in their rows or in more.
    within
        The largest error that is allowed; by default every power of ten that is reached has a row.
    certified
        Bounds of the mean errors, by cell.

    Raises
    ------
    RequestError
        If the number of queries or the error is not positive.
    """
    for what, value in (("number of queries", queries), ("largest error", within)):
        if value is not None and not 0.0 < value < math.inf:
            raise RequestError(f"the {what} is {value:g}, expected a positive number")
    measured = errors_of_solution(cells) if errors is None else errors.reindex(cells.index)
    fine = ~excluded(cells, measured).any(axis=1) & cells["online_s"].notna()
    rows = list[dict[str, Any]]()
    for _, mine in cells[fine].groupby(["problem", "problem_options", "machine"], dropna=False, sort=False):
        levels = reached_errors(measured[mine.index]) if within is None else [within]
        every, bounds = list(candidates(mine, paired)), dict(_of_models(mine, certified))
        for level in levels:
            allowed = {None, *mine["cell"][measured[mine.index] <= level * (1.0 + 1e-12)]}
            row = _winner([one for one in every if one.key in allowed], paired, queries)
            bound = bounds.get(tuple(row[name] for name in OF_ONE_MODEL))
            rows.append(row | {BAND: level, "certified_error": bound})
    return pd.DataFrame(_without_repeats(rows), columns=["problem", BAND, *_other_columns(cells)])


def _other_columns(cells: pd.DataFrame) -> list[str]:
    return [*cells.columns.drop("problem"), *(name for name in ADDED if name != BAND)]


def _of_models(cells: pd.DataFrame, certified: pd.Series | None) -> Iterator[tuple[tuple[Any, ...], float]]:
    """Bounds of mean errors by `OF_ONE_MODEL`: the fastest cell of a model is seldom the one with certificates."""
    known = {} if certified is None else certified.dropna()
    for cell, *key in cells[["cell", *OF_ONE_MODEL]].itertuples(index=False):
        if cell in known:
            yield tuple(key), float(known[cell])


def _without_repeats(rows: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The rows without those whose model is that of the next smaller error of the same problem."""
    for row, following in zip(rows, [*rows[1:], None], strict=True):
        if following is None or (row["problem"], row["cell"]) != (following["problem"], following["cell"]):
            yield row


def candidates(cells: pd.DataFrame, paired: PairedSeconds) -> Iterator[Candidate]:
    """The high-fidelity model and the cells of a problem, with total costs at one speed of the machine.

    Cells of different groups are timed at different times: seconds of a query are those of a high-fidelity solution,
    which is timed in all of them, divided by the gain. These solutions are the unit of all totals: draws are of what
    the ratios to them may be in other runs, whose machine may be faster or slower as a whole.
    """
    rng, rows = np.random.default_rng(0), [dict(row) for row in cells.to_dict("records")]
    solution = float(np.exp(np.mean(np.log([row["hf_s"] for row in rows]))))
    setup = float(np.median([row["hf_setup_s"] for row in rows]))
    yield Candidate(
        model_row(rows[0], setup, solution), setup, solution, np.full(DRAWS, setup), np.full(DRAWS, solution)
    )
    for row in rows:
        ratio = paired.ratio(None, row["cell"]) or Estimate(math.log(row["online_s"] / row["hf_s"]), 0.0, 1.0)
        online = solution * np.exp(ratio.draws(rng, DRAWS))
        yield Candidate(row, row["offline_s"], solution * math.exp(ratio.mean), offline_draws(row, setup, rng), online)


def _winner(every: Sequence[Candidate], paired: PairedSeconds, queries: float) -> dict[str, Any]:
    """The row of the cheapest model, with what `COLUMNS` adds."""
    totals = np.array([one.offline + queries * one.online for one in every])
    drawn = np.array([one.offline_draws + queries * one.online_draws for one in every])
    first = int(np.argmin(totals))
    best, others = every[first], [one for k, one in enumerate(every) if k != first]
    low, high = np.quantile(drawn[first], (TAIL, 1.0 - TAIL)).tolist() if best.key else (None, None)
    begin, end = _cheapest_between(best, others)
    ties = sum(_ties(best, one, paired, queries) for one in others)
    sure = float(np.mean(np.argmin(drawn, axis=0) == first))
    numbers = {"total_s": float(totals[first]), "total_low_s": low, "total_high_s": high}
    between = {"cheapest_from": begin, "cheapest_until": end}
    return {**best.row, "online_s": best.online, **numbers, **between, "probability": sure, "ties": ties}


def _cheapest_between(best: Candidate, others: Sequence[Candidate]) -> tuple[float, float]:
    """The numbers of queries between which a model is the cheapest, which it is for one of them."""
    begin, end = 0.0, math.inf
    for one in others:
        dearer, faster = best.offline - one.offline, one.online - best.online
        if faster > 0.0:
            begin = max(begin, dearer / faster)
        elif faster < 0.0:
            end = min(end, dearer / faster)
    return math.ceil(begin), end if math.isinf(end) else math.floor(end)


def _ties(best: Candidate, other: Candidate, paired: PairedSeconds, queries: float) -> bool:
    """Whether the 95 % interval of the difference of two totals contains 0; shared offline phases cancel."""
    if best.key is None or other.key is None:
        difference = other.offline_draws - best.offline_draws + queries * (other.online_draws - best.online_draws)
    else:
        rng = np.random.default_rng(0)
        shared = shared_offline(best.row, other.row)
        ratio = paired.ratio(best.key, other.key) or Estimate(math.log(other.online / best.online), 0.0, 1.0)
        more = offline_draws(other.row, shared, rng) - offline_draws(best.row, shared, rng)
        difference = more + queries * best.online * (np.exp(ratio.draws(rng, DRAWS)) - 1.0)
    return float(np.mean(difference <= 0.0)) > TAIL


def certified_errors(queries: pd.DataFrame) -> pd.Series:
    """Bounds of the mean relative errors of cells with certificates, by cell: the larger one of u and λ, in energy."""
    fine = queries[queries["status"] == "ok"]
    return relative_bounds(fine).groupby(fine["cell"]).mean().max(axis=1, skipna=False)


def relative_bounds(queries: pd.DataFrame) -> pd.DataFrame:
    """Relative bounds of u and λ at online cost, by the names of `CERTIFIED_BOUNDS`, of every query.

    A query without a relative error, where the solution is zero, has no relative bound.
    """
    sizes = {name: queries[f"error_{name}_absolute"] / queries[f"error_{name}"] for name in CERTIFIED_BOUNDS}
    return pd.DataFrame(
        {name: queries[f"bound_online_{name}"].astype(float) / size.astype(float) for name, size in sizes.items()}
    )
