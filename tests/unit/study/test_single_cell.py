import json
from collections import Counter
from pathlib import Path

import pytest
from running import Changed, Main, refused, succeeded

from vibench.execution.recorded_cell import recorded_study
from vibench.results import formats
from vibench.results.read import read_table
from vibench.results.sqlite import FILE
from vibench.study.cells import Cell
from vibench.study.matrix import expand, read_study, study_of_cell


@pytest.mark.parametrize("name", ["quick", "benefit", "hertz-quadrature", "paper-hertz"])
def test_a_study_of_one_cell_has_the_same_cell(name: str) -> None:
    """With prescribed sizes, tolerances by strategy, options, labels and reduced assembly."""
    cells = expand(read_study(name))
    for cell in (*cells[:4], *cells[-4:], *cells[:: max(len(cells) // 8, 1)]):
        (again,) = expand(study_of_cell(cell, name))
        assert (again.key, str(again), again.code) == (cell.key, str(cell), cell.code)


def test_a_row_is_made_again_from_its_results_file_or_an_older_definition(quick_run: Path, main: Main) -> None:
    named = str(quick_run.with_suffix(".toml"))
    cell = expand(read_study(named))[0]
    older = json.loads(cell.definition)
    for name in ("training", "validation_sampling", "set_labels", "formulation", "formulation_label", "bounds"):
        del older[name]
    assert Cell.from_definition(json.dumps(older)) == cell
    certified = Cell.from_definition(json.dumps(older | {"assembly": "certified"}))
    assert (certified.assembly, certified.bounds) == ("reduced", True)
    row = read_table(quick_run / FILE, "cells").iloc[3]
    study = recorded_study(str(quick_run / FILE), row["cell"][:6])
    assert [cell.key for cell in expand(study)] == [row["cell"]]
    assert (study.name, study.timing_rounds) == ("quick", row["timing_rounds"])
    for source, key in ((str(quick_run / FILE), row["cell"][:6]), (named, row["cell"])):
        out = succeeded(main("run", source, "--cell", key, "--dry-run"))
        assert out == f"{row['cell']}  {formats.name_of_cell(row)}\n1 cells\n"


def test_a_cell_is_found_by_its_beginning_or_refused(quick_run: Path, changed: Changed, main: Main) -> None:
    results = str(quick_run / FILE)
    refused(main("run", results, "--cell", "xyz"), "0 cells", "begin with 'xyz'", "expected one")
    refused(main("run", "quick", "--cell", "xyz"), "0 cells of 'quick' begin", "`vibench run quick --dry-run` lists")
    ((digit, count),) = Counter(cell.key[0] for cell in expand(read_study("quick"))).most_common(1)
    refused(main("run", "quick", "--cell", digit, "--dry-run"), f"{count} cells of 'quick' begin with '{digit}'")
    refused(main("run", results, "--cell", "a", "--solver", "piqp"), "leave out solvers")
    for definition in ("", "[]", "{}", '{"problem": 3}'):
        broken = changed(f"UPDATE cells SET definition = '{definition}'")
        key = read_table(broken, "cells")["cell"].iloc[0]
        refused(main("run", str(broken), "--cell", key), key, "cannot be read")
