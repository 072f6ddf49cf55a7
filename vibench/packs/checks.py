"""What the numbers of a model pack mean: definiteness, Dirichlet rows, signs and scalings of reference solutions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.inner_product import InnerProduct, asymmetry
from vibench.packs.members import Affine
from vibench.packs.pack import ModelPack
from vibench.packs.reader import naming, one_triangle, read_pack
from vibench.qp.verification import kkt_residuals

FACTORISED = 3
"""Listed parameters at which the definiteness of A is checked; a run checks it wherever it solves."""

PENALTY = 1e10
"""Ratio of the largest to the median diagonal entry of A above which the former penalises Dirichlet unknowns."""

NEGATIVE_RTOL = 1e-8
"""Size of negative entries of λ, relative to its largest one, that count as round-off."""


def read_model_pack(path: str | Path) -> ModelPack:
    """Read a model pack and check it.

    Parameters
    ----------
    path
        Its folder.

    Raises
    ------
    RequestError
        Naming what is wrong, and what would be right.
    """
    pack = read_pack(path)
    with naming(path):
        check_pack(pack)
    return pack


def check_pack(pack: ModelPack) -> float | None:
    """Check a pack beyond its shapes; returns the largest KKT residual of its reference solutions, if it has any.

    Raises
    ------
    RequestError
        Naming the property that is violated and what was probably meant.
    """
    if pack.members:
        try:
            _check_operators(pack)
        except NumericalError as error:
            raise RequestError(f"operators: {error}") from None
    if pack.reference is None:
        return None
    if not np.any(pack.reference.lam):
        raise RequestError("solutions.lam is zero everywhere: no constraint is active, there is nothing to reduce")
    _check_signs(pack)
    return _check_solutions(pack) if pack.members and pack.reference.u is not None else None


def _check_operators(pack: ModelPack) -> None:
    A, B, listed = pack.members["A"], pack.members["B"], _listed(pack)
    for k, matrix in enumerate(A.arrays):
        what = "operators.A" if len(A.arrays) == 1 else f"operators.A, array {k}"
        one_triangle(matrix, what)
        if off := asymmetry(matrix):
            hint = "; rows of Dirichlet unknowns were replaced and their columns kept" if _replaced_rows(matrix) else ""
            raise RequestError(f"{what} is not symmetric: entries differ by {off:.1e}{hint}")
    if all(matrix.nnz == 0 or not np.any(matrix.data) for matrix in B.arrays):
        raise RequestError("operators.B is zero: no constraint acts on any unknown")
    for name in MEMBERS:
        member = pack.members[name]
        if isinstance(member, Affine):
            try:
                for mu in listed:
                    member.sum.coefficients(mu)
            except NumericalError as error:
                raise RequestError(f"operators.{name}: {error}") from None
    for mu in listed[np.linspace(0, len(listed) - 1, FACTORISED).round().astype(int)]:
        vi = pack.at(mu)
        _check_dirichlet(pack, vi.A)
        try:
            SparseCholesky(sp.csc_array(vi.A), f"A at mu = {mu.tolist()}")
        except NumericalError as error:
            raise RequestError(f"operators: {error}; {_why_indefinite(vi.A)}") from None


def _listed(pack: ModelPack) -> Array:
    return pack.training if pack.validation is None else np.vstack([pack.training, pack.validation])


def _replaced_rows(matrix: Any) -> bool:
    """Whether some rows have a diagonal entry alone while their columns have more."""
    off = sp.csr_array(matrix - sp.diags_array(matrix.diagonal()))
    off.eliminate_zeros()
    rows, columns = np.diff(off.indptr), np.diff(sp.csc_array(off).indptr)
    return bool(np.any((rows == 0) & (columns > 0)))


def _why_indefinite(A: Any) -> str:
    if np.all(A.diagonal() < 0.0):
        return "it is −A that is positive definite: the sign of A is the opposite one"
    if np.abs(A @ np.ones(A.shape[0])).max() <= 1e-10 * abs(A).max():
        return "constants are in its kernel: Dirichlet conditions were not applied, remove the rows and columns"
    return "a coercive problem has a positive definite one on its free unknowns"


def _check_dirichlet(pack: ModelPack, A: Any) -> None:
    diagonal = A.diagonal()
    if diagonal.max(initial=0.0) > PENALTY * max(float(np.median(diagonal)), 0.0) > 0.0:
        k = np.flatnonzero(diagonal > PENALTY * np.median(diagonal))
        raise RequestError(
            f"operators.A has diagonal entries of {diagonal.max():.0e} at {len(k)} unknowns, the first is {k[0]}: a "
            "penalty for Dirichlet conditions was left in; remove these unknowns, or name the free ones in spaces.free"
        )
    assert pack.V is not None
    coupled_V, coupled_A = (_couplings(matrix) > 0 for matrix in (pack.V.matrix, A))
    alone = np.flatnonzero(coupled_V & ~coupled_A)
    if len(alone) and np.any(coupled_A):
        raise RequestError(
            f"operators.A couples {len(alone)} unknowns with no other, the first is {alone[0]}, and X_V does: rows of "
            "Dirichlet unknowns were left in; remove these unknowns, or name the free ones in spaces.free"
        )


def _couplings(matrix: Any) -> Array:
    """Number of entries beside the diagonal, per row."""
    off = sp.csr_array(matrix - sp.diags_array(matrix.diagonal()))
    off.eliminate_zeros()
    return np.diff(off.indptr)


def _check_signs(pack: ModelPack) -> None:
    assert pack.reference is not None
    lam = pack.reference.lam
    if lam.min() >= -NEGATIVE_RTOL * np.abs(lam).max():
        return
    if pack.members and pack.reference.u is not None:
        _explain(pack, int(np.argmin(lam.min(axis=0))))
    if lam.max() <= NEGATIVE_RTOL * np.abs(lam).max():
        raise RequestError("solutions.lam is negative: λ has the other sign, it is −λ that is nonnegative")
    i, k = np.unravel_index(lam.argmin(), lam.shape)
    raise RequestError(
        f"solutions.lam has both signs, {lam[i, k]:.1e} at entry {i} of column {k}: λ needs coefficients that are "
        "nonnegative, in a basis in which W⁺ is the cone of nonnegative coefficients"
    )


def _check_solutions(pack: ModelPack) -> float:
    assert pack.reference is not None
    worst = 0.0
    for k in range(pack.reference.lam.shape[1]):
        residual = _Solution.of(pack, k).residual
        if not residual <= pack.reference.tolerance:
            _explain(pack, k)
        worst = max(worst, residual)
    return worst


@dataclass(frozen=True)
class _Solution:
    """A reference solution with the variational inequality that it should solve."""

    vi: VariationalInequality
    u: Array
    lam: Array

    @classmethod
    def of(cls, pack: ModelPack, k: int) -> _Solution:
        assert pack.reference is not None
        assert pack.reference.u is not None
        try:
            vi = pack.at(pack.reference.parameters[k])
        except NumericalError as error:
            raise RequestError(f"solutions: {error}") from None
        return cls(vi, pack.reference.u[:, k], pack.reference.lam[:, k])

    @property
    def residual(self) -> float:
        """The largest relative KKT residual; infinite for λ outside W⁺."""
        if self.lam.min(initial=0.0) < -NEGATIVE_RTOL * np.abs(self.lam).max(initial=0.0):
            return float("inf")
        return kkt_residuals(self.vi, self.u, np.maximum(self.lam, 0.0)).worst

    def change(self, *, u: float = 1.0, lam: float = 1.0, **factors: float) -> _Solution:
        """The same with its parts multiplied by factors."""
        vi = replace(self.vi, **{name: factor * getattr(self.vi, name) for name, factor in factors.items()})
        return _Solution(vi, u * self.u, lam * self.lam)


Change = Callable[[_Solution, InnerProduct], _Solution]

MISTAKES: Mapping[str, Change] = {
    "λ has the other sign: with B u ≤ g, A u + Bᵀλ = f and λ ≥ 0": lambda s, _: s.change(lam=-1.0),
    "the constraints are B u ≥ g: write B and g with the other sign": lambda s, _: s.change(B=-1.0, g=-1.0),
    "the constraints are B u ≥ g and λ ≤ 0: write B, g and λ with the other sign": lambda s, _: s.change(
        B=-1.0, g=-1.0, lam=-1.0
    ),
    "f has the other sign": lambda s, _: s.change(f=-1.0),
    "g has the other sign": lambda s, _: s.change(g=-1.0),
    "B has the other sign": lambda s, _: s.change(B=-1.0),
    "u has the other sign": lambda s, _: s.change(u=-1.0),
    "the energy has no factor ½: write 2A, or f, g and λ to match": lambda s, _: s.change(A=2.0),
    "λ are nodal forces or moments ∫ λ·φ: write the coefficients X_W⁻¹ λ": lambda s, W: replace(s, lam=W.riesz(s.lam)),
    "λ are coefficients, but B has not been multiplied by X_W, or the other way round": lambda s, W: replace(
        s, lam=W.apply(s.lam)
    ),
}
"""What may be wrong with a solution that solves nothing, and the change that mends it."""


def _explain(pack: ModelPack, k: int) -> None:
    """Refuse a reference solution, with the single change that would make it right if there is one.

    Raises
    ------
    RequestError
        Always.
    """
    assert pack.reference is not None
    found, tolerance = _Solution.of(pack, k), pack.reference.tolerance
    title = f"solutions: column {k}, mu = {pack.reference.parameters[k].tolist()}, does not solve the problem"
    for meant, change in MISTAKES.items():
        if change(found, pack.W).residual <= tolerance:
            raise RequestError(f"{title}; probably {meant}")
    for other, mu in enumerate(pack.reference.parameters):
        if other != k and replace(found, vi=pack.at(mu)).residual <= tolerance:
            raise RequestError(f"{title}, but that of parameter {other}: the columns are in another order")
    residuals = kkt_residuals(found.vi, found.u, np.maximum(found.lam, 0.0))
    parts = {"B u ≤ g": residuals.primal, "A u + Bᵀλ = f": residuals.dual, "λᵀ(B u − g) = 0": residuals.gap}
    worst = max(parts, key=lambda name: parts[name])
    raise RequestError(f"{title}: {worst} is violated by {parts[worst]:.1e} relatively; accepted: {tolerance:g}")
