"""The order of stages: each once, after what it needs, and none that leads to nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property

import pytest
from counting import growth
from hypothesis import given, settings
from hypothesis import strategies as st

from vibench.execution.graph import Graph
from vibench.plugins.kinds import STUDY
from vibench.plugins.registry import registered
from vibench.stages.base import Result, Stage
from vibench.stages.cell_queries import cell_queries
from vibench.stages.pictures import PictureStage
from vibench.storage.artefacts import Store
from vibench.study.matrix import expand, read_study


@dataclass(frozen=True)
class Node(Stage):
    """A stage that needs others."""

    label = "node"

    name: str
    direct: tuple[Node, ...] = field(default=())

    @cached_property
    def key(self) -> str:
        return self.name

    def inputs(self) -> tuple[Stage, ...]:
        return self.direct

    def run(self, store: Store) -> Result:
        return Result(self.name)


@st.composite
def graphs(draw: st.DrawFn) -> tuple[list[Node], list[Node]]:
    """Nodes, each needing some of those before, and goals among them that nobody needs."""
    nodes: list[Node] = []
    for number in range(draw(st.integers(1, 8))):
        direct = draw(st.lists(st.sampled_from(nodes), unique=True, max_size=3)) if nodes else []
        nodes.append(Node(f"n{number}", tuple(direct)))
    needs = st.lists(st.sampled_from(nodes), unique=True, min_size=1, max_size=3)
    goals = [Node(f"goal{k}", tuple(draw(needs))) for k in range(draw(st.integers(1, 4)))]
    return nodes, goals


@given(graphs(), st.data())
def test_what_fails_takes_its_goals_along_and_nothing_else(
    graph: tuple[list[Node], list[Node]], data: st.DataObject
) -> None:
    nodes, goals = graph
    there = {node.name for node in nodes if data.draw(st.booleans())}
    bad = {node.name for node in nodes if data.draw(st.integers(0, 3)) == 0} - there
    asked: list[str] = []

    def is_there(stage: Stage) -> bool:
        assert isinstance(stage, Node)
        asked.append(stage.name)
        return stage.name in there

    plan, begun, lost = Graph(), [], []
    for goal in goals:
        plan.add_goal(goal, is_there)
    assert len(asked) == len(set(asked))
    while plan.waiting:
        batch = list(plan.begin(data.draw(st.integers(1, 3))))
        assert batch  # there is always something to begin
        for stage in batch:
            assert isinstance(stage, Node)
            assert all(below.name in {*begun, *there} for below in stage.inputs() if isinstance(below, Node))
            assert not bad & {below.name for below in stage.inputs() if isinstance(below, Node)} - there
            begun.append(stage.name)
            if stage.name in bad:
                lost += [goal.name for goal in plan.lost(stage) if isinstance(goal, Node)]
            else:
                plan.done(stage)
    assert len(begun) == len(set(begun))
    assert not there & set(begun)
    assert sorted([*lost, *(name for name in begun if name.startswith("goal"))]) == sorted(goal.name for goal in goals)


def test_a_stage_costs_the_same_however_many_wait() -> None:
    """A run of many cells that share a stage; of every third one a stage fails that only it needs."""

    def run(cells: int) -> Callable[[], object]:
        shared = Node("shared")
        own = [Node(f"own{k}", (shared,)) for k in range(cells)]
        goals = [Node(f"goal{k}", (shared, needed)) for k, needed in enumerate(own)]

        failing = {node.name for node in own[::3]}

        def work() -> None:
            graph = Graph()
            for goal in goals:
                graph.add_goal(goal, lambda _: False)
            while graph.waiting:
                for stage in graph.begin(2):
                    if stage.key in failing:
                        assert [goal.key for goal in graph.lost(stage)] == [stage.key.replace("own", "goal")]
                    else:
                        graph.done(stage)

        return work

    assert growth(run, 50) < 1.1


Goals = dict[str, tuple[Stage, frozenset[str]]]
"""The goals of a study, each with the keys of all that it needs."""


@cache
def goals_of(study: str) -> Goals:
    known: dict[str, frozenset[str]] = {}

    def closure(stage: Stage) -> frozenset[str]:
        if stage.key not in known:
            known[stage.key] = frozenset([stage.key]).union(*map(closure, stage.inputs()))
        return known[stage.key]

    goals: list[Stage] = [cell_queries(cell, 20.0) for cell in expand(read_study(study))]
    goals += [PictureStage(problem) for problem in {goal.axes.problem for goal in goals} if problem is not None]
    return {goal.key: (goal, closure(goal)) for goal in goals}


@pytest.mark.parametrize("study", registered(STUDY))
@settings(max_examples=5)
@given(st.data())
def test_whatever_fails_in_a_real_study_every_goal_ends_once(study: str, data: st.DataObject) -> None:
    """The goals that need a stage that failed are lost, and no other; nothing waits for ever."""
    every = sorted(goals_of(study).items())
    # positions, not goals: the text of a strategy over goals is long enough for a warning of hypothesis, and it writes
    # that text whenever a thread of an earlier test draws from `random` meanwhile
    drawn = data.draw(st.lists(st.sampled_from(range(len(every))), min_size=1, max_size=12, unique=True))
    goals = dict(every[position] for position in drawn)
    stages = sorted(frozenset().union(*(needed for _, needed in goals.values())))
    bad = set(data.draw(st.lists(st.sampled_from(stages), max_size=4)))
    graph, failed, lost, done = Graph(), set(), [], []
    for goal, _ in goals.values():
        graph.add_goal(goal, lambda _: False)
    assert set(graph.stages) == set(stages)
    while graph.waiting:
        batch = list(graph.begin(data.draw(st.integers(1, 3))))
        assert batch
        for stage in batch:
            if stage.key in bad:
                failed.add(stage.key)
                lost += [goal.key for goal in graph.lost(stage)]
            else:
                done.append(stage.key)
                graph.done(stage)
    assert sorted(lost) == sorted(key for key, (_, needed) in goals.items() if needed & failed)
    assert set(goals) == {*lost, *(key for key in done if key in goals)}
    assert len(done) == len(set(done))
