"""The two sides that `as_published.py` compares: the algorithms as published, and vibench's own."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import published

from vibench import Array, CompiledModel, CompiledProgram, Problem, Reduction, Stop, UnsupportedError
from vibench.qp import kkt_residuals
from vibench.qp.solve import solve_qp
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle
from vibench_strategies.cpg import CPG
from vibench_strategies.mcpg import ModifiedCPG
from vibench_strategies.offline_pga import OfflinePGA
from vibench_strategies.online_supremizers import OnlineSupremizers


@dataclass(frozen=True)
class Case:
    """One pair of reduced spaces of the paper: where V_N and the cones stop, δ_PGA, and the number of queries."""

    problem: type[Problem]
    pod: Stop
    cone: Stop
    pga: float
    queries: int
    # Relative difference of numbers of supremizers. Where B(mu) varies, many σ equal 1 at first, and which of the
    # vectors that belong to them is added depends on the basis of S_R(mu).
    ties: float = 0.0


CASES: Mapping[str, Case] = {
    "obstacle": Case(Obstacle, Stop(tolerance=1e-3), Stop(tolerance=1e-2), 1e-3, 64),
    "hertz": Case(Hertz, Stop(size=46), Stop(size=12), 0.3, 30, ties=0.05),
}
"""For the obstacle the first column of the paper's Table 1, for Hertz contact the third one of Table 2."""


class Side:
    """What one side has made so far: snapshots u (n×P) and λ (m×P), V_N (n×N), generators of both greedies (m×R), …"""

    u: Array
    lam: Array
    basis: Array
    plain: Array  # of CPG
    chi: Array  # of mCPG
    space: Array  # V_N + S^red (n×N')

    def __init__(self, problem: Problem, case: Case) -> None:
        self.problem, self.case = problem, case

    def do(self, stage: str) -> Any:
        """A stage offline: snapshots, POD, CPG, …"""
        return getattr(self, stage.lower().replace(",", "").replace(" ", "_"))()

    def prepare(self) -> None:
        """Make what queries need besides; not timed."""


class Published(Side):
    def snapshots(self) -> None:
        self.u, self.lam = published.snapshots(self.problem, self.problem.training_set())

    def pod(self) -> None:
        self.basis = published.pod(self.u, self.problem.V.matrix, self.case.pod)

    def cpg(self) -> None:
        self.plain = published.cpg(self.lam, self.problem.W.matrix, self.case.cone)

    def mcpg(self) -> None:
        self.chi = published.mcpg(self.lam, self.problem.W.matrix, self.case.cone)

    def pga(self) -> None:
        added = published.pga(self.problem, self.basis, self.chi, self.case.pga)
        self.space = np.column_stack([self.basis, added])

    def pga_residuals_kept(self) -> None:
        published.pga(self.problem, self.basis, self.chi, self.case.pga, kept=True)

    def reduction(self) -> None:
        pass  # the paper assembles in full

    def prepare(self) -> None:
        self.factor = published.factorise(self.problem.V.matrix)

    def query(self, way: str, mu: Array, accuracy: float) -> published.Answer:
        """The answer at mu (d,) with V_N + S_R(mu), "online", or with V_N + S^red, "offline"."""
        if way == "online":
            return published.query_online(self.problem, self.factor, self.basis, self.chi, mu, accuracy)
        return published.query_offline(self.problem, self.space, self.chi, mu, accuracy)


class Ours(Side):
    compiled: CompiledProgram
    not_compiled = ""

    def __init__(self, problem: Problem, case: Case) -> None:
        super().__init__(problem, case)
        pair, stops = (ModifiedCPG(), OfflinePGA()), (case.pod, case.cone)
        self.fixed = Reduction(problem, *pair, *stops, tolerance=case.pga, assembly="reduced")

    def _again(self, *known: str) -> Reduction:
        """The reduction with these steps alone: a stage that is timed repeatedly is computed every time."""
        self.fixed = replace(self.fixed).given(**{name: getattr(self.fixed, name) for name in known})
        return self.fixed

    def snapshots(self) -> None:
        found = self._again().snapshots
        self.u, self.lam = found.u, found.lam

    def pod(self) -> None:
        self.basis = self._again("snapshots").pod.basis

    def cpg(self) -> None:
        self.plain = CPG().reduce(self.lam, self.problem.W, self.case.cone).generators

    def mcpg(self) -> None:
        self.chi = self._again("snapshots", "pod").multipliers.chi

    def pga(self) -> None:
        self.space = self._again("snapshots", "pod", "cone", "multipliers").projection.fixed_basis

    def pga_residuals_kept(self) -> None:
        self.pga()

    def reduction(self) -> None:
        assert self._again("snapshots", "pod", "cone", "multipliers", "enrichment").operators

    def prepare(self) -> None:
        made = {name: getattr(self.fixed, name) for name in ("snapshots", "pod", "cone", "multipliers", "members")}
        self.per_parameter = replace(self.fixed, primal=OnlineSupremizers(), tolerance=None).given(**made)
        assert self.per_parameter.assembled
        try:
            self.compiled = CompiledModel.of(self.fixed.assembled, 1e-10).program(self.fixed.assembled)
        except UnsupportedError as error:
            self.not_compiled = str(error)

    def query(self, way: str, mu: Array, accuracy: float, solver: str = "daqp") -> published.Answer:
        """The answer at mu (d,) of the same spaces, in reduced assembly."""
        # As queries of a study do: the public `solve_qp` checks what users pass, which takes a fifth of a query.
        reduced = (self.per_parameter if way == "online" else self.fixed).assembled.assemble(mu)
        found = solve_qp(reduced.program, solver, accuracy, factor=reduced.factor)
        return reduced.program, found.x, found.alpha, lambda: reduced.basis

    def compiled_residual(self, mu: Array) -> float:
        """Its largest residual in the program of the reduced offline query."""
        found = self.compiled(mu)
        return kkt_residuals(self.fixed.assembled.assemble(mu).program, found.x, found.alpha).worst
