"""Hyper-reduction: integration over few elements, and the pressures of the cone on few contact rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import scipy.linalg
from annotated_types import Ge, Gt, Lt

from vibench import (
    Array,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    Indices,
    Problem,
    QuerySettings,
    UnsupportedError,
    VariationalInequality,
    projected_members,
)
from vibench.reduction import Cubature, constraint_classes
from vibench_strategies.formulations.reduced_programs import FixedSpacesModel, refuse_free, solved
from vibench_strategies.infsup_greedy import InfSupGreedy

if TYPE_CHECKING:
    from vibench import OfflinePhase

STABILITY = 0.1
"""Weight of A times a random vector beside A times a snapshot: A has to stay definite where no snapshot is."""

PARAMETERS = 32
"""Training parameters, spread over all of them, at which the cubatures are trained."""


class HyperReduced(Formulation):
    """Hyper-reduced contact after Fauque, Ramière and Ryckelynck (2018) and Le Berre et al. (2022).

    A and f, as far as they depend on the parameter and are not affine, are integrated over a reduced integration domain
    of few elements, with weights from nonnegative least squares on the snapshots (Farhat, Chapman and Avery 2015): the
    energy stays convex. The dual is restricted, too: the generators χ_r of the cone test contact on few rows J, with
    weights ω > 0 with which they do the same work in V; the constraint of χ_r is Σ_{j ∈ J} ω_j χ_jr (B v − g)_j ≤ 0.
    Every v with B v ≤ g satisfies it, and a pressure that is complementary to v in all rows is so in these: the
    restriction changes the equilibrium alone, by the tolerance. (With one multiplier for each row, as published, u
    passes between the rows in the interior of a membrane, where a point has no capacity, and the weights, by which
    multipliers are divided, are not determined: snapshots do no work where B u = g = 0.)

    V is V_N and supremizers of the multipliers that V feels least, until the condition number of the projected contact
    rigidity, B V in the norms of V and W, is at most `condition` times that on all of the high-fidelity space: the
    greedy raises its smallest singular value, the largest one cannot be larger than there.

    Parameters
    ----------
    tolerance
        Relative residual of the cubatures; 0 for the whole domain, with which it is the mixed formulation of V and the
        cone.
    condition
        See above.
    integrate
        "varying" members are integrated on the reduced domain, and what is constant or affine is projected once and
        exactly; or "all" are, as published.
    """

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "solvers", "accuracy")

    def __init__(
        self,
        tolerance: Annotated[float, Ge(0.0), Lt(1.0)] = 1e-3,
        condition: Annotated[float, Gt(1.0)] = 2.0,
        integrate: Literal["varying", "all"] = "varying",
    ) -> None:
        self.tolerance, self.condition, self.integrate = tolerance, condition, integrate

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        """The enriched basis, and rows and elements with their weights."""
        problem, snapshots, members = offline.problem, offline.snapshots, self._integrated(offline.problem)
        if missing := " and ".join(sorted(members - problem.elementwise)):
            raise UnsupportedError(f"hyper-reduction integrates {missing} by elements, the problem does not")
        refuse_free(offline.cone)
        vectors = offline.enriched(InfSupGreedy(), 1.0 / self.condition).projection.fixed_basis
        chosen = np.unique(np.linspace(0, len(snapshots.mu) - 1, PARAMETERS).round().astype(int))
        mus, u = snapshots.mu[chosen], snapshots.u[:, chosen]
        constraints = constraint_classes(problem.constraint(mu)[0] for mu in mus).representatives
        works = [np.asarray(B @ vectors) for B in constraints]
        built = {"vectors": vectors, "rows": reduced_rows(offline.cone.generators, works, self.tolerance)}
        if members:
            everywhere = np.arange(problem.element_dofs.shape[1])
            whole = ReducedDomain(problem, members, vectors, everywhere, np.ones(len(everywhere)))
            built["elements"] = whole.cubature(mus, u, self.tolerance)
        return built

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        """The model on the reduced domain."""
        return HyperReducedContact(offline, built, self._integrated(offline.problem))

    def _integrated(self, problem: Problem) -> frozenset[str]:
        """Members that are integrated at every query."""
        once = frozenset() if self.integrate == "all" else problem.constant | problem.affine.keys()
        return frozenset({"A", "f"}) - once


class HyperReducedContact(FixedSpacesModel):
    """Assembles on the reduced domain alone, apart from what is projected once."""

    def __init__(self, offline: OfflinePhase, built: Mapping[str, Any], integrated: frozenset[str]) -> None:
        super().__init__(V := built["vectors"], chi := offline.cone.generators)
        self.enrichment = V.shape[1] - offline.pod.basis.shape[1]
        problem, tests, (rows, shares) = offline.problem, np.zeros_like(chi), built["rows"]
        tests[rows] = shares[:, None] * chi[rows]
        self._projected = projected_members(problem, V, tests, left_out=integrated)
        self._domain = ReducedDomain(problem, integrated, V, *built["elements"]) if integrated else None

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        """The program of the reduced domain."""
        members = self._projected(mu) | (self._domain.at(mu) if self._domain else {})
        A, f, B, g = (members[name] for name in "AfBg")
        return solved(settings, VariationalInequality(A, f, B, g))


class ReducedDomain:
    """A and f, or one of them, integrated over elements (e,) and weights, between vectors V (n×N')."""

    def __init__(self, problem: Problem, members: frozenset[str], V: Array, elements: Indices, weights: Array) -> None:
        dofs, self._sampler = problem.element_dofs[:, elements], problem.element_sampler(elements)
        padded = np.vstack([V, np.zeros(V.shape[1])])  # the last row is that of -1
        self._local = np.ascontiguousarray(np.moveaxis(padded[dofs], 0, 1))
        self._problem, self._members, self._vectors, self._weights = problem, members, V, weights

    def at(self, mu: Array) -> dict[str, Array]:
        """The members at mu (d,) by name, A (N'×N') and f (N',)."""
        sampled, found = self._sampler(mu), dict[str, Array]()
        if "A" in self._members:
            A = np.tensordot(self._local, (self._weights[:, None, None] * sampled["A"]) @ self._local, ((0, 1), (0, 1)))
            found["A"] = 0.5 * (A + A.T)
        if "f" in self._members:
            found["f"] = self._works(sampled["f"]) @ self._weights
        return found

    def _works(self, forces: Array) -> Array:
        """Works (N'×e) of forces on elements (e×k)."""
        return np.asarray(np.einsum("ekn,ek->ne", self._local, forces))

    def cubature(self, mus: Array, u: Array, tolerance: float) -> tuple[Indices, Array]:
        """Few of the elements and their weights, trained on snapshots u (n×P) at mus (P×d).

        Its conditions are works of f, of A x, and of A times noise, as far as these are integrated.
        """
        problem, V, rng = self._problem, self._vectors, np.random.default_rng(0)
        sums = Cubature(V.shape[1], len(self._weights))
        for mu, x in zip(mus, problem.V.gram(V, u).T, strict=True):
            sampled = self._sampler(mu)
            lower = scipy.linalg.cholesky(V.T @ np.asarray(problem.assemble(mu).A @ V), lower=True)
            trials = [(1.0, x), (STABILITY, rng.standard_normal(len(x)))] if "A" in self._members else []
            forces = [(weight, np.einsum("eij,ej->ei", sampled["A"], self._local @ trial)) for weight, trial in trials]
            for weight, each in [*forces, (1.0, sampled["f"])] if "f" in self._members else forces:
                sums.add(scipy.linalg.solve_triangular(lower, self._works(each), lower=True), weight)
        return sums.columns(tolerance)


def reduced_rows(pressures: Array, works: Sequence[Array], tolerance: float) -> tuple[Indices, Array]:
    """Rows and weights with which each of the pressures χ (m×R) does about the work χᵀ B V that it does on all rows.

    `works` are B V (m×N') at some parameters.
    """
    sums = Cubature(works[0].shape[1], len(pressures))
    for each in works:
        for pressure in pressures.T:
            sums.add(each.T * pressure, 1.0)
    return sums.columns(tolerance)
