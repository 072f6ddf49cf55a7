"""Training and validation sets of a study, computed and checked before anything runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal, cast

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError, VibenchError, foreign, placed
from vibench.interfaces.dual_sets import BlockKind
from vibench.interfaces.problem import Problem
from vibench.interfaces.strategies import AdaptiveSampling, Sampling
from vibench.interfaces.validation import training_parameters, validation_parameters
from vibench.plugins.plugin import Plugin
from vibench.process import put_back

# Name of the training and the validation set of the problem itself.
OWN = "own"

# Number of chunks of a parameter set, each a stage of its own; fixed, so that keys do not depend on the workers.
CHUNKS = 4


@dataclass(frozen=True)
class ParameterSet:
    """The training or the validation set of a problem: its own, or that of a sampling strategy."""

    # `count` is the number of parameters of a validation set, and `seed` that of a problem's own one, and of random
    # numbers in timings; both are 0 for training sets. `sampling` is `None` for the problem's own set. Sets that differ
    # only in their labels are the same set. Training parameters without a solution are left out where the set `skips`.

    role: Literal["training", "validation"]
    count: int
    seed: int
    sampling: Plugin | None = None
    label: str = field(default=OWN, compare=False)
    skips: bool = False

    @property
    def is_adaptive(self) -> bool:
        """Whether parameters are chosen one after the other from solutions; `of` returns candidates then."""
        return self.sampling is not None and issubclass(self.sampling.registered.load(), AdaptiveSampling)

    @property
    def follows_solutions(self) -> bool:
        """Whether its parameters are known only once they are solved: those of an adaptive set, or with a solution."""
        return self.is_adaptive or self.skips

    @property
    def is_ordered(self) -> bool:
        """Whether its parameters are a path, along which every solution is the initial guess of the next one."""
        kind = None if self.sampling is None else self.sampling.registered.load()
        return kind is not None and issubclass(kind, Sampling) and kind.ordered

    @property
    def options(self) -> str:
        return "{}" if self.sampling is None else self.sampling.options

    def strategy(self) -> Sampling | None:
        """A new instance of the sampling strategy; `None` for the problem's own set."""
        return None if self.sampling is None else cast("Sampling", self.sampling.create())

    def of(self, problem: Problem) -> Array:
        """The parameters (P×d) of a problem; raises a `NumericalError` or a `RequestError` if there is no valid set."""
        if self.role == "training":
            return training_parameters(problem, self.strategy())
        return validation_parameters(problem, self.count, self.seed, self.strategy())

    def sized(self, problem: Plugin) -> ParameterSet:
        """The same set with the number of parameters of its strategy for a problem, if both are installed."""
        if self.sampling is None or not is_available(problem, self.sampling):
            return self
        return replace(self, count=len(parameters_of(problem, self)))


# A problem's own training set.
OWN_TRAINING = ParameterSet("training", 0, 0)


def is_available(*plugins: Plugin) -> bool:
    """Whether plugins are available here: their names are unambiguous, and their requirements installed."""
    return not any(plugin.registered.conflict or plugin.registered.missing for plugin in plugins)


def blocks_of(problem: Plugin) -> frozenset[BlockKind]:
    """Kinds of blocks besides rays of a problem's K; it is built where its class declares any, if it is installed."""
    declared = is_available(problem) and problem.registered.load().blocks
    return _problem(problem).K.kinds if declared else frozenset()


@lru_cache(maxsize=4)
def _problem(plugin: Plugin) -> Problem:
    with _refused(f"problem '{plugin.name}'"):
        return cast("Problem", plugin.create())


@contextmanager
def _refused(who: str) -> Iterator[None]:
    """Turn what a plugin raises in the process of the command into a `RequestError`, and put back what it changes."""
    with foreign(who, RequestError), placed(who, VibenchError), put_back():
        yield


@lru_cache(maxsize=64)
def parameters_of(problem: Plugin, parameters: ParameterSet) -> Array:
    """The parameters (P×d) of a set for a problem, which is built; cached, so that nobody may change them."""
    built, sampling = _problem(problem), parameters.sampling
    strategy = "" if sampling is None else f"sampling strategy '{sampling.name}' for "
    with _refused(f"{strategy}problem '{problem.name}'"):
        return parameters.of(built)


def check_sets(problem: Plugin, training: ParameterSet, validation: ParameterSet) -> None:
    """Raise a `RequestError` if a problem has no such sets, or all validation parameters are training parameters."""
    # Errors there would say nothing of other parameters, and two strategies with one seed draw the same points. Only
    # the problem itself may choose equal sets.
    choosing = "chooses training parameters by what solutions know"
    if validation.is_adaptive and validation.sampling is not None:
        raise RequestError(f"sampling strategy '{validation.sampling.name}' {choosing}; it makes no validation set")
    if training.is_adaptive and training.skips and training.sampling is not None:
        remedy = 'it has none to skip: leave out on_failure = "skip"'
        raise RequestError(f"sampling strategy '{training.sampling.name}' {choosing}; {remedy}")
    mus = parameters_of(problem, validation)
    if training.sampling is None and validation.sampling is None:
        return
    # Every row is one value, equal only if all bits are.
    both = (np.ascontiguousarray(rows, float) for rows in (parameters_of(problem, training), mus))
    trained, validated = (rows.view(f"V{8 * mus.shape[1]}").ravel() for rows in both)
    if np.isin(validated, trained).all():
        what = f"all validation parameters of problem '{problem.name}' are training parameters"
        remedy = "give one of the two sets another seed, or other parameters"
        raise RequestError(f"{what}, so that errors would say nothing of others: {remedy}")


def chunk_edges(count: int) -> list[int]:
    """Numbers of the first parameter of every chunk of `count` parameters, and `count` (CHUNKS + 1,)."""
    # Rounded edges: chunks differ by one parameter at most.
    return [int(edge) for edge in np.linspace(0, count, CHUNKS + 1).round()]


def chunk_size(count: int, chunk: int) -> int:
    first, end = chunk_edges(count)[chunk : chunk + 2]
    return end - first


def chunk_of(everything: Array, chunk: int) -> tuple[int, Array]:
    """Number of the first parameter of a chunk, and its parameters, of all (P×d)."""
    first, end = chunk_edges(len(everything))[chunk : chunk + 2]
    return first, everything[first:end]
