"""A formulation built on the offline phase of a study, its assembly at reduced cost, and its certificate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, cast

from vibench.arrays import Array
from vibench.interfaces.formulations import Formulation, Snapshots
from vibench.interfaces.strategies import Enrichment, Kind, ReducedSet
from vibench.linalg.cholesky import PartialCholesky, SparseCholesky
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.inner_product import InnerProduct
from vibench.model.affine import AffineMember, Evaluation, affine_decomposition
from vibench.model.certificates.base import CertificateBase, OnlineInfSup, certificate_base
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.certificates.contact_correction import ContactCompliance
from vibench.model.certificates.prepared_correction import PreparedCorrections
from vibench.model.certificates.residual import ResidualBasis
from vibench.model.certificates.spectral import AnchorGrid, SpectralBounds, TermRanges
from vibench.model.chebyshev import AffinePolynomial
from vibench.model.hyperreduced import ProjectedMember, ReducedOperators
from vibench.offline.compiled import CompiledModel
from vibench.offline.models import ACCURACY, Model, check_built
from vibench.offline.reduction import Reduction
from vibench.plugins.plugin import Plugin
from vibench.reduction.pod import POD
from vibench.reduction.supremizers import ContactCoordinates, LoadCoordinates, SpannedCoordinates
from vibench.stability.coercivity import Constant
from vibench.stages.artefacts import Store, storable
from vibench.stages.base import Result, Stage, build_problem, faults_of, value_of
from vibench.stages.enrichment import EnrichmentStage
from vibench.stages.offline import ConeStage, PODStage, ReducedCone
from vibench.stages.snapshots import gather, parameters_in, solution_stages
from vibench.study.parameter_sets import OWN_TRAINING, ParameterSet
from vibench.timing import timed

storable(
    AffineMember, Evaluation, ReducedOperators, ProjectedMember, ContactCoordinates, LoadCoordinates,
    SpannedCoordinates, InnerProduct, SparseCholesky, PartialCholesky, BlockDiagonal,
    # Formulations may build steps of other offline phases, and compiled programs.
    POD, ReducedSet, Kind, Enrichment, CompiledModel, AffinePolynomial,
    CertificateBase, Constant, ContactCompliance, OnlineInfSup, PreparedCorrections, ResidualBasis, SpectralBounds,
    AnchorGrid, TermRanges,
)  # fmt: skip


@dataclass(frozen=True)
class AffineDecomposition(Stage):
    """Affine decomposition of A, f, B and g over the training set, for their evaluation at reduced cost."""

    # The training matrices are not stored, they are assembled again.

    label = "affine decomposition"

    problem: Plugin
    tolerance: float
    training: ParameterSet = OWN_TRAINING

    def inputs(self) -> tuple[Stage, ...]:
        return solution_stages(self.problem, self.training) if self.training.skips else ()

    def run(self, store: Store) -> Result:
        """An `AffineMember` by name."""
        problem, mus = build_problem(self.problem), self.parameters(store)
        return Result(*timed(lambda: affine_decomposition(problem, mus, self.tolerance)))

    def parameters(self, store: Store) -> Array:
        """Parameters (P×d) at which members are assembled: the training set, or the problem's own."""
        # The decomposition needs no solutions, and an adaptive training has too few parameters for it.
        return parameters_in(store, self.problem, OWN_TRAINING if self.training.is_adaptive else self.training)


@dataclass(frozen=True)
class HyperReduction(Stage):
    """Projection of the decomposed members on the space of a reduced model."""

    label = "hyper-reduction"

    enrichment: EnrichmentStage
    decomposition: AffineDecomposition

    def inputs(self) -> tuple[Stage, ...]:
        return (*self.enrichment.model_inputs, self.decomposition)

    def run(self, store: Store) -> Result:
        """The `ReducedOperators` of a reduced model, or the reason why its queries are assembled in full."""
        reduction = self.enrichment.reduction(store).given(members=value_of(store, self.decomposition))
        reduction.projection  # noqa: B018  computed before the clock begins
        return Result(*timed(lambda: reduction.operators))


@storable
@dataclass(frozen=True)
class BuiltFormulation:
    """The result of `Formulation.build`, and the reduced operators it uses if no other stage computes them."""

    built: Mapping[str, Any]
    operators: ReducedOperators | str | None


@dataclass(frozen=True, eq=False)
class _StoredReduction(Reduction):
    """An offline phase whose snapshots and members are read from the store at their first use."""

    read: Mapping[str, Callable[[], Any]] = field(default_factory=dict)

    @cached_property
    def snapshots(self) -> Snapshots:
        return cast("Snapshots", self.read["snapshots"]())

    @cached_property
    def members(self) -> Mapping[str, AffineMember]:
        # Only assembly at reduced cost has stored members.
        return cast("Mapping[str, AffineMember]", self.read["members"]()) if "members" in self.read else super().members


