"""The queries of a cell: a reduced program solved and verified, its solution compared with the high-fidelity one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from vibench.arrays import Array
from vibench.errors import in_a_line
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.bound_terms import CorrectionMode
from vibench.model.errors import UNMEASURABLE, ReferenceSolutions
from vibench.model.galerkin import ReducedModel
from vibench.offline.assemblies import assemblies
from vibench.offline.correction import Answer, Corrector
from vibench.offline.models import AnyReducedModel
from vibench.plugins import registry
from vibench.qp.exact import ExactSolution
from vibench.qp.scaling import in_units, nearby, random_units, ratio
from vibench.qp.solve import solve_qp, takes_start
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, check_answer, slack, verify
from vibench.results.consistency import solution_row
from vibench.stability.coercivity import Stability
from vibench.stages.assembly import AssemblyStage, ReducedPrograms
from vibench.stages.base import Row, Watch, value_of
from vibench.stages.judging.pairs import online_columns, pair_columns
from vibench.storage.artefacts import Store
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import SLOW, Seconds, timed


@dataclass(frozen=True)
class Query:
    """A reduced program, and the QP solver that is to solve it."""

    program: VariationalInequality
    factor: Array | None
    """The Cholesky factor of A where it is known."""
    solver: str
    accuracy: float
    """Relative accuracy prescribed to the solver."""
    start: tuple[int, VariationalInequality] | None = None
    """Number and program of the query whose solution the solver starts from; `None` for a cold start."""
    units: Array | None = None
    """Units (n,) of the unknowns where they are not those of the model."""

    @property
    def form(self) -> str:
        """How it is solved: in the unknowns of the program, or in its multipliers."""
        return "primal" if self.factor is None else "dual"

    def in_model(self, x: Array) -> Array:
        """Coordinates (n,) of the model from those of an answer."""
        return x if self.units is None else self.units * x

    def repeated(self, *seed: int) -> Query:
        """The same query in other units of the unknowns, which depend on the seed; see `vibench.qp.scaling`."""
        d = random_units(len(self.program.f), self.accuracy, *seed)
        return replace(
            self,
            program=in_units(self.program, d),
            factor=None if self.factor is None else self.factor * d[:, None],
            start=None if self.start is None else (self.start[0], in_units(self.start[1], d)),
            units=d,
        )

    def check(self, answer: QPSolution) -> None:
        """Refuse the answer of a timed repetition that is none; raises a `NumericalError`."""
        check_answer(self.program, answer, self.accuracy)

    def prepare(self, watch: Watch) -> Callable[[], tuple[QPSolution, Seconds]]:
        """Solve the query to start from, whose seconds are not those of this one; returns the timed solution itself."""
        extra = registry.qp_solver(self.solver)
        solve = partial(solve_qp, solver=self.solver, accuracy=self.accuracy, extra=extra, factor=self.factor)
        start: QPSolution | None = None
        if self.start is not None:
            watch(True)
            start = solve(self.start[1])
            watch(False)

        def solution() -> tuple[QPSolution, Seconds]:
            watch(True)
            solved = timed(lambda: solve(self.program, start=start))
            watch(False)
            return solved

        return solution


class Queries:
    """The queries of a reduced model, one per validation parameter, for any QP solver.

    The store holds the artefacts of the stage of the reduced programs, of its inputs, and of what else queries need.
    `model` is the reduced model, `note` says why requested reduced assembly was replaced by full assembly, or is "",
    `mus` are the validation parameters (P×d) and `reduced` the reduced programs.
    """

    def __init__(self, store: Store, assembly: AssemblyStage) -> None:
        self.model, self.note = assembly.model(store)
        self.mus, self._seed = assembly.validation.of(self.model.problem), assembly.validation.seed
        self._validation = assembly.validation
        self.reduced: ReducedPrograms = value_of(store, assembly)
        self.store = store

    @cached_property
    def _before(self) -> list[int | None]:
        return query_before(self._validation, self.model.problem)

    def near(self, number: int, *seed: int) -> Array:
        """A parameter (d,) next to that of a query, which depends on the seed: what a timed assembly assembles at."""
        return nearby(self.model.problem.parameters, self.mus[number], self._seed, number, *seed)

    def query(self, number: int, solver: str, accuracy: float, warm_start: bool) -> Query:
        """One query of a solver; for a warm start with the one before it on the path of `query_before`.

        That one is solved again for this purpose, so that a start does not depend on what the process solved before. A
        primal basis that changes with the parameter allows none: coordinates of two queries are not comparable.
        """
        programs, start = self.reduced.programs, None
        if warm_start and takes_start(solver) and self.model.kind is not Kind.PER_PARAMETER:
            before = self._before[number]
            start = None if before is None else (before, programs[before])
        return Query(programs[number], self.reduced.factor, solver, accuracy, start)


def query_before(validation: ParameterSet, problem: Problem) -> list[int | None]:
    """The query whose solution every query of a validation set starts from: the one before it on the path.

    That is the path of the set itself where it is ordered, else one through nearest neighbours.
    """
    mus = validation.of(problem)
    return [None, *range(len(mus) - 1)] if validation.is_ordered else path_before(mus, problem.parameters)


def path_before(mus: Array, box: ParameterBox) -> list[int | None]:
    """Predecessor of every parameter (P×d) on the nearest-neighbour path from the first; ties go to the lower index."""
    scaled = (mus - box.lower) / np.maximum(box.upper - box.lower, np.finfo(float).tiny)
    before: list[int | None] = [None] * len(mus)
    left, here = set(range(1, len(mus))), 0
    while left:
        following = min(left, key=lambda k: (float(np.linalg.norm(scaled[k] - scaled[here])), k))
        before[following], here = here, following
        left.remove(following)
    return before


def run_query(query: Query, query_seconds: float, watch: Watch) -> tuple[Row, Row | None]:
    """The columns of a query, and those of its solution if there is one.

    A solver that takes more than `query_seconds` has the status timeout. What is ok and took less than `SLOW` is
    solved a second time, to see whether the solver repeats itself.
    """
    program = query.program
    row: Row = {"form": query.form}
    if query.start is not None:
        row["started_from"] = query.start[0]
    try:
        solve = query.prepare(watch)
        solution, seconds = solve()
        status, reason, residuals = verify(program, solution, query.accuracy)
        again = solve()[0] if status is Status.OK and seconds.wall <= SLOW else None
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001  a solver may raise anything; recorded in the row
        return row | {"status": Status.ERROR.value, "reason": in_a_line(error)}, None
    if seconds.wall > query_seconds:
        status, reason = Status.TIMEOUT, f"took {seconds.wall:.1f} s, the limit is {query_seconds:g} s"
    row |= {
        "status": status.value,
        "reason": reason,
        "solver_status": solution.solver_status,
        "iterations": solution.iterations,
        "repeatable": None if again is None else int(_identical(solution, again)),
    }
    if residuals is None or solution.x is None or solution.alpha is None:
        return row, None
    row |= {"primal_residual": residuals.primal, "dual_residual": residuals.dual, "gap": residuals.gap}
    open_by_accuracy = slack(program, solution.x, solution.alpha, query.accuracy)
    return row, solution_row(solution.x, solution.alpha, open_by_accuracy)


def _identical(one: QPSolution, other: QPSolution) -> bool:
    """Whether two solutions are the same to the last bit."""
    pairs = ((one.x, other.x), (one.alpha, other.alpha))
    return all((a is b) if a is None or b is None else a.tobytes() == b.tobytes() for a, b in pairs)


def error_columns(
    corrector: Corrector,
    mus: Array,
    solutions: Sequence[tuple[Array, Array]],
    reference: ReferenceSolutions,
    constants: Sequence[Stability],
    exact: Sequence[ExactSolution | None],
    projected: Sequence[ExactSolution | None] = (),
) -> list[Row]:
    """Errors of answers to solutions (x, α), one per parameter of `mus` (P×d), their error bounds and effectivities.

    `exact` are the same programs solved to round-off: what the solver contributes to the errors. `projected` are the
    programs assembled in full, solved to round-off, where those of the queries are not: what reduced assembly
    contributes. A `corrector` with a certificate gives bounds at online cost, too.
    """
    if not solutions:
        return []
    model = corrector.model
    problem = model.problem
    vis = [assemblies(problem).at(mu) for mu in mus]
    u, lam = _reconstructed(model, mus, vis, solutions)
    queries = zip(mus, solutions, u.T, lam.T, strict=True)
    answers = [corrector.answer(mu, *solution, *pair) for mu, solution, *pair in queries]
    if any(answer.is_corrected for answer in answers):
        u, lam = (np.column_stack([getattr(answer, name) for answer in answers]) for name in ("u", "lam"))
    rows = pair_columns(problem, mus, vis, u, lam, reference, constants)
    for row, answer in zip(rows, answers, strict=True):
        if corrector.mode is not CorrectionMode.NONE:
            row["corrected"], row["correction_share"] = int(answer.is_corrected), answer.share
            row["correction_note"] = answer.note
        if answer.bound is not None:
            row.update(online_columns(answer.bound, row))
    contributions = _Contributions(corrector, problem.V.norm(reference.u), problem.W.norm(reference.lam))
    full = projected or [None] * len(rows)
    for k, (row, (x, alpha), own, galerkin) in enumerate(zip(rows, solutions, exact, full, strict=True)):
        if own is None:
            continue
        given = k, mus[k], answers[k].is_corrected, row
        row.update(contributions.of("solver", *given, ExactSolution(x, alpha, unique=True), own))
        if galerkin is not None:
            row.update(contributions.of("assembly", *given, own, galerkin))
    return rows


def _reconstructed(
    model: AnyReducedModel, mus: Array, vis: Sequence[VariationalInequality], solutions: Sequence[tuple[Array, Array]]
) -> tuple[Array, Array]:
    """The columns u_N (n×P) and λ_N (m×P) of solutions (x, α)."""
    lam = model.generators @ np.column_stack([alpha for _, alpha in solutions])
    if model.kind is Kind.PER_PARAMETER:
        if isinstance(model, ReducedModel):
            return model.reconstruct_all(vis, [x for x, _ in solutions]), lam
        queries = zip(mus, vis, solutions, strict=True)
        return np.hstack([model.reconstruct(mu, vi, x[:, None]) for mu, vi, (x, _) in queries]), lam
    # a fixed basis: all solutions are reconstructed at once
    return model.reconstruct(mus[0], vis[0], np.column_stack([x for x, _ in solutions])), lam


@dataclass(frozen=True)
class _Contributions:
    """What sources of differences contribute to the relative errors of queries; `u` and `lam` (P,) are ‖u‖ and ‖λ‖."""

    corrector: Corrector
    u: Array
    lam: Array

    def of(
        self, source: str, number: int, mu: Array, corrected: bool, row: Row, one: ExactSolution, other: ExactSolution
    ) -> Row:
        """What makes the difference of two solutions of the query contributes, to those of their corrected pairs."""
        parts: Row = {}
        problem, unique = self.corrector.model.problem, one.unique and other.unique
        if corrected:
            pairs = [self._corrected(mu, solution) for solution in (one, other)]
            if not all(pair.is_corrected for pair in pairs):
                return parts
            of_u = float(problem.V.norm(pairs[0].u - pairs[1].u))
            of_lam = float(problem.W.norm(pairs[0].lam - pairs[1].lam))
        else:
            of_u = float(np.linalg.norm(one.x - other.x))  # the basis is orthonormal in V
            of_lam = float(problem.W.norm(self.corrector.model.generators @ (one.alpha - other.alpha)))
        if row["error_u"] is not None:
            parts["u"] = ratio(of_u, self.u[number])
        if row["error_lambda"] is not None and unique:
            parts["lambda"] = ratio(of_lam, self.lam[number])
        names = [name for name in ("u", "lambda") if (row[f"error_{name}"] or 0.0) > UNMEASURABLE]
        share = max((parts.get(name, 0.0) / row[f"error_{name}"] for name in names), default=None)
        return {f"{source}_error_{name}": part for name, part in parts.items()} | {f"{source}_share": share}

    def _corrected(self, mu: Array, solution: ExactSolution) -> Answer:
        """The corrected pair of a solution, whatever its ω and ρ are."""
        corrector = replace(self.corrector, mode=CorrectionMode.FEASIBLE)
        model, vi = corrector.model, assemblies(corrector.model.problem).at(mu)
        u = np.asarray(model.reconstruct(mu, vi, solution.x[:, None])[:, 0])
        alpha = np.maximum(solution.alpha, 0.0)
        return corrector.answer(mu, solution.x, alpha, u, model.generators @ alpha)
