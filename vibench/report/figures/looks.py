"""Looks of strategies and solvers: colour and marker follow from the name, in every figure of every run."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

COLOURS = ("#520186", "#91071B", "#A22174", "#615CDB", "#DF5225", "#2CA980", "#AEA0F2", "#E4BD20")
"""Equidistant in lightness (CIELAB, 22 to 78 in steps of 8), so that print in grey keeps them apart, with the hues that
are farthest apart for readers with and without a colour vision deficiency; markers differ, too."""

BLACK = "#000000"
"""The colour of the high-fidelity model, and of what belongs to no strategy."""

DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
MARKERS = "os^vDPX*dph"
"""Triangles to the left and to the right mark break-evens."""

SEED = (120727).to_bytes(8, "big")
"""Salt of the hash of names; with this number all dual strategies that are shipped have colours of their own, all
primal ones, too, and no two of these and of the solvers look the same."""

MARKED = 9
"""Number of markers on a line, to identify it in grey print."""


@dataclass(frozen=True)
class Look:
    """How a series is drawn: colour and marker, and what tells it from others that share these.

    Attributes
    ----------
    colour, marker
        Determined by the name of the strategy or solver.
    rank
        Place among the series with the same colour and marker in a figure; sets line style and filling.
    """

    colour: str
    marker: str
    rank: int = 0

    def line(self, count: int = 0) -> dict[str, Any]:
        """The look as arguments of `Axes.plot`; of `count` points only about `MARKED` carry the marker."""
        return {
            "color": self.colour,
            "linestyle": DASHES[self.rank % len(DASHES)],
            "marker": self.marker,
            "markersize": 3.5,
            "markevery": (self.rank % 3, max(1, count // MARKED)),
            **self._filling(),
        }

    def point(self) -> dict[str, Any]:
        """The same for points without a line, which filling and edge alone tell apart."""
        edge = 1.0 + 0.6 * (self.rank // len(self._faces()))
        return {"color": self.colour, "marker": self.marker, "linestyle": "none", "markersize": 5} | {
            **self._filling(),
            "markeredgewidth": edge,
        }

    def _filling(self) -> dict[str, Any]:
        faces = self._faces()
        return {"markerfacecolor": faces[self.rank % len(faces)]}

    def _faces(self) -> tuple[str, ...]:
        return (self.colour, "white", "0.75")


HIGH_FIDELITY_LOOK = Look(BLACK, "s", 3)
"""The look of the high-fidelity model: dotted black lines."""


class Series(NamedTuple):
    """A series of a figure: the name of its strategy or solver, and what tells it from others of that name."""

    name: str
    variant: str | float = ""


def look_of(name: str) -> Look:
    """The look of a strategy or a solver; it depends on the name alone."""
    number = int.from_bytes(hashlib.blake2b(name.encode(errors="replace"), digest_size=8, salt=SEED).digest(), "big")
    return Look(COLOURS[number % len(COLOURS)], MARKERS[number // len(COLOURS) % len(MARKERS)])


class Looks:
    """The looks of the series of one figure.

    Series that share colour and marker, those of one strategy at several tolerances in particular, get ranks in their
    order, so that no two series of a figure look the same.
    """

    def __init__(self, series: Iterable[Series]) -> None:
        alike: dict[Look, list[Series]] = defaultdict(list)
        for one in sorted(set(series), key=_order):
            alike[look_of(one.name)].append(one)
        self._known = {one: replace(look, rank=rank) for look, group in alike.items() for rank, one in enumerate(group)}

    def __getitem__(self, series: Series) -> Look:
        return self._known[series]

    def __iter__(self) -> Iterator[Series]:
        return iter(self._known)


def _order(series: Series) -> tuple[str, bool, float, str]:
    """The key by which series are sorted: name, then variants, texts before numbers."""
    number = isinstance(series.variant, float)
    return series.name, number, float(series.variant) if number else 0.0, str(series.variant)
