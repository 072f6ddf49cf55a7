"""What Niakh, Drouet, Ehrlacher and Ern (2022) publish in numbers of Figures 3 to 15, in text, captions and tables.

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
    """One pair of reduced spaces of the paper.

    Attributes
    ----------
    size
        (N, R).
    prescribed
        Tolerances or sizes of the cells that correspond to it, by column.
    tight, loose
        δ_PGA of the left and the middle column of Figures 7 and 14, and of the panel of Figures 8 and 15.
    """

    size: tuple[int, int]
    prescribed: Mapping[str, float]
    tight: float
    loose: float

    @property
    def name(self) -> str:
        """(N, R) as text."""
        return "({}, {})".format(*self.size)


@dataclass(frozen=True)
class Published:
    """What is published of one problem.

    Attributes
    ----------
    section
        Section and short name.
    pairs
        The pairs of spaces.
    modes, generators
        N by δ_POD and R by δ_mCPG.
    figures
        Numbers of the figures with projection errors, orthogonality, PGA and inf-sup constants.
    convergence
        What is said of the convergence of PGA.
    """

    section: str
    pairs: tuple[Pair, ...]
    modes: Mapping[float, int]
    generators: Mapping[float, int]
    figures: tuple[int, int, int, int]
    convergence: str


OBSTACLE = Published(
    "§5.1, obstacle",
    (
        Pair((19, 50), {"pod_tol": 1e-3, "dual_tol": 1e-2}, 1e-3, 0.5),
        Pair((51, 70), {"pod_tol": 1e-4, "dual_tol": 1e-3}, 1e-3, 0.6),
        Pair((89, 50), {"pod_tol": 1e-6, "dual_tol": 1e-2}, 1e-3, 0.95),
    ),
    {1e-3: 19, 1e-4: 51, 1e-6: 89},
    {1e-2: 50, 1e-3: 70},
    (5, 6, 7, 8),
    "it takes at most R iterations",
)

HERTZ = Published(
    "§5.2, Hertz contact",
    (
        Pair((3, 12), {"pod_size": 3, "dual_size": 12}, 0.3, 0.5),
        Pair((46, 70), {"pod_size": 46, "dual_size": 70}, 0.3, 0.6),
        Pair((46, 12), {"pod_size": 46, "dual_size": 12}, 0.3, 0.4),
    ),
    {1e-2: 3, 1e-3: 46},
    {1e-2: 12, 1e-3: 70},
    (11, 12, 14, 15),
    "σ decreases much more slowly than for the obstacle",
)

PROBLEMS: Mapping[str, Published] = {"obstacle": OBSTACLE, "hertz": HERTZ}

MEMBRANE = (0.9, 0.025, -0.025)
"""Parameter of Figure 4: the radius 0.18 m over that of the reference disc, 0.2 m, and the centre [m]."""

DEFORMED = 0.9
"""Radius [m] of Figure 10, left."""

RADII = (0.7, 0.8, 1.0, 1.1, 1.3)
"""Radii [m] of Figure 10, right."""

NODES = {"obstacle": 3594, "hertz": 6130}
"""Nodes of the meshes."""
