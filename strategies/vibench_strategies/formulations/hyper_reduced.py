"""Hyper-reduction: integration over few elements, and the pressures of the cone on few contact rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Gt, Lt

from vibench import (
    AffineSum,
    Array,
    Asked,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    Problem,
    UnsupportedError,
    VariationalInequality,
)
from vibench.reduction import constraint_classes
from vibench_strategies.formulations.reduced_domain import ReducedDomain, reduced_elements, reduced_rows
from vibench_strategies.formulations.reduced_programs import FixedSpacesModel, refuse_free, solved
from vibench_strategies.infsup_greedy import InfSupGreedy

if TYPE_CHECKING:
    from vibench import Reduction

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

    def build(self, offline: Reduction) -> Mapping[str, Any]:
        """The enriched basis, and rows and elements with their weights."""
        problem, snapshots, members = offline.problem, offline.snapshots, self._integrated(offline.problem)
        if missing := " and ".join(sorted(members - problem.elementwise)):
            raise UnsupportedError(f"hyper-reduction integrates {missing} by elements, the problem does not")
        refuse_free(offline.cone)
        known = {name: getattr(offline, name) for name in ("snapshots", "pod", "cone", "multipliers")}
        greedy = replace(offline, primal=InfSupGreedy(), tolerance=1.0 / self.condition).given(**known)
        vectors = greedy.projection.fixed_basis
        chosen = np.unique(np.linspace(0, len(snapshots.mu) - 1, PARAMETERS).round().astype(int))
        mus, u = snapshots.mu[chosen], snapshots.u[:, chosen]
        constraints = constraint_classes(problem.constraint(mu)[0] for mu in mus).representatives
        works = [np.asarray(B @ vectors) for B in constraints]
        rows, shares = reduced_rows(offline.cone.generators, works, self.tolerance)
        built = {"vectors": vectors, "rows": rows, "shares": shares}
        if members:
            found = reduced_elements(problem, members, vectors, mus, u, self.tolerance)
            built |= {"elements": found[0], "weights": found[1]}
        return built

    def model(self, offline: Reduction, built: Mapping[str, Any]) -> FormulationModel:
        """The model on the reduced domain."""
        return HyperReducedContact(offline, built, self._integrated(offline.problem))

    def _integrated(self, problem: Problem) -> frozenset[str]:
        """Members that are integrated at every query."""
        both = frozenset({"A", "f"})
        return both if self.integrate == "all" else both - problem.constant - problem.affine.keys()


class HyperReducedContact(FixedSpacesModel):
    """Assembles on the reduced domain alone, apart from what is projected once."""

    def __init__(self, offline: Reduction, built: Mapping[str, Any], integrated: frozenset[str]) -> None:
        super().__init__(V := built["vectors"], chi := offline.cone.generators)
        self.enrichment = V.shape[1] - offline.pod.basis.shape[1]
        self._problem, self._tests = problem, tests = offline.problem, np.zeros_like(chi)
        tests[built["rows"]] = built["shares"][:, None] * chi[built["rows"]]
        projections: dict[str, Callable[[Any], Array]] = {
            "A": lambda A: V.T @ np.asarray(A @ V),
            "f": lambda f: V.T @ f,
            "B": lambda B: tests.T @ np.asarray(B @ V),
            "g": lambda g: tests.T @ np.minimum(g, np.finfo(float).max),  # pressures are zero where g is infinite
        }
        vi = problem.assemble(offline.snapshots.mu[0])
        sums = dict(problem.affine) | {name: AffineSum.of([(1.0, getattr(vi, name))], ()) for name in problem.constant}
        self._once = {name: of.mapped(projections[name]).at for name, of in sums.items() if name not in integrated}
        if integrated:
            self._domain = ReducedDomain(problem, integrated, V, built["elements"], built["weights"])
        self._loads = problem.contact_loads(tests) if problem.has_contact else None
        self._touched = V[problem.contact_dofs] if problem.has_contact else V

    def solve(self, mu: Array, asked: Asked) -> FormulationAnswer:
        """The program of the reduced domain."""
        members = {name: of(mu) for name, of in self._once.items()}
        if not {"A", "f"} <= members.keys():
            members |= self._domain.at(mu)
        if not {"B", "g"} <= members.keys():
            if self._loads is None:
                B, g = self._problem.constraint(mu)
                members |= {"B": self._tests.T @ np.asarray(B @ self._touched), "g": self._tests.T @ g}
            else:
                loads, members["g"] = self._loads.at(mu)
                members["B"] = loads.T @ self._touched
        return solved(asked, VariationalInequality(**members))
