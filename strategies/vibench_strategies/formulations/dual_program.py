"""The dual program: the reduced multipliers are the unknowns, and stay in the dual set itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.linalg import solve_triangular

from vibench import (
    Array,
    BlockKind,
    Cone,
    DualSet,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    QuerySettings,
    UnsupportedError,
    VariationalInequality,
)
from vibench_strategies.formulations.reduced_programs import PhasesModel, solved

if TYPE_CHECKING:
    from vibench import OfflinePhase


class DualProgram(Formulation):
    """The dual of the reduced problem, min ½αᵀŜα − qᵀα with χα in the dual set K, for a QP solver.

    With A = L Lᵀ, Ŝ = B A⁻¹Bᵀ and q = B A⁻¹f − g in the reduced spaces; then A x = f − Bᵀα. Two kinds of reduced sets
    are known. Generators that are free in sign span a linear space, and its *section* { α : χα ∈ K } takes a row for
    every ray and two for every interval; Ŝ has to be regular there: enrich V_N. Generators with signs have α ≥ 0, and
    those of a *hull* Σ γ_i α_i ≤ 1. They may be opposite to each other, and Ŝ gets 1e-10 of its mean diagonal: of all α
    that differ in round-off a small one is the answer. For contact it is the one of "mixed".
    """

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "solvers", "accuracy", "assembly")
    blocks = (BlockKind.INTERVAL,)
    is_default = True
    has_certificate = True

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:  # noqa: ARG002
        """The reduced model with the rows of its multipliers."""
        return DualProgramModel(offline)


class DualProgramModel(PhasesModel):
    """Assembles the reduced problem, and hands its dual to the QP solver; the unknowns x are the coefficients α."""

    def __init__(self, offline: OfflinePhase) -> None:
        super().__init__([offline])
        self._chi, self._K = offline.cone.generators, offline.problem.K
        self._rows, self._bounds = reduced_rows(offline.cone, self._K)
        self._is_signed = not offline.cone.free.any()
        self.dimension, self.generators = offline.cone.size, len(self._bounds)
        self.reduced = offline.assembled

    def _dual(self, mu: Array) -> tuple[Any, Array, Array]:
        """The reduced problem, L⁻¹[f, Bᵀ] (N'×(1+R)) and the Cholesky factor L."""
        reduced, R = self.assembled(mu), self.dimension
        L = np.linalg.cholesky(reduced.program.A) if reduced.factor is None else reduced.factor
        right = np.column_stack([reduced.program.f, reduced.program.B[:R].T])
        return reduced, solve_triangular(L, right, lower=True), L

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        """The coefficients α at mu (d,)."""
        reduced, whitened, _ = self._dual(mu)
        Y = whitened[:, 1:]
        S = Y.T @ Y
        if self._is_signed and len(S):
            S.flat[:: len(S) + 1] += 1e-10 * np.trace(S) / len(S)
        # The accuracy of a solver means nothing in directions that are round-off.
        if np.linalg.matrix_rank(S, tol=1e-14 * np.trace(S), hermitian=True) < len(S):
            return FormulationAnswer.none("the reduced compliance B A⁻¹Bᵀ is singular: enrich V_N, or take more modes")
        q = Y.T @ whitened[:, 0] - reduced.program.g[: self.dimension]
        return solved(settings, VariationalInequality(S, q, self._rows, self._bounds))

    def coordinates(self, mu: Array, answer: FormulationAnswer) -> tuple[Any, Array, Array]:
        """The reduced problem, x = A⁻¹(f − Bᵀα), and α on the generators of `reduced`: free ones have both signs.

        α is smaller than that of the answer where the accuracy of the solver leaves χα outside of a bounded K.
        """
        assert answer.x is not None
        alpha = np.maximum(answer.x, 0.0) if self._is_signed else answer.x
        gauge = self._K.gauge(self._chi @ alpha)
        # Sums over generators of both signs have a round-off of their own.
        alpha = alpha / (gauge * (1.0 + 1e-12)) if 1.0 - 1e-12 < gauge < np.inf else alpha
        reduced, whitened, L = self._dual(mu)
        x = solve_triangular(L, whitened[:, 0] - whitened[:, 1:] @ alpha, lower=True, trans="T")
        return (
            reduced,
            x,
            alpha if self._is_signed else np.concatenate([np.maximum(alpha, 0.0), np.maximum(-alpha, 0.0)]),
        )

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
        """U = Z x and the point of K nearest to χα, which is χα but for rays."""
        reduced, x, alpha = self.coordinates(mu, answer)
        return reduced.reconstruct(x[:, None])[:, 0], self._K.project(self.reduced.generators @ alpha)

    def certificate(self, offline: OfflinePhase) -> Any:
        """The certificate, of solutions of the dual program at training parameters."""
        return offline.certificate_of(self.reduced, self)


def reduced_rows(cone: Cone, K: DualSet) -> tuple[Array, Array]:
    """Rows (k×R) and bounds (k,) of the coefficients: those of the section of K, of the hull, or of the cone.

    Raises an `UnsupportedError` if some generators are free in sign and others are not, or a cone leaves K.
    """
    chi, R = cone.generators, cone.size
    if not cone.free.any():
        if cone.gauges is None:
            if K.blocks:
                raise UnsupportedError("a cone leaves a bounded K: choose a dual strategy of hulls or linear spaces")
            return -np.eye(R), np.zeros(R)
        return np.vstack([-np.eye(R), cone.gauges[None]]), np.append(np.zeros(R), 1.0)
    if not cone.free.all():
        raise UnsupportedError("the cone has generators with and without a sign: no section of K, and no hull in it")
    radii = K.radii(len(chi))
    ray, bounded = ~np.isfinite(radii), np.isfinite(radii)
    inside = chi[bounded] / radii[bounded, None]
    return np.vstack([-chi[ray], inside, -inside]), np.append(np.zeros(ray.sum()), np.ones(2 * len(inside)))
