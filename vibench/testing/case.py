"""A plugin under examination, checks that several kinds share, and comparisons that name the entry at fault."""

from __future__ import annotations

import pickle
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar, cast

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.errors import NumericalError, in_a_line, placed
from vibench.execution.isolated import NotImportableError
from vibench.plugins.options import Option, options_of
from vibench.signatures import check_attributes
from vibench.stages.artefacts import dumps, loads
from vibench.testing.checks import SECONDS, Check, ConformanceError, Doubt, Note, call_in_other_process, kind_of
from vibench.timing import timed

PluginT = TypeVar("PluginT")
ArgumentT = TypeVar("ArgumentT")
ResultT = TypeVar("ResultT")
T = TypeVar("T")

Arrays = dict[str, Any]  # dense arrays and sparse matrices by name


@dataclass(eq=False)
class Case(ABC, Generic[PluginT, ArgumentT, ResultT]):
    """A plugin under examination, the arguments it is called with, and the results."""

    # Every call receives arrays that are read-only: whoever writes into them says so by an error at that line.
    base: ClassVar[type]
    checks: ClassVar[tuple[Check[Any], ...]]
    round_off: ClassVar[float] = 0.0  # largest relative difference that arrays of another process may have

    create: Callable[..., PluginT]
    _: KW_ONLY
    seconds: float = SECONDS  # limit of each call

    def __post_init__(self) -> None:
        kind_of(self.create)  # refuses an instance
        self._times: defaultdict[str, list[float]] = defaultdict(list)
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
    def plugin(self) -> PluginT:
        """The instance that most checks use."""
        return self.clocked("the construction", self.create)

    @cached_property
    def results(self) -> dict[str, ResultT]:
        """Results by the names of their arguments."""
        return {name: self.evaluate(argument) for name, argument in self.arguments.items()}

    @property
    def late(self) -> bool:
        """True once a search for faults has to end: the checks after it need the rest of the time."""
        return time.monotonic() - self._began > 0.7 * self.seconds

    def clocked(self, what: str, work: Callable[[], T]) -> T:
        """Result of some work; the check "time" reports its wall time."""
        result, seconds = timed(work)
        self._times[what].append(seconds.wall)
        return result

    def construction(self) -> Iterator[str]:
        """An instance of the right class can be made, whose attributes are what that annotates."""
        plugin: object = self.plugin
        if not isinstance(plugin, self.base):
            yield f"a {type(plugin).__name__} was made; expected a subclass of vibench.{self.base.__name__}"
        check_attributes(plugin, self.base)

    @property
    def constructor_options(self) -> Mapping[str, Option]:
        """Options of the class by name; none of a function that makes an instance."""
        constructor = getattr(self.create, "func", self.create)
        return options_of(constructor) if isinstance(constructor, type) else {}

    def options(self) -> Iterator[str]:
        """Every option has an annotation that its default conforms to: study files may set no other to anything."""
        doubts = {option.name: option.doubt for option in self.constructor_options.values()}
        yield from (Doubt(f"the option '{name}' {doubt}") for name, doubt in doubts.items() if doubt)

    def duration(self) -> Iterator[str]:
        """The constructor and every call stay below the limit."""
        for what, seconds in self._times.items():
            if max(seconds) > self.seconds:
                excess = f"{what} takes {max(seconds):.3g} s, above the limit of {self.seconds:g} s"
                yield f"{excess}; is something recomputed that could be stored?"
            yield Note(f"{what} takes {np.median(seconds):.2g} s")

    def determinism(self) -> Iterator[str]:
        """A second call and another instance give the same results to the last bit."""
        # Results may depend on a state of the instance, or on one that it is made with.
        again = list(self._changes("a second call", self._evaluation(self.plugin), self.arguments, 0.0))
        yield from again or self._changes("another instance", self._evaluation(self.create()), self.arguments, 0.0)

    def another_process(self) -> Iterator[str]:
        """Another process, whose sets have another order, gives the same results up to `round_off`."""
        # Three arguments show an order of sets; a process of its own costs a second instance.
        some = dict([*self.arguments.items()][-3:])
        try:
            there = call_in_other_process(_evaluated, type(self), self.create, some, seconds=self.seconds)
        except NotImportableError as error:
            yield Note(f"not compared: {error}")
            return
        for line in self._changes("another process", there.__getitem__, some, self.round_off):
            yield f"{line}; look for the order of sets, unseeded random numbers, time, folder and environment"

    def pickling(self) -> Iterator[str]:
        """The plugin can be sent to another process, and its result be stored."""
        if reason := _pickling_error(self.plugin):
            faulty = [key for key, value in getattr(self.plugin, "__dict__", {}).items() if _pickling_error(value)]
            where = f": look at attribute {', '.join(faulty)}" if faulty else ""
            raise ConformanceError(f"the {type(self.plugin).__name__} cannot be pickled ({reason}){where}")
        # A run stores the results of all stages, and later processes read them.
        name, before = next(iter(self.results.items()))
        with placed(f"the {type(before).__name__} cannot be stored", NumericalError):
            after = self.stored(before)
        for array, what in differences(self.arrays(after), self.arrays(before), 0.0):
            yield f"{name}: storing changes {array}: {what}"
        copy = pickle.loads(pickle.dumps(self.plugin))
        yield from self._changes("a pickled copy", self._evaluation(copy), self.arguments, 0.0)

    def stored(self, result: ResultT) -> ResultT:
        """A result as a stage finds it in its artefact."""
        return cast("ResultT", loads(dumps(result)))

    def _evaluation(self, plugin: PluginT) -> Callable[[str], Arrays]:
        return lambda name: self.arrays(self.evaluate(self.arguments[name], plugin))

    def _changes(self, source: str, again: Callable[[str], Arrays], names: Iterable[str], rtol: float) -> Iterator[str]:
        """Arrays that differ from those of all results, or of some, each named once."""
        faults: dict[str, str] = {}
        # The reverse order reveals results that depend on the previous call.
        for name in reversed([*names]):
            for array, what in differences(again(name), self.arrays(self.results[name]), rtol):
                faults.setdefault(array, f"{name}: {source} gives different values of {array}: {what}")
        yield from faults.values()


