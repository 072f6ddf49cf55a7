"""Claims of the paper and the predicates that compare them with measured numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from vibench.arrays import Array
from vibench.results.break_even import Meaning
from vibench.results.tables import cell_text, interval

DIMENSION = 0.15
"""Dimensions agree within this relative difference."""

MESH = 0.02
"""Sizes of meshes agree within this relative difference."""

RATIO = 0.25
"""Ratios of seconds agree within this relative difference."""

ORDER = math.sqrt(10.0)
"""Orders of magnitude agree within this factor."""

WIDEST = 3.0
"""Largest ratio of the ends of an interval that can confirm a number; a wider one contains almost any."""

ROUND_OFF = 1e-9
"""Relative violation of an inequality that counts as round-off."""


class Verdict(StrEnum):
    """Outcome of a comparison."""

    AGREES = "agrees"
    DIFFERS = "differs"
    OPEN = "cannot be compared"


@dataclass(frozen=True)
class Claim:
    """One row of the page.

    Attributes
    ----------
    claim
        What the paper says, and where.
    paper, ours
        Its value and ours.
    verdict
        Whether they agree.
    why
        How it was compared, and the cause of a difference.
    """

    claim: str
    paper: str
    ours: str
    verdict: Verdict
    why: str


def text(values: object) -> str:
    """A number with three significant digits, several separated by commas, or text as it is."""
    if isinstance(values, (tuple, list, np.ndarray)):
        return ", ".join(text(value) for value in values)
    return cell_text(float(values)) if isinstance(values, (int, float, np.integer, np.floating)) else str(values)


def span(values: Iterable[float]) -> str:
    """Smallest and largest value."""
    found = np.asarray(list(values), float)
    low, high = text(found.min()), text(found.max())
    return low if low == high else f"{low} to {high}"


def judged(holds: bool) -> Verdict:
    """The verdict of a predicate."""
    return Verdict.AGREES if holds else Verdict.DIFFERS


def close(paper: float | Sequence[float], ours: float | Sequence[float], within: float = 0.0) -> bool:
    """Whether all numbers are equal within a relative difference, that of round-off at least."""
    one, other = np.atleast_1d(np.asarray(paper, float)), np.atleast_1d(np.asarray(ours, float))
    return bool(one.shape == other.shape and np.all(np.abs(other - one) <= max(within, ROUND_OFF) * np.abs(one)))


def same_order(paper: float, ours: Iterable[float]) -> bool:
    """Whether all values are of an order of magnitude."""
    return all(paper / ORDER <= value <= paper * ORDER for value in ours)


def exceptions(smaller: Mapping[int, float], larger: Mapping[int, float]) -> list[int]:
    """Steps, among those of both, at which smaller ≤ larger is violated beyond round-off."""
    return [k for k in smaller if k in larger and smaller[k] > larger[k] * (1.0 + ROUND_OFF)]


def below(smaller: Array, larger: Array) -> bool:
    """Whether smaller ≤ larger everywhere, up to round-off."""
    return bool(np.all(smaller <= larger * (1.0 + ROUND_OFF) + 1e-14))


def break_even_verdict(paper: float, meaning: str, low: float | None, high: float | None) -> Verdict:
    """Whether a published break-even lies in a measured interval; "from" is the only meaning that the paper knows.

    Open where the break-even is undecided, or where the interval contains the number and is too wide to confirm it.
    """
    if meaning == Meaning.UNDECIDED:
        return Verdict.OPEN
    if meaning != Meaning.FROM or low is None or high is None or not low <= paper <= high:
        return Verdict.DIFFERS
    return Verdict.AGREES if high <= WIDEST * low else Verdict.OPEN


def break_even_text(number: float | None, meaning: str, low: float | None, high: float | None) -> str:
    """A break-even with its interval."""
    found = meaning if number is None or math.isnan(number) else f"{meaning} {number:.0f}"
    ends = interval(low, high)
    return f"{found} ({ends})" if ends else found


def cheaper_from(meanings: Iterable[str]) -> Verdict:
    """Whether several break-evens all read "from"; open where none contradicts it but some are undecided."""
    found = set(meanings)
    if found - {Meaning.FROM, Meaning.UNDECIDED}:
        return Verdict.DIFFERS
    return Verdict.OPEN if Meaning.UNDECIDED in found else Verdict.AGREES


def ranges(steps: Sequence[int]) -> str:
    """Rising steps, consecutive ones as a range."""
    groups: list[list[int]] = []
    for step in steps:
        if groups and step == groups[-1][-1] + 1:
            groups[-1].append(step)
        else:
            groups.append([step])
    return ", ".join(str(group[0]) if len(group) == 1 else f"{group[0]}–{group[-1]}" for group in groups)


def reason(verdict: Verdict, why: str, cause: str) -> str:
    """The remark, and the cause where they do not agree."""
    return why if verdict is Verdict.AGREES else " ".join(part for part in (why, cause) if part)


def number(
    claim: str,
    paper: float | Sequence[float],
    ours: float | Sequence[float],
    *,
    within: float = 0.0,
    why: str = "",
    cause: str = "",
) -> Claim:
    """A claim about numbers: one or several, which agree within a relative difference; open where one is missing."""
    measured = np.all(np.isfinite(np.asarray(ours, float)))
    verdict = judged(close(paper, ours, within)) if measured else Verdict.OPEN
    return Claim(claim, text(paper), text(ours), verdict, reason(verdict, why, cause))


def holds(claim: str, paper: str, ours: str, condition: object, *, why: str = "", cause: str = "") -> Claim:
    """A claim that a predicate of our numbers decides."""
    verdict = judged(bool(condition))
    return Claim(claim, paper, ours, verdict, reason(verdict, why, cause))


def unknown(claim: str, paper: object, ours: object, why: str) -> Claim:
    """A claim for which one of the two sides is missing, or means something else."""
    return Claim(claim, text(paper), text(ours), Verdict.OPEN, why)
