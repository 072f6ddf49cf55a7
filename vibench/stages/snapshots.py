"""High-fidelity sweeps: solutions over the training and the validation parameters, and their constants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vibench.arrays import Array
from vibench.highfidelity import active_set
from vibench.interfaces.problem import Problem
from vibench.interfaces.validation import checked_assembly, training_parameters, validation_parameters
from vibench.stages.artefacts import History, Store
from vibench.stages.base import Result, Stage, build_problem, value_of
from vibench.study.cells import Plugin
from vibench.timing import NO_TIME, Seconds, Stopwatch

CHUNKS = 4
"""Parts the parameters of a high-fidelity sweep are split into, whatever the number of jobs; each prepares anew."""


@dataclass(frozen=True)
class Solutions:
    """High-fidelity solutions at some parameters: columns of u (n×P) and λ (m×P)."""

    mu: Array
    u: Array
    lam: Array
    seconds: tuple[Seconds, ...]
    fallbacks: tuple[str, ...]


@dataclass(frozen=True)
class HighFidelity(Stage):
    """High-fidelity solutions of one chunk of the training or the validation parameters; seconds per solution."""

    problem: Plugin
    purpose: Literal["training", "validation"]
    count: int
    seed: int
    chunk: int

    def inputs(self) -> tuple[Stage, ...]:
        """Nothing comes before."""
        return ()

    def run(self, store: Store) -> Result:  # noqa: ARG002
        """Assemble and solve at every parameter of the chunk."""
        problem = build_problem(self.problem)
        everything = training_parameters(problem) if self.purpose == "training" else self._validation(problem)
        first, mus = self._part(everything)
        u, lam = np.zeros((problem.V.dim, len(mus))), np.zeros((problem.W.dim, len(mus)))
        seconds, fallbacks, solver = [], [], active_set.HighFidelitySolver(problem)
        for k, mu in enumerate(mus):
            watch = Stopwatch()
            vi = checked_assembly(problem, mu)
            solution = solver.solve_assembled(mu, vi)
            seconds.append(watch.seconds())
            if k == 0 or "A" not in problem.constant:
                solver.check_coercive(mu, vi)
            u[:, k], lam[:, k] = solution.u, solution.lam
            fallbacks.append(solution.fallback)
        solutions = Solutions(mus, u, lam, tuple(seconds), tuple(fallbacks))
        return Result(solutions, sum(seconds, NO_TIME), self._diagnostics(problem, mus, first))

    def _validation(self, problem: Problem) -> Array:
        return validation_parameters(problem, self.count, self.seed)

    def _part(self, everything: Array) -> tuple[int, Array]:
        edges = np.linspace(0, len(everything), CHUNKS + 1).round().astype(int)
        return int(edges[self.chunk]), everything[edges[self.chunk] : edges[self.chunk + 1]]

    def _diagnostics(self, problem: Problem, mus: Array, first: int) -> tuple[History, ...]:
        found: dict[str, list[float]] = {}
        for mu in mus:
            for quantity, value in problem.diagnostics(mu).items():
                found.setdefault(quantity, []).append(float(value))
        key = {"stage": self.purpose, "first_step": first}
        return tuple(History(key, quantity, tuple(values)) for quantity, values in found.items())


def sweep(problem: Plugin, purpose: Literal["training", "validation"], count: int, seed: int) -> tuple[Stage, ...]:
    """The chunks of one high-fidelity sweep."""
    return tuple(HighFidelity(problem, purpose, count, seed, chunk) for chunk in range(CHUNKS))


def training(problem: Plugin) -> tuple[Stage, ...]:
    """The training sweep; it depends on nothing but the problem."""
    return sweep(problem, "training", 0, 0)


def gather(store: Store, chunks: tuple[Stage, ...]) -> Solutions:
    """The solutions of a whole sweep."""
    parts = [value_of(store, chunk) for chunk in chunks]
    return Solutions(
        np.concatenate([part.mu for part in parts]),
        np.hstack([part.u for part in parts]),
        np.hstack([part.lam for part in parts]),
        tuple(s for part in parts for s in part.seconds),
        tuple(note for part in parts for note in part.fallbacks),
    )
