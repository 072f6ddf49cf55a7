"""A formulation built on the offline phase of a study, as a stage of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from vibench.interfaces.formulations import Formulation
from vibench.model.affine import AffineMember
from vibench.model.hyperreduced import ReducedOperators
from vibench.offline.formulated import ACCURACY, Formulated, check_built
from vibench.offline.reduction import Reduction
from vibench.offline.sweep import Snapshots
from vibench.plugins.plugin import Plugin
from vibench.stages.assembly import AffineDecomposition, HyperReduction
from vibench.stages.base import Result, Stage, build_problem, faults_of, value_of
from vibench.stages.enrichment import EnrichmentStage
from vibench.stages.offline import ConeStage, PODStage, ReducedCone
from vibench.stages.snapshots import gather, solution_stages
from vibench.storage.artefacts import Store
from vibench.storage.serialisation import storable
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import timed


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

    @property
    def model_inputs(self) -> tuple[Stage, ...]:
        """The stages whose artefacts `formulated` reads: snapshots and members among them, if the model needs these."""
        made = (stage for stage in (self.decomposition, self.reduction) if stage is not None)
        return (*solution_stages(self.problem, self.training), *self.phases, *made)

    def inputs(self) -> tuple[Stage, ...]:
        """The offline phase."""
        return self.model_inputs

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
            self.of(formulation, offline, built, None, ACCURACY).model  # noqa: B018  is made, and dropped
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

    def offline(self, store: Store) -> Reduction:
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
            read=read,
        ).given(**steps)

    @staticmethod
    def of(
        formulation: Formulation, offline: Reduction, built: Mapping[str, Any], solver: str | None, accuracy: float
    ) -> Formulated:
        """The model of a formulation for a solver."""
        return Formulated(formulation, offline, built, solver, accuracy)

    def formulated(self, store: Store, solver: str | None, accuracy: float | None) -> Formulated:
        """The model, once the stage has been run."""
        stored: BuiltFormulation = value_of(store, self)
        offline = self.offline(store)
        if stored.operators is not None:
            offline = offline.given(operators=stored.operators)
        return self.of(self.create(), offline, stored.built, solver, ACCURACY if accuracy is None else accuracy)
