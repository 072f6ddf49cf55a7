import io
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import pytest
from counting import instructions
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from samples import STUDY, changed, write_study

from vibench import Stop
from vibench.execution.run import Agenda
from vibench.library.progress import DrawingDisplay, ProgressDisplay, TimeLeft, duration
from vibench.plugins.plugin import Plugin
from vibench.stages.base import Stage
from vibench.stages.cell_queries import CellQueries, cell_queries
from vibench.stages.offline import PODStage
from vibench.stages.snapshots import SnapshotStage
from vibench.study.cells import Cell
from vibench.study.matrix import expand, read_study
from vibench.study.parameter_sets import CHUNKS, OWN_TRAINING

PROBLEM = Plugin("problem", "p", "{}", "")  # there is none: nothing is built to estimate seconds
OK = {"status": "ok", "reason": ""}
PODS: list[Stage] = [PODStage(PROBLEM, Stop(size=k)) for k in range(1, 5)]
CHUNK: list[Stage] = [SnapshotStage(PROBLEM, OWN_TRAINING, chunk) for chunk in range(CHUNKS)]


@pytest.fixture
def cells(tmp_path: Path) -> list[Cell]:
    content = changed(changed(STUDY, "primal", to=["decorrelated"]), "problem", 0, "label", to="[red]membrane")
    return expand(read_study(write_study(tmp_path, content)))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr("vibench.library.progress.monotonic", lambda: now[0])
    return now


@pytest.fixture
def queries(cells: list[Cell]) -> list[Stage]:
    return [cell_queries(cell, 20.0) for cell in cells]


@pytest.mark.parametrize("jobs", [1, 3])
def test_stages_of_one_sort_are_taken_to_last_as_long(jobs: int) -> None:
    left = TimeLeft(PODS, jobs)
    assert left.seconds() is None
    for stage, seconds, expected in zip(PODS, (2.0, 4.0, 3.0, 3.0), (6.0, 6.0, 3.0, 0.0), strict=True):
        left.done(stage, seconds)
        assert left.seconds() == pytest.approx(expected / jobs)
    left.done(PODS[0], 2.0)
    assert left.seconds() == 0.0  # done twice, after its worker was lost


def test_a_stage_that_tells_its_fraction_counts_before_its_end(clock: list[float]) -> None:
    left = TimeLeft(CHUNK[:4], 2)
    left.begin(CHUNK[0])
    assert left.fractions_done([(CHUNK[0], 0.0)]) == 0.0
    assert left.seconds() is None
    clock[0] += 10.0
    assert left.fractions_done([(CHUNK[0], 0.25)]) == 0.0  # its pace may be that of a set-up
    assert left.seconds() == pytest.approx((4 * 40.0 - 10.0) / 2)
    left.done(CHUNK[0], 30.0)
    assert left.seconds() == pytest.approx(3 * 30.0 / 2)
    # the set-up of a long stage is not expected of the others
    clock[0], left = 0.0, TimeLeft(CHUNK[:2], 1)
    left.begin(CHUNK[0])
    for seconds, fraction in ((30.0, 0.1), (35.0, 0.2), (37.0, 0.2), (40.0, 0.3)):
        clock[0] = seconds
        left.fractions_done([(CHUNK[0], fraction)])
    assert left.seconds() == pytest.approx(0.7 * 50.0 + 50.0)


def test_what_was_never_seen_is_estimated_from_its_effort(queries: list[Stage]) -> None:
    assert CHUNK[0].effort > PODS[0].effort == 1.0
    left = TimeLeft([*PODS[:2], *CHUNK[:4]], 1)
    left.done(PODS[0], 3.0)
    assert left.seconds() == pytest.approx(3.0 + sum(3.0 * chunk.effort for chunk in CHUNK[:4]))
    left.done(CHUNK[0], 1.0)
    assert left.seconds() == pytest.approx(3.0 + 3 * 1.0)
    # another problem is taken to be as quick
    others: list[Stage] = [SnapshotStage(Plugin("problem", "q", "{}", ""), OWN_TRAINING, k) for k in range(CHUNKS)]
    left = TimeLeft([*CHUNK, *others], 1)
    for chunk in CHUNK:
        left.done(chunk, 2.0 * chunk.effort)
    assert left.seconds() == pytest.approx(sum(2.0 * chunk.effort for chunk in others))
    left.done(others[0], 5.0)
    assert left.seconds() == pytest.approx(3 * 5.0)
    # solvers are distinguished
    fast, slow = ([one for one in queries if getattr(one, "solver", "") == name][:3] for name in ("piqp", "osqp"))
    left = TimeLeft([*fast, *slow], 1)
    left.done(fast[0], 1.0)
    left.done(slow[0], 10.0)
    assert left.seconds() == pytest.approx(2 * 1.0 + 2 * 10.0)


