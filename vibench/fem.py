"""Building blocks of problems with scikit-fem: Gram matrices, masses, unilateral constraints, Dirichlet data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
import scipy.sparse as sp
from skfem import Basis, BilinearForm, ElementVector, FacetBasis, LinearForm
from skfem.helpers import ddot, dot, grad

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.inner_product import InnerProduct

__all__ = ["Unilateral", "eliminate", "h1_gram", "lumped_mass", "mass", "normal_constraint", "unilateral"]

Sense = Literal["<=", ">="]
Integrals = Callable[[Callable[[Array], Array]], Array]  # of a function times those of a basis


def mass(basis: Basis) -> SparseMatrix:
    """Matrix of ∫ v·w (N×N) over the elements or facets of a scalar or vector basis."""
    form = BilinearForm(lambda u, v, _: dot(u, v) if _is_vector(basis) else u * v)
    return sp.csr_array(form.assemble(basis))


def lumped_mass(basis: Basis) -> Array:
    """Integrals ∫ φ_i (N,) over the elements or facets of a scalar basis: the row sums of its mass matrix."""
    return np.asarray(LinearForm(lambda v, _: v).assemble(basis))


def h1_gram(basis: Basis, free: Indices | None = None, length: float = 1.0) -> SparseMatrix:
    """Gram matrix of ‖v‖² = ∫ |v|² + ℓ² ∫ |∇v|² for a scalar or vector basis (paper, equation (44)).

    Parameters
    ----------
    basis, free
        The basis, with N functions, and the unknowns (n,) that are kept; by default all.
    length
        ℓ, in the unit of length of the mesh.
    """
    form = BilinearForm(lambda u, v, _: (ddot if _is_vector(basis) else dot)(grad(u), grad(v)))
    gram = sp.csr_array(mass(basis) + length**2 * sp.csr_array(form.assemble(basis)))
    return gram if free is None else sp.csr_array(gram[free][:, free])


@dataclass(frozen=True)
class Unilateral:
    """A constraint in weak form with nodal multipliers: ∫ c(u) η ≤ ∫ bound η for every nonnegative η, or with ≥.

    Here c(u) is a scalar field or a component of a displacement field. Signs are those of B u ≤ g: for ≥ both sides
    change theirs.

    Attributes
    ----------
    B
        Constraint (m×N) on all unknowns of the basis.
    W
        L² product of the multipliers (m×m), consistent or lumped.
    nodes
        Vertices (m,) of the mesh that carry a multiplier, rising.
    points
        Places of the nodes (dim×m).
    sense
        "<=" or ">=".
    """

    B: SparseMatrix
    W: InnerProduct
    nodes: Indices
    points: Array
    sense: Sense
    _integrals: Integrals | None = field(repr=False, default=None)

    def bound(self, values: Callable[[Array], Array] | Array) -> Array:
        """The vector g (m,) of a bound, which is a function of x (dim×…) or has values at `points` (m,).

        With a consistent mass a function is integrated by the quadrature of the basis; values are interpolated.
        """
        sign = 1.0 if self.sense == "<=" else -1.0
        if callable(values) and self._integrals is not None:
            return sign * self._integrals(values)
        at_points = np.broadcast_to(values(self.points) if callable(values) else values, self.W.dim)
        return sign * self.W.apply(np.asarray(at_points, float))


def unilateral(basis: Basis, sense: Sense, *, free: Indices | None = None, lumped: bool = True) -> Unilateral:
    """The constraint u ≤ bound or u ≥ bound of a scalar field, on a domain, a patch or a part of the boundary.

    Parameters
    ----------
    basis
        Scalar basis with one function per vertex, linear on edges (P1, Q1), over all elements, some
        (`basis.with_elements`), or facets (`FacetBasis`).
    sense
        "<=" or ">=".
    free
        Unknowns that are not prescribed; vertices with prescribed values carry no multiplier. By default all.
    lumped
        Whether the mass is lumped: the constraint is then imposed vertex by vertex, and X_W is diagonal.

    Raises
    ------
    NumericalError
        If the integral of a function is not positive, as with quadratic elements.
    """
    mesh, is_on_facets = basis.mesh, isinstance(basis, FacetBasis)
    table, chosen = (mesh.facets, basis.find) if is_on_facets else (mesh.t, basis.tind)
    vertices = np.unique(table if chosen is None else table[:, chosen]).astype(np.intp)
    if free is not None:
        vertices = vertices[np.isin(basis.nodal_dofs[0, vertices], free)]
    dofs, points = basis.nodal_dofs[0, vertices], mesh.p[:, vertices]
    sign = 1.0 if sense == "<=" else -1.0
    W, integrals = _multipliers(basis, dofs, lumped)
    places, shape = (np.arange(len(dofs)), dofs), (len(dofs), basis.N)
    rows = sp.csr_array((W.matrix.diagonal(), places), shape=shape) if lumped else mass(basis)[dofs]
    return Unilateral(sp.csr_array(sign * rows), W, vertices, points, sense, integrals)


def normal_constraint(
    basis: Basis, facets: Indices, *, direction: Array | None = None, free: Indices | None = None, lumped: bool = True
) -> Unilateral:
    """The constraint n·u ≤ gap of a displacement field on a part of the boundary, such as contact with a rigid body.

    Parameters
    ----------
    basis
        Vector basis with a function per vertex and component, such as `Basis(mesh, ElementVector(ElementTriP1()))`.
    facets
        Facets of the potential contact zone, as from `mesh.facets_satisfying`.
    direction
        Vector (dim,) in place of the outward normal n.
    free
        Unknowns that are not prescribed; a vertex carries a multiplier if one of its components in the constraint is
        free. By default all.
    lumped
        Whether multipliers act at single vertices: row i is ∫ φ_i n, applied to the displacement of vertex i.

    Raises
    ------
    NumericalError
        If the basis is scalar, or the integral of a function is not positive.
    """
    if not _is_vector(basis):
        raise NumericalError("normal displacements need a vector basis: Basis(mesh, ElementVector(element))")
    scalar = FacetBasis(basis.mesh, basis.elem.elem, facets=facets)
    vertices = np.unique(basis.mesh.facets[:, facets])
    B = sp.csr_array((len(vertices), basis.N))
    for k, unknowns in enumerate(basis.nodal_dofs):
        dofs = scalar.nodal_dofs[0, vertices]
        if direction is not None:
            part = float(direction[k]) * mass(scalar)
        else:
            part = sp.csr_array(BilinearForm(lambda u, v, w, k=k: w.n[k] * u * v).assemble(scalar))
        part = part[dofs][:, dofs]
        part = sp.diags_array(part.sum(axis=1)) if lumped else part
        places = (np.arange(len(vertices)), unknowns[vertices])
        B = B + part @ sp.csr_array((np.ones(len(vertices)), places), shape=B.shape)
    # Entries below round-off are components of a normal that vanish.
    B.data[np.abs(B.data) <= 1e-14 * np.max(np.abs(B.data), initial=0.0)] = 0.0
    B.eliminate_zeros()
    constrained = np.arange(len(vertices)) if free is None else np.flatnonzero(abs(B[:, free]).sum(axis=1) > 0.0)
    B, vertices = sp.csr_array(B[constrained]), vertices[constrained]
    W, integrals = _multipliers(scalar, scalar.nodal_dofs[0, vertices], lumped)
    return Unilateral(B, W, vertices, basis.mesh.p[:, vertices], "<=", integrals)


def eliminate(vi: VariationalInequality, free: Indices, dirichlet_lift: Array | None = None) -> VariationalInequality:
    """Restrict a variational inequality in all N unknowns to the free ones.

    Parameters
    ----------
    vi
        A (N×N), f (N,), B (m×N) and g (m,), without boundary conditions.
    free
        Unknowns (n,) that are not prescribed.
    dirichlet_lift
        Vector (N,) with the prescribed values, any values elsewhere; by default zero. The unknowns are those of
        u minus this lift: f − A·lift and g − B·lift take the place of f and g.
    """
    A, B, f, g = sp.csr_array(vi.A), sp.csr_array(vi.B), vi.f, vi.g
    if dirichlet_lift is not None:
        f, g = f - A @ dirichlet_lift, g - B @ dirichlet_lift
    return VariationalInequality(sp.csr_array(A[free][:, free]), f[free], sp.csr_array(B[:, free]), g, dirichlet_lift)


def _integrals(basis: Basis, dofs: Indices, values: Callable[[Array], Array]) -> Array:
    """Integrals ∫ bound η for chosen functions η of a scalar basis, by its quadrature."""
    return np.asarray(LinearForm(lambda v, w: values(np.asarray(w.x)) * v).assemble(basis))[dofs]


def _is_vector(basis: Basis) -> bool:
    return isinstance(basis.elem, ElementVector)


def _multipliers(basis: Basis, dofs: Indices, lumped: bool) -> tuple[InnerProduct, Integrals | None]:
    """The product of chosen functions of a scalar basis, lumped or consistent, and for the latter their integrals."""
    if not lumped:
        return InnerProduct(sp.csr_array(mass(basis)[dofs][:, dofs]), "X_W"), partial(_integrals, basis, dofs)
    integrals = lumped_mass(basis)
    weights = integrals[dofs]
    if np.min(weights, initial=np.inf) <= 1e-14 * np.max(integrals, initial=0.0):
        needed = "multipliers need nonnegative functions: linear or bilinear elements"
        raise NumericalError(f"a basis function has the integral {weights.min():.1e}; {needed}")
    return InnerProduct(sp.csr_array(sp.diags_array(weights)), "X_W"), None
