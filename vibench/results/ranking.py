"""How models are compared: by the error of u and λ or of a quantity of interest, in bands of it, and who wins."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from vibench.arrays import Array
from vibench.errors import RequestError, unknown_name
from vibench.model.bound_terms import CorrectionMode
from vibench.qp.status import Status
from vibench.results.break_even import HIGH_FIDELITY, TAIL, offline_draws, shared_offline
from vibench.results.paired_timing import DRAWS, MeanEstimate, PairedTiming
from vibench.results.schema import STORED, Column, Row, integer, real
from vibench.stability.infsup import VANISHES


def columns_of_measures() -> dict[str, tuple[str, ...]]:
    """Measures of the error of the solution, each with the columns of the cells table whose maximum it is."""
    return {"solution": ("error_u_mean", "error_lambda_mean"), "u": ("error_u_mean",), "lambda": ("error_lambda_mean",)}


def measures(outputs: pd.DataFrame) -> list[str]:
    """Error measures of a run, from its table of outputs."""
    return [*columns_of_measures(), *(f"output:{name}" for name in outputs["output"].unique())]


def error_columns() -> dict[str, Column]:
    """Columns that an error measure adds to a table of break-even points."""
    return {
        "error_a": real("1", "Error of model a by the chosen measure; 0 of the high-fidelity one.", "error a", 22),
        "error_b": real("1", "Error of model b by the chosen measure.", "error b", 23),
    }


def fastest_columns() -> dict[str, Column]:
    """Columns of the table of the fastest queries: those of the cells, the accuracy and the ties."""
    return {
        **STORED["cells"],
        "error_below": real("1", "Power of ten that mean errors, of u and λ unless told, do not exceed.", "error ≤", 1),
        "ties": integer("Other models whose query may be as fast: the interval of the ratio contains 1.", "ties", 24),
    }  # fmt: skip


def cheapest_columns() -> dict[str, Column]:
    """Columns of the table of the cheapest models: those of the fastest ones, and what a number of queries adds."""
    return fastest_columns() | {
        "total_s": real("s", "Offline seconds and those of the queries.", "total [s]", 24),
        "total_low_s": real("s", "Lower end of the 95 % interval of this sum, in seconds of a high-fidelity solution "
            "as this run measured it; the sum of the high-fidelity model has none."),
        "total_high_s": real("s", "Upper end of the interval of the total; a table shows both.", "interval [s]", 25),
        "certified_error": real("1", "Mean over the queries of the larger bound of the relative errors of u and λ, in "
            "energy, at online cost, of this model; empty if no cell of the run has its certificate.",
            "certified error", 22),
        "cheapest_from": real("1", "Number of queries from which it is the cheapest.", "cheapest from", 26),
        "cheapest_until": real("1", "Number of queries until which it is; infinite if for ever.", "until", 27),
        "probability": real("1", "Share of draws of what other runs may measure in which it is the cheapest.",
            "sure", 28),
        "ties": integer("Other models that may be as cheap: the 95 % interval of the difference to this one contains "
            "0.", "ties", 29),
    }  # fmt: skip


def added_columns() -> dict[str, Column]:
    """Columns of the table of the cheapest models that the cells table does not have."""
    return {name: column for name, column in cheapest_columns().items() if name not in STORED["cells"]}


def errors_of(cells: pd.DataFrame, outputs: pd.DataFrame, measure: str = "solution") -> pd.Series:
    """Mean relative errors, one for each row of the cells table; missing where none is known.

    A quantity of interest is measured by its mean relative error over the ok queries where it is not zero.

    Raises a `RequestError` if there is no such measure.
    """
    if measure not in measures(outputs):
        raise unknown_name("error measure", measure, measures(outputs))
    if measure in columns_of_measures():
        return errors_of_solution(cells, measure)
    of_output = outputs[outputs["output"] == measure.removeprefix("output:")]
    return cells["cell"].map(of_output.set_index("cell")["error_mean"]).astype(float)


def errors_of_solution(cells: pd.DataFrame, measure: str = "solution") -> pd.Series:
    """Mean relative errors of u, of λ, or the larger one of these; the other one where one is missing."""
    return cells[list(columns_of_measures()[measure])].astype(float).max(axis=1, skipna=True)


def with_errors(thresholds: pd.DataFrame, cells: pd.DataFrame, errors: pd.Series) -> pd.DataFrame:
    """Break-even points with the errors of both models; `errors` are those of the cells, in their rows."""
    by_cell = pd.Series(errors.to_numpy(float), index=cells["cell"])
    of_a, of_b = (thresholds[end].map(by_cell).astype(float) for end in ("cell_a", "cell_b"))
    return thresholds.assign(error_a=of_a.mask(thresholds["cell_a"].isna(), 0.0), error_b=of_b)


def within(thresholds: pd.DataFrame, largest: float) -> pd.DataFrame:
    """Break-even points of models with errors of at most `largest`; a `RequestError` if this is not positive."""
    if not largest > 0.0:
        raise RequestError(f"the largest error is {largest:g}, expected a positive number")
    return thresholds[(thresholds["error_a"] <= largest) & (thresholds["error_b"] <= largest)]


# Mean errors above this are no answer: such cells win nothing, however fast they are.
LARGEST_BAND = 0.1


def no_best_cell() -> str:
    """Reason why a run may have no best cell."""
    parts = "less than 10 % of an error made by the QP solver, and by reduced assembly"
    needed = f"every query ok, mean errors of at most {100.0 * LARGEST_BAND:g} %, and {parts}"
    return f"no cell takes part in the comparison: one that does has {needed}"


def excluded(cells: pd.DataFrame, errors: pd.Series | None = None) -> pd.DataFrame:
    """Whether a row of the cells table takes no part, for each reason; a row has the first reason that holds.

    A query is not ok (`incomplete`); the QP solver makes too large a share of the error (`loose`), or reduced assembly
    does (`interpolated`); a mean error is above `LARGEST_BAND`, or none is known (`inexact`). That β over the span
    vanishes at a parameter is no such defect: λ need not be unique there, but mostly is; such cells are marked
    (`unstable`). `errors` are those by another measure than the larger one of u and λ.
    """
    reasons = {
        "incomplete": cells["status"] != Status.OK,
        "loose": too_loose(cells, "solver"),
        "interpolated": too_loose(cells, "assembly"),
        "inexact": ~((errors_of_solution(cells) if errors is None else errors) <= LARGEST_BAND),
    }
    holds = pd.DataFrame(reasons, index=cells.index).astype(bool)
    earlier = holds.astype(int).cumsum(axis=1).shift(1, axis=1, fill_value=0) > 0
    return holds & ~earlier


def unstable(cells: pd.DataFrame) -> pd.Series:
    """Cells where β over the span vanishes at a parameter, so that λ may not be unique there."""
    return cells["beta_span_min"].astype(float) < VANISHES


def eligible(cells: pd.DataFrame) -> pd.Series:
    """Mask of the rows of the cells table that take part in a comparison; `excluded` gives the others' reasons."""
    return ~excluded(cells).any(axis=1)


