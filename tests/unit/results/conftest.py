from collections.abc import Iterator
from pathlib import Path

import pytest
from samples import RECORDED

from vibench.results.database import ResultsDatabase


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[ResultsDatabase]:
    made = ResultsDatabase(tmp_path / "run", RECORDED)
    yield made
    made.close()
