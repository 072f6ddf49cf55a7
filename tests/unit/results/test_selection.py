import contextlib
import hashlib
import sqlite3
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from running import refusal

from vibench import RequestError
from vibench.results.selection import matching, parts, short_keys, sorted_by

FRAME = pd.DataFrame(columns=["cell", "solver", "N", "beta_span_min"])


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("selected") / "results.sqlite"
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE cells (cell TEXT PRIMARY KEY, solver TEXT, N INTEGER, beta_span_min REAL)")
    db.execute("CREATE INDEX of_solver ON cells(solver)")
    rows = [("c", "piqp", 8, 1e-4), ("a", "osqp", 9, 0.5), ("b", "piqp", 10, None), ("d", "it's", 11, 0.1)]
    db.executemany("INSERT INTO cells VALUES (?, ?, ?, ?)", rows)
    db.execute("CREATE TABLE meta (key TEXT, value TEXT)")
    db.execute("INSERT INTO meta VALUES ('seed', '1')")
    db.commit()
    db.close()
    return path


def test_conditions_select_rows_and_whatever_else_is_refused_in_one_line(file: Path) -> None:
    for condition, rows in (
        ("solver = 'piqp' and beta_span_min < 1e-3", [0]),
        ("solver = 'piqp'", [0, 2]),  # in the order of the rows, not of an index
        ("beta_span_min is null", [2]),
        ("not beta_span_min > 0.2", [0, 3]),  # a missing value is neither
        ("solver like 'P%' or N in (9, 12)", [0, 1, 2]),
        ("(N between 9 and 10)", [1, 2]),
        ("solver = 'it''s'", [3]),
        ("solver != 'a; -- \"' and N + 1 > 9", [1, 2, 3]),
    ):
        assert [k for k, found in enumerate(matching(file, "cells", condition, FRAME)) if found] == rows
    for condition in (
        "", "solver =", "N > 1; DROP TABLE cells", "1) UNION SELECT 1 FROM meta WHERE (1", "1) OR (1", "(1",
        "cell IN (SELECT key FROM meta)", "EXISTS (SELECT 1)", "(SELECT 1)", "randomblob(1000000000) > 1",
        "load_extension('x')", "max(N) > 1", "count(*) OVER () > 1", "current_timestamp > 1", "1 -- a", "1 /* a */",
        'solver = "piqp"', "[N] > 1", "`N` > 1", "N = :a", "N = ?", "1 FROM meta", "N > 1 LIMIT 1",
        "(WITH RECURSIVE a(x) AS (SELECT 1 UNION ALL SELECT x FROM a) SELECT x FROM a)", "'", "a" * 2000,
        "(" * 500 + "1" + ")" * 500, "N REGEXP 'a'", "PRAGMA user_version",
    ):  # fmt: skip
        before = hashlib.sha256(file.read_bytes()).digest()
        assert "--where" in refusal(matching, file, "cells", condition, FRAME)
        assert hashlib.sha256(file.read_bytes()).digest() == before


def test_rows_are_sorted_up_and_down_names_stand_between_commas_and_wrong_ones_have_hints(file: Path) -> None:
    with pytest.raises(RequestError, match="no column of cells is called 'beta_spn_min'; did you mean 'beta_span_min'"):
        matching(file, "cells", "beta_spn_min < 1", FRAME)
    frame = pd.DataFrame({"a": [2.0, None, 1.0, 2.0], "b": [1, 2, 3, 4]})
    assert list(sorted_by(frame, ["a"], "cells")["b"]) == [3, 1, 4, 2]
    assert list(sorted_by(frame, ["-a", "-b"], "cells")["b"]) == [4, 1, 3, 2]
    with pytest.raises(RequestError, match="no column of cells is called 'c'"):
        sorted_by(frame, ["-c"], "cells")
    assert (parts("a, b,,online [ms]"), parts("")) == (["a", "b", "online [ms]"], [])


@given(st.text(max_size=30))
def test_any_text_selects_rows_or_is_refused(file: Path, text: str) -> None:
    with contextlib.suppress(RequestError):
        assert len(matching(file, "cells", text, FRAME)) == 4


@given(st.sets(st.text("0123456789abcdef", min_size=16, max_size=16), min_size=1, max_size=20))
def test_a_short_key_is_the_beginning_of_one_key(keys: set[str]) -> None:
    length = short_keys(keys)
    assert len({key[:length] for key in keys}) == len(keys)
    assert length == 4 or len({key[: length - 1] for key in keys}) < len(keys)
