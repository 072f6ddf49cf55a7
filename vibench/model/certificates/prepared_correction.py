"""Corrections by a matrix that is inverted offline, where the constraint of some bodies is one matrix times a factor.

Let the loads c of w = X⁻¹ E c act on bodies, blocks of C, on which B(µ) is θ(µ) B₀, and be multiples of some rows J of
it: those that the best w holds at a training parameter. The minimiser of the program of
`vibench.model.certificates.contact_correction` over such w is c = θ B₀ᵀ(ν − λ)/γ with

    ν = λ + (γ/θ²) M (s + v) ≥ 0,    v = B w − s ≥ 0,    νᵀv = 0,    M = S₀⁻¹,    S₀ = B₀ C B₀ᵀ,    on J,

where M does not depend on the parameter. The method of `vibench.model.certificates.contact_correction` starts from
v = 0 where λ > 0 costs nothing, as there, and its systems have the size of the rows with v > 0, which are few.

Where B(µ) is θ(µ) B₀ everywhere, w is the best one, but for λ beyond J, in rows that do not touch. Where it is so on
some bodies alone, w is the best of those that deform no other body: of two equal ones in contact the correction of one
has √2 times the norm of that of both. In either case it must satisfy B w ≥ s in all rows, with the B of the parameter
and bounds of round-off. Otherwise there is no prepared one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.interfaces.dual_sets import RAYS
from vibench.linalg import EPS
from vibench.linalg.definite import connected_blocks
from vibench.model.bound_terms import first_margin
from vibench.model.certificates.contact_correction import ContactCompliance, complementary


@dataclass(frozen=True)
class PreparedCorrections:
    """Parameter-independent data of prepared corrections.

    Where B(µ) is θ(µ) B₀ everywhere arrays called (p×·) are multiplied by B₀, or by |B₀| (p = m), and have one row per
    contact unknown (p = k) otherwise.
    """

    # Where C B₀ᵀ is not zero: contact unknowns, or rows of B₀ where that is multiplied by it.
    moved: Indices
    # J (j,), rising.
    rows: Indices
    # M and S₀ (j×j).
    inverse: Array
    compliance: Array
    # |B₀| √C_ii (j,) on the rows J.
    reach: Array
    # Φ at the contact unknowns (p×d).
    basis: Array
    # Rows `moved` of C B₀ᵀ (p×j): w for unit multiples of the rows J.
    responses: Array
    # Norms of the rows of Φ, and √C_ii (p×2).
    sizes: Array
    # Coordinates (j×K) of the rows J of B₀ as functionals, in the basis of residuals.
    directions: Array
    # Bound of the number of round-off errors, of size `EPS`, in an entry of s and of B w; but for those of B.
    terms: int
    # The μ of C (`vibench.model.certificates.base`).
    error: float

    def correction(
        self, B: float | SparseMatrix, g: Array, g_size: Array, y: Array, lam: Array, gamma: float
    ) -> tuple[Array, float, float, float] | None:
        """Coordinates (K,) of X w in the basis of residuals, ‖w‖, κ, and the round-off in the coordinates, as a norm.

        `B` is θ where B(µ) is θ(µ) B₀ everywhere, else B (m×k); `g_size` is a bound (m,) of the terms that g (m,) is
        the sum of; `y` are coordinates (d,) of u_N. `None` if no w was found.
        """
        if (found := self._feasible(B, g, g_size, y, lam, gamma)) is None:
            return None
        _, a, norm, most = found
        rounded = 2.0 * self.terms * EPS * float(self.reach @ np.abs(a))
        return a @ self.directions, norm, RAYS.gap(lam, most), rounded

    def multiplier(
        self, theta: float, g: Array, g_size: Array, y: Array, lam: Array, gamma: float
    ) -> tuple[Array, float, float, float] | None:
        """The multiplier ν ≥ 0 (m,) with γ X w = Bᵀ(ν − λ), ‖w‖, and νᵀ(B w − s), where B(µ) is θ B₀ everywhere.

        Also a bound of the distance of w from the one that belongs to ν. Elsewhere w is the best of those that deform
        some bodies alone, and there is no such ν.
        """
        if (found := self._feasible(theta, g, g_size, y, lam, gamma)) is None:
            return None
        (nu, _, norm, most), on_all = found, lam.copy()
        on_all[self.rows] = np.maximum(nu, 0.0)
        away = 8.0 * EPS * abs(theta) * float(self.reach @ (on_all + lam).take(self.rows)) / gamma
        return on_all, norm, RAYS.gap(on_all, most), away + self.error * norm

    def _feasible(
        self, B: float | SparseMatrix, g: Array, g_size: Array, y: Array, lam: Array, gamma: float
    ) -> tuple[Array, Array, float, Array] | None:
        """The ν on the rows J, a with c = B₀ᵀ a, and bounds of ‖w‖ and B w − s (m,) of a w that is feasible."""
        B = B if isinstance(B, (float, sp.csr_array)) else sp.csr_array(B)
        theta, terms = (B, self.terms) if isinstance(B, float) else (1.0, self.terms + int(np.diff(B.indptr).max()))
        # B vanishes, and no load on its rows lifts anything.
        if theta == 0.0:
            return None
        excess, size, unit = _times(B, self.basis @ y) - g, _times(abs(B), self.sizes), 1.01 * terms * EPS
        round_off = unit * (float(y @ y) ** 0.5 * size[:, 0] + g_size)
        margin, here = first_margin(round_off), lam.take(self.rows)
        for _ in range(4):
            wanted, scale = (excess + margin).take(self.rows), gamma / theta**2
            released = here * self.compliance.diagonal() <= -scale * wanted
            nu = complementary(here + scale * (self.inverse @ wanted), self.inverse.__getitem__, released)
            nu = np.maximum(nu, 0.0)
            a = (theta / gamma) * (nu - here)  # c = B₀ᵀ a
            values = np.zeros(len(self.basis))
            values[self.moved] = self.responses @ a
            slack, reach = _times(B, values) - excess, float(self.reach @ np.abs(a))
            rounded = round_off + (unit * reach) * size[:, 1]
            lacking = rounded - slack
            if lacking.max() <= 0.0:  # NaN is not
                square = float(a @ (values.take(self.rows) if isinstance(B, float) else self.compliance @ a))
                norm = ((max(0.0, square) + 2.0 * unit * reach**2) * (1.0 + self.error)) ** 0.5
                return nu, a, norm, slack + rounded
            # Larger margins on J do not help if only rows beyond J are violated.
            if lacking[self.rows].max() <= 0.0:
                return None
            margin = margin + 2.0 * np.maximum(lacking, 0.0)
        return None


def _times(B: float | SparseMatrix, x: Array) -> Array:
    return np.asarray(B * x if isinstance(B, float) else B @ x)


def constant_unknowns(compliance: Array, constraints: list[SparseMatrix]) -> Mask:
    """Contact unknowns (k,) of the blocks of C on which all of the constraints (m×k) are the same matrix."""
    first, same = sp.csc_array(constraints[0]), np.ones(len(compliance), bool)
    for other in constraints[1:]:
        difference = sp.csc_array(abs(sp.csc_array(other) - first))
        same &= np.asarray(difference.max(axis=0).todense()).ravel() == 0.0
    for block in connected_blocks(compliance):
        same[block] = same[block].all()
    return same


def prepare_corrections(
    B: SparseMatrix, scaled: bool, compliance: ContactCompliance, rows: Mask, basis: Array, directions: Array
) -> PreparedCorrections | None:
    """Prepare corrections by loads that are multiples of some rows of B₀; `None` where these are dependent, or none.

    `B` is B₀ (m×k), zero on unknowns of bodies that corrections must not load; `scaled` tells whether B(µ) is θ(µ) B₀
    everywhere; `rows` (m,) are J. Φ (k×d) is taken at the contact unknowns, whose coordinates as functionals are
    `directions` (k×K).
    """
    J, B = np.flatnonzero(rows), sp.csr_array(B)
    chosen, root = B[J], compliance.root
    responses = np.asarray((chosen @ compliance.matrix).T)
    S = np.asarray(chosen @ responses)
    S = 0.5 * (S + S.T)
    # rows are dependent beyond a condition number of 1e9: M would have lost more digits than margins cover
    if not len(J) or not np.linalg.cond(S) <= 1e9:
        return None
    inverse = scipy.linalg.inv(S)
    sizes = np.column_stack([np.linalg.norm(basis, axis=1), root])
    if scaled:
        basis, responses, sizes = B @ basis, np.asarray(B @ responses), abs(B) @ sizes
    moved = np.flatnonzero(responses.any(axis=1))
    # products with Φ or M, twice with a row of B, and the operations between them
    terms = max(basis.shape[1], len(J)) + 2 * int(np.diff(B.indptr).max()) + 8
    reach, along = abs(chosen) @ root, np.asarray(chosen @ directions)
    symmetric = 0.5 * (inverse + inverse.T)
    few = np.ascontiguousarray(responses[moved])
    return PreparedCorrections(moved, J, symmetric, S, reach, basis, few, sizes, along, terms, compliance.error)
