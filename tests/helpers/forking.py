"""The command in a process that is forked from one with the libraries loaded: their import is most of a short run."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

LOADED = [
    "annotated_types", "cachetools", "jinja2", "lazy_loader", "multiprocessing.connection", "numpy", "osqp", "pandas",
    "piqp", "platformdirs", "proxsuite", "pydantic", "rich.console", "rich.live", "rich.progress", "rich.table",
    "safetensors", "scipy.optimize", "scipy.sparse.linalg", "skfem", "statistics", "typer",
]  # fmt: skip
"""Libraries of others alone: vibench and plugins are imported by every process itself."""

TESTS = Path(__file__).parents[1]

context = multiprocessing.get_context("forkserver")
context.set_forkserver_preload(LOADED)


def run_command(
    arguments: Sequence[str], folder: Path, plugins: Path, timeout: float
) -> subprocess.CompletedProcess[str]:
    """Run `vibench ARGUMENTS` in a folder, third-party plugins first on its path; as `subprocess.run` does."""
    printed = [folder / f".printed-{name}" for name in ("out", "err")]
    path = [str(plugins), *(entry for entry in sys.path if entry and TESTS not in (Path(entry), *Path(entry).parents))]
    process = context.Process(target=_main, args=(list(arguments), str(folder), path, dict(os.environ), printed))
    process.start()
    process.join(timeout)
    if process.exitcode is None:
        assert process.pid is not None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.join()
        raise subprocess.TimeoutExpired(list(arguments), timeout)
    out, err = (file.read_text(encoding="utf-8") for file in printed)
    for file in printed:
        file.unlink()
    return subprocess.CompletedProcess(list(arguments), process.exitcode, out, err)


def _main(
    arguments: list[str], folder: str, path: list[str], environment: Mapping[str, str], printed: Sequence[Path]
) -> None:
    """What the installed command does, in the forked process; it leads a process group of its own."""
    os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:], sys.argv = path, ["vibench", *arguments]
    for descriptor, file in zip((1, 2), printed, strict=True):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
    from vibench.cli import start  # noqa: PLC0415  in this process and no earlier

    start()
