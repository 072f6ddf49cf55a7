"""The last stage of a cell, which answers its queries: what is the same whatever model it is that answers."""

from __future__ import annotations

import json
import math
import resource
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from vibench.errors import in_a_line
from vibench.interfaces.problem import Problem
from vibench.model.errors import ReferenceSolutions, output_scales, summarise_outputs, zeros
from vibench.offline.assemblies import assemblies
from vibench.plugins.kinds import SOLVER
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import find
from vibench.provenance import machine
from vibench.qp.status import Status
from vibench.stability.coercivity import Stability
from vibench.stability.infsup import InfSup
from vibench.stages.artefacts import Artefact, Store
from vibench.stages.base import Failed, Items, ItemwiseStage, Row, Stage, TimeLimit, build_problem
from vibench.stages.cell_summary import summarise
from vibench.stages.infsup_constants import ReferenceConstants
from vibench.stages.offline import ConstraintMatrices
from vibench.stages.snapshots import TimedSnapshots, gather, solution_stages
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import median_of

JUDGED = 1.5
"""A query and what is measured of its answer take about as long as so many high-fidelity solutions."""

QueryRows = tuple[Row, Row | None]
"""The row of a query, and that of its solution if there is one."""


@dataclass(frozen=True)
class CellRows:
    """The rows of one cell: its own, one per query, the solutions of those that have one, and one per output.

    `parameters` are names and units of mu_1, mu_2, … of the queries.
    """

    cell: Row
    queries: tuple[Row, ...]
    solutions: tuple[Row, ...] = ()
    outputs: tuple[Row, ...] = ()
    parameters: tuple[tuple[str, str], ...] = ()


class CellStage(ItemwiseStage):
    """All queries of one cell, each an item; the value is a `CellRows`. Subclasses are frozen dataclasses."""

    label = "queries"

    solver: str | None
    """The QP solver, `None` where there is none."""
    validation_set: ParameterSet
    """The validation set, whose parameters are those of the queries."""

    @property
    @abstractmethod
    def problem(self) -> Plugin:
        """The problem."""

    @property
    @abstractmethod
    def training_set(self) -> ParameterSet:
        """The training set."""

    @property
    @abstractmethod
    def model(self) -> str:
        """Key of the reduced model, which cells that differ in their solver alone share."""

    @property
    @abstractmethod
    def offline(self) -> Mapping[str, tuple[Stage, ...]]:
        """The stages whose seconds add up to the offline time of the cell, by column."""

    @property
    @abstractmethod
    def timed_inputs(self) -> tuple[Stage, ...]:
        """The stages whose artefacts the rounds of timing read."""

    @property
    def kind_of_work(self) -> str:
        """Queries of one solver take about as long."""
        return f"{self.label} with {self.solver}"

    @property
    def effort(self) -> float:
        """By the number of queries."""
        return JUDGED * self.items

    @cached_property
    def packages(self) -> frozenset[str]:
        """The packages of the strategies, the problem and the solver."""
        own = super().packages
        return own if self.solver is None else own | {find(SOLVER, self.solver).package} - {""}

    @property
    def items(self) -> int:
        """One query per validation parameter."""
        return self.validation_set.count

    @property
    def reference(self) -> ReferenceConstants:
        """The stages of the constants of the high-fidelity problem."""
        return ReferenceConstants(ConstraintMatrices(self.problem, self.validation_set))

    @property
    def training(self) -> tuple[Stage, ...]:
        """The stages of the training snapshots."""
        return solution_stages(self.problem, self.training_set)

    @property
    def validation(self) -> tuple[Stage, ...]:
        """The stages of the reference solutions."""
        return solution_stages(self.problem, self.validation_set)


