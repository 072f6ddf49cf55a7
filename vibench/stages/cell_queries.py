"""The queries of a cell: every validation parameter solved, verified and compared with the high-fidelity solution."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vibench.interfaces.formulations import Multiplier
from vibench.interfaces.strategies import Kind
from vibench.model.affine import MISSED
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.offline.correction import Corrector
from vibench.plugins.plugin import Plugin
from vibench.qp.exact import ExactSolution
from vibench.results.consistency import vectors
from vibench.stability.infsup import stability_ratio
from vibench.stages.assembly import AssemblyStage, ExactSolutions, assembly_stage
from vibench.stages.base import Row, Stage, Watch, value_of
from vibench.stages.certification import CertificateStage
from vibench.stages.compilation import CompilationStage, compiled_query, loaded_program
from vibench.stages.formulations.queries import formulation_queries
from vibench.stages.infsup_constants import InfSupConstants
from vibench.stages.judging.cell_goal import CellGoal, CellItems, QueryRows, inf_sup_columns
from vibench.stages.offline import ReducedCone
from vibench.stages.query import Queries, Query, error_columns, run_query
from vibench.storage.artefacts import Store
from vibench.study.cells import CERTIFIED, COMPILED, Cell
from vibench.study.parameter_sets import ParameterSet

CLEAR_GAP = 10.0
"""A rank is in doubt where the singular values on both sides of the threshold differ by less than this factor."""


@dataclass(frozen=True)
class CellQueries(CellGoal):
    """All queries of one cell with the mixed formulation, quadratic programs."""

    assembly: AssemblyStage
    solver: str
    accuracy: float
    query_seconds: float
    warm_start: bool = False
    certificate: CertificateStage | None = None
    correction: CorrectionMode = CorrectionMode.NONE
    compilation: CompilationStage | None = None

    @property
    def problem(self) -> Plugin:
        """That of the model."""
        return self.assembly.enrichment.pod.problem

    @property
    def training_set(self) -> ParameterSet:
        """That of the model."""
        return self.assembly.enrichment.pod.training

    @property
    def validation_set(self) -> ParameterSet:
        """That of the reduced programs."""
        return self.assembly.validation

    @property
    def model(self) -> str:
        """The key of the reduced programs."""
        return self.assembly.key

    @property
    def timed_inputs(self) -> tuple[Stage, ...]:
        """The model and the reduced programs, the certificate with its base, and the compiled program."""
        certifying = () if self.certificate is None else (self.certificate.base, self.certificate)
        compiled = () if self.compilation is None else (self.compilation,)
        return (*self.assembly.model_inputs, self.assembly, *certifying, *compiled)

    def query(self, queries: Queries, number: int) -> Query:
        """One query of the cell's reduced model, for its solver or its compiled program."""
        if self.compilation is not None:
            program = loaded_program(queries.store, self.compilation)
            return compiled_query(queries, program, number, self.solver, self.accuracy)
        return queries.query(number, self.solver, self.accuracy, self.warm_start)

    @property
    def constants(self) -> tuple[InfSupConstants, ...]:
        """The stages of the inf-sup constants of the reduced pair, of V with the cone, and of V_N alone."""
        enrichment = self.assembly.enrichment
        return tuple(
            InfSupConstants(space, enrichment.cone, self.reference.constraints)
            for space in (enrichment, None, enrichment.pod)
        )

    @property
    def exact(self) -> ExactSolutions:
        """The stage of the reduced programs solved to round-off."""
        return ExactSolutions(self.assembly)

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
            "formulation": (),
            "assembly": () if reduction is None else (reduction.decomposition, reduction, *compiled),
            "certificate": () if self.certificate is None else (self.certificate.base, self.certificate),
        }

    def inputs(self) -> tuple[Stage, ...]:
        """All stages whose artefacts enter the rows of the cell."""
        timed = (stage for stages in self.offline.values() for stage in stages)
        read = (self.assembly, self.exact, *self.assembly.model_inputs, *timed)
        stages = (*read, *self.constants, *self.reference.stages, *self.validation)
        return tuple(dict.fromkeys(stages))

    def begin(self, store: Store) -> _Queries:
        """Load the reduced programs and the reference solutions."""
        return _Queries(self, store)


def cell_queries(cell: Cell, query_seconds: float) -> CellGoal:
    """The last stage of a cell; all its other stages are inputs of it, directly or indirectly."""
    if cell.formulation is not None:
        return formulation_queries(cell, query_seconds)
    assert cell.solver is not None  # the mixed formulation has all axes
    assert cell.accuracy is not None
    assembly = assembly_stage(cell)
    certificate = CertificateStage(assembly) if cell.assembly == CERTIFIED else None
    mode, asked = CorrectionMode(cell.correction), (cell.solver, cell.accuracy, query_seconds, cell.warm_start)
    compilation = CompilationStage(assembly, cell.accuracy) if cell.assembly == COMPILED else None
    return CellQueries(assembly, *asked, certificate, mode, compilation)


