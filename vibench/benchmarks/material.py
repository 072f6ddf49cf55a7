"""What the stages of a problem need from those before, made once by vibench's own functions; never timed here."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import pytest

from vibench.arrays import Array
from vibench.benchmarks.cases import Case, Primal, Spaces
from vibench.errors import in_a_line
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Enrichment, Offline
from vibench.interfaces.validation import (
    check_cone,
    check_enrichment,
    checked_assembly,
    training_parameters,
    validation_parameters,
)
from vibench.model.affine import AffineMember, affine_decomposition
from vibench.model.errors import ReferenceSolutions
from vibench.model.galerkin import ReducedModel
from vibench.model.hyperreduced import HyperReducedModel, Operators, hyper_reduce, reason_for_full_assembly
from vibench.offline.models import AnyReducedModel
from vibench.reduction.pod import POD, pod
from vibench.stability.infsup import multipliers
from vibench.stages.offline import ReducedCone
from vibench.study import registry

T = TypeVar("T")

SEED = 2022
QUERIES = 8
"""Validation parameters that queries are asked at in turn."""

INTERPOLATION = 1e-6
"""Tolerance of the separation."""


@dataclass(frozen=True)
class Query:
    """A validation parameter (d,), the matrices there, and the high-fidelity solution."""

    mu: Array
    vi: VariationalInequality
    exact: ReferenceSolutions


class Material:
    """The problem of a case and what comes of it, each made when it is first asked for.

    What cannot be made fails every benchmark that asks for it, with the same line.

    Parameters
    ----------
    case
        The problem.
    usual
        Where V_N and the cone stop, unless a method is told.
    """

    def __init__(self, case: Case, usual: Spaces) -> None:
        self.case = case
        self.usual = usual
        self._made: dict[Hashable, tuple[Any, str]] = {}

    def _once(self, what: str, make: Callable[[], T], *which: Hashable) -> T:
        key = (what, *which)
        if key not in self._made:
            try:
                self._made[key] = make(), ""
            except (Exception, SystemExit) as error:  # noqa: BLE001  plugins are code of strangers
                self._made[key] = None, f"{self.case}, {what}: {in_a_line(error)}"
        found, why = self._made[key]
        if why:
            pytest.fail(why, pytrace=False)
        return found  # type: ignore[no-any-return]

    @property
    def problem(self) -> Problem:
        """The problem."""
        case = self.case
        found: Problem = self._once("problem", lambda: registry.create("problem", case.problem, case.options))
        return found

    @property
    def training(self) -> Array:
        """The training parameters (P×d)."""
        problem = self.problem
        return self._once("training set", lambda: training_parameters(problem))

    @property
    def sweep(self) -> list[HighFidelitySolution]:
        """High-fidelity solutions at the training parameters."""
        problem, training = self.problem, self.training
        return self._once("high-fidelity sweep", lambda: solve_all(problem, training))

    @property
    def snapshots(self) -> tuple[Array, Array]:
        """Columns of u (n×P) and λ (m×P)."""
        sweep = self.sweep
        return self._once(
            "snapshots", lambda: (np.column_stack([s.u for s in sweep]), np.column_stack([s.lam for s in sweep]))
        )

    def pod(self, spaces: Spaces | None = None) -> POD:
        """V_N."""
        V, u, spaces = self.problem.V, self.snapshots[0], spaces or self.usual
        return self._once("POD", lambda: pod(u, V, spaces.pod), spaces.pod)

    def cone(self, spaces: Spaces | None = None) -> ReducedCone:
        """The reduced cone."""
        W, lam, spaces = self.problem.W, self.snapshots[1], spaces or self.usual

        def make() -> ReducedCone:
            found = registry.create("dual strategy", spaces.dual, {}).reduce(lam, W, spaces.cone)
            check_cone(found, W)
            return ReducedCone(found, multipliers(found.generators, W, found.free))

        return self._once(f"cone of {spaces.dual}", make, spaces.cone)

    def offline(self, spaces: Spaces | None = None) -> Offline:
        """What primal strategies start from."""
        reduced = self.cone(spaces)
        return Offline(self.problem, self.pod(spaces).basis, reduced.cone, reduced.prepared.span, self.training)

    def enrichment(self, primal: Primal, spaces: Spaces | None = None) -> Enrichment:
        """What a primal strategy adds."""
        offline = self.offline(spaces)

        def make() -> Enrichment:
            found = registry.create("primal strategy", primal.name, {}).build(offline, primal.tolerance)
            return check_enrichment(found, offline.problem.V, offline.basis)

        return self._once(f"enrichment by {primal}", make, spaces)

    def model(self, primal: Primal, spaces: Spaces | None = None) -> ReducedModel:
        """A new reduced model: it has nothing in store from earlier queries."""
        return model_with(self.offline(spaces), self.enrichment(primal, spaces))

    @property
    def members(self) -> Mapping[str, AffineMember]:
        """The members as sums of parameter-independent terms, or samples of them."""
        problem, training = self.problem, self.training
        return self._once("separation", lambda: affine_decomposition(problem, training, INTERPOLATION))

    def operators(self, primal: Primal, spaces: Spaces | None = None) -> Operators | str:
        """The projected members, or why queries have to be assembled in full."""
        model, members = self.model(primal, spaces), self.members
        return self._once(
            f"projection of members with {primal}",
            lambda: reason_for_full_assembly(model, members) or hyper_reduce(model, members),
            spaces,
        )

    def online(self, primal: Primal, spaces: Spaces | None = None) -> tuple[AnyReducedModel, str]:
        """A new model that assembles in the quickest way there is, and why that is in full; "" where it is not."""
        model, operators = self.model(primal, spaces), self.operators(primal, spaces)
        return (model, operators) if isinstance(operators, str) else (HyperReducedModel(model, operators), "")

    @property
    def queries(self) -> list[Query]:
        """The validation parameters, with what is exact there."""
        problem, (u, lam) = self.problem, self.snapshots
        scales = float(problem.V.norm(u).max()), float(problem.W.norm(lam).max())

        def make() -> list[Query]:
            mus = validation_parameters(problem, QUERIES, SEED)
            exact = [ReferenceSolutions(s.u[:, None], s.lam[:, None], *scales) for s in solve_all(problem, mus)]
            return [Query(mu, checked_assembly(problem, mu), known) for mu, known in zip(mus, exact, strict=True)]

        return self._once("validation", make)


def solve_all(problem: Problem, mus: Array) -> list[HighFidelitySolution]:
    """High-fidelity solutions at parameters (P×d), one after the other."""
    solver = HighFidelitySolver(problem)
    return [solver.solve(mu) for mu in mus]


def model_with(offline: Offline, enrichment: Enrichment) -> ReducedModel:
    """The reduced model with an enrichment."""
    return ReducedModel(offline.problem, offline.basis, enrichment, offline.cone.rays, offline.span)


def spread(parameters: Array, count: int) -> Sequence[Array]:
    """At most `count` of the parameters (P×d), the first, the last and some between."""
    return [parameters[k] for k in np.unique(np.linspace(0, len(parameters) - 1, count).round().astype(int))]
