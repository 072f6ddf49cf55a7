"""The queries of a cell: every validation parameter solved, verified and compared with the high-fidelity solution."""

from __future__ import annotations

import resource
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.assembly import Assembled, AssemblyStage
from vibench.assess import Reference
from vibench.error_bounds import Stability
from vibench.infsup import InfSup, Multipliers
from vibench.qp import Status
from vibench.query import Row, Task
from vibench.reduced import ReducedModel
from vibench.stage import Result, Stage, value_of
from vibench.stages import reduced_model
from vibench.store import Store
from vibench.strategy import Kind
from vibench.sweeps import ReferenceConstants, Solutions, gather, sweep, training
from vibench.timing import Seconds


@dataclass(frozen=True)
class CellRows:
    """The rows one cell leaves: its own, one per query, and the solutions of the queries that have one."""

    cell: Row
    queries: tuple[Row, ...]
    solutions: tuple[Row, ...] = ()


@dataclass(frozen=True)
class QueriesStage(Stage):
    """All queries of one cell."""

    assembly: AssemblyStage
    solver: str
    accuracy: float
    query_seconds: float

    @property
    def reference(self) -> ReferenceConstants:
        """The stage that knows the constants of the high-fidelity problem."""
        return ReferenceConstants(self.assembly.enrichment.pod.problem, self.assembly.count, self.assembly.seed)

    @property
    def validation(self) -> tuple[Stage, ...]:
        """The high-fidelity sweep over the validation parameters."""
        return sweep(self.assembly.enrichment.pod.problem, "validation", self.assembly.count, self.assembly.seed)

    def inputs(self) -> tuple[Stage, ...]:
        """Everything the cell's rows are made from."""
        problem = self.assembly.enrichment.pod.problem
        return (self.assembly, *self.assembly.inputs(), self.reference, *training(problem), *self.validation)

    def run(self, store: Store) -> Result:
        """Solve, verify and assess every query; the value is a `CellRows`."""
        model, _, prepared = reduced_model(store, self.assembly.enrichment)
        snapshots = gather(store, training(self.assembly.enrichment.pod.problem))
        reference = gather(store, self.validation)
        floors = tuple(
            1e-12 * float(np.max(space.norm(columns), initial=0.0))
            for space, columns in ((model.problem.V, snapshots.u), (model.problem.W, snapshots.lam))
        )
        assembled: Assembled = value_of(store, self.assembly)
        constants: list[Stability] = value_of(store, self.reference)
        task = Task(self.solver, self.accuracy, self.query_seconds)
        rows, solutions = [], []
        for k in range(len(reference.mu)):
            exact = Reference(reference.u[:, k], reference.lam[:, k], *floors)
            found, solution = task.run(model, reference.mu[k], exact, constants[k], assembled.seconds[k])
            rows.append(
                {f"mu_{i + 1}": float(value) for i, value in enumerate(reference.mu[k])}
                | {"hf_s": reference.seconds[k].cpu}
                | found
                | _constants("beta_", assembled.own[k])
                | _constants("beta_full_", assembled.full[k])
                | _constants("beta_plain_", assembled.plain[k])
                | _constants("beta_hf_", constants[k].inf_sup)
                | {"bounds": assembled.own[k].sharp}
            )
            if solution is not None:
                solutions.append({"query": k} | solution)
        cell = self._cell(store, model, prepared, rows) | self._offline(store, reference)
        return Result(CellRows(cell, tuple(rows), tuple(solutions)))

    def _cell(self, store: Store, model: ReducedModel, prepared: Multipliers, rows: Sequence[Row]) -> Row:
        """Sizes, and means and extremes over the queries."""
        enrichment = self.assembly.enrichment
        built, cone = value_of(store, enrichment), value_of(store, enrichment.cone)
        basis = value_of(store, enrichment.pod).basis
        fallbacks = [*cone.cone.fallbacks, *built.fallbacks]
        for purpose, chunks in (("training", training(enrichment.pod.problem)), ("validation", self.validation)):
            notes = [note for note in gather(store, chunks).fallbacks if note]
            fallbacks += [f"{len(notes)} of the {purpose} solutions: {notes[0]}"] if notes else []
        per_parameter = built.kind is Kind.PER_PARAMETER
        size = basis.shape[1]
        return summarise(rows) | {
            "model": self.assembly.key,
            "enrichment_kind": built.kind.value,
            "dim_V": model.problem.V.dim,
            "dim_W": model.problem.W.dim,
            "N": size,
            "R": cone.cone.size,
            "rank": prepared.rank,
            "enrichment": prepared.rank if per_parameter else model.fixed_basis.shape[1] - size,
            "fallbacks": "; ".join(fallbacks),
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }

    def _offline(self, store: Store, reference: Solutions) -> Row:
        """Seconds of the stages the cell would have had to run."""
        enrichment = self.assembly.enrichment
        stages = {
            "snapshots": training(enrichment.pod.problem),
            "pod": (enrichment.pod,),
            "cone": (enrichment.cone,),
            "enrichment": (enrichment,),
        }
        spent = {name: [_artefact_seconds(store, stage) for stage in parts] for name, parts in stages.items()}
        row: Row = {f"offline_{name}_s": sum(s.cpu for s in parts) for name, parts in spent.items()}
        row["offline_assembly_s"] = 0.0
        row["offline_s"] = sum(row.values())
        row["offline_wall_s"] = sum(s.wall for parts in spent.values() for s in parts)
        row["hf_s"] = float(np.mean([s.cpu for s in reference.seconds]))
        return row


def _artefact_seconds(store: Store, stage: Stage) -> Seconds:
    artefact = store.get(stage.key)
    assert artefact is not None  # an input of this stage
    return artefact.seconds


def _constants(prefix: str, constants: InfSup) -> Row:
    return {
        f"{prefix}span": constants.span,
        f"{prefix}cone_lower": constants.cone_lower,
        f"{prefix}cone_upper": constants.cone_upper,
    }


def summarise(rows: Sequence[Row]) -> Row:
    """The columns of a cell that are means, extremes and counts over its queries; means are over the ok ones."""
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
        "violation_max": most("violation"),
        "residual_max": max((r for r in residuals if r is not None), default=None),
        "beta_span_min": min(row["beta_span"] for row in rows),
        "beta_cone_lower_min": min(row["beta_cone_lower"] for row in rows),
        "beta_cone_upper_min": min(row["beta_cone_upper"] for row in rows),
        "disturbed": int(wall > 1.5 * cpu),
    }


def _mu(row: Row) -> str:
    values = [row[name] for name in sorted(row) if name.startswith("mu_")]
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
