"""The stages that compute inf-sup constants at the validation parameters; each serves many cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench.arrays import SparseMatrix
from vibench.assess import constants_full, constants_on, everywhere
from vibench.infsup import InfSup, Multipliers, inf_sup
from vibench.problem import Problem, VariationalInequality, validation_parameters
from vibench.reduced import ReducedModel
from vibench.stage import Result, Stage, assemblies, build_problem, value_of
from vibench.stages import ConeStage, EnrichmentStage, PODStage, reduced_model
from vibench.store import Store
from vibench.strategy import Kind
from vibench.supremizer import constraint_classes


@dataclass(frozen=True)
class FullConstants(Stage):
    """Constants of the whole of V with a reduced cone, what online supremizers reach: an `InfSup` per parameter."""

    cone: ConeStage
    count: int
    seed: int

    def inputs(self) -> tuple[Stage, ...]:
        """The cone."""
        return (self.cone,)

    def run(self, store: Store) -> Result:
        """Compute the constants."""
        problem = build_problem(self.cone.problem)
        matrices = _constraints(problem, self.count, self.seed)
        return Result(constants_full(problem.V, matrices, value_of(store, self.cone).prepared))


@dataclass(frozen=True)
class PlainConstants(Stage):
    """Constants of V_N alone with a reduced cone: an `InfSup` per parameter."""

    pod: PODStage
    cone: ConeStage
    count: int
    seed: int

    def inputs(self) -> tuple[Stage, ...]:
        """The basis and the cone."""
        return (self.pod, self.cone)

    def run(self, store: Store) -> Result:
        """Compute the constants."""
        matrices = _constraints(build_problem(self.pod.problem), self.count, self.seed)
        return Result(constants_on(value_of(store, self.pod).basis, matrices, value_of(store, self.cone).prepared))


@dataclass(frozen=True)
class OwnConstants(Stage):
    """Constants of the pair of spaces that a reduced model works with: an `InfSup` per parameter."""

    enrichment: EnrichmentStage
    count: int
    seed: int

    def inputs(self) -> tuple[Stage, ...]:
        """The reduced model."""
        return (self.enrichment, *self.enrichment.inputs())

    def run(self, store: Store) -> Result:
        """Compute the constants."""
        model, _, cone = reduced_model(store, self.enrichment)
        mus = validation_parameters(model.problem, self.count, self.seed)
        matrices = [assemblies(model.problem).at(mu).B for mu in mus]
        if model.kind is not Kind.PER_PARAMETER:
            return Result(constants_on(model.fixed_basis, matrices, cone))
        if model.enrichment.eta is None:
            return Result([_constants_at(model, assemblies(model.problem).at(mu), cone) for mu in mus])
        classes = constraint_classes(matrices)  # supremizers of proportional matrices span the same space
        at_firsts = (assemblies(model.problem).at(mu) for mu in mus[classes.firsts])
        return Result(everywhere(classes, [_constants_at(model, vi, cone) for vi in at_firsts]))


def _constants_at(model: ReducedModel, vi: VariationalInequality, cone: Multipliers) -> InfSup:
    images = model.images(vi, np.hstack([cone.span, cone.chi]))
    return inf_sup(images[:, : cone.rank], images[:, cone.rank :], cone)


def _constraints(problem: Problem, count: int, seed: int) -> list[SparseMatrix]:
    return [assemblies(problem).at(mu).B for mu in validation_parameters(problem, count, seed)]
