"""Offline stages timed again: the scatter of their seconds, and the offline columns of a cell."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vibench.results.break_even import SCATTER, offline_factor
from vibench.stages.artefacts import Store
from vibench.stages.base import Result, Row, Stage
from vibench.stages.cell_queries import CellQueries
from vibench.timing import Seconds


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


def scatter(runs: Iterable[Sequence[Seconds]]) -> float:
    """Standard deviation of the logarithm of offline seconds, from the stages that were timed more than once."""
    logarithms = [np.log([one.cpu for one in some]) for some in runs if _is_repeated(len(some), some[0].cpu)]
    if not logarithms:
        return SCATTER
    squares = sum(float(np.sum((one - one.mean()) ** 2)) for one in logarithms)
    return float(np.sqrt(squares / sum(len(one) - 1 for one in logarithms)))


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
    repeats = sum(_is_repeated(count, spent) for count, spent in zip(times, seconds, strict=True))
    ends = {"offline_low_s": total / factor, "offline_high_s": total * factor}
    return columns | {"offline_s": total, **ends, "offline_repeats": repeats}


def _is_repeated(times: int, cpu: float) -> bool:
    # The scatter of a stage below a millisecond says nothing about that of a whole offline phase.
    return times > 1 and cpu >= 1e-3


def sources(cell: CellQueries) -> Iterator[Stage]:
    """The stages whose work takes the offline seconds of a cell."""
    return (stage.measured_by[0] for stages in cell.offline_stages.values() for stage in stages)
