"""Hertz contact in three dimensions: an elastic half-space pressed by a rigid elliptic paraboloid, or two spheres."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Gt, Le
from skfem import BilinearForm, ElementHex0, ElementHex1, FacetBasis

from vibench import AffineProblem, Array, InnerProduct, MeshFields, ParameterBox, Picture, RequestError, SparseMatrix
from vibench_problems.contact_zone import ContactZone
from vibench_problems.cube_shells import graded_block, hexahedra, quads
from vibench_problems.elastic_forms import AXES, ORDER, ElementSurfaceBubble, interior
from vibench_problems.elliptic_contact import EllipticContact, elliptic_contact
from vibench_problems.far_field import FarField
from vibench_problems.two_spheres import TwoSpheres

CELLS = {"coarse": 6, "medium": 10, "paper": 14, "fine": 21}
"""Cells along the potential contact zone behind each named resolution: 5, 22, 58 and 194 thousand unknowns."""

UNKNOWNS_PER_CELL = 21.0
"""Unknowns divided by the cube of the number of cells, at large ones."""

WIDTH = 0.06
"""Edge [m] of the potential contact zone of the quarter."""

LARGEST = 0.0464
"""Largest semi-axis [m] of the contact in the parameter box."""

OPTIONS_OF = {"paraboloid": ("far", "distance"), "sphere": ("extent",)}
"""Options that have a meaning with one obstacle only."""

PICTURED = 2.5
"""Edge of the square that a picture shows, relative to that of the potential contact zone."""


class Hertz3D(ContactZone, AffineProblem):
    """A half-space z ≤ 0 pressed by the paraboloid z = x²/(2 R_x) + y²/(2 R_y) − δ; mu = (R_x, R_y, δ, ν).

    Rigid and frictionless, small strains. A point of the surface that moves by u is outside the paraboloid if, to
    first order in u, u·n ≤ x²/(2 R_x) + y²/(2 R_y) − δ with its normal n = (−x/R_x, −y/R_y, 1), whose vertical
    component is one: λ is the vertical contact pressure. So B and g are affine in 1/R_x, 1/R_y and δ, and A is in
    Lamé's constants. The closed form (`theory`) has vertical normals: at these parameters its force is smaller by
    a share of (1 − 2ν)/(π(1 − ν)) a/R, up to 1 %.

    Of the block one quarter is meshed. Q1 displacements on hexahedra; on each surface facet of the zone a constant
    multiplier and, for its sake, a bubble of the vertical displacement: without bubbles the pressure oscillates by
    15 %. Contact is that of gaps integrated over facets.

    Parameters
    ----------
    resolution
        "coarse" (5 thousand unknowns), "medium" (22), "paper" (58), "fine" (194), or a number of unknowns.
    far
        What is outside the block: "boussinesq", the half-space, where displacements are in the span of two fields whose
        amplitudes are unknowns (`far_field`); or "clamped", nothing moves, which adds about 0.9 a/L to the force.
    distance
        L, edge of the block, divided by the largest semi-axis a of the contact in the parameter box.
    growth
        Ratio of the sizes of successive layers at "medium", outside the cube below the potential contact zone. Other
        resolutions have layers in proportion to their cells.
    young
        E [Pa].
    obstacle
        "paraboloid", the rigid one; or "sphere", elastic: `TwoSpheres`, with its parameters (R, δ, ν), of which
        `resolution`, `growth`, `young` and `extent` are options and the others above are not.
    extent
        Semi-axis [m] of the largest contact of two spheres of the radius 1 m.
    """

    parameters = ParameterBox(
        names=("radius_x", "radius_y", "approach", "poisson"),
        lower=np.array([0.7, 0.7, 0.001, 0.2]),
        upper=np.array([1.3, 1.3, 0.0015, 0.4]),
        units=("m", "m", "m", "1"),
    )

    def __new__(cls, *arguments: Any, **options: Any) -> Any:
        """A problem of this class; or, with a sphere, one of `TwoSpheres`, whose parameters and members are others.

        Raises
        ------
        RequestError
            If an option is given that the obstacle does not have.
        """
        obstacle = options.pop("obstacle", "paraboloid")
        for name in OPTIONS_OF["sphere" if obstacle == "paraboloid" else "paraboloid"]:
            if name in options:
                own = " and ".join(f"'{each}'" for each in OPTIONS_OF[obstacle])
                raise RequestError(f"obstacle = '{obstacle}' has no option '{name}'; beside those of both it has {own}")
        return super().__new__(cls) if obstacle == "paraboloid" else TwoSpheres(*arguments, **options)

    def __init__(
        self,
        resolution: Literal["coarse", "medium", "paper", "fine"] | Annotated[int, Ge(1000), Le(2_000_000)] = "medium",
        far: Literal["boussinesq", "clamped"] = "boussinesq",
        distance: Annotated[float, Ge(5.0), Le(1000.0)] = 20.0,
        growth: Annotated[float, Gt(1.0), Le(2.0)] = 1.15,
        young: Annotated[float, Gt(0.0)] = 1.0,
        obstacle: Literal["paraboloid", "sphere"] = "paraboloid",  # noqa: ARG002  `__new__` reads it
        extent: Annotated[float, Ge(0.001), Le(0.2)] = 0.2,  # noqa: ARG002
    ) -> None:
        number = CELLS[resolution] if isinstance(resolution, str) else (resolution / UNKNOWNS_PER_CELL) ** (1.0 / 3.0)
        cells = round(number)
        self.young, length = young, distance * LARGEST
        layers = round(np.log(length / WIDTH) / np.log(growth) * cells / CELLS["medium"])
        self.block = graded_block(cells, layers, WIDTH, length)
        self._facets = FacetBasis(self.block.mesh, ElementHex1(), facets=self.block.zone, intorder=ORDER)
        # Facets of the zone and the hexahedra below them have one order, that of rows of B and of bubbles.
        self._below = np.asarray(self.block.mesh.f2t[0, self.block.zone])
        self.areas = self._integrals(lambda x: np.ones_like(x[0]))
        self.squares = np.stack([self._integrals(lambda x: x[0] ** 2), self._integrals(lambda x: x[1] ** 2)])
        self.middles = np.stack([self._integrals(lambda x: x[0]), self._integrals(lambda x: x[1])]) / self.areas
        outside = self._restrict(far)
        lame, shear, gram = interior(self.block.mesh, self._below, self._restriction)
        if outside is not None:
            n = self._restriction.shape[1]
            parts = (outside.divergences, outside.strains, outside.gradients)
            lame, shear, gram = (
                sp.csr_array(inner + sp.block_diag([sp.csr_array((n - 2, n - 2)), outer]))
                for inner, outer in zip((lame, shear, gram), parts, strict=True)
            )
        self.V, self.W = InnerProduct(gram), InnerProduct(sp.diags_array(self.areas))
        x, y = self.squares
        self.declare(
            A=[
                (f"{young!r} * poisson / ((1 + poisson) * (1 - 2 * poisson))", lame),
                (f"{0.5 * young!r} / (1 + poisson)", shear),
            ],
            f=np.zeros(self.V.dim),
            B=[
                (1.0, self._coupling(2, lambda x: np.ones_like(x[0]))),
                ("-1 / radius_x", self._coupling(0, lambda x: x[0])),
                ("-1 / radius_y", self._coupling(1, lambda x: x[1])),
            ],
            g=[("0.5 / radius_x", x), ("0.5 / radius_y", y), ("-approach", self.areas)],
        )

    def _restrict(self, far: str) -> FarField | None:
        """Set the columns of the unknowns in components x, y, z of nodes and in bubbles; returns the field outside."""
        mesh, block = self.block.mesh, self.block
        nodes, bubbles = mesh.p.shape[1], len(block.zone)
        fixed = [np.flatnonzero(mesh.p[axis] == 0.0) + axis * nodes for axis in (0, 1)]
        fixed += [block.far + axis * nodes for axis in AXES]
        self._everywhere = 3 * nodes + bubbles
        free = np.setdiff1d(np.arange(self._everywhere), np.concatenate(fixed))
        chosen = sp.csc_array((np.ones(len(free)), (free, np.arange(len(free)))), shape=(self._everywhere, len(free)))
        self._restriction: SparseMatrix = chosen
        self._outside = 0 if far == "clamped" else 2
        if far == "clamped":
            return None
        outside = FarField.around(mesh, block.sides, block.far, block.length)
        columns = np.zeros((self._everywhere, 2))
        for axis in AXES:
            columns[axis * nodes + block.far] = outside.values[:, axis].T
        self._restriction = sp.csc_array(sp.hstack([chosen, sp.csc_array(columns)]))
        return outside

    def _coupling(self, axis: int, weight: Callable[[Array], Array]) -> SparseMatrix:
        """∫ weight u_axis η over the facets of the zone (m×n)."""
        product = BilinearForm(lambda u, v, w: weight(w.x) * u * v)
        patches = self._facets.with_element(ElementHex0())
        rows = patches.element_dofs[0]
        nodal = sp.csr_array(product.assemble(self._facets, patches))[rows]
        bubbles = sp.csr_array(product.assemble(self._facets.with_element(ElementSurfaceBubble()), patches))[rows]
        nodes = nodal.shape[1]
        blocks = [nodal if axis == k else sp.csr_array((len(rows), nodes)) for k in AXES]
        blocks.append(bubbles[:, self._below] if axis == 2 else sp.csr_array((len(rows), len(rows))))
        return sp.csr_array(sp.csr_array(sp.hstack(blocks)) @ self._restriction)

    def _integrals(self, function: Callable[[Array], Array]) -> Array:
        """∫ of a function of x over the facets of the zone (m,)."""
        return np.asarray(np.sum(function(np.asarray(self._facets.global_coordinates())) * self._facets.dx, axis=1))

    def training_set(self) -> Array:
        """The 3×3×4×3 grid."""
        return self.parameters.grid(3, 3, 4, 3)

    def theory(self, mu: Array) -> EllipticContact:
        """Hertz's elliptic contact at mu."""
        return elliptic_contact(float(mu[0]), float(mu[1]), float(mu[2]), self.young / (1.0 - float(mu[3]) ** 2))

    def displacement(self, u: Array) -> Array:
        """Displacements (3×nodes) of the nodes, of u (n,)."""
        return np.asarray((self._restriction @ u)[: 3 * self.block.mesh.p.shape[1]].reshape(3, -1))

    def amplitudes(self, u: Array) -> Array:
        """Amplitudes (2,) [m] of the two fields outside the block, the last unknowns; none where it is clamped."""
        return u[self._restriction.shape[1] - self._outside :]

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:  # noqa: ARG002
        """The pressed surface from above, coloured by its vertical displacement, and the contact pressure."""
        nodes, triangles = self.block.surface(PICTURED * WIDTH)
        settled = self.displacement(u)[2, nodes]
        return Picture(
            self.block.mesh.p[:2, nodes], triangles, settled, "vertical displacement [m]", self.middles, lam,
            "contact pressure [Pa]", "m",
        )  # fmt: skip

    def mesh_fields(self, mu: Array, u: Array, lam: Array) -> MeshFields:  # noqa: ARG002
        """Displacements of the block's nodes, without bubbles, and the contact pressure on facets of the zone."""
        mesh = self.block.mesh
        cells = {"hexahedron": hexahedra(mesh), "quad": quads(mesh, self.block.zone)}
        fields = {"u [m]": self.displacement(u).T.copy()}
        return MeshFields(mesh.p.T.copy(), cells, fields, {"quad": {"contact pressure [Pa]": lam}})
