"""Plugins of a third party that the runner is tried on: a small problem, and one plugin for every way to misbehave."""

import ctypes
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Le

from vibench import Array, Indices, InnerProduct, ParameterBox, Problem, QPSolution, Sampler, VariationalInequality
from vibench.interfaces.strategies import DualStrategy, Enrichment, Kind, Offline, PrimalStrategy, ReducedSet, Stop
from vibench.qp.solve import solve_qp
from vibench.reduction.cones import greedy_cone


class Wire(Problem):
    """A wire between two fixed ends, pressed with a force mu on a flat support."""

    parameters = ParameterBox(("force",), np.array([4.0]), np.array([8.0]), ("N/m",))

    def __init__(self, nodes: Annotated[int, Ge(4), Le(500)] = 12, depth: float = 0.2) -> None:
        self.step, self.depth = 1.0 / (nodes + 1), depth
        ones = np.ones(nodes - 1)
        bands = [2.0 * np.ones(nodes), -ones, -ones]
        self.stiffness = sp.csr_array(sp.diags_array(bands, offsets=[0, 1, -1])) / self.step
        self.mass = sp.csr_array(sp.diags_array(np.full(nodes, self.step)))
        self.V = InnerProduct(self.stiffness + self.mass)
        self.W = InnerProduct(self.mass)

    def training_set(self) -> Array:
        return self.parameters.grid(9)

    def assemble(self, mu: Array) -> VariationalInequality:
        load = np.full(self.V.dim, -mu[0] * self.step)
        return VariationalInequality(self.stiffness, load, -self.mass, np.full(self.W.dim, self.depth * self.step))


class UnevenWire(Wire):
    """Its load has another shape between the training parameters, which interpolation over them cannot see."""

    entrywise = frozenset({"f"})

    def assemble(self, mu: Array) -> VariationalInequality:
        vi, x = super().assemble(mu), np.linspace(0.0, np.pi, self.V.dim)
        return VariationalInequality(vi.A, vi.f * (1.0 + 0.5 * np.sin(2 * np.pi * mu[0]) ** 2 * np.cos(x)), vi.B, vi.g)

    def sampler(self, wanted: Mapping[str, tuple[Indices, Indices]]) -> Sampler:
        return lambda mu: {"f": self.assemble(mu).f[wanted["f"][0]]}


def _changed(name: str, change: Callable[[VariationalInequality], Any]) -> type[Wire]:
    return type(name, (Wire,), {"__module__": __name__, "assemble": lambda self, mu: change(Wire.assemble(self, mu))})


def throw(error: BaseException) -> Any:
    raise error


def segfault() -> Any:
    print("the last words")
    ctypes.string_at(0)


Raises = _changed("Raises", lambda vi: throw(ArithmeticError("the wire\nsnapped")))
Sleeps = _changed("Sleeps", lambda vi: time.sleep(3600))
Exits = _changed("Exits", lambda vi: os._exit(3))
Segfaults = _changed("Segfaults", lambda vi: segfault())


class Broken(Wire):
    def __init__(self) -> None:
        raise OSError("no wire in stock")


class BadCone(DualStrategy):
    def __init__(self, how: Literal["negative"]) -> None:
        self.how = how

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        return ReducedSet(-snapshots[:, :2] / W.norm(snapshots[:, :2]), np.ones(1), np.zeros(2, dtype=bool))


def _reducing(name: str, act: Callable[[], Any], **members: Any) -> type[DualStrategy]:
    return type(name, (DualStrategy,), {"__module__": __name__, "reduce": lambda *_: act(), **members})


RaisingCone = _reducing("RaisingCone", lambda: throw(LookupError("no generator found")))
ExitingCone = _reducing("ExitingCone", lambda: os._exit(3))
InterruptingCone = _reducing("InterruptingCone", lambda: throw(KeyboardInterrupt()))
NeedyCone = _reducing("NeedyCone", lambda: throw(ImportError("no such")), requires=("no-such-distribution",))


class WaitingCone(DualStrategy):
    """Reduces as CPG does, once a file exists."""

    def __init__(self, file: str) -> None:
        self.file = Path(file)

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        while not self.file.exists():
            time.sleep(0.05)
        return greedy_cone(snapshots, W, stop)


class CountingEnrichment(PrimalStrategy):
    """Adds nothing, and reports a history of whole numbers."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        return Enrichment(Kind.NONE, history={"steps": np.arange(3)})


def careful(program: VariationalInequality, accuracy: float) -> QPSolution:
    return solve_qp(program, "piqp", accuracy)


def _answering(answer: Callable[[VariationalInequality], Any]) -> Callable[[VariationalInequality, float], Any]:
    return lambda program, accuracy: answer(program)


raises = _answering(lambda _: throw(RuntimeError("the solver\ngave in")))
leaves = _answering(lambda _: sys.exit(3))
dies = _answering(lambda _: os._exit(7))
gives_up = _answering(lambda _: QPSolution(None, None, "gave up"))
wrong = _answering(lambda vi: QPSolution(np.zeros(len(vi.f)), np.zeros(len(vi.g)), "solved"))


def numpy_count(program: VariationalInequality, accuracy: float) -> QPSolution:
    found = solve_qp(program, "piqp", accuracy)
    return QPSolution(found.x, found.alpha, found.solver_status, np.int64(3))


def hangs(program: VariationalInequality, accuracy: float) -> QPSolution:
    """In native code that keeps every other thread of its process waiting."""
    ctypes.PyDLL(None).sleep(3600)
    return careful(program, accuracy)


def segfaults(program: VariationalInequality, accuracy: float) -> QPSolution:
    segfault()
    return careful(program, accuracy)


def dies_sometimes(program: VariationalInequality, accuracy: float) -> QPSolution:
    """Where the force is below 6 N/m: the first constraint of three modes is violated by less than the others there."""
    if program.g[0] > -0.9993:
        os.kill(os.getpid(), signal.SIGKILL)
    return careful(program, accuracy)


def dies_once(program: VariationalInequality, accuracy: float) -> QPSolution:
    """At the call whose number an environment variable gives; calls are counted in a file that another one names."""
    calls = Path(os.environ["FAKE_CALLS"])
    with calls.open("a", encoding="ascii") as file:
        file.write(".")
    if calls.stat().st_size == int(os.environ["FAKE_LAST_CALL"]):
        os.kill(os.getpid(), signal.SIGKILL)
    return careful(program, accuracy)


def chatty(program: VariationalInequality, accuracy: float) -> QPSolution:
    print("solving")
    os.write(2, b"solving past Python\n")
    return careful(program, accuracy)
