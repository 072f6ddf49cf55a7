"""Problems of another nature than the built-in ones: plastic torsion, a thermal block, membranes, a put, a block."""

from typing import Annotated

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Le
from skfem import Basis, ElementHex1, ElementTriP1, ElementVector, MeshHex, MeshTri
from skfem.models.elasticity import linear_elasticity
from skfem.models.poisson import laplace

from vibench import AffineProblem, Array, InnerProduct, ParameterBox, Problem, VariationalInequality, fem


def nodal(entries: Array) -> sp.csr_array:
    return sp.csr_array(sp.diags_array(entries))


class Torsion(AffineProblem):
    """Elastic–plastic torsion of a square bar: −Δu = twist where |∇u| < 1, as the obstacle problem u ≤ dist(x, ∂Ω).

    The obstacle problem is equivalent (Brezis and Sibony 1971). The bar yields first in the middle of its sides, at a
    twist of about 3; below it no constraint is active and λ = 0. P1 on a square mesh, lumped multipliers at its nodes.
    """

    parameters = ParameterBox(("twist",), np.array([1.0]), np.array([8.0]), ("1/m",))

    def __init__(self, cells: Annotated[int, Ge(4), Le(64)] = 12) -> None:
        ticks = np.linspace(0.0, 1.0, cells + 1)
        basis = Basis(MeshTri.init_tensor(ticks, ticks), ElementTriP1())
        free = basis.complement_dofs(basis.get_dofs())
        contact = fem.unilateral(basis, "<=", free=free)
        distance = np.minimum(contact.points, 1.0 - contact.points).min(axis=0)
        self.V, self.W = InnerProduct(fem.h1_gram(basis, free)), contact.W
        load = [("twist", fem.lumped_mass(basis))]
        self.declare(A=laplace.assemble(basis), f=load, B=contact.B, g=contact.bound(distance), free=free)

    def training_set(self) -> Array:
        return self.parameters.grid(15)


class ThermalBlock(AffineProblem):
    """A membrane below an obstacle, of square patches with their own stiffness: a parameter and a term of A for each.

    P1 on a square mesh whose lines are those of the patches, lumped multipliers at its nodes.
    """

    def __init__(self, patches: Annotated[int, Ge(1), Le(4)] = 3, cells: Annotated[int, Ge(2), Le(64)] = 18) -> None:
        names = tuple(f"k{i}{j}" for i in range(patches) for j in range(patches))
        self.parameters = ParameterBox(names, np.full(len(names), 0.1), np.ones(len(names)), ("1",) * len(names))
        ticks = np.linspace(0.0, 1.0, cells + 1)
        mesh = MeshTri.init_tensor(ticks, ticks)
        whole = Basis(mesh, ElementTriP1())
        free = whole.complement_dofs(whole.get_dofs())
        number = (np.floor(patches * mesh.p[:, mesh.t].mean(axis=1)).T @ [patches, 1]).astype(int)
        parts = [Basis(mesh, ElementTriP1(), elements=np.flatnonzero(number == k)) for k in range(len(names))]
        contact = fem.unilateral(whole, "<=", free=free)
        self.V, self.W = InnerProduct(fem.h1_gram(whole, free)), contact.W
        self.declare(
            A=[(name, laplace.assemble(part)) for name, part in zip(names, parts, strict=True)],
            f=fem.lumped_mass(whole), B=contact.B, g=contact.bound(0.07), free=free,
        )  # fmt: skip

    def training_set(self) -> Array:
        return self.parameters.sample(60, 3)


class Covered(AffineProblem):
    """A membrane that an inflated cushion presses on an obstacle nearly everywhere; its tension and the load vary.

    Where the load is large all nodes but those next to the edge are in contact.
    """

    parameters = ParameterBox(("tension", "load", "slope"), np.array([0.5, 20, -1]), np.array([2, 80, 1.0]), ("1",) * 3)

    def __init__(self, cells: Annotated[int, Ge(2), Le(64)] = 16) -> None:
        ticks = np.linspace(0.0, 1.0, cells + 1)
        basis = Basis(MeshTri.init_tensor(ticks, ticks), ElementTriP1())
        free = basis.complement_dofs(basis.get_dofs())
        contact = fem.unilateral(basis, "<=", free=free)
        self.V, self.W = InnerProduct(fem.h1_gram(basis, free)), contact.W
        weights, x = fem.lumped_mass(basis), basis.mesh.p[0]
        self.declare(
            A=[("tension", laplace.assemble(basis)), (1.0, fem.mass(basis))],
            f=[("load", weights), ("load * slope / 2", weights * (x - 0.5))],
            B=contact.B, g=contact.bound(0.02 + 0.02 * contact.points[0]), free=free,
        )  # fmt: skip

    def training_set(self) -> Array:
        return self.parameters.grid(4, 4, 3)


