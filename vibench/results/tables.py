"""Tables of a run, read from its results file."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd

from vibench.errors import RequestError
from vibench.files import write_atomically
from vibench.qp.status import Status
from vibench.results import error_measures, plugin_columns
from vibench.results.break_even import Meaning
from vibench.results.columns import (
    BLOB,
    CELLS,
    INTEGER,
    KEYS,
    REAL,
    STORED,
    TABLES,
    THRESHOLDS,
    VERSION,
    Column,
    shown_columns,
)
from vibench.results.plugin_columns import Extended
from vibench.results.sqlite.reading import FILE, read_meta, read_rows
from vibench.text import brief, parsed_json, printable_lines, unbroken

ORDER = (
    *KEYS, "primal_a", "primal_b", "primal_tol_a", "primal_tol_b", "assembly_a", "assembly_b", "stage", "quantity",
    "query", "step",
)  # fmt: skip
"""Columns by which rows are sorted, where a table has them."""


def results_file(run: str) -> Path:
    """Results file of a run: a results file, its folder, or the name of a study under `runs/`.

    Raises
    ------
    RequestError
        If there is no results file, or its schema has another version.
    """
    for folder in (Path(run), Path("runs") / run):
        path = folder if folder.is_file() else folder / FILE
        if path.is_file():
            schema = read_meta(path).get("schema")
            if schema != str(VERSION):
                raise RequestError(f"'{path}' has schema {schema}, this vibench reads {VERSION}")
            return path
    raise RequestError(f"no results in '{run}': expected a folder with {FILE}, as `vibench run` makes under runs/")


def read(path: Path, table: str) -> pd.DataFrame:
    """One table of a results file, in the order in which its rows were written.

    Raises
    ------
    RequestError
        If they are damaged, or have a value that is none of its column.
    """
    names, rows = read_rows(path, table)
    frame = pd.DataFrame.from_records(rows, columns=names, coerce_float=True)
    for name, column in STORED.get(table, {}).items():
        if column.kind.startswith(BLOB) or pd.api.types.is_numeric_dtype(frame[name]):
            continue
        number = column.kind.startswith((REAL, INTEGER))
        is_right, right = A_NUMBER if number else RIGHT.get(name, A_TEXT)
        for value in frame[name].dropna().unique():
            if not is_right(value):
                found = f"{brief(repr(value), 60)} in the column '{name}' of '{table}'"
                raise RequestError(f"'{path}' has {found}, expected {right}")
        if number:
            frame[name] = frame[name].astype(float)  # every value is NULL
    return frame


def _is_json_object(value: object) -> bool:
    try:
        return isinstance(value, str) and isinstance(parsed_json(value), dict)
    except ValueError:
        return False


A_NUMBER = (lambda value: isinstance(value, float | int)), "a number"
A_TEXT = (lambda value: isinstance(value, str)), "a text"
RIGHT: Mapping[str, tuple[Callable[[object], bool], str]] = {
    "meaning": (set(Meaning).__contains__, f"one of {', '.join(Meaning)}"),
    "versions": (_is_json_object, "a JSON object"),
}
"""What the values of some columns of texts have to be, and how it is said."""


def extended(path: Path, table: str) -> Extended:
    """One table of a results file with the columns that plugins add to it, in the order in which it was written.

    Raises
    ------
    RequestError
        If it is damaged; what is wrong with a plugin is among the faults instead.
    """
    return extended_tables(path, (table,))[table]


def extended_tables(path: Path, names: Collection[str]) -> dict[str, Extended]:
    """Several tables of a results file, as `extended` reads one; plugins are loaded once for all of them.

    Raises
    ------
    RequestError
        If one is damaged.
    """
    return plugin_columns.extended_tables(names, partial(read, path))


SUMMARY = "summary.md"
EXPORTED = (*(f"{table}.csv" for table in TABLES), SUMMARY)
"""Names of the files that `export` writes."""


def measured(path: Path, measure: str = error_measures.SOLUTION) -> tuple[pd.DataFrame, pd.Series]:
    """The recorded cells of a results file, and the error of each by a measure.

    Raises
    ------
    RequestError
        If there is no such measure, or the file cannot be read.
    """
    cells = read(path, "cells")
    return cells, error_measures.errors_of(cells, read(path, "outputs"), measure)


def export(path: Path, folder: Path, note: Callable[[str], None] = lambda _: None) -> list[Path]:
    """Write every table as CSV and the summary as Markdown into a folder; returns the files.

    `note` is called with a line for every column of a plugin that could not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = extended_tables(path, TABLES)
    for line in plugin_columns.faults_of(found.values()):
        note(line)
    texts = {f"{table}.csv": to_csv(whole_numbers(in_order(one.frame))) for table, one in found.items()}
    texts[SUMMARY] = to_markdown(summary(found["cells"].frame, found["cells"].columns))
    for name, text in texts.items():
        write_atomically(folder / name, text.encode("utf-8"))
    return [folder / name for name in texts]


