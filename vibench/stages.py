"""The offline stages: POD and cone ▸ enrichment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.cone import orthogonality
from vibench.contracts import check_cone, check_enrichment
from vibench.greedy import LazyMaximum
from vibench.infsup import Multipliers, beta_span, multipliers
from vibench.matrix import Cell, Plugin
from vibench.nested import Grown, grow_through
from vibench.pod import POD, pod
from vibench.problem import training_parameters
from vibench.reduced import ReducedModel
from vibench.stage import Result, Stage, build_problem, value_of
from vibench.store import History, Store
from vibench.strategy import Cone, Enrichment, Kind, Offline, Stop
from vibench.supremizer import ConstraintClasses, constraint_classes, on_basis, supremizer_images
from vibench.sweeps import gather, training
from vibench.timing import Stopwatch, timed

GRAM_RTOL = 1e-8
"""Eigenvalues of a Gram matrix below this fraction of the largest have lost half of their digits to round-off."""


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
    """A cone with what every constant and every enrichment computed from it shares."""

    cone: Cone
    prepared: Multipliers


@dataclass(frozen=True)
class ConeStage(Stage):
    """The dual strategy on the training multipliers."""

    problem: Plugin
    dual: Plugin
    stop: Stop

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
        found = ReducedCone(cone, multipliers(cone.generators, W, cone.free))
        seconds = spent + watch.seconds()
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
class Reached:
    """The constraint matrices of the training set, and β_span of the whole of V with a cone at every parameter (P,)."""

    classes: ConstraintClasses
    full: Array


@dataclass(frozen=True)
class TrainingConstants(Stage):
    """What no enrichment of V_N can surpass on the training set; assessed, not timed."""

    cone: ConeStage

    def inputs(self) -> tuple[Stage, ...]:
        """The cone."""
        return (self.cone,)

    def run(self, store: Store) -> Result:
        """A `Reached`."""
        problem = build_problem(self.cone.problem)
        span = value_of(store, self.cone).prepared.span
        classes = constraint_classes([problem.constraint(mu)[0] for mu in training_parameters(problem)])
        image = supremizer_images(problem.V, classes.representatives, span.shape[1])
        found = np.array([beta_span(image(B, span)) for B in classes.representatives])
        return Result(Reached(classes, found[classes.members] * np.abs(classes.factors)))


@dataclass(frozen=True)
class GrowthStage(Stage):
    """A nested primal strategy, grown once through all its tolerances."""

    pod: PODStage
    cone: ConeStage
    primal: Plugin
    tolerances: tuple[float, ...]

    def inputs(self) -> tuple[Stage, ...]:
        """POD and cone."""
        return (self.pod, self.cone)

    def run(self, store: Store) -> Result:
        """A `Grown`; its seconds are counted where its tolerances are."""
        return Result(grow_through(self.primal.create(), _offline(store, self.pod, self.cone), self.tolerances))


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
        known = (self.pod, self.cone, self.reached)
        return known if self.growth is None else (*known, self.growth)

    def run(self, store: Store) -> Result:
        """Build the enrichment; what it reaches on the training set is assessed, not timed."""
        offline = _offline(store, self.pod, self.cone)
        if self.growth is not None and self.tolerance is not None:
            grown: Grown = value_of(store, self.growth)
            enrichment, seconds = grown.at(self.tolerance)
        else:
            strategy = self.primal.create()
            enrichment, seconds = timed(lambda: strategy.build(offline, self.tolerance))
        check_enrichment(enrichment, offline.problem.V, offline.basis)
        key = {"stage": "enrichment"}
        histories = [History(key, quantity, tuple(values)) for quantity, values in enrichment.history.items()]
        if enrichment.kind is Kind.FIXED:
            histories += _training_constants(key, offline, enrichment, value_of(store, self.reached))
        return Result(enrichment, seconds, tuple(histories))


def _offline(store: Store, pod: PODStage, cone: ConeStage) -> Offline:
    problem, basis = build_problem(pod.problem), value_of(store, pod).basis
    reduced: ReducedCone = value_of(store, cone)
    return Offline(problem, basis, reduced.cone, reduced.prepared.span, training_parameters(problem))


def _training_constants(
    key: dict[str, Any], offline: Offline, enrichment: Enrichment, reached: Reached
) -> list[History]:
    """Of a fixed enrichment: min over training mu of β_span after every vector; β_span of it and of V at every mu."""
    assert enrichment.vectors is not None  # a fixed enrichment has vectors
    classes, sizes = reached.classes, np.abs(reached.classes.factors)
    Z = np.hstack([offline.basis, enrichment.vectors])
    images = [on_basis(Z, B, offline.span) for B in classes.representatives]
    weights = [float(np.min(sizes[classes.members == k])) for k in range(len(images))]
    steps = _smallest_over_steps(images, weights, offline.basis.shape[1])
    own = np.array([beta_span(image) for image in images])[classes.members] * sizes
    return [
        History(key, "beta_span_min", tuple(steps)),
        History(key, "beta_span_training", tuple(own)),
        History(key, "beta_full_span_training", tuple(reached.full)),
    ]


def _smallest_over_steps(images: list[Array], weights: list[float], first: int) -> list[float]:
    """The smallest β_span of the first `first`, `first` + 1, … rows of images (k×rank), each times its weight.

    It only grows with the rows, so an earlier value bounds it from below and few are computed again. Squares come from
    Gram matrices that grow with the rows; where they would keep too few digits the rows themselves are asked.
    """
    grams, known = [np.zeros((image.shape[1],) * 2) for image in images], [0] * len(images)

    def negative(p: int, rows: int) -> float:
        image = images[p]
        if not image.shape[1] or rows < image.shape[1]:
            return -weights[p] * beta_span(image[:rows])
        new, known[p] = image[known[p] : rows], rows
        grams[p] = grams[p] + new.T @ new
        squares = np.linalg.eigvalsh(grams[p])
        sharp = squares[0] > GRAM_RTOL * squares[-1]
        return -weights[p] * (float(np.sqrt(squares[0])) if sharp else beta_span(image[:rows]))

    smallest = LazyMaximum(np.zeros(len(images)))
    last = images[0].shape[0]
    return [-smallest.next(partial(negative, rows=rows))[1] for rows in range(first, last + 1)]


def enrichment_stage(cell: Cell) -> EnrichmentStage:
    """The stage that completes the reduced model of a cell."""
    cone = ConeStage(cell.problem, cell.dual, cell.cone)
    return EnrichmentStage(PODStage(cell.problem, cell.pod), cone, cell.primal, cell.primal_tol, cell.along)


def reduced_model(store: Store, stage: EnrichmentStage) -> tuple[ReducedModel, Array, Multipliers]:
    """The reduced model of an enrichment, the basis of V_N it extends and the prepared multipliers."""
    basis: POD = value_of(store, stage.pod)
    reduced: ReducedCone = value_of(store, stage.cone)
    model = ReducedModel(
        build_problem(stage.pod.problem),
        basis.basis,
        value_of(store, stage),
        reduced.cone.rays,
        reduced.prepared.span,
    )
    return model, basis.basis, reduced.prepared
