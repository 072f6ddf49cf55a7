"""Checks of what a problem is before it is assembled: its spaces, its parameters and its declarations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.problem import MEMBERS, ParameterBox, Problem
from vibench.interfaces.validation import training_parameters, validation_parameters
from vibench.linalg.inner_product import InnerProduct
from vibench.testing.checks import Note, plugin_line
from vibench.testing.comparisons import array_fault, at, difference, matrix_fault
from vibench.testing.problem_case import Case

OUTSIDE_RTOL = 1e-12
"""How far a parameter may be outside the box, relative to the box."""

COUNT = 5
"""Validation parameters asked for."""


def construction(case: Case) -> Iterator[str]:
    """It can be made."""
    try:
        problem: object = case.problem
    except NumericalError as error:  # what `InnerProduct` refuses
        place = plugin_line(error)
        space = next(
            (f"X_{name}: " for name in "VW" if f"self.{name} =" in place and f"X_{name}" not in str(error)), ""
        )
        yield f"{space}{error} ({place})"
        return
    if not isinstance(problem, Problem):
        yield f"a {type(problem).__name__} was made; expected a subclass of vibench.Problem"


def spaces(case: Case) -> Iterator[str]:
    """X_V and X_W are symmetric positive definite."""
    for name in ("V", "W"):
        space = getattr(case.problem, name, None)
        if not isinstance(space, InnerProduct):
            yield f"{name} is a {type(space).__name__}; expected a vibench.InnerProduct"
            continue
        if space.dim == 0:
            yield f"{name} has dimension 0; {'no unknown is free' if name == 'V' else 'there is no constraint'}"
            continue
        if fault := matrix_fault(f"X_{name}", space.matrix, (space.dim, space.dim)):
            yield fault
            continue
        try:
            InnerProduct(space.matrix, f"X_{name}")
        except NumericalError as error:
            yield f"{error}: it was changed after the InnerProduct was made"
    integrals = case.problem.multiplier_integrals()
    if fault := array_fault("multiplier_integrals", integrals, (case.problem.W.dim,)):
        yield fault
    elif np.any(integrals <= 0.0):
        k = int(np.argmin(integrals))
        yield (
            f"multiplier_integrals has the value {integrals[k]:.2g} at entry {k}; expected positive ones, the unit in "
            "which a violation is a length: override it where the basis does not sum to one"
        )


def parameters(case: Case) -> Iterator[str]:
    """The box is one."""
    box = case.problem.parameters
    if not isinstance(box, ParameterBox):
        yield f"parameters is a {type(box).__name__}; expected a vibench.ParameterBox"
        return
    if isinstance(box.names, str) or not box.names or not all(isinstance(name, str) and name for name in box.names):
        yield f"the names of the parameters are {box.names!r}; expected a tuple of texts, one for each parameter"
        return
    if len(set(box.names)) < box.dim:
        yield f"two parameters have the same name: {', '.join(box.names)}"
    if isinstance(box.units, str) or len(box.units) != box.dim:
        yield f"the units of the parameters are {box.units!r}; expected a tuple of {box.dim}, '1' for a number"
    faults = [array_fault(f"parameters.{name}", getattr(box, name), (box.dim,)) for name in ("lower", "upper")]
    yield from filter(None, faults)
    if not any(faults):
        for name, low, high in zip(box.names, box.lower, box.upper, strict=True):
            if low > high:
                yield f"the lower bound {low:g} of the parameter '{name}' is above its upper bound {high:g}"


def training_set(case: Case) -> Iterator[str]:
    """Training parameters lie in the box, and there are several."""
    mus = training_parameters(case.problem)
    yield from _outside("training_set", mus, case.problem.parameters)
    if len(np.unique(mus, axis=0)) < 2:
        yield (
            f"training_set is mu = {mus[0].tolist()} alone: it does not tell how anything depends on mu; "
            "give two different parameters at least"
        )
    if what := difference(training_parameters(case.problem), mus):
        yield f"training_set is not the same when asked for again: {what} before"
    yield Note(f"{len(mus)} parameters")


def validation_set(case: Case) -> Iterator[str]:
    """Validation parameters lie in the box and are reproducible."""
    mus = validation_parameters(case.problem, COUNT, case.seed)
    yield from _outside("validation_set", mus, case.problem.parameters)
    if what := difference(validation_parameters(case.problem, COUNT, case.seed), mus):
        yield f"validation_set is not the same for the same seed: {what} before; draw from default_rng(seed)"


def undeclarable(declaration: str, names: Iterable[str]) -> Iterator[str]:
    """Names in `constant` or `entrywise` that are no members."""
    if isinstance(names, str):
        yield f"`{declaration}` is the text {names!r}; expected a set of names: frozenset({{{names!r}}})"
        return
    for name in sorted(set(names) - set(MEMBERS)):
        yield f"`{declaration}` names '{name}'; expected {', '.join(MEMBERS)}"


def _outside(name: str, mus: Array, box: ParameterBox) -> Iterator[str]:
    slack = OUTSIDE_RTOL * np.maximum(np.abs(box.lower), np.abs(box.upper))
    wrong = np.argwhere((mus < box.lower - slack) | (mus > box.upper + slack))
    if len(wrong):
        k, i = wrong[0]
        yield (
            f"{name} leaves the box: parameter {k}, {at(mus[k])}, has '{box.names[i]}' outside "
            f"[{box.lower[i]:g}, {box.upper[i]:g}]"
        )
