"""The queries of a cell: every validation parameter solved, verified and compared with the high-fidelity solution."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vibench.arrays import Array
from vibench.errors import in_a_line
from vibench.interfaces.problem import ParameterBox, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.error_bounds import Stability
from vibench.model.errors import Reference
from vibench.provenance import machine
from vibench.qp.status import Status
from vibench.results.solver_agreement import vectors
from vibench.stability.infsup import InfSup
from vibench.stages.artefacts import Artefact, Store
from vibench.stages.assembly import Assembled, AssemblyStage, assembly_columns, query_model
from vibench.stages.base import Failed, Pieces, PiecewiseStage, Stage, value_of
from vibench.stages.infsup_constants import (
    FullConstants,
    OwnConstants,
    PlainConstants,
    ReferenceConstants,
    ValidationConstraints,
)
from vibench.stages.offline import ReducedCone, enrichment_of
from vibench.stages.query import Asked, Row, Task, assess
from vibench.stages.snapshots import gather, sweep, training
from vibench.timing import calibration

DISTURBED = 1.3
"""Rows measured where the calibration is this much slower than at its best are marked."""


@dataclass(frozen=True)
class CellRows:
    """The rows one cell leaves: its own, one per query, and the solutions of the queries that have one."""

    cell: Row
    queries: tuple[Row, ...]
    solutions: tuple[Row, ...] = ()


Answered = tuple[Row, Row | None]
"""The row of a query, and of its solution if there is one."""


@dataclass(frozen=True)
class QueriesStage(PiecewiseStage):
    """All queries of one cell, each a piece; the value is a `CellRows`."""

    assembly: AssemblyStage
    solver: str
    accuracy: float
    query_seconds: float
    warm_start: bool = False

    @property
    def pieces(self) -> int:
        """One query per validation parameter."""
        return self.assembly.count

    @property
    def reference(self) -> ReferenceConstants:
        """The stage that knows the constants of the high-fidelity problem."""
        return ReferenceConstants(self._constraints)

    @property
    def _constraints(self) -> ValidationConstraints:
        return ValidationConstraints(self.assembly.enrichment.pod.problem, self.assembly.count, self.assembly.seed)

    @property
    def constants(self) -> tuple[OwnConstants, FullConstants, PlainConstants]:
        """The stages that know the inf-sup constants of the reduced pair, of V with the cone, and of V_N alone."""
        enrichment, constraints = self.assembly.enrichment, self._constraints
        return (
            OwnConstants(enrichment, constraints),
            FullConstants(enrichment.cone, constraints),
            PlainConstants(enrichment.pod, enrichment.cone, constraints),
        )

    @property
    def validation(self) -> tuple[Stage, ...]:
        """The high-fidelity sweep over the validation parameters."""
        return sweep(self.assembly.enrichment.pod.problem, "validation", self.assembly.count, self.assembly.seed)

    def inputs(self) -> tuple[Stage, ...]:
        """Everything the cell's rows are made from."""
        problem = self.assembly.enrichment.pod.problem
        known = (self._constraints, *self.constants, self.reference, *training(problem), *self.validation)
        return (self.assembly, *self.assembly.inputs(), *known)

    def begin(self, store: Store) -> Queries:
        """Bring the reduced model and the reference solutions back."""
        return Queries(self, store)


