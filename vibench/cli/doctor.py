"""Whether vibench works here: what is installed, what works, what there is room for, and what timings are worth."""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import requires
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from threadpoolctl import threadpool_info, threadpool_limits

from vibench import provenance
from vibench.cli import solver_check
from vibench.cli.console import new_console
from vibench.errors import RequestError, in_a_line
from vibench.locking import locked
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers
from vibench.qp.status import Status
from vibench.stages.artefacts import CACHE_VARIABLE, LOCK, Store, default_folder
from vibench.stages.cell_summary import DISTURBED
from vibench.study import registry
from vibench.study.reader import load_study
from vibench.timing import Calibration, Stopwatch

LITTLE = 1.0
"""GiB of memory or disk below which there is a note."""

OTHERS = 0.25
"""Share of the cores that other processes may keep busy before there is a note."""

WAITS = 1.5
"""Wall over CPU seconds above which `vibench.stages.cell_queries` marks a row as disturbed."""

LISTENING = 0.5
"""Seconds for which the machine is listened to."""


class Health(StrEnum):
    """How bad a finding is: `BROKEN` is for what vibench cannot work without, or what is there and does not work."""

    OK = "ok"
    NOTE = "note"
    BROKEN = "broken"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at: what, what was found, and how bad that is."""

    subject: str
    found: str
    health: Health = Health.OK


def doctor(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the runs.")] = Path("runs"),
) -> None:
    """Check versions, QP solvers, plugins, disk and timings.

    Every installed solver solves a small program. Exit code 1 if something is broken: there and not working, or needed
    and not there.
    """
    console, broken = new_console(), []
    for title, examine in _sections(out).items():
        findings = list(examine())
        _print(console, title, findings)
        broken += [finding.subject for finding in findings if finding.health is Health.BROKEN]
    console.print(f"broken: {', '.join(broken)}" if broken else "nothing is broken", markup=False, soft_wrap=True)
    if broken:
        raise typer.Exit(1)


def _sections(out: Path) -> Mapping[str, Callable[[], Iterable[Finding]]]:
    return {
        "versions": versions,
        "QP solvers": solvers,
        "plugins": registered,
        "machine": machine,
        "disk": lambda: disk(out),
        "timings": timings,
    }


def _print(console: Console, title: str, findings: list[Finding]) -> None:
    table = Table.grid(padding=(0, 2))
    for options in ({"min_width": 6}, {"min_width": 18, "no_wrap": True}, {"overflow": "fold"}):
        table.add_column(**options)
    for finding in findings:
        style = {Health.OK: "", Health.NOTE: "yellow", Health.BROKEN: "bold red"}[finding.health]
        table.add_row(Text(finding.health, style), Text(finding.subject), Text(finding.found))
    console.print(title, style="bold")
    console.print(table)


def versions() -> Iterator[Finding]:
    """Python, vibench and what it needs; broken where something of that is missing."""
    yield Finding("Python", f"{platform.python_version()}, {platform.python_implementation()}, {platform.platform()}")
    yield Finding("vibench", provenance.core_code())
    found = {name: provenance.distribution_version(name) for name, extras in requirements().items() if not extras}
    yield Finding("libraries", ", ".join(f"{name} {there}" for name, there in found.items() if there))
    for name, there in found.items():
        if not there:
            yield Finding(name, "is needed and not installed", Health.BROKEN)


def requirements() -> dict[str, list[str]]:
    """Distributions that vibench asks for, and the extras they are for; none for what it always needs."""
    found: dict[str, list[str]] = {}
    for line in requires("vibench") or ():
        name = re.match(r"[\w.-]+", line)
        assert name is not None
        found.setdefault(name[0], []).extend(re.findall(r"extra\s*==\s*['\"]([\w.-]+)['\"]", line))
    return found


def solvers() -> Iterator[Finding]:
    """Every QP solver there could be; those that are there solve a small program each."""
    extra, _ = _names("QP solver")
    installed = installed_solvers(extra)
    trials = solver_check.attempts(installed)
    for name in sorted({*SETTINGS, *extra}):
        version = provenance.solver_version(name) if name in SETTINGS else registry.version("QP solver", name)
        if name not in trials:
            yield _absent(name, version)
            continue
        trial = trials[name]
        reached = "" if trial.residual is None else f"largest residual {trial.residual:.0e}"
        if trial.status is Status.OK:
            yield Finding(name, f"{version}: {reached}")
        else:
            yield Finding(name, f"{version}: {trial.status}, {trial.reason}", Health.BROKEN)


def _absent(solver: str, version: str) -> Finding:
    """What to say of a solver that cannot be run."""
    distribution = provenance.SOLVER_DISTRIBUTIONS.get(solver, solver)
    if version:
        try:
            importlib.import_module(distribution)
        except (Exception, SystemExit) as error:  # noqa: BLE001  whatever keeps it from being imported
            return Finding(solver, f"{version} is installed and cannot be imported: {in_a_line(error)}", Health.BROKEN)
        return Finding(solver, f"{version} is installed and qpsolvers does not know it", Health.BROKEN)
    extras = requirements().get(distribution)
    if extras == []:
        return Finding(solver, "is needed and not installed", Health.BROKEN)
    hint = f"; pip install 'vibench[{extras[0]}]' brings it" if extras else ""
    return Finding(solver, f"not installed{hint}", Health.NOTE)


def registered() -> Iterator[Finding]:
    """How many plugins of each kind load, and why the others do not."""
    for kind in registry.GROUPS:
        names, doubled = _names(kind)
        if doubled:
            yield Finding(kind, doubled, Health.BROKEN)
            continue
        broken = {name: reason for name in names if (reason := _why_not(kind, name))}
        fine = [name for name in names if name not in broken]
        yield Finding(kind, ", ".join(fine) or "none")
        for name, reason in broken.items():
            yield Finding(f"{kind} '{name}'", f"{reason} (from {registry.version(kind, name)})", Health.BROKEN)


def _names(kind: str) -> tuple[list[str], str]:
    """The names of a kind; none where two packages register one, and what is to be said about that."""
    try:
        return registry.names(kind), ""
    except RequestError as error:
        return [], str(error)


def _why_not(kind: str, name: str) -> str:
    """Why a plugin is of no use; "" if it loads."""
    try:
        if kind == "study":
            load_study(name)
        else:
            registry.load(kind, name)
            if kind != "QP solver":
                registry.options(kind, name)
    except RequestError as error:
        return str(error)
    except Exception as error:  # noqa: BLE001  annotations of strangers are evaluated
        return in_a_line(error)
    return ""


def machine() -> Iterator[Finding]:
    """Processor, memory that is free, and the BLAS of NumPy and SciPy."""
    yield Finding("processor", provenance.machine())
    free = _free_memory()
    yield Finding("free memory", f"{free:.1f} GiB", Health.NOTE if free < LITTLE else Health.OK)
    for pool in threadpool_info():
        name = f"{pool['internal_api']} {pool.get('version') or ''}".strip()
        threads = f"{pool['num_threads']} threads here, 1 in workers"
        subject = "BLAS" if pool["user_api"] == "blas" else pool["user_api"]
        yield Finding(subject, f"{name} of {Path(pool['filepath']).parent.name}, {threads}")


def _free_memory() -> float:
    """GiB that processes can still get."""
    info = Path("/proc/meminfo")
    found = re.search(r"MemAvailable:\s*(\d+) kB", info.read_text()) if info.is_file() else None
    return int(found[1]) / 2**20 if found else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def disk(out: Path) -> Iterator[Finding]:
    """Room and rights where runs and artefacts go, and what artefacts take."""
    store = Store(default_folder())
    yield _place("runs", out.absolute())
    yield _place("artefacts", store.folder)
    sizes = [size for _, size, _ in store.contents()]
    yield Finding("kept", f"{len(sizes)} artefacts, {sum(sizes) / 2**20:.1f} MiB; `vibench clean` frees them")
    source = f"${CACHE_VARIABLE}" if os.environ.get(CACHE_VARIABLE) else f"the default; ${CACHE_VARIABLE} changes it"
    yield Finding("place of artefacts", source)


def _place(subject: str, folder: Path) -> Finding:
    """Whether a folder, or the one it will be made in, takes locks and databases, and how much else."""
    there = next(parent for parent in (folder, *folder.parents) if parent.exists())
    try:
        free = shutil.disk_usage(there).free / 2**30
        with tempfile.TemporaryDirectory(dir=there, prefix=".vibench-") as scratch:
            _use(Path(scratch))
    except (OSError, RequestError, sqlite3.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        return Finding(subject, f"{folder}: cannot be used: {reason}", Health.BROKEN)
    return Finding(subject, f"{folder}: {free:.1f} GiB free", Health.NOTE if free < LITTLE else Health.OK)


def _use(folder: Path) -> None:
    """Do in a folder what runs do: lock a file, and write a database ahead."""
    with locked(folder / LOCK, busy="a lock of our own is taken"):
        db = sqlite3.connect(folder / "trial.sqlite")
        try:
            mode = db.execute("PRAGMA journal_mode=WAL").fetchone()[0]
            db.execute("CREATE TABLE trial (number)")
            db.commit()
        finally:
            db.close()
    if mode != "wal":
        raise RequestError("SQLite cannot write ahead here; is it a network drive?")


def timings() -> Iterator[Finding]:
    """Who else is at work, how steady a fixed calculation is, and what follows for seconds measured now."""
    before, watch = _busy(), Stopwatch()
    with threadpool_limits(1):
        calibration = Calibration()
        slowdowns = [calibration.slowdown()]
        while watch.seconds().wall < LISTENING:
            slowdowns.append(calibration.slowdown())
    spent, after = watch.seconds(), _busy()
    cores = os.cpu_count() or 1
    own = spent.cpu / spent.wall
    others = max((after - before) / spent.wall - own, 0.0) if after > before else max(os.getloadavg()[0] - own, 0.0)
    slow, waits = float(np.quantile(slowdowns, 0.9)), spent.wall / spent.cpu
    heard = [
        Finding("other load", f"{others:.1f} of {cores} cores", _above(others, OTHERS * cores)),
        Finding("slowdown", f"{slow:.2f}; rows are marked above {DISTURBED}", _above(slow, DISTURBED)),
        Finding("wall over CPU", f"{waits:.2f}; rows are marked above {WAITS}", _above(waits, WAITS)),
    ]
    yield from heard
    doubts = [finding.subject for finding in heard if finding.health is not Health.OK]
    verdict = f"are not to be trusted: {', '.join(doubts)}" if doubts else "can be trusted"
    yield Finding("verdict", f"seconds measured now {verdict}", Health.NOTE if doubts else Health.OK)


def _above(value: float, limit: float) -> Health:
    return Health.NOTE if value > limit else Health.OK


def _busy() -> float:
    """CPU seconds that the whole machine has worked; 0 where the system does not tell."""
    stat = Path("/proc/stat")
    if not stat.is_file():
        return 0.0
    user, nice, system, _, _, irq, softirq, steal = map(int, stat.read_text().split(maxsplit=9)[1:9])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")