def _evaluated(case: type[Case[Any, Any, Any]], create: Any, arguments: Mapping[str, Any]) -> dict[str, Arrays]:
    other = case(create)
    return {name: other.arrays(other.evaluate(argument)) for name, argument in arguments.items()}


def _pickling_error(thing: Any) -> str:
    try:
        pickle.loads(pickle.dumps(thing))
    except Exception as error:  # noqa: BLE001  a plugin may raise anything
        return in_a_line(error)
    return ""


def copies(arrays: Arrays) -> Arrays:
    """Copies of dense arrays, and of sparse matrices in CSR format without duplicate entries."""
    copied: Arrays = {}
    for name, value in arrays.items():
        copied[name] = value.copy() if isinstance(value, np.ndarray) else sp.csr_array(value, copy=True)
        if sp.issparse(copied[name]):
            copied[name].sum_duplicates()
    return copied


def largest_entry(value: Any) -> float:
    """Largest modulus of an entry of a dense array or a sparse matrix; 0 without entries."""
    return float(np.max(np.abs(_entries(value)), initial=0.0))


def difference(one: Any, other: Any, limit: float) -> str:
    """Entry in which two arrays differ most, "entry (3, 4) is 1.0 against 2.0"; "" if by no more than the limit."""
    if one.shape != other.shape:
        return f"the shape is {one.shape} against {other.shape}"
    gap = one - other
    sizes = np.abs(_entries(gap))
    if not len(sizes) or np.max(sizes) <= limit:
        return ""
    # NaN counts as the largest difference.
    place = _place(gap, int(np.argmax(np.where(np.isnan(sizes), np.inf, sizes))))
    values = float(one[place]), float(other[place])
    # Six digits do not tell round-off: all of them are printed then.
    short = [f"{value:.6g}" for value in values]
    first, second = short if short[0] != short[1] else map(repr, values)
    return f"entry {place} is {first} against {second}"


def differences(one: Arrays, other: Arrays, rtol: float) -> Iterator[tuple[str, str]]:
    """Names of the arrays that differ by more than rtol times the largest entry of the other, and the `difference`."""
    for name in {**one, **other}:
        if name not in one or name not in other:
            yield name, "one of the two has none"
        elif what := difference(one[name], other[name], rtol * largest_entry(other[name])):
            yield name, what


def at(mu: Array) -> str:
    """A parameter (d,) in words: "at mu = [4.0, 0.1]"."""
    return f"at mu = {[float(f'{value:.12g}') for value in mu]}"


def _entries(value: Any) -> Array:
    """Entries of a dense array, or stored entries of a sparse matrix."""
    return np.asarray(value.data if sp.issparse(value) else np.ravel(value))


def _place(value: Any, k: int) -> tuple[int, ...] | int:
    """Index of the k-th of these entries, in a vector a number."""
    axes = [axis[k] for axis in sp.coo_array(value).coords] if sp.issparse(value) else np.unravel_index(k, value.shape)
    return tuple(int(index) for index in axes) if len(axes) > 1 else int(axes[0])


class Segment(NamedTuple):
    """A segment, its arrays at the left end, in the middle and at the right end, and the one that bends most there."""

    left: float
    right: float
    values: tuple[Arrays, Arrays, Arrays]
    name: str
    deviation: float  # in the middle from the mean of both ends, relative to the largest entry


def find_jump(
    evaluate: Callable[[float], Arrays], scales: dict[str, float], late: Callable[[], bool] = lambda: False
) -> Segment | None:
    """A segment of length 2⁻³⁰ at most on which an array jumps, `None` if no jump is found before it is `late`."""
    # Jumps below 1e-3 of the largest entry are not found. `evaluate` returns the arrays at t ∈ [0, 1]; `scales` names
    # those that are examined, with their largest modulus.

    def segment(left: float, right: float, first: Arrays, last: Arrays) -> Segment:
        middle = evaluate(0.5 * (left + right))
        off = {name: middle[name] - 0.5 * (first[name] + last[name]) for name in scales}
        deviations = {name: largest_entry(off[name]) / scales[name] for name in scales}
        name = max(deviations, key=deviations.__getitem__)
        return Segment(left, right, (first, middle, last), name, deviations[name])

    knots = [(t, evaluate(t)) for t in (0.0, 0.25, 0.5, 0.75, 1.0)]
    segments = [segment(left, right, first, last) for (left, first), (right, last) in pairwise(knots)]
    # Halving a segment divides the deviation of a smooth array by 4 and that at a kink by 2; at a jump it stays half
    # the jump. A kink takes fewer than 60 halvings; what changes by 1e-3 over 2⁻³⁰ is discontinuous or as steep as 1e6.
    for _ in range(60):
        worst = max(segments, key=lambda each: each.deviation)
        if worst.deviation < 0.5e-3 or late():
            return None
        if worst.right - worst.left <= 2.0**-30:
            return worst
        segments.remove(worst)
        middle = 0.5 * (worst.left + worst.right)
        first, between, last = worst.values
        segments += [segment(worst.left, middle, first, between), segment(middle, worst.right, between, last)]
    return None
