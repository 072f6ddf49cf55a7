"""Dual norms of residuals at online cost, from their coordinates in an orthonormal basis.

A residual is r = Σ_j z_j t_j with functionals t_j that do not depend on the parameter and coefficients z that do. With
X = FᵀF, its norm in X⁻¹ is ‖Σ_j z_j F⁻ᵀt_j‖. It is evaluated from coordinates in an orthonormal basis U of the F⁻ᵀt_j:
the sum over products z_i z_j of a Gram matrix would keep half the digits (Buhr, Engwer, Ohlberger and Rave, 2014).

Terms that hardly ever contribute, and directions of the others that do not, are left out of U, with bounds of what they
contribute, whatever z is. With R = (F⁻ᵀt_j) of the terms that are kept, a scale d > 0 of their coefficients and
P = I − UUᵀ,

    ‖P R z‖ ≤ ‖P R D‖ ‖D⁻¹z‖,      and    Σ_j |z_j| ‖F⁻ᵀt_j‖    over the terms that are left out.

Sharpness alone depends on d: samples of z give it, and how much is left out is a share of the norms that they have.

**Round-off.** A computed y_j ≈ F⁻ᵀt_j has ‖t_j − Fᵀy_j‖_{X⁻¹} ≤ ε_j, whatever the condition number of X is. With
FᵀF ≼ (1 + η) X,

    ‖Σ_j z_j t_j‖_{X⁻¹} ≤ √(1 + η) |Σ_j z_j y_j| + Σ_j |z_j| ε_j,    Σ_j |z_j| ε_j ≤ |Dε| ‖D⁻¹z‖ for the terms kept.

What U and UᵀR miss of R is computed from them, as R D − U UᵀR D, so that no more is assumed of the decompositions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import isqrt, sqrt

import numpy as np
import scipy.linalg
from scipy.linalg.blas import dgemm

from vibench.arrays import Array, Indices
from vibench.interfaces.problem import Contact
from vibench.linalg import EPS
from vibench.linalg.inner_product import project_out


@dataclass(frozen=True)
class ColumnBlock:
    """A block of the F⁻ᵀt_j (n×p) with their ε_j (p,); only the last rows of `values` (·×p) are not zero."""

    values: Array
    errors: Array
    dim: int

    @cached_property
    def norms(self) -> Array:
        """Their norms (p,)."""
        return np.asarray(np.linalg.norm(self.values, axis=0))

    def padded(self, last: Array) -> Array:
        """Columns of length n, from their last rows."""
        return last if len(last) == self.dim else np.pad(last, ((self.dim - len(last), 0), (0, 0)))


@dataclass(frozen=True)
class ResidualBasis:
    """An orthonormal basis U of residuals."""

    # Positions (p,) in z of the terms that U represents.
    kept: Indices
    # Uᵀ R (K×p).
    factor: Array
    # 1/d (p,).
    inverse_scale: Array
    # Bound of ‖P R D‖.
    remainder: float
    # Bound of the round-off in coordinates and of the ε_j, for ‖D⁻¹z‖ = 1.
    round_off: float
    # Norms (Z,) of the terms that are left out, with their ε_j; zero for those that are kept.
    norms: Array
    # Bound of ‖UᵀU − I‖, and of the same of the transformation that left few rows.
    distortion: float

    def parts(self, z: Array) -> tuple[Array, float, float]:
        """The residual with coefficients z (Z,): its coordinates (K,) in U, and bounds of what is left out of them.

        These are of the part that is orthogonal to U, and of the terms that are left out with all round-off.
        """
        represented = z.take(self.kept)
        scaled = self.inverse_scale * represented
        size = float(scaled @ scaled) ** 0.5
        missing = float(self.norms @ np.abs(z)) + self.round_off * size
        return self.factor @ represented, self.remainder * size, missing


def residual_basis(
    blocks: Sequence[ColumnBlock], samples: Array, beside: float, last: int | None = None
) -> tuple[ResidualBasis, Array]:
    """Basis of the F⁻ᵀt_j, blocks (n×·), from samples of their coefficients (Z×S), and U itself (n×K).

    Remainders are compared with the sampled norms and `beside`, the other term of the same bound, in quadrature. With
    `last`, only that many rows of U are returned (last×K), from the end: if few terms have entries in the rows before,
    an orthogonal factorisation replaces these by as few.
    """
    norms = np.concatenate([block.norms for block in blocks])
    sizes, ranges = np.abs(samples), list(pairwise(np.cumsum([0, *(len(block.norms) for block in blocks)])))
    scale = sizes.max(axis=1, initial=0.0)
    parts = list(zip(blocks, ranges, strict=True))
    sampled = sum(block.padded(block.values @ samples[a:b]) for block, (a, b) in parts)
    typical = float(np.hypot(np.median(np.linalg.norm(sampled, axis=0)), beside))
    # Of many terms those are dropped that add up to 5 % of the typical norm. Few cost little: there 0.3 %, as what
    # they contribute elsewhere may be larger than in the samples.
    fraction = 0.05 if np.count_nonzero(scale) > 1000 else 0.003
    largest, mean = norms * scale, norms * sizes.mean(axis=1)
    order, keep = np.argsort(mean), np.ones(len(mean), bool)
    keep[order[np.cumsum(mean[order]) <= fraction * typical]] = False
    # contributions below 1e-12 of the largest one are round-off of the others
    kept = np.flatnonzero(keep & (largest > 1e-12 * largest.max(initial=0.0)))
    R = np.hstack([block.padded(block.values[:, kept[(kept >= a) & (kept < b)] - a]) for block, (a, b) in parts])
    errors = np.concatenate([block.errors for block in blocks])
    scale, rotated, lost = scale[kept], 0.0, 0.0
    if last is not None:
        R, rotated, lost = _with_fewer_rows(R, last, scale)
    inverse = 1.0 / scale
    reach = float(np.linalg.norm(inverse[:, None] * samples[kept], axis=0).mean())
    # directions left out are orthogonal to the others: 40 % of the typical norm adds 8 % in quadrature
    U, few = _directions(R, scale, 0.4 * typical / max(reach, np.finfo(float).tiny))
    factor, (rows, count) = U.T @ R, U.shape
    left = R * scale - U @ (factor * scale)
    # the round-off in sums of so many terms, see Higham 2002, §3.1 and 3.5
    unit, lengths = 1.01 * EPS, [float(np.linalg.norm(part * scale)) for part in (R, factor)]
    rounded = unit * (count + 4.0) * (lengths[0] + sqrt(count) * lengths[1])
    remainder = length = float(np.linalg.norm(left))
    if few:  # more is left than round-off: the spectral norm, with more than the round-off in it
        small = left.T if left.shape[1] < rows else left
        remainder = min(remainder, sqrt(float(np.linalg.norm(small @ small.T, 2)) * (1.0 + 1e-7)))
    across = float(np.linalg.norm(U.T @ left)) + unit * (rows + 4.0) * sqrt(count) * length + rounded
    round_off = lost + across + unit * (len(kept) + 8.0) * lengths[1]
    round_off += float(np.linalg.norm(scale * (errors[kept] + 4.0 * EPS * norms[kept])))
    norms += errors + 4.0 * EPS * norms
    norms[kept] = 0.0
    distortion = rotated + _distortion(U)
    basis = ResidualBasis(kept, factor, inverse, remainder + rounded, round_off, norms, distortion)
    return basis, U if last is None else U[len(U) - last :]


def _distortion(Q: Array) -> float:
    """Bound of ‖QᵀQ − I‖ (n×k); sums of √n sums of √n terms have less round-off than sums of n terms."""
    parts = np.array_split(Q, isqrt(len(Q)) + 1)
    rounded = 1.01 * EPS * (len(parts) + len(parts[0]) + 4.0) * Q.shape[1]
    return float(np.linalg.norm(sum(part.T @ part for part in parts) - np.eye(Q.shape[1])) + rounded)


def _with_fewer_rows(R: Array, last: int, scale: Array) -> tuple[Array, float, float]:
    """R (n×p) after an orthogonal transformation that leaves few of all rows but the last ones.

    Also its distortion, and a bound of what it loses of the norm of R D z, D = diag(`scale`), for |z| = 1.
    """
    first, last_rows = R[: len(R) - last], R[len(R) - last :]
    entering = np.flatnonzero(first.any(axis=0))
    count = len(entering)
    if 2 * count >= len(first):
        return R, 0.0, 0.0
    few = np.zeros((count, R.shape[1]))
    Q, few[:, entering] = np.linalg.qr(first[:, entering])
    lost = float(np.linalg.norm((first[:, entering] - Q @ few[:, entering]) * scale[entering]))
    lost += 1.01 * EPS * (count + 4.0) * sqrt(count) * float(np.linalg.norm(few * scale))
    return np.vstack([few, last_rows]), _distortion(Q), lost


def _directions(R: Array, scale: Array, allowed: float) -> tuple[Array, bool]:
    """Orthonormal basis (n×K) of S = R D (n×p), D = diag(`scale`), up to a remainder of at most `allowed`.

    If 800 principal directions are not enough, or save few of the columns, the basis is of all columns. Also whether it
    is of fewer.
    """
    count, rest = R.shape[1], 0.0
    # A decomposition of so many terms would cost more than a randomised one, with 100 directions to spare.
    if count > 1000:
        if (randomised := _random_range(R, scale, allowed, limit=900, block=100)) is None:
            return np.linalg.qr(R * scale)[0], False
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
        return Q @ left[:, :enough], True
    return (Q if count <= 1000 else np.linalg.qr(R * scale)[0]), False


def _random_range(R: Array, D: Array, allowed: float, *, limit: int, block: int) -> tuple[Array, Array, float] | None:
    """Orthonormal Q (n×k), QᵀS (k×p) and ‖S − QQᵀS‖ in the Frobenius norm, at most half of `allowed`, for S = R D.

    A randomised range finder by blocks of directions (Martinsson and Voronin, 2016): each of them is computed from the
    remainder of those before, so that no more are computed than are needed. `None` if the decay of remainders says that
    `limit` directions are not enough.
    """
    rng, limit = np.random.default_rng(0), min(limit, *R.shape)
    # updated in place: allocating so much takes as long as computing it
    left = np.empty(R.shape, order="F")
    np.multiply(R, D, out=left)
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
