"""The queries of a cell: every validation parameter solved, verified and compared with the high-fidelity solution."""

from __future__ import annotations

import json
import math
import resource
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vibench.errors import in_a_line
from vibench.interfaces.strategies import Kind
from vibench.model.affine import MISSED
from vibench.model.certificates.base import Guarantee
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.error_bounds import CorrectionMode
from vibench.model.errors import ReferenceSolutions, output_scales, summarise_outputs, zeros
from vibench.offline.correction import Corrector
from vibench.provenance import machine
from vibench.qp.exact import ExactSolution
from vibench.qp.status import Status
from vibench.results.solver_agreement import vectors
from vibench.stability.coercivity import Stability
from vibench.stability.infsup import InfSup, share
from vibench.stages.assembly import AssemblyStage, ExactSolutions, assembly_stage
from vibench.stages.base import Failed, Items, ItemwiseStage, Row, Stage, value_of
from vibench.stages.cell_summary import summarise
from vibench.stages.certification import CertificateStage
from vibench.stages.compilation import CompilationStage, compiled_query, loaded_program
from vibench.stages.infsup_constants import InfSupConstants, ReferenceConstants
from vibench.stages.offline import ConstraintMatrices, ReducedCone
from vibench.stages.query import Queries, Query, error_columns, run_query
from vibench.stages.snapshots import gather, solution_stages
from vibench.storage.artefacts import Artefact, Store
from vibench.study.cells import CERTIFIED, COMPILED, Cell
from vibench.study.kinds import SOLVER
from vibench.study.registry import find
from vibench.timing import median_of

CLEAR_GAP = 10.0
"""A rank is in doubt where the singular values on both sides of the threshold differ by less than this factor."""

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


@dataclass(frozen=True)
class CellQueries(ItemwiseStage):
    """All queries of one cell, each a item; the value is a `CellRows`."""

    label = "queries"

    assembly: AssemblyStage
    solver: str
    accuracy: float
    query_seconds: float
    warm_start: bool = False
    certificate: CertificateStage | None = None
    correction: CorrectionMode = CorrectionMode.NONE
    compilation: CompilationStage | None = None

    @property
    def sort(self) -> str:
        """Queries of one solver take about as long."""
        return f"{self.label} with {self.solver}"

    @cached_property
    def packages(self) -> frozenset[str]:
        """The packages of the strategies, the problem and the solver."""
        return super().packages | {find(SOLVER, self.solver).package} - {""}

    @property
    def items(self) -> int:
        """One query per validation parameter."""
        return self.assembly.validation.count

    def query(self, queries: Queries, number: int) -> Query:
        """One query of the cell's reduced model, for its solver or its compiled program."""
        if self.compilation is not None:
            program = loaded_program(queries.store, self.compilation)
            return compiled_query(queries, program, number, self.solver, self.accuracy)
        return queries.query(number, self.solver, self.accuracy, self.warm_start)

    @property
    def reference(self) -> ReferenceConstants:
        """The stage of the constants of the high-fidelity problem."""
        return ReferenceConstants(self._constraints)

    @property
    def constants(self) -> tuple[InfSupConstants, ...]:
        """The stages of the inf-sup constants of the reduced pair, of V with the cone, and of V_N alone."""
        enrichment = self.assembly.enrichment
        return tuple(
            InfSupConstants(space, enrichment.cone, self._constraints) for space in (enrichment, None, enrichment.pod)
        )

    @property
    def _constraints(self) -> ConstraintMatrices:
        return ConstraintMatrices(self.assembly.enrichment.pod.problem, self.assembly.validation)

    @property
    def exact(self) -> ExactSolutions:
        """The stage of the reduced programs solved to round-off."""
        return ExactSolutions(self.assembly)

    @property
    def training(self) -> tuple[Stage, ...]:
        """The stages of the training snapshots."""
        return self.assembly.enrichment.pod.inputs()

    @property
    def validation(self) -> tuple[Stage, ...]:
        """The stages of the reference solutions."""
        return solution_stages(self.assembly.enrichment.pod.problem, self.assembly.validation)

    @property
    def offline(self) -> Mapping[str, tuple[Stage, ...]]:
        """The stages whose seconds add up to the offline time of the cell, by column."""
        enrichment, reduction = self.assembly.enrichment, self.assembly.reduction
        compiled = () if self.compilation is None else (self.compilation,)
        return {
            "snapshots": self.training,
            "pod": (enrichment.pod,),
            "cone": (enrichment.cone,),
            "enrichment": (enrichment,),
            "assembly": () if reduction is None else (reduction.decomposition, reduction, *compiled),
            "certificate": () if self.certificate is None else (self.certificate.base, self.certificate),
        }

    def inputs(self) -> tuple[Stage, ...]:
        """All stages whose artefacts enter the rows of the cell."""
        timed = (stage for stages in self.offline.values() for stage in stages)
        read = (self.assembly, self.exact, *self.assembly.model_inputs, *timed)
        stages = (*read, *self.constants, self.reference, *self.validation)
        return tuple(dict.fromkeys(stages))

    def begin(self, store: Store) -> _Queries:
        """Load the reduced programs and the reference solutions."""
        return _Queries(self, store)


