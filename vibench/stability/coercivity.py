"""Constants of A(µ) in the norms of V and W that error bounds need: estimated by Lanczos iterations, proved by inertia.

    α = min vᵀAv / ‖v‖_V²,    γ_a = max vᵀAv / ‖v‖_V²,    β_A = min sup ηᵀBv / (‖v‖_A ‖η‖_W)   (min over η, sup over v)

β_A² is the smallest eigenvalue of BA⁻¹Bᵀ against X_W. Lanczos approximates extreme eigenvalues from inside, so that a
margin moves them outwards; that alone proves nothing, since an iteration may miss an eigenvalue. Where the margin is
too small, a more accurate estimate comes before a larger margin. A number a ≤ α is proved by the n positive eigenvalues
of A − aX_V, c ≥ γ_a by those of cX_V − A, and, where A is positive definite, b ≤ β_A by the m negative eigenvalues of

    [ A    Bᵀ     ]
    [ B    b²X_W  ],    whose Schur complement of A is b²X_W − BA⁻¹Bᵀ (Haynsworth),

see `vibench.linalg.proofs` for the proofs in floating-point arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import structural_rank

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.linalg.cholesky import SparseCholesky, symmetric_lu
from vibench.linalg.factorisations import implementation
from vibench.linalg.inner_product import InnerProduct
from vibench.linalg.lanczos import Lanczos
from vibench.linalg.proofs import is_proved_definite, proved_positive
from vibench.linalg.schur_complement import FEW_PER_UNKNOWN
from vibench.stability.infsup import InfSup

# Fractions by which constants are moved outwards: the first for which they are proved, or the first if none is.
MARGINS = (1e-3, 1e-2, 1e-1, 0.5)

# Spaces of at most this dimension have their eigenvalues from a dense matrix; Lanczos needs more than two.
FEW = 30


@dataclass(frozen=True)
class Constant:
    """A constant, and whether it is proved or only estimated."""

    value: float
    proved: bool


@dataclass(frozen=True)
class Stability:
    """β_HF in the norms of V and W, and bounds of α, γ_a and β_A, at one parameter of the high-fidelity problem."""

    inf_sup: InfSup
    coercivity: Constant
    continuity: Constant
    energy_inf_sup: Constant


# From a right-hand side (n,) to the solution with A.
Solve = Callable[[Array], Array]

# From a relative error to an estimate of a constant.
Estimate = Callable[[float], float]


def coercivity_and_continuity(A: SparseMatrix, V: InnerProduct) -> tuple[Constant, Constant]:
    """Lower bound of α and upper bound of γ_a for A (n×n); see `coercivity` and `continuity`.

    Raises a `NumericalError` if A is seen not to be symmetric positive definite.
    """
    quotients = Quotients(A, V)
    return coercivity(quotients), continuity(quotients)


class Quotients:
    """Estimates of both ends of the spectrum of A (n×n) against X_V.

    Both come from one iteration with X_V⁻¹A, whose factor of X_V all parameters share, while the lower end is among its
    first vectors; else α comes from an iteration with A⁻¹X_V. `solve` solves with a factorisation of A that exists; by
    default A is factorised as X_V is where that is needed.
    """

    def __init__(self, A: SparseMatrix, V: InnerProduct, solve: Solve | None = None) -> None:
        self.A, self.V, self._solve = A, V, solve

    @cached_property
    def _both(self) -> Lanczos:
        return Lanczos(lambda v: self.V.riesz(self.A @ v), self.V.matrix)

    @cached_property
    def _inverse(self) -> Estimate:
        return _lowest(self.A, self.V, self._solve)

    def lowest(self, accuracy: float) -> float:
        """Estimate of α with this relative error.

        Raises a `NumericalError` if A is seen not to be symmetric positive definite.
        """
        alpha = self._both.smallest(accuracy) if self.V.dim > FEW else None
        return alpha if alpha is not None else self._inverse(accuracy)

    def highest(self, accuracy: float) -> float:
        """Estimate of γ_a with this relative error."""
        return self._both.largest(accuracy) if self.V.dim > FEW else _largest(self.A, self.V)(accuracy)


def coercivity(quotients: Quotients, order: Indices | None = None) -> Constant:
    """Lower bound of α for A (n×n).

    `order` (n,) is one for the elimination of its unknowns; by default of minimum degree. Raises a `NumericalError` if
    A is seen not to be symmetric positive definite.
    """
    A, V = quotients.A, quotients.V
    chosen = implementation(V.factorisation)
    return moved(quotients.lowest, -1.0, lambda a: is_proved_definite([A, -a * V.matrix], chosen, order))


@lru_cache(maxsize=4)  # that of V is asked for at every parameter
def share_of_diagonal(X: InnerProduct) -> Constant:
    """A ξ with X ≽ ξ diag(X), of the order of the largest one."""
    diagonal = X.matrix.diagonal()
    # A rough estimate is enough: it is moved by the largest margin.
    xi = _lowest(X.matrix, InnerProduct(sp.diags_array(diagonal)), X.riesz)(1e-2) / (1.0 + MARGINS[-1])
    parts = [X.matrix, sp.diags_array(-xi * diagonal)]
    return Constant(xi, is_proved_definite(parts, implementation(X.factorisation)))


def continuity(quotients: Quotients) -> Constant:
    """Upper bound of γ_a for A (n×n), symmetric positive definite."""
    A, V = quotients.A, quotients.V
    chosen = implementation(V.factorisation)
    return moved(quotients.highest, 1.0, lambda c: is_proved_definite([c * V.matrix, -A], chosen))


def operator_norm(M: SparseMatrix, X: InnerProduct) -> Constant:
    """Upper bound of max |vᵀMv| / ‖v‖² over v for a symmetric M (n×n), with ‖v‖ the norm of X."""
    if not abs(M).sum():
        return Constant(0.0, True)
    return moved(_largest(M, X), 1.0, lambda c: all(proved_above(part, -c, X) for part in (-M, M)))


def proved_above(M: SparseMatrix, bound: float, X: InnerProduct) -> bool:
    """Prove M ≽ b X for a symmetric M (n×n) and b < 0."""
    return is_proved_definite([-bound * X.matrix, M], implementation(X.factorisation))


def largest_quotient(M: SparseMatrix, X: InnerProduct) -> float:
    """Rough estimate of max |vᵀMv| / ‖v‖² over v for a symmetric M (n×n); nothing is proved."""
    return _largest(M, X)(1e-2) if abs(M).sum() else 0.0


def _largest(M: SparseMatrix, X: InnerProduct) -> Estimate:
    """Estimates of max |vᵀMv| / ‖v‖² over v for a symmetric M (n×n) that is not zero."""
    if X.dim <= FEW:
        largest = float(np.abs(scipy.linalg.eigvalsh(M.toarray(), X.matrix.toarray())).max())
        return lambda _: largest
    return Lanczos(lambda v: X.riesz(M @ v), X.matrix).largest


def _lowest(A: SparseMatrix, V: InnerProduct, solve: Solve | None = None) -> Estimate:
    """Estimates of α for A (n×n), the smallest eigenvalue of A against X_V.

    Raises a `NumericalError` if A is not symmetric positive definite and no `solve` is given.
    """
    inverse = solve or InnerProduct(A, "A", V.factorisation).riesz
    if V.dim <= FEW:
        smallest = float(scipy.linalg.eigvalsh(A.toarray(), V.matrix.toarray())[0])
        return lambda _: smallest
    iterations = Lanczos(lambda v: inverse(V.matrix @ v), A)
    return lambda accuracy: 1.0 / iterations.largest(accuracy)


def moved(estimate: Estimate, sign: float, proves: Callable[[float], bool]) -> Constant:
    """An estimate moved outwards, downwards for a negative sign, until it is proved."""
    # Estimates err inwards: a constant that is proved with the smallest margin is as close as that margin, however
    # accurate its estimate. A first one of that accuracy is usually enough.
    first = estimate(1e-3)
    if not 0.0 < first < np.inf:
        return Constant(0.0 if sign < 0.0 else float("inf"), False)
    closest = first * (1.0 + MARGINS[0]) ** sign
    if proves(closest):
        return Constant(closest, True)
    accurate = estimate(1e-5)
    candidates = [accurate * (1.0 + margin) ** sign for margin in MARGINS]
    for candidate in candidates:
        if candidate != closest and proves(candidate):
            return Constant(candidate, True)
    return Constant(candidates[0], False)


def energy_inf_sup(A: SparseMatrix, B: SparseMatrix, W: InnerProduct) -> Constant:
    """Lower bound of β_A, proved where A (n×n) is positive definite, for B (m×n); 0 where no other is proved.

    Raises a `NumericalError` if A is not positive definite.
    """
    factor, (m, n) = SparseCholesky(A, "A"), B.shape
    if not m:
        return Constant(float("inf"), True)
    last = np.concatenate([factor.order, n + np.arange(m)])
    # Multipliers last have the pivots of a Schur complement, which is dense: with many of them that is all the work.
    orders = [last] if m <= FEW_PER_UNKNOWN * n else [_after_their_unknowns(factor.order, B), last]
    roots = np.sqrt(A.diagonal()), np.sqrt(W.matrix.diagonal())

    def stable(order: Indices, beta: float) -> bool:
        saddle = -_saddle_point(A, B, beta**2 * W.matrix)
        return bool(proved_positive([saddle], np.concatenate([roots[0], beta * roots[1]]), order) >= m)

    for order in orders:
        constant = moved(_smallest_compliance(A, sp.csc_array(B), W, factor, order), -1.0, partial(stable, order))
        if constant.proved:
            return constant
    return Constant(0.0, True)


def _after_their_unknowns(order: Indices, B: SparseMatrix) -> Indices:
    """An elimination order of the saddle point: that of A (n,), every multiplier after the last unknown of its row."""
    place, rows = np.empty(len(order)), sp.csr_array(B)
    place[order] = np.arange(len(order))
    ends = [np.max(place[row], initial=-1.0) for row in np.split(rows.indices, rows.indptr[1:-1])]
    return np.argsort(np.concatenate([place, np.array(ends) + 0.5]), kind="stable")


def _smallest_compliance(
    A: SparseMatrix, B: SparseMatrix, W: InnerProduct, factor: SparseCholesky, order: Indices
) -> Estimate:
    """Estimates of the root of the smallest eigenvalue of BA⁻¹Bᵀ against X_W; 0 where it is singular."""
    m, n = B.shape
    if m <= FEW:
        return smallest_root(np.asarray(B @ factor.solve(B.toarray().T)), W.matrix)
    # SuperLU may destroy the heap where the system cannot be regular.
    if structural_rank(sp.csr_array(B)) < m:
        return lambda _: 0.0
    saddle = _saddle_point(A, B, sp.csc_array((m, m)))[order][:, order]
    try:
        solve = symmetric_lu(sp.csc_array(saddle), "NATURAL").solve
    except RuntimeError:
        return lambda _: 0.0

    def inverse(v: Array) -> Array:
        # −(BA⁻¹Bᵀ)⁻¹ is the last block of the inverse.
        solution = np.empty(n + m)
        solution[order] = solve(np.concatenate([np.zeros(n), W.matrix @ v])[order])
        return -solution[n:]

    iterations = Lanczos(inverse, W.matrix)
    return lambda accuracy: iterations.largest(accuracy) ** -0.5


def _saddle_point(A: SparseMatrix, B: SparseMatrix, corner: SparseMatrix) -> SparseMatrix:
    return sp.csc_array(sp.block_array([[A, B.T], [B, corner]]))


def smallest_root(matrix: Array, mass: SparseMatrix) -> Estimate:
    """Estimates of the root of the smallest eigenvalue of a symmetric matrix (m×m) against `mass`; 0 if negative."""
    if len(matrix) <= FEW:
        smallest = float(scipy.linalg.eigvalsh(matrix, mass.toarray())[0])
        return lambda _: float(np.sqrt(max(0.0, smallest)))
    try:
        factor = scipy.linalg.cho_factor(matrix)
    except np.linalg.LinAlgError:
        return lambda _: 0.0

    def inverse(v: Array) -> Array:
        return np.asarray(scipy.linalg.cho_solve(factor, mass @ v, overwrite_b=True, check_finite=False))

    iterations = Lanczos(inverse, mass)
    return lambda accuracy: iterations.largest(accuracy) ** -0.5
