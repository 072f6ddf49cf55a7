"""The queries of a cell: every validation parameter solved, verified and compared with the high-fidelity solution."""

from __future__ import annotations

import json
import math
import resource
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from vibench.errors import in_a_line
from vibench.interfaces.formulations import FormulationAnswer
from vibench.interfaces.strategies import Kind
from vibench.model.affine import is_missed
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee
from vibench.model.errors import ReferenceSolutions, output_scales, summarise_outputs, zeros
from vibench.offline.assemblies import assemblies
from vibench.offline.models import Model
from vibench.offline.solution import Corrector
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import find
from vibench.provenance import machine
from vibench.qp.exact import ExactSolution
from vibench.qp.status import Status
from vibench.results.consistency import vectors
from vibench.stability.coercivity import Constant, Stability
from vibench.stability.infsup import InfSup, stability_ratio
from vibench.stages.artefacts import Artefact, Store
from vibench.stages.assembly import AssemblyStage, ExactSolutions, ReducedPrograms
from vibench.stages.assessment import error_columns, online_columns, pair_columns, refutation, summarise
from vibench.stages.base import Failed, Items, ItemwiseStage, Row, Stage, TimeLimit, build_problem, value_of
from vibench.stages.enrichment import EnrichmentStage, spaces_of
from vibench.stages.formulation import CertificateStage, FormulationStage
from vibench.stages.infsup_constants import InfSupConstants, ReferenceConstants
from vibench.stages.offline import ConstraintMatrices, ReducedCone
from vibench.stages.query import ModelQuery, ProgramQuery, Queries, run_query
from vibench.stages.snapshots import TimedSnapshots, gather, solution_stages
from vibench.study.cells import Cell
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import median_of

QueryRows = tuple[Row, Row | None]
"""The row of a query, and that of its solution if there is one."""


@dataclass(frozen=True)
class CellRows:
    """The rows of one cell: its own, one per query, the solutions of those that have one, and one per output."""

    # `parameters` are names and units of mu_1, mu_2, … of the queries.

    cell: Row
    queries: tuple[Row, ...]
    solutions: tuple[Row, ...] = ()
    outputs: tuple[Row, ...] = ()
    parameters: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class CellQueries(ItemwiseStage):
    """All queries of one cell, each an item; the value is a `CellRows`. `solver` is `None` where there is none."""

    label = "queries"

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
        return self.built.problem

    @property
    def items(self) -> int:
        return self.validation_set.count

    @property
    def kind_of_work(self) -> str:
        # Queries of one solver take about as long as each other.
        return f"{self.label} with {self.solver}"

    @property
    def effort(self) -> float:
        # A query with the assessment of its answer costs about 1.5 high-fidelity solutions.
        return 1.5 * self.items

    @cached_property
    def packages(self) -> frozenset[str]:
        # A QP solver is no `Plugin` of the fields: it is looked up by its name.
        own = super().packages
        return own if self.solver is None else own | {find(PluginKind.SOLVER, self.solver).package} - {""}

    @property
    def reference(self) -> ReferenceConstants:
        """The stages of the constants of the high-fidelity problem."""
        return ReferenceConstants(ConstraintMatrices(self.problem, self.validation_set))

    @property
    def training(self) -> tuple[Stage, ...]:
        """The stages of the training snapshots."""
        return solution_stages(self.problem, self.built.training)

    @property
    def validation(self) -> tuple[Stage, ...]:
        """The stages of the reference solutions."""
        return solution_stages(self.problem, self.validation_set)

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
        """Key of the reduced model, which cells that differ only in their solver share."""
        return self.built.key if self.assembly is None else self.assembly.key

    @property
    def constants(self) -> tuple[InfSupConstants, ...]:
        """The stages of the inf-sup constants of the reduced pair, of V with the cone, and of V_N alone."""
        enrichment = self.built.enrichment
        if self.assembly is None or enrichment is None:
            return ()
        spaces = (enrichment, None, enrichment.pod)
        return tuple(InfSupConstants(space, enrichment.cone, self.reference.constraints) for space in spaces)

    @property
    def offline_stages(self) -> Mapping[str, tuple[Stage, ...]]:
        """The stages whose seconds add up to the offline time of the cell, by column."""
        built, certificate = self.built, self.certificate
        parts: Mapping[str, tuple[Stage | None, ...]] = {
            "pod": (built.pod,), "cone": (built.cone,), "enrichment": (built.enrichment,),
            "formulation": (built if built.builds else None,), "assembly": (built.decomposition, built.reduction),
            "certificate": (None,) if certificate is None else (certificate.base, certificate),
        }  # fmt: skip
        made = {name: tuple(stage for stage in stages if stage is not None) for name, stages in parts.items()}
        return {"snapshots": self.training} | made

    @property
    def model_inputs(self) -> tuple[Stage, ...]:
        """The stages of the model, its programs and its certificate, which are all that a timed query reads."""
        assembly = () if self.assembly is None else self.assembly.stored_in
        certifying = () if self.certificate is None else (self.certificate.base, self.certificate)
        return (*self.built.model_inputs, *assembly, *certifying)

    def inputs(self) -> tuple[Stage, ...]:
        exact = () if self.assembly is None else (ExactSolutions(self.assembly),)
        offline = (stage for stages in self.offline_stages.values() for stage in stages)
        assessment = (*exact, *offline, *self.constants, *self.reference.stages, *self.validation)
        return tuple(dict.fromkeys((*self.model_inputs, *assessment)))

    def bounded_model(self, store: Store) -> Model:
        """The model of the cell, with its bounds if it has them."""
        certified = None if self.certificate is None else self.certificate.certificate(store)
        model = self.built.model(store, self.solver, self.accuracy)
        return replace(model, certificate=certified, correction=self.correction)

    def queries(self, store: Store) -> Queries:
        """The queries of the model, which cells that differ only in their solver share."""
        return Queries(store, self.built, self.validation_set, self.assembly, self.accuracy)

    def query(self, queries: Queries, number: int) -> ProgramQuery | ModelQuery:
        """One query of the model, for the solver of the cell."""
        return queries.query(number, self.solver, self.accuracy, self.warm_start)

    def begin(self, store: Store) -> _Queries:
        return _Queries(self, store)

    def has_failed(self, value: CellRows) -> bool:
        return Status(value.cell["status"]).severity >= Status.FAILED.severity


