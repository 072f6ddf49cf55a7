"""Cones of the multipliers of a model pack: the dual half of a reduced model, which needs λ and X_W alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.interfaces.strategies import Cone, DualStrategy, Stop
from vibench.interfaces.validation import check_cone
from vibench.packs.pack import ModelPack
from vibench.reduction.cones import project_on_cone


@dataclass(frozen=True)
class ReducedMultipliers:
    """A cone, and its largest relative error over the multipliers it was not built from, if there are any."""

    cone: Cone
    validation_error: float | None


def multipliers(pack: ModelPack) -> tuple[Array, Array]:
    """The multipliers of a pack at training parameters (m×P), and the others (m×Q).

    Raises
    ------
    RequestError
        If it has none, or none at training parameters.
    """
    if pack.reference is None:
        raise RequestError("the pack has no multipliers; [solutions] lam would give them")
    known = {tuple(mu) for mu in pack.training.tolist()}
    training = np.array([tuple(mu) in known for mu in pack.reference.parameters.tolist()])
    if not training.any():
        raise RequestError("none of the parameters of the solutions is a training parameter")
    lam = np.maximum(pack.reference.lam, 0.0)  # what is negative is round-off, as `check_pack` has found
    return lam[:, training], lam[:, ~training]


def reduce_multipliers(pack: ModelPack, strategy: DualStrategy, tolerance: float) -> ReducedMultipliers:
    """Build a cone from the multipliers at training parameters; errors are relative to the largest norm there.

    Raises
    ------
    RequestError
        If the pack has no multipliers.
    NumericalError
        If the strategy fails, or what it returns is no cone.
    """
    training, others = multipliers(pack)
    cone = check_cone(strategy.reduce(training, pack.W, Stop(tolerance=tolerance)), pack.W)
    if not others.shape[1]:
        return ReducedMultipliers(cone, None)
    distances = [project_on_cone(cone.rays, column, pack.W).distance for column in others.T]
    return ReducedMultipliers(cone, float(max(distances) / pack.W.norm(training).max()))
