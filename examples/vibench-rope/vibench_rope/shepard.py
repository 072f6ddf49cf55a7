"""Inverse distance interpolation of the snapshots: a formulation that solves nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt

from vibench import Array, Formulation, FormulationAnswer, FormulationModel, OfflinePhase, QuerySettings


class Shepard(Formulation):
    """Shepard's interpolation (1968) of the modes' coefficients and of the multipliers over the training set.

    Weights are positive and their sum is 1: u_N is in V_N, λ_N is in the cone of all snapshots. Neither solves the
    problem between the training parameters; how well it does, the residuals of the high-fidelity problem say.

    Parameters
    ----------
    power
        Weights are distances, relative to the box, to the power of minus this.
    """

    uses = ("pod",)

    def __init__(self, power: Annotated[float, Gt(0.0)] = 3.0) -> None:
        self.power = power

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        """Coefficients (N×P) of the snapshots, the multipliers (m×P), and their parameters (P×d)."""
        snapshots, basis = offline.snapshots, offline.pod.basis
        return {"x": offline.problem.V.gram(basis, snapshots.u), "lam": snapshots.lam, "mus": snapshots.mu}

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        """The interpolant."""
        return _Interpolant(offline.pod.basis, offline.problem.parameters.widths, self.power, **built)


class _Interpolant(FormulationModel):
    def __init__(self, basis: Array, widths: Array, power: float, x: Array, lam: Array, mus: Array) -> None:
        self._basis, self._widths, self._power = basis, widths, power
        self._x, self._lam, self._mus = x, lam, mus
        self.dimension, self.generators = x.shape[0], lam.shape[1]

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:  # noqa: ARG002
        distances = np.linalg.norm((self._mus - mu) / self._widths, axis=1)
        nearest = max(float(distances.min()), np.finfo(float).tiny)
        weights = (nearest / np.maximum(distances, nearest)) ** self._power
        weights /= weights.sum()
        return FormulationAnswer(self._x @ weights, weights)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:  # noqa: ARG002
        assert answer.x is not None  # `solve` always answers
        assert answer.alpha is not None
        return self._basis @ answer.x, self._lam @ answer.alpha
