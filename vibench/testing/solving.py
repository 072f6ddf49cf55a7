"""Checks of a problem's solutions, and of what it makes of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError
from vibench.highfidelity import active_set
from vibench.interfaces.problem import Picture
from vibench.interfaces.validation import training_parameters
from vibench.testing.checks import Note
from vibench.testing.comparisons import array_fault, at
from vibench.testing.problem_case import Case

SOLVED = 5
"""Training parameters solved at; more of them, up to ten times as many, while no constraint is active."""


def solution(case: Case) -> Iterator[str]:
    """High-fidelity solutions are found, with multipliers in W⁺ that are not all zero."""
    mus = training_parameters(case.problem)
    solver, worst, contacts, tried, fallbacks = active_set.HighFidelitySolver(case.problem), 0.0, 0, 0, 0
    for k in _spread(len(mus)):
        if tried >= SOLVED and contacts:
            break
        tried += 1
        try:
            found = solver.solve(mus[k].copy())
        except NumericalError as error:
            yield f"no solution {at(mus[k])}: {error}"
            return
        if np.min(found.lam) < 0.0:
            yield f"the multiplier is not in W⁺ {at(mus[k])}: entry {np.argmin(found.lam)} is {np.min(found.lam):.1e}"
            return
        worst = max(worst, found.residuals.worst)
        contacts, fallbacks = contacts + bool(np.any(found.lam > 0.0)), fallbacks + bool(found.fallback)
    if not contacts:
        yield (
            f"no constraint is active at any of {tried} training parameters: all multipliers are zero, and there is "
            "nothing to make a cone of; are B and g such that B u ≤ g is what is allowed?"
        )
    helped = f", {fallbacks} with a first guess of an interior-point method" if fallbacks else ""
    yield Note(f"residuals up to {worst:.0e}, contact at {contacts} of {tried} parameters{helped}")


def _spread(count: int) -> Indices:
    """Indices below `count`: `SOLVED` of them first, then those between, evenly spread."""
    first = np.linspace(0, count - 1, SOLVED).round().astype(np.intp)
    more = np.linspace(0, count - 1, 10 * SOLVED).round().astype(np.intp)
    return np.array(list(dict.fromkeys([*first, *more])), dtype=np.intp)


def pictures(case: Case) -> Iterator[str]:
    """What is optional, `diagnostics` and `picture`, is of the right shape."""
    mu = training_parameters(case.problem)[0]
    for name, value in case.problem.diagnostics(mu.copy()).items():
        if not isinstance(name, str) or not np.isscalar(value) or not np.isfinite(float(value)):  # type: ignore[arg-type]
            yield f"diagnostics gives {value!r} for {name!r} {at(mu)}; expected a finite number for a name"
    found = active_set.HighFidelitySolver(case.problem).solve(mu.copy())
    u, lam = found.u.copy(), found.lam.copy()
    picture = case.problem.picture(mu.copy(), u, lam)
    if not (np.array_equal(u, found.u) and np.array_equal(lam, found.lam)):
        yield "picture changes the solution it is given"
    if picture is None:
        yield Note("no picture")
    elif not isinstance(picture, Picture):
        yield f"picture gives a {type(picture).__name__}; expected a vibench.Picture or None"
    else:
        yield from _picture_faults(picture, len(lam))


def _picture_faults(picture: Picture, m: int) -> Iterator[str]:
    count, line = np.shape(picture.points)[-1], np.shape(picture.points)[:1] == (1,)
    where: Array = picture.positions
    expected = {"points": (1 if line else 2, count), "values": (count,), "multiplier": (m,),
                "positions": (1 if np.shape(where)[:1] == (1,) else 2, m)}  # fmt: skip
    for name, shape in expected.items():
        if fault := array_fault(f"the picture's {name}", getattr(picture, name), shape):
            yield fault
    triangles = np.asarray(picture.triangles)
    if line:
        return
    if triangles.ndim != 2 or len(triangles) != 3 or not np.issubdtype(triangles.dtype, np.integer):
        yield f"the picture's triangles are {triangles.dtype} of shape {triangles.shape}; expected indices (3, t)"
    elif triangles.size and (triangles.min() < 0 or triangles.max() >= count):
        yield f"the picture's triangles name point {triangles.max()}; there are {count}"
