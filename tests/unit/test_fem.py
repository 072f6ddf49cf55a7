from functools import partial

import numpy as np
import pytest
from skfem import Basis, ElementHex1, ElementTriP1, ElementTriP2, ElementVector, FacetBasis, MeshHex, MeshTri
from skfem.models.elasticity import linear_elasticity
from skfem.models.poisson import laplace, unit_load

from vibench import AffineProblem, Array, HighFidelitySolver, InnerProduct, NumericalError, ParameterBox, fem
from vibench.interfaces.problem import VariationalInequality
from vibench.testing import check

MESH = MeshTri.init_tensor(np.linspace(0.0, 2.0, 7), np.linspace(0.0, 1.0, 4)).with_boundaries(
    {"top": lambda x: x[1] == 1.0, "left": lambda x: x[0] == 0.0}
)


def test_the_h1_norm_of_polynomials() -> None:
    scalar, vector = Basis(MESH, ElementTriP1()), Basis(MESH, ElementVector(ElementTriP1()))
    x = MESH.p[0]
    # On [0, 2]×[0, 1] the square of x has the integral 8/3, that of its gradient 2.
    assert x @ fem.h1_gram(scalar, length=3.0) @ x == pytest.approx(8.0 / 3.0 + 9.0 * 2.0)
    field = np.zeros(vector.N)
    field[vector.nodal_dofs[0]], field[vector.nodal_dofs[1]] = x, 1.0
    assert field @ fem.h1_gram(vector, length=3.0) @ field == pytest.approx(8.0 / 3.0 + 2.0 + 9.0 * 2.0)
    free = scalar.complement_dofs(scalar.get_dofs("left"))
    assert np.array_equal(fem.h1_gram(scalar, free).toarray(), fem.h1_gram(scalar).toarray()[np.ix_(free, free)])


def test_masses_and_loads_of_a_domain_a_patch_and_a_part_of_the_boundary() -> None:
    whole = Basis(MESH, ElementTriP1())
    patch = whole.with_elements(MESH.elements_satisfying(lambda x: x[0] < 1.0))
    top = FacetBasis(MESH, ElementTriP1(), facets="top")
    for basis, measure in ((whole, 2.0), (patch, 1.0), (top, 2.0)):
        assert fem.lumped_mass(basis).sum() == pytest.approx(measure)
        assert np.allclose(fem.mass(basis).sum(axis=1), fem.lumped_mass(basis))
    basis = Basis(MESH, ElementTriP1())
    assert np.allclose(fem.lumped_mass(basis), unit_load.assemble(basis))


@pytest.mark.parametrize("sense", ["<=", ">="])
@pytest.mark.parametrize("lumped", [True, False])
def test_a_field_is_constrained_vertex_by_vertex_or_in_the_mean(sense: fem.Sense, lumped: bool) -> None:
    basis = Basis(MESH, ElementTriP1(), intorder=4)
    patch = basis.with_elements(MESH.elements_satisfying(lambda x: x[0] < 1.0))
    patch = Basis(MESH, ElementTriP1(), elements=patch.tind, intorder=4)
    free = basis.complement_dofs(basis.get_dofs("left"))
    found = fem.unilateral(patch, sense, free=free, lumped=lumped)
    assert np.array_equal(found.nodes, np.flatnonzero((MESH.p[0] > 0.0) & (MESH.p[0] <= 1.0)))
    assert np.array_equal(found.points, MESH.p[:, found.nodes])
    assert found.B.shape == (len(found.nodes), basis.N)
    sign = 1.0 if sense == "<=" else -1.0
    # A field is at its own bound: B u = g, exactly for linear functions.
    linear = lambda x: 0.3 + x[0] - 2.0 * x[1]  # noqa: E731
    assert np.allclose(found.B @ linear(MESH.p), found.bound(linear), atol=1e-15)
    if lumped:
        assert np.allclose(found.bound(np.ones(len(found.nodes))), sign * fem.lumped_mass(patch)[found.nodes])
        assert np.allclose(found.W.matrix.diagonal(), fem.lumped_mass(patch)[found.nodes])
    else:
        assert np.allclose(found.W.matrix.toarray(), fem.mass(patch)[found.nodes][:, found.nodes].toarray())
        square = found.bound(lambda x: x[0] ** 2)  # by quadrature, and not of the interpolant
        interior = found.nodes == np.flatnonzero(np.all(np.isclose(MESH.p.T, [2.0 / 3.0, 1.0 / 3.0]), axis=1))[0]
        h = 1.0 / 3.0  # ∫ x² φ = |ω_φ|/3 · (x_i² + h²/6) for a hat on this mesh
        assert square[interior] == pytest.approx(sign * h**2 * ((2.0 / 3.0) ** 2 + h**2 / 6.0))


