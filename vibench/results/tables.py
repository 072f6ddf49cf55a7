"""Tables of a run, read from its results file."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType, NoneType

import pandas as pd

from vibench.errors import RequestError
from vibench.files import write_atomically
from vibench.interfaces.formulations import MIXED
from vibench.qp.status import Status
from vibench.results import plugin_columns
from vibench.results.columns import (
    BLOB,
    CELLS,
    INTEGER,
    KEYS,
    PARAMETER,
    REAL,
    STORED,
    TABLES,
    TEXT,
    THRESHOLDS,
    VERSION,
    Column,
    shown_columns,
)
from vibench.results.costs import ranking
from vibench.results.costs.break_even import Meaning
from vibench.results.formats import asked, break_even, csv_lines, decimal_interval, interval, to_csv, to_markdown
from vibench.results.plugin_columns import Extended
from vibench.results.sqlite.reading import FILE, Part, read_meta, read_parts, read_rows
from vibench.study.cells import UNCORRECTED
from vibench.text import brief, json_object

ORDER = (
    *KEYS, "formulation_a", "formulation_b", "primal_a", "primal_b", "primal_tol_a", "primal_tol_b", "assembly_a",
    "assembly_b", "stage", "quantity", "query", "step",
)  # fmt: skip
"""Columns by which rows are sorted, where a table has them."""


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
    raise RequestError(f"no results in '{run}': expected a folder with {FILE}, as `vibench run` makes under runs/")


def read(path: Path, table: str, cells: Sequence[str] = ()) -> pd.DataFrame:
    """One table of a results file, or its rows of some cells, in the order in which they were written.

    Raises a `RequestError` if they are damaged, or have a value that is none of its column.
    """
    return _framed(path, table, read_rows(path, table, cells))


def read_in_parts(path: Path, table: str) -> Iterator[pd.DataFrame]:
    """One table as `read` gives it, some thousand rows at a time, since it may be larger than memory.

    Raises a `RequestError` as `read`; of damage after the last part.
    """
    return (_framed(path, table, part) for part in read_parts(path, table))


def _framed(path: Path, table: str, part: Part) -> pd.DataFrame:
    names, rows = _checked(path, table, part)
    frame = pd.DataFrame.from_records(rows, columns=names, coerce_float=True)
    for name in names:
        if not _column(table, name).kind.startswith((TEXT, BLOB)) and not pd.api.types.is_numeric_dtype(frame[name]):
            frame[name] = frame[name].astype(float)  # every value is NULL
    return frame


def _checked(path: Path, table: str, part: Part) -> Part:
    """Rows as they are; a `RequestError` if one has a value that is none of its column."""
    names, rows = part
    for name, values in zip(names, zip(*rows, strict=True), strict=False):  # no values where there are no rows
        kind = _column(table, name).kind
        types = set(map(type, values)) - {NoneType}
        if kind.startswith(BLOB) or (types <= {int, float} and kind.startswith((REAL, INTEGER))):
            continue
        is_right, right = A_NUMBER if kind.startswith((REAL, INTEGER)) else RIGHT.get(name, A_TEXT)
        for value in dict.fromkeys(values):
            if value is not None and not is_right(value):
                strange = f"{brief(repr(value), 60)} in the column '{name}' of '{table}'"
                raise RequestError(f"'{path}' has {strange}, expected {right}")
    return part


def _column(table: str, name: str) -> Column:
    return STORED[table].get(name, PARAMETER)


A_NUMBER = (lambda value: isinstance(value, float | int)), "a number"
A_TEXT = (lambda value: isinstance(value, str)), "a text"
RIGHT: Mapping[str, tuple[Callable[[object], bool], str]] = {
    "meaning": (set(Meaning).__contains__, f"one of {', '.join(Meaning)}"),
    "versions": (lambda value: json_object(value) is not None, "a JSON object"),
}
"""What the values of some columns of texts have to be, and how it is said."""


def extended(path: Path, table: str, cells: Sequence[str] = ()) -> Extended:
    """One table of a results file with the columns that plugins add to it, in the order in which it was written.

    With `cells`, only the rows of these are read: no plugin may add a column to the table, which may depend on others.

    Raises a `RequestError` if it is damaged; what is wrong with a plugin is among the faults instead.
    """
    return plugin_columns.extended_tables((table,), partial(read, path, cells=cells))[table]


def extended_tables(path: Path, names: Collection[str]) -> dict[str, Extended]:
    """Several tables of a results file, as `extended` reads one; plugins are loaded once for all of them.

    Raises a `RequestError` if one is damaged.
    """
    return plugin_columns.extended_tables(names, partial(read, path))


SUMMARY = "summary.md"
EXPORTED = (*(f"{table}.csv" for table in TABLES), SUMMARY)
"""Names of the files that `export` writes."""


def measured(path: Path, measure: str = ranking.SOLUTION) -> tuple[pd.DataFrame, pd.Series]:
    """The recorded cells of a results file, and the error of each by a measure.

    Raises a `RequestError` if there is no such measure, or the file cannot be read.
    """
    cells = read(path, "cells")
    return cells, ranking.errors_of(cells, read(path, "outputs"), measure)


def export(path: Path, folder: Path, note: Callable[[str], None] = lambda _: None) -> list[Path]:
    """Write every table as CSV and the summary as Markdown into a folder; returns the files.

    `note` is called with a line for every column of a plugin that could not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # The other tables are written as they are read: queries may be more than memory holds.
    whole = extended_tables(path, [name for name in TABLES if name == "cells" or plugin_columns.is_extended(name)])
    for line in plugin_columns.faults_of(whole.values()):
        note(line)
    texts: dict[str, Iterable[str]] = {
        f"{name}.csv": [to_csv(whole_numbers(in_order(whole[name].frame)))] if name in whole else _csv_parts(path, name)
        for name in TABLES
    }
    texts[SUMMARY] = [to_markdown(summary(whole["cells"].frame, whole["cells"].columns))]
    for name, parts in texts.items():
        write_atomically(folder / name, (part.encode("utf-8") for part in parts))
    return [folder / name for name in texts]


