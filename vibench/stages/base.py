"""Stages: pure functions of their inputs, stored as artefacts and shared by every cell that needs them."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar, cast

from vibench.errors import NumericalError, RequestError, VibenchError, in_a_line
from vibench.interfaces.problem import Problem
from vibench.plugins.plugin import Plugin
from vibench.provenance import libraries, numerical_code, source_hash
from vibench.qp.status import Status
from vibench.stages.artefacts import History, Store
from vibench.study.cells import Axes, digest
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import NO_TIME, Seconds

Row = dict[str, Any]  # a row of a results table: column → value


@lru_cache(maxsize=4)
def build_problem(plugin: Plugin) -> Problem:
    """The problem of a stage; one instance per process."""
    return cast("Problem", plugin.create())


@contextmanager
def faults_of(plugin: Plugin) -> Iterator[None]:
    """Name a plugin in what it raises, and the command that checks it in a `NumericalError`."""
    try:
        yield
    except (NumericalError, RequestError) as error:
        raise NumericalError(f"{error}; run `{plugin.check}`") from error
    except (VibenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        raise NumericalError(f"the {plugin} raised {in_a_line(error)}; run `{plugin.check}`") from error


@dataclass(frozen=True)
class Result:
    """Result of a stage: its value, the seconds that count as its own, and histories."""

    value: Any
    seconds: Seconds = NO_TIME
    histories: tuple[History, ...] = ()


@dataclass(frozen=True)
class Done:
    """A stage that succeeded: its histories, its value where that is not stored, seconds in all and its own."""

    histories: tuple[History, ...]
    value: Any
    spent: Seconds
    seconds: Seconds = NO_TIME


@dataclass(frozen=True)
class Failed:
    """A stage, or an item of one, that failed: the status of the rows that need it, and the reason."""

    status: Status
    reason: str


@dataclass(frozen=True)
class Unstored:
    """A stage whose artefact could not be written, and the reason; writing others is not tried."""

    reason: str


class Stage(ABC):
    """One stage of a computation; subclasses are frozen dataclasses of what determines the result."""

    # The runner and the progress display treat all stages alike: a stage declares its label and the axes of the study
    # it depends on.

    label: ClassVar[str]  # name of the result in a word or two, for messages and for the names of artefacts
    stored: ClassVar[bool] = True  # whether the value is kept as an artefact, under `key`
    # Whether several stages hold parts of one result; progress is then shown part by part.
    partial: ClassVar[bool] = False
    # Whether stages that need it run even if it failed, and find the reason in `Store.lost`; these are not `stored`.
    dispensable: ClassVar[bool] = False

    @cached_property
    # Cells make equal stages again and again, and hashing one takes a fifth of describing it.
    @lru_cache(maxsize=2**16)  # noqa: B019  processes that run stages keep them anyway
    def key(self) -> str:
        """Name of the artefact: the label, and a hash of everything that determines the value."""
        # These are the fields of the stage, the keys of its inputs, the libraries, its own module with those of other
        # stages that it imports, and the layers of vibench below the stages that determine numbers. The code of a
        # plugin enters through `Plugin.code`.
        own = {name: _described(value) for name, value in self._fields().items()}
        content = [type(self).__name__, self.code(), libraries(), own, [one.key for one in self.inputs()]]
        return f"{self.label.lower().replace(' ', '-')}-{digest(content)}"

    @classmethod
    @cache
    def code(cls) -> str:
        """Hash of the code that determines the value; that of the inputs is in their keys."""
        # Of its own layer only the modules count that it imports from: an edit of one stage keeps most other artefacts.
        imported = {str(getattr(one, "__module__", "")) for one in vars(sys.modules[cls.__module__]).values()}
        # These two modules only pass values on.
        own = {name for name in imported if name.startswith("vibench.stages.")} - {__name__, "vibench.stages.artefacts"}
        sources = [source_hash(Path(str(sys.modules[name].__file__))) for name in sorted({cls.__module__, *own})]
        return " ".join([*sources, numerical_code(below="stages")])

    @property
    def kind_of_work(self) -> str:
        """Name of the stages that take about as long, for the estimate of the time left."""
        return self.label

    @property
    def effort(self) -> float:
        """Estimated cost in units of one high-fidelity solve, until a stage of its kind is done."""
        return 1.0

    @property
    def weight(self) -> int:
        """Number of cells that the stage works for at once; the limit `cell_seconds` is for each."""
        return 1

    @property
    def session(self) -> int:
        """Number of the session: a process that ran a stage of an earlier one is replaced before it runs this one."""
        return 0

    @property
    def axes(self) -> Axes:
        """The axes of the study that the stage depends on; they name its histories."""
        return Axes()

    @property
    def measured_by(self) -> tuple[Stage, str]:
        """The stage that does the work of this one, and the name of its seconds in `measure`."""
        return self, ""

    def measure(self, store: Store) -> Mapping[str, Seconds]:
        """Do the work again and return its seconds by name; the artefacts of the inputs are in the store."""
        return {"": self.run(store).seconds}

    def _fields(self) -> dict[str, Any]:
        return {part.name: getattr(self, part.name) for part in fields(self)}  # type: ignore[arg-type]

    @cached_property
    def plugins(self) -> tuple[Plugin, ...]:
        """The plugins that the stage and its inputs depend on, each once."""
        values = self._fields().values()
        named = [value.sampling if isinstance(value, ParameterSet) else value for value in values]
        own = [value for value in named if isinstance(value, Plugin)]
        stages = [*(value for value in values if isinstance(value, Stage)), *self.inputs()]
        return tuple(dict.fromkeys([*own, *(plugin for stage in stages for plugin in stage.plugins)]))

    @cached_property
    def packages(self) -> frozenset[str]:
        """Third-party distributions whose code the stage runs; a process runs the code of one set of these."""
        return frozenset(plugin.registered.package for plugin in self.plugins) - {""}

    def inputs(self) -> tuple[Stage, ...]:
        """Stages whose artefacts `run` reads itself: by default those among the fields, without the inputs of these."""
        return tuple(value for value in self._fields().values() if isinstance(value, Stage))

    @abstractmethod
    def run(self, store: Store) -> Result:
        """Compute the value; the artefacts of the inputs are in the store."""


def _described(value: Any) -> Any:
    """A field of a stage in JSON: the key of a stage, the compared fields of another object."""
    if isinstance(value, Stage):
        return value.key
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, tuple):
        return [_described(part) for part in value]
    if is_dataclass(value):
        return {part.name: _described(getattr(value, part.name)) for part in fields(value) if part.compare}
    return value


TimeLimit = Callable[[], AbstractContextManager[None]]  # context of an operation that has a time limit of its own


class Items(ABC):
    """The items of a stage in progress, which can be done in any order and by several processes."""

    @abstractmethod
    def run_item(self, number: int, time_limit: TimeLimit) -> Any:
        """Do one item; operations that have a limit of their own run `with time_limit():`."""

    def failed(self, number: int, failed: Failed) -> Any:  # noqa: ARG002
        """The substitute for an item that exceeded its limit or whose process died: by default the failure itself."""
        return failed

    @abstractmethod
    def collect(self, items: Sequence[Any]) -> Any:
        """The value of the stage."""


class ItemwiseStage(Stage):
    """A stage whose items are returned one by one: if its process dies or hangs, only the current item is lost."""

    stored = False

    @property
    @abstractmethod
    def items(self) -> int:
        """Number of items."""

    def stage_of(self, number: int) -> Stage:  # noqa: ARG002
        """The stage whose plugins an item runs; items that run those of other packages get other processes."""
        return self

    def has_failed(self, value: Any) -> bool:  # noqa: ARG002
        """Whether the value tells of something that failed: its process serves no other stage then."""
        return False

    @abstractmethod
    def begin(self, store: Store) -> Items:
        """Prepare for items; the artefacts of the inputs are in the store."""

    def run(self, store: Store) -> Result:
        work = self.begin(store)
        return Result(work.collect([work.run_item(number, nullcontext) for number in range(self.items)]))


def value_of(store: Store, stage: Stage) -> Any:
    """The stored value of a stage that has been run. Raises a `NumericalError` if its artefact is missing."""
    artefact = store.get(stage.key)
    if artefact is None:
        raise NumericalError(f"the artefact {stage.key} is missing")
    return artefact.value
