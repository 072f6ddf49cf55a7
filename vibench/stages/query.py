"""One query of a cell: its solution, which is timed, and its verification."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import ClassVar, NamedTuple

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, in_a_line
from vibench.interfaces.formulations import FormulationAnswer
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.offline.models import CellSolver, Model, QueryStatus
from vibench.plugins import registry
from vibench.qp.scaling import in_units, nearby, random_units
from vibench.qp.solve import form_of, solve_qp, takes_start
from vibench.qp.status import Status
from vibench.qp.verification import RECOGNISED, QPSolution, check_answer, slack, verify
from vibench.results.consistency import solution_row
from vibench.stages.artefacts import Store
from vibench.stages.assembly import AssemblyStage, ReducedPrograms
from vibench.stages.base import Row, TimeLimit
from vibench.stages.formulation import FormulationStage
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import SLOW, Seconds, timed


class Answered(NamedTuple):
    """The answer of a formulation, and the solver that it was given."""

    answer: FormulationAnswer
    solver: CellSolver

    @property
    def x(self) -> Array | None:
        return self.answer.x

    @property
    def alpha(self) -> Array | None:
        return self.answer.alpha


@dataclass(frozen=True)
class ProgramQuery:
    """An assembled program for the QP solver of the cell."""

    program: VariationalInequality
    factor: Array | None  # the Cholesky factor of A where it is known; the program is then solved in its multipliers
    solver: str
    accuracy: float  # relative accuracy prescribed to the solver
    # Number and program of the query whose solution the solver starts from; `None` for a cold start.
    start: tuple[int, VariationalInequality] | None = None
    units: Array | None = None  # units (n,) of the unknowns where they are not those of the model

    @property
    def form(self) -> str:
        return form_of(self.solver, self.factor, registry.qp_solver(self.solver))

    def in_model(self, x: Array) -> Array:
        """Coordinates (n,) of the model from those of an answer."""
        return x if self.units is None else self.units * x

    def repeated(self, *seed: int) -> ProgramQuery:
        """The same query in other units of the unknowns, which depend on the seed (see docs/measurement.md)."""
        d = random_units(len(self.program.f), self.accuracy, *seed)
        return replace(
            self, program=in_units(self.program, d), factor=None if self.factor is None else self.factor * d[:, None],
            start=None if self.start is None else (self.start[0], in_units(self.start[1], d)), units=d,
        )  # fmt: skip

    def prepare(self, time_limit: TimeLimit) -> Callable[[], tuple[QPSolution, Seconds]]:
        """Solve the query to start from, untimed, and return the timed solution of this one."""
        extra = registry.qp_solver(self.solver)
        solve = partial(solve_qp, solver=self.solver, accuracy=self.accuracy, extra=extra, factor=self.factor)
        start: QPSolution | None = None
        if self.start is not None:
            with time_limit():
                start = solve(self.start[1])

        def solution() -> tuple[QPSolution, Seconds]:
            with time_limit():
                return timed(lambda: solve(self.program, start=start))

        return solution

    def check(self, answer: QPSolution) -> None:
        """Raise a `NumericalError` if the answer of a timed repetition is wrong."""
        check_answer(self.program, answer, self.accuracy)

    def assess(self, answer: QPSolution, time_limit: TimeLimit) -> tuple[QueryStatus, Row, Row | None]:  # noqa: ARG002
        """The status of an answer, and its columns in the tables of queries and of solutions."""
        status, reason, residuals = verify(self.program, answer, self.accuracy)
        row: Row = {"solver_status": answer.solver_status, "iterations": answer.iterations}
        solution = None
        if residuals is not None and answer.x is not None and answer.alpha is not None:
            solution = solution_row(answer.x, answer.alpha, slack(self.program, answer.alpha, residuals, self.accuracy))
        return QueryStatus(status, reason, residuals=residuals), row, solution


@dataclass(frozen=True)
class ModelQuery:
    """A query that the formulation itself answers at a parameter mu (d,)."""

    # `near` returns a parameter next to mu for every seed, `program` is its program, if it has any, and `start` number
    # and parameter of the query whose answer it starts from.

    form: ClassVar[str] = "formulation"

    model: Model
    mu: Array
    near: Callable[..., Array]
    program: VariationalInequality | None = None
    start: tuple[int, Array] | None = None

    def in_model(self, x: Array) -> Array:
        return x

    def repeated(self, *seed: int) -> ModelQuery:
        """The query at a parameter next to its own."""
        # A caching formulation would be timed on a cache hit at the same parameter.
        mu = self.near(*seed)
        return replace(self, mu=mu, program=self.program and self.model.online.program(mu).program)

    def prepare(self, time_limit: TimeLimit) -> Callable[[], tuple[Answered, Seconds]]:
        """Answer the query to start from, untimed, and return the timed solution of this one."""
        model, start = self.model, None
        if self.start is not None:
            with time_limit():
                start = model.answered(self.start[1], model.settings()[0])[0]

        def solution() -> tuple[Answered, Seconds]:
            settings, solver = model.settings(start)
            with time_limit():
                answer, seconds = model.answered(self.mu, settings)
            return Answered(answer, solver), seconds

        return solution

    def check(self, answered: Answered) -> QueryStatus:
        """The status of the answer of a timed repetition; a `NumericalError` if it is wrong."""
        status = self.model.status_of(self.mu, *answered, RECOGNISED, self.program)
        if status.status is not Status.OK:
            raise NumericalError(f"timed at a parameter next to its own, {status.status.value}: {status.reason}")
        return status

    def assess(self, answered: Answered, time_limit: TimeLimit) -> tuple[QueryStatus, Row, Row | None]:
        """The status of an answer, and its columns in the tables of queries and of solutions."""
        answer, solver = answered
        with time_limit():
            status = self.model.status_of(self.mu, answer, solver, 1.0, self.program)
        # A program of the formulation's own has no QP solver whose words could be recorded.
        words = answer.reason if self.program is not None else solver.last[1].solver_status if solver.last else ""
        row: Row = {"solver_status": words, "iterations": answer.iterations, "error_u_predicted": answer.uncertainty}
        x, alpha = answer.x, answer.alpha
        if self.program is None:
            return status, row, None if status.pair is None or x is None else solution_row(x, alpha, None)
        if status.residuals is None or x is None or alpha is None:
            return status, row, None
        return status, row, solution_row(x, alpha, slack(self.program, alpha, status.residuals, self.model.accuracy))


class Queries:
    """The queries of a model at the validation parameters `mus` (P×d), for any QP solver."""

    # `programs` are the programs at these, of a formulation that has any.

    def __init__(
        self, store: Store, built: FormulationStage, validation: ParameterSet, assembly: AssemblyStage | None,
        accuracy: float | None,
    ) -> None:  # fmt: skip
        self.model, self._validation = built.model(store, accuracy=accuracy), validation
        self.mus = validation.of(self.model.problem)
        self.programs: ReducedPrograms | None = None if assembly is None else assembly.programs(store)

    @cached_property
    def _before(self) -> list[int | None]:
        return query_before(self._validation, self.model.problem)

    def near(self, number: int, *seed: int) -> Array:
        """A parameter (d,) next to that of a query, which depends on the seed, for timed repetitions."""
        return nearby(self.model.problem.parameters, self.mus[number], self._validation.seed, number, *seed)

    def query(self, k: int, solver: str | None, accuracy: float | None, warm_start: bool) -> ProgramQuery | ModelQuery:
        """One query of a solver; for a warm start with the one before it on the path of `query_before`."""
        # The query before is solved again, so that a start does not depend on what the process solved before.
        before = self._before[k] if warm_start else None
        if self.programs is None or solver is None:
            model = self.model.solving(solver)
            program = None if self.programs is None else self.programs.programs[k]
            start = None if before is None else (before, self.mus[before])
            return ModelQuery(model, self.mus[k], partial(self.near, k), program, start)
        assert accuracy is not None  # formulations with programs for a QP solver have this axis
        programs = self.programs.programs
        # Coordinates of two queries are not comparable if the primal basis changes with the parameter.
        may_start = takes_start(solver) and self.model.reduced.kind is not Kind.PER_PARAMETER
        begun = (before, programs[before]) if before is not None and may_start else None
        return ProgramQuery(programs[k], self.programs.factor, solver, accuracy, begun)


def query_before(validation: ParameterSet, problem: Problem) -> list[int | None]:
    """The query whose solution every query starts from: the one before it in an ordered set, else in `path_before`."""
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


def run_query(query: ProgramQuery | ModelQuery, query_seconds: float, time_limit: TimeLimit) -> tuple[Row, Row | None]:
    """The columns of a query, and those of its solution if there is one."""
    # A solver that takes more than `query_seconds` has the status timeout.
    row: Row = {"form": query.form}
    if query.start is not None:
        row["started_from"] = query.start[0]
    try:
        solve = query.prepare(time_limit)
        answer, seconds = solve()
        # mypy cannot pair the answer with the class of the query.
        outcome, columns, solution = query.assess(answer, time_limit)  # type: ignore[arg-type]
        # Solve fast queries a second time: a deterministic solver repeats itself to the last bit.
        again = solve()[0] if outcome.status is Status.OK and seconds.wall <= SLOW else None
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001  a solver or a plugin may raise anything; recorded
        return row | {"status": Status.ERROR.value, "reason": in_a_line(error)}, None
    status, reason = outcome.status, outcome.reason
    if seconds.wall > query_seconds:
        status, reason = Status.TIMEOUT, f"took {seconds.wall:.1f} s, the limit is {query_seconds:g} s"
    repeatable = None
    if again is not None:
        pairs = ((answer.x, again.x), (answer.alpha, again.alpha))
        repeatable = int(all((a is b) if a is None or b is None else a.tobytes() == b.tobytes() for a, b in pairs))
    row |= {"status": status.value, "reason": reason, "repeatable": repeatable} | columns
    if (residuals := outcome.residuals) is not None:
        row |= {"primal_residual": residuals.primal, "dual_residual": residuals.dual, "gap": residuals.gap}
    return row, solution
