"""The stages of the enrichment, the last part of the offline phase, and the reduced model that they complete."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import FunctionType
from typing import cast

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.strategies import Enrichment, Kind, Offline, PrimalStrategy
from vibench.interfaces.validation import check_enrichment
from vibench.offline.reduction import Reduction
from vibench.plugins.plugin import Plugin
from vibench.reduction.nested import Grown, Milestone, grow_through
from vibench.reduction.supremizers import ConstraintClasses, projected_supremizers
from vibench.stability.infsup import ProjectedSupremizers
from vibench.stages.artefacts import History, Store, storable
from vibench.stages.base import Result, Stage, build_problem, faults_of, value_of
from vibench.stages.offline import ConeStage, PODStage, ReducedCone, TrainingConstants
from vibench.stages.snapshots import parameters_in
from vibench.study.cells import Axes, Cell
from vibench.timing import Seconds, timed

storable(Kind, Grown, Milestone)


@storable
@dataclass(frozen=True)
class BuiltEnrichment:
    """An `Enrichment` as it is stored: `supply` is the name of a function in the module of its strategy, or ""."""

    kind: Kind
    vectors: Array | None
    eta: Array | None
    supply: str
    history: Mapping[str, Array]
    fallbacks: tuple[str, ...]

    @classmethod
    def of(cls, enrichment: Enrichment, strategy: PrimalStrategy) -> BuiltEnrichment:
        """The enrichment that a strategy has built; a supply must be a function in the module of the strategy."""
        name = "" if enrichment.supply is None else getattr(enrichment.supply, "__name__", "")
        if enrichment.supply is not None and _functions(strategy).get(name) is not enrichment.supply:
            raise NumericalError(f"the supply of the enrichment is not a function in {type(strategy).__module__}")
        return cls(enrichment.kind, enrichment.vectors, enrichment.eta, name, enrichment.history, enrichment.fallbacks)

    def restored(self, strategy: PrimalStrategy) -> Enrichment:
        """The enrichment of a strategy, whose module has the supply."""
        supply = _functions(strategy)[self.supply] if self.supply else None
        return Enrichment(self.kind, self.vectors, self.eta, supply, self.history, self.fallbacks)


def _functions(strategy: PrimalStrategy) -> dict[str, FunctionType]:
    module = vars(sys.modules[type(strategy).__module__])
    return {name: value for name, value in module.items() if isinstance(value, FunctionType)}


@storable
@dataclass(frozen=True)
class AssessedGrowth:
    """A nested enrichment and its inf-sup constants on the training set."""

    grown: Grown
    # `steps`, `ratios`: the smallest β_span, and the smallest ratio of β_span to that of V, after every vector (S+1,).
    steps: Array
    ratios: Array
    training: Mapping[float, Array]  # β_span at every training parameter (P,), by tolerance


@dataclass(frozen=True)
class GrowthStage(Stage):
    """A nested primal strategy, run once through all its tolerances; its seconds are recorded per tolerance."""

    label = "nested enrichment"

    pod: PODStage
    cone: ConeStage
    primal: Plugin
    tolerances: tuple[float, ...]

    def inputs(self) -> tuple[Stage, ...]:
        return (self.pod, self.cone, self.cone.constraints, TrainingConstants(self.cone))

    def run(self, store: Store) -> Result:
        """An `AssessedGrowth`."""
        offline = _offline(store, self.pod, self.cone)
        with faults_of(self.primal):
            grown = grow_through(self.primal.create(), replace(offline), self.tolerances)
        projected = _projected(offline, grown.vectors, value_of(store, self.cone.constraints))
        size = offline.basis.shape[1]
        training = {tolerance: projected.first(size + m.count).beta_span() for tolerance, m in grown.milestones.items()}
        ratios = projected.stability_ratios(size, value_of(store, TrainingConstants(self.cone)))
        return Result(AssessedGrowth(grown, projected.over_steps(size), ratios, training))

    def measure(self, store: Store) -> Mapping[str, Seconds]:
        grown = grow_through(self.primal.create(), _offline(store, self.pod, self.cone), self.tolerances)
        return {f"{tolerance!r}": milestone.seconds for tolerance, milestone in grown.milestones.items()}

    def reduction(self, store: Store) -> Reduction:
        """The offline phase with all vectors."""
        growth: AssessedGrowth = value_of(store, self)
        vectors = Enrichment(Kind.FIXED, vectors=growth.grown.vectors)
        return _reduction(store, self.pod, self.cone).given(enrichment=vectors)


@dataclass(frozen=True)
class EnrichmentStage(Stage):
    """The primal strategy, offline, at one tolerance; it completes a reduced model."""

    label = "enrichment"

    pod: PODStage
    cone: ConeStage
    primal: Plugin
    tolerance: float | None

    @property
    def axes(self) -> Axes:
        stops = self.pod.stop, self.cone.stop
        return Axes(self.pod.problem, self.cone.dual, self.primal, *stops, self.tolerance, self.pod.training)

    @property
    def growth(self) -> GrowthStage | None:
        """The stage that holds the vectors of all tolerances of a nested strategy; `None` for any other."""
        return None

    @property
    def model_inputs(self) -> tuple[Stage, ...]:
        """The stages whose artefacts `reduction` reads."""
        return (self.pod, self.cone, self)

    @abstractmethod
    def enrichment(self, store: Store) -> Enrichment:
        """The enrichment, once the stage has been run."""

    def reduction(self, store: Store) -> Reduction:
        """The offline phase up to the enrichment, once the stage has been run."""
        return _reduction(store, self.pod, self.cone).given(enrichment=self.enrichment(store))


@dataclass(frozen=True)
class SingleEnrichment(EnrichmentStage):
    """An enrichment built for its tolerance alone; the value is a `BuiltEnrichment`."""

    def inputs(self) -> tuple[Stage, ...]:
        return (self.pod, self.cone, self.cone.constraints, TrainingConstants(self.cone))

    def run(self, store: Store) -> Result:
        offline, strategy = _offline(store, self.pod, self.cone), self.primal.create()
        with faults_of(self.primal):
            given = replace(offline)
            enrichment, seconds = timed(lambda: strategy.build(given, self.tolerance))
            enrichment = check_enrichment(enrichment, offline.problem.V, offline.basis)
        quantities = dict(enrichment.history)
        # The assessment on the training set is not timed.
        if enrichment.vectors is not None:
            projected = _projected(offline, enrichment.vectors, value_of(store, self.cone.constraints))
            size, reachable = offline.basis.shape[1], value_of(store, TrainingConstants(self.cone))
            quantities |= {"beta_span_min": projected.over_steps(size)}
            quantities |= {"share_min": projected.stability_ratios(size, reachable)}
            quantities |= {"beta_span_training": projected.beta_span(), "beta_full_span_training": reachable}
        return Result(BuiltEnrichment.of(enrichment, strategy), seconds, _histories(quantities))

    def enrichment(self, store: Store) -> Enrichment:
        return cast("BuiltEnrichment", value_of(store, self)).restored(self.primal.create())


@dataclass(frozen=True)
class NestedEnrichment(EnrichmentStage):
    """The leading vectors of a `GrowthStage`; the value is the `Milestone` of the tolerance."""

    tolerances: tuple[float, ...]

    @property
    def growth(self) -> GrowthStage:
        return GrowthStage(self.pod, self.cone, self.primal, self.tolerances)

    @property
    def measured_by(self) -> tuple[Stage, str]:
        return self.growth, f"{self.tolerance!r}"

    @property
    def model_inputs(self) -> tuple[Stage, ...]:
        return (*super().model_inputs, self.growth)

    def inputs(self) -> tuple[Stage, ...]:
        return (self.pod, self.cone, self.growth, TrainingConstants(self.cone))

    def run(self, store: Store) -> Result:
        assert self.tolerance is not None  # a nested strategy always has one
        offline, growth = _offline(store, self.pod, self.cone), value_of(store, self.growth)
        milestone: Milestone = growth.grown.milestone(self.tolerance)
        with faults_of(self.primal):
            check_enrichment(growth.grown.at(milestone), offline.problem.V, offline.basis)
        quantities = dict(milestone.history) | {
            "beta_span_min": growth.steps[: milestone.count + 1],
            "share_min": growth.ratios[: milestone.count + 1],
            "beta_span_training": growth.training[self.tolerance],
            "beta_full_span_training": value_of(store, TrainingConstants(self.cone)),
        }
        return Result(milestone, milestone.seconds, _histories(quantities))

    def enrichment(self, store: Store) -> Enrichment:
        return cast("AssessedGrowth", value_of(store, self.growth)).grown.at(value_of(store, self))


def spaces_of(cell: Cell) -> tuple[PODStage | None, ConeStage | None, EnrichmentStage | None]:
    """The stages of V_N, cone and enrichment of a cell; `None` where its formulation has no such axis."""
    pod = cone = None
    if cell.pod is not None:
        pod = PODStage(cell.problem, cell.pod, cell.training)
    if cell.dual is not None and cell.cone is not None:
        cone = ConeStage(cell.problem, cell.dual, cell.cone, cell.training)
    if pod is None or cone is None or cell.primal is None:
        return pod, cone, None
    if cell.nested_tolerances:
        return pod, cone, NestedEnrichment(pod, cone, cell.primal, cell.primal_tol, cell.nested_tolerances)
    return pod, cone, SingleEnrichment(pod, cone, cell.primal, cell.primal_tol)


def _histories(quantities: Mapping[str, Array]) -> tuple[History, ...]:
    return tuple(History.of("enrichment", quantity, values) for quantity, values in quantities.items())


def _reduction(store: Store, pod: PODStage, cone: ConeStage) -> Reduction:
    """The offline phase up to V_N and the cone, which are stored."""
    reduced: ReducedCone = value_of(store, cone)
    reduction = Reduction(
        build_problem(pod.problem), cone.dual.create(), None, pod.stop, cone.stop, training=pod.training.strategy(),
        on_failure="skip" if pod.training.skips else "stop",
    )  # fmt: skip
    return reduction.given(pod=value_of(store, pod), cone=reduced.cone, multipliers=reduced.prepared)


def _offline(store: Store, pod: PODStage, cone: ConeStage) -> Offline:
    return _reduction(store, pod, cone).given(parameters=parameters_in(store, pod.problem, pod.training)).offline


def _projected(offline: Offline, vectors: Array, classes: ConstraintClasses) -> ProjectedSupremizers:
    """ZᵀBᵀη of V_N and vectors (n×S) for every class of the training set, η orthonormal in span χ."""
    Z = np.hstack([offline.basis, vectors])
    return ProjectedSupremizers([projected_supremizers(Z, B, offline.span) for B in classes.representatives], classes)
