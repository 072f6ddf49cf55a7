"""The conformance checks of dual strategies: cone, tolerance, size and claimed errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property, partial

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, VibenchError
from vibench.interfaces.strategies import Cone, DualStrategy, Stop, rays
from vibench.interfaces.validation import check_cone
from vibench.linalg.inner_product import InnerProduct
from vibench.reduction.cones import project_on_cone
from vibench.testing.case import Case
from vibench.testing.checks import Check, Conformance, Note
from vibench.testing.comparisons import Arrays, array_fault, unmutated
from vibench.testing.samples.sample_problem import sample_snapshots

TOLERANCES = (0.3, 0.1, 0.01)
SIZES = (1, 3)

ERROR_ATOL = 1e-8
"""Largest absolute difference of a claimed projection error from that of nonnegative least squares."""

ERROR_RTOL = 1e-6
"""Relative excess over a tolerance, or over an error, that counts as round-off of the strategy's projection."""


@dataclass(eq=False)
class DualCase(Case[DualStrategy, Stop, Cone]):
    """A dual strategy, tolerances and sizes, and the cones it makes of snapshots (m×P).

    A cone with R + 1 errors claims that its generators are nested, and every error is computed again; a construction
    that is not nested returns its last error alone.

    Parameters
    ----------
    create
        Class, or `partial` of it with options; an instance is refused with a `TypeError`.
    snapshots, W
        Multiplier snapshots (m×P), nonnegative coefficients, and their space; both or neither. By default those of a
        sample problem.
    seconds
        Longest wall time [s] of one call.
    tolerances, sizes
        Stopping rules of the cones that are made.
    """

    base = DualStrategy
    snapshots: Array | None = None
    W: InnerProduct | None = None
    _: KW_ONLY
    tolerances: Sequence[float] = TOLERANCES
    sizes: Sequence[int] = SIZES

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.snapshots is not None and self.W is not None:
            self.lam, self.space = self.snapshots, self.W
        elif self.snapshots is None and self.W is None:
            self.lam, self.space = sample_snapshots()
        else:
            raise TypeError("pass both snapshots and W, or neither")

    @cached_property
    def arguments(self) -> dict[str, Stop]:
        """Tolerances and sizes."""
        stops = {f"tolerance {value}": Stop(tolerance=value) for value in self.tolerances}
        return stops | {f"size {value}": Stop(size=value) for value in self.sizes}

    def evaluate(self, argument: Stop, plugin: DualStrategy | None = None, snapshots: Array | None = None) -> Cone:
        """Cone of all snapshots, or of others."""
        given = (self.lam if snapshots is None else snapshots).copy()
        return self.clocked("a cone", lambda: (plugin or self.plugin).reduce(given, self.space, argument))

    def arrays(self, result: Cone) -> Arrays:
        """Generators, errors and signs."""
        return {"generators": result.generators, "errors": result.errors, "free": result.free.astype(float)}

    def cone(self) -> Iterator[str]:
        """Generators lie in W⁺ and have unit norm; errors have the right shape."""
        for stop, cone in self.results.items():
            fault = _cone_fault(cone, self.space)
            yield f"{stop}: {fault}" if fault else Note(f"{stop}: R = {cone.size}")

    def tolerance(self) -> Iterator[str]:
        """The projection error of every snapshot is below the tolerance."""
        for name, stop in self.arguments.items():
            if stop.tolerance is not None:
                yield from self._missed(stop.tolerance, self.results[name], self.lam)

    def _missed(self, tolerance: float, cone: Cone, snapshots: Array) -> Iterator[str]:
        errors = self._errors(cone, cone.size, snapshots)
        if errors.max(initial=0.0) > tolerance * (1.0 + ERROR_RTOL) + ERROR_ATOL:
            yield (
                f"tolerance {tolerance:g} is missed: with {cone.size} generators the projection error of snapshot "
                f"{errors.argmax()} is {errors.max():.3g}, relative to the largest norm of a snapshot; "
                f"the claimed error is {cone.errors[-1]:.3g}"
            )

    def size(self) -> Iterator[str]:
        """The cone has the prescribed number of generators, fewer only if it contains all snapshots."""
        for name, stop in self.arguments.items():
            cone = self.results[name]
            if stop.size is None or cone.size == stop.size:
                continue
            error = self._errors(cone, cone.size, self.lam).max(initial=0.0)
            if cone.size > stop.size or error > ERROR_ATOL:
                yield f"{name} was prescribed; the cone has {cone.size} generators and the projection error {error:.1e}"

    def errors(self) -> Iterator[str]:
        """Claimed errors are the projection errors of the first r generators."""
        for stop, cone in self.results.items():
            first = 0 if len(cone.errors) == cone.size + 1 else cone.size
            for r, claimed in enumerate(cone.errors, first):
                error = self._errors(cone, r, self.lam).max(initial=0.0)
                if abs(error - claimed) > ERROR_ATOL + ERROR_RTOL * error:
                    yield (
                        f"{stop}: the claimed error e({r}) is {claimed:.6g}; the projection error of the snapshots is "
                        f"{error:.6g} for r = {r} (a construction that is not nested returns its last error alone)"
                    )
                    break

    def no_mutation(self) -> None:
        """`reduce` changes neither the snapshots nor the space."""
        for name, stop in self.arguments.items():
            given = self.lam.copy()
            arrays = {"the snapshots": given, "X_W": self.space.matrix}
            unmutated(f"{name}: reduce", arrays, partial(self.plugin.reduce, given, self.space, stop))

    def without_contact(self) -> Iterator[str]:
        """Zero, repeated and single snapshots are reduced; snapshots that all vanish are reduced or refused."""
        tolerance = next(iter(self.tolerances), TOLERANCES[0])
        some, stop = self.lam, Stop(tolerance=tolerance)
        largest = some[:, [np.linalg.norm(some, axis=0).argmax()]]
        for name, snapshots in {
            "with a zero snapshot": np.hstack([np.zeros((len(some), 1)), some]),
            "with a repeated snapshot": np.hstack([some, largest]),
            "with one snapshot": largest,
        }.items():
            cone = self.evaluate(stop, snapshots=snapshots)
            if fault := _cone_fault(cone, self.space) or "".join(self._missed(tolerance, cone, snapshots)):
                yield f"{name}: {fault}"
        try:
            cone = self.evaluate(stop, snapshots=np.zeros_like(some))
        except VibenchError:  # a strategy may refuse them in one line
            return
        if fault := _cone_fault(cone, self.space):
            yield f"with zero snapshots alone: {fault}; expected a cone without generators"

    def _errors(self, cone: Cone, r: int, snapshots: Array) -> Array:
        """Projection errors (P,) on the cone of the first r generators, relative to the largest norm of a snapshot."""
        largest = float(np.max(self.space.norm(snapshots), initial=0.0)) or 1.0
        chi = rays(cone.generators[:, :r], cone.free[:r])
        return np.array([project_on_cone(chi, theta, self.space).distance for theta in snapshots.T]) / largest