def contenders(cells: pd.DataFrame) -> pd.DataFrame:
    """The cells of one problem of which a verdict names the best: eligible ones, else those whose errors are large."""
    timed, reasons = cells["online_s"].notna(), excluded(cells)
    taking_part = timed & ~reasons.any(axis=1)
    # Errors too large for a ranking still tell how far away an answer is.
    inexact = timed & reasons["inexact"] & errors_of_solution(cells).notna()
    return cells[taking_part if taking_part.any() else inexact]


def too_loose(cells: pd.DataFrame, source: Literal["solver", "assembly"]) -> pd.Series:
    """Mask of the cells to which the source contributes too large a fraction of an error to compare strategies."""
    # At a tenth of an error the solver or the assembly, not the strategies, would decide who is more accurate.
    return cells[f"{source}_share_mean"].astype(float) >= 0.1


def fastest(cells: pd.DataFrame, errors: pd.Series | None = None, paired: PairedTiming | None = None) -> pd.DataFrame:
    """The model, for every problem and power of ten, with the fastest query whose mean errors do not exceed it.

    The high-fidelity model competes. Cells that are not `eligible` take no part, as in the leaderboard of a report. A
    band whose model is that of the next smaller one is left out. `errors` are those of the cells by another measure, in
    their rows or in more; with the rounds of the cells, others that may be as fast are counted as ties.
    """
    measured = errors_of_solution(cells) if errors is None else errors.reindex(cells.index)
    fine = ~excluded(cells, measured).any(axis=1) & cells["online_s"].notna()
    rows = list[pd.Series]()
    for _, mine in cells[fine].groupby(["problem", "problem_options"], dropna=False):
        for error, within, smallest in bands(mine, measured[mine.index], ["online_s"]):
            winner = _fastest(within, smallest["online_s"], paired)
            rows.append(pd.Series({**winner.cell, "error_below": error, "ties": len(winner.ties)}))
    columns = ["problem", "error_below", "ties", *cells.columns.drop("problem")]
    return pd.DataFrame(rows, columns=columns).reset_index(drop=True)


