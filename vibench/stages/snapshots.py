"""High-fidelity solutions over the training and the validation parameters: the snapshots and the references."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, TypeVar

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, at_parameter, message_of
from vibench.highfidelity.active_set import ActiveSetSolution, HighFidelitySolution, HighFidelitySolver
from vibench.interfaces.formulations import Snapshots
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import Fingerprint, ReferenceAssembly, checked_assembly
from vibench.model.certificates.greedy import GreedyTrainer
from vibench.model.error_bounds import reference_bound
from vibench.offline.assemblies import assemblies
from vibench.offline.reduction import check_skipped
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.qp.scaling import nearby
from vibench.signatures import refuse_others, rule_of
from vibench.stages.artefacts import History, Store, storable
from vibench.stages.base import Result, Stage, build_problem, faults_of, value_of
from vibench.study.cells import Axes
from vibench.study.parameter_sets import CHUNKS, ParameterSet, chunk_of, chunk_size
from vibench.timing import NO_TIME, SLOW, Seconds, Stopwatch, median_of, timed

T = TypeVar("T")

storable(Fingerprint)


@storable
@dataclass(frozen=True)
class TimedSnapshots(Snapshots):
    """High-fidelity solutions at some parameters, and their seconds."""

    # Seconds per solution, assembly included and set-up excluded: the median of repeats at validation parameters.
    seconds: tuple[Seconds, ...]
    # Seconds of the set-up of each chunk: those of the first solution beyond its repetition from a known start.
    setups: tuple[Seconds, ...]
    fallbacks: tuple[str, ...]  # fallbacks of the active set method per solution, "" where it needed none
    # Fingerprint of the problem at the first training parameter, as the process of the chunk assembled it.
    fingerprint: Fingerprint
    selecting: Seconds = NO_TIME  # seconds of the choice of the parameters by an adaptive training
    # Relative error bounds of validation solutions, infinite where there is none; empty for training solutions.
    bounds: tuple[float, ...] = ()


class _WrongProblemError(NumericalError):
    """A problem is not what it declares, whatever its parameter is."""


@dataclass(frozen=True)
class _Work:
    """The solver of a chunk of parameters, and the assembly to compare with."""

    problem: Problem
    solver: HighFidelitySolver
    reference: ReferenceAssembly

    def solve(self, mu: Array) -> tuple[VariationalInequality, ActiveSetSolution]:
        """The inequality at mu (d,) and its solution, which are timed."""
        vi = checked_assembly(self.problem, mu)
        with self.explained(mu, vi):
            return vi, self.solver.solve_assembled(mu, vi)

    @contextmanager
    def explained(self, mu: Array, vi: VariationalInequality) -> Iterator[None]:
        """Name the cause of a failed solution where the problem is at fault."""
        try:
            yield
        except NumericalError:
            try:
                self.reference.refuse_false_declarations(mu, vi)
            except NumericalError as error:
                raise _WrongProblemError(str(error)) from None
            raise


# The solver of the last problem of this process whose set-up is done, and the seconds of that: its chunks share both.
_set_up: dict[Problem, tuple[HighFidelitySolver, Seconds]] = {}


@dataclass(frozen=True)
class SnapshotStage(Stage):
    """High-fidelity solutions at one chunk of a parameter set; each has its own set-up."""

    label = "high-fidelity solutions"
    partial = True

    problem: Plugin
    parameters: ParameterSet
    chunk: int

    @property
    def kind_of_work(self) -> str:
        # Validation solutions are repeated and verified, which takes longer.
        return f"{self.label} of the {self.parameters.role} set"

    @property
    def effort(self) -> float:
        # A validation solution with repetitions and error bound takes about as long as three training solutions.
        each = 3.0 if self.parameters.role == "validation" else 1.0
        # The number of a problem's own training parameters is known only once it is built: guess 100.
        return each * chunk_size(self.parameters.count or 100, self.chunk)

    @property
    def axes(self) -> Axes:
        # The training set names the histories of its own parts only.
        return Axes(self.problem, training=self.parameters if self.parameters.role == "training" else None)

    def run(self, store: Store) -> Result:
        with faults_of(self.problem):
            return self._sweep(build_problem(self.problem), store)

    def _sweep(self, problem: Problem, store: Store) -> Result:
        first, mus = chunk_of(self.parameters.of(problem), self.chunk)
        # The factors of another problem are released before those of this one need memory.
        if problem not in _set_up:
            _set_up.clear()
        solver = _set_up[problem][0] if problem in _set_up else HighFidelitySolver(problem)
        work = _Work(problem, solver, ReferenceAssembly(problem))
        # No solution may depend on what this process has solved before.
        work.solver.forget()
        solutions, seconds = list[HighFidelitySolution](), list[Seconds]()
        skipped, solved, lost = list[str](), np.zeros(len(mus), bool), NO_TIME
        for k, mu in enumerate(mus):
            watch = Stopwatch()
            try:
                vi, solution, taken = self._solved(work, k, mu)
            except NumericalError as error:
                if not self.parameters.skips or isinstance(error, _WrongProblemError):
                    raise
                skipped.append(message_of(error))
                # Whoever trains pays for what fails, too.
                lost += watch.seconds()
            else:
                work.reference.refuse_false_declarations(mu, vi)
                work.solver.remember(mu, solution)
                solutions.append(solution)
                seconds.append(taken)
                solved[k] = True
            store.progress((k + 1) / len(mus))
        mus = mus[solved]
        u, lam = np.zeros((problem.V.dim, len(mus))), np.zeros((problem.W.dim, len(mus)))
        for k, solution in enumerate(solutions):
            u[:, k], lam[:, k] = solution.u, solution.lam
        if solutions:
            beginning, seconds[0] = seconds[0], self._once_started(work, solutions, mus)
            # The first chunk of a process does the set-up; the others have none.
            if problem not in _set_up:
                _set_up[problem] = solver, beginning.beyond(seconds[0])
        if self.parameters.role == "validation" and self.parameters.sampling is None and not self.chunk:
            # A short validation set is random in the box, but not enough.
            work.reference.refuse_at_random(max(0, 16 - len(self.parameters.of(problem))), self.parameters.seed + 1)
        work.reference.refuse_rewritten_constants()
        setups = (_set_up[problem][1],) if problem in _set_up else ()
        fallbacks, bounds = (solution.fallback for solution in solutions), self._bounds(problem, mus, u, lam)
        measured = tuple(seconds), setups, tuple(fallbacks), work.reference.fingerprint
        swept = TimedSnapshots(mus, u, lam, *measured, bounds=tuple(bounds), skipped=tuple(skipped))
        return Result(swept, sum(seconds, lost), self._diagnostics(problem, mus, first))

    def _solved(self, work: _Work, k: int, mu: Array) -> tuple[VariationalInequality, HighFidelitySolution, Seconds]:
        """The inequality at mu (d,), its verified solution, and the seconds of that without the verification."""
        # The first one without repetitions: its seconds from a known start are measured in the end.
        runs = self._runs if k else 1
        repeated = itertools.chain([mu], self._near(work.problem, mu, k))
        (vi, unverified), taken = self._measure(work.solve, repeated, runs)
        # Repetitions at other parameters may have written into the arrays.
        if runs > 1:
            vi = checked_assembly(work.problem, mu)
        with work.explained(mu, vi):
            return vi, work.solver.verify(mu, vi, unverified), taken

    def _bounds(self, problem: Problem, mus: Array, u: Array, lam: Array) -> Iterator[float]:
        """Error bounds that verify reference solutions; none for training solutions."""
        matrices = assemblies(problem)
        for k, mu in enumerate(mus if self.parameters.role != "training" else ()):
            with at_parameter(mu):
                bound = reference_bound(matrices.at(mu), matrices.energy_at(mu), u[:, k], lam[:, k])
            yield bound

    def _once_started(self, work: _Work, solutions: Sequence[ActiveSetSolution], mus: Array) -> Seconds:
        """Seconds of the first solution from the contact set of the nearest of the others; if it is alone, its own."""
        # A start from none takes several times as long but happens once, however many solutions follow.
        work.solver.forget()
        for mu, solution in list(zip(mus, solutions, strict=True))[min(1, len(solutions) - 1) :]:
            work.solver.remember(mu, solution)
        return self._measure(work.solve, self._near(work.problem, mus[0], 0), self._runs)[1]

    @property
    def _runs(self) -> int:
        # Training solutions are an offline cost, timed once. The median of three runs of a validation solution ignores
        # a disturbed one; the rounds time it again, beside the queries that it is compared with.
        return 1 if self.parameters.role == "training" else 3

    def _near(self, problem: Problem, mu: Array, number: int) -> Iterator[Array]:
        # A caching problem would be timed on a cache hit at the same parameter.
        return (nearby(problem.parameters, mu, self.parameters.seed, number, again) for again in itertools.count())

    def _measure(self, work: Callable[[Array], T], mus: Iterator[Array], runs: int) -> tuple[T, Seconds]:
        """The result at the first parameter, and the median seconds at the first `runs` of them, or of one slow run."""
        result, first = timed(partial(work, next(mus)))
        rest = range(runs - 1) if first.wall <= SLOW else ()
        return result, median_of([first, *(timed(partial(work, next(mus)))[1] for _ in rest)])

    def _diagnostics(self, problem: Problem, mus: Array, first: int) -> tuple[History, ...]:
        by_quantity: dict[str, list[float]] = {}
        for mu in mus:
            found = problem.diagnostics(mu)
            refuse_others(f"what `diagnostics` returned at mu = {mu.tolist()}", found, rule_of(Mapping[str, float]))
            for quantity, value in found.items():
                by_quantity.setdefault(quantity, []).append(float(value))
        return tuple(History.of(self.parameters.role, name, values, first) for name, values in by_quantity.items())


@dataclass(frozen=True)
class AdaptiveTraining(Stage):
    """Training parameters chosen one after the other by a sampling strategy, with their high-fidelity solutions."""

    # The value is a `TimedSnapshots`; the seconds of the stage include those of the choice.

    label = "adaptive training"

    problem: Plugin
    training: ParameterSet

    @property
    def axes(self) -> Axes:
        return Axes(self.problem, training=self.training)

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """Train; histories are the bounds that led to solutions, the parameters, and the number of bounds so far."""
        assert self.training.sampling is not None  # a problem's own set is not adaptive
        with faults_of(self.problem):
            problem = build_problem(self.problem)
            reference = ReferenceAssembly(problem)
            trainer = GreedyTrainer(problem, reference)
            with faults_of(self.training.sampling):
                self.training.sampling.create().train(problem.parameters, trainer)
            reference.refuse_rewritten_constants()
        solved = trainer.solved
        if not solved:
            raise NumericalError(f"the sampling strategy '{self.training.sampling.name}' has solved at no parameter")
        seconds, mus = tuple(one.seconds for one in solved), np.array([one.mu for one in solved])
        u, lam = (np.column_stack([getattr(one.solution, name) for one in solved]) for name in ("u", "lam"))
        fallbacks, setups = tuple(one.fallback for one in solved), (trainer.setup,)
        swept = TimedSnapshots(mus, u, lam, seconds, setups, fallbacks, reference.fingerprint, trainer.selecting)
        quantities = {"bound": [one.bound for one in solved], "bounds evaluated": [one.evaluated for one in solved]}
        columns = [*quantities.items(), *zip(problem.parameters.names, mus.T, strict=True)]
        histories = (History.of("selection", name, column) for name, column in columns)
        return Result(swept, sum(seconds, trainer.selecting), tuple(histories))


def solution_stages(problem: Plugin, parameters: ParameterSet) -> tuple[Stage, ...]:
    """The stages that solve at the parameters of a set: its chunks, or one stage if the set is adaptive."""
    if parameters.is_adaptive:
        return (AdaptiveTraining(problem, parameters),)
    return tuple(SnapshotStage(problem, parameters, chunk) for chunk in range(CHUNKS))


def parameters_in(store: Store, problem: Plugin, parameters: ParameterSet) -> Array:
    """The parameters (P×d) of a set, of those with solutions alone where these are known only once they are solved."""
    if parameters.follows_solutions:
        return gather(store, solution_stages(problem, parameters)).mu
    return parameters.of(build_problem(problem))


@lru_cache(maxsize=4)
def fingerprint_here(problem: Plugin) -> Fingerprint:
    """The fingerprint of a problem in this process."""
    return ReferenceAssembly(build_problem(problem)).fingerprint


@contextmanager
def unchanged(stage: Stage) -> Iterator[None]:
    """Raise a `NumericalError` if plugins change the problem of a stage in the block, which other stages share."""
    # Plugins of vibench change nothing, and cost nothing here.
    guests = [one for one in stage.plugins if one.kind is not PluginKind.PROBLEM and one.registered.package]
    problems = [one for one in stage.plugins if one.kind is PluginKind.PROBLEM] if guests else []
    before = {plugin: (fingerprint_here(plugin), _parts_of(build_problem(plugin))) for plugin in problems}
    yield
    # Where the stage is the first one of a plugin, no other has been at work.
    earlier = {plugin for one in stage.inputs() for plugin in one.plugins}
    for plugin, (known, parts) in before.items():
        try:
            problem = build_problem(plugin)
            here = _parts_of(problem)
            deviations = [f"{name} is replaced" for name, value in parts.items() if here.get(name) is not value]
            deviations = deviations or list(ReferenceAssembly(problem).fingerprint.deviations(known))
        except NumericalError as error:
            deviations = [str(error)]
        for deviation in deviations:
            who = " or the ".join(str(one) for one in [one for one in guests if one not in earlier] or guests)
            what = f"the {who} writes into what it is given"
            raise NumericalError(f"{what}, and the {plugin} is another one since: {deviation}")


def _parts_of(problem: Problem) -> dict[str, Any]:
    """Parts that no fingerprint looks at: attributes of its spaces, and its own ones in place of methods."""
    own = {name: vars(problem).get(name) for name, member in vars(Problem).items() if callable(member)}
    return own | {f"{name}.{part}": value for name in "VW" for part, value in vars(getattr(problem, name)).items()}


def gather(store: Store, chunks: tuple[Stage, ...]) -> TimedSnapshots:
    """The snapshots of all chunks."""
    parts = [value_of(store, chunk) for chunk in chunks]
    (problem,) = {plugin for chunk in chunks for plugin in chunk.plugins if plugin.kind is PluginKind.PROBLEM}
    skipped = tuple(reason for part in parts for reason in part.skipped)
    with faults_of(problem):
        check_skipped(skipped, sum(len(part.mu) for part in parts))
        here = fingerprint_here(problem)
        for deviation in (text for part in parts for text in part.fingerprint.deviations(here)):
            unequal = f"two assemblies at one parameter are not the same, as in another process: {deviation}"
            look_for = "unseeded random numbers, the order of sets, and what is kept between calls"
            raise NumericalError(f"{unequal}; look for {look_for}")
    joined: dict[str, Any] = {name: np.hstack([getattr(part, name) for part in parts]) for name in ("u", "lam")}
    for name in ("seconds", "setups", "fallbacks", "bounds"):
        joined[name] = tuple(one for part in parts for one in getattr(part, name))
    joined |= {"selecting": sum((part.selecting for part in parts), NO_TIME), "skipped": skipped}
    return TimedSnapshots(np.concatenate([part.mu for part in parts]), **joined, fingerprint=here)