def test_constraints_without_vertices_of_their_own_carry_no_multiplier() -> None:
    top = FacetBasis(MESH, ElementTriP1(), facets="top")
    inner = np.flatnonzero((MESH.p[0] > 0.1) & (MESH.p[0] < 1.9))
    found = fem.unilateral(top, "<=", free=inner)
    assert np.all(found.points[1] == 1.0)
    assert np.allclose(found.W.matrix.diagonal(), 1.0 / 3.0)
    basis = Basis(MESH, ElementVector(ElementTriP1()))
    top = MESH.boundaries["top"]
    fixed_vertically = basis.nodal_dofs[1, MESH.p[0] < 0.5]
    free = np.setdiff1d(np.arange(basis.N), fixed_vertically)
    found = fem.normal_constraint(basis, top, free=free)
    assert np.all(found.points[0] > 0.5)
    assert len(found.nodes) == 5
    with pytest.raises(NumericalError, match="linear or bilinear elements"):
        fem.unilateral(Basis(MESH, ElementTriP2()), "<=")
    with pytest.raises(NumericalError, match="ElementVector"):
        fem.normal_constraint(Basis(MESH, ElementTriP1()), MESH.boundaries["top"])


@pytest.mark.parametrize("lumped", [True, False])
def test_normal_displacements_of_a_rigid_motion(lumped: bool) -> None:
    basis = Basis(MESH, ElementVector(ElementTriP1()))
    facets = MESH.facets_satisfying(lambda x: (x[1] == 1.0) | (x[0] == 2.0))
    found = fem.normal_constraint(basis, facets, lumped=lumped)
    motion = np.zeros(basis.N)
    motion[basis.nodal_dofs[0]], motion[basis.nodal_dofs[1]] = 0.2, 0.5
    pressed = found.B @ motion
    assert pressed.sum() == pytest.approx(0.5 * 2.0 + 0.2 * 1.0)  # ∫ n·u over the top and the right side
    corner = np.all(found.points.T == [2.0, 1.0], axis=1)
    assert pressed[corner] == pytest.approx(0.5 / 6.0 + 0.2 / 6.0)
    along = fem.normal_constraint(basis, facets, direction=np.array([0.0, 1.0]), lumped=lumped)
    assert (along.B @ motion).sum() == pytest.approx(0.5 * 3.0)
    assert np.allclose(along.bound(np.ones(len(along.nodes))).sum(), 3.0)


class Patch(AffineProblem):
    """A membrane with the boundary values slope·x + offset above a low obstacle: u is linear."""

    parameters = ParameterBox(("slope", "offset", "tension"), np.array([-1.0, 0.0, 1.0]), np.ones(3) * 2.0, ("1",) * 3)

    def __init__(self, depth: float = 9.0, lumped: bool = True) -> None:
        self.basis = Basis(MESH, ElementTriP1())
        self.free = self.basis.complement_dofs(self.basis.get_dofs())
        contact = fem.unilateral(self.basis, ">=", free=self.free, lumped=lumped)
        self.V, self.W = InnerProduct(fem.h1_gram(self.basis, self.free)), contact.W
        self.full = laplace.assemble(self.basis), contact.B, contact.bound(np.full(len(contact.nodes), -depth))
        stiffness, B, g = self.full
        lift = [("slope", self.edge(MESH.p[0])), ("offset", self.edge(np.ones(self.basis.N)))]
        f = np.zeros(self.basis.N)
        self.declare(A=[("tension", stiffness)], f=f, B=B, g=g, free=self.free, dirichlet_lift=lift)

    def edge(self, values: Array) -> Array:
        return np.where(np.isin(np.arange(self.basis.N), self.free), 0.0, values)

    def training_set(self) -> Array:
        return self.parameters.grid(2, 2, 2)