def reached_errors(errors: pd.Series) -> list[float]:
    """The powers of ten that errors do not exceed, from the largest to the smallest."""
    return [10.0**digit for digit in sorted(set(_digits(errors)), reverse=True)]


def _digits(errors: pd.Series) -> pd.Series:
    # By round-off the logarithm of 1e-3 may be above -3.
    return np.ceil(np.log10(errors.clip(lower=np.finfo(float).tiny)) - 1e-12)


def bands(cells: pd.DataFrame, errors: pd.Series, names: Collection[str]) -> Iterator[tuple[float, pd.DataFrame, Row]]:
    """The bands of accuracy that the cells of one problem reach, from the largest error to the smallest.

    Yields the power of ten that the errors in the band do not exceed, its cells, and by each of the named columns of
    which it has a value the index of the smallest one, of equal ones the first. A band in which the same cells have
    these as in the next smaller one is left out.
    """
    digits = _digits(errors)
    smaller: Row | None = None
    reached = list[tuple[float, pd.DataFrame, Row]]()
    for digit in sorted(set(digits)):
        mine = cells[digits <= digit]
        smallest = {name: _compared(mine, name).idxmin() for name in names if mine[name].notna().any()}
        keys = {name: mine.at[index, "cell"] for name, index in smallest.items()}
        if keys != smaller:
            reached.append((10.0**digit, mine, smallest))
        smaller = keys
    yield from reversed(reached)


def _compared(cells: pd.DataFrame, column: str) -> pd.Series:
    """Values that are compared: a column, or the ratio of seconds of a query to those of a high-fidelity solution.

    Both are timed in the same rounds; those of other cells may have come when the machine was slower.
    """
    values = cells[column].astype(float)
    return values / cells["hf_s"].astype(float) if column == Criterion.QUERY.column else values


class Criterion(StrEnum):
    """Quantity that is smallest for the winner."""

    QUERY = "fastest query"
    OFFLINE = "fewest offline seconds"
    ERROR = "smallest error"

    @property
    def column(self) -> str:
        """Column with the quantity: CPU seconds, or the larger one of the mean relative errors of u and λ."""
        columns = {Criterion.QUERY: "online_s", Criterion.OFFLINE: "offline_s"}
        return columns.get(self, "largest_mean_error")


@dataclass(frozen=True)
class Winner:
    """A cell with the smallest value among the cells of its problem whose mean errors are within a band."""

    criterion: Criterion
    value: float  # seconds, or a relative error
    cell: Row  # the whole row of the cells table; the high-fidelity model has the empty key ""
    # Other cells that share the place: the 95 % interval of the difference contains 0, or there is no difference.
    ties: tuple[str, ...] = ()


