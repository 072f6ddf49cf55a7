"""Projection on polyhedral cones, and cones that grow greedily, by a lazy maximum, from snapshots (paper, §4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import scipy.linalg
from scipy.optimize import nnls

from vibench.arrays import Array, Indices, Mask
from vibench.errors import NumericalError
from vibench.interfaces.strategies import ReducedSet, Stop, no_free, rays
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.inner_product import InnerProduct
from vibench.signatures import Count, bordered

# A snapshot whose relative distance from the cone is below this is reproduced up to round-off.
REPRODUCED = 1e-12

# Values within this fraction of the largest first value count as equal, and the smallest index wins: duplicated or
# mirrored snapshots must not let round-off choose.
TIE = 1e-9


@bordered
class LazyMaximum:
    """Argmax over indicators that are non-increasing from one greedy step to the next.

    A value computed at an earlier step bounds the present one from above, so only indices whose bound reaches the
    maximum are evaluated again (Minoux 1978). The choice, ties included, is that of evaluating all indicators; `first`
    are those (P,) of the first step. `evaluations` counts evaluations of an indicator.
    """

    _bounds: Annotated[Any, "P"]

    def __init__(self, first: Annotated[Array, "P"]) -> None:
        self._bounds = np.array(first, dtype=float)
        self._tie = TIE * float(np.max(self._bounds, initial=0.0))
        self.evaluations = 0

    def next(self, evaluate: Callable[[int], float]) -> tuple[int, float]:
        """Index of the largest indicator, the smallest one within `TIE`, and the value; `evaluate(p)` is that of p."""
        fresh = np.isneginf(self._bounds)  # excluded
        while True:
            largest = float(self._bounds.max())
            candidates = np.flatnonzero(self._bounds >= largest - self._tie)
            stale = candidates[~fresh[candidates]]
            if not len(stale):
                return int(candidates[0]), largest
            p = int(stale[0])
            # Round-off must not make an indicator grow.
            self._bounds[p] = min(self._bounds[p], evaluate(p))
            fresh[p] = True
            self.evaluations += 1

    def bound(self, bounds: Annotated[Array, "P"]) -> None:
        """Apply upper bounds (P,) of the current indicators where they are below the stored ones."""
        self._bounds = np.minimum(self._bounds, bounds)

    def exclude(self, index: Annotated[Count, "<P"]) -> None:
        """Exclude an index from all later choices."""
        self._bounds[index] = -np.inf


@dataclass(frozen=True)
class Projection:
    """Projection of θ on a cone: coefficients α ≥ 0 (R,) and the distance ‖θ − χα‖_W."""

    coefficients: Array
    distance: float


def project_on_cone(
    generators: Annotated[Array, "m", "R"], theta: Annotated[Array, "m"], W: Annotated[InnerProduct, "m"]
) -> Projection:
    """Project θ (m,) on the cone of `generators` (m×R) in the W norm; a nonnegative least squares problem."""
    return _project_whitened(W.whiten(generators), W.whiten(theta))


def hull_distances(points: Annotated[Array, "m", "r"], targets: Annotated[Array, "m", "k"]) -> Array:
    """Distances (k,) of targets (m×k) from the convex hull of zero and points (m×r), by nonnegative least squares.

    Points and targets are whitened. The weight of zero is one more unknown, and a row that is heavy beside all others
    makes the sum of the weights 1.
    """
    heavy = 1e6 * float(np.max(np.abs(points), initial=0.0))
    sums = np.full((1, points.shape[1] + 1), heavy)
    system = np.vstack([np.column_stack([points, np.zeros(len(points))]), sums])
    weights = np.column_stack([nnls(system, np.append(target, heavy))[0] for target in targets.T])
    return np.asarray(np.linalg.norm(points @ weights[:-1] - targets, axis=0))


def project_on_orthant(functional: Array, W: InnerProduct) -> Array:
    """Projection (m,) on W⁺, nonnegative coefficients, of the Riesz representer of a functional (m,) in the W norm.

    X_W π − s ≥ 0 and π ≥ 0 are complementary. An active set method starts from the support of the positive part of s;
    where its sets cycle, nonnegative least squares replaces it.
    """
    if W.is_diagonal:
        return np.asarray(np.maximum(functional, 0.0) / W.matrix.diagonal())
    free, seen, norms = functional > 0.0, set[bytes](), np.sqrt(W.matrix.diagonal())
    round_off = 1e-14 * norms * np.max(np.abs(functional) / norms, initial=0.0)
    while free.tobytes() not in seen:
        seen.add(free.tobytes())
        support = np.flatnonzero(free)
        projection = np.zeros(W.dim)
        if len(support):
            projection[support] = _solve_block(W, support, functional[support])
        residual = functional - W.apply(projection)
        following = np.where(free, projection > 0.0, residual > round_off)
        if np.array_equal(following, free):
            return projection
        free = following
    return project_on_cone(np.eye(W.dim), W.riesz(functional), W).coefficients


def _solve_block(W: InnerProduct, support: Indices, right: Array) -> Array:
    # Below 128 unknowns a dense system costs less than a sparse one; a dense X_W is stored for small spaces.
    if len(support) > 128:
        return SparseCholesky(W.matrix[support][:, support], "a block of X_W").solve(right)
    block = W.dense[np.ix_(support, support)] if W.dim <= 1024 else W.matrix[support][:, support].toarray()
    return np.asarray(scipy.linalg.cho_solve(scipy.linalg.cho_factor(block, check_finite=False), right))


def _project_whitened(generators: Array, theta: Array) -> Projection:
    if not generators.shape[1]:
        return Projection(np.zeros(0), float(np.linalg.norm(theta)))
    try:
        coefficients, distance = nnls(generators, theta, maxiter=30 * generators.shape[1])
    except RuntimeError as error:
        raise NumericalError(f"projection on a cone of {generators.shape[1]} generators failed: {error}") from None
    return Projection(np.asarray(coefficients), float(distance))


@bordered
class GrowingCone:
    """A cone that grows by one generator at a time, and the snapshot that is farthest from it.

    Greedy algorithms with the relative maximum criterion (paper, equations (13) and (34)) are a loop over `farthest`
    and `add`. Cones are nested, so distances only fall and the maximum is taken lazily. `generators` are those so far
    (m×r), of unit norm, `farthest` is the index of the snapshot farthest from the cone, and `error` its distance,
    relative to the largest norm of a snapshot.

    Raises a `NumericalError` if a snapshot θ_q (m×Q) has a negative coefficient: it would not be in W⁺.
    """

    def __init__(self, snapshots: Annotated[Array, "m", "Q"], W: Annotated[InnerProduct, "m"]) -> None:
        refuse_negative(snapshots)
        whitened = W.whiten(snapshots)
        self._W, self._norms = W, np.linalg.norm(whitened, axis=0)
        self.generators = np.zeros((W.dim, 0))
        largest = float(self._norms.max(initial=0.0))
        self.error = 1.0 if largest else 0.0
        self._errors, self._fallbacks = [self.error], list[str]()
        if largest:
            # Ties go to the smallest index, as in `LazyMaximum`.
            self.farthest = int(np.argmax(self._norms >= largest * (1.0 - TIE)))
            self._distances = LazyDistances(whitened)

    def reached(self, stop: Stop) -> bool:
        """Whether the cone is large enough, or reproduces all snapshots to round-off."""
        return stop.reached(self.generators.shape[1], self.error) or self.error <= REPRODUCED

    def add(self, direction: Annotated[Array, "m"], note: str = "") -> bool:
        """Add the generator of a direction (m,), such as `farthest`, with a `note` on a deviation from the algorithm.

        `False` where the direction is nothing but round-off, as it is if all snapshots are reproduced, and where there
        are as many generators as snapshots, which would themselves be enough.
        """
        if note:
            self._fallbacks.append(f"generator {self.generators.shape[1] + 1}: {note}")
        length = float(self._W.norm(direction))
        complete = not self.error or self.generators.shape[1] == len(self._norms)
        if complete or length <= REPRODUCED * self._norms[self.farthest]:
            # Normalised, round-off would be an arbitrary generator.
            return False
        self.generators = np.column_stack([self.generators, direction / length])
        self._distances.widen(self._W.whiten(self.generators), self.farthest)
        self.farthest, largest = self._distances.next()
        self.error = max(largest, 0.0)  # of no snapshot if all are excluded
        self._errors.append(self.error)
        return True

    def result(self) -> ReducedSet:
        """The cone, with its error for every number of generators."""
        return ReducedSet(
            self.generators, np.array(self._errors), no_free(len(self._errors) - 1), tuple(self._fallbacks)
        )


def greedy_cone(snapshots: Annotated[Array, "m", "P"], W: Annotated[InnerProduct, "m"], stop: Stop) -> ReducedSet:
    """Cone of snapshots (m×Q) chosen greedily (paper, Remark 4.3, and Benaceur, Ern and Ehrlacher 2020).

    Each step adds the snapshot farthest from the present cone, normalised. It ends before `stop` where all snapshots
    are reproduced to round-off (Remark 4.2). Snapshots that are not in W⁺ are refused as by `GrowingCone`.
    """
    cone = GrowingCone(snapshots, W)
    while not cone.reached(stop) and cone.add(snapshots[:, cone.farthest]):
        pass
    return cone.result()


def refuse_negative(snapshots: Annotated[Array, "m", "Q"]) -> None:
    """Raise a `NumericalError` if snapshots (m×Q) have a negative coefficient: they would not be in W⁺."""
    if np.min(snapshots, initial=0.0) < 0.0:
        raise NumericalError(f"a multiplier snapshot has the negative coefficient {snapshots.min():.1e}")


@bordered
class LazyDistances:
    """Largest distance of snapshots from a growing cone, relative to the largest norm, with few projections.

    Any point of the cone bounds the distance from above. One point is stored for every snapshot. When the cone grows,
    the point is replaced by its best combination with the new generator and improved by one sweep of coordinate
    descent. A projection is computed only where these bounds do not decide the `maximum`, which counts them.

    The snapshots (m×Q), not all zero, are `whitened`: in coordinates in which the norm is Euclidean.
    """

    _snapshots: Annotated[Any, "m", "Q"]
    _generators: Annotated[Any, "m", "r"]

    def __init__(self, whitened: Annotated[Array, "m", "Q"]) -> None:
        self._snapshots = whitened
        norms = np.linalg.norm(whitened, axis=0)
        self._largest = float(norms.max())
        self._generators = np.zeros((whitened.shape[0], 0))
        self._coefficients = np.zeros((0, whitened.shape[1]))  # one point of the cone for every snapshot
        self._taken = np.zeros(whitened.shape[1], bool)
        self.maximum = LazyMaximum(norms / self._largest)

    def widen(self, generators: Annotated[Array, "m", "r+1"], taken: Annotated[Count | None, "<Q"] = None) -> None:
        """Add the last of the generators (m×r, unit norm, whitened), which is of the snapshot `taken`.

        That one is not chosen again if it is in the cone to round-off (paper, Remark 4.1).
        """
        old, new = _best_combination(self._generators @ self._coefficients, generators[:, -1], self._snapshots)
        self._coefficients = np.vstack([self._coefficients * old, new])
        self._generators = generators
        # One sweep of coordinate descent makes the bounds much sharper at the cost of a product.
        slope = generators.T @ (self._snapshots - generators @ self._coefficients)
        for i, row in enumerate(generators.T @ generators):
            step = np.maximum(slope[i], -self._coefficients[i])
            self._coefficients[i] += step
            slope -= row[:, None] * step
        bounds = np.linalg.norm(self._snapshots - generators @ self._coefficients, axis=0) / self._largest
        self.maximum.bound(bounds)
        if taken is not None:
            self._taken[taken] = True
            if bounds[taken] <= TIE:
                self.maximum.exclude(taken)

    def next(self) -> tuple[int, float]:
        """Index of the snapshot farthest from the cone, and its distance; −inf if all were taken."""
        return self.maximum.next(self._distance)

    def residual(self, q: Annotated[Count, "<Q"]) -> Array:
        """Snapshot minus its stored point of the cone (m,), which is its projection for the index from `next`."""
        return np.asarray(self._snapshots[:, q] - self._generators @ self._coefficients[:, q])

    def _distance(self, q: int) -> float:
        projection = _project_whitened(self._generators, self._snapshots[:, q])
        self._coefficients[:, q] = projection.coefficients
        distance = projection.distance / self._largest
        return -np.inf if self._taken[q] and distance <= TIE else distance


def _best_combination(points: Array, nu: Array, targets: Array) -> tuple[Array, Array]:
    """Coefficients a, b ≥ 0 (Q,) that minimise ‖a·point + b·ν − target‖; points, targets (m×Q), unit vector ν (m,).

    These are the unconstrained minimiser where both are nonnegative, else the better one of a = 0 and b = 0.
    """
    square, overlap = np.sum(points**2, axis=0), nu @ points
    on_point, on_nu = np.sum(points * targets, axis=0), nu @ targets
    determinant = square - overlap**2
    independent = determinant > 1e-8 * square
    scale = np.where(independent, determinant, 1.0)
    a, b = (on_point - overlap * on_nu) / scale, (square * on_nu - overlap * on_point) / scale
    both, safe = independent & (a >= 0.0) & (b >= 0.0), np.where(square > 0.0, square, 1.0)
    nu_alone = (np.maximum(on_nu, 0.0) ** 2 > on_point**2 / safe) | (square == 0.0)
    single_a = np.where(nu_alone, 0.0, np.maximum(on_point, 0.0) / safe)
    single_b = np.where(nu_alone, np.maximum(on_nu, 0.0), 0.0)
    return np.where(both, a, single_a), np.where(both, b, single_b)


def orthogonality(generators: Array, W: InnerProduct, free: Mask | None = None) -> Array:
    """e_orth(r) for r = 0 … R−1: distance of generator r+1 from the cone of the first r (paper, equation (41)).

    `free` marks generators (R,) that may be used with either sign; none by default.
    """
    whitened = W.whiten(generators)
    free = no_free(whitened.shape[1]) if free is None else free
    cones = (rays(whitened[:, :r], free[:r]) for r in range(whitened.shape[1]))
    return np.array([_project_whitened(cone, whitened[:, r]).distance for r, cone in enumerate(cones)])
