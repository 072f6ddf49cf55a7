"""Corrections of constraint violations that are known by their values on the contact unknowns, at the cost of those.

Of all w with given values w_E on the contact unknowns E, w = X⁻¹ E c with c = C⁻¹ w_E, C = Eᵀ X⁻¹ E, has the smallest
norm ‖w‖² = cᵀ C c. As B w depends on w_E alone, the minimiser of

    ½ γ ‖w‖² + λᵀ B w    subject to    B w ≥ s

is of this form with γ c = Bᵀ(ν − λ), multipliers ν ≥ 0 and complementarity. Let S = B C Bᵀ / γ and v = B w − s. Let I
be the rows with λ_i > 0 in which releasing λ_i alone violates the constraint, λ_i S_ii > −s_i, and those that other w
violate; on the other rows, J, ν = 0. Then ν = λ + S_II⁻¹(s + v + S_IJ λ_J) on I: a linear complementarity problem for
v ≥ 0 and ν ≥ 0, solved from v = 0, where λ > 0 costs nothing, by a primal-dual active set method (Hintermüller, Ito and
Kunisch, 2002) and by one that always ends where that cycles (`vibench.model.certificates.complementarity`). Few rows
leave v = 0, so that one factorisation of S_II serves all steps.

Any w with B w ≥ s is as good as another for a bound to hold. Optimality is not verified, feasibility is: s is raised by
a margin above its round-off. Rows far from the contact are not evaluated where |B w| ≤ Σ_j |B_ij| √C_jj ‖w‖, which is
the inequality of Cauchy and Schwarz, suffices.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpotrf, dpotrs

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.interfaces.problem import Contact
from vibench.linalg import EPS
from vibench.linalg.definite import BlockDiagonal
from vibench.model.certificates.complementarity import complementary
from vibench.model.certificates.tied_correction import tied_correction
from vibench.model.error_bounds import ATTEMPTS, MARGIN

EXTENSIONS = 10
"""How often rows are added to I."""

NEGLIGIBLE = 1e-6
"""Below this share of what a row lacks, a multiplier of it does not move the minimiser."""

REGULAR = 1e-13
"""Share of the diagonal of S_II that is added to it, so that dependent rows have a factorisation."""


@dataclass(frozen=True)
class ContactCorrection:
    """A w = X⁻¹ E c with B w ≥ s.

    Attributes
    ----------
    unknowns, load
        Positions (l,) of the contact unknowns where c is not zero, and its values there.
    norm
        ‖w‖ in X.
    kappa
        λᵀ(B w − s) ≥ 0.
    nu, gap
        ν ≥ 0 (m,) with γ c = Bᵀ(ν − λ), and νᵀ(B w − s) ≥ 0, which is zero but for round-off where w is the best one.
        ν is `None` for a w that holds dependent rows as equalities, with forces that pull: no such ν is known.
    eta
        Where there are equalities, another w' satisfies B w' ≥ s, with ‖w' − w‖ at most this; the others are of w'.
    """

    unknowns: Indices
    load: Array
    norm: float
    kappa: float
    nu: Array | None
    gap: float
    eta: float = 0.0


@dataclass(frozen=True)
class ContactCompliance:
    """C on all contact unknowns, and on those that corrections usually involve.

    Attributes
    ----------
    matrix
        C (k×k).
    near
        Positions (l,) of the contact unknowns that rows near the support of the generators touch, rising.
    """

    matrix: Array
    near: Indices

    @cached_property
    def root(self) -> Array:
        """√C_jj (k,)."""
        return np.asarray(np.sqrt(np.diag(self.matrix)))

    @cached_property
    def blocks(self) -> tuple[tuple[Indices, Indices, BlockDiagonal], tuple[Indices, Indices, BlockDiagonal]]:
        """Unknowns, the position of every unknown among them or −1, and C on them: the near ones, and all."""
        return self._block(self.near), self._block(np.arange(len(self.matrix)))

    def _block(self, chosen: Indices) -> tuple[Indices, Indices, BlockDiagonal]:
        position = np.full(len(self.matrix), -1, np.intp)
        position[chosen] = np.arange(len(chosen))
        return chosen, position, BlockDiagonal.of(self.matrix[np.ix_(chosen, chosen)])


def held_rows(compliance: ContactCompliance, contact: Contact, on_contact: Array, lam: Array) -> Mask:
    """Rows (m,) that are violated, or in which the best w for u_N (k,) and λ (m,) may hold B w = s for γ = 1."""
    B = sp.csr_array(contact.B)
    excess, reach = B @ on_contact - contact.g, abs(B) @ compliance.root
    return np.asarray((excess > 0.0) | (lam * reach**2 > np.abs(excess)))


def find_contact_correction(
    compliance: ContactCompliance, contact: Contact, on_contact: Array, uncertain: Array, lam: Array, gamma: float
) -> ContactCorrection | None:
    """A w with B w ≥ s = B u_N − g, close to the best one; `None` if none was found.

    Parameters
    ----------
    compliance, contact
        C, and B (m×k) and g (m,).
    on_contact, uncertain
        u_N (k,) on the contact unknowns, and a bound (k,) of its round-off.
    lam, gamma
        λ ≥ 0 (m,) and γ.
    """
    B = sp.csr_array(contact.B)
    if not B.has_canonical_format or len(B.indices) > B.nnz:
        B = B.copy()
        B.sum_duplicates()
    size, terms = sp.csr_array((np.abs(B.data), B.indices, B.indptr), B.shape), 1.01 * EPS * (np.diff(B.indptr) + 4.0)
    excess = B @ on_contact - contact.g
    round_off = 1.01 * (size @ uncertain) + terms * (size @ np.abs(on_contact) + np.abs(contact.g))
    reach = size @ compliance.root
    for unknowns, position, C in compliance.blocks:
        if not len(C):
            continue  # no generator, no unknown near one
        inside = position[B.indices] >= 0
        restricted = sp.csr_array((B.data * inside, np.maximum(position[B.indices], 0), B.indptr), (len(lam), len(C)))
        near = np.ones(len(lam), bool)
        near[np.repeat(np.arange(len(lam)), np.diff(B.indptr))[~inside]] = False
        if not near[lam > 0.0].all():
            continue
        best = _Program(C, restricted, near, excess, round_off, reach, terms, lam, gamma).best()
        if best is not None:
            return ContactCorrection(unknowns, *best)
    total = size @ np.abs(on_contact) + np.abs(contact.g)
    tied = tied_correction(compliance.matrix, contact, excess, round_off, total, lam, gamma)
    return None if tied is None else ContactCorrection(np.arange(len(compliance.matrix)), *tied)


@dataclass(frozen=True)
class _Program:
    """The program above in the unknowns of a block of C; rows that are not `near` involve others, too."""

    compliance: BlockDiagonal
    B: SparseMatrix
    near: Mask
    excess: Array
    round_off: Array
    reach: Array
    terms: Array
    lam: Array
    gamma: float

    def best(self) -> tuple[Array, float, float, Array | None, float] | None:
        """What a `ContactCorrection` has besides its unknowns, in this order."""
        B, margin = self.B, MARGIN * self.round_off
        size = sp.csr_array((np.abs(B.data), B.indices, B.indptr), B.shape)
        for _ in range(ATTEMPTS):
            for load, values, norm, nu in self._minimisers(self.excess + margin):
                slack = self.B @ values - self.excess
                lacking = self.terms * (size @ np.abs(values)) + self.round_off - slack
                far = self.reach * norm * (1.0 + 1e-10) + self.excess + self.round_off
                lacking = np.where(self.near, lacking, far)
                if np.all(lacking <= 0.0):  # NaN is not
                    kappa, pushing = max(0.0, float(self.lam @ slack)), np.maximum(nu, 0.0)
                    pulls = np.any(nu < -8.0 * EPS * self.lam)  # beyond the round-off in ν − λ + λ
                    return load, norm, kappa, None if pulls else pushing, max(0.0, float(pushing @ slack))
                if np.any(lacking[~self.near] > 0.0):
                    return None
                margin = np.maximum(margin, 2.0 * np.nan_to_num(lacking, nan=0.0, posinf=0.0))
            margin = 10.0 * margin
        return None

    def _minimisers(self, excess: Array) -> Iterator[tuple[Array, Array, float, Array]]:
        """The last w of the active set method: c, w on the unknowns of the block, its norm, and ν of any sign."""
        size = self.reach**2 / self.gamma  # at least the diagonal of S
        chosen = (self.lam > 0.0) & (self.lam * size > -excess)
        for _ in range(EXTENSIONS):
            difference = self._difference(chosen, excess, size)
            load = (self.B.T @ difference) / self.gamma
            values = self.compliance @ load
            violated = self.near & ~chosen & (excess - self.B @ values > self.round_off)
            if not violated.any():
                yield load, values, float(np.sqrt(max(0.0, float(load @ values)))), self.lam + difference
                return
            chosen |= violated

    def _difference(self, chosen: Mask, excess: Array, size: Array) -> Array:
        """ν − λ (m,) with ν = 0 on rows that are not chosen, but for those where λ is negligible: there ν = λ."""
        lam, rows = self.lam, np.flatnonzero(chosen)
        difference = np.where(chosen | (lam * size <= NEGLIGIBLE * np.abs(excess)), 0.0, -lam)
        if not len(rows):
            return difference
        block, wanted = _selected_rows(self.B, chosen), excess[rows]
        if difference.any():
            wanted = wanted - block @ (self.compliance @ (self.B.T @ difference)) / self.gamma
        S = self.compliance.congruent(block) / self.gamma
        units = np.sqrt(S.diagonal())  # of rows, which may have any scale
        units[~(units > 0.0)] = 1.0
        S /= np.outer(units, units)
        S[np.diag_indices_from(S)] += REGULAR
        factor, singular = dpotrf(S, lower=1, clean=0)
        wanted, known = wanted / units, lam[rows] * units
        difference[rows] = (
            np.linalg.lstsq(S, wanted)[0] if singular else _complementary(factor, wanted, known) - known
        ) / units
        return difference


def _selected_rows(B: SparseMatrix, chosen: Mask) -> SparseMatrix:
    """The chosen rows of a matrix; faster than its own selection, which checks indices."""
    counts = np.diff(B.indptr)
    kept = np.repeat(chosen, counts)
    ends = np.concatenate([np.zeros(1, B.indptr.dtype), np.cumsum(counts[chosen], dtype=B.indptr.dtype)])
    return sp.csr_array((B.data[kept], B.indices[kept], ends), (len(ends) - 1, B.shape[1]))


def _complementary(factor: Array, excess: Array, lam: Array) -> Array:
    """ν ≥ 0 (i,) with ν = λ + S⁻¹(s + v), v ≥ 0 and νᵀv = 0, from the Cholesky factor (lower) of S."""
    fixed: Array = lam + dpotrs(factor, excess, lower=1)[0]
    inverse, computed = np.zeros((len(lam), len(lam))), np.zeros(len(lam), bool)

    def rows_of_inverse(rows: Indices) -> Array:
        if len(new := rows[~computed[rows]]):
            units = np.zeros((len(lam), len(new)), order="F")
            units[new, np.arange(len(new))] = 1.0
            inverse[new], computed[new] = dpotrs(factor, units, lower=1, overwrite_b=1)[0].T, True
        return inverse[rows]

    return np.maximum(complementary(fixed, rows_of_inverse, fixed < 0.0), 0.0)
