"""The bounds of `vibench.model.error_bounds` at online cost: no array of mesh size is used at a parameter.

With an inner product X that does not depend on the parameter, bounds α X ≼ A(µ) ≼ γ X, and w ∈ V with B w ≥ s,

    ‖e‖²_A ≤ Δ² = ρ²/α + γ ω² + 2κ,    ‖Bᵀε‖_{A⁻¹} ≤ min(√(Δ² + 2 rᵀw), ω √γ + Δ),    ρ = ‖r‖_{X⁻¹}, ω = ‖w‖_X.

Where A is constant X is A, α = γ = 1, and nothing is lost. See docs/mathematics.md, "Bounds at online cost".

- ρ comes from coordinates of the residual in an orthonormal basis (`residual`). If B is assembled on the contact, the
  terms of Bᵀλ_N are B₀ᵀ times the generators, with the part B₀ of B that is the same at all training parameters, and
  the functionals on the contact unknowns, with the values of (B − B₀)ᵀλ_N at the parameter.
- w is one of `prepared_correction` or of `contact_correction`, α and γ are those of `spectral`.
- Members that are not declared to be constant or affine sums have errors: with A = Ã + D and f = f̃ + d the residual
  lacks d − D u_N, and ρ grows by ‖d‖ and ‖D‖ ‖u_N‖_X. These are measured (`base`), which proves nothing, even if they
  are zero: the bounds are verified then, not certified, and there are none outside the parameter box.

The best correction w for c X in place of A comes with ν ≥ 0, c X w = Bᵀ(ν − λ_N). The *corrected pair* v = u_N − w, ν
has the residual r − (c X − A) w and violates nothing, so that both of its errors are at most the root of
‖r − (c X − A) w‖²_{A⁻¹} + 2 νᵀ(B w − s). The norm is at most ρ/√α + ½ (γ − α)/√α ‖w‖_X for c = ½ (α + γ).

**Bounds of u and λ apart.** If one error is much smaller than the other, its bound above is that of the larger one. A
step of defect correction separates them: û = u_N + z/c − w with z = X⁻¹r, c X w = Bᵀ(ν − λ_N) and c = ½ (α + γ) gives

    ‖u − u_N‖_A ≤ √γ ‖û − u_N‖_X + δ,         ‖Bᵀ(λ − λ_N)‖_{A⁻¹} ≤ ‖Bᵀ(ν − λ_N)‖_{X⁻¹}/√α + δ,

δ = ½ (γ − α)/√α ‖û − u_N‖_X. w is the correction of u_N + z/c in place of u_N. Only the part of r in the span of the
basis of residuals is used; the rest, and what is not known of r, adds its norm to that of the residual.

**Round-off** is bounded in all terms, however large the condition number of X: in ρ (`residual`), in w and its norm
by the μ of C (`contact_correction`), in κ, in A(µ) and its spectrum (`base`), and in the energy of u_N, which relative
bounds are divided by. With FᵀF between (1 ± η) X, the distortion of U and the computed directions, rᵀw differs from the
product of coordinates by at most m ρ ω, and ρ is at most (1 + m) times what they give (`OnlineCertificate.margin`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import inf, sqrt
from typing import TypeAlias

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.errors import UnsupportedError
from vibench.interfaces.parameters import outside
from vibench.interfaces.problem import Contact, Problem
from vibench.linalg import EPS, UNIT_ROUND_OFF
from vibench.linalg.factorisations import implementation
from vibench.model.affine import AffineMember
from vibench.model.bound_terms import BoundNote, BoundTerms, CorrectionMode, outside_note
from vibench.model.certificates.base import CertificateBase, Guarantee, contact_unknowns, is_exact
from vibench.model.certificates.contact_correction import (
    ContactCompliance,
    ContactCorrection,
    bounded_correction,
    find_contact_correction,
    unknowns_near,
)
from vibench.model.certificates.prepared_correction import PreparedCorrections, prepare_corrections
from vibench.model.certificates.residual import ColumnBlock, ResidualBasis, residual_basis, residual_coefficients
from vibench.model.galerkin import ReducedProblem, contact_at
from vibench.model.hyperreduced import HyperReducedModel
from vibench.qp.solve import solve_qp

Solve: TypeAlias = Callable[[Array], tuple[ReducedProblem, Array, Array] | None]
"""From mu (d,) to a reduced problem with its x and α, or `None` where there is no solution."""


@dataclass(frozen=True)
class OnlineBound:
    """Bounds of one reduced solution, infinite where there are none."""

    # Bounds of ‖u − u_N‖ in the norm of A(µ) and of ‖Bᵀ(λ − λ_N)‖ in that of A(µ)⁻¹.
    u_energy: float
    lambda_natural: float
    # Bound of ‖u − u_N‖ / ‖u‖ in the norm of A(µ), or of the larger error of u and λ over what contact does.
    relative: float
    # Upper bounds of the terms ρ/√α, ω√γ and κ.
    rho: float
    omega: float
    kappa: float
    # α.
    coercivity: float
    # Their worth; and why there are none, that no prepared correction was feasible, or "".
    guarantee: Guarantee
    note: str
    # Bound of ‖λ − λ_N‖ in the norm of W: `lambda_natural` over `inf_sup`.
    lam: float
    # A lower bound of β_A, and which it is; 0, and why there is none.
    inf_sup: float
    inf_sup_note: str

    @classmethod
    def none(cls, note: str) -> OnlineBound:
        """No bound, and why."""
        return cls(inf, inf, inf, inf, inf, inf, 0.0, Guarantee.NONE, str(note), inf, 0.0, "")


@dataclass(frozen=True)
class OnlineCorrection:
    """The corrected pair v = u_N − w and ν of one reduced solution.

    `load` is c (k,) on the contact unknowns E, w = X⁻¹ E c, and `nu` is ν ≥ 0 (m,). In its bounds ω is zero, ρ the norm
    of its residual, and κ is νᵀ(B w − s).
    """

    load: Array
    nu: Array
    bound: OnlineBound


class _Query:
    """One reduced solution, and what its bounds and its correction share; the constraint is evaluated at most once."""

    def __init__(
        self, base: CertificateBase, problem: Problem, mu: Array, reduced: ReducedProblem, x: Array, lam: Array
    ) -> None:
        evaluated = reduced.evaluated
        self.problem, self.mu, self.x, self.lam, self.y = problem, mu, x, lam, evaluated.in_space(x)
        self.A, self.samples, self._contact = reduced.program.A, evaluated.samples, evaluated.contact
        self.theta = base.coefficients(self.samples)
        self.lower, self.upper, self.error = base.spectrum(mu, self.theta["A"], self.samples)

    @property
    def contact(self) -> Contact:
        """The constraint on the contact unknowns; the assembly of the program may have evaluated it."""
        # no cached property: its lock costs more than all other attributes of a query
        if self._contact is None:
            self._contact = contact_at(self.problem, self.mu)
        return self._contact


@dataclass(frozen=True)
class OnlineCertificate:
    """Data that bound the errors of one reduced model at online cost, made by `prepare`."""

    # Data shared with other models of the problem.
    base: CertificateBase
    # The basis of its residuals; their coefficients are those of f, of A for every vector of Φ, and of Bᵀλ_N.
    residual: ResidualBasis
    # Coordinates (k×K) in that basis of the functionals that act on one contact unknown each.
    contact_directions: Array
    # C, and which contact unknowns matter.
    compliance: ContactCompliance
    # Rows (k×d) of Φ at the contact unknowns.
    contact_basis: Array
    # χ (m×R).
    generators: Array
    # B₀ᵀχ (k×R) where B is assembled on the contact; `None` where it is exactly the sum of its terms.
    forces: Array | None
    # m, relative: see `vibench.model.certificates.bounds`.
    margin: float
    # Corrections that take no factorisation at the parameter, where there are any.
    prepared: PreparedCorrections | None
    # Round-off (Q,) in energies of vectors with coefficients of norm 1, for every term of A that a query evaluates.
    energy_round_off: Array

    @cached_property
    def bound_sizes(self) -> Array:
        """Absolute values |g_q| (m×Q) of the terms of g."""
        assert self.base.bound_terms is not None  # where this is called
        return np.abs(self.base.bound_terms)

    @cached_property
    def unit_round_off(self) -> Array:
        """Round-off (k,) of u_N at the contact unknowns, for coefficients of norm 1."""
        # d products, their sum, and the round-off of Φ itself: at most (d + 4) eps by Cauchy and Schwarz
        return np.asarray((self.contact_basis.shape[1] + 4.0) * EPS * np.linalg.norm(self.contact_basis, axis=1))

    def certify(
        self, problem: Problem, mu: Array, reduced: ReducedProblem, x: Array, alpha: Array, mode: CorrectionMode
    ) -> tuple[OnlineBound, OnlineCorrection | None]:
        """Bounds of a solution x (N',), α (R,) of a reduced program that a `HyperReducedModel` assembled at mu (d,).

        Also the corrected pair with its own where the mode asks for it and there is one.
        """
        query = _Query(self.base, problem, mu, reduced, x, self.generators @ alpha)
        bound = self._bound(query, alpha)
        if bound.guarantee is Guarantee.NONE or not mode.applies(bound.omega, bound.rho):
            return bound, None
        return bound, self._corrected_pair(query, bound)

    def least_contact(
        self, problem: Problem, mu: Array, reduced: ReducedProblem, alpha: Array, lam: Array, natural: float
    ) -> float:
        """A lower bound of ‖u − A⁻¹f‖_A = ‖Bᵀλ‖_{A⁻¹} at mu (d,), from a λ_N (m,) with this natural bound.

        ‖Bᵀλ_N‖ is at least λ_NᵀBz / ‖z‖_A for every z, such as that of the reduced program for its α (R,). May be
        negative.
        """
        program = reduced.program
        z = scipy.linalg.solve(program.A, program.B.T @ alpha, assume_a="pos")
        query = _Query(self.base, problem, mu, reduced, z, lam)
        if not natural < inf or not (size := float(z @ (program.A @ z))) > 0.0:
            return 0.0
        # The interpolated stiffness may be softer than A by its error: ‖z‖²_A ≤ zᵀA_N z (1 + ε/(α − ε)).
        energy = (size + self._energy_error(query)) * query.lower / (query.lower - query.error)
        values, uncertain = self._on_contact(query)
        uncertain = uncertain + EPS * (len(values) + len(lam) + 4.0) * np.abs(values)
        force = float(lam @ (query.contact.B @ values)) - float(np.abs(lam) @ (abs(query.contact.B) @ uncertain))
        return force / sqrt(energy) - natural

    def _energy_error(self, query: _Query) -> float:
        """Round-off in xᵀA x, the energy of the vector with the coordinates x of a query."""
        terms = float(np.abs(query.samples.get("A", self.base.one)) @ self.energy_round_off)
        # Absolute values of an orthonormal basis of a part of the space have at most the norm √N.
        return terms * float(query.x @ query.x) * (1.0 if query.y is query.x else len(query.x))

    def _bound(self, query: _Query, alpha: Array) -> OnlineBound:
        base, lam, lower, upper = self.base, query.lam, query.lower, query.upper
        if not (K := query.problem.K).contains(lam):
            return OnlineBound.none(outside_note(K))
        if not base.is_exact and outside(query.problem.parameters, query.mu).any():
            return OnlineBound.none(BoundNote.OUTSIDE)
        if not lower > query.error:
            return OnlineBound.none(BoundNote.NOT_COERCIVE)
        quick, note = None, ""
        if self.prepared is not None:
            quick = self.prepared.correction(*self._constraint(query), query.y, lam, upper)
            note = BoundNote.NOT_PREPARED
        if quick is not None:
            (along, norm, kappa, eta), note = quick, ""
        else:
            best = self._best_correction(query, upper)
            if best is None:
                return OnlineBound.none(BoundNote.NO_CORRECTION)
            # coordinates of X w in the basis of residuals
            along = best.load @ self.contact_directions[best.unknowns]
            norm, kappa, eta = best.norm, best.kappa, best.eta
        contact = None if self.forces is None else query.contact
        z = residual_coefficients(query.theta, query.y, self.forces, contact, alpha, lam)
        coordinates, beside, missing = self.residual.parts(z)
        square_of_u = float(query.x @ (query.A @ query.x))
        # ‖u_N‖_X from ‖u_N‖ in the interpolated stiffness, whose coercivity is at least α less its error
        rounded = self._energy_error(query)
        u_norm = sqrt(max(0.0, square_of_u + rounded) / (lower - query.error))
        lacking = base.load_error + query.error * u_norm
        if contact is not None:
            # the round-off in what B₀ᵀλ_N lacks, from all |B_ij| λ_i √C_jj; |B| as a matrix would show
            # in the seconds of a query
            rows, unit = sp.csr_array(contact.B), 2.0 * EPS * (len(lam) + len(alpha))
            sizes = np.abs(rows.data) * self.compliance.root.take(rows.indices)
            lacking += unit * float(sizes @ np.repeat(np.abs(lam), np.diff(rows.indptr)))
        rho = (sqrt(float(coordinates @ coordinates) + beside**2) + missing) * (1.0 + self.margin) + lacking
        kappa *= 1.0 + self.margin
        # an upper bound of rᵀw: what r has besides its coordinates may act along w, and w' is within η of w
        work = float(along @ coordinates) + (beside + missing + lacking) * norm + rho * (eta + self.margin * norm)
        terms = BoundTerms.from_work(rho / sqrt(lower), norm * sqrt(upper), kappa, work)
        of_u, of_lam = terms.primal, terms.dual
        if self.prepared is None and base.spectral is not None:
            others = self._defect_corrected(query, coordinates, beside + missing + lacking)
            of_u, of_lam = min(of_u, others[0]), min(of_lam, others[1])
        # a lower bound of ‖u‖_A, from that of ‖u_N‖_A and the triangle inequality
        least = sqrt(max(0.0, square_of_u - rounded - query.error * u_norm**2)) - of_u
        relative = of_u / least if least > 0.0 else inf
        beta, which = base.inf_sup.lower_bound(float(query.theta["B"][0]), lambda: query.contact.B, upper)
        in_W = of_lam / beta if beta > 0.0 else inf
        own = terms.rho, terms.omega, kappa, lower
        return OnlineBound(of_u, of_lam, relative, *own, base.guarantee, str(note), in_W, beta, which)

    def _defect_corrected(self, query: _Query, coordinates: Array, outside: float) -> tuple[float, float]:
        """Bounds of ‖u − u_N‖_A and of ‖Bᵀ(λ − λ_N)‖_{A⁻¹}; infinite where no correction was found.

        The residual has these coordinates (K,), and `outside` is the norm of what they lack.
        """
        lower, upper, directions = query.lower, query.upper, self.contact_directions
        on_contact, uncertain = self._on_contact(query)
        middle = 0.5 * (lower + upper)
        moved = coordinates / middle  # z/c
        shift, terms = directions @ moved, len(moved) + 4.0
        size_of_shift = np.linalg.norm(directions, axis=1) * np.linalg.norm(moved) + np.abs(shift)
        uncertain = uncertain + terms * EPS * size_of_shift
        moved_contact = query.contact, on_contact + shift, uncertain, query.lam, middle
        found = find_contact_correction(self.compliance, *moved_contact)
        if found is None or found.nu is None:
            return inf, inf
        # the coordinates of X w, whose rest is orthogonal to z
        along = found.load @ directions[found.unknowns]
        beside = max(0.0, found.norm**2 - float(along @ along))
        round_off = (terms * EPS + self.margin) * (float(np.linalg.norm(moved)) + found.norm)
        distance = float(np.linalg.norm(moved - along)) + round_off
        distance = sqrt(distance**2 + beside + (terms * EPS + 2.0 * self.margin) * found.norm**2)
        eta = found.eta + found.away
        left = (outside + 0.5 * (upper - lower) * distance + middle * (eta + round_off)) / sqrt(lower)
        delta = sqrt(left**2 + 2.0 * found.gap) + eta * sqrt(upper)
        return sqrt(upper) * distance + delta, middle * found.norm / sqrt(lower) + delta

    def _best_correction(self, query: _Query, gamma: float) -> ContactCorrection | None:
        """The best correction for γ, found at the parameter; `None` if none was found."""
        given = self.compliance, query.contact, *self._on_contact(query), query.lam, gamma
        K = query.problem.K
        return bounded_correction(*given, K) if K.blocks else find_contact_correction(*given)

    def _on_contact(self, query: _Query) -> tuple[Array, Array]:
        """The solution u_N (k,) on the contact unknowns, and a bound of its round-off."""
        return self.contact_basis @ query.y, float(np.linalg.norm(query.y)) * self.unit_round_off

    def _constraint(self, query: _Query) -> tuple[float | SparseMatrix, Array, Array]:
        """The constraint as prepared corrections take it, and a bound of the terms of g."""
        if (terms := self.base.bound_terms) is None:
            contact = query.contact
            return contact.B, contact.g, np.abs(contact.g)
        of_g = query.samples.get("g", self.base.one)
        return float(query.theta["B"][0]), terms @ of_g, self.bound_sizes @ np.abs(of_g)

    def _corrected_pair(self, query: _Query, bound: OnlineBound) -> OnlineCorrection | None:
        """The corrected pair of a solution whose bounds are known."""
        lower, upper, lam, contact = query.lower, query.upper, query.lam, query.contact
        middle = 0.5 * (lower + upper)
        pair = None
        # prepared corrections of some bodies alone are not the best ones, and no ν belongs to them
        if self.prepared is not None and self.base.bound_terms is not None:
            B, g, g_size = self._constraint(query)
            pair = self.prepared.multiplier(float(B), g, g_size, query.y, lam, middle)
        if pair is None:
            best = self._best_correction(query, middle)
            if best is None or best.nu is None:
                return None
            pair = best.nu, best.norm, best.gap, best.eta + best.away
        nu, norm, gap, eta = pair
        rho = bound.rho + (0.5 * (upper - lower) * norm + middle * eta) / sqrt(lower)
        both = sqrt(rho**2 + 2.0 * gap) + eta * sqrt(upper)
        # over the lower bound of ‖u‖ that the first bounds gave
        relative = both / (bound.u_energy / bound.relative) if 0.0 < bound.relative < inf else inf
        in_W = both / bound.inf_sup if bound.inf_sup > 0.0 else inf
        corrected = replace(
            bound, u_energy=both, lambda_natural=both, relative=relative, rho=rho, omega=0.0, kappa=gap, lam=in_W
        )
        return OnlineCorrection(np.asarray(contact.B.T @ (nu - lam)) / middle, nu, corrected)

    def corrected(self, u: Array, correction: OnlineCorrection, unknowns: Indices) -> Array:
        """The corrected solution v = u_N − w (n,) from u_N (n,) and the contact unknowns (k,).

        Costs one solve with X, by arrays of mesh size, whose round-off is not in the bounds of v.
        """
        load = np.zeros(self.base.X.dim)
        load[unknowns] = correction.load
        return np.asarray(u - self.base.X.riesz(load))


def prepare(
    model: HyperReducedModel, members: Mapping[str, AffineMember], base: CertificateBase, training: Array,
    solve: Solve | None = None,
) -> OnlineCertificate:  # fmt: skip
    """Prepare the certificate of a reduced model, from the members it was made of and its `certificate_base`.

    Only sharpness depends on `training` (P×d), parameters that show which terms of residuals contribute, and on who
    solves there: by default a QP solver the programs of the model.
    """
    problem, Phi, chi, B = model.problem, model.basis, model.generators, members["B"]
    X, dofs, scaled = base.X.matrix, contact_unknowns(problem), base.bound_terms is not None
    factor = implementation(base.X.factorisation).eliminate_with_factor(X, dofs, "A")
    forces = None if is_exact(problem, "B", B) else np.asarray(base.constraint.T @ chi)
    squares = X.diagonal()
    eliminated, of_solution = np.array(factor.backward_errors(squares)) / [base.share.value, sqrt(base.share.value)]

    def block(values: Array, rounded: Array | float) -> ColumnBlock:
        """Solutions with the factor, and the round-off in what they solve."""
        return ColumnBlock(values, rounded + of_solution * np.linalg.norm(values, axis=0), len(squares))

    def products(matrix: SparseMatrix, vectors: Array, terms: int) -> ColumnBlock:
        """The products with a sparse matrix, which enter sums of so many terms."""
        unit = 1.01 * EPS * (np.max(np.diff(sp.csr_array(matrix).indptr)) + terms + 4.0) / sqrt(base.share.value)
        rounded = unit * (abs(matrix) @ np.abs(vectors)) / np.sqrt(squares)[:, None]
        return block(factor.solve_factor_transposed(np.asarray(matrix @ vectors)), np.linalg.norm(rounded, axis=0))

    loads, trailing = np.column_stack(members["f"].terms), factor.trailing_factor
    blocks = [products(sp.eye_array(len(loads), format="csr"), loads, loads.shape[1])]
    blocks += [products(term, Phi, 0) for term in ([X] if base.spectral is None else base.terms)]
    if forces is None:
        blocks += [products(B_q.T, chi, len(B.terms) + chi.shape[1]) for B_q in B.terms]
    else:
        # loads on the contact unknowns, which come last: the others are not touched
        on_contact = np.eye(len(dofs)), forces
        blocks += [block(scipy.linalg.solve_triangular(trailing, load, trans="T"), 0.0) for load in on_contact]
    near = np.any([unknowns_near(contact_at(problem, mu).B, chi) for mu in training], axis=0)
    compliance = ContactCompliance(base.compliance, np.flatnonzero(near), base.compliance_error)
    contact_basis = np.ascontiguousarray(Phi[dofs])
    z, typical, held = _sampled(model, base, compliance, forces, training, solve or partial(_solved, model))
    residual, U = residual_basis(blocks, z, typical, len(dofs))
    directions = scipy.linalg.solve_triangular(trailing, U)
    prepared = (base.constraint, scaled, compliance, held, contact_basis, directions)
    corrections = None if problem.K.blocks else prepare_corrections(*prepared)
    trailing, scale = np.abs(trailing), np.sqrt(squares[dofs])
    # of the dense factor γ_{k+1}|F|ᵀ|F|, whose largest row sum in units of S is at least its norm
    dense = (len(dofs) + 2.0) * UNIT_ROUND_OFF * float(np.max(trailing.T @ (trailing @ (1.0 / scale)) / scale))
    eta = 1.01 * eliminated + 1.02 * dense / base.share.value
    # what triangular solutions miss of U in the norm of F⁻ᵀE c, and the round-off in products of c with the directions:
    # Σ |c_i| √C_ii is at most the root below times ‖w‖
    solved = float(np.linalg.norm(trailing @ np.abs(directions)))
    spread = sqrt(len(dofs) * float(np.diag(base.compliance) @ np.sum(trailing**2, axis=0)))
    rounded = EPS * (sum(directions.shape) + 16.0) * (solved + spread)
    margin = 1.01 * (2.0 * eta + residual.distortion + base.compliance_error + rounded) if eta < 0.5 else inf
    own = residual, directions, compliance, contact_basis, chi, forces, margin, corrections
    return OnlineCertificate(base, *own, _energy_round_off(members["A"].terms, Phi))


def _energy_round_off(terms: Sequence[SparseMatrix], Phi: Array) -> Array:
    """Bounds (Q,) of |xᵀÃ_q x − xᵀΦᵀA_qΦ x| for |x| = 1 and the computed Ã_q = ΦᵀA_qΦ, and of sums of these."""
    size = np.abs(Phi)
    sizes = [float(np.linalg.norm(size.T @ (abs(term) @ size))) for term in terms]
    entries = max(int(np.max(np.diff(sp.csr_array(term).indptr))) for term in terms)
    # the numbers of terms in a column of AΦ, ΦᵀAΦ, the sum over q, and xᵀA x, also in another basis of the space
    return np.asarray(1.01 * EPS * (entries + len(size) + len(terms) + 4.0 * size.shape[1] + 16.0) * np.array(sizes))


def _sampled(
    model: HyperReducedModel, base: CertificateBase, compliance: ContactCompliance, forces: Array | None, mus: Array,
    solve: Solve,
) -> tuple[Array, float, Mask]:  # fmt: skip
    """Samples of reduced solutions at training parameters, with the `forces` of `residual_coefficients`.

    They are coefficients (Z×S) of residuals, the median norm of corrections, and the rows (m,) that some of these hold.
    """
    problem, residuals, norms, held = model.problem, [], [0.0], np.zeros(len(model.generators), bool)
    rows = np.ascontiguousarray(model.basis[contact_unknowns(problem)])
    # up to 200 samples, and a correction of every eighth: only medians and maxima of them are used
    for number, mu in enumerate(mus[:: -(-len(mus) // 200)]):
        if (solved := solve(mu)) is None:
            continue
        reduced, x, alpha = solved
        evaluated = reduced.evaluated
        lam, y = model.generators @ alpha, evaluated.in_space(x)
        contact, theta = evaluated.contact or contact_at(problem, mu), base.coefficients(evaluated.samples)
        residuals.append(residual_coefficients(theta, y, forces, contact, alpha, lam))
        # rows that are violated, or in which the best w may hold B w = s for γ = 1
        excess, reach = contact.B @ (rows @ y) - contact.g, abs(contact.B) @ compliance.root
        held |= (excess > 0.0) | (lam * reach**2 > np.abs(excess))
        if number % 8 == 0 and not problem.K.blocks:
            correction = find_contact_correction(compliance, contact, rows @ y, np.zeros(len(rows)), lam, 1.0)
            norms += [] if correction is None else [correction.norm]
    if not residuals:
        raise UnsupportedError("no reduced program at a training parameter has a solution")
    return np.column_stack(residuals), float(np.median(norms)), held


def _solved(model: HyperReducedModel, mu: Array) -> tuple[ReducedProblem, Array, Array] | None:
    """The program of a model at mu (d,) with its solution; `None` if it has none."""
    reduced = model.assemble(mu)
    answer = solve_qp(reduced.program, "daqp", 1e-8, factor=reduced.factor)
    if answer.x is None or answer.alpha is None or not np.all(np.isfinite(answer.x)):
        return None
    return reduced, answer.x, np.maximum(answer.alpha, 0.0)


def output_error_bound(weights: tuple[float, float], base: CertificateBase, bound: OnlineBound) -> float:
    """Bound of the error of an output with these `output_weights`, where u and λ have these bounds; or infinity."""
    (of_u, of_lam), beta = weights, base.inf_sup.value
    if bound.guarantee is Guarantee.NONE or (of_lam and not bound.inf_sup > 0.0):
        return inf
    in_u = of_u * bound.u_energy / sqrt(bound.coercivity)
    return in_u + (of_lam * beta * bound.lam if of_lam else 0.0)
