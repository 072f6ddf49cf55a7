"""Checks of problems."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

from vibench.interfaces.problem import Problem
from vibench.testing import assembling, partial_assembly, solving, spaces
from vibench.testing.checks import SECONDS, Check, Finding, examine, name_of, require, too_long
from vibench.testing.problem_case import Case

CHECKS: tuple[tuple[str, Callable[[Case], Iterator[str]], tuple[str, ...]], ...] = (
    ("construction", spaces.construction, ()),
    ("spaces", spaces.spaces, ("construction",)),
    ("parameters", spaces.parameters, ("construction",)),
    ("training set", spaces.training_set, ("parameters",)),
    ("validation set", spaces.validation_set, ("parameters",)),
    ("assembly", assembling.assembly, ("spaces", "parameters")),
    ("no mutation", assembling.no_mutation, ("assembly",)),
    ("symmetry of A", assembling.symmetry, ("assembly",)),
    ("definiteness of A", assembling.definiteness, ("symmetry of A",)),
    ("determinism", assembling.determinism, ("assembly",)),
    ("independence of mu", assembling.independence, ("determinism",)),
    ("continuity in mu", assembling.continuity, ("independence of mu",)),
    ("assembly on the contact", partial_assembly.on_contact, ("determinism",)),
    ("assembly by entries", partial_assembly.by_entries, ("determinism",)),
    ("pickling", assembling.pickling, ("determinism",)),
    (
        "high-fidelity solution",
        solving.solution,
        ("training set", "definiteness of A", "independence of mu", "assembly on the contact"),
    ),
    ("picture and diagnostics", solving.pictures, ("high-fidelity solution",)),
)
"""Every check, in the order in which they are made, and those without which it tells nothing."""


def check_problem(create: Callable[[], Problem], *, seed: int = 0, seconds: float = SECONDS) -> None:
    """Check all that vibench takes for granted of a problem; see `examine_problem`.

    Raises
    ------
    ConformanceError
        Listing every failure: what is wrong, and where to look.
    """
    require(name_of(create), examine_problem(create, seed=seed, seconds=seconds))


def examine_problem(create: Callable[[], Problem], *, seed: int = 0, seconds: float = SECONDS) -> list[Finding]:
    """Findings of all checks of a problem.

    Parameters
    ----------
    create
        Makes an instance: the class, or a `partial` of it with options. Take a coarse mesh: it is assembled some
        hundred times.
    seed
        Of the random parameters and entries that are looked at.
    seconds
        Longest time that an assembly, or making the problem, may take.
    """
    name_of(create)
    case = Case(create, seed)
    checks = [Check(name, partial(faults, case), needs) for name, faults, needs in CHECKS]
    return examine([*checks, Check("time", partial(_time, case, seconds), ("assembly",))])


def _time(case: Case, limit: float) -> Iterator[str]:
    yield from too_long("making the problem", [case.construction], limit)
    yield from too_long("an assembly", case.times, limit)
