"""Decisions of a calibration, taken where error bounds prove them, and by the high-fidelity model elsewhere.

Bounds of outputs give an interval of the misfit. Whether one parameter fits better than another is decided where their
intervals are apart; otherwise the high-fidelity model is asked. A method that consists of such decisions takes the path
of the high-fidelity model, step by step.

Bounds are distances from the exact solution, decisions those of the computed one, whose natural residuals are at most ε
(`Sensors.accuracy`). Bounds grow by the distance of these two, δ = 2 √ε P, where P is at least ‖u‖ and Σ λ_i ‖B_i‖: see
docs/mathematics.md, "Decisions".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, nan, sqrt
from typing import Annotated, NamedTuple

import numpy as np
import scipy.sparse as sp
from cachetools import LRUCache

from vibench.arrays import Array, SparseMatrix, is_sound
from vibench.calibration.data import Data, Sensors, outputs_of
from vibench.errors import NumericalError, RequestError, UnsupportedError
from vibench.interfaces.dual_sets import DualSet
from vibench.interfaces.formulations import FormulationAnswer
from vibench.interfaces.parameters import ParameterBox, outside
from vibench.interfaces.problem import Problem
from vibench.linalg import EPS
from vibench.linalg.inner_product import InnerProduct
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee, output_coefficients
from vibench.model.certificates.bounds import OnlineBound, output_error_bound
from vibench.model.galerkin import Evaluated, contact_at
from vibench.model.hyperreduced import HyperReducedModel
from vibench.model.proved_norms import ProvedNorms
from vibench.offline import c_source
from vibench.offline.compiled import loaded
from vibench.offline.exported import exported
from vibench.offline.models import Model
from vibench.qp.verification import QPSolution, extended
from vibench.signatures import Rule, Seed, bordered, bordered_constructor
from vibench.stability.coercivity import share_of_diagonal
from vibench.timing import timed


class RefutedError(NumericalError):
    """A high-fidelity solution contradicts the bounds: decisions that rest on them prove nothing."""


class Prediction(NamedTuple):
    """Outputs (k,) of a reduced model, bounds (k,) of their distances from the high-fidelity ones, and their worth.

    The `correlation` (k×k) of these distances is that of `Data.interval`.
    """

    outputs: Array
    bounds: Array
    guarantee: Guarantee
    correlation: Array | None = None

    @classmethod
    def without_bounds(cls, outputs: Array) -> Prediction:
        """Nothing is known, and nothing is claimed: the high-fidelity model is asked."""
        return cls(outputs, np.full(len(outputs), inf), Guarantee.CERTIFIED)


Predict = Callable[[Array], Prediction]


def refuse_bounded(K: DualSet) -> None:
    """Raise a `RequestError` where multipliers are bounded: the δ above is derived for λ ≥ 0 alone."""
    if K.blocks:
        raise RequestError(f"decisions are proved for λ ≥ 0 alone, and K has {K.names()}; take a problem of contact")


@bordered_constructor
class BoundedSensors:
    """Outputs of a reduced model with proved or verified bounds.

    Raises a `RequestError` if the model has no bounds, an output is unknown, or no inf-sup constant is proved.
    """

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        problem, outputs = model.problem, outputs_of(model.problem, names)
        if model.certificate is None:
            raise RequestError("the model has no error bounds: a calibration needs one with bounds = true")
        refuse_bounded(problem.K)
        self.model, self.certificate, self.base = model, model.certificate, model.certificate.base
        share = share_of_diagonal(problem.W)
        if not (self.base.inf_sup.value > 0.0 and share.proved and share.value > 0.0):
            raise RequestError(f"λ has no bound, which the accuracy of solutions needs: {self.base.inf_sup.note}")
        self.names, self.mass = names, share.value * problem.W.matrix.diagonal()
        self._root = np.sqrt((1.0 + self.base.compliance_error) * np.diag(self.base.compliance))
        # Where B(µ) is θ(µ) B₀ it need not be assembled.
        self._is_scaled, self._reach = self.base.bound_terms is not None, self._lengths(self.base.constraint)
        self._weights = [model.output_weights[name] or (inf, inf) for name in names]
        of_u, of_lam = map(np.array, zip(*(output_coefficients(problem, output) for output in outputs), strict=True))
        self.correlation = None if of_lam.any() else _correlation(self.base.X, of_u, np.array(self._weights)[:, 0])
        reduced, self._of_alpha = model.reduced, of_lam @ model.reduced.generators
        assert isinstance(reduced, HyperReducedModel)  # as certificates need it
        self._of_y = of_u @ reduced.basis
        # Steps are small: most rows that the last solution presses are pressed again.
        self._last = np.zeros(0), np.zeros(0)

    def __call__(self, mu: Array) -> Prediction:
        """The outputs at mu (d,), with bounds that allow for the accuracy of the high-fidelity solution."""
        model, problem = self.model, self.model.problem
        assembled, (settings, solver) = model.online.program(mu), model.settings()
        answer: FormulationAnswer | QPSolution
        if model.solver is None:
            answer = model.online.solve(mu, settings)
        else:
            # Enrichments at the parameter may have another number of vectors.
            start = self._last if len(self._last[0]) == len(assembled.program.f) else None
            answer = solver(assembled.program, factor=assembled.factor, start=start)
        # Bounds hold for any pair: how well it solves the program shows in their size alone.
        if answer.x is None or answer.alpha is None or not (is_sound(answer.x) and is_sound(answer.alpha)):
            return Prediction.without_bounds(np.zeros(len(self._weights)))
        x, alpha = answer.x, np.maximum(answer.alpha, 0.0)
        self._last = x, alpha
        outputs = self._of_y @ assembled.evaluated.in_space(x) + self._of_alpha @ alpha
        if not self._is_scaled and assembled.evaluated.contact is None:
            # Evaluated once for the bounds and the accuracy.
            assembled = replace(assembled, evaluated=replace(assembled.evaluated, contact=contact_at(problem, mu)))
        bound, _ = self.certificate.certify(problem, mu, assembled, x, alpha, CorrectionMode.NONE)
        delta = self._distance_of_computed(assembled.evaluated, model.reduced.generators @ alpha, bound)
        if not delta < inf:
            return Prediction.without_bounds(outputs)
        widened = replace(bound, u_energy=bound.u_energy + delta, lam=bound.lam + delta / bound.inf_sup)
        bounds = [output_error_bound(weights, self.base, widened) for weights in self._weights]
        return Prediction(outputs, np.array(bounds), bound.guarantee, self.correlation)

    def _distance_of_computed(self, evaluated: Evaluated, lam: Array, bound: OnlineBound) -> float:
        """The δ of a reduced solution with the multiplier λ_N = `lam` (m,) and these bounds."""
        # The relative bound is Δ_u over a lower bound of ‖u‖; there is none of a solution without energy.
        if not (bound.lam < inf and 0.0 < bound.relative < inf):
            return inf
        theta, (d, entries) = 1.0, self._reach
        if self._is_scaled:
            theta = abs(float(evaluated.samples.get("B", self.base.one)[0]))
        elif evaluated.contact is not None:
            d, entries = self._lengths(evaluated.contact.B)
        d = d * (theta / sqrt(bound.coercivity))
        force = float(d @ lam) + sqrt(float(d @ (d / self.mass))) * bound.lam
        # A tenth more for the round-off in ‖u_N‖.
        size = 1.1 * (bound.u_energy / bound.relative + 2.0 * bound.u_energy)
        return 2.0 * sqrt(max(Sensors.accuracy, 3.0 * EPS * (entries + 2.0))) * max(force, size)

    def _lengths(self, B: SparseMatrix) -> tuple[Array, int]:
        """The sums Σ_j |B_ij| ‖e_j‖ (m,) in the norm of X⁻¹, and the largest number of entries of a row."""
        B = sp.csr_array(B)
        counts, sizes = np.diff(B.indptr), np.abs(B.data) * self._root.take(B.indices)
        sums = np.bincount(np.repeat(np.arange(len(counts)), counts), sizes, len(counts))
        return np.asarray(sums, float), int(counts.max())


def _correlation(X: InnerProduct, functionals: Array, norms: Array) -> Array | None:
    """The products (k×k) of functionals (k×n) over upper bounds (k,) of their norms in X⁻¹; `None` if they are rough.

    With p ≈ X⁻¹ℓ, ‖Σ c_i ℓ_i‖ ≤ ‖Σ c_i p_i‖ + Σ |c_i| ‖ℓ_i − X p_i‖: as in `vibench.model.proved_norms`.
    """
    proved, p = ProvedNorms(X.matrix, precise=True), extended(X.riesz(functionals.T))
    lengths, lost = proved.energies(p, product := proved.A @ p)
    # A tenth of what `Data.interval` adds.
    is_sharp = bool((lost < 1e-7).all() and (lengths > (1.0 - 1e-7) * norms).all())
    return np.asarray(p.T @ product, float) / np.outer(norms, norms) if is_sharp else None


@bordered_constructor
class CompiledSensors:
    """The outputs of `BoundedSensors` by a C program, compiled and loaded into this process: a query is one call.

    Pairs whose violation dominates the bounds are corrected. Raises an `UnsupportedError` without a C compiler, and a
    `RequestError` if the model has no program with bounds.
    """

    def __init__(self, sensors: BoundedSensors) -> None:
        model, base = sensors.model, sensors.base
        found = exported(model, bases=False, c=True)
        if why := found.about["no_bounds"]:
            raise RequestError(f"the C program of the model has no bounds: {why}")
        # No row has more entries than there are contact unknowns.
        accuracy = max(Sensors.accuracy, 3.0 * EPS * (len(base.compliance) + 2.0))
        text, _ = found.source("model", {
            "sensor_mass": c_source.numbers(sensors.mass), "sensor_inf_sup": base.inf_sup.value,
            "sensor_accuracy": accuracy, "sensor_mode": [*CorrectionMode].index(CorrectionMode.AUTO),
        })  # fmt: skip
        self._sensed, self._guarantee = loaded(text, "model_sensed", 4), Guarantee(found.about["certificate"])
        names = [output["name"] for output in found.about["outputs"]["linear"]]
        self._chosen = [names.index(name) for name in sensors.names]
        self._found, self._correlation = np.zeros((2, len(names))), sensors.correlation
        # The active set of the last solution: steps are small.
        self._active = np.zeros(model.reduced.generators.shape[1] + 1, np.uint8)

    def __call__(self, mu: Array) -> Prediction:
        """The outputs at mu (d,), with bounds that allow for the accuracy of the high-fidelity solution."""
        at = np.ascontiguousarray(mu, float)
        code = self._sensed(*(array.ctypes.data for array in (at, self._active, *self._found)))
        outputs, bounds = self._found[:, self._chosen]
        if code:
            return Prediction.without_bounds(outputs)
        return Prediction(outputs, bounds, self._guarantee, self._correlation)


def quickest_sensors(model: Model, names: tuple[str, ...]) -> tuple[Predict, str]:
    """Outputs with bounds by the C program of a model where it has one, or in Python; which, and why."""
    sensors = BoundedSensors(model, names)
    try:
        return CompiledSensors(sensors), "C program"
    except (RequestError, UnsupportedError) as reason:
        return sensors, f"Python: {reason}"


@dataclass(eq=False)
class Interval:
    """Bounds of the misfit at a parameter, which are equal once the high-fidelity model was asked."""

    lower: float
    upper: float
    # The misfit of the reduced model, by which decisions without bounds are taken.
    middle: float
    # Number of the models that were queried, the high-fidelity model among them.
    level: int

    def below(self, other: Interval, shift: float) -> bool | None:
        """Whether this misfit is less than the other one plus a shift; `None` if the intervals do not decide."""
        if self.upper < other.lower + shift:
            return True
        return False if self.lower >= other.upper + shift else None


@dataclass
class Counts:
    """Decisions, those that bounds left open, audits, decisions that the reduced model takes wrongly without bounds."""

    decisions: int
    undecided: int
    audits: int
    wrong: int
    # CPU seconds of the reduced model.
    model_seconds: float


@bordered
class Decisions:
    """Whether a parameter fits data better than another one, as the high-fidelity model says.

    Parameters
    ----------
    problem, data
        The problem, and the data that its outputs are compared with.
    models
        Outputs with bounds, as of `BoundedSensors`, from the quickest model to the most accurate one: each is queried
        where those before it leave a decision open, and the high-fidelity model where all of them do.
    audit
        Share of the decided decisions, drawn at random, for which the high-fidelity model is asked all the same.
    seed
        The seed of this draw.
    """

    _box: Annotated[ParameterBox, "d"]

    def __init__(
        self, problem: Problem, data: Data, models: Sequence[Predict],
        audit: Annotated[float, Rule("a number from 0 to 1", lambda value: 0.0 <= value <= 1.0)], seed: Seed,
    ) -> None:  # fmt: skip
        self.data, self.counts, self.guarantee = data, Counts(0, 0, 0, 0, 0.0), Guarantee.CERTIFIED
        self._box, self._models, self._audit = problem.parameters, tuple(models), audit
        self._solve, self._random = Sensors(problem, data.sensors), np.random.default_rng(seed)
        # Misfit and CPU seconds of the high-fidelity model by the bytes of the parameter: all that were asked, and
        # those that an interrupted run has asked before.
        self.answers: dict[bytes, tuple[float, float]] = {}
        self.earlier: dict[bytes, tuple[float, float]] = {}
        # Methods compare with what they saw last.
        self._recent: LRUCache[bytes, Interval] = LRUCache(1000)

    def interval(self, mu: Annotated[Array, "d"]) -> Interval:
        """Bounds of the misfit at mu (d,), ½ (s − d)ᵀ C⁻¹ (s − d); minus that is the log-likelihood."""
        if (key := mu.tobytes()) not in self._recent:
            known = self._recent[key] = Interval(0.0, inf, 0.0, 0)
            # Bounds are claimed in the box alone.
            if outside(self._box, mu).any():
                known.level = len(self._models)
            elif self._models:
                self._narrow(mu, known)
            if key in self.answers:
                self.ask(mu)
        return self._recent[key]

    def _narrow(self, mu: Array, known: Interval) -> None:
        """Narrow an interval by the next model, of which the high-fidelity model is the last; its answers are kept."""
        if known.level < len(self._models):
            (outputs, bounds, guarantee, correlation), spent = timed(lambda: self._models[known.level](mu))
            self.counts.model_seconds += spent.cpu
            if guarantee is not Guarantee.CERTIFIED:
                self.guarantee = Guarantee.VERIFIED
            lower, upper = self.data.interval(outputs, bounds, correlation)
            known.middle, by = self.data.misfit(outputs), "another model"
        else:
            if (key := mu.tobytes()) not in self.answers:
                self.answers[key] = self.earlier.get(key) or self._solved(mu)
            lower = upper = self.answers[key][0]
            by = "the high-fidelity model"
        if not (lower <= known.upper and upper >= known.lower):
            both = f"{known.lower:.6g} to {known.upper:.6g}, and {lower:.6g} to {upper:.6g} by {by}"
            raise RefutedError(f"the bounds are refuted at mu = {mu.tolist()}: the misfit is {both}")
        known.lower, known.upper, known.level = max(lower, known.lower), min(upper, known.upper), known.level + 1

    def _solved(self, mu: Array) -> tuple[float, float]:
        outputs, spent = timed(lambda: self._solve(mu))
        return self.data.misfit(outputs), spent.cpu

    def ask(self, mu: Annotated[Array, "d"]) -> float:
        """The misfit of the high-fidelity model at mu (d,), which is kept; a `RefutedError` if bounds exclude it."""
        known = self.interval(mu)
        if known.level <= len(self._models):
            known.level = len(self._models)
            self._narrow(mu, known)
        return known.lower

    def less(self, a: Annotated[Array, "d"], b: Annotated[Array, "d"], shift: float = 0.0) -> bool:
        """Whether the high-fidelity misfit at a (d,) is less than that at b (d,) plus a shift.

        Raises a `RefutedError` if an answer of the high-fidelity model contradicts the bounds.
        """
        one, other = map(self.interval, (a, b))
        is_open = False
        while (verdict := one.below(other, shift)) is None:
            # Later decisions compare with b again, the present state of a chain: it is queried and asked first.
            mu, known = (b, other) if other.level <= one.level else (a, one)
            is_open = is_open or known.level == len(self._models)
            self._narrow(mu, known)
        if not is_open and self._models and self._random.random() < self._audit:
            self.counts.audits += 1
            for mu in (a, b):
                self.ask(mu)
        self.counts.decisions += 1
        self.counts.undecided += is_open
        self.counts.wrong += bool(self._models and (one.middle < other.middle + shift) != verdict)
        return verdict

    @property
    def seconds(self) -> float:
        """CPU seconds of all queries and questions."""
        return self.counts.model_seconds + sum(seconds for _, seconds in self.answers.values())

    @property
    def high_fidelity_seconds(self) -> float:
        """CPU seconds of a chain that the high-fidelity model decides: its mean, as n solutions take n times the mean.

        It solves at every proposal in the box, and at the start. NaN if nothing was asked.
        """
        spent = [seconds for _, seconds in self.answers.values()]
        return sum(spent) / len(spent) * (self.counts.decisions + 1) if spent else nan

    @property
    def claim(self) -> str:
        """The claim that the bounds of the decisions so far allow."""
        is_exact = self.guarantee is Guarantee.CERTIFIED
        return "exact" if is_exact else f"no contradiction in {self.counts.audits} audits"