@dataclass(frozen=True)
class Band:
    """The winners among the `cells` cells whose mean errors of u and λ are both at most `error`, a power of ten."""

    error: float
    cells: int
    winners: tuple[Winner, ...]

    def winner(self, criterion: Criterion) -> Winner | None:
        """The winner by a criterion; `None` where no cell of the band has a value of it."""
        return next((one for one in self.winners if one.criterion is criterion), None)


@dataclass(frozen=True)
class Standings:
    """The leaderboard of one problem, with its label and options as in the table of cells."""

    problem: str
    options: str
    bands: tuple[Band, ...]  # from the largest error to the smallest that is reached
    cells: int  # number of all cells
    unstable: int  # number of cells that take part although β over the span vanishes at a parameter
    # Numbers of cells that take no part, by the reason that `excluded` explains.
    incomplete: int
    loose: int
    interpolated: int
    inexact: int


def leaderboard(cells: pd.DataFrame, paired: PairedTiming | None = None) -> tuple[Standings, ...]:
    """The winners of every problem in every band of accuracy, in the order of the cells.

    One machine has measured them all, since seconds are compared. The high-fidelity model competes for the fastest
    query. There are no bands where no cell takes part. Who may be as good shares the place, of seconds of a query where
    their rounds are given.
    """
    found, columns = list[Standings](), [criterion.column for criterion in Criterion]
    for (problem, options), mine in cells.groupby(["problem", "problem_options"], dropna=False, sort=False):
        without, errors = excluded(mine), errors_of_solution(mine)
        rows = mine.assign(**{Criterion.ERROR.column: errors})[~without.any(axis=1)]
        reached = tuple(
            Band(error, len(within), tuple(_winners(mine, within, smallest, paired)))
            for error, within, smallest in bands(rows, errors[rows.index], columns)
        )
        counts = {str(reason): int(count) for reason, count in without.sum().items()} | {"cells": len(mine)}
        found.append(Standings(str(problem), str(options), reached, unstable=int(unstable(rows).sum()), **counts))
    return tuple(found)


def _winners(cells: pd.DataFrame, rows: pd.DataFrame, smallest: Row, paired: PairedTiming | None) -> Iterator[Winner]:
    for criterion in Criterion:
        column = criterion.column
        if column in smallest and criterion is Criterion.QUERY:
            yield _fastest(rows.drop(columns=Criterion.ERROR.column), smallest[column], paired)
        elif column in smallest:
            first, others = rows.loc[smallest[column]], rows.drop(index=smallest[column])
            alike = tuple(other["cell"] for _, other in others.iterrows() if _as_good(criterion, first, other))
            yield Winner(criterion, float(first[column]), cells.loc[smallest[column]], alike)


def _as_good(criterion: Criterion, first: pd.Series, other: pd.Series) -> bool:
    """Whether a cell shares the place of the first one, by errors or by offline seconds."""
    if criterion is Criterion.OFFLINE:
        rng, shared = np.random.default_rng(0), shared_offline(first, other)
        more = offline_draws(other, shared, rng) - offline_draws(first, shared, rng)
        return float(np.mean(more <= 0.0)) > TAIL
    column, names = Criterion.ERROR.column, ("solver_error_u_max", "solver_error_lambda_max")
    parts = [[float(one[name]) for name in names if pd.notna(one[name])] for one in (first, other)]
    allowed = sum(max(some, default=0.0) for some in parts)
    return bool(other[column] - first[column] <= allowed)


def high_fidelity_row(cell: Row, cells: pd.DataFrame) -> dict[str, Any]:
    """A row of the cells table, like that of a cell, for the high-fidelity model of some cells; it has no errors."""
    setup = float(np.median(cells["hf_setup_s"].astype(float)))
    solution = float(np.exp(np.mean(np.log(cells["hf_s"].astype(float)))))
    same = ("problem", "problem_options", "machine", "status", "queries", "queries_ok", "accuracy", "training")
    row = dict.fromkeys(cell) | {name: cell.get(name) for name in same}
    row |= dict.fromkeys(("cell", "formulation", "dual", "solver", "assembly"), "")
    row |= dict.fromkeys((f"{axis}_options" for axis in ("formulation", "training", "dual", "primal")), "{}")
    row.update(N=cell.get("dim_V"), R=cell.get("dim_W"), offline_s=setup, online_s=solution, hf_s=solution)
    row.update(error_u_mean=0.0, error_lambda_mean=0.0, bounds=None, disturbed=0)
    return row | {"primal": HIGH_FIDELITY, "correction": CorrectionMode.NONE.value}


