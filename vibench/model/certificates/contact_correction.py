"""Corrections of constraint violations that are known by their values on the contact unknowns, at the cost of those.

Of all w with given values w_E on the contact unknowns E, w = X⁻¹ E c with c = C⁻¹ w_E, C = Eᵀ X⁻¹ E, has the smallest
norm ‖w‖² = cᵀ C c. As B w depends on w_E alone, the minimiser of ½ γ ‖w‖² + λᵀ B w subject to B w ≥ s is of this form
with γ c = Bᵀ(ν − λ), multipliers ν ≥ 0 and complementarity. Let S = B C Bᵀ / γ and v = B w − s. Let I be the rows with
λ_i > 0 in which releasing λ_i alone violates the constraint, λ_i S_ii > −s_i, and those that other w violate; on the
other rows, J, ν = 0. Then ν = λ + S_II⁻¹(s + v + S_IJ λ_J) on I, with v ≥ 0 and ν ≥ 0. Few rows leave v = 0, so that
one factorisation of S_II serves all steps. Optimality of w is not verified, feasibility is. Rows far from the contact
are skipped if |B w| ≤ Σ_j |B_ij| √C_jj ‖w‖, the inequality of Cauchy and Schwarz, suffices. The computed C decides
on no row: w has the values C c, and is within μ ‖w‖ of X⁻¹ E c, with the μ of `vibench.model.certificates.base`.

**Complementarity.** ν = ν₀ + M v ≥ 0, v ≥ 0, νᵀv = 0, with M symmetric positive definite, has one solution. The
primal-dual active set method (Hintermüller, Ito and Kunisch, 2002) takes few steps, but it may cycle where M is no
M-matrix. Then v is found as the minimiser of ½ vᵀM v + ν₀ᵀv over v ≥ 0 by the method of Lawson and Hanson (Solving
Least Squares Problems, 1974, chapter 23), whose objective falls in every step. Round-off decides where ν and v are both
zero: SciPy's own method, which does not bound it, returns wrong solutions in such cases (1.17.1).

**Intervals.** A bounded K asks nothing of w, and every w has a κ: active sets of three states find the best one.

**Equalities.** The rows of a row and its opposite are dependent. The program is then solved as a least distance problem
in y, w_E = L y, with C = L Lᵀ and ‖w‖ = |y|. The w' that holds them is within η of w (`vibench.model.bound_terms`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.linalg.lapack import dposv, dpotrf, dpotrs

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.highfidelity.active_set import active_set_iterations
from vibench.highfidelity.kkt_systems import ActiveSetSystem
from vibench.interfaces.dual_sets import RAYS, DualSet
from vibench.interfaces.problem import Contact
from vibench.linalg import EPS
from vibench.linalg.definite import BlockDiagonal
from vibench.model.bound_terms import Equalities, first_margin
from vibench.qp.exact import least_distance, rows_that_matter
from vibench.qp.scaling import row_norms


def complementary(fixed: Array, rows_of: Callable[[Indices], Array], released: Mask) -> Array:
    """The multiplier ν (i,) of ν₀ (i,) up to round-off; its correction has to be verified in any case.

    `rows_of` gives rows of M (·×i) by their numbers. `released` are those where v may be positive at first (i,); the
    systems that are solved have the size of such sets.
    """
    # two or three exchanges are usual; after 30 they cycle
    for _ in range(30):
        rows = released.nonzero()[0]
        nu, wrong = fixed, fixed < 0.0
        if len(rows):
            among = rows_of(rows)
            _, v, singular = dposv(among[:, rows], -fixed[rows])
            # A cycle or a singular system is left to the descent, which needs no start.
            if singular:
                break
            nu = fixed + v @ among
            nu[rows] = 0.0
            wrong = nu < 0.0
            wrong[rows] = v < 0.0
        if not wrong.any():
            return nu
        released = released != wrong
    return fixed + descent(rows_of(np.arange(len(fixed))), fixed)


def descent(M: Array, fixed: Array) -> Array:
    """The product M v (i,) for the minimiser v ≥ 0 of ½ vᵀM v + ν₀ᵀv, up to round-off.

    Lawson and Hanson's `w` is −ν here, their `z` is the solution on the set of positive unknowns.
    """
    size, unit = len(fixed), 1.0 / np.sqrt(M.diagonal())
    v, positive, passed = np.zeros(size), np.zeros(size, bool), np.zeros(size, bool)
    # as many steps as unknowns are usual; round-off alone could make it go on
    for _ in range(20 * size):
        nu = fixed + M @ v + EPS * size * (np.abs(fixed) + np.abs(M) @ v)
        nu[positive | passed] = 0.0
        entering = int(np.argmin(nu * unit))
        if nu[entering] >= 0.0:
            break
        positive[entering], first = True, True
        while (rows := positive.nonzero()[0]).size:
            z = np.zeros(size)
            _, z[rows], singular = dposv(M[np.ix_(rows, rows)], -fixed[rows])
            if singular:
                return np.asarray(M @ v)
            # round-off made the sign of ν there: skip the unknown until another one has moved; NaN is not positive
            if first and not z[entering] > 0.0:
                positive[entering], passed[entering] = False, True
                break
            blocking, first = positive & (z <= 0.0), False
            if not blocking.any():
                v, passed = z, np.zeros(size, bool)
                break
            steps = np.full(size, np.inf)
            steps[blocking] = v[blocking] / (v[blocking] - z[blocking])
            v = v + steps.min() * (z - v)
            positive &= ~(blocking & (steps <= steps.min())) & (v > 0.0)
            v[~positive] = 0.0
    return np.asarray(M @ v)


@dataclass(frozen=True)
class ContactCorrection:
    """Correction w = X⁻¹ E c with B w ≥ s."""

    # Positions (l,) of the contact unknowns where c is not zero, and its values there.
    unknowns: Indices
    load: Array
    # ‖w‖ in X.
    norm: float
    # λᵀ(B w − s) ≥ 0.
    kappa: float
    # ν ≥ 0 (m,) with γ c = Bᵀ(ν − λ), and νᵀ(B w − s) ≥ 0, which is zero but for round-off where w is the best one. ν
    # is `None` for a w that holds dependent rows as equalities, with forces that pull: no such ν is known.
    nu: Array | None
    gap: float
    # Where there are equalities, another w' satisfies B w' ≥ s, with ‖w' − w‖ at most this; the others are of w'.
    eta: float
    # Bound of the distance of w from the one that belongs to ν, by round-off.
    away: float


@dataclass(frozen=True)
class ContactCompliance:
    """The compliance C (k×k) on all contact unknowns, and on those that corrections usually involve.

    `near` are positions (l,), rising, of the unknowns that rows near the support of the generators touch. `error` is
    the μ of C (`vibench.model.certificates.base`).
    """

    matrix: Array
    near: Indices
    error: float

    @cached_property
    def root(self) -> Array:
        """Roots √C_jj (k,)."""
        return np.asarray(np.sqrt(np.diag(self.matrix)))

    @cached_property
    def blocks(self) -> list[tuple[Indices, Indices, BlockDiagonal]]:
        """Unknowns, the position of every unknown among them or −1, and C on them: the near ones, and all."""
        found = []
        for chosen in (self.near, np.arange(len(self.matrix))):
            position = np.full(len(self.matrix), -1, np.intp)
            position[chosen] = np.arange(len(chosen))
            found.append((chosen, position, BlockDiagonal.of(self.matrix[np.ix_(chosen, chosen)])))
        return found


def unknowns_near(B: SparseMatrix, generators: Array) -> Mask:
    """Contact unknowns (k,) that rows of B (m×k) in the support of a generator χ (m×R), or next to it, touch."""
    touches, rows = abs(sp.csr_array(B)) > 0.0, np.any(generators > 0.0, axis=1)
    # One ring of neighbours around the support: corrections seldom reach farther.
    return np.asarray(touches.T @ (touches @ (touches.T @ rows)), bool)


def find_contact_correction(
    compliance: ContactCompliance, contact: Contact, on_contact: Array, uncertain: Array, lam: Array, gamma: float
) -> ContactCorrection | None:
    """Find a w with B w ≥ s = B u_N − g, close to the best one for λ ≥ 0 (m,) and γ; `None` if none was found.

    `on_contact` is u_N (k,) on the contact unknowns, and `uncertain` a bound (k,) of its round-off.
    """
    program = _Program(compliance, contact, on_contact, uncertain, lam, gamma)
    # The near unknowns are tried first: their rows are enough unless λ or a violation is elsewhere.
    for block in compliance.blocks:
        if program.restrict(*block) and (found := program.best()) is not None:
            return found
    return program.tied()


def bounded_correction(
    compliance: ContactCompliance, contact: Contact, on_contact: Array, uncertain: Array, lam: Array, gamma: float,
    K: DualSet,
) -> ContactCorrection:  # fmt: skip
    """The best w for λ in intervals K (m,), or w = 0 where active sets cycle: every w has a κ.

    ν − λ minimises ½ dᵀS d − sᵀd over λ + d ∈ K, with S = B C Bᵀ/γ; there is no row that w has to satisfy.
    """
    program = _Program(compliance, contact, on_contact, uncertain, lam, gamma)
    B, s, reached = program.B, program.excess, np.asarray(program.B @ compliance.matrix)
    S = np.asarray(B @ reached.T) / gamma

    def solve_active(active: Indices, fixed: Array | None = None) -> tuple[Array, Array]:
        difference = -lam if fixed is None else fixed - lam
        difference[active] = 0.0
        difference[active] = np.linalg.solve(S[np.ix_(active, active)], (s - S @ difference)[active])
        return difference @ reached / gamma, lam + difference

    system = ActiveSetSystem(-B, -s, solve_active, np.asarray, np.asarray, K=K)
    found = active_set_iterations(system, K.free(lam))
    nu = lam if found is None else K.project(found[1])
    load = np.asarray(B.T @ (nu - lam)) / gamma
    values, unit = compliance.matrix @ load, 1.01 * EPS * (len(load) + len(lam) + 8.0)
    size = float(compliance.root @ np.abs(load))
    norm = float(np.sqrt((max(0.0, float(load @ values)) + 2.0 * unit * size**2) * (1.0 + compliance.error)))
    rounded = program.terms * (program.sizes @ np.abs(values)) + program.round_off + program.reach * unit * size
    slack = B @ values - s
    kappa, gap = (K.gap(one, slack, rounded) for one in (lam, nu))
    away = compliance.error * norm + unit * float(program.reach @ (np.abs(nu) + np.abs(lam))) / gamma
    return ContactCorrection(np.arange(len(load)), load, norm, kappa, nu, gap, 0.0, away)


class _Program:
    """The program for w of one solution, on all contact unknowns or on some of them."""

    def __init__(
        self, whole: ContactCompliance, contact: Contact, on_contact: Array, uncertain: Array, lam: Array, gamma: float
    ) -> None:
        B = sp.csr_array(contact.B)
        if not B.has_canonical_format or len(B.indices) > B.nnz:
            B = B.copy()
            B.sum_duplicates()
        self.whole, self.B, self.g, self.lam, self.gamma = whole, B, contact.g, lam, gamma
        # |B|, the terms of s, their number times the round-off of one, and the round-off of s
        self.sizes, self.terms = _absolute(B), 1.01 * EPS * (np.diff(B.indptr) + 4.0)
        self.excess = B @ on_contact - contact.g
        self.total = self.sizes @ np.abs(on_contact) + np.abs(contact.g)
        self.round_off = 1.01 * (self.sizes @ uncertain) + self.terms * self.total
        self.reach = self.sizes @ whole.root

    def restrict(self, unknowns: Indices, position: Indices, C: BlockDiagonal) -> bool:
        """Leave the unknowns of a block of C; false where there are none, or λ presses rows that involve others."""
        B, rows = self.B, np.diff(self.B.indptr)
        inside = position[B.indices] >= 0
        # rows that involve no other unknown
        self.near = np.ones(len(rows), bool)
        self.near[np.repeat(np.arange(len(rows)), rows)[~inside]] = False
        if not len(C) or not self.near[self.lam > 0.0].all():
            return False
        places = np.maximum(position[B.indices], 0)
        self.own = sp.csr_array((B.data * inside, places, B.indptr), (len(rows), len(C)))
        self.unknowns, self.C, self.root = unknowns, C, self.whole.root[unknowns]
        return True

    def best(self) -> ContactCorrection | None:
        """The best correction on the unknowns that are left; `None` if it is not feasible."""
        B, lam, margin, size = self.own, self.lam, first_margin(self.round_off), _absolute(self.own)
        unit = 1.01 * EPS * (len(self.root) + len(lam) + 8.0)
        for _ in range(4):
            if (found := self._minimiser(self.excess + margin)) is not None:
                load, values, norm, nu = found
                slack = B @ values - self.excess
                # with the round-off in C c
                uncertain = unit * float(self.root @ np.abs(load))
                rounded = self.terms * (size @ np.abs(values)) + self.round_off + self.reach * uncertain
                # 1e-10 more than the round-off in ‖w‖ and in the bound of |B w|
                far = self.reach * norm * (1.0 + 1e-10) + self.excess + self.round_off
                lacking = np.where(self.near, rounded - slack, far)
                if np.all(lacking <= 0.0):  # NaN is not
                    pushing, most = np.maximum(nu, 0.0), slack + rounded
                    # A force pulls if ν is negative beyond the round-off in ν − λ + λ.
                    known = None if np.any(nu < -8.0 * EPS * lam) else pushing
                    away = self.whole.error * norm + unit * float(self.reach @ (pushing + lam)) / self.gamma
                    kappa, gap = RAYS.gap(lam, most), RAYS.gap(pushing, most)
                    return ContactCorrection(self.unknowns, load, norm, kappa, known, gap, 0.0, away)
                if np.any(lacking[~self.near] > 0.0):
                    return None
                margin = np.maximum(margin, 2.0 * np.nan_to_num(lacking, nan=0.0, posinf=0.0))
            margin = 10.0 * margin
        return None

    def _minimiser(self, excess: Array) -> tuple[Array, Array, float, Array] | None:
        """The last w of the active set method: c, w on the unknowns of the block, its norm, and ν of any sign."""
        size = self.reach**2 / self.gamma  # at least the diagonal of S
        chosen = (self.lam > 0.0) & (self.lam * size > -excess)
        # each extension adds all rows that w violates; ten are never needed where rows are independent
        for _ in range(10):
            difference = self._difference(chosen, excess, size)
            load = (self.own.T @ difference) / self.gamma
            values = self.C @ load
            violated = self.near & ~chosen & (excess - self.own @ values > self.round_off)
            if not violated.any():
                rounded = 2.02 * EPS * (len(load) + 4.0) * float(self.root @ np.abs(load)) ** 2
                square = (max(0.0, float(load @ values)) + rounded) * (1.0 + self.whole.error)
                return load, values, float(np.sqrt(square)), self.lam + difference
            chosen |= violated
        return None

    def _difference(self, chosen: Mask, excess: Array, size: Array) -> Array:
        """The difference ν − λ (m,) with ν = 0 on rows not chosen, or ν = λ where λ is negligible."""
        B, C, lam, rows = self.own, self.C, self.lam, np.flatnonzero(chosen)
        # Multipliers below 1e-6 of the row's slack are kept as they are: they do not change the minimiser.
        difference = np.where(chosen | (lam * size <= 1e-6 * np.abs(excess)), 0.0, -lam)
        if not len(rows):
            return difference
        # faster than a selection of rows, which checks indices
        counts = np.diff(B.indptr)
        kept, ends = np.repeat(chosen, counts), np.append(0, np.cumsum(counts[chosen])).astype(B.indptr.dtype)
        block = sp.csr_array((B.data[kept], B.indices[kept], ends), (len(rows), B.shape[1]))
        wanted = excess[rows]
        if difference.any():
            wanted = wanted - block @ (C @ (B.T @ difference)) / self.gamma
        S = C.congruent(block) / self.gamma
        # Rows may have any scale: factorise in units of their own compliance.
        units = np.sqrt(S.diagonal())
        units[~(units > 0.0)] = 1.0
        S /= np.outer(units, units)
        # 1e-13 of the diagonal, so that dependent rows have a factorisation; w is verified in any case
        S[np.diag_indices_from(S)] += 1e-13
        factor, singular = dpotrf(S, lower=1, clean=0)
        wanted, known = wanted / units, lam[rows] * units
        step = np.linalg.lstsq(S, wanted)[0] if singular else _complementary(factor, wanted, known) - known
        difference[rows] = step / units
        return difference

    def tied(self) -> ContactCorrection | None:
        """A correction that holds equalities; `None` without these, or if none was found."""
        B, lam, gamma, compliance = self.B, self.lam, self.gamma, self.whole
        # opposite rows with less room than 1e-12 of the terms of s are an equality, as in `vibench.model.error_bounds`
        rows = rows_that_matter(B, self.g, 1e-12 * self.total, lam)
        if not rows.equal.any():
            return None
        L, kept, lengths = np.linalg.cholesky(compliance.matrix), rows.kept, row_norms(B)[rows.kept]
        # what C misses of the energy of values of w, and the factor and solutions with it of C
        condition = float(np.linalg.norm(abs(scipy.linalg.solve_triangular(L, np.eye(len(L)), lower=True)) @ abs(L)))
        loss = compliance.error + 4.0 * EPS * (len(L) + 4.0) * condition**2
        if not loss <= 0.1:  # η is twice what it would be without
            return None
        whitened = np.asarray((B @ L).T)
        equalities = Equalities.from_rows(whitened[:, rows.equalities], lambda y: np.asarray(L @ y), B)
        K, load = -whitened[:, kept] / lengths / np.sqrt(gamma), -(whitened @ lam) / np.sqrt(gamma)
        margin = np.where(rows.equal, 0.0, first_margin(self.round_off)[kept])
        for _ in range(4):
            forces = least_distance(K, load, -(self.excess[kept] + margin) / lengths, rows.equal)
            if forces is None:
                return None
            w = L @ (load - K @ forces) / np.sqrt(gamma)
            missed = (B @ w - self.excess)[rows.equalities]
            w = w - equalities.step(missed)
            slack = B @ w - self.excess
            rounded = self.round_off + self.terms * (self.sizes @ np.abs(w))
            eta = equalities.distance((np.abs(slack) + rounded)[rows.equalities])
            # ν belongs to the w before the step: its distance counts twice.
            eta += equalities.distance(np.abs(missed))
            moved = equalities.reach * eta
            lacking = np.where(rows.implied, 0.0, rounded + moved - slack)
            if np.all(lacking <= 0.0):  # NaN is not
                y = scipy.linalg.solve_triangular(L, w, lower=True)
                nu = rows.multipliers(np.where(rows.equal, forces, np.maximum(forces, 0.0)) / lengths, len(lam))
                # slack may be infinite on absent rows, where multipliers are zero
                most = slack + rounded
                kappa, gap = (RAYS.gap(one, np.where(one > 0.0, most, 0.0)) + float(one @ moved) for one in (lam, nu))
                c = scipy.linalg.solve_triangular(L, y, lower=True, trans="T")
                norm = float(np.linalg.norm(y)) * (1.0 + loss)
                # also the round-off in the forces of ν − λ
                away = loss * norm + EPS * (len(L) + len(lam) + 8.0) * float(self.reach @ (lam + nu)) / gamma
                return ContactCorrection(np.arange(len(L)), c, norm + eta, kappa, nu, gap, eta, away)
            margin = 10.0 * np.maximum(margin, np.where(rows.equal, 0.0, np.nan_to_num(lacking[kept], posinf=0.0)))
        return None


def _absolute(B: SparseMatrix) -> SparseMatrix:
    """|B|; `abs` would check indices."""
    return sp.csr_array((np.abs(B.data), B.indices, B.indptr), B.shape)


def _complementary(factor: Array, excess: Array, lam: Array) -> Array:
    """The multiplier ν ≥ 0 (i,) with ν = λ + S⁻¹(s + v), v ≥ 0, νᵀv = 0, from the Cholesky factor of S."""
    fixed: Array = lam + dpotrs(factor, excess, lower=1)[0]
    inverse, computed = np.zeros((len(lam), len(lam))), np.zeros(len(lam), bool)

    def rows_of_inverse(rows: Indices) -> Array:
        if len(new := rows[~computed[rows]]):
            units = np.zeros((len(lam), len(new)), order="F")
            units[new, np.arange(len(new))] = 1.0
            inverse[new], computed[new] = dpotrs(factor, units, lower=1, overwrite_b=1)[0].T, True
        return inverse[rows]

    return np.maximum(complementary(fixed, rows_of_inverse, fixed < 0.0), 0.0)
