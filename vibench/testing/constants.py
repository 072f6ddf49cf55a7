"""The constants of a problem: coercivity and continuity of A in the norm of V, the inf-sup constant of B."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, eigsh

from vibench.arrays import SparseMatrix
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.dense import singular_values
from vibench.linalg.inner_product import InnerProduct
from vibench.testing.case import ProblemCase
from vibench.testing.checks import Doubt, Note

DENSE = 400
"""Up to so many unknowns eigenvalues are those of dense matrices."""

EIGENVALUE_RTOL = 1e-2
"""Relative accuracy of the eigenvalues of larger ones."""

MOST_CONSTRAINTS = 1000
"""With more constraints β_HF is not computed."""

EXTREME = 10.0
"""Up to this γ_a/α a norm is not doubted."""

DIAGONAL_SHARE = 0.8
"""Share of the condition number of A with its own diagonal that a good norm stays below, already on coarse meshes."""

DEPENDENT = 1e-10
"""β_HF / γ_b below which rows of B are linearly dependent up to round-off."""


def constants(case: ProblemCase) -> Iterator[str]:
    """α and γ_a of A, β_HF and γ_b of B are of a moderate ratio.

    Norms of V that bound A from both sides, such as energy and H¹ norms, have a ratio γ_a/α that does not depend on the
    mesh. Diagonal matrices in their place have one of O(h⁻²), and so have a mass matrix and any norm without gradients;
    one in another order of the unknowns has a larger one. The ratio is compared with that of the diagonal of A.
    """
    where, found = next(iter(case.results.items()))
    A, V, W = found["A"], case.plugin.V, case.plugin.W
    lowest, highest = extreme_eigenvalues(A, V)
    yield Note(f"{where}: α = {lowest:.3g}, γ_a = {highest:.3g}")
    low, high = extreme_eigenvalues(A, InnerProduct(sp.diags_array(A.diagonal(), format="csc")))
    ratio, diagonal = highest / lowest, high / low
    if ratio > max(EXTREME, DIAGONAL_SHARE * diagonal):
        yield Doubt(
            f"γ_a/α = {ratio:.2g}, as large as with the diagonal of A in place of X_V ({diagonal:.2g}): probably X_V "
            "has the unknowns in another order than A, or is a norm without gradients, such as a mass matrix"
        )
    if W.dim > MOST_CONSTRAINTS:
        yield Note(f"β_HF is not computed for more than {MOST_CONSTRAINTS} constraints")
        return
    values = singular_values(V.whiten_functional(np.asarray(found["B"].T @ W.unwhiten(np.eye(W.dim)))))
    beta = float(values[-1]) if len(values) == W.dim else 0.0
    yield Note(f"β_HF = {beta:.3g}, γ_b = {values[0]:.3g}")
    if beta <= DEPENDENT * values[0]:
        dependent = W.dim - int(np.sum(values > DEPENDENT * values[0]))
        yield Doubt(f"β_HF/γ_b = {beta / values[0]:.1g}: {dependent} rows of B depend linearly on the others")


def extreme_eigenvalues(A: SparseMatrix, X: InnerProduct) -> tuple[float, float]:
    """Smallest and largest λ with A v = λ X v; A sparse SPD (n×n)."""
    n = X.dim
    if n <= DENSE:
        values = scipy.linalg.eigvalsh(A.toarray(), X.matrix.toarray())
        return float(values[0]), float(values[-1])
    factor, start = SparseCholesky(A, "A"), np.random.default_rng(0).standard_normal(n)

    def largest(product: object) -> float:
        operator = LinearOperator((n, n), matvec=product, dtype=float)
        return float(eigsh(operator, 1, v0=start, tol=EIGENVALUE_RTOL, return_eigenvectors=False)[0])

    # In whitened coordinates y = F v, X = FᵀF, the matrix is F⁻ᵀ A F⁻¹ and its inverse F A⁻¹ Fᵀ, Fᵀ y being X F⁻¹ y.
    high = largest(lambda y: X.whiten_functional(A @ X.unwhiten(y)))
    inverse = largest(lambda y: X.whiten(factor.solve(X.apply(X.unwhiten(y)))))
    return 1.0 / inverse, high
