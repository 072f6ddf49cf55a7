"""What work costs, counted: seconds depend on what else the machine does."""

import gc
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any


def instructions(work: Callable[[], object]) -> int:
    """Number of instructions of Python that a call executes, whatever functions it passes.

    None of them are those of callbacks of the garbage collector, such as Hypothesis has.
    """
    count, before, collects = 0, sys.gettrace(), gc.isenabled()

    def trace(frame: FrameType, event: str, _: Any) -> Callable[..., Any]:
        nonlocal count
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        count += event == "opcode"
        return trace

    gc.disable()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
        if collects:
            gc.enable()
    return count


def growth(work: Callable[[int], Callable[[], object]], size: int, factor: int = 4) -> float:
    """How much more a call costs per unit of its size where that is `factor` times as large; `work` prepares it."""
    # Caches that earlier tests may have filled are filled first.
    work(factor * size)()
    return instructions(work(factor * size)) / (factor * instructions(work(size)))
