"""Seconds of queries of several cells, each alternated with high-fidelity solutions, round by round."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from vibench.arrays import Array, Indices
from vibench.interfaces.validation import checked_assembly
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel
from vibench.offline.assemblies import Assemblies
from vibench.offline.correction import corrected_in_full
from vibench.provenance import machine
from vibench.results.paired_timing import beside, paces
from vibench.stages.artefacts import Store
from vibench.stages.base import Failed, Items, ItemwiseStage, Row, Stage, TimeLimit, build_problem
from vibench.stages.cell_queries import CellQueries
from vibench.stages.marginal_solutions import (
    ASSEMBLY_SEED,
    MarginalSolution,
    MarginalSolutions,
    SolutionsBeside,
    parts_alike,
)
from vibench.stages.query import ModelQuery, Queries
from vibench.stages.snapshots import TimedSnapshots, gather
from vibench.stages.timed_seconds import TimedCell, TimedRound, round_columns
from vibench.timing import NO_TIME, Seconds, calibration, timed

SHARE = 3
"""A round takes a third of the queries of a cell, another one each time: short rounds interleave more closely."""

ROUND_SECONDS = 5.0
"""Wall seconds of the solver after which a cell's part of a round ends."""

ASSEMBLY_SECONDS = 0.02
"""CPU seconds of assemblies in full after which no further one is timed in a cell's part of a round."""


