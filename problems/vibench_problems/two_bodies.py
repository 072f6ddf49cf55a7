"""Two elastic bodies in three dimensions whose surfaces are in contact, with grids that do not match."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import ClassVar

import numpy as np
import scipy.sparse as sp
from skfem import MeshHex

from vibench import (
    AffineSum,
    Array,
    Contact,
    ContactLoads,
    ContactSource,
    Indices,
    InnerProduct,
    MeshFields,
    NumericalError,
    ParameterBox,
    Picture,
    SparseMatrix,
    VariationalInequality,
)
from vibench_problems.contact_zone import ContactZone
from vibench_problems.cube_shells import hexahedra, quads
from vibench_problems.elastic_forms import interior

COVERED_RTOL = 1e-12
"""Share of the zone by which the grid above may fall short of it, by round-off."""

OF_BUBBLE = 4.0 / 9.0
"""Mean of a bubble over its facet."""

UPSIDE_DOWN = np.array([[1.0], [1.0], [-1.0]])
"""From coordinates and displacements of the body above to those where its apex is above its flat."""


@dataclass(frozen=True)
class Shape:
    """The mesh of one quarter of a body below its surface, symmetric in the planes x = 0 and y = 0.

    Attributes
    ----------
    mesh
        Its hexahedra; third reference coordinates of those below `zone` are zero on their upper sides.
    zone
        Facets (k²,) of the surface that cover the square 0 ≤ x, y ≤ `ticks[-1]`, seen from above: the facet i·k + j
        covers the i-th interval of `ticks` along x and the j-th along y.
    corners
        Nodes ((k + 1)²,) of these facets, rising, in the same order.
    ticks
        Abscissae (k + 1,), and ordinates, of these nodes.
    flat
        Nodes that do not move vertically.
    """

    mesh: MeshHex
    zone: Indices
    corners: Indices
    ticks: Array
    flat: Indices


@dataclass(frozen=True)
class Body:
    """An elastic body.

    Attributes
    ----------
    shape
        Its mesh.
    forms
        The forms of Lamé's constants and the product of gradients (`interior`), in its unknowns.
    restriction
        Values in components x, y, z of nodes and in bubbles, of its unknowns.
    contact
        Its unknowns on the zone, rising: vertical displacements of its nodes, then bubbles, in the order of facets.
    """

    shape: Shape
    forms: list[SparseMatrix]
    restriction: SparseMatrix
    contact: Indices

    @classmethod
    def of(cls, shape: Shape, bubbles: bool) -> Body:
        """The body with a bubble on each facet of its zone, or without them."""
        mesh, nodes = shape.mesh, shape.mesh.p.shape[1]
        below = mesh.f2t[0, shape.zone] if bubbles else shape.zone[:0]
        everywhere = 3 * nodes + len(below)
        fixed = [np.flatnonzero(mesh.p[axis] == 0.0) + axis * nodes for axis in (0, 1)]
        free = np.setdiff1d(np.arange(everywhere), np.concatenate([*fixed, shape.flat + 2 * nodes]))
        restriction = sp.csc_array((np.ones(len(free)), (free, np.arange(len(free)))), shape=(everywhere, len(free)))
        contact = np.concatenate([2 * nodes + shape.corners, np.arange(3 * nodes, everywhere)])
        return cls(shape, interior(mesh, below, restriction), restriction, np.searchsorted(free, contact))

    @property
    def dim(self) -> int:
        """Number of its unknowns."""
        return int(self.restriction.shape[1])

    @property
    def depths(self) -> Array:
        """Depths of the nodes of the zone below the apex."""
        return np.asarray(-self.shape.mesh.p[2, self.shape.corners])

    def at_nodes(self, u: Array) -> Array:
        """Displacements (3×nodes) of the nodes, without bubbles."""
        return np.asarray((self.restriction @ u)[: 3 * self.shape.mesh.p.shape[1]].reshape(3, -1))


def hat_integrals(cuts: Array, nodes: Array) -> Array:
    """∫ of the hat function of each node over each interval between cuts (k×nodes), both rising.

    Raises
    ------
    NumericalError
        If the nodes do not cover the cuts.
    """
    if nodes[-1] < cuts[-1] * (1.0 - COVERED_RTOL):
        raise NumericalError(
            f"the grid above ends at x = {nodes[-1]:.4g} m, but the potential contact zone below reaches "
            f"x = {cuts[-1]:.4g} m: the radius is too small"
        )
    cell = np.clip(np.searchsorted(nodes, cuts, side="right") - 1, 0, len(nodes) - 2)
    width = np.diff(nodes)
    share = (cuts - nodes[cell]) / width[cell]
    # From the first node to each cut: whole cells, then a part of one.
    whole = np.where(np.arange(len(width)) < cell[:, None], 0.5 * width, 0.0)
    upto = np.zeros((len(cuts), len(nodes)))
    upto[:, :-1] += whole
    upto[:, 1:] += whole
    rows = np.arange(len(cuts))
    upto[rows, cell] += width[cell] * share * (1.0 - 0.5 * share)
    upto[rows, cell + 1] += 0.5 * width[cell] * share**2
    return np.asarray(np.diff(upto, axis=0))


class TwoBodies(ContactZone):
    """An elastic body below and another one above it, upside down, scaled by its radius R; mu = (R, δ, ν).

    Frictionless, small strains, one material. Points are paired by the vertical projection φ of the undeformed
    surfaces, as in the plane (`hertz`): with displacements u₁ and u₂ relative to the ends of the bodies, which approach
    by δ, the condition is

        ∫ (u₁ − u₂∘φ) · e_z η ≤ ∫ (gap − δ) η,

    integrals over the surface seen from above, so that λ is a normal pressure: the vertical component of p n per area
    seen from above is p. Seen from above the zones of both bodies are grids parallel to the axes, the one above scaled
    by R about the apex: integrals of products of functions on both are products of those of one variable, and exact.
    B depends on R, and not affinely; A does affinely, because energy scales with R in space.

    Q1 displacements. On the body below, the mortar's slave side, each facet of the zone has a constant multiplier and a
    bubble of the vertical displacement.

    Parameters
    ----------
    slave, master
        The bodies below and above, the latter at the radius 1 m and not upside down.
    parameters
        The box of R [m], δ [m] and ν.
    young
        E [Pa].
    """

    constant: ClassVar[frozenset[str]] = frozenset({"f"})

    def __init__(self, slave: Body, master: Body, parameters: ParameterBox, young: float) -> None:
        self.slave, self.master, self.parameters, self.young = slave, master, parameters, young
        ticks = self.slave.shape.ticks
        own = hat_integrals(ticks, ticks)
        widths, firsts, seconds = (np.asarray(np.diff(ticks**power) / power) for power in (1, 2, 3))
        self.areas = np.asarray(np.kron(widths, widths))
        self.middles = np.stack([np.kron(firsts, widths), np.kron(widths, firsts)]) / self.areas
        self.squares = np.stack([np.kron(seconds, widths), np.kron(widths, seconds)])
        nodal = sp.csr_array(sp.kron(own, own))
        self._on_slave = sp.csr_array(sp.hstack([nodal, sp.diags_array(OF_BUBBLE * self.areas)]))
        self._slave_gap, self._height = np.asarray(nodal @ self.slave.depths), self.master.depths
        self.V = InnerProduct(sp.csr_array(sp.block_diag([self.slave.forms[2], self.master.forms[2]])))
        self.W = InnerProduct(sp.diags_array(self.areas))
        self.affine = {"A": AffineSum.of(self._stiffness(), self.parameters.names)}

    def _stiffness(self) -> list[tuple[str, SparseMatrix]]:
        """The terms of A with their coefficients: forms of the master are those at the radius 1 m, times the radius."""
        below, above = self.slave.forms, self.master.forms
        empty = sp.csr_array(below[0].shape), sp.csr_array(above[0].shape)
        E, terms = repr(self.young), []
        lame, shear = f"{E} * poisson / ((1 + poisson) * (1 - 2 * poisson))", f"0.5 * {E} / (1 + poisson)"
        for form, theta in enumerate((lame, shear)):
            terms.append((theta, sp.csr_array(sp.block_diag([below[form], empty[1]]))))
            terms.append((f"radius * {theta}", sp.csr_array(sp.block_diag([empty[0], above[form]]))))
        return terms

    def training_set(self) -> Array:
        """The 9×4×3 grid."""
        return self.parameters.grid(9, 4, 3)

    def assemble(self, mu: Array) -> VariationalInequality:
        """Energy of both bodies, and the integrated gaps."""
        B, g = self.constraint(mu)
        return VariationalInequality(A=self.affine["A"].at(mu), f=np.zeros(self.V.dim), B=B, g=g)

    @property
    def contact_dofs(self) -> Indices:
        """Vertical displacements of the zone below, its bubbles, and vertical displacements of the zone above."""
        return np.concatenate([self.slave.contact, self.slave.dim + self.master.contact])

    def contact(self, mu: Array) -> Contact:
        """The condition on both zones. The displacements above are those downwards: their part has a plus as well."""
        above = self._pairs(mu)
        on_master = sp.csr_array(sp.kron(above, above))
        B = sp.csr_array(sp.hstack([self._on_slave, on_master]))
        return Contact(B, self._slave_gap + on_master @ (mu[0] * self._height) - mu[1] * self.areas)

    def contact_loads(self, eta: Array) -> ContactLoads:
        """Loads below are the same at all parameters; those above are products of integrals along x and y."""
        k, count = len(self.slave.shape.ticks) - 1, eta.shape[1]
        slaves, tested = len(self.slave.contact), eta.reshape(k, k, count)
        fixed = np.zeros((len(self.contact_dofs), count))
        fixed[:slaves] = self._on_slave.T @ eta
        gaps, areas = eta.T @ self._slave_gap, eta.T @ self.areas

        def varying(mu: Array) -> tuple[Array, Array]:
            above = self._pairs(mu)
            loads = np.einsum("ia,ijc,jb->abc", above, tested, above, optimize=True).reshape(-1, count)
            return loads, gaps + mu[0] * (self._height @ loads) - mu[1] * areas

        return ContactLoads(fixed, varying, slaves)

    def contact_source(self) -> ContactSource:
        """The same condition in C."""
        below, above, fixed = self.slave.shape.ticks, self.master.shape.ticks, self._on_slave
        cells, hats = len(below) - 1, 2 * len(below) + len(above)
        tables = {
            "below": below, "above": above, "cells": cells, "nodes": len(above), "covered": COVERED_RTOL, "hats": hats,
            "gap": self._slave_gap, "areas": self.areas, "height": self._height, "slaves": len(self.slave.contact),
            "slave_ends": fixed.indptr, "slave_columns": fixed.indices, "slave_values": fixed.data,
        }  # fmt: skip
        text = (files("vibench_problems") / "two_bodies.c").read_text(encoding="utf-8")
        return ContactSource(text, tables, fixed.nnz + hats**2)

    def _pairs(self, mu: Array) -> Array:
        """Integrals over the cells below of the hat functions above, along one axis (k×(k + 1))."""
        return hat_integrals(self.slave.shape.ticks, mu[0] * self.master.shape.ticks)

    def displacements(self, mu: Array, u: Array) -> tuple[Array, Array]:
        """Displacements (3×nodes) of the nodes below and above, of u (n,); the flat above moves by −δ."""
        lower, upper = self.slave.at_nodes(u[: self.slave.dim]), self.master.at_nodes(u[self.slave.dim :])
        return lower, UPSIDE_DOWN * upper - np.array([[0.0], [0.0], [mu[1]]])

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:
        """The potential contact zone below, from above, coloured by its vertical displacement, and the pressure."""
        mesh, zone = self.slave.shape.mesh, self.slave.shape.zone
        nodes, places = np.unique(quads(mesh, zone).T, return_inverse=True)
        around = places.reshape(4, -1)
        settled = self.displacements(mu, u)[0][2, nodes]
        triangles = np.hstack([around[[0, 1, 2]], around[[0, 2, 3]]])
        return Picture(
            mesh.p[:2, nodes], triangles, settled, "vertical displacement [m]", self.middles, lam,
            "contact pressure [Pa]", "m",
        )  # fmt: skip

    def mesh_fields(self, mu: Array, u: Array, lam: Array) -> MeshFields:
        """Displacements of the nodes of both bodies, without bubbles, and the pressure on facets of the zone below."""
        lower, above = self.slave.shape.mesh, self.master.shape.mesh
        upper = MeshHex(np.ascontiguousarray(mu[0] * UPSIDE_DOWN * above.p), above.t)
        points = np.hstack([lower.p, upper.p])
        both = np.vstack([hexahedra(lower), hexahedra(upper) + lower.p.shape[1]])
        cells = {"hexahedron": both, "quad": quads(lower, self.slave.shape.zone)}
        moved = np.hstack(self.displacements(mu, u))
        return MeshFields(points.T.copy(), cells, {"u [m]": moved.T.copy()}, {"quad": {"contact pressure [Pa]": lam}})
