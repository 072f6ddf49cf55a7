"""The model of formulations whose queries are reduced quadratic programs."""

from __future__ import annotations

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.formulations import FormulationAnswer, FormulationModel, QuerySettings
from vibench.interfaces.strategies import Kind
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel


class ProgramModel(FormulationModel):
    """Assembles the program of a reduced model at a parameter, and leaves its solution to the QP solver of the cell."""

    def __init__(self, reduced: AnyReducedModel) -> None:
        self.reduced = reduced
        spaces = reduced.model if isinstance(reduced, HyperReducedModel) else reduced
        varying = spaces.span.shape[1] if spaces.enrichment.kind is Kind.PER_PARAMETER else 0
        self.dimension = int(reduced.fixed_basis.shape[1] + varying)
        self.generators = int(reduced.generators.shape[1])

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        """The solution of the program at mu (d,)."""
        assembled = self.program(mu)
        found = settings.solve_qp(assembled.program, factor=assembled.factor)
        if found.x is None or found.alpha is None:
            return FormulationAnswer.none(found.solver_status)
        return FormulationAnswer(found.x, found.alpha, reason=found.solver_status, iterations=found.iterations)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
        """The pair u = Z x and λ = χ α; it assembles again."""
        assert answer.x is not None
        assert answer.alpha is not None
        u = self.program(mu).reconstruct(answer.x[:, None])[:, 0]
        return np.asarray(u), np.asarray(self.reduced.generators @ answer.alpha)
