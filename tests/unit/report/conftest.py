import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from browsing import FORMULA, chromium
from running import Shared, execute
from selenium.webdriver import Chrome

from vibench.report import html
from vibench.results.sqlite import FILE


@pytest.fixture(scope="session")
def reported(quick_run: Path, shared: Shared) -> Path:
    """Folder of a real run with its report, made once for all workers.

    A strategy has a label that looks like a formula, and the seconds of two cells were measured on a disturbed machine.
    """
    labelled = (
        f"UPDATE {table} SET primal = '{FORMULA}' WHERE primal = 'decorrelated'"
        for table in ("cells", "queries", "histories", "disagreements")
    )
    disturbed = ("UPDATE cells SET disturbed = 0", "UPDATE cells SET disturbed = 1 WHERE rowid IN (2, 9)")

    def make(folder: Path) -> None:
        folder.mkdir()
        shutil.copy(quick_run / FILE, folder / FILE)
        execute(folder, *labelled, *disturbed)
        html.write(folder / FILE, folder / "report.html")

    return shared("reported", make)


@pytest.fixture(scope="session")
def made(reported: Path) -> Path:
    return reported / "report.html"


@pytest.fixture(scope="module")
def downloads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("downloads")


@pytest.fixture(scope="module")
def browser(downloads: Path) -> Iterator[Chrome]:
    with chromium(downloads) as found:
        yield found
