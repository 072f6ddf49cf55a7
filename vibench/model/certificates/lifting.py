"""Liftings of constraint violations that are known by their values on the contact unknowns, at the cost of those.

Of all w with given values w_E on the contact unknowns E, w = X⁻¹ E c with c = C⁻¹ w_E, C = Eᵀ X⁻¹ E, has the smallest
norm ‖w‖² = cᵀ C c. As B w depends on w_E alone, the minimiser of

    ½ γ ‖w‖² + λᵀ B w    subject to    B w ≥ s

is of this form with γ c = Bᵀ(ν − λ), multipliers ν ≥ 0 and complementarity. Let I be the rows with λ > 0 and those that
other w violate, S = (B C Bᵀ)_II / γ, and v = (B w − s)_I. Then ν = λ + S⁻¹(s + v) on I: a linear complementarity
problem for v ≥ 0 and ν ≥ 0, solved by a primal-dual active set method from v = 0, where λ > 0 costs nothing
(Hintermüller, Ito and Kunisch, 2002). Few rows leave v = 0, so that one factorisation of S serves all steps.

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

STEPS = 30
"""Steps of the active set method for one I."""

EXTENSIONS = 10
"""How often rows are added to I."""

ATTEMPTS = 4
"""Margins that are tried, each at least ten times the one before."""

MARGIN = 4.0
"""The first margin of s, as a multiple of the round-off in s."""

REGULAR = 1e-13
"""Share of the largest diagonal entry of S that is added to all, so that dependent rows have a factorisation."""

UNIT = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Lifting:
    """A w = X⁻¹ E c with B w ≥ s.

    Attributes
    ----------
    unknowns, load
        Positions (l,) of the contact unknowns where c is not zero, and its values there.
    norm
        ‖w‖ in X.
    kappa
        λᵀ(B w − s) ≥ 0.
    """

    unknowns: Indices
    load: Array
    norm: float
    kappa: float


@dataclass(frozen=True)
class ContactCompliance:
    """C on all contact unknowns, and on those that liftings usually involve.

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
    def blocks(self) -> tuple[tuple[Indices, Indices, Array], tuple[Indices, Indices, Array]]:
        """Unknowns, the position of every unknown among them or −1, and C on them: the near ones, and all."""
        return self._block(self.near), self._block(np.arange(len(self.matrix)))

    def _block(self, chosen: Indices) -> tuple[Indices, Indices, Array]:
        position = np.full(len(self.matrix), -1, np.intp)
        position[chosen] = np.arange(len(chosen))
        return chosen, position, np.ascontiguousarray(self.matrix[np.ix_(chosen, chosen)])


def lift(
    compliance: ContactCompliance, contact: Contact, on_contact: Array, uncertain: Array, lam: Array, gamma: float
) -> Lifting | None:
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
    size, terms = sp.csr_array((np.abs(B.data), B.indices, B.indptr), B.shape), 1.01 * UNIT * (np.diff(B.indptr) + 4.0)
    excess = B @ on_contact - contact.g
    round_off = 1.01 * (size @ uncertain) + terms * (size @ np.abs(on_contact) + np.abs(contact.g))
    reach = size @ compliance.root
    for unknowns, position, C in compliance.blocks:
        inside = position[B.indices] >= 0
        restricted = sp.csr_array((B.data * inside, np.maximum(position[B.indices], 0), B.indptr), (len(lam), len(C)))
        near = np.ones(len(lam), bool)
        near[np.repeat(np.arange(len(lam)), np.diff(B.indptr))[~inside]] = False
        if not near[lam > 0.0].all():
            continue
        found = _Program(C, restricted, near, excess, round_off, reach, terms, lam, gamma).best()
        if found is not None:
            return Lifting(unknowns, *found)
    return None


