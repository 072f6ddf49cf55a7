from __future__ import annotations

import fcntl
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from browsing import FORMULA, chromium
from running import execute
from selenium.webdriver import Chrome

from vibench.report import html
from vibench.results.sqlite import FILE


@pytest.fixture(scope="session")
def reported(quick_run: Path) -> Path:
    """Folder of a real run with its report, with pictures of one problem, drawn once for all workers.

    A strategy has a label that looks like a formula, and the seconds of two cells were measured on a disturbed machine.
    """
    folder = quick_run.parent / "reported"
    with (quick_run.parent / "reported.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "report.html").exists():
            folder.mkdir(exist_ok=True)
            shutil.copy(quick_run / FILE, folder / FILE)
            execute(
                folder,
                *(
                    f"UPDATE {table} SET primal = '{FORMULA}' WHERE primal = 'decorrelated'"
                    for table in ("cells", "queries", "histories", "disagreements")
                ),
                "UPDATE cells SET disturbed = 0",
                "UPDATE cells SET disturbed = 1 WHERE rowid IN (2, 9)",
            )
            with pytest.MonkeyPatch.context() as patch:
                tasks_of = html.tasks_of
                patch.setattr(html, "tasks_of", lambda name, data: tasks_of(name, data) if name == "obstacle" else [])
                html.write(folder / FILE, folder / "report.html")
    return folder


@pytest.fixture(scope="module")
def downloads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the browser saves what it downloads."""
    return tmp_path_factory.mktemp("downloads")


@pytest.fixture(scope="module")
def browser(downloads: Path) -> Iterator[Chrome]:
    with chromium(downloads) as found:
        yield found
