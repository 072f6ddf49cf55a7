"""The queries of a formulation: timed, judged, and assessed as those of the mixed one are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.errors import in_a_line
from vibench.interfaces.formulations import FormulationAnswer
from vibench.interfaces.strategies import Kind
from vibench.model.certificates.base import Guarantee
from vibench.offline.assemblies import assemblies
from vibench.offline.formulated import CellSolver, Formulated
from vibench.plugins.plugin import Plugin
from vibench.qp.scaling import nearby
from vibench.qp.status import Status
from vibench.results.consistency import answer_row
from vibench.stages.base import Row, Stage, Watch
from vibench.stages.enrichment import spaces_of
from vibench.stages.formulations.building import FormulationStage
from vibench.stages.judging.cell_goal import CellGoal, CellItems, QueryRows
from vibench.stages.judging.pairs import pair_columns
from vibench.stages.query import query_before
from vibench.storage.artefacts import Store
from vibench.study.cells import Cell
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import SLOW, Seconds, timed


@dataclass(frozen=True)
class FormulationQuery:
    """A query of a formulation at a parameter mu (d,); `start` is that of the query whose answer it starts from."""

    formulated: Formulated
    mu: Array
    near: Callable[..., Array]
    """A parameter next to that of the query, for every seed."""
    start: tuple[int, Array] | None = None

    def repeated(self, *seed: int) -> FormulationQuery:
        """The query at a parameter next to its own: whoever remembers answers would be timed at looking them up."""
        return replace(self, mu=self.near(*seed))

    def prepare(self, watch: Watch) -> Callable[[], tuple[tuple[FormulationAnswer, CellSolver], Seconds]]:
        """Solve the query to start from, whose seconds are not those of this one; returns the timed solution itself."""
        formulated, start = self.formulated, None
        if self.start is not None:
            watch(True)
            start = formulated.model.solve(self.start[1], formulated.asked()[0])
            watch(False)

        def solution() -> tuple[tuple[FormulationAnswer, CellSolver], Seconds]:
            asked, solver = formulated.asked(start)
            watch(True)
            answer, seconds = timed(lambda: formulated.model.solve(self.mu, asked))
            watch(False)
            return (answer, solver), seconds

        return solution

    def check(self, found: tuple[FormulationAnswer, CellSolver]) -> None:
        """Refuse the answer of a timed repetition that is none; raises a `NumericalError`."""
        self.formulated.check_repeated(self.mu, *found)


class FormulationModels:
    """The queries of a formulation, one per validation parameter, once its stage has been run."""

    def __init__(self, store: Store, stage: FormulationQueries) -> None:
        self.formulated = stage.built.formulated(store, stage.solver, stage.accuracy)
        self.problem = self.formulated.offline.problem
        self.mus, self._seed = stage.validation_set.of(self.problem), stage.validation_set.seed
        self._validation, self._warm = stage.validation_set, stage.warm_start

    @cached_property
    def _before(self) -> list[int | None]:
        return query_before(self._validation, self.problem)

    def near(self, number: int, *seed: int) -> Array:
        """A parameter (d,) next to that of a query, which depends on the seed."""
        return nearby(self.problem.parameters, self.mus[number], self._seed, number, *seed)

    def query(self, number: int) -> FormulationQuery:
        """One query; for a warm start with the one before it on the path of `query_before`."""
        before = self._before[number] if self._warm else None
        start = None if before is None else (before, self.mus[before])
        return FormulationQuery(self.formulated, self.mus[number], lambda *seed: self.near(number, *seed), start)


@dataclass(frozen=True)
class FormulationQueries(CellGoal):
    """All queries of one cell whose formulation is a plugin."""

    built: FormulationStage
    validated: ParameterSet
    solver: str | None
    accuracy: float | None
    query_seconds: float
    warm_start: bool = False

    @property
    def problem(self) -> Plugin:
        """That of the formulation."""
        return self.built.problem

    @property
    def training_set(self) -> ParameterSet:
        """That of the formulation."""
        return self.built.training

    @property
    def validation_set(self) -> ParameterSet:
        """That of the study."""
        return self.validated

    @property
    def model(self) -> str:
        """The key of the formulation on its offline phase."""
        return self.built.key

    @property
    def offline(self) -> Mapping[str, tuple[Stage, ...]]:
        """The stages whose seconds add up to the offline time of the cell, by column."""
        built = self.built
        made = (built.decomposition, built.reduction)
        return {
            "snapshots": self.training,
            "pod": () if built.pod is None else (built.pod,),
            "cone": () if built.cone is None else (built.cone,),
            "enrichment": () if built.enrichment is None else (built.enrichment,),
            "formulation": (built,),
            "assembly": tuple(stage for stage in made if stage is not None),
            "certificate": (),
        }

    @property
    def timed_inputs(self) -> tuple[Stage, ...]:
        """The formulation and its offline phase."""
        return (*self.built.model_inputs, self.built)

    def inputs(self) -> tuple[Stage, ...]:
        """All stages whose artefacts enter the rows of the cell."""
        timed = (stage for stages in self.offline.values() for stage in stages)
        return tuple(dict.fromkeys((*self.timed_inputs, *timed, *self.reference.stages, *self.validation)))

    def begin(self, store: Store) -> _FormulationItems:
        """Load the model and the reference solutions."""
        return _FormulationItems(self, store)


class _FormulationItems(CellItems):
    """The queries of a formulation in progress."""

    def __init__(self, stage: FormulationQueries, store: Store) -> None:
        super().__init__(stage, store)
        self._stage, self._models = stage, FormulationModels(store, stage)

    def answer(self, number: int, watch: Watch) -> QueryRows:
        """The rows of one query; u and λ are reconstructed here, too, where a broken answer costs one query."""
        row, solution = self._run(self._models.query(number), watch)
        return self.known(number) | row, solution and {"query": number} | solution

    def _run(self, query: FormulationQuery, watch: Watch) -> tuple[Row, Row | None]:
        row: Row = {"form": "formulation"}
        if query.start is not None:
            row["started_from"] = query.start[0]
        try:
            solve = query.prepare(watch)
            (answer, solver), seconds = solve()
            watch(True)
            verdict = query.formulated.judged(query.mu, answer, solver)
            watch(False)
            again = solve()[0][0] if verdict.status is Status.OK and seconds.wall <= SLOW else None
        except MemoryError:
            raise
        except (Exception, SystemExit) as error:  # noqa: BLE001  a plugin may raise anything; recorded in the row
            return row | {"status": Status.ERROR.value, "reason": in_a_line(error)}, None
        status, reason = verdict.status, verdict.reason
        if seconds.wall > self._stage.query_seconds:
            status, reason = Status.TIMEOUT, f"took {seconds.wall:.1f} s, the limit is {self._stage.query_seconds:g} s"
        row |= {
            "status": status.value,
            "reason": reason,
            "solver_status": "" if solver.last is None else solver.last[1].solver_status,
            "iterations": answer.iterations,
            "repeatable": None if again is None else int(_same(answer, again)),
            "error_u_predicted": answer.uncertainty,
        }
        if (found := verdict.residuals) is not None:
            row |= {"primal_residual": found.primal, "dual_residual": found.dual, "gap": found.gap}
        return row, None if verdict.pair is None or answer.x is None else answer_row(answer.x, answer.alpha)

    def assess(self, solutions: Mapping[int, Row]) -> list[Row]:
        """Error columns of some queries."""
        numbers, formulated, mus = list(solutions), self._models.formulated, self._models.mus
        pairs = [formulated.pair(mus[k], answer_of(solution)) for k, solution in solutions.items()]
        if not pairs:
            return []
        u, lam = (np.column_stack(of_all) for of_all in zip(*pairs, strict=True))
        vis = [assemblies(self._problem).at(mus[k]) for k in numbers]
        compared, constants = self._compared.at(numbers), self.constants(numbers)
        return pair_columns(self._problem, mus[numbers], vis, u, lam, compared, constants)

    def sizes(self, rows: Sequence[Row]) -> tuple[Row, list[str]]:  # noqa: ARG002
        """Dimensions, and the fallbacks of the offline phase and of the model."""
        built, model = self._stage.built, self._models.formulated.model
        offline = self._models.formulated.offline
        fallbacks = [*model.fallbacks]
        kind, added = Kind.NONE, None
        if built.cone is not None:
            fallbacks += offline.cone.fallbacks
        if built.enrichment is not None:
            fallbacks += offline.enrichment.fallbacks
            kind, vectors = offline.enrichment.kind, offline.enrichment.vectors
            fixed = 0 if vectors is None else vectors.shape[1]
            added = offline.multipliers.rank if kind is Kind.PER_PARAMETER else fixed
        added = added if model.enrichment is None else model.enrichment
        return {
            "enrichment_kind": kind.value,
            "N": model.dimension - (added or 0),
            "R": model.generators,
            "enrichment": added,
            "multiplier": self._models.formulated.formulation.multiplier.value,
            "correction_cost": "",
            "certificate": Guarantee.NONE.value,
        }, fallbacks


def answer_of(solution: Mapping[str, Any]) -> FormulationAnswer:
    """The answer of a row of the solutions table: its coefficients, which are all that is kept of it."""
    x, alpha = (None if solution[name] is None else np.frombuffer(solution[name], "<f8") for name in ("x", "alpha"))
    return FormulationAnswer(x, alpha)


def _same(one: FormulationAnswer, other: FormulationAnswer) -> bool:
    """Whether two answers are the same to the last bit."""
    pairs = ((one.x, other.x), (one.alpha, other.alpha))
    return all((a is b) if a is None or b is None else a.tobytes() == b.tobytes() for a, b in pairs)


def formulation_queries(cell: Cell, query_seconds: float) -> FormulationQueries:
    """The last stage of a cell whose formulation is a plugin."""
    assert cell.formulation is not None  # otherwise it is `mixed`
    built = FormulationStage(cell.problem, cell.formulation, cell.training, *spaces_of(cell), cell.interpolation)
    return FormulationQueries(built, cell.validation, cell.solver, cell.accuracy, query_seconds, cell.warm_start)
