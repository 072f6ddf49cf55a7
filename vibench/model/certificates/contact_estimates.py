"""Estimates of the error bounds of a growing model at the cost of the contact, to rank candidates by.

The bounds (ii) of `vibench.model.error_bounds` take two factorisations of mesh size at a parameter. Here A(µ) is
replaced by γ X in them, X = A(µ₁) at the first solution and γ = ‖u_N‖²_A / ‖u_N‖²_X: the correction is that of
`vibench.model.certificates.contact_correction` with the compliance C = Eᵀ X⁻¹ E of the contact unknowns E, which is
computed once. Where A and f are constant nothing of mesh size is left: X is A, the estimates are the bounds, and with
Φ and z the basis and u_N = Φ z,

    ‖r‖²_{A⁻¹} = ‖f‖² − 2 fᵀu_N + ‖u_N‖²_A − 2 (A⁻¹f)_Eᵀ F + 2 (u_N)_Eᵀ F + Fᵀ C F,    F = Bᵀλ_N on E.

This sum keeps half of the digits: a residual below 1e-7 of u_N is round-off, and what is not far above that is no
bound. Otherwise r is formed, and X⁻¹ r solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.problem import Contact, Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.definite import dense_inverse
from vibench.linalg.schur_complement import EliminationPattern, StaticCondensation
from vibench.model.certificates.contact_correction import ContactCompliance, ContactCorrection, find_contact_correction
from vibench.qp.exact import exact_solution
from vibench.qp.scaling import ratio

MOST_CONTACT = 4000
"""Largest number of contact unknowns whose compliance is a dense matrix here."""

KEPT = 1000
"""Parameters whose projected stiffness is kept."""

RESOLVED = 1e-9
"""Squares of bounds that are at least this share of the largest of their terms have lost no more than nine digits."""


@dataclass(frozen=True)
class Reduced:
    """The reduced solution z (d,) and λ_N (m,) of an estimate, and what was assembled for it."""

    vi: VariationalInequality
    z: Array
    lam: Array


@dataclass(frozen=True)
class Estimate:
    """About what the bound of `vibench.model.certificates.growing` is, and whether it is this bound up to round-off.

    `reduced` is of a problem whose A or f vary.
    """

    value: float
    is_bound: bool = False
    reduced: Reduced | None = None


class ContactEstimates:
    """What estimates of one growing model are computed from; see above.

    Parameters
    ----------
    problem
        One that `supports` estimates.
    vi, stiffness
        The variational inequality of the first solution, and its A as a high-fidelity solver condensed it.
    """

    def __init__(self, problem: Problem, vi: VariationalInequality, stiffness: CondensedStiffness) -> None:
        assert problem.contact_dofs is not None  # as `supports` says
        self._problem, self._dofs, self._A, self._f = problem, problem.contact_dofs, vi.A.copy(), vi.f.copy()
        self.may_be_bounds = {"A", "f"} <= set(problem.constant)
        if self.may_be_bounds and stiffness.dense and np.array_equal(stiffness.retained, self._dofs):
            self._solve, compliance = stiffness.solve, stiffness.liftings(sp.eye_array(len(self._dofs), format="csr"))
        else:
            condensed = StaticCondensation(vi.A, EliminationPattern.of(vi.A, self._dofs))
            self._solve, compliance = SparseCholesky(vi.A, "A").solve, dense_inverse(condensed.dense_schur, "A")
        self._compliance = ContactCompliance(compliance, np.zeros(0, np.intp))
        self._near = np.zeros(len(self._dofs), bool)
        of_load = self._solve(self._f[:, None])[:, 0]
        self._of_load, self._square_of_load = of_load[self._dofs], float(self._f @ of_load)
        self._basis, self._at_contact = np.zeros((len(vi.f), 0)), np.zeros((len(self._dofs), 0))
        self._sizes = np.zeros(len(self._dofs))
        self._stiffness, self._loads, self._generators = np.zeros((0, 0)), np.zeros(0), np.zeros((len(vi.g), 0))
        self._projected = dict[bytes, Array]()

    @staticmethod
    def supports(problem: Problem) -> bool:
        """Whether the problem assembles its constraint on contact unknowns, which are not too many."""
        dofs = problem.contact_dofs
        return problem.has_contact and dofs is not None and len(dofs) <= MOST_CONTACT

    def grow(self, vi: VariationalInequality, basis: Array, generators: Array) -> None:
        """Take the basis Φ (n×d) and the generators (m×R) of the model, after it has taken a solution of `vi`.

        Φ begins with what it was before.
        """
        self._basis, self._generators = basis, generators
        self._at_contact = np.ascontiguousarray(self._basis[self._dofs])
        self._sizes = np.linalg.norm(self._at_contact, axis=1)
        self._stiffness, self._loads = self._grown(self._stiffness, self._A, self._f)
        touches = abs(sp.csr_array(vi.B)[:, self._dofs]) > 0.0
        near = self._near | self._next_to(touches)
        if np.any(near & ~self._near):
            self._near = near
            self._compliance = ContactCompliance(self._compliance.matrix, np.flatnonzero(near))

    def _grown(self, projected: Array, A: SparseMatrix, f: Array) -> tuple[Array, Array]:
        """ΦᵀAΦ (d×d), from that on the first vectors of Φ, and Φᵀf (d,)."""
        size, (n, count) = len(projected), self._basis.shape
        right = np.empty((n, count - size + 1))  # one product with Φ, which is large, for all
        right[:, :-1], right[:, -1] = A @ self._basis[:, size:], f
        products = self._basis.T @ right
        new, grown = products[:, :-1], np.zeros((count, count))
        grown[:size, :size], grown[:, size:], grown[size:] = projected, new, new.T
        grown[size:, size:] = 0.5 * (new[size:] + new[size:].T)
        return grown, products[:, -1]

    def _program(self, mu: Array, vi: VariationalInequality, contact: Contact) -> VariationalInequality:
        """The reduced program at mu (d,), where A varies; candidates are evaluated again with a larger basis."""
        key, chi = mu.tobytes(), self._generators
        A, f = self._grown(self._projected.pop(key, np.zeros((0, 0))), vi.A, vi.f)
        self._projected[key] = A
        if len(self._projected) > KEPT:
            del self._projected[next(iter(self._projected))]
        return VariationalInequality(A, f, chi.T @ np.asarray(contact.B @ self._at_contact), chi.T @ contact.g)

    def _next_to(self, touches: Mask) -> Mask:
        """Contact unknowns (k,) in rows of the support of a generator, or in rows that touch one of these."""
        rows = np.any(self._generators > 0.0, axis=1)
        return np.asarray(touches.T @ (touches @ (touches.T @ rows)), bool)

    def at(self, mu: Array) -> Estimate:
        """The estimate at mu (d,); infinite where the reduced program has no solution, or no correction was found."""
        contact = self._problem.contact(mu)
        assert contact is not None  # as `supports` says
        chi, rows = self._generators, sp.csr_array(contact.B)
        vi = None if self.may_be_bounds else checked_assembly(self._problem, mu)
        if vi is None:
            B = chi.T @ np.asarray(rows @ self._at_contact)
            program = VariationalInequality(self._stiffness, self._loads, B, chi.T @ contact.g)
        else:
            program = self._program(mu, vi, contact)
        answer = exact_solution(program)
        if answer is None:
            return Estimate(inf)
        z, lam = answer.x, chi @ np.maximum(answer.alpha, 0.0)
        energy, force, on_contact = float(z @ (program.A @ z)), np.asarray(rows.T @ lam), self._at_contact @ z
        gamma = 1.0 if vi is None else ratio(energy, float(z @ (self._stiffness @ z))) or 1.0
        uncertain = (len(z) + 4.0) * float(np.finfo(float).eps) * float(np.linalg.norm(z)) * self._sizes
        found = find_contact_correction(self._compliance, contact, on_contact, uncertain, lam, gamma)
        reduced = None if vi is None else Reduced(vi, z, lam)
        if found is None:
            return Estimate(inf, reduced=reduced)
        _, _, C = self._compliance.blocks[len(found.unknowns) > len(self._compliance.near)]
        pushed = C @ force[found.unknowns]  # no force is elsewhere, or the correction would have other unknowns
        pressed, size_of_load = float(force[found.unknowns] @ pushed), self._square_of_load
        if vi is None:
            riesz = (self._of_load - on_contact)[found.unknowns] - pushed
            square = size_of_load + energy - 2.0 * float(self._loads @ z + (self._of_load - on_contact) @ force)
            square += pressed
        else:
            riesz, square = self._residual(vi, z, force, found.unknowns)
        bounds = _Bounds.of(found, max(square, 0.0) / gamma, gamma, riesz)
        value = self._relative(bounds, lam, found.nu, sqrt(max(energy, 0.0)), sqrt(max(pressed, 0.0) / gamma))
        resolved = bounds.smallest_square >= RESOLVED * max(size_of_load, energy, pressed)
        return Estimate(value, vi is None and resolved and found.nu is not None and not found.eta, reduced)

    def _residual(self, vi: VariationalInequality, z: Array, force: Array, unknowns: Indices) -> tuple[Array, float]:
        """X⁻¹ r on some contact unknowns (l,), and the square of ‖r‖ in X⁻¹."""
        residual = vi.f - vi.A @ (self._basis @ z)
        residual[self._dofs] -= force
        riesz = self._solve(residual[:, None])[:, 0]
        return riesz[self._dofs[unknowns]], float(residual @ riesz)

    def _relative(self, bounds: _Bounds, lam: Array, nu: Array | None, energy: float, pressed: float) -> float:
        """The largest of the bounds of u and λ and the estimate of λ in W, relative to u_N and λ_N, as in `bound`.

        `energy` and `pressed` are ‖u_N‖_A and the norm of Bᵀλ_N.
        """
        of_u = ratio(bounds.primal, energy)
        if not pressed > 0.0:
            return of_u
        X = self._problem.W.matrix  # as no digit is lost in a sum of squares, no factor of it is needed
        squares = (float(eta @ (X @ eta)) for eta in (np.zeros_like(lam) if nu is None else nu - lam, lam))
        in_W = ratio(*(sqrt(max(0.0, square)) for square in squares))
        return max(of_u, ratio(bounds.dual, pressed), in_W)


@dataclass(frozen=True)
class _Bounds:
    """Bounds (ii) with a correction: Δ_A, that of λ, and the smallest of the squares that they are roots of."""

    primal: float
    dual: float
    smallest_square: float

    @classmethod
    def of(cls, found: ContactCorrection, square: float, gamma: float, riesz: Array) -> _Bounds:
        """With ρ² and X⁻¹ r (l,) on the unknowns of the correction."""
        omega = sqrt(gamma) * found.norm
        total = square + omega**2 + 2.0 * found.kappa
        primal, gap = sqrt(total), total + 2.0 * float(riesz @ found.load)
        return cls(primal, min(sqrt(max(0.0, gap)), omega + primal), min(total, gap))
