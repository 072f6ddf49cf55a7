"""The dual program: the reduced multipliers are the unknowns, and stay in the dual set itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.linalg import solve_triangular

from vibench import (
    Array,
    BlockKind,
    DualSet,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    Outcome,
    QuerySettings,
    ReducedSet,
    UnsupportedError,
    VariationalInequality,
)
from vibench_strategies.formulations.reduced_programs import PhasesModel

if TYPE_CHECKING:
    from vibench import OfflinePhase


class DualProgram(Formulation):
    """The dual of the reduced problem, min ½αᵀŜα − qᵀα with χα in the dual set K, for a QP solver.

    With A = L Lᵀ and Y = L⁻¹Bᵀ in the reduced spaces, Ŝ = YᵀY and q = YᵀL⁻¹f − g; then A x = f − Bᵀα. Two kinds of
    reduced sets are known. Generators that are free in sign span a linear space. Its *section* { α : χα ∈ K } takes a
    row for every ray and two for every interval. Ŝ has to be regular there: enrich V_N. Generators with signs have
    α ≥ 0, and those of a *hull* Σ γ_i α_i ≤ 1. They are given as the primal program, with y = Lᵀx and one unknown ζ:
    min ½|y|² − (L⁻¹f)ᵀy + ζ, Yᵀy − ζγ ≤ g, ζ ≥ 0. Neither ζ nor, where generators are dependent, α has a curvature:
    proximal steps from zero supply it, and of all α a small one is the answer. Sections take such steps where the
    solver misses the accuracy. For contact the answer is the one of "mixed".
    """

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "solvers", "accuracy", "assembly")
    blocks = (BlockKind.INTERVAL,)
    is_default = True
    has_certificate = True

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:  # noqa: ARG002
        """The reduced model with the rows of its multipliers."""
        return DualProgramModel(offline)


class DualProgramModel(PhasesModel):
    """Assembles the reduced problem, and hands it to the QP solver.

    The unknowns of a section are T α, with TᵀT = Ŝ + σ. Of a hull they are y, √σ(α − its last step) and ζ.
    """

    def __init__(self, offline: OfflinePhase) -> None:
        super().__init__([offline])
        cone, N, self._R = offline.cone, self.dimension, offline.cone.size
        self._chi, self._K = cone.generators, offline.problem.K
        self._is_signed = not cone.free.any()
        if self._is_signed:
            self._gauges = gauges_of(cone, self._K)
            self.dimension, self.generators = N + self._R + 1, self._R + 1
            self.enrichment = self.dimension - offline.pod.basis.shape[1]
        else:
            self._rows, self._bounds = section_rows(cone, self._K)
            self.dimension, self.generators = self._R, len(self._bounds)
        if N < self._R and not self._is_signed:
            raise UnsupportedError(f"{self._R} multipliers of a section need as many vectors, not {N}: enrich V_N")
        self.reduced = offline.assembled

    def _dual(self, mu: Array) -> tuple[Any, Array, Array, Array]:
        """The reduced problem, Y = L⁻¹Bᵀ (N'×R), L⁻¹f (N',) and the Cholesky factor L."""
        reduced = self.assembled(mu)
        L = np.linalg.cholesky(reduced.program.A) if reduced.factor is None else reduced.factor
        right = np.column_stack([reduced.program.B[: self._R].T, reduced.program.f])
        whitened = solve_triangular(L, right, lower=True)
        return reduced, whitened[:, :-1], whitened[:, -1], L

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        """The unknowns of the section, or those of the hull with the coefficients α, at mu (d,)."""
        reduced, Y, load, _ = self._dual(mu)
        g = reduced.program.g[: self._R]
        return self._in_hull(settings, Y, load, g) if self._is_signed else self._in_section(settings, Y, load, g)

    def _in_section(self, settings: QuerySettings, Y: Array, load: Array, g: Array) -> FormulationAnswer:
        """Solve exactly; where the solver misses the accuracy by proximal steps, whose Hessian is the identity."""
        q, (T, sigma) = Y.T @ load - g, proximal_factor(Y, 1e-4)
        # The accuracy of a solver means nothing in directions that are round-off.
        if np.linalg.matrix_rank(Y, tol=1e-7 * np.linalg.norm(Y)) < self._R:
            return FormulationAnswer.none("the reduced compliance B A⁻¹Bᵀ is singular: enrich V_N, or take more modes")
        inverse = solve_triangular(T, np.eye(self._R))
        rows, half = self._rows @ inverse, Y @ inverse
        exact = VariationalInequality(half.T @ half, inverse.T @ q, rows, self._bounds)
        found = settings.solve_qp(exact)
        if is_met(exact, found, 0.5 * settings.accuracy):
            return FormulationAnswer(found.x, found.alpha, iterations=found.iterations)

        def step(alpha: Array) -> tuple[Any, Array]:
            f = inverse.T @ (q + sigma * alpha)
            found = solved_step(settings, VariationalInequality(np.eye(self._R), f, rows, self._bounds))
            return found, alpha if found.x is None else inverse @ found.x

        return proximal(step, Y, np.full(self._R, sigma), settings.accuracy, 300)

    def _in_hull(self, settings: QuerySettings, Y: Array, load: Array, g: Array) -> FormulationAnswer:
        """Take proximal steps of α and ζ, in units of ζ such that the largest vertex has the energy 1."""
        R, lengths = self._R, np.linalg.norm(Y, axis=0)
        # Smaller than in a section, as the Hessian is the identity in any case: two or three steps.
        _, sigma = proximal_factor(Y, 1e-6)
        vertices = np.divide(lengths, self._gauges, out=np.zeros(R), where=self._gauges > 0.0)
        # Of a cone ζ has no part: a price of 1 holds it at zero.
        energy = float(vertices.max(initial=0.0)) or 1.0
        shared = np.append(self._gauges * energy, 1.0)
        rows = np.column_stack([np.vstack([Y.T, 0.0 * load]), np.vstack([np.eye(R), np.zeros(R)]), -shared])
        rows[:, -1 - R : -1] *= np.sqrt(sigma)
        identity, bounds = np.eye(rows.shape[1]), np.append(g, 0.0)

        def step(last: Array) -> tuple[Any, Array]:
            f = np.concatenate([load, np.sqrt(sigma) * last[:R], [last[R] - energy]])
            found = solved_step(settings, VariationalInequality(identity, f, rows, bounds))
            return found, last if found.x is None or found.alpha is None else np.append(found.alpha[:R], found.x[-1])

        return proximal(step, Y, np.append(np.full(R, sigma), 1.0 / energy), settings.accuracy, 30)

    def coordinates(self, mu: Array, answer: FormulationAnswer) -> tuple[Any, Array, Array]:
        """The reduced problem, x = A⁻¹(f − Bᵀα), and α on the generators of `reduced`: free ones have both signs.

        α is smaller than that of the answer where the accuracy of the solver leaves χα outside of a bounded K.
        """
        assert answer.x is not None
        reduced, Y, load, L = self._dual(mu)
        assert answer.alpha is not None
        alpha = answer.alpha[: self._R]
        if not self._is_signed:
            alpha = solve_triangular(proximal_factor(Y, 1e-4)[0], answer.x)
        gauge = self._K.gauge(self._chi @ alpha)
        # Sums over generators of both signs have a round-off of their own.
        alpha = alpha / (gauge * (1.0 + 1e-12)) if 1.0 - 1e-12 < gauge < np.inf else alpha
        x = solve_triangular(L, load - Y @ alpha, lower=True, trans="T")
        both = alpha if self._is_signed else np.concatenate([np.maximum(alpha, 0.0), np.maximum(-alpha, 0.0)])
        return reduced, x, both

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
        """U = Z x and the point of K nearest to χα, which is χα but for rays."""
        reduced, x, alpha = self.coordinates(mu, answer)
        return reduced.reconstruct(x[:, None])[:, 0], self._K.project(self.reduced.generators @ alpha)

    def certificate(self, offline: OfflinePhase) -> Any:
        """The certificate, of solutions of the dual program at training parameters."""
        return offline.certificate_of(self.reduced, self)


def proximal(
    step: Callable[[Array], tuple[Any, Array]], Y: Array, weights: Array, accuracy: float, most: int
) -> FormulationAnswer:  # fmt: skip
    """Proximal steps from zero until they leave of the terms that they add, by their weights, less than the accuracy.

    Every step gives the answer of the solver and its point (k,), whose first unknowns are α. What σ adds to a row of
    Yᵀy ≤ g is relative to its length and to the energy |Yα| of the multipliers.
    """
    R, point, iterations = Y.shape[1], np.zeros(len(weights)), 0
    units = np.append(np.sqrt(np.square(Y).sum(axis=0) + weights[:R]), np.ones(len(weights) - R))
    for _ in range(most):
        last = point
        found, point = step(last)
        iterations += found.iterations or 0
        if found.x is None or found.alpha is None:
            return FormulationAnswer.none(found.solver_status)
        left, energy = weights * np.abs(point - last) / units, float(np.linalg.norm(Y @ point[:R]))
        if (left[:R] <= accuracy * energy).all() and (left[R:] <= accuracy).all():
            return FormulationAnswer(found.x, found.alpha, iterations=iterations)
    reason = f"{most} proximal steps leave {left.max():.1e} of the terms that they add"
    return FormulationAnswer(found.x, found.alpha, Outcome.INACCURATE, reason, iterations)


def solved_step(settings: QuerySettings, program: VariationalInequality) -> Any:
    """The solution of a program whose Hessian is the identity, in dual form where the solver misses the accuracy."""
    found = settings.solve_qp(program)
    # Some solvers take rows at small angles for infeasible ones, and not in dual form.
    met = is_met(program, found, settings.accuracy)
    return found if met else settings.solve_qp(program, factor=program.A)


def proximal_factor(Y: Array, share: float) -> tuple[Array, float]:
    """The upper factor T (R×R) of Ŝ + σ, for σ a share of the mean diagonal of Ŝ."""
    sigma = share * float(np.mean(np.square(Y).sum(axis=0))) if Y.size else 0.0
    return np.asarray(np.linalg.qr(np.vstack([Y, np.sqrt(sigma) * np.eye(Y.shape[1])]))[1]), sigma


def is_met(program: VariationalInequality, found: Any, accuracy: float) -> bool:
    """Whether residuals are small, in Euclidean norms, which are the natural ones where A is near the identity."""
    x, nu = found.x, found.alpha
    if x is None or nu is None:
        return False
    force, excess = program.B.T @ nu, program.B @ x - program.g
    unit = accuracy * float(np.linalg.norm(force))
    lengths, residual = np.linalg.norm(program.B, axis=1), program.f - program.A @ x - force
    # Without a row that acts the solution is that of a linear system.
    unit = unit or accuracy * float(np.linalg.norm(x))
    return bool(
        (excess <= unit * lengths).all()
        and np.linalg.norm(residual) <= unit
        and np.abs(nu @ excess) * accuracy <= unit * unit
    )


def gauges_of(cone: ReducedSet, K: DualSet) -> Array:
    """The γ (R,) of a hull, zeros for a cone; an `UnsupportedError` if a cone leaves K."""
    if cone.kind == "cone" and K.blocks:
        raise UnsupportedError("a cone leaves a bounded K: choose a dual strategy of hulls or linear spaces")
    return np.zeros(cone.size) if cone.gauges is None else np.asarray(cone.gauges)


def section_rows(cone: ReducedSet, K: DualSet) -> tuple[Array, Array]:
    """Rows (k×R) and bounds (k,) of the section { α : χα ∈ K }, of generators that are all free in sign."""
    if not cone.free.all():
        raise UnsupportedError("the cone has generators with and without a sign: no section of K, and no hull in it")
    chi, radii = cone.generators, K.radii(len(cone.generators))
    ray, bounded = ~np.isfinite(radii), np.isfinite(radii)
    inside = chi[bounded] / radii[bounded, None]
    return np.vstack([-chi[ray], inside, -inside]), np.append(np.zeros(ray.sum()), np.ones(2 * len(inside)))
