"""The graph of the stages of a run: which can begin, and what is lost with a stage that fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush

from vibench.stages.base import Stage


@dataclass
class Graph:
    """The stages of a run, by key: the goals, and the stages that they need.

    A stage that begins, ends or is lost costs as many steps as it has neighbours, however many others wait. `waiting`
    has the inputs that are not done of each stage that has not begun.
    """

    stages: dict[str, Stage] = field(default_factory=dict)
    waiting: dict[str, set[str]] = field(default_factory=dict)
    # For each stage, those that need it and have not begun, in the order of the plan: an ordered set.
    _needed: dict[str, dict[str, None]] = field(default_factory=dict)
    # A heap of the stages whose inputs are done, by their number; some may have been dropped since.
    _ready: list[tuple[int, str]] = field(default_factory=list)
    _numbers: dict[str, int] = field(default_factory=dict)
    _goals: set[str] = field(default_factory=set)
    _available: set[str] = field(default_factory=set)

    def add_goal(self, stage: Stage, is_available: Callable[[Stage], bool]) -> None:
        """Plan a stage and its inputs without those that are available; `is_available` is called once per stage."""
        self._goals.add(stage.key)
        self._add(stage, is_available)

    def _add(self, stage: Stage, is_available: Callable[[Stage], bool]) -> bool:
        if stage.key in self._available:
            return False
        if stage.key in self.stages:
            return True
        # Available stages hide their inputs: these need not be computed for them.
        if is_available(stage):
            self._available.add(stage.key)
            return False
        inputs = {needed.key for needed in stage.inputs() if self._add(needed, is_available)}
        self._numbers[stage.key] = len(self.stages)
        self.stages[stage.key] = stage
        self.waiting[stage.key] = inputs
        for needed in inputs:
            self._needed.setdefault(needed, {})[stage.key] = None
        if not inputs:
            heappush(self._ready, (self._numbers[stage.key], stage.key))
        return True

    def begin(self, count: int) -> Iterator[Stage]:
        """Take at most `count` stages whose inputs are done, in the order of the plan; they count as begun."""
        while count > 0 and self._ready:
            # A stage that was dropped after it became ready is not waiting any more.
            _, key = heappop(self._ready)
            if self.waiting.pop(key, None) is not None:
                count -= 1
                yield self.stages[key]

    def done(self, stage: Stage) -> None:
        """Mark a stage as done; stages that are planned later do not wait for it."""
        self._available.add(stage.key)
        for key in self._needed.pop(stage.key, ()):
            self.waiting[key].discard(stage.key)
            if not self.waiting[key]:
                heappush(self._ready, (self._numbers[key], key))

    def lost(self, stage: Stage) -> list[Stage]:
        """Drop the stages that depend on a failed one, and those that no remaining goal needs."""
        # Returns the goals that are lost in the order of the plan, the failed stage among them if it is a goal.
        gone, ahead = {stage.key}, [stage.key]
        while ahead:
            # The stages that need a dropped one were dropped with it, and are not listed any more.
            more = self._needed.pop(ahead.pop(), {}).keys() - gone
            gone |= more
            ahead += more
        ahead = list(gone - {stage.key})
        while ahead:
            key = ahead.pop()
            for needed in self.waiting.pop(key):
                others = self._needed.get(needed, {})
                others.pop(key, None)
                if needed in self.waiting and not others and needed not in self._goals and needed not in gone:
                    ahead.append(needed)
        return [self.stages[key] for key in sorted(gone & self._goals, key=self._numbers.__getitem__)]
