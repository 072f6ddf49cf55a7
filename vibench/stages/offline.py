"""The offline stages before the enrichment: POD, cone, and the constants that enrichments are compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace

from vibench.interfaces.dual_sets import refuse_blocks
from vibench.interfaces.strategies import ReducedSet, Stop
from vibench.interfaces.validation import check_cone
from vibench.plugins.plugin import Plugin
from vibench.reduction.cones import orthogonality
from vibench.reduction.pod import POD, pod
from vibench.reduction.supremizers import ConstraintClasses, constraint_classes, isometric_supremizers
from vibench.stability.infsup import ConeBasis, beta_span, cone_basis
from vibench.stages.artefacts import History, Store, storable
from vibench.stages.base import Result, Stage, build_problem, faults_of, value_of
from vibench.stages.snapshots import gather, parameters_in, solution_stages
from vibench.study.cells import Axes
from vibench.study.parameter_sets import OWN_TRAINING, ParameterSet
from vibench.timing import timed

storable(POD, ReducedSet, ConeBasis, ConstraintClasses)


@dataclass(frozen=True)
class PODStage(Stage):
    """POD of the training displacements."""

    label = "POD"

    problem: Plugin
    stop: Stop
    training: ParameterSet = OWN_TRAINING

    @property
    def axes(self) -> Axes:
        return Axes(problem=self.problem, pod=self.stop, training=self.training)

    def inputs(self) -> tuple[Stage, ...]:
        return solution_stages(self.problem, self.training)

    def run(self, store: Store) -> Result:
        """Compute the modes; the history is the relative tail over the number of modes."""
        snapshots = gather(store, self.inputs()).u
        basis, seconds = timed(lambda: pod(snapshots, build_problem(self.problem).V, self.stop))
        return Result(basis, seconds, (History.of("pod", "error", basis.errors),))


@storable
@dataclass(frozen=True)
class ReducedCone:
    """A cone, and its multipliers prepared for constants and enrichments."""

    cone: ReducedSet
    prepared: ConeBasis


@dataclass(frozen=True)
class ConeStage(Stage):
    """The dual strategy on the training multipliers."""

    label = "cone"

    problem: Plugin
    dual: Plugin
    stop: Stop
    training: ParameterSet = OWN_TRAINING

    @property
    def axes(self) -> Axes:
        return Axes(problem=self.problem, dual=self.dual, cone=self.stop, training=self.training)

    @property
    def constraints(self) -> ConstraintMatrices:
        return ConstraintMatrices(self.problem, self.training)

    def inputs(self) -> tuple[Stage, ...]:
        return solution_stages(self.problem, self.training)

    def run(self, store: Store) -> Result:
        """Reduce; histories are the projection error and e_orth over the number of generators."""
        snapshots, problem = gather(store, self.inputs()).lam, build_problem(self.problem)
        strategy, W, K = self.dual.create(), problem.W, problem.K
        refuse_blocks(K, strategy.blocks, f"the dual strategy '{self.dual.name}'")
        # Verification is no part of the offline time.
        with faults_of(self.dual):
            cone, reducing = timed(lambda: strategy.reduce(snapshots, W, replace(self.stop)))
            cone = check_cone(cone, W, K)
        if self.stop.tolerance and (error := float(cone.errors[-1])) > self.stop.tolerance:
            missed = f"the cone misses its tolerance {self.stop.tolerance:g}: its error is {error:.2g}"
            cone = replace(cone, fallbacks=(*cone.fallbacks, missed))
        prepared, preparing = timed(lambda: cone_basis(cone.generators, W, cone.free))
        orthogonal = orthogonality(cone.generators, W, cone.free)
        histories = History.of("cone", "error", cone.errors), History.of("cone", "e_orth", orthogonal)
        return Result(ReducedCone(cone, prepared), reducing + preparing, histories)


@dataclass(frozen=True)
class ConstraintMatrices(Stage):
    """The constraint matrices at the parameters of a set, sorted into classes of proportional ones; not timed."""

    label = "constraint matrices"

    problem: Plugin
    parameters: ParameterSet

    def inputs(self) -> tuple[Stage, ...]:
        return solution_stages(self.problem, self.parameters) if self.parameters.follows_solutions else ()

    def run(self, store: Store) -> Result:
        """The `ConstraintClasses`."""
        problem, mus = build_problem(self.problem), parameters_in(store, self.problem, self.parameters)
        return Result(constraint_classes(problem.constraint(mu)[0] for mu in mus))


@dataclass(frozen=True)
class TrainingConstants(Stage):
    """The upper bound of β_span over all enrichments of V_N, on the training set; not timed."""

    label = "training constants"

    cone: ConeStage

    def inputs(self) -> tuple[Stage, ...]:
        return (self.cone, self.cone.constraints)

    def run(self, store: Store) -> Result:
        """β_span of the whole of V with the cone at every parameter (P,)."""
        span, classes = value_of(store, self.cone).prepared.span, value_of(store, self.cone.constraints)
        image = isometric_supremizers(build_problem(self.cone.problem).V, classes.representatives, span.shape[1])
        return Result(classes.expand_classes([beta_span(image(B, span)) for B in classes.representatives]))
