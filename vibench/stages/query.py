"""The queries of a cell: what is solved and timed, and its verification."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

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
from vibench.qp.solve import solve_qp, takes_start
from vibench.qp.status import Status
from vibench.qp.verification import RECOGNISED, QPSolution, check_answer, slack, verify
from vibench.results.consistency import solution_row
from vibench.stages.artefacts import Store
from vibench.stages.assembly import AssemblyStage, ReducedPrograms
from vibench.stages.base import Row, TimeLimit, value_of
from vibench.stages.formulation import FormulationStage
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import SLOW, Seconds, timed


class Answered(NamedTuple):
    """The answer of a formulation, and the solver that it was given."""

    answer: FormulationAnswer
    solver: CellSolver

    @property
    def x(self) -> Array | None:
        """Coefficients of u."""
        return self.answer.x

    @property
    def alpha(self) -> Array | None:
        """Coefficients of λ."""
        return self.answer.alpha


@dataclass(frozen=True)
class ProgramQuery:
    """An assembled program for the QP solver of the cell."""

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

    def repeated(self, *seed: int) -> ProgramQuery:
        """The same query in other units of the unknowns, which depend on the seed; see `vibench.qp.scaling`."""
        d = random_units(len(self.program.f), self.accuracy, *seed)
        return replace(
            self,
            program=in_units(self.program, d),
            factor=None if self.factor is None else self.factor * d[:, None],
            start=None if self.start is None else (self.start[0], in_units(self.start[1], d)),
            units=d,
        )

    def prepare(self, time_limit: TimeLimit) -> Callable[[], tuple[QPSolution, Seconds]]:
        """Solve the query to start from, whose seconds are not those of this one; returns the timed solution itself."""
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
        """Refuse the answer of a timed repetition that is none; raises a `NumericalError`."""
        check_answer(self.program, answer, self.accuracy)

    def judge(self, answer: QPSolution, time_limit: TimeLimit) -> tuple[QueryStatus, Row, Row | None]:  # noqa: ARG002
        """The status of an answer, and its columns in the tables of queries and of solutions."""
        status, reason, residuals = verify(self.program, answer, self.accuracy)
        row: Row = {"solver_status": answer.solver_status, "iterations": answer.iterations}
        solution = None
        if residuals is not None and answer.x is not None and answer.alpha is not None:
            left_open = slack(self.program, answer.x, answer.alpha, self.accuracy)
            solution = solution_row(answer.x, answer.alpha, left_open)
        return QueryStatus(status, reason, residuals=residuals), row, solution


@dataclass(frozen=True)
class ModelQuery:
    """A query that the formulation itself answers at a parameter mu (d,).

    `program` is its program, if it has any, `start` number and parameter of the query whose answer it starts from.
    """

    model: Model
    mu: Array
    near: Callable[..., Array]
    """A parameter next to that of the query, for every seed."""
    program: VariationalInequality | None = None
    start: tuple[int, Array] | None = None

    @property
    def form(self) -> str:
        """How it is solved."""
        return "formulation"

    def in_model(self, x: Array) -> Array:
        """Coordinates of the model are those of the answer."""
        return x

    def repeated(self, *seed: int) -> ModelQuery:
        """The query at a parameter next to its own: a cache of answers would be timed otherwise."""
        mu = self.near(*seed)
        return replace(self, mu=mu, program=self.program and self.model.online.program(mu).program)

    def prepare(self, time_limit: TimeLimit) -> Callable[[], tuple[Answered, Seconds]]:
        """Answer the query to start from, whose seconds are not of this one; returns the timed solution itself."""
        model, start = self.model, None
        if self.start is not None:
            with time_limit():
                start = model.online.solve(self.start[1], model.settings()[0])

        def solution() -> tuple[Answered, Seconds]:
            settings, solver = model.settings(start)
            with time_limit():
                answer, seconds = timed(lambda: model.online.solve(self.mu, settings))
            return Answered(answer, solver), seconds

        return solution

    def check(self, answered: Answered) -> None:
        """Refuse the answer of a timed repetition that is none; raises a `NumericalError`."""
        found = self.model.status_of(self.mu, *answered, RECOGNISED, self.program)
        if found.status is not Status.OK:
            raise NumericalError(f"timed at a parameter next to its own, {found.status.value}: {found.reason}")

    def judge(self, answered: Answered, time_limit: TimeLimit) -> tuple[QueryStatus, Row, Row | None]:
        """The status of an answer, and its columns in the tables of queries and of solutions."""
        answer, solver = answered
        with time_limit():
            found = self.model.status_of(self.mu, answer, solver, program=self.program)
        words = answer.reason if self.program is not None else solver.last[1].solver_status if solver.last else ""
        row: Row = {"solver_status": words, "iterations": answer.iterations, "error_u_predicted": answer.uncertainty}
        x, alpha = answer.x, answer.alpha
        if self.program is None:
            return found, row, None if found.pair is None or x is None else solution_row(x, alpha, None)
        if found.residuals is None or x is None or alpha is None:
            return found, row, None
        return found, row, solution_row(x, alpha, slack(self.program, x, alpha, self.model.accuracy))


class Queries:
    """The queries of a model, one per validation parameter, for any QP solver.

    Attributes
    ----------
    model
        The model; its queries are for the solver that they are asked for.
    mus
        The validation parameters (P×d).
    programs
        The programs at these, of a formulation that has any.
    """

    def __init__(
        self,
        store: Store,
        built: FormulationStage,
        validation: ParameterSet,
        assembly: AssemblyStage | None,
        accuracy: float | None,
    ) -> None:
        self.model, self._validation = built.model(store, accuracy=accuracy), validation
        self.mus = validation.of(self.model.problem)
        self.programs: ReducedPrograms | None = None if assembly is None else value_of(store, assembly)

    @cached_property
    def _before(self) -> list[int | None]:
        return query_before(self._validation, self.model.problem)

    def near(self, number: int, *seed: int) -> Array:
        """A parameter (d,) next to that of a query, which depends on the seed: what a timed assembly assembles at."""
        return nearby(self.model.problem.parameters, self.mus[number], self._validation.seed, number, *seed)

    def query(
        self, number: int, solver: str | None, accuracy: float | None, warm_start: bool
    ) -> ProgramQuery | ModelQuery:
        """One query of a solver; for a warm start with the one before it on the path of `query_before`.

        That one is solved again for this purpose, so that a start does not depend on what the process solved before. A
        primal basis that changes with the parameter allows none: coordinates of two queries are not comparable.
        """
        before = self._before[number] if warm_start else None
        if self.programs is None or solver is None:
            model = self.model.solving(solver)
            program = None if self.programs is None else self.programs.programs[number]
            start = None if before is None else (before, self.mus[before])
            return ModelQuery(model, self.mus[number], partial(self.near, number), program, start)
        assert accuracy is not None  # formulations with programs for a QP solver have the axis
        programs = self.programs.programs
        may_start = takes_start(solver) and self.model.reduced.kind is not Kind.PER_PARAMETER
        begun = (before, programs[before]) if before is not None and may_start else None
        return ProgramQuery(programs[number], self.programs.factor, solver, accuracy, begun)


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


def run_query(query: ProgramQuery | ModelQuery, query_seconds: float, time_limit: TimeLimit) -> tuple[Row, Row | None]:
    """The columns of a query, and those of its solution if there is one.

    A solver that takes more than `query_seconds` has the status timeout. What is ok and took less than `SLOW` is
    solved a second time, to see whether the solver repeats itself.
    """
    row: Row = {"form": query.form}
    if query.start is not None:
        row["started_from"] = query.start[0]
    try:
        solve = query.prepare(time_limit)
        answer, seconds = solve()
        judged, columns, solution = query.judge(answer, time_limit)  # type: ignore[arg-type]  # what `prepare` has made
        again = solve()[0] if judged.status is Status.OK and seconds.wall <= SLOW else None
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001  a solver or a plugin may raise anything; recorded
        return row | {"status": Status.ERROR.value, "reason": in_a_line(error)}, None
    status, reason = judged.status, judged.reason
    if seconds.wall > query_seconds:
        status, reason = Status.TIMEOUT, f"took {seconds.wall:.1f} s, the limit is {query_seconds:g} s"
    repeatable = None if again is None else int(_identical(answer, again))
    row |= {"status": status.value, "reason": reason, "repeatable": repeatable} | columns
    if (residuals := judged.residuals) is not None:
        row |= {"primal_residual": residuals.primal, "dual_residual": residuals.dual, "gap": residuals.gap}
    return row, solution


def _identical(one: QPSolution | Answered, other: QPSolution | Answered) -> bool:
    """Whether two solutions are the same to the last bit."""
    pairs = ((one.x, other.x), (one.alpha, other.alpha))
    return all((a is b) if a is None or b is None else a.tobytes() == b.tobytes() for a, b in pairs)
