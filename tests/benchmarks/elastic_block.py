"""CPU seconds of the constants and error bounds at one new parameter, in high-fidelity solutions at the same one.

    python tests/benchmarks/elastic_block.py block|obstacle|hertz [--cells 21] [--count 3]

The block is an elastic cube on a fixed floor, of trilinear hexahedra, pressed from above by a rigid paraboloid; A is
affine in Lamé's constants. With 21 cells along an edge it has about 30,000 unknowns. One solution is assembly,
factorisation and active sets at a parameter at which nothing is known; what does not depend on the parameter, such as
factors of X_V, is known before both. On one thread.
"""

from __future__ import annotations

import os

if __name__ == "__main__":  # before NumPy is imported
    for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR"):
        os.environ[f"{library}_NUM_THREADS"] = "1"

import numpy as np
import scipy.sparse as sp
from skfem import Basis, BilinearForm, ElementHex1, ElementVector, MeshHex
from skfem.helpers import ddot, eye, sym_grad, trace

from vibench import AffineProblem, Array, InnerProduct, ParameterBox, fem


@BilinearForm
def dilatation(u, v, _):  # type: ignore[no-untyped-def]
    """∫ tr ε(u) tr ε(v)."""
    return ddot(eye(trace(sym_grad(u)), 3), sym_grad(v))


@BilinearForm
def shearing(u, v, _):  # type: ignore[no-untyped-def]
    """2 ∫ ε(u) : ε(v)."""
    return 2.0 * ddot(sym_grad(u), sym_grad(v))


class Block(AffineProblem):
    """A unit cube on a fixed floor, pressed by a rigid paraboloid of radius 1; the depth and Lamé's constants vary."""

    parameters = ParameterBox(
        names=("lame", "shear", "depth"),
        lower=np.array([0.5, 0.5, 0.02]),
        upper=np.array([2.0, 2.0, 0.06]),
        units=("Pa", "Pa", "m"),
    )

    def __init__(self, cells: int = 21) -> None:
        mesh = MeshHex.init_tensor(*[np.linspace(0.0, 1.0, cells + 1)] * 3)
        basis = Basis(mesh, ElementVector(ElementHex1()))
        free = np.setdiff1d(np.arange(basis.N), basis.get_dofs(lambda x: x[2] == 0.0).all())
        top = np.flatnonzero(mesh.p[2] == 1.0)
        vertical = basis.nodal_dofs[2, top]
        facets = mesh.facets_satisfying(lambda x: x[2] == 1.0)
        area = fem.lumped_mass(Basis(mesh, ElementHex1()).boundary(facets))[top]
        self.V = InnerProduct(fem.h1_gram(basis, free))
        self.W = InnerProduct(sp.diags_array(area))
        B = sp.csr_array((area, (np.arange(len(top)), vertical)), shape=(len(top), basis.N))
        gap = 0.5 * np.sum((mesh.p[:2, top] - 0.5) ** 2, axis=0)
        self.declare(
            A=[("lame", dilatation.assemble(basis)), ("shear", shearing.assemble(basis))],
            f=np.zeros(basis.N),
            B=B,
            g=[(1.0, area * gap), ("depth", -area)],
            free=free,
        )

    def training_set(self) -> Array:
        return self.parameters.grid(2, 2, 2)
