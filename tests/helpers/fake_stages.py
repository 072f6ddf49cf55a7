"""Stages that misbehave, for the supervisor of worker processes; importable there."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fake_plugins
import numpy as np
from forking import SUPERVISOR

from vibench.plugins.plugin import Plugin
from vibench.stages.artefacts import Store
from vibench.stages.base import Failed, Items, ItemwiseStage, Result, Stage, TimeLimit
from vibench.timing import Seconds


def interrupt() -> None:
    raise KeyboardInterrupt


MISBEHAVIOUR: Mapping[str, Callable[[], object]] = {
    "sleep": lambda: time.sleep(3600),
    "hang": lambda: ctypes.PyDLL(None).sleep(3600),  # in native code that keeps every other thread waiting
    "exit": lambda: os._exit(5), "segfault": fake_plugins.segfault, "interrupt": interrupt, "fork": os.fork,
    "hunger": lambda: np.ones(2**36), "moment": lambda: time.sleep(0.05),
}  # fmt: skip


def misbehave(how: str) -> None:
    MISBEHAVIOUR.get(how, lambda: start(*how.split()))()


def meet(diary: Path) -> None:
    while len(diary.read_text().splitlines()) < 2:
        time.sleep(0.01)


def start(kind: str = "", *seconds: str) -> None:
    """Start a process that would outlive its parent; a daemon is in a session of its own, and soon nobody's child.

    Or "linger", after a note in a diary, the file that is given in place of seconds.
    """
    if kind == "child":
        subprocess.Popen(["sleep", *seconds])
    elif kind == "daemon":
        subprocess.run(["sh", "-c", f"setsid sleep {seconds[0]} >/dev/null 2>&1 &"], check=True)
    elif kind == "linger":
        with Path(seconds[0]).open("a") as diary:
            diary.write("begun\n")
        time.sleep(2.0)


@dataclass(frozen=True)
class Whole(Stage):
    label = "whole"

    how: str
    diary: str = ""

    def inputs(self) -> tuple[Stage, ...]:
        return ()

    def run(self, store: Store) -> Result:
        if self.diary:
            with Path(self.diary).open("a") as file:
                file.write(f"{os.getpid()}\n")
        if self.how.startswith("meet"):
            meet(Path(self.diary))
        elif self.how == "third":
            store.progress(1.0 / 3.0)
        else:
            misbehave(self.how)
        return Result(self.how, Seconds(1.0, 1.0))


@dataclass(frozen=True)
class OfAPlugin(Stage):
    """A stage that depends on a plugin, below another stage."""

    label = "of a plugin"

    below: OfAPlugin | None = None
    problem: Plugin | None = None

    def inputs(self) -> tuple[Stage, ...]:
        return () if self.below is None else (self.below,)

    def run(self, store: Store) -> Result:
        return Result("fine")


@dataclass(frozen=True)
class KillsItsSupervisor(Stage):
    """Kills the process that keeps the worker, the first time it is run."""

    label = "kills its supervisor"

    diary: str

    def inputs(self) -> tuple[Stage, ...]:
        return ()

    def run(self, store: Store) -> Result:
        first = not Path(self.diary).exists()
        with Path(self.diary).open("a") as file:
            file.write("begun\n")
        if first:
            os.kill(int(os.environ[SUPERVISOR]), signal.SIGKILL)
            time.sleep(20)
        return Result("survived")


@dataclass(frozen=True)
class InItems(ItemwiseStage):
    """Every item does what its word says, and what the one in `unlimited` says before the supervisor is told."""

    label = "in items"

    hows: tuple[str, ...]
    at_begin: str = ""
    at_end: str = ""
    unlimited: tuple[str, ...] = ()

    @property
    def items(self) -> int:
        return len(self.hows)

    def inputs(self) -> tuple[Stage, ...]:
        return ()

    def begin(self, store: Store) -> Items:
        misbehave(self.at_begin)
        return Work(self)


class Work(Items):
    def __init__(self, stage: InItems) -> None:
        self.stage = stage

    def run_item(self, number: int, time_limit: TimeLimit) -> Any:
        misbehave(self.stage.unlimited[number] if self.stage.unlimited else "")
        with time_limit():
            misbehave(self.stage.hows[number])
        return number, os.getpid()

    def failed(self, number: int, failed: Failed) -> Any:
        return number, failed

    def collect(self, items: Sequence[Any]) -> Any:
        misbehave(self.stage.at_end)
        return list(items)
