"""The mixed formulation as a program of the machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

from vibench import (
    Array,
    CompiledModel,
    CompiledProgram,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    ProgramModel,
    QuerySettings,
)

if TYPE_CHECKING:
    from vibench import OfflinePhase


class Compiled(Formulation):
    """The mixed quadratic program as exported C source, compiled when the model is made: needs a C compiler.

    A query is one call, from the parameter to the solution by the active set methods of the exported file. The basis
    must not depend on the parameter.
    """

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "accuracy")
    assembled: ClassVar[str] = "reduced"
    has_program: ClassVar[bool] = True

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        """The polynomials of which the source is made: who loads an artefact runs nothing that is in it."""
        return {"polynomials": CompiledModel.of(offline.assembled, offline.accuracy)}

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        """The program, compiled for the accuracy of the queries and loaded into this process."""
        return CompiledFormulationModel(offline, replace(built["polynomials"], accuracy=offline.accuracy))


class CompiledFormulationModel(ProgramModel):
    """Calls the program."""

    def __init__(self, offline: OfflinePhase, made: CompiledModel) -> None:
        super().__init__(offline.assembled)
        self.call = _loaded(made.source(self.reduced), self.dimension, self.generators)

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:  # noqa: ARG002
        """The solution at mu (d,), or what the program says without one."""
        found = self.call(mu)
        if found.x is None:
            return FormulationAnswer.none(found.solver_status)
        return FormulationAnswer(found.x, found.alpha, reason=found.solver_status, iterations=found.iterations)


@lru_cache(maxsize=32)
def _loaded(source: str, unknowns: int, constraints: int) -> CompiledProgram:
    # Cells that differ only in their corrections share a program: the compiler takes about a second.
    return CompiledProgram(source, unknowns, constraints)