DUAL = Conformance("dual", DualCase, (
    Check("construction", DualCase.construction),
    Check("options", DualCase.options, ("construction",)),
    Check("cone", DualCase.cone, ("construction",)),
    Check("tolerance", DualCase.tolerance, ("cone",)),
    Check("size", DualCase.size, ("cone",)),
    Check("errors", DualCase.errors, ("cone",)),
    Check("determinism", DualCase.determinism, ("cone",)),
    Check("no mutation", DualCase.no_mutation, ("cone",)),
    Check("snapshots without contact", DualCase.without_contact, ("cone", "tolerance")),
    Check("pickling", DualCase.pickling, ("determinism",)),
    Check("time", DualCase.duration, ("cone",)),
))  # fmt: skip


def _cone_fault(cone: object, W: InnerProduct) -> str:
    """What is wrong with a cone, and where; "" if nothing is."""
    try:
        checked = check_cone(cone, W)
    except NumericalError as error:
        return str(error)
    errors, R = checked.errors, checked.size
    fault = array_fault("errors", errors, np.shape(errors))
    if not fault and (errors.ndim != 1 or len(errors) not in (1, R + 1) or errors.min() < 0.0):
        return f"errors has shape {errors.shape}; expected e(0) … e({R}), or e({R}) alone, none negative"
    return fault