def _fastest(cells: pd.DataFrame, index: Any, paired: PairedTiming | None) -> Winner:
    """The fastest query of some cells, of which that in row `index` is the fastest, and of the high-fidelity model."""
    first, timed = cells.loc[index], cells[cells["online_s"].notna()]
    row = high_fidelity_row(first.to_dict(), timed) if first["online_s"] > first["hf_s"] else first
    others = timed["cell"][timed["cell"] != row["cell"]]
    ratios = {} if paired is None else {cell: paired.ratio(row["cell"] or None, cell) for cell in others}
    # Those tie for which the 95 % interval of the ratio contains 1, or none is known.
    ties = (cell for cell, ratio in ratios.items() if ratio is None or ratio.interval(TAIL)[0] <= 0.0)
    return Winner(Criterion.QUERY, float(row["online_s"]), row, tuple(ties))


class Candidate(NamedTuple):
    """A model that competes: its row of the cells table, and its total costs."""

    row: Row
    offline: float
    online: float
    offline_draws: Array
    online_draws: Array

    @property
    def key(self) -> str | None:
        """Its cell; `None` of the high-fidelity model."""
        return self.row["cell"] or None


def cheapest(
    cells: pd.DataFrame, paired: PairedTiming, queries: float, errors: pd.Series | None = None,
    within: float | None = None, certified: pd.Series | None = None,
) -> pd.DataFrame:  # fmt: skip
    """The model with the smallest total costs for a number of queries, for every problem and level of error.

    The cells are those of one machine, and `paired` has their rounds. `errors` are those of the cells by another
    measure than the larger mean one of u and λ, in their rows or in more. `within` is the largest error allowed; by
    default every power of ten that is reached has a row. `certified` are bounds of the mean errors, by cell.

    Raises a `RequestError` if the number of queries or the error is not positive.
    """
    for what, value in (("number of queries", queries), ("largest error", within)):
        if value is not None and not 0.0 < value < math.inf:
            raise RequestError(f"the {what} is {value:g}, expected a positive number")
    measured = errors_of_solution(cells) if errors is None else errors.reindex(cells.index)
    fine = ~excluded(cells, measured).any(axis=1) & cells["online_s"].notna()
    rows = list[dict[str, Any]]()
    # Columns that are equal in cells whose queries have the same solutions, with certificates or without: the fastest
    # cell of a model is seldom the one with certificates.
    axes = ["model", "correction", "solver", "accuracy"]
    known = {} if certified is None else certified.dropna()
    for _, mine in cells[fine].groupby(["problem", "problem_options", "machine"], dropna=False, sort=False):
        levels = reached_errors(measured[mine.index]) if within is None else [within]
        every, models = list(candidates(mine, paired)), mine[["cell", *axes]].itertuples(index=False)
        bounds = {tuple(model): float(known[cell]) for cell, *model in models if cell in known}
        for level in levels:
            allowed = {None, *mine["cell"][measured[mine.index] <= level * (1.0 + 1e-12)]}
            row = _winner([one for one in every if one.key in allowed], paired, queries)
            bound = bounds.get(tuple(row[name] for name in axes))
            rows.append(row | {"error_below": level, "certified_error": bound})
    others = [*cells.columns.drop("problem"), *(name for name in added_columns() if name != "error_below")]
    # Without the rows whose model is that of the next smaller error of the same problem.
    models = [(row["problem"], row["cell"]) for row in rows]
    different = [row for row, mine, after in zip(rows, models, [*models[1:], None], strict=True) if mine != after]
    return pd.DataFrame(different, columns=["problem", "error_below", *others])