def cell_queries(cell: Cell, query_seconds: float) -> CellQueries:
    """The last stage of a cell; all its other stages are inputs of it, directly or indirectly."""
    built = FormulationStage(cell.problem, cell.formulation, cell.training, *spaces_of(cell), cell.interpolation)
    return CellQueries(
        built, cell.validation, cell.solver, cell.accuracy, query_seconds, cell.warm_start,
        cell.bounds, CorrectionMode(cell.correction),
    )  # fmt: skip


class _Queries(Items):
    def __init__(self, stage: CellQueries, store: Store) -> None:
        self._stage, self._store, self._queries = stage, store, stage.queries(store)
        self._problem, self._model = build_problem(stage.problem), self._queries.model
        solved = _solutions(store, stage.problem, stage.training, stage.validation)
        self._training, self._reference, self._compared = solved
        self._zeros = zeros(self._problem, self._compared)
        self._stability = stage.reference.gather(store)
        self._certificate = None if stage.certificate is None else stage.certificate.certificate(store)
        self._constants = [value_of(store, one) for one in stage.constants]
        self._exact: Sequence[ExactSolution | None] = ()
        if stage.assembly is not None:
            self._exact = value_of(store, ExactSolutions(stage.assembly))

    @property
    def _corrector(self) -> Corrector:
        return Corrector(self._model.reduced, self._certificate, self._stage.correction)

    def run_item(self, number: int, time_limit: TimeLimit) -> QueryRows:
        constants = self._stability[number]
        # Without the constants of the problem no error bound can be evaluated: the query is not answered.
        if isinstance(constants, Failed):
            return self.failed(number, constants)
        row, solution = run_query(self._stage.query(self._queries, number), self._stage.query_seconds, time_limit)
        return self._known(number) | row, solution and {"query": number} | solution

    def failed(self, number: int, failed: Failed) -> QueryRows:
        return self._known(number) | {"status": failed.status.value, "reason": failed.reason}, None

    def collect(self, items: Sequence[QueryRows]) -> CellRows:
        solutions = {k: solution for k, (_, solution) in enumerate(items) if solution is not None}
        assessed = dict(zip(solutions, self._assess_in_parts(solutions), strict=True))
        rows = [row | assessed.get(k, {}) for k, (row, _) in enumerate(items)]
        rows = [row | refutation(row) for row in rows]
        sizes, fallbacks = self._sizes(rows)
        own = summarise(rows) | self._common(fallbacks) | sizes | self._offline()
        fine = [row["outputs"] for row in rows if row["status"] == Status.OK]
        outputs = summarise_outputs(self._problem.outputs, self._compared.scale_outputs, fine)
        written = [row | {"outputs": json.dumps(values) if (values := row.get("outputs")) else None} for row in rows]
        box = self._problem.parameters
        named = tuple(zip(map(str, box.names), map(str, box.units), strict=True))
        return CellRows(own, tuple(written), tuple(solutions.values()), tuple(map(dict, outputs)), named)

    def _assess_in_parts(self, solutions: Mapping[int, Row]) -> list[Row]:
        """Error columns of some queries; a row says why its assessment failed."""
        # Factors of A are kept for all queries that are assessed at once: as many as fit in memory.
        numbers = list(solutions)
        if not numbers:
            return []
        try:
            count = assemblies(self._problem).together(self._reference.mu[numbers[0]])
            if len(numbers) <= count:
                return self._assess(solutions)
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  whatever it is, it may concern one query alone
            if len(numbers) == 1:
                return [{"status": Status.ERROR.value, "reason": f"in the assessment: {in_a_line(error)}"}]
            # One broken answer must not take the columns of the others along: go on one by one.
            count = 1
        parts = (numbers[first : first + count] for first in range(0, len(numbers), count))
        return [row for part in parts for row in self._assess_in_parts({k: solutions[k] for k in part})]

    def _assess(self, solutions: Mapping[int, Row]) -> list[Row]:
        numbers, mus, programs = list(solutions), self._queries.mus[list(solutions)], self._queries.programs
        compared = self._compared.restrict(numbers)
        constants = [one for k in numbers if isinstance(one := self._stability[k], Stability)]
        if programs is not None:
            return error_columns(
                self._corrector, mus, [vectors(solution) for solution in solutions.values()], compared, constants,
                [self._exact[k] for k in numbers],
                [programs.projected[k] for k in numbers] if programs.projected else (),
            )  # fmt: skip
        # u and λ of a formulation are reconstructed only here, where a broken answer costs one query.
        answers = [FormulationAnswer(*vectors(solution)) for solution in solutions.values()]
        pairs = [self._model.pair(mu, answer) for mu, answer in zip(mus, answers, strict=True)]
        u, lam = (np.column_stack(columns) for columns in zip(*pairs, strict=True))
        vis = [assemblies(self._problem).at(mu) for mu in mus]
        rows = pair_columns(self._problem, mus, vis, u, lam, compared, constants)
        certified = replace(self._model, certificate=self._certificate)
        bounds = [certified.bound_of(mu, answer) for mu, answer in zip(mus, answers, strict=True)]
        return [row | (online_columns(one, row) if one else {}) for row, one in zip(rows, bounds, strict=True)]

    def _known(self, number: int) -> Row:
        """The columns of a query that do not depend on its solution: parameter, zeros of the reference, constants."""
        reference, (zero_u, zero_lam), programs = self._reference, self._zeros, self._queries.programs
        bound, constants = reference.bounds[number], self._stability[number]
        row: Row = {f"mu_{i + 1}": float(value) for i, value in enumerate(reference.mu[number])}
        row |= {"hf_s": reference.seconds[number].cpu, "reference_bound": bound if math.isfinite(bound) else None}
        row |= {"zero_u": int(zero_u[number]), "zero_lambda": int(zero_lam[number])}
        if isinstance(constants, Stability):
            row |= _inf_sup_columns("beta_hf_", constants.inf_sup) | {"beta_energy": constants.energy_inf_sup.value}
            for name in ("coercivity", "continuity"):
                one: Constant = getattr(constants, name)
                row |= {name: one.value, f"{name}_proved": int(one.proved)}
        for prefix, of_pair in zip(("beta_", "beta_full_", "beta_plain_"), self._constants, strict=False):
            row |= _inf_sup_columns(prefix, of_pair[number])
        if self._constants:
            row["beta_bounds"] = self._constants[0][number].sharp
        return row if programs is None else row | {"assembly_error": programs.errors[number]}

    def _sizes(self, rows: Sequence[Row]) -> tuple[Row, list[str]]:
        """Columns of the model of the cell, and its fallbacks, from the rows of its queries."""
        built, offline, online = self._stage.built, self._model.offline, self._model.online
        fallbacks = [*online.fallbacks]
        kind, added = Kind.NONE, None
        if built.cone is not None:
            fallbacks += offline.cone.fallbacks
        if built.enrichment is not None:
            fallbacks += offline.enrichment.fallbacks
            kind, vectors = offline.enrichment.kind, offline.enrichment.vectors
            fixed = 0 if vectors is None else vectors.shape[1]
            added = offline.multipliers.span.shape[1] if kind is Kind.PER_PARAMETER else fixed
        # A formulation may count its vectors otherwise than the offline phase.
        added = added if online.enrichment is None else online.enrichment
        row: Row = {
            "enrichment_kind": kind.value, "N": online.dimension - (added or 0), "R": online.generators,
            "enrichment": added, "multiplier": self._model.formulation.multiplier.value, "correction_cost": "",
            "certificate": (Guarantee.NONE if self._certificate is None else self._certificate.base.guarantee).value,
        }  # fmt: skip
        if self._queries.programs is not None and self._stage.assembly is not None:
            row |= self._stage.assembly.columns(self._store)
            row |= self._program_sizes(self._queries.programs, rows, fallbacks)
        return row, fallbacks

    def _program_sizes(self, programs: ReducedPrograms, rows: Sequence[Row], fallbacks: list[str]) -> Row:
        """Columns of a model with programs; adds the fallbacks of these."""
        built, offline, online = self._stage.built, self._model.offline, self._model.online
        if built.reduction is not None and isinstance(why := offline.operators, str):
            fallbacks.append(f"assembled in full: {why}")
        tolerance, error = built.interpolation, max(programs.errors)
        if tolerance is not None and is_missed(tolerance, error):
            differs = f"reduced assembly differs from the Galerkin projection by up to {error:.1e}"
            holds = f"the interpolation tolerance {tolerance:g} holds at training parameters only"
            fallbacks.append(f"{differs} at validation parameters: {holds}")
        row: Row = {"correction_cost": self._corrector.cost}
        if built.cone is not None:
            cone: ReducedCone = value_of(self._store, built.cone)
            prepared = cone.prepared
            # The singular values on both sides of the threshold should differ by a clear factor.
            if prepared.rank_gap < 10.0:
                last = f"its last singular value is {prepared.rank_gap:.2g} times what is below"
                fallbacks.append(f"the rank {prepared.rank} is in doubt: {last}")
            if online.generators == cone.cone.rays.shape[1]:
                # A free generator counts once, with two coefficients.
                row["R"] = cone.cone.size
            row |= {"rank": prepared.rank, "rank_gap": prepared.rank_gap, "gram_condition": prepared.gram_condition}
        if uncorrected := [note for one in rows if (note := one.get("correction_note"))]:
            fallbacks.append(f"{len(uncorrected)} of {len(rows)} queries are not corrected: {uncorrected[0]}")
        return row | (self._shares(built.enrichment) if built.enrichment is not None else {})

    def _shares(self, enrichment: EnrichmentStage) -> Row:
        """The smallest stability ratios β_span / β_V,span, and the one that the last σ of the enrichment guarantees."""
        histories = {h.quantity: h.values for h in self._artefact(enrichment).histories}
        validation = [stability_ratio(own.span, full.span) for own, full in zip(*self._constants[:2], strict=True)]
        row: Row = {"share_validation": min(validation)}
        if "share_min" in histories:
            row["share_training"] = histories["share_min"][-1]
        # The last σ is the sine of an angle, whose cosine bounds the ratio from below.
        if "sigma" in histories:
            row["share_guaranteed"] = math.sqrt(max(0.0, 1.0 - histories["sigma"][-1] ** 2))
        return row

    def _common(self, fallbacks: list[str]) -> Row:
        """Columns that do not depend on how the cell answers; adds the fallbacks of its high-fidelity solutions."""
        for purpose, solved in (("training", self._training), ("validation", self._reference)):
            notes = [note for note in solved.fallbacks if note]
            fallbacks += [f"{len(notes)} of the {purpose} solutions: {notes[0]}"] if notes else []
        if skipped := self._training.skipped:
            fallbacks.append(f"{len(skipped)} training parameters without a solution were skipped: {skipped[0]}")
        if unbounded := int(np.sum(np.isinf(self._reference.bounds))):
            fallbacks.append(f"{unbounded} of the validation solutions have no error bound: residuals verify them")
        return {
            "model": self._stage.model, "dim_V": self._problem.V.dim, "dim_W": self._problem.W.dim,
            "snapshots": len(self._training.mu), "skipped": len(self._training.skipped),
            "fallbacks": "; ".join(fallbacks),
            "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }  # fmt: skip

    def _offline(self) -> Row:
        """Offline seconds as if the cell had been run alone, and the machines that measured them."""
        phases = self._stage.offline_stages.items()
        artefacts = {name: [self._artefact(stage) for stage in stages] for name, stages in phases}
        spent = {name: [artefact.seconds for artefact in read] for name, read in artefacts.items()}
        # Chunks solved in parallel have one set-up per process; the cell alone would have had one.
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


# Cells of one problem share its solutions.
@lru_cache(maxsize=1)
def _solutions(
    store: Store, plugin: Plugin, training: tuple[Stage, ...], validation: tuple[Stage, ...]
) -> tuple[TimedSnapshots, TimedSnapshots, ReferenceSolutions]:
    """Training and validation solutions, and the latter with the largest values of the former."""
    trained, reference, problem = gather(store, training), gather(store, validation), build_problem(plugin)
    norms = problem.V.norm(trained.u), problem.W.norm(trained.lam)
    of_u, of_lam = (float(np.max(one, initial=0.0)) for one in norms)
    scales = output_scales(problem.outputs, trained.mu, trained.u, trained.lam)
    return trained, reference, ReferenceSolutions(reference.u, reference.lam, of_u, of_lam, scales)


def _inf_sup_columns(prefix: str, constants: InfSup) -> Row:
    return {f"{prefix}{name}": getattr(constants, name) for name in ("span", "cone_lower", "cone_upper")}
