"""How queries are assembled, in full or reduced: what that takes offline, and what it takes per query."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.interfaces.validation import checked_assembly, training_parameters, validation_parameters
from vibench.model.affine import AffineMember, Evaluation, affine_decomposition
from vibench.model.galerkin import ReducedModel, leading_part, project
from vibench.model.hyperreduced import HyperReducedModel, Operators, hyper_reduce, reason_for_full_assembly
from vibench.stages.artefacts import Store
from vibench.stages.assemblies import assemblies
from vibench.stages.base import Result, Stage, build_problem, value_of
from vibench.stages.offline import EnrichmentStage, GrowthStage, enrichment_stage, grown_model, reduced_model
from vibench.study.cells import Cell, Plugin
from vibench.timing import NO_TIME, REPEATS, Seconds, median_of, median_seconds, timed

Model = ReducedModel | HyperReducedModel
"""What gives the reduced problem at a parameter."""


@dataclass(frozen=True)
class Separation(Stage):
    """How A, f, B, g can be evaluated without assembling all of them; it depends on the problem alone."""

    problem: Plugin
    tolerance: float

    def inputs(self) -> tuple[Stage, ...]:
        """Nothing comes before: the matrices of the training parameters are not kept."""
        return ()

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """A `AffineMember` by name."""
        problem = build_problem(self.problem)
        return Result(*timed(lambda: affine_decomposition(problem, training_parameters(problem), self.tolerance)))


@dataclass(frozen=True)
class Reduction:
    """The projected members of a reduced model, or why there are none and queries are assembled in full."""

    operators: Operators | None
    why_full: str


@dataclass(frozen=True)
class ReductionStage(Stage):
    """Projection of the separated members on the space of a reduced model."""

    enrichment: EnrichmentStage
    separation: Separation

    def inputs(self) -> tuple[Stage, ...]:
        """The reduced model and the members."""
        return (self.enrichment, *self.enrichment.inputs(), self.separation)

    def run(self, store: Store) -> Result:
        """A `Reduction`."""
        model, _, _ = reduced_model(store, self.enrichment)
        members: Mapping[str, AffineMember] = value_of(store, self.separation)
        why = reason_for_full_assembly(model, members)
        if why:
            return Result(Reduction(None, why), NO_TIME)
        operators, seconds = timed(lambda: hyper_reduce(model, members))
        return Result(Reduction(operators, ""), seconds)


@dataclass(frozen=True)
class FormsStage(Stage):
    """What assembling the high-fidelity matrices takes: median seconds per validation parameter."""

    problem: Plugin
    count: int
    seed: int

    def inputs(self) -> tuple[Stage, ...]:
        """Nothing comes before."""
        return ()

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """Time every assembly; the same for all reduced models that assemble in full."""
        problem = build_problem(self.problem)
        seconds = []
        for mu in validation_parameters(problem, self.count, self.seed):
            vi, spent = median_seconds(partial(checked_assembly, problem, mu))
            assemblies(problem).keep(mu, vi)
            seconds.append(spent)
        return Result(tuple(seconds))


@dataclass(frozen=True)
class Projections(Stage):
    """Programs of everything a nested strategy grew, in full; those of its tolerances are their beginnings."""

    growth: GrowthStage
    count: int
    seed: int

    def inputs(self) -> tuple[Stage, ...]:
        """The growth and what it was built on."""
        return (self.growth, *self.growth.inputs())

    def run(self, store: Store) -> Result:
        """One program per validation parameter; not timed."""
        model = grown_model(store, self.growth)
        mus, kept = validation_parameters(model.problem, self.count, self.seed), assemblies(model.problem)
        return Result(tuple(model.reduce(kept.at(mu)).program for mu in mus))


@dataclass(frozen=True)
class Assembled:
    """Reduced programs and what assembling them takes, whatever solves them.

    Attributes
    ----------
    programs
        One per validation parameter.
    factor
        Cholesky factor (lower) of their A, where it is the same in all and they are solved through the dual.
    seconds
        Seconds of the assembly per validation parameter.
    errors
        Largest relative difference of a member of the reduced program from its Galerkin projection, per parameter; zero
        where it is assembled in full.
    """

    programs: tuple[VariationalInequality, ...]
    factor: Array | None
    seconds: tuple[Seconds, ...]
    errors: tuple[float, ...]


@dataclass(frozen=True)
class AssemblyStage(Stage):
    """Assembly of the reduced problems at the validation parameters, timed."""

    enrichment: EnrichmentStage
    interpolation: float | None
    count: int
    seed: int

    @property
    def reduction(self) -> ReductionStage | None:
        """What reduced assembly needs offline; `None` for assembly in full."""
        if self.interpolation is None:
            return None
        return ReductionStage(self.enrichment, Separation(self.enrichment.pod.problem, self.interpolation))

    @property
    def forms(self) -> FormsStage:
        """The stage that knows what high-fidelity matrices take."""
        return FormsStage(self.enrichment.pod.problem, self.count, self.seed)

    @property
    def projections(self) -> Projections | None:
        """What knows the programs in full of an enrichment that others are the beginnings of."""
        growth = self.enrichment.growth
        return None if growth is None else Projections(growth, self.count, self.seed)

    def inputs(self) -> tuple[Stage, ...]:
        """Enrichment, what it was built on, what the matrices take, and what is known of full and reduced assembly."""
        reduction, projections = self.reduction, self.projections
        known = () if projections is None else (projections,)
        extra = () if reduction is None else (reduction, reduction.separation)
        return (self.enrichment, *self.enrichment.inputs(), self.forms, *known, *extra)

    def run(self, store: Store) -> Result:
        """Time every assembly; compare reduced ones with full ones, untimed."""
        model, _ = query_model(store, self)
        mus = validation_parameters(model.problem, self.count, self.seed)
        known = None if self.projections is None else value_of(store, self.projections)
        if isinstance(model, HyperReducedModel):
            return Result(_reduced(model, mus, known))
        return Result(_in_full(model, mus, value_of(store, self.forms), known))


InFull = Sequence[VariationalInequality] | None
"""Programs in full of a space that begins with that of a model, one per parameter, if they are known."""


def _reduced(model: HyperReducedModel, mus: Array, known: InFull) -> Assembled:
    """Assemble without arrays of mesh size at every parameter; how far the members are from their projections."""
    matrices = assemblies(model.problem)
    programs, seconds, errors, factor = [], [], [], None
    for k, mu in enumerate(mus):
        found, spent = median_seconds(partial(model.assemble, mu))
        factor = found.factor
        full = known and leading_part(known[k], len(found.program.f))
        errors.append(
            _largest_difference(found.program, full or project(matrices.at(mu), found.basis, model.generators))
        )
        programs.append(found.program)
        seconds.append(spent)
    return Assembled(tuple(programs), factor, tuple(seconds), tuple(errors))


def _in_full(model: ReducedModel, mus: Array, forms: Sequence[Seconds], known: InFull) -> Assembled:
    """Assemble the high-fidelity matrices, which are timed once for all models, and project them.

    After a warm-up the projection is timed once at every parameter. On a space that does not vary it takes as long at
    each, and the median over the first parameters counts for all, where the programs are known already.
    """
    matrices, model_of_one = assemblies(model.problem), model.kind is not Kind.PER_PARAMETER
    size = len(model.reduce(matrices.at(mus[0])).program.f)
    timed_at = mus[:REPEATS] if known and model_of_one else mus
    each = [timed(partial(model.reduce, matrices.at(mu))) for mu in timed_at]
    projecting = [seconds for _, seconds in each]
    if model_of_one:
        projecting = [median_of(projecting)] * len(mus)
    programs = [leading_part(program, size) for program in known] if known else [found.program for found, _ in each]
    total = tuple(form + spent for form, spent in zip(forms, projecting, strict=True))
    return Assembled(tuple(programs), None, total, (0.0,) * len(mus))


def _largest_difference(found: VariationalInequality, exact: VariationalInequality) -> float:
    pairs = [(getattr(found, name), getattr(exact, name)) for name in MEMBERS]
    return max(float(np.linalg.norm(one - other)) / (float(np.linalg.norm(other)) or 1.0) for one, other in pairs)


def query_model(store: Store, stage: AssemblyStage) -> tuple[Model, str]:
    """The model that queries ask, and why it assembles in full although reduced assembly was asked for."""
    model, _, _ = reduced_model(store, stage.enrichment)
    if stage.reduction is None:
        return model, ""
    reduction: Reduction = value_of(store, stage.reduction)
    if reduction.operators is None:
        return model, f"assembled in full: {reduction.why_full}"
    return HyperReducedModel(model, reduction.operators), ""


def assembly_columns(store: Store, stage: AssemblyStage) -> dict[str, float | int | None]:
    """Columns of a cell: tolerance, training error and number of terms of every member; none for assembly in full."""
    if stage.reduction is None:
        return {}
    members: Mapping[str, AffineMember] = value_of(store, stage.reduction.separation)
    summed = {name: member for name, member in members.items() if member.terms}
    return {
        "interpolation_tol": stage.interpolation,
        "interpolation_error": max((member.error for member in summed.values()), default=0.0),
        **{f"terms_{name}": len(m.rows) if m.way is Evaluation.INTERPOLATED else 0 for name, m in summed.items()},
    }


def assembly_stage(cell: Cell) -> AssemblyStage:
    """The stage that times the assembly of a cell's queries."""
    return AssemblyStage(enrichment_stage(cell), cell.interpolation, cell.validation, cell.seed)
