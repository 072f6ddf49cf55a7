"""A formulation built on the offline phase of a study, as a stage of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from vibench.arrays import Array
from vibench.interfaces.formulations import Formulation
from vibench.interfaces.problem import Problem
from vibench.interfaces.strategies import Cone, Enrichment, Kind
from vibench.linalg.cholesky import PartialCholesky, SparseCholesky
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.inner_product import InnerProduct
from vibench.model.affine import AffineMember, Evaluation, affine_decomposition
from vibench.model.chebyshev import AffinePolynomial
from vibench.model.hyperreduced import ProjectedMember, ReducedOperators
from vibench.offline.compiled import CompiledModel
from vibench.offline.models import ACCURACY, Model, check_built
from vibench.offline.reduction import Reduction, Snapshots
from vibench.plugins.plugin import Plugin
from vibench.reduction.pod import POD
from vibench.reduction.supremizers import ContactCoordinates, LoadCoordinates, SpannedCoordinates
from vibench.stages.artefacts import Store
from vibench.stages.base import Result, Stage, build_problem, faults_of, value_of
from vibench.stages.enrichment import EnrichmentStage
from vibench.stages.offline import ConeStage, PODStage, ReducedCone
from vibench.stages.serialisation import storable
from vibench.stages.snapshots import gather, solution_stages
from vibench.study.parameter_sets import OWN_TRAINING, ParameterSet
from vibench.timing import timed

for _kind in (
    AffineMember, Evaluation, ReducedOperators, ProjectedMember, ContactCoordinates, LoadCoordinates,
    SpannedCoordinates, InnerProduct, SparseCholesky, PartialCholesky, BlockDiagonal,
    # what formulations may build: steps of other offline phases, and programs of the machine
    POD, Cone, Kind, Enrichment, CompiledModel, AffinePolynomial,
):  # fmt: skip
    storable(_kind)


@dataclass(frozen=True)
class AffineDecomposition(Stage):
    """Affine decomposition of A, f, B and g over the training set, for their evaluation at reduced cost.

    The training matrices are not stored, they are assembled again.
    """

    label = "affine decomposition"

    problem: Plugin
    tolerance: float
    training: ParameterSet = OWN_TRAINING

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """An `AffineMember` by name."""
        problem = build_problem(self.problem)
        mus = self.parameters(problem)
        return Result(*timed(lambda: affine_decomposition(problem, mus, self.tolerance)))

    def parameters(self, problem: Problem) -> Array:
        """Parameters (P×d) at which members are assembled: the training set, or the problem's own.

        That needs no solutions, and an adaptive training has too few parameters for it.
        """
        return (OWN_TRAINING if self.training.is_adaptive else self.training).of(problem)


@dataclass(frozen=True)
class HyperReduction(Stage):
    """Projection of the decomposed members on the space of a reduced model."""

    label = "hyper-reduction"

    enrichment: EnrichmentStage
    decomposition: AffineDecomposition

    def inputs(self) -> tuple[Stage, ...]:
        """The reduced model and the members."""
        return (*self.enrichment.model_inputs, self.decomposition)

    def run(self, store: Store) -> Result:
        """The `ReducedOperators` of a reduced model, or why there are none and queries are assembled in full."""
        reduction = self.enrichment.reduction(store).given(members=value_of(store, self.decomposition))
        reduction.projection  # noqa: B018  the clock begins after it
        return Result(*timed(lambda: reduction.operators))


@storable
@dataclass(frozen=True)
class BuiltFormulation:
    """What a formulation has built, and the reduced operators, where no other stage has made those it uses."""

    built: Mapping[str, Any]
    operators: ReducedOperators | str | None


@dataclass(frozen=True, eq=False)
class _StoredReduction(Reduction):
    """An offline phase whose snapshots and members are read when they are asked for, and not computed again."""

    read: Mapping[str, Callable[[], Any]] = field(default_factory=dict)

    @cached_property
    def snapshots(self) -> Snapshots:
        """The stored training snapshots."""
        found: Snapshots = self.read["snapshots"]()
        return found

    @cached_property
    def members(self) -> Mapping[str, AffineMember]:
        """The stored members, of a phase with assembly in reduced form."""
        if "members" not in self.read:
            return super().members
        found: Mapping[str, AffineMember] = self.read["members"]()
        return found


@dataclass(frozen=True)
class FormulationStage(Stage):
    """A formulation built on the offline phase, `None` being what that does not have; a `BuiltFormulation`."""

    label = "formulation"

    problem: Plugin
    formulation: Plugin
    training: ParameterSet
    pod: PODStage | None
    cone: ConeStage | None
    enrichment: EnrichmentStage | None
    interpolation: float | None

    @property
    def decomposition(self) -> AffineDecomposition | None:
        """The stage of the members; `None` for assembly in full."""
        if self.interpolation is None:
            return None
        return AffineDecomposition(self.problem, self.interpolation, self.training)

    @property
    def reduction(self) -> HyperReduction | None:
        """The stage that projects the members on an enriched space; without enrichment this stage does it itself."""
        if self.enrichment is None or self.decomposition is None:
            return None
        return HyperReduction(self.enrichment, self.decomposition)

    @property
    def phases(self) -> tuple[Stage, ...]:
        """The stages of V_N, cone and enrichment."""
        enriched = () if self.enrichment is None else self.enrichment.model_inputs
        return tuple(dict.fromkeys(stage for stage in (self.pod, self.cone, *enriched) if stage is not None))

    @cached_property
    def kind(self) -> type[Formulation]:
        """The class of the formulation, which declares its axes and capabilities."""
        kind: type[Formulation] = self.formulation.registered.load()
        return kind

    @property
    def builds(self) -> bool:
        """Whether the stage is run: a formulation without `build` whose queries are programs needs spaces alone."""
        return self.kind.build is not Formulation.build or not self.kind.has_program

    @property
    def model_inputs(self) -> tuple[Stage, ...]:
        """The stages whose artefacts `model` reads."""
        if self.builds:
            return (*self.inputs(), self)
        return self.phases if self.reduction is None else (*self.phases, self.reduction)

    def inputs(self) -> tuple[Stage, ...]:
        """The offline phase: snapshots and members among it, if a formulation asks for these."""
        made = (stage for stage in (self.decomposition, self.reduction) if stage is not None)
        return (*solution_stages(self.problem, self.training), *self.phases, *made)

    def run(self, store: Store) -> Result:
        """Build the formulation and make its model, timed: a model may have something to compute, too.

        Raises an `UnsupportedError` if the problem does not have what it needs.
        """
        offline, formulation = self.offline(store), self.create()
        offline.snapshots  # noqa: B018  the clock begins after they are read
        if self.decomposition is not None:
            offline.members  # noqa: B018  likewise

        def work() -> Mapping[str, Any]:
            built = check_built(formulation.build(offline))
            Model(formulation, offline, built, None, ACCURACY).online  # noqa: B018  is made, and dropped
            return built

        with faults_of(self.formulation):
            built, seconds = timed(work)
        operators = offline.__dict__.get("operators") if self.reduction is None else None
        return Result(BuiltFormulation(dict(built), operators), seconds)

    def create(self) -> Formulation:
        """A new instance of the formulation."""
        made = self.formulation.create()
        assert isinstance(made, Formulation)  # `RegisteredPlugin.load` refuses anything else
        return made

    def offline(self, store: Store, accuracy: float = ACCURACY) -> Reduction:
        """The offline phase, whose steps are stored."""
        pod, cone, enrichment = self.pod, self.cone, self.enrichment
        snapshots = solution_stages(self.problem, self.training)
        read: dict[str, Callable[[], Any]] = {"snapshots": lambda: gather(store, snapshots)}
        if (decomposition := self.decomposition) is not None:
            read["members"] = lambda: value_of(store, decomposition)
        steps: dict[str, Any] = {}
        if pod is not None:
            steps["pod"] = value_of(store, pod)
        if cone is not None:
            reduced: ReducedCone = value_of(store, cone)
            steps |= {"cone": reduced.cone, "multipliers": reduced.prepared}
        if enrichment is not None:
            steps["enrichment"] = enrichment.enrichment(store)
        if self.reduction is not None:
            steps["operators"] = value_of(store, self.reduction)
        return _StoredReduction(
            build_problem(self.problem),
            None if cone is None else cone.dual.create(),
            None if enrichment is None else enrichment.primal.create(),
            None if pod is None else pod.stop,
            None if cone is None else cone.stop,
            None if enrichment is None else enrichment.tolerance,
            training=self.training.strategy(),
            assembly="full" if self.interpolation is None else "reduced",
            interpolation=self.interpolation or Reduction.interpolation,
            accuracy=accuracy,
            read=read,
        ).given(**steps)

    def model(self, store: Store, solver: str | None = None, accuracy: float | None = None) -> Model:
        """The model for a solver and an accuracy, once the stages of `model_inputs` have been run."""
        accuracy = ACCURACY if accuracy is None else accuracy
        offline, built = self.offline(store, accuracy), dict[str, Any]()
        if self.builds:
            stored: BuiltFormulation = value_of(store, self)
            built = dict(stored.built)
            if stored.operators is not None:
                offline = offline.given(operators=stored.operators)
        return Model(self.create(), offline, built, solver, accuracy)
