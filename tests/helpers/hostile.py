"""Plugins that do all they can to their process and their neighbours, and honest ones of their package."""

import locale
import os
import random
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np
from broken_strategies import Greedy
from fake_plugins import Wire
from formulations import Nearest, Program, ProgramModel

import vibench
from vibench import Array, Enrichment, FormulationAnswer, InnerProduct, Kind, Offline, VariationalInequality

Acts = Mapping[str, tuple[str, Callable[[Any], Any]]]
"""What is done, by its name, and what its cell says of it: the status and words of the reason."""

CHANGED = "error: writes into what it is given, and the problem 'Wire' is another one since: row "


class Honest(Program):
    pass


class HonestNearest(Nearest):
    pass


def throw(error: BaseException) -> Any:
    raise error


def fill(array: Array) -> None:
    array[...] = 0.0


def double(matrix: Any) -> None:
    matrix.data *= 2.0


def replaced(owner: Any, name: str) -> None:
    setattr(owner, name, copy(getattr(owner, name)))


def changed(name: str, change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda one: replace(one, **{name: change(getattr(one, name))})


def vi(owner: Any) -> Any:
    return owner.problem.assemble(np.array([5.0]))


def hang(_: object) -> None:
    time.sleep(600.0)


ANYWHERE: Acts = {
    "path": ("ok: ", lambda _: sys.path.clear()), "errors": ("ok: ", lambda _: np.seterr(all="raise")),
    "recursion": ("error: RecursionError", lambda _: sys.setrecursionlimit(5)),
    "warnings": ("ok: ", lambda _: warnings.simplefilter("error")), "folder": ("ok: ", lambda _: os.chdir("/")),
    "environment": ("ok: ", lambda _: os.environ.clear()),
    "random": ("ok: ", lambda _: (random.seed(1), np.random.seed(1))),  # noqa: NPY002
    "signals": ("ok: ", lambda _: [signal.signal(one, signal.SIG_IGN) for one in (signal.SIGTERM, signal.SIGUSR1)]),
    "alarm": ("ok: ", lambda _: signal.alarm(1)), "locale": ("ok: ", lambda _: locale.setlocale(locale.LC_ALL, "C")),
    "thread": ("ok: ", lambda _: threading.Thread(target=hang, args=(0,), daemon=True).start()),
    "raises": ("error: ArithmeticError: no pivot", lambda _: throw(ArithmeticError("no pivot"))),
    "leaves": ("error: SystemExit: 3", lambda _: sys.exit(3)), "exits": ("crashed: exit code 3", lambda _: os._exit(3)),
    "dies": ("crashed: signal SIGKILL", lambda _: os.kill(os.getpid(), signal.SIGKILL)),
}  # fmt: skip
BUILD: Acts = {
    "A": (CHANGED, lambda offline: double(vi(offline).A)),
    "B": ("ok: ", lambda offline: double(vi(offline).B)),
    "indices": (CHANGED, lambda offline: fill(vi(offline).A.indices)),
    "multiplied": (CHANGED, lambda offline: vi(offline).A.__imul__(2.0)),
    "box": ("error: read-only", lambda offline: fill(offline.problem.parameters.lower)),
    "depth": (CHANGED, lambda offline: setattr(offline.problem, "depth", 0.1)),
    "stiffness": (CHANGED, lambda offline: setattr(offline.problem, "stiffness", 2.0 * offline.problem.stiffness)),
    "method": ("error: is another one since", lambda offline: setattr(offline.problem, "assemble", lambda mu: None)),
    "V": ("error: read-only", lambda offline: double(offline.problem.V.matrix)),
    "W": ("error: read-only", lambda offline: double(offline.problem.W.matrix)),
    "basis": ("error: read-only", lambda offline: fill(offline.pod.basis)),
    "cone": ("error: read-only", lambda offline: fill(offline.cone.generators)),
    "span": ("error: read-only", lambda offline: fill(offline.multipliers.span)),
    "snapshots": ("ok: ", lambda offline: fill(offline.snapshots.u)),
    "training": ("error: another one since: training_set", lambda o: setattr(o.problem, "training_set", throw)),
}
MODEL: Acts = {
    "true": ("error: `dimension` of HostileModel is True", lambda made: setattr(made, "dimension", True)),
    "nan": ("error: `generators` of HostileModel is nan", lambda made: setattr(made, "generators", np.nan)),
    "less": ("error: `enrichment` of HostileModel is -5", lambda made: setattr(made, "enrichment", -5)),
    "more": ("error: `enrichment` of the model is 99, more", lambda made: setattr(made, "enrichment", 99)),
}
TRIVIAL = VariationalInequality(np.eye(1), np.zeros(1), np.zeros((1, 1)), np.zeros(1))
SOLVE: Acts = {
    "mu": ("error: read-only", lambda model: fill(model.mu)),
    "A": (CHANGED, lambda model: double(vi(model).A)),
    "slow": ("timeout: query_seconds = 1 s", hang),
    "trivial": ("inaccurate: its solution is not the answer", lambda one: one.settings.solve_qp(TRIVIAL)),
}
ANSWER: Acts = {
    "tuple": ("error: `solve` returned a tuple", lambda one: (one.x, one.alpha)),
    "nothing": ("error: `solve` returned a NoneType", lambda one: None),
    "list": ("error: x of the answer has the type list", lambda one: replace(one, x=one.x.tolist())),
    "complex": ("error: x of the answer is complex", lambda one: replace(one, x=one.x + 1j)),
    "masked": ("error: x of the answer is a masked", lambda one: replace(one, x=np.ma.masked_array(one.x))),
    "long": ("error: x of the answer has 99 coeff", lambda one: replace(one, x=np.zeros(99))),
    "table": ("error: x of the answer has shape", lambda one: replace(one, x=one.x[:, None])),
    "outcome": ("error: outcome of the answer is 'ok'", lambda one: replace(one, outcome="ok")),
    "reason": ("error: reason of the answer is None", lambda one: replace(one, reason=None)),
    "steps": ("error: iterations of the answer is nan", lambda one: replace(one, iterations=np.nan)),
    "backwards": ("error: iterations of the answer is -1", lambda one: replace(one, iterations=-1)),
    "negative": ("error: uncertainty of the answer is -1.0", lambda one: replace(one, uncertainty=-1.0)),
    "infinite": ("error: uncertainty of the answer is inf", lambda one: replace(one, uncertainty=np.inf)),
    "lost": ("nonfinite: x or alpha of the answer is not", lambda one: replace(one, x=one.x * np.nan)),
}
PAIR: Acts = {
    "short": ("error: u of `reconstruct` has shape (11,), expected (12,)", lambda pair: (pair[0][1:], pair[1])),
    "pulls": ("failed: λ has negative coefficients, as -", lambda pair: (pair[0], pair[1] - 1.0)),
    "one": ("error: expected a pair (u, λ)", lambda pair: pair[0]),
    "undone": ("error: `reconstruct` returned no λ", lambda pair: (pair[0], None)),
    "far": ("nonfinite: u or λ is not finite", lambda pair: (1e200 * pair[0], pair[1])),
    "unreal": ("error: u of `reconstruct` is complex", lambda pair: (pair[0] + 0j, pair[1])),
    "force": ("nonfinite: u or λ is not finite", lambda pair: (pair[0], np.inf * pair[1])),
    "buffer": ("ok: ", lambda pair: (kept(pair[0][:, None])[:, 0], pair[1])),
}
RECONSTRUCT: Acts = {
    "mu": ("error: read-only", lambda model: fill(model.mu)),
    "A": (CHANGED, lambda model: double(vi(model).A)),
    "solves": ("ok: ", lambda model: attrgetter("u", "lam")(vibench.HighFidelitySolver(model.problem).solve(model.mu))),
}
REDUCE: Acts = {
    "snapshots": ("ok: ", lambda given: fill(given[0])),
    "W": ("error: read-only", lambda given: double(given[1].matrix)),
    "dense": ("error: read-only", lambda given: fill(given[1].dense)),
    "factor": ("error: W._factor is replaced", lambda given: replaced(given[1], "_factor")),
    "matrix": ("error: W.matrix is replaced", lambda given: setattr(given[1], "matrix", 2.0 * given[1].matrix)),
    "stop": ("ok: ", lambda given: object.__setattr__(given[2], "tolerance", 1.0)),
}
CONE: Acts = {
    "nan": ("error: generators of ReducedSet has an entry that is", changed("generators", lambda chi: chi * np.nan)),
    "short": ("error: `generators` of the cone has shape (11, ", changed("generators", lambda chi: chi[1:])),
    "negative": ("error: a generator has the negative coefficient -", changed("generators", np.negative)),
    "long": ("error: the generators do not all have unit norm in W", changed("generators", lambda chi: 2.0 * chi)),
    "nothing": ("error: the dual strategy returned a NoneType, expected a ReducedSet", lambda _: None),
    "buffer": ("ok: ", lambda cone: replace(cone, generators=kept(cone.generators))),
    "forged": ("error: `errors` of the cone has the type", lambda cone: forged(cone, "errors", None)),
    "words": ("error: raised TypeError: 'int'", lambda cone: forged(cone, "fallbacks", 5)),
}
ENRICH: Acts = {
    "A": (CHANGED, lambda offline: double(vi(offline).A)),
    "basis": ("error: read-only", lambda offline: fill(offline.basis)),
    "span": ("error: read-only", lambda offline: fill(offline.span)),
    "training": ("error: read-only", lambda offline: fill(offline.training)),
    "phase": ("ok: ", lambda offline: object.__setattr__(offline, "basis", offline.basis[:, :1])),
    "V": ("error: V._solver is replaced", lambda offline: replaced(offline.problem.V, "_solver")),
    "spaces": ("error: read-only", lambda offline: fill(offline.problem.V._factor._root)),
}
VECTORS: Acts = {
    "nan": ("error: vectors of Enrichment has an entry that is not finite", changed("vectors", lambda Z: Z * np.nan)),
    "short": ("error: `vectors` of the enrichment has shape (11, ", changed("vectors", lambda Z: Z[1:])),
    "long": ("error: the vectors of the enrichment are not orthonormal in V", changed("vectors", lambda Z: 2.0 * Z)),
    "nothing": ("error: the primal strategy returned a NoneType, expected an Enrichment", lambda _: None),
    "flat": ("error: has shape (12,), expected (12, count)", lambda _: Enrichment(Kind.PER_PARAMETER, supply=flat)),
    "buffer": ("ok: ", lambda one: replace(one, vectors=kept(one.vectors))),
    "history": ("error: history of Enrichment is {'x': array(['", changed("history", lambda _: {"x": np.array(["y"])})),
    "supply": (CHANGED, lambda one: Enrichment(Kind.PER_PARAMETER, supply=doubling)),
}
PARAMETERS: Acts = {"box": ("error: read-only", lambda given: fill(given.parameters.lower))}
ASSEMBLE: Acts = {"mu": ("error: read-only", fill)}


def kept(array: Array) -> Array:
    """The same in a buffer that the next call fills again."""
    BUFFERS[:, : array.shape[1]] = array
    return BUFFERS[:, : array.shape[1]]


BUFFERS = np.zeros((12, 12))


def forged(made: Any, name: str, value: Any) -> Any:
    object.__setattr__(made, name, value)
    return made


def doubling(V: InnerProduct, vi: VariationalInequality, span: Array) -> Array:
    double(vi.A)
    return np.ones((V.dim, 1))


def flat(V: InnerProduct, vi: VariationalInequality, span: Array) -> Array:
    return np.ones(V.dim)


class HonestCone(Greedy):
    pass


class HonestSpace(vibench.PrimalStrategy):
    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        V, B = offline.problem.V, offline.problem.constraint(offline.training[0])[0]
        return Enrichment(Kind.FIXED, vectors=V.orthonormalise(vibench.supremizers(V, B, offline.span), offline.basis))


class Acting:
    """It does what its option says, in a phase, by the tables above."""

    def __init__(self, how: str) -> None:
        self.how = how

    def act(self, phase: str, given: Any, otherwise: Any = None) -> Any:
        own, name = self.how.split("-")
        phases = {one: acts for _, of_kind in KINDS.values() for one, acts in of_kind.items()}
        return phases[phase][name][1](given) if own == phase else otherwise


class HostileCone(Acting, HonestCone):
    def reduce(self, snapshots: Array, W: InnerProduct, stop: vibench.Stop) -> vibench.ReducedSet:
        cone = super().reduce(snapshots, W, stop)
        self.act("reduce", (snapshots, W, stop))
        return self.act("cone", cone, cone)


class HostileSpace(Acting, HonestSpace):
    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        enrichment = super().build(offline, tolerance)
        self.act("enrich", offline)
        return self.act("vectors", enrichment, enrichment)


class HostileWire(Acting, Wire):
    def __init__(self, how: str) -> None:
        super().__init__(how)
        self.act("init", self)
        Wire.__init__(self)

    def training_set(self) -> Array:
        self.act("parameters", self)
        return super().training_set()

    def assemble(self, mu: Array) -> VariationalInequality:
        self.act("assemble", mu)
        return super().assemble(mu)


class HostileSampling(Acting, vibench.Sampling):
    """It chooses parameters in the process of the command, too, which refuses what raises."""

    def parameters(self, box: vibench.ParameterBox) -> Array:
        self.act("build", box)
        return box.grid(5)


class Hostile(Acting, Program):
    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "solvers", "accuracy")

    def build(self, offline: vibench.OfflinePhase) -> Mapping[str, Any]:
        self.act("build", offline)
        return {}

    def model(self, offline: vibench.OfflinePhase, built: Mapping[str, Any]) -> vibench.FormulationModel:
        made = HostileModel(offline)
        made.how, made.problem = self.how, offline.problem
        self.act("model", made)
        return made


