"""Claims of the paper, and the rules by which measured numbers confirm them: every page that judges has them from here.

The rules are the strictest that the text supports. A number that a run does not have is neither confirmed nor refuted,
an observation on a figure is judged by the parameters and tolerances of that figure, and a quantity of which only
bounds are known is judged by the bound that proves something.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # pages without figures load no matplotlib
    from vibench.report import CaptionedFigure, Sheet

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


class Agreement(StrEnum):
    """Outcome of a comparison."""

    AGREES = "agrees"
    DIFFERS = "differs"
    OPEN = "cannot be compared"
    GIVEN = "by construction"
    """Agrees because it was put in: an input that is copied from the paper, a size that a study prescribes, arithmetic
    on numbers that the paper prints. It is no outcome, and does not count as one."""


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, compared.

    Attributes
    ----------
    place
        Where the paper makes it: figure, table, equation, section.
    statement
        What it says.
    paper, ours
        Its value and ours.
    verdict
        Whether they agree.
    why
        How they were compared, and the cause of a difference.
    """

    place: str
    statement: str
    paper: str
    ours: str
    verdict: Agreement
    why: str = ""

    @property
    def name(self) -> str:
        """Place and statement."""
        return f"{self.place}: {self.statement}"


def number(
    place: str,
    statement: str,
    paper: float | Sequence[float],
    ours: float | Sequence[float],
    *,
    within: float = 0.0,
    why: str = "",
    cause: str = "",
    given: bool = False,
) -> Claim:
    """A claim about numbers: one or several, which agree within a relative difference; open where one is missing.

    `given` says that ours was put in, so that agreement is no outcome.
    """
    measured = bool(np.all(np.isfinite(np.asarray(ours, float))))
    verdict = judged(close(paper, ours, within) if measured else None, given=given)
    return Claim(place, statement, text(paper), text(ours), verdict, reason(verdict, why, cause))


def holds(
    place: str,
    statement: str,
    ours: str,
    condition: Any,
    *,
    paper: str = "yes",
    why: str = "",
    cause: str = "",
    given: bool = False,
) -> Claim:
    """A claim that a predicate of our numbers decides; open where it is `None`, no outcome where it was put in."""
    verdict = judged(condition, given=given)
    return Claim(place, statement, paper, ours, verdict, reason(verdict, why, cause))


def unknown(place: str, statement: str, paper: object, ours: object, why: str) -> Claim:
    """A claim for which one of the two sides is missing, or means something else."""
    return Claim(place, statement, text(paper), text(ours), Agreement.OPEN, why)


def ordered(
    place: str,
    statement: str,
    smaller: Mapping[int, float],
    larger: Mapping[int, float],
    why: str = "",
    cause: str = "",
) -> Claim:
    """A claim that one history lies below another, at all steps of both."""
    bad, common = exceptions(smaller, larger), smaller.keys() & larger.keys()
    worst = max((smaller[k] / larger[k] for k in bad), default=1.0)
    failing = f"fails at r = {ranges(bad)} of {len(common)}, by a factor up to {worst:.3g}"
    ours = failing if bad else f"at {len(common)} r"
    return holds(place, statement, ours, not bad, paper="for all r", why=why, cause=cause)


def judged(condition: Any, *, given: bool = False) -> Agreement:
    """The verdict of a predicate, open where it is `None`; `given` where it holds because it was put in."""
    agreed = Agreement.GIVEN if given else Agreement.AGREES
    return Agreement.OPEN if condition is None else agreed if condition else Agreement.DIFFERS


def reason(verdict: Agreement, why: str, cause: str) -> str:
    """The remark, and the cause where they do not agree."""
    return why if verdict in (Agreement.AGREES, Agreement.GIVEN) else " ".join(part for part in (why, cause) if part)


def close(paper: float | Sequence[float], ours: float | Sequence[float], within: float = 0.0) -> bool:
    """Whether all numbers are equal within a relative difference, that of round-off at least."""
    one, other = np.atleast_1d(np.asarray(paper, float)), np.atleast_1d(np.asarray(ours, float))
    return bool(one.shape == other.shape and np.all(np.abs(other - one) <= max(within, ROUND_OFF) * np.abs(one)))


def same_order(paper: float, ours: Iterable[float]) -> bool:
    """Whether all values are of an order of magnitude."""
    return all(paper / ORDER <= value <= paper * ORDER for value in ours)


