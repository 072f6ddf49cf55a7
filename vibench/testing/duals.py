"""Checks of dual strategies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, VibenchError
from vibench.interfaces.strategies import Cone, DualStrategy, Stop
from vibench.interfaces.validation import check_cone
from vibench.linalg.inner_product import InnerProduct
from vibench.reduction.cones import project_on_cone
from vibench.testing.checks import SECONDS, Check, Finding, Note, examine, name_of, require, too_long
from vibench.testing.comparisons import array_fault, copied, difference, pickled, why_not_pickled
from vibench.testing.sample import sample_snapshots
from vibench.timing import timed

TOLERANCES = (0.3, 0.1, 0.01)
SIZES = (1, 3)

ERROR_ATOL = 1e-8
"""How far a claimed projection error may be from ours, which comes from a nonnegative least squares solver."""

KEPT = 1e-6
"""Share of a tolerance by which it may be missed: round-off of whoever projects."""


def check_dual(
    create: Callable[[], DualStrategy],
    snapshots: Array | None = None,
    W: InnerProduct | None = None,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    sizes: Sequence[int] = SIZES,
    seconds: float = SECONDS,
) -> None:
    """Check all that vibench takes for granted of a dual strategy; see `examine_dual`.

    Raises
    ------
    ConformanceError
        Listing every failure: what is wrong, and where to look.
    """
    findings = examine_dual(create, snapshots, W, tolerances=tolerances, sizes=sizes, seconds=seconds)
    require(name_of(create), findings)


def examine_dual(
    create: Callable[[], DualStrategy],
    snapshots: Array | None = None,
    W: InnerProduct | None = None,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    sizes: Sequence[int] = SIZES,
    seconds: float = SECONDS,
) -> list[Finding]:
    """Findings of all checks of a dual strategy.

    A cone with R + 1 errors claims that its generators are nested, and every error is computed again; a construction
    that is not nested gives its last error alone.

    Parameters
    ----------
    create
        Makes an instance: the class, or a `partial` of it with options.
    snapshots, W
        Multiplier snapshots (m×P), coefficientwise nonnegative, and their space; those of a sample problem by default.
    tolerances, sizes
        What it is asked for.
    seconds
        Longest time that one construction may take.
    """
    name_of(create)
    if (snapshots is None) != (W is None):
        raise TypeError("give both snapshots and W, or neither")
    given, space = sample_snapshots() if snapshots is None or W is None else (snapshots, W)
    stops = [*(Stop(tolerance=value) for value in tolerances), *(Stop(size=value) for value in sizes)]
    case = _Case(create, given, space, stops, seconds)
    return examine([
        Check("construction", case.construction),
        Check("cone", case.cone, ("construction",)),
        Check("tolerance", case.tolerance, ("cone",)),
        Check("size", case.size, ("cone",)),
        Check("errors", case.errors, ("cone",)),
        Check("determinism", case.determinism, ("cone",)),
        Check("no mutation", case.no_mutation, ("cone",)),
        Check("snapshots without contact", case.without_contact, ("cone", "tolerance")),
        Check("pickling", case.pickling, ("determinism",)),
        Check("time", case.time, ("cone",)),
    ])  # fmt: skip


class _Case:
    """A dual strategy under examination; it is given copies."""

    def __init__(
        self, create: Callable[[], DualStrategy], snapshots: Array, W: InnerProduct, stops: list[Stop], limit: float
    ) -> None:
        self._create, self._snapshots, self._W, self._stops, self._limit = create, snapshots, W, stops, limit
        self._times: list[float] = []

    @cached_property
    def _strategy(self) -> DualStrategy:
        return self._create()

    @cached_property
    def _cones(self) -> list[tuple[Stop, Cone]]:
        return [(stop, self._reduce(stop)) for stop in self._stops]

    def _reduce(self, stop: Stop, snapshots: Array | None = None, strategy: DualStrategy | None = None) -> Cone:
        given = (self._snapshots if snapshots is None else snapshots).copy()
        cone, spent = timed(lambda: (strategy or self._strategy).reduce(given, self._W, stop))
        self._times.append(spent.wall)
        return cone

    def construction(self) -> Iterator[str]:
        """It can be made."""
        strategy: object = self._strategy
        if not isinstance(strategy, DualStrategy):
            yield f"a {type(strategy).__name__} was made; expected a subclass of vibench.DualStrategy"

    def cone(self) -> Iterator[str]:
        """What is handed over is a cone in W⁺, of unit generators."""
        for stop, cone in self._cones:
            if fault := _cone_fault(cone, self._W):
                yield f"{stop}: {fault}"
        if not [fault for _, cone in self._cones if (fault := _cone_fault(cone, self._W))]:
            yield Note(", ".join(f"{stop}: R = {cone.size}" for stop, cone in self._cones))

    def tolerance(self) -> Iterator[str]:
        """Every snapshot is as near to the cone as was asked for."""
        for stop, cone in self._cones:
            if stop.tolerance is not None and (fault := self._missed(stop.tolerance, cone, self._snapshots)):
                yield fault

    def _missed(self, tolerance: float, cone: Cone, snapshots: Array) -> str:
        distances = _distances(cone, cone.size, snapshots, self._W)
        if distances.max(initial=0.0) <= tolerance * (1.0 + KEPT) + ERROR_ATOL:
            return ""
        worst = int(np.argmax(distances))
        return (
            f"tolerance {tolerance:g} is missed: the cone of {cone.size} generators leaves {distances[worst]:.3g} of "
            f"snapshot {worst}, relative to the largest norm of a snapshot; the error claimed is {cone.errors[-1]:.3g}"
        )

    def size(self) -> Iterator[str]:
        """There are as many generators as were asked for, fewer only where all snapshots are reproduced."""
        for stop, cone in self._cones:
            if stop.size is None or cone.size == stop.size:
                continue
            left = float(_distances(cone, cone.size, self._snapshots, self._W).max(initial=0.0))
            if cone.size > stop.size or left > ERROR_ATOL:
                yield f"{stop} was asked for and the cone has {cone.size} generators, which leave {left:.1e}"

    def errors(self) -> Iterator[str]:
        """The errors claimed are those of the generators."""
        for stop, cone in self._cones:
            claimed = cone.errors
            sizes = range(cone.size + 1) if len(claimed) == cone.size + 1 else [cone.size]
            for r, claim in zip(sizes, claimed[-len(sizes) :], strict=True):
                found = float(_distances(cone, r, self._snapshots, self._W).max(initial=0.0))
                if abs(found - float(claim)) > ERROR_ATOL + KEPT * found:
                    yield (
                        f"{stop}: the error of {r} generators is given as {claim:.6g}; the first {r} leave "
                        f"{found:.6g} of the worst snapshot (a cone that is not nested gives its last error alone)"
                    )
                    break

    def determinism(self) -> Iterator[str]:
        """The same again, to the last bit: of the same instance, and of another."""
        for how, strategy in (("when asked again", self._strategy), ("of another instance", self._create())):
            for stop, before in self._cones:
                if what := _different(self._reduce(stop, strategy=strategy), before):
                    yield f"{stop}: the {what.replace(': ', f' are not the same {how}: ', 1)}"
                    return

    def no_mutation(self) -> Iterator[str]:
        """Snapshots and space are left as they are."""
        for stop, _ in self._cones:
            given, gram = self._snapshots.copy(), copied(self._W.matrix)
            self._strategy.reduce(given, self._W, stop)
            if what := difference(given, self._snapshots):
                yield f"{stop}: reduce changes the snapshots it is given: {what} before; work on a copy"
                return
            if what := difference(copied(self._W.matrix), gram):
                yield f"{stop}: reduce changes X_W: {what} before"
                return

    def without_contact(self) -> Iterator[str]:
        """A snapshot that is zero, one that comes twice, one alone; all of them zero."""
        tolerance = next((stop.tolerance for stop in self._stops if stop.tolerance is not None), TOLERANCES[0])
        some = self._snapshots
        cases = {
            "with a zero snapshot": np.column_stack([np.zeros(len(some)), some]),
            "with a snapshot that comes twice": np.column_stack([some, some[:, np.linalg.norm(some, axis=0).argmax()]]),
            "with one snapshot": some[:, [np.linalg.norm(some, axis=0).argmax()]],
        }
        for name, snapshots in cases.items():
            cone = self._reduce(Stop(tolerance=tolerance), snapshots)
            if fault := _cone_fault(cone, self._W) or self._missed(tolerance, cone, snapshots):
                yield f"{name}: {fault}"
        try:
            cone = self._reduce(Stop(tolerance=tolerance), np.zeros_like(some))
        except VibenchError:  # a refusal in a line is an answer, too
            return
        if fault := _cone_fault(cone, self._W):
            yield f"with nothing but zero snapshots: {fault}; expected a cone without generators"

    def pickling(self) -> Iterator[str]:
        """Strategy and cone travel between processes."""
        for thing in (self._strategy, self._cones[0][1]):
            if what := why_not_pickled(thing):
                yield what
                return
        stop, before = self._cones[0]
        if what := _different(self._reduce(stop, strategy=pickled(self._strategy)), before):
            yield f"{stop}: the {what.replace(': ', ' are not the same after pickling: ', 1)}"

    def time(self) -> Iterator[str]:
        """Nothing takes absurdly long."""
        yield from too_long("a cone", self._times, self._limit)


def _cone_fault(cone: object, W: InnerProduct) -> str:
    """What is wrong with a cone, and where."""
    try:
        checked = check_cone(cone, W)
    except NumericalError as error:
        return f"{error}{_where(cone, W)}"
    errors = checked.errors
    if fault := array_fault("errors", errors, np.shape(errors)):
        return fault
    R = checked.size
    if errors.ndim != 1 or len(errors) not in (1, R + 1) or errors.min() < 0.0:
        return f"errors has shape {errors.shape}; expected e(0) … e({R}), or e({R}) alone, none negative"
    return ""


def _where(cone: object, W: InnerProduct) -> str:
    """The generator that is to blame."""
    if not isinstance(cone, Cone) or np.ndim(cone.generators) != 2 or len(cone.generators) != W.dim:
        return ""
    chi = cone.generators
    if not np.all(np.isfinite(chi)):
        return f": look at generator {np.flatnonzero(~np.isfinite(chi).all(axis=0))[0]}"
    away = np.abs(W.norm(chi) - 1.0)
    if away.max(initial=0.0) > ERROR_ATOL:
        return f": that of generator {away.argmax()} is {W.norm(chi)[away.argmax()]:.6g}"
    i, r = np.unravel_index(int(chi.argmin()), chi.shape)
    return f": look at coefficient {i} of generator {r}"


def _distances(cone: Cone, r: int, snapshots: Array, W: InnerProduct) -> Array:
    """Distances (P,) of the snapshots from the cone of the first r generators, over the largest norm of a snapshot."""
    largest = float(np.max(W.norm(snapshots), initial=0.0))
    if largest == 0.0:
        return np.zeros(snapshots.shape[1])
    chi, free = cone.generators[:, :r], cone.free[:r]
    both = np.hstack([chi, -chi[:, free]])
    return np.array([project_on_cone(both, theta, W).distance for theta in snapshots.T]) / largest


def _different(one: Cone, other: Cone) -> str:
    for name in ("generators", "errors"):
        if what := difference(getattr(one, name), getattr(other, name)):
            return f"{name}: {what}"
    return "" if np.array_equal(one.free, other.free) else "signs: other generators are free"
