import itertools
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from scipy.special import bdtr

from vibench import timing
from vibench.timing import NO_TIME, Calibration, Seconds, median_interval, median_seconds, timed


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Function that makes every timed piece of work take the given (CPU, wall) seconds in turn."""

    def script(*durations: tuple[float, float]) -> None:
        cpu: Iterator[float] = iter([t for c, _ in durations for t in (100.0, 100.0 + c)])
        wall: Iterator[float] = iter([t for _, w in durations for t in (500.0, 500.0 + w)])
        monkeypatch.setattr(timing, "process_time", lambda: next(cpu))
        monkeypatch.setattr(timing, "perf_counter", lambda: next(wall))

    return script


class Work:
    """Counts how often it is done; the result says which time it was."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> int:
        self.count += 1
        return self.count


def test_seconds_add_up_and_differences_are_never_negative() -> None:
    assert Seconds(1.0, 2.0) + Seconds(0.5, 0.25) == Seconds(1.5, 2.25)
    assert sum([Seconds(1.0, 2.0)] * 3, NO_TIME) == Seconds(3.0, 6.0)
    assert Seconds(3.0, 1.0).beyond(Seconds(1.0, 2.0)) == Seconds(2.0, 0.0)


def test_the_interval_of_a_median_has_the_tabulated_order_statistics() -> None:
    """As in Conover, Practical Nonparametric Statistics: the largest ones left out with a probability up to 0.025."""
    for count, first in ((1, 0), (5, 0), (6, 0), (9, 1), (30, 9), (100, 39), (2000, 955), (20_000, 9860)):
        values = [float(k) for k in range(count)]
        assert median_interval(values[::-1]) == (first, count - 1 - first)
        if count > 5:
            inside, wider = (1.0 - 2.0 * bdtr(k, count, 0.5) for k in (first, first + 1))
            assert inside >= 0.95 > wider


def test_repeats_are_timed_until_they_have_taken_enough(clocks: Callable[..., None]) -> None:
    with pytest.raises(ZeroDivisionError):
        median_seconds(lambda: 1 // 0)
    clocks((0.25, 0.75))
    assert timed(Work()) == (1, Seconds(0.25, 0.75))
    sixteenths = ((1, 1), (8, 12), (2, 4), (4, 8), (6, 2), (1, 10))
    for durations, seconds, count in (
        ([(0.125, 1.25)], Seconds(0.125, 1.25), 1),
        ([(0.9, 0.9), (0.5, 0.5), (0.25, 0.25), (0.25, 0.25)], Seconds(0.25, 0.25), 1 + 3),
        ([(cpu / 256, wall / 256) for cpu, wall in sixteenths], Seconds(4 / 256, 8 / 256), 6),
    ):
        clocks(*durations)
        work = Work()
        assert (*median_seconds(work), work.count) == (1, seconds, count)
    clocks(*[(0.1, 0.1)] * 6)
    done: list[int] = []
    result, seconds = median_seconds(lambda number: done.append(number) or -number, itertools.count(7))
    assert result == -7
    assert done == list(range(7, 13))
    assert seconds.cpu == pytest.approx(0.1)


def test_clocks_are_those_of_this_module_and_sleep_is_no_cpu_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    _, spent = timed(lambda: time.sleep(0.2))
    assert spent.wall >= 0.2
    assert spent.cpu < 0.5 * spent.wall
    with monkeypatch.context() as patch:
        for clock in ("thread_time", "process_time", "perf_counter", "monotonic", "time"):
            patch.setattr(time, clock, lambda: 0.0)
        _, spent = timed(lambda: sum(range(1000)))
    assert spent.cpu > 0.0
    assert spent.wall > 0.0


def in_a_thread() -> None:
    other = threading.Thread(target=spend)
    other.start()
    other.join()


def spend() -> None:
    while time.thread_time() < 0.05:
        sum(range(1000))


def in_a_child() -> None:
    code = "import time\nwhile time.process_time() < 0.05: sum(range(1000))"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("work", [in_a_thread, in_a_child])
def test_work_in_a_thread_or_in_a_child_process_is_counted(work: Callable[[], None]) -> None:
    assert timed(work)[1].cpu >= 0.05


def test_the_calibration_tells_how_much_slower_and_is_not_marked_by_a_quick_run(clocks: Callable[..., None]) -> None:
    """Against the best of all, every round but the luckiest would count as disturbed."""
    spent = (2.0, 1.0, 2.0, 4.0, 0.7, 0.5, 1.0, 2.0)
    clocks(*[(cpu, 9.0) for cpu in spent])
    calibration = Calibration()
    assert [calibration.slowdown() for _ in range(3)] == pytest.approx([2.0, 1.0, 2.0])
    clocks(*[(cpu, cpu) for cpu in [0.5] * 2 + [1.0] * 38 + [1.5] * 2])
    calibration = Calibration()
    slowdowns = [calibration.slowdown() for _ in range(20)]
    assert slowdowns[8:] == pytest.approx([1.0] * 11 + [1.5])
