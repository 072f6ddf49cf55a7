"""Bounds of the errors of linear outputs, from those of u and λ at online cost.

An output s(u, λ) = l(u) + m(λ) has the error l(e) + m(ε), e = u − u_N and ε = λ − λ_N. With α X ≼ A(µ) ≼ γ X,

    |l(e)| ≤ ‖l‖_{A⁻¹} ‖e‖_A ≤ ‖l‖_{X⁻¹} ‖e‖_A / √α,

and where B(µ) = θ B₀, or B₀ on the bodies on which it is constant with θ = 1, for any z and with S = B₀ X⁻¹B₀ᵀ,

    |m(ε)| ≤ c ‖B₀ᵀε‖_{X⁻¹} ≤ c √γ/|θ| ‖Bᵀε‖_{A⁻¹},    c = √(zᵀS z) + ‖m − S z‖_{W⁻¹}/β₀,

since β₀ ‖ε‖_W ≤ ‖B₀ᵀε‖_{X⁻¹}. z = S⁻¹m makes c small also where β₀ is, which the modes of ε on single elements decide.
"""

from __future__ import annotations

from contextlib import suppress
from math import inf, sqrt

import numpy as np
import scipy.linalg

from vibench.arrays import Array
from vibench.interfaces.outputs import Output
from vibench.interfaces.problem import Problem
from vibench.model.certificates.base import CertificateBase, Guarantee
from vibench.model.certificates.bounds import OnlineBound


def coefficients(problem: Problem, output: Output) -> tuple[Array, Array]:
    """Coefficients (n,) of u and (m,) of λ of a linear output.

    Raises
    ------
    NumericalError
        If they have another shape.
    """
    sizes = problem.V.dim, problem.W.dim
    output.values(problem.parameters.lower[None], *(np.zeros((size, 1)) for size in sizes))
    given = zip((output.u, output.lam), sizes, strict=True)
    of_u, of_lam = (np.zeros(size) if weights is None else np.asarray(weights, float) for weights, size in given)
    return of_u, of_lam


def weights(problem: Problem, base: CertificateBase, output: Output) -> tuple[float, float]:
    """‖l‖_{X⁻¹} and c of a linear output; c is infinite where no β₀ is proved."""
    of_u, of_lam = coefficients(problem, output)
    return float(np.linalg.norm(base.X.whiten_functional(of_u))), _of_multiplier(problem, base, of_lam)


def _of_multiplier(problem: Problem, base: CertificateBase, of_lam: Array) -> float:
    beta, B = base.inf_sup.value, base.inf_sup.constraint
    if not of_lam.any():
        return 0.0
    if not beta > 0.0 or base.inf_sup.reason:
        return inf
    S = np.asarray(B @ np.asarray(B @ base.compliance).T)
    S, found = 0.5 * (S + S.T), [float(np.linalg.norm(problem.W.whiten_functional(of_lam))) / beta]
    with suppress(np.linalg.LinAlgError):  # rows that are dependent up to round-off
        z = scipy.linalg.cho_solve(scipy.linalg.cho_factor(S), of_lam)
        rest = float(np.linalg.norm(problem.W.whiten_functional(of_lam - S @ z)))
        found.append(float(np.sqrt(max(0.0, z @ S @ z))) + rest / beta)
    return min(found)


def error_bound(of_output: tuple[float, float], base: CertificateBase, bound: OnlineBound) -> float:
    """Bound of the error of an output with these `weights`, where u and λ have these bounds; or infinity."""
    (of_u, of_lam), beta = of_output, base.inf_sup.value
    if bound.guarantee is Guarantee.NONE or (of_lam and not bound.inf_sup > 0.0):
        return inf
    in_u = of_u * bound.u_energy / sqrt(bound.coercivity)
    return in_u + (of_lam * beta * bound.lam if of_lam else 0.0)
