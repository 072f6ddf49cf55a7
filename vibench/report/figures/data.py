"""The tables of a results file, problem by problem, as figures and findings read them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from vibench.plugins.registry import default_formulation
from vibench.report.figures.style import Series
from vibench.results import pictures
from vibench.results.read import in_order, read_table
from vibench.study.cells import NO_SUCH_AXIS
from vibench.text import json_object

Panel = TypeVar("Panel")


@dataclass(frozen=True)
class ProblemTables:
    """The tables of one problem of a run, and of one training set where it has several.

    Each table has a column `pair`, a text of the tolerances or sizes that determine (N, R); queries also have the
    columns `enrichment_kind`, `N` and `R` of their cells.

    Attributes
    ----------
    problem
        Label of the problem in the study, with that of the training set where the problem has several.
    problem_name, problem_options
        Name of its plugin, and the options that are not at their default.
    cells, queries, histories, thresholds
        Rows of the tables of the results file, in the order of the axes.
    pictures
        Its recorded solutions.
    """

    problem: str
    problem_name: str
    problem_options: Mapping[str, Any]
    cells: pd.DataFrame
    queries: pd.DataFrame
    histories: pd.DataFrame
    thresholds: pd.DataFrame
    pictures: tuple[pictures.Shown, ...]

    @property
    def machine(self) -> str:
        return ", ".join(str(name) for name in self.cells["machine"].dropna().unique())

    @property
    def parameter(self) -> str:
        """Name and unit of the only parameter, as the label of an axis; "" if there are several."""
        if self.queries.filter(regex=r"^mu_\d+$").notna().any().sum() != 1:
            return ""
        # Only the titles of pictures, "radius = 0.7 m", have the name and the unit in a results file.
        named = (one.title.rpartition(" = ") for one in self.pictures if one.picture is not None)
        name, _, value = next(named, ("", "", ""))
        unit = value.partition(" ")[2]
        return f"{name} µ" * bool(name) + "µ" * (not name) + f" [{unit}]" * bool(unit)


def problem_tables(
    path: Path, known: Mapping[str, pd.DataFrame] = MappingProxyType({})
) -> Iterator[tuple[str, ProblemTables]]:
    """Problems and training sets of a results file that have queries, each with the name its files begin with.

    Tables that are `known` are not read again.
    """
    names = ("cells", "queries", "histories", "thresholds")
    read = {name: in_order(known[name] if name in known else read_table(path, name)) for name in names}
    if read["queries"].empty:
        return
    for axis in ("training", "formulation", "dual", "primal"):
        _tell_apart(axis, read["cells"], [frame for frame in read.values() if axis in frame])
    for frame in read.values():
        _name_formulations(frame)
    read["queries"] = read["queries"].merge(read["cells"][["cell", "enrichment_kind", "N", "R"]], "left", "cell")
    sizes, problem_columns = ["pod_tol", "pod_size", "dual_tol", "dual_size"], ["problem", "problem_options"]
    for frame in read.values():
        if "assembly" in frame:
            frame["way"] = _per_combination(frame[["assembly", "bounds", "correction"]], way)
        frame["pair"] = _per_combination(frame[sizes].astype(float), lambda *pair: str(pair))
    shown = tuple(pictures.read(path))
    keys = list(dict.fromkeys(read["queries"][[*problem_columns, "training"]].itertuples(index=False, name=None)))
    several = {key[:2] for key in keys if len({one for one in keys if one[:2] == key[:2]}) > 1}
    labels = [f"{key[0]}, {key[2]}" if key[:2] in several else str(key[0]) for key in keys]
    for name, label, (*problem, training) in zip(file_names(labels), labels, keys, strict=True):
        mine = {
            # Diagnostics of validation solutions belong to no training set.
            table: frame[(frame[problem_columns] == problem).all(axis=1) & frame["training"].isin([training, None])]
            for table, frame in read.items()
        }
        drawn = tuple(one for one in shown if one.key == tuple(problem))
        options = json_object(problem[1]) or {}
        yield name, ProblemTables(label, _plugin_name(mine["cells"], "problem"), options, **mine, pictures=drawn)


def _tell_apart(axis: str, cells: pd.DataFrame, frames: list[pd.DataFrame]) -> None:
    """Add options to the labels of strategies, so that a label means the same strategy in every run.

    A label chosen by the study replaces the options, unless several strategies have it.
    """
    columns = [axis, f"{axis}_options"]
    strategies = pd.concat([frame[columns].dropna().drop_duplicates() for frame in frames]).drop_duplicates()
    names = {tuple(key): _plugin_name(rows, axis) for key, rows in cells.groupby(columns)}
    shared = strategies.duplicated(axis, keep=False)
    labels = dict[tuple[Any, ...], str]()
    for (label, text), several in zip(strategies.itertuples(index=False, name=None), shared, strict=True):
        options = json_object(text) or {}
        named = ", ".join(f"{name} = {value}" for name, value in options.items())
        if options and (several or names.get((label, text)) == label):
            labels[label, text] = f"{label} ({named})"
    for frame in frames if labels else ():
        made = _per_combination(frame[columns], lambda *key: labels.get(key, key[0]))
        frame[axis] = made.astype(frame[axis].dtype)


def _name_formulations(frame: pd.DataFrame) -> None:
    """Label plugin formulations, so that curves and markers can be distinguished."""
    if "formulation" not in frame or not (other := frame["formulation"] != default_formulation()).any():
        return
    for column in ("primal", "primal_b"):
        if column in frame:
            made = _per_combination(
                frame[["formulation", column]],
                lambda name, primal: name if primal == NO_SUCH_AXIS else f"{name} ({primal})",
            )
            frame[column] = frame[column].where(~other, made)
    frame["dual"] = frame["dual"].where(frame["dual"] != NO_SUCH_AXIS, "no cone")


def _per_combination(frame: pd.DataFrame, value: Callable[..., Any]) -> pd.Series:
    """A function of the values of every row, called once for each combination: millions of rows have few."""
    number = frame.groupby(list(frame.columns), dropna=False, sort=False).ngroup().to_numpy()
    _, first = np.unique(number, return_index=True)
    values = np.empty(len(first), dtype=object)
    values[:] = [value(*row) for row in frame.iloc[first].itertuples(index=False, name=None)]
    return pd.Series(values[number], frame.index)


def _plugin_name(cells: pd.DataFrame, axis: str) -> str:
    """Registered name of the plugin on an axis of some cells; "" if no cell records it."""
    for definition in cells["definition"].dropna():
        plugin = (json_object(definition) or {}).get(axis)
        return str(plugin.get("name", "")) if isinstance(plugin, dict) else ""
    return ""


def leading(panels: Sequence[Panel], most: int, noun: str) -> tuple[Sequence[Panel], str]:
    """The panels, or curves, that a figure has room for, and a sentence on the others, "" where there are none."""
    left_out = len(panels) - most
    return panels[:most], f"The tables have the other {left_out} {noun}." if left_out > 0 else ""


def dimensions(rows: pd.DataFrame) -> str:
    """(N, R) of cells or queries of one pair, as a title."""
    sizes = rows[["N", "R"]].dropna()
    if sizes.empty:
        return "(N, R) unknown"
    low, high = sizes.min().astype(int), sizes.max().astype(int)
    return "(N, R) = ({}, {})".format(*(f"{a}" if a == b else f"{a}–{b}" for a, b in zip(low, high, strict=True)))


def by_strategy(rows: pd.DataFrame) -> Iterator[tuple[str, Series, pd.DataFrame]]:
    """Rows by primal strategy and tolerance, with the label and the key in legends of each group."""
    for (primal, tolerance), group in rows.groupby(["primal", "primal_tol"], dropna=False):
        key = Series(str(primal), "" if pd.isna(tolerance) else float(tolerance))
        yield label(primal, tolerance), key, group


def way(assembly: Any, bounds: Any, correction: Any) -> str:
    """Assembly, bounds and correction of queries in labels; "" for full assembly without correction."""
    assembled = assembly if isinstance(assembly, str) and assembly != "full" else ""
    corrected = {"none": "", "feasible": "corrected", "auto": "corrected where ω > ρ"}.get(correction, correction)
    parts = (f"{assembled}{' with bounds' * bool(bounds == 1)}".strip(), corrected)
    return ", ".join(part for part in parts if isinstance(part, str) and part)


def label(name: Any, tolerance: Any = None, way: str = "") -> str:
    """Label of a primal strategy with its tolerance and the `way` of its queries."""
    with_tolerance = str(name) if pd.isna(tolerance) else f"{name}, δ = {tolerance:g}"
    return f"{with_tolerance}, {way}" if way else with_tolerance


def file_names(labels: list[str]) -> list[str]:
    """File names for labels, in their order, all different."""
    # Letters and digits, cut to 90 bytes: two labels are part of a name of at most 255.
    words = (re.sub(r"[^\w.=-]+", "-", label).strip("-.")[:60] for label in labels)
    plain = [text.encode()[:90].decode(errors="ignore") or "unnamed" for text in words]
    names: list[str] = []
    for name in plain:
        numbered = (f"{name}-{k}" for k in count(1))
        taken = {*plain, *names}
        names.append(name if plain.count(name) == 1 else next(one for one in numbered if one not in taken))
    return names


def of_solvers(queries: pd.DataFrame) -> pd.DataFrame:
    """Rows of the queries that a QP solver answered."""
    return queries[queries["solver"] != NO_SUCH_AXIS]
