"""A plugin under examination, and the checks that plugins of several kinds have in common."""

from __future__ import annotations

import pickle
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, in_a_line
from vibench.interfaces.problem import MEMBERS, Problem
from vibench.plugins.options import options_of
from vibench.storage.serialisation import dumps, loads
from vibench.testing.checks import SECONDS, ConformanceError, Doubt, Note, plugin_line
from vibench.testing.comparisons import Arrays, at, copies, differences
from vibench.testing.processes import NotImportableError, call_in_other_process
from vibench.timing import timed

MOST_POINTS, LEAST_POINTS = 7, 2
"""Numbers of parameters at which a problem is assembled: where there is time, and where there is not."""

CALLS_PER_POINT = 10
"""Assemblies that all checks but the search for jumps make at each of them, about."""

MOST_SENT = 3
"""Number of arguments at which another process is compared."""

PARTIAL_RTOL = 1e-10
"""Largest difference of round-off between two ways to assemble, relative to the largest entry of the member."""

LATE = 0.7
"""Share of the time limit after which no search for faults goes on."""

PluginT = TypeVar("PluginT")
ArgumentT = TypeVar("ArgumentT")
ResultT = TypeVar("ResultT")
T = TypeVar("T")


@dataclass(eq=False)
class Examined(Generic[PluginT]):
    """A plugin of any kind under examination; `seconds` bounds the wall time [s] of the checks."""

    base: ClassVar[type]
    """Class that the plugin derives from."""

    create: Callable[[], PluginT]
    _: KW_ONLY
    seconds: float = SECONDS

    def __post_init__(self) -> None:
        self._times: defaultdict[str, list[float]] = defaultdict(list)
        if not callable(self.create):
            raise TypeError(
                f"pass the class {type(self.create).__name__}, or a function that makes an instance, not an instance: "
                "two instances are compared"
            )

    @cached_property
    def plugin(self) -> PluginT:
        """The instance that most checks use."""
        return self.clocked("the construction", self.create)

    def clocked(self, what: str, work: Callable[[], T]) -> T:
        """Result of some work; the check "time" reports its wall time."""
        result, seconds = timed(work)
        self._times[what].append(seconds.wall)
        return result

    def construction(self) -> Iterator[str]:
        """An instance of the right class can be made."""
        plugin: object = self.plugin
        if not isinstance(plugin, self.base):
            yield f"a {type(plugin).__name__} was made; expected a subclass of vibench.{self.base.__name__}"

    def duration(self) -> Iterator[str]:
        """The constructor and every call stay below the limit."""
        for what, seconds in self._times.items():
            if max(seconds) > self.seconds:
                excess = f"{what} takes {max(seconds):.3g} s, above the limit of {self.seconds:g} s"
                yield f"{excess}; is something recomputed that could be stored?"
        yield from self._spent()

    def _spent(self) -> Iterator[Note]:
        """What all calls took."""
        yield from (Note(f"{what} takes {np.median(seconds):.2g} s") for what, seconds in self._times.items())


