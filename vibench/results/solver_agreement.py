"""Agreement of QP solvers: distances of ok solutions of the same program, and the distance their accuracy allows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.formulations import MIXED
from vibench.qp.verification import Slack, allowed
from vibench.results.columns import DISAGREEMENTS, KEYS
from vibench.study.cells import COMPILED

if TYPE_CHECKING:  # worker processes, which start often, have no use for pandas
    import pandas as pd


def solution_row(x: Array, alpha: Array, left_open: Slack) -> dict[str, Any]:
    """Columns of the solutions table that hold x (N',), α (R,) and the slack of a solution."""
    return {
        "x": np.asarray(x, "<f8").tobytes(),
        "alpha": np.asarray(alpha, "<f8").tobytes(),
        "slack_linear": left_open.linear,
        "slack_constant": left_open.constant,
    }


def answer_row(x: Array, alpha: Array | None) -> dict[str, Any]:
    """The same columns of the answer of a formulation, whose accuracy leaves nothing open that could be compared."""
    return {
        "x": np.asarray(x, "<f8").tobytes(),
        "alpha": None if alpha is None else np.asarray(alpha, "<f8").tobytes(),
        "slack_linear": None,
        "slack_constant": None,
    }


def vectors(row: Mapping[str, Any]) -> tuple[Array, Array]:
    """The two vectors, x and α, of a row of the solutions table."""
    return np.frombuffer(row["x"], "<f8"), np.frombuffer(row["alpha"], "<f8")


@dataclass(frozen=True)
class Recorded:
    """An ok solution x (N',) of one query by one solver, with its slack."""

    solver: str
    query: int
    x: Array
    slack: Slack


def disagreement_rows(
    cells: Iterable[Mapping[str, Any]], fine_solutions: Callable[[str], Iterable[Mapping[str, Any]]]
) -> Iterator[dict[str, Any]]:
    """Rows of the disagreements table from rows of the cells table.

    `fine_solutions` gives rows of the solutions table, those of the ok queries of a cell, by its key: it is asked for
    one reduced model after the other, since all solutions of a run may be more than memory holds.
    """
    programs: dict[tuple[str, float], list[Mapping[str, Any]]] = {}
    for cell in cells:
        # answers of compiled programs and of formulations are no solver's
        if cell["model"] and cell["assembly"] != COMPILED and cell["formulation"] == MIXED:
            programs.setdefault((cell["model"], cell["accuracy"]), []).append(cell)
    for same in programs.values():
        if len({cell["solver"] for cell in same}) < 2:
            continue
        keys = {name: same[-1][name] for name in DISAGREEMENTS if name in KEYS}
        answers = (_recorded(cell, row) for cell in same for row in fine_solutions(cell["cell"]))
        yield from (keys | row for row in compare(answers))


def _recorded(cell: Mapping[str, Any], row: Mapping[str, Any]) -> Recorded:
    left_open = Slack(row["slack_linear"], row["slack_constant"])
    return Recorded(cell["solver"], row["query"], vectors(row)[0], left_open)


def sentence(disagreements: pd.DataFrame, solvers: int) -> str:
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
        if common:
            yield {"solver_a": a, "solver_b": b, **_differences(by_solver[a], by_solver[b], common)}


def _differences(a: Mapping[int, Recorded], b: Mapping[int, Recorded], queries: list[int]) -> dict[str, Any]:
    apart = np.array([float(np.linalg.norm(a[k].x - b[k].x)) for k in queries])
    limits = np.array([allowed(a[k].slack, b[k].slack) for k in queries])
    sizes = np.array([float(np.linalg.norm(a[k].x)) for k in queries])
    relative = apart / np.where(sizes > 0.0, sizes, 1.0)
    far = apart > limits
    worst = int(np.argmax(relative))
    return {
        "queries": len(queries),
        "difference_max": float(relative[worst]),
        "query_worst": queries[worst],
        "allowed_worst": float(limits[worst] / (sizes[worst] or 1.0)),
        "flagged": int(far.sum()),
        "query_flagged": queries[int(np.argmax(far))] if far.any() else None,
    }
