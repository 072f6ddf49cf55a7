"""What repeated timings repeat: programs and parameters equivalent to the first one, and never in the same bytes.

Whoever remembers answers, a solver or a problem, would be timed at looking them up otherwise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import VariationalInequality
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, verify

APART = 1e3
"""Units of the unknowns vary by this many times the accuracy, so that the answer in other units is not the answer."""

WIDEST, NARROWEST = 1e-2, 1e-12
"""Units vary by shares between these: the program is as difficult as before, and differs in its bytes."""

RECOGNISED = 30.0
"""A timed answer with residuals above this many times the accuracy is not one of the program that was posed."""

NEARBY = 1e-10
"""Share of the way to a random point of the box by which a parameter is moved."""


def units(count: int, accuracy: float, *seed: int) -> Array:
    """Units (count,) of the unknowns, all close to 1; the same for the same seed."""
    spread = min(max(APART * accuracy, NARROWEST), WIDEST)
    return np.asarray(1.0 + spread * (2.0 * _uniform(count, seed) - 1.0))


def in_units(program: VariationalInequality, d: Array) -> VariationalInequality:
    """The dense program of y, where x = D y with units d (n,) of the unknowns: D A D, D f, B D, g.

    It is the same program: as definite and as feasible, with the same multipliers, and its solution is D⁻¹x. Zeros,
    symmetry, and pairs of opposite constraints stay what they are to the last bit.
    """
    return replace(program, A=program.A * np.outer(d, d), f=d * program.f, B=program.B * d, g=program.g.copy())


def check_answer(program: VariationalInequality, answer: QPSolution, accuracy: float) -> None:
    """Refuse the answer of a timed repetition that does not solve its program to some multiple of the accuracy.

    Raises
    ------
    NumericalError
        Naming the residual.
    """
    status, reason, _ = verify(program, answer, RECOGNISED * accuracy)
    if status is not Status.OK:
        raise NumericalError(f"timed in other units of the unknowns, {reason}; does the solver remember answers?")


def nearby(box: ParameterBox, mu: Array, *seed: int) -> Array:
    """A parameter (d,) of the box next to mu (d,); the same for the same seed."""
    elsewhere = box.lower + _uniform(box.dim, seed) * (box.upper - box.lower)
    return np.asarray(mu + NEARBY * (elsewhere - mu))


def _uniform(count: int, seed: tuple[int, ...]) -> Array:
    """Random numbers (count,) between 0 and 1."""
    # NumPy takes (s, 0) for s, the seed of the validation set: the parameter elsewhere would be the one to be moved.
    return np.random.default_rng((*seed, 1)).random(count)