class _Program:
    """The program above in the unknowns of a block of C; rows that are not `near` involve others, too."""

    def __init__(
        self,
        C: Array,
        B: SparseMatrix,
        near: Mask,
        excess: Array,
        round_off: Array,
        reach: Array,
        terms: Array,
        lam: Array,
        gamma: float,
    ) -> None:
        self._C, self._B, self._near, self._gamma, self._lam = C, B, near, gamma, lam
        self._size = sp.csr_array((np.abs(B.data), B.indices, B.indptr), B.shape)
        self._excess, self._round_off, self._reach, self._terms = excess, round_off, reach, terms

    def best(self) -> tuple[Array, float, float] | None:
        """C on the unknowns of the block, the norm of w, and κ."""
        margin = MARGIN * self._round_off
        for _ in range(ATTEMPTS):
            for load, values, norm in self._minimisers(self._excess + margin):
                slack = self._B @ values - self._excess
                lacking = self._terms * (self._size @ np.abs(values)) + self._round_off - slack
                far = self._reach * norm * (1.0 + 1e-10) + self._excess + self._round_off
                lacking = np.where(self._near, lacking, far)
                if np.all(lacking <= 0.0):  # NaN is not
                    return load, norm, max(0.0, float(self._lam @ slack))
                if np.any(lacking[~self._near] > 0.0):
                    return None
                margin = np.maximum(margin, 2.0 * np.nan_to_num(lacking, nan=0.0, posinf=0.0))
            margin = 10.0 * margin
        return None

    def _minimisers(self, excess: Array) -> Iterator[tuple[Array, Array, float]]:
        """The last w of the active set method: c, w on the unknowns of the block, and its norm."""
        chosen = self._lam > 0.0
        for _ in range(EXTENSIONS):
            rows = np.flatnonzero(chosen)
            load = np.zeros(len(self._C))
            if len(rows):
                block = self._B[rows]
                load = (block.T @ self._difference(block, excess[rows], self._lam[rows])) / self._gamma
            values = self._C @ load
            violated = self._near & ~chosen & (excess - self._B @ values > self._round_off)
            if not violated.any():
                yield load, values, float(np.sqrt(max(0.0, float(load @ values))))
                return
            chosen |= violated

    def _difference(self, block: SparseMatrix, excess: Array, lam: Array) -> Array:
        """ν − λ on the rows I of a block of B, from s and λ there."""
        S = (block @ (block @ self._C).T) / self._gamma
        S[np.diag_indices_from(S)] += REGULAR * S.diagonal().max()
        factor, singular = dpotrf(S, lower=1, clean=0)
        if singular:
            return np.asarray(np.linalg.lstsq(S, excess)[0])
        return _complementary(factor, excess, lam) - lam


def _complementary(factor: Array, excess: Array, lam: Array) -> Array:
    """ν ≥ 0 (i,) with ν = λ + S⁻¹(s + v), v ≥ 0 and νᵀv = 0, from the Cholesky factor (lower) of S."""
    fixed: Array = lam + dpotrs(factor, excess, lower=1)[0]
    nu, v, released = fixed, np.zeros(len(lam)), np.zeros(len(lam), bool)
    inverse, known = np.zeros((len(lam), len(lam)), order="F"), np.zeros(len(lam), bool)  # some columns of S⁻¹
    for _ in range(STEPS):
        wanted = np.where(released, v >= 0.0, nu < 0.0)
        if np.array_equal(wanted, released):
            break
        released, new = wanted, np.flatnonzero(wanted & ~known)
        if len(new):
            units = np.zeros((len(lam), len(new)), order="F")
            units[new, np.arange(len(new))] = 1.0
            inverse[:, new], known[new] = dpotrs(factor, units, lower=1, overwrite_b=1)[0], True
        rows, v = np.flatnonzero(released), np.zeros(len(lam))
        among = inverse[:, rows]
        v[rows] = np.linalg.solve(among[rows], -fixed[rows])
        nu = fixed + among @ v[rows]
        nu[rows] = 0.0
    return np.maximum(nu, 0.0)
