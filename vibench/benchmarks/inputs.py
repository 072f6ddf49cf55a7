"""What the stages of a problem need from those before, made once by vibench's own functions; never timed here."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from vibench.arrays import Array
from vibench.benchmarks.cases import PrimalChoice, ReducedSpaces, Setting, TimedProblem
from vibench.errors import VibenchError, in_a_line
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Stop
from vibench.interfaces.validation import checked_assembly, training_parameters, validation_parameters
from vibench.model.affine import AffineMember, affine_decomposition
from vibench.model.errors import ReferenceSolutions
from vibench.offline.reduction import Reduction
from vibench.offline.sweep import Snapshots, high_fidelity_sweep
from vibench.plugins.kinds import DUAL, PRIMAL, PROBLEM
from vibench.plugins.registry import find
from vibench.reduction.pod import pod

P = ParamSpec("P")
T = TypeVar("T")

SEED = 2022
QUERIES = 8
"""Validation parameters that queries are asked at in turn."""

INTERPOLATION = 1e-6
"""Tolerance of the separation."""

SOLVER, ACCURACY = "piqp", 1e-10
"""QP solver of complete queries, and what it is asked for."""


@dataclass(frozen=True)
class ValidationQuery:
    """A validation parameter (d,), the matrices there, and the high-fidelity solution."""

    mu: Array
    vi: VariationalInequality
    exact: ReferenceSolutions


class InputError(VibenchError):
    """What a benchmark needs cannot be made."""


def _once(make: Callable[Concatenate[StageInputs, P], T]) -> Callable[Concatenate[StageInputs, P], T]:
    """A method that makes what it returns once for all benchmarks; where it fails, all fail with the same line."""

    @wraps(make)
    def made(self: StageInputs, /, *args: P.args, **kwargs: P.kwargs) -> T:
        key = (make.__name__, *args)
        if key not in self.made:
            try:
                self.made[key] = make(self, *args, **kwargs)
            except InputError as error:
                self.made[key] = error
            except (Exception, SystemExit) as error:  # noqa: BLE001  plugins are code of strangers
                self.made[key] = InputError(f"{self.case}, {make.__name__}: {in_a_line(error)}")
        if isinstance(value := self.made[key], InputError):
            raise value
        return value  # type: ignore[no-any-return]

    return made


class StageInputs:
    """The problem of a case and what comes of it.

    The setting says where V_N and the cone stop, unless a method is told, and what completes a model of which one part
    is timed.
    """

    def __init__(self, case: TimedProblem, setting: Setting) -> None:
        self.case, self.usual, self.primal = case, setting.spaces, setting.primal
        self.made: dict[Hashable, Any] = {}

    def about(self) -> dict[str, object]:
        """Problem, resolution and dimensions of the spaces."""
        case, problem = self.case, self.problem
        return {"problem": case.problem, "resolution": case.resolution, "n": problem.V.dim, "m": problem.W.dim}

    @property
    @_once
    def problem(self) -> Problem:
        """The problem."""
        created: Problem = find(PROBLEM, self.case.problem).create(self.case.options)
        return created

    @property
    @_once
    def training(self) -> Array:
        """The training parameters (P×d)."""
        return training_parameters(self.problem)

    @property
    @_once
    def snapshots(self) -> Snapshots:
        """High-fidelity solutions at the training parameters."""
        return high_fidelity_sweep(self.problem, self.training)

    @property
    @_once
    def members(self) -> Mapping[str, AffineMember]:
        """The members as sums of parameter-independent terms, or samples of them."""
        return affine_decomposition(self.problem, self.training, INTERPOLATION)

    @property
    @_once
    def queries(self) -> list[ValidationQuery]:
        """The validation parameters, with what is exact there."""
        problem, snapshots = self.problem, self.snapshots
        mus = validation_parameters(problem, QUERIES, SEED)
        scales = float(problem.V.norm(snapshots.u).max()), float(problem.W.norm(snapshots.lam).max())
        exact = [ReferenceSolutions(s.u[:, None], s.lam[:, None], *scales) for s in solve_all(problem, mus)]
        return [ValidationQuery(mu, checked_assembly(problem, mu), one) for mu, one in zip(mus, exact, strict=True)]

    @_once
    def reduction(self, spaces: ReducedSpaces, primal: PrimalChoice | None = None) -> Reduction:
        """V_N and the cone at some spaces, and the enrichment where there is a primal strategy.

        `given()` makes the same reduction anew, whose models have nothing in store from earlier queries.
        """
        dual = find(DUAL, spaces.dual).create({})
        strategy = None if primal is None else find(PRIMAL, primal.name).create({})
        tolerance = None if primal is None else primal.tolerance
        reduction = Reduction(
            self.problem, dual, strategy, spaces.modes, spaces.generators, tolerance,
            assembly="reduced", interpolation=INTERPOLATION, solver=SOLVER, accuracy=ACCURACY,
        ).given(snapshots=self.snapshots, parameters=self.training)  # fmt: skip
        if primal is not None:
            before = self.reduction(spaces)
            reduction = reduction.given(pod=before.pod, cone=before.cone, multipliers=before.multipliers)
        return reduction.given(
            pod=reduction.pod,
            cone=reduction.cone,
            multipliers=reduction.multipliers,
            enrichment=reduction.enrichment,
        )

    @_once
    def online(self, spaces: ReducedSpaces, primal: PrimalChoice) -> Reduction:
        """The reduction with projected members, or with the reason why queries have to be assembled in full."""
        reduction = self.reduction(spaces, primal).given(members=self.members)
        return reduction.given(operators=reduction.operators)

    @_once
    def modes(self, stop: Stop) -> int:
        """N of the POD."""
        return len(pod(self.snapshots.u, self.problem.V, stop).basis.T)

    def dimensions(self, spaces: ReducedSpaces) -> tuple[int, int]:
        """N and R of some spaces."""
        reduction = self.reduction(spaces)
        return reduction.pod.basis.shape[1], reduction.cone.size


def solve_all(problem: Problem, mus: Array) -> list[HighFidelitySolution]:
    """High-fidelity solutions at parameters (P×d), one after the other."""
    solver = HighFidelitySolver(problem)
    return [solver.solve(mu) for mu in mus]
