"""The training and validation sets of a study, found and checked before anything is run."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError
from vibench.interfaces.problem import Problem
from vibench.interfaces.strategies import AdaptiveSampling, Sampling
from vibench.interfaces.validation import training_parameters, validation_parameters
from vibench.plugins.plugin import Plugin

OWN = "own"
"""Name of the training and the validation set that a problem itself has."""

CHUNKS = 4
"""Number of chunks of a parameter set, which are stages of their own where every parameter takes long; fixed, so that
keys do not depend on the workers."""


@dataclass(frozen=True)
class ParameterSet:
    """The training or the validation set of a problem: its own, or that of a sampling strategy."""

    role: Literal["training", "validation"]
    """What the solutions at its parameters are for."""
    count: int = 0
    """Number of parameters of a validation set; 0 for training sets, whose size the problem or the strategy chooses."""
    seed: int = 0
    """Seed of the validation set of a problem itself, and of what is drawn to time solutions; 0 for training sets."""
    sampling: Plugin | None = None
    """The sampling strategy; `None` for the set of the problem itself."""
    label: str = field(default=OWN, compare=False)
    """Its name in results. Sets that differ in their labels alone are the same set."""

    @property
    def is_adaptive(self) -> bool:
        """Whether its parameters are chosen as solutions are known; `of` gives candidates then."""
        return self.sampling is not None and issubclass(self.sampling.registered.load(), AdaptiveSampling)

    @property
    def is_ordered(self) -> bool:
        """Whether its parameters are a path, along which every solution is the start of the next one."""
        kind = None if self.sampling is None else self.sampling.registered.load()
        return kind is not None and issubclass(kind, Sampling) and kind.ordered

    @property
    def options(self) -> str:
        """The options of the sampling strategy as canonical JSON."""
        return "{}" if self.sampling is None else self.sampling.options

    def strategy(self) -> Sampling | None:
        """A new instance of the sampling strategy; `None` for the set of the problem itself."""
        if self.sampling is None:
            return None
        strategy = self.sampling.create()
        assert isinstance(strategy, Sampling)  # `RegisteredPlugin.load` refuses anything else
        return strategy

    def of(self, problem: Problem) -> Array:
        """The parameters (P×d) of a problem.

        Raises a `NumericalError` if the set of the problem itself has the wrong shape, or values that are not finite,
        and a `RequestError` if the sampling strategy makes no set in the box of the problem.
        """
        if self.role == "training":
            return training_parameters(problem, self.strategy())
        return validation_parameters(problem, self.count, self.seed, self.strategy())

    def sized(self, problem: Plugin) -> ParameterSet:
        """The same set with the number of parameters that its strategy makes for a problem, if both are installed."""
        if self.sampling is None or not is_available(problem, self.sampling):
            return self
        return replace(self, count=len(parameters_of(problem, self)))


OWN_TRAINING = ParameterSet("training")
"""The training set of a problem itself."""


def is_available(*plugins: Plugin) -> bool:
    """Whether plugins can be made here: their names are unambiguous, and what they require is installed."""
    return not any(plugin.registered.conflict or plugin.registered.missing for plugin in plugins)


@lru_cache(maxsize=4)
def _problem(plugin: Plugin) -> Problem:
    try:
        problem = plugin.create()
    except NumericalError as error:
        raise RequestError(f"problem '{plugin.name}': {error}") from None
    assert isinstance(problem, Problem)  # as above
    return problem


@lru_cache(maxsize=64)
def parameters_of(problem: Plugin, parameters: ParameterSet) -> Array:
    """The parameters (P×d) of a set for a problem, which is built; for reading only.

    Raises a `RequestError` if there is no such set; the message names the problem, and the strategy if there is one.
    """
    built, sampling = _problem(problem), parameters.sampling
    try:
        return parameters.of(built)
    except (RequestError, NumericalError) as error:
        strategy = "" if sampling is None else f"sampling strategy '{sampling.name}' for "
        raise RequestError(f"{strategy}problem '{problem.name}': {error}") from None


def check_sets(problem: Plugin, training: ParameterSet, validation: ParameterSet) -> None:
    """Refuse sets that a problem does not have, and a validation set all of whose parameters are training parameters.

    Errors there would say nothing of other parameters; two strategies with the same seed draw the same points. The sets
    of a problem itself are its own business.

    Raises a `RequestError` if it is so.
    """
    if validation.is_adaptive and validation.sampling is not None:
        raise RequestError(
            f"sampling strategy '{validation.sampling.name}' chooses training parameters by what solutions know; it "
            "makes no validation set"
        )
    asked = parameters_of(problem, validation)
    if training.sampling is None and validation.sampling is None:
        return
    if np.isin(_rows(asked), _rows(parameters_of(problem, training))).all():
        raise RequestError(
            f"all validation parameters of problem '{problem.name}' are training parameters, so that errors would say "
            "nothing of others: give one of the two sets another seed, or other parameters"
        )


def _rows(mus: Array) -> Array:
    """Every row as one value that compares to the last bit."""
    return np.ascontiguousarray(mus, float).view(f"V{8 * mus.shape[1]}").ravel()


def chunk_edges(count: int) -> list[int]:
    """Numbers of the first parameter of every chunk of `count` parameters, and `count` (CHUNKS + 1,)."""
    return [int(edge) for edge in np.linspace(0, count, CHUNKS + 1).round()]


def chunk_size(count: int, chunk: int) -> int:
    """Number of parameters in a chunk of `count`."""
    first, end = chunk_edges(count)[chunk : chunk + 2]
    return end - first


def chunk_of(everything: Array, chunk: int) -> tuple[int, Array]:
    """Number of the first parameter of a chunk, and its parameters, of all (P×d)."""
    first, end = chunk_edges(len(everything))[chunk : chunk + 2]
    return first, everything[first:end]