def in_order(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows sorted by the columns that identify them, loose tolerances first, whatever order cells finished in."""
    by = [name for name in ORDER if name in frame.columns]
    ascending = ["_tol" not in name for name in by]
    return frame.sort_values(by, ascending=ascending, kind="stable", na_position="first", ignore_index=True)


def summary(cells: pd.DataFrame, plugins: Mapping[str, Column] = MappingProxyType({})) -> pd.DataFrame:
    """The summary of a run: one row per cell, the columns with a heading in `CELLS`, and those of plugins with one."""
    return _for_reading(in_order(cells), {**CELLS, **plugins})


def benefits(thresholds: pd.DataFrame, plugins: Mapping[str, Column] = MappingProxyType({})) -> pd.DataFrame:
    """The break-even table: the number of queries from which, or until which, b is cheaper than a."""
    return _for_reading(in_order(thresholds), {**THRESHOLDS, **plugins})


def _for_reading(frame: pd.DataFrame, table: Mapping[str, Column]) -> pd.DataFrame:
    """The columns that have a heading, under it; some only where they say something."""
    return under_headings(frame, [name for name in shown_columns(table) if says_something(frame, name)], table)


def says_something(frame: pd.DataFrame, name: str) -> bool:
    """Whether to show a column unasked: accuracy and training sets where they are an axis, zero solutions if any."""
    if name == "accuracy":
        return bool(frame[name].nunique() > 1)
    if name in ("training", "snapshots"):
        return bool(frame["training"].nunique() > 1)
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


def _shown(frame: pd.DataFrame, name: str, column: Column) -> pd.Series | list[str]:
    """One column under its heading; some combine several columns of the results file."""
    if name in ("pod_tol", "dual_tol"):
        return [asked(row, name.removesuffix("_tol")) for row in frame.to_dict("records")]
    if name == "queries_ok":
        return [f"{fine:.0f}/{count:.0f}" for fine, count in zip(frame[name], frame["queries"], strict=True)]
    if name == "benefit_threshold":
        return [break_even(*row) for row in zip(frame["meaning"], frame[name], strict=True)]
    if name == "threshold_high":
        return [interval(*ends) for ends in zip(frame["threshold_low"], frame[name], strict=True)]
    if column.kind == INTEGER:
        return frame[name].astype("Int64")
    return 1e3 * frame[name] if column.unit == "s" and column.heading.endswith("[ms]") else frame[name]


def whole_numbers(frame: pd.DataFrame) -> pd.DataFrame:
    """A table of the results file with whole numbers where its columns hold them: a missing one makes them floats."""
    whole = {name: "Int64" for name in frame.columns if name in WHOLE and frame[name].dtype.kind in "if"}
    return frame.astype(whole)


WHOLE = {name for table in TABLES.values() for name, column in table.items() if column.kind == INTEGER}
"""Columns of whole numbers; no name is a column of whole numbers in one table and of others in another."""


def to_csv(frame: pd.DataFrame) -> str:
    """CSV with full precision; a text that a spreadsheet would take for a formula has an apostrophe before it."""
    shown = frame.rename(columns=lambda name: _no_formula(str(name)))
    for k, kind in enumerate(frame.dtypes):
        if not pd.api.types.is_numeric_dtype(kind):
            shown.isetitem(k, pd.Series(map(_no_formula, frame.iloc[:, k]), index=frame.index, dtype=object))
    return str(shown.to_csv(index=False))


FORMULA = tuple("=+-@＝＋－＠\n")
"""First characters of a text that spreadsheets may take for a formula (OWASP, CSV injection)."""

NUMBER = re.compile(r"[+-]([0-9]+(\.[0-9]+)?(e[+-]?[0-9]+)?|inf)")


def _no_formula(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    text = printable_lines(value)
    return f"'{text}" if text.startswith(FORMULA) and not NUMBER.fullmatch(text) else text


def to_markdown(frame: pd.DataFrame) -> str:
    """A Markdown table, numbers with three significant digits."""
    return f"{_as_text(frame, _markdown).to_markdown(index=False, disable_numparse=True)}\n"


def to_latex(frame: pd.DataFrame) -> str:
    """A LaTeX tabular (package booktabs), numbers with three significant digits.

    What vibench itself writes compiles with every engine; labels in scripts other than Latin need LuaLaTeX or XeLaTeX.
    """
    columns = "".join("r" if pd.api.types.is_numeric_dtype(kind) else "l" for kind in frame.dtypes)
    table = str(_as_text(frame, to_latex_text).to_latex(index=False, column_format=columns))
    return f"% needs \\usepackage{{booktabs}}\n{table}"


MARKUP = re.compile(r"[\\`*|]|\](?=[(\[])|(?<![^\W_])_|_(?![^\W_])")
"""What Markdown acts on and a backslash makes text; an underscore inside a word, or a unit in brackets, is text."""

ENTITIES = {
    ord(sign): f"&{name};" for sign, name in {"&": "amp", "<": "lt", ">": "gt", "$": "#36", "~": "#126"}.items()
}
"""What HTML, or Markdown of some dialects, acts on and a backslash would not make text in all of them."""

LATEX = str.maketrans({
    **{sign: f"\\{sign}" for sign in "&%$#_{}"}, "\\": r"\textbackslash{}", "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    "[": "{[}", "*": "{*}",  # arguments of the line break before them, at the beginning of a row
    **{sign: f"${command}$" for sign, command in {
        "≤": r"\leq", "≥": r"\geq", "→": r"\to", "−": "-", "√": r"\surd", "∞": r"\infty", "‖": r"\|", "Δ": r"\Delta",
        "²": "^2", "·": r"\cdot", "×": r"\times", "γ": r"\gamma", "α": r"\alpha",
    }.items()}, "–": "--", "…": r"\dots{}", "\u202f": r"\,",
    "µ": r"$\mu$", "μ": r"$\mu$", "β": r"$\beta$", "δ": r"$\delta$", "λ": r"$\lambda$", "σ": r"$\sigma$",
})  # fmt: skip


def _markdown(text: str) -> str:
    return MARKUP.sub(r"\\\g<0>", text).translate(ENTITIES)


def to_latex_text(text: str) -> str:
    """A text whose characters LaTeX shows, and acts on none of them."""
    return text.translate(LATEX)


def _as_text(frame: pd.DataFrame, escape: Callable[[str], str]) -> pd.DataFrame:
    """The table as it is printed, special characters escaped and line breaks removed."""
    rows = [[escape(unbroken(cell_text(value))) for value in row] for row in frame.itertuples(index=False)]
    return pd.DataFrame(rows, columns=[escape(unbroken(str(name))) for name in frame.columns])


def to_json(frame: pd.DataFrame) -> str:
    """A JSON array of objects with full precision; missing values are null, infinite ones the numbers ±1e999.

    JSON has no infinity; parsers read a number beyond the largest double as infinite.
    """
    # DataFrame.to_json keeps 15 digits at most and writes infinite values as null.
    known = frame.astype(object).where(frame.notna(), None).to_dict("records")
    rows = [",\n".join(f"  {_json(str(name))}: {_json(value)}" for name, value in row.items()) for row in known]
    return printable_lines("[\n" + ",\n".join(f" {{\n{row}\n }}" for row in rows) + "\n]\n")


def _json(value: Any) -> str:
    if isinstance(value, float) and math.isinf(value):
        return "1e999" if value > 0.0 else "-1e999"
    return json.dumps(value, ensure_ascii=False)


def cell_text(value: Any) -> str:
    """A value as tables print it: integers whole, other numbers with three significant digits, "" if missing."""
    if pd.isna(value):
        return ""
    if isinstance(value, float):
        return f"{value:.0f}" if value.is_integer() and abs(value) < 1e6 else f"{value:.3g}"
    return str(value)


def asked(row: Mapping[str, Any] | pd.Series, axis: str) -> str:
    """The tolerance of `axis`, "pod" or "dual", or the dimension where the study prescribes one."""
    tolerance, count = row[f"{axis}_tol"], row[f"{axis}_size"]
    return f"{'N' if axis == 'pod' else 'R'}={int(count)}" if pd.notna(count) else f"{tolerance:g}"


def name_of_cell(row: Mapping[str, Any] | pd.Series) -> str:
    """A cell by all its axes, as `Cell` prints itself."""
    tolerance = "" if pd.isna(row["primal_tol"]) else f" {row['primal_tol']:g}"
    sizes = ", ".join(asked(row, axis) for axis in ("pod", "dual"))
    assembly = "" if row["assembly"] == "full" else f" · {row['assembly']}"
    trained = "" if row["training"] == "own" else f" ({row['training']})"
    way = f"{row['problem']}{trained} · {row['dual']} · {row['primal']}{tolerance}"
    return f"{way} · {sizes} · {row['solver']} {row['accuracy']:g}{assembly}"


def break_even(meaning: str, number: float | None) -> str:
    """When one model is cheaper than another, such as "from 203": the one place where the number of it is rounded."""
    return meaning if pd.isna(number) else f"{meaning} {number:.0f}"


def interval(low: float | None, high: float | None) -> str:
    """The interval of a break-even; without an upper end where none is known, "" where neither is."""
    if pd.isna(low):
        return ""
    return f"≥ {low:.0f}" if pd.isna(high) else f"{low:.0f}–{high:.0f}"


FORMS = {"markdown": to_markdown, "csv": to_csv, "latex": to_latex, "json": to_json}
"""Formats in which a table is printed when the output is not a terminal."""
