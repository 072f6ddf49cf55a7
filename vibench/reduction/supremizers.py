"""Supremizers T(mu)η = X_V⁻¹ B(mu)ᵀη (paper, equation (15)) and the space that contains all of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix, real_matrix
from vibench.errors import NumericalError
from vibench.interfaces.problem import ContactLoads
from vibench.linalg.definite import MANY_UNKNOWNS, BlockDiagonal, Elimination
from vibench.linalg.factorisations import implementation
from vibench.linalg.inner_product import InnerProduct, orthogonal_factorisation
from vibench.signatures import Rule


def supremizers(
    V: Annotated[InnerProduct, "n"], B: Annotated[SparseMatrix, "m", "n"], eta: Annotated[Array, "m", "k"]
) -> Array:
    """Supremizers T(mu)η = X_V⁻¹ Bᵀη (n×k) for B (m×n) and multipliers η (m×k)."""
    return V.riesz(np.asarray(B.T @ eta))


def proportionality(B: SparseMatrix, reference: SparseMatrix) -> float | None:
    """Factor c ≠ 0 with B = c·reference up to round-off, or `None`."""
    norm, square = sp.linalg.norm(B), float(reference.multiply(reference).sum())
    if norm == 0.0 or square == 0.0:
        return None
    factor = float(B.multiply(reference).sum()) / square
    return factor if factor and sp.linalg.norm(B - factor * reference) <= 1e-12 * norm else None


@dataclass(frozen=True)
class ConstraintClasses:
    """Constraint matrices B(mu_p) = c_p · representatives[members[p]] of classes that share their supremizer space.

    The representative of a class is its first matrix; `members` are the classes of all p (P,), `factors` the c_p (P,).
    """

    representatives: tuple[SparseMatrix, ...]
    members: Indices
    factors: Array

    @property
    def firsts(self) -> Indices:
        """Index p of the representative of every class."""
        return np.unique(self.members, return_index=True)[1]

    def expand_classes(self, constants: Sequence[float]) -> Array:
        """Expand inf-sup constants of the representatives to every p (P,)."""
        return np.array(constants)[self.members] * np.abs(self.factors)


def constraint_classes(matrices: Collection[SparseMatrix] | Iterator[SparseMatrix]) -> ConstraintClasses:
    """Sort matrices into classes of proportional ones; each may be written over the one before it.

    Where every B(mu) is one matrix times a scalar, one supremizer space replaces one for each parameter.
    """
    classes: list[tuple[SparseMatrix, Array]] = []
    placed: list[tuple[int, float]] = []
    for matrix in matrices:
        fingerprint = _fingerprint(real_matrix(matrix, "a constraint matrix"))
        for k, (representative, other) in enumerate(classes):
            # Fingerprints of proportional matrices are equal up to sign and round-off: a cheap necessary condition.
            distances = (float(np.abs(fingerprint + sign * other).max(initial=0.0)) for sign in (-1.0, 1.0))
            factor = proportionality(matrix, representative) if min(distances) <= 1e-10 else None
            if factor is not None:
                placed.append((k, factor))
                break
        else:
            placed.append((len(classes), 1.0))
            classes.append((matrix.copy(), fingerprint))
    members, factors = [k for k, _ in placed], [factor for _, factor in placed]
    return ConstraintClasses(tuple(B for B, _ in classes), np.array(members, dtype=np.intp), np.array(factors))


def _fingerprint(matrix: SparseMatrix) -> Array:
    """Normalised product (m,) with a random vector, which proportional matrices share up to its sign."""
    probe = np.random.default_rng(0).standard_normal(matrix.shape[1])
    return np.asarray(matrix @ probe) / ((sp.linalg.norm(matrix) * float(np.linalg.norm(probe))) or 1.0)


class SpannedCoordinates:
    """Euclidean coordinates in V_N, given by a V-orthonormal basis (n×N), + span of vectors (n×k), dependent or not.

    `plain` are the coordinates (d×N) of the basis, which are the first ones, `represented` those (d×k) of the vectors.
    """

    def __init__(self, V: InnerProduct, basis: Array, vectors: Array) -> None:
        # What is stored holds no functions.
        self._V = V
        coordinates, self._span = V.coordinates(np.hstack([basis, vectors]))
        self._whitened, self.represented = _beside(*np.split(coordinates, [basis.shape[1]], axis=1))
        self.plain: Array = np.eye(self._whitened.shape[1], basis.shape[1])

    def vectors(self, coordinates: Array) -> Array:
        """Vectors (n×k) with these coordinates (d×k)."""
        y = self._whitened @ coordinates
        return self._V.unwhiten(y) if self._span is None else np.asarray(self._span @ y)


class ContactCoordinates:
    """Euclidean coordinates in V_N + X_V⁻¹E: with E the contact unknowns, this contains the supremizers of every B(mu).

    Let S be the Schur complement of X_V on E, and H the extension of values on E by X_V u = 0 elsewhere. Every v is the
    sum of H v_E, whose norm is that of v_E in S, and of a v⁰ that is zero on E and orthogonal to X_V⁻¹E, the range of
    H. With S = F_EEᵀF_EE, the coordinates of X_V⁻¹ r for a load r on E are F_EE⁻ᵀ r: no array larger than E is needed
    for them. V_N is given by a V-orthonormal basis (n×N), E by `dofs`, rising; `plain` are the coordinates (d×N) of the
    basis, orthonormal.
    """

    def __init__(self, V: InnerProduct, basis: Array, dofs: Indices) -> None:
        self._factor, self._tail = _contact_factor(V, dofs.astype(np.intp).tobytes())
        rest, on_contact = np.setdiff1d(np.arange(V.dim), dofs), basis[dofs]
        X = sp.csr_array(V.matrix)[rest][:, rest]
        others, r = orthogonal_factorisation(X, (basis - self._factor.extend(on_contact))[rest])
        self._off_contact = np.zeros((V.dim, len(r)))
        self._off_contact[rest] = others
        self.plain: Array = np.vstack([r, self._tail @ on_contact])

    def supremizers(self, loads: Array) -> Array:
        """Coordinates (d×k) of X_V⁻¹ r for loads r on E (|E|×k), such as Bᵀη."""
        on_contact = self._tail.solve_triangular(loads, transposed=True)
        return np.vstack([np.zeros((self._off_contact.shape[1], loads.shape[1])), on_contact])

    def vectors(self, coordinates: Array) -> Array:
        k = self._off_contact.shape[1]
        last = self._tail.solve_triangular(coordinates[k:])
        return np.asarray(self._off_contact @ coordinates[:k] + self._factor.extend(last))


class LoadCoordinates:
    """Coordinates in V_N + X_V⁻¹(fixed loads, loads on reached unknowns): the supremizers of B(mu) that loads give.

    V_N has the first coordinates, then come the fixed loads, then the reached unknowns one by one: what loads on the
    first j of these give needs no coordinates of the others. `plain` are the coordinates (d×N) of the basis of V_N.
    `loads` are those of some multipliers; other arguments are as for `ContactCoordinates`.
    """

    def __init__(self, V: InnerProduct, basis: Array, dofs: Indices, loads: ContactLoads) -> None:
        self._contact = ContactCoordinates(V, basis, dofs)
        acting = loads.fixed.any(axis=0)
        spanning = self._contact.supremizers(np.hstack([loads.fixed[:, acting], np.eye(len(dofs))[:, loads.reached]]))
        self._axes, represented = _beside(self._contact.plain, spanning)
        dim, count = self._axes.shape[1], int(acting.sum())
        self.plain: Array = np.eye(dim, basis.shape[1])
        self._fixed, self._reached = np.zeros((dim, loads.fixed.shape[1])), np.ascontiguousarray(represented[:, count:])
        self._fixed[:, acting] = represented[:, :count]
        self._before = basis.shape[1] + count

    @property
    def multipliers(self) -> int:
        """Number k of the multipliers that the loads are of."""
        return int(self._fixed.shape[1])

    @property
    def terms(self) -> tuple[Array, Array]:
        """Coordinates (k×d) of the supremizers of the fixed loads, and (j×d) of those of each load that may vary."""
        return self._fixed.T, self._reached.T

    def supremizers(self, varying: Array) -> Array:
        """Coordinates (d'×k) of the supremizers with `varying` (j×k) added to the fixed loads; those after d' are zero.

        Raises a `NumericalError` if the loads reach unknowns that they were not said to.
        """
        j = len(varying)
        if j > self._reached.shape[1]:
            raise NumericalError(f"contact loads reach {j} unknowns, {self._reached.shape[1]} were expected at most")
        used = min(self._before + j, self._axes.shape[1])
        return np.asarray(self._fixed[:used] + self._reached[:used, :j] @ varying)

    def vectors(self, coordinates: Array) -> Array:
        return self._contact.vectors(self._axes[:, : len(coordinates)] @ coordinates)


def _beside(basis: Array, vectors: Array) -> tuple[Array, Array]:
    """Orthonormal columns, first those of `basis` (d×N), that span vectors (d×k), too, and the coordinates of these."""
    count = basis.shape[1]
    q, r = np.linalg.qr(np.hstack([basis, vectors]))
    # For the basis itself r is the identity but for these signs.
    signs = np.where(np.diagonal(r)[:count] < 0.0, -1.0, 1.0)
    q[:, :count] *= signs
    r[:count] *= signs[:, None]
    return q, r[:, count:]


# Cached: all models of a problem share the factors for the unknowns of the training set, of the validation set, and the
# declared ones.
@lru_cache(maxsize=3)
def _contact_factor(V: InnerProduct, dofs: bytes) -> tuple[Elimination, BlockDiagonal]:
    """The elimination of all unknowns of X_V but some E, and the factor F_EE (|E|×|E|) of its Schur complement."""
    last = np.frombuffer(dofs, np.intp)
    chosen = implementation(V.factorisation)
    factor = chosen.eliminate(V.matrix, chosen.order(V.matrix, last), len(last), "X_V")
    return factor, factor.schur_blocks().cholesky("X_V")


Coordinates = SpannedCoordinates | ContactCoordinates
# Those in which V_N has the first coordinates.
PlainCoordinates = SpannedCoordinates | LoadCoordinates


def isometric_supremizers(
    V: InnerProduct, matrices: Sequence[SparseMatrix], count: int
) -> Callable[[SparseMatrix, Array], Array]:
    """Return the cheaper function from B (m×n) and η (m×k) to an isometric image (d×k) of T(mu)η.

    It is for these matrices and `count` multipliers each.
    """
    constrained = _constrained_unknowns(matrices)
    # Whitening a supremizer on the mesh costs about as much as two unknowns of the contact factor.
    if 2 * count * len(matrices) <= len(constrained):
        return lambda B, eta: V.whiten_functional(np.asarray(B.T @ eta))
    contact = ContactCoordinates(V, np.zeros((V.dim, 0)), constrained)
    return lambda B, eta: contact.supremizers(_loads(B, constrained, eta))


def _constrained_unknowns(matrices: Sequence[SparseMatrix]) -> Indices:
    """Unknowns that occur in some of the matrices, rising."""
    return np.unique(np.concatenate([sp.csr_array(B).indices for B in matrices]))


def projected_supremizers(
    Z: Annotated[Array, "n", "N'"], B: Annotated[SparseMatrix, "m", "n"], eta: Annotated[Array, "m", "k"]
) -> Array:
    """The product ZᵀBᵀη (N'×k) from the rows of Z (n×N') at the nonzero columns of B (m×n)."""
    rows = _constrained_unknowns([B])
    return np.asarray(Z[rows].T @ _loads(B, rows, eta))


def _loads(B: SparseMatrix, dofs: Indices, eta: Array) -> Array:
    return np.asarray(sp.csr_array(B)[:, dofs].T @ eta)


def supremizer_coordinates(
    V: Annotated[InnerProduct, "n"], basis: Annotated[Array, "n", "N"],
    matrices: Annotated[Sequence[Annotated[SparseMatrix, "m", "n"]], Rule("at least one matrix", len)],
    eta: Annotated[Array, "m", "k"],
) -> tuple[Coordinates, list[Array]]:  # fmt: skip
    """Coordinates for greedy algorithms over supremizers, and those (d×k) of T(mu)η for every matrix.

    From a V-orthonormal basis of V_N (n×N), constraint matrices B(mu) (m×n) and multipliers η (m×k).
    """
    space: Coordinates
    constrained = _constrained_unknowns(matrices)
    if len(constrained) > MANY_UNKNOWNS:  # unknowns that no multiplier loads need no dense work
        constrained = _constrained_unknowns([sp.csr_array(B)[eta.any(axis=1)] for B in matrices])
    # A QR factorisation of all supremizers costs about as much as dense solves with the contact factor of equal size.
    if V.dim * eta.shape[1] * len(matrices) <= len(constrained) ** 2:
        space = SpannedCoordinates(V, basis, np.hstack([supremizers(V, B, eta) for B in matrices]))
        coordinates = space.represented
    else:
        space = ContactCoordinates(V, basis, constrained)
        coordinates = space.supremizers(np.hstack([_loads(B, constrained, eta) for B in matrices]))
    return space, np.split(coordinates, len(matrices), axis=1)
