"""The stages of inf-sup and other constants at the validation parameters; many cells share each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from vibench.errors import at_parameter
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.galerkin import ReducedModel
from vibench.offline.assemblies import assemblies
from vibench.plugins.plugin import Plugin
from vibench.reduction.supremizers import ConstraintClasses
from vibench.stability import infsup
from vibench.stability.coercivity import Constant, Stability
from vibench.stages.artefacts import Store, storable
from vibench.stages.base import Failed, Result, Stage, build_problem, value_of
from vibench.stages.enrichment import EnrichmentStage
from vibench.stages.offline import ConeStage, ConstraintMatrices, PODStage
from vibench.study.parameter_sets import CHUNKS, ParameterSet, chunk_edges, chunk_of, chunk_size

storable(ConstraintClasses, Stability, Constant, infsup.InfSup)


@dataclass(frozen=True)
class ReferenceInfSup(Stage):
    """β_HF of the high-fidelity pair: an `InfSup` per parameter."""

    label = "high-fidelity inf-sup constants"

    constraints: ConstraintMatrices

    def run(self, store: Store) -> Result:
        problem = build_problem(self.constraints.problem)
        return Result(infsup.constants_full(problem.V, value_of(store, self.constraints), infsup.nodal_cone(problem.W)))


@dataclass(frozen=True)
class EnergyConstants(Stage):
    """α, γ_a and β_A of the high-fidelity problem at one chunk of a parameter set: three `Constant` per parameter."""

    label = "high-fidelity constants"
    partial = True
    dispensable = True

    problem: Plugin
    parameters: ParameterSet
    chunk: int

    @property
    def effort(self) -> float:
        # The constants of one parameter take about as long as six high-fidelity solutions.
        return 6.0 * chunk_size(self.parameters.count, self.chunk)

    def run(self, store: Store) -> Result:
        problem, constants = build_problem(self.problem), []
        matrices, (_, mus) = assemblies(problem), chunk_of(self.parameters.of(problem), self.chunk)
        # All constants of one parameter together, as long as its factorisation is there.
        for mu in mus:
            with at_parameter(mu):
                found = matrices.coercivity_at(mu), matrices.continuity_at(mu), matrices.energy_inf_sup_at(mu)
            constants.append(found)
            store.progress(len(constants) / len(mus))
        return Result(constants)


@dataclass(frozen=True)
class ReferenceConstants:
    """All constants of the high-fidelity problem at the parameters of a set."""

    constraints: ConstraintMatrices

    @property
    def energy(self) -> tuple[EnergyConstants, ...]:
        """The stages of α, γ_a and β_A."""
        problem, parameters = self.constraints.problem, self.constraints.parameters
        return tuple(EnergyConstants(problem, parameters, chunk) for chunk in range(CHUNKS))

    @property
    def stages(self) -> tuple[Stage, ...]:
        return (ReferenceInfSup(self.constraints), *self.energy)

    def gather(self, store: Store) -> list[Stability | Failed]:
        """The constants at every parameter, or the failure of the chunk of the parameter."""
        inf_sup: list[infsup.InfSup] = value_of(store, ReferenceInfSup(self.constraints))
        constants: list[Stability | Failed] = []
        for chunk, (first, end) in zip(self.energy, pairwise(chunk_edges(len(inf_sup))), strict=True):
            if (failed := store.lost.get(chunk.key)) is not None:
                constants += [replace(failed, reason=f"in {chunk.label}: {failed.reason}")] * (end - first)
            else:
                pairs = zip(inf_sup[first:end], value_of(store, chunk), strict=True)
                constants += [Stability(hf, *of_A) for hf, of_A in pairs]
        return constants


@dataclass(frozen=True)
class InfSupConstants(Stage):
    """Inf-sup constants of a primal space with a reduced cone: an `InfSup` per validation parameter."""

    # The space is that of a reduced model, V_N alone, or, with `None`, the whole of V.

    label = "inf-sup constants"

    space: EnrichmentStage | PODStage | None
    cone: ConeStage
    constraints: ConstraintMatrices

    @property
    def kind_of_work(self) -> str:
        # The constants of a larger space take longer.
        return f"{self.label} of {'V' if self.space is None else self.space.label}"

    def inputs(self) -> tuple[Stage, ...]:
        spaces = self.space.model_inputs if isinstance(self.space, EnrichmentStage) else (self.space, self.cone)
        return (*(stage for stage in spaces if stage is not None), self.constraints)

    def run(self, store: Store) -> Result:
        classes: ConstraintClasses = value_of(store, self.constraints)
        cone: infsup.ConeBasis = value_of(store, self.cone).prepared
        # No enrichment exceeds the constants of the whole of V, and online supremizers attain them.
        if self.space is None:
            return Result(infsup.constants_full(build_problem(self.cone.problem).V, classes, cone))
        if isinstance(self.space, PODStage):
            return Result(infsup.constants_on(value_of(store, self.space).basis, classes, cone))
        model = self.space.reduction(store).projection
        if model.kind is not Kind.PER_PARAMETER:
            return Result(infsup.constants_on(model.fixed_basis, classes, cone))
        mus, matrices = self.constraints.parameters.of(model.problem), assemblies(model.problem)
        if model.enrichment.eta is None:
            return Result([_constants_at(model, matrices.at(mu), cone) for mu in mus])
        # Parameters with proportional constraint matrices share one space: compute its constants once.
        at_firsts = (matrices.at(mu) for mu in mus[classes.firsts])
        return Result(infsup.expand_classes(classes, [_constants_at(model, vi, cone) for vi in at_firsts]))


def _constants_at(model: ReducedModel, vi: VariationalInequality, cone: infsup.ConeBasis) -> infsup.InfSup:
    projected = model.project_supremizers(vi, np.hstack([cone.span, cone.chi]))
    return infsup.inf_sup(projected[:, : cone.rank], projected[:, cone.rank :], cone)
