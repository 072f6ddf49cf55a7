"""A membrane on a disc above a paraboloid: an obstacle problem with a closed-form solution."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from scipy.special import lambertw
from skfem import Basis, ElementTriP1, MeshTri
from skfem.models.poisson import laplace

from vibench import AffineProblem, Array, InnerProduct, Output, ParameterBox, Picture, fem
from vibench_problems.disc_mesh import rings_in_disc

RINGS = {"coarse": 11, "medium": 20, "paper": 34, "fine": 68}
"""Rings of nodes behind each named resolution: 397, 1261, 3571 and 14 077 nodes."""

Radially = Callable[[Array], Array]
"""A function of the distance from the centre."""


@dataclass(frozen=True)
class RadialSolution:
    """The exact solution at one parameter; r is the distance from the centre, any shape.

    On r ≤ ρ the membrane lies on the obstacle and λ = 1 + 4c. Outside −Δu = −1, hence u = r²/4 + a ln r − ¼, which
    vanishes at r = 1; u and u' continue those of ψ = −h − c r² at ρ for a = −ρ²(½ + 2c) and, with s = ρ²,

        s(1 − ln s) = K = (¼ − h)/(¼ + c),    that is    s = exp(1 + W₋₁(−K/e))

    with the lower branch of Lambert's function.

    Attributes
    ----------
    height, curvature
        h [m] and c [1/m].
    """

    height: float
    curvature: float

    @property
    def contact_radius(self) -> float:
        """ρ [m]."""
        share = (0.25 - self.height) / (0.25 + self.curvature)
        return float(np.exp(0.5 * (1.0 + lambertw(-share / math.e, -1).real)))

    def u(self, r: Array) -> Array:
        """Deflection [m]."""
        rho, outside = self.contact_radius, np.maximum(r, 1e-300)  # ln r is evaluated at r = 0, too, and discarded
        free = 0.25 * r**2 - rho**2 * (0.5 + 2.0 * self.curvature) * np.log(outside) - 0.25
        return np.where(r <= rho, -self.height - self.curvature * r**2, free)

    def slope(self, r: Array) -> Array:
        """Derivative of the deflection along r."""
        rho, outside = self.contact_radius, np.maximum(r, 1e-300)
        free = 0.5 * r - rho**2 * (0.5 + 2.0 * self.curvature) / outside
        return np.where(r <= rho, -2.0 * self.curvature * r, free)

    def lam(self, r: Array) -> Array:
        """Multiplier [1/m]: the contact pressure."""
        return np.where(r <= self.contact_radius, 1.0 + 4.0 * self.curvature, 0.0)


def squared_radius(x: Array) -> Array:
    """|x|² at points (2×…)."""
    return np.asarray(np.sum(x**2, axis=0))


class Radial(AffineProblem):
    """Membrane of load −1 on the unit disc above ψ(x) = −h − c|x|², h and c the parameters; closed-form solution.

    P1 displacements, zero on the circle, P1 multipliers on the inner half of the rings: |x| ≤ ½, or 5/11 at "coarse".
    Only g depends on mu. The problem verifies solvers of obstacle problems against a solution that involves no mesh.

    Parameters
    ----------
    resolution
        "coarse" (397 nodes), "medium" (1261), "paper" (3571, about as many as the obstacle problem), "fine" (14077), or
        a number of nodes.
    length
        ℓ̂ [m] of the norm (44).
    """

    parameters = ParameterBox(
        names=("height", "curvature"), lower=np.array([0.14, 0.0]), upper=np.array([0.2, 0.25]), units=("m", "1/m")
    )

    def __init__(
        self,
        resolution: Literal["coarse", "medium", "paper", "fine"] | Annotated[int, Ge(100), Le(200_000)] = "paper",
        length: Annotated[float, Gt(0.0)] = 1.0,
    ) -> None:
        rings = RINGS[resolution] if isinstance(resolution, str) else 2 * round(np.sqrt(resolution / 3.0) / 2.0)
        points, triangles = rings_in_disc(rings, 1.0)
        self.mesh = MeshTri(np.ascontiguousarray(points.T), np.ascontiguousarray(triangles.T))
        self.length = length
        zone_nodes = 1 + 3 * (rings // 2) * (rings // 2 + 1)
        basis = Basis(self.mesh, ElementTriP1())
        zone = np.flatnonzero(np.all(self.mesh.t < zone_nodes, axis=0))
        contact = fem.unilateral(basis.with_elements(zone), ">=", lumped=False)
        self.free, self.disc_nodes, self._zone = basis.complement_dofs(basis.get_dofs()), contact.nodes, zone
        self.V, self.W = InnerProduct(fem.h1_gram(basis, self.free, length)), contact.W
        self.declare(
            A=laplace.assemble(basis),
            f=-fem.lumped_mass(basis),
            B=contact.B,
            g=[("-height", contact.bound(np.ones(len(contact.nodes)))), ("-curvature", contact.bound(squared_radius))],
            free=self.free,
        )

    def training_set(self) -> Array:
        """The 7×7 grid."""
        return self.parameters.grid(7, 7)

    def exact(self, mu: Array) -> RadialSolution:
        """The solution in closed form at mu = (h, c)."""
        return RadialSolution(float(mu[0]), float(mu[1]))

    def errors(self, mu: Array, u: Array, lam: Array) -> tuple[float, float]:
        """Relative distances of u (n,) in V and of λ (m,) in L²(ω) from the exact solution, by quadrature."""
        exact, nothing = self.exact(mu), np.zeros(self.mesh.p.shape[1])
        deflection, multiplier = nothing.copy(), nothing.copy()
        deflection[self.free], multiplier[self.disc_nodes] = u, lam
        whole, disc = (
            Basis(self.mesh, ElementTriP1(), elements=elements, intorder=8) for elements in (None, self._zone)
        )

        def distance(basis: Basis, field: Array, value: Radially, slope: Radially | None) -> float:
            x = np.asarray(basis.global_coordinates())
            r, interpolated = np.linalg.norm(x, axis=0), basis.interpolate(field)
            square = (np.asarray(interpolated) - value(r)) ** 2
            if slope is not None:
                square += self.length**2 * np.sum((interpolated.grad - x * (slope(r) / r)) ** 2, axis=0)
            return float(np.sqrt(np.sum(square * basis.dx)))

        def relative(basis: Basis, field: Array, value: Radially, slope: Radially | None = None) -> float:
            return distance(basis, field, value, slope) / distance(basis, nothing, value, slope)

        return relative(whole, deflection, exact.u, exact.slope), relative(disc, multiplier, exact.lam)

    def contact_radius(self, lam: Array) -> float:
        """ρ of a discrete multiplier (m,): the radius of the disc with the same resultant at the median pressure."""
        active = lam > 0.0
        if not active.any():
            return 0.0
        plateau = float(np.median(lam[active]))
        return float(np.sqrt(self.W.apply(lam).sum() / (np.pi * plateau)))

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Deflections of the nodes nearest to (¼, 0), which is in contact, (0.55 m, 0) and (0.8 m, 0)."""
        places = (("inner", 0.25), ("middle", 0.55), ("outer", 0.8))
        return tuple(Output(f"{name} deflection", "m", u=self._at(x)) for name, x in places)

    def _at(self, x: float) -> Array:
        found = np.zeros(self.V.dim)
        found[np.linalg.norm(self.mesh.p[:, self.free] - np.array([[x], [0.0]]), axis=0).argmin()] = 1.0
        return found

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:  # noqa: ARG002
        """The membrane's deflection and the multiplier."""
        deflection = np.zeros(self.mesh.p.shape[1])
        deflection[self.free] = u
        disc = self.mesh.p[:, self.disc_nodes]
        return Picture(self.mesh.p, self.mesh.t, deflection, "deflection u [m]", disc, lam, "multiplier λ [1/m]", "m")
