"""Nonnegative matrix factorisation of the multiplier snapshots."""

from __future__ import annotations

import warnings
from typing import Annotated

import numpy as np
from annotated_types import Ge, Lt

from vibench import Array, DualStrategy, InnerProduct, NumericalError, ReducedSet, Stop, foreign, no_free
from vibench.linalg import singular_values
from vibench.reduction import refuse_negative
from vibench_strategies.snapshot_cones import normalised, projection_errors


class NonnegativeFactors(DualStrategy):
    """NMF, as Balajewicz, Amsallem and Farhat (2016) compress multipliers; factorised by scikit-learn.

    The factorisation minimises the sum of squares in a lumped norm, the diagonal of X_W, because whitening by a
    consistent mass matrix does not preserve nonnegativity. The errors of the cone are in the norm of W. R is the
    smallest number of generators that meets the tolerance.
    """

    requires = ("scikit-learn",)

    def __init__(self, seed: Annotated[int, Ge(0), Lt(2**32)] = 0, iterations: Annotated[int, Ge(1)] = 1000) -> None:
        # Imported here, since scikit-learn is optional, and not in `reduce`, whose seconds count.
        with foreign("scikit-learn cannot be used"):
            from sklearn.decomposition import NMF  # noqa: PLC0415
            from sklearn.exceptions import ConvergenceWarning  # noqa: PLC0415

        self.seed, self.iterations = seed, iterations
        self._factorisation, self._not_converged = NMF, ConvergenceWarning

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Factorise with one more generator at a time, from the smallest number at which POD meets the tolerance."""
        refuse_negative(snapshots)
        sigma, norms = singular_values(W.whiten(snapshots)), W.norm(snapshots)
        means = np.sqrt(np.append(np.cumsum(sigma[::-1] ** 2)[::-1], 0.0) / max(1, len(norms)))
        # A lower bound: the largest distance is at least the root mean square, which POD minimises.
        first = stop.first_reached(means / (np.max(norms, initial=0.0) or 1.0))
        best, most = np.inf, min(W.dim, int(np.count_nonzero(norms)))
        for size in range(most if first is None else min(first, most), most + 1):
            cone = self._factorised(snapshots, W, size)
            best = min(best, cone.errors[-1])
            if stop.size is not None or cone.errors[-1] <= (stop.tolerance or 0.0):
                return cone
        raise NumericalError(
            f"no factorisation reaches {stop}: the best of up to {most} generators has the error {best:.1e}"
        )

    def _factorised(self, snapshots: Array, W: InnerProduct, size: int) -> ReducedSet:
        if not size:
            return ReducedSet(np.zeros((W.dim, 0)), projection_errors(np.zeros((W.dim, 0)), snapshots, W), no_free(0))
        weights, scale = np.sqrt(W.matrix.diagonal())[:, None], float(snapshots.max())
        method = self._factorisation(size, init="nndsvd", max_iter=self.iterations, random_state=self.seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", self._not_converged)  # recorded in the notes
            generators = normalised(method.fit_transform(weights * (snapshots / scale)) / weights, W)
        stopped = method.n_iter_ >= self.iterations
        notes = (f"the factorisation was stopped after {method.n_iter_} iterations",) if stopped else ()
        return ReducedSet(generators, projection_errors(generators, snapshots, W), no_free(generators.shape[1]), notes)
