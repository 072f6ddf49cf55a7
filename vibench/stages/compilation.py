"""Compiled programs of reduced models: made and tried offline, and the queries that they answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from cachetools import LRUCache

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality
from vibench.model.chebyshev import AffinePolynomial
from vibench.offline.compiled import CompiledModel, Program
from vibench.qp.verification import QPSolution
from vibench.stages.assembly import AssemblyStage
from vibench.stages.base import Result, Stage, Watch, value_of
from vibench.stages.query import Queries, Query
from vibench.storage.artefacts import Store
from vibench.storage.serialisation import storable
from vibench.timing import Seconds, timed

for _kind in (CompiledModel, AffinePolynomial):
    storable(_kind)


LOADED = 32
"""Programs that a process keeps; the least recently used one is compiled again when it is needed again."""


@dataclass(frozen=True)
class CompilationStage(Stage):
    """The C program of a reduced model; the value is a `CompiledModel`.

    Its seconds are those of the polynomials and of the compiler. The program itself is not kept: who loads an artefact
    runs nothing that is in it.
    """

    label = "compilation"

    assembly: AssemblyStage
    accuracy: float

    def inputs(self) -> tuple[Stage, ...]:
        """The reduced model."""
        return self.assembly.model_inputs

    def run(self, store: Store) -> Result:
        """Make the source, and compile it to see that it can be.

        Raises an `UnsupportedError` if there is no such source, or no compiler that takes it.
        """
        model, _ = self.assembly.model(store)

        def work() -> CompiledModel:
            made = CompiledModel.of(model, self.accuracy)
            made.program()
            return made

        return Result(*timed(work))


_programs: LRUCache[str, Program] = LRUCache(LOADED)


def loaded_program(store: Store, stage: CompilationStage) -> Program:
    """The program of a stage, which a process compiles when it first needs it."""
    program = _programs.get(stage.key)
    if program is None:
        made: CompiledModel = value_of(store, stage)
        program = _programs[stage.key] = made.program()
    return program


@dataclass(frozen=True, kw_only=True)
class CompiledQuery(Query):
    """A query of a compiled program at a parameter mu (d,); the `program` of the model verifies its answer.

    A program knows its parameter alone: what repeats it is posed at a parameter `near` by, which depends on a seed.
    """

    compiled: Program
    mu: Array
    near: Callable[..., tuple[Array, VariationalInequality]]

    @property
    def form(self) -> str:
        """How it is solved."""
        return "compiled"

    def repeated(self, *seed: int) -> CompiledQuery:
        """The query at a parameter near by."""
        mu, program = self.near(*seed)
        return replace(self, mu=mu, program=program)

    def prepare(self, watch: Watch) -> Callable[[], tuple[QPSolution, Seconds]]:
        """The timed call of the program."""

        def solution() -> tuple[QPSolution, Seconds]:
            watch(True)
            solved = timed(lambda: self.compiled(self.mu))
            watch(False)
            return solved

        return solution


def compiled_query(queries: Queries, program: Program, number: int, solver: str, accuracy: float) -> CompiledQuery:
    """The query of a number; `solver` is that of its row, which has no part in the answer."""

    def near(*seed: int) -> tuple[Array, VariationalInequality]:
        mu = queries.near(number, *seed)
        return mu, queries.model.assemble(mu).program

    return CompiledQuery(
        program=queries.reduced.programs[number],
        factor=None,
        solver=solver,
        accuracy=accuracy,
        compiled=program,
        mu=queries.mus[number],
        near=near,
    )
