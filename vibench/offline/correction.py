"""Answers of queries: the reduced solution, or the corrected pair of its certificate."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality
from vibench.model.bound_terms import BoundNote, CorrectionMode, in_dual_set
from vibench.model.certificates.base import Guarantee, contact_unknowns
from vibench.model.certificates.bounds import OnlineBound, OnlineCertificate
from vibench.model.error_bounds import CorrectedPair, corrected_pair
from vibench.model.galerkin import ReducedModel
from vibench.model.hyperreduced import HyperReducedModel
from vibench.offline.assemblies import Assemblies, assemblies


class Answer(NamedTuple):
    """The pair u (n,), λ (m,), whether it is corrected, and a note why it is not although that is asked for."""

    # `bound` has its bounds at online cost, where the model has them; `share` is ω/ρ of the reduced solution.

    u: Array
    lam: Array
    bound: OnlineBound | None = None
    is_corrected: bool = False
    share: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Corrector:
    """Corrects solutions of a reduced model: at online cost where it has a certificate, else at high-fidelity cost."""

    model: ReducedModel | HyperReducedModel
    certificate: OnlineCertificate | None
    mode: CorrectionMode

    @property
    def cost(self) -> str:
        """Cost of a correction: "online" or "high-fidelity", or "" without any."""
        if self.mode is CorrectionMode.NONE:
            return ""
        return "high-fidelity" if self.certificate is None else "online"

    def answer(self, mu: Array, x: Array, alpha: Array, u: Array, lam: Array) -> Answer:
        """The answer at mu (d,) from x (N',) and α (R,), with u_N (n,) and λ_N (m,) reconstructed from these."""
        if self.certificate is not None and isinstance(self.model, HyperReducedModel):
            return self._online(self.certificate, self.model, mu, x, alpha, u, lam)
        if self.mode is CorrectionMode.NONE:
            return Answer(u, lam)
        return self.in_full(mu, u, lam)

    def in_full(self, mu: Array, u: Array, lam: Array) -> Answer:
        """The answer at high-fidelity cost."""
        # Corrections are defined for λ_N ≥ 0 only (docs/mathematics.md, "Error bounds").
        if not in_dual_set(lam):
            return Answer(u, lam, note=BoundNote.NOT_IN_CONE)
        cache = assemblies(self.model.problem)
        pair = corrected_pair(cache.at(mu), cache.energy_at(mu), u, lam)
        if pair is None:
            return Answer(u, lam, note=BoundNote.NO_CORRECTION)
        share = _share(pair.omega, pair.rho)
        if not self.mode.applies(pair.omega, pair.rho):
            return Answer(u, lam, share=share)
        return Answer(pair.u, pair.lam, None, is_corrected=True, share=share)

    def _online(
        self,
        certificate: OnlineCertificate,
        model: HyperReducedModel,
        mu: Array,
        x: Array,
        alpha: Array,
        u: Array,
        lam: Array,
    ) -> Answer:
        problem = model.problem
        bound, correction = certificate.certify(problem, mu, model.assemble(mu), x, alpha, self.mode)
        share = None if bound.guarantee is Guarantee.NONE else _share(bound.omega, bound.rho)
        if correction is None:
            wanted = self.mode is not CorrectionMode.NONE and (
                share is None or self.mode.applies(bound.omega, bound.rho)
            )
            # The bound exists, but its correction has no multiplier ν ≥ 0 that would make it a pair.
            no_pair = "the certificate found a correction, but no multiplier ν ≥ 0 that belongs to it"
            why = bound.note if bound.guarantee is Guarantee.NONE else no_pair
            return Answer(u, lam, bound, share=share, note=why if wanted else "")
        v = certificate.corrected(u, correction, contact_unknowns(problem))
        return Answer(v, correction.nu, correction.bound, is_corrected=True, share=share)


def corrected_in_full(
    model: ReducedModel | HyperReducedModel,
    cache: Assemblies,
    mu: Array,
    vi: VariationalInequality,
    x: Array,
    alpha: Array,
) -> CorrectedPair | None:
    """The correction at high-fidelity cost of x (N',), α (R,), with factorisations of an assembled A."""
    u = np.asarray(model.reconstruct(mu, vi, x[:, None])[:, 0])
    return corrected_pair(vi, cache.energy_of(vi), u, np.maximum(model.generators @ alpha, 0.0))


def _share(omega: float, rho: float) -> float:
    return omega / rho if rho > 0.0 else inf if omega > 0.0 else 0.0
