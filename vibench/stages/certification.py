"""What certificates of reduced models at online cost need: prepared offline, in stages of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from vibench.model.affine import AffineMember
from vibench.model.certificates.base import CertificateBase, OnlineInfSup, certificate_base
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.certificates.contact_correction import ContactCompliance
from vibench.model.certificates.prepared_correction import PreparedCorrections
from vibench.model.certificates.residual import ResidualBasis
from vibench.model.certificates.spectral import SpectralBounds
from vibench.stages.artefacts import Store
from vibench.stages.base import Result, Stage, build_problem, value_of
from vibench.stages.formulation import AffineDecomposition, FormulationStage
from vibench.stages.serialisation import storable
from vibench.timing import timed

for _kind in (
    CertificateBase, ContactCompliance, OnlineInfSup, PreparedCorrections, ResidualBasis, SpectralBounds,
):  # fmt: skip
    storable(_kind)


BASE_SOLUTIONS, SOLUTIONS = 25.0, 4.0
"""A base, and a certificate, take about as long as so many high-fidelity solutions."""


@dataclass(frozen=True)
class CertificateBaseStage(Stage):
    """What certificates of all reduced models of a problem have in common; the value is a `CertificateBase`."""

    label = "certificate base"

    decomposition: AffineDecomposition

    @property
    def effort(self) -> float:
        """Those of a bound of the spectrum."""
        return BASE_SOLUTIONS

    def run(self, store: Store) -> Result:
        """Factorise, bound the spectrum, measure interpolation errors."""
        problem = build_problem(self.decomposition.problem)
        members: Mapping[str, AffineMember] = value_of(store, self.decomposition)
        training = self.decomposition.parameters(problem)
        return Result(*timed(lambda: certificate_base(problem, members, training)))


@dataclass(frozen=True)
class CertificateStage(Stage):
    """What certifies the queries of one reduced model; the value are the members of its `OnlineCertificate` but one.

    The base, which is of mesh size, is stored once for all models.
    """

    label = "certificate"

    built: FormulationStage

    @property
    def effort(self) -> float:
        """Those of the functionals of its residuals."""
        return SOLUTIONS

    @property
    def base(self) -> CertificateBaseStage:
        """The stage of what it shares with other models."""
        assert self.built.decomposition is not None  # cells with bounds have reduced assembly
        return CertificateBaseStage(self.built.decomposition)

    def inputs(self) -> tuple[Stage, ...]:
        """The model, its members, and the base."""
        return (*self.built.model_inputs, self.base.decomposition, self.base)

    def certificate(self, store: Store) -> OnlineCertificate:
        """The certificate, once the stage has been run."""
        return OnlineCertificate(value_of(store, self.base), **value_of(store, self))

    def run(self, store: Store) -> Result:
        """Prepare the certificate.

        Raises an `UnsupportedError` if the model is assembled in full.
        """
        model = self.built.model(store)
        offline = model.offline.given(
            members=value_of(store, self.base.decomposition),
            certificate_base=value_of(store, self.base),
            decomposed=self.base.decomposition.parameters(model.problem),
        )
        model.reduced  # noqa: B018  the clock begins after it
        prepared, seconds = timed(lambda: model.online.certificate(offline))
        own = (one.name for one in fields(prepared) if one.name != "base")
        return Result({name: getattr(prepared, name) for name in own}, seconds)