class Queries(Pieces):
    """The queries of a cell: solve, verify and assess every one."""

    def __init__(self, stage: QueriesStage, store: Store) -> None:
        self._slowdown = calibration().slowdown()
        self._stage, self._store = stage, store
        enrichment = stage.assembly.enrichment
        self._model, self._note = query_model(store, stage.assembly)
        self._cone: ReducedCone = value_of(store, enrichment.cone)
        snapshots = gather(store, training(enrichment.pod.problem))
        self._reference = gather(store, stage.validation)
        problem = self._model.problem
        self._floors = tuple(
            1e-12 * float(np.max(space.norm(columns), initial=0.0))
            for space, columns in ((problem.V, snapshots.u), (problem.W, snapshots.lam))
        )
        self._assembled: Assembled = value_of(store, stage.assembly)
        self._own, self._full, self._plain = (value_of(store, known) for known in stage.constants)
        self._stability: list[Stability] = value_of(store, stage.reference)
        self._task = Task(stage.solver, stage.accuracy, stage.query_seconds)

    def piece(self, number: int, watch: Callable[[bool], None]) -> Answered:
        """The rows of one query."""
        assembled, k = self._assembled, number
        asked = Asked(assembled.programs[k], assembled.factor, assembled.seconds[k], self._before(k))
        found, solution = self._task.run(asked, watch)
        return self._known(k) | found, solution and {"query": k} | solution

    @cached_property
    def _path(self) -> list[int | None]:
        return path_before(self._reference.mu, self._model.problem.parameters)

    def _before(self, number: int) -> tuple[int, VariationalInequality] | None:
        """The query before this one on a path through the parameters, where one starts from the solution of the other.

        It is solved again for that: what a query starts from does not depend on who solved what before. Where the
        primal basis changes with the parameter there is nothing to start from.
        """
        programs = self._assembled.programs
        if not self._stage.warm_start or self._model.kind is Kind.PER_PARAMETER:
            return None
        before = self._path[number]
        return None if before is None else (before, programs[before])

    def lost(self, number: int, failed: Failed) -> Answered:
        """The row of a query whose process hung or died."""
        outcome = {"status": failed.status.value, "reason": failed.reason}
        return self._known(number) | {"assemble_s": self._assembled.seconds[number].cpu} | outcome, None

    def finish(self, pieces: Sequence[Answered]) -> CellRows:
        """All rows; the cell's are means and extremes over the queries."""
        solutions = {k: solution for k, (_, solution) in enumerate(pieces) if solution is not None}
        assessed = dict(zip(solutions, self._assess(solutions), strict=True))
        rows = [row | assessed.get(k, {}) for k, (row, _) in enumerate(pieces)]
        slowdown = max(self._slowdown, calibration().slowdown())
        found = summarise(rows, slowdown)
        return CellRows(found | self._sizes() | self._offline(), tuple(rows), tuple(solutions.values()))

    def _assess(self, solutions: Mapping[int, Row]) -> list[Row]:
        """What comparing the solutions of some queries with the high-fidelity ones gives, row by row.

        Where that fails for all together it is done one by one, and the rows that it fails for say so.
        """
        try:
            return self._assessed(solutions)
        except MemoryError:
            raise
        except Exception:  # noqa: BLE001  whatever it is, it may be of one query alone
            return [row for k, solution in solutions.items() for row in self._alone(k, solution)]

    def _alone(self, number: int, solution: Row) -> list[Row]:
        try:
            return self._assessed({number: solution})
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  the row says what
            return [{"status": Status.ERROR.value, "reason": f"in the assessment: {in_a_line(error)}"}]

    def _assessed(self, solutions: Mapping[int, Row]) -> list[Row]:
        numbers, reference = list(solutions), self._reference
        return assess(
            self._model,
            reference.mu[numbers],
            [vectors(solution) for solution in solutions.values()],
            Reference(reference.u, reference.lam, *self._floors).at(numbers),
            [self._stability[k] for k in numbers],
        )

    def _known(self, number: int) -> Row:
        """What is known of a query before it is asked: where, and the inf-sup constants there."""
        reference = self._reference
        return (
            {f"mu_{i + 1}": float(value) for i, value in enumerate(reference.mu[number])}
            | {"hf_s": reference.seconds[number].cpu}
            | _constants("beta_", self._own[number])
            | _constants("beta_full_", self._full[number])
            | _constants("beta_plain_", self._plain[number])
            | _constants("beta_hf_", self._stability[number].inf_sup)
            | {"bounds": self._own[number].sharp, "assembly_error": self._assembled.errors[number]}
        )

    def _sizes(self) -> Row:
        """Dimensions, fallbacks, memory."""
        enrichment = self._stage.assembly.enrichment
        built, cone = enrichment_of(self._store, enrichment), self._cone
        size = value_of(self._store, enrichment.pod).basis.shape[1]
        fallbacks = [*cone.cone.fallbacks, *built.fallbacks, *([self._note] if self._note else [])]
        for purpose, chunks in (("training", training(enrichment.pod.problem)), ("validation", self._stage.validation)):
            notes = [note for note in gather(self._store, chunks).fallbacks if note]
            fallbacks += [f"{len(notes)} of the {purpose} solutions: {notes[0]}"] if notes else []
        added = self._model.fixed_basis.shape[1] - size
        return {
            "model": self._stage.assembly.key,
            "enrichment_kind": built.kind.value,
            "dim_V": self._model.problem.V.dim,
            "dim_W": self._model.problem.W.dim,
            "N": size,
            "R": cone.cone.size,
            "rank": cone.prepared.rank,
            "gram_condition": cone.gram_condition,
            "enrichment": cone.prepared.rank if built.kind is Kind.PER_PARAMETER else added,
            **assembly_columns(self._store, self._stage.assembly),
            "fallbacks": "; ".join(fallbacks),
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }

    def _offline(self) -> Row:
        """Seconds of the stages the cell would have had to run, and the machines that measured them."""
        enrichment = self._stage.assembly.enrichment
        reduction = self._stage.assembly.reduction
        stages: dict[str, tuple[Stage, ...]] = {
            "snapshots": training(enrichment.pod.problem),
            "pod": (enrichment.pod,),
            "cone": (enrichment.cone,),
            "enrichment": (enrichment,),
            "assembly": () if reduction is None else (reduction.separation, reduction),
        }
        artefacts = {name: [self._artefact(stage) for stage in parts] for name, parts in stages.items()}
        spent = {name: [artefact.seconds for artefact in found] for name, found in artefacts.items()}
        row: Row = {f"offline_{name}_s": sum(s.cpu for s in parts) for name, parts in spent.items()}
        row["offline_s"] = sum(row.values())
        row["offline_wall_s"] = sum(s.wall for parts in spent.values() for s in parts)
        row["hf_s"] = float(np.mean([s.cpu for s in self._reference.seconds]))
        others = [
            self._artefact(stage)
            for stage in (self._stage.assembly, self._stage.assembly.forms, *self._stage.validation)
        ]
        machines = {artefact.machine for found in (*artefacts.values(), others) for artefact in found} | {machine()}
        return row | {"machine": "; ".join(sorted(machines))}

    def _artefact(self, stage: Stage) -> Artefact:
        artefact = self._store.get(stage.key)
        assert artefact is not None  # an input of this stage
        return artefact