def test_the_time_left_costs_the_same_however_much_is_done() -> None:
    def estimate(done: int) -> int:
        left = TimeLeft(PODS, 1)
        for _ in range(done):
            left.done(PODS[0], 2.0)
        return instructions(left.seconds)

    assert estimate(1000) == estimate(10)


@given(st.floats(0.0, 1e7))
def test_a_duration_in_words_is_about_the_duration(seconds: float) -> None:
    words = duration(seconds).split()
    units = {"s": 1.0, "min": 60.0, "h": 3600.0}
    found = sum(int(number) * units[unit] for number, unit in pairwise(words) if number.isdigit())
    assert abs(found - seconds) <= max(0.5, 30.0 * (seconds >= 90))
    said = {40.2: "40 s", 89.4: "89 s", 91.0: "2 min", 5300.0: "88 min", 5400.0: "1 h 30 min", 4800.0: "80 min"}
    assert {seconds: duration(seconds) for seconds in said} == said


def report(*, terminal: bool = False) -> tuple[ProgressDisplay, io.StringIO]:
    printed = io.StringIO()
    return ProgressDisplay(Console(file=printed, force_terminal=terminal, width=120)), printed


def agenda(cells: int, stages: Sequence[Stage], workers: int) -> Agenda:
    """Every queries' stage is a cell to be run."""
    return Agenda(cells, sum(isinstance(stage, CellQueries) for stage in stages), 0, stages, workers)


def test_the_beginning_and_stages_that_begin_are_said(queries: list[Stage]) -> None:
    for workers, some, said in ((2, 4, "4 stages on 2 workers"), (1, 4, "4 stages on 1 worker"), (0, 0, "0 stages")):
        for terminal in (False, True):
            made, printed = report(terminal=terminal)
            with made:
                made.start(agenda(20, PODS[:some], workers))
            assert f"20 cells, 0 to run, {said}\n" in printed.getvalue()
            assert ("0:00:00" in printed.getvalue()) is (terminal and some > 0)
    made, printed = report()
    made.start(agenda(20, [*queries[:3], *PODS], 2))
    assert printed.getvalue() == "20 cells, 3 to run, 7 stages on 2 workers\n"
    made, printed = report()
    made.start(agenda(1, PODS, 2))
    for stage in (*PODS, queries[0]):
        made.begin(stage)
    assert printed.getvalue().splitlines()[1:] == ["POD …", "queries …"]
    made, printed = report(terminal=True)
    with made:
        made.start(agenda(1, PODS, 2))
        made.begin(PODS[0])
    assert "POD" in printed.getvalue()


def test_the_time_left_is_said_if_it_is_a_second(cells: list[Cell], queries: list[Stage]) -> None:
    same = sum(isinstance(stage, CellQueries) for stage in queries) - 1
    for seconds, said in ((20.0, True), (0.02, False)):
        made, printed = report()
        made.start(agenda(len(cells), queries, 1))
        made.stage(queries[0], seconds)
        made.cell(cells[0], OK)
        assert (f"about {duration(seconds * same)} left" in printed.getvalue()) is said
        assert ("left" in printed.getvalue()) is said


