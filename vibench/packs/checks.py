"""Checks of the numbers of a model pack: definiteness, Dirichlet rows, signs and scalings of reference solutions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError, RequestError, at_parameter, placed
from vibench.highfidelity.active_set import HighFidelitySolution, solve_high_fidelity
from vibench.interfaces.absent_rows import zero_rows
from vibench.interfaces.dual_sets import DualSet
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.validation import settled
from vibench.linalg.inner_product import asymmetry, check_positive_definite
from vibench.packs.manifest import read_manifest
from vibench.packs.pack import ModelPack, PackSolutions
from vibench.packs.reader import PackReader, naming, one_triangle
from vibench.qp.verification import kkt_residuals
from vibench.signatures import bordered


@bordered
def read_model_pack(path: str | Path) -> ModelPack:
    """Read a model pack and check it.

    A `RequestError` names what is wrong in the manifest or with an array, what was probably meant, and what is right.

    Parameters
    ----------
    path
        Its folder.
    """
    with naming(path) as folder:
        pack = PackReader(folder, read_manifest(folder)).pack()
        return replace(pack, residual=_check(pack))


def solve_at_training(pack: ModelPack) -> tuple[Array, HighFidelitySolution]:
    """The first training parameter (d,) of a pack with operators, and the solution; a `RequestError` if it has none."""
    mu = pack.training[0]
    with placed("there is no solution", NumericalError), at_parameter(mu):
        return mu, solve_high_fidelity(pack.at(mu))


def zero_rows_of(pack: ModelPack) -> Indices:
    """The rows (k,) of B that are zero at every listed parameter."""
    return np.flatnonzero(np.all([zero_rows(pack.members["B"].at(mu)) for mu in pack.listed], axis=0))


def _check(pack: ModelPack) -> float | None:
    """Check a pack beyond its shapes; returns the largest KKT residual of its reference solutions, if it has any."""
    if pack.V is not None:
        with placed("operators", NumericalError):
            _check_operators(pack, pack.V.matrix)
    reference = pack.reference
    if reference is None:
        return None
    if not np.any(reference.lam):
        raise RequestError("solutions.lam is zero everywhere: no constraint is active, there is nothing to reduce")
    solved = pack.V is not None and reference.u is not None
    numbers = range(len(reference.parameters)) if solved else ()
    residuals = [_Solution.from_pack(pack, reference, k).residual for k in numbers]
    # Up to 1e-8 of the largest entry are round-off.
    outside = np.array([_outside(pack.K, column) for column in reference.lam.T])
    if outside.max() > 1e-8 * np.abs(reference.lam).max():
        if solved:
            raise _explained(pack, reference, int(np.argmax(outside)))
        if pack.K.blocks:
            raise RequestError(f"solutions.lam leaves K by {outside.max():.1e}: in K are {pack.K.names()}")
        # Without a solution u there is nothing that would explain them.
        if reference.lam.max() <= 1e-8 * np.abs(reference.lam).max():
            raise RequestError("solutions.lam is negative: λ has the other sign, it is −λ that is nonnegative")
        row, column = np.unravel_index(reference.lam.argmin(), reference.lam.shape)
        signs = f"solutions.lam has both signs, {reference.lam.min():.1e} at entry {row} of column {column}"
        needed = "coefficients that are nonnegative, in a basis in which W⁺ is the cone of nonnegative coefficients"
        raise RequestError(f"{signs}: λ needs {needed}")
    for k, residual in enumerate(residuals):
        if not residual <= reference.tolerance:
            raise _explained(pack, reference, k)
    return max(residuals, default=None)


def _outside(K: DualSet, lam: Array) -> float:
    """The largest coefficient of λ (m,) less the nearest point of K."""
    return float(np.max(np.abs(lam - K.project(lam)), initial=0.0))


def _check_operators(pack: ModelPack, X_V: Any) -> None:
    A, B, listed = pack.members["A"], pack.members["B"], pack.listed
    for k, matrix in enumerate(A.arrays):
        what = "operators.A" if len(A.arrays) == 1 else f"operators.A, array {k}"
        one_triangle(matrix, what)
        if off := asymmetry(matrix):
            # Rows with a diagonal entry alone whose columns have more.
            replaced = np.any((_couplings(matrix) == 0) & (_couplings(matrix.T) > 0))
            hint = "; rows of Dirichlet unknowns were replaced and their columns kept" if replaced else ""
            raise RequestError(f"{what} is not symmetric: entries differ by {off:.1e}{hint}")
    if all(matrix.nnz == 0 or not np.any(matrix.data) for matrix in B.arrays):
        raise RequestError("operators.B is zero: no constraint acts on any unknown")
    for name, member in pack.members.items():
        with placed(f"operators.{name}", NumericalError):
            for mu in listed if member.thetas else ():
                member.sum.coefficients(mu)
    # A zero row of B must not have a negative bound.
    for mu in listed:
        with at_parameter(mu):
            settled(pack.at(mu))
    # Three samples: a run checks the definiteness of A wherever it solves.
    for mu in listed[np.linspace(0, len(listed) - 1, 3).round().astype(int)]:
        matrix = A.at(mu)
        _check_dirichlet(matrix, X_V)
        check_positive_definite(matrix, f"A at mu = {mu.tolist()}")


def _check_dirichlet(A: Any, X_V: Any) -> None:
    # Penalties of Dirichlet unknowns are ten orders of magnitude above the median of the diagonal.
    diagonal, advice = A.diagonal(), "remove these unknowns, or name the free ones in spaces.free"
    middle = float(np.median(diagonal)) if len(diagonal) else 0.0
    if middle > 0.0 and len(k := np.flatnonzero(diagonal > 1e10 * middle)):
        what = f"diagonal entries of {diagonal.max():.0e} at {len(k)} unknowns, the first is {k[0]}"
        raise RequestError(f"operators.A has {what}: a penalty for Dirichlet conditions was left in; {advice}")
    # A Dirichlet row keeps its diagonal entry alone, while X_V was assembled without conditions.
    coupled_V, coupled_A = (_couplings(matrix) > 0 for matrix in (X_V, A))
    alone = np.flatnonzero(coupled_V & ~coupled_A)
    if len(alone) and np.any(coupled_A):
        what = f"{len(alone)} unknowns with no other, the first is {alone[0]}, and X_V does"
        raise RequestError(f"operators.A couples {what}: rows of Dirichlet unknowns were left in; {advice}")


def _couplings(matrix: Any) -> Array:
    off = sp.csr_array(matrix - sp.diags_array(matrix.diagonal()))
    off.eliminate_zeros()
    return np.diff(off.indptr)


@dataclass(frozen=True)
class _Solution:
    """A reference solution with the variational inequality that it should solve."""

    vi: VariationalInequality
    u: Array
    lam: Array

    @classmethod
    def from_pack(cls, pack: ModelPack, given: PackSolutions, k: int) -> _Solution:
        assert given.u is not None, "solutions are compared with operators"
        with placed("solutions", NumericalError):
            return cls(pack.at(given.parameters[k]), given.u[:, k], given.lam[:, k])

    @property
    def residual(self) -> float:
        """The largest relative KKT residual; infinite for λ outside K."""
        # As in `_check`: what is less far outside is round-off.
        if _outside(self.vi.K, self.lam) > 1e-8 * np.abs(self.lam).max(initial=0.0):
            return float("inf")
        return kkt_residuals(self.vi, self.u, self.vi.K.project(self.lam)).worst

    def change(self, **factors: float) -> _Solution:
        """A copy with members, u or lam multiplied by factors."""
        members = {name: factor * getattr(self.vi, name) for name, factor in factors.items() if name in MEMBERS}
        u, lam = (factors.get(name, 1.0) * getattr(self, name) for name in ("u", "lam"))
        return _Solution(replace(self.vi, **members), u, lam)


def _explained(pack: ModelPack, given: PackSolutions, k: int) -> RequestError:
    """The error for a reference solution, with the single change that would make it right if there is one."""
    solution, tolerance = _Solution.from_pack(pack, given, k), given.tolerance
    title = f"solutions: column {k}, mu = {given.parameters[k].tolist()}, does not solve the problem"
    # Possible mistakes, each with the change that corrects it; a change of one sign comes before one of several.
    reversed_ = solution.change(B=-1.0, g=-1.0, lam=-1.0)
    weighted, coefficients = (replace(solution, lam=change(solution.lam)) for change in (pack.W.apply, pack.W.riesz))
    mistakes = {
        "λ has the other sign: with B u ≤ g, A u + Bᵀλ = f and λ ≥ 0": solution.change(lam=-1.0),
        "the constraints are B u ≥ g: write B and g with the other sign": solution.change(B=-1.0, g=-1.0),
        "the constraints are B u ≥ g and λ ≤ 0: write B, g and λ with the other sign": reversed_,
        "f has the other sign": solution.change(f=-1.0),
        "g has the other sign": solution.change(g=-1.0),
        "B has the other sign": solution.change(B=-1.0),
        "u has the other sign": solution.change(u=-1.0),
        "the energy has no factor ½: write 2A, or f, g and λ to match": solution.change(A=2.0),
        "λ are nodal forces or moments ∫ λ·φ: write the coefficients X_W⁻¹ λ": coefficients,
        "λ are coefficients, but B has not been multiplied by X_W, or the other way round": weighted,
    }
    for meant, changed in mistakes.items():
        if changed.residual <= tolerance:
            return RequestError(f"{title}; probably {meant}")
    # Columns in another order than the parameters solve other problems of the pack.
    for other, mu in enumerate(given.parameters):
        if other != k and replace(solution, vi=pack.at(mu)).residual <= tolerance:
            return RequestError(f"{title}, but that of parameter {other}: the columns are in another order")
    residuals = kkt_residuals(solution.vi, solution.u, solution.vi.K.project(solution.lam))
    of_gap = "σ_K(B u − g) = λᵀ(B u − g)" if pack.K.blocks else "λᵀ(B u − g) = 0"
    parts = {"B u ≤ g": residuals.primal, "A u + Bᵀλ = f": residuals.dual, of_gap: residuals.gap}
    worst = max(parts, key=lambda name: parts[name])
    return RequestError(f"{title}: {worst} is violated by {parts[worst]:.1e} relatively; accepted: {tolerance:g}")
