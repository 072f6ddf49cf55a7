"""The assembly stage: reduced problems at the validation parameters, timed, and judged by their inf-sup constants."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from vibench.assess import constants_full, constants_on
from vibench.infsup import InfSup, inf_sup_on
from vibench.problem import checked_assembly, validation_parameters
from vibench.stage import Result, Stage
from vibench.stages import EnrichmentStage, reduced_model
from vibench.store import Store
from vibench.strategy import Kind
from vibench.timing import Seconds, median_seconds


@dataclass(frozen=True)
class Assembled:
    """What the queries of a reduced model have in common, whatever solves them.

    Attributes
    ----------
    seconds
        Median seconds of the assembly per validation parameter.
    own, full, plain
        Inf-sup constants per validation parameter: of the reduced pair, of the whole of V with the reduced cone (what
        online supremizers reach), of V_N alone.
    """

    seconds: tuple[Seconds, ...]
    own: tuple[InfSup, ...]
    full: tuple[InfSup, ...]
    plain: tuple[InfSup, ...]


@dataclass(frozen=True)
class AssemblyStage(Stage):
    """Assembly of the reduced problems at the validation parameters: timed, and judged by its inf-sup constants."""

    enrichment: EnrichmentStage
    assembly: str
    count: int
    seed: int

    def inputs(self) -> tuple[Stage, ...]:
        """Enrichment, and what it was built on."""
        return (self.enrichment, *self.enrichment.inputs())

    def run(self, store: Store) -> Result:
        """Time every assembly and compute the constants of the spaces it leads to."""
        model, basis, prepared = reduced_model(store, self.enrichment)
        problem = model.problem
        mus = validation_parameters(problem, self.count, self.seed)
        measured, own, matrices = [], [], []
        for mu in mus:
            reduced, seconds = median_seconds(partial(model.assemble, mu))
            measured.append(seconds)
            matrices.append(checked_assembly(problem, mu).B)
            if model.kind is Kind.PER_PARAMETER:
                own.append(inf_sup_on(reduced.basis, matrices[-1], prepared))
        if model.kind is not Kind.PER_PARAMETER:
            own = constants_on(model.fixed_basis, matrices, prepared)
        full, plain = constants_full(problem.V, matrices, prepared), constants_on(basis, matrices, prepared)
        return Result(Assembled(tuple(measured), tuple(own), tuple(full), tuple(plain)))
