"""Seconds of the queries of several cells, measured interleaved: a round over all cells, then the next round."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

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
from vibench.qp.repeats import check_answer
from vibench.stages.assembly import AssemblyStage
from vibench.stages.base import Failed, Items, ItemwiseStage, Row, Stage, value_of
from vibench.stages.cell_queries import CellQueries
from vibench.stages.query import Queries, Watch
from vibench.storage.artefacts import Store
from vibench.timing import DISTURBED, NO_TIME, WAITED, Seconds, calibration, timed

SHARE = 4
"""A round takes every fourth query of a cell, another quarter each time: short rounds interleave more closely."""

ROUND_SECONDS = 5.0
"""Wall seconds of the solver after which a cell's part of a round ends."""


SPREAD = (0.025, 0.975)
"""Quantiles of the slowdowns of a cell's rounds: what is timed once may have met any of them."""

CELL_SECONDS = (
    "online_s", "online_q1_s", "online_q3_s", "online_wall_s", "online_assemble_s", "online_solve_s",
    "online_certify_s", "slowdown", "disturbed", "offline_low_s", "offline_high_s",
)  # fmt: skip
"""Columns of a cell that follow from its rounds."""


@dataclass(frozen=True)
class TimedRound:
    """One round of one cell: seconds of its queries by their number, and how slow the machine was beside them."""

    assemble: Mapping[int, Seconds]
    """Seconds of the assembly; in full, of one query, which counts for all."""
    solve: Mapping[int, Seconds]
    slowdown: float
    """Slowdown of the calibration before or after it, whichever is larger."""
    certify: Mapping[int, Seconds] = field(default_factory=dict)
    """Seconds of the certificate; nothing without one."""


@dataclass(frozen=True)
class TimedCell:
    """The rounds of one cell, the machine that timed them, and why rounds are missing, or ""."""

    rounds: tuple[TimedRound, ...]
    machine: str
    reason: str


@dataclass(frozen=True)
class TimingRounds(ItemwiseStage):
    """Timing of the queries of cells that are compared; a item is one round of one cell.

    A disturbance of the machine that lasts longer than a round meets all cells alike. The order of the cells is another
    one in each round. The value is a `TimedCell` per cell.
    """

    label = "timing"

    cells: tuple[CellQueries, ...]
    queries: tuple[tuple[int, ...], ...]
    """The queries of every cell that are ok."""
    rounds: int

    @property
    def items(self) -> int:
        """One for each round of each cell."""
        return self.rounds * len(self.cells)

    @property
    def weight(self) -> int:
        """It works for all of its cells."""
        return len(self.cells)

    def inputs(self) -> tuple[Stage, ...]:
        """The models and the programs of the cells."""
        read = [stage for cell in self.cells for stage in (*cell.assembly.model_inputs, cell.assembly)]
        read += [stage for cell in self.cells for stage in (cell.certificate, cell.compilation) if stage is not None]
        return tuple(dict.fromkeys(read))

    def place(self, item: int) -> tuple[int, int]:
        """The round and the cell of a item."""
        number, within = divmod(item, len(self.cells))
        return number, int(_order(number, len(self.cells))[within])

    def stage_of(self, number: int) -> CellQueries:
        """The cell of a item: processes take turns where its plugins are of other packages than the next one's."""
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
        self._models: dict[str, Queries] = {}
        self._certificates: dict[str, OnlineCertificate] = {}
        self._factors: dict[str, Assemblies] = {}
        self._warm: set[int] = set()
        self._forms: dict[tuple[int, int], tuple[VariationalInequality, Seconds]] = {}

    def item(self, number: int, watch: Watch) -> TimedRound:
        """One round of one cell, after a warm-up if it is the cell's first one in this process."""
        at, cell = self._stage.place(number)
        if cell not in self._warm:
            self._round(at, cell, watch, warm_up=True)
            self._warm.add(cell)
        before = calibration().slowdown()
        assemble, solve, certify = self._round(at, cell, watch)
        return TimedRound(assemble, solve, max(before, calibration().slowdown()), certify)

    def _round(
        self, at: int, cell: int, watch: Watch, *, warm_up: bool = False
    ) -> tuple[dict[int, Seconds], dict[int, Seconds], dict[int, Seconds]]:
        """Seconds of assembly, solution, certificate and correction of the cell's queries, or of one to warm up.

        What is timed is equivalent to the queries and nowhere the same: nothing is gained by remembering it.
        """
        stage = self._stage.cells[cell]
        queries, fine = self._queries(stage.assembly), self._stage.queries[cell]
        share = min(SHARE, len(fine))
        order = fine[at % share :: share][: 1 if warm_up else None]
        assemble = self._assemblies(queries, order, at, cell, warm_up=warm_up)
        solve: dict[int, Seconds] = {}
        certify: dict[int, Seconds] = {}
        for k in order:
            seed = (stage.assembly.validation.seed, k, at, cell, int(warm_up))
            query = stage.query(queries, k).repeated(*seed)
            answer, solve[k] = query.prepare(watch)()
            check_answer(query.program, answer, query.accuracy)
            asked = stage.certificate is not None or stage.correction is not CorrectionMode.NONE
            if asked and answer.x is not None and answer.alpha is not None:
                near = queries.near(k, at, cell, int(warm_up))
                certify[k] = self._certified(stage, queries, near, (query.in_model(answer.x), answer.alpha))
            if sum(seconds.wall for seconds in solve.values()) > ROUND_SECONDS:
                break
        return assemble, solve, certify

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
            self._certificates[key] = value_of(self._store, stage.certificate)
        assert isinstance(model, HyperReducedModel)  # it has a certificate
        given = model.problem, near, model.assemble(near), *solution
        return timed(partial(self._certificates[key].certify, *given, stage.correction))[1]

    def _queries(self, assembly: AssemblyStage) -> Queries:
        if assembly.key not in self._models:
            self._models[assembly.key] = Queries(self._store, assembly)
        return self._models[assembly.key]

    def _assemblies(
        self, queries: Queries, order: Sequence[int], at: int, cell: int, *, warm_up: bool
    ) -> dict[int, Seconds]:
        """Seconds of the assembly of every query; in full, which costs the same at each parameter, of the first one.

        High-fidelity matrices are the same for all models: they are assembled once in a round.
        """
        model = queries.model
        if self._stage.cells[cell].compilation is not None:
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
        """The rounds of every cell, in their order."""
        rounds: list[list[TimedRound]] = [[] for _ in self._stage.cells]
        lost: list[list[Failed]] = [[] for _ in self._stage.cells]
        for number, outcome in enumerate(items):
            cell = self._stage.place(number)[1]
            if isinstance(outcome, Failed):
                lost[cell].append(outcome)
            else:
                rounds[cell].append(outcome)
        reasons = [f"{len(gone)} of {self._stage.rounds} rounds: {gone[0].reason}" if gone else "" for gone in lost]
        return tuple(TimedCell(tuple(f), machine(), reason) for f, reason in zip(rounds, reasons, strict=True))


