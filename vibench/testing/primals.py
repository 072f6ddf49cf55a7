"""The conformance checks of primal strategies: tolerance, enrichment, kind and nestedness."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, VibenchError
from vibench.interfaces.strategies import Cone, Enrichment, Kind, Offline, PrimalStrategy, no_free
from vibench.interfaces.validation import check_enrichment
from vibench.reduction.nested import NestedStrategy, grow_through
from vibench.stages.enrichment import BuiltEnrichment
from vibench.storage.serialisation import dumps, loads
from vibench.testing.case import Case
from vibench.testing.checks import Check, Conformance, ConformanceError, Note, raised
from vibench.testing.comparisons import Arrays, array_fault, at, difference, unmutated
from vibench.testing.samples.sample_problem import arrays_of, copy_of, sample_offline

TOLERANCES = (0.9, 0.5, 0.1)

NESTED_ATOL = 1e-10
"""Largest difference of the vectors of two nested constructions, relative to the largest entry."""


@dataclass(eq=False)
class PrimalCase(Case[PrimalStrategy, float | None, Enrichment]):
    """A primal strategy, tolerances or `None`, and the enrichments it makes of a reduced model.

    Parameters
    ----------
    create
        Class, or `partial` of it with options; an instance is refused with a `TypeError`.
    offline
        Reduced model to enrich; by default one of a sample problem.
    seconds
        Longest wall time [s] of one call.
    tolerances
        Tolerances for a strategy that takes one, in any order.
    """

    base = PrimalStrategy
    offline: Offline | None = None
    _: KW_ONLY
    tolerances: Sequence[float] = TOLERANCES

    @cached_property
    def model(self) -> Offline:
        """The reduced model."""
        return self.offline or sample_offline()

    @cached_property
    def arguments(self) -> dict[str, float | None]:
        """Tolerances from loose to tight, or `None` alone."""
        if not self.plugin.takes_tolerance:
            return {"without tolerance": None}
        ordered = sorted(self.tolerances, reverse=not self.plugin.larger_is_tighter)
        return {f"tolerance {tolerance}": tolerance for tolerance in ordered}

    def evaluate(self, argument: float | None, plugin: PrimalStrategy | None = None) -> Enrichment:
        """Enrichment for a tolerance."""
        given = copy_of(self.model)
        return self.clocked("an enrichment", lambda: (plugin or self.plugin).build(given, argument))

    def arrays(self, result: Enrichment, offline: Offline | None = None) -> Arrays:
        """Vectors (n×S), eta (m×k), or the vectors (n×k) supplied at the first training parameter."""
        reduced = offline or self.model
        problem, mu = reduced.problem, reduced.training[0]
        named = {"vectors": result.vectors, "eta": result.eta}
        if result.supply is not None:
            named[f"the supply {at(mu)}"] = result.supply(problem.V, problem.assemble(mu.copy()), reduced.span.copy())
        return {name: value for name, value in named.items() if value is not None}

    def stored(self, result: Enrichment) -> Enrichment:
        """An enrichment as a stage finds it in its artefact."""
        built: BuiltEnrichment = loads(dumps(BuiltEnrichment.of(result, self.plugin)))
        return built.restored(lambda: self.plugin)

    def tolerance(self) -> Iterator[str]:
        """`build` accepts a tolerance exactly if `takes_tolerance` says so."""
        takes: object = self.plugin.takes_tolerance
        if not isinstance(takes, bool):
            raise ConformanceError(f"takes_tolerance is {takes!r}; expected True or False")
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
            if fault := self._fault(built, self.model):
                raise ConformanceError(f"{name}: {fault}")
            vectors = built.vectors if built.vectors is not None else built.eta
            yield Note(f"{name}: {built.kind}" + ("" if vectors is None else f", {vectors.shape[1]} vectors"))

    def _fault(self, built: Enrichment, offline: Offline) -> str:
        V, W = offline.problem.V, offline.problem.W
        try:
            check_enrichment(built, V, offline.basis)
        except NumericalError as error:
            return str(error)
        if not isinstance(built.kind, Kind):
            return f"the kind is {built.kind!r}; expected a vibench.Kind"
        for name, value in self.arrays(built, offline).items():
            rows = W.dim if name == "eta" else V.dim
            if fault := array_fault(name, value, (rows, *np.shape(value)[-1:])):
                return fault
        for quantity, values in built.history.items():
            if np.ndim(values) != 1 or not np.all(np.isfinite(values)):
                return f"the history of '{quantity}' is not a vector of finite numbers, one for each step"
        return ""

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
        tolerances = {name: tolerance for name, tolerance in self.arguments.items() if tolerance is not None}
        grown = grow_through(self.plugin, copy_of(self.model), tolerances.values())
        fixed = self._fixed()
        tightest, longest = list(fixed.items())[-1]
        limit = NESTED_ATOL * float(np.max(np.abs(longest), initial=0.0))
        for name, vectors in fixed.items():
            if what := difference(vectors, longest[:, : vectors.shape[1]], limit):
                yield f"the vectors of {name} are not the first ones of {tightest}: {what}"
            if what := difference(grown.at(grown.milestone(tolerances[name])).vectors, vectors, limit):
                yield f"the vectors of {name} differ if one growth serves all tolerances: {what}"

    def _fixed(self) -> dict[str, Array]:
        """Vectors of fixed enrichments, from loose to tight."""
        return {name: built.vectors for name, built in self.results.items() if built.vectors is not None}

    def no_mutation(self) -> None:
        """`build` changes nothing of the reduced model."""
        for name, tolerance in self.arguments.items():
            given = copy_of(self.model)
            unmutated(f"{name}: build", arrays_of(given), partial(self.plugin.build, given, tolerance))

    def without_contact(self) -> Iterator[str]:
        """A cone without generators, as of snapshots without contact, is accepted or refused."""
        none = np.zeros((self.model.problem.W.dim, 0))
        offline = replace(copy_of(self.model), cone=Cone(none, np.zeros(1), no_free(0)), span=none)
        try:
            built = self.plugin.build(offline, next(iter(self.arguments.values())))
        except VibenchError:  # a strategy may refuse it in one line
            return
        if fault := self._fault(built, offline):
            yield f"with a cone without generators: {fault}"


PRIMAL = Conformance("primal", PrimalCase, (
    Check("construction", PrimalCase.construction),
    Check("options", PrimalCase.options, ("construction",)),
    Check("tolerance", PrimalCase.tolerance, ("construction",)),
    Check("enrichment", PrimalCase.enrichment, ("tolerance",)),
    Check("kind", PrimalCase.kind, ("enrichment",)),
    Check("determinism", PrimalCase.determinism, ("enrichment",)),
    Check("tighter tolerances", PrimalCase.tighter, ("kind", "determinism")),
    Check("nested growth", PrimalCase.nested, ("tighter tolerances",)),
    Check("no mutation", PrimalCase.no_mutation, ("enrichment",)),
    Check("model without contact", PrimalCase.without_contact, ("enrichment",)),
    Check("pickling", PrimalCase.pickling, ("determinism",)),
    Check("time", PrimalCase.duration, ("enrichment",)),
))  # fmt: skip
