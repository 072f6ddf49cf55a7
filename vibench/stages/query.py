"""A query: a reduced program solved (timed) and verified, and its solution compared with the high-fidelity one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from vibench.arrays import Array
from vibench.errors import in_a_line
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.error_bounds import Bounds, Stability, bounds
from vibench.model.errors import Errors, Reference, errors, relative_to
from vibench.qp.accuracy_bounds import slack
from vibench.qp.exact import ExactSolution
from vibench.qp.scaling import ratio
from vibench.qp.solution import QPSolution
from vibench.qp.solve import solve_qp, takes_start
from vibench.qp.status import Status
from vibench.qp.verification import verify
from vibench.results.solver_agreement import solution_row
from vibench.stages.assemblies import assemblies
from vibench.stages.assembly import Model
from vibench.stages.base import Row
from vibench.stages.cell_summary import UNMEASURABLE
from vibench.study import registry
from vibench.timing import Seconds, median_seconds


@dataclass(frozen=True)
class Query:
    """A reduced program to be solved.

    Attributes
    ----------
    program, factor
        The program, and the Cholesky factor of A where it is known.
    seconds
        Seconds of its assembly.
    start
        Number and program of the query whose solution the solver starts from; `None` for a cold start.
    """

    program: VariationalInequality
    factor: Array | None
    seconds: Seconds
    start: tuple[int, VariationalInequality] | None = None


def run_query(
    query: Query, solver: str, accuracy: float, query_seconds: float, watch: Callable[[bool], None]
) -> tuple[Row, Row | None]:
    """The columns of a query, and those of its solution if there is one.

    Its solution is verified to `accuracy`; a solver that takes more than `query_seconds` has the status timeout.
    `watch(True)` is called, untimed, before the solver begins and `watch(False)` when it has returned.
    """
    program, assembly, extra = query.program, query.seconds, registry.qp_solver(solver)
    row: Row = {"assemble_s": assembly.cpu, "form": "primal" if query.factor is None else "dual"}
    repeats: list[QPSolution] = []
    start: QPSolution | None = None

    def work() -> QPSolution:
        repeats.append(solve_qp(program, solver, accuracy, extra, query.factor, start))
        return repeats[-1]

    try:
        # The solution to start from belongs to an earlier query: its seconds are not those of this one.
        if query.start is not None and takes_start(solver):
            watch(True)
            row["started_from"], similar = query.start
            start = solve_qp(similar, solver, accuracy, extra, query.factor)
        solution, solving = median_seconds(work, before=partial(watch, True))
        watch(False)
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001  a solver may raise anything; recorded in the row
        return row | {"status": Status.ERROR.value, "reason": in_a_line(error)}, None
    status, reason, residuals = verify(program, solution, accuracy)
    if solving.wall > query_seconds:
        status, reason = Status.TIMEOUT, f"took {solving.wall:.1f} s, the limit is {query_seconds:g} s"
    row |= {
        "solve_s": solving.cpu,
        "total_s": assembly.cpu + solving.cpu,
        "total_wall_s": assembly.wall + solving.wall,
        "status": status.value,
        "reason": reason,
        "solver_status": solution.solver_status,
        "iterations": solution.iterations,
        "repeatable": int(all(_identical(solution, other) for other in repeats)),
    }
    if residuals is None or solution.x is None or solution.alpha is None:
        return row, None
    row |= {"primal_residual": residuals.primal, "dual_residual": residuals.dual, "gap": residuals.gap}
    open_by_accuracy = slack(program, solution.x, solution.alpha, accuracy)
    return row, solution_row(solution.x, solution.alpha, open_by_accuracy)


def _identical(one: QPSolution, other: QPSolution) -> bool:
    """Whether two solutions are the same to the last bit."""
    pairs = ((one.x, other.x), (one.alpha, other.alpha))
    return all((a is b) if a is None or b is None else a.tobytes() == b.tobytes() for a, b in pairs)


def error_columns(
    model: Model,
    mus: Array,
    solutions: Sequence[tuple[Array, Array]],
    reference: Reference,
    known: Sequence[Stability],
    exact: Sequence[ExactSolution | None],
) -> list[Row]:
    """Errors of solutions (x, α), one per parameter of `mus` (P×d), their error bounds and effectivities.

    `exact` are the same programs solved to round-off: what the solver contributes to the errors.
    """
    if not solutions:
        return []
    problem = model.problem
    vis = [assemblies(problem).at(mu) for mu in mus]
    if model.kind is Kind.PER_PARAMETER:
        queries = zip(mus, vis, solutions, strict=True)
        u = np.hstack([model.lift(mu, vi, x[:, None]) for mu, vi, (x, _) in queries])
    else:  # a fixed basis: all solutions are reconstructed at once
        u = model.lift(mus[0], vis[0], np.column_stack([x for x, _ in solutions]))
    lam = model.generators @ np.column_stack([alpha for _, alpha in solutions])
    found = zip(errors(problem, vis, reference, u, lam), bounds(problem, vis, known, u, lam), strict=True)
    rows = [_columns(error, bound) for error, bound in found]
    sizes = zip(*relative_to(problem, reference), strict=True)
    for row, (x, alpha), program, (size_u, size_lam) in zip(rows, solutions, exact, sizes, strict=True):
        if program is None:
            continue
        row["solver_error_u"] = ratio(float(np.linalg.norm(x - program.x)), size_u)  # the basis is orthonormal in V
        if program.unique:
            difference = model.generators @ (alpha - program.alpha)
            row["solver_error_lambda"] = ratio(float(problem.W.norm(difference)), size_lam)
        names = [name for name in ("u", "lambda") if row[f"error_{name}"] > UNMEASURABLE]
        row["solver_share"] = max((row.get(f"solver_error_{n}", 0.0) / row[f"error_{n}"] for n in names), default=None)
    return rows


def _columns(error: Errors, bound: Bounds | None) -> Row:
    row = asdict(error)
    if bound is not None:
        row |= {"bound_u": bound.u, "bound_lambda": bound.lam}
        if error.error_u > UNMEASURABLE:
            row["effectivity_u"] = bound.u / error.error_u_absolute
        if error.error_lambda > UNMEASURABLE:
            row["effectivity_lambda"] = bound.lam / error.error_lambda_absolute
    return row
