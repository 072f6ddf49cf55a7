"""Checks of primal strategies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, VibenchError
from vibench.interfaces.strategies import Cone, Enrichment, Kind, Offline, PrimalStrategy, no_free
from vibench.interfaces.validation import ROUND_OFF, check_enrichment
from vibench.linalg.inner_product import InnerProduct
from vibench.reduction.nested import NestedStrategy, grow_through
from vibench.testing.checks import SECONDS, Check, Finding, Note, examine, name_of, raised, require, too_long
from vibench.testing.comparisons import array_fault, at, difference, pickled, why_not_pickled
from vibench.testing.sample import arrays_of, copy_of, offline_of, sample_offline
from vibench.timing import timed

TOLERANCES = (0.9, 0.5, 0.1)

NESTED_ATOL = 1e-10
"""How far vectors of one growth may be from those of another, relative to the largest entry."""


def check_primal(
    create: Callable[[], PrimalStrategy],
    offline: Offline | None = None,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    seconds: float = SECONDS,
) -> None:
    """Check all that vibench takes for granted of a primal strategy; see `examine_primal`.

    Raises
    ------
    ConformanceError
        Listing every failure: what is wrong, and where to look.
    """
    require(name_of(create), examine_primal(create, offline, tolerances=tolerances, seconds=seconds))


def examine_primal(
    create: Callable[[], PrimalStrategy],
    offline: Offline | None = None,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    seconds: float = SECONDS,
) -> list[Finding]:
    """Findings of all checks of a primal strategy.

    Parameters
    ----------
    create
        Makes an instance: the class, or a `partial` of it with options.
    offline
        What it gets to work with; a reduced model of a sample problem by default.
    tolerances
        What a strategy that takes one is asked for, in any order.
    seconds
        Longest time that one construction may take.
    """
    name_of(create)
    case = _Case(create, offline or sample_offline(), tolerances, seconds)
    return examine([
        Check("construction", case.construction),
        Check("tolerance", case.tolerance, ("construction",)),
        Check("enrichment", case.enrichment, ("tolerance",)),
        Check("kind", case.kind, ("enrichment",)),
        Check("determinism", case.determinism, ("enrichment",)),
        Check("tighter tolerances", case.tighter, ("kind", "determinism")),
        Check("nested growth", case.nested, ("tighter tolerances",)),
        Check("no mutation", case.no_mutation, ("enrichment",)),
        Check("model without contact", case.without_contact, ("enrichment",)),
        Check("pickling", case.pickling, ("determinism",)),
        Check("time", case.time, ("enrichment",)),
    ])  # fmt: skip


class _Case:
    """A primal strategy under examination; it is given copies."""

    def __init__(
        self, create: Callable[[], PrimalStrategy], offline: Offline, tolerances: Sequence[float], limit: float
    ) -> None:
        self._create, self._offline, self._asked, self._limit = create, offline, tolerances, limit
        self._times: list[float] = []

    @cached_property
    def _strategy(self) -> PrimalStrategy:
        return self._create()

    @cached_property
    def _tolerances(self) -> list[float]:
        """From loose to tight."""
        return sorted(self._asked, reverse=not self._strategy.larger_is_tighter)

    @cached_property
    def _built(self) -> list[tuple[float | None, Enrichment]]:
        asked = self._tolerances if self._strategy.takes_tolerance else [None]
        return [(tolerance, self._build(tolerance)) for tolerance in asked]

    def _build(self, tolerance: float | None, strategy: PrimalStrategy | None = None) -> Enrichment:
        given = copy_of(self._offline)
        found, spent = timed(lambda: (strategy or self._strategy).build(given, tolerance))
        self._times.append(spent.wall)
        return found

    def construction(self) -> Iterator[str]:
        """It can be made."""
        strategy: object = self._strategy
        if not isinstance(strategy, PrimalStrategy):
            yield f"a {type(strategy).__name__} was made; expected a subclass of vibench.PrimalStrategy"

    def tolerance(self) -> Iterator[str]:
        """A tolerance is accepted exactly if `takes_tolerance` says so."""
        takes: object = self._strategy.takes_tolerance
        if not isinstance(takes, bool):
            yield f"takes_tolerance is {takes!r}; expected True or False"
            return
        try:
            self._built  # noqa: B018  whether it can be built is what is asked
        except Exception as error:  # noqa: BLE001  a strategy is code of strangers
            advice = "" if takes else "; a strategy that needs a tolerance says takes_tolerance = True"
            asked = "with a tolerance" if takes else "without a tolerance, as takes_tolerance = False has it"
            yield f"build fails {asked}: {raised(error)}{advice}"
            return
        if takes and self._builds_without():
            yield (
                "takes_tolerance is True, yet build(offline, None) gives an enrichment; refuse it, "
                "or say takes_tolerance = False"
            )

    def _builds_without(self) -> bool:
        try:
            self._build(None)
        except Exception:  # noqa: BLE001  any refusal will do
            return False
        return True

    def enrichment(self) -> Iterator[str]:
        """What is handed over keeps its promises."""
        sizes = []
        for tolerance, found in self._built:
            if fault := self._fault(found, self._offline):
                yield f"{_asked(tolerance)}{fault}"
                return
            count = found.vectors if found.vectors is not None else found.eta
            sizes.append(
                f"{_asked(tolerance)}{found.kind}" + (f", {count.shape[1]} vectors" if count is not None else "")
            )
        yield Note("; ".join(sizes))

    def _fault(self, found: Enrichment, offline: Offline) -> str:
        V = offline.problem.V
        try:
            check_enrichment(found, V, offline.basis)
        except NumericalError as error:
            return f"{error}{_where(found, V, offline.basis)}"
        if not isinstance(found.kind, Kind):
            return f"the kind is {found.kind!r}; expected a vibench.Kind"
        if found.eta is not None:
            fault = array_fault("eta", found.eta, (offline.problem.W.dim, np.shape(found.eta)[-1]))
            if fault:
                return fault
        for quantity, values in found.history.items():
            if np.ndim(values) != 1 or not np.all(np.isfinite(values)):
                return f"the history of '{quantity}' is not a vector of finite numbers, one for each step"
        return self._supply_fault(found, offline) if found.supply is not None else ""

    @staticmethod
    def _supply_fault(found: Enrichment, offline: Offline) -> str:
        V, mu = offline.problem.V, offline.training[0]
        assert found.supply is not None  # who calls has looked
        vectors = found.supply(V, offline.problem.assemble(mu.copy()), offline.span.copy())
        fault = array_fault("what the supply gives", vectors, (V.dim, np.shape(vectors)[-1] if np.ndim(vectors) else 0))
        return f"{fault} ({at(mu)})" if fault else ""

    def kind(self) -> Iterator[str]:
        """The kind does not depend on the tolerance."""
        kinds = {found.kind: tolerance for tolerance, found in self._built}
        if len(kinds) > 1:
            yield "the kind depends on the tolerance: " + ", ".join(f"{kind} at {t:g}" for kind, t in kinds.items())

    def determinism(self) -> Iterator[str]:
        """The same again, to the last bit: of the same instance, and of another."""
        for how, strategy in (("when asked again", self._strategy), ("of another instance", self._create())):
            for tolerance, before in self._built:
                if what := self._different(self._build(tolerance, strategy), before):
                    yield f"{_asked(tolerance)}the enrichment is not the same {how}: {what}"
                    return

    def _different(self, one: Enrichment, other: Enrichment) -> str:
        if one.kind is not other.kind:
            return f"{one.kind} against {other.kind}"
        for name in ("vectors", "eta"):
            first, second = getattr(one, name), getattr(other, name)
            if first is not None and (what := difference(first, second)):
                return f"of the {name}, {what}"
        if one.supply is None or other.supply is None:
            return ""
        problem, span = self._offline.problem, self._offline.span
        vi = problem.assemble(self._offline.training[0].copy())
        what = difference(one.supply(problem.V, vi, span.copy()), other.supply(problem.V, vi, span.copy()))
        return f"of what it supplies, {what}" if what else ""

    def tighter(self) -> Iterator[str]:
        """Of a fixed enrichment a tighter tolerance asks for no fewer vectors."""
        fixed = [(tolerance, found.vectors.shape[1]) for tolerance, found in self._built if found.vectors is not None]
        for (loose, before), (tight, after) in pairwise(fixed):
            if after < before:
                yield f"tolerance {tight:g} gives {after} vectors, fewer than the {before} of tolerance {loose:g}"
                return

    def nested(self) -> Iterator[str]:
        """A `NestedStrategy` begins at a tight tolerance as it does at a loose one."""
        if not isinstance(self._strategy, NestedStrategy):
            yield Note("not declared")
            return
        grown = grow_through(self._strategy, copy_of(self._offline), self._tolerances)
        longest = self._built[-1][1].vectors
        assert longest is not None  # a nested strategy is a fixed one
        limit = NESTED_ATOL * float(np.max(np.abs(longest), initial=0.0))
        for tolerance, found in self._built:
            assert tolerance is not None  # likewise
            assert found.vectors is not None
            count = found.vectors.shape[1]
            if what := difference(found.vectors, longest[:, :count], limit):
                yield (
                    f"the vectors of tolerance {tolerance:g} are not the beginning of those of "
                    f"{self._tolerances[-1]:g}: {what}"
                )
            if what := difference(grown.at(grown.milestone(tolerance)).vectors, found.vectors, limit):
                yield f"the vectors of tolerance {tolerance:g} are others when all are grown at once: {what}"

    def no_mutation(self) -> Iterator[str]:
        """Whatever is given is left as it is."""
        for tolerance, _ in self._built:
            given = copy_of(self._offline)
            before = arrays_of(copy_of(given))
            self._strategy.build(given, tolerance)
            changed = ((name, difference(now, before[name])) for name, now in arrays_of(given).items())
            for name, what in changed:
                if what:
                    yield f"{_asked(tolerance)}build changes offline.{name}: {what} before; work on a copy"
                    return

    def without_contact(self) -> Iterator[str]:
        """Where no snapshot was in contact there is no generator, and nothing to enrich for."""
        full = self._offline
        empty = Cone(np.zeros((full.problem.W.dim, 0)), np.zeros(1), no_free(0))
        offline = offline_of(full.problem, full.basis.copy(), empty)
        try:
            found = self._strategy.build(offline, self._built[0][0])
        except VibenchError:  # a refusal in a line is an answer, too
            return
        if fault := self._fault(found, offline):
            yield f"with a cone that has no generator: {fault}"

    def pickling(self) -> Iterator[str]:
        """Strategy and enrichment travel between processes."""
        tolerance, before = self._built[0]
        for thing in (self._strategy, before):
            if what := why_not_pickled(thing):
                yield what
                return
        if what := self._different(pickled(before), before):
            yield f"{_asked(tolerance)}the enrichment is not the same after pickling: {what}"
        if what := self._different(self._build(tolerance, pickled(self._strategy)), before):
            yield f"{_asked(tolerance)}the enrichment of a pickled strategy is not the same: {what}"

    def time(self) -> Iterator[str]:
        """Nothing takes absurdly long."""
        yield from too_long("an enrichment", self._times, self._limit)


def _asked(tolerance: float | None) -> str:
    return "" if tolerance is None else f"tolerance {tolerance:g}: "


def _where(found: object, V: InnerProduct, basis: Array) -> str:
    """The vector that is to blame."""
    vectors = found.vectors if isinstance(found, Enrichment) else None
    if vectors is None or np.ndim(vectors) != 2 or len(vectors) != V.dim:
        return ""
    if not np.all(np.isfinite(vectors)):
        return f": look at vector {np.flatnonzero(~np.isfinite(vectors).all(axis=0))[0]}"
    off = V.gram(np.hstack([basis, vectors]), vectors)
    off[basis.shape[1] :] -= np.eye(vectors.shape[1])
    i, j = (int(k) for k in np.unravel_index(int(np.abs(off).argmax()), off.shape))
    if abs(off[i, j]) <= ROUND_OFF:
        return ""
    first = i - basis.shape[1]
    if first == j:
        return f": the norm of vector {j} is {float(V.norm(vectors[:, j])):.6g}"
    other = f"vector {first}" if first >= 0 else f"mode {i} of V_N"
    return f": the inner product of vector {j} with {other} is {off[i, j]:.1e}"
