"""The constraint of a problem as C, for programs that have no code of the problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from vibench.arrays import Array, Indices
from vibench.signatures import AtLeastOne, bordered


@bordered
@dataclass(frozen=True)
class ContactSource:
    """`Problem.contact` as C99, which exported programs evaluate.

    Attributes
    ----------
    text
        Defines `static int contact(const double *mu, int *ends, int *columns, double *values, double *g)` for a finite
        mu (d,). It fills g (m,) and the entries of B, row by row: those of row i end before `ends[i + 1]`, and
        `ends[0]` is zero. The function returns 1, or 0 where mu has no constraint. All its other names begin with
        `contact_`; `math.h` is there.
    tables
        What the text knows as `contact_NAME`, by name: arrays of float or int, and numbers.
    entries
        The largest number of entries of B.
    """

    text: str
    tables: Mapping[str, Array | Indices | float]
    entries: AtLeastOne
