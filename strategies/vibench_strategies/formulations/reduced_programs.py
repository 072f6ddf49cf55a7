"""What formulations have in common: reduced programs, the spaces of answers, and cones without free generators."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vibench import (
    Array,
    Asked,
    Cone,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    Kind,
    Outcome,
    UnsupportedError,
    VariationalInequality,
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
        refuse_free(offline.cone)
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


class FixedSpacesModel(FormulationModel):
    """A model whose answers are in the span of vectors V (n×N') and in the cone of generators χ (m×R), at every mu."""

    def __init__(self, vectors: Array, generators: Array) -> None:
        self._vectors, self._chi = vectors, generators
        self.dimension, self.generators = int(vectors.shape[1]), int(generators.shape[1])

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:  # noqa: ARG002
        """U = V x and λ = χ α."""
        assert answer.x is not None
        assert answer.alpha is not None
        return self._vectors @ answer.x, self._chi @ answer.alpha


def refuse_free(cone: Cone) -> None:
    """Raise an `UnsupportedError` if generators may be used with either sign."""
    if cone.free.any():
        raise UnsupportedError("the formulation needs λ ≥ 0, and the cone has generators that are free in sign")


def solved(asked: Asked, program: VariationalInequality, factor: Array | None = None) -> FormulationAnswer:
    """The answer of the QP solver of the cell; `factor` is the Cholesky factor of A where it is known."""
    found = asked.solve_qp(program, factor=factor)
    if found.x is None or found.alpha is None:
        return FormulationAnswer.none(found.solver_status)
    return FormulationAnswer(found.x, found.alpha, iterations=found.iterations)


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