class CellWork(Items):
    """The queries of a cell: every one is solved, verified and assessed."""

    def __init__(self, stage: CellStage, store: Store) -> None:
        self._goal, self._store = stage, store
        self._problem: Problem = build_problem(stage.problem)
        solved = _solutions(_Solutions(stage.problem, stage.training, stage.validation, store.folder, store))
        self._training, self._reference, self._compared = solved
        self._zeros = zeros(self._problem, self._compared)
        self._stability = stage.reference.gather(store)

    def run_item(self, number: int, time_limit: TimeLimit) -> QueryRows:
        """The rows of one query; of one without constants the reason."""
        constants = self._stability[number]
        return self.failed(number, constants) if isinstance(constants, Failed) else self.answer(number, time_limit)

    @abstractmethod
    def answer(self, number: int, time_limit: TimeLimit) -> QueryRows:
        """The rows of one query at a parameter that has all constants."""

    def constants(self, numbers: Iterable[int]) -> list[Stability]:
        """The constants of the high-fidelity problem for some queries that have an answer."""
        return [one for k in numbers if isinstance(one := self._stability[k], Stability)]

    @abstractmethod
    def assess(self, solutions: Mapping[int, Row]) -> list[Row]:
        """Error columns of some queries, by their solutions. An exception may concern one of them alone."""

    @abstractmethod
    def sizes(self, rows: Sequence[Row]) -> tuple[Row, list[str]]:
        """Columns of the model of the cell, and its fallbacks, from the rows of its queries."""

    def failed(self, number: int, failed: Failed) -> QueryRows:
        """The row of a query that exceeded its limit or whose process died."""
        outcome = {"status": failed.status.value, "reason": failed.reason}
        return self.known(number) | outcome, None

    def collect(self, items: Sequence[QueryRows]) -> CellRows:
        """All rows; the row of the cell has means and extremes over the queries."""
        solutions = {k: solution for k, (_, solution) in enumerate(items) if solution is not None}
        assessed = dict(zip(solutions, self._assess(solutions), strict=True))
        rows = [row | assessed.get(k, {}) for k, (row, _) in enumerate(items)]
        sizes, fallbacks = self.sizes(rows)
        own = summarise(rows) | self._common(fallbacks) | sizes | self._offline()
        outputs = self._outputs(rows)
        written = [row | {"outputs": json.dumps(values) if (values := row.get("outputs")) else None} for row in rows]
        box = self._problem.parameters
        named = tuple(zip(map(str, box.names), map(str, box.units), strict=True))
        return CellRows(own, tuple(written), tuple(solutions.values()), outputs, named)

    def _assess(self, solutions: Mapping[int, Row]) -> list[Row]:
        """Error columns of some queries, of as many at once as there is memory for the factors of their A.

        Where that fails, one by one, and a row says why it failed.
        """
        numbers = list(solutions)
        if not numbers:
            return []
        try:
            count = assemblies(self._problem).together(self._reference.mu[numbers[0]])
            if len(numbers) <= count:
                return self.assess(solutions)
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  whatever it is, it may concern one query alone
            if len(numbers) == 1:
                return [{"status": Status.ERROR.value, "reason": f"in the assessment: {in_a_line(error)}"}]
            count = 1
        parts = (numbers[first : first + count] for first in range(0, len(numbers), count))
        return [row for part in parts for row in self._assess({k: solutions[k] for k in part})]

    def known(self, number: int) -> Row:
        """The columns of a query that do not depend on its solution: parameter, zeros of the reference, constants."""
        reference, (zero_u, zero_lam) = self._reference, self._zeros
        constants = self._stability[number]
        return (
            {f"mu_{i + 1}": float(value) for i, value in enumerate(reference.mu[number])}
            | {"hf_s": reference.seconds[number].cpu, "reference_bound": _finite(reference.bounds[number])}
            | {"zero_u": int(zero_u[number]), "zero_lambda": int(zero_lam[number])}
            | (_constants(constants) if isinstance(constants, Stability) else {})
        )

    def _outputs(self, rows: Sequence[Row]) -> tuple[Row, ...]:
        """Rows of the problem's outputs, over the ok queries."""
        fine = [row["outputs"] for row in rows if row["status"] == Status.OK]
        outputs, scale = self._problem.outputs, self._compared.scale_outputs
        return tuple(dict(row) for row in summarise_outputs(outputs, scale, fine))

    def _common(self, fallbacks: list[str]) -> Row:
        """Columns that do not depend on how the cell answers, the fallbacks of its high-fidelity solutions included."""
        for purpose, solved in (("training", self._training), ("validation", self._reference)):
            notes = [note for note in solved.fallbacks if note]
            fallbacks += [f"{len(notes)} of the {purpose} solutions: {notes[0]}"] if notes else []
        if unbounded := int(np.sum(np.isinf(self._reference.bounds))):
            fallbacks.append(f"{unbounded} of the validation solutions have no error bound: residuals verify them")
        return {
            "model": self._goal.model,
            "dim_V": self._problem.V.dim,
            "dim_W": self._problem.W.dim,
            "snapshots": len(self._training.mu),
            "fallbacks": "; ".join(fallbacks),
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }

    def _offline(self) -> Row:
        """Offline seconds as if the cell had been run alone, and the machines that measured them."""
        artefacts = {name: [self._artefact(stage) for stage in parts] for name, parts in self._goal.offline.items()}
        spent = {name: [artefact.seconds for artefact in read] for name, read in artefacts.items()}
        # Every chunk has the set-up of the process that solved it, for the sake of parallel runs: one counts.
        setup = median_of([*self._training.setups, *self._reference.setups])
        spent["snapshots"].append(setup)
        row: Row = {f"offline_{name}_s": sum(s.cpu for s in parts) for name, parts in spent.items()}
        row["offline_s"] = sum(row.values())
        row["offline_selection_s"] = self._training.selecting.cpu
        row["offline_wall_s"] = sum(s.wall for parts in spent.values() for s in parts)
        marginal = [seconds.cpu for seconds in self._reference.seconds]
        row |= {"hf_setup_s": setup.cpu, "hf_s": float(np.mean(marginal))}
        solved = [self._artefact(stage) for stage in self._goal.validation]
        machines = {artefact.machine for read in (*artefacts.values(), solved) for artefact in read} | {machine()}
        return row | {"machine": "; ".join(sorted(machines))}

    def _artefact(self, stage: Stage) -> Artefact:
        artefact = self._store.get(stage.key)
        assert artefact is not None  # an input of this stage
        return artefact


