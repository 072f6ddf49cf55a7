"""Solutions of reduced models at one parameter: the reduced solution, or the corrected pair of its certificate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from math import inf
from typing import Any, NamedTuple

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.interfaces.problem import VariationalInequality
from vibench.model.bound_terms import BoundNote, CorrectionMode, outside_note
from vibench.model.certificates.base import Guarantee, contact_unknowns
from vibench.model.certificates.bounds import OnlineBound, OnlineCertificate, OnlineCorrection, output_error_bound
from vibench.model.error_bounds import CorrectedPair, ErrorBounds, bound_errors_at, corrected_pair
from vibench.model.errors import high_fidelity_residuals
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel
from vibench.offline.assemblies import Assemblies, assemblies
from vibench.qp.status import Status
from vibench.qp.verification import Residuals


class Answer(NamedTuple):
    """The pair u (n,), λ (m,), whether it is corrected, and a note why it is not although that is asked for."""

    u: Array
    lam: Array
    bound: OnlineBound | None = None  # its bounds at online cost, where the model has them
    is_corrected: bool = False
    share: float | None = None  # ω/ρ of the reduced solution
    note: str = ""


@dataclass(frozen=True)
class Corrector:
    """Corrects solutions of a reduced model: at online cost where it has a certificate, else at high-fidelity cost."""

    model: AnyReducedModel
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
        if self.certificate is None or not isinstance(self.model, HyperReducedModel):
            return Answer(u, lam) if self.mode is CorrectionMode.NONE else self.in_full(mu, u, lam)
        problem, certify = self.model.problem, self.certificate.certify
        bound, correction = certify(problem, mu, self.model.assemble(mu), x, alpha, self.mode)
        share = None if bound.guarantee is Guarantee.NONE else _share(bound.omega, bound.rho)
        if correction is not None:
            v = self.certificate.corrected(u, correction, contact_unknowns(problem))
            return Answer(v, correction.nu, correction.bound, is_corrected=True, share=share)
        applies = share is None or self.mode.applies(bound.omega, bound.rho)
        if self.mode is CorrectionMode.NONE or not applies:
            return Answer(u, lam, bound, share=share)
        # The bound exists, but its correction has no multiplier ν ≥ 0 that would make it a pair.
        no_pair = "the certificate found a correction, but no multiplier ν ≥ 0 that belongs to it"
        return Answer(u, lam, bound, share=share, note=bound.note if bound.guarantee is Guarantee.NONE else no_pair)

    def in_full(self, mu: Array, u: Array, lam: Array) -> Answer:
        """The answer at high-fidelity cost."""
        # Corrections are defined for λ_N ≥ 0 only (docs/mathematics.md, "Error bounds").
        problem = self.model.problem
        if not problem.K.contains(lam):
            return Answer(u, lam, note=outside_note(problem.K))
        cache = assemblies(problem)
        pair = corrected_pair(cache.at(mu), cache.energy_at(mu), u, lam)
        if pair is None:
            return Answer(u, lam, note=BoundNote.NO_CORRECTION)
        is_corrected, share = self.mode.applies(pair.omega, pair.rho), _share(pair.omega, pair.rho)
        u, lam = (pair.u, pair.lam) if is_corrected else (u, lam)
        return Answer(u, lam, is_corrected=is_corrected, share=share)


def corrected_in_full(
    model: AnyReducedModel, cache: Assemblies, mu: Array, vi: VariationalInequality, x: Array, alpha: Array
) -> CorrectedPair | None:
    """The correction at high-fidelity cost of x (N',), α (R,), with factorisations of an assembled A."""
    u = np.asarray(model.reconstruct(mu, vi, x[:, None])[:, 0])
    return corrected_pair(vi, cache.energy_of(vi), u, vi.K.project(model.generators @ alpha))


def _share(omega: float, rho: float) -> float:
    return omega / rho if rho > 0.0 else inf if omega > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class Solution:
    """The answer of a model at one parameter; the fields are those of a row of the queries table.

    Attributes
    ----------
    mu
        The parameter (d,).
    status, reason
        The verdict of verification, and why it is not ok.
    x, alpha
        Coefficients of u (N',) and of λ (R,); `None` if there is no answer, or α where λ has no coefficients.
    residuals
        Recomputed KKT residuals of the (last) quadratic program; `None` without one.
    assembly, solution
        CPU seconds of the assembly of the program, 0 where it is part of the solution, and of the solution.
    bound, tolerance
        Error bounds at online cost where the model has a certificate, and the relative error asked for; else `None`.
    correction
        The correction at online cost: `u`, `lam` and `bound` are of the corrected pair, x and α are not.
    mode
        Whether a correction was asked for. Without a certificate it is made when `u` or `lam` is, at high-fidelity
        cost.
    iterations, uncertainty
        Steps of the solver or the formulation, and the formulation's own estimate of ‖u − u_N‖_V, if it makes one.
    """

    mu: Array
    status: Status
    reason: str
    x: Array | None
    alpha: Array | None
    residuals: Residuals | None
    assembly: float
    solution: float
    _model: Any = field(repr=False)  # the `Model`, whose module imports this one
    _pair: Callable[[], tuple[Array, Array] | None] = field(repr=False)
    bound: OnlineBound | None = None
    tolerance: float | None = None
    correction: OnlineCorrection | None = None
    mode: CorrectionMode = CorrectionMode.NONE
    iterations: int | None = None
    uncertainty: float | None = None

    @property
    def verdict(self) -> str:
        """Whether the bound is within the tolerance: "certified" or "verified", as its guarantee, or "not certified".

        "no tolerance" where none was asked for. A solution that is not ok is not certified, however small its bound is.
        """
        if self.tolerance is None or self.bound is None:
            return "no tolerance"
        # A bound holds for any pair, however far it is from solving the program.
        certified = self.status is Status.OK and self.bound.relative <= self.tolerance
        return self.bound.guarantee.value if certified else "not certified"

    def _repr_html_(self) -> str:
        return html("solution", self.columns())

    def columns(self) -> dict[str, Any]:
        """The solution as a row of the table that `Model.solve_all` makes."""
        row: dict[str, Any] = dict(zip(self._model.problem.parameters.names, self.mu.tolist(), strict=True))
        row |= {"status": self.status.value, "reason": self.reason}
        row["residual"] = None if self.residuals is None else self.residuals.worst
        if (bound := self.bound) is not None:
            row |= {"bound_u_energy": bound.u_energy, "bound_lambda_natural": bound.lambda_natural}
            row |= {"bound_u_relative": bound.relative, "guarantee": bound.guarantee.value, "verdict": self.verdict}
        if self.x is not None:
            row |= {f"output:{name}": value for name, value in self.outputs.items()}
            bounds = self.output_bounds if bound is not None else {}
            row |= {f"bound:{name}": value for name, value in bounds.items()}
        return row | {"assembly": self.assembly, "solution": self.solution}

    @property
    def u(self) -> Array:
        """The primal solution u (n,)."""
        return self.answer.u

    @property
    def lam(self) -> Array:
        """The multiplier λ (m,)."""
        return self.answer.lam

    @cached_property
    def answer(self) -> Answer:
        """Both of these, whether they are a corrected pair, and why not."""
        certificate, problem = self._model.certificate, self._model.problem
        pair = self._pair()
        if pair is None:
            raise RequestError(f"there is no solution at mu = {self.mu.tolist()}: {self.status.value}: {self.reason}")
        # Without a certificate the correction takes factorisations at mu: made only when u or λ is asked for.
        if certificate is None and self.mode is not CorrectionMode.NONE:
            return Corrector(self._model.reduced, None, self.mode).in_full(self.mu, *pair)
        if certificate is None or self.correction is None:
            return Answer(*pair, self.bound)
        v = certificate.corrected(pair[0], self.correction, contact_unknowns(problem))
        return Answer(v, self.correction.nu, self.bound, is_corrected=True)

    @cached_property
    def outputs(self) -> dict[str, float]:
        """Values of the problem's quantities of interest, by name; of the corrected pair where `answer` is one."""
        pair = self.mu[None], self.u[:, None], self.lam[:, None]
        return {output.name: float(output.values(*pair)[0]) for output in self._model.problem.outputs}

    @property
    def output_bounds(self) -> dict[str, float]:
        """Bounds of the absolute errors of `outputs`, by name, from `bound`; infinite where there are none.

        There are none without `bound`, of outputs that are not linear, and of those of λ without a bound in W.
        """
        bound, certificate, bounds = self.bound, self._model.certificate, dict.fromkeys(self._model.output_weights, inf)
        for name, weight in self._model.output_weights.items():
            if bound is not None and certificate is not None and weight is not None:
                bounds[name] = output_error_bound(weight, certificate.base, bound)
        return bounds

    @cached_property
    def error_bounds(self) -> ErrorBounds:
        """Proved bounds on the errors of u and λ in four norms, at the cost of high-fidelity factorisations at mu."""
        cache = assemblies(self._model.problem)
        V, mu = self._model.problem.V, self.mu
        constants = cache.coercivity_at(mu), cache.energy_inf_sup_at(mu)
        return bound_errors_at(V, cache.at(mu), cache.energy_at(mu), *constants, self.u, self.lam)

    @cached_property
    def high_fidelity_residuals(self) -> Residuals:
        """Natural KKT residuals of the high-fidelity problem, at the same cost."""
        cache = assemblies(self._model.problem)
        return high_fidelity_residuals(cache.at(self.mu), cache.energy_at(self.mu), self.u, self.lam)


def html(title: str, values: Mapping[str, Any]) -> str:
    """A table of two columns, for notebooks."""
    texts = ((name, f"{value:.3g}" if isinstance(value, float) else str(value)) for name, value in values.items())
    body = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in texts if text)
    return f"<table><caption>{escape(title)}</caption><tbody>{body}</tbody></table>"
