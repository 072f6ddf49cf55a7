"""Inner products with a sparse Gram matrix: norms, Riesz representers, orthonormal bases, numerical rank."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property
from typing import Annotated

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array, SparseMatrix, frozen, read_only
from vibench.errors import NumericalError, RequestError
from vibench.linalg import EPS
from vibench.linalg.cholesky import SparseCholesky, have_one_pattern
from vibench.linalg.definite import Factor
from vibench.linalg.factorisations import DEFAULT, implementation
from vibench.signatures import Judged, bordered, bordered_constructor
from vibench.text import shown

RANK_RTOL = 1e-12
"""Directions below this fraction of the largest one are round-off and are dropped from every orthonormal basis."""

_postponed: ContextVar[list[InnerProduct] | None] = ContextVar("inner products not factorised yet", default=None)


@contextmanager
def factorised_later() -> Iterator[None]:
    """Postpone the factorisation of inner products, and the refusal of indefinite ones, to the end of the context.

    Another implementation may be chosen until then: the default takes minutes for a space of 200,000 dimensions.
    """
    made: list[InnerProduct] = []
    token = _postponed.set(made)
    try:
        yield
    finally:
        _postponed.reset(token)
    for product in made:
        product._solver  # noqa: B018


@bordered_constructor
class InnerProduct:
    """The inner product ⟨u, v⟩ = uᵀ X v of a space, X sparse symmetric positive definite (n×n).

    X = FᵀF is factorised once. In whitened coordinates F v the inner product is Euclidean. Singular values, QR and
    nonnegative least squares are computed there and not from Gram matrices, whose eigenvalues keep half the digits.

    `name` is that of X in error messages, `factorisation` the implementation that factorises X where no explicit F is
    needed, see `factorised_by`. Raises a `NumericalError` if X is not square, not finite, not symmetric or not positive
    definite, a `RequestError` if it is no matrix of real numbers, no factorisation has the name, or what a method is
    given is not of the space.
    """

    def __init__(
        self, matrix: Annotated[SparseMatrix, Judged], name: str = "the Gram matrix", factorisation: str = DEFAULT
    ) -> None:
        is_matrix = (sp.issparse(matrix) or isinstance(matrix, np.ndarray)) and matrix.ndim == 2
        if not is_matrix or matrix.dtype.kind not in "fiub":
            raise RequestError(f"{name} is {shown(matrix)}, expected a matrix of real numbers")
        self.matrix = frozen(sp.csc_array(matrix, dtype=float))
        self._name, self.factorisation = name, factorisation
        check_symmetric(self.matrix, name)
        if (postponed := _postponed.get()) is not None:
            postponed.append(self)
        else:
            self._solver  # noqa: B018  refuse an indefinite matrix here, not at its first use

    def __getstate__(self) -> dict[str, object]:
        # SuperLU objects cannot be pickled.
        return {name: value for name, value in vars(self).items() if name in ("matrix", "_name", "factorisation")}

    @property
    def dim(self) -> int:
        """Dimension n of the space."""
        return int(self.matrix.shape[0])

    @cached_property
    def is_diagonal(self) -> bool:
        """Whether X has no entry off its diagonal."""
        return int(self.matrix.count_nonzero()) == int(np.count_nonzero(self.matrix.diagonal()))

    @cached_property
    def dense(self) -> Array:
        """The matrix X as an array."""
        return read_only(self.matrix.toarray())

    @bordered
    def factorised_by(self, name: str) -> None:
        """Let an implementation (`vibench.linalg.factorisations`) solve with X and eliminate unknowns of it.

        F, which is explicit, is always SuperLU's.
        """
        self.factorisation = implementation(name).name
        self.__dict__.pop("_solver", None)

    @cached_property
    def _factor(self) -> SparseCholesky:
        return SparseCholesky(self.matrix, self._name)

    @cached_property
    def _solver(self) -> Factor | SparseCholesky:
        chosen = implementation(self.factorisation)
        return chosen.factorise(self.matrix, self._name) if chosen.name != DEFAULT else self._factor

    def _refuse_others(self, u: Array) -> None:
        """Refuse an array without one row for each dimension of the space."""
        shape, n = getattr(u, "shape", ()), self.dim
        if shape[:1] != (n,) or len(shape) > 2 or u.dtype.kind not in "fiub":
            what = f"an array of the shape {shape}" if shape else shown(u)
            raise RequestError(f"{what} is not of a space of dimension {n}, expected the shape ({n},) or ({n}, k)")

    def apply(self, u: Array) -> Array:
        """The product X u for u (n,) or (n, k)."""
        self._refuse_others(u)
        return np.asarray(self.matrix @ u)

    def gram(self, u: Array, v: Array) -> Array:
        """Matrix of inner products uᵀ X v (k×l) of the columns of u (n×k) and v (n×l)."""
        self._refuse_others(u)
        return np.asarray(u.T @ self.apply(v))

    def norm(self, u: Array) -> Array:
        """Norms of u (n,) as a scalar array, or of every column of u (n×k) as (k,)."""
        if implementation(self.factorisation).is_iterative:
            return np.asarray(np.sqrt(np.maximum(np.sum(u * self.apply(u), axis=0), 0.0)))
        return np.asarray(np.linalg.norm(self.whiten(u), axis=0))

    def riesz(self, functional: Array) -> Array:
        """Riesz representer X⁻¹ ℓ of functionals given as (n,) or (n, k)."""
        self._refuse_others(functional)
        return self._solver.solve(functional)

    def whiten(self, u: Array) -> Array:
        """Coordinates F u, in which the inner product is Euclidean; u (n,) or (n, k)."""
        self._refuse_others(u)
        return self._factor.apply_factor(u)

    def unwhiten(self, y: Array) -> Array:
        """The vector F⁻¹ y, the inverse of `whiten`; y (n,) or (n, k)."""
        self._refuse_others(y)
        return self._factor.solve_factor(y)

    def whiten_functional(self, functional: Array) -> Array:
        """Coordinates F⁻ᵀ ℓ of the Riesz representer of ℓ (n,) or (n, k); Euclidean norms are dual norms."""
        self._refuse_others(functional)
        return self._factor.solve_factor_transposed(functional)

    def coordinates(self, u: Array) -> tuple[Array, Array | None]:
        """Euclidean coordinates of u (n×k): whitened ones, or by iteration those in a basis (n×k), given second."""
        if not implementation(self.factorisation).is_iterative:
            return self.whiten(u), None
        self._refuse_others(u)
        q, r = orthogonal_factorisation(self.matrix, u)
        return r, q

    def orthonormalise(self, u: Array, against: Array | None = None) -> Array:
        """Orthonormal basis (n×r) of span(u), u (n×k), or of its part orthogonal to orthonormal `against` (n×l).

        It is computed by `orthonormal_range` in whitened coordinates; r ≤ k is the numerical rank.
        """
        fixed = np.zeros((self.dim, 0)) if against is None else self.whiten(against)
        return self.unwhiten(orthonormal_range(self.whiten(u), fixed))


def orthogonal_factorisation(X: SparseMatrix, y: Array) -> tuple[Array, Array]:
    """Q (n×k) and R (k×l) with Q R = y (n×l) and QᵀXQ = I, k = min(n, l), for a sparse positive definite X (n×n).

    No factor of X is needed. Householder's factorisation in units of single unknowns leaves columns that are
    independent in the norm of X, too, and two passes of Cholesky's factorisation of their Gram matrix make them
    orthonormal to round-off (CholeskyQR2: Fukaya, Nakatsukasa, Yanagisawa and Yamamoto 2014).
    """
    # Cholesky's factorisation of the Gram matrix needs columns with a condition number below 1e8, which this gives.
    units = np.sqrt(X.diagonal())[:, None]
    q, r = np.linalg.qr(units * y)
    q = q / units
    for _ in range(2):
        lower = np.linalg.cholesky(q.T @ (X @ q))
        q = scipy.linalg.solve_triangular(lower, q.T, lower=True).T
        r = lower.T @ r
    return q, r


def asymmetry(matrix: SparseMatrix) -> float:
    """Largest difference of an entry of a square matrix from that of its transpose; 0.0 if it is round-off."""
    rows = sp.csr_array(matrix)
    transposed = sp.csr_array(rows.T)
    # Differences of entries need no third matrix where the patterns are the same.
    same = rows.has_canonical_format and have_one_pattern(rows, transposed)
    off = float(np.abs(rows.data - transposed.data if same else (rows - transposed).data).max(initial=0.0))
    # Assembly sums the two entries in different orders: differences relative to the largest entry are round-off.
    return off if off and off > 1e-12 * abs(matrix).max() else 0.0


def check_symmetric(matrix: SparseMatrix, name: str) -> None:
    """Raise a `NumericalError` if a matrix is not square, not finite or not symmetric up to round-off."""
    rows, columns = matrix.shape
    if rows != columns:
        raise NumericalError(f"{name} must be square, it is {rows}×{columns}")
    if not np.all(np.isfinite(matrix.data)):
        raise NumericalError(f"{name} has entries that are not finite")
    if asymmetry(matrix):
        raise NumericalError(f"{name} is not symmetric")


def check_positive_definite(matrix: SparseMatrix, name: str) -> None:
    """Raise a `NumericalError` that says why a matrix is not symmetric positive definite beyond round-off, if so."""
    check_symmetric(matrix, name)
    try:
        solve = SparseCholesky(matrix, name).solve
    except NumericalError:
        raise NumericalError(f"{name} is not positive definite: {why_indefinite(matrix)}") from None
    check_regular(matrix, solve, name)


def check_regular(matrix: SparseMatrix, solve: Callable[[Array], Array], name: str) -> None:
    """Raise a `NumericalError` if a positive definite matrix (n×n), with which `solve` solves, is singular.

    A pivot that vanishes in exact arithmetic may be positive by round-off. Two steps of inverse iteration show a
    direction without energy, in units of the diagonal.
    """
    n, units = matrix.shape[0], np.sqrt(np.abs(matrix.diagonal()))[:, None]
    direction, growth = np.random.default_rng(0).standard_normal((n, 1)), 0.0
    for _ in range(2):
        direction = direction / (np.linalg.norm(direction) or 1.0)
        direction = units * solve(units * direction)
        growth = float(np.linalg.norm(direction))
    # The round-off of a factorisation grows with the number of terms at most as slowly.
    if not growth * EPS * max(16.0, np.sqrt(n)) < 1.0:
        raise NumericalError(f"{name} is not positive definite: {why_indefinite(matrix)}")


def why_indefinite(matrix: SparseMatrix) -> str:
    """Say whether a symmetric matrix (n×n) that is not positive definite is singular or indefinite."""
    diagonal = matrix.diagonal()
    if np.all(diagonal < 0.0):
        return "it is −A that is positive definite, the sign of A is the opposite one"
    units = sp.diags_array(np.where(diagonal > 0.0, diagonal, np.max(np.abs(diagonal), initial=0.0) or 1.0))
    try:
        # Far above round-off, and far below what an indefinite matrix lacks.
        solve = SparseCholesky(sp.csc_array(matrix + 1e-10 * units)).solve
    except NumericalError:
        return "it has a negative eigenvalue, and a coercive problem has none"
    direction = np.random.default_rng(0).standard_normal(matrix.shape[0])
    for _ in range(3):
        direction = solve(units @ direction)
        direction /= np.max(np.abs(direction))
    constant = np.ptp(direction) <= 1e-6
    motion = "constants are" if constant else f"a motion that is largest at unknown {np.argmax(np.abs(direction))} is"
    why = "Dirichlet conditions were not applied, or contact alone holds a body, which is not covered"
    return f"it is singular, {motion} in its kernel: {why}; prescribe such motions, or add a weak foundation"


def svd(a: Annotated[Array, "n", "l"]) -> tuple[Array, Array, Array]:
    """Thin singular value decomposition a = (u·s) vᵀ: u (n×k), s (k,) falling, vᵀ (k×l).

    By QR iteration (LAPACK's gesvd): the divide-and-conquer routine behind `numpy.linalg.svd` was seen not to converge
    on sines of principal angles, whose values cluster at 1 and at round-off.
    """
    u, s, vt = scipy.linalg.svd(a, full_matrices=False, lapack_driver="gesvd")
    return np.asarray(u), np.asarray(s), np.asarray(vt)


def singular_values(a: Annotated[Array, "n", "l"]) -> Array:
    """Singular values of `a`, falling; by the same routine as `svd`."""
    if not a.size:
        return np.zeros(0)
    return np.asarray(scipy.linalg.svd(a, compute_uv=False, lapack_driver="gesvd"))


def orthonormal_range(y: Annotated[Array, "n", "k"], against: Annotated[Array, "n", "l"] | None = None) -> Array:
    """Euclidean orthonormal basis of the columns of y (n×k), with orthonormal columns `against` (n×l) projected out.

    The basis is (n×r), r the numerical rank at `RANK_RTOL` by pivoted QR.
    """
    # Compare each column with its own norm before the projection: a short column is not a dependent one.
    norms = np.linalg.norm(y, axis=0)
    y = y[:, norms > 0.0] / norms[norms > 0.0]
    if against is not None:
        y = project_out(against, y)
    if not y.size:
        return np.zeros((y.shape[0], 0))
    q, r, _ = scipy.linalg.qr(y, mode="economic", pivoting=True)
    q = q[:, np.abs(np.diag(r)) > RANK_RTOL]
    if against is not None and np.max(np.abs(against.T @ q), initial=0.0) > 1e-13:
        # Normalising a column of which little is left has magnified its round-off along `against`.
        q, _ = np.linalg.qr(project_out(against, q))
    return np.asarray(q)


def project_out(space: Annotated[Array, "n", "l"], y: Annotated[Array, "n", "k?"]) -> Array:
    """The part (I − Π)y of y (n,) or (n×k) for orthonormal columns `space` (n×l); applied twice against round-off."""
    for _ in range(2):
        y = y - space @ (space.T @ y)
    return y