@dataclass(frozen=True)
class _Solutions:
    """The stages of the solutions of a problem that queries are compared with, and the store that has them."""

    problem: Plugin
    training: tuple[Stage, ...]
    validation: tuple[Stage, ...]
    folder: Path
    store: Store = field(compare=False)


@lru_cache(maxsize=1)
def _solutions(of: _Solutions) -> tuple[TimedSnapshots, TimedSnapshots, ReferenceSolutions]:
    """Training and validation solutions, and the latter with what is largest of the former; cells share them."""
    trained, reference = gather(of.store, of.training), gather(of.store, of.validation)
    problem = build_problem(of.problem)
    return (
        trained,
        reference,
        ReferenceSolutions(
            reference.u,
            reference.lam,
            float(np.max(problem.V.norm(trained.u), initial=0.0)),
            float(np.max(problem.W.norm(trained.lam), initial=0.0)),
            output_scales(problem.outputs, trained.mu, trained.u, trained.lam),
        ),
    )


def _finite(bound: float) -> float | None:
    return bound if math.isfinite(bound) else None


def inf_sup_columns(prefix: str, constants: InfSup) -> Row:
    """The columns of a pair of spaces, whose names begin so."""
    return {
        f"{prefix}span": constants.span,
        f"{prefix}cone_lower": constants.cone_lower,
        f"{prefix}cone_upper": constants.cone_upper,
    }


def _constants(constants: Stability) -> Row:
    return inf_sup_columns("beta_hf_", constants.inf_sup) | {
        "coercivity": constants.coercivity.value,
        "coercivity_proved": int(constants.coercivity.proved),
        "continuity": constants.continuity.value,
        "continuity_proved": int(constants.continuity.proved),
        "beta_energy": constants.energy_inf_sup.value,
    }
