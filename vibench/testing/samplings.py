"""The conformance checks of sampling strategies: points of the box, as many as asked for, that follow from a seed."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.strategies import AdaptiveSampling, Sampling, Trainer, check_sample
from vibench.testing.case import Case
from vibench.testing.checks import Check, Conformance, ConformanceError, Doubt, Note, raised
from vibench.testing.comparisons import Arrays

SIZES = (1, 5, 16)
"""Values of an option `size` that are tried."""

MOST_SOLUTIONS = 5000
"""Solutions after which an adaptive strategy is taken for one that does not end."""

_WHOLE = ParameterBox(
    ("position", "height", "stiffness"), np.array([-1.0, 1e-3, 5.0]), np.array([2.0, 1e3, 5.5]), ("m", "m", "N/m")
)

BOXES: Mapping[str, ParameterBox] = {
    f"{d} parameter{'s' * (d > 1)}": ParameterBox(
        _WHOLE.names[:d], _WHOLE.lower[:d], _WHOLE.upper[:d], _WHOLE.units[:d]
    )
    for d in (1, 2, 3)
}
"""Boxes by what they are called in messages: of a negative lower bound, of six orders of magnitude, and a thin one."""


@dataclass(eq=False)
class SamplingCase(Case[Sampling, ParameterBox, Array]):
    """A sampling strategy, boxes, and its points (P×d) in those that its options fit.

    An option called `size` is the number of points, one called `seed` determines whatever is random; both are tried
    with other values.

    Parameters
    ----------
    create
        Class, or `partial` of it with options; an instance is refused with a `TypeError`.
    boxes
        Boxes by what they are called in messages; by default three, of one to three parameters called position, height
        and stiffness. A strategy may refuse some of them by a `RequestError`, where its options do not fit.
    seconds
        Longest wall time [s] of one call.
    """

    base = Sampling
    boxes: Mapping[str, ParameterBox] = field(default_factory=lambda: BOXES)

    @cached_property
    def tried(self) -> dict[str, Array | RequestError]:
        """Points in every box, or why the strategy refuses it."""
        tried: dict[str, Array | RequestError] = {}
        for name, box in self.boxes.items():
            try:
                tried[name] = self.evaluate(box)
            except RequestError as error:
                tried[name] = error
        return tried

    @property
    def arguments(self) -> dict[str, ParameterBox]:
        """The boxes that are not refused."""
        return {name: self.boxes[name] for name, points in self.tried.items() if not isinstance(points, RequestError)}

    @cached_property
    def results(self) -> dict[str, Array]:
        """The points by the names of their boxes."""
        return {name: points for name, points in self.tried.items() if not isinstance(points, RequestError)}

    def evaluate(self, argument: ParameterBox, plugin: Sampling | None = None) -> Array:
        """Points in a box, as the strategy returns them."""
        return self.clocked("a sample", partial(_points, plugin or self.plugin, argument))

    def arrays(self, result: Array) -> Arrays:
        """The points."""
        return {"the points": result}

    def parameters(self) -> Iterator[str]:
        """Points have the right shape, are finite, different, and in the box; some box is not refused."""
        for name, points in self.tried.items():
            if isinstance(points, RequestError):
                yield Note(f"{name}: refused, {points}")
                continue
            try:
                yield Note(f"{name}: P = {len(check_sample(self.boxes[name], points))}")
            except RequestError as error:
                yield f"{name}: {error}"
        if not self.results:
            reasons = dict.fromkeys(str(points) for points in self.tried.values())
            yield f"no box of one to three parameters ({', '.join(_WHOLE.names)}) is accepted: {'; '.join(reasons)}"

    def size(self) -> Iterator[str]:
        """There are as many points as an option `size` says."""
        if not self._takes("size"):
            yield Note("no option is called 'size'")
            return
        for size in dict.fromkeys([*SIZES, *([self._given["size"]] if "size" in self._given else [])]):
            for name, box in self.arguments.items():
                try:
                    points = self.evaluate(box, self._variant(size=size))
                except RequestError as error:
                    yield Note(f"{name}: size {size} is refused, {error}")
                    continue
                if len(points) != size:
                    yield f"{name}: size = {size} was asked for; there are {len(points)} points"

    def seed(self) -> Iterator[str]:
        """Another value of an option `seed` gives other points; without one nothing is random."""
        if not self._takes("seed"):
            yield Note("no option is called 'seed'")
            return
        seeds = [self._variant(seed=seed) for seed in range(4)]
        for name, box in self.arguments.items():
            samples = [self.evaluate(box, plugin) for plugin in seeds]
            if len(samples[0]) > 1 and all(np.array_equal(samples[0], other) for other in samples[1:]):
                yield Doubt(f"{name}: seeds 0 to 3 give the same points, so that the option 'seed' changes nothing")

    def no_mutation(self) -> Iterator[str]:
        """Neither the box nor NumPy's global random numbers are changed."""
        for name, box in self.arguments.items():
            given, state = _copy(box), np.random.get_state()  # noqa: NPY002  the state that others share
            self.plugin.parameters(given)
            for what in ("lower", "upper"):
                if not np.array_equal(getattr(given, what), getattr(box, what)):
                    yield f"{name}: parameters changes box.{what}; work on copies"
            if not all(map(np.array_equal, state, np.random.get_state())):  # noqa: NPY002
                yield f"{name}: parameters changes NumPy's global random numbers: use np.random.default_rng(seed)"

    def training(self) -> Iterator[str]:
        """An adaptive strategy solves at points of the box, the same ones in every call, and ends."""
        if not isinstance(self.plugin, AdaptiveSampling):
            yield Note("the strategy is not adaptive")
            return
        for name, box in self.arguments.items():
            first, again = (_train(plugin, box) for plugin in (self.plugin, self.create()))
            if not first:
                yield f"{name}: train solves nowhere; expected a training parameter at least"
                continue
            try:
                check_sample(box, np.array(first))
            except (RequestError, ValueError) as error:
                yield f"{name}: train: {error}"
                continue
            same = len(first) == len(again) and all(map(np.array_equal, first, again))
            yield (
                Note(f"{name}: {len(first)} solutions") if same else f"{name}: a second call solves at other parameters"
            )

    @property
    def _given(self) -> dict[str, Any]:
        """Options that are given."""
        return dict(getattr(self.create, "keywords", {}))

    def _takes(self, option: str) -> bool:
        constructor = getattr(self.create, "func", self.create)
        return isinstance(constructor, type) and option in inspect.signature(constructor).parameters

    def _variant(self, **options: Any) -> Sampling:
        """The strategy with other options."""
        constructor: Callable[..., Sampling] = getattr(self.create, "func", self.create)
        return constructor(**self._given | options)