def path_before(mus: Array, box: ParameterBox) -> list[int | None]:
    """Of every parameter (P×d) the one before it on a path that goes on to the nearest not yet visited."""
    scaled = (mus - box.lower) / np.maximum(box.upper - box.lower, np.finfo(float).tiny)
    before: list[int | None] = [None] * len(mus)
    left, here = set(range(1, len(mus))), 0
    while left:
        following = min(left, key=lambda k: (float(np.linalg.norm(scaled[k] - scaled[here])), k))
        before[following], here = here, following
        left.remove(following)
    return before


def _constants(prefix: str, constants: InfSup) -> Row:
    return {
        f"{prefix}span": constants.span,
        f"{prefix}cone_lower": constants.cone_lower,
        f"{prefix}cone_upper": constants.cone_upper,
    }


def summarise(rows: Sequence[Row], slowdown: float = 1.0) -> Row:
    """The columns of a cell that are means, extremes and counts over its queries; means are over the ok ones.

    `slowdown` is that of the calibration, before or after the queries.
    """
    fine = [row for row in rows if row["status"] == Status.OK]
    worst = max((Status(row["status"]) for row in rows), key=lambda status: status.severity)
    reasons = [f"mu={_mu(row)}: {row['reason']}" for row in rows if row["status"] == worst and row["reason"]]

    def column(name: str) -> Array:
        return np.array([row[name] for row in fine if row.get(name) is not None], dtype=float)

    def mean(name: str) -> float | None:
        return float(column(name).mean()) if column(name).size else None

    def most(name: str) -> float | None:
        return float(column(name).max()) if column(name).size else None

    residuals = [most(name) for name in ("primal_residual", "dual_residual", "gap")]
    cpu, wall = column("total_s").sum(), column("total_wall_s").sum()
    return {
        "status": worst.value,
        "reason": f"{len(reasons)} of {len(rows)} queries, first {reasons[0]}" if reasons else "",
        "queries": len(rows),
        "queries_ok": len(fine),
        "online_s": mean("total_s"),
        "online_wall_s": mean("total_wall_s"),
        "online_assemble_s": mean("assemble_s"),
        "online_solve_s": mean("solve_s"),
        "error_u_mean": mean("error_u"),
        "error_u_max": most("error_u"),
        "error_lambda_mean": mean("error_lambda"),
        "error_lambda_max": most("error_lambda"),
        "assembly_error_max": most("assembly_error"),
        "violation_max": most("violation"),
        "residual_max": max((r for r in residuals if r is not None), default=None),
        "beta_span_min": min(row["beta_span"] for row in rows),
        "beta_cone_lower_min": min(row["beta_cone_lower"] for row in rows),
        "beta_cone_upper_min": min(row["beta_cone_upper"] for row in rows),
        "slowdown": slowdown,
        "disturbed": int(wall > 1.5 * cpu or slowdown > DISTURBED),
    }


def _mu(row: Row) -> str:
    values = [row[name] for name in sorted(row) if name.startswith("mu_")]
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
