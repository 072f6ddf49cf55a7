"""Plugins of a third party that the runner is tried on: a small problem, and one plugin for every way to misbehave."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Le

from vibench import qp
from vibench.arrays import Array
from vibench.cone import greedy_cone
from vibench.problem import ParameterBox, Problem, VariationalInequality
from vibench.qp import Answer
from vibench.space import InnerProduct
from vibench.strategy import Cone, DualStrategy, Enrichment, Kind, Offline, PrimalStrategy, Stop


class Wire(Problem):
    """A wire between two fixed ends, pressed with a force mu on a flat support."""

    parameters = ParameterBox(("force",), np.array([4.0]), np.array([8.0]), ("N/m",))

    def __init__(self, nodes: Annotated[int, Ge(4), Le(500)] = 12, depth: float = 0.2) -> None:
        self.step, self.depth = 1.0 / (nodes + 1), depth
        ones = np.ones(nodes - 1)
        self.stiffness = (
            sp.csr_array(sp.diags_array([2.0 * np.ones(nodes), -ones, -ones], offsets=[0, 1, -1])) / self.step
        )
        self.mass = sp.csr_array(sp.diags_array(np.full(nodes, self.step)))
        self.V = InnerProduct(self.stiffness + self.mass)
        self.W = InnerProduct(self.mass)

    def training_set(self) -> Array:
        return self.parameters.grid(9)

    def assemble(self, mu: Array) -> VariationalInequality:
        load = np.full(self.V.dim, -mu[0] * self.step)
        return VariationalInequality(self.stiffness, load, -self.mass, np.full(self.W.dim, self.depth * self.step))


class Raises(Wire):
    def assemble(self, mu: Array) -> VariationalInequality:
        raise ArithmeticError("the wire\nsnapped")


class NotANumber(Wire):
    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        return VariationalInequality(vi.A, vi.f * np.nan, vi.B, vi.g)


class WrongShape(Wire):
    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        return VariationalInequality(vi.A, vi.f, vi.B, vi.g[:-1])


class Indefinite(Wire):
    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        return VariationalInequality(-vi.A, vi.f, vi.B, vi.g)


class Broken(Wire):
    def __init__(self) -> None:
        raise OSError("no wire in stock")


class Hungry(Wire):
    def __init__(self) -> None:
        super().__init__()
        self.meal = np.ones(2**36)


class RaisingCone(DualStrategy):
    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> Cone:
        raise LookupError("no generator found")


class WaitingCone(DualStrategy):
    """Reduces as CPG does, once a file exists."""

    def __init__(self, file: str) -> None:
        self.file = Path(file)

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> Cone:
        while not self.file.exists():
            time.sleep(0.05)
        return greedy_cone(snapshots, W, stop, lambda theta, _: (np.zeros_like(theta), ""))


class RaisingEnrichment(PrimalStrategy):
    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        raise LookupError("no vector found")


class CountingEnrichment(PrimalStrategy):
    """Adds nothing, and reports a history of whole numbers."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        return Enrichment(Kind.NONE, history={"steps": np.arange(3)})


def careful(program: VariationalInequality, accuracy: float) -> Answer:
    return qp.solve(program, "piqp", accuracy)


def raises(program: VariationalInequality, accuracy: float) -> Answer:
    raise RuntimeError("the solver\ngave in")


def nothing(program: VariationalInequality, accuracy: float) -> Answer:
    return None  # type: ignore[return-value]


def gives_up(program: VariationalInequality, accuracy: float) -> Answer:
    return Answer(None, None, "gave up")


def not_a_number(program: VariationalInequality, accuracy: float) -> Answer:
    return Answer(np.full(len(program.f), np.nan), np.zeros(len(program.g)), "solved")


def wrong(program: VariationalInequality, accuracy: float) -> Answer:
    return Answer(np.zeros(len(program.f)), np.zeros(len(program.g)), "solved")


def wrong_length(program: VariationalInequality, accuracy: float) -> Answer:
    return Answer(np.zeros(len(program.f) + 1), np.zeros(len(program.g)), "solved")


def numpy_count(program: VariationalInequality, accuracy: float) -> Answer:
    found = qp.solve(program, "piqp", accuracy)
    return Answer(found.x, found.alpha, found.solver_status, np.int64(3))


def dies(program: VariationalInequality, accuracy: float) -> Answer:
    os._exit(7)


def leaves(program: VariationalInequality, accuracy: float) -> Answer:
    sys.exit(3)