@dataclass(frozen=True)
class FormulationStage(Stage):
    """A formulation built on the offline phase, of which absent parts are `None`; the value is a `BuiltFormulation`."""

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
        """The stage that projects the members on an enriched space."""
        # Without enrichment there is nothing to share: this stage projects itself.
        if self.enrichment is None or self.decomposition is None:
            return None
        return HyperReduction(self.enrichment, self.decomposition)

    @property
    def phases(self) -> tuple[Stage, ...]:
        enriched = () if self.enrichment is None else self.enrichment.model_inputs
        return tuple(dict.fromkeys(stage for stage in (self.pod, self.cone, *enriched) if stage is not None))

    @cached_property
    def kind(self) -> type[Formulation]:
        """The class of the formulation, which declares its axes and capabilities."""
        return cast("type[Formulation]", self.formulation.registered.load())

    @property
    def builds(self) -> bool:
        """Whether the stage is run."""
        # A formulation without `build` whose queries are programs needs the spaces only.
        return self.kind.build is not Formulation.build or not self.kind.has_program

    @property
    def model_inputs(self) -> tuple[Stage, ...]:
        """The stages whose artefacts `model` reads."""
        if self.builds:
            return (*self.inputs(), self)
        return self.phases if self.reduction is None else (*self.phases, self.reduction)

    def inputs(self) -> tuple[Stage, ...]:
        made = (stage for stage in (self.decomposition, self.reduction) if stage is not None)
        return (*solution_stages(self.problem, self.training), *self.phases, *made)

    def run(self, store: Store) -> Result:
        """Build the formulation, timed; raises an `UnsupportedError` if the problem lacks what it needs."""
        offline, formulation = self.offline(store), self.formulation.create()
        # Read snapshots and members before the clock begins.
        offline.snapshots  # noqa: B018
        if self.decomposition is not None:
            offline.members  # noqa: B018

        def work() -> Mapping[str, Any]:
            built = check_built(formulation.build(offline))
            # The model may have something to compute, too: make it and drop it.
            Model(formulation, offline, built, None, ACCURACY).online  # noqa: B018
            return built

        with faults_of(self.formulation):
            built, seconds = timed(work)
        operators = offline.__dict__.get("operators") if self.reduction is None else None
        return Result(BuiltFormulation(dict(built), operators), seconds)

    def offline(self, store: Store, accuracy: float = ACCURACY) -> Reduction:
        pod, cone, enrichment = self.pod, self.cone, self.enrichment
        snapshots = solution_stages(self.problem, self.training)
        read: dict[str, Callable[[], Any]] = {"snapshots": lambda: gather(store, snapshots)}
        if (decomposition := self.decomposition) is not None:
            read["members"] = lambda: dict(value_of(store, decomposition))
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
            build_problem(self.problem), None if cone is None else cone.dual.create(),
            None if enrichment is None else enrichment.primal.create(), None if pod is None else pod.stop,
            None if cone is None else cone.stop, None if enrichment is None else enrichment.tolerance,
            training=self.training.strategy(), assembly="full" if self.interpolation is None else "reduced",
            interpolation=self.interpolation or Reduction.interpolation, accuracy=accuracy, read=read,
            on_failure="skip" if self.training.skips else "stop",
        ).given(**steps)  # fmt: skip

    def model(self, store: Store, solver: str | None = None, accuracy: float | None = None) -> Model:
        """The model for a solver and an accuracy, once the stages of `model_inputs` have been run."""
        accuracy = ACCURACY if accuracy is None else accuracy
        offline, built = self.offline(store, accuracy), dict[str, Any]()
        if self.builds:
            stored: BuiltFormulation = value_of(store, self)
            built = dict(stored.built)
            if stored.operators is not None:
                offline = offline.given(operators=stored.operators)
        return Model(self.formulation.create(), offline, built, solver, accuracy)


@dataclass(frozen=True)
class CertificateBaseStage(Stage):
    """Offline data shared by the certificates of all reduced models of a problem; the value is a `CertificateBase`."""

    label = "certificate base"

    decomposition: AffineDecomposition

    @property
    def effort(self) -> float:
        # The bounds of the spectrum take about as long as 25 high-fidelity solutions.
        return 25.0

    def run(self, store: Store) -> Result:
        problem = build_problem(self.decomposition.problem)
        members: Mapping[str, AffineMember] = value_of(store, self.decomposition)
        training = self.decomposition.parameters(store)
        return Result(*timed(lambda: certificate_base(problem, members, training)))


@dataclass(frozen=True)
class CertificateStage(Stage):
    """Certificate of the queries of one reduced model; the value is its `OnlineCertificate` without the base."""

    # The base, which is of mesh size, is stored once for all models.

    label = "certificate"

    built: FormulationStage

    @property
    def effort(self) -> float:
        # The functionals of its residuals take about as long as 4 high-fidelity solutions.
        return 4.0

    @property
    def base(self) -> CertificateBaseStage:
        assert self.built.decomposition is not None  # cells with bounds have reduced assembly
        return CertificateBaseStage(self.built.decomposition)

    def inputs(self) -> tuple[Stage, ...]:
        return (*self.built.model_inputs, self.base.decomposition, self.base)

    def certificate(self, store: Store) -> OnlineCertificate:
        """The certificate, once the stage has been run."""
        return OnlineCertificate(value_of(store, self.base), **value_of(store, self))

    def run(self, store: Store) -> Result:
        """Prepare the certificate; raises an `UnsupportedError` if the model is assembled in full."""
        model = self.built.model(store)
        offline = model.offline.given(
            members=value_of(store, self.base.decomposition),
            certificate_base=value_of(store, self.base),
            decomposed=self.base.decomposition.parameters(store),
        )
        model.online  # noqa: B018  assembled before the clock begins
        prepared, seconds = timed(lambda: model.online.certificate(offline))
        own = (one.name for one in fields(prepared) if one.name != "base")
        return Result({name: getattr(prepared, name) for name in own}, seconds)
