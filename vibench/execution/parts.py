"""Parts of a stage: packages of third parties share no process, and the pieces of a stage may need several."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass
from itertools import groupby

from vibench.stages.base import PiecewiseStage, Stage


@dataclass(frozen=True)
class Part:
    """What one process does in succession: pieces, or a stage without pieces.

    Attributes
    ----------
    packages
        Packages whose code it runs.
    numbers
        The pieces.
    ends
        Whether the stage ends with it.
    """

    packages: frozenset[str]
    numbers: tuple[int, ...]
    ends: bool


@dataclass(frozen=True)
class PartDone:
    """A part is done that does not end its stage."""


def parts(stage: Stage, done: Container[int]) -> Iterator[Part]:
    """What is left of a stage, in the order of its pieces; `done` are the pieces that are not."""
    left = [k for k in range(stage.pieces) if k not in done] if isinstance(stage, PiecewiseStage) else []
    grouped = [(packages, tuple(ks)) for packages, ks in groupby(left, lambda k: _packages(stage, k))]
    for packages, numbers in grouped[:-1]:
        yield Part(packages, numbers, ends=False)
    packages, numbers = grouped[-1] if grouped else (stage.packages, ())
    yield Part(packages, numbers, ends=True)


def _packages(stage: Stage, number: int) -> frozenset[str]:
    return stage.stage_of(number).packages if isinstance(stage, PiecewiseStage) else stage.packages
