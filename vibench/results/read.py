"""Tables of a run, read from its results file."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from types import NoneType

import pandas as pd

from vibench.errors import RequestError
from vibench.model.bound_terms import CorrectionMode
from vibench.results import ranking
from vibench.results.break_even import Meaning
from vibench.results.schema import KEYS, STORED, TABLES, VERSION, Column, SqlType, column_of
from vibench.results.sqlite import FILE, Part, read_meta, read_parts, read_rows
from vibench.text import brief, json_object, shown


def results_file(run: str) -> Path:
    """Results file of a run: a results file, its folder, or the name of a study under `runs/`.

    Raises a `RequestError` if there is no results file, or its schema has another version.
    """
    for folder in (Path(run), Path("runs") / run):
        # os.path, since methods of Path raise OSError for names too long for a file.
        path = folder if os.path.isfile(folder) else folder / FILE  # noqa: PTH113
        if os.path.isfile(path):  # noqa: PTH113
            schema = read_meta(path).get("schema")
            if schema != str(VERSION):
                raise RequestError(f"'{path}' has schema {schema}, this vibench reads {VERSION}")
            return path
    raise RequestError(
        f"no results in '{brief(str(run), 300)}': expected a folder with {FILE}, as `vibench run` makes under runs/"
    )


def read_table(path: Path, table: str, cells: Sequence[str] = ()) -> pd.DataFrame:
    """One table of a results file, or its rows of some cells, in the order in which they were written.

    Raises a `RequestError` if they are damaged, or have a value that is none of its column.
    """
    return _framed(path, table, read_rows(path, table, cells))


def read_in_parts(path: Path, table: str) -> Iterator[pd.DataFrame]:
    """One table as `read_table` gives it, some thousand rows at a time; errors of damage come after the last part."""
    return (_framed(path, table, part) for part in read_parts(path, table))


def _framed(path: Path, table: str, part: Part) -> pd.DataFrame:
    names, rows = checked(path, table, part)
    frame = pd.DataFrame.from_records(rows, columns=names, coerce_float=True)
    for name in names:
        if column_of(table, name).kind.is_number and not pd.api.types.is_numeric_dtype(frame[name]):
            frame[name] = frame[name].astype(float)  # every value is NULL
    return frame


def checked(path: Path, table: str, part: Part) -> Part:
    """Rows as they are; a `RequestError` if one has a value that is none of its column."""
    names, rows = part
    for name, values in zip(names, zip(*rows, strict=True), strict=False):  # no values where there are no rows
        column = column_of(table, name)
        kind = column.kind
        types = set(map(type, values)) - {NoneType}
        if kind == SqlType.BLOB or (types <= {int, float} and kind.is_number):
            continue
        is_right, right = _expected(column, name)
        for value in dict.fromkeys(values):
            if value is not None and not is_right(value):
                strange = f"{shown(value)} in the column '{name}' of '{table}'"
                raise RequestError(f"'{path}' has {strange}, expected {right}")
    return part


def _expected(column: Column, name: str) -> tuple[Callable[[object], bool], str]:
    if column.kind.is_number:
        return lambda value: isinstance(value, float | int), "a number"
    if name == "meaning":
        return set(Meaning).__contains__, f"one of {', '.join(Meaning)}"
    if name == "versions":
        return lambda value: json_object(value) is not None, "a JSON object"
    return lambda value: isinstance(value, str), "a text"


def cells_with_errors(path: Path, measure: str = "solution") -> tuple[pd.DataFrame, pd.Series]:
    """The recorded cells of a results file, and the error of each by a measure; a `RequestError` if it is unknown."""
    cells = read_table(path, "cells")
    return cells, ranking.errors_of(cells, read_table(path, "outputs"), measure)


def _order(names: Collection[str]) -> list[str]:
    order = (
        *KEYS, "formulation_a", "formulation_b", "primal_a", "primal_b", "primal_tol_a", "primal_tol_b", "assembly_a",
        "bounds_a", "assembly_b", "bounds_b", "stage", "quantity", "query", "step",
    )  # fmt: skip
    return [name for name in order if name in names]


def in_order(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows sorted by the columns that identify them, loose tolerances first, whatever order cells finished in."""
    by = _order(frame.columns)
    # Cells without correction come first.
    return frame.sort_values(
        by, ascending=list(map(_rises, by)), kind="stable", na_position="first", ignore_index=True,
        key=lambda column: column != CorrectionMode.NONE if column.name == "correction" else column,
    )  # fmt: skip


def terms_in_order(names: Collection[str]) -> list[str]:
    """The order of `in_order` as terms of SQL, for a table with columns of these names."""
    terms = {name: f'"{name}" IS NOT NULL, "{name}" {"ASC" if _rises(name) else "DESC"}' for name in _order(names)}
    if "correction" in terms:
        terms["correction"] = f"correction IS NOT '{CorrectionMode.NONE}'"
    return [*terms.values(), "rowid"]


def _rises(name: str) -> bool:
    return "_tol" not in name


def whole_numbers(frame: pd.DataFrame) -> pd.DataFrame:
    """A table with integers in columns of integers: pandas makes them floats where one is missing."""
    # No name is a column of integers in one table and of others in another.
    whole = {name for table in TABLES for name, column in STORED[table].items() if column.kind == SqlType.INTEGER}
    return frame.astype({name: "Int64" for name in frame.columns if name in whole and frame[name].dtype.kind in "if"})
