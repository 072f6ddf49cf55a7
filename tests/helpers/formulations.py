"""Formulations that are right, for tests: the mixed one as a plugin, and one that has no multiplier."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

import vibench
from vibench import Array, Formulation, FormulationAnswer, FormulationModel, Multiplier, OfflinePhase, QuerySettings


class Program(Formulation):
    """The quadratic program of the mixed formulation, as a third party would write it."""

    takes_start: ClassVar[bool] = False

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        return {}

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        return ProgramModel(offline)


class ProgramModel(FormulationModel):
    def __init__(self, offline: OfflinePhase) -> None:
        self.assembled = offline.assembled
        self.dimension = self.assembled.fixed_basis.shape[1] + offline.multipliers.rank
        self.generators = self.assembled.generators.shape[1]

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        reduced = self.assembled.assemble(mu)
        found = settings.solve_qp(reduced.program, factor=reduced.factor)
        if found.x is None or found.alpha is None:
            return FormulationAnswer.none(found.solver_status)
        return FormulationAnswer(found.x, found.alpha, iterations=found.iterations)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
        u = self.assembled.assemble(mu).reconstruct(answer.x[:, None])[:, 0]
        return np.asarray(u), np.asarray(self.assembled.generators @ answer.alpha)


class Nearest(Formulation):
    """The displacement of the nearest training parameter; λ is what is left to balance its residual."""

    uses: ClassVar[tuple[str, ...]] = ()
    multiplier: ClassVar[Multiplier] = Multiplier.RESIDUAL

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        return {"u": offline.snapshots.u, "mus": offline.snapshots.mu}

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        return NearestModel(built["u"], built["mus"], offline.problem.parameters.widths)


class NearestModel(FormulationModel):
    dimension = 1

    def __init__(self, u: Array, mus: Array, widths: Array) -> None:
        self.u, self.mus, self.widths = u, mus, widths

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        nearest = int(np.argmin(np.linalg.norm((self.mus - mu) / self.widths, axis=1)))
        return FormulationAnswer(np.array([float(nearest)]), uncertainty=0.5)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
        return self.u[:, int(answer.x[0])].copy(), None


class Coarse(Formulation):
    """The mixed program with every other generator of the cone: a formulation that the machinery runs as `mixed`."""

    has_program = has_certificate = takes_start = True

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        return {}

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        cone = replace(offline.cone, generators=offline.cone.generators[:, ::2], free=offline.cone.free[::2])
        phase = replace(offline).given(pod=offline.pod, cone=cone, enrichment=offline.enrichment)
        return vibench.ProgramModel(phase.assembled)