def candidates(cells: pd.DataFrame, paired: PairedTiming) -> Iterator[Candidate]:
    """The high-fidelity model and the cells of a problem, with total costs at one speed of the machine.

    Cells of different groups are timed at different times: seconds of a query are those of a high-fidelity solution,
    which is timed in all of them, divided by the gain. Draws are of what the ratios to these may be in other runs.
    """
    rng, rows = np.random.default_rng(0), [dict(row) for row in cells.to_dict("records")]
    row = high_fidelity_row(rows[0], cells)
    setup, solution = row["offline_s"], row["online_s"]
    yield Candidate(row, setup, solution, np.full(DRAWS, setup), np.full(DRAWS, solution))
    for row in rows:
        ratio = paired.ratio(None, row["cell"]) or MeanEstimate(math.log(row["online_s"] / row["hf_s"]), 0.0, 1.0)
        online = solution * np.exp(ratio.draws(rng))
        yield Candidate(row, row["offline_s"], solution * math.exp(ratio.mean), offline_draws(row, setup, rng), online)


def _winner(every: Sequence[Candidate], paired: PairedTiming, queries: float) -> dict[str, Any]:
    totals = np.array([one.offline + queries * one.online for one in every])
    drawn = np.array([one.offline_draws + queries * one.online_draws for one in every])
    first = int(np.argmin(totals))
    best, others = every[first], [one for k, one in enumerate(every) if k != first]
    low, high = np.quantile(drawn[first], (TAIL, 1.0 - TAIL)).tolist() if best.key else (None, None)
    # The numbers of queries between which it is the cheapest, from its break-even with every other model.
    begin, end = 0.0, math.inf
    for one in others:
        dearer, faster = best.offline - one.offline, one.online - best.online
        if faster > 0.0:
            begin = max(begin, dearer / faster)
        elif faster < 0.0:
            end = min(end, dearer / faster)
    ties = sum(_ties(best, one, paired, queries) for one in others)
    sure = float(np.mean(np.argmin(drawn, axis=0) == first))
    numbers = {"total_s": float(totals[first]), "total_low_s": low, "total_high_s": high}
    between = {"cheapest_from": math.ceil(begin), "cheapest_until": end if math.isinf(end) else math.floor(end)}
    return {**best.row, "online_s": best.online, **numbers, **between, "probability": sure, "ties": ties}


def _ties(best: Candidate, other: Candidate, paired: PairedTiming, queries: float) -> bool:
    """Whether the 95 % interval of the difference of two totals contains 0; shared offline phases cancel."""
    if best.key is None or other.key is None:
        difference = other.offline_draws - best.offline_draws + queries * (other.online_draws - best.online_draws)
    else:
        rng = np.random.default_rng(0)
        shared = shared_offline(best.row, other.row)
        ratio = paired.ratio(best.key, other.key) or MeanEstimate(math.log(other.online / best.online), 0.0, 1.0)
        more = offline_draws(other.row, shared, rng) - offline_draws(best.row, shared, rng)
        difference = more + queries * best.online * (np.exp(ratio.draws(rng)) - 1.0)
    return float(np.mean(difference <= 0.0)) > TAIL


def certified_errors(queries: pd.DataFrame) -> pd.Series:
    """Bounds of the mean relative errors of cells with certificates, by cell: the larger one of u and λ, in energy."""
    fine = queries[(queries["status"] == "ok") & (queries["certificate"] != "refuted")]
    return relative_bounds(fine).groupby(fine["cell"]).mean().max(axis=1, skipna=False)


def relative_bounds(queries: pd.DataFrame) -> pd.DataFrame:
    """Relative bounds of u and λ at online cost, "u_energy" and "lambda_natural", of every query.

    A query without a relative error, where the solution is zero, has no relative bound.
    """
    relative = {}
    for name in ("u_energy", "lambda_natural"):
        size = queries[f"error_{name}_absolute"] / queries[f"error_{name}"]
        relative[name] = queries[f"bound_online_{name}"].astype(float) / size.astype(float)
    return pd.DataFrame(relative)