@dataclass(eq=False)
class Case(Examined[PluginT], ABC, Generic[PluginT, ArgumentT, ResultT]):
    """A plugin, the arguments it is called with, and the results.

    Every call receives copies, so that a plugin that writes to its input fails the check "no mutation" alone.
    """

    round_off: ClassVar[float] = 0.0
    """Largest relative difference that arrays of another process may have."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._began = time.monotonic()

    @property
    @abstractmethod
    def arguments(self) -> dict[str, ArgumentT]:
        """Arguments by their names in messages."""

    @abstractmethod
    def evaluate(self, argument: ArgumentT, plugin: PluginT | None = None) -> ResultT:
        """Result of one call of the plugin, or of another instance."""

    @abstractmethod
    def arrays(self, result: ResultT) -> Arrays:
        """Arrays of a result that a repeated call has to reproduce to the last bit."""

    @cached_property
    def results(self) -> dict[str, ResultT]:
        """Results by the names of their arguments."""
        return {name: self.evaluate(argument) for name, argument in self.arguments.items()}

    @property
    def late(self) -> bool:
        """Whether most of the time has passed, so that a search for faults has to end."""
        return time.monotonic() - self._began > LATE * self.seconds

    def options(self) -> Iterator[str]:
        """Every option has an annotation that its default conforms to: study files may set no other to anything."""
        constructor = getattr(self.create, "func", self.create)
        if isinstance(constructor, type):
            for option in options_of(constructor).values():
                if doubt := option.doubt:
                    yield Doubt(f"the option '{option.name}' {doubt}")

    def determinism(self) -> Iterator[str]:
        """A second call and another instance give the same results to the last bit."""
        again = list(self._deviations("a second call", self._evaluation(self.plugin)))
        yield from again or self._deviations("another instance", self._evaluation(self.create()))

    def another_process(self) -> Iterator[str]:
        """Another process, whose sets have another order, gives the same results up to `round_off`."""
        some = dict([*self.arguments.items()][-MOST_SENT:])
        try:
            there = call_in_other_process(evaluated, type(self), self.create, some, seconds=self.seconds)
        except NotImportableError as error:
            yield Note(f"not compared: {error}")
            return
        for line in self._deviations("another process", there.__getitem__, some, self.round_off):
            yield (
                f"{line}; look for the order of sets, unseeded random numbers, and what depends on time, folder or "
                "environment"
            )

    def pickling(self) -> Iterator[str]:
        """The plugin can be sent to another process, and its result be stored."""
        if reason := _pickling_error(self.plugin):
            faulty = [key for key, value in getattr(self.plugin, "__dict__", {}).items() if _pickling_error(value)]
            where = f": look at attribute {', '.join(faulty)}" if faulty else ""
            raise ConformanceError(f"the {type(self.plugin).__name__} cannot be pickled ({reason}){where}")
        name, before = next(iter(self.results.items()))
        try:
            after = self.stored(before)
        except NumericalError as error:
            raise ConformanceError(f"the {type(before).__name__} cannot be stored: {error}") from None
        for array, what in differences(self.arrays(after), self.arrays(before)):
            yield f"{name}: storing changes {array}: {what}"
        yield from self._deviations("a pickled copy", self._evaluation(pickle.loads(pickle.dumps(self.plugin))))

    def stored(self, result: ResultT) -> ResultT:
        """A result as a stage finds it in its artefact."""
        again: ResultT = loads(dumps(result))
        return again

    def _evaluation(self, plugin: PluginT) -> Callable[[str], Arrays]:
        """What an instance gives for an argument, by its name."""
        return lambda name: self.arrays(self.evaluate(self.arguments[name], plugin))

    def _deviations(
        self, source: str, again: Callable[[str], Arrays], names: Iterable[str] = (), rtol: float = 0.0
    ) -> Iterator[str]:
        """Arrays that differ from those of all results, or of some, each named once."""
        named: set[str] = set()
        # The reverse order reveals results that depend on the previous call.
        for name in reversed([*(names or self.arguments)]):
            for array, what in differences(again(name), self.arrays(self.results[name]), rtol):
                if array not in named:
                    named.add(array)
                    yield f"{name}: {source} gives different values of {array}: {what}"


def evaluated(
    case: Callable[[Callable[[], PluginT]], Case[PluginT, ArgumentT, Any]],
    create: Callable[[], PluginT],
    arguments: Mapping[str, ArgumentT],
) -> dict[str, Arrays]:
    """What another instance gives for some arguments."""
    other = case(create)
    return {name: other.arrays(other.evaluate(argument)) for name, argument in arguments.items()}


@dataclass(eq=False)
class ProblemCase(Case[Problem, Array, Arrays]):
    """A problem, parameters, and the arrays it assembles.

    Parameters
    ----------
    create
        Class, or `partial` of it with options; an instance is refused with a `TypeError`. Choose a coarse mesh: some
        hundred assemblies are made.
    seconds
        Wall time [s] that all checks may take, about: where an assembly is slow, they are made at fewer parameters.
    seed
        Of the random parameters and entries.
    """

    base = Problem
    round_off = PARTIAL_RTOL
    _: KW_ONLY
    seed: int = 0

    @cached_property
    def one_assembly(self) -> float:
        """Wall seconds of the first assembly."""
        box, problem = self.plugin.parameters, self.plugin
        return timed(lambda: problem.assemble(0.5 * (box.lower + box.upper)))[1].wall

    @cached_property
    def points(self) -> int:
        """Number of parameters, such that all checks take about half of the time limit: 7, or 2 at least."""
        try:
            seconds = self.one_assembly
        except Exception:  # noqa: BLE001  the check "assembly" says what a plugin raises
            return MOST_POINTS
        calls = 0.5 * self.seconds / max(seconds, 1e-9)
        return int(min(max(calls / CALLS_PER_POINT, LEAST_POINTS), MOST_POINTS))

    @cached_property
    def mus(self) -> Array:
        """Parameters (7×d): two corners of the box, its centre, and four random ones; only the first if it is slow."""
        box = self.plugin.parameters
        fixed = np.stack([box.lower, box.upper, 0.5 * (box.lower + box.upper)])
        return np.concatenate([fixed, box.sample(MOST_POINTS - 3, self.seed)])[: self.points]

    @cached_property
    def arguments(self) -> dict[str, Array]:
        """The parameters."""
        return {at(mu): mu for mu in self.mus}

    def evaluate(self, argument: Array, plugin: Problem | None = None) -> Arrays:
        """Copies of A, f, B and g at a parameter (d,), and of X_V and X_W."""
        problem, mu = plugin or self.plugin, argument.copy()
        vi = self.clocked("an assembly", lambda: problem.assemble(mu))
        members = {name: getattr(vi, name) for name in MEMBERS}
        return copies({**members, "X_V": problem.V.matrix, "X_W": problem.W.matrix})

    def arrays(self, result: Arrays) -> Arrays:
        """The members and Gram matrices."""
        return result

    def construction(self) -> Iterator[str]:
        """An instance can be made; a refused Gram matrix is named."""
        try:
            yield from super().construction()
        except NumericalError as error:
            place = plugin_line(error)
            names = [f"X_{name}: " for name in "VW" if f"self.{name} =" in place and f"X_{name}" not in str(error)]
            raise ConformanceError(f"{''.join(names)}{error} ({place})") from error


def _pickling_error(thing: Any) -> str:
    try:
        pickle.loads(pickle.dumps(thing))
    except Exception as error:  # noqa: BLE001  a plugin may raise anything
        return in_a_line(error)
    return ""
