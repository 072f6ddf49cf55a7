"""The graph of the stages of a run: which can begin, and what is lost with a stage that fails."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, field

from vibench.stages.base import Stage


@dataclass
class Graph:
    """The stages of a run, by key: the goals, and the stages that they need.

    Attributes
    ----------
    stages
        All stages that were planned.
    waiting
        For each stage that has not begun, its inputs that are not done.
    """

    stages: dict[str, Stage] = field(default_factory=dict)
    waiting: dict[str, set[str]] = field(default_factory=dict)
    _inputs: dict[str, frozenset[str]] = field(default_factory=dict)
    _goals: set[str] = field(default_factory=set)
    _there: set[str] = field(default_factory=set)

    def add_goal(self, stage: Stage, is_there: Callable[[Stage], bool]) -> None:
        """Plan a stage and the inputs that are not available; `is_there` is called once per stage."""
        self._goals.add(stage.key)
        self._add(stage, is_there)

    def _add(self, stage: Stage, is_there: Callable[[Stage], bool]) -> bool:
        if stage.key in self._there:
            return False
        if stage.key in self.stages:
            return True
        if is_there(stage):
            self._there.add(stage.key)
            return False
        needed = {needed.key for needed in stage.inputs() if self._add(needed, is_there)}
        self.stages[stage.key] = stage
        self.waiting[stage.key], self._inputs[stage.key] = needed, frozenset(needed)
        return True

    def begin(self, count: int) -> Iterator[Stage]:
        """Take at most `count` stages whose inputs are done; they count as begun."""
        for key in [key for key, needed in self.waiting.items() if not needed][: max(count, 0)]:
            del self.waiting[key]
            yield self.stages[key]

    def done(self, stage: Stage) -> None:
        """Note that a stage succeeded; what is planned later does not wait for it."""
        self._there.add(stage.key)
        for needed in self.waiting.values():
            needed.discard(stage.key)

    def lost(self, stage: Stage) -> list[Stage]:
        """Drop the stages that depend on a failed one, and those that no remaining goal needs.

        Returns
        -------
        list
            The goals that are lost, the stage itself among them if it is one.
        """
        used_by: dict[str, set[str]] = {}
        for key, inputs in self._inputs.items():
            for needed in inputs:
                used_by.setdefault(needed, set()).add(key)
        gone = _closure([stage.key], used_by)
        # Goals that an earlier failure has dropped are not waiting any more, so that each is reported once.
        lost = {key for key in self._goals & gone if key in self.waiting or key == stage.key}
        wanted = _closure((self.waiting.keys() & self._goals) - gone, self._inputs)
        for key in self.waiting.keys() - wanted:
            del self.waiting[key]
        return [self.stages[key] for key in self.stages if key in lost]


def _closure(keys: Iterable[str], edges: Mapping[str, Set[str]]) -> set[str]:
    """The keys and all that can be reached from them."""
    reached: set[str] = set()
    ahead = list(keys)
    while ahead:
        key = ahead.pop()
        if key not in reached:
            reached.add(key)
            ahead += edges.get(key, ())
    return reached
