"""Assembly of reduced programs, in full or hyper-reduced: its offline part, and the programs of the queries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.affine import AffineMember, Evaluation
from vibench.model.galerkin import ReducedModel, leading_part, project
from vibench.model.hyperreduced import HyperReducedModel
from vibench.offline.assemblies import assemblies
from vibench.qp.exact import ExactSolution, exact_solution
from vibench.stages.artefacts import Store
from vibench.stages.base import Result, Stage, value_of
from vibench.stages.enrichment import GrowthStage
from vibench.stages.formulation import FormulationStage
from vibench.stages.serialisation import storable
from vibench.study.parameter_sets import ParameterSet

for _kind in (VariationalInequality, ExactSolution):
    storable(_kind)


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
    """Assembly of the programs of a formulation at the validation parameters; the value is a `ReducedPrograms`."""

    label = "assembly"

    built: FormulationStage
    validation: ParameterSet

    @property
    def nested(self) -> NestedPrograms | None:
        """The stage of the fully assembled programs of a nested strategy; `None` for any other."""
        growth = None if self.built.enrichment is None else self.built.enrichment.growth
        return None if growth is None else NestedPrograms(growth, self.validation)

    def inputs(self) -> tuple[Stage, ...]:
        """The model, and the programs in full that are known."""
        return (*self.built.model_inputs, *(() if self.nested is None else (self.nested,)))

    def run(self, store: Store) -> Result:
        """Assemble at every parameter; compare reduced programs with full ones."""
        model = self.built.model(store)
        reduced, mus = model.reduced, self.validation.of(model.problem)
        # Nested programs are those of all vectors of the offline phase: a formulation may use other spaces.
        is_own = self.nested is not None and reduced is model.offline.assembled
        larger = value_of(store, self.nested) if self.nested is not None and is_own else None
        if isinstance(reduced, HyperReducedModel):
            return Result(_reduced(reduced, mus, larger))
        return Result(_in_full(reduced, mus, larger))

    def columns(self, store: Store) -> dict[str, float | int | None]:
        """Columns of a cell: tolerance, training error and terms of every member; none for assembly in full."""
        if self.built.decomposition is None:
            return {}
        members: Mapping[str, AffineMember] = value_of(store, self.built.decomposition)
        summed = {name: member for name, member in members.items() if member.terms}
        return {
            "interpolation_tol": self.built.interpolation,
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
