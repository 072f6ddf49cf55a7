"""Decisions of a calibration, taken where error bounds prove them, and by the high-fidelity model elsewhere.

Bounds of outputs give an interval of the misfit. Whether one parameter fits better than another is decided where their
intervals are apart; otherwise the high-fidelity model is asked. A method that consists of such decisions takes the path
of the high-fidelity model, step by step.

**The accuracy of the high-fidelity solution.** Its natural residuals are at most ε = `ACCURACY`. With S the energy of
the solution and F that of its contact force, its errors in the norms of the bounds are at most δ with

    δ² ≤ ε² F² + 2ε F (F + Σ_i λ_i ‖B_i‖) ≤ (3 √ε P)²,    P ≥ S and Σ_i λ_i ‖B_i‖ ≥ F,    ‖B_i‖ in the norm of A⁻¹

(docs/mathematics.md, "Error bounds"). P follows from the reduced solution and its bounds: with d_i ≥ ‖B_i‖,
Σ λ_i d_i ≤ Σ λ_N,i d_i + ‖d‖_{W⁻¹} ‖λ − λ_N‖_W. Intervals are widened by δ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf, sqrt
from typing import Annotated, NamedTuple

import numpy as np
from cachetools import LRUCache

from vibench.arrays import Array, is_sound
from vibench.calibration.data import Data
from vibench.errors import NumericalError, RequestError, unknown_name
from vibench.highfidelity.active_set import ACCURACY, HighFidelitySolver
from vibench.interfaces.formulations import FormulationAnswer
from vibench.interfaces.problem import Contact, Problem
from vibench.linalg.inner_product import InnerProduct
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee, output_coefficients, output_weights
from vibench.model.certificates.bounds import OnlineBound, output_error_bound
from vibench.model.galerkin import contact_at
from vibench.model.hyperreduced import HyperReducedModel
from vibench.offline.models import Model
from vibench.plugins import registry
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution
from vibench.signatures import Rule, Seed, constructed
from vibench.timing import timed


class RefutedError(NumericalError):
    """A high-fidelity solution contradicts the bounds: decisions that rest on them prove nothing."""


class Prediction(NamedTuple):
    """Outputs (k,) of a reduced model, bounds (k,) of their distances from the high-fidelity ones, and their worth."""

    outputs: Array
    bounds: Array
    guarantee: Guarantee


Predict = Callable[[Array], Prediction]


class Sensors:
    """Outputs of a problem by their names; a `RequestError` if there is no such output."""

    def __init__(self, problem: Problem, names: tuple[str, ...]) -> None:
        known = {output.name: output for output in problem.outputs}
        for name in names:
            if name not in known:
                raise unknown_name("output of the problem", name, known)
        self.problem, self.outputs = problem, tuple(known[name] for name in names)

    def of(self, mu: Array, u: Array, lam: Array) -> Array:
        """The outputs (k,) of a solution u (n,), λ (m,) at mu (d,)."""
        return np.array([one.values(mu[None], u[:, None], lam[:, None])[0] for one in self.outputs])

    def high_fidelity(self) -> Callable[[Array], Array]:
        """From mu (d,) to the outputs (k,) of the high-fidelity solution."""
        solver = HighFidelitySolver(self.problem)

        def ask(mu: Array) -> Array:
            solution = solver.solve(mu)
            return self.of(mu, solution.u, solution.lam)

        return ask


class BoundedSensors:
    """Outputs of a reduced model with proved or verified bounds.

    Raises a `RequestError` if the model has no bounds, an output is not linear, or no inf-sup constant is proved.
    """

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        self.model, outputs = model, Sensors(model.problem, names).outputs
        if model.certificate is None:
            raise RequestError("the model has no error bounds: a calibration needs one with bounds = true")
        self.certificate, self.base = model.certificate, model.certificate.base
        for output in outputs:
            if not output.linear:
                linear = ", ".join(one.name for one in model.problem.outputs if one.linear)
                raise RequestError(f"'{output.name}' is no linear output, and has no bound; linear: {linear or 'none'}")
        if not self.base.inf_sup.value > 0.0:
            raise RequestError(f"λ has no bound, which the accuracy of solutions needs: {self.base.inf_sup.note}")
        self.weights = [output_weights(model.problem, self.base, output) for output in outputs]
        pairs = [output_coefficients(model.problem, output) for output in outputs]
        self._of_u, of_lam = (np.array(rows) for rows in zip(*pairs, strict=True))
        reduced = model.reduced
        # Where the basis depends on the parameter there is no one map from x to the outputs.
        self._of_x: Array | None = None
        if isinstance(reduced, HyperReducedModel) and reduced.space is None:
            self._of_x = self._of_u @ reduced.basis
        self._of_alpha = of_lam @ reduced.generators

    def __call__(self, mu: Array) -> Prediction:
        """The outputs at mu (d,), with bounds that allow for the accuracy of the high-fidelity solution."""
        model, problem = self.model, self.model.problem
        assembled = model.online.program(mu)
        if model.solver is None:
            answer: FormulationAnswer | QPSolution = model.online.solve(mu, model.settings()[0])
        else:
            extra = registry.qp_solver(model.solver)
            answer = solve_qp(assembled.program, model.solver, model.accuracy, extra, assembled.factor)
        # Bounds hold for any pair: how well it solves the program shows in their size alone.
        if answer.x is None or answer.alpha is None or not (is_sound(answer.x) and is_sound(answer.alpha)):
            return self._nothing
        x, alpha = answer.x, np.maximum(answer.alpha, 0.0)
        # Evaluated once for the bounds and the accuracy.
        contact = assembled.evaluated.contact or contact_at(problem, mu)
        assembled = replace(assembled, evaluated=replace(assembled.evaluated, contact=contact))
        bound, _ = self.certificate.certify(problem, mu, assembled, x, alpha, CorrectionMode.NONE)
        if bound.guarantee is Guarantee.NONE:
            return self._nothing
        of_u = self._of_u @ assembled.reconstruct(x[:, None])[:, 0] if self._of_x is None else self._of_x @ x
        lam = model.reduced.generators @ alpha
        delta = distance_of_computed(problem.W, self.base.compliance, contact, lam, bound)
        if not delta < inf:
            return self._nothing
        widened = replace(bound, u_energy=bound.u_energy + delta, lam=bound.lam + delta / bound.inf_sup)
        bounds = [output_error_bound(weight, self.base, widened) for weight in self.weights]
        return Prediction(of_u + self._of_alpha @ alpha, np.array(bounds), bound.guarantee)

    @property
    def _nothing(self) -> Prediction:
        # Nothing is known here, and nothing is claimed: the high-fidelity model is asked.
        count = len(self.weights)
        return Prediction(np.zeros(count), np.full(count, inf), Guarantee.CERTIFIED)


def distance_of_computed(W: InnerProduct, compliance: Array, contact: Contact, lam: Array, bound: OnlineBound) -> float:
    """The largest distance δ of the computed high-fidelity solution from the exact one.

    `bound` has the bounds of a reduced solution with the multiplier λ_N = `lam` (m,).
    """
    # ‖B_i‖ is at most the sum of |B_ij| times the norms of the unit loads.
    reach = abs(contact.B) @ np.sqrt(np.diag(compliance) / bound.coercivity)
    if not (bound.lam < inf and bound.relative < inf):
        return inf
    force = float(reach @ lam) + float(np.linalg.norm(W.whiten_functional(reach))) * bound.lam
    # ‖u_N‖ from the relative bound, u_energy over a lower bound of ‖u‖, with a tenth for its round-off.
    size = 1.1 * (bound.u_energy / bound.relative + 2.0 * bound.u_energy) if bound.relative > 0.0 else 0.0
    return 3.0 * sqrt(ACCURACY) * max(force, size)


@dataclass(eq=False)
class Interval:
    """What is known of the misfit at a parameter: bounds, which are equal once the high-fidelity model was asked."""

    lower: float
    upper: float
    # The misfit of the reduced model, by which decisions without bounds are taken.
    middle: float

    def below(self, other: Interval, shift: float) -> bool | None:
        """Whether this misfit is less than the other one plus a shift; `None` if the intervals do not decide."""
        if self.upper < other.lower + shift:
            return True
        return False if self.lower >= other.upper + shift else None


@dataclass
class Counts:
    """Decisions, those that asked, questions to the high-fidelity model, audits, and CPU seconds of both models.

    `wrong` are the decisions that the reduced model takes differently without bounds.
    """

    decisions: int = 0
    undecided: int = 0
    questions: int = 0
    audits: int = 0
    wrong: int = 0
    model_seconds: float = 0.0
    question_seconds: list[float] = field(default_factory=list)


@constructed
class Decisions:
    """Whether a parameter fits data better than another one, as the high-fidelity model says.

    Parameters
    ----------
    problem, data
        The problem, and the data that its outputs are compared with.
    predict
        Outputs with bounds: a `BoundedSensors`, or a `CertifiedProgram`; `None` asks the high-fidelity model always.
    audit
        Share of the decided decisions, drawn at random, for which the high-fidelity model is asked all the same.
    seed
        Of this draw.
    """

    def __init__(
        self, problem: Problem, data: Data, predict: Predict | None,
        audit: Annotated[float, Rule("a number from 0 to 1", lambda value: 0.0 <= value <= 1.0)] = 0.01, seed: Seed = 0,
    ) -> None:  # fmt: skip
        self.data, self.counts, self.guarantee = data, Counts(), Guarantee.CERTIFIED
        self._predict, self._ask = predict, Sensors(problem, data.sensors).high_fidelity()
        self._audit, self.random = audit, np.random.default_rng(seed)
        # Answers of the high-fidelity model, by the bytes of the parameter.
        self.answers: dict[bytes, float] = {}
        # Methods compare with what they saw last.
        self._recent: LRUCache[bytes, Interval] = LRUCache(1000)

    def interval(self, mu: Array) -> Interval:
        """What is known of the misfit at mu (d,), ½ (s − d)ᵀ C⁻¹ (s − d); minus that is the log-likelihood."""
        key = mu.tobytes()
        if (known := self._recent.get(key)) is None:
            known = self._recent[key] = self._estimated(mu)
            if key in self.answers:
                known.lower = known.upper = self.answers[key]
        return known

    def _estimated(self, mu: Array) -> Interval:
        if (predict := self._predict) is None:
            return Interval(0.0, inf, 0.0)
        (outputs, bounds, guarantee), seconds = timed(lambda: predict(mu))
        self.counts.model_seconds += seconds.cpu
        if guarantee is not Guarantee.CERTIFIED:
            self.guarantee = Guarantee.VERIFIED
        return Interval(*self.data.interval(outputs, bounds), self.data.misfit(outputs))

    def ask(self, mu: Array) -> float:
        """The misfit of the high-fidelity model at mu (d,), which is kept; a `RefutedError` if bounds exclude it."""
        key, known = mu.tobytes(), self.interval(mu)
        if key not in self.answers:
            outputs, seconds = timed(lambda: self._ask(mu))
            self.counts.questions += 1
            self.counts.question_seconds.append(seconds.cpu)
            misfit = self.data.misfit(outputs)
            if not known.lower <= misfit <= known.upper:
                found = f"the high-fidelity misfit {misfit:.6g} is not between {known.lower:.6g} and {known.upper:.6g}"
                raise RefutedError(f"the bounds are refuted at mu = {mu.tolist()}: {found}")
            self.answers[key] = misfit
        known.lower = known.upper = self.answers[key]
        return self.answers[key]

    def less(self, a: Array, b: Array, shift: float = 0.0) -> bool:
        """Whether the high-fidelity misfit at a (d,) is less than that at b (d,) plus a shift.

        Raises a `RefutedError` if an answer of the high-fidelity model contradicts the bounds.
        """
        one, other = self.interval(a), self.interval(b)
        verdict = one.below(other, shift)
        self.counts.decisions += 1
        if verdict is None:
            self.counts.undecided += 1
            # Later decisions compare with b again, the present state of a chain: it is asked first.
            for mu in (b, a):
                self.ask(mu)
                if (verdict := one.below(other, shift)) is not None:
                    break
        elif self._predict is not None and self.random.random() < self._audit:
            self.counts.audits += 1
            self.ask(a)
            self.ask(b)
        self.counts.wrong += bool(self._predict is not None and (one.middle < other.middle + shift) != verdict)
        return bool(verdict)

    @property
    def is_exact(self) -> bool:
        """Whether all bounds so far are certified."""
        return self.guarantee is Guarantee.CERTIFIED

    @property
    def claim(self) -> str:
        """What holds of the decisions so far."""
        return "exact" if self.is_exact else f"no contradiction in {self.counts.audits} audits"
