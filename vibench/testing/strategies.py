"""The conformance checks of dual, primal and sampling strategies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from vibench.arrays import Array, read_only, taken
from vibench.errors import NumericalError, RequestError, VibenchError, placed
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.strategies import (
    AdaptiveSampling,
    DualStrategy,
    Enrichment,
    Offline,
    PrimalStrategy,
    ReducedSet,
    Sampling,
    Stop,
    Trainer,
    check_sample,
    no_free,
    rays,
)
from vibench.interfaces.validation import check_cone, check_enrichment
from vibench.linalg.inner_product import InnerProduct
from vibench.offline.sample_problem import sample_offline, sample_snapshots
from vibench.reduction.cones import hull_distances, project_on_cone
from vibench.reduction.nested import NestedStrategy, grow_through
from vibench.stages.artefacts import dumps, loads
from vibench.stages.enrichment import BuiltEnrichment
from vibench.testing.case import Arrays, Case, at, difference
from vibench.testing.checks import Check, ConformanceError, Doubt, Note, raised


@dataclass(eq=False)
class DualCase(Case[DualStrategy, Stop, ReducedSet]):
    """A dual strategy, tolerances and sizes, and the cones it makes of snapshots (m×P)."""

    base = DualStrategy
    snapshots: Array | None = None
    W: InnerProduct | None = None
    _: KW_ONLY
    tolerances: Sequence[float] = (0.3, 0.1, 0.01)
    sizes: Sequence[int] = (1, 3)

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.snapshots is None) != (self.W is None):
            raise TypeError("pass both snapshots and W, or neither")
        own = None if self.snapshots is None or self.W is None else (self.snapshots, self.W)
        self.lam, self.space = own or sample_snapshots()

    @cached_property
    def arguments(self) -> dict[str, Stop]:
        stops = {f"tolerance {value}": Stop(tolerance=value) for value in self.tolerances}
        return stops | {f"size {value}": Stop(size=value) for value in self.sizes}

    def evaluate(
        self, argument: Stop, plugin: DualStrategy | None = None, snapshots: Array | None = None
    ) -> ReducedSet:
        given = read_only(self.lam if snapshots is None else snapshots)
        return self.clocked("a cone", lambda: (plugin or self.plugin).reduce(given, self.space, argument))

    def arrays(self, result: ReducedSet) -> Arrays:
        return {"generators": result.generators, "errors": result.errors, "free": result.free.astype(float)}

    def cone(self) -> Iterator[str]:
        """Generators lie in W⁺ and have unit norm; errors have the right shape."""
        for stop, cone in self.results.items():
            with placed(stop, NumericalError):
                check_cone(cone, self.space)
            yield Note(f"{stop}: R = {cone.size}")

    def tolerance(self) -> Iterator[str]:
        """The projection error of every snapshot is below the tolerance."""
        for name, stop in self.arguments.items():
            if stop.tolerance is not None:
                yield from self._missed(stop.tolerance, self.results[name], self.lam)

    def _missed(self, tolerance: float, cone: ReducedSet, snapshots: Array) -> Iterator[str]:
        errors = self._errors(cone, cone.size, snapshots)
        if errors.max(initial=0.0) > tolerance + _round_off(tolerance):
            missed = f"tolerance {tolerance:g} is missed by {cone.size} generators, which claim {cone.errors[-1]:.3g}"
            yield f"{missed}: the relative projection error of snapshot {errors.argmax()} is {errors.max():.3g}"

    def size(self) -> Iterator[str]:
        """The cone has the prescribed number of generators, fewer only if it contains all snapshots."""
        for name, stop in self.arguments.items():
            cone = self.results[name]
            if stop.size is None or cone.size == stop.size:
                continue
            error = self._errors(cone, cone.size, self.lam).max(initial=0.0)
            if cone.size > stop.size or error > _round_off(0.0):
                yield f"{name} was prescribed; the cone has {cone.size} generators and the projection error {error:.1e}"

    def errors(self) -> Iterator[str]:
        """Claimed errors are the projection errors of the first r generators."""
        for stop, cone in self.results.items():
            # R + 1 errors claim nested generators, e(0) … e(R); one is e(R) alone.
            first = 0 if len(cone.errors) == cone.size + 1 else cone.size
            for r, claimed in enumerate(cone.errors, first):
                error = self._errors(cone, r, self.lam).max(initial=0.0)
                if abs(error - claimed) > _round_off(error):
                    advice = "a construction that is not nested returns its last error alone"
                    yield f"{stop}: the projection error e({r}) is {error:.6g}, not {claimed:.6g} as claimed; {advice}"
                    break

    def without_contact(self) -> Iterator[str]:
        """Zero, repeated and single snapshots are reduced; snapshots that all vanish are reduced or refused."""
        tolerance = next(iter(self.tolerances), 0.3)
        some, stop = self.lam, Stop(tolerance=tolerance)
        # Greedy constructions divide by norms of remainders, which vanish for these snapshots.
        largest = some[:, [np.linalg.norm(some, axis=0).argmax()]]
        zero, repeated = np.hstack([np.zeros_like(largest), some]), np.hstack([some, largest])
        for what, snapshots in (("a zero snapshot", zero), ("a repeated snapshot", repeated), ("one", largest)):
            cone = self.evaluate(stop, snapshots=snapshots)
            with placed(f"with {what}", NumericalError):
                check_cone(cone, self.space)
            yield from (f"with {what}: {fault}" for fault in self._missed(tolerance, cone, snapshots))
        with suppress(VibenchError):  # a strategy may refuse them in one line
            cone = self.evaluate(stop, snapshots=np.zeros_like(some))
        with placed("with zero snapshots alone", NumericalError):
            check_cone(cone, self.space)

    def _errors(self, cone: ReducedSet, r: int, snapshots: Array) -> Array:
        """Projection errors (P,) on the cone of the first r generators, relative to the largest norm of a snapshot."""
        largest = float(np.max(self.space.norm(snapshots), initial=0.0)) or 1.0
        chi = rays(cone.generators[:, :r], cone.free[:r])
        if cone.gauges is not None:
            points = self.space.whiten(chi / cone.gauges[:r])
            return hull_distances(points, self.space.whiten(snapshots)) / largest
        return np.array([project_on_cone(chi, theta, self.space).distance for theta in snapshots.T]) / largest

    checks = (
        Check("construction", Case.construction), Check("options", Case.options, ("construction",)),
        Check("cone", cone, ("construction",)), Check("tolerance", tolerance, ("cone",)),
        Check("size", size, ("cone",)), Check("errors", errors, ("cone",)),
        Check("determinism", Case.determinism, ("cone",)),
        Check("snapshots without contact", without_contact, ("cone", "tolerance")),
        Check("pickling", Case.pickling, ("determinism",)), Check("time", Case.duration, ("cone",)),
    )  # fmt: skip


def _round_off(error: float) -> float:
    """Largest difference of a projection error of a strategy from that of nonnegative least squares."""
    return 1e-8 + 1e-6 * error


@dataclass(eq=False)
class PrimalCase(Case[PrimalStrategy, float | None, Enrichment]):
    """A primal strategy, tolerances or `None`, and the enrichments it makes of a reduced model."""

    base = PrimalStrategy
    offline: Offline | None = None
    _: KW_ONLY
    tolerances: Sequence[float] = (0.9, 0.5, 0.1)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.model = self.offline or sample_offline()

    @cached_property
    def arguments(self) -> dict[str, float | None]:
        """Tolerances from loose to tight, or `None` alone."""
        if not self.plugin.takes_tolerance:
            return {"without tolerance": None}
        ordered = sorted(self.tolerances, reverse=not self.plugin.larger_is_tighter)
        return {f"tolerance {tolerance}": tolerance for tolerance in ordered}

    def evaluate(self, argument: float | None, plugin: PrimalStrategy | None = None) -> Enrichment:
        return self.clocked("an enrichment", lambda: (plugin or self.plugin).build(replace(self.model), argument))

    def arrays(self, result: Enrichment, offline: Offline | None = None) -> Arrays:
        """Vectors (n×S), eta (m×k), or the vectors (n×k) supplied at the first training parameter."""
        reduced = offline or self.model
        problem, mu = reduced.problem, reduced.training[0]
        named = {"vectors": result.vectors, "eta": result.eta}
        if result.supply is not None:
            named[f"the supply {at(mu)}"] = result.supply(problem.V, problem.assemble(mu.copy()), reduced.span.copy())
        return {name: value for name, value in named.items() if value is not None}

    def stored(self, result: Enrichment) -> Enrichment:
        built: BuiltEnrichment = loads(dumps(BuiltEnrichment.of(result, self.plugin)))
        return built.restored(self.plugin)

    def tolerance(self) -> Iterator[str]:
        """`build` accepts a tolerance exactly if `takes_tolerance` says so."""
        takes = self.plugin.takes_tolerance
        try:
            self.results  # noqa: B018  the first use builds them
        except Exception as error:  # a plugin may raise anything
            how = "with a tolerance" if takes else "without a tolerance, although takes_tolerance is False"
            advice = "" if takes else "; set takes_tolerance = True if the strategy needs one"
            raise ConformanceError(f"build fails {how}: {raised(error)}{advice}") from error
        with suppress(Exception):  # every refusal is right
            if takes:
                self.evaluate(None)
                advice = "refuse None, or set takes_tolerance = False"
                yield f"takes_tolerance is True, but build(offline, None) returns an enrichment; {advice}"

    def enrichment(self) -> Iterator[str]:
        """Enrichments have the right types and shapes; fixed vectors are orthonormal and orthogonal to V_N."""
        for name, built in self.results.items():
            self._check(name, built, self.model)
            vectors = built.vectors if built.vectors is not None else built.eta
            yield Note(f"{name}: {built.kind}" + ("" if vectors is None else f", {vectors.shape[1]} vectors"))

    def _check(self, where: str, built: Enrichment, offline: Offline) -> None:
        with placed(where, NumericalError):
            check_enrichment(built, offline.problem.V, offline.basis)
            for name, value in self.arrays(built, offline).items() if built.supply is not None else ():
                taken(value, name, offline.problem.V.dim, "count")

    def kind(self) -> Iterator[str]:
        """The kind does not depend on the tolerance."""
        kinds = {built.kind: name for name, built in self.results.items()}
        if len(kinds) > 1:
            yield "the kind depends on the tolerance: " + ", ".join(f"{kind} at {name}" for kind, name in kinds.items())

    def tighter(self) -> None:
        """A fixed enrichment of a tighter tolerance has at least as many vectors."""
        for (loose, before), (tight, after) in pairwise(self._fixed().items()):
            if (fewer := after.shape[1]) < (more := before.shape[1]):
                raise ConformanceError(f"{tight} gives {fewer} vectors, fewer than the {more} of {loose}")

    def nested(self) -> Iterator[str]:
        """The vectors of a `NestedStrategy` at a loose tolerance are the first ones at a tight tolerance."""
        if not isinstance(self.plugin, NestedStrategy):
            yield Note("not declared")
            return
        # A run grows an enrichment once, through all tolerances of a study.
        tolerances = {name: tolerance for name, tolerance in self.arguments.items() if tolerance is not None}
        grown = grow_through(self.plugin, self.model, tolerances.values())
        fixed = self._fixed()
        tightest, longest = list(fixed.items())[-1]
        # The growth may be orthonormalised in another order: the difference is round-off.
        limit = 1e-10 * float(np.max(np.abs(longest), initial=0.0))
        for name, vectors in fixed.items():
            if what := difference(vectors, longest[:, : vectors.shape[1]], limit):
                yield f"the vectors of {name} are not the first ones of {tightest}: {what}"
            if what := difference(grown.at(grown.milestone(tolerances[name])).vectors, vectors, limit):
                yield f"the vectors of {name} differ if one growth serves all tolerances: {what}"

    def _fixed(self) -> dict[str, Array]:
        """Vectors of fixed enrichments, from loose to tight."""
        return {name: built.vectors for name, built in self.results.items() if built.vectors is not None}

    def without_contact(self) -> None:
        """A cone without generators, as of snapshots without contact, is accepted or refused."""
        none = np.zeros((self.model.problem.W.dim, 0))
        offline = replace(self.model, cone=ReducedSet(none, np.zeros(1), no_free(0)), span=none)
        try:
            built = self.plugin.build(offline, next(iter(self.arguments.values())))
        except VibenchError:  # a strategy may refuse it in one line
            return
        self._check("with a cone without generators", built, offline)

    checks = (
        Check("construction", Case.construction), Check("options", Case.options, ("construction",)),
        Check("tolerance", tolerance, ("construction",)), Check("enrichment", enrichment, ("tolerance",)),
        Check("kind", kind, ("enrichment",)), Check("determinism", Case.determinism, ("enrichment",)),
        Check("tighter tolerances", tighter, ("kind", "determinism")),
        Check("nested growth", nested, ("tighter tolerances",)),
        Check("model without contact", without_contact, ("enrichment",)),
        Check("pickling", Case.pickling, ("determinism",)), Check("time", Case.duration, ("enrichment",)),
    )  # fmt: skip


def sample_boxes() -> Mapping[str, ParameterBox]:
    """Boxes by what they are called in messages: a negative lower bound, six orders of magnitude, and a thin one."""
    names, lower, upper = ("position", "height", "stiffness"), np.array([-1.0, 1e-3, 5.0]), np.array([2.0, 1e3, 5.5])
    return {
        f"{d} parameter{'s' * (d > 1)}": ParameterBox(names[:d], lower[:d], upper[:d], ("m", "m", "N/m")[:d])
        for d in (1, 2, 3)
    }


@dataclass(eq=False)
class SamplingCase(Case[Sampling, ParameterBox, Array]):
    """A sampling strategy, boxes, and its points (P×d) in those that it does not refuse by a `RequestError`."""

    base = Sampling
    boxes: Mapping[str, ParameterBox] = field(default_factory=sample_boxes)

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
        return {name: self.boxes[name] for name in self.results}

    @cached_property
    def results(self) -> dict[str, Array]:
        return {name: points for name, points in self.tried.items() if not isinstance(points, RequestError)}

    def evaluate(self, argument: ParameterBox, plugin: Sampling | None = None) -> Array:
        points = self.clocked("a sample", lambda: (plugin or self.plugin).parameters(argument))
        return np.array(points, float)

    def arrays(self, result: Array) -> Arrays:
        return {"the points": result}

    def parameters(self) -> Iterator[str]:
        """Points have the right shape, are finite, different, and in the box; some box is not refused."""
        for name, points in self.tried.items():
            if isinstance(points, RequestError):
                yield Note(f"{name}: refused, {points}")
                continue
            with placed(name):
                yield Note(f"{name}: P = {len(check_sample(self.boxes[name], points))}")
        if not self.results:
            reasons = dict.fromkeys(str(points) for points in self.tried.values())
            names = max((box.names for box in self.boxes.values()), key=len)
            yield f"no box of one to three parameters ({', '.join(names)}) is accepted: {'; '.join(reasons)}"

    def size(self) -> Iterator[str]:
        """There are as many points as an option `size` says."""
        if "size" not in self.constructor_options:
            yield Note("no option is called 'size'")
            return
        for size in dict.fromkeys([1, 5, 16, getattr(self.create, "keywords", {}).get("size", 16)]):
            for name, box in self.arguments.items():
                try:
                    points = self.evaluate(box, self.create(size=size))
                except RequestError as error:
                    yield Note(f"{name}: size {size} is refused, {error}")
                    continue
                if len(points) != size:
                    yield f"{name}: size = {size} was asked for; there are {len(points)} points"

    def seed(self) -> Iterator[str]:
        """Another value of an option `seed` gives other points; without one nothing is random."""
        if "seed" not in self.constructor_options:
            yield Note("no option is called 'seed'")
            return
        seeds = [self.create(seed=seed) for seed in range(4)]
        for name, box in self.arguments.items():
            samples = [self.evaluate(box, plugin) for plugin in seeds]
            # One point may be a rule of its own, such as the centre.
            if len(samples[0]) > 1 and all(np.array_equal(samples[0], other) for other in samples[1:]):
                yield Doubt(f"{name}: seeds 0 to 3 give the same points, so that the option 'seed' changes nothing")

    def training(self) -> Iterator[str]:
        """An adaptive strategy solves at points of the box, the same ones in every call, and ends."""
        if not isinstance(self.plugin, AdaptiveSampling):
            yield Note("the strategy is not adaptive")
            return
        for name, box in self.arguments.items():
            first, again = (_train(plugin, box) for plugin in (self.plugin, self.create()))
            try:
                check_sample(box, np.array(first))
            except (RequestError, ValueError) as error:
                nowhere = "solves nowhere; expected a training parameter at least"
                yield f"{name}: train: {error}" if first else f"{name}: train {nowhere}"
                continue
            same = len(first) == len(again) and all(map(np.array_equal, first, again))
            fault = f"{name}: a second call solves at other parameters"
            yield Note(f"{name}: {len(first)} solutions") if same else fault

    checks = (
        Check("construction", Case.construction), Check("options", Case.options, ("construction",)),
        Check("parameters", parameters, ("construction",)), Check("size", size, ("parameters",)),
        Check("determinism", Case.determinism, ("parameters",)), Check("seed", seed, ("determinism",)),
        Check("another process", Case.another_process, ("determinism",)),
        Check("training", training, ("determinism",)),
        Check("pickling", Case.pickling, ("determinism",)), Check("time", Case.duration, ("parameters",)),
    )  # fmt: skip


class DistanceTrainer(Trainer):
    """A model whose error at a parameter is bounded by the distance to the nearest solution, in widths of the box."""

    def __init__(self, box: ParameterBox) -> None:
        self._box, self.solved = box, list[Array]()

    def solve(self, mu: Array, bound: float = float("nan")) -> None:  # noqa: ARG002
        # Bounds fall with every solution: a rule that stops at any bound has stopped by then.
        if len(self.solved) >= 5000:
            raise ConformanceError("train does not end after 5000 solutions, with bounds that decrease")
        self.solved.append(np.array(mu, float))

    def bound(self, mu: Array) -> float:
        """The distance, infinite without a solution."""
        gaps = [np.abs((mu - other) / (self._box.upper - self._box.lower)).max() for other in self.solved]
        return float(min(gaps, default=np.inf))


def _train(plugin: Sampling, box: ParameterBox) -> list[Array]:
    assert isinstance(plugin, AdaptiveSampling)  # its caller asks for no other
    trainer = DistanceTrainer(box)
    try:
        plugin.train(box, trainer)
    except ConformanceError:
        raise
    except Exception as error:
        raise ConformanceError(f"train fails after {len(trainer.solved)} solutions: {raised(error)}") from error
    return trainer.solved
