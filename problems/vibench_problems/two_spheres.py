"""Two elastic hemispheres pressed against each other in three dimensions."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from vibench import Array, ParameterBox
from vibench_problems.elliptic_contact import EllipticContact, elliptic_contact
from vibench_problems.hemisphere import EDGE, hemisphere
from vibench_problems.two_bodies import Body, TwoBodies

CELLS = {"coarse": 5, "medium": 9, "paper": 12, "fine": 18}
"""Cells along the potential contact zone behind each named resolution."""

UNKNOWNS_PER_CELL = 33.0
"""Unknowns of both bodies divided by the cube of the number of cells, at large ones and the default extent."""

ZONE = 1.37
"""Edge of the potential contact zone, relative to the extent; by Hertz's theory the contact reaches 1.06 of it."""

SMALLEST, LARGEST = 0.8, 1.25
"""Radii [m] of the upper sphere."""


class TwoSpheres(TwoBodies):
    """A hemisphere of radius 1 m, and one of radius R above it; mu = (R, δ, ν). Their flats approach by δ.

    The condition of contact and the multipliers are those of `TwoBodies`. The flats are free horizontally. Equal
    spheres have been published as the case SSNV104 of code_aster (R = 50 mm, E = 20 GPa, ν = 0.3, δ = 4 mm).

    Parameters
    ----------
    resolution
        "coarse" (5 thousand unknowns), "medium" (20), "paper" (62), "fine" (200), or a number of unknowns.
    growth
        Ratio of the sizes of successive layers at "medium", outside the cube below the potential contact zone.
    young
        E [Pa].
    extent
        Semi-axis [m] of the largest contact of equal spheres by Hertz's theory. Approaches δ are between 4/3 of
        its square and twice this. The force exceeds Hertz's by a share that is proportional to it.
    """

    def __init__(
        self,
        resolution: Literal["coarse", "medium", "paper", "fine"] | Annotated[int, Ge(1000), Le(2_000_000)] = "medium",
        growth: Annotated[float, Gt(1.0), Le(2.0)] = 1.15,
        young: Annotated[float, Gt(0.0)] = 1.0,
        extent: Annotated[float, Ge(0.001), Le(0.2)] = 0.2,
    ) -> None:
        box = ParameterBox(
            names=("radius", "approach", "poisson"),
            lower=np.array([SMALLEST, 4.0 / 3.0 * extent**2, 0.2]),
            upper=np.array([LARGEST, 2.0 * extent**2, 0.4]),
            units=("m", "m", "1"),
        )
        number = CELLS[resolution] if isinstance(resolution, str) else (resolution / UNKNOWNS_PER_CELL) ** (1.0 / 3.0)
        cells, width = round(number), ZONE * extent
        # At the smallest radius the zone above is as large as the one below; at others its cells are larger.
        slave, master = (
            Body.of(hemisphere(cells, _layers(cells, edge, growth), edge), bubbles)
            for edge, bubbles in ((width, True), (width / SMALLEST, False))
        )
        super().__init__(slave, master, box, young)

    def theory(self, mu: Array) -> EllipticContact:
        """Hertz's contact of two spheres: that with a rigid one of the radius R/(1 + R), of half the modulus."""
        radius, modulus = float(mu[0] / (1.0 + mu[0])), 0.5 * self.young / (1.0 - float(mu[2]) ** 2)
        return elliptic_contact(radius, radius, float(mu[1]), modulus)


def _layers(cells: int, edge: float, growth: float) -> int:
    """Shells around a cube of an edge, at least one."""
    return max(1, round(float(np.log(EDGE / edge) / np.log(growth)) * cells / CELLS["medium"]))
