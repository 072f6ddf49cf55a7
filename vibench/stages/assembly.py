"""Assembly of the reduced programs of the queries, in full or hyper-reduced, and their exact solutions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.dual_sets import BlockKind, Blocks, DualSet
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.affine import AffineMember, Evaluation
from vibench.model.galerkin import ReducedModel, leading_part, project
from vibench.model.hyperreduced import HyperReducedModel
from vibench.offline.assemblies import assemblies
from vibench.qp.exact import ExactSolution, exact_solution
from vibench.stages.artefacts import Store, storable
from vibench.stages.base import Result, Stage, value_of
from vibench.stages.enrichment import GrowthStage
from vibench.stages.formulation import FormulationStage
from vibench.study.parameter_sets import ParameterSet

storable(VariationalInequality, DualSet, Blocks, BlockKind, ExactSolution)


@dataclass(frozen=True)
class NestedPrograms(Stage):
    """Reduced programs, in full, with all vectors of a nested strategy; its tolerances take their leading parts."""

    label = "nested programs"

    growth: GrowthStage
    validation: ParameterSet

    def inputs(self) -> tuple[Stage, ...]:
        return (self.growth.pod, self.growth.cone, self.growth)

    def run(self, store: Store) -> Result:
        model = self.growth.reduction(store).projection
        return Result(tuple(_projections(model, self.validation.of(model.problem))))


@storable
@dataclass(frozen=True)
class ReducedPrograms:
    """Reduced programs at the validation parameters, for any QP solver."""

    programs: tuple[VariationalInequality, ...]
    factor: Array | None  # Cholesky factor (lower) of A, where A is constant and the programs are solved in dual form
    # Largest relative difference of a member of each program from its Galerkin projection; zero for full assembly.
    errors: tuple[float, ...]
    # The Galerkin projections solved to round-off, or `None` where that fails; empty for full assembly.
    projected: tuple[ExactSolution | None, ...] = ()
    # Number of vectors of programs that are the leading parts of nested ones: they are not stored twice.
    size: int | None = None


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
        return (*self.built.model_inputs, *(() if self.nested is None else (self.nested,)))

    def run(self, store: Store) -> Result:
        model = self.built.model(store)
        reduced, mus = model.reduced, self.validation.of(model.problem)
        # Nested programs are those of all vectors of the offline phase: a formulation may use other spaces.
        is_own = self.nested is not None and reduced is model.offline.assembled
        larger = value_of(store, self.nested) if self.nested is not None and is_own else None
        if isinstance(reduced, HyperReducedModel):
            return Result(_reduced(reduced, mus, larger))
        if larger is not None:
            return Result(ReducedPrograms((), None, (0.0,) * len(mus), size=reduced.fixed_basis.shape[1]))
        return Result(ReducedPrograms(tuple(_projections(reduced, mus)), None, (0.0,) * len(mus)))

    @property
    def stored_in(self) -> tuple[Stage, ...]:
        """The stages whose artefacts `programs` reads."""
        return (self,) if self.nested is None else (self, self.nested)

    def programs(self, store: Store) -> ReducedPrograms:
        """The value with its programs, once the stages in `stored_in` have been run."""
        stored: ReducedPrograms = value_of(store, self)
        if (size := stored.size) is None or self.nested is None:
            return stored
        return replace(stored, programs=tuple(leading_part(one, size) for one in value_of(store, self.nested)))

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


def _reduced(model: HyperReducedModel, mus: Array, larger: Sequence[VariationalInequality] | None) -> ReducedPrograms:
    """The hyper-reduced programs, compared with Galerkin projections: the leading parts of `larger` ones if known."""
    matrices = assemblies(model.problem)
    programs, errors, projected, factor = [], [], [], None
    for k, mu in enumerate(mus):
        reduced = model.assemble(mu)
        program, factor = reduced.program, reduced.factor
        full = leading_part(larger[k], len(program.f)) if larger else None
        full = full or project(matrices.at(mu), reduced.basis, model.generators)
        pairs = [(getattr(program, name), getattr(full, name)) for name in MEMBERS]
        relative = (np.linalg.norm(one - exact) / (np.linalg.norm(exact) or 1.0) for one, exact in pairs)
        errors.append(float(max(relative)))
        projected.append(exact_solution(full))
        programs.append(program)
    return ReducedPrograms(tuple(programs), factor, tuple(errors), tuple(projected))


def _projections(model: ReducedModel, mus: Array) -> list[VariationalInequality]:
    matrices, problem = assemblies(model.problem), model.problem
    if model.kind is Kind.PER_PARAMETER:
        bases = model.primal_bases(map(matrices.at, mus))
        return [project(matrices.at(mu), Z, model.generators) for mu, Z in zip(mus, bases, strict=True)]
    Z, chi, programs = model.fixed_basis, model.generators, list[VariationalInequality]()
    for mu in mus:
        # Constant members are projected once on a fixed basis.
        known = {name: getattr(programs[0], name) for name in problem.constant if programs}
        programs.append(project(matrices.at(mu), Z, chi, known))
    return programs


@dataclass(frozen=True)
class ExactSolutions(Stage):
    """The reduced programs solved to round-off, for any QP solver and accuracy; not timed."""

    label = "exact reduced solutions"

    assembly: AssemblyStage

    def inputs(self) -> tuple[Stage, ...]:
        return self.assembly.stored_in

    def run(self, store: Store) -> Result:
        """One `ExactSolution` per validation parameter, or `None`."""
        return Result(tuple(map(exact_solution, self.assembly.programs(store).programs)))