class _Queries(CellItems):
    """The queries of a cell: solve, verify and assess every one."""

    def __init__(self, stage: CellQueries, store: Store) -> None:
        super().__init__(stage, store)
        self._stage, self._queries = stage, Queries(store, stage.assembly)
        self._model, self._reduced = self._queries.model, self._queries.reduced
        self._cone: ReducedCone = value_of(store, stage.assembly.enrichment.cone)
        self._own, self._full, self._plain = (value_of(store, one) for one in stage.constants)
        self._exact: tuple[ExactSolution | None, ...] = value_of(store, stage.exact)
        self._certificate: OnlineCertificate | None = (
            None if stage.certificate is None else stage.certificate.certificate(store)
        )
        self._corrector = Corrector(self._model, self._certificate, stage.correction)

    def answer(self, number: int, watch: Watch) -> QueryRows:
        """The rows of one query."""
        row, solution = run_query(self._stage.query(self._queries, number), self._stage.query_seconds, watch)
        return self.known(number) | row, solution and {"query": number} | solution

    def assess(self, solutions: Mapping[int, Row]) -> list[Row]:
        """Error columns of some queries."""
        numbers = list(solutions)
        return error_columns(
            self._corrector,
            self._reference.mu[numbers],
            [vectors(solution) for solution in solutions.values()],
            self._compared.at(numbers),
            self.constants(numbers),
            [self._exact[k] for k in numbers],
            [self._reduced.projected[k] for k in numbers] if self._reduced.projected else (),
        )

    def known(self, number: int) -> Row:
        """With the constants of the reduced pair, and what its assembly in reduced form misses."""
        return (
            super().known(number)
            | inf_sup_columns("beta_", self._own[number])
            | inf_sup_columns("beta_full_", self._full[number])
            | inf_sup_columns("beta_plain_", self._plain[number])
            | {"bounds": self._own[number].sharp, "assembly_error": self._reduced.errors[number]}
        )

    def sizes(self, rows: Sequence[Row]) -> tuple[Row, list[str]]:
        """Dimensions, and the fallbacks of cone, enrichment, assembly and corrections."""
        assembly, cone = self._stage.assembly, self._cone
        built = assembly.enrichment.enrichment(self._store)
        size = value_of(self._store, assembly.enrichment.pod).basis.shape[1]
        fallbacks = [*cone.cone.fallbacks, *built.fallbacks, *([self._queries.note] if self._queries.note else [])]
        tolerance, error = assembly.interpolation, max(self._reduced.errors)
        if tolerance is not None and error > MISSED * tolerance:
            fallbacks.append(
                f"reduced assembly differs from the Galerkin projection by up to {error:.1e} at validation parameters: "
                f"the interpolation tolerance {tolerance:g} holds at training parameters only"
            )
        if (gap := cone.prepared.rank_gap) < CLEAR_GAP:
            rank = cone.prepared.rank
            fallbacks.append(f"the rank {rank} is in doubt: its last singular value is {gap:.2g} times what is below")
        if uncorrected := [note for row in rows if (note := row.get("correction_note"))]:
            fallbacks.append(f"{len(uncorrected)} of {len(rows)} queries are not corrected: {uncorrected[0]}")
        added = self._model.fixed_basis.shape[1] - size
        return {
            "enrichment_kind": built.kind.value,
            "multiplier": Multiplier.SOLVED.value,
            "N": size,
            "R": cone.cone.size,
            "rank": cone.prepared.rank,
            "rank_gap": cone.prepared.rank_gap,
            "gram_condition": cone.prepared.gram_condition,
            "enrichment": cone.prepared.rank if built.kind is Kind.PER_PARAMETER else added,
            **assembly.columns(self._store),
            "correction_cost": self._corrector.cost,
            "certificate": (Guarantee.NONE if self._certificate is None else self._certificate.base.guarantee).value,
            **self._shares(),
        }, fallbacks

    def _shares(self) -> Row:
        """The smallest shares of β_span in that of V, and the share that the last σ of the enrichment guarantees."""
        histories = {h.quantity: h.values for h in self._artefact(self._stage.assembly.enrichment).histories}
        validation = [stability_ratio(own.span, full.span) for own, full in zip(self._own, self._full, strict=True)]
        row: Row = {"share_validation": min(validation)}
        if "share_min" in histories:
            row["share_training"] = histories["share_min"][-1]
        if "sigma" in histories:
            row["share_guaranteed"] = math.sqrt(max(0.0, 1.0 - histories["sigma"][-1] ** 2))
        return row