def cell_queries(cell: Cell, query_seconds: float) -> CellQueries:
    """The last stage of a cell; all its other stages are inputs of it, directly or indirectly."""
    assembly = assembly_stage(cell)
    certificate = CertificateStage(assembly) if cell.assembly == CERTIFIED else None
    mode, asked = CorrectionMode(cell.correction), (cell.solver, cell.accuracy, query_seconds, cell.warm_start)
    compilation = CompilationStage(assembly, cell.accuracy) if cell.assembly == COMPILED else None
    return CellQueries(assembly, *asked, certificate, mode, compilation)


class _Queries(Items):
    """The queries of a cell: solve, verify and assess every one."""

    def __init__(self, stage: CellQueries, store: Store) -> None:
        self._stage, self._store, self._queries = stage, store, Queries(store, stage.assembly)
        self._model, self._reduced = self._queries.model, self._queries.reduced
        self._cone: ReducedCone = value_of(store, stage.assembly.enrichment.cone)
        self._training, self._reference = gather(store, stage.training), gather(store, stage.validation)
        problem = self._model.problem
        trained = self._training
        self._compared = ReferenceSolutions(
            self._reference.u,
            self._reference.lam,
            float(np.max(problem.V.norm(trained.u), initial=0.0)),
            float(np.max(problem.W.norm(trained.lam), initial=0.0)),
            output_scales(problem.outputs, trained.mu, trained.u, trained.lam),
        )
        self._zeros = zeros(problem, self._compared)
        self._own, self._full, self._plain = (value_of(store, one) for one in stage.constants)
        self._stability: list[Stability] = value_of(store, stage.reference)
        self._exact: tuple[ExactSolution | None, ...] = value_of(store, stage.exact)
        self._certificate: OnlineCertificate | None = (
            None if stage.certificate is None else value_of(store, stage.certificate)
        )
        self._corrector = Corrector(self._model, self._certificate, stage.correction)

    def item(self, number: int, watch: Callable[[bool], None]) -> QueryRows:
        """The rows of one query."""
        row, solution = run_query(self._stage.query(self._queries, number), self._stage.query_seconds, watch)
        return self._known(number) | row, solution and {"query": number} | solution

    def lost(self, number: int, failed: Failed) -> QueryRows:
        """The row of a query that exceeded its limit or whose process died."""
        outcome = {"status": failed.status.value, "reason": failed.reason}
        return self._known(number) | outcome, None

    def finish(self, items: Sequence[QueryRows]) -> CellRows:
        """All rows; the row of the cell has means and extremes over the queries."""
        solutions = {k: solution for k, (_, solution) in enumerate(items) if solution is not None}
        assessed = dict(zip(solutions, self._assess(solutions), strict=True))
        rows = [row | assessed.get(k, {}) for k, (row, _) in enumerate(items)]
        own = summarise(rows) | self._sizes(rows) | self._shares() | self._offline()
        outputs = self._outputs(rows)
        written = [row | {"outputs": json.dumps(values) if (values := row.get("outputs")) else None} for row in rows]
        box = self._model.problem.parameters
        named = tuple(zip(map(str, box.names), map(str, box.units), strict=True))
        return CellRows(own, tuple(written), tuple(solutions.values()), outputs, named)

    def _outputs(self, rows: Sequence[Row]) -> tuple[Row, ...]:
        """Rows of the problem's outputs, over the ok queries."""
        fine = [row["outputs"] for row in rows if row["status"] == Status.OK]
        outputs, scale = self._model.problem.outputs, self._compared.scale_outputs
        return tuple(dict(row) for row in summarise_outputs(outputs, scale, fine))

    def _assess(self, solutions: Mapping[int, Row]) -> list[Row]:
        """Error columns of some queries, all at once; where that fails, one by one, and a row says why it failed."""
        numbers = list(solutions)
        try:
            return error_columns(
                self._corrector,
                self._reference.mu[numbers],
                [vectors(solution) for solution in solutions.values()],
                self._compared.at(numbers),
                [self._stability[k] for k in numbers],
                [self._exact[k] for k in numbers],
                [self._reduced.projected[k] for k in numbers] if self._reduced.projected else (),
            )
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  whatever it is, it may concern one query alone
            if len(numbers) > 1:
                return [row for k in numbers for row in self._assess({k: solutions[k]})]
            return [{"status": Status.ERROR.value, "reason": f"in the assessment: {in_a_line(error)}"}]

    def _known(self, number: int) -> Row:
        """The columns of a query that do not depend on its solution: parameter, zeros of the reference, constants."""
        reference, (zero_u, zero_lam) = self._reference, self._zeros
        return (
            {f"mu_{i + 1}": float(value) for i, value in enumerate(reference.mu[number])}
            | {"hf_s": reference.seconds[number].cpu, "reference_bound": _finite(reference.bounds[number])}
            | {"zero_u": int(zero_u[number]), "zero_lambda": int(zero_lam[number])}
            | _constants("beta_", self._own[number])
            | _constants("beta_full_", self._full[number])
            | _constants("beta_plain_", self._plain[number])
            | _constants("beta_hf_", self._stability[number].inf_sup)
            | _energy_constants(self._stability[number])
            | {"bounds": self._own[number].sharp, "assembly_error": self._reduced.errors[number]}
        )

    def _sizes(self, rows: Sequence[Row]) -> Row:
        """Dimensions, fallbacks, memory."""
        assembly, cone = self._stage.assembly, self._cone
        built = assembly.enrichment.enrichment(self._store)
        size = value_of(self._store, assembly.enrichment.pod).basis.shape[1]
        fallbacks = [*cone.cone.fallbacks, *built.fallbacks, *([self._queries.note] if self._queries.note else [])]
        for purpose, solved in (("training", self._training), ("validation", self._reference)):
            notes = [note for note in solved.fallbacks if note]
            fallbacks += [f"{len(notes)} of the {purpose} solutions: {notes[0]}"] if notes else []
        tolerance, error = assembly.interpolation, max(self._reduced.errors)
        if tolerance is not None and error > MISSED * tolerance:
            fallbacks.append(
                f"reduced assembly differs from the Galerkin projection by up to {error:.1e} at validation parameters: "
                f"the interpolation tolerance {tolerance:g} holds at training parameters only"
            )
        if unbounded := int(np.sum(np.isinf(self._reference.bounds))):
            fallbacks.append(f"{unbounded} of the validation solutions have no error bound: residuals verify them")
        if (gap := cone.prepared.rank_gap) < CLEAR_GAP:
            rank = cone.prepared.rank
            fallbacks.append(f"the rank {rank} is in doubt: its last singular value is {gap:.2g} times what is below")
        if uncorrected := [note for row in rows if (note := row.get("correction_note"))]:
            fallbacks.append(f"{len(uncorrected)} of {len(rows)} queries are not corrected: {uncorrected[0]}")
        added = self._model.fixed_basis.shape[1] - size
        return {
            "model": assembly.key,
            "enrichment_kind": built.kind.value,
            "dim_V": self._model.problem.V.dim,
            "dim_W": self._model.problem.W.dim,
            "N": size,
            "R": cone.cone.size,
            "rank": cone.prepared.rank,
            "rank_gap": cone.prepared.rank_gap,
            "gram_condition": cone.prepared.gram_condition,
            "snapshots": len(self._training.mu),
            "enrichment": cone.prepared.rank if built.kind is Kind.PER_PARAMETER else added,
            **assembly.columns(self._store),
            "correction_cost": self._corrector.cost,
            "certificate": (Guarantee.NONE if self._certificate is None else self._certificate.base.guarantee).value,
            "fallbacks": "; ".join(fallbacks),
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }

    def _shares(self) -> Row:
        """The smallest shares of β_span in that of V, and the share that the last σ of the enrichment guarantees."""
        histories = {h.quantity: h.values for h in self._artefact(self._stage.assembly.enrichment).histories}
        validation = [share(own.span, full.span) for own, full in zip(self._own, self._full, strict=True)]
        row: Row = {"share_validation": min(validation)}
        if "share_min" in histories:
            row["share_training"] = histories["share_min"][-1]
        if "sigma" in histories:
            row["share_guaranteed"] = math.sqrt(max(0.0, 1.0 - histories["sigma"][-1] ** 2))
        return row

    def _offline(self) -> Row:
        """Offline seconds as if the cell had been run alone, and the machines that measured them."""
        artefacts = {name: [self._artefact(stage) for stage in parts] for name, parts in self._stage.offline.items()}
        spent = {name: [artefact.seconds for artefact in read] for name, read in artefacts.items()}
        # The chunks of a parameter set have a set-up each, for the sake of parallel runs: one counts.
        setup = median_of([*self._training.setups, *self._reference.setups])
        spent["snapshots"].append(setup)
        row: Row = {f"offline_{name}_s": sum(s.cpu for s in parts) for name, parts in spent.items()}
        row["offline_s"] = sum(row.values())
        row["offline_selection_s"] = self._training.selecting.cpu
        row["offline_wall_s"] = sum(s.wall for parts in spent.values() for s in parts)
        marginal = [seconds.cpu for seconds in self._reference.seconds]
        row |= {"hf_setup_s": setup.cpu, "hf_s": float(np.mean(marginal))}
        solved = [self._artefact(stage) for stage in self._stage.validation]
        machines = {artefact.machine for read in (*artefacts.values(), solved) for artefact in read} | {machine()}
        return row | {"machine": "; ".join(sorted(machines))}

    def _artefact(self, stage: Stage) -> Artefact:
        artefact = self._store.get(stage.key)
        assert artefact is not None  # an input of this stage
        return artefact


def _finite(bound: float) -> float | None:
    return bound if math.isfinite(bound) else None


def _constants(prefix: str, constants: InfSup) -> Row:
    return {
        f"{prefix}span": constants.span,
        f"{prefix}cone_lower": constants.cone_lower,
        f"{prefix}cone_upper": constants.cone_upper,
    }


def _energy_constants(constants: Stability) -> Row:
    return {
        "coercivity": constants.coercivity.value,
        "coercivity_proved": int(constants.coercivity.proved),
        "continuity": constants.continuity.value,
        "continuity_proved": int(constants.continuity.proved),
        "beta_energy": constants.energy_inf_sup.value,
    }
