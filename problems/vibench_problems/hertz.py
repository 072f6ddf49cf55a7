"""Frictionless contact of two discs: the Hertz problem of Niakh, Drouet, Ehrlacher and Ern (2022), §5.2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Gt, Le, Lt
from skfem import Basis, BilinearForm, ElementTriP1, ElementVector
from skfem.helpers import ddot, eye, sym_grad, trace

from vibench import (
    Array,
    Contact,
    ContactLoads,
    ContactSource,
    Indices,
    InnerProduct,
    Output,
    ParameterBox,
    Picture,
    Problem,
    Sampler,
    VariationalInequality,
    fem,
)
from vibench_problems.graded_mesh import Triangulation, quarter_disc
from vibench_problems.mortar import ALL, Pairing

SLAVE_ANGLE = np.pi / 6.0
"""End of the potential contact zone on disc 1 [rad]: x ≤ 0.5 m."""

MASTER_ANGLE = 0.83
"""End of the potential contact zone on disc 2 [rad]; the arc of the smallest disc still covers x ≤ 0.5 m."""

EDGES = {"coarse": 90, "medium": 240, "paper": 560, "fine": 1120}
"""Slave edges behind each named resolution; 560 give the paper's 6130 nodes at the default growth and ratio."""

WITH_APPROACH = ParameterBox(
    names=("radius", "approach"), lower=np.array([0.905, 0.075]), upper=np.array([1.125, 0.15]), units=("m", "m")
)
"""The parameter box with the approach as second parameter."""

NODES_PER_EDGE = 6130 / EDGES["paper"]


@BilinearForm
def elasticity(u, v, w):  # type: ignore[no-untyped-def]
    """∫ σ(u) : ε(v) with Lamé's constants, equation (47)."""
    strain = sym_grad(u)
    return ddot(w.lame * eye(trace(strain), 2) + 2.0 * w.shear * strain, sym_grad(v))


