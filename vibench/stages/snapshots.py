"""High-fidelity solutions over the training and the validation parameters: the snapshots and the references."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TypeVar

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.highfidelity.active_set import ActiveSetSolution, HighFidelitySolver
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import Fingerprint, checked_assembly, reference_assembly
from vibench.linalg.inner_product import InnerProduct
from vibench.model.certificates.greedy import GreedyTrainer
from vibench.model.error_bounds import reference_bound
from vibench.offline.assemblies import assemblies
from vibench.offline.reduction import Snapshots
from vibench.plugins.kinds import PROBLEM
from vibench.plugins.plugin import Plugin
from vibench.qp.scaling import nearby
from vibench.stages.artefacts import History, Store
from vibench.stages.base import SHARE, Result, Stage, build_problem, faults_of, value_of
from vibench.stages.serialisation import storable
from vibench.study.cells import Axes
from vibench.study.parameter_sets import CHUNKS, ParameterSet, chunk_of, chunk_size
from vibench.timing import NO_TIME, SLOW, Seconds, median_of, timed

T = TypeVar("T")

TRAINED = 100
"""Number of training parameters that is expected of a problem, which is not built to ask for its own."""

VALIDATED = 3.0
"""As many training solutions take about as long as a validation solution, its repetitions and its error bound."""

storable(Fingerprint)

RUNS = 3
"""How often a validation solution is solved, so that a disturbed one does not count. That is no more than its share of
those that rounds time later, beside the queries which they are compared with."""


@storable
@dataclass(frozen=True)
class TimedSnapshots(Snapshots):
    """High-fidelity solutions at some parameters, and what they took."""

    seconds: tuple[Seconds, ...]
    """Seconds per solution, assembly included and set-up excluded: the median of repeats at validation parameters."""
    setups: tuple[Seconds, ...]
    """Seconds of the set-up, once per chunk: what the first solution took beyond its repetition from a known start."""
    fallbacks: tuple[str, ...]
    """Fallbacks of the active set method per solution, "" where it needed none."""
    fingerprint: Fingerprint
    """Fingerprint of the problem at the first training parameter, as the process of the chunk assembled it."""
    selecting: Seconds = NO_TIME
    """Seconds of the choice of the parameters, none unless the training is adaptive."""
    bounds: tuple[float, ...] = ()
    """Relative error bounds of validation solutions, infinite where there is none; none of training solutions."""


@dataclass
class _SetUp:
    """A solver of a problem whose set-up is done, and the seconds of that; `None` before."""

    solver: HighFidelitySolver | None = None
    seconds: Seconds | None = None

    def done(self, solver: HighFidelitySolver, seconds: Seconds) -> None:
        """The set-up is that of the first chunk; the others have none."""
        if self.seconds is None:
            self.solver, self.seconds = solver, seconds


@lru_cache(maxsize=1)
def _set_up(problem: Problem) -> _SetUp:  # noqa: ARG001
    """That of the problem that this process works on: chunks in one process share it."""
    return _SetUp()


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
        """Those of the two sets take differently long."""
        return f"{self.label} of the {self.parameters.role} set"

    @property
    def effort(self) -> float:
        """Those of the chunk."""
        each = VALIDATED if self.parameters.role == "validation" else 1.0
        return each * chunk_size(self.parameters.count or TRAINED, self.chunk)

    @property
    def axes(self) -> Axes:
        """The problem, and the training set if it is a part of that."""
        return Axes(self.problem, training=self.parameters if self.parameters.role == "training" else None)

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """Assemble and solve at every parameter of the chunk."""
        with faults_of(self.problem):
            return self._sweep(build_problem(self.problem))

    def _sweep(self, problem: Problem) -> Result:
        first, mus = chunk_of(self.parameters.of(problem), self.chunk)
        given, reference = mus.copy(), reference_assembly(problem)
        u, lam = np.zeros((problem.V.dim, len(mus))), np.zeros((problem.W.dim, len(mus)))
        seconds, fallbacks, kept = [], [], _set_up(problem)
        solver = kept.solver or HighFidelitySolver(problem)
        solver.forget()  # no solution may depend on what this process has solved before

        def refuse_shifted() -> None:
            if not np.array_equal(mus, given):
                raise NumericalError("assemble changes its argument mu: work on a copy")

        @contextmanager
        def explained(mu: Array, vi: VariationalInequality) -> Iterator[None]:
            """Name the cause rather than what came of it."""
            try:
                yield
            except NumericalError:
                refuse_shifted()
                InnerProduct(vi.A, f"A at mu = {mu.tolist()}")
                reference.refuse_false_constants(mu, vi)
                raise

        def solve(mu: Array) -> tuple[VariationalInequality, ActiveSetSolution]:
            vi = checked_assembly(problem, mu)
            with explained(mu, vi):
                return vi, solver.solve_assembled(mu, vi)

        solutions: list[ActiveSetSolution] = []
        for k, mu in enumerate(mus):
            # the first one without repetitions: what it takes from a known start is measured in the end
            runs, repeated = self._runs if k else 1, itertools.chain([mu], self._near(problem, mu, k))
            (vi, unverified), taken = self._measure(solve, repeated, runs)
            seconds.append(taken)  # verification, which is what follows, is not timed
            if runs > 1:
                vi = checked_assembly(problem, mu)  # repetitions at other parameters may have written into its arrays
            with explained(mu, vi):
                solution = solver.verify(mu, vi, unverified)
            if k == 0 or "A" not in problem.constant:
                solver.check_coercive(mu, vi)
            reference.refuse_false_constants(mu, vi)
            solver.remember(mu, solution)
            solutions.append(solution)
            u[:, k], lam[:, k] = solution.u, solution.lam
            fallbacks.append(solution.fallback)
            SHARE.get()((k + 1) / len(mus))
        if solutions:
            beginning, seconds[0] = seconds[0], self._once_started(problem, solver, solve, solutions, mus)
            kept.done(solver, beginning.beyond(seconds[0]))
        reference.refuse_rewritten_constants()
        refuse_shifted()
        setups = () if kept.seconds is None else (kept.seconds,)
        measured = tuple(seconds), setups, tuple(fallbacks), reference.fingerprint
        swept = TimedSnapshots(mus, u, lam, *measured, bounds=tuple(self._bounds(problem, mus, u, lam)))
        return Result(swept, sum(seconds, NO_TIME), self._diagnostics(problem, mus, first))

    def _bounds(self, problem: Problem, mus: Array, u: Array, lam: Array) -> Iterator[float]:
        """Verify the references by their error bounds; training solutions are none."""
        kept = assemblies(problem)
        for k, mu in enumerate(mus if self.parameters.role != "training" else ()):
            try:
                yield reference_bound(kept.at(mu), kept.energy_at(mu), u[:, k], lam[:, k])
            except NumericalError as error:
                raise NumericalError(f"at mu = {mu.tolist()}: {error}") from error

    def _once_started(
        self,
        problem: Problem,
        solver: HighFidelitySolver,
        solve: Callable[[Array], object],
        solutions: Sequence[ActiveSetSolution],
        mus: Array,
    ) -> Seconds:
        """Seconds of the first solution from the contact set of the nearest of the others, or from its own without any.

        To start from none takes several times as long, and happens once, however many solutions follow.
        """
        solver.forget()
        for mu, solution in list(zip(mus, solutions, strict=True))[min(1, len(solutions) - 1) :]:
            solver.remember(mu, solution)
        return self._measure(solve, self._near(problem, mus[0], 0), self._runs)[1]

    @property
    def _runs(self) -> int:
        """A training solution is an offline cost, timed once; of a validation solution the median of a few counts."""
        return 1 if self.parameters.role == "training" else RUNS

    def _near(self, problem: Problem, mu: Array, number: int) -> Iterator[Array]:
        """Parameters next to one of the chunk."""
        return (nearby(problem.parameters, mu, self.parameters.seed, number, again) for again in itertools.count())

    def _measure(self, work: Callable[[Array], T], mus: Iterator[Array], runs: int) -> tuple[T, Seconds]:
        """The result at the first parameter, and the median of runs at so many, or of one that is slow."""
        result, first = timed(partial(work, next(mus)))
        rest = range(runs - 1) if first.wall <= SLOW else ()
        return result, median_of([first, *(timed(partial(work, next(mus)))[1] for _ in rest)])

    def _diagnostics(self, problem: Problem, mus: Array, first: int) -> tuple[History, ...]:
        by_quantity: dict[str, list[float]] = {}
        for mu in mus:
            for quantity, value in problem.diagnostics(mu).items():
                by_quantity.setdefault(quantity, []).append(float(value))
        return tuple(
            History.of(self.parameters.role, quantity, values, first) for quantity, values in by_quantity.items()
        )


@dataclass(frozen=True)
class AdaptiveTraining(Stage):
    """Training parameters chosen one after the other by a sampling strategy, with their high-fidelity solutions.

    The value is a `TimedSnapshots`; the seconds of the stage have those of the choice, which is made of error bounds.
    """

    label = "adaptive training"

    problem: Plugin
    training: ParameterSet

    @property
    def axes(self) -> Axes:
        """The problem and the training set."""
        return Axes(self.problem, training=self.training)

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """Train; histories are the bounds that led to solutions, the parameters, and the number of bounds so far."""
        assert self.training.sampling is not None  # a problem's own set is not adaptive
        with faults_of(self.problem):
            problem, strategy = build_problem(self.problem), self.training.sampling.create()
            reference = reference_assembly(problem)
            trainer = GreedyTrainer(problem, reference)
            strategy.train(problem.parameters, trainer)
            reference.refuse_rewritten_constants()
        solved = trainer.solved
        if not solved:
            raise NumericalError(f"the sampling strategy '{self.training.sampling.name}' has solved at no parameter")
        seconds, mus = tuple(one.seconds for one in solved), np.array([one.mu for one in solved])
        u, lam = (np.column_stack([getattr(one.solution, name) for one in solved]) for name in ("u", "lam"))
        fallbacks, setups = tuple(one.fallback for one in solved), (trainer.setup,)
        swept = TimedSnapshots(mus, u, lam, seconds, setups, fallbacks, reference.fingerprint, trainer.selecting)
        histories = (
            History.of("selection", "bound", [one.bound for one in solved]),
            History.of("selection", "bounds evaluated", [one.evaluated for one in solved]),
            *(
                History.of("selection", name, column)
                for name, column in zip(problem.parameters.names, mus.T, strict=True)
            ),
        )
        return Result(swept, sum(seconds, trainer.selecting), histories)


def solution_stages(problem: Plugin, parameters: ParameterSet) -> tuple[Stage, ...]:
    """The stages that solve at the parameters of a set: its chunks, or one stage if the set is adaptive."""
    if parameters.is_adaptive:
        return (AdaptiveTraining(problem, parameters),)
    return tuple(SnapshotStage(problem, parameters, chunk) for chunk in range(CHUNKS))


def choosing_stages(problem: Plugin, parameters: ParameterSet) -> tuple[Stage, ...]:
    """The stages that `parameters_in` reads."""
    return solution_stages(problem, parameters) if parameters.is_adaptive else ()


def parameters_in(store: Store, problem: Plugin, parameters: ParameterSet) -> Array:
    """The parameters (P×d) of a set; those of an adaptive one are known once it is solved."""
    if parameters.is_adaptive:
        return gather(store, solution_stages(problem, parameters)).mu
    return parameters.of(build_problem(problem))


@lru_cache(maxsize=4)
def fingerprint_here(problem: Plugin) -> Fingerprint:
    """The fingerprint of a problem in this process."""
    return reference_assembly(build_problem(problem)).fingerprint


def gather(store: Store, chunks: tuple[Stage, ...]) -> TimedSnapshots:
    """The snapshots of all chunks.

    Raises a `NumericalError` if the problem was assembled otherwise for a chunk than it is in this process.
    """
    parts = [value_of(store, chunk) for chunk in chunks]
    (problem,) = {plugin for chunk in chunks for plugin in chunk.plugins if plugin.kind is PROBLEM}
    with faults_of(problem):
        here = fingerprint_here(problem)
        for deviation in (text for part in parts for text in part.fingerprint.deviations(here)):
            raise NumericalError(
                f"two assemblies at one parameter are not the same, as in another process: {deviation}; look for "
                "unseeded random numbers, the order of sets, and what is kept between calls"
            )
    return TimedSnapshots(
        np.concatenate([part.mu for part in parts]),
        np.hstack([part.u for part in parts]),
        np.hstack([part.lam for part in parts]),
        tuple(seconds for part in parts for seconds in part.seconds),
        tuple(seconds for part in parts for seconds in part.setups),
        tuple(note for part in parts for note in part.fallbacks),
        here,
        sum((part.selecting for part in parts), NO_TIME),
        tuple(bound for part in parts for bound in part.bounds),
    )