def round_rows(rounds: Sequence[TimedRound]) -> list[Row]:
    """Rows of the timings table: seconds of a query, mean over the queries of the round."""
    return [
        {"round": number, "queries": len(one.solve), "slowdown": one.slowdown}
        | _columns(*(_of_all(np.mean, parts.values()) for parts in (one.assemble, one.solve, one.certify)))
        for number, one in enumerate(rounds)
    ]


def _of_all(average: Callable[..., Any], parts: Iterable[Seconds]) -> Array | None:
    """Average CPU and wall seconds (2,); `None` of none."""
    every = np.array([(seconds.cpu, seconds.wall) for seconds in parts])
    return np.asarray(average(every, axis=0)) if len(every) else None


def _columns(assemble: Array | None, solve: Array | None, certify: Array | None) -> Row:
    """The columns that rounds and queries share, from CPU and wall seconds of the parts of a query (2,)."""
    parts = {"assemble_s": assemble, "solve_s": solve, "certify_s": certify}
    total, wall = sum((part for part in parts.values() if part is not None), np.zeros(2))
    seconds = {name: None if part is None else part[0] for name, part in parts.items()}
    return seconds | {"total_s": total, "total_wall_s": wall}


def seconds_of_cell(rows: Sequence[Row], offline: float) -> Row:
    """The columns of a cell from its rounds: medians, and quartiles of the seconds of a query; empty without any.

    `offline` are its offline seconds, measured once: they are as uncertain as the machine was unsteady in the rounds.
    """
    if not rows:
        return dict.fromkeys(CELL_SECONDS)
    total, wall, slowdown = (np.array([row[name] for row in rows]) for name in ("total_s", "total_wall_s", "slowdown"))
    certified = [row["certify_s"] for row in rows if row["certify_s"] is not None]
    low, middle, high = np.quantile(total, (0.25, 0.5, 0.75))
    quickest, slowest = np.quantile(slowdown / np.median(slowdown), SPREAD)
    return {
        "online_s": middle,
        "online_q1_s": low,
        "online_q3_s": high,
        "online_wall_s": np.median(wall),
        "online_assemble_s": np.median([row["assemble_s"] for row in rows]),
        "online_solve_s": np.median([row["solve_s"] for row in rows]),
        "online_certify_s": np.median(certified) if certified else None,
        "offline_low_s": offline * quickest,
        "offline_high_s": offline * slowest,
        "slowdown": np.median(slowdown),
        "disturbed": int(np.median(wall / total) > WAITED or np.median(slowdown) > DISTURBED),
    }


def seconds_of_queries(rounds: Sequence[TimedRound]) -> dict[int, Row]:
    """The columns of the queries that were timed: medians over the rounds."""
    rows = {}
    for k in sorted({k for one in rounds for k in one.solve}):
        # In full, a query is not assembled in every round: the other queries' seconds stand for its own.
        assembled = [one.assemble[k] if k in one.assemble else next(iter(one.assemble.values())) for one in rounds]
        solved = [one.solve[k] for one in rounds if k in one.solve]
        certified = [one.certify[k] for one in rounds if k in one.certify]
        rows[k] = _columns(*(_of_all(np.median, parts) for parts in (assembled, solved, certified)))
    return rows
