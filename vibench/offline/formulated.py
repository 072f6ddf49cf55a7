"""A formulation built on an offline phase: queries at any parameter, and what is said of their answers.

What a formulation returns is judged before anything is measured of it: a vector of the wrong size, one that is not
finite, and a negative multiplier are broken answers, whatever the formulation says of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError
from vibench.interfaces.formulations import Asked, Formulation, FormulationAnswer, FormulationModel, Multiplier
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.strategies import Cone, Enrichment, Kind
from vibench.model.error_bounds import ErrorBounds, bound_errors_at
from vibench.model.errors import high_fidelity_residuals, residual_multiplier
from vibench.offline.assemblies import assemblies
from vibench.offline.models import Parameters, parameter_in
from vibench.plugins import registry
from vibench.qp.solve import solve_qp, takes_start
from vibench.qp.status import Status
from vibench.qp.verification import RECOGNISED, QPSolution, Residuals, verify
from vibench.reduction.pod import POD
from vibench.storage.serialisation import storable
from vibench.text import brief
from vibench.timing import timed

if TYPE_CHECKING:
    from vibench.offline.reduction import Reduction

for _step in (POD, Cone, Kind, Enrichment):
    storable(_step)  # steps of other offline phases, which a formulation may build

ACCURACY = 1e-7
"""What formulations without an axis of accuracies are asked for."""


class CellSolver:
    """The QP solver of a query, which keeps the last program that it was given and its solution."""

    def __init__(self, solver: str | None, accuracy: float) -> None:
        self._solver, self._accuracy = solver, accuracy
        self._extra = {} if solver is None else registry.qp_solver(solver)
        self.last: tuple[VariationalInequality, QPSolution] | None = None

    def __call__(
        self,
        program: VariationalInequality,
        *,
        factor: Array | None = None,
        start: tuple[Array, Array] | None = None,
    ) -> QPSolution:
        """The solution of a dense program; see `vibench.interfaces.formulations.SolveQP`."""
        if self._solver is None:
            raise NumericalError("the formulation solves a quadratic program without 'solvers' among its axes (`uses`)")
        begun = None
        if start is not None and takes_start(self._solver):
            begun = QPSolution(*start, "the start")
        solution = solve_qp(program, self._solver, self._accuracy, self._extra, factor, begun)
        self.last = program, solution
        return solution

    def verdict(self, slackened: float = 1.0) -> tuple[Status, str, Residuals | None]:
        """What verification says of the last solution, to some multiple of the accuracy; ok if there is none."""
        if self.last is None:
            return Status.OK, "", None
        return verify(*self.last, slackened * self._accuracy)


@dataclass(frozen=True)
class Verdict:
    """What is said of an answer: its status and why it is not ok, the pair u (n,), λ (m,) unless it is broken.

    `residuals` are those of the last quadratic program that it took, if any.
    """

    status: Status
    reason: str
    pair: tuple[Array, Array] | None = None
    residuals: Residuals | None = None


@dataclass(frozen=True, eq=False)
class Formulated:
    """A model of a formulation, and the solver and accuracy of its queries.

    Attributes
    ----------
    formulation, offline
        What made it, and from what.
    built
        What `formulation.build` returned.
    solver, accuracy
        QP solver of its queries, `None` for formulations without, and the relative accuracy that they have to reach.
    """

    formulation: Formulation
    offline: Reduction
    built: Mapping[str, Any] = field(repr=False)
    solver: str | None
    accuracy: float = ACCURACY

    @cached_property
    def model(self) -> FormulationModel:
        """What answers queries.

        Raises
        ------
        NumericalError
            If the formulation makes something else.
        """
        made = self.formulation.model(self.offline, self.built)
        if not isinstance(made, FormulationModel):
            raise NumericalError(f"the formulation made a {type(made).__name__}, expected a FormulationModel")
        sizes = {"dimension": getattr(made, "dimension", None), "generators": made.generators or 0}
        for name, size in sizes.items():
            if not isinstance(size, Integral) or size < 0:
                raise NumericalError(f"`{name}` of the model is {brief(repr(size), 80)}, expected a whole number")
        return made

    def asked(self, start: FormulationAnswer | None = None) -> tuple[Asked, CellSolver]:
        """What a query is asked for, and the solver that it is given."""
        solver = CellSolver(self.solver, self.accuracy)
        return Asked(self.accuracy, solver, start), solver

    def check_repeated(self, mu: Array, answer: FormulationAnswer, solver: CellSolver) -> None:
        """Refuse an answer that is timed once more and is not ok to some multiple of the accuracy.

        Raises
        ------
        NumericalError
            Naming the fault.
        """
        found = self.judged(mu, answer, solver, RECOGNISED)
        if found.status is not Status.OK:
            raise NumericalError(f"timed at a parameter next to its own, {found.status.value}: {found.reason}")

    def judged(self, mu: Array, answer: FormulationAnswer, solver: CellSolver, slackened: float = 1.0) -> Verdict:
        """The verdict on an answer at mu (d,) that was found with this solver.

        Raises
        ------
        NumericalError
            If it is of another type or size.
        """
        if not isinstance(answer, FormulationAnswer):
            raise NumericalError(f"`solve` returned a {type(answer).__name__}, expected a FormulationAnswer")
        status, reason = Status(answer.outcome.value), answer.reason
        if answer.x is None:
            return Verdict(Status.FAILED if status is Status.OK else status, reason or "there is no answer")
        of_qp, why, residuals = solver.verdict(slackened)
        if of_qp.severity > status.severity:
            status, reason = of_qp, f"its last quadratic program: {why}"
        for name in ("x", "alpha"):
            _refuse_other_size(f"`solve` returned an answer whose {name} has", getattr(answer, name))
            if not _finite(getattr(answer, name)):
                return Verdict(Status.NONFINITE, f"{name} of the answer is not finite", residuals=residuals)
        u, lam = self.pair(mu, answer)
        if not (_finite(u) and _finite(lam)):
            return Verdict(Status.NONFINITE, "the reconstructed u or λ is not finite", residuals=residuals)
        if lam.min(initial=0.0) < 0.0:
            worst = f"{lam.min():.1e} in row {int(lam.argmin())}"
            return Verdict(Status.FAILED, f"a broken answer: λ has negative coefficients, as {worst}")
        return Verdict(status, reason, (u, lam), residuals)

    def pair(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
        """The pair u (n,), λ (m,) of an answer, of the right sizes; λ from the residual where the formulation has none.

        Raises a `NumericalError` that names the fault.
        """
        problem, declared = self.offline.problem, self.formulation.multiplier
        made = self.model.reconstruct(mu, answer)
        if not isinstance(made, tuple) or len(made) != 2:
            raise NumericalError(f"`reconstruct` returned a {type(made).__name__}, expected a pair (u, λ)")
        u, lam = made
        _refuse_other_size("`reconstruct` returned a u of", u, problem.V.dim)
        if (lam is None) != (declared is Multiplier.RESIDUAL):
            found = "no λ" if lam is None else "a λ"
            raise NumericalError(f"`reconstruct` returned {found}, and the formulation declares `{declared.value}`")
        if lam is None:
            kept = assemblies(problem)
            return u, residual_multiplier(kept.at(mu), kept.energy_at(mu), u)
        _refuse_other_size("`reconstruct` returned a λ of", lam, problem.W.dim)
        return u, lam

    def solve(self, mu: Parameters) -> FormulatedSolution:
        """Answer a query at a parameter, and judge it, in this process without the limits of a study.

        Raises
        ------
        RequestError
            If mu is not a parameter of the problem.
        NumericalError
            If the answer is of another type or size.
        """
        at = parameter_in(self.offline.problem.parameters, mu)
        asked, solver = self.asked()
        answer, seconds = timed(lambda: self.model.solve(at, asked))
        return FormulatedSolution(at, answer, self.judged(at, answer, solver), seconds.cpu, self)


@dataclass(frozen=True, eq=False)
class FormulatedSolution:
    """The answer of a formulation at mu (d,), the verdict on it, and the CPU seconds that it took."""

    mu: Array
    answer: FormulationAnswer
    verdict: Verdict
    seconds: float
    _of: Formulated = field(repr=False)

    @property
    def status(self) -> Status:
        """What is said of the answer."""
        return self.verdict.status

    @property
    def reason(self) -> str:
        """Why it is not ok; "" if it is."""
        return self.verdict.reason

    @property
    def u(self) -> Array:
        """The primal solution u (n,)."""
        return self._pair[0]

    @property
    def lam(self) -> Array:
        """The multiplier λ (m,)."""
        return self._pair[1]

    @cached_property
    def outputs(self) -> dict[str, float]:
        """Values of the problem's quantities of interest, by name."""
        given = self.mu[None], self.u[:, None], self.lam[:, None]
        return {output.name: float(output.values(*given)[0]) for output in self._of.offline.problem.outputs}

    @cached_property
    def residuals(self) -> Residuals:
        """Natural KKT residuals of the high-fidelity problem, at the cost of its factorisations at mu."""
        kept = assemblies(self._of.offline.problem)
        return high_fidelity_residuals(kept.at(self.mu), kept.energy_at(self.mu), *self._pair)

    @cached_property
    def error_bounds(self) -> ErrorBounds:
        """Proved bounds on the errors of u and λ in four norms, likewise."""
        kept = assemblies(self._of.offline.problem)
        alpha, beta = kept.coercivity_at(self.mu), kept.energy_inf_sup_at(self.mu)
        return bound_errors_at(kept.at(self.mu), kept.energy_at(self.mu), alpha, beta, *self._pair)

    @property
    def _pair(self) -> tuple[Array, Array]:
        if self.verdict.pair is None:
            raise RequestError(f"there is no answer at mu = {self.mu.tolist()}: {self.status.value}: {self.reason}")
        return self.verdict.pair


def check_built(built: object) -> Mapping[str, Any]:
    """What a formulation has built, refused if it is no mapping with texts as names.

    Raises
    ------
    NumericalError
        Naming what it is.
    """
    if not isinstance(built, Mapping) or not all(isinstance(name, str) for name in built):
        raise NumericalError(f"`build` returned a {type(built).__name__}, expected a mapping whose names are texts")
    return built


def _finite(vector: Array | None) -> bool:
    return vector is None or bool(np.all(np.isfinite(vector)))


def _refuse_other_size(what: str, vector: object, size: int | None = None) -> None:
    """Refuse what is no vector of real numbers, of this size if one is given."""
    if vector is None and size is None:
        return
    array = vector if isinstance(vector, np.ndarray) else None
    if array is None or array.dtype != np.float64 or array.shape != (array.size if size is None else size,):
        found = f"the type {type(vector).__name__}" if array is None else f"{array.dtype} and the shape {array.shape}"
        raise NumericalError(f"{what} {found}, expected float64 and ({'count' if size is None else size},)")
