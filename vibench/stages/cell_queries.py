"""The queries of a cell: every validation parameter solved, verified and compared with the high-fidelity solution."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vibench.interfaces.formulations import FormulationAnswer
from vibench.interfaces.strategies import Kind
from vibench.model.affine import MISSED
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.offline.assemblies import assemblies
from vibench.offline.correction import Corrector
from vibench.plugins.plugin import Plugin
from vibench.qp.exact import ExactSolution
from vibench.results.consistency import vectors
from vibench.stability.infsup import stability_ratio
from vibench.stages.artefacts import Store
from vibench.stages.assembly import AssemblyStage, ExactSolutions, ReducedPrograms
from vibench.stages.assessment import error_columns, pair_columns
from vibench.stages.base import Row, Stage, TimeLimit, value_of
from vibench.stages.cell_stage import CellStage, CellWork, QueryRows, inf_sup_columns
from vibench.stages.certification import CertificateStage
from vibench.stages.enrichment import EnrichmentStage, spaces_of
from vibench.stages.formulation import FormulationStage
from vibench.stages.infsup_constants import InfSupConstants
from vibench.stages.offline import ReducedCone
from vibench.stages.query import ModelQuery, ProgramQuery, Queries, run_query
from vibench.study.cells import Cell
from vibench.study.parameter_sets import ParameterSet


@dataclass(frozen=True)
class CellQueries(CellStage):
    """All queries of one cell."""

    built: FormulationStage
    validation_set: ParameterSet
    solver: str | None
    accuracy: float | None
    query_seconds: float
    warm_start: bool = False
    bounds: bool = False
    correction: CorrectionMode = CorrectionMode.NONE

    @property
    def problem(self) -> Plugin:
        """The problem."""
        return self.built.problem

    @property
    def training_set(self) -> ParameterSet:
        """The training set."""
        return self.built.training

    @property
    def assembly(self) -> AssemblyStage | None:
        """The stage of the programs; `None` for a formulation that has none."""
        return AssemblyStage(self.built, self.validation_set) if self.built.kind.has_program else None

    @property
    def certificate(self) -> CertificateStage | None:
        """The stage of the certificate; `None` without bounds."""
        return CertificateStage(self.built) if self.bounds else None

    @property
    def model(self) -> str:
        """The key of the programs, or of the formulation on its offline phase."""
        return self.built.key if self.assembly is None else self.assembly.key

    @property
    def timed_inputs(self) -> tuple[Stage, ...]:
        """The model and its programs, and the certificate with its base."""
        assembly = () if self.assembly is None else (self.assembly,)
        certifying = () if self.certificate is None else (self.certificate.base, self.certificate)
        return (*self.built.model_inputs, *assembly, *certifying)

    def queries(self, store: Store) -> Queries:
        """The queries of the model, which cells that differ in their solver alone share."""
        return Queries(store, self.built, self.validation_set, self.assembly, self.accuracy)

    def query(self, queries: Queries, number: int) -> ProgramQuery | ModelQuery:
        """One query of the model, for the solver of the cell."""
        return queries.query(number, self.solver, self.accuracy, self.warm_start)

    @property
    def constants(self) -> tuple[InfSupConstants, ...]:
        """The stages of the inf-sup constants of the reduced pair, of V with the cone, and of V_N alone."""
        enrichment = self.built.enrichment
        if self.assembly is None or enrichment is None:
            return ()
        spaces = (enrichment, None, enrichment.pod)
        return tuple(InfSupConstants(space, enrichment.cone, self.reference.constraints) for space in spaces)

    @property
    def exact(self) -> tuple[ExactSolutions, ...]:
        """The stage of the programs solved to round-off, if there are any."""
        return () if self.assembly is None else (ExactSolutions(self.assembly),)

    @property
    def offline(self) -> Mapping[str, tuple[Stage, ...]]:
        """The stages whose seconds add up to the offline time of the cell, by column."""
        built, certificate = self.built, self.certificate
        parts: Mapping[str, tuple[Stage | None, ...]] = {
            "pod": (built.pod,),
            "cone": (built.cone,),
            "enrichment": (built.enrichment,),
            "formulation": (built if built.builds else None,),
            "assembly": (built.decomposition, built.reduction),
            "certificate": (None,) if certificate is None else (certificate.base, certificate),
        }
        made = {name: tuple(stage for stage in stages if stage is not None) for name, stages in parts.items()}
        return {"snapshots": self.training} | made

    def inputs(self) -> tuple[Stage, ...]:
        """All stages whose artefacts enter the rows of the cell."""
        timed = (stage for stages in self.offline.values() for stage in stages)
        stages = (*self.timed_inputs, *self.exact, *timed, *self.constants, *self.reference.stages, *self.validation)
        return tuple(dict.fromkeys(stages))

    def begin(self, store: Store) -> _Queries:
        """Load the model, its programs and the reference solutions."""
        return _Queries(self, store)


def cell_queries(cell: Cell, query_seconds: float) -> CellQueries:
    """The last stage of a cell; all its other stages are inputs of it, directly or indirectly."""
    spaces = spaces_of(cell)
    built = FormulationStage(cell.problem, cell.formulation, cell.training, *spaces, cell.interpolation)
    return CellQueries(
        built, cell.validation, cell.solver, cell.accuracy, query_seconds, cell.warm_start,
        cell.bounds, CorrectionMode(cell.correction),
    )  # fmt: skip


class _Queries(CellWork):
    """The queries of a cell: solve, verify and assess every one."""

    def __init__(self, stage: CellQueries, store: Store) -> None:
        super().__init__(stage, store)
        self._stage, self._queries = stage, stage.queries(store)
        self._model = self._queries.model
        certificate: OnlineCertificate | None = (
            None if stage.certificate is None else stage.certificate.certificate(store)
        )
        self._certificate = certificate
        self._constants = [value_of(store, one) for one in stage.constants]
        self._exact: list[ExactSolution | None] = [one for exact in stage.exact for one in value_of(store, exact)]

    def answer(self, number: int, time_limit: TimeLimit) -> QueryRows:
        """The rows of one query; u and λ of a formulation are reconstructed here, where a broken answer costs one."""
        row, solution = run_query(self._stage.query(self._queries, number), self._stage.query_seconds, time_limit)
        return self.known(number) | row, solution and {"query": number} | solution

    def assess(self, solutions: Mapping[int, Row]) -> list[Row]:
        """Error columns of some queries."""
        numbers, mus = list(solutions), self._queries.mus[list(solutions)]
        compared, constants, programs = (
            self._compared.restrict(numbers),
            self.constants(numbers),
            self._queries.programs,
        )
        if programs is not None:
            return error_columns(
                self._corrector,
                mus,
                [vectors(solution) for solution in solutions.values()],
                compared,
                constants,
                [self._exact[k] for k in numbers],
                [programs.projected[k] for k in numbers] if programs.projected else (),
            )
        answers = [FormulationAnswer(*vectors(solution)) for solution in solutions.values()]
        pairs = [self._model.pair(mu, answer) for mu, answer in zip(mus, answers, strict=True)]
        u, lam = (np.column_stack(columns) for columns in zip(*pairs, strict=True))
        vis = [assemblies(self._problem).at(mu) for mu in mus]
        return pair_columns(self._problem, mus, vis, u, lam, compared, constants)

    @property
    def _corrector(self) -> Corrector:
        return Corrector(self._model.reduced, self._certificate, self._stage.correction)

    def known(self, number: int) -> Row:
        """With the constants of the reduced pair, and what its assembly in reduced form misses."""
        row = super().known(number)
        for prefix, constants in zip(("beta_", "beta_full_", "beta_plain_"), self._constants, strict=False):
            row |= inf_sup_columns(prefix, constants[number])
        if self._constants:
            row["beta_bounds"] = self._constants[0][number].sharp
        programs = self._queries.programs
        return row if programs is None else row | {"assembly_error": programs.errors[number]}

    def sizes(self, rows: Sequence[Row]) -> tuple[Row, list[str]]:
        """Dimensions, and the fallbacks of model, cone, enrichment, assembly and corrections."""
        built, offline, online = self._stage.built, self._model.offline, self._model.online
        fallbacks = [*online.fallbacks]
        kind, added = Kind.NONE, None
        if built.cone is not None:
            fallbacks += offline.cone.fallbacks
        if built.enrichment is not None:
            fallbacks += offline.enrichment.fallbacks
            kind, vectors = offline.enrichment.kind, offline.enrichment.vectors
            fixed = 0 if vectors is None else vectors.shape[1]
            added = offline.multipliers.rank if kind is Kind.PER_PARAMETER else fixed
        added = added if online.enrichment is None else online.enrichment
        row: Row = {
            "enrichment_kind": kind.value,
            "N": online.dimension - (added or 0),
            "R": online.generators,
            "enrichment": added,
            "multiplier": self._model.formulation.multiplier.value,
            "correction_cost": "",
            "certificate": (Guarantee.NONE if self._certificate is None else self._certificate.base.guarantee).value,
        }
        if self._queries.programs is not None and self._stage.assembly is not None:
            row |= self._program_sizes(self._stage.assembly, self._queries.programs, rows, fallbacks)
        return row, fallbacks

    def _program_sizes(
        self, assembly: AssemblyStage, programs: ReducedPrograms, rows: Sequence[Row], fallbacks: list[str]
    ) -> Row:
        """Columns of a model with programs; adds the fallbacks of these."""
        built, offline, online = assembly.built, self._model.offline, self._model.online
        if built.reduction is not None and isinstance(why := offline.operators, str):
            fallbacks.append(f"assembled in full: {why}")
        tolerance, error = built.interpolation, max(programs.errors)
        if tolerance is not None and error > MISSED * tolerance:
            fallbacks.append(
                f"reduced assembly differs from the Galerkin projection by up to {error:.1e} at validation parameters: "
                f"the interpolation tolerance {tolerance:g} holds at training parameters only"
            )
        row: Row = {"correction_cost": self._corrector.cost} | assembly.columns(self._store)
        if built.cone is not None:
            cone: ReducedCone = value_of(self._store, built.cone)
            prepared = cone.prepared
            # The singular values on both sides of the threshold should differ by a clear factor.
            if prepared.rank_gap < 10.0:
                fallbacks.append(
                    f"the rank {prepared.rank} is in doubt: its last singular value is {prepared.rank_gap:.2g} times "
                    "what is below"
                )
            if online.generators == cone.cone.rays.shape[1]:
                row["R"] = cone.cone.size  # a free generator is one, with two coefficients
            row |= {"rank": prepared.rank, "rank_gap": prepared.rank_gap, "gram_condition": prepared.gram_condition}
        if uncorrected := [note for one in rows if (note := one.get("correction_note"))]:
            fallbacks.append(f"{len(uncorrected)} of {len(rows)} queries are not corrected: {uncorrected[0]}")
        return row | (self._shares(built.enrichment) if built.enrichment is not None else {})

    def _shares(self, enrichment: EnrichmentStage) -> Row:
        """The smallest shares of β_span in that of V, and the share that the last σ of the enrichment guarantees."""
        histories = {h.quantity: h.values for h in self._artefact(enrichment).histories}
        validation = [stability_ratio(own.span, full.span) for own, full in zip(*self._constants[:2], strict=True)]
        row: Row = {"share_validation": min(validation)}
        if "share_min" in histories:
            row["share_training"] = histories["share_min"][-1]
        if "sigma" in histories:
            row["share_guaranteed"] = math.sqrt(max(0.0, 1.0 - histories["sigma"][-1] ** 2))
        return row
