"""Strategies that are wrong, each in one way; what `vibench check` has to find, and nothing else."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from vibench import Array, InnerProduct, NestedStrategy, Step, greedy_cone, project_on_cone, supremizers
from vibench.interfaces.strategies import DualStrategy, Enrichment, Kind, Offline, PrimalStrategy, ReducedSet, Stop


class Greedy(DualStrategy):
    """The snapshot farthest from the cone, as often as needed."""

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        return greedy_cone(snapshots, W, stop)


def _reducing(name: str, change: Callable[[ReducedSet, InnerProduct], ReducedSet]) -> type[Greedy]:
    members = {"reduce": lambda self, snapshots, W, stop: change(greedy_cone(snapshots, W, stop), W)}
    return type(name, (Greedy,), {"__module__": __name__, **members})


def _stopping(name: str, change: Callable[[Stop], Stop]) -> type[Greedy]:
    members = {"reduce": lambda self, snapshots, W, stop: greedy_cone(snapshots, W, change(stop))}
    return type(name, (Greedy,), {"__module__": __name__, **members})


def _with_a_negative_entry(cone: ReducedSet, W: InnerProduct) -> ReducedSet:
    """Generators with the last one taken out of them; directions that are no multipliers."""
    chi = cone.generators.copy()
    chi[3, -1] = -0.01
    return replace(cone, generators=chi / W.norm(chi))


def _drawn(cone: ReducedSet, W: InnerProduct) -> ReducedSet:
    """Snapshots summed up with weights that are drawn each time."""
    chi = cone.generators * (1.0 + 1e-12 * np.random.default_rng().random((W.dim, 1)))
    return replace(cone, generators=chi / W.norm(chi))


NegativeGenerators = _reducing("NegativeGenerators", _with_a_negative_entry)
# Claims smaller errors than it makes, but for the first and the last.
Boasts = _reducing(
    "Boasts",
    lambda cone, W: replace(cone, errors=np.r_[cone.errors[:1], 0.5 * cone.errors[1:-1], cone.errors[1:][-1:]]),
)
# Says how good the cone is, and nothing of smaller ones; which is all right.
LastErrorAlone = _reducing(
    "LastErrorAlone", lambda cone, W: replace(cone, generators=cone.generators[:, ::-1].copy(), errors=cone.errors[-1:])
)
OneErrorTooFew = _reducing("OneErrorTooFew", lambda c, W: replace(c, errors=c.errors[1:]) if c.size > 1 else c)
Draws = _reducing("Draws", _drawn)
# Stops at twice the tolerance, and says so.
Misses = _stopping("Misses", lambda stop: stop if stop.tolerance is None else Stop(tolerance=2.0 * stop.tolerance))
# Two generators at least.
Oversized = _stopping("Oversized", lambda stop: Stop(size=2) if stop.size == 1 else stop)


class Normalises(Greedy):
    """Divides the snapshots it is given by their norms."""

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        cone = super().reduce(snapshots.copy(), W, stop)
        norms = W.norm(snapshots)
        snapshots /= np.where(norms > 0.0, norms, 1.0)
        return cone


class DividesByZero(DualStrategy):
    """Every snapshot is a generator, a zero one as well."""

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        count = snapshots.shape[1] if stop.size is None else stop.size
        with np.errstate(invalid="ignore"):
            chi = snapshots[:, :count] / W.norm(snapshots[:, :count])
        distances = [project_on_cone(chi, q, W).distance for q in snapshots.T] if np.all(np.isfinite(chi)) else [0.0]
        error = max(distances) / max(float(W.norm(snapshots).max()), 1e-300)
        return ReducedSet(chi, np.array([error]), np.zeros(chi.shape[1], dtype=bool))


class UnpicklableDual(Greedy):
    def __init__(self) -> None:
        self.weight = lambda theta: theta


class Supremizing(PrimalStrategy):
    """All supremizers of the first training parameters, the more the tighter the tolerance."""

    takes_tolerance: ClassVar[bool] = True

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        return Enrichment(Kind.FIXED, vectors=self.vectors(offline, self.count(float(tolerance))))  # type: ignore[arg-type]

    def count(self, tolerance: float) -> int:
        return round(5.0 * (1.0 - tolerance))

    def vectors(self, offline: Offline, count: int) -> Array:
        V, problem = offline.problem.V, offline.problem
        found = [supremizers(V, problem.constraint(mu)[0], offline.span) for mu in offline.training[:count]]
        return V.orthonormalise(np.hstack([np.zeros((V.dim, 0)), *found]), offline.basis)


def _supremizing(name: str, **members: Any) -> type[Supremizing]:
    return type(name, (Supremizing,), {"__module__": __name__, **members})


def _drawn_vectors(self: Supremizing, offline: Offline, count: int) -> Array:
    V = offline.problem.V
    return V.orthonormalise(np.random.default_rng().standard_normal((V.dim, count)), offline.basis)


def _of_one_kind_above(self: Supremizing, offline: Offline, tolerance: float) -> Enrichment:
    return Enrichment(Kind.NONE) if tolerance > 0.8 else Supremizing.build(self, offline, tolerance)


# Orthonormal in the Euclidean sense.
NotOrthogonal = _supremizing(
    "NotOrthogonal", vectors=lambda self, offline, count: np.linalg.qr(Supremizing.vectors(self, offline, count))[0]
)
# Forgets to say that it takes one.
AsksForATolerance = _supremizing("AsksForATolerance", takes_tolerance=False)
# Takes a tolerance, and is content without.
NeedsNone = _supremizing("NeedsNone", build=lambda self, offline, tol: Supremizing.build(self, offline, tol or 0.5))
Fewer = _supremizing("Fewer", count=lambda self, tolerance: round(5.0 * tolerance))
KindOfTwo = _supremizing("KindOfTwo", build=_of_one_kind_above)
DrawsVectors = _supremizing("DrawsVectors", vectors=_drawn_vectors)


class ChangesTheBasis(Supremizing):
    def vectors(self, offline: Offline, count: int) -> Array:
        found = super().vectors(offline, count)
        offline.basis[:, 0] *= -1.0
        return found


class NoMultiplier(Supremizing):
    """Fails where the cone is empty."""

    def vectors(self, offline: Offline, count: int) -> Array:
        assert offline.span.shape[1] > 0, "no multiplier"
        return super().vectors(offline, count)


class SuppliesFunction(PrimalStrategy):
    """Supplies what cannot travel between processes."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        return Enrichment(Kind.PER_PARAMETER, supply=lambda V, vi, span: supremizers(V, vi.B, span))


def one_vector(V: InnerProduct, vi: object, span: Array) -> Array:
    return np.ones(V.dim)


class SuppliesAVector(PrimalStrategy):
    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        return Enrichment(Kind.PER_PARAMETER, supply=one_vector)


class Restarts(NestedStrategy):
    """Says it is nested, and begins with another vector at every tolerance."""

    def steps(self, offline: Offline) -> Iterator[Step]:
        V, problem = offline.problem.V, offline.problem
        B, _ = problem.constraint(offline.training[0])
        found = V.orthonormalise(supremizers(V, B, offline.span), offline.basis)
        for count in range(found.shape[1] + 1):
            measure = 0.0 if count == found.shape[1] else 1.0 - (count + 0.5) / 4.0
            yield Step(count, measure, lambda first, count=count: found[:, :count][:, ::-1][:, first:], {})
