"""The oil film of a journal bearing that cavitates: Reynolds' equation with p ≥ 0."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le
from scipy.optimize import brentq
from skfem import Basis, BilinearForm, ElementTriP1, LinearForm, MeshTri

from vibench import AffineProblem, Array, InnerProduct, Output, ParameterBox, Picture, fem

CELLS = {"coarse": 8, "medium": 14, "paper": 24, "fine": 48}
"""Rows of cells along half of the axis behind each named resolution: 312, 966, 2856 and 11 472 unknowns."""

AROUND = 5
"""Cells around the shaft per row of cells along half of the axis."""

BINOMIALS = 1, 3, 3, 1
"""h³ = (1 + ε cos θ)³ is the sum of binomials · ε^q · cos^q θ."""


@dataclass(frozen=True)
class SommerfeldSolution:
    """The exact pressure of an infinitely long bearing at one eccentricity, which depends on the angle θ alone.

    Where there is oil, h³p′ = h − h*, h* = h(θ*): the film ruptures at θ* with p = p′ = 0 (the condition of Swift and
    Stieber, or Reynolds). Sommerfeld's angle γ, 1 + ε cos θ = (1 − ε²)/(1 − ε cos γ), makes the integrals elementary:

        (1 − ε²)^(3/2) p = γ − ε sin γ − (γ − 2ε sin γ + ε²γ/2 + ε² sin γ cos γ/2)/(1 − ε cos γ*),

    which vanishes at γ* for 2(sin γ* − γ* cos γ*) + ε(sin γ* cos γ* − γ*) = 0, π < γ* < 3π/2 (Hamrock, Schmid and
    Jacobson 2004).

    Attributes
    ----------
    eccentricity
        ε of the shaft over the clearance.
    """

    eccentricity: float

    @property
    def _rupture(self) -> float:
        """Sommerfeld's angle γ* of the rupture."""
        e = self.eccentricity

        def excess(g: float) -> float:
            return 2.0 * (math.sin(g) - g * math.cos(g)) + e * (math.sin(g) * math.cos(g) - g)

        return float(brentq(excess, math.pi, 1.5 * math.pi, xtol=1e-15))

    @property
    def rupture(self) -> float:
        """The angle θ* at which the film ruptures, between π and 2π."""
        c, e = math.cos(self._rupture), self.eccentricity
        return 2.0 * math.pi - math.acos((c - e) / (1.0 - e * c))

    def pressure(self, theta: Array) -> Array:
        """P at angles from 0 to 2π, any shape."""
        e, last = self.eccentricity, self._rupture
        # γ and θ are in the same half turn: tan(γ/2) = √((1 − ε)/(1 + ε)) tan(θ/2)
        g = 2.0 * np.arctan2(math.sqrt(1.0 - e) * np.sin(0.5 * theta), math.sqrt(1.0 + e) * np.cos(0.5 * theta))
        cubes = g - 2.0 * e * np.sin(g) + 0.5 * e**2 * (g + np.sin(g) * np.cos(g))
        film = (g - e * np.sin(g) - cubes / (1.0 - e * math.cos(last))) / (1.0 - e**2) ** 1.5
        return np.where(g < last, film, 0.0)


