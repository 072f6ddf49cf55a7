"""Consistency of recorded results: inequalities in every row of `queries`, and agreement of QP solvers.

A violated inequality is a bug in the linear algebra of vibench. Inf-sup constants grow with the primal space: V_N ≤
enriched V_N ≤ V, with equality of the last two for per-parameter enrichments. Of intervals over the cone, the upper end
of the larger constant is compared with the lower end of the smaller. A cone with free generators is not in W⁺, and
compared with the high-fidelity pair over the span alone. The tolerance for round-off is relative to the constant of V,
at most the norm of the form. Solvers agree where ok solutions are no further apart than their accuracy allows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.strategies import Kind
from vibench.qp.verification import Slack, allowed
from vibench.results.schema import KEYS, STORED, Row
from vibench.stability.infsup import ABSOLUTE, RELATIVE
from vibench.study.cells import NO_SUCH_AXIS

if TYPE_CHECKING:  # worker processes, which start often, have no use for pandas
    import pandas as pd


@dataclass(frozen=True)
class Violation:
    """An invariant, the number of rows that violate it, and the largest violation."""

    invariant: str
    rows: int
    worst: float

    def __str__(self) -> str:
        return f"{self.invariant} is violated in {self.rows} rows, by up to {self.worst:.1e}"


def added_up(parts: Iterable[Violation]) -> list[Violation]:
    """Violations of several parts of a table, each invariant once."""
    found: dict[str, Violation] = {}
    for one in parts:
        before = found.get(one.invariant, Violation(one.invariant, 0, one.worst))
        worst = float(np.fmax(before.worst, one.worst))
        found[one.invariant] = Violation(one.invariant, before.rows + one.rows, worst)
    return list(found.values())


def violations(rows: pd.DataFrame, kinds: pd.Series) -> list[Violation]:
    """Violated invariants in rows of the queries table; `kinds` is the kind of enrichment of each cell, by cell."""
    found = list[Violation]()
    for name in (name for name in STORED["queries"] if name.startswith("effectivity_")):
        # A bound that is the error itself in exact arithmetic may be below it by round-off.
        below = rows[name].astype(float) < 1.0 - 1e-10
        if below.any():
            found.append(Violation(f"{name} ≥ 1", int(below.sum()), float(1.0 - rows[name].min())))
    # Formulations without programs have no constants.
    rows = rows[rows["beta_bounds"].notna()]
    queries, kind = rows.filter(regex="^beta_(full_|plain_|hf_)?(span|cone_)").astype(float), rows["cell"].map(kinds)
    signed = ~rows["beta_bounds"].str.startswith("span/")
    scale = queries["beta_full_cone_upper"]
    for larger, smaller in (("full_", ""), ("", "plain_"), ("full_", "hf_")):
        inside = signed if smaller == "hf_" else signed | True
        found += _at_least(queries, f"beta_{larger}span", f"beta_{smaller}span", scale)
        found += _at_least(queries[inside], f"beta_{larger}cone_upper", f"beta_{smaller}cone_lower", scale[inside])
    for whose in ("", "full_", "plain_", "hf_"):
        for smaller in ("span", "cone_lower"):
            found += _at_least(queries, f"beta_{whose}cone_upper", f"beta_{whose}{smaller}", scale)
    online, of_online = queries[kind == Kind.PER_PARAMETER], scale[kind == Kind.PER_PARAMETER]
    for larger, smaller in (("span", "full_span"), ("cone_upper", "full_cone_lower")):
        found += _at_least(online, f"beta_{larger}", f"beta_{smaller}", of_online)
    return found


def _at_least(rows: pd.DataFrame, larger: str, smaller: str, scale: pd.Series) -> Iterator[Violation]:
    missing = rows[smaller] * (1.0 - RELATIVE) - ABSOLUTE * scale - rows[larger]
    # Negated, so that NaN violates it too.
    broken = ~(missing <= 0.0) & np.isfinite(rows[smaller])
    if broken.any():
        yield Violation(f"{larger} ≥ {smaller}", int(broken.sum()), float(missing[broken].max()))


def solution_row(x: Array, alpha: Array | None, left_open: Slack | None) -> dict[str, Any]:
    """Columns of the solutions table: x (N',), α (R,), and the slack of a solution of a program."""
    return {
        "x": np.asarray(x, "<f8").tobytes(),
        "alpha": None if alpha is None else np.asarray(alpha, "<f8").tobytes(),
        "slack_linear": None if left_open is None else left_open.linear,
        "slack_constant": None if left_open is None else left_open.constant,
    }


def vectors(row: Row) -> tuple[Array, Any]:
    """The two vectors, x and α, of a row of the solutions table; α is `None` where λ has no coefficients."""
    return np.frombuffer(row["x"], "<f8"), None if row["alpha"] is None else np.frombuffer(row["alpha"], "<f8")


@dataclass(frozen=True)
class Recorded:
    """An ok solution x (N',) of one query by one solver, with its slack."""

    solver: str
    query: int
    x: Array
    slack: Slack


def disagreement_rows(cells: Iterable[Row], fine_solutions: Callable[[str], Iterable[Row]]) -> Iterator[dict[str, Any]]:
    """Rows of the disagreements table from rows of the cells table.

    `fine_solutions` gives rows of the solutions table, those of the ok queries of a cell, by its key: it is asked for
    one reduced model after the other, since all solutions of a run may be more than memory holds.
    """
    programs: dict[tuple[str, float], list[Row]] = {}
    for cell in cells:
        if cell["model"] and cell["solver"] != NO_SUCH_AXIS:
            programs.setdefault((cell["model"], cell["accuracy"]), []).append(cell)
    for same in programs.values():
        if len({cell["solver"] for cell in same}) < 2:
            continue
        keys = {name: same[-1][name] for name in STORED["disagreements"] if name in KEYS}
        rows = ((cell, row) for cell in same for row in fine_solutions(cell["cell"]))
        # Without slack it is the answer of a formulation to no program that all solvers were given.
        answers = (
            Recorded(cell["solver"], row["query"], vectors(row)[0], Slack(row["slack_linear"], row["slack_constant"]))
            for cell, row in rows
            if row["slack_linear"] is not None
        )
        yield from (keys | row for row in compare(answers))


def agreement_sentence(disagreements: pd.DataFrame, solvers: int) -> str:
    """The disagreements table in one sentence; "" for a run of fewer than two solvers, which leaves nothing to say."""
    if solvers < 2:
        return ""
    if disagreements.empty:
        return "no two solvers were ok on the same reduced problem"
    pairs, flagged = int(disagreements["queries"].sum()), int(disagreements["flagged"].sum())
    worst = disagreements.loc[disagreements["difference_max"].idxmax()]
    largest = f"u differs by at most {worst['difference_max']:.1e} ({worst['solver_a']} and {worst['solver_b']})"
    if not flagged:
        return f"solvers that were ok on the same reduced problem agree in all {pairs} comparisons: {largest}"
    return f"solvers disagree by more than the accuracy allows in {flagged} of {pairs} comparisons: {largest}"


def compare(answers: Iterable[Recorded]) -> Iterator[dict[str, Any]]:
    """Largest distance of every two solvers of one reduced model, and the number of queries where it is too large."""
    by_solver: dict[str, dict[int, Recorded]] = {}
    for answer in answers:
        by_solver.setdefault(answer.solver, {})[answer.query] = answer
    for a, b in combinations(sorted(by_solver), 2):
        common = sorted(by_solver[a].keys() & by_solver[b].keys())
        if not common:
            continue
        pairs = [(by_solver[a][k], by_solver[b][k]) for k in common]
        apart = np.array([float(np.linalg.norm(x.x - y.x)) for x, y in pairs])
        limits = np.array([allowed(x.slack, y.slack) for x, y in pairs])
        sizes = np.array([float(np.linalg.norm(x.x)) for x, _ in pairs])
        relative, far = apart / np.where(sizes > 0.0, sizes, 1.0), apart > limits
        worst = int(np.argmax(relative))
        row = {"solver_a": a, "solver_b": b, "queries": len(common), "query_worst": common[worst]}
        row |= {"difference_max": float(relative[worst]), "flagged": int(far.sum())}
        row |= {"allowed_worst": float(limits[worst] / (sizes[worst] or 1.0))}
        yield row | {"query_flagged": common[int(np.argmax(far))] if far.any() else None}
