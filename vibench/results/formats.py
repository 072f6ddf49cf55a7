"""Tables, and values in them, as text: CSV, JSON, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import pandas as pd

from vibench.model.bound_terms import CorrectionMode
from vibench.plugins.registry import default_formulation
from vibench.qp.status import Status
from vibench.results.break_even import Meaning
from vibench.results.read import in_order
from vibench.results.schema import STORED, Column, Row, SqlType, shown_columns
from vibench.study.cells import NO_SUCH_AXIS
from vibench.text import printable_lines, unbroken


def to_csv(frame: pd.DataFrame) -> str:
    """CSV with full precision; a text that a spreadsheet would take for a formula has an apostrophe before it."""
    # NaN differs from itself; `pandas.isna` would take a hundred times as long.
    columns = [
        [None if value is None or value is pd.NA or bool(value != value) else value for value in column.tolist()]  # noqa: PLR0124
        for _, column in frame.items()
    ]
    return csv_lines([list(map(str, frame.columns)), *zip(*columns, strict=True)])


def csv_lines(rows: Iterable[Sequence[Any]]) -> str:
    """Lines of CSV as `to_csv` writes them, from rows of values as Python has them; `None` is a missing one."""
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerows([_no_formula(value) if isinstance(value, str) else value for value in row] for row in rows)
    return lines.getvalue()


# Cached: most rows of a table have the same texts.
@lru_cache(maxsize=1 << 16)
def _no_formula(value: str) -> str:
    text = printable_lines(value)
    # Spreadsheets may take a text with one of these first characters for a formula (OWASP, CSV injection).
    risky = text.startswith(tuple("=+-@＝＋－＠\n"))
    return f"'{text}" if risky and not re.fullmatch(r"[+-]([0-9]+(\.[0-9]+)?(e[+-]?[0-9]+)?|inf)", text) else text


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


def _markdown(text: str) -> str:
    # A backslash makes text of what Markdown acts on; underscores inside words, and units in brackets, are text anyway.
    escaped = re.sub(r"[\\`*|]|\](?=[(\[])|(?<![^\W_])_|_(?![^\W_])", r"\\\g<0>", text)
    # Characters that HTML, or some dialects of Markdown, act on even after a backslash.
    entities: dict[str, str | int | None] = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "$": "&#36;", "~": "&#126;"}
    return escaped.translate(str.maketrans(entities))


def to_latex_text(text: str) -> str:
    """A text whose characters LaTeX shows, and acts on none of them."""
    characters = str.maketrans({
        **{sign: f"\\{sign}" for sign in "&%$#_{}"}, "\\": r"\textbackslash{}", "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
        "[": "{[}", "*": "{*}",  # arguments of the line break before them, at the beginning of a row
        **{sign: f"${command}$" for sign, command in {
            "≤": r"\leq", "≥": r"\geq", "→": r"\to", "−": "-", "√": r"\surd", "∞": r"\infty", "‖": r"\|",
            "Δ": r"\Delta", "²": "^2", "·": r"\cdot", "×": r"\times", "γ": r"\gamma", "α": r"\alpha",
        }.items()}, "–": "--", "…": r"\dots{}", "\u202f": r"\,",
        "µ": r"$\mu$", "μ": r"$\mu$", "β": r"$\beta$", "δ": r"$\delta$", "λ": r"$\lambda$", "σ": r"$\sigma$",
    })  # fmt: skip
    return text.translate(characters)


def _as_text(frame: pd.DataFrame, escape: Callable[[str], str]) -> pd.DataFrame:
    rows = [[escape(unbroken(cell_text(value))) for value in row] for row in frame.itertuples(index=False)]
    return pd.DataFrame(rows, columns=[escape(unbroken(str(name))) for name in frame.columns])


def to_json(frame: pd.DataFrame) -> str:
    """A JSON array of objects with full precision; missing values are null, infinite ones the numbers ±1e999.

    JSON has no infinity; parsers read a number beyond the largest double as infinite.
    """
    # DataFrame.to_json keeps 15 digits at most and writes infinite values as null.
    records = frame.astype(object).where(frame.notna(), None).to_dict("records")
    rows = [",\n".join(f"  {_json(str(name))}: {_json(value)}" for name, value in row.items()) for row in records]
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


def asked(row: Row | pd.Series, axis: str) -> str:
    """The tolerance of `axis`, "pod" or "dual", or the dimension where the study prescribes one."""
    tolerance, count = row[f"{axis}_tol"], row[f"{axis}_size"]
    if pd.notna(count):
        return f"{'N' if axis == 'pod' else 'R'}={int(count)}"
    return NO_SUCH_AXIS if pd.isna(tolerance) else f"{tolerance:g}"


def solver_text(row: Row | pd.Series) -> str:
    """QP solver and accuracy, as far as the formulation of a cell has them; "" without either."""
    solver = "" if row["solver"] == NO_SUCH_AXIS else str(row["solver"])
    return " ".join(filter(None, [solver, "" if pd.isna(row["accuracy"]) else f"{row['accuracy']:g}"]))


def name_of_cell(row: Row | pd.Series) -> str:
    """A cell by all its axes, as `Cell` prints itself."""
    tolerance = "" if pd.isna(row["primal_tol"]) else f" {row['primal_tol']:g}"
    sizes = ", ".join(text for axis in ("pod", "dual") if (text := asked(row, axis)) != NO_SUCH_AXIS)
    how = "" if row["assembly"] == "full" else f" · {row['assembly']}{' with bounds' * bool(row['bounds'])}"
    how += "" if row["correction"] == "none" else f" · corrected: {row['correction']}"
    trained = "" if row["training"] == "own" else f" ({row['training']})"
    formulation = "" if row["formulation"] == default_formulation() else row["formulation"]
    spaces = [name for name in (row["dual"], f"{row['primal']}{tolerance}") if name != NO_SUCH_AXIS]
    parts = [f"{row['problem']}{trained}", formulation, *spaces, sizes, solver_text(row)]
    return " · ".join(filter(None, parts)) + how


def break_even(meaning: str, number: float | None) -> str:
    """When one model is cheaper than another, such as "from 203": the one place where the number of it is rounded."""
    return meaning if pd.isna(number) else f"{meaning} {number:.0f}"


def interval(low: float | None, high: float | None) -> str:
    """The interval of a break-even; without an upper end where none is known, "" where neither is."""
    if pd.isna(low):
        return ""
    return f"≥ {low:.0f}" if pd.isna(high) else f"{low:.0f}–{high:.0f}"


def decimal_interval(low: float, high: float) -> str:
    """The interval of a number with three significant digits, "" where none is known."""
    return "" if pd.isna(low) or pd.isna(high) else f"{cell_text(float(low))}–{cell_text(float(high))}"


def to_text(frame: pd.DataFrame, form: str) -> str:
    """A table in one of the formats of files: markdown, csv, latex or json."""
    return {"markdown": to_markdown, "csv": to_csv, "latex": to_latex, "json": to_json}[form](frame)


def summary(cells: pd.DataFrame) -> pd.DataFrame:
    """The summary of a run: one row per cell, the columns that have a heading."""
    return _for_reading(in_order(cells), STORED["cells"])


def break_even_table(break_even_rows: pd.DataFrame) -> pd.DataFrame:
    """The break-even table: the number of queries from which, or until which, b is cheaper than a."""
    return _for_reading(in_order(break_even_rows), STORED["thresholds"])


def between_formulations(break_even_rows: pd.DataFrame) -> pd.Series:
    """Mask of the break-evens between two formulations, the high-fidelity model apart."""
    return break_even_rows["cell_a"].notna() & (break_even_rows["formulation_a"] != break_even_rows["formulation_b"])


def _for_reading(frame: pd.DataFrame, table: Mapping[str, Column]) -> pd.DataFrame:
    # Committed tables have no column `bounds`: their assembly says it.
    names = [name for name in shown_columns(table) if name in frame and says_something(frame, name)]
    return under_headings(frame, names, table)


def says_something(frame: pd.DataFrame, name: str) -> bool:
    """Whether to show a column unasked: accuracy and training sets if they vary, corrections and zeros if any."""
    if name == "accuracy":
        return bool(frame[name].nunique() > 1)
    # Values that mean nothing where all cells have them.
    usual = {"correction": CorrectionMode.NONE, "certificate": "none", "formulation": default_formulation()}
    if (axis := re.sub("_[ab]$", "", name)) in usual:
        return bool((~frame[name].dropna().isin([usual[axis], ""])).any())
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
    shown = {}
    for name in names:
        column = headed.get(name)
        heading, values = (name, frame[name]) if column is None else (column.heading, _shown(frame, name, column))
        shown[heading] = values
    return pd.DataFrame(shown, index=frame.index)


def _shown(frame: pd.DataFrame, name: str, column: Column) -> pd.Series | list[str]:
    """One column under its heading; some combine several columns of the results file."""
    if name in ("pod_tol", "dual_tol"):
        axis = name.removesuffix("_tol")
        return [asked(row, axis) for row in frame[[name, f"{axis}_size"]].to_dict("records")]
    if name == "queries_ok":
        return [f"{fine:.0f}/{count:.0f}" for fine, count in zip(frame[name], frame["queries"], strict=True)]
    if name == "benefit_threshold":
        return [break_even(*row) for row in zip(frame["meaning"], frame[name], strict=True)]
    if name in ("threshold_high", "total_high_s"):
        written = interval if name == "threshold_high" else decimal_interval
        ends = zip(frame[name.replace("high", "low")], frame[name], strict=True)
        return [written(low, high) for low, high in ends]
    if column.kind == SqlType.INTEGER:
        return frame[name].astype("Int64")
    return 1e3 * frame[name] if column.unit == "s" and column.heading.endswith("[ms]") else frame[name]
