"""The parameter sets that sampling strategies make for the problems of a study, checked before anything is run."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError
from vibench.interfaces.problem import ParameterBox, Problem
from vibench.interfaces.sampling import AdaptiveSampling, Sampling
from vibench.interfaces.validation import training_parameters, validation_parameters
from vibench.study import registry
from vibench.study.plugin import Plugin


def is_available(*plugins: Plugin) -> bool:
    """Whether plugins can be made here: their names are unambiguous, and what they require is installed."""
    return not any(registry.conflict(p.kind, p.name) or registry.missing(p.kind, p.name) for p in plugins)


@lru_cache(maxsize=4)
def _problem(plugin: Plugin) -> Problem:
    try:
        problem = plugin.create()
    except NumericalError as error:
        raise RequestError(f"problem '{plugin.name}': {error}") from None
    assert isinstance(problem, Problem)  # `registry.load` refuses anything else
    return problem


def box_of(problem: Plugin) -> ParameterBox:
    """The parameter box of a problem; the problem is built.

    Raises
    ------
    RequestError
        If it cannot be built.
    """
    return _problem(problem).parameters


@lru_cache(maxsize=64)
def sampled(problem: Plugin, sampling: Plugin) -> Array:
    """The parameters (P×d) of a sampling strategy in the box of a problem, for reading only.

    Raises
    ------
    RequestError
        If there is no such set; the message names the strategy and the problem.
    """
    strategy = sampling.create()
    assert isinstance(strategy, Sampling)  # as above
    try:
        return training_parameters(_problem(problem), strategy)
    except (RequestError, NumericalError) as error:
        raise RequestError(f"sampling strategy '{sampling.name}' for problem '{problem.name}': {error}") from None


def size_of_set(problem: Plugin, sampling: Plugin) -> int:
    """Number of parameters of a set; 0 if the problem or the strategy is not available, and nothing can be run."""
    return len(sampled(problem, sampling)) if is_available(problem, sampling) else 0


def check_no_training(validation: Plugin) -> None:
    """Refuse a sampling strategy that makes training sets alone as one of a validation set."""
    if isinstance(validation.create(), AdaptiveSampling):
        raise RequestError(
            f"sampling strategy '{validation.name}' chooses training parameters by what solutions know; it makes no "
            "validation set"
        )


def check_own_validation(problem: Plugin, count: int, seed: int) -> None:
    """Refuse a number of validation parameters that the problem does not have."""
    try:
        validation_parameters(_problem(problem), count, seed)
    except NumericalError as error:
        raise RequestError(f"problem '{problem.name}': {error}") from None


def check_unseen(problem: Plugin, training: Plugin | None, validation: Plugin | int, seed: int) -> None:
    """Refuse a validation set all of whose parameters are training parameters, if a strategy has made one of the two.

    Errors there would say nothing of other parameters; two strategies with the same seed draw the same points.

    Raises
    ------
    RequestError
        If it is so.
    """
    if training is None and isinstance(validation, int):
        return
    built = _problem(problem)
    known = training_parameters(built) if training is None else sampled(problem, training)
    asked = (
        validation_parameters(built, validation, seed) if isinstance(validation, int) else sampled(problem, validation)
    )
    if np.isin(_rows(asked), _rows(known)).all():
        raise RequestError(
            f"all validation parameters of problem '{problem.name}' are training parameters, so that errors would say "
            "nothing of others: give one of the two sets another seed, or other parameters"
        )


def _rows(mus: Array) -> Array:
    """Every row as one value that compares to the last bit."""
    return np.ascontiguousarray(mus, float).view(f"V{8 * mus.shape[1]}").ravel()
