"""Seconds of queries of several cells and of high-fidelity solutions, measured interleaved, round by round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from vibench.arrays import Array, Indices
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.validation import checked_assembly
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.error_bounds import CorrectionMode
from vibench.model.hyperreduced import HyperReducedModel
from vibench.offline.assemblies import Assemblies
from vibench.offline.correction import corrected_in_full
from vibench.provenance import machine
from vibench.results.costs.paired_seconds import paces
from vibench.rounds.marginal_solutions import MarginalSolutions, parts_alike
from vibench.rounds.timed_seconds import TimedCell, TimedRound, round_columns
from vibench.stages.assembly import AssemblyStage
from vibench.stages.base import Failed, Items, ItemwiseStage, Row, Stage, Watch, build_problem
from vibench.stages.cell_queries import CellQueries
from vibench.stages.formulations.queries import FormulationModels, FormulationQueries
from vibench.stages.judging.cell_goal import CellGoal
from vibench.stages.query import Queries
from vibench.stages.snapshots import TimedSnapshots, gather
from vibench.storage.artefacts import Store
from vibench.timing import NO_TIME, Seconds, calibration, timed

SHARE = 3
"""A round takes a third of the queries of a cell, another one each time: short rounds interleave more closely."""

ROUND_SECONDS = 5.0
"""Wall seconds of the solver after which a cell's part of a round ends."""


HIGH_FIDELITY_SECONDS = 0.02
"""CPU seconds of high-fidelity solutions after which their part of a round ends."""


@dataclass(frozen=True)
class TimingRounds(ItemwiseStage):
    """One block of rounds of cells that are compared and of the high-fidelity model; a item is a round of one of them.

    A disturbance of the machine that lasts longer than a round meets all alike. Their order is another one in each
    round. The value is a `TimedCell` per cell, then that of the high-fidelity model.
    """

    label = "timing"

    cells: tuple[CellGoal, ...]
    queries: tuple[tuple[int, ...], ...]
    """The queries of every cell that are ok."""
    rounds: int
    first: int = 0
    """Number of the first one of its rounds: those of earlier blocks come before."""
    session: int = 0
    """Blocks of a later session are timed in processes that have timed none of an earlier one."""

    @property
    def items(self) -> int:
        """One for each round of each cell, and of the high-fidelity model."""
        return self.rounds * self.competitors

    @property
    def competitors(self) -> int:
        """The cells and the high-fidelity model, which is the last one."""
        return len(self.cells) + 1

    @property
    def weight(self) -> int:
        """It works for all of its cells."""
        return self.competitors

    @property
    def solutions(self) -> tuple[Stage, ...]:
        """The stages of the high-fidelity solutions at the validation parameters."""
        return self.cells[0].validation

    def inputs(self) -> tuple[Stage, ...]:
        """The models and the programs of the cells, and the solutions that high-fidelity ones start from."""
        read = [stage for cell in self.cells for stage in cell.timed_inputs]
        return tuple(dict.fromkeys((*read, *self.solutions)))

    def place(self, item: int) -> tuple[int, int]:
        """The round of the block, and the competitor, of a item."""
        number, within = divmod(item, self.competitors)
        return number, int(_order(self.first + number, self.competitors)[within])

    def stage_of(self, number: int) -> Stage:
        """The cell of a item: processes take turns where its plugins are of other packages than the next one's."""
        return (*self.cells, self.solutions[0])[self.place(number)[1]]

    def begin(self, store: Store) -> _Rounds:
        """Models are loaded when they are first needed; cells that differ in their solver alone share one."""
        return _Rounds(self, store)


@lru_cache(maxsize=2)
def _order(number: int, cells: int) -> Indices:
    """The order of the cells in a round."""
    return np.random.default_rng(number).permutation(cells)


