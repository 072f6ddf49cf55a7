"""CMA-ES on ranks: an optimiser that compares parameters and uses no values, so that its path can be certified."""

from __future__ import annotations

from functools import cmp_to_key

import numpy as np

from vibench.arrays import Array
from vibench.calibration.decisions import Decisions
from vibench.errors import foreign
from vibench.interfaces.parameters import ParameterBox
from vibench.signatures import AtLeastOne, Positive, Seed, bordered


@bordered
def minimise(
    decisions: Decisions, box: ParameterBox, *, seed: Seed, iterations: AtLeastOne, tolx: Positive
) -> tuple[Array, Array]:
    """Minimise the misfit over a parameter box by CMA-ES (Hansen 2016), from its centre.

    It ends after so many generations, or when steps are below `tolx` of the box. Its values are ranks, which decisions
    make: its path is that of the high-fidelity model with the same seed. Returns the best parameter (d,) that was seen,
    and the means (T×d) of the generations.

    Raises an `UnsupportedError` if the package `cma` is not installed.
    """
    with foreign("the package cma, of the extra 'calibration', cannot be used"):
        import cma  # noqa: PLC0415  an extra
    # Criteria that look at values are switched off: ranks are no values. Seeds are of 32 bits, and 0 is
    # the clock.
    ignored = dict.fromkeys(("tolfun", "tolfunhist"), 0.0) | dict.fromkeys(("tolflatfitness", "tolstagnation"), np.inf)
    unit_cube = [np.zeros(box.dim), np.ones(box.dim)]
    limits = {"seed": seed % (2**32 - 1) + 1, "bounds": unit_cube, "tolx": tolx, "maxiter": iterations, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.full(box.dim, 0.5), 0.2, limits | ignored)

    less = decisions.less

    def compare(one: tuple[int, Array], other: tuple[int, Array]) -> int:
        return -1 if less(one[1], other[1]) else 1

    best, path = 0.5 * (box.lower + box.upper), []
    while not strategy.stop():
        unit = strategy.ask()
        candidates = [box.lower + np.asarray(one) * box.widths for one in unit]
        order = sorted(enumerate(candidates), key=cmp_to_key(compare))
        ranks = np.empty(len(unit))
        ranks[[number for number, _ in order]] = np.arange(len(unit))
        strategy.tell(unit, ranks.tolist())
        best = order[0][1] if less(order[0][1], best) else best
        path.append(box.lower + np.asarray(strategy.mean) * box.widths)
    return best, np.array(path)
