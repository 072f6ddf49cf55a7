"""`vibench doctor`: versions, QP solvers, plugins, machine, disk, and whether timings can be trusted."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from enum import StrEnum
from importlib.metadata import requires
from math import inf
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from rich.table import Table
from rich.text import Text
from threadpoolctl import threadpool_info, threadpool_limits

from vibench import provenance
from vibench.cli.console import echo, shown
from vibench.errors import RequestError, in_a_line
from vibench.execution.isolated import solver_trials
from vibench.files import locked, scratch
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.factorisations import IMPLEMENTATIONS
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import RegisteredPlugin, find, registered, unreadable
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers, load_qpsolvers
from vibench.qp.status import Status
from vibench.stages.artefacts import Store, default_folder
from vibench.study.matrix import read_study
from vibench.text import new_console
from vibench.timing import Calibration, Stopwatch, is_disturbed


class Health(StrEnum):
    """Severity of a diagnosis: `BROKEN` if a required part is missing, or an installed one does not work."""

    OK = "ok"
    NOTE = "note"
    BROKEN = "broken"


class Diagnosis(NamedTuple):
    """Result of one check: its subject, the finding, and how severe it is."""

    subject: str
    text: str
    health: Health = Health.OK


def print_diagnoses(out: Path) -> list[str]:
    """Print the diagnoses of all checks, and return the subjects of those that are broken."""
    console, broken = new_console(), []
    styles = {Health.OK: "", Health.NOTE: "yellow", Health.BROKEN: "bold red"}
    sections = {
        "versions": check_versions(), "QP solvers": check_solvers(), "factorisations": check_factorisations(),
        "plugins": check_plugins(), "machine": check_machine(), "disk": check_disk(out), "timings": check_timings(),
    }  # fmt: skip
    for title, diagnoses in sections.items():
        # Subjects of all sections begin in one column, and long findings are folded beside them.
        table = Table.grid(padding=(0, 2))
        table.add_column(min_width=6)
        table.add_column(min_width=18, no_wrap=True)
        table.add_column(overflow="fold")
        for subject, text, health in diagnoses:
            table.add_row(Text(health, styles[health]), shown(subject), shown(text))
            broken += [subject] * (health is Health.BROKEN)
        console.print(title, style="bold")
        console.print(table)
    echo(f"broken: {', '.join(broken)}" if broken else "nothing is broken")
    return broken


def check_versions() -> Iterator[Diagnosis]:
    """Versions of Python, vibench and the libraries it requires."""
    yield Diagnosis("Python", f"{platform.python_version()}, {platform.python_implementation()}, {platform.platform()}")
    yield Diagnosis("vibench", provenance.core_code())
    # Libraries of extras are reported where they are used, as solvers or factorisations.
    required = (name for name, extras in required_distributions().items() if not extras)
    versions = {name: provenance.distribution_version(name) for name in required}
    yield Diagnosis("libraries", ", ".join(f"{name} {version}" for name, version in versions.items() if version))
    missing = (name for name, version in versions.items() if not version)
    yield from (Diagnosis(name, "is required and not installed", Health.BROKEN) for name in missing)


def required_distributions() -> dict[str, list[str]]:
    """Distributions that vibench depends on, each with the extras that include it; no extra if it is required."""
    extras: dict[str, list[str]] = {}
    for line in requires("vibench") or ():
        name = re.match(r"[\w.-]+", line)
        assert name is not None
        extras.setdefault(name[0], []).extend(re.findall(r"extra\s*==\s*['\"]([\w.-]+)['\"]", line))
    return extras


def check_solvers() -> Iterator[Diagnosis]:
    """All known QP solvers; the installed ones solve a small program each, at the default accuracy of studies."""
    trials = solver_trials(wire(), 1e-7, installed_solvers(registered(PluginKind.SOLVER)), 60.0)
    for name in sorted({*SETTINGS, *registered(PluginKind.SOLVER)}):
        version = provenance.solver_version(name) if name in SETTINGS else find(PluginKind.SOLVER, name).origin
        if name not in trials:
            yield _unavailable(name, version)
        elif (trial := trials[name]).status is Status.OK and trial.residuals is not None:
            yield Diagnosis(name, f"{version}: largest residual {trial.residuals.worst:.0e}")
        else:
            # A solver of an extra may work and reach only a lower accuracy.
            extra = required_distributions().get(provenance.solver_distribution(name)) != []
            health = Health.NOTE if extra and trial.status is Status.INACCURATE else Health.BROKEN
            yield Diagnosis(name, f"{version}: {trial.status}, {trial.reason}", health)


def check_factorisations() -> Iterator[Diagnosis]:
    """All implementations of factorisations; the installed ones solve with a small matrix each."""
    A = sp.csc_array(wire().A)
    for name, one in IMPLEMENTATIONS.items():
        distribution = one.distribution or "scipy"
        version = f"{distribution} {provenance.distribution_version(distribution)}".strip()
        if not one.is_installed:
            yield Diagnosis(name, f"not installed: `pip install {distribution}` ({one.summary})", Health.NOTE)
            continue
        try:
            left = float(np.abs(A @ one.factorise(A, "A").solve(np.ones(A.shape[0])) - 1.0).max())
        except (Exception, SystemExit) as error:  # noqa: BLE001  a library may raise anything when it is imported
            yield Diagnosis(name, f"{version}: {in_a_line(error)}", Health.BROKEN)
        else:
            yield Diagnosis(name, f"{version}: residual {left:.0e} ({one.summary})")


def wire() -> VariationalInequality:
    """A wire of 12 nodes in contact with a flat support around its middle; dense, like reduced programs."""
    n, step = 12, 1.0 / 13
    A = (2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)) / step
    return VariationalInequality(A, np.full(n, -4.0 * step), -step * np.eye(n), np.full(n, 0.2 * step))


def _unavailable(solver: str, version: str) -> Diagnosis:
    """The reason why a solver cannot be run."""
    distribution = provenance.solver_distribution(solver)
    if version:
        reason = load_qpsolvers()[1].get(solver, "qpsolvers does not know it")
        return Diagnosis(solver, f"{version} is installed and {reason}", Health.BROKEN)
    extras = required_distributions().get(distribution)
    if extras == []:
        return Diagnosis(solver, "is required and not installed", Health.BROKEN)
    hint = f"; pip install 'vibench[{extras[0]}]' installs it" if extras else ""
    return Diagnosis(solver, f"not installed{hint}", Health.NOTE)


def check_plugins() -> Iterator[Diagnosis]:
    """The plugins of each kind that load, and the errors of those that do not."""
    for kind in PluginKind:
        errors = {name: error for name, plugin in registered(kind).items() if (error := _load_error(plugin))}
        yield Diagnosis(kind, ", ".join(name for name in registered(kind) if name not in errors) or "none")
        for name, error in errors.items():
            plugin = find(kind, name)
            yield Diagnosis(str(plugin), f"{error} (from {plugin.origin})", Health.BROKEN)
    yield from (Diagnosis(name, reason, Health.BROKEN) for name, reason in unreadable().items())


def _load_error(plugin: RegisteredPlugin) -> str:
    """The error of loading a plugin; "" if it loads."""
    try:
        if plugin.kind is PluginKind.STUDY:
            read_study(plugin.name)
        elif plugin.kind is PluginKind.SOLVER:
            plugin.load()
        else:
            list(map(str, plugin.options.values()))  # loads it and evaluates its annotations
    except RequestError as error:
        return str(error)
    except Exception as error:  # noqa: BLE001  annotations of plugins are evaluated
        return in_a_line(error)
    return ""


def check_machine() -> Iterator[Diagnosis]:
    """Processor, free memory, and the BLAS libraries of NumPy and SciPy."""
    yield Diagnosis("processor", provenance.machine())
    info = Path("/proc/meminfo")
    # A container may have less memory than the machine: the smaller of both counts.
    available = re.search(r"MemAvailable:\s*(\d+) kB", info.read_text()) if info.is_file() else None
    free = min(int(available[1]) / 2**20 if available else inf, provenance.memory() / 2**30)
    yield Diagnosis("free memory", f"{free:.1f} GiB", _note_if(free < 1.0))
    for pool in threadpool_info():
        name = f"{pool['internal_api']} {pool.get('version') or ''}".strip()
        threads = f"threads: {pool['num_threads']} here, 1 in workers"
        subject = "BLAS" if pool["user_api"] == "blas" else pool["user_api"]
        yield Diagnosis(subject, f"{name} of {Path(pool['filepath']).parent.name}, {threads}")


def check_disk(out: Path) -> Iterator[Diagnosis]:
    """Free space and permissions in the folders of runs and artefacts, and the size of stored artefacts."""
    store = Store(default_folder())
    yield _folder("runs", out.absolute())
    yield _folder("artefacts", store.folder)
    sizes = [size for _, size, _ in store.contents()]
    yield Diagnosis("stored", f"{len(sizes)} artefacts, {sum(sizes) / 2**20:.1f} MiB; `vibench clean` deletes them")
    source = "$VIBENCH_CACHE" if os.environ.get("VIBENCH_CACHE") else "the default; $VIBENCH_CACHE changes it"
    yield Diagnosis("artefact folder", source)


def _folder(subject: str, folder: Path) -> Diagnosis:
    """Free space of a folder, or of the one it will be created in, and whether locks and databases work there."""
    # Try out what a run does there: locks, and a database with a write-ahead log, fail on some network drives.
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    try:
        free = shutil.disk_usage(existing).free / 2**30
        with (
            scratch(existing) as trial,
            locked(Store(trial).lock, busy="a new lock is already held"),
            closing(sqlite3.connect(trial / "trial.sqlite")) as db,
        ):
            mode = db.execute("PRAGMA journal_mode=WAL").fetchone()[0]
            db.execute("CREATE TABLE trial (number)")
            db.commit()
        if mode != "wal":
            raise RequestError("SQLite cannot keep a write-ahead log here; is it a network drive?")
    except (OSError, RequestError, sqlite3.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        return Diagnosis(subject, f"{folder}: cannot be used: {reason}", Health.BROKEN)
    return Diagnosis(subject, f"{folder}: {free:.1f} GiB free", _note_if(free < 1.0))


def check_timings() -> Iterator[Diagnosis]:
    """Load of other processes, slowdown of a fixed calculation, and whether timings can be trusted."""
    before, watch = _busy_seconds(), Stopwatch()
    # Other threads of this process would count as the load of others.
    with threadpool_limits(1):
        calibration = Calibration()
        slowdowns = [calibration.slowdown()]
        # Half a second averages over the scheduler's slices and is hardly noticed.
        while watch.seconds().wall < 0.5:
            slowdowns.append(calibration.slowdown())
    spent, after = watch.seconds(), _busy_seconds()
    cores = os.cpu_count() or 1
    # The mean load of the last minute stands in where the system counts no seconds.
    load = (after - before) / spent.wall if after > before else os.getloadavg()[0]
    others = max(load - spent.cpu / spent.wall, 0.0)
    # The 90 % quantile shows a slowdown that lasts, not a single interruption.
    slowdown, ratio = float(np.quantile(slowdowns, 0.9)), spent.wall / spent.cpu
    doubts = []
    for subject, text, doubtful in (
        ("other load", f"{others:.1f} of {cores} cores", others > 0.25 * cores),
        ("slowdown", f"{slowdown:.2f} times a calm machine", is_disturbed(slowdown)),
        ("wall over CPU", f"{ratio:.2f}; above 1.5 processes often wait for a core", ratio > 1.5),
    ):
        yield Diagnosis(subject, text, _note_if(doubtful))
        doubts += [subject] * doubtful
    verdict = f"cannot be trusted: {', '.join(doubts)}" if doubts else "can be trusted"
    yield Diagnosis("verdict", f"seconds measured now {verdict}", _note_if(bool(doubts)))


def _note_if(doubtful: bool) -> Health:
    return Health.NOTE if doubtful else Health.OK


def _busy_seconds() -> float:
    """CPU seconds used by all processes since the start of the machine; 0 where the system does not tell."""
    stat = Path("/proc/stat")
    if not stat.is_file():
        return 0.0
    user, nice, system, _, _, irq, softirq, steal = map(int, stat.read_text().split(maxsplit=9)[1:9])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")
