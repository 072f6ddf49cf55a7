"""Dual sets: the closed convex set K of the multipliers, a product of blocks of rows.

The problem is min ½uᵀA u − fᵀu + σ_K(B u − g), with σ_K(y) = sup { λᵀy : λ ∈ K }. A row by itself is a ray, λ ≥ 0:
contact, σ_K = 0 where B u ≤ g. The other blocks have

    interval  |λ| ≤ c      one row      σ_K(y) = c |y|             friction with a given bound in the plane
    disc      |λ| ≤ c      k rows       σ_K(y) = c |y|             the same in space, Bingham flow
    cone      |λ₁| ≤ λ₂    k + 1 rows   0 where |y₁| ≤ −y₂, or ∞   bounds of gradients, Coulomb's law in space

where |·| is Euclidean and λ₂ is the last row of a cone. Other bounded sets are classes of their own (see `Blocks`).
Rows and radii do not depend on the parameter. A bound c(mu) that does belongs into B and g: the multipliers
θ = λ / c(mu) are then in one set ("Dual sets" in docs/mathematics.md).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Annotated, TypeAlias

import numpy as np

from vibench.arrays import Array, Indices, Mask, read_only
from vibench.errors import RequestError, UnsupportedError
from vibench.linalg import EPS
from vibench.signatures import Count, NotNegative, Rule, bordered

OfRows: TypeAlias = Annotated[Array, "m"]
Rising: TypeAlias = Annotated[Indices, Rule("rising indices", lambda rows: bool((np.diff(rows) > 0).all())), "k"]


class BlockKind(StrEnum):
    """Kinds of blocks of a dual set; rows in no block are rays."""

    RAY = "ray"
    INTERVAL = "interval"
    DISC = "disc"
    CONE = "cone"
    OTHER = "other set"


@bordered
@dataclass(frozen=True)
class Blocks:
    """Blocks of one kind and size: their rows (b×k), and radii c > 0 (b,), which cones do not have.

    Any other bounded, closed convex set that contains zero is a class of its own, with `support`, `gauge` and `project`
    of the kind `BlockKind.OTHER`; its radii are those of discs that contain the sets. Residuals and bounds know it.
    """

    kind: BlockKind
    rows: Annotated[Indices, "b", "k", "<m"]
    radii: Annotated[Array, "b"] | None = None

    def __post_init__(self) -> None:
        size = self.rows.shape[1]
        if self.kind is BlockKind.RAY:
            raise RequestError("rows in no block are rays: there are no blocks of them")
        if (self.radii is None) != (self.kind is BlockKind.CONE):
            raise RequestError("intervals and discs have radii, and cones have none")
        if self.kind is BlockKind.OTHER and type(self) is Blocks:
            raise RequestError("another set is a class of its own, with support, gauge and project")
        if self.radii is not None and not (np.isfinite(self.radii) & (self.radii > 0.0)).all():
            raise RequestError("a radius is not positive and finite; leave a row without friction out of B")
        if (self.kind is BlockKind.INTERVAL and size != 1) or (self.kind is BlockKind.CONE and size < 2):
            raise RequestError(f"{self.kind.value}s have {'one row' if size != 1 else 'two rows or more'}, not {size}")
        object.__setattr__(self, "rows", read_only(self.rows))

    def parts(self, values: OfRows) -> tuple[Array, Array]:
        """Lengths (b,) of the rows of blocks in values (m,), and of a cone the last row (b,) apart, or the radii."""
        inside = values[self.rows]
        if self.radii is None:
            return np.linalg.norm(inside[:, :-1], axis=1), inside[:, -1]
        return np.linalg.norm(inside, axis=1), self.radii

    def support(self, values: OfRows) -> Array:
        """σ (b,) of values (m,), infinite outside its domain."""
        lengths, limits = self.parts(values)
        return np.where(lengths <= -limits, 0.0, np.inf) if self.radii is None else np.asarray(limits * lengths)

    def gauge(self, lam: OfRows) -> Array:
        """The smallest γ ≥ 0 (b,) with λ (m,) in γ times a block; infinite where there is none."""
        lengths, limits = self.parts(lam)
        return np.where(lengths <= limits, 0.0, np.inf) if self.radii is None else np.asarray(lengths / limits)

    def gap(self, lam: OfRows, slack: OfRows, error: OfRows, unit: NotNegative) -> float:
        """An upper bound of the sum of σ(y) − λᵀy, see `DualSet.gap`; `unit` is a round-off of sums of two terms."""
        bounded = self.radii is not None
        own = np.einsum("bk,bk->b", lam[self.rows], slack[self.rows])
        own += self.support(-slack) if bounded else 0.0
        away = np.linalg.norm(error[self.rows], axis=1)
        reach = np.linalg.norm(lam[self.rows], axis=1) + (self.radii if bounded else 0.0)
        # `own` may be a small difference of terms with a round-off of their own
        away += (4.0 + self.rows.shape[1]) * unit * np.linalg.norm(slack[self.rows], axis=1)
        return float(np.sum(np.maximum(own, 0.0) + reach * away))

    def project(self, values: OfRows) -> Array:
        """The nearest points (b×k) of the blocks, in the Euclidean norm of the rows."""
        inside, (lengths, limits) = values[self.rows], self.parts(values)
        positive = np.where(lengths > 0.0, lengths, 1.0)
        if self.kind is BlockKind.INTERVAL:
            return np.clip(inside, -limits[:, None], limits[:, None])
        if self.radii is not None:
            # Round-off must not leave a point outside.
            share = np.where(lengths > limits, (1.0 - 4.0 * EPS) * limits / positive, 1.0)
            return np.asarray(inside * share[:, None])
        # inside, in the polar cone, or on the boundary, whose nearest point has the height (|λ₁| + λ₂) / 2
        height = np.where(lengths <= limits, limits, np.maximum(0.5 * (lengths + limits), 0.0))
        share = np.where(lengths <= limits, 1.0, (1.0 - 4.0 * EPS) * height / positive)
        return np.column_stack([inside[:, :-1] * share[:, None], height])


@bordered
@dataclass(frozen=True, eq=False)
class DualSet:
    """The set K of the multipliers of m rows: these blocks, and a ray for every other row."""

    blocks: tuple[Blocks, ...] = ()

    def __post_init__(self) -> None:
        rows = [block.rows.ravel() for block in self.blocks]
        taken = np.concatenate(rows) if rows else np.zeros(0, np.intp)
        if len(np.unique(taken)) < len(taken):
            raise RequestError("a row of the dual set is in two blocks")

    @classmethod
    @bordered
    def intervals(cls, rows: Annotated[Indices, "k"], radius: float | Annotated[Array, "k"]) -> DualSet:
        """The set with |λ_i| ≤ `radius` in some rows (k,)."""
        radii = np.broadcast_to(np.asarray(radius, float), np.shape(rows)).copy()
        return cls((Blocks(BlockKind.INTERVAL, np.asarray(rows, np.intp)[:, None], radii),) if len(rows) else ())

    @property
    def kinds(self) -> frozenset[BlockKind]:
        """Kinds of blocks other than rays."""
        return frozenset(block.kind for block in self.blocks)

    @cached_property
    def _blocked(self) -> Indices:
        return np.concatenate([block.rows.ravel() for block in self.blocks]) if self.blocks else np.zeros(0, np.intp)

    @cached_property
    def _least(self) -> int:
        return int(self._blocked.max(initial=-1)) + 1

    def _refuse_fewer(self, count: int) -> None:
        if count < self._least:
            raise RequestError(f"{count} rows are too few for a dual set with blocks in {self._least}")

    def rays(self, count: Count) -> Mask:
        """Rows (m,) that are rays, of so many."""
        self._refuse_fewer(count)
        found = np.ones(count, bool)
        found[self._blocked] = False
        return found

    def radii(self, count: Count) -> Array:
        """The c (m,) with |λ| ≤ c of intervals, infinite in all other rows."""
        self._refuse_fewer(count)
        found = np.full(count, np.inf)
        for block in self.blocks:
            if block.kind is BlockKind.INTERVAL and block.radii is not None:
                found[block.rows[:, 0]] = block.radii
        return found

    def support(self, values: OfRows) -> float:
        """σ_K(y) of y (m,), infinite outside its domain."""
        total = np.inf if values[self.rays(len(values))].max(initial=0.0) > 0.0 else 0.0
        return float(total + sum(float(np.sum(block.support(values))) for block in self.blocks))

    def gauge(self, lam: OfRows) -> float:
        """The smallest γ ≥ 0 with λ ∈ γ K for λ (m,); infinite where there is none."""
        largest = np.inf if lam[self.rays(len(lam))].min(initial=0.0) < 0.0 else 0.0
        return float(max([largest, *(float(np.max(block.gauge(lam), initial=0.0)) for block in self.blocks)]))

    def contains(self, lam: OfRows) -> bool:
        """Whether λ (m,) is in K, without any round-off; not where one of them is no number."""
        if not self.blocks:
            return not lam.min(initial=0.0) < 0.0
        return bool(self.gauge(lam) <= 1.0)

    def project(self, lam: OfRows) -> Array:
        """The nearest point (m,) of K to λ, in the Euclidean norm of the rows."""
        self._refuse_fewer(len(lam))
        found = np.maximum(lam, 0.0)
        for block in self.blocks:
            found[block.rows] = block.project(lam)
        return np.asarray(found)

    def gap(self, lam: OfRows, slack: OfRows, round_off: OfRows | None = None) -> float:
        """An upper bound of σ_K(y) − λᵀy for λ ∈ K and y (m,) = −`slack`, which is feasible where rows are rays.

        `round_off` (m,) bounds that of y; without it the bound is the value.
        """
        rays = self.rays(len(lam)) if self.blocks else slice(None)
        error = np.zeros_like(slack) if round_off is None else round_off
        # round-off may leave a negative product of numbers that vanish in pairs
        total = max(0.0, float(lam[rays] @ (slack + error)[rays]))
        unit = 0.0 if round_off is None else EPS
        return total + sum(block.gap(lam, slack, error, unit) for block in self.blocks)

    def free(self, lam: Annotated[Array, "m", "P?"]) -> Mask:
        """Rows inside their blocks, where B u = g: rays with λ > 0, intervals with |λ| < c, for λ (m,) or (m×P)."""
        if not self.blocks:
            return np.asarray(lam > 0.0)
        count, columns = len(lam), (1,) * (lam.ndim - 1)
        rays, radii = self.rays(count).reshape(count, *columns), self.radii(count).reshape(count, *columns)
        return np.asarray(np.where(rays, lam > 0.0, np.isfinite(radii) & (np.abs(lam) < radii)))

    def of(self, rows: Rising) -> DualSet:
        """The set of some rows (k,), rising; blocks are in them as a whole, or not at all."""
        kept = []
        for block in self.blocks:
            inside = np.isin(block.rows, rows).all(axis=1)
            radii = None if block.radii is None else block.radii[inside]
            places = np.searchsorted(rows, block.rows[inside])
            kept += [replace(block, rows=places, radii=radii)] if inside.any() else []
        return DualSet(tuple(kept)) if self.blocks else self

    def names(self) -> str:
        """The kinds of the blocks in words."""
        return " and ".join(f"{kind.value}s" for kind in sorted(self.kinds)) or "rays"

    def __eq__(self, other: object) -> bool:
        """Whether blocks are equal in kind, rows and radii."""
        if not isinstance(other, DualSet) or len(self.blocks) != len(other.blocks):
            return False
        pairs = zip(self.blocks, other.blocks, strict=True)
        return all(
            type(a) is type(b)
            and a.kind is b.kind
            and np.array_equal(a.rows, b.rows)
            and np.array_equal(a.radii, b.radii)  # type: ignore[arg-type]
            for a, b in pairs
        )

    def __hash__(self) -> int:
        return hash(tuple((block.kind, block.rows.shape) for block in self.blocks))


RAYS = DualSet()
"""The dual set of contact: λ ≥ 0."""


def refuse_blocks(K: DualSet, known: Collection[BlockKind], what: str) -> None:
    """Raise an `UnsupportedError` if K has blocks that are neither rays nor of the kinds that something knows."""
    if not K.kinds <= set(known):
        others = " and ".join(f"{kind.value}s" for kind in sorted(known))
        raise UnsupportedError(f"{what} knows {f'rays and {others}' if others else 'λ ≥ 0 alone'}; K has {K.names()}")