class Put(Problem):
    """The perpetual American put with strike 1, as an obstacle problem in x = ln S.

    The Black–Scholes operator with volatility σ and rate r becomes symmetric for w = e^{κx} V, κ = r/σ² − ½:

        −½σ² w″ + (r + ½σ²κ²) w ≥ 0,    w ≥ e^{κx} (1 − eˣ)₊,    one of them an equality.

    P1 elements on [−1, 5] with the payoff as Dirichlet data, lumped multipliers at all free nodes.
    """

    parameters = ParameterBox(
        ("volatility", "rate"), np.array([0.25, 0.05]), np.array([0.35, 0.08]), ("a^(-1/2)", "1/a")
    )
    left, right = -1.0, 5.0

    def __init__(self, cells: Annotated[int, Ge(20), Le(2000)] = 120) -> None:
        self.x = np.linspace(self.left, self.right, cells + 1)
        step, ones = self.x[1] - self.x[0], np.ones(cells)
        diagonal = np.concatenate([[1.0], 2.0 * ones[1:], [1.0]])
        self._K = sp.csr_array(sp.diags_array([diagonal, -ones, -ones], offsets=[0, 1, -1])) / step
        self._M = sp.csr_array(sp.diags_array([2.0 * diagonal, ones, ones], offsets=[0, 1, -1])) * (step / 6.0)
        self._weights = np.full(cells - 1, step)
        self.V = InnerProduct((self._K + self._M)[1:-1, 1:-1])
        self.W = InnerProduct(nodal(self._weights))

    def training_set(self) -> Array:
        return self.parameters.grid(5, 4)

    def assemble(self, mu: Array) -> VariationalInequality:
        half, kappa = 0.5 * mu[0] ** 2, mu[1] / mu[0] ** 2 - 0.5
        A = half * self._K + (mu[1] + half * kappa**2) * self._M
        payoff = np.exp(kappa * self.x) * np.maximum(1.0 - np.exp(self.x), 0.0)
        lift = np.where(np.arange(len(self.x)) == 0, payoff, 0.0)
        f, inner = -(A @ lift)[1:-1], slice(1, -1)
        return VariationalInequality(A[inner, inner], f, -nodal(self._weights), -self._weights * payoff[inner], lift)


class Block(AffineProblem):
    """A linearly elastic cube, clamped below, into which a rigid paraboloid is pressed: no load, g drives it alone.

    The parameters are the depth of the indentation and the place of the apex. Trilinear
    hexahedra, lumped multipliers at the nodes of the top: the force per area that keeps u_z ≤ gap − depth.
    """

    def __init__(self, cells: Annotated[int, Ge(2), Le(12)] = 4, modulus: float = 1.0, size: float = 1.0) -> None:
        lower, upper = size * np.array([0.01, 0.4]), size * np.array([0.06, 0.6])
        self.parameters = ParameterBox(("depth", "place"), lower, upper, ("m", "m"))
        ticks = np.linspace(0.0, size, cells + 1)
        basis = Basis(MeshHex.init_tensor(ticks, ticks, ticks), ElementVector(ElementHex1()))
        free = basis.complement_dofs(basis.get_dofs(lambda x: x[2] < 1e-6 * size))
        top = basis.mesh.facets_satisfying(lambda x: x[2] > (1.0 - 1e-6) * size)
        contact = fem.normal_constraint(basis, top, free=free)
        elasticity = linear_elasticity(modulus * 0.3 / (1.3 * 0.4), modulus / 2.6)  # ν = 0.3
        self.V, self.W = InnerProduct(fem.h1_gram(basis, free, size)), contact.W
        x, y = contact.points[:2]
        # The gap below the paraboloid, ((x − place)² + (y − size/2)²)/(2 size) − depth, in powers of the place.
        gap = (x**2 + (y - 0.5 * size) ** 2) / (2.0 * size)
        g = [(1.0, gap), ("place", -x / size), ("place**2", np.full_like(x, 0.5 / size)), ("-depth", np.ones_like(x))]
        self.declare(
            A=elasticity.assemble(basis), f=np.zeros(basis.N), B=contact.B,
            g=[(theta, contact.bound(values)) for theta, values in g], free=free,
        )  # fmt: skip

    def training_set(self) -> Array:
        return self.parameters.grid(6, 3)
