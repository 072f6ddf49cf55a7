"""What a stage is: a pure function of its true inputs, shared by every cell that needs it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from typing import Any

from vibench.errors import NumericalError
from vibench.matrix import Plugin, digest
from vibench.problem import Problem
from vibench.provenance import core_code
from vibench.store import History, Store
from vibench.timing import NO_TIME, Seconds


@lru_cache(maxsize=4)
def build_problem(plugin: Plugin) -> Problem:
    """The problem of a stage; one instance per process."""
    problem = plugin.create()
    assert isinstance(problem, Problem)  # `plugins.load` refuses anything else
    return problem


@dataclass(frozen=True)
class Result:
    """What a stage gives: its value, the seconds that count as its own, and histories."""

    value: Any
    seconds: Seconds = NO_TIME
    histories: tuple[History, ...] = ()


class Stage(ABC):
    """One stage; subclasses are frozen dataclasses."""

    @cached_property
    def key(self) -> str:
        """Name of the stage's artefact: its kind, and a hash of all that determines it, the code included."""
        name = type(self).__name__.lower()
        return f"{name}-{digest([name, core_code(), asdict(self)])}"  # type: ignore[call-overload]

    @abstractmethod
    def inputs(self) -> tuple[Stage, ...]:
        """Stages whose artefacts `run` reads."""

    @abstractmethod
    def run(self, store: Store) -> Result:
        """Do the work; inputs are in the store."""


def value_of(store: Store, stage: Stage) -> Any:
    """The stored value of a stage that has been run."""
    artefact = store.get(stage.key)
    if artefact is None:
        raise NumericalError(f"the artefact {stage.key} is missing")
    return artefact.value
