"""Which stages a run has to do, and in what order: a graph that shrinks as they end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from vibench.stages.base import Stage


@dataclass
class Plan:
    """Stages by key; `waiting` says of each that has not begun which others it still waits for.

    Goals are what the run is for; every other stage is there because a goal needs it. A stage names all it needs in
    `inputs`, not only the nearest.
    """

    stages: dict[str, Stage] = field(default_factory=dict)
    waiting: dict[str, set[str]] = field(default_factory=dict)
    _goals: set[str] = field(default_factory=set)
    _there: set[str] = field(default_factory=set)

    def add_goal(self, stage: Stage, is_there: Callable[[Stage], bool]) -> None:
        """Plan a stage, and what it needs and is not there already; `is_there` is asked once of each."""
        self._goals.add(stage.key)
        self._add(stage, is_there)

    def _add(self, stage: Stage, is_there: Callable[[Stage], bool]) -> bool:
        if stage.key in self.stages:
            return True
        if stage.key in self._there:
            return False
        if is_there(stage):
            self._there.add(stage.key)
            return False
        needed = {needed.key for needed in stage.inputs() if self._add(needed, is_there)}
        self.stages[stage.key] = stage
        self.waiting[stage.key] = needed
        return True

    def begin(self, count: int) -> Iterator[Stage]:
        """At most so many stages that wait for nothing; they begin now."""
        for key in [key for key, needed in self.waiting.items() if not needed][: max(count, 0)]:
            del self.waiting[key]
            yield self.stages[key]

    def done(self, stage: Stage) -> None:
        """A stage went through."""
        for needed in self.waiting.values():
            needed.discard(stage.key)

    def lost(self, stage: Stage) -> list[Stage]:
        """A stage did not go through; gives the goals that needed it, and drops what led to nothing else."""
        gone = [key for key, needed in self.waiting.items() if stage.key in needed]
        for key in gone:
            del self.waiting[key]
        wanted = self.waiting.keys() & self._goals
        wanted = wanted.union(*(self.waiting[key] for key in wanted))
        for key in self.waiting.keys() - wanted:
            del self.waiting[key]
        return [self.stages[key] for key in gone if key in self._goals]
