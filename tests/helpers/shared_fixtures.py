"""Fixtures of all tests: of those that run vibench, and what these need in every process."""

import fcntl
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import typer.main
from forking import fork_workers, run_command, start_new_worker
from running import PATIENCE, Changed, Main, Register, Shared, Vibench, execute
from samples import QUICK_ROUNDS, SMALL, install_fakes
from threadpoolctl import threadpool_limits
from unsynced import leave_syncing_to_the_system

from vibench.cli import start
from vibench.execution import supervisor
from vibench.library import runs
from vibench.plugins import registry
from vibench.plugins.kinds import PluginKind
from vibench.results.sqlite import FILE

leave_syncing_to_the_system()


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """BLAS on one thread, as in workers: on several, products of this size spend twice the CPU seconds on waiting.

    Only in this process, no variable of the environment: processes that tests start see to their threads themselves.
    """
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session", autouse=True)
def artefacts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder in which the runs of this test process keep their artefacts: nobody else's are reused."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VIBENCH_CACHE", str(folder))
        # Hundreds of processes are started; each would compile the sources again where bytecode is not kept.
        patch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
        patch.delenv("COLUMNS", raising=False)  # pytest-xdist sets it: tables would leave out what does not fit
        yield folder / "artefacts"


@pytest.fixture(scope="session", autouse=True)
def forked_workers(artefacts: Path) -> Iterator[None]:
    """Worker processes of runs and checks that tests make in this process are forked, as those of `vibench` are."""
    with fork_workers():
        yield


@pytest.fixture
def new_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worker processes are new interpreters, as those of users, where a test is about them."""
    monkeypatch.setattr(supervisor, "start_worker", start_new_worker)


@pytest.fixture(scope="session")
def command() -> str:
    return str(Path(sysconfig.get_path("scripts")) / "vibench")


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory, artefacts: Path) -> Shared:
    """Function that makes a folder once, whichever of the parallel workers needs it first; nobody changes it.

    The artefacts of runs in it are kept beside it, and copied to where runs of this process look for theirs: none of
    the workers computes them again.
    """
    base = tmp_path_factory.getbasetemp()
    parent = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def once(name: str, make: Callable[[Path], object]) -> Path:
        folder, made, cache = parent / name, parent / f"{name}.made", parent / f"{name}.cache"
        with (parent / f"{name}.lock").open("w") as lock, pytest.MonkeyPatch.context() as patch:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not made.exists():
                patch.setenv("VIBENCH_CACHE", str(cache))
                make(folder)
                made.touch()
        if cache.exists():
            shutil.copytree(cache, artefacts.parent, dirs_exist_ok=True)
        return folder

    return once


@pytest.fixture(scope="session")
def quick_run(shared: Shared) -> Path:
    """Folder of one run of `quick` with half its queries, timed in half the rounds, by the command line; not drawn."""

    def run(folder: Path) -> None:
        study = Path(registry.registered(PluginKind.STUDY)["quick"].load()).read_text(encoding="utf-8")
        # Half the queries: half the seconds of the run and of what is computed from it, in every table as before.
        study = study.replace("validation = 16", "validation = 8")
        path = folder.with_suffix(".toml")
        path.write_text(f"timing_rounds = {QUICK_ROUNDS}\n{study}", encoding="utf-8")
        arguments = ["run", str(path), "--out", str(folder), "--jobs", "2", "--no-figures"]
        done = run_command(arguments, folder.parent, folder.with_suffix(".plugins"), PATIENCE)
        assert done.returncode == 0, done.stderr
        (folder / "printed.txt").write_text(done.stdout, encoding="utf-8")

    return shared("quick", run)


@pytest.fixture(scope="session")
def small_run(shared: Shared) -> runs.Run:
    return runs.open_run(shared("small", lambda folder: runs.run(SMALL, folder, progress=False, jobs=1)))


@pytest.fixture
def changed(quick_run: Path, tmp_path: Path) -> Changed:
    """Function that gives a copy of the results of a real run, changed by SQL; the next one takes its place."""

    def copy(*statements: str) -> Path:
        folder = tmp_path / "changed"
        folder.mkdir(exist_ok=True)
        shutil.copy(quick_run / FILE, folder / FILE)
        execute(folder, *statements)
        return folder / FILE

    return copy


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch) -> Iterator[Register]:
    """Function that makes entry points, given as (group, name, value), the only ones beside the default formulation."""

    def forget() -> None:
        registry._readable.cache_clear()
        registry.registered.cache_clear()
        registry.default_formulation.cache_clear()

    def replace(*entries: tuple[str, str, str]) -> None:
        entries = (*entries, ("vibench.formulations", "mixed", "vibench_strategies.formulations.mixed:Mixed"))
        found = [EntryPoint(name=name, group=group, value=value) for group, name, value in entries]
        monkeypatch.setattr(registry, "entry_points", lambda *, group: [e for e in found if e.group == group])
        forget()

    forget()
    yield replace
    forget()


@pytest.fixture(scope="module")
def plugins_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the third-party package is installed; one of the solvers that are optional is not."""
    folder = install_fakes(tmp_path_factory.mktemp("third-party") / "site")
    (folder / "ecos.py").write_text("raise ImportError('not on this machine')\n")
    return folder


@pytest.fixture(scope="module")
def vibench(plugins_folder: Path) -> Vibench:
    """Function that runs the command in a folder; it draws where a test is about figures."""

    def run(
        folder: Path, *arguments: str, plugins: Path = plugins_folder, figures: bool = False, timeout: float = PATIENCE,
        file_kib: int | None = None,
    ) -> subprocess.CompletedProcess[str]:  # fmt: skip
        plain = ["--no-figures"] if arguments[:1] == ("run",) and not figures else []
        return run_command([*arguments, *plain], folder, plugins, timeout, file_kib)

    return run


command_line = cache(typer.main.get_command)
"""The command line that typer makes of an app: it would make the same one at every call, in longer than most take."""


@pytest.fixture
def main(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Main:
    """Function that calls the command in an empty folder; gives exit code, what was printed, and errors."""
    monkeypatch.setattr(typer.main, "get_command", command_line)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["vibench", *arguments])
        with pytest.raises(SystemExit) as caught:
            start()
        printed = capsys.readouterr()
        return int(caught.value.code or 0), printed.out, printed.err

    return call