class Bearing(AffineProblem):
    """Journal bearing with cavitation; parameters: eccentricity of the shaft, length over diameter of the bearing.

    The oil film between shaft and bearing has the thickness h = 1 + ε cos θ in units of the clearance. Its pressure
    p ≥ 0, in units of 6ηω(R/c)², satisfies Reynolds' equation as a variational inequality (Kinderlehrer
    and Stampacchia 2000),

        ∂θ(h³ ∂θ p) + (D/L)² ∂ζ(h³ ∂ζ p) ≤ ∂θ h,

    with equality where p > 0: the film ruptures without a gradient of the pressure (Swift–Stieber, or Reynolds,
    condition). The oil enters at θ = 0, where h is largest and p = 0. The axial coordinate ζ goes from the middle of
    the bearing to its end; half of the bearing is meshed.

    P1 pressures and lumped P1 multipliers on the whole film. A has eight affine terms, h³ in powers of ε in either
    direction, f has one, B and g are constant.

    Parameters
    ----------
    resolution
        "coarse" (312 unknowns), "medium" (966), "paper" (2856), "fine" (11472), or a number of unknowns, met to within
        20 per cent.
    ends
        "open", p = 0 at the end, or "sealed": no oil leaves there, and p is that of an infinitely long bearing, which
        has a closed form (`SommerfeldSolution`).
    """

    parameters = ParameterBox(
        names=("eccentricity", "aspect_ratio"), lower=np.array([0.1, 0.5]), upper=np.array([0.9, 1.5]), units=("1", "1")
    )

    def __init__(
        self,
        resolution: Literal["coarse", "medium", "paper", "fine"] | Annotated[int, Ge(60), Le(1_000_000)] = "paper",
        ends: Literal["open", "sealed"] = "open",
    ) -> None:
        rows = CELLS[resolution] if isinstance(resolution, str) else round(math.sqrt(resolution / AROUND))
        around, along = np.linspace(0.0, 2.0 * np.pi, AROUND * rows + 1), np.linspace(0.0, 1.0, rows + 1)
        self.mesh = MeshTri.init_tensor(around, along)
        basis = Basis(self.mesh, ElementTriP1(), intorder=6)
        theta, zeta = self.mesh.p
        atmospheric = (theta == around[0]) | (theta == around[-1]) | ((zeta == 1.0) & (ends == "open"))
        self.free = np.flatnonzero(~atmospheric)
        film = fem.unilateral(basis, ">=", free=self.free)
        self.V, self.W = InnerProduct(fem.h1_gram(basis, self.free)), film.W

        @BilinearForm
        def conductance(p, v, w):  # type: ignore[no-untyped-def]
            """∫ cos^q θ ∂p ∂v, the derivatives along one coordinate."""
            return np.cos(w.x[0]) ** w.power * p.grad[w.direction] * v.grad[w.direction]

        self.declare(
            A=[
                (f"{binomial} * eccentricity**{q}{scale}", conductance.assemble(basis, power=q, direction=direction))
                for direction, scale in enumerate(("", " / aspect_ratio**2"))
                for q, binomial in enumerate(BINOMIALS)
            ],
            f=[("eccentricity", LinearForm(lambda v, w: np.sin(w.x[0]) * v).assemble(basis))],
            B=film.B,
            g=np.zeros(len(film.nodes)),
            free=self.free,
        )

    def training_set(self) -> Array:
        """The 10×6 grid."""
        return self.parameters.grid(10, 6)

    def exact(self, mu: Array) -> SommerfeldSolution:
        """The solution with sealed ends at mu, in closed form."""
        return SommerfeldSolution(float(mu[0]))

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The force on half of the shaft, along the line of centres and across it, and the cavitated share of the film.

        Forces are ∫ p cos θ and ∫ p sin θ over θ and ζ, by the nodal rule; the first is negative where p is largest
        before the narrowest place: it pushes the shaft back to the centre.
        """
        theta, areas = self.mesh.p[0, self.free], self.multiplier_integrals()
        share = areas / areas.sum()
        return (
            Output("force along the line of centres", "1", u=areas * np.cos(theta)),
            Output("force across the line of centres", "1", u=areas * np.sin(theta)),
            Output("cavitated share", "1", function=lambda _, __, lam: float(share @ (lam > 0.0))),
        )

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:  # noqa: ARG002
        """The pressure over the unrolled film, and the multiplier where it has ruptured."""
        pressure = np.zeros(self.mesh.p.shape[1])
        pressure[self.free] = u
        film = self.mesh.p[:, self.free]
        return Picture(self.mesh.p, self.mesh.t, pressure, "pressure p [1]", film, lam, "multiplier λ [1]")
