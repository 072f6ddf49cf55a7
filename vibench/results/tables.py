"""Tables of a run, read from its results file alone."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd

from vibench.errors import RequestError
from vibench.results.columns import CELLS, INTEGER, KEYS, STORED, TABLES, THRESHOLDS, VERSION, Column, shown_columns
from vibench.results.database import FILE, read_meta

SUMMARY = "summary"


def results_file(run: str) -> Path:
    """Results file of a run folder, or of a study's name under `runs/`.

    Raises
    ------
    RequestError
        If there is none, or it is of another schema.
    """
    for folder in (Path(run), Path("runs") / run):
        path = folder if folder.name == FILE else folder / FILE
        if path.is_file():
            schema = read_meta(path).get("schema")
            if schema != str(VERSION):
                raise RequestError(f"'{path}' has schema {schema}, this vibench reads {VERSION}")
            return path
    raise RequestError(f"no results in '{run}': expected a folder with {FILE}, as `vibench run` makes under runs/")


def read(path: Path, table: str) -> pd.DataFrame:
    """One table of a results file, cells in the order they were first written."""
    db = sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)
    try:
        frame = pd.read_sql_query(f"SELECT * FROM {table}", db)
    finally:
        db.close()
    for name, column in STORED.get(table, {}).items():
        if column.kind.startswith(("REAL", "INTEGER")) and frame[name].dtype == object:  # nothing but NULL
            frame[name] = frame[name].astype(float)
    return frame


def export(path: Path, folder: Path) -> list[Path]:
    """Write every table as CSV and the summary as Markdown into a folder; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for table in TABLES:
        files.append(folder / f"{table}.csv")
        _replace(files[-1], to_csv(in_order(read(path, table))))
    files.append(folder / f"{SUMMARY}.md")
    _replace(files[-1], to_markdown(summary(read(path, "cells"))))
    return files


def in_order(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows sorted by the columns that name them, loose tolerances first: the number of jobs does not change a table."""
    names = (
        *KEYS,
        "primal_a",
        "primal_b",
        "primal_tol_a",
        "primal_tol_b",
        "assembly_a",
        "assembly_b",
        "stage",
        "quantity",
        "query",
        "step",
    )
    by = [name for name in names if name in frame.columns]
    return frame.sort_values(
        by, ascending=["_tol" not in name for name in by], kind="stable", na_position="first", ignore_index=True
    )


def summary(cells: pd.DataFrame) -> pd.DataFrame:
    """The table for reading: one line per cell, the figures people compare."""
    return _for_reading(in_order(cells), CELLS)


def benefits(thresholds: pd.DataFrame) -> pd.DataFrame:
    """The break-evens for reading: from how many queries on b is cheaper than a."""
    return _for_reading(in_order(thresholds), THRESHOLDS)


def _for_reading(frame: pd.DataFrame, table: Mapping[str, Column]) -> pd.DataFrame:
    """The columns of a table that are shown, under their headings."""
    shown = {column.heading: _shown(frame, name, column) for name, column in shown_columns(table).items()}
    return pd.DataFrame(shown, index=frame.index)


def _shown(frame: pd.DataFrame, name: str, column: Column) -> pd.Series | list[str]:
    """One column for reading; some are made of several."""
    if name in ("pod_tol", "dual_tol"):
        return [asked(row, name.removesuffix("_tol")) for row in frame.to_dict("records")]
    if name == "queries_ok":
        return [
            f"{fine}/{count}" + ("" if status == "ok" else f" {status}")
            for fine, count, status in zip(frame["queries_ok"], frame["queries"], frame["status"], strict=True)
        ]
    if name == "benefit_threshold":
        return [
            meaning if pd.isna(number) else f"{meaning} {number:.0f}"
            for number, meaning in zip(frame["benefit_threshold"], frame["meaning"], strict=True)
        ]
    if column.kind == INTEGER:
        return frame[name].astype("Int64")
    return 1e3 * frame[name] if column.heading.endswith("[ms]") else frame[name]


def to_csv(frame: pd.DataFrame) -> str:
    """CSV with full precision."""
    return str(frame.to_csv(index=False))


def to_markdown(frame: pd.DataFrame) -> str:
    """A Markdown table with figures of three digits."""
    rows = [[_one_cell(cell_text(value)) for value in row] for row in frame.itertuples(index=False)]
    text = pd.DataFrame(rows, columns=frame.columns).to_markdown(index=False, disable_numparse=True)
    return f"{text}\n"


def to_latex(frame: pd.DataFrame) -> str:
    """A LaTeX tabular (package booktabs) with figures of three digits."""
    heads = [_for_latex(str(name)) for name in frame.columns]
    numeric = [pd.api.types.is_numeric_dtype(frame[name]) for name in frame.columns]
    rows = [[_for_latex(cell_text(value)) for value in row] for row in frame.itertuples(index=False)]
    body = [" & ".join(row) + r" \\" for row in rows]
    columns = "".join("r" if right else "l" for right in numeric)
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", " & ".join(heads) + r" \\", r"\midrule", *body]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


LATEX = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"}, "\\": r"\textbackslash{}", "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}", "µ": r"$\mu$", "β": r"$\beta$", "δ": r"$\delta$", "λ": r"$\lambda$", "σ": r"$\sigma$",
}  # fmt: skip


def _for_latex(text: str) -> str:
    return "".join(LATEX.get(sign, sign) for sign in " ".join(text.split()))


def to_json(frame: pd.DataFrame) -> str:
    """A JSON array of objects with full precision; what is missing is null, and infinity the text "inf"."""
    rows = [
        {str(name): _for_json(value) for name, value in zip(frame.columns, row, strict=True)}
        for row in frame.itertuples(index=False)
    ]
    return json.dumps(rows, ensure_ascii=False, indent=1) + "\n"


def _for_json(value: Any) -> Any:
    if value is None or value is pd.NA or value != value:  # noqa: PLR0124  NaN
        return None
    plain = value.item() if hasattr(value, "item") else value
    return str(plain) if plain in (float("inf"), float("-inf")) else plain


def _one_cell(text: str) -> str:
    """Text that does not end its cell or its line in Markdown."""
    return " ".join(text.split()).replace("|", "\\|")


def cell_text(value: Any) -> str:
    """How a value is printed in a table: integers whole, other numbers with three digits, "" for what is missing."""
    if value is None or value is pd.NA or value != value:  # noqa: PLR0124  NaN
        return ""
    if isinstance(value, float):
        return f"{value:.0f}" if value.is_integer() and abs(value) < 1e6 else f"{value:.3g}"
    return str(value)


def asked(row: Mapping[str, Any] | pd.Series, axis: str) -> str:
    """The tolerance of "pod" or "dual", or the size where the study prescribed that."""
    tolerance, count = row[f"{axis}_tol"], row[f"{axis}_size"]
    return f"{'N' if axis == 'pod' else 'R'}={int(count)}" if pd.notna(count) else f"{tolerance:g}"


def _replace(path: Path, text: str) -> None:
    part = path.with_suffix(path.suffix + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


FORMS: Mapping[str, Callable[[pd.DataFrame], str]] = {
    "markdown": to_markdown,
    "csv": to_csv,
    "latex": to_latex,
    "json": to_json,
}
"""Ways to print a table where no person reads it on a terminal."""
