"""The stages that compute inf-sup constants at the validation parameters; many cells share each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.galerkin import ReducedModel
from vibench.offline.assemblies import assemblies
from vibench.reduction.supremizers import ConstraintClasses
from vibench.stability.coercivity import Constant, Stability
from vibench.stability.infsup import (
    InfSup,
    Multipliers,
    constants_full,
    constants_on,
    everywhere,
    inf_sup,
    nodal_multipliers,
)
from vibench.stages.base import Result, Stage, build_problem, value_of
from vibench.stages.enrichment import EnrichmentStage
from vibench.stages.offline import ConeStage, ConstraintMatrices, PODStage
from vibench.storage.artefacts import Store
from vibench.storage.serialisation import storable

for _kind in (ConstraintClasses, Stability, Constant, InfSup):
    storable(_kind)


@dataclass(frozen=True)
class ReferenceConstants(Stage):
    """Constants of the high-fidelity problem: β_HF, α, γ_a and β_A; a `Stability` per parameter."""

    label = "high-fidelity constants"

    constraints: ConstraintMatrices

    def run(self, store: Store) -> Result:
        """Compute the constants."""
        problem = build_problem(self.constraints.problem)
        inf_sup = constants_full(problem.V, value_of(store, self.constraints), nodal_multipliers(problem.W))
        mus, kept = self.constraints.parameters.of(problem), assemblies(problem)
        different = mus[:1] if {"A", "B"} <= problem.constant else mus
        # of one parameter together, as long as its factorisation is there
        others = [(kept.coercivity_at(mu), kept.continuity_at(mu), kept.energy_inf_sup_at(mu)) for mu in different]
        others *= len(mus) // len(different)
        return Result([Stability(hf, *constants) for hf, constants in zip(inf_sup, others, strict=True)])


@dataclass(frozen=True)
class InfSupConstants(Stage):
    """Inf-sup constants of a primal space with a reduced cone: an `InfSup` per validation parameter.

    The space is that of a reduced model, V_N alone, or, with `None`, the whole of V, whose constants online supremizers
    attain.
    """

    label = "inf-sup constants"

    space: EnrichmentStage | PODStage | None
    cone: ConeStage
    constraints: ConstraintMatrices

    @property
    def sort(self) -> str:
        """The constants of a larger space take longer."""
        return f"{self.label} of {'V' if self.space is None else self.space.label}"

    def inputs(self) -> tuple[Stage, ...]:
        """The space, the cone and the constraint matrices."""
        spaces = self.space.model_inputs if isinstance(self.space, EnrichmentStage) else (self.space, self.cone)
        return (*(stage for stage in spaces if stage is not None), self.constraints)

    def run(self, store: Store) -> Result:
        """Compute the constants."""
        classes: ConstraintClasses = value_of(store, self.constraints)
        cone: Multipliers = value_of(store, self.cone).prepared
        if self.space is None:
            return Result(constants_full(build_problem(self.cone.problem).V, classes, cone))
        if isinstance(self.space, PODStage):
            return Result(constants_on(value_of(store, self.space).basis, classes, cone))
        model = self.space.reduction(store).projection
        if model.kind is not Kind.PER_PARAMETER:
            return Result(constants_on(model.fixed_basis, classes, cone))
        mus, kept = self.constraints.parameters.of(model.problem), assemblies(model.problem)
        if model.enrichment.eta is None:
            return Result([_constants_at(model, kept.at(mu), cone) for mu in mus])
        at_firsts = (kept.at(mu) for mu in mus[classes.firsts])  # a class shares one space
        return Result(everywhere(classes, [_constants_at(model, vi, cone) for vi in at_firsts]))


def _constants_at(model: ReducedModel, vi: VariationalInequality, cone: Multipliers) -> InfSup:
    projected = model.project_supremizers(vi, np.hstack([cone.span, cone.chi]))
    return inf_sup(projected[:, : cone.rank], projected[:, cone.rank :], cone)
