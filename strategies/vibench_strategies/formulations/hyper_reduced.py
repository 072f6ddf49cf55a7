"""Hyper-reduction: a reduced integration domain, the multipliers of its contact, and a V_N enriched for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import scipy.linalg
from annotated_types import Ge, Gt, Lt
from scipy.optimize import nnls

from vibench import (
    Array,
    Asked,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    Indices,
    Multiplier,
    Problem,
    UnsupportedError,
    VariationalInequality,
)
from vibench.linalg import project_out

if TYPE_CHECKING:
    from vibench import Reduction

PARAMETERS = 32
"""Training parameters, spread over all of them, at which cubature and enrichment are trained."""

SKETCH = 200
"""Random combinations of all conditions of a cubature, in place of them: they keep its residual to some per cent."""

STABILITY = 0.1
"""Weight of A times a random vector beside A times a snapshot: A has to stay definite where no snapshot is."""


class HyperReduced(Formulation):
    """Hyper-reduced contact after Fauque, Ramière and Ryckelynck (2018) and Le Berre et al. (2022).

    A and f, as far as they depend on the parameter and are not affine, are integrated over a reduced integration domain
    of few elements, with weights from nonnegative least squares on the snapshots (Farhat, Chapman and Avery 2015): the
    energy stays convex. The multipliers are those of the high-fidelity problem, not reduced but restricted to few
    contact rows J, chosen in the same way: those with which weighted pressures of the snapshots do the same work in
    V_N. V_N is enriched by supremizers of J, each in the direction of the smallest singular value of B_J V, until its
    condition number, rows having unit norm in V', is at most `condition` times that on all of V. Outside of J, λ is the
    nonnegative combination of snapshots that is nearest to what it is on J.

    Parameters
    ----------
    tolerance
        Relative residual of the cubatures; 0 for the whole domain, with which it is the mixed formulation of V_N, its
        enrichment, and all multipliers.
    condition
        See above.
    integrate
        "varying" members are integrated on the reduced domain, and what is constant or affine is projected once and
        exactly; or "all" are, as published.
    seed
        Of the random combinations.
    """

    uses: ClassVar[tuple[str, ...]] = ("pod", "solvers", "accuracy")
    multiplier = Multiplier.RECOVERED

    def __init__(
        self,
        tolerance: Annotated[float, Ge(0.0), Lt(1.0)] = 1e-3,
        condition: Annotated[float, Gt(1.0)] = 10.0,
        integrate: Literal["varying", "all"] = "varying",
        seed: Annotated[int, Ge(0)] = 0,
    ) -> None:
        self.tolerance, self.condition, self.integrate, self.seed = tolerance, condition, integrate, seed

    def build(self, offline: Reduction) -> Mapping[str, Any]:
        """Rows J and their weights, the enriched basis, elements and their weights."""
        problem, mus, basis = offline.problem, offline.snapshots.mu, offline.pod.basis
        names = self.integrated(problem)
        if names - problem.elementwise:
            missing = " and ".join(sorted(names - problem.elementwise))
            raise UnsupportedError(f"hyper-reduction integrates {missing} by elements, the problem does not")
        chosen = np.unique(np.linspace(0, len(mus) - 1, PARAMETERS).round().astype(int))
        rng, known = np.random.default_rng(self.seed), mus[chosen]
        constraints = [problem.constraint(mu)[0].copy() for mu in known]
        rows, shares = np.arange(problem.W.dim), np.ones(problem.W.dim)
        if self.tolerance:
            sketch = np.zeros((SKETCH, problem.W.dim))
            for lam, B in zip(offline.snapshots.lam.T[chosen], constraints, strict=True):
                works = (B @ basis).T * lam
                sketch += _combined(works, float(np.linalg.norm(works.sum(axis=1))), rng)
            rows, shares = cubature(sketch, self.tolerance)
        vectors = self._enriched(problem, basis, [B[rows] for B in constraints])
        elements, weights = np.zeros(0, int), np.zeros(0)
        if names:
            elements = np.arange(problem.element_dofs.shape[1])
            weights = np.ones(len(elements))
            if self.tolerance:
                elements, weights = self._domain(problem, vectors, known, offline.snapshots.u[:, chosen], rng)
        return {"rows": rows, "shares": shares, "vectors": vectors, "elements": elements, "weights": weights}

    def _enriched(self, problem: Problem, basis: Array, constraints: list[Any]) -> Array:
        """V_N and supremizers, orthonormal in V, until the condition of the rows is good enough at all parameters."""
        V, limits, units = problem.V, [], []
        for B in constraints:
            loads = V.whiten_functional(B.T.toarray())
            lengths = np.linalg.norm(loads, axis=0)
            units.append(loads[:, lengths > 0.0] / lengths[lengths > 0.0])
            sigma = np.linalg.svd(units[-1], compute_uv=False)
            limits.append(self.condition * float(sigma[0] / sigma[-1]) if len(sigma) else np.inf)
        space = V.whiten(basis)
        while any(each.size for each in units):
            found = [_worst(each, space) for each in units]
            excess = [condition / limit for (condition, _), limit in zip(found, limits, strict=True)]
            number = int(np.argmax(excess))
            if excess[number] <= 1.0:
                break
            added = project_out(space, units[number] @ found[number][1])
            space = np.column_stack([space, added / np.linalg.norm(added)])
        return V.unwhiten(space)

    def _domain(
        self, problem: Problem, vectors: Array, mus: Array, u: Array, rng: np.random.Generator
    ) -> tuple[Indices, Array]:
        """Elements and weights of a cubature of A times snapshots u (n×k) and random vectors, and of f."""
        integrals, names = (
            Integrals(problem, vectors, np.arange(problem.element_dofs.shape[1])),
            self.integrated(problem),
        )
        sketch = np.zeros((SKETCH, problem.element_dofs.shape[1]))
        coordinates = problem.V.gram(vectors, u)
        for mu, x in zip(mus, coordinates.T, strict=True):
            sampled, vi = integrals.sampler(mu), problem.assemble(mu)
            lower = scipy.linalg.cholesky(vectors.T @ np.asarray(vi.A @ vectors), lower=True)
            conditions = []
            if "A" in names:
                for weight, trial in ((1.0, x), (STABILITY, rng.standard_normal(len(x)))):
                    works = integrals.tested(np.einsum("eij,ej->ei", sampled["A"], integrals.local @ trial))
                    conditions.append((weight, works))
            if "f" in names:
                conditions.append((1.0, integrals.tested(sampled["f"])))
            for weight, works in conditions:
                energies = scipy.linalg.solve_triangular(lower, works, lower=True)
                sketch += _combined(weight * energies, float(np.linalg.norm(energies.sum(axis=1))), rng)
        return cubature(sketch, self.tolerance)

    def model(self, offline: Reduction, built: Mapping[str, Any]) -> FormulationModel:
        """The model on the reduced domain."""
        names = self.integrated(offline.problem)
        return HyperReducedContact(offline, built, _projected(offline, built["vectors"], {"A", "f"} - names))

    def integrated(self, problem: Problem) -> frozenset[str]:
        """Members that are integrated at every query."""
        both = frozenset({"A", "f"})
        return both if self.integrate == "all" else both - problem.constant - problem.affine.keys()


class HyperReducedContact(FormulationModel):
    """Assembles on the reduced integration domain alone, and recovers λ outside of it from the snapshots."""

    def __init__(
        self, offline: Reduction, built: Mapping[str, Any], projected: Mapping[str, Callable[[Array], Array]]
    ) -> None:
        problem, vectors, rows = offline.problem, built["vectors"], built["rows"]
        self._problem, self._vectors, self._rows, self._shares = problem, vectors, rows, built["shares"]
        self.dimension, self.generators = int(vectors.shape[1]), len(rows)
        self.enrichment = self.dimension - int(offline.pod.basis.shape[1])
        self._weights, self._fixed = built["weights"], projected
        if len(built["elements"]):
            self._integrals = Integrals(problem, vectors, built["elements"])
        self._loads = problem.contact_loads(np.eye(problem.W.dim)[:, rows]) if problem.has_contact else None
        lam = offline.snapshots.lam
        self._pressures = lam[:, lam.any(axis=0)]

    def solve(self, mu: Array, asked: Asked) -> FormulationAnswer:
        """The program of the reduced domain."""
        members = {name: of(mu) for name, of in self._fixed.items()}
        if len(members) < 2:
            sampled = self._integrals.sampler(mu)
            if "A" not in members:
                members["A"] = self._integrals.energy(self._weights[:, None, None] * sampled["A"])
            if "f" not in members:
                members["f"] = self._integrals.tested(sampled["f"]) @ self._weights
        if not len(self._rows):  # no snapshot has contact
            return FormulationAnswer(scipy.linalg.solve(members["A"], members["f"], assume_a="pos"), np.zeros(0))
        if self._loads is None:
            B, g = self._problem.constraint(mu)
            program = VariationalInequality(members["A"], members["f"], B[self._rows] @ self._vectors, g[self._rows])
        else:
            varying, g = self._loads.varying(mu)
            loads = self._loads.fixed.copy()
            loads[self._loads.first : self._loads.first + len(varying)] += varying
            B = loads.T @ self._vectors[self._problem.contact_dofs]
            program = VariationalInequality(members["A"], members["f"], B, g)
        found = asked.solve_qp(program)
        if found.x is None or found.alpha is None:
            return FormulationAnswer.none(found.solver_status)
        return FormulationAnswer(found.x, found.alpha, iterations=found.iterations)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:  # noqa: ARG002
        """U, and the combination of snapshots nearest to the pressures on the chosen rows."""
        assert answer.x is not None
        assert answer.alpha is not None
        if len(self._rows) == self._problem.W.dim:  # in their order
            return self._vectors @ answer.x, answer.alpha
        measure = np.sqrt(self._shares * np.maximum(self._problem.multiplier_integrals()[self._rows], 0.0))
        local = measure[:, None] * self._pressures[self._rows]
        scales = np.linalg.norm(local, axis=0)
        kept = scales > 0.0
        if not kept.any():  # nonnegative least squares without a column ends the process (SciPy 1.17)
            return self._vectors @ answer.x, np.zeros(self._problem.W.dim)
        shares = nnls(local[:, kept] / scales[kept], measure * answer.alpha / self._shares)[0]
        return self._vectors @ answer.x, self._pressures[:, kept] @ (shares / scales[kept])


class Integrals:
    """Integrals over some elements, tested by the vectors (n×N') of a basis."""

    def __init__(self, problem: Problem, vectors: Array, elements: Indices) -> None:
        dofs, self.sampler = problem.element_dofs[:, elements], problem.element_sampler(elements)
        padded = np.vstack([vectors, np.zeros(vectors.shape[1])])  # the last row is that of -1
        self.local = np.ascontiguousarray(np.moveaxis(padded[dofs], 0, 1))
        self._stacked = self.local.reshape(-1, vectors.shape[1])

    def tested(self, loads: Array) -> Array:
        """What loads on elements (e×k) do with the vectors (N'×e)."""
        return np.asarray(np.einsum("ekn,ek->ne", self.local, loads))

    def energy(self, matrices: Array) -> Array:
        """Sum over elements of matrices (e×k×k), between the vectors (N'×N')."""
        A = self._stacked.T @ (matrices @ self.local).reshape(self._stacked.shape)
        return np.asarray(0.5 * (A + A.T))


def _projected(offline: Reduction, vectors: Array, names: AbstractSet[str]) -> dict[str, Callable[[Array], Array]]:
    """Constant and affine members, projected on the vectors (n×N')."""
    problem = offline.problem

    def project(member: Any) -> Any:
        return vectors.T @ member if member.ndim == 1 else vectors.T @ np.asarray(member @ vectors)

    known = dict[str, Callable[[Array], Array]]()
    for name in names:
        if name in problem.affine:
            known[name] = problem.affine[name].mapped(project).at
        else:
            known[name] = partial(_constant, project(getattr(problem.assemble(offline.snapshots.mu[0]), name)))
    return known


def _constant(value: Array, _: Array) -> Array:
    return value


def _combined(conditions: Array, size: float, rng: np.random.Generator) -> Array:
    """Random combinations (SKETCH×e) of conditions (N'×e) relative to their size; zero if that is zero."""
    mixed = rng.standard_normal((SKETCH, len(conditions))) @ conditions
    return np.asarray(mixed / size if size else np.zeros_like(mixed))


def _worst(units: Array, space: Array) -> tuple[float, Array]:
    """Condition number of rows, unit columns (n×j) here, in a space, and the combination (j,) that it feels least."""
    if not units.shape[1]:  # without contact there is nothing to feel
        return 1.0, np.zeros(0)
    left, sigma, _ = np.linalg.svd(units.T @ space)
    smallest = float(sigma.min(initial=np.inf)) if len(sigma) == units.shape[1] else 0.0
    return float(sigma.max(initial=0.0)) / smallest if smallest else np.inf, left[:, -1:].sum(axis=1)


def cubature(conditions: Array, tolerance: float) -> tuple[Indices, Array]:
    """Few columns (j,) of conditions (k×e) and weights (j,) > 0 with which they have about the sum of all.

    Nonnegative least squares after Lawson and Hanson (1974), ended at a relative residual as by Farhat et al. (2015).
    """
    total = conditions.sum(axis=1)
    chosen, weights, residual = list[int](), np.zeros(conditions.shape[1]), total
    while np.linalg.norm(residual) > tolerance * np.linalg.norm(total):
        slopes = conditions.T @ residual
        slopes[chosen] = -np.inf
        best = int(np.argmax(slopes))
        if not slopes[best] > 0.0:
            break  # the least residual there is
        chosen.append(best)
        while True:
            solved = np.linalg.lstsq(conditions[:, chosen], total, rcond=None)[0]
            if solved.min() > 0.0:
                break
            present = weights[chosen]
            falling = solved <= 0.0
            step = float(np.min(present[falling] / (present[falling] - solved[falling])))
            weights[chosen] = present + step * (solved - present)
            dropped = {chosen[k] for k in np.flatnonzero(falling) if weights[chosen[k]] <= 1e-14 * weights.max()}
            weights[list(dropped)] = 0.0
            chosen = [k for k in chosen if k not in dropped]
        weights[:] = 0.0
        weights[chosen] = solved
        residual = total - conditions[:, chosen] @ solved
    rows = np.sort(np.array(chosen, int))
    return rows, weights[rows]
