"""A problem under examination: parameters to look at, and what it assembles there."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.testing.comparisons import Members, members

RANDOM = 4
"""Random parameters looked at, beside two corners and the centre of the box."""


class Case:
    """A problem under examination; whatever it assembles is copied at once, so that one fault stays one.

    Parameters
    ----------
    create
        Makes an instance.
    seed
        Of whatever is random.

    Attributes
    ----------
    times
        Wall seconds of every assembly.
    construction
        Wall seconds that it took to make the first instance.
    """

    def __init__(self, create: Callable[[], Problem], seed: int) -> None:
        self.create, self.seed = create, seed
        self.times: list[float] = []
        self.construction = 0.0

    @cached_property
    def problem(self) -> Problem:
        """The instance that most checks look at."""
        start = time.perf_counter()
        problem = self.create()
        self.construction = time.perf_counter() - start
        return problem

    @cached_property
    def mus(self) -> Array:
        """Parameters (K×d): two corners of the box, its centre, and random ones."""
        box = self.problem.parameters
        fixed = np.stack([box.lower, box.upper, 0.5 * (box.lower + box.upper)])
        return np.concatenate([fixed, box.sample(RANDOM, self.seed)])

    @cached_property
    def assembled(self) -> list[Members]:
        """Members at all these parameters."""
        return [self.members(mu) for mu in self.mus]

    def assemble(self, mu: Array, problem: Problem | None = None) -> Any:
        """What `assemble` gives at a copy of mu (d,), of the problem or of another instance."""
        start = time.perf_counter()
        vi = (problem or self.problem).assemble(mu.copy())
        self.times.append(time.perf_counter() - start)
        return vi

    def members(self, mu: Array, problem: Problem | None = None) -> Members:
        """Copies of A, f, B and g at mu (d,)."""
        vi: VariationalInequality = self.assemble(mu, problem)
        return members(vi)
