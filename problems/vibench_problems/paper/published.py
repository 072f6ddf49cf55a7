"""What Niakh, Drouet, Ehrlacher and Ern (2022) publish in numbers: text, captions and tables of §5.

Curves are not read off the figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

PUBLICATION = (
    "Niakh, Drouet, Ehrlacher and Ern, Stable model reduction for linear variational inequalities with "
    "parameter-dependent constraints, ESAIM: M2AN (2022), doi 10.1051/m2an/2022077"
)


@dataclass(frozen=True)
class Pair:
    """One pair of reduced spaces, which is a column of a table, with online (on) and offline (off) enrichment.

    Attributes
    ----------
    size
        (N, R).
    tolerances
        (δ_POD, δ_mCPG) that give it in the paper.
    loose
        δ_PGA of its panel in Figure 8 or 15.
    offline, online
        Seconds of the offline phase and of one query, on and off, on the authors' machine.
    threshold
        Benefit threshold: the number of queries from which the offline enrichment is cheaper in total.
    by_size
        Whether our studies prescribe the sizes and not the tolerances.
    """

    size: tuple[int, int]
    tolerances: tuple[float, float]
    loose: float
    offline: tuple[float, float]
    online: tuple[float, float]
    threshold: int
    by_size: bool = False

    @property
    def name(self) -> str:
        """(N, R) as text."""
        return "({}, {})".format(*self.size)

    @property
    def prescribed(self) -> Mapping[str, float]:
        """Tolerances or sizes of the cells that correspond to it, by column."""
        kind, values = ("size", self.size) if self.by_size else ("tol", self.tolerances)
        return {f"pod_{kind}": values[0], f"dual_{kind}": values[1]}


@dataclass(frozen=True)
class Published:
    """What is published of one problem.

    Attributes
    ----------
    section, title
        Number and short name of its section.
    table
        Number of its table.
    figures
        Numbers of the figures with projection errors, orthogonality, PGA and inf-sup constants.
    tight
        δ_PGA of the table, and of the left and the middle column of Figure 7 or 14.
    pairs
        The pairs of spaces.
    nodes
        Nodes of the mesh.
    """

    section: str
    title: str
    table: int
    figures: tuple[int, int, int, int]
    tight: float
    pairs: tuple[Pair, ...]
    nodes: int

    @property
    def heading(self) -> str:
        """Section and short name."""
        return f"{self.section}, {self.title}"

    @property
    def modes(self) -> Mapping[float, int]:
        """N by δ_POD."""
        return {pair.tolerances[0]: pair.size[0] for pair in self.pairs}

    @property
    def generators(self) -> Mapping[float, int]:
        """R by δ_mCPG."""
        return {pair.tolerances[1]: pair.size[1] for pair in self.pairs}


OBSTACLE = Published(
    section="§5.1",
    title="obstacle",
    table=1,
    figures=(5, 6, 7, 8),
    tight=1e-3,
    pairs=(
        Pair((19, 50), (1e-3, 1e-2), 0.5, (1112.0, 2296.0), (14.0, 2.4), 102),
        Pair((51, 70), (1e-4, 1e-3), 0.6, (1193.0, 2395.0), (17.0, 2.5), 83),
        Pair((89, 50), (1e-6, 1e-2), 0.95, (1272.0, 1884.0), (14.0, 2.3), 52),
    ),
    nodes=3594,
)

HERTZ = Published(
    section="§5.2",
    title="Hertz contact",
    table=2,
    figures=(11, 12, 14, 15),
    tight=0.3,
    pairs=(
        Pair((3, 12), (1e-2, 1e-2), 0.5, (8490.0, 18098.0), (75.0, 18.0), 169, by_size=True),
        Pair((46, 70), (1e-3, 1e-3), 0.6, (10889.0, 19750.0), (162.0, 20.0), 62, by_size=True),
        Pair((46, 12), (1e-3, 1e-2), 0.4, (10874.0, 18312.0), (78.0, 19.0), 126, by_size=True),
    ),
    nodes=6130,
)

PROBLEMS: Mapping[str, Published] = {"obstacle": OBSTACLE, "hertz": HERTZ}
"""The two problems, by the names under which they are registered."""

MEMBRANE = (0.9, 0.025, -0.025)
"""Parameter of Figure 4: the radius 0.18 m over that of the reference disc, 0.2 m, and the centre [m]."""

DEFORMED = 0.9
"""Radius [m] of Figure 10, left."""

RADII = (0.7, 0.8, 1.0, 1.1, 1.3)
"""Radii [m] of Figure 10, right."""
