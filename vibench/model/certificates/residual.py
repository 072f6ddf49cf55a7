"""Dual norms of residuals at online cost, from their coordinates in an orthonormal basis.

A residual is r = Σ_j z_j t_j with functionals t_j that do not depend on the parameter and coefficients z that do. With
X = FᵀF, its norm in X⁻¹ is ‖Σ_j z_j F⁻ᵀt_j‖. It is evaluated from coordinates in an orthonormal basis U of the F⁻ᵀt_j:
the sum over products z_i z_j of a Gram matrix would keep half the digits (Buhr, Engwer, Ohlberger and Rave, 2014).

Terms that hardly ever contribute, and directions of the others that do not, are left out of U, with bounds of what they
contribute, whatever z is. With R = (F⁻ᵀt_j) of the terms that are kept, a scale d > 0 of their coefficients and
P = I − UUᵀ,

    ‖P R z‖ ≤ ‖P R D‖ ‖D⁻¹z‖,      and    Σ_j |z_j| ‖F⁻ᵀt_j‖    over the terms that are left out.

Sharpness alone depends on d: samples of z give it, and how much is left out is a share of the norms that they have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Protocol

import numpy as np
import scipy.linalg
from scipy.linalg.blas import dgemm

from vibench.arrays import Array, Indices
from vibench.interfaces.problem import Contact
from vibench.linalg import EPS
from vibench.linalg.inner_product import project_out


class ResidualTerms(Protocol):
    """A block of the F⁻ᵀt_j, of which only some columns may be computed."""

    @property
    def norms(self) -> Array:
        """Their norms (p,)."""

    def columns(self, chosen: Indices) -> Array:
        """The chosen ones (n×c)."""

    def combined(self, samples: Array) -> Array:
        """Their sums (n×S) with coefficients (p×S)."""


@dataclass(frozen=True)
class ColumnBlock:
    """A block that is stored as an array (n×p)."""

    values: Array

    @property
    def norms(self) -> Array:
        return np.asarray(np.linalg.norm(self.values, axis=0))

    def columns(self, chosen: Indices) -> Array:
        return self.values[:, chosen]

    def combined(self, samples: Array) -> Array:
        return np.asarray(self.values @ samples)


@dataclass(frozen=True)
class ContactFunctionals:
    """The functionals that act on one contact unknown each, in coordinates that have these unknowns at the end.

    There X = FᵀF with F upper triangular, and `trailing` is its last block (k×k); n is the dimension of the space.
    """

    trailing: Array
    dim: int

    @cached_property
    def norms(self) -> Array:
        inverse = scipy.linalg.solve_triangular(self.trailing, np.eye(len(self.trailing)), check_finite=False)
        return np.asarray(np.linalg.norm(inverse, axis=1))

    def columns(self, chosen: Indices) -> Array:
        return self.combined(np.eye(len(self.trailing))[:, chosen])

    def combined(self, samples: Array) -> Array:
        result = np.zeros((self.dim, samples.shape[1]))
        if samples.size:
            last = scipy.linalg.solve_triangular(self.trailing, samples, trans="T", check_finite=False)
            result[self.dim - len(self.trailing) :] = last
        return result


@dataclass(frozen=True)
class ResidualBasis:
    """An orthonormal basis U of residuals.

    Attributes
    ----------
    kept
        Positions (p,) in z of the terms that U represents.
    factor
        Uᵀ R (K×p).
    inverse_scale
        1/d (p,).
    remainder
        Bound of ‖P R D‖, and of the round-off in coordinates for ‖D⁻¹z‖ = 1.
    norms
        Norms (Z,) of the terms that are left out; zero for those that are kept.
    """

    kept: Indices
    factor: Array
    inverse_scale: Array
    remainder: float
    norms: Array

    def parts(self, z: Array) -> tuple[Array, float, float]:
        """The residual with coefficients z (Z,): its coordinates (K,) in U, and bounds of what is left out of them.

        These are of the part that is orthogonal to U with the round-off, and of the terms that are left out.
        """
        represented = z.take(self.kept)
        scaled = self.inverse_scale * represented
        beside = self.remainder * float(scaled @ scaled) ** 0.5
        return self.factor @ represented, beside, float(self.norms @ np.abs(z))

    def norm(self, z: Array) -> float:
        """Upper bound of the dual norm of the residual."""
        coordinates, beside, missing = self.parts(z)
        return float(np.hypot(np.linalg.norm(coordinates), beside)) + missing


def residual_basis(
    blocks: Sequence[ResidualTerms], samples: Array, beside: float, last: int | None = None
) -> tuple[ResidualBasis, Array]:
    """Basis of the F⁻ᵀt_j, blocks (n×·), from samples of their coefficients (Z×S), and U itself (n×K).

    Remainders are compared with the sampled norms and `beside`, the other term of the same bound, in quadrature. With
    `last`, only that many rows of U are returned (last×K), from the end: if few terms have entries in the rows before,
    an orthogonal factorisation replaces these by as few.
    """
    norms = np.concatenate([block.norms for block in blocks])
    sizes, ranges = np.abs(samples), list(pairwise(np.cumsum([0, *(len(block.norms) for block in blocks)])))
    scale = sizes.max(axis=1, initial=0.0)
    sampled = sum(block.combined(samples[a:b]) for block, (a, b) in zip(blocks, ranges, strict=True))
    typical = float(np.hypot(np.median(np.linalg.norm(sampled, axis=0)), beside))
    # Of many terms those are dropped that add up to 5 % of the typical norm. Few cost little: there 0.3 %, as what
    # they contribute elsewhere may be larger than in the samples.
    fraction = 0.05 if np.count_nonzero(scale) > 1000 else 0.003
    largest, mean = norms * scale, norms * sizes.mean(axis=1)
    order, keep = np.argsort(mean), np.ones(len(mean), bool)
    keep[order[np.cumsum(mean[order]) <= fraction * typical]] = False
    # contributions below 1e-12 of the largest one are round-off of the others
    kept = np.flatnonzero(keep & (largest > 1e-12 * largest.max(initial=0.0)))
    pairs = zip(blocks, ranges, strict=True)
    R = np.hstack([block.columns(kept[(kept >= a) & (kept < b)] - a) for block, (a, b) in pairs])
    if last is not None:
        R = _with_fewer_rows(R, last)
    inverse = 1.0 / scale[kept]
    reach = float(np.linalg.norm(inverse[:, None] * samples[kept], axis=0).mean())
    # directions left out are orthogonal to the others: 40 % of the typical norm adds 8 % in quadrature
    U, remainder = _directions(R, scale[kept], 0.4 * typical / max(reach, np.finfo(float).tiny))
    norms[kept], factor = 0.0, U.T @ R
    # the round-off in sums of p terms, of the product UᵀR and of that with z, see Higham 2002, §3.1
    round_off = 1.01 * EPS * (len(kept) + 8.0) * float(np.linalg.norm(factor * scale[kept]))
    basis = ResidualBasis(kept, factor, inverse, remainder + round_off, norms)
    return basis, U if last is None else U[len(U) - last :]


def _with_fewer_rows(R: Array, last: int) -> Array:
    """The matrix R (n×p) after an orthogonal transformation that leaves few of all rows but the last ones."""
    first, last_rows = R[: len(R) - last], R[len(R) - last :]
    entering = np.flatnonzero(first.any(axis=0))
    if 2 * len(entering) >= len(first):
        return R
    few = np.zeros((len(entering), R.shape[1]))
    few[:, entering] = np.linalg.qr(first[:, entering], mode="r")
    return np.vstack([few, last_rows])


def _directions(R: Array, scale: Array, allowed: float) -> tuple[Array, float]:
    """Orthonormal basis (n×K) of S = R D (n×p), D = diag(`scale`), up to a remainder, and a bound of its norm.

    It is at most `allowed`. If 800 principal directions are not enough, or save few of the columns, the basis is of all
    columns, and nothing remains.
    """
    count, rest = R.shape[1], 0.0
    # A decomposition of so many terms would cost more than a randomised one, with 100 directions to spare.
    if count > 1000:
        randomised = _random_range(R, scale, allowed, limit=900, block=100)
        if randomised is None:
            return np.linalg.qr(R * scale)[0], 0.0
        Q, small, rest = randomised
    else:
        Q, small = np.linalg.qr(R * scale)
        allowed *= 0.25  # few directions cost little: a quarter of the remainder
    # The transpose of a triangular factor has the same left singular vectors.
    triangle = scipy.linalg.qr(small.T, mode="r", check_finite=False)[0][: len(small)]
    left, sigma, _ = np.linalg.svd(triangle.T, full_matrices=False)
    remainders = np.hypot(np.append(sigma, 0.0), rest)
    enough = int(np.argmax(remainders <= allowed))
    if remainders[enough] <= allowed and enough <= min(800, 0.7 * count):
        return Q @ left[:, :enough], float(remainders[enough])
    return (Q if count <= 1000 else np.linalg.qr(R * scale)[0]), 0.0


def _random_range(
    R: Array, scale: Array, allowed: float, *, limit: int, block: int
) -> tuple[Array, Array, float] | None:
    """Orthonormal Q (n×k), QᵀS (k×p) and ‖S − QQᵀS‖ in the Frobenius norm, at most half of `allowed`, for S = R D.

    A randomised range finder by blocks of directions (Martinsson and Voronin, 2016): each of them is computed from the
    remainder of those before, so that no more are computed than are needed. `None` if the decay of remainders says that
    `limit` directions are not enough.
    """
    rng, limit = np.random.default_rng(0), min(limit, *R.shape)
    # updated in place: allocating so much takes as long as computing it
    left = np.empty(R.shape, order="F")
    np.multiply(R, scale, out=left)
    bases, parts, rests = list[Array](), list[Array](), [float(np.linalg.norm(left))]
    while rests[-1] > 0.5 * allowed:
        remaining = limit - sum(basis.shape[1] for basis in bases)
        # the decay in one block; that of the first one is the fastest, and predicts nothing
        decay = rests[-1] / rests[-2] if len(bases) > 1 else 0.0
        if not remaining or rests[-1] * decay ** (remaining / block) > allowed:
            return None
        Q = np.linalg.qr(left @ rng.standard_normal((R.shape[1], min(block, remaining))))[0]
        Q = np.linalg.qr(left @ (left.T @ Q))[0]
        if bases:
            Q = np.linalg.qr(project_out(np.hstack(bases), Q))[0]
        parts.append(Q.T @ left)
        left = dgemm(-1.0, Q, parts[-1], 1.0, left, overwrite_c=1)
        bases.append(Q)
        rests.append(float(np.linalg.norm(left)))
    return np.hstack(bases), np.vstack(parts), rests[-1]


def residual_coefficients(
    theta: Mapping[str, Array], y: Array, forces: Array | None, contact: Contact | None, alpha: Array, lam: Array
) -> Array:
    """Coefficients (Z,) of a residual: those of f, of A for every vector of Φ, and of Bᵀλ_N.

    The last ones are θ_q α_i of all Bᵀ_q χ_i (Q R,) where B is exactly the sum of its terms. Where it is assembled on
    the contact, and there are `forces`, they are what B₀ᵀλ_N lacks, on the contact unknowns, and α for the vectors
    B₀ᵀχ (k+R,).
    """
    if forces is None:
        of_lam = (theta["B"][:, None] * alpha).ravel()
    else:
        assert contact is not None  # evaluated where B is assembled on the contact
        of_lam = np.concatenate([contact.B.T @ lam - forces @ alpha, alpha])
    return np.concatenate([theta["f"], (-theta["A"][:, None] * y).ravel(), -of_lam])
