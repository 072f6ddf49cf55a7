"""Offline stages timed once more: how much their seconds scatter, and what those of a cell are with them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vibench.results.break_even import SCATTER, offline_factor
from vibench.stages.artefacts import Store
from vibench.stages.base import Result, Row, Stage
from vibench.stages.cell_queries import CellQueries
from vibench.timing import Seconds

NOTICEABLE = 1e-3
"""CPU seconds of a stage below which its scatter says nothing of that of a whole offline phase."""


@dataclass(frozen=True)
class OfflineRepeat(Stage):
    """A stage that was run before, timed again; the value is CPU and wall seconds by the name of what has them."""

    label = "offline repeat"

    stage: Stage
    number: int

    @property
    def kind_of_work(self) -> str:
        """It takes about as long as the stage itself."""
        return self.stage.kind_of_work

    def inputs(self) -> tuple[Stage, ...]:
        """What the stage itself reads."""
        return self.stage.inputs()

    def run(self, store: Store) -> Result:
        """Time the work of the stage again; its result is the one that is stored already."""
        return Result({name: [spent.cpu, spent.wall] for name, spent in self.stage.measure(store).items()})

    def seconds(self, store: Store, name: str) -> Seconds | None:
        """Seconds of what has this name, once the stage has been run."""
        artefact = store.get(self.key)
        return None if artefact is None else Seconds(*artefact.value[name])


def scatter(runs: Iterable[Sequence[Seconds]]) -> float:
    """Standard deviation of the logarithm of offline seconds, from the stages that were timed more than once."""
    logarithms = [np.log([one.cpu for one in some]) for some in runs if len(some) > 1 and some[0].cpu >= NOTICEABLE]
    if not logarithms:
        return SCATTER
    squares = sum(float(np.sum((one - one.mean()) ** 2)) for one in logarithms)
    return float(np.sqrt(squares / sum(len(one) - 1 for one in logarithms)))


def offline_columns(cell: CellQueries, setup: float, runs: Mapping[str, Sequence[Seconds]], deviation: float) -> Row:
    """The offline columns of a cell: of each of its stages the median of its `runs`, by key, and one `setup`.

    `deviation` is the `scatter` of one run. The interval is that of seconds that all deviate alike, as by the speed of
    the machine; a sum of stages that deviate independently scatters less.
    """
    columns: Row = {}
    times, seconds = list[int](), list[float]()
    for phase, stages in cell.offline.items():
        mine = [runs[stage.key] for stage in stages]
        typical = [float(np.median([one.cpu for one in some])) for some in mine]
        columns[f"offline_{phase}_s"] = sum(typical) + (setup if phase == "snapshots" else 0.0)
        times += map(len, mine)
        seconds += typical
    total = sum(columns.values())
    # As often as the seconds were measured, weighed by themselves.
    often = float(np.average(times, weights=seconds)) if sum(seconds) else 1.0
    factor = offline_factor(deviation / float(np.sqrt(often)))
    repeats = sum(count > 1 and spent >= NOTICEABLE for count, spent in zip(times, seconds, strict=True))
    ends = {"offline_low_s": total / factor, "offline_high_s": total * factor}
    return columns | {"offline_s": total, **ends, "offline_repeats": repeats}


def sources(cell: CellQueries) -> Iterator[Stage]:
    """The stages whose work has the offline seconds of a cell."""
    return (stage.measured_by[0] for stages in cell.offline.values() for stage in stages)
