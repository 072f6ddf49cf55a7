"""Names of parameters: recorded beside the rows, and shown where mu_1 would stand."""

from pathlib import Path

import pandas as pd
import pytest
from samples import cell_row, query_rows

from vibench.errors import RequestError
from vibench.results.database import ResultsDatabase
from vibench.results.show import Table, look_up
from vibench.results.sqlite import FILE, parameters_of

NAMES = (("radius", "m"), ("friction", "1"))


def write(journal: ResultsDatabase, problem: str, *names: tuple[str, str]) -> None:
    rows = [row | {"problem": problem} for row in query_rows(problem)]
    journal.write_cell(cell_row(problem, problem=problem), rows, parameters=names)


def queries(tmp_path: Path, **asked: object) -> Table:
    return look_up(tmp_path / "run" / FILE, "queries", **asked)


def test_names_are_shown_to_readers_and_asked_for_by_either_name(journal: ResultsDatabase, tmp_path: Path) -> None:
    write(journal, "disc", *NAMES)
    table = queries(tmp_path)
    assert {"radius [m]", "friction"} <= set(table.readable.columns)
    assert not {"mu_1", "mu_2"} & {*table.readable.columns, *table.priority}
    assert {"mu_1", "mu_2"} <= set(table.exact.columns)
    asked = queries(tmp_path, columns=["query", "radius"], sort=["-radius"])
    assert list(asked.readable.columns) == ["query", "radius [m]"]
    pd.testing.assert_frame_equal(asked.rows, queries(tmp_path, columns=["query", "mu_1"], sort=["-mu_1"]).rows)
    assert list(asked.rows["query"]) == [1, 0]


def test_names_of_several_problems_stand_side_by_side(journal: ResultsDatabase, tmp_path: Path) -> None:
    write(journal, "disc", *NAMES)
    write(journal, "rope", ("load", "N"))
    assert {"radius [m] / load [N]", "friction"} <= set(queries(tmp_path).readable.columns)
    assert "load [N]" in queries(tmp_path, where="problem = 'rope'").readable.columns


@pytest.mark.parametrize("name", ["status", "mu_2"])
def test_a_parameter_called_like_a_column_takes_no_place(journal: ResultsDatabase, tmp_path: Path, name: str) -> None:
    write(journal, "disc", (name, "1"))
    table = queries(tmp_path, columns=[name, "mu_1"])
    assert list(table.exact.columns) == [name, "mu_1"]
    assert list(table.readable.columns) == [name, "mu_1"]


def test_results_without_names_have_columns_all_the_same(journal: ResultsDatabase, tmp_path: Path) -> None:
    write(journal, "disc")
    assert "mu_1" in queries(tmp_path).readable.columns


def test_names_are_written_again_where_they_changed_or_refused_in_a_line(
    journal: ResultsDatabase, tmp_path: Path
) -> None:
    for names in (NAMES, NAMES, NAMES[::-1]):
        write(journal, "disc", *names)
        assert parameters_of(tmp_path / "run" / FILE) == {"disc": list(names)}
    path = tmp_path / "run" / FILE
    journal._db.execute("UPDATE meta SET value = '[1, 2]' WHERE key LIKE 'parameters of %'")
    journal._digests.forget(name="meta")
    journal._digests.count("meta")
    journal._db.commit()
    with pytest.raises(RequestError, match=r"has '\[1, 2\]' as the parameters of disc, expected pairs of texts"):
        parameters_of(path)
