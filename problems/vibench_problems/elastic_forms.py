"""Forms of isotropic elasticity, component by component from scalar bases, and bubbles on the surface of hexahedra."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp
from skfem import Basis, BilinearForm, ElementHex1, MeshHex
from skfem.element import ElementH1
from skfem.refdom import RefHex

from vibench import Indices, SparseMatrix

AXES = range(3)

ORDER = 5
"""Order of the quadrature next to the contact zone, where integrands with bubbles are polynomials of that degree."""

Gradients = Sequence[Sequence[SparseMatrix]]
"""∫ ∂_a u ∂_b v of scalar functions, for a and then b."""


class ElementSurfaceBubble(ElementH1):  # type: ignore[misc]
    """The function 16 x (1 − x) y (1 − y) (1 − z) of the reference hexahedron: it vanishes on all sides but z = 0."""

    interior_dofs = 1
    maxdeg = 5
    dofnames = ("u",)
    doflocs = np.array([[0.5, 0.5, 0.0]])
    refdom = RefHex

    def lbasis(self, X, i):  # type: ignore[no-untyped-def]  # noqa: ARG002
        """Value and gradient of the function."""
        x, y, z = X
        along, across = 4.0 * x * (1.0 - x), 4.0 * y * (1.0 - y)
        slopes = [(4.0 - 8.0 * x) * across * (1.0 - z), along * (4.0 - 8.0 * y) * (1.0 - z), -along * across]
        return along * across * (1.0 - z), np.array(slopes)


def products_of_gradients(trial: Basis, test: Basis | None = None) -> Gradients:
    """∫ ∂_a u ∂_b v of functions u and v of scalar bases with the same points of quadrature.

    Nine forms of scalar functions are assembled an order of magnitude faster than one of displacements.
    """
    forms = [[BilinearForm(lambda u, v, _, a=a, b=b: u.grad[a] * v.grad[b]) for b in AXES] for a in AXES]
    pair = (trial,) if test is None else (trial, test)
    return [[sp.csr_array(form.assemble(*pair)) for form in row] for row in forms]


def dilatation(products: Gradients, i: int, j: int) -> SparseMatrix:
    """∫ tr ε(u) tr ε(v) for a displacement u along the axis i, tested with v along j."""
    return products[i][j]


def shearing(products: Gradients, i: int, j: int) -> SparseMatrix:
    """2 ∫ ε(u) : ε(v)."""
    return products[j][i] + gradients(products, i, j) if i == j else products[j][i]


def gradients(products: Gradients, i: int, j: int) -> SparseMatrix:
    """∫ ∇u : ∇v."""
    both = products[0][0] + products[1][1] + products[2][2]
    return both if i == j else sp.csr_array(both.shape)


def interior(mesh: MeshHex, below: Indices, restriction: SparseMatrix) -> list[SparseMatrix]:
    """The forms of Lamé's constants, ∫ tr ε(u) tr ε(v) and 2 ∫ ε(u) : ε(v), and ∫ ∇u : ∇v of a body of hexahedra.

    Parameters
    ----------
    mesh
        Its hexahedra.
    below
        Those with a bubble of the vertical displacement (k,).
    restriction
        Values in components x, y, z of nodes and in bubbles, of the unknowns ((3·nodes + k)×n).
    """
    nodal = products_of_gradients(Basis(mesh, ElementHex1()))
    bubbles = Basis(mesh, ElementSurfaceBubble(), elements=below, intorder=ORDER)
    beside = Basis(mesh, ElementHex1(), elements=below, intorder=ORDER)
    mixed = [[each[:, below] for each in row] for row in products_of_gradients(bubbles, beside)]
    own = [[each[below][:, below] for each in row] for row in products_of_gradients(bubbles)]

    def whole(form: Callable[[Gradients, int, int], SparseMatrix]) -> SparseMatrix:
        upper = [[*(form(nodal, i, j) for i in AXES), form(mixed, 2, j)] for j in AXES]
        last = [*(row[-1].T for row in upper), form(own, 2, 2)]
        T = restriction
        return sp.csr_array(T.T @ sp.csr_array(sp.block_array([*upper, last])) @ T)

    return [whole(form) for form in (dilatation, shearing, gradients)]
