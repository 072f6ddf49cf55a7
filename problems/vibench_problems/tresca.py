"""Friction with a given bound: partial slip of a cylinder on a half-plane (Cattaneo 1938, Mindlin 1949)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Gt, Le, Lt
from scipy.optimize import brentq
from skfem import Basis, ElementQuad1, ElementVector, MeshQuad

from vibench import (
    Array,
    BlockKind,
    Contact,
    DualSet,
    Indices,
    InnerProduct,
    Output,
    ParameterBox,
    Picture,
    Problem,
    VariationalInequality,
)
from vibench_problems.hertz import elasticity

ELEMENTS = {"coarse": 10, "medium": 20, "fine": 40, "paper": 80}
"""Elements per unit of length along the zone behind each named resolution."""

ZONE = 1.0625
"""End of the zone with multipliers, beyond the largest half-width."""

FAR = 100.0
"""Distance of the clamped sides."""


@dataclass(frozen=True)
class PartialSlip:
    """The closed form: the tangential force over its limit, Q/fP, and the half-width c of the stick zone."""

    force: float
    stick: float
    half_width: float

    def traction(self, x: Array) -> Array:
        """The traction at x (k,), relative to its bound."""
        within = np.abs(x) < self.half_width
        at = np.where(within, x / self.half_width, 0.0)
        inner = np.sqrt(np.maximum(1.0 - (x / self.stick) ** 2, 0.0)) if self.stick > 0.0 else np.zeros_like(x)
        return np.where(within, 1.0 - self.stick / self.half_width * inner / np.sqrt(1.0 - at**2), 1.0)


class Tresca(Problem):
    """A half-plane under Hertz's pressure, dragged by a shifted cylinder: it sticks inside and slips at the edges.

    Two equal cylinders of unit radius touch in |x| ≤ a, with the pressure p = p₀ √(1 − x²/a²), p₀ = E* a / (2R*) of
    Hertz's theory. A tangential shift drags them along each other. By symmetry normal and tangential problems decouple,
    and the surface of one body, a half-plane, moves by half of the shift where it sticks. The bound of friction f p is
    given (Tresca's law), as the pressure does not change. Multipliers are tractions over that bound, θ ∈ [−1, 1] at
    every node. Outside of the contact the bound is 1e-4 f p₀ instead of zero: θ is unique there, too. The norm of θ has
    the bound of the widest contact as a weight. V has the energy norm: supremizers are the displacements of tractions.

    The body is a block of bilinear elements that grow away from the zone, clamped at a distance of 100. The shift is a
    fraction of the one from which everything slips, computed once for this block.

    Parameters
    ----------
    resolution
        "coarse" (10 elements per unit length along the zone), "medium" (20), "fine" (40), "paper" (80), or a number.
    friction
        The coefficient f. Or "parameter": it is mu_3, from 0.3 to 0.5, and shifts are relative to slip at f = 0.3.
    young, poisson
        E [Pa] and ν.
    growth
        Ratio of the sizes of successive elements away from the zone.
    """

    parameters = ParameterBox(
        names=("half_width", "shift"), lower=np.array([0.5, -0.95]), upper=np.array([1.0, 0.95]), units=("m", "1")
    )
    constant: ClassVar[frozenset[str]] = frozenset({"A", "f"})
    blocks = (BlockKind.INTERVAL,)

    def __init__(
        self,
        resolution: Literal["coarse", "medium", "fine", "paper"] | Annotated[int, Ge(4), Le(400)] = "paper",
        friction: Literal["parameter"] | Annotated[float, Gt(0.0), Le(2.0)] = 0.3,
        young: Annotated[float, Gt(0.0)] = 1.0,
        poisson: Annotated[float, Ge(0.0), Lt(0.5)] = 0.3,
        growth: Annotated[float, Gt(1.0), Le(2.0)] = 1.15,
    ) -> None:
        per_unit = ELEMENTS[resolution] if isinstance(resolution, str) else resolution
        self._friction = None if isinstance(friction, str) else friction
        if self._friction is None:
            box = self.parameters
            self.parameters = ParameterBox(
                (*box.names, "friction"), np.append(box.lower, 0.3), np.append(box.upper, 0.5), (*box.units, "1")
            )
        count = int(np.ceil(ZONE * per_unit))
        zone = np.arange(-count, count + 1) / per_unit
        outward = _growing(zone[-1], 1.0 / per_unit, growth)
        depths = _growing(0.0, 1.0 / per_unit, growth)
        x = np.concatenate([-outward[::-1], zone, outward])
        self.mesh = MeshQuad.init_tensor(x, -np.concatenate([[0.0], depths])[::-1])
        self.young, self.poisson = young, poisson
        basis = Basis(self.mesh, ElementVector(ElementQuad1()))
        lame, shear = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
        stiffness = sp.csr_array(elasticity.assemble(basis, lame=lame, shear=shear))
        p, far = self.mesh.p, FAR * (1.0 - 1e-9)
        clamped = np.flatnonzero((np.abs(p[0]) >= far) | (p[1] <= -far))
        self.free = np.setdiff1d(np.arange(basis.N), np.concatenate([2 * clamped, 2 * clamped + 1]))
        surface = np.flatnonzero((p[1] == 0.0) & (np.abs(p[0]) <= zone[-1] + 1e-9))
        self.nodes = surface[np.argsort(p[0, surface])]
        self.x = p[0, self.nodes]
        # The mass of a node at the end of the zone is that of half an element.
        self._lengths = np.full(len(self.x), 1.0 / per_unit)
        self._lengths[[0, -1]] *= 0.5
        self._dofs = np.searchsorted(self.free, 2 * self.nodes)
        self._A = stiffness[self.free][:, self.free]
        # In the H¹ norm of a body so large little counts but displacements far away from the contact.
        self.V = InnerProduct(self._A)
        # Tractions over their bound say little where the bound is small: they are weighed by the widest one.
        self.W = InnerProduct(sp.diags_array(self._lengths * np.maximum(1.0 - self.x**2, 1e-2)))
        self.K = DualSet.intervals(np.arange(len(self.x)), 1.0)
        self._load = np.zeros(len(self.free))
        # u(0) under Hertz's traction of resultant 1 in |x| ≤ 1 is k L(1); at half-width a, L(a) = L(1) − ln a.
        self._compliance = 2.0 * (1.0 - poisson**2) / (np.pi * young)
        self._far = self._unit_slip() / self._compliance

    def _unit_slip(self) -> float:
        """The displacement of x = 0 under Hertz's traction of resultant 1 in |x| ≤ 1."""
        load = self._load.copy()
        load[self._dofs] = self._lengths * 2.0 / np.pi * np.sqrt(np.maximum(1.0 - self.x**2, 0.0))
        load /= load.sum()
        return float(InnerProduct(self._A).riesz(load)[self._dofs[len(self.x) // 2]])

    def training_set(self) -> Array:
        """A grid of 9×21 half-widths and shifts, at the ends of the friction coefficient and in their middle."""
        return self.parameters.grid(*((9, 21) if self._friction is not None else (6, 15, 3)))

    def friction(self, mu: Array) -> float:
        """The coefficient f at mu."""
        return float(mu[2]) if self._friction is None else self._friction

    def peak(self, mu: Array) -> float:
        """The peak pressure p₀ [Pa] of Hertz's theory at mu."""
        return self.young / (2.0 * (1.0 - self.poisson**2)) * float(mu[0])

    def limit(self, mu: Array) -> float:
        """The tangential force f P [N/m] from which everything slips."""
        return 0.5 * np.pi * self.friction(mu) * self.peak(mu) * float(mu[0])

    def _length(self, half_width: float) -> float:
        # L = u(0) / (k Q) under Hertz's traction of resultant Q
        return float(self._far - np.log(half_width))

    def displacement(self, mu: Array) -> float:
        """The displacement [m] of the surface where it sticks."""
        reference = 0.3 if self._friction is None else self._friction
        full = self.limit(mu) / self.friction(mu) * reference * self._compliance * self._length(float(mu[0]))
        return float(mu[1]) * full

    def exact(self, mu: Array) -> PartialSlip:
        """Cattaneo's and Mindlin's solution at mu."""
        a, L = float(mu[0]), self._length(float(mu[0]))
        share = abs(self.displacement(mu)) / (self.limit(mu) * self._compliance)
        if share >= L:
            return PartialSlip(float(np.sign(mu[1])), 0.0, a)
        # The traction is Hertz's of |x| ≤ a without one of |x| ≤ c, and the displacements of both subtract.
        ratio = brentq(lambda r: L - r**2 * (L - np.log(r)) - share, 1e-12, 1.0, xtol=1e-15)
        return PartialSlip(float(np.sign(mu[1]) * (1.0 - ratio**2)), float(ratio * a), a)

    def bounds(self, mu: Array) -> Array:
        """The bound of friction f p [Pa] at the nodes (m,)."""
        inside = np.sqrt(np.maximum(1.0 - (self.x / float(mu[0])) ** 2, 0.0))
        return np.asarray(self.friction(mu) * self.peak(mu) * np.maximum(inside, 1e-4))

    @property
    def contact_dofs(self) -> Indices:
        """Tangential displacements of the nodes of the zone."""
        return np.sort(self._dofs)

    def contact(self, mu: Array) -> Contact:
        """Slip, the displacement beyond that of the cylinder, times the bound of friction at every node."""
        weights = self._lengths * self.bounds(mu)
        B = sp.csr_array((weights, (np.arange(len(weights)), np.searchsorted(self.contact_dofs, self._dofs))))
        return Contact(B, weights * self.displacement(mu))

    def assemble(self, mu: Array) -> VariationalInequality:
        """Elasticity, and the dissipation ∫ f p |u₁ − δ/2| of friction by its multipliers."""
        B, g = self.constraint(mu)
        return VariationalInequality(A=self._A, f=self._load, B=B, g=g, K=self.K)

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Tangential force per unit thickness, from the work on a field that is 1 on the zone, and the stick zone."""
        field = np.zeros(self.V.dim)
        field[self._dofs] = 1.0
        return (
            Output("tangential force", "N/m", u=np.asarray(self._A @ field)),
            Output(
                "stick half-width", "m", function=lambda _mu, _u, lam: 0.5 * float(self._lengths @ (abs(lam) < 1.0))
            ),
        )

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:  # noqa: ARG002
        """The tangential displacement near the zone, and the traction over its bound."""
        moved = np.zeros(2 * self.mesh.p.shape[1])
        moved[self.free] = u
        near = (np.abs(self.mesh.p) <= 2.0).all(axis=0)
        inner = self.mesh.t[:, near[self.mesh.t].all(axis=0)]
        triangles = np.hstack([inner[[0, 1, 2]], inner[[0, 2, 3]]])
        return Picture(
            self.mesh.p, triangles, moved[::2], "tangential displacement [m]", self.x[None], lam,
            "traction over its bound", "m",
        )  # fmt: skip


def _growing(start: float, size: float, growth: float) -> Array:
    """Coordinates beyond `start` whose distances grow from `size` on, up to `FAR`."""
    sizes = size * growth ** np.arange(1, 1 + int(np.ceil(np.log(1.0 + (FAR - start) / size) / np.log(growth)) + 40))
    ends = start + np.cumsum(sizes)
    ends = ends[: int(np.searchsorted(ends, FAR)) + 1]
    return np.asarray(start + (ends - start) * (FAR - start) / (ends[-1] - start))