def test_a_long_first_part_says_how_long_the_run_will_take(clock: list[float]) -> None:
    made, printed = report()
    made.start(agenda(1, CHUNK, 1))
    made.begin(CHUNK[0])
    for seconds, share in ((10.0, 0.1), (15.0, 0.25), (15.0, 0.4)):
        clock[0] += seconds
        made.fractions_done([(CHUNK[0], share)])
    assert printed.getvalue().count("left") == 1
    assert "high-fidelity solutions: 25% of one part, about 6 min left" in printed.getvalue()
    # high-fidelity parts are reported four by four
    made, printed = report()
    made.start(agenda(1, CHUNK, 2))
    for stage in (*CHUNK[:-1], PODS[0]):
        made.stage(stage, 0.1)
    assert len(printed.getvalue().splitlines()) == 1  # neither parts before the fourth nor other stages
    made.stage(CHUNK[-1], 0.1)
    assert f"high-fidelity solutions: {CHUNKS} of {CHUNKS} parts" in printed.getvalue()


def test_every_cell_has_a_line_but_not_a_thousand(cells: list[Cell], queries: list[Stage]) -> None:
    made, printed = report()
    made.start(agenda(len(cells), queries, 2))
    made.cell(cells[0], OK)
    made.cell(cells[1], {"status": "timeout", "reason": "took [bold]long"})
    made.cell(cells[0], {"status": "error", "reason": "word " * 100})
    text, count = printed.getvalue(), len(queries)
    ok, timeout = f"[1/{count}] ok: {cells[0]}", f"[2/{count}] timeout: {cells[1]} (took [bold]long)"
    assert "[red]membrane" in ok
    assert text.splitlines()[1:3] == [ok, timeout]
    assert len(text.splitlines()) == 4
    assert not {"\x1b", "\r"} & set(text)
    made, printed = report(terminal=True)
    with made:
        made.start(agenda(len(cells), queries, 2))
        made.stage(queries[0], 30.0)
        made.cell(cells[0], OK)
        made.cell(cells[1], {"status": "error", "reason": "broke"})
    words = ("\x1b", f"1/{len(queries)}", "left", f"error: {cells[1]}", f"ok: {cells[0]}")
    assert [word in printed.getvalue() for word in words] == [True, True, True, True, False]
    made, printed = report()
    made.start(agenda(1000, queries[:1] * 1000, 2))
    for k in range(1000):
        made.cell(cells[0], {"status": "timeout", "reason": f"took {k}.5 s"} if k % 2 else OK)
    lines = printed.getvalue().splitlines()
    assert len(lines) < 60
    assert sum("timeout: " in line for line in lines) == 3
    # what is not installed is one line, and none where no cell can run here, with which the command ends
    for count, told in ((48, ["unavailable: no solver: `pip install it`"]), (24, [])):
        made, printed = report()
        made.start(Agenda(count, 24, 24, [], 0))
        for _ in range(24):
            made.cell(cells[0], {"status": "unavailable", "reason": "no solver: `pip install it`"})
        assert printed.getvalue().splitlines()[1:] == told


@pytest.mark.parametrize("terminal", [False, True])
def test_a_label_is_no_markup(terminal: bool, queries: list[Stage], tmp_path: Path) -> None:
    odd = changed(STUDY, "problem", 0, "label", to="[/b] [red]a :warning:\x1b[2J\n[1/1] ok: b")
    cell = expand(read_study(write_study(tmp_path, odd)))[0]
    made, printed = report(terminal=terminal)
    with made:
        made.start(agenda(1, queries[:1], 1))
        made.cell(cell, {"status": "error", "reason": "[/i] \x1b[31m:smile:\ud800"})
    (line,) = [line for line in printed.getvalue().splitlines() if "error: " in line]
    assert r"error: [/b] [red]a :warning:\u001b[2J\n[1/1] ok: b · " in line
    assert line.endswith(r"([/i] \u001b[31m:smile:\ud800)")


def test_the_figure_that_is_being_drawn_is_named() -> None:
    for terminal in (False, True):
        printed = io.StringIO()
        with DrawingDisplay(Console(file=printed, force_terminal=terminal, width=80)) as display:
            display.show("[red]hertz-errors", 2, 25)
        expected = {"description": False, "[red]hertz-errors": terminal, "figures": True}
        assert {word: word in printed.getvalue() for word in expected} == expected
