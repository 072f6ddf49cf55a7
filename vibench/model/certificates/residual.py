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

TERMS, DIRECTIONS = 0.05, 0.4
"""Bounds of what is left out are these shares of the typical norm: of terms, and of directions, which are orthogonal to
those that are kept."""

NEGLIGIBLE = 1e-12
"""Contributions below this share of the largest one are not worth computing."""

FEW, SHARE_OF_FEW = 1000, 0.25
"""All principal directions of up to so many terms are computed, and this share of the above is left out."""

TERMS_OF_FEW = 0.003
"""Few terms in all are kept but for this share: what they contribute elsewhere may be larger than in samples."""

MOST, OVERSAMPLING = 800, 100
"""Largest number of principal directions, and how many more a randomised method computes."""

BLOCK = 100
"""Directions that the randomised method computes at once."""


class ResidualTerms(Protocol):
    """Some of the F⁻ᵀt_j, of which not all may be wanted."""

    @property
    def norms(self) -> Array:
        """Their norms (p,)."""

    def columns(self, chosen: Indices) -> Array:
        """The chosen ones (n×c)."""

    def combined(self, samples: Array) -> Array:
        """Their sums (n×S) with coefficients (p×S)."""


@dataclass(frozen=True)
class ColumnBlock:
    """All of them, as an array (n×p)."""

    values: Array

    @property
    def norms(self) -> Array:
        """Their norms (p,)."""
        return np.asarray(np.linalg.norm(self.values, axis=0))

    def columns(self, chosen: Indices) -> Array:
        """The chosen ones (n×c)."""
        return self.values[:, chosen]

    def combined(self, samples: Array) -> Array:
        """Their sums (n×S) with coefficients (p×S)."""
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
        """Their norms (k,)."""
        inverse = scipy.linalg.solve_triangular(self.trailing, np.eye(len(self.trailing)), check_finite=False)
        return np.asarray(np.linalg.norm(inverse, axis=1))

    def columns(self, chosen: Indices) -> Array:
        """The chosen ones (n×c)."""
        return self.combined(np.eye(len(self.trailing))[:, chosen])

    def combined(self, samples: Array) -> Array:
        """Their sums (n×S) with coefficients (k×S)."""
        result = np.zeros((self.dim, samples.shape[1]))
        if samples.size:
            last = scipy.linalg.solve_triangular(self.trailing, samples, trans="T", check_finite=False)
            result[self.dim - len(self.trailing) :] = last
        return result


