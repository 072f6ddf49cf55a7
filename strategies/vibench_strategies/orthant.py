"""A face of the high-fidelity cone: single coordinate directions as generators."""

from __future__ import annotations

import numpy as np

from vibench import Array, DualStrategy, InnerProduct, ReducedSet, Stop, no_free
from vibench.reduction import REPRODUCED, TIE, LazyDistances, refuse_negative


class Orthant(DualStrategy):
    """Selected degrees of freedom of the high-fidelity multiplier.

    Fauque, Ramière and Ryckelynck (2018) restrict the multiplier to its degrees of freedom on a reduced integration
    domain; here a matching pursuit (Mallat and Zhang 1993) with coefficients α ≥ 0 selects them.
    """

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Add the direction most correlated with the residual of the snapshot farthest from the cone."""
        refuse_negative(snapshots)
        units = np.eye(W.dim) / np.sqrt(W.matrix.diagonal())
        if not np.any(snapshots):
            return ReducedSet(units[:, :0], np.zeros(1), no_free(0))
        whitened, chosen = W.whiten(units), list[int]()
        distances = LazyDistances(W.whiten(snapshots))
        farthest, error = distances.next()
        errors = [error]
        while not stop.reached(len(chosen), errors[-1]) and errors[-1] > REPRODUCED:
            shares = whitened.T @ distances.residual(farthest)
            shares[chosen] = -np.inf  # zero up to round-off: must not be selected again
            chosen.append(int(np.argmax(shares >= shares.max() * (1.0 - TIE))))
            distances.widen(whitened[:, chosen])
            farthest, error = distances.next()
            errors.append(error)
        return ReducedSet(units[:, chosen], np.array(errors), no_free(len(chosen)))
