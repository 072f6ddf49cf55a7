"""Sentences on what a reader of a run has to know beside its numbers, computed from its results file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from vibench.qp.status import Status
from vibench.results import consistency
from vibench.results.consistency import agreement_sentence
from vibench.results.ranking import too_loose
from vibench.results.read import read_table


def findings(path: Path) -> list[str]:
    """Sentences on completeness, invariants, solvers, declarations and zero solutions, what is alarming first."""
    return list(all_findings({name: read_table(path, name) for name in ("cells", "queries", "disagreements")}))


def all_findings(read: Mapping[str, pd.DataFrame]) -> Iterator[str]:
    """`findings` from the tables of a run."""
    cells, checks = read["cells"], list(_checks(read))
    ok = int((cells["status"] == Status.OK).sum())
    count, accurate = (int(cells[name].fillna(0).sum()) for name in ("queries", "queries_ok"))
    met = f"{accurate} of {count} queries meet the prescribed accuracy in their recomputed KKT residuals"
    yield from (text for failed, text in checks if failed)
    yield f"{_number(len(cells), 'cell')}, {ok} with every query ok; {met}."
    yield from (text for failed, text in checks if not failed)
    yield from _not_compared(cells)
    yield from _by_problem(cells, read["queries"])


def _checks(read: Mapping[str, pd.DataFrame]) -> Iterator[tuple[bool, str]]:
    """Sentences of the checks of a run, and whether each failed."""
    cells, queries, disagreements = read["cells"], read["queries"], read["disagreements"]
    violated = consistency.violations(queries, cells.set_index("cell")["enrichment_kind"]) if len(queries) else []
    invariants = "of the inf-sup constants and the error bounds"
    # A violated invariant is an error of vibench or of a plugin, and no number of the run is to be trusted.
    if violated:
        number = _number(len(violated), "invariant")
        yield True, f"{number} {invariants} {_are(violated)} violated: {violated[0]}."
    elif len(queries):
        yield False, f"The invariants {invariants} hold in all {len(queries)} queries."
    if agreement := agreement_sentence(disagreements, cells["solver"].nunique()):
        yield bool(disagreements["flagged"].sum()), f"{agreement[:1].upper()}{agreement[1:]}."


def _not_compared(cells: pd.DataFrame) -> Iterator[str]:
    """Cells that take no part in comparisons, or whose numbers need care."""
    more = "More training parameters, a smaller interpolation tolerance or full assembly would help."
    remedies: Mapping[Literal["solver", "assembly"], tuple[str, str]] = {
        "solver": ("the QP solver makes", "A smaller accuracy would help."),
        "assembly": ("reduced assembly makes", more),
    }
    for source, (what, remedy) in remedies.items():
        if len(loose := cells[too_loose(cells, source)]):
            left_out = f"{_number(len(loose), 'cell')} {_are(loose)} not compared with others"
            cause = f"{what} 10 % or more of an error there (column {source}_share_mean)"
            yield f"{left_out}: {cause}. {remedy}"
    if len(many := cells[cells["R"] > cells["dim_W"]]):
        most = many.loc[many["R"].idxmax()]
        sizes = f"{most['R']:.0f} generators for {most['dim_W']:.0f} multipliers"
        yield f"{most['dual']} has {sizes}: one for each is a smaller cone, and exact."
    few = cells[cells["queries_ok"] < 0.5 * cells["queries"]]
    if len(few):
        having = f"{_number(len(few), 'cell')} {'has' if len(few) == 1 else 'have'}"
        yield f"{having} fewer than half of the queries ok: such errors are not compared with others."
    timed, disturbed = int(cells["disturbed"].notna().sum()), int((cells["disturbed"] == 1).sum())
    if disturbed:
        those = f"{disturbed} of {_number(timed, 'timed cell')} {'was' if disturbed == 1 else 'were'}"
        yield f"{those} timed while other processes slowed the machine down (column disturbed)."


def _by_problem(cells: pd.DataFrame, queries: pd.DataFrame) -> Iterator[str]:
    """How far declarations are tested, and solutions that are zero."""
    for problem, mine in cells.groupby("problem", sort=False):
        count = int(mine["queries"].max())
        # Three parameters or fewer exclude nothing.
        if count > 3 and mine["certificate"].isin(("certified", "verified")).any():
            # If a share p of the box were false, k random parameters would all miss it with probability (1 - p)^k.
            agree = f"Declarations of {problem} agree with the assembly at all {count} validation parameters"
            share = f"one is false in at most {3.0 / count:.2g} of the box, at 95 %"
            yield f"{agree}. Where these are drawn at random, as by default, {share}."
    for name, symbol in (("u", "u"), ("lambda", "λ")):
        for problem, mine in queries[queries[f"zero_{name}"] == 1].groupby("problem", sort=False):
            count = mine["query"].nunique()
            yield (
                f"{symbol} of {problem} is zero at {count} validation parameters: it has no relative error there, and "
                f"means are over the other queries. The reduced {symbol} is at most "
                f"{mine[f'error_{name}_scaled'].max():.2g} of the largest of the training set there."
            )


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _are(items: pd.DataFrame | list[Any]) -> str:
    return "is" if len(items) == 1 else "are"
