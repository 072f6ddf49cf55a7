"""Programs solved to round-off as least distance problems, whether their constraints are independent or not.

Reduced ones are solved as a whole: the part of an error that a QP solver makes is measured against these solutions. Of
large ones with sparse matrices the constraints are added that the solution so far violates.
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
from vibench.interfaces.problem import ABSENT, VariationalInequality, is_absent
from vibench.linalg import EPS
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.inner_product import project_out
from vibench.qp.scaling import row_norms, size

PARALLEL = 8.0 * EPS
"""Largest difference of entries of two parallel rows of length 1, which were scaled with a rounding."""

CLOSE = 1e-12
"""Rows of length 1 with the same product with a random vector, but for this, may be parallel."""


@dataclass(frozen=True)
class Rows:
    """The rows that matter.

    Attributes
    ----------
    kept
        Their numbers (k,), rising.
    equal
        Which of them are equalities (k,).
    opposite, ratio
        Of equalities the row on the other side (k,), and the length of this row over that of the other.
    implied
        Rows (m,) that need no look of their own: equalities, those parallel to them, and absent ones.
    """

    kept: Indices
    equal: Mask
    opposite: Indices
    ratio: Array
    implied: Mask

    @property
    def equalities(self) -> Indices:
        """The numbers (e,) of equalities."""
        return self.kept[self.equal]

    def program(self, vi: VariationalInequality) -> VariationalInequality:
        """`vi` with these rows alone."""
        if len(self.kept) == len(vi.g):
            return vi
        return replace(vi, B=sp.csr_array(vi.B)[self.kept], g=vi.g[self.kept])

    def multipliers(self, forces: Array, count: int) -> Array:
        """λ ≥ 0 (m,) from multipliers (k,) of the rows that are kept, of any sign on equalities."""
        lam = np.zeros(count)
        lam[self.kept] = np.where(self.equal, np.maximum(forces, 0.0), forces)
        lam[self.opposite[self.equal]] = (self.ratio * np.maximum(-forces, 0.0))[self.equal]
        return lam


@dataclass(frozen=True)
class Directions:
    """Rows of one matrix that are parallel.

    Attributes
    ----------
    lengths
        Euclidean norms (m,) of all rows.
    members, group, side
        The rows (p,) that are parallel to others, the number of the direction of each, and its sign in it.
    """

    lengths: Array
    members: Indices
    group: Indices
    side: Array

    @classmethod
    def of(cls, B: SparseMatrix, present: Mask) -> Directions:
        """Of the rows of B (m×n) that are `present` (m,)."""
        lengths = row_norms(B)
        return cls(lengths, *_parallel(B, lengths, present))


def rows_that_matter(
    B: SparseMatrix, g: Array, room: Array, preferred: Array | None = None, directions: Directions | None = None
) -> Rows:
    """The rows of B (m×n) and g (m,) that matter.

    Parameters
    ----------
    room
        Opposite rows are an equality where there is at most this room (m,) between them, in the unit of g.
    preferred
        Of an equality the row with the larger of these (m,) is kept, in units of its length.
    directions
        Those of the rows that are not absent, where they are known.
    """
    m = len(g)
    dropped, equal, opposite, ratio = is_absent(g), np.zeros(m, bool), np.arange(m), np.ones(m)
    implied = dropped.copy()
    directions = directions or Directions.of(sp.csr_array(B), ~dropped)
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
    both, of_equalities = np.flatnonzero(np.diff(group[tightest]) == 0), []  # a group has a tightest row on either side
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


@lru_cache(maxsize=4)
def _random(count: int) -> Array:
    """A random vector (count,)."""
    return np.random.default_rng(0).standard_normal(count)


def _parallel(B: SparseMatrix, lengths: Array, present: Mask) -> tuple[Indices, Indices, Array]:
    """The rows (p,) that are parallel to others, the number of the direction of each, and its sign in it."""
    probes = B @ _random(B.shape[1]) / lengths
    rows = np.flatnonzero(present & (probes != 0.0))
    rows = rows[np.argsort(np.abs(probes[rows]), kind="stable")]
    sizes = np.abs(probes[rows])
    group = np.cumsum(np.diff(sizes, prepend=-1.0) > CLOSE * (1.0 + sizes)) - 1
    first = np.flatnonzero(np.diff(group, prepend=-1))
    shared = np.bincount(group, minlength=len(first))[group] > 1
    rows, first, group = rows[shared], rows[first][group][shared], group[shared]
    if not len(rows):
        return rows, group, np.zeros(0)
    side = np.sign(probes)
    unit = sp.csr_array(sp.diags_array(side / lengths) @ B)
    gaps = abs(unit[rows] - unit[first]).max(axis=1)
    same = np.asarray(gaps.todense()).ravel() <= PARALLEL
    return rows[same], group[same], side[rows[same]]


ROUND_OFF = 1e-12
"""Residuals below this fraction of their terms are round-off."""

DEPENDENT = 1e-10
"""Constraints are dependent where a pivot of their factorisation is below this fraction of the largest."""

CANCELLED = 32.0 * EPS
"""Round-off in B x, relative to what the load alone would make of it."""

FARTHEST = 1e-50 * ABSENT
"""Constraints are absent from here on: reduced ones are sums of products of absent ones with generators of any unit."""

TIGHT = 1e-8
"""Constraints with a smaller slack than this fraction of its terms may carry a multiplier."""

MAX_ITERATIONS = 20
"""Active sets tried after the first, and how often constraints are added."""


@dataclass(frozen=True)
class ExactSolution:
    """The solution x (n,) of a program, and multipliers α (m,); there may be others where these are not `unique`."""

    x: Array
    alpha: Array
    unique: bool


def exact_solution(program: VariationalInequality) -> ExactSolution | None:
    """The solution of a dense program up to round-off; `None` if it has none or is too badly conditioned.

    With A = L Lᵀ and z = L⁻¹(f − Ax) the program is a least distance problem, min ‖z‖ subject to Cᵀz ≥ d, C = L⁻¹Bᵀ.
    Nonnegative least squares finds its active set (Lawson and Hanson 1974, chapter 23); orthogonal factors of the
    active columns of C then give z and the multipliers without squaring the condition number. Where round-off has
    misled the first set, a primal–dual active set method continues from it.
    """
    if not len(program.f):
        return ExactSolution(np.zeros(0), np.zeros(len(program.g)), unique=True)
    if (absent := program.g >= FARTHEST).any():
        present = exact_solution(replace(program, B=program.B[~absent], g=program.g[~absent]))
        if present is None:
            return None
        alpha = np.zeros(len(absent))
        alpha[~absent] = present.alpha
        return replace(present, alpha=alpha)
    return _exact_solution(program)


def _exact_solution(program: VariationalInequality) -> ExactSolution | None:
    """That of a program that has unknowns, without absent constraints."""
    try:
        for member in (program.A, program.f, program.B, program.g):
            np.asarray_chkfinite(member)
        L = np.linalg.cholesky(program.A)
    except (ValueError, np.linalg.LinAlgError):
        return None
    whitened = _Whitened(program, L)
    active, seen = whitened.least_distance_set(), set[bytes]()
    for _ in range(MAX_ITERATIONS):
        x, alpha = whitened.solve_active(active)
        if not (np.all(np.isfinite(x)) and np.all(np.isfinite(alpha))):  # something has overflowed
            return None
        # An excess is compared with the terms that it is the difference of, not with g alone, which may be small.
        excess, terms = program.B @ x - program.g, np.abs(program.B) @ np.abs(x) + np.abs(program.g)
        violated, pulling = excess > ROUND_OFF * terms + whitened.noise, alpha < -ROUND_OFF * size(alpha)
        if not np.any(violated) and not np.any(pulling):
            alpha = np.maximum(alpha, 0.0)
            forces = np.abs(program.A) @ np.abs(x) + np.abs(program.f) + np.abs(program.B.T) @ alpha
            if np.any(np.abs(program.A @ x - program.f + program.B.T @ alpha) > ROUND_OFF * np.max(forces)):
                return None
            tight = excess > -TIGHT * terms  # multipliers are unique where these constraints are independent
            return ExactSolution(x, alpha, len(whitened.factorised(tight)[0]) == int(np.sum(tight)))
        seen.add(active.tobytes())
        active = violated | (active & ~pulling)
        if active.tobytes() in seen:
            return None
    return None


def least_distance_solution(
    vi: VariationalInequality, factor: SparseCholesky, equal: Mask, start: Mask
) -> tuple[Array, Array] | None:
    """The solution u (n,) and λ (m,) of a sparse program whose constraints may be dependent; `None` if none is found.

    Parameters
    ----------
    vi, factor
        A, f, B and g, and the Cholesky factor of A.
    equal, start
        Constraints that hold as equalities (m,), with multipliers of any sign, and those to begin with (m,).
    """
    B, lengths = sp.csr_array(vi.B), row_norms(vi.B)
    tolerance = ROUND_OFF * lengths
    chosen, load = start | equal, factor.solve_factor_transposed(vi.f)
    for _ in range(MAX_ITERATIONS):
        rows = np.flatnonzero(chosen)
        scaled = sp.csr_array(sp.diags_array(1.0 / lengths[rows]) @ B[rows])
        K = factor.solve_factor_transposed(scaled.toarray().T)
        forces = least_distance(K, load, vi.g[rows] / lengths[rows], equal[rows])
        if forces is None:
            return None
        lam = np.zeros(len(vi.g))
        lam[rows] = forces / lengths[rows]
        u = factor.solve(vi.f - B.T @ lam)
        violated = ~chosen & (B @ u - vi.g > tolerance * (size(u) + np.abs(vi.g) / lengths))
        if not violated.any():
            return u, lam
        chosen |= violated
    return None


def least_distance(K: Array, load: Array, g: Array, equal: Mask) -> Array | None:
    """Multipliers (k,) of min ½|y|² − loadᵀy subject to Kᵀy ≤ g, or = g where `equal`; `None` if none are found.

    The columns of K (n×k) may be dependent; the point itself is y = load − K · multipliers.
    """
    held, free, forces = np.flatnonzero(equal), np.flatnonzero(~equal), np.zeros(len(g))
    Q, R = np.zeros((len(K), 0)), np.zeros((0, 0))
    if len(held):
        q, r, order = scipy.linalg.qr(K[:, held], mode="economic", pivoting=True)
        pivots = np.abs(np.diag(r))
        rank = int(np.sum(pivots > DEPENDENT * pivots[0]))
        Q, R, held = q[:, :rank], r[:rank, :rank], held[order[:rank]]
    prescribed = scipy.linalg.solve_triangular(R, g[held], trans="T") if len(held) else np.zeros(0)
    rest = project_out(Q, K[:, free])
    left = np.linalg.norm(rest, axis=0) > DEPENDENT * np.linalg.norm(K[:, free], axis=0)  # others follow from `equal`
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


class _Whitened:
    """A program in the coordinates z = L⁻¹(f − A x), in which its constraints are Cᵀz ≥ d, in units of their norms."""

    def __init__(self, program: VariationalInequality, L: Array) -> None:
        self._program, self._L, self._rows = program, L, row_norms(program.B)
        self._C, self._load = self._whiten((program.B / self._rows[:, None]).T), self._whiten(program.f)
        self._factors: tuple[bytes, tuple[Indices, Array, Array]] | None = None
        # What is left of the load where forces balance it: all there is of x where constraints hold it at zero.
        self.noise = CANCELLED * self._rows * np.linalg.norm(self._C, axis=0) * np.linalg.norm(self._load)

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

    def factorised(self, chosen: Mask) -> tuple[Indices, Array, Array]:
        """A largest independent set of constraints, and the QR factors of their columns of C.

        The last ones are kept: where no other constraint is tight, those that are active are asked for twice.
        """
        key = chosen.tobytes()
        if self._factors is None or self._factors[0] != key:
            self._factors = key, self._factorised(chosen)
        return self._factors[1]

    def _factorised(self, chosen: Mask) -> tuple[Indices, Array, Array]:
        columns = np.flatnonzero(chosen)
        if not len(columns):  # LAPACK does not factorise matrices without columns
            return columns, np.zeros((len(self._C), 0)), np.zeros((0, 0))
        q, r, order = scipy.linalg.qr(self._C[:, columns], mode="economic", pivoting=True)
        pivots = np.abs(np.diag(r))
        rank = int(np.sum(pivots > DEPENDENT * np.max(pivots, initial=0.0)))
        return columns[order[:rank]], q[:, :rank], r[:rank, :rank]

    def solve_active(self, active: Mask) -> tuple[Array, Array]:
        """Solution x (n,), α (m,) with the active constraints as equalities, refined once."""
        kept, q, r = self.factorised(active)
        program, B = self._program, self._program.B[kept] / self._rows[kept, None]
        x, alpha = np.zeros(len(program.f)), np.zeros(len(program.g))
        for _ in range(2):  # the second time for the residual of the first
            load = self._whiten(program.f - program.A @ x - program.B.T @ alpha)
            right = r.T @ (q.T @ load) - (program.g[kept] / self._rows[kept] - B @ x)
            y = _solve_triangular(r, right, transposed=True)
            x = x + _solve_triangular(self._L, load - q @ y, lower=True, transposed=True)
            alpha[kept] += _solve_triangular(r, y) / self._rows[kept]
        return x, alpha


def _solve_triangular(factor: Array, right: Array, *, lower: bool = False, transposed: bool = False) -> Array:
    """LAPACK's solution with a triangular matrix (k×k), without the checks that take longer in SciPy's function.

    Raises a `LinAlgError` if the matrix is exactly singular.
    """
    if not right.size:
        return np.zeros_like(right)
    solved, singular = dtrtrs(factor.T, right, lower=not lower, trans=not transposed)
    if singular:
        raise np.linalg.LinAlgError("a triangular matrix is singular")
    return np.asarray(solved)
