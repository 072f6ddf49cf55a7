"""The membrane obstacle problem of Niakh, Drouet, Ehrlacher and Ern (2022), §5.1."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Gt, Le
from skfem import Basis, BilinearForm, ElementTriP1, LinearForm
from skfem.helpers import dot

from vibench import (
    AffineSum,
    Array,
    Contact,
    Indices,
    InnerProduct,
    Mask,
    NestedStart,
    Output,
    ParameterBox,
    Picture,
    Problem,
    Sampler,
    VariationalInequality,
    fem,
)
from vibench_problems.disc_map import DiscMap
from vibench_problems.disc_mesh import aspect_ratios, disc_in_square, displaced_around_disc
from vibench_problems.p1_entries import LoadEntries, MovedMesh, StiffnessEntries, TriangleForms

RADIUS = 0.2
"""Radius of the reference disc ω̂ [m]."""

NODES = {"coarse": 400, "medium": 1200, "paper": 3594, "fine": 4 * 3594}
"""Number of nodes behind each named resolution, Dirichlet nodes included."""

NESTED = 10_000
"""From so many nodes on a first contact set comes from a coarser mesh, of a quarter of the nodes."""

WITH_BULGE = ParameterBox(
    names=("scale", "centre_x", "centre_y", "bulge"),
    lower=np.array([0.8, -0.05, -0.05, -0.3]),
    upper=np.array([1.2, 0.05, 0.05, 0.3]),
    units=("1", "m", "m", "1"),
)
"""The parameter box with the bulge as fourth parameter."""


@BilinearForm
def weighted_mass(u, v, w):  # type: ignore[no-untyped-def]
    """∫ ρ u v."""
    return w.density * u * v


@LinearForm
def weighted_paraboloid(v, w):  # type: ignore[no-untyped-def]
    """∫ ρ |x|² v."""
    return w.density * dot(w.x, w.x) * v


class Obstacle(Problem):
    """Membrane on a square above a parabolic obstacle on a disc that scales with mu_1 and moves with (mu_2, mu_3).

    P1 displacements, P1 multipliers. The reference mesh fits the disc ω̂; h(mu) scales and shifts ω̂ and is extended
    harmonically to the fixed outer boundary, so the physical mesh is the reference mesh with its nodes moved.
    The paper states mu_1 ∈ [0.8, 1.2] as the radius itself, in a square of side 1 m, which contradicts its node counts
    (467 of 3594 nodes in ω̂). They imply the reading used here: r = 0.2·mu_1, with ψ̂ independent of mu.

    The paper's map is affine on ω̂: B(mu) is mu_1² times one matrix, and all mu share one space of supremizers. With
    `bulge` there is a fourth parameter that deforms the disc into an egg shape (see `DiscMap`): B(mu) is a combination
    of three matrices, in proportions that vary with mu, and so do the supremizers.

    Parameters
    ----------
    resolution
        "coarse" (400 nodes), "medium" (1200), "paper" (3594), "fine" (four times "paper"), or a number of nodes; met
        to within 5 per cent ("coarse" and other small numbers: 10).
    length
        ℓ̂ [m] of the norm (44), ‖v‖² = ‖v‖²_L² + ℓ̂²‖∇v‖²_L².
    load
        Vertical load [1/m], negative downwards.
    obstacle
        Coefficient of the obstacle ψ̂ = obstacle·|x̂|² [1/m] on ω̂, which h(mu) transports: without a bulge
        ψ = obstacle·|x − c|²/mu_1².
    asymmetric
        Whether the nodes are displaced at random. The mesh and the training grid are symmetric otherwise, so that many
        steps of a greedy algorithm are ties between snapshots.
    ceiling
        Height [m] of a second obstacle over the first one, with which it moves: ψ ≤ u ≤ ψ + ceiling on ω̂, by two
        families of rows, B and −B. The membrane touches both for heights up to about 0.015. `None` for no ceiling.
    bulge
        Whether there is a fourth parameter, mu_4 ∈ [−0.3, 0.3]; on ω̂ lengths then vary by factors from 0.7 to 1.3.
        Aspect ratios stay below 4.7 at "paper" and 8.2 at "fine", against 3.2 and 4.6 without a bulge.
    """

    parameters = ParameterBox(
        names=("scale", "centre_x", "centre_y"),
        lower=np.array([0.8, -0.05, -0.05]),
        upper=np.array([1.2, 0.05, 0.05]),
        units=("1", "m", "m"),
    )

    entrywise: ClassVar[frozenset[str]] = frozenset({"A", "f"})
    elementwise: ClassVar[frozenset[str]] = frozenset({"A", "f"})

    def __init__(
        self,
        resolution: Literal["coarse", "medium", "paper", "fine"] | Annotated[int, Ge(150), Le(2_000_000)] = "paper",
        length: Annotated[float, Gt(0.0)] = 1.0,
        load: float = -1.0,
        obstacle: float = -1.25,
        bulge: bool = False,
        asymmetric: bool = False,
        ceiling: Annotated[float, Gt(0.0)] | None = None,
    ) -> None:
        nodes = NODES[resolution] if isinstance(resolution, str) else resolution
        self.load = load
        self.obstacle = obstacle
        self.bulge = bulge
        self.ceiling = ceiling
        self._options = length, load, obstacle, bulge, asymmetric, ceiling
        if bulge:
            self.parameters = WITH_BULGE
        self.mesh = disc_in_square(nodes, RADIUS)
        if asymmetric:
            self.mesh = displaced_around_disc(self.mesh, RADIUS)
        basis = Basis(self.mesh, ElementTriP1())
        self.free = basis.complement_dofs(basis.get_dofs())
        self.disc_nodes = np.flatnonzero(np.linalg.norm(self.mesh.p, axis=0) <= RADIUS * (1.0 + 1e-9))
        self._map = DiscMap(self.mesh, self.disc_nodes, RADIUS, bulge)
        self._moved = MovedMesh(self.mesh.t, self.free, self.nodes)
        self.V = InnerProduct(fem.h1_gram(basis, self.free, length))
        self._contact_dofs = np.searchsorted(self.free, self.disc_nodes)
        self._assemble_disc(basis.with_elements("disc"))

    def _assemble_disc(self, disc: Basis) -> None:
        """W, and B and g on ω̂ as sums over the monomials of the areas, the first of which is that of W.

        With a ceiling rows of u ≤ ψ + ceiling follow those of u ≥ ψ, with multipliers of their own.
        """
        nodes, areas = self.disc_nodes, self._map.areas(self.mesh.t[:, disc.tind])
        densities = [np.repeat(ratio[:, None], disc.dx.shape[1], axis=1) for ratio in areas]
        densities[0] = np.ones_like(densities[0])
        mass, sides = fem.mass(disc)[nodes][:, nodes], [-1.0] if self.ceiling is None else [-1.0, 1.0]
        self.W = InnerProduct(sp.block_diag([mass] * len(sides), format="csr"))
        masses = [weighted_mass.assemble(disc, density=rho)[nodes][:, nodes] for rho in densities]
        integrals = [weighted_paraboloid.assemble(disc, density=rho)[nodes] for rho in densities]
        thetas = self._monomials  # one object: queries evaluate it once for both sums
        on_disc = AffineSum(tuple(sp.csr_array(sp.vstack([side * term for side in sides])) for term in masses), thetas)
        bounds = [[-self.obstacle * term for term in integrals]]
        if self.ceiling is not None:
            # The integrals of the multiplier functions are sums of the rows of a mass matrix.
            lifts = [self.ceiling * np.asarray(term.sum(axis=1)).ravel() for term in masses]
            bounds.append([lift - floor for lift, floor in zip(lifts, bounds[0], strict=True)])
        g = AffineSum(tuple(np.concatenate(parts) for parts in zip(*bounds, strict=True)), thetas)
        unknowns = sp.csr_array((np.ones(len(nodes)), (np.arange(len(nodes)), self._contact_dofs)))
        unknowns.resize((len(nodes), len(self.free)))
        self._B_on_disc, self.affine = on_disc, {"B": on_disc.mapped(lambda term: term @ unknowns), "g": g}

    def _monomials(self, mu: Array) -> Array:
        """Coefficients θ(mu) (1,) or (3,) of B and g."""
        return self._map.monomials(self._map.weights(mu))

    @property
    def nodes(self) -> int:
        """Number of nodes of the mesh, Dirichlet nodes included; `V.dim` excludes them."""
        return int(self.mesh.p.shape[1])

    def training_set(self) -> Array:
        """The 5×5×5 grid; with a bulge the 4×4×4×5 grid, from which A is interpolated to 1e-5 at other parameters."""
        return self.parameters.grid(4, 4, 4, 5) if self.bulge else self.parameters.grid(5, 5, 5)

    def assemble(self, mu: Array) -> VariationalInequality:
        """Forms (37) to (40) on the mapped mesh; b = −∫ v η and g = −∫ ψ η, so that B u ≤ g states u ≥ ψ.

        The paper prints (40) without the minus signs, which would reverse the constraint.
        """
        stiffness, areas = self._moved.forms(self.points(mu))
        B, g = self.constraint(mu)
        return VariationalInequality(A=stiffness, f=self.load * areas, B=B, g=g)

    def start(self, mu: Array, nearest: Mask | None) -> Mask | NestedStart | None:  # noqa: ARG002
        """The contact set of the nearest parameter; without one, or by multigrid, on fine meshes, of a coarser mesh."""
        # With multigrid a set that moves across the mesh, row by row, costs more than the coarser meshes.
        return (self._on_coarser_mesh or nearest) if nearest is None or self.factorisation == "multigrid" else nearest

    @cached_property
    def _on_coarser_mesh(self) -> NestedStart | None:
        if self.nodes < NESTED:
            return None
        coarser = Obstacle(self.nodes // 4, *self._options)
        return NestedStart(coarser, coarser._rows(), self._rows())

    def _rows(self) -> Array:
        """Places (3×m) of the constraints; the third coordinate tells the ceiling from the obstacle."""
        disc = self.mesh.p[:, self.disc_nodes]
        sides = range(1 if self.ceiling is None else 2)
        return np.hstack([np.vstack([disc, np.full(disc.shape[1], float(side))]) for side in sides])

    @property
    def contact_dofs(self) -> Indices:
        """The nodes of the disc."""
        return self._contact_dofs

    def contact(self, mu: Array) -> Contact:
        """B and g on the disc; they depend on the parameter only through the areas of the triangles."""
        return Contact(self._B_on_disc.at(mu), self.affine["g"].at(mu))

    def sampler(self, wanted: Mapping[str, tuple[Indices, Indices]]) -> Sampler:
        """Entries of A and f from the triangles at their nodes."""
        evaluated: dict[str, Callable[[Array], Array]] = {}
        if "A" in wanted:
            rows, columns = (self.free[places] for places in wanted["A"])
            evaluated["A"] = StiffnessEntries(self._map.modes, self.mesh.t, rows, columns)
        if "f" in wanted:
            integrals = LoadEntries(self._map.modes, self.mesh.t, self.free[wanted["f"][0]])
            evaluated["f"] = lambda weights: self.load * integrals(weights)

        def sample(mu: Array) -> Mapping[str, Array]:
            weights = self._map.weights(mu)
            return {name: entries(weights) for name, entries in evaluated.items()}

        return sample

    @property
    def element_dofs(self) -> Indices:
        """The unknowns at the corners of the triangles."""
        number = np.full(self.nodes, -1)
        number[self.free] = np.arange(len(self.free))
        return np.asarray(number[self.mesh.t])

    def element_sampler(self, elements: Indices) -> Sampler:
        """A and f on triangles, of which only the corners are moved."""
        forms = TriangleForms(self._map.modes, self.mesh.t[:, elements])

        def sample(mu: Array) -> Mapping[str, Array]:
            stiffness, integrals = forms(self._map.weights(mu))
            return {"A": stiffness, "f": self.load * integrals}

        return sample

    def points(self, mu: Array) -> Array:
        """Nodes (2×nodes) of the mesh of Ω at mu: h(mu) of the reference nodes."""
        return self._map.points(mu)

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Force and area of the contact at mu, and deflections of three points outside the disc, which move with h(mu).

        The points are the nodes nearest to (0.35 m, 0), (−0.35 m, 0) and (0, −0.35 m) of the reference domain, half-way
        between the disc and the edge.
        """
        places = {"deflection": (0.35, 0.0), "left deflection": (-0.35, 0.0), "lower deflection": (0.0, -0.35)}
        return (
            Output("contact force", "m", function=lambda mu, _, lam: float(self._integrals(mu) @ self._pressure(lam))),
            Output(
                "contact area",
                "m²",
                function=lambda mu, _, lam: float(self._integrals(mu) @ (self._pressure(lam) != 0.0)),
            ),
            *(Output(name, "m", u=self._at(place)) for name, place in places.items()),
        )

    def _at(self, place: tuple[float, float]) -> Array:
        found = np.zeros(self.V.dim)
        found[np.linalg.norm(self.mesh.p[:, self.free] - np.array(place)[:, None], axis=0).argmin()] = 1.0
        return found

    def _integrals(self, mu: Array) -> Array:
        """Integrals (nodes of the disc,) of the multiplier functions over the disc at mu."""
        return -np.asarray(self.contact(mu).B.sum(axis=1)).ravel()[: len(self.disc_nodes)]

    def _pressure(self, lam: Array) -> Array:
        """The pressure (nodes of the disc,) of the obstacle upwards, less that of the ceiling downwards."""
        return lam if self.ceiling is None else lam[: len(self.disc_nodes)] - lam[len(self.disc_nodes) :]

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:
        """The membrane's deflection on the mapped mesh and the contact pressure on the disc (paper, Figure 4)."""
        deflection = np.zeros(self.nodes)
        deflection[self.free] = u
        points = self.points(mu)
        disc = points[:, self.disc_nodes]
        pressure = self._pressure(lam)
        return Picture(points, self.mesh.t, deflection, "deflection u [m]", disc, pressure, "multiplier λ [1/m]", "m")

    def diagnostics(self, mu: Array) -> Mapping[str, float]:
        """Largest aspect ratio of the mapped mesh (paper, Figure 3; 1 for equilateral triangles)."""
        return {"aspect_ratio": float(aspect_ratios(self.points(mu), self.mesh.t).max())}
