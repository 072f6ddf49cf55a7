"""Assembly of reduced programs, in full or hyper-reduced: its offline part, and the programs of the queries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import MEMBERS, Problem, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.linalg.cholesky import PartialCholesky, SparseCholesky
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.inner_product import InnerProduct
from vibench.model.affine import AffineMember, Evaluation, affine_decomposition
from vibench.model.galerkin import ReducedModel, leading_part, project
from vibench.model.hyperreduced import HyperReducedModel, ProjectedMember, ReducedOperators
from vibench.offline.assemblies import assemblies
from vibench.offline.models import AnyReducedModel
from vibench.offline.reduction import Reduction
from vibench.plugins.plugin import Plugin
from vibench.qp.exact import ExactSolution, exact_solution
from vibench.reduction.supremizers import ContactCoordinates, LoadCoordinates, SpannedCoordinates
from vibench.stages.base import Result, Stage, build_problem, value_of
from vibench.stages.enrichment import EnrichmentStage, GrowthStage, enrichment_stage
from vibench.storage.artefacts import Store
from vibench.storage.serialisation import storable
from vibench.study.cells import Cell
from vibench.study.parameter_sets import OWN_TRAINING, ParameterSet
from vibench.timing import timed

for _kind in (
    AffineMember, Evaluation, ReducedOperators, ProjectedMember, ContactCoordinates, LoadCoordinates,
    SpannedCoordinates, InnerProduct, SparseCholesky, PartialCholesky, BlockDiagonal,
    VariationalInequality, ExactSolution,
):  # fmt: skip
    storable(_kind)


@dataclass(frozen=True)
class AffineDecomposition(Stage):
    """Affine decomposition of A, f, B and g over the training set, for their evaluation at reduced cost.

    The training matrices are not stored, they are assembled again.
    """

    label = "affine decomposition"

    problem: Plugin
    tolerance: float
    training: ParameterSet = OWN_TRAINING

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """An `AffineMember` by name."""
        problem = build_problem(self.problem)
        mus = self.parameters(problem)
        return Result(*timed(lambda: affine_decomposition(problem, mus, self.tolerance)))

    def parameters(self, problem: Problem) -> Array:
        """Parameters (P×d) at which members are assembled: the training set, or the problem's own.

        That needs no solutions, and an adaptive training has too few parameters for it.
        """
        return (OWN_TRAINING if self.training.is_adaptive else self.training).of(problem)


@dataclass(frozen=True)
class HyperReduction(Stage):
    """Projection of the decomposed members on the space of a reduced model."""

    label = "hyper-reduction"

    enrichment: EnrichmentStage
    decomposition: AffineDecomposition

    def inputs(self) -> tuple[Stage, ...]:
        """The reduced model and the members."""
        return (*self.enrichment.model_inputs, self.decomposition)

    def run(self, store: Store) -> Result:
        """The `ReducedOperators` of a reduced model, or why there are none and queries are assembled in full."""
        reduction = self.enrichment.reduction(store).given(members=value_of(store, self.decomposition))
        reduction.projection  # noqa: B018  the clock begins after it
        return Result(*timed(lambda: reduction.operators))


@dataclass(frozen=True)
class NestedPrograms(Stage):
    """Reduced programs, in full, with all vectors of a nested strategy; its tolerances take their leading parts."""

    label = "nested programs"

    growth: GrowthStage
    validation: ParameterSet

    def inputs(self) -> tuple[Stage, ...]:
        """The growth, and the POD and the cone of its model."""
        return (self.growth.pod, self.growth.cone, self.growth)

    def run(self, store: Store) -> Result:
        """One program per validation parameter; not timed."""
        model = self.growth.reduction(store).projection
        return Result(tuple(_projections(model, self.validation.of(model.problem))))


@storable
@dataclass(frozen=True)
class ReducedPrograms:
    """Reduced programs, for any QP solver."""

    programs: tuple[VariationalInequality, ...]
    """One per validation parameter."""
    factor: Array | None
    """Cholesky factor (lower) of A, where A is constant and the programs are solved in dual form."""
    errors: tuple[float, ...]
    """Largest relative difference of a member of the reduced program from its Galerkin projection, per parameter; zero
    where it is assembled in full."""
    projected: tuple[ExactSolution | None, ...] = ()
    """The Galerkin projections solved to round-off, or `None` where that fails; none where programs are assembled in
    full, which are these projections."""


@dataclass(frozen=True)
class AssemblyStage(Stage):
    """Assembly of the reduced programs at the validation parameters; the value is a `ReducedPrograms`."""

    label = "assembly"

    enrichment: EnrichmentStage
    interpolation: float | None
    validation: ParameterSet

    @property
    def reduction(self) -> HyperReduction | None:
        """The offline stage of reduced assembly; `None` for full assembly."""
        if self.interpolation is None:
            return None
        pod = self.enrichment.pod
        return HyperReduction(self.enrichment, AffineDecomposition(pod.problem, self.interpolation, pod.training))

    @property
    def nested(self) -> NestedPrograms | None:
        """The stage of the fully assembled programs of a nested strategy; `None` for any other."""
        growth = self.enrichment.growth
        return None if growth is None else NestedPrograms(growth, self.validation)

    @property
    def model_inputs(self) -> tuple[Stage, ...]:
        """The stages whose artefacts `model` reads."""
        reduction = self.reduction
        return self.enrichment.model_inputs + (() if reduction is None else (reduction,))

    def inputs(self) -> tuple[Stage, ...]:
        """The model, and the programs in full that are known."""
        nested = self.nested
        return (*self.model_inputs, *(() if nested is None else (nested,)))

    def run(self, store: Store) -> Result:
        """Assemble at every parameter; compare reduced programs with full ones."""
        model, _ = self.model(store)
        mus = self.validation.of(model.problem)
        larger = None if self.nested is None else value_of(store, self.nested)
        if isinstance(model, HyperReducedModel):
            return Result(_reduced(model, mus, larger))
        return Result(_in_full(model, mus, larger))

    def offline(self, store: Store) -> Reduction:
        """The offline phase of the model that queries use, with all its steps."""
        if self.reduction is None:
            return self.enrichment.reduction(store)
        return self.enrichment.reduction(store, self.interpolation).given(operators=value_of(store, self.reduction))

    def model(self, store: Store) -> tuple[AnyReducedModel, str]:
        """The model that queries use, and why requested reduced assembly was replaced by full assembly, or ""."""
        reduction = self.offline(store)
        why = "" if self.reduction is None or not isinstance(reduction.operators, str) else reduction.operators
        return reduction.assembled, f"assembled in full: {why}" if why else ""

    def columns(self, store: Store) -> dict[str, float | int | None]:
        """Columns of a cell: tolerance, training error and terms of every member; none for assembly in full."""
        if self.reduction is None:
            return {}
        members: Mapping[str, AffineMember] = value_of(store, self.reduction.decomposition)
        summed = {name: member for name, member in members.items() if member.terms}
        return {
            "interpolation_tol": self.interpolation,
            "interpolation_error": max((member.error for member in summed.values()), default=0.0),
            **{f"terms_{n}": 0 if m.way is Evaluation.CONSTANT else len(m.terms) for n, m in summed.items()},
        }


InFull = Sequence[VariationalInequality] | None
"""Fully assembled programs of a larger nested space, one per parameter, if they are known."""


def _reduced(model: HyperReducedModel, mus: Array, larger: InFull) -> ReducedPrograms:
    """The hyper-reduced assembly at every parameter, compared with the Galerkin projection."""
    matrices = assemblies(model.problem)
    programs, errors, projected, factor = [], [], [], None
    for k, mu in enumerate(mus):
        reduced = model.assemble(mu)
        program, factor = reduced.program, reduced.factor
        full = leading_part(larger[k], len(program.f)) if larger else None
        full = full or project(matrices.at(mu), reduced.basis, model.generators)
        errors.append(_largest_difference(program, full))
        projected.append(exact_solution(full))
        programs.append(program)
    return ReducedPrograms(tuple(programs), factor, tuple(errors), tuple(projected))


def _in_full(model: ReducedModel, mus: Array, larger: InFull) -> ReducedPrograms:
    """The projection of the high-fidelity matrices at every parameter."""
    size = model.fixed_basis.shape[1]
    programs = [leading_part(p, size) for p in larger] if larger else _projections(model, mus)
    return ReducedPrograms(tuple(programs), None, (0.0,) * len(mus))


def _projections(model: ReducedModel, mus: Array) -> list[VariationalInequality]:
    """The Galerkin projections at every parameter; constant members are projected once on a fixed basis."""
    matrices, problem = assemblies(model.problem), model.problem
    if model.kind is Kind.PER_PARAMETER:
        bases = model.primal_bases(map(matrices.at, mus))
        return [project(matrices.at(mu), Z, model.generators) for mu, Z in zip(mus, bases, strict=True)]
    Z, chi, programs = model.fixed_basis, model.generators, list[VariationalInequality]()
    for mu in mus:
        known = {name: getattr(programs[0], name) for name in problem.constant if programs}
        programs.append(project(matrices.at(mu), Z, chi, known))
    return programs


def _largest_difference(program: VariationalInequality, exact: VariationalInequality) -> float:
    pairs = [(getattr(program, name), getattr(exact, name)) for name in MEMBERS]
    return max(float(np.linalg.norm(one - other)) / (float(np.linalg.norm(other)) or 1.0) for one, other in pairs)


@dataclass(frozen=True)
class ExactSolutions(Stage):
    """The reduced programs solved to round-off, for any QP solver and accuracy; not timed."""

    label = "exact reduced solutions"

    assembly: AssemblyStage

    def run(self, store: Store) -> Result:
        """One `ExactSolution` per validation parameter, or `None`."""
        return Result(tuple(exact_solution(program) for program in value_of(store, self.assembly).programs))


def assembly_stage(cell: Cell) -> AssemblyStage:
    """The stage that assembles the reduced programs of a cell."""
    return AssemblyStage(enrichment_stage(cell), cell.interpolation, cell.validation)