class Hertz(Problem):
    """Two quarter discs pressed against each other; the parameter mu_1 is the radius of the lower one.

    P1 displacements, multipliers constant on macro-edges of two slave edges (local average contact), pairing by the
    vertical projection in the physical configuration. Disc 2 is scaled about its apex, which changes neither its
    two-dimensional elastic energy nor the gap on the axis. The flats are moved by a rigid-body lifting, which causes no
    stress. Hence A and f do not depend on mu; B and g do.

    With `approach = "parameter"` the approach d is a second parameter, after Benaceur, Ern and Ehrlacher (2020). Their
    radii run from 0.905 to 1.125 m, and their d takes the values 0.15 + 0.01 i m. These values are interpreted here as
    the total approach 2d of both flats, 0 ≤ i ≤ 15: d runs from 0.075 to 0.15 m and includes the 0.09 m of the later
    paper, strains stay small, and the contact extends to x = 0.39 m, inside the potential contact zone (0.5 m). If each
    flat moved by that value, the contact would leave the potential contact zone from 0.22 m on.

    Parameters
    ----------
    resolution
        "coarse" (about 1000 nodes), "medium", "paper" (6130 nodes, 560 slave edges, 280 multipliers), "fine", or a
        number of nodes.
    quadrature
        "exact" (segments cut at projected master nodes), or a number of Gauss points per slave edge (as in the paper).
    flats
        "free" horizontally, or "clamped".
    ratio
        Density of master edges relative to that of slave edges, before disc 2 is scaled. By default both zones have the
        same number of edges, and master edges are longer than slave edges at every radius, as usual in mortar methods.
    growth
        Ratio of the sizes of successive element layers away from the contact zone.
    triangulation
        Of both discs, with the same boundary nodes: "staggered" (every other layer of nodes shifted by half a spacing),
        "aligned" (no shift, all diagonals one way) or "irregular" (staggered, inner nodes displaced at random).
    length
        ℓ̂ [m] of the norm (44).
    young, poisson
        E [Pa] and ν.
    approach
        d [m]: each flat moves by d towards the other. Or "parameter": d is mu_2.
    gap
        γ₀ [m] between the apexes.
    """

    parameters = ParameterBox(names=("radius",), lower=np.array([0.7]), upper=np.array([1.3]), units=("m",))
    constant: ClassVar[frozenset[str]] = frozenset({"A", "f"})
    elementwise: ClassVar[frozenset[str]] = frozenset({"A", "f"})

    def __init__(
        self,
        resolution: Literal["coarse", "medium", "paper", "fine"] | Annotated[int, Ge(300), Le(200_000)] = "paper",
        quadrature: Literal["exact"] | Annotated[int, Ge(1), Le(20)] = "exact",
        flats: Literal["free", "clamped"] = "free",
        ratio: Annotated[float, Ge(0.25), Le(4.0)] = 0.631,
        growth: Annotated[float, Gt(1.0), Le(2.0)] = 1.265,
        triangulation: Triangulation = "staggered",
        length: Annotated[float, Gt(0.0)] = 1.0,
        young: Annotated[float, Gt(0.0)] = 15.0,
        poisson: Annotated[float, Ge(0.0), Lt(0.5)] = 0.35,
        approach: Literal["parameter"] | Annotated[float, Gt(0.0)] = 0.09,
        gap: Annotated[float, Ge(0.0)] = 1e-3,
    ) -> None:
        edges = EDGES[resolution] if isinstance(resolution, str) else 2 * round(resolution / NODES_PER_EDGE / 2)
        self.quadrature, self.gap, self.young, self.poisson = quadrature, gap, young, poisson
        self._approach = None if isinstance(approach, str) else approach
        if self._approach is None:
            self.parameters = WITH_APPROACH
        self.slave = quarter_disc(edges, SLAVE_ANGLE, growth, triangulation)
        masters = round(ratio * edges * MASTER_ANGLE / SLAVE_ANGLE)
        self.master = quarter_disc(masters, MASTER_ANGLE, growth, triangulation)
        lame = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
        shear = young / (2.0 * (1.0 + poisson))
        blocks, norms, fixed, elements, offset = [], [], [], [], 0
        for disc in (self.slave, self.master):
            basis = Basis(disc.mesh, ElementVector(ElementTriP1()))
            blocks.append(elasticity.assemble(basis, lame=lame, shear=shear))
            elements.append((basis.element_dofs + offset, elasticity.coo_data(basis, lame=lame, shear=shear)))
            norms.append(fem.h1_gram(basis, length=length))
            fixed += [offset + 2 * disc.axis, offset + 2 * disc.flat + 1]
            fixed += [offset + 2 * disc.flat] if flats == "clamped" else []
            offset += basis.N
        self.free = np.setdiff1d(np.arange(offset), np.concatenate(fixed))
        self._element_dofs = np.hstack([dofs for dofs, _ in elements])
        self._element_stiffness = np.vstack([data.tolocal() for _, data in elements])
        self._all_stiffness = sp.csr_array(sp.block_diag(blocks))
        self._stiffness = self._all_stiffness[self.free][:, self.free]
        self._second = 2 * self.slave.mesh.p.shape[1]  # first degree of freedom of disc 2
        self._unit_lift = np.zeros(offset)
        self._unit_lift[1 : self._second : 2], self._unit_lift[self._second + 1 :: 2] = -1.0, 1.0
        zone = np.concatenate([2 * self.slave.zone + 1, self._second + 2 * self.master.zone + 1])
        self._contact_dofs, self._contact_lift = np.searchsorted(self.free, zone), self._unit_lift[zone]
        upper, lower = self.points(np.ones(1))
        self._pairing = Pairing(upper[:, self.slave.zone], quadrature)
        self._master_zone = lower[:, self.master.zone]  # at radius 1; any other radius scales it
        self.V = InnerProduct(sp.csr_array(sp.block_diag(norms))[self.free][:, self.free])
        self.W = InnerProduct(sp.diags_array(self.macro_lengths))

    @property
    def nodes(self) -> int:
        """Nodes of both meshes."""
        return int(self.slave.mesh.p.shape[1] + self.master.mesh.p.shape[1])

    @property
    def macro_lengths(self) -> Array:
        """Lengths (m,) of the macro-edges."""
        zone = self.slave.mesh.p[:, self.slave.zone]
        return np.asarray(np.linalg.norm(np.diff(zone, axis=1), axis=0).reshape(-1, 2).sum(axis=1))

    def training_set(self) -> Array:
        """The 81 radii 0.7 + 0.0075 i; or 12 radii 0.905 + 0.02 i times 16 approaches 0.075 + 0.005 j."""
        return self.parameters.grid(81) if self._approach is not None else self.parameters.grid(12, 16)

    def approach(self, mu: Array) -> float:
        """Displacement d [m] of each flat at mu."""
        return float(mu[1]) if self._approach is None else self._approach

    def points(self, mu: Array) -> tuple[Array, Array]:
        """Nodes (2×…) of disc 1 and of disc 2 at the radius mu[0], undeformed; the apexes on x = 0 at γ₀ and at 0."""
        upper = self.slave.mesh.p + np.array([[0.0], [1.0 + self.gap]])
        lower = mu[0] * (self.master.mesh.p + np.array([[0.0], [1.0]])) * np.array([[1.0], [-1.0]])
        return upper, lower

    def assemble(self, mu: Array) -> VariationalInequality:
        """Form (45) and the non-interpenetration condition ∫ (v₂∘φ − v₁)·e_y η ≤ ∫ (x − φ(x))·e_y η, lifting included.

        The sign follows from the closing direction: the normal printed in the paper would, with the printed boundary
        displacements, pull the discs apart. Equation (52) prints g independent of mu; with a vertical projection φ(mu)
        it depends on mu. The lifting moves disc 1 by −d and disc 2 by +d as rigid bodies: it reduces the gap by 2d.

        Raises
        ------
        NumericalError
            If mu_1 is so small that the arc of disc 2 does not cover the whole potential contact zone.
        """
        B, g = self.constraint(mu)
        return VariationalInequality(
            A=self._stiffness, f=np.zeros(len(self.free)), B=B, g=g, dirichlet_lift=self._lift(mu)
        )

    @property
    def element_dofs(self) -> Indices:
        """Displacements of the corners of the triangles, those of disc 1 first."""
        number = np.full(len(self._unit_lift), -1)
        number[self.free] = np.arange(len(self.free))
        return np.asarray(number[self._element_dofs])

    def element_sampler(self, elements: Indices) -> Sampler:
        """The same at every parameter, as A and f are."""
        chosen = self._element_stiffness[elements]

        def sample(_: Array) -> Mapping[str, Array]:
            return {"A": chosen, "f": np.zeros(chosen.shape[:2])}

        return sample

    @property
    def contact_dofs(self) -> Indices:
        """Vertical displacements of the potential contact zones of both discs."""
        return self._contact_dofs

    def contact(self, mu: Array) -> Contact:
        """The non-interpenetration condition on the potential contact zones."""
        integrals = self._pairing.couple(mu[0] * self._master_zone)
        return Contact(integrals.jump, integrals.gap - integrals.jump @ (self.approach(mu) * self._contact_lift))

    def contact_loads(self, eta: Array) -> ContactLoads:
        """Those of multipliers η (m×k) on disc 1 are the same at every radius; those on disc 2 begin at its axis."""
        tested, slaves, (x, y) = self._pairing.tested(eta), len(self.slave.zone), self._master_zone
        fixed = np.zeros((len(self._contact_dofs), eta.shape[1]))
        fixed[:slaves] = tested.on_slave
        lift_below, lift_above = self._contact_lift[slaves:], tested.on_slave.T @ self._contact_lift[:slaves]

        def varying(mu: Array) -> tuple[Array, Array]:
            radius, approach = mu[0], self.approach(mu)
            loads = tested.on_master(radius * x)
            j = len(loads)
            return loads, tested.height - approach * lift_above - (radius * y[:j] + approach * lift_below[:j]) @ loads

        # At the smallest radius that covers the zone η reaches the most nodes of disc 2.
        smallest = self._pairing.end(ALL) / x[-1]
        reach = int(np.searchsorted(smallest * x, tested.end)) + 1
        return ContactLoads(fixed, varying, slaves, min(reach + 1, len(x)))

    def contact_source(self) -> ContactSource:
        """The same condition in C."""
        return self._pairing.source(self._master_zone, self._contact_lift, self._approach or 0.0)

    def refuse(self, mu: Array, u: Array, lam: Array) -> str:  # noqa: ARG002
        """Refuse contact that reaches the last macro-edge: it may extend beyond the potential contact zone."""
        if lam[-1] <= 0.0:
            return ""
        return "the contact reaches the end of the potential contact zone: a smaller approach d keeps it inside"

    def _lift(self, mu: Array) -> Array:
        return self.approach(mu) * self._unit_lift

    def displacement(self, mu: Array, u: Array) -> Array:
        """Displacements (2×nodes) of both discs at mu, the lifting included, disc 1 first."""
        everywhere = self._lift(mu)
        everywhere[self.free] += u
        return np.asarray(everywhere.reshape(-1, 2).T)

    def resultants(self, mu: Array, u: Array) -> tuple[float, float]:
        """Vertical forces [N/m] that the flats exert on disc 1 (downwards) and on disc 2 (upwards), half bodies."""
        forces = self._all_stiffness @ self.displacement(mu, u).T.ravel()
        upper, lower = 2 * self.slave.flat + 1, self._second + 2 * self.master.flat + 1
        return -float(forces[upper].sum()), float(forces[lower].sum())

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Contact force of the whole discs per unit thickness, half-width of the contact, and indentation of disc 1.

        The indentation is the vertical displacement of the apex relative to the flat, which the lifting moves.
        """
        widths = np.diff(self.slave.mesh.p[0, self.slave.zone[::2]])  # of the macro-edges, along the abscissa
        apex = np.zeros(self.V.dim)
        apex[np.searchsorted(self.free, 2 * self.slave.zone[0] + 1)] = 1.0
        return (
            Output("contact force", "N/m", lam=2.0 * self.macro_lengths),
            Output("contact half-width", "m", function=lambda _mu, _u, lam: float(widths @ (lam > 0.0))),
            Output("indentation", "m", u=apex),
        )

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:
        """Deformed discs coloured by the vertical displacement, and the contact pressure (paper, Figure 10)."""
        upper, lower = self.points(mu)
        moved = self.displacement(mu, u)
        triangles = np.hstack([self.slave.mesh.t, self.master.mesh.t + self.slave.mesh.p.shape[1]])
        middles = upper[:1, self.slave.zone[1::2]]
        return Picture(
            np.hstack([upper, lower]) + moved, triangles, moved[1], "vertical displacement [m]", middles, lam,
            "contact pressure [Pa]", "m",
        )  # fmt: skip