def _csv_parts(path: Path, table: str) -> Iterator[str]:
    """A table without columns of plugins as CSV, in the order of `in_order`, part by part."""
    header = True
    for part in read_parts(path, table, order=terms_in_order(STORED[table])):
        names, rows = _checked(path, table, part)
        yield csv_lines([names, *rows] if header else rows)
        header = False


def in_order(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows sorted by the columns that identify them, loose tolerances first, whatever order cells finished in."""
    by = [name for name in ORDER if name in frame.columns]
    ascending = [_rises(name) for name in by]
    return frame.sort_values(
        by, ascending=ascending, kind="stable", na_position="first", ignore_index=True, key=_without_correction_first
    )


def terms_in_order(names: Collection[str]) -> list[str]:
    """The order of `in_order` as terms of SQL, for a table with columns of these names."""
    by = [name for name in ORDER if name in names and name != "correction"]
    terms = {name: f'"{name}" IS NOT NULL, "{name}" {"ASC" if _rises(name) else "DESC"}' for name in by}
    terms |= {"correction": f"correction IS NOT '{UNCORRECTED}'"} if "correction" in names else {}
    return [*(terms[name] for name in ORDER if name in terms), "rowid"]


def _rises(name: str) -> bool:
    """Whether the smallest value of a column comes first."""
    return "_tol" not in name


def _without_correction_first(column: pd.Series) -> pd.Series:
    return column != UNCORRECTED if column.name == "correction" else column


def summary(cells: pd.DataFrame, plugins: Mapping[str, Column] = MappingProxyType({})) -> pd.DataFrame:
    """The summary of a run: one row per cell, the columns with a heading in `CELLS`, and those of plugins with one."""
    return _for_reading(in_order(cells), {**CELLS, **plugins})


def benefits(thresholds: pd.DataFrame, plugins: Mapping[str, Column] = MappingProxyType({})) -> pd.DataFrame:
    """The break-even table: the number of queries from which, or until which, b is cheaper than a."""
    return _for_reading(in_order(thresholds), {**THRESHOLDS, **plugins})


def between_formulations(thresholds: pd.DataFrame) -> pd.Series:
    """Which break-evens are those of a formulation with another one, the high-fidelity model apart."""
    return thresholds["cell_a"].notna() & (thresholds["formulation_a"] != thresholds["formulation_b"])


def _for_reading(frame: pd.DataFrame, table: Mapping[str, Column]) -> pd.DataFrame:
    """The columns that have a heading, under it; some only where they say something."""
    return under_headings(frame, [name for name in shown_columns(table) if says_something(frame, name)], table)


USUAL = {
    "correction": UNCORRECTED, "certificate": "none",
    **dict.fromkeys(("formulation", "formulation_a", "formulation_b"), MIXED),
}  # fmt: skip
"""Values of columns that say nothing where all cells have them."""


def says_something(frame: pd.DataFrame, name: str) -> bool:
    """Whether to show a column unasked: accuracy and training sets if they vary, corrections and zeros if any."""
    if name == "accuracy":
        return bool(frame[name].nunique() > 1)
    if name in USUAL:
        return bool((~frame[name].dropna().isin([USUAL[name], ""])).any())
    if name in ("training", "snapshots"):
        return bool(frame["training"].nunique() > 1)
    if name == "rounds_missing":
        return bool((frame["meaning"] == Meaning.UNDECIDED).any())
    if name == "status":
        return bool((frame[name] != Status.OK).any())
    zero = re.fullmatch(r"queries_zero_(u|lambda)|error_(u|lambda)_zero_max", name)
    return zero is None or bool((frame[f"queries_zero_{zero[1] or zero[2]}"] > 0).any())


def under_headings(frame: pd.DataFrame, names: Sequence[str], table: Mapping[str, Column]) -> pd.DataFrame:
    """Columns of a table under their headings, in the form and unit that these name; others as they are."""
    headed = {name: column for name, column in table.items() if column.heading}
    shown = {
        headed[name].heading if name in headed else name: _shown(frame, name, headed[name])
        if name in headed
        else frame[name]
        for name in names
    }
    return pd.DataFrame(shown, index=frame.index)


INTERVALS: Mapping[str, tuple[str, Callable[..., str]]] = {
    "threshold_high": ("threshold_low", interval), "total_high_s": ("total_low_s", decimal_interval),
}  # fmt: skip
"""Columns that are shown as the upper end of an interval: its lower end, and how it is written."""


def _shown(frame: pd.DataFrame, name: str, column: Column) -> pd.Series | list[str]:
    """One column under its heading; some combine several columns of the results file."""
    if name in ("pod_tol", "dual_tol"):
        axis = name.removesuffix("_tol")
        return [asked(row, axis) for row in frame[[name, f"{axis}_size"]].to_dict("records")]
    if name == "queries_ok":
        return [f"{fine:.0f}/{count:.0f}" for fine, count in zip(frame[name], frame["queries"], strict=True)]
    if name == "benefit_threshold":
        return [break_even(*row) for row in zip(frame["meaning"], frame[name], strict=True)]
    if name in INTERVALS:
        low, shown = INTERVALS[name]
        return [shown(*ends) for ends in zip(frame[low], frame[name], strict=True)]
    if column.kind == INTEGER:
        return frame[name].astype("Int64")
    return 1e3 * frame[name] if column.unit == "s" and column.heading.endswith("[ms]") else frame[name]


def whole_numbers(frame: pd.DataFrame) -> pd.DataFrame:
    """A table of the results file with whole numbers where its columns hold them: a missing one makes them floats."""
    whole = {name: "Int64" for name in frame.columns if name in WHOLE and frame[name].dtype.kind in "if"}
    return frame.astype(whole)


WHOLE = {name for table in TABLES.values() for name, column in table.items() if column.kind == INTEGER}
"""Columns of whole numbers; no name is a column of whole numbers in one table and of others in another."""
