"""Formulations that are wrong, each in one way; what `vibench check` has to find, and nothing else."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from formulations import Program, ProgramModel

from vibench import Array, FormulationAnswer, FormulationModel, Multiplier, Outcome, QuerySettings, Reduction, solve_qp

Change = Callable[[FormulationAnswer], FormulationAnswer]


class _Wrong(Program):
    """The mixed formulation with another model."""

    kind: ClassVar[type[ProgramModel]] = ProgramModel

    def model(self, offline: Reduction, built: Mapping[str, Any]) -> FormulationModel:
        return self.kind(offline)


class AxisThatIsNone(Program):
    uses: ClassVar[tuple[str, ...]] = ("pod", "cones")


class EnrichesNothing(Program):
    uses: ClassVar[tuple[str, ...]] = ("pod", "primal")


class MultiplierInWords(Program):
    multiplier: ClassVar[Multiplier] = "somehow"  # type: ignore[assignment]


class BuildsAList(Program):
    def build(self, offline: Reduction) -> Mapping[str, Any]:
        return [offline.snapshots.u]  # type: ignore[return-value]


class BuildsAFunction(Program):
    def build(self, offline: Reduction) -> Mapping[str, Any]:
        return {"tangent": lambda mu: mu}


class MakesADictionary(Program):
    def model(self, offline: Reduction, built: Mapping[str, Any]) -> FormulationModel:
        return {"basis": offline.pod.basis}  # type: ignore[return-value]


class WithoutDimension(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def __init__(self, offline: Reduction) -> None:
            super().__init__(offline)
            del self.dimension


class AnswersInATuple(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
            answer = super().solve(mu, settings)
            return answer.x, answer.alpha  # type: ignore[return-value]


class NotANumber(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
            answer = super().solve(mu, settings)
            assert answer.x is not None
            answer.x[2] = np.nan
            return answer


class NeverConverges(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
            return replace(super().solve(mu, settings), outcome=Outcome.INACCURATE, reason="100 steps were too few")


class SaysNotWhy(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
            outcome = Outcome.FAILED if mu[0] > 0.0 else Outcome.OK
            return replace(super().solve(mu, settings), outcome=outcome)


class MoreThanDeclared(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def __init__(self, offline: Reduction) -> None:
            super().__init__(offline)
            self.generators = 3


class OfAnotherSize(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
            u, lam = super().reconstruct(mu, answer)
            return u[1:], lam


class Pulls(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
            u, lam = super().reconstruct(mu, answer)
            assert lam is not None
            return u, lam - 1e-12 * lam.max()


class ForgetsTheMultiplier(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
            return super().reconstruct(mu, answer)[0], None


class RemembersItsScale(_Wrong):
    """The factor of u is not among the coefficients."""

    class kind(ProgramModel):  # noqa: N801
        scale = 1.0

        def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
            answer = super().solve(mu, settings)
            assert answer.x is not None
            self.scale = float(np.linalg.norm(answer.x))
            return replace(answer, x=answer.x / self.scale)

        def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
            u, lam = super().reconstruct(mu, answer)
            return self.scale * u, lam


class Rolls(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
            answer = super().solve(mu, settings)
            assert answer.x is not None
            return replace(answer, x=answer.x * (1.0 + 1e-9 * np.random.default_rng().random()))


class StepsOn(_Wrong):
    """Changes the parameter that it is given."""

    class kind(ProgramModel):  # noqa: N801
        def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
            answer = super().solve(mu, settings)
            mu += 1e-3
            return answer


class WrongSide(_Wrong):
    class kind(ProgramModel):  # noqa: N801
        def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
            u, lam = super().reconstruct(mu, answer)
            return -u, lam


class NoProgram(_Wrong):
    """Says that it has a solver, and always calls the same one."""

    class kind(ProgramModel):  # noqa: N801
        def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
            found = solve_qp(self.assembled.assemble(mu).program, "piqp", settings.accuracy)
            return FormulationAnswer(found.x, found.alpha)


class SolverOfItsOwnAccord(Program):
    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "accuracy", "assembly")


class Unpicklable(Program):
    def __init__(self) -> None:
        self.weight = lambda mu: mu


class Misbehaves(Program):
    """Misbehaves at every parameter whose first component is in the upper half of the box."""

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "solvers", "accuracy")

    def __init__(self, how: str = "nan") -> None:
        self.how = how

    def model(self, offline: Reduction, built: Mapping[str, Any]) -> FormulationModel:
        return MisbehavingModel(offline, self.how)


class MisbehavingModel(ProgramModel):
    def __init__(self, offline: Reduction, how: str) -> None:
        super().__init__(offline)
        box = offline.problem.parameters
        self.how, self.middle = how, 0.5 * (box.lower + box.upper)[0]

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        answer = super().solve(mu, settings)
        if mu[0] < self.middle:
            return answer
        if self.how == "hangs":
            time.sleep(600.0)
        if self.how == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.how == "raises":
            raise ArithmeticError("no pivot")
        if self.how == "nan":
            assert answer.x is not None
            return replace(answer, x=np.full_like(answer.x, np.nan))
        return answer

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
        u, lam = super().reconstruct(mu, answer)
        assert lam is not None
        if mu[0] < self.middle or self.how not in ("size", "pulls"):
            return u, lam
        return (u[:-1], lam) if self.how == "size" else (u, lam - 1.0)
