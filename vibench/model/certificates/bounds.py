"""The bounds of `vibench.model.error_bounds` at online cost: no array of mesh size is used at a parameter.

With an inner product X that does not depend on the parameter, bounds α X ≼ A(µ) ≼ γ X, and w ∈ V with B w ≥ s,

    ‖e‖²_A ≤ Δ² = ρ²/α + γ ω² + 2κ,    ‖Bᵀε‖_{A⁻¹} ≤ min(√(Δ² + 2 rᵀw), ω √γ + Δ),    ρ = ‖r‖_{X⁻¹}, ω = ‖w‖_X,

follow from the bounds (ii) there, as ‖r‖²_{A⁻¹} ≤ ρ²/α and ‖w‖²_A ≤ γ ω². Where A does not depend on the parameter X is
A, α = γ = 1, and nothing is lost. Elsewhere X is A at the centre of the parameter box.

- ρ comes from coordinates of the residual in an orthonormal basis (`vibench.model.certificates.residual`). Its terms
  are those of f, of A times the basis of the reduced space, and of Bᵀ times the generators. Where B is assembled on
  the contact the last ones are the functionals on the contact unknowns, with the values of Bᵀλ_N at the parameter.
- s = B u_N − g is evaluated on all rows with the B and g of the parameter, which involve the contact unknowns alone.
- w is the lifting of `vibench.model.certificates.lifting` with the compliance C = Eᵀ X⁻¹ E of the contact unknowns E.
- α and γ are those of `vibench.model.certificates.spectral`.

Members that the problem declares to be constant or affine sums are exact, those that are interpolated are not. With
A = Ã + D and f = f̃ + d, the residual of Ã and f̃ lacks d − D u_N, and ρ grows by the largest ‖d‖ and ‖D‖ ‖u_N‖_X. These
are measured at random parameters and doubled, which proves nothing: the bounds are then called verified instead of
certified. They are certified where α, γ and the norms in them are proved, too. Round-off is bounded where it decides
whether w is feasible, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.errors import UnsupportedError
from vibench.highfidelity.active_set import FALLBACK_SOLVER
from vibench.interfaces.problem import Contact, Problem
from vibench.model.affine import AffineMember
from vibench.model.certificates.base import (
    CertificateBase,
    Guarantee,
    coefficients,
    contact_unknowns,
    injected,
    is_exact,
)
from vibench.model.certificates.lifting import ContactCompliance, lift
from vibench.model.certificates.residual import ResidualBasis, residual_basis
from vibench.model.error_bounds import NO_LIFTING, NOT_IN_CONE
from vibench.model.galerkin import Evaluated, ReducedProblem
from vibench.model.hyperreduced import HyperReducedModel
from vibench.qp.solve import solve_qp

SAMPLES = 200
"""Training parameters at most whose reduced solutions tell what terms of the residual contribute."""

RINGS = 1
"""Rings of rows around the support of the generators whose contact unknowns liftings usually involve."""

SAMPLE_ACCURACY = 1e-8

NOT_COERCIVE = "no positive lower bound of the coercivity of A was found at this parameter"


@dataclass(frozen=True)
class OnlineBound:
    """Bounds of one reduced solution, infinite where there are none.

    Attributes
    ----------
    u_energy, lambda_natural
        Of ‖u − u_N‖ in the norm of A(µ) and of ‖Bᵀ(λ − λ_N)‖ in that of A(µ)⁻¹.
    relative
        Of ‖u − u_N‖ / ‖u‖ in the norm of A(µ).
    rho, omega, kappa
        Upper bounds of the terms ρ/√α, ω√γ and κ.
    coercivity
        α.
    guarantee, note
        What they are worth, and why there are none or "".
    """

    u_energy: float
    lambda_natural: float
    relative: float
    rho: float
    omega: float
    kappa: float
    coercivity: float
    guarantee: Guarantee
    note: str = ""

    @classmethod
    def none(cls, note: str) -> OnlineBound:
        """No bound, and why."""
        inf = float("inf")
        return cls(inf, inf, inf, inf, inf, inf, 0.0, Guarantee.NONE, note)


@dataclass(frozen=True)
class OnlineCertificate:
    """What bounds the errors of one reduced model at online cost; from `prepare`.

    Attributes
    ----------
    base
        What it shares with other models of the problem.
    residual
        The basis of its residuals; their coefficients are those of f, of A for every vector of Φ, and of Bᵀλ_N.
    contact_directions
        Coordinates (k×K) in that basis of the functionals that act on one contact unknown each.
    compliance
        C, and which contact unknowns matter.
    contact_basis
        Rows (k×d) of Φ at the contact unknowns.
    generators
        χ (m×R).
    on_contact
        Whether the coefficients of Bᵀλ_N are its values on the contact unknowns, not multiples of Bᵀχ.
    """

    base: CertificateBase
    residual: ResidualBasis
    contact_directions: Array
    compliance: ContactCompliance
    contact_basis: Array
    generators: Array
    on_contact: bool

    @cached_property
    def _near_directions(self) -> Array:
        """Rows of `contact_directions` for the unknowns of most liftings."""
        return np.ascontiguousarray(self.contact_directions[self.compliance.near])

    @cached_property
    def _round_off(self) -> Array:
        """Round-off (k,) of u_N at the contact unknowns, for coefficients of norm 1."""
        terms = self.contact_basis.shape[1] + 4.0
        return np.asarray(terms * np.finfo(float).eps * np.linalg.norm(self.contact_basis, axis=1))

    def evaluate(self, problem: Problem, mu: Array, reduced: ReducedProblem, x: Array, alpha: Array) -> OnlineBound:
        """Bounds of a solution x (N',), α (R,) of a reduced program that a `HyperReducedModel` assembled at mu (d,)."""
        lam, base = self.generators @ alpha, self.base
        if np.min(lam, initial=0.0) < 0.0:
            return OnlineBound.none(NOT_IN_CONE)
        evaluated = _evaluated(reduced)
        contact, y = _contact(problem, mu, evaluated), _coordinates(evaluated, x)
        theta = coefficients(base, evaluated.samples)
        lower, upper = (1.0, 1.0) if base.spectral is None else base.spectral.at(mu, theta["A"])
        if not lower > 0.0:
            return OnlineBound.none(NOT_COERCIVE)
        on_contact, uncertain = self.contact_basis @ y, float(np.linalg.norm(y)) * self._round_off
        lifting = lift(self.compliance, contact, on_contact, uncertain, lam, upper)
        if lifting is None:
            return OnlineBound.none(NO_LIFTING)
        of_lam = contact.B.T @ lam if self.on_contact else np.outer(theta["B"], alpha).ravel()
        z = residual_coefficients(theta, y, of_lam)
        energy = float(np.sqrt(max(0.0, float(x @ (reduced.program.A @ x)))))
        u_norm = energy / float(np.sqrt(max(lower - base.stiffness_error, np.finfo(float).tiny)))  # of u_N in X
        lacking = base.load_error + base.stiffness_error * u_norm
        coordinates, (beside, missing) = self.residual.coordinates(z), self.residual.left_out(z)
        rho = float(np.hypot(np.linalg.norm(coordinates), beside)) + missing + lacking
        omega, kappa = lifting.norm * float(np.sqrt(upper)), lifting.kappa
        square = rho**2 / lower + omega**2 + 2.0 * kappa
        bound = float(np.sqrt(square))
        near = len(lifting.unknowns) == len(self.compliance.near)
        along = lifting.load @ (self._near_directions if near else self.contact_directions)
        work = float(along @ coordinates) + (beside + missing + lacking) * lifting.norm  # at least rᵀw
        natural = min(float(np.sqrt(max(0.0, square + 2.0 * work))), omega + bound)
        least = float(np.sqrt(max(0.0, energy**2 - base.stiffness_error * u_norm**2))) - bound  # of ‖u‖
        relative = bound / least if least > 0.0 else float("inf")
        terms = rho / float(np.sqrt(lower)), omega, kappa
        return OnlineBound(bound, natural, relative, *terms, lower, base.guarantee)


def residual_coefficients(theta: Mapping[str, Array], y: Array, of_lam: Array) -> Array:
    """Coefficients (Z,) of a residual: those of f, of A for every vector of Φ, and of Bᵀλ_N."""
    return np.concatenate([theta["f"], -np.outer(theta["A"], y).ravel(), -of_lam])


def prepare(
    model: HyperReducedModel, members: Mapping[str, AffineMember], base: CertificateBase, training: Array
) -> OnlineCertificate:
    """Prepare what bounds the errors of a reduced model, from the members it was made of and `certificate_base`.

    Sharpness alone depends on `training` (P×d), parameters that show which terms of residuals contribute.
    """
    problem, Phi, chi, B = model.problem, model.basis, model.generators, members["B"]
    functionals, on_contact = injected(problem), not is_exact(problem, "B", B)
    blocks = [np.column_stack(members["f"].terms), *(np.asarray(term @ Phi) for term in base.terms)]
    blocks += [functionals] if on_contact else [np.asarray(term.T @ chi) for term in B.terms]
    compliance = ContactCompliance(base.compliance, _near(problem, chi, training))
    residual, U = residual_basis(base.X, blocks, *_sampled(model, base, compliance, on_contact, training))
    directions = base.X.whiten_functional(functionals).T @ U
    contact_basis = np.ascontiguousarray(Phi[contact_unknowns(problem)])
    return OnlineCertificate(base, residual, directions, compliance, contact_basis, chi, on_contact)


def _near(problem: Problem, chi: Array, training: Array) -> Indices:
    """Contact unknowns that rows in the support of a generator, or next to it, touch at some training parameter."""
    found = np.zeros(len(contact_unknowns(problem)), bool)
    for mu in training:
        contact = problem.contact(mu)
        assert contact is not None  # `unsupported` refuses problems without
        touches, rows = abs(sp.csr_array(contact.B)) > 0.0, np.any(chi > 0.0, axis=1)
        for _ in range(RINGS):
            rows = touches @ (touches.T @ rows)
        found |= touches.T @ rows
    return np.flatnonzero(found)


def _sampled(
    model: HyperReducedModel, base: CertificateBase, compliance: ContactCompliance, on_contact: bool, training: Array
) -> tuple[Array, float]:
    """Coefficients of residuals (Z×S) of reduced solutions at training parameters, and the median norm of liftings."""
    problem, found, norms = model.problem, [], [0.0]
    rows = model.basis[contact_unknowns(problem)]
    for number, mu in enumerate(training[:: -(-len(training) // SAMPLES)]):
        reduced = model.assemble(mu)
        answer = solve_qp(reduced.program, FALLBACK_SOLVER, SAMPLE_ACCURACY, factor=reduced.factor)
        if answer.x is None or answer.alpha is None or not np.all(np.isfinite(answer.x)):
            continue
        evaluated, lam = _evaluated(reduced), model.generators @ np.maximum(answer.alpha, 0.0)
        contact, y = _contact(problem, mu, evaluated), _coordinates(evaluated, answer.x)
        theta = coefficients(base, evaluated.samples)
        of_lam = contact.B.T @ lam if on_contact else np.outer(theta["B"], answer.alpha).ravel()
        found.append(residual_coefficients(theta, y, of_lam))
        if number % 8 == 0:
            lifting = lift(compliance, contact, rows @ y, np.zeros(len(rows)), lam, 1.0)
            norms += [] if lifting is None else [lifting.norm]
    if not found:
        raise UnsupportedError("no reduced program at a training parameter has a solution")
    return np.column_stack(found), float(np.median(norms))


def _evaluated(reduced: ReducedProblem) -> Evaluated:
    assert reduced.evaluated is not None  # assembled by a `HyperReducedModel`
    return reduced.evaluated


def _contact(problem: Problem, mu: Array, evaluated: Evaluated) -> Contact:
    """B and g at mu on the contact unknowns."""
    contact = evaluated.contact or problem.contact(mu)
    assert contact is not None  # `unsupported` refuses problems without
    return contact


def _coordinates(evaluated: Evaluated, x: Array) -> Array:
    """Coordinates (d,) of u_N in Φ."""
    return x if evaluated.coordinates is None else np.asarray(evaluated.coordinates @ x)
