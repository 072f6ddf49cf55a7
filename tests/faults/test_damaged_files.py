"""Damaged results files and artefacts: any bit, any length; it is found, or without effect on any number."""

import random
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from running import Main, execute, rows
from samples import write_study

from vibench import RequestError
from vibench.execution import run  # noqa: F401  lists the classes of all stages
from vibench.report.comparison import compare
from vibench.results.database import ResultsDatabase
from vibench.results.read import results_file
from vibench.results.schema import STORED
from vibench.results.sqlite import FILE, read_meta, read_rows, study_of
from vibench.stages.artefacts import Store, dumps

STUDY = {
    "name": "small", "seed": 3, "validation": 2, "solvers": ["piqp", "osqp"], "dual": ["mcpg"],
    "primal": ["decorrelated", "offline-pga"], "assembly": ["full", "reduced"],
    "problem": [{"name": "radial-obstacle", "options": {"resolution": 200}}],
    "tolerances": [{"pod": [1e-1], "dual": [1e-1], "primal": {"offline-pga": [0.5]}}], "timing_rounds": 2,
}  # fmt: skip


Damage = Callable[[bytes], bytes]


@pytest.fixture(scope="module")
def made(vibench: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    write_study(folder, STUDY)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VIBENCH_CACHE", str(folder / "cache"))
        done = vibench(folder, "run", "study.toml", "--jobs", "1", "--out", "out")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def results(made: Path, tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    shutil.copy(made / "out" / FILE, tmp_path / "run" / FILE)
    return tmp_path / "run" / FILE


def flips(seed: int, count: int, first: int = 0) -> Iterator[Damage]:
    """Damages of one bit each, every third among the first bytes, such as the header and the schema of a file."""
    rng = random.Random(seed)

    def flip(content: bytes, at: float, bit: int, end: int) -> bytes:
        changed = bytearray(content)
        changed[int(at * (end or len(content)))] ^= 1 << bit
        return bytes(changed)

    for k in range(count):
        at, bit, end = rng.random(), rng.randrange(8), first if k % 3 == 0 else 0
        yield lambda content, at=at, bit=bit, end=end: flip(content, at, bit, end)


def truncations(seed: int, count: int) -> Iterator[Damage]:
    """Damages that leave the beginning of a file, every second one whole pages of it."""
    rng = random.Random(seed)
    for k in range(count):
        share, page = rng.random(), 4096 if k % 2 else 1
        yield lambda content, share=share, page=page: content[: int(share * len(content)) // page * page]


def everything(path: Path) -> list[Any]:
    found = results_file(str(path))
    read = [[names, *rows] for names, rows in (read_rows(found, table) for table in STORED)]
    return [study_of(found, read_meta(found)), *read]


def change(path: Path, *statements: str) -> None:
    """Change rows behind the back of their digests."""
    with closing(sqlite3.connect(path)) as db:
        for statement in statements:
            db.execute(statement)
        db.commit()


def refusal(path: Path) -> str:
    with pytest.raises(RequestError) as caught:
        everything(path)
    return str(caught.value)


MANY = pytest.param(flips(3, 3000, 8192), marks=pytest.mark.long, id="many flips")


@pytest.mark.parametrize("damages", [flips(1, 90, 8192), truncations(2, 60), MANY], ids=["flips", "truncations", None])
def test_damage_of_a_results_file_is_found_or_harmless(damages: Iterator[Damage], made: Path, results: Path) -> None:
    """As the file itself says it is: its digests are those that were written with it."""
    content, original = results.read_bytes(), everything(results)
    harmless, lines = 0, list[str]()
    for damage in damages:
        results.write_bytes(damage(content))
        try:
            found = everything(results)
        except RequestError as error:
            lines.append(str(error))
            continue
        assert found == original
        harmless += 1
        if harmless < 4:
            changes = compare([made / "out" / FILE, results], 1.0).changes
            assert not len(changes)
    assert len(lines) > 20
    assert [line for line in lines if not line.isprintable() or str(results.parent) not in line] == []


@pytest.mark.long
def test_every_number_of_a_results_file_is_watched(results: Path) -> None:
    """One value of every column that has one, changed in its last bit or letter."""
    with closing(sqlite3.connect(results)) as db:
        db.execute("PRAGMA synchronous=OFF")
        for table, columns in {"meta": ("value",), **STORED}.items():
            for column in columns:
                keys = db.execute(f"SELECT rowid, {column} FROM {table} WHERE {column} IS NOT NULL").fetchone()
                if keys is None:
                    continue
                row, value = keys
                other = value + "x" if isinstance(value, str) else value + b"x" if isinstance(value, bytes) else -value
                if other == value:
                    other = value + 1
                db.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (other, row))
                db.commit()
                assert "is damaged" in refusal(results) or (table, column) == ("meta", "value")
                db.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (value, row))
                db.commit()
        for table in STORED:
            db.execute(f"CREATE TABLE kept AS SELECT * FROM {table} LIMIT 1")
            if db.execute(f"DELETE FROM {table} WHERE rowid = (SELECT min(rowid) FROM {table})").rowcount:
                db.commit()
                assert f"in the table '{table}' are not those that were written" in refusal(results)
                db.execute(f"INSERT INTO {table} SELECT * FROM kept")
            db.execute("DROP TABLE kept")
            db.commit()
        everything(results)


def test_what_sqlite_says_of_a_schema_is_printable(results: Path) -> None:
    damage = "UPDATE sqlite_master SET sql = replace(sql, '(', char(5)) WHERE name = 'timings'"
    change(results, "PRAGMA writable_schema=ON", damage)
    assert refusal(results).endswith('malformed database schema (timings) - unrecognized token: "\\u0005"')


def test_commands_refuse_a_damaged_cell_by_its_name(results: Path, main: Main) -> None:
    cell = rows(results.parent)[0]["cell"]
    tables = {"cells": "online_s", "queries": "error_u"}
    change(results, *(f"UPDATE {t} SET {c} = {c} * (1 + 1e-15) WHERE cell = '{cell}'" for t, c in tables.items()))
    folder = str(results.parent)
    line = f"vibench: '{results}' is damaged: rows of the cell {cell} in the table"
    for command in (
        ("show", folder),
        ("show", folder, "--table", "queries", "--format", "json"),
        ("report", folder, "--no-figures"),
        ("compare", folder, folder, "--table", "changes"),
        ("compare", folder, folder),
        ("replay", folder, cell),
        ("export", folder, "set"),
    ):
        code, _, errors = main(*command)
        assert (code, errors.startswith(line), errors.count("\n")) == (2, True, 1), errors
    assert main("show", folder, "--table", "thresholds")[0] == 0  # which has no part in it
    assert not (results.parent / "report.html").exists()


def test_of_the_first_rows_alone_damage_is_noticed_in_their_cells(results: Path, main: Main) -> None:
    with closing(sqlite3.connect(results)) as db:
        order = "problem, dual, primal, primal_tol DESC, solver, pod_tol DESC, dual_tol DESC"
        first, *_, last = [cell for (cell,) in db.execute(f"SELECT cell FROM cells ORDER BY {order}")]
    change(results, f"UPDATE queries SET error_u = error_u * (1 + 1e-15) WHERE cell = '{last}'")
    shown = ("show", str(results.parent), "--table", "queries", "--limit", "1")
    assert main(*shown)[0] == 0
    code, _, errors = main("show", str(results.parent), last, "--table", "queries", "--limit", "1")
    assert (code, f"rows of the cell {last} in the table 'queries'" in errors) == (2, True)
    change(results, f"DELETE FROM queries WHERE cell = '{first}' AND query = 1")
    code, _, errors = main(*shown)
    assert (code, f"rows of the cell {first} in the table 'queries'" in errors) == (2, True)


@pytest.mark.long
def test_a_resumed_run_computes_damaged_cells_again(made: Path, results: Path, vibench: Callable[..., Any]) -> None:
    shutil.copy(made / "study.toml", results.parent.parent)
    first, second = sorted(row["cell"] for row in rows(results.parent))[:2]
    change(results, f"UPDATE queries SET error_u = 0.0 WHERE cell = '{first}'")
    change(results, f"UPDATE solutions SET x = NULL WHERE cell = '{second}'")
    change(results, "UPDATE thresholds SET benefit_threshold = 1.0")  # made anew by every run
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VIBENCH_CACHE", str(made / "cache"))
        done = vibench(results.parent.parent, "run", "study.toml", "--jobs", "1", "--out", "run")
    assert done.returncode == 0, done.stderr
    assert f"computed again, as their rows were damaged: {first}, {second}" in done.stdout
    changes = compare([made / "out" / FILE, results], 1.0 + 1e-9).changes
    assert not len(changes[~changes["what"].str.contains(r"_s$|break-even")])
    everything(results)


def test_a_damaged_index_is_made_again(made: Path, results: Path) -> None:
    """Rows are read without it; where they are changed it is checked."""
    with closing(sqlite3.connect(results)) as db:
        (root,) = db.execute("SELECT rootpage FROM sqlite_master WHERE name = 'queries_of_cell'").fetchone()
        (size,) = db.execute("PRAGMA page_size").fetchone()
        (cell,) = db.execute("SELECT cell FROM queries LIMIT 1").fetchone()
    content, page = results.read_bytes(), slice((root - 1) * size, root * size)
    damaged = content[page].replace(cell.encode(), b"0" * 16)
    assert damaged != content[page]
    results.write_bytes(content[: page.start] + damaged + content[page.stop :])
    assert everything(results) == everything(made / "out" / FILE)
    database = ResultsDatabase(results.parent, study_of(results, read_meta(results)))
    assert database.damaged == ()
    assert len(database.fine_queries(cell)) == STUDY["validation"]
    database.close()


def test_a_run_is_not_resumed_where_no_cell_explains_the_damage(results: Path) -> None:
    content = results.read_bytes()
    for table in ("histories", "pictures"):
        results.write_bytes(content)
        change(results, f"DELETE FROM {table} WHERE rowid = 1")
        before = rows(results.parent, table)
        said = f"is damaged: rows of the table '{table}' have changed; use another --out"
        with pytest.raises(RequestError, match=said):
            ResultsDatabase(results.parent, study_of(results, read_meta(results)))
        assert rows(results.parent, table) == before
        assert [path.name for path in results.parent.iterdir()] == [FILE]


def test_a_status_that_does_not_exist_is_refused(results: Path, main: Main) -> None:
    """Written by a stranger, with the right digest."""
    content, folder = results.read_bytes(), str(results.parent)
    for table in ("cells", "queries"):
        results.write_bytes(content)
        execute(results.parent, f"UPDATE {table} SET status = 'fine'")
        code, _, errors = main("compare", folder, folder, "--table", "changes")
        assert code == 2
        assert f"has the status 'fine' in '{table}', expected one of ok, inaccurate" in errors


WRONG = {
    ("cells", "online_s", "'fast'"): "a number", ("cells", "online_s", "x'00ff'"): "a number",
    ("cells", "reason", "x'00ff'"): "a text", ("cells", "versions", "'[1, 2]'"): "a JSON object",
    ("thresholds", "meaning", "'sometimes'"): "one of from, until, never, at once, as fast, undecided",
}  # fmt: skip


@pytest.mark.parametrize("command", ["show", "report", "figures", "compare"])
def test_a_value_that_is_none_of_its_column_is_refused(command: str, results: Path, main: Main) -> None:
    """Written by a stranger, with the right digest."""
    content, folder = results.read_bytes(), str(results.parent)
    for (table, column, value), expected in WRONG.items():
        results.write_bytes(content)
        execute(results.parent, f"UPDATE {table} SET {column} = {value} WHERE rowid = 1")
        more = {"show": ["--table", table], "compare": [folder], "report": ["--no-figures"], "figures": []}
        code, _, errors = main(command, folder, *more[command])
        assert code == 2
        assert f"in the column '{column}' of '{table}', expected {expected}" in errors
        assert errors.count("\n") == 1


@pytest.mark.parametrize("damages", [flips(3, 45), truncations(4, 30)], ids=["flips", "truncations"])
def test_damage_of_an_artefact_is_found(damages: Iterator[Damage], made: Path, tmp_path: Path) -> None:
    """Every kind of artefact; the digest covers all of it."""
    paths = sorted((made / "cache" / "artefacts").glob("*.artefact"))
    assert len({path.name.rpartition("-")[0] for path in paths}) >= 15
    for path, damage in zip(paths * 10, damages, strict=False):
        content, key = path.read_bytes(), path.name.removesuffix(".artefact")
        (tmp_path / path.name).write_bytes(damage(content))
        assert Store(tmp_path).get(key) is None
        (tmp_path / path.name).write_bytes(content)
        found = Store(tmp_path).get(key)
        assert dumps(found) == content[32:]  # read and written again, it is the same to the last bit