class DistanceTrainer(Trainer):
    """A model whose error at a parameter is bounded by the distance to the nearest solution, in widths of the box."""

    def __init__(self, box: ParameterBox) -> None:
        self._box, self.solved = box, list[Array]()

    def solve(self, mu: Array, bound: float = float("nan")) -> None:  # noqa: ARG002
        """Note the parameter."""
        if len(self.solved) >= MOST_SOLUTIONS:
            raise ConformanceError(f"train does not end after {MOST_SOLUTIONS} solutions, with bounds that decrease")
        self.solved.append(np.array(mu, float))

    def bound(self, mu: Array) -> float:
        """The distance, infinite without a solution."""
        gaps = [np.abs((mu - other) / (self._box.upper - self._box.lower)).max() for other in self.solved]
        return float(min(gaps, default=np.inf))


def _points(plugin: Sampling, box: ParameterBox) -> Array:
    return np.array(plugin.parameters(_copy(box)), float)


def _copy(box: ParameterBox) -> ParameterBox:
    return replace(box, lower=box.lower.copy(), upper=box.upper.copy())


def _train(plugin: Sampling, box: ParameterBox) -> list[Array]:
    """The parameters at which a strategy solves."""
    assert isinstance(plugin, AdaptiveSampling)  # its caller asks for no other
    trainer = DistanceTrainer(box)
    try:
        plugin.train(_copy(box), trainer)
    except ConformanceError:
        raise
    except Exception as error:
        raise ConformanceError(f"train fails after {len(trainer.solved)} solutions: {raised(error)}") from error
    return trainer.solved


SAMPLING = Conformance("sampling", SamplingCase, (
    Check("construction", SamplingCase.construction),
    Check("options", SamplingCase.options, ("construction",)),
    Check("parameters", SamplingCase.parameters, ("construction",)),
    Check("size", SamplingCase.size, ("parameters",)),
    Check("determinism", SamplingCase.determinism, ("parameters",)),
    Check("seed", SamplingCase.seed, ("determinism",)),
    Check("another process", SamplingCase.another_process, ("determinism",)),
    Check("no mutation", SamplingCase.no_mutation, ("parameters",)),
    Check("training", SamplingCase.training, ("determinism",)),
    Check("pickling", SamplingCase.pickling, ("determinism",)),
    Check("time", SamplingCase.duration, ("parameters",)),
))  # fmt: skip
