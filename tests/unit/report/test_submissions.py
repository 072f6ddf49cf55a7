"""What is said of a published site that somebody submits: nothing of a good one, a line for every fault of another."""

from __future__ import annotations

import importlib
import json
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from vibench.provenance import PROTOCOL
from vibench.report.citation import Citation
from vibench.report.site import publish
from vibench.results.read import read_table
from vibench.results.sqlite import FILE

SCRIPTS = Path(__file__).parents[3] / "results" / "scripts"


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        yield importlib.import_module("check_submission")


@pytest.fixture(scope="module")
def site(quick_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("submitted") / "site"
    publish([quick_run / FILE], folder, Citation("quick"), figures=False)
    return folder


@pytest.fixture
def copied(site: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(site, tmp_path / "site"))


def run_of(site: Path) -> Path:
    (folder,) = (site / "runs").iterdir()
    return folder


def test_of_a_good_site_nothing_is_missing(script: ModuleType, site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert list(script.faults(site)) == []
    script.main(str(site))
    assert capsys.readouterr().out == f"{site}: nothing is missing\n"


def change_a_number(site: Path) -> None:
    path = run_of(site) / "tables" / "cells.csv"
    table = pd.read_csv(path)
    table.loc[0, "error_u_mean"] *= 1.01
    table.to_csv(path, index=False)


def change_a_row(site: Path) -> None:
    with closing(sqlite3.connect(run_of(site) / FILE)) as connection, connection:
        connection.execute("UPDATE cells SET online_s = 0.5 * online_s")


def change_versions(site: Path) -> None:
    path = run_of(site) / "provenance.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | {"versions": {"numpy": "9"}}))


@pytest.mark.parametrize(
    ("break_it", "said"),
    [
        (lambda site: (site / "citation.bib").unlink(), "citation.bib is missing"),
        (lambda site: shutil.rmtree(site / "runs"), "there are no runs in the folder runs"),
        (lambda site: (run_of(site) / "requirements.txt").unlink(), "requirements.txt is missing"),
        (change_a_number, "tables/cells.csv has other values of error_u_mean than the results file"),
        (change_a_row, f"{FILE}: "),  # the digests say so
        (change_versions, f"provenance.json has other versions than {FILE}"),
    ],
)
def test_what_is_wrong_is_named(
    break_it: Callable[[Path], None], said: str, script: ModuleType, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    break_it(copied)
    assert any(said in line for line in script.faults(copied))
    with pytest.raises(SystemExit) as ended:
        script.main(str(copied))
    assert ended.value.code == 1
    assert said in capsys.readouterr().out


def test_another_protocol_and_residuals_above_the_accuracy_are_named(script: ModuleType, quick_run: Path) -> None:
    cells, queries = (read_table(quick_run / FILE, name) for name in ("cells", "queries"))
    earlier = cells.assign(versions=cells["versions"].str.replace(f'"protocol": "{PROTOCOL}"', '"protocol": "0"'))
    assert any(f"protocol 0, expected {PROTOCOL}" in line for line in script.of_cells(earlier))
    assert any("never timed" in line for line in script.of_cells(cells.assign(timing_rounds=0)))
    kinds = cells.set_index("cell")["enrichment_kind"]
    assert any("dual_residual" in line for line in script.of_queries(queries.assign(dual_residual=1.0), kinds))
    assert list(script.of_queries(queries, kinds)) == []
