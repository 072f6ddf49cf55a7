"""Sentences on the results of a run, computed from its results file; none without data that support it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum, auto
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from vibench.interfaces.strategies import Kind
from vibench.model.bound_terms import CorrectionMode
from vibench.model.errors import UNMEASURABLE
from vibench.qp.status import Status
from vibench.report.figures import data as tables
from vibench.report.figures.data import Comparable, ProblemTables, label, label_of
from vibench.results import consistency, formats
from vibench.results.consistency import agreement_sentence
from vibench.results.ranking import LARGEST_BAND, eligible, too_loose
from vibench.results.read import read_table
from vibench.results.schema import KEYS, TABLES
from vibench.stability.infsup import VANISHES


class Weight(IntEnum):
    """Importance of a finding: if only a few are shown, smaller weights come first."""

    ALARM = auto()
    WHOLE_RUN = auto()
    COMPARISON = auto()
    DETAIL = auto()


@dataclass(frozen=True)
class Finding:
    """A sentence, its subject ("" for the whole run), and its weight."""

    subject: str
    text: str
    weight: Weight


def findings(path: Path) -> dict[str, list[str]]:
    """Sentences on completeness, stability, errors, costs and solvers by subject, "" for the whole run."""
    by_subject = defaultdict[str, list[str]](list)
    read = {name: read_table(path, name) for name in TABLES}
    for one in all_findings(read, tables.problem_tables(path, read)):
        by_subject[one.subject].append(one.text)
    return dict(by_subject)


def all_findings(
    read: Mapping[str, pd.DataFrame], by_problem: Iterable[tuple[str, ProblemTables]]
) -> Iterator[Finding]:
    """Findings from the tables of a run and from its `problem_tables`: on the whole run, then problem by problem."""
    for weight, text in _whole_run(read):
        yield Finding("", text, weight)
    for name, data in by_problem:
        about = list[tuple[str, Weight, Iterator[str]]]()
        for title, cells in tables.by_dimensions(tables.best_solver(data.cells)):
            compared = tables.on_common_queries(cells, data.queries)
            about.append((f"{name}, {title}", Weight.COMPARISON, _stability(cells, compared)))
            about.append((f"{name}, {title}", Weight.COMPARISON, _costs(cells, data.thresholds)))
        about.append((f"{name}, corrections", Weight.COMPARISON, _corrections(data)))
        about.append((f"{name}, declarations", Weight.DETAIL, _declarations(data.cells)))
        about.append((f"{name}, training", Weight.COMPARISON, _training(data.cells)))
        about.append((f"{name}, enrichments", Weight.DETAIL, _off_training(data)))
        about.append((f"{name}, zero solutions", Weight.DETAIL, _zero_solutions(data)))
        about.append((f"{name}, solvers", Weight.DETAIL, _solvers(data)))
        yield from (Finding(subject, text, weight) for subject, weight, texts in about for text in texts)


def leading(findings: Iterable[Finding], most: int) -> list[Finding]:
    """The `most` findings by weight; of equal weight, every subject has its first one before its second."""
    before = defaultdict[tuple[Weight, str], int](int)
    ranked = list[tuple[Weight, int, Finding]]()
    for one in findings:
        ranked.append((one.weight, before[one.weight, one.subject], one))
        before[one.weight, one.subject] += 1
    return [one for *_, one in sorted(ranked, key=lambda entry: entry[:2])][:most]


def _whole_run(read: Mapping[str, pd.DataFrame]) -> Iterator[tuple[Weight, str]]:
    cells, queries = read["cells"], read["queries"]
    ok = int((cells["status"] == Status.OK).sum())
    count, accurate = (int(cells[name].fillna(0).sum()) for name in ("queries", "queries_ok"))
    met = f"{accurate} of {count} queries meet the prescribed accuracy in their recomputed KKT residuals"
    yield Weight.WHOLE_RUN, f"{_number(len(cells), 'cell')}, {ok} with every query ok; {met}."
    violated = consistency.violations(queries, cells.set_index("cell")["enrichment_kind"]) if len(queries) else []
    invariants = "of the inf-sup constants and the error bounds"
    # A violated invariant is an error of vibench or of a plugin, and no number of the run is to be trusted.
    if violated:
        number = _number(len(violated), "invariant")
        yield Weight.ALARM, f"{number} {invariants} {_are(violated)} violated: {violated[0]}."
    elif len(queries):
        yield Weight.WHOLE_RUN, f"The invariants {invariants} hold in all {len(queries)} queries."
    disagreements = read["disagreements"]
    if agreement := agreement_sentence(disagreements, cells["solver"].nunique()):
        flagged = bool(disagreements["flagged"].sum())
        yield Weight.ALARM if flagged else Weight.WHOLE_RUN, f"{agreement[:1].upper()}{agreement[1:]}."
    more = "More training parameters, a smaller interpolation tolerance or full assembly would help."
    remedies: Mapping[Literal["solver", "assembly"], tuple[str, str]] = {
        "solver": ("the QP solver makes", "A smaller accuracy would help."),
        "assembly": ("reduced assembly makes", more),
    }
    for source, (what, remedy) in remedies.items():
        if len(loose := cells[too_loose(cells, source)]):
            left_out = f"{_number(len(loose), 'cell')} {_are(loose)} not compared with others"
            cause = f"{what} 10 % or more of an error there (column {source}_share_mean)"
            yield Weight.WHOLE_RUN, f"{left_out}: {cause}. {remedy}"
    if len(many := cells[cells["R"] > cells["dim_W"]]):
        most = many.loc[many["R"].idxmax()]
        sizes = f"{most['R']:.0f} generators for {most['dim_W']:.0f} multipliers"
        yield Weight.WHOLE_RUN, f"{most['dual']} has {sizes}: one for each is a smaller cone, and exact."
    few = cells[cells["queries_ok"] < 0.5 * cells["queries"]]
    if len(few):
        having = f"{_number(len(few), 'cell')} {'has' if len(few) == 1 else 'have'}"
        # The same half as in `on_common_queries`.
        yield Weight.WHOLE_RUN, f"{having} fewer than half of the queries ok: such errors are not compared with others."
    timed, disturbed = int(cells["disturbed"].notna().sum()), int((cells["disturbed"] == 1).sum())
    if disturbed:
        those = f"{disturbed} of {_number(timed, 'timed cell')} {'was' if disturbed == 1 else 'were'}"
        yield Weight.WHOLE_RUN, f"{those} timed while other processes slowed the machine down (column disturbed)."


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _are(items: pd.DataFrame | list[Any]) -> str:
    return "is" if len(items) == 1 else "are"


def _percent(error: float) -> str:
    return f"{100.0 * error:g} %"


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"


def _errors(cell: Any) -> str:
    errors = {"u": cell["error_u_mean"], "λ": cell["error_lambda_mean"]}
    return " and ".join(f"{value:.3g} in {name}" for name, value in errors.items() if not pd.isna(value))


def _stability(cells: pd.DataFrame, compared: Comparable) -> Iterator[str]:
    """Effect of the enrichments on the inf-sup constant over the span and on the error of the multiplier."""
    errors = dict(zip(compared.cells["cell"], compared.cells["error_lambda_mean"], strict=True))
    # Constants do not depend on corrections: uncorrected models say more of the enrichment.
    if (plain := cells["correction"] == CorrectionMode.NONE).any():
        cells = cells[plain]
    for row in cells[cells["enrichment_kind"] == Kind.NONE].head(1).itertuples():
        if np.isfinite(row.beta_span_min):
            value = "zero" if row.beta_span_min < VANISHES else f"{row.beta_span_min:.3g}"
            yield (
                f"Without enrichment, min β over the span is {value} and min β over the cone at least "
                f"{row.beta_cone_lower_min:.3g}{_mean_error(errors.get(row.cell), compared.over)}."
            )
    fixed = cells[(cells["enrichment_kind"] == Kind.FIXED) & np.isfinite(cells["beta_span_min"])]
    for row in fixed.drop_duplicates(["primal", "primal_tol"]).itertuples():
        yield (
            f"{label(row.primal, row.primal_tol)} adds {row.enrichment:.0f} vectors, with which min β over the span is "
            f"{row.beta_span_min:.3g}, at every validation parameter at least {100.0 * row.share_validation:.0f} % of "
            f"the constant of the whole of V{_mean_error(errors.get(row.cell), compared.over)}."
        )


def _corrections(data: ProblemTables) -> Iterator[str]:
    """Effect of the correction of all solutions on errors and seconds, against the same models without it."""
    model = [name for name in KEYS if name != "correction"]
    plain = data.cells[data.cells["correction"] == CorrectionMode.NONE]
    both = data.cells.merge(plain, on=model, suffixes=("", "_without"))
    corrected = both[both["correction"] == CorrectionMode.FEASIBLE]
    for (how, bounds), cells in corrected.groupby(["assembly", "bounds"], sort=False):
        assembly = f"{how} assembly{' and bounds' * bool(bounds)}"
        ratios = {
            name: cells[f"{column}_without"] / cells[column]
            for name, column in (("u", "error_u_mean"), ("λ", "error_lambda_mean"), ("query", "online_s"))
        }
        medians, best = {name: values.median() for name, values in ratios.items()}, ratios["λ"].max()
        if np.isfinite([*medians.values(), best]).all():
            yield (
                f"Correction of all solutions, with {assembly}, divides the mean error of u by "
                f"{medians['u']:.2g} and that of λ by {medians['λ']:.2g} in the median of "
                f"{_number(len(cells), 'model')}, of λ by at most {best:.2g}; a query takes "
                f"{1.0 / medians['query']:.2g} times as long."
            )


def _declarations(cells: pd.DataFrame) -> Iterator[str]:
    """How far declarations are tested, where bounds at online cost rest on them."""
    count = int(cells["queries"].max())
    # Fewer parameters exclude nothing.
    if count > 3 and cells["certificate"].isin(("certified", "verified")).any():
        # If a share p of the box were false, k random parameters would all miss it with probability (1 - p)^k.
        yield (
            f"Declarations agree with the assembly at all {count} validation parameters. Where these are drawn at "
            f"random, as by default, a declaration is false in at most {3.0 / count:.2g} of the box, at 95 %."
        )


def _training(cells: pd.DataFrame) -> Iterator[str]:
    """Training sets that took longer to choose than to solve: as many solutions again would have cost less."""
    chosen = cells[(cells["offline_selection_s"] > 0.0) & (cells["hf_s"] > 0.0)]
    for (training, _), group in chosen.groupby(["training", "training_options"], sort=False):
        row = group.loc[group["snapshots"].idxmax()]
        count, instead = int(row["snapshots"]), int(row["offline_selection_s"] / row["hf_s"])
        if instead > count:
            yield (
                f"Choosing {count} training parameters by {training} took {row['offline_selection_s']:.2g} s, as long "
                f"as {instead} more solutions: it can pay only where a given training set would need {count + instead}."
            )


def _mean_error(error: float | None, over: str) -> str:
    """The mean error of λ of a cell over the common queries; "" without one."""
    return "" if error is None or pd.isna(error) else f"; the mean error of λ is {error:.3g}{over}"


def _off_training(data: ProblemTables) -> Iterator[str]:
    """Stability of fixed enrichments at validation parameters against that at training parameters."""
    # Ratios that differ by less are equal up to round-off.
    margin = 1e-8
    fixed = data.cells[data.cells["share_training"].notna()].drop_duplicates(["primal", "primal_tol", "dual", "pair"])
    lost = fixed["share_training"] - fixed["share_validation"]
    if lost.max() > margin:
        worst = fixed.loc[lost.idxmax()]
        yield (
            f"The share of β over the span in that of the whole of V is smaller at validation parameters than at "
            f"training parameters in {(lost > margin).sum()} of {len(fixed)} fixed enrichments, at worst "
            f"{worst['share_validation']:.3f} against {worst['share_training']:.3f} "
            f"({label(worst['primal'], worst['primal_tol'])}, {worst['dual']})."
        )
    bounded = fixed[fixed["share_guaranteed"].notna()]
    broken = bounded[bounded["share_validation"] < bounded["share_guaranteed"] - margin]
    if len(bounded):
        yield (
            f"√(1 − σ²), which bounds this share at training parameters, is not reached at a validation parameter in "
            f"{len(broken)} of {len(bounded)} fixed enrichments that record σ."
        )


def _zero_solutions(data: ProblemTables) -> Iterator[str]:
    """Queries without relative error, since the high-fidelity u or λ is zero, and the size of the reduced one."""
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
                f"({label_of(worst)}, {worst['dual']}, "
                f"{worst['solver']}), in the median {scaled.median():.2g}."
            )


def _costs(cells: pd.DataFrame, thresholds: pd.DataFrame) -> Iterator[str]:
    """The fastest query of the eligible cells of one pair, and the break-even of its cell."""
    timed = cells[eligible(cells) & cells["online_s"].notna()]
    if timed.empty:
        return
    row = timed.loc[timed["online_s"].idxmin()]
    name = label_of(row)
    yield (
        f"The fastest query with mean errors of at most {_percent(LARGEST_BAND)} is that of {name}: "
        f"{_milliseconds(row['online_s'])}, of which the QP solver takes {_milliseconds(row['online_solve_s'])}, with "
        f"mean errors of {_errors(row)}; a high-fidelity solution takes {_milliseconds(row['hf_s'])} after a set-up of "
        f"{_milliseconds(row['hf_setup_s'])}."
    )
    against = thresholds[(thresholds["cell_b"] == row["cell"]) & thresholds["cell_a"].isna()]
    for threshold in against.itertuples():
        number = "" if pd.isna(threshold.benefit_threshold) else " queries"
        interval = formats.interval(threshold.threshold_low, threshold.threshold_high)
        within = f", 95 % interval {interval}" if interval else ""
        break_even = f"{formats.break_even(threshold.meaning, threshold.benefit_threshold)}{number}{within}"
        yield f"Break-even of {name} against high-fidelity solutions: {break_even}."


def _solvers(data: ProblemTables) -> Iterator[str]:
    """Programs solved by each solver at each accuracy; median time and mean errors on the common ones."""
    several, by = data.cells["accuracy"].nunique() > 1, ["solver", "accuracy"]
    solved = data.queries[data.queries["status"] == Status.OK].groupby(by).size()
    shared = dict(iter(tables.common_programs(data.queries).groupby(by)))
    common, errors = max(map(len, shared.values()), default=0), list[str]()
    for way, cells in data.cells.groupby(by, sort=False):
        solver = "{} at {:g}".format(*way) if several else way[0]
        asked, median = int(cells["queries"].fillna(0).sum()), ""
        if way in shared:
            over = f" over the {common} programs that all solved" if common < asked else ""
            median = f", with a median of {1e3 * shared[way]['solve_s'].median():.3g} ms{over}"
            means = shared[way][["error_u", "error_lambda"]].mean()
            errors.append(f"{solver} {means.iloc[0]:.3g} and {means.iloc[1]:.3g}")
        yield f"{solver} solved {solved.get(way, 0)} of {asked} programs{median}."
    if len(errors) > 1 and common < solved.max():
        yield f"Mean errors of u and λ over these {common} programs: {'; '.join(errors)}."