@dataclass(frozen=True)
class ResidualBasis:
    """An orthonormal basis U of residuals; see above.

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
        represented = z[self.kept]
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
    """Basis of the F⁻ᵀt_j, given as blocks (n×·), from samples of their coefficients (Z×S), and U itself (n×K).

    What is left out is compared with the sampled norms and `beside`, what else enters the same bound in quadrature.
    With `last`, U is returned in so many rows at the end alone (last×K): where few terms have entries in the rows
    before, these are replaced by as many by an orthogonal factorisation.
    """
    norms = np.concatenate([block.norms for block in blocks])
    sizes, ranges = np.abs(samples), list(pairwise(np.cumsum([0, *(len(block.norms) for block in blocks)])))
    scale = sizes.max(axis=1, initial=0.0)
    sampled = sum(block.combined(samples[a:b]) for block, (a, b) in zip(blocks, ranges, strict=True))
    typical = float(np.hypot(np.median(np.linalg.norm(sampled, axis=0)), beside))
    share = TERMS if np.count_nonzero(scale) > FEW else TERMS_OF_FEW
    kept = _worth_keeping(norms * scale, norms * sizes.mean(axis=1), share * typical)
    pairs = zip(blocks, ranges, strict=True)
    R = np.hstack([block.columns(kept[(kept >= a) & (kept < b)] - a) for block, (a, b) in pairs])
    if last is not None:
        R = _with_fewer_rows(R, last)
    inverse = 1.0 / scale[kept]
    reach = float(np.linalg.norm(inverse[:, None] * samples[kept], axis=0).mean())
    U, remainder = _directions(R, scale[kept], DIRECTIONS * typical / max(reach, np.finfo(float).tiny))
    norms[kept], factor = 0.0, U.T @ R
    round_off = 1.01 * EPS * (len(kept) + 8.0) * float(np.linalg.norm(factor * scale[kept]))
    basis = ResidualBasis(kept, factor, inverse, remainder + round_off, norms)
    return basis, U if last is None else U[len(U) - last :]


def _with_fewer_rows(R: Array, last: int) -> Array:
    """R (n×p) after an orthogonal transformation of all rows but the last ones, that leaves few of them."""
    first, last_rows = R[: len(R) - last], R[len(R) - last :]
    entering = np.flatnonzero(first.any(axis=0))
    if 2 * len(entering) >= len(first):
        return R
    few = np.zeros((len(entering), R.shape[1]))
    few[:, entering] = np.linalg.qr(first[:, entering], mode="r")
    return np.vstack([few, last_rows])


def _worth_keeping(largest: Array, mean: Array, allowed: float) -> Indices:
    """Positions of the terms to keep, rising: the others contribute `allowed` at most on average."""
    order = np.argsort(mean)
    dropped = np.cumsum(mean[order]) <= allowed
    keep = np.ones(len(mean), bool)
    keep[order[dropped]] = False
    return np.flatnonzero(keep & (largest > NEGLIGIBLE * largest.max(initial=0.0)))


def _directions(R: Array, scale: Array, allowed: float) -> tuple[Array, float]:
    """Orthonormal basis (n×K) of S = R D (n×p), D = diag(`scale`), up to a remainder, and a bound of its norm.

    It is at most `allowed`. All of the columns where `MOST` principal directions are not enough, or few of the columns
    are saved: then nothing remains.
    """
    count = R.shape[1]
    if count > FEW:
        found = _random_range(R, scale, allowed)
        if found is None:
            return np.linalg.qr(R * scale)[0], 0.0
        Q, small, rest = found
    else:
        Q, small = np.linalg.qr(R * scale)
        rest, allowed = 0.0, allowed * SHARE_OF_FEW  # but for round-off
    # The transpose of a triangular factor has the same left singular vectors.
    triangle = scipy.linalg.qr(small.T, mode="r", check_finite=False)[0][: len(small)]
    left, sigma, _ = np.linalg.svd(triangle.T, full_matrices=False)
    remainders = np.hypot(np.append(sigma, 0.0), rest)
    enough = int(np.argmax(remainders <= allowed))
    if remainders[enough] <= allowed and enough <= min(MOST, 0.7 * count):
        return Q @ left[:, :enough], float(remainders[enough])
    return (Q if count <= FEW else np.linalg.qr(R * scale)[0]), 0.0


def _random_range(R: Array, scale: Array, allowed: float) -> tuple[Array, Array, float] | None:
    """Orthonormal Q (n×k), QᵀS (k×p) and ‖S − QQᵀS‖ in the Frobenius norm, at most half of `allowed`, for S = R D.

    A randomised range finder by blocks (Martinsson and Voronin, 2016): each of them is found in what the ones before
    leave, so that no more are computed than are needed. `None` where the decay says that `MOST` will not do.
    """
    rng, limit = np.random.default_rng(0), min(MOST + OVERSAMPLING, *R.shape)
    left = np.empty(R.shape, order="F")  # updated in place: to allocate so much takes as long as to compute it
    np.multiply(R, scale, out=left)
    bases, parts, rests = list[Array](), list[Array](), [float(np.linalg.norm(left))]
    while rests[-1] > 0.5 * allowed:
        remaining = limit - sum(basis.shape[1] for basis in bases)
        decay = rests[-1] / rests[-2] if len(bases) > 1 else 0.0  # of a block; the first one is the fastest
        if not remaining or rests[-1] * decay ** (remaining / BLOCK) > allowed:
            return None
        Q = np.linalg.qr(left @ rng.standard_normal((R.shape[1], min(BLOCK, remaining))))[0]
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