class _Rounds(Items):
    """Rounds in progress."""

    def __init__(self, stage: TimingRounds, store: Store) -> None:
        self._stage, self._store = stage, store
        self._models: dict[str, Queries] = {}
        self._formulations: dict[str, FormulationModels] = {}
        self._certificates: dict[str, OnlineCertificate] = {}
        self._factors: dict[str, Assemblies] = {}
        self._warm: set[int] = set()
        self._forms: dict[tuple[int, int], tuple[VariationalInequality, Seconds]] = {}
        self._slowdown: float | None = None

    @cached_property
    def _reference(self) -> TimedSnapshots:
        return gather(self._store, self._stage.solutions)

    @cached_property
    def _parts(self) -> tuple[tuple[int, ...], ...]:
        """The validation parameters that the rounds of a block take in turn."""
        return parts_alike([seconds.cpu for seconds in self._reference.seconds], SHARE)

    @cached_property
    def _marginal(self) -> MarginalSolutions:
        one = self._stage.cells[0]
        return MarginalSolutions(build_problem(one.problem), self._reference, one.validation_set.seed)

    def item(self, number: int, watch: Watch) -> TimedRound:
        """One round of one cell, after a warm-up if it is the cell's first one in this process."""
        within, cell = self._stage.place(number)
        at, before = self._stage.first + within, self._slowdown
        timed_round = self._solutions if cell == len(self._stage.cells) else partial(self._round, cell, watch)
        if cell not in self._warm:
            timed_round(at, warm_up=True)
            self._warm.add(cell)
            before = None
        before = calibration().slowdown() if before is None else before
        assemble, solve, certify = timed_round(at)
        self._slowdown = calibration().slowdown()
        return TimedRound(assemble, solve, max(before, self._slowdown), certify)

    def _solutions(
        self, at: int, *, warm_up: bool = False
    ) -> tuple[dict[int, Seconds], dict[int, Seconds], dict[int, Seconds]]:
        """Seconds of high-fidelity solutions of a round, or of one to warm up.

        Where they are too long for all parameters of the round, what the sweep took says how many the others stand for.
        """
        part, sweep = self._parts[at % SHARE] or self._parts[0], [s.cpu for s in self._reference.seconds]
        shift = at // SHARE % len(part)  # another one in every block
        solve: dict[int, Seconds] = {}
        for k in [*part[shift:], *part[:shift]][: 1 if warm_up else None]:
            solve[k] = self._marginal.seconds(k, at, int(warm_up))
            if sum(seconds.cpu for seconds in solve.values()) > HIGH_FIDELITY_SECONDS:
                break
        share = float(np.mean([sweep[k] for k in part]) / np.mean([sweep[k] for k in solve]))
        return {}, {k: Seconds(share * seconds.cpu, share * seconds.wall) for k, seconds in solve.items()}, {}

    def _round(
        self, cell: int, watch: Watch, at: int, *, warm_up: bool = False
    ) -> tuple[dict[int, Seconds], dict[int, Seconds], dict[int, Seconds]]:
        """Seconds of assembly, solution, certificate and correction of the cell's queries, or of one to warm up.

        What is timed is equivalent to the queries and nowhere the same: nothing is gained by remembering it.
        """
        stage, fine = self._stage.cells[cell], self._stage.queries[cell]
        mine = [k for k in fine if k in self._parts[at % SHARE]] or [fine[at % len(fine)]]
        order = mine[: 1 if warm_up else None]
        solve: dict[int, Seconds] = {}
        certify: dict[int, Seconds] = {}
        if isinstance(stage, FormulationQueries):
            return self._formulated(stage, order, watch, at, cell, int(warm_up))
        assert isinstance(stage, CellQueries)
        queries = self._queries(stage.assembly)
        assemble = self._assemblies(queries, order, at, cell, stage, warm_up=warm_up)
        for k in order:
            seed = (stage.assembly.validation.seed, k, at, cell, int(warm_up))
            query = stage.query(queries, k).repeated(*seed)
            answer, solve[k] = query.prepare(watch)()
            query.check(answer)
            asked = stage.certificate is not None or stage.correction is not CorrectionMode.NONE
            if asked and answer.x is not None and answer.alpha is not None:
                near = queries.near(k, at, cell, int(warm_up))
                certify[k] = self._certified(stage, queries, near, (query.in_model(answer.x), answer.alpha))
            if sum(seconds.wall for seconds in solve.values()) > ROUND_SECONDS:
                break
        return assemble, solve, certify

    def _formulated(
        self, stage: FormulationQueries, order: Sequence[int], watch: Watch, *seed: int
    ) -> tuple[dict[int, Seconds], dict[int, Seconds], dict[int, Seconds]]:
        """Seconds of queries of a formulation, whose assembly is a part of the solution."""
        if stage.key not in self._formulations:
            self._formulations[stage.key] = FormulationModels(self._store, stage)
        solve: dict[int, Seconds] = {}
        for k in order:
            query = self._formulations[stage.key].query(k).repeated(*seed)
            answer, solve[k] = query.prepare(watch)()
            query.check(answer)
            if sum(seconds.wall for seconds in solve.values()) > ROUND_SECONDS:
                break
        return dict.fromkeys(solve, NO_TIME), solve, {}

    def _certified(self, stage: CellQueries, queries: Queries, near: Array, solution: tuple[Array, Array]) -> Seconds:
        """Seconds of the certificate of a solution at a parameter and of its correction, or of that in full."""
        model = queries.model
        if stage.certificate is None:
            kept = self._factors.setdefault(stage.assembly.key, Assemblies(model.problem, 0))
            vi, assembly = timed(lambda: checked_assembly(model.problem, near).copy())
            _, seconds = timed(partial(corrected_in_full, model, kept, near, vi, *solution))
            return assembly + seconds if isinstance(model, HyperReducedModel) else seconds
        key = stage.certificate.key
        if key not in self._certificates:
            self._certificates[key] = stage.certificate.certificate(self._store)
        assert isinstance(model, HyperReducedModel)  # it has a certificate
        given = model.problem, near, model.assemble(near), *solution
        return timed(partial(self._certificates[key].certify, *given, stage.correction))[1]

    def _queries(self, assembly: AssemblyStage) -> Queries:
        if assembly.key not in self._models:
            self._models[assembly.key] = Queries(self._store, assembly)
        return self._models[assembly.key]

    def _assemblies(
        self, queries: Queries, order: Sequence[int], at: int, cell: int, stage: CellQueries, *, warm_up: bool
    ) -> dict[int, Seconds]:
        """Seconds of the assembly of every query; in full, which costs the same at each parameter, of the first one.

        High-fidelity matrices are the same for all models: they are assembled once in a round.
        """
        model = queries.model
        if stage.compilation is not None:
            return dict.fromkeys(order, NO_TIME)  # it is part of the solution
        if isinstance(model, HyperReducedModel):
            return {k: timed(partial(model.assemble, queries.near(k, at, cell, int(warm_up))))[1] for k in order}
        k = order[0]
        if (at, k) not in self._forms:
            if not self._forms:
                checked_assembly(model.problem, queries.near(k, at, cell, 1))  # the warm-up
            vi, seconds = timed(partial(checked_assembly, model.problem, queries.near(k, at, cell, 0)))
            self._forms = {(at, k): (vi.copy(), seconds)}  # the next assembly may be written into the same arrays
        vi, forms = self._forms[at, k]
        return {k: forms + timed(partial(model.reduce, vi))[1]}

    def lost(self, number: int, failed: Failed) -> Failed:  # noqa: ARG002
        """A round without a result."""
        return failed

    def finish(self, items: Sequence[TimedRound | Failed]) -> tuple[TimedCell, ...]:
        """The rounds of every cell and of the high-fidelity model, in their order."""
        rounds: list[dict[int, TimedRound]] = [{} for _ in range(self._stage.competitors)]
        lost: list[list[Failed]] = [[] for _ in rounds]
        for number, outcome in enumerate(items):
            within, competitor = self._stage.place(number)
            if isinstance(outcome, Failed):
                lost[competitor].append(outcome)
            else:
                rounds[competitor][self._stage.first + within] = outcome
        return tuple(
            TimedCell(mine, machine(), len(gone), gone[0].reason if gone else "")
            for mine, gone in zip(rounds, lost, strict=True)
        )


def block_rows(stage: TimingRounds, timed: Sequence[TimedCell]) -> list[list[Row]]:
    """Rows of the timings table of every cell of a block, from its rounds and those of the high-fidelity model."""
    numbers = range(stage.first, stage.first + stage.rounds)
    seconds = np.array([[one.rounds[k].cpu if k in one.rounds else np.nan for k in numbers] for one in timed])
    pace, high_fidelity = dict(zip(numbers, paces(seconds), strict=True)), timed[-1].rounds
    block = stage.key.rpartition("-")[2]
    return [
        [
            {"block": block, "round": k, "queries": len(one.solve), "slowdown": one.slowdown, "pace": pace[k]}
            | {"hf_s": high_fidelity[k].cpu if k in high_fidelity else None}
            | round_columns(one)
            for k, one in cell.rounds.items()
        ]
        for cell in timed[:-1]
    ]