def below(smaller: Any, larger: Any) -> bool:
    """Whether smaller ≤ larger everywhere, up to round-off."""
    one, other = np.asarray(smaller, float), np.asarray(larger, float)
    return bool(np.all(one <= other * (1.0 + ROUND_OFF) + 1e-14))


def exceptions(smaller: Mapping[int, float], larger: Mapping[int, float]) -> list[int]:
    """Steps, among those of both, at which smaller ≤ larger is violated beyond round-off."""
    return [k for k in smaller if k in larger and smaller[k] > larger[k] * (1.0 + ROUND_OFF)]


OPEN = frozenset({"undecided", "as fast"})
"""Meanings of a break-even that claim no number and contradict none."""


def break_even_verdict(paper: float, meaning: str, low: float | None, high: float | None) -> Agreement:
    """Whether a published break-even lies in a measured interval; "from" is the only meaning that the paper knows.

    Open where the break-even is undecided or the queries are as fast, so that no number is claimed, or where the
    interval contains the number and is too wide to confirm it.
    """
    if meaning in OPEN:
        return Agreement.OPEN
    if meaning != "from" or low is None or high is None or not low <= paper <= high:
        return Agreement.DIFFERS
    return Agreement.AGREES if high <= WIDEST * low else Agreement.OPEN


def cheaper_from(meanings: Iterable[str]) -> Agreement:
    """Whether several break-evens all read "from"; open where none contradicts it but some are open."""
    different = set(meanings) - {"from"}
    return judged(False if different - OPEN else None if different else True)


def break_even_text(value: float | None, meaning: str, low: float | None, high: float | None) -> str:
    """A break-even with its interval, which has no upper end where none is known."""
    ends = [None if end is None or math.isnan(end) else f"{end:.0f}" for end in (low, high)]
    interval = "" if ends[0] is None else f" (≥ {ends[0]})" if ends[1] is None else f" ({ends[0]}–{ends[1]})"
    return (meaning if value is None or math.isnan(value) else f"{meaning} {value:.0f}") + interval


def text(values: object) -> str:
    """A number with three significant digits, several separated by commas, or text as it is."""
    if isinstance(values, (tuple, list, np.ndarray)):
        return ", ".join(text(value) for value in values)
    if not isinstance(values, (int, float, np.integer, np.floating)):
        return str(values)
    value = float(values)
    if math.isnan(value):
        return "none"
    return f"{value:.0f}" if value.is_integer() and abs(value) < 1e6 else f"{value:.3g}"


def span(values: Iterable[float]) -> str:
    """Smallest and largest value."""
    ends = np.asarray(list(values), float)
    low, high = text(ends.min()), text(ends.max())
    return low if low == high else f"{low} to {high}"


def ranges(steps: Sequence[int]) -> str:
    """Rising steps, consecutive ones as a range."""
    groups: list[list[int]] = []
    for step in steps:
        if groups and step == groups[-1][-1] + 1:
            groups[-1].append(step)
        else:
            groups.append([step])
    return ", ".join(str(group[0]) if len(group) == 1 else f"{group[0]}–{group[-1]}" for group in groups)


def typeset(words: str) -> str:
    """One line; exponents without zeros, and minus signs."""
    short = re.sub(r"(?<=\d)e([+-])0*(?=\d)", lambda match: "e" + match[1].replace("+", ""), " ".join(words.split()))
    return re.sub(r"(?<![\w–-])-(?=\d)", "−", short)


def published(claims: Iterable[Claim]) -> str:
    """What the paper says, as a sentence."""
    values = (claim.statement + f": {claim.paper}" * (claim.paper != "yes") for claim in claims)
    return typeset(f"{'; '.join(values)}.")


def compared(claims: Iterable[Claim]) -> str:
    """What agrees with the paper, what differs from it and what cannot be compared, as sentences."""
    by_verdict: dict[Agreement, list[str]] = {verdict: [] for verdict in Agreement}
    for claim in claims:
        by_verdict[claim.verdict].append(f"{claim.statement}: {claim.ours}")
    said = (f"{verdict.capitalize()}: {'; '.join(texts)}." for verdict, texts in by_verdict.items() if texts)
    return typeset(" ".join(said))


def judged_figure(sheet: Sheet, caption: str, claims: Iterable[Claim]) -> CaptionedFigure:
    """The finished figure with its caption, what is published of it, and how the two compare."""
    figure, every = sheet.finish(typeset(caption)), list(claims)
    figure.published, figure.compared = published(every), compared(every)
    return figure