@dataclass(frozen=True)
class TimingRounds(ItemwiseStage):
    """One block of rounds of cells that are compared; an item is a round of one of them.

    A cell's queries alternate with high-fidelity solutions, so that a disturbance of the machine meets both alike. The
    order of the cells is another one in each round. The value is a `TimedCell` per cell.
    """

    label = "timing"

    cells: tuple[CellQueries, ...]
    queries: tuple[tuple[int, ...], ...]
    """The queries of every cell that are ok."""
    rounds: int
    first: int = 0
    """Number of the first one of its rounds: those of earlier blocks come before."""
    session: int = 0
    """Blocks of a later session are timed in processes that have timed none of an earlier one."""

    @property
    def items(self) -> int:
        """One for each round of each cell."""
        return self.rounds * len(self.cells)

    @property
    def weight(self) -> int:
        """It works for all of its cells."""
        return len(self.cells)

    @property
    def solutions(self) -> tuple[Stage, ...]:
        """The stages of the high-fidelity solutions at the validation parameters."""
        return self.cells[0].validation

    def inputs(self) -> tuple[Stage, ...]:
        """The models and the programs of the cells, and the solutions that high-fidelity ones start from."""
        read = [stage for cell in self.cells for stage in cell.timed_inputs]
        return tuple(dict.fromkeys((*read, *self.solutions)))

    def place(self, item: int) -> tuple[int, int]:
        """The round of the block, and the cell, of an item."""
        number, within = divmod(item, len(self.cells))
        return number, int(_order(self.first + number, len(self.cells))[within])

    def stage_of(self, number: int) -> Stage:
        """The cell of an item: processes take turns where its plugins are of other packages than the next one's."""
        return self.cells[self.place(number)[1]]

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
        self._models: dict[tuple[str, float | None], Queries] = {}
        self._certificates: dict[str, OnlineCertificate] = {}
        self._factors: dict[str, Assemblies] = {}
        self._warm: set[int] = set()
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

    @cached_property
    def _beside(self) -> SolutionsBeside:
        return SolutionsBeside(self._marginal, [seconds.cpu for seconds in self._reference.seconds])

    def run_item(self, number: int, time_limit: TimeLimit) -> TimedRound:
        """One round of one cell, after a warm-up if it is the cell's first one in this process."""
        within, cell = self._stage.place(number)
        at, before = self._stage.first + within, self._slowdown
        if cell not in self._warm:
            self._queries_of(time_limit, self._warming_up(cell, at), at, cell, 1)
            self._warm.add(cell)
            before = None
        before = calibration().slowdown() if before is None else before
        part = self._parts[at % SHARE] or self._parts[0]
        solutions: list[MarginalSolution] = []
        alternated = self._beside.alternated(self._order(cell, at, part), solutions, at, cell)
        assemble, solve, certify = self._queries_of(time_limit, alternated, at, cell, 0)
        self._slowdown = calibration().slowdown()
        return TimedRound(assemble, solve, max(before, self._slowdown), certify, self._beside.seconds(solutions, part))

    def _order(self, cell: int, at: int, part: Sequence[int]) -> Sequence[int]:
        """The queries of a cell in a round; the first one is another one in every block, and for the next cell.

        Solutions at some parameters stand for all by the seconds of the sweep, whose errors should differ by cell.
        """
        fine = self._stage.queries[cell]
        mine = [k for k in fine if k in part] or [fine[at % len(fine)]]
        shift = (at // SHARE + cell) % len(mine)
        return [*mine[shift:], *mine[:shift]]

    def _warming_up(self, cell: int, at: int) -> Iterator[tuple[int, MarginalSolution]]:
        """One query with an assembly before it, and a solution in a process that has made none: it does the set-up."""
        k = self._stage.queries[cell][0]
        yield k, self._marginal.assemble(k, at, cell) if self._warm else self._marginal.solve(k, at, cell, 1)

    def _queries_of(
        self,
        time_limit: TimeLimit,
        alternated: Iterator[tuple[int, MarginalSolution | None]],
        at: int,
        cell: int,
        warm_up: int,
    ) -> tuple[dict[int, Seconds], dict[int, Seconds], dict[int, Seconds]]:
        """Seconds of assembly, solution, certificate and correction of queries, each with the solution before it.

        What is timed is equivalent to the queries and nowhere the same: nothing is gained by remembering it.
        """
        stage, seed = self._stage.cells[cell], (at, cell, warm_up)
        assemble: dict[int, Seconds] = {}
        solve: dict[int, Seconds] = {}
        certify: dict[int, Seconds] = {}
        queries = self._queries(stage)
        certified = stage.certificate is not None or stage.correction is not CorrectionMode.NONE
        for k, solution in alternated:
            query, near = stage.query(queries, k), queries.near(k, *seed)
            if isinstance(query, ModelQuery):
                query = query.repeated(*seed)
                assemble[k] = NO_TIME  # it is part of the solution
            else:
                further = partial(self._marginal.assemble, k, at, cell, ASSEMBLY_SEED + warm_up)
                seconds = _assembly(queries.model.reduced, near, solution, further, assemble)
                assemble |= {} if seconds is None else {k: seconds}
                query = query.repeated(stage.validation_set.seed, k, *seed)
            answer, solve[k] = query.prepare(time_limit)()
            query.check(answer)  # type: ignore[arg-type]  # what `prepare` has made
            if certified and answer.x is not None and answer.alpha is not None:
                certify[k] = self._certified(stage, queries, near, (query.in_model(answer.x), answer.alpha))
            if sum(seconds.wall for seconds in solve.values()) > ROUND_SECONDS:
                break
        return assemble, solve, certify

    def _certified(self, stage: CellQueries, queries: Queries, near: Array, solution: tuple[Array, Array]) -> Seconds:
        """Seconds of the certificate of a solution at a parameter and of its correction, or of that in full."""
        model = queries.model.reduced
        if stage.certificate is None:
            kept = self._factors.setdefault(stage.built.key, Assemblies(model.problem, 0))
            vi, assembly = timed(lambda: checked_assembly(model.problem, near).copy())
            _, seconds = timed(partial(corrected_in_full, model, kept, near, vi, *solution))
            return assembly + seconds if isinstance(model, HyperReducedModel) else seconds
        key = stage.certificate.key
        if key not in self._certificates:
            self._certificates[key] = stage.certificate.certificate(self._store)
        assert isinstance(model, HyperReducedModel)  # it has a certificate
        given = model.problem, near, model.assemble(near), *solution
        return timed(partial(self._certificates[key].certify, *given, stage.correction))[1]

    def _queries(self, stage: CellQueries) -> Queries:
        key = stage.model, stage.accuracy
        if key not in self._models:
            self._models[key] = stage.queries(self._store)
        return self._models[key]

    def failed(self, number: int, failed: Failed) -> Failed:  # noqa: ARG002
        """A round without a result."""
        return failed

    def collect(self, items: Sequence[TimedRound | Failed]) -> tuple[TimedCell, ...]:
        """The rounds of every cell, in their order."""
        rounds: list[dict[int, TimedRound]] = [{} for _ in self._stage.cells]
        lost: list[list[Failed]] = [[] for _ in rounds]
        for number, outcome in enumerate(items):
            within, cell = self._stage.place(number)
            if isinstance(outcome, Failed):
                lost[cell].append(outcome)
            else:
                rounds[cell][self._stage.first + within] = outcome
        return tuple(
            TimedCell(mine, machine(), len(gone), gone[0].reason if gone else "")
            for mine, gone in zip(rounds, lost, strict=True)
        )


def _assembly(
    model: AnyReducedModel,
    near: Array,
    solution: MarginalSolution | None,
    further: Callable[[], MarginalSolution],
    done: Mapping[int, Seconds],
) -> Seconds | None:
    """Seconds of the assembly of a query, `None` where it is not timed.

    In full it costs the same at each parameter: some assemblies stand for all, those of the high-fidelity solutions and
    `further` ones until they are enough.
    """
    if isinstance(model, HyperReducedModel):
        return timed(partial(model.assemble, near))[1]
    if sum(seconds.cpu for seconds in done.values()) > ASSEMBLY_SECONDS:
        return None
    assembled = solution or further()
    return assembled.assembly + timed(partial(model.reduce, assembled.vi))[1]


def block_rows(stage: TimingRounds, timed: Sequence[TimedCell]) -> list[list[Row]]:
    """Rows of the timings table of every cell of a block, from its rounds."""
    numbers = range(stage.first, stage.first + stage.rounds)
    rounds, nothing = [[one.rounds.get(k) for k in numbers] for one in timed], (np.nan, np.nan)
    measured = np.array([[(one.cpu, one.beside_cpu) if one else nothing for one in cell] for cell in rounds])
    queries, solutions = measured[:, :, 0], measured[:, :, 1]
    pace = paces(np.vstack([queries, solutions]))
    high_fidelity, at = beside(solutions, pace), dict(zip(numbers, map(float, pace), strict=True))
    block = stage.key.rpartition("-")[2]
    return [
        [
            {"block": block, "round": k, "queries": len(one.solve), "slowdown": one.slowdown, "pace": at[k]}
            | {"hf_s": None if np.isnan(high_fidelity) else high_fidelity * at[k]}
            | round_columns(one)
            for k, one in cell.rounds.items()
        ]
        for cell in timed
    ]
