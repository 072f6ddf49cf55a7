"""Parameter sets in chunks: what is long at every parameter is done in several stages, on several workers."""

from __future__ import annotations

import numpy as np

from vibench.arrays import Array

CHUNKS = 4
"""Number of chunks of a parameter set; fixed, so that keys do not depend on the workers."""


def edges(count: int) -> list[int]:
    """Numbers of the first parameter of every chunk of `count` parameters, and `count` (CHUNKS + 1,)."""
    return [int(edge) for edge in np.linspace(0, count, CHUNKS + 1).round()]


def part(everything: Array, chunk: int) -> tuple[int, Array]:
    """Number of the first parameter of a chunk, and its parameters, of all (P×d)."""
    first, end = edges(len(everything))[chunk : chunk + 2]
    return first, everything[first:end]
