"""Formulations that are _wrong, each in one way; what `vibench check` has to find, and nothing else."""

import os
import signal
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from formulations import Program, ProgramModel

import vibench
from vibench import Array, FormulationAnswer, FormulationModel, OfflinePhase, Outcome, QuerySettings


def _variant(name: str, **members: Any) -> type[Program]:
    return type(name, (Program,), {"__module__": __name__, **members})


def _wrong(name: str, **members: Any) -> type[Program]:
    """The mixed formulation with a model that has other members."""
    kind = type(f"{name}Model", (ProgramModel,), members)
    return _variant(name, model=lambda self, offline, built: kind(offline))


def _answering(name: str, change: Callable[[FormulationAnswer, Array], Any]) -> type[Program]:
    return _wrong(name, solve=lambda self, mu, settings: change(ProgramModel.solve(self, mu, settings), mu))


def _rebuilding(name: str, change: Callable[[Array, Array], Any]) -> type[Program]:
    """The mixed formulation that makes another pair of its answer."""
    return _wrong(name, reconstruct=lambda self, mu, answer: change(*ProgramModel.reconstruct(self, mu, answer)))


def _stepped_on(answer: FormulationAnswer, mu: Array) -> FormulationAnswer:
    mu += 1e-3
    return answer


def _same_solver(self: Any, mu: Array, settings: QuerySettings) -> FormulationAnswer:
    found = vibench.solve_qp(self.assembled.assemble(mu).program, "piqp", settings.accuracy)
    return FormulationAnswer(found.x, found.alpha)


AxisThatIsNone = _variant("AxisThatIsNone", uses=("pod", "cones"))
EnrichesNothing = _variant("EnrichesNothing", uses=("pod", "primal"))
SolverOfItsOwnAccord = _variant("SolverOfItsOwnAccord", uses=("pod", "dual", "primal", "accuracy", "assembly"))
MultiplierInWords = _variant("MultiplierInWords", multiplier="somehow")
BuildsAList = _variant("BuildsAList", build=lambda self, offline: [offline.snapshots.u])
BuildsAFunction = _variant("BuildsAFunction", build=lambda self, offline: {"tangent": lambda mu: mu})
MakesADictionary = _variant("MakesADictionary", model=lambda self, offline, built: {"basis": offline.pod.basis})
# It says that it has a solver, and always calls the same one.
NoProgram = _wrong("NoProgram", solve=_same_solver)
# It changes the parameter that it is given.
StepsOn = _answering("StepsOn", _stepped_on)
NotANumber = _answering("NotANumber", lambda one, mu: replace(one, x=one.x * np.where(one.x == one.x[2], np.nan, 1.0)))
NeverConverges = _answering(
    "NeverConverges", lambda answer, mu: replace(answer, outcome=Outcome.INACCURATE, reason="100 steps were too few")
)
SaysNotWhy = _answering("SaysNotWhy", lambda one, mu: replace(one, outcome=Outcome.FAILED if mu[0] > 0 else Outcome.OK))
WrongSide = _rebuilding("WrongSide", lambda u, lam: (-u, lam))
Rolls = _rebuilding("Rolls", lambda u, lam: (u * (1.0 + 1e-9 * np.random.default_rng().random()), lam))


class RemembersItsScale(Program):
    """The factor of u is not among the coefficients."""

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        return _ScaledModel(offline)


class _ScaledModel(ProgramModel):
    scale = 0.0

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        self.scale = 1.0
        return super().solve(mu, settings)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
        u, lam = super().reconstruct(mu, answer)
        return self.scale * u, lam


class Unpicklable(Program):
    def __init__(self) -> None:
        self.weight = lambda mu: mu


class Misbehaves(Program):
    """Misbehaves at every parameter whose first component is in the upper half of the box."""

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "solvers", "accuracy")

    def __init__(self, how: str = "raises") -> None:
        self.how = how

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        return MisbehavingModel(offline, self.how)


class MisbehavingModel(ProgramModel):
    def __init__(self, offline: OfflinePhase, how: str) -> None:
        super().__init__(offline)
        box = offline.problem.parameters
        self.how, self.middle = how, 0.5 * (box.lower + box.upper)[0]

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        answer = super().solve(mu, settings)
        if mu[0] < self.middle:
            return answer
        if self.how == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.how == "raises":
            raise ArithmeticError("no pivot")
        return answer
