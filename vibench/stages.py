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
from vibench.infsup import Multipliers, beta_span, compressed, multipliers
from vibench.matrix import Cell, Plugin
from vibench.pod import POD, pod
from vibench.problem import training_parameters
from vibench.reduced import ReducedModel
from vibench.stage import Result, Stage, build_problem, value_of
from vibench.store import History, Store
from vibench.strategy import Cone, Enrichment, Kind, Offline, Stop
from vibench.supremizer import constraint_classes, supremizer_coordinates
from vibench.sweeps import gather, training
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
        found = ReducedCone(cone, multipliers(cone.generators, W))
        seconds = spent + watch.seconds()
        key = {"stage": "cone"}
        return Result(
            found,
            seconds,
            (
                History(key, "error", tuple(cone.errors)),
                History(key, "e_orth", tuple(orthogonality(cone.generators, W))),
            ),
        )


@dataclass(frozen=True)
class EnrichmentStage(Stage):
    """The primal strategy, offline."""

    pod: PODStage
    cone: ConeStage
    primal: Plugin
    tolerance: float | None

    def inputs(self) -> tuple[Stage, ...]:
        """POD and cone; the training parameters come from the problem."""
        return (self.pod, self.cone)

    def run(self, store: Store) -> Result:
        """Build the enrichment; what it reaches on the training set is assessed, not timed."""
        problem = build_problem(self.pod.problem)
        basis: POD = value_of(store, self.pod)
        reduced: ReducedCone = value_of(store, self.cone)
        offline = Offline(problem, basis.basis, reduced.cone, reduced.prepared.span, training_parameters(problem))
        strategy = self.primal.create()
        enrichment, seconds = timed(lambda: strategy.build(offline, self.tolerance))
        check_enrichment(enrichment, problem.V, basis.basis)
        key = {"stage": "enrichment"}
        histories = [History(key, quantity, tuple(values)) for quantity, values in enrichment.history.items()]
        if enrichment.kind is Kind.FIXED:
            histories += _training_constants(key, offline, enrichment, reduced.prepared)
        return Result(enrichment, seconds, tuple(histories))


def _training_constants(
    key: dict[str, Any], offline: Offline, enrichment: Enrichment, prepared: Multipliers
) -> list[History]:
    """Of a fixed enrichment: min over training mu of β_span after every vector; β_span of it and of V at every mu."""
    assert enrichment.vectors is not None  # a fixed enrichment has vectors
    V = offline.problem.V
    classes = constraint_classes([offline.problem.constraint(mu)[0] for mu in offline.training])
    sizes = np.abs(classes.factors)
    Z = np.hstack([offline.basis, enrichment.vectors])
    images = [Z.T @ np.asarray(B.T @ prepared.span) for B in classes.representatives]
    weights = [float(np.min(sizes[classes.members == k])) for k in range(len(images))]
    steps = _smallest_over_steps(images, weights, offline.basis.shape[1])
    _, supremizers = supremizer_coordinates(V, offline.basis, classes.representatives, prepared.span)
    own, full = (np.array([beta_span(image) for image in found])[classes.members] for found in (images, supremizers))
    return [
        History(key, "beta_span_min", tuple(steps)),
        History(key, "beta_span_training", tuple(own * sizes)),
        History(key, "beta_full_span_training", tuple(full * sizes)),
    ]


def _smallest_over_steps(images: list[Array], weights: list[float], first: int) -> list[float]:
    """The smallest β_span of the first `first`, `first` + 1, … rows of images (k×rank), each times its weight.

    It only grows with the rows, so an earlier value bounds it from below and few are computed again.
    """
    triangles, known = [image[:0] for image in images], [0] * len(images)

    def negative(p: int, rows: int) -> float:
        triangles[p] = compressed(np.vstack([triangles[p], images[p][known[p] : rows]]))
        known[p] = rows
        return -weights[p] * beta_span(triangles[p])

    smallest = LazyMaximum(np.zeros(len(images)))
    last = images[0].shape[0]
    return [-smallest.next(partial(negative, rows=rows))[1] for rows in range(first, last + 1)]


def enrichment_stage(cell: Cell) -> EnrichmentStage:
    """The stage that completes the reduced model of a cell."""
    cone = ConeStage(cell.problem, cell.dual, cell.cone)
    return EnrichmentStage(PODStage(cell.problem, cell.pod), cone, cell.primal, cell.primal_tol)


def reduced_model(store: Store, stage: EnrichmentStage) -> tuple[ReducedModel, Array, Multipliers]:
    """The reduced model of an enrichment, the basis of V_N it extends and the prepared multipliers."""
    basis: POD = value_of(store, stage.pod)
    reduced: ReducedCone = value_of(store, stage.cone)
    model = ReducedModel(
        build_problem(stage.pod.problem),
        basis.basis,
        value_of(store, stage),
        reduced.cone.generators,
        reduced.prepared.span,
    )
    return model, basis.basis, reduced.prepared
