"""Queries: a reduced problem solved (timed) and judged, and solutions compared with the high-fidelity ones (not)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.errors import in_a_line
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.error_bounds import Bounds, Stability, bounds
from vibench.model.errors import Errors, Reference, errors
from vibench.qp import verification
from vibench.qp.accuracy_bounds import slack
from vibench.qp.solution import QPSolution
from vibench.qp.solve import solve_qp, takes_start
from vibench.qp.status import Status
from vibench.results.solver_agreement import solution_row
from vibench.stages.assemblies import assemblies
from vibench.stages.assembly import Model
from vibench.study import registry
from vibench.timing import Seconds, median_seconds

Row = dict[str, Any]
"""A row of a results table: column → value."""

UNMEASURABLE = 1e-8
"""Relative errors below this may be those of the high-fidelity solution: no effectivity is made of them."""


@dataclass(frozen=True)
class Asked:
    """One query before it is solved.

    Attributes
    ----------
    program, factor
        The reduced program, and the Cholesky factor of A where it is known.
    seconds
        What assembling the program takes.
    before
        Program of the parameter whose solution the solver starts from, and the number of that query; `None` to start
        from nothing.
    """

    program: VariationalInequality
    factor: Array | None
    seconds: Seconds
    before: tuple[int, VariationalInequality] | None = None


@dataclass(frozen=True)
class Task:
    """How the queries of a cell are solved and judged."""

    solver: str
    accuracy: float
    query_seconds: float

    def run(self, asked: Asked, watch: Callable[[bool], None]) -> tuple[Row, Row | None]:
        """The columns of one query, and of its solution if there is one.

        `watch` is told, untimed, when the solver begins and when it is back.
        """
        program, assembly, registered = asked.program, asked.seconds, registry.qp_solver(self.solver)
        answers: list[QPSolution] = []

        row: Row = {"assemble_s": assembly.cpu, "form": "primal" if asked.factor is None else "dual"}
        start: QPSolution | None = None

        def work() -> QPSolution:
            answers.append(solve_qp(program, self.solver, self.accuracy, registered, asked.factor, start))
            return answers[-1]

        try:
            if asked.before is not None and takes_start(self.solver):
                watch(True)
                row["started_from"], similar = asked.before
                start = solve_qp(similar, self.solver, self.accuracy, registered, asked.factor)
            answer, solving = median_seconds(work, before=partial(watch, True))
            watch(False)
        except MemoryError:
            raise
        except (Exception, SystemExit) as error:  # noqa: BLE001  a solver may raise anything; the row says what
            return row | {"status": Status.ERROR.value, "reason": in_a_line(error)}, None
        status, reason, residuals = verification.verify(program, answer, self.accuracy)
        if solving.wall > self.query_seconds:
            status, reason = Status.TIMEOUT, f"took {solving.wall:.1f} s, the limit is {self.query_seconds:g} s"
        row |= {
            "solve_s": solving.cpu,
            "total_s": assembly.cpu + solving.cpu,
            "total_wall_s": assembly.wall + solving.wall,
            "status": status.value,
            "reason": reason,
            "solver_status": answer.solver_status,
            "iterations": answer.iterations,
            "repeatable": int(all(_same(answer, other) for other in answers)),
        }
        if residuals is None or answer.x is None or answer.alpha is None:
            return row, None
        row |= {"primal_residual": residuals.primal, "dual_residual": residuals.dual, "gap": residuals.gap}
        return row, solution_row(answer.x, answer.alpha, slack(program, answer.x, answer.alpha, self.accuracy))


def _same(one: QPSolution, other: QPSolution) -> bool:
    """Whether two answers are the same to the last bit."""
    pairs = ((one.x, other.x), (one.alpha, other.alpha))
    return all((a is b) if a is None or b is None else a.tobytes() == b.tobytes() for a, b in pairs)


def assess(
    model: Model, mus: Array, answers: Sequence[tuple[Array, Array]], exact: Reference, known: Sequence[Stability]
) -> list[Row]:
    """Errors of solutions (x, α), one per parameter of `mus` (P×d), their certified bounds and effectivities."""
    if not answers:
        return []
    problem = model.problem
    vis = [assemblies(problem).at(mu) for mu in mus]
    if model.kind is Kind.PER_PARAMETER:
        asked = zip(mus, vis, answers, strict=True)
        u = np.hstack([model.lift(mu, vi, x[:, None]) for mu, vi, (x, _) in asked])
    else:
        u = model.lift(mus[0], vis[0], np.column_stack([x for x, _ in answers]))
    lam = model.generators @ np.column_stack([alpha for _, alpha in answers])
    found = zip(errors(problem, vis, exact, u, lam), bounds(problem, vis, known, u, lam), strict=True)
    return [_columns(error, bound) for error, bound in found]


def _columns(error: Errors, bound: Bounds | None) -> Row:
    row = {
        "error_u": error.u,
        "error_lambda": error.lam,
        "error_energy": error.energy,
        "error_u_absolute": error.absolute_u,
        "error_lambda_absolute": error.absolute_lam,
        "violation": error.violation,
        "complementarity": error.complementarity,
    }
    if bound is not None:
        row |= {"bound_u": bound.u, "bound_lambda": bound.lam}
        if error.u > UNMEASURABLE:
            row["effectivity_u"] = bound.u / error.absolute_u
        if error.lam > UNMEASURABLE:
            row["effectivity_lambda"] = bound.lam / error.absolute_lam
    return row
