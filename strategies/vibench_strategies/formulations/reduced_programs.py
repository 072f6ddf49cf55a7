"""What formulations that solve the reduced program of the mixed one by an algorithm of their own have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vibench import (
    Array,
    Asked,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    Kind,
    Outcome,
    UnsupportedError,
)
from vibench_strategies.formulations.whitened import Whitened

if TYPE_CHECKING:
    from vibench import Reduction


class ProgramFormulation(Formulation):
    """The reduced program of V_N, its enrichment and the cone, solved by an algorithm instead of a QP solver."""

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "accuracy", "assembly")

    @abstractmethod
    def algorithm(self, program: Whitened, accuracy: float) -> tuple[Array, Array, int, str]:
        """The solution z (N,), ν (k,) ≥ 0 of a program, steps, and why it is not accurate; "" if it is.

        Raises a `NumericalError` if there is none.
        """

    def build(self, offline: Reduction) -> Mapping[str, Any]:
        """Nothing beside the reduced model, whose multipliers have to have signs."""
        if offline.cone.free.any():
            raise UnsupportedError("the formulation needs λ ≥ 0, and the cone has generators that are free in sign")
        return {}

    def model(self, offline: Reduction, built: Mapping[str, Any]) -> FormulationModel:  # noqa: ARG002
        """The reduced model with the algorithm in place of a QP solver."""
        return ProgramModel(offline, self)


class ProgramModel(FormulationModel):
    """Assembles the reduced program at a parameter, and solves it by the algorithm of a formulation."""

    def __init__(self, offline: Reduction, formulation: ProgramFormulation) -> None:
        self._assembled, self._formulation = offline.assembled, formulation
        self.dimension, self.generators = largest_dimension(offline), int(self._assembled.generators.shape[1])

    def solve(self, mu: Array, asked: Asked) -> FormulationAnswer:
        """Assemble, whiten, solve, and return to the coordinates of the model."""
        reduced = self._assembled.assemble(mu)
        program = Whitened.of(reduced.program, reduced.factor)
        if program.is_free:
            x, alpha = program.back(program.y, np.zeros(len(program.g)))
            return FormulationAnswer(x, alpha, iterations=0)
        z, nu, steps, reason = self._formulation.algorithm(program, asked.accuracy)
        x, alpha = program.back(z, nu)
        outcome = Outcome.INACCURATE if reason else Outcome.OK
        return FormulationAnswer(x, alpha, outcome, reason, steps)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
        """U = Z x and λ = χ α."""
        return reconstructed(self._assembled, mu, answer)


def largest_dimension(offline: Reduction) -> int:
    """Largest dimension over all parameters of V_N and its enrichment; of what a strategy supplies it is a guess."""
    added, enrichment = offline.multipliers.span, offline.enrichment
    if enrichment.kind is not Kind.PER_PARAMETER:
        added = np.zeros((0, 0)) if enrichment.vectors is None else enrichment.vectors
    elif enrichment.eta is not None:
        added = enrichment.eta
    return int(offline.pod.basis.shape[1] + added.shape[1])


def reconstructed(assembled: Any, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
    """The pair u (n,), λ (m,) of coefficients in the spaces of a reduced model at mu (d,)."""
    assert answer.x is not None
    assert answer.alpha is not None
    return assembled.assemble(mu).reconstruct(answer.x[:, None])[:, 0], assembled.generators @ answer.alpha