class HostileModel(ProgramModel, Acting):
    mu = problem = settings = None

    def solve(self, mu: Array, settings: vibench.QuerySettings) -> FormulationAnswer:
        self.mu, self.settings = mu, settings
        answer = super().solve(mu, settings)
        self.act("solve", self)
        return self.act("answer", answer, answer)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> Any:
        self.mu = mu
        pair = self.act("reconstruct", self) or super().reconstruct(mu, answer)
        return self.act("pair", pair, pair)


def anywhere(*names: str) -> Acts:
    return {name: ANYWHERE[name] for name in names}


KINDS: Mapping[str, tuple[type, Mapping[str, Acts]]] = {
    "formulation": (Hostile, {
        "build": BUILD | ANYWHERE, "model": MODEL, "solve": SOLVE | anywhere("raises", "leaves", "exits"),
        "answer": ANSWER, "pair": PAIR, "reconstruct": RECONSTRUCT | anywhere("raises", "exits"),
    }),
    "dual": (HostileCone, {
        "reduce": REDUCE | anywhere("path", "thread", "alarm", "exits", "leaves", "raises"), "cone": CONE,
    }),
    "primal": (HostileSpace, {
        "enrich": ENRICH | anywhere("signals", "random", "exits", "raises"), "vectors": VECTORS,
    }),
    "problem": (HostileWire, {
        "init": anywhere("folder", "leaves"), "parameters": PARAMETERS | anywhere("raises", "leaves", "exits"),
        "assemble": ASSEMBLE | anywhere("errors", "exits"),
    }),
}  # fmt: skip
