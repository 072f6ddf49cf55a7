"""What formulations have in common: reduced programs, the spaces of answers, and cones without free generators."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vibench import (
    Array,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    Kind,
    Outcome,
    QuerySettings,
    ReducedSet,
    UnsupportedError,
    VariationalInequality,
)
from vibench_strategies.formulations.whitened import Whitened

if TYPE_CHECKING:
    from vibench import OfflinePhase


class ProgramFormulation(Formulation):
    """The reduced program of V_N, its enrichment and the cone, solved by an algorithm instead of a QP solver."""

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "accuracy", "assembly")

    @abstractmethod
    def algorithm(self, program: Whitened, accuracy: float) -> tuple[Array, Array, int, str]:
        """The solution z (N,), ν (k,) ≥ 0 of a program, steps, and why it is not accurate; "" if it is.

        Raises a `NumericalError` if there is none.
        """

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        """Nothing beside the reduced model, whose multipliers have to have signs."""
        refuse_free(offline.cone)
        return {}

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:  # noqa: ARG002
        """The reduced model with the algorithm in place of a QP solver."""
        return ProgramModel(offline, self)


class PhasesModel(FormulationModel):
    """A model that answers in the spaces of offline phases, of one of them at each parameter."""

    def __init__(self, phases: Sequence[OfflinePhase]) -> None:
        self._models = [phase.assembled for phase in phases]
        self.dimension = max(largest_dimension(phase) for phase in phases)
        self.generators = max(phase.cone.size for phase in phases)

    def phase(self, mu: Array) -> int:  # noqa: ARG002
        """The number of the phase that answers at mu (d,)."""
        return 0

    def assembled(self, mu: Array) -> Any:
        """The reduced problem at mu (d,), of the phase that answers there."""
        return self._models[self.phase(mu)].assemble(mu)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
        """U = Z x and λ = χ α in the spaces of this phase."""
        assert answer.x is not None
        assert answer.alpha is not None
        chi = self._models[self.phase(mu)].generators
        return self.assembled(mu).reconstruct(answer.x[:, None])[:, 0], chi @ answer.alpha


class ProgramModel(PhasesModel):
    """Assembles the reduced program at a parameter, and solves it by the algorithm of a formulation."""

    def __init__(self, offline: OfflinePhase, formulation: ProgramFormulation) -> None:
        super().__init__([offline])
        self._formulation = formulation

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        """Assemble, whiten, solve, and return to the coordinates of the model."""
        reduced = self.assembled(mu)
        program = Whitened.of(reduced.program, reduced.factor)
        if program.is_free:
            x, alpha = program.back(np.zeros_like(program.y), np.zeros(len(program.g)))
            return FormulationAnswer(x, alpha, iterations=0)
        z, nu, steps, reason = self._formulation.algorithm(program, settings.accuracy)
        x, alpha = program.back(z, nu)
        outcome = Outcome.INACCURATE if reason else Outcome.OK
        return FormulationAnswer(x, alpha, outcome, reason, steps)


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


def refuse_free(cone: ReducedSet) -> None:
    """Raise an `UnsupportedError` if generators may be used with either sign."""
    if cone.free.any():
        raise UnsupportedError("the formulation needs λ ≥ 0, and the cone has generators that are free in sign")


def solved(settings: QuerySettings, program: VariationalInequality, factor: Array | None = None) -> FormulationAnswer:
    """The answer of the QP solver of the cell; `factor` is the Cholesky factor of A where it is known."""
    found = settings.solve_qp(program, factor=factor)
    if found.x is None or found.alpha is None:
        return FormulationAnswer.none(found.solver_status)
    return FormulationAnswer(found.x, found.alpha, iterations=found.iterations)


def largest_dimension(offline: OfflinePhase) -> int:
    """Largest dimension over all parameters of V_N and its enrichment; of what a strategy supplies it is a guess."""
    added, enrichment = offline.multipliers.span, offline.enrichment
    if enrichment.kind is not Kind.PER_PARAMETER:
        added = np.zeros((0, 0)) if enrichment.vectors is None else enrichment.vectors
    elif enrichment.eta is not None:
        added = enrichment.eta
    return int(offline.pod.basis.shape[1] + added.shape[1])
