from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

from counting import growth
from hypothesis import given
from hypothesis import strategies as st

from vibench.execution.graph import Graph
from vibench.stages.artefacts import Store
from vibench.stages.base import Result, Stage


@dataclass(frozen=True)
class Node(Stage):
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
def test_a_failure_takes_its_goals_alone_along(graph: tuple[list[Node], list[Node]], data: st.DataObject) -> None:
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
