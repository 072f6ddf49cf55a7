"""Seconds of queries, timed in rounds as docs/measurement.md says, and of offline stages that are timed again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from statistics import fmean, median

import numpy as np

from vibench.arrays import Array, Indices
from vibench.interfaces.formulations import FormulationAnswer
from vibench.interfaces.validation import checked_assembly
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel
from vibench.offline.assemblies import Assemblies
from vibench.offline.solution import corrected_in_full
from vibench.provenance import machine
from vibench.results.break_even import is_repeated, offline_factor
from vibench.results.paired_timing import beside, blocks_of, mean_seconds, paces
from vibench.stages.artefacts import Store
from vibench.stages.base import Failed, Items, ItemwiseStage, Result, Row, Stage, TimeLimit, build_problem
from vibench.stages.cell_queries import CellQueries
from vibench.stages.marginal_solutions import MarginalSolution, MarginalSolutions, SolutionsBeside, parts_alike
from vibench.stages.query import ModelQuery, Queries
from vibench.stages.snapshots import gather
from vibench.timing import NO_TIME, Seconds, calibration, is_disturbed, timed

# A round takes a third of the queries of a cell, another one each time: short rounds interleave more closely.
QUERY_SUBSETS = 3
# CPU seconds of full assemblies after which no further one is timed in a cell's part of a round.
ASSEMBLY_SECONDS = 0.01


@dataclass(frozen=True)
class TimedRound:
    """One round of one cell."""

    # `assemble`, `solve`, `certify`: seconds of assembly, solver and certificate by the number of the query. A full
    # assembly is timed for some of the queries, which count for all.
    assemble: Mapping[int, Seconds]
    solve: Mapping[int, Seconds]
    slowdown: float  # slowdown of the calibration before or after it, whichever is larger
    certify: Mapping[int, Seconds] = field(default_factory=dict)
    # Mean seconds of the high-fidelity solutions beside the queries, their assembly included.
    beside: Seconds | None = None
    # Seconds of `reconstruct`, those that count in `solve`, too.
    reconstruct: Mapping[int, Seconds] = field(default_factory=dict)

    @property
    def cpu(self) -> float:
        """CPU seconds of a query, mean over those of the round."""
        return float(round_columns(self)["total_s"])

    @property
    def beside_cpu(self) -> float:
        """CPU seconds of a high-fidelity solution; NaN without one."""
        return np.nan if self.beside is None else self.beside.cpu


@dataclass(frozen=True)
class TimedCell:
    """The rounds of one cell by their number, the machine that timed them, and the failures of missing rounds."""

    rounds: Mapping[int, TimedRound]
    machine: str
    failures: tuple[Failed, ...] = ()


@dataclass(frozen=True)
class TimingRounds(ItemwiseStage):
    """One block of rounds of cells that are compared; an item is a round of one of them."""

    # A cell's queries alternate with high-fidelity solutions, so that a disturbance of the machine affects both alike.
    # The order of the cells changes from round to round. The value is a `TimedCell` per cell.

    label = "timing"

    cells: tuple[CellQueries, ...]
    queries: tuple[tuple[int, ...], ...]  # the queries of every cell that are ok
    # `rounds`, `first`: number of rounds, and number of the first one: those of earlier blocks come before.
    rounds: int
    first: int
    session: int = 0  # blocks of a later session are timed in processes that have timed none of an earlier one

    @property
    def items(self) -> int:
        return self.rounds * len(self.cells)

    @property
    def weight(self) -> int:
        # The limit of seconds is for each of its cells.
        return len(self.cells)

    def inputs(self) -> tuple[Stage, ...]:
        # Timed queries read models and programs only; their answers were assessed before.
        read = [stage for cell in self.cells for stage in cell.model_inputs]
        return tuple(dict.fromkeys((*read, *self.cells[0].validation)))

    def place(self, item: int) -> tuple[int, int]:
        """The round of the block, and the cell, of an item."""
        number, within = divmod(item, len(self.cells))
        return number, int(_order(self.first + number, len(self.cells))[within])

    def stage_of(self, number: int) -> Stage:
        """The cell of an item: another process takes over where its plugins belong to other packages."""
        return self.cells[self.place(number)[1]]

    def begin(self, store: Store) -> _Rounds:
        return _Rounds(self, store)


@lru_cache(maxsize=2)
def _order(number: int, cells: int) -> Indices:
    """The order of the cells in a round."""
    return np.random.default_rng(number).permutation(cells)


class _Rounds(Items):
    """Rounds in progress. Models are loaded at their first query; cells that differ only in their solver share one."""

    def __init__(self, stage: TimingRounds, store: Store) -> None:
        self._stage, self._store = stage, store
        self._models: dict[tuple[str, float | None], Queries] = {}
        self._certificates: dict[str, OnlineCertificate] = {}
        self._factors: dict[str, Assemblies] = {}
        self._warm: set[int] = set()
        self._slowdown: float | None = None

    @cached_property
    def _beside(self) -> SolutionsBeside:
        one = self._stage.cells[0]
        reference = gather(self._store, one.validation)
        marginal = MarginalSolutions(build_problem(one.problem), reference, one.validation_set.seed)
        return SolutionsBeside(marginal, [seconds.cpu for seconds in reference.seconds])

    def run_item(self, number: int, time_limit: TimeLimit) -> TimedRound:
        within, cell = self._stage.place(number)
        at, before = self._stage.first + within, self._slowdown
        # Warm up with one query: the first one of a process loads, compiles and allocates.
        if cell not in self._warm:
            k = self._stage.queries[cell][0]
            # A process that has made no high-fidelity solution makes one, which does the set-up; others assemble.
            marginal = self._beside.marginal
            solution = marginal.assemble(k, at, cell) if self._warm else marginal.solve(k, at, cell, 1)
            self._time_queries(time_limit, [(k, solution)], at, cell, 1)
            self._warm.add(cell)
            before = None
        # The calibration after a round counts for the next one, unless a warm-up is between them.
        before = calibration().slowdown() if before is None else before
        # The rounds of a block take parts of the validation parameters in turn.
        parts = parts_alike(self._beside.sweep, QUERY_SUBSETS)
        part = parts[at % QUERY_SUBSETS] or parts[0]
        solutions: list[MarginalSolution] = []
        alternated = self._beside.alternated(self._order(cell, at, part), solutions, at, cell)
        assemble, solve, certify, reconstruct = self._time_queries(time_limit, alternated, at, cell, 0)
        self._slowdown, spent = calibration().slowdown(), self._beside.seconds(solutions, part)
        return TimedRound(assemble, solve, max(before, self._slowdown), certify, spent, reconstruct)

    def _order(self, cell: int, at: int, part: Sequence[int]) -> Sequence[int]:
        fine = self._stage.queries[cell]
        mine = [k for k in fine if k in part] or [fine[at % len(fine)]]
        # Solutions at a few parameters are scaled to all by the seconds of the sweep. Start elsewhere in every block
        # and for every cell, so that the errors of this scaling differ.
        shift = (at // QUERY_SUBSETS + cell) % len(mine)
        return [*mine[shift:], *mine[:shift]]

    def _time_queries(
        self, time_limit: TimeLimit, alternated: Iterable[tuple[int, MarginalSolution | None]], at: int, cell: int,
        warm_up: int,
    ) -> tuple[dict[int, Seconds], ...]:  # fmt: skip
        """Seconds of assembly, solution, certificate and reconstruction of queries; `warm_up` is part of the seeds."""
        # Every repetition is perturbed, so that a caching solver or problem cannot be timed on a cache hit.
        stage, seed = self._stage.cells[cell], (at, cell, warm_up)
        assemble, solve, certify, reconstruct = (dict[int, Seconds]() for _ in range(4))
        queries = self._queries(stage)
        certified = stage.certificate is not None or stage.correction is not CorrectionMode.NONE
        for k, solution in alternated:
            query, near = stage.query(queries, k), queries.near(k, *seed)
            if isinstance(query, ModelQuery):
                query = query.repeated(*seed)
                # The assembly is part of the solution.
                assemble[k] = NO_TIME
            else:
                # Seeds below 5 are those of queries and of the at most two solutions.
                further = partial(self._beside.marginal.assemble, k, at, cell, 5 + warm_up)
                seconds = _assembly(queries.model.reduced, near, solution, further, assemble)
                assemble |= {} if seconds is None else {k: seconds}
                query = query.repeated(stage.validation_set.seed, k, *seed)
            answer, solve[k] = query.prepare(time_limit)()
            judged = query.check(answer)  # type: ignore[arg-type]  # what `prepare` has made
            if judged is not None and judged.reconstruction is not None:
                reconstruct[k] = judged.reconstruction
                solve[k] += judged.counted
            if certified and answer.x is not None and answer.alpha is not None:
                certify[k] = self._certified(stage, queries, near, query.in_model(answer.x), answer.alpha)
            # A slow solver ends its part of a round after 5 s, so that the cells keep alternating.
            if sum(seconds.wall for seconds in solve.values()) > 5.0:
                break
        return assemble, solve, certify, reconstruct

    def _certified(self, stage: CellQueries, queries: Queries, near: Array, x: Array, alpha: Array) -> Seconds:
        """Seconds of the certificate and the correction of a solution at a parameter."""
        model = queries.model.online.reduced
        # Without certificate the correction takes high-fidelity matrices, which a full assembly has made already.
        if stage.certificate is None:
            factors = self._factors.setdefault(stage.built.key, Assemblies(model.problem))
            vi, assembly = timed(lambda: checked_assembly(model.problem, near).copy())
            _, seconds = timed(partial(corrected_in_full, model, factors, near, vi, x, alpha))
            return assembly + seconds if isinstance(model, HyperReducedModel) else seconds
        key = stage.certificate.key
        if key not in self._certificates:
            self._certificates[key] = stage.certificate.certificate(self._store)
        assert isinstance(model, HyperReducedModel)  # others have no certificates
        if not stage.built.kind.has_program:
            given = queries.model.online.coordinates(near, FormulationAnswer(x, alpha))
        else:
            given = model.assemble(near), x, alpha
        query = model.problem, near, *given
        return timed(partial(self._certificates[key].certify, *query, stage.correction))[1]

    def _queries(self, stage: CellQueries) -> Queries:
        key = stage.model, stage.accuracy
        if key not in self._models:
            self._models[key] = stage.queries(self._store)
        return self._models[key]

    def collect(self, items: Sequence[TimedRound | Failed]) -> tuple[TimedCell, ...]:
        rounds: list[dict[int, TimedRound]] = [{} for _ in self._stage.cells]
        failures: list[list[Failed]] = [[] for _ in rounds]
        for number, outcome in enumerate(items):
            within, cell = self._stage.place(number)
            if isinstance(outcome, Failed):
                failures[cell].append(outcome)
            else:
                rounds[cell][self._stage.first + within] = outcome
        return tuple(TimedCell(mine, machine(), tuple(missing)) for mine, missing in zip(rounds, failures, strict=True))


def _assembly(
    model: AnyReducedModel, near: Array, solution: MarginalSolution | None, further: Callable[[], MarginalSolution],
    done: Mapping[int, Seconds],
) -> Seconds | None:  # fmt: skip
    """Seconds of the assembly of a query, `None` where it is not timed."""
    if isinstance(model, HyperReducedModel):
        return timed(partial(model.assemble, near))[1]
    # A full assembly costs the same at every parameter: a few count for all.
    if sum(seconds.cpu for seconds in done.values()) > ASSEMBLY_SECONDS:
        return None
    # The high-fidelity solution before the query was assembled at another parameter at the same cost.
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


def round_columns(one: TimedRound) -> Row:
    """Seconds of the parts of a query and of the whole, means over the queries of a round."""
    parts = one.assemble, one.solve, one.certify, one.reconstruct
    return _columns(*(_of_all(fmean, part.values()) for part in parts))


def _of_all(average: Callable[[Sequence[float]], float], parts: Iterable[Seconds]) -> Array | None:
    every = [(seconds.cpu, seconds.wall) for seconds in parts]
    return np.array([average(column) for column in zip(*every, strict=True)]) if every else None


def _columns(assemble: Array | None, solve: Array | None, certify: Array | None, reconstruct: Array | None) -> Row:
    """The columns that rounds and queries share, from CPU and wall seconds of the parts of a query (2,)."""
    parts = {"assemble_s": assemble, "solve_s": solve, "certify_s": certify}
    total, wall = sum((part for part in parts.values() if part is not None), np.zeros(2))
    seconds = {name: None if part is None else part[0] for name, part in parts.items()}
    own = None if reconstruct is None else reconstruct[0]
    return seconds | {"reconstruct_s": own, "total_s": total, "total_wall_s": wall}


def seconds_of_cell(rows: Sequence[Row]) -> Row:
    """The columns of a cell from its rounds; empty without any."""

    def middle(name: str) -> float | None:
        known = [row[name] for row in rows if row[name] is not None]
        return float(np.median(known)) if known else None

    low, high = np.quantile([row["total_s"] for row in rows], (0.25, 0.75)) if rows else (None, None)
    # Geometric means over the blocks of medians over their rounds: the quotient of the two is the paired one.
    online, high_fidelity = mean_seconds(blocks_of(rows).values()) if rows else (None, None)
    slowdown, parts = middle("slowdown"), ("assemble_s", "solve_s", "certify_s", "reconstruct_s")
    return {
        "online_s": online, "online_q1_s": low, "online_q3_s": high, "online_wall_s": middle("total_wall_s"),
        **{f"online_{name}": middle(name) for name in parts},
        "slowdown": slowdown, "disturbed": None if slowdown is None else int(is_disturbed(slowdown)),
    } | ({} if high_fidelity is None else {"hf_s": high_fidelity})  # fmt: skip


def seconds_of_queries(rounds: Sequence[TimedRound]) -> dict[int, Row]:
    """The columns of the queries that were timed: medians over the rounds."""
    rows = {}
    for k in sorted({k for one in rounds for k in one.solve}):
        # A full assembly is not timed for each query of a round: take the seconds of another one.
        assembled = [one.assemble[k] if k in one.assemble else next(iter(one.assemble.values())) for one in rounds]
        solved = [one.solve[k] for one in rounds if k in one.solve]
        certified = [one.certify[k] for one in rounds if k in one.certify]
        reconstructed = [one.reconstruct[k] for one in rounds if k in one.reconstruct]
        rows[k] = _columns(*(_of_all(median, parts) for parts in (assembled, solved, certified, reconstructed)))
    return rows


@dataclass(frozen=True)
class OfflineRepeat(Stage):
    """A stage that was run before, timed again; the value is CPU and wall seconds by the name of what has them."""

    label = "offline repeat"

    stage: Stage
    number: int

    @property
    def kind_of_work(self) -> str:
        # A repeat takes about as long as the stage itself.
        return self.stage.kind_of_work

    def inputs(self) -> tuple[Stage, ...]:
        return self.stage.inputs()

    def run(self, store: Store) -> Result:
        return Result({name: [spent.cpu, spent.wall] for name, spent in self.stage.measure(store).items()})

    def seconds(self, store: Store, name: str) -> Seconds | None:
        artefact = store.get(self.key)
        return None if artefact is None else Seconds(*artefact.value[name])


def offline_columns(cell: CellQueries, setup: float, runs: Mapping[str, Sequence[Seconds]], deviation: float) -> Row:
    """The offline columns of a cell from the `runs` of its stages by key, one `setup`, and the `scatter` of one run."""
    columns: Row = {}
    times, seconds = list[int](), list[float]()
    for phase, stages in cell.offline_stages.items():
        mine = [runs[stage.key] for stage in stages]
        typical = [float(np.median([one.cpu for one in some])) for some in mine]
        columns[f"offline_{phase}_s"] = sum(typical) + (setup if phase == "snapshots" else 0.0)
        times += map(len, mine)
        seconds += typical
    total = sum(columns.values())
    # Mean number of runs, weighted by seconds. The interval assumes that all stages deviate alike, as by the speed of
    # the machine; a sum of stages that deviate independently scatters less.
    often = float(np.average(times, weights=seconds)) if sum(seconds) else 1.0
    factor = offline_factor(deviation / float(np.sqrt(often)))
    repeats = sum(is_repeated(count, spent) for count, spent in zip(times, seconds, strict=True))
    ends = {"offline_low_s": total / factor, "offline_high_s": total * factor}
    return columns | {"offline_s": total, **ends, "offline_repeats": repeats}


def sources(cell: CellQueries) -> Iterator[Stage]:
    """The stages whose work takes the offline seconds of a cell."""
    return (stage.measured_by[0] for stages in cell.offline_stages.values() for stage in stages)
