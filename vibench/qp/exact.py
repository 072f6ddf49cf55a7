"""Programs with parallel, opposite or dependent constraints: which rows matter, and solutions up to round-off.

Rows b u ≤ g and −c b u ≤ g', c > 0, with c g + g' = 0 are the equality b u = g. No u satisfies both by a margin, and
they are linearly dependent. An equality in their place, with a multiplier of any sign, has neither defect: its positive
part belongs to the one row, its negative part to the other.

Programs are solved as least distance problems: reduced ones as a whole, as a reference for QP solvers; large sparse
ones with the constraints that the solution so far violates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.linalg.lapack import dtrtrs
from scipy.optimize import nnls

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.interfaces.absent_rows import ABSENT, is_absent, zero_rows
from vibench.interfaces.dual_sets import RAYS, DualSet
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg import EPS
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.inner_product import project_out
from vibench.qp.scaling import row_norms, size

# Residuals below this fraction of their terms are round-off.
ROUND_OFF = 1e-12


@dataclass(frozen=True)
class Rows:
    """The rows that matter: their numbers `kept` (k,), rising, and which of them are equalities (k,)."""

    kept: Indices
    equal: Mask
    # For equalities the row on the other side (k,), and the length of this row over that of the other.
    opposite: Indices
    ratio: Array
    # Rows (m,) that need no check of their own: equalities, those parallel to them, absent and zero ones. Nor do those
    # that are no rays, which no u violates.
    implied: Mask

    @property
    def equalities(self) -> Indices:
        """The numbers (e,) of equalities."""
        return self.kept[self.equal]

    @property
    def tied(self) -> Mask:
        """Rows (m,) that are equalities with another one; their multipliers need no sign, and open no gap."""
        tied = np.zeros(len(self.implied), bool)
        tied[self.equalities] = tied[self.opposite[self.equal]] = True
        return tied

    def program(self, vi: VariationalInequality) -> VariationalInequality:
        """The program `vi` with these rows alone."""
        return vi if len(self.kept) == len(vi.g) else vi.kept(self.kept)

    def multipliers(self, forces: Array, count: int) -> Array:
        """Multipliers λ ≥ 0 (m,) from those (k,) of the rows that matter, of any sign on equalities."""
        lam = np.zeros(count)
        lam[self.kept] = np.where(self.equal, np.maximum(forces, 0.0), forces)
        lam[self.opposite[self.equal]] = (self.ratio * np.maximum(-forces, 0.0))[self.equal]
        return lam


@dataclass(frozen=True)
class Directions:
    """Rows of one matrix that are parallel."""

    # Euclidean norms (m,) of all rows.
    lengths: Array
    # The rows (p,) that are parallel to others, the number of the direction of each, and its sign in it.
    members: Indices
    group: Indices
    side: Array

    @classmethod
    def of(cls, B: SparseMatrix | Array, present: Mask) -> Directions:
        """Find parallel rows of B (m×n) among those that are `present` (m,)."""
        lengths = row_norms(B)
        # Parallel rows of length 1 have the same product with a random vector but for round-off, which few others have.
        probes = B @ _probe(B.shape[1]) / lengths
        rows = np.flatnonzero(present & (probes != 0.0))
        rows = rows[np.argsort(np.abs(probes[rows]), kind="stable")]
        sizes = np.abs(probes[rows])
        group = np.cumsum(np.diff(sizes, prepend=-1.0) > 1e-12 * (1.0 + sizes)) - 1
        first = np.flatnonzero(np.diff(group, prepend=-1))
        shared = np.bincount(group, minlength=len(first))[group] > 1
        rows, first, group = rows[shared], rows[first][group][shared], group[shared]
        if not len(rows):
            return cls(lengths, rows, group, np.zeros(0))
        side = np.sign(probes)
        unit = sp.csr_array(sp.diags_array(side / lengths) @ B)
        gaps = abs(unit[rows] - unit[first]).max(axis=1)
        # Both rows were scaled to length 1 with a rounding.
        same = np.asarray(gaps.todense()).ravel() <= 8.0 * EPS
        return cls(lengths, rows[same], group[same], side[rows[same]])


@lru_cache(maxsize=4)  # new random numbers would cost more than the product
def _probe(count: int) -> Array:
    return np.random.default_rng(0).standard_normal(count)


def rows_that_matter(
    B: SparseMatrix | Array, g: Array, room: Array, preferred: Array | None = None,
    directions: Directions | None = None, K: DualSet = RAYS,
) -> Rows:  # fmt: skip
    """Find the rows of B (m×n) and g (m,) that matter: the tightest of parallel ones, one equality for opposite ones.

    Absent rows, and zero ones that hold, do not matter.
    Opposite rows are an equality where there is at most some `room` (m,) between them, in the unit of g. It is
    represented by the row with the larger entry of `preferred` (m,), in units of its length. `directions` are those of
    the rays that are not absent, where they are known. Rows of other blocks of K matter as they are.
    """
    m, rays = len(g), K.rays(len(g))
    dropped, equal, opposite, ratio = is_absent(g), np.zeros(m, bool), np.arange(m), np.ones(m)
    dropped |= zero_rows(B) & (g >= 0.0)
    dropped &= rays
    implied = dropped | ~rays
    directions = directions or Directions.of(B, ~implied)
    if not len(directions.members):
        kept = np.flatnonzero(~dropped)
        return Rows(kept, equal[kept], kept, ratio[kept], implied)
    lengths, members, group, side = directions.lengths, directions.members, directions.group, directions.side
    bounds = g[members] / lengths[members]
    order = np.lexsort((members, bounds, side, group))
    members, group, side, bounds = members[order], group[order], side[order], bounds[order]
    tightest = np.flatnonzero((np.diff(group, prepend=-1) != 0) | (np.diff(side, prepend=0) != 0))
    dropped[members] = True
    dropped[members[tightest]] = False
    # A group has at most one tightest row on either side, and these follow each other.
    both, of_equalities = np.flatnonzero(np.diff(group[tightest]) == 0), []
    for low, high in zip(tightest[both], tightest[both + 1], strict=True):
        i, j = int(members[low]), int(members[high])
        if abs(bounds[low] + bounds[high]) <= max(room[i] / lengths[i], room[j] / lengths[j]):
            if preferred is not None and preferred[j] * lengths[j] > preferred[i] * lengths[i]:
                i, j = j, i
            dropped[j], equal[i], opposite[i], ratio[i] = True, True, j, lengths[i] / lengths[j]
            of_equalities.append(group[low])
    implied[members[np.isin(group, of_equalities)]] = True
    kept = np.flatnonzero(~dropped)
    return Rows(kept, equal[kept], opposite[kept], ratio[kept], implied)


@dataclass(frozen=True)
class ExactSolution:
    """The solution x (n,) of a program, and multipliers α (m,); there may be others where these are not `unique`."""

    x: Array
    alpha: Array
    unique: bool


def exact_solution(program: VariationalInequality) -> ExactSolution | None:
    """Solve a dense program up to round-off; `None` if it has no solution or is too badly conditioned.

    With A = L Lᵀ and z = L⁻¹(f − Ax) the program is a least distance problem, min ‖z‖ subject to Cᵀz ≥ d, C = L⁻¹Bᵀ.
    Nonnegative least squares finds its active set (Lawson and Hanson 1974, chapter 23); orthogonal factors of the
    active columns of C then give z and the multipliers without squaring the condition number. Where round-off has
    misled the first set, a primal–dual active set method continues from it.
    """
    if not len(program.f):
        return ExactSolution(np.zeros(0), np.zeros(len(program.g)), unique=True)
    # Reduced constraints are sums of products of absent ones with generators of any unit, and so absent much earlier.
    if (absent := program.g >= 1e-50 * ABSENT).any():
        if (present := exact_solution(replace(program, B=program.B[~absent], g=program.g[~absent]))) is None:
            return None
        alpha = np.zeros(len(absent))
        alpha[~absent] = present.alpha
        return replace(present, alpha=alpha)
    try:
        for member in (program.A, program.f, program.B, program.g):
            np.asarray_chkfinite(member)
        whitened = _Whitened(program, np.linalg.cholesky(program.A))
    except (ValueError, np.linalg.LinAlgError):
        return None
    return _active_set_solution(program, whitened)


def _active_set_solution(program: VariationalInequality, whitened: _Whitened) -> ExactSolution | None:
    active, seen = whitened.least_distance_set(), set[bytes]()
    for _ in range(20):  # active sets after the first; few programs need more than two
        x, alpha = whitened.solve_active(active)
        if not (np.all(np.isfinite(x)) and np.all(np.isfinite(alpha))):  # something has overflowed
            return None
        # Compare an excess with the terms that it is the difference of: g alone may be small.
        excess, terms = program.B @ x - program.g, np.abs(program.B) @ np.abs(x) + np.abs(program.g)
        violated, pulling = excess > ROUND_OFF * terms + whitened.noise, alpha < -ROUND_OFF * size(alpha)
        if not np.any(violated) and not np.any(pulling):
            alpha = np.maximum(alpha, 0.0)
            forces = np.abs(program.A) @ np.abs(x) + np.abs(program.f) + np.abs(program.B.T) @ alpha
            if np.any(np.abs(program.A @ x - program.f + program.B.T @ alpha) > ROUND_OFF * np.max(forces)):
                return None
            # Only constraints without slack may carry a multiplier, which is unique where they are independent.
            tight = excess > -1e-8 * terms
            return ExactSolution(x, alpha, len(whitened.factorise(tight)[0]) == int(np.sum(tight)))
        seen.add(active.tobytes())
        active = violated | (active & ~pulling)
        if active.tobytes() in seen:
            return None
    return None


def least_distance_solution(
    vi: VariationalInequality, factor: SparseCholesky, equal: Mask, start: Mask
) -> tuple[Array, Array] | None:
    """Find the solution u (n,) and λ (m,) of a sparse program whose constraints may be dependent; `None` if it fails.

    `factor` is that of A. Constraints that are `equal` (m,) have multipliers of any sign; those in `start` (m,) come
    first.
    """
    B, lengths = sp.csr_array(vi.B), row_norms(vi.B)
    chosen, load = start | equal, factor.solve_factor_transposed(vi.f)
    for _ in range(20):  # constraints are added so often; each time all violated ones are
        rows = np.flatnonzero(chosen)
        scaled = sp.csr_array(sp.diags_array(1.0 / lengths[rows]) @ B[rows])
        K = factor.solve_factor_transposed(scaled.toarray().T)
        if (forces := least_distance(K, load, vi.g[rows] / lengths[rows], equal[rows])) is None:
            return None
        lam = np.zeros(len(vi.g))
        lam[rows] = forces / lengths[rows]
        u = factor.solve(vi.f - B.T @ lam)
        violated = ~chosen & (B @ u - vi.g > ROUND_OFF * lengths * (size(u) + np.abs(vi.g) / lengths))
        if not violated.any():
            return u, lam
        chosen |= violated
    return None


def least_distance(K: Array, load: Array, g: Array, equal: Mask) -> Array | None:
    """Multipliers (k,) of min ½|y|² − loadᵀy subject to Kᵀy ≤ g, or = g where `equal`; `None` if none are found.

    The columns of K (n×k) may be dependent; the point itself is y = load − K · multipliers.
    """
    held, free, forces = np.flatnonzero(equal), np.flatnonzero(~equal), np.zeros(len(g))
    independent, Q, R = _independent_columns(K[:, held])
    held = held[independent]
    prescribed = scipy.linalg.solve_triangular(R, g[held], trans="T") if len(held) else np.zeros(0)
    rest = project_out(Q, K[:, free])
    # Constraints of which nothing is left follow from the equalities.
    left = np.linalg.norm(rest, axis=0) > 1e-10 * np.linalg.norm(K[:, free], axis=0)
    free, rest = free[left], rest[:, left]
    along = Q.T @ K[:, free]
    P, S = np.linalg.qr(rest)
    inner = exact_solution(VariationalInequality(np.eye(P.shape[1]), P.T @ load, S.T, g[free] - along.T @ prescribed))
    if inner is None:
        return None
    forces[free] = inner.alpha
    if len(held):
        forces[held] = scipy.linalg.solve_triangular(R, Q.T @ load - along @ inner.alpha - prescribed)
    return forces


def _independent_columns(K: Array) -> tuple[Indices, Array, Array]:
    """A largest independent set of columns (r,) of K (n×k), and their QR factors (n×r, r×r)."""
    if not K.shape[1]:  # LAPACK does not factorise matrices without columns
        return np.zeros(0, np.intp), np.zeros((len(K), 0)), np.zeros((0, 0))
    q, r, order = scipy.linalg.qr(K, mode="economic", pivoting=True)
    pivots = np.abs(np.diag(r))
    rank = int(np.sum(pivots > 1e-10 * np.max(pivots, initial=0.0)))
    return order[:rank], q[:, :rank], r[:rank, :rank]


class _Whitened:
    """A program in the coordinates z = L⁻¹(f − A x), in which its constraints are Cᵀz ≥ d, in units of their norms."""

    def __init__(self, program: VariationalInequality, L: Array) -> None:
        self._program, self._L, self._rows = program, L, row_norms(program.B)
        self._C, self._load = self._whiten((program.B / self._rows[:, None]).T), self._whiten(program.f)
        self._factors: tuple[bytes, tuple[Indices, Array, Array]] | None = None
        # Round-off in B x that is left of the load where forces balance it, which is all of x where constraints hold it
        # at zero.
        self.noise = 32.0 * EPS * self._rows * np.linalg.norm(self._C, axis=0) * np.linalg.norm(self._load)

    def _whiten(self, right: Array) -> Array:
        return _solve_triangular(self._L, right, lower=True)

    def least_distance_set(self) -> Mask:
        """Constraints that are active in min ‖z‖ subject to Cᵀz ≥ d; none where nonnegative least squares fails."""
        d = self._C.T @ self._load - self._program.g / self._rows
        if not len(d):
            return np.zeros(0, dtype=bool)
        system = np.vstack([self._C / size(self._C), d / size(d)])
        try:
            weights, _ = nnls(system, np.append(np.zeros(len(self._C)), 1.0), maxiter=30 * max(system.shape))
        except RuntimeError:
            return np.zeros(len(d), dtype=bool)
        return np.asarray(weights > 0.0)

    def factorise(self, chosen: Mask) -> tuple[Indices, Array, Array]:
        """A largest independent set of chosen constraints, and the QR factors of their columns of C."""
        # Cached: where no other constraint is tight, the factors of the active ones are needed twice.
        key = chosen.tobytes()
        if self._factors is None or self._factors[0] != key:
            columns = np.flatnonzero(chosen)
            independent, q, r = _independent_columns(self._C[:, columns])
            self._factors = key, (columns[independent], q, r)
        return self._factors[1]

    def solve_active(self, active: Mask) -> tuple[Array, Array]:
        """Solution x (n,), α (m,) with the active constraints as equalities, refined once."""
        held, q, r = self.factorise(active)
        program, B = self._program, self._program.B[held] / self._rows[held, None]
        x, alpha = np.zeros(len(program.f)), np.zeros(len(program.g))
        for _ in range(2):  # the second time for the residual of the first
            load = self._whiten(program.f - program.A @ x - program.B.T @ alpha)
            right = r.T @ (q.T @ load) - (program.g[held] / self._rows[held] - B @ x)
            y = _solve_triangular(r, right, transposed=True)
            x = x + _solve_triangular(self._L, load - q @ y, lower=True, transposed=True)
            alpha[held] += _solve_triangular(r, y) / self._rows[held]
        return x, alpha


def _solve_triangular(factor: Array, right: Array, *, lower: bool = False, transposed: bool = False) -> Array:
    """Solve with a triangular matrix (k×k) by LAPACK, without SciPy's checks, which cost more than the solution.

    Raises a `LinAlgError` if the matrix is exactly singular.
    """
    if not right.size:
        return np.zeros_like(right)
    solved, singular = dtrtrs(factor.T, right, lower=not lower, trans=not transposed)
    if singular:
        raise np.linalg.LinAlgError("a triangular matrix is singular")
    return np.asarray(solved)
