"""The conformance checks of formulations: axes, what is built, answers, the pairs that they stand for, and status."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple
from unittest import SkipTest

import numpy as np

import vibench.stages.formulation  # noqa: F401  lists the classes that formulations may store
from vibench.arrays import Array, read_only
from vibench.errors import NumericalError, UnsupportedError, VibenchError, placed
from vibench.interfaces.formulations import Formulation, FormulationAnswer, OfflinePhase, Outcome, axes_of
from vibench.interfaces.strategies import ReducedSet, no_free
from vibench.model.errors import residual_multiplier
from vibench.offline.assemblies import assemblies
from vibench.offline.models import ACCURACY, CellSolver, Model, check_built
from vibench.offline.reduction import Reduction
from vibench.offline.sample_problem import sample_reduction
from vibench.qp.status import Status
from vibench.stages.artefacts import dumps, loads
from vibench.testing.case import Arrays, Case, at, difference, differences, largest_entry
from vibench.testing.checks import Check, Note


class Answered(NamedTuple):
    """The answer of a query with the solver that it was given, and its pair u (n,), λ (m,)."""

    answer: FormulationAnswer
    solver: CellSolver
    pair: tuple[Array, Array | None]


@dataclass(eq=False)
class FormulationCase(Case[Formulation, Array, Answered]):
    """A formulation, parameters, and its answers there on an offline phase."""

    base = Formulation
    offline: Reduction | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._made: dict[int, tuple[Formulation, Model]] = {}
        self.whole = self.offline or sample_reduction()

    def phase(self, plugin: Formulation) -> _Seen:
        """The offline phase that a formulation gets, without the steps that it does not use."""
        uses, whole = axes_of(plugin, type(plugin).__name__), self.whole
        steps = {"pod": ("pod",), "dual": ("cone", "multipliers"), "primal": ("enrichment",)}
        given = {name: getattr(whole, name) for axis, names in steps.items() if axis in uses for name in names}
        inputs = {"dual": "dual", "primal": "primal", "modes": "pod", "generators": "dual", "tolerance": "primal"}
        own: dict[str, Any] = {name: getattr(whole, name) if axis in uses else None for name, axis in inputs.items()}
        # Whoever writes into what it is given says so by an error at that line.
        known: dict[str, Any] = {name: read_only(getattr(whole.snapshots, name)) for name in ("mu", "u", "lam")}
        phase = _Seen(whole.problem, **own).given(snapshots=replace(whole.snapshots, **known), **given)
        assert isinstance(phase, _Seen)
        # The attributes that this function has read are no use by the formulation.
        phase.seen.clear()
        return phase

    @cached_property
    def arguments(self) -> dict[str, Array]:
        """A training parameter, the centre of the box, and random parameters."""
        box = self.whole.problem.parameters
        fixed = np.stack([self.whole.snapshots.mu[0], 0.5 * (box.lower + box.upper)])
        return {at(mu): read_only(mu) for mu in np.concatenate([fixed, box.sample(4, seed=0)])}

    def model_of(self, plugin: Formulation) -> Model:
        """The model of an instance, made of its stored offline part."""
        # Keyed by identity: two instances may be equal. The instance is kept, so that no other gets its number.
        if id(plugin) not in self._made:
            offline = self.phase(plugin)
            # A run builds once and loads the artefact: what storing changes would be found nowhere else.
            built = self.clocked("building", lambda: check_built(plugin.build(offline)))
            self._made[id(plugin)] = plugin, self._of(plugin, offline, loads(dumps(dict(built))))
        return self._made[id(plugin)][1]

    @staticmethod
    def _of(plugin: Formulation, offline: OfflinePhase, built: Mapping[str, Any]) -> Model:
        uses = axes_of(plugin, type(plugin).__name__)
        return Model(plugin, offline, built, "piqp" if "solvers" in uses else None, ACCURACY)

    def evaluate(self, argument: Array, plugin: Formulation | None = None) -> Answered:
        of, mu = self.model_of(plugin or self.plugin), read_only(argument)
        settings, solver = of.settings()
        answer = self.clocked("a query", lambda: of.online.solve(mu, settings))
        return Answered(answer, solver, of.online.reconstruct(mu, answer))

    def arrays(self, result: Answered) -> Arrays:
        named = {"x": result.answer.x, "alpha": result.answer.alpha, "u": result.pair[0], "λ": result.pair[1]}
        return {name: value for name, value in named.items() if value is not None}

    def stored(self, result: Answered) -> Answered:
        """A result with the coefficients of the answer as a run stores them."""
        coefficients = loads(dumps({"x": result.answer.x, "alpha": result.answer.alpha}))
        return result._replace(answer=replace(result.answer, **coefficients))

    def axes(self) -> Iterator[str]:
        """The axes that `uses` declares are some."""
        uses = axes_of(self.plugin, type(self.plugin).__name__)
        yield Note(f"uses {', '.join(uses) or 'no axis'}; λ is {self.plugin.multiplier}")

    def build(self) -> None:
        """`build` returns a mapping of what can be stored, or refuses the problem, as its cells in a study do."""
        try:
            built = check_built(self.plugin.build(self.phase(self.plugin)))
        except UnsupportedError as error:
            # A formulation may need more than the sample problem has; all later checks need this one.
            raise SkipTest(f"the formulation does not support the problem: {error}") from None
        for name, value in built.items():
            with placed(f"what `build` returns as '{name}' cannot be stored", NumericalError):
                dumps(value)

    def model(self) -> None:
        """`model` makes a `FormulationModel` that says how many coefficients its answers have."""
        self.model_of(self.plugin).online  # noqa: B018  is made and checked

    def answers(self) -> Iterator[str]:
        """Answers are vectors of at most the sizes declared, with an outcome, and one at least is ok."""
        of, outcomes = self.model_of(self.plugin), list[Outcome]()
        for name, mu in self.arguments.items():
            answer, _ = of.answered(mu, of.settings()[0])
            if answer.outcome is Outcome.OK and answer.x is None:
                yield f"{name}: the outcome is ok, and there is no x"
            if answer.outcome is not Outcome.OK and not answer.reason:
                yield f"{name}: the outcome is {answer.outcome}, without a reason"
            outcomes.append(answer.outcome)
        if Outcome.OK not in outcomes:
            yield f"no answer at {len(outcomes)} parameters is ok: the outcomes are {', '.join(map(str, outcomes))}"

    def pairs(self) -> Iterator[str]:
        """`reconstruct` gives u (n,) and λ (m,) ≥ 0; λ is `None` exactly for `Multiplier.RESIDUAL`."""
        of = self.model_of(self.plugin)
        for name, mu in self.arguments.items():
            settings, solver = of.settings()
            answer, _ = of.answered(mu, settings)
            if answer.outcome is not Outcome.OK:
                continue
            with placed(name, NumericalError):
                found = of.status_of(mu, answer, solver, 1.0)
            if found.status is not Status.OK:
                yield f"{name}: {found.reason}"

    def coefficients(self) -> Iterator[str]:
        """`reconstruct` needs x and alpha alone: another model gives the same pair, which has solved nothing."""
        offline = self.model_of(self.plugin).offline
        for name, result in self.results.items():
            fresh = self._of(self.plugin, offline, self.model_of(self.plugin).built).online
            kept = FormulationAnswer(result.answer.x, result.answer.alpha)
            again = result._replace(pair=fresh.reconstruct(self.arguments[name], kept))
            for array, what in differences(self.arrays(again), self.arrays(result), 0.0):
                yield f"{name}: reconstructed from x and alpha by another model, {array} differs: {what}"

    def plausible(self) -> Iterator[str]:
        """At a training parameter an ok answer is nearer to the solution than u = 0 and λ = 0 are."""
        name, result = next(iter(self.results.items()))
        if result.answer.outcome is not Outcome.OK:
            yield Note(f"not compared: the outcome {name} is {result.answer.outcome}")
            return
        problem, snapshots, mu = self.whole.problem, self.whole.snapshots, self.arguments[name]
        kept = assemblies(problem)
        energy, vi, u = kept.energy_at(mu), kept.at(mu), result.pair[0]
        lam = residual_multiplier(vi, energy, u) if result.pair[1] is None else result.pair[1]
        on = energy.contact_form(vi)
        of_u = energy.norm(u - snapshots.u[:, 0]) / energy.norm(snapshots.u[:, 0])
        of_lam = on.force_representer(lam - snapshots.lam[:, 0]).norm / on.force_representer(snapshots.lam[:, 0]).norm
        for what, error in (("u", of_u), ("λ", of_lam)):
            if not error < 1.0:
                yield f"{name}, a training parameter, the error of {what} is {error:.2g} of it: zero would be nearer"
        yield Note(f"at a training parameter, errors of {of_u:.1e} (u) and {of_lam:.1e} (λ)")

    def axes_used(self) -> Iterator[str]:
        """Every axis in `uses` is used: cells would be repeated over an axis on which nothing depends."""
        self.results  # noqa: B018  the first use builds and asks
        of = self.model_of(self.plugin)
        assert isinstance(of.offline, _Seen)
        # The attributes of an offline phase whose use shows that a formulation has an axis.
        steps = {"pod": ("pod", "modes"), "dual": ("cone", "multipliers", "dual", "generators")}
        steps |= {"primal": ("enrichment", "primal"), "assembly": ("assembled", "operators", "members", "assembly")}
        for axis in axes_of(self.plugin, type(self.plugin).__name__):
            if axis == "solvers" and all(result.solver.last is None for result in self.results.values()):
                yield "uses declares 'solvers', but no query calls `settings.solve_qp`"
            elif axis in steps and of.offline.seen.isdisjoint(steps[axis]):
                yield f"uses declares '{axis}', but nothing is made of offline.{steps[axis][0]}"

    def starts(self) -> Iterator[str]:
        """An answer that starts from another one is the same up to the accuracy."""
        if not self.plugin.takes_start:
            yield Note("not declared")
            return
        of, (first, *others) = self.model_of(self.plugin), self.results.items()
        for name, result in others:
            warm = of.online.solve(self.arguments[name], of.settings(first[1].answer)[0])
            u = of.online.reconstruct(self.arguments[name], warm)[0]
            # Both are accurate to the accuracy of the solver; a thousandth tells another solution.
            if what := difference(u, result.pair[0], 1e-3 * largest_entry(result.pair[0])):
                yield f"{name}: started from the answer {first[0]}, u differs: {what}"

    def without_contact(self) -> Iterator[str]:
        """Snapshots without contact are accepted, or refused in one line."""
        offline, m = self.phase(self.plugin), self.whole.problem.W.dim
        none = replace(offline.snapshots, lam=np.zeros_like(offline.snapshots.lam))
        empty = {"cone": ReducedSet(np.zeros((m, 0)), np.zeros(1), no_free(0))} if offline.dual is not None else {}
        steps = {"snapshots": none} | ({"pod": self.whole.pod} if offline.modes is not None else {}) | empty
        mu = next(iter(self.arguments.values()))
        try:
            given = replace(offline, primal=None, tolerance=None).given(**steps)
            of = self._of(self.plugin, given, check_built(self.plugin.build(given)))
            settings, solver = of.settings()
            found = of.status_of(mu, of.answered(mu, settings)[0], solver, 1.0)
        except VibenchError:  # a formulation may refuse it in one line
            return
        if found.status in (Status.NONFINITE, Status.ERROR) or "broken" in found.reason:
            yield f"from snapshots without contact, {found.status}: {found.reason}"

    checks = (
        Check("construction", Case.construction), Check("options", Case.options, ("construction",)),
        Check("axes", axes, ("construction",)), Check("build", build, ("axes",)), Check("model", model, ("build",)),
        Check("answers", answers, ("model",)), Check("pairs", pairs, ("answers",)),
        Check("determinism", Case.determinism, ("pairs",)), Check("coefficients", coefficients, ("determinism",)),
        Check("errors", plausible, ("pairs",)), Check("axes in use", axes_used, ("pairs",)),
        Check("starts", starts, ("pairs",)),
        Check("snapshots without contact", without_contact, ("pairs",)),
        Check("another process", Case.another_process, ("determinism",)),
        Check("pickling", Case.pickling, ("determinism",)), Check("time", Case.duration, ("answers",)),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Seen(Reduction):
    """An offline phase that notes which of its attributes, or of those of phases made from it, were asked for."""

    seen: set[str] = field(default_factory=set)

    def __getattribute__(self, name: str) -> Any:
        if not name.startswith("_") and name != "seen" and "seen" in self.__dict__:
            self.seen.add(name)
        return super().__getattribute__(name)
