"""The offline stages: POD and cone ▸ enrichment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.strategies import Cone, Enrichment, Kind, Offline, Stop
from vibench.interfaces.validation import check_cone, check_enrichment, training_parameters
from vibench.model.galerkin import ReducedModel
from vibench.reduction.cones import orthogonality
from vibench.reduction.nested import Grown, grow_through
from vibench.reduction.pod import POD, pod
from vibench.reduction.supremizers import (
    ConstraintClasses,
    constraint_classes,
    projected_supremizers,
    supremizer_images,
)
from vibench.stability.growth import ProjectedSupremizers
from vibench.stability.infsup import Multipliers, beta_span, multipliers
from vibench.stages.artefacts import History, Store
from vibench.stages.base import Result, Stage, build_problem, value_of
from vibench.stages.snapshots import gather, training
from vibench.study.cells import Cell, Plugin
from vibench.timing import Stopwatch, timed


@dataclass(frozen=True)
class PODStage(Stage):
    """POD of the training displacements."""

    problem: Plugin
    stop: Stop

    def inputs(self) -> tuple[Stage, ...]:
        """The training sweep."""
        return training(self.problem)

    def run(self, store: Store) -> Result:
        """Compress; the history is the relative tail over the number of modes."""
        snapshots = gather(store, self.inputs()).u
        found, seconds = timed(lambda: pod(snapshots, build_problem(self.problem).V, self.stop))
        return Result(found, seconds, (History({"stage": "pod"}, "error", tuple(found.errors)),))


@dataclass(frozen=True)
class ReducedCone:
    """A cone, what every constant and enrichment computed from it shares, and the condition of its Gram matrix."""

    cone: Cone
    prepared: Multipliers
    gram_condition: float | None


@dataclass(frozen=True)
class ConeStage(Stage):
    """The dual strategy on the training multipliers."""

    problem: Plugin
    dual: Plugin
    stop: Stop

    @property
    def constraints(self) -> TrainingConstraints:
        """The stage that knows the constraint matrices of the training set, for what is computed on the cone."""
        return TrainingConstraints(self.problem)

    def inputs(self) -> tuple[Stage, ...]:
        """The training sweep."""
        return training(self.problem)

    def run(self, store: Store) -> Result:
        """Reduce; histories are the projection error and e_orth over the number of generators."""
        snapshots, W = gather(store, self.inputs()).lam, build_problem(self.problem).W
        strategy = self.dual.create()
        watch = Stopwatch()
        cone = strategy.reduce(snapshots, W, self.stop)
        spent = watch.seconds()
        check_cone(cone, W)
        watch = Stopwatch()
        prepared = multipliers(cone.generators, W, cone.free)
        seconds = spent + watch.seconds()
        found = ReducedCone(cone, prepared, float(np.linalg.cond(prepared.gram)) if cone.size else None)
        key = {"stage": "cone"}
        return Result(
            found,
            seconds,
            (
                History(key, "error", tuple(cone.errors)),
                History(key, "e_orth", tuple(orthogonality(cone.generators, W, cone.free))),
            ),
        )


@dataclass(frozen=True)
class TrainingConstraints(Stage):
    """The constraint matrices of the training set, sorted into classes; for what is assessed, not timed."""

    problem: Plugin

    def inputs(self) -> tuple[Stage, ...]:
        """Nothing comes before."""
        return ()

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """The `ConstraintClasses`."""
        problem = build_problem(self.problem)
        return Result(constraint_classes([problem.constraint(mu)[0] for mu in training_parameters(problem)]))


@dataclass(frozen=True)
class TrainingConstants(Stage):
    """What no enrichment of V_N can surpass on the training set; assessed, not timed."""

    cone: ConeStage

    def inputs(self) -> tuple[Stage, ...]:
        """The cone and the constraint matrices."""
        return (self.cone, self.cone.constraints)

    def run(self, store: Store) -> Result:
        """β_span of the whole of V with the cone at every parameter (P,)."""
        span, classes = value_of(store, self.cone).prepared.span, value_of(store, self.cone.constraints)
        image = supremizer_images(build_problem(self.cone.problem).V, classes.representatives, span.shape[1])
        return Result(classes.everywhere([beta_span(image(B, span)) for B in classes.representatives]))


@dataclass(frozen=True)
class AssessedGrowth:
    """A growth, and what it reaches on the training set.

    Attributes
    ----------
    grown
        The vectors and where they passed the tolerances.
    steps
        The smallest β_span after every vector (S+1,).
    training
        β_span at every parameter (P,) by the tolerance that was reached.
    """

    grown: Grown
    steps: Array
    training: Mapping[float, Array]


@dataclass(frozen=True)
class GrowthStage(Stage):
    """A nested primal strategy, grown once through all its tolerances."""

    pod: PODStage
    cone: ConeStage
    primal: Plugin
    tolerances: tuple[float, ...]

    def inputs(self) -> tuple[Stage, ...]:
        """POD, cone and the constraint matrices."""
        return (self.pod, self.cone, self.cone.constraints)

    def run(self, store: Store) -> Result:
        """An `AssessedGrowth`; its seconds are counted where its tolerances are."""
        offline = _offline(store, self.pod, self.cone)
        grown = grow_through(self.primal.create(), offline, self.tolerances)
        images, size = _images(offline, grown.vectors, value_of(store, self.cone.constraints)), offline.basis.shape[1]
        training = {tolerance: images.first(size + m.count).beta_span() for tolerance, m in grown.milestones.items()}
        return Result(AssessedGrowth(grown, images.over_steps(size), training))


@dataclass(frozen=True)
class EnrichmentStage(Stage):
    """The primal strategy, offline; `along` are the tolerances that a nested one is grown through."""

    pod: PODStage
    cone: ConeStage
    primal: Plugin
    tolerance: float | None
    along: tuple[float, ...] = ()

    @property
    def growth(self) -> GrowthStage | None:
        """The stage that builds it beside those of other tolerances."""
        return GrowthStage(self.pod, self.cone, self.primal, self.along) if self.along else None

    @property
    def reached(self) -> TrainingConstants:
        """The stage that knows what the whole of V reaches on the training set."""
        return TrainingConstants(self.cone)

    def inputs(self) -> tuple[Stage, ...]:
        """POD, cone and what is to be reached; the training parameters come from the problem."""
        known = (self.pod, self.cone, self.reached, self.cone.constraints)
        return known if self.growth is None else (*known, self.growth)

    def run(self, store: Store) -> Result:
        """Build the enrichment, which `enrichment_of` gives; what it reaches on the training set is not timed."""
        offline = _offline(store, self.pod, self.cone)
        if self.growth is not None:
            assert self.tolerance is not None  # a nested strategy is given one
            growth: AssessedGrowth = value_of(store, self.growth)
            enrichment, seconds = growth.grown.at(self.tolerance)
            reached = {"beta_span_min": growth.steps[: growth.grown.milestones[self.tolerance].count + 1]}
            reached |= {"beta_span_training": growth.training[self.tolerance]}
            check_enrichment(enrichment, offline.problem.V, offline.basis)
        else:
            strategy = self.primal.create()
            enrichment, seconds = timed(lambda: strategy.build(offline, self.tolerance))
            check_enrichment(enrichment, offline.problem.V, offline.basis)
            reached = {}
            if enrichment.vectors is not None:
                images = _images(offline, enrichment.vectors, value_of(store, self.cone.constraints))
                reached = {"beta_span_min": images.over_steps(offline.basis.shape[1])}
                reached |= {"beta_span_training": images.beta_span()}
        if reached:
            reached |= {"beta_full_span_training": value_of(store, self.reached)}
        found = (dict(enrichment.history) | reached).items()
        histories = (History({"stage": "enrichment"}, quantity, tuple(values)) for quantity, values in found)
        return Result(enrichment if self.growth is None else None, seconds, tuple(histories))


def _offline(store: Store, pod: PODStage, cone: ConeStage) -> Offline:
    """What a primal strategy builds on."""
    problem, basis = build_problem(pod.problem), value_of(store, pod).basis
    reduced: ReducedCone = value_of(store, cone)
    return Offline(problem, basis, reduced.cone, reduced.prepared.span, training_parameters(problem))


def _images(offline: Offline, vectors: Array, classes: ConstraintClasses) -> ProjectedSupremizers:
    """ZᵀBᵀη of V_N and vectors (n×S) for every class of the training set, η orthonormal in span χ."""
    Z = np.hstack([offline.basis, vectors])
    return ProjectedSupremizers([projected_supremizers(Z, B, offline.span) for B in classes.representatives], classes)


def enrichment_of(store: Store, stage: EnrichmentStage) -> Enrichment:
    """The enrichment of a stage that has been run; the beginning of a growth is stored with the growth alone."""
    if stage.growth is None:
        found: Enrichment = value_of(store, stage)
        return found
    assert stage.tolerance is not None  # a nested strategy is given one
    growth: AssessedGrowth = value_of(store, stage.growth)
    return growth.grown.at(stage.tolerance)[0]


def enrichment_stage(cell: Cell) -> EnrichmentStage:
    """The stage that completes the reduced model of a cell."""
    cone = ConeStage(cell.problem, cell.dual, cell.cone)
    return EnrichmentStage(PODStage(cell.problem, cell.pod), cone, cell.primal, cell.primal_tol, cell.along)


def reduced_model(store: Store, stage: EnrichmentStage) -> tuple[ReducedModel, Array, Multipliers]:
    """The reduced model of an enrichment, the basis of V_N it extends and the prepared multipliers."""
    basis: POD = value_of(store, stage.pod)
    model = _model(store, stage.pod, stage.cone, enrichment_of(store, stage))
    return model, basis.basis, value_of(store, stage.cone).prepared


def grown_model(store: Store, stage: GrowthStage) -> ReducedModel:
    """The reduced model with everything that was grown."""
    growth: AssessedGrowth = value_of(store, stage)
    return _model(store, stage.pod, stage.cone, Enrichment(Kind.FIXED, vectors=growth.grown.vectors))


def _model(store: Store, pod: PODStage, cone: ConeStage, enrichment: Enrichment) -> ReducedModel:
    basis, reduced = value_of(store, pod).basis, value_of(store, cone)
    return ReducedModel(build_problem(pod.problem), basis, enrichment, reduced.cone.rays, reduced.prepared.span)