@pytest.mark.parametrize("lumped", [True, False])  # functions of a consistent mass reach prescribed values
@pytest.mark.parametrize("mu", [[1.5, 0.25, 1.2], [-0.5, 1.0, 2.0]])
def test_dirichlet_data_that_depend_on_the_parameter_are_lifted(mu: list[float], lumped: bool) -> None:
    problem, at = Patch(lumped=lumped), np.array(mu)
    vi = problem.assemble(at)
    solution = HighFidelitySolver(problem).solve(at)
    whole = np.zeros(problem.basis.N)
    whole[problem.free] = solution.u
    assert np.allclose(whole + vi.dirichlet_lift, mu[0] * MESH.p[0] + mu[1], atol=1e-13)
    stiffness, B, g = problem.full
    full = VariationalInequality(mu[2] * stiffness, np.zeros(problem.basis.N), B, g)
    by_hand = fem.eliminate(full, problem.free, vi.dirichlet_lift)
    for name in ("f", "g"):
        assert np.allclose(getattr(vi, name), getattr(by_hand, name), rtol=1e-13, atol=1e-14)
    assert abs(vi.A - by_hand.A).max() <= 1e-14
    assert abs(vi.B - by_hand.B).max() == 0.0


def test_lifted_problems_pass_the_checks_and_keep_their_constants() -> None:
    check(partial(Patch, depth=0.2))
    problem = Patch()
    stiffness, B, g = problem.full
    ones, lift = np.ones(problem.basis.N), problem.edge(MESH.p[0])
    problem.declare(A=stiffness, f=ones, B=B, g=g, free=problem.free, dirichlet_lift=lift)
    assert problem.constant == {"A", "f", "B", "g"}
    assert np.allclose(problem.assemble(np.ones(3)).f, (ones - stiffness @ lift)[problem.free])


def test_contact_of_a_block_is_uniform_compression() -> None:
    """Of a cube of ν = 0, pressed by a rigid plane and free to slide."""
    mesh = MeshHex.init_tensor(*[np.linspace(0.0, 1.0, 3)] * 3)
    basis = Basis(mesh, ElementVector(ElementHex1()))
    fixed = np.concatenate([basis.nodal_dofs[k, mesh.p[k] == 0.0] for k in range(3)])
    free = np.setdiff1d(np.arange(basis.N), fixed)
    contact = fem.normal_constraint(basis, mesh.facets_satisfying(lambda x: x[2] == 1.0), free=free)
    stiffness = linear_elasticity(0.0, 0.5).assemble(basis)  # E = 1
    full = VariationalInequality(stiffness, np.zeros(basis.N), contact.B, contact.bound(np.full(9, -0.1)))

    class Cube(AffineProblem):
        parameters = ParameterBox(("depth",), np.array([0.05]), np.array([0.2]), ("m",))

        def __init__(self) -> None:
            self.V, self.W = InnerProduct(fem.h1_gram(basis, free)), contact.W
            g = [("-depth", contact.bound(np.ones(9)))]
            self.declare(A=stiffness, f=np.zeros(basis.N), B=contact.B, g=g, free=free)

        def training_set(self) -> Array:
            return self.parameters.grid(3)

    solution = HighFidelitySolver(Cube()).solve(np.array([0.1]))
    assert np.allclose(solution.lam, 0.1)  # pressure E·ε
    exact = np.zeros(basis.N)
    exact[basis.nodal_dofs[2]] = -0.1 * mesh.p[2]
    assert np.allclose(solution.u, exact[free], atol=1e-13)
    assert np.allclose(fem.eliminate(full, free).B.toarray(), Cube().assemble(np.array([0.1])).B.toarray())
