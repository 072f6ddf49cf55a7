"""The tables of a results file, problem by problem, as figures and findings read them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import pandas as pd

from vibench.results import pictures, tables

TABLES = ("cells", "queries", "histories", "thresholds", "outputs")

PAIR = ["pod_tol", "pod_size", "dual_tol", "dual_size"]
"""Tolerances or prescribed sizes that determine the dimensions (N, R)."""

PROBLEM = ["problem", "problem_options"]

PRIMAL = ["primal", "primal_options", "primal_tol"]


@dataclass(frozen=True)
class Data:
    """The tables of one problem of a run, and of one training set where it has several.

    Each has a column `pair`, a text of the values of `PAIR`; queries also have the columns `enrichment_kind`, `N` and
    `R` of their cells.
    """

    problem: str
    cells: pd.DataFrame
    queries: pd.DataFrame
    histories: pd.DataFrame
    thresholds: pd.DataFrame
    outputs: pd.DataFrame
    pictures: tuple[pictures.Shown, ...]

    def of_dual(self, dual: str) -> Data:
        """The rows of one dual strategy."""
        frames = {name: getattr(self, name) for name in TABLES}
        return replace(self, **{name: frame[frame["dual"] == dual] for name, frame in frames.items()})

    @property
    def duals(self) -> list[str]:
        """Dual strategies, in the order of the tables."""
        return [str(dual) for dual in self.queries["dual"].unique()]


def problems(path: Path) -> Iterator[tuple[str, Data]]:
    """Every problem and training set of a results file that has queries, with the name its files begin with.

    The training set is named where a problem has several.
    """
    read = {name: tables.in_order(tables.read(path, name)) for name in TABLES}
    if read["queries"].empty:
        return
    for axis in ("training", "dual", "primal"):
        _tell_apart(axis, [frame for frame in read.values() if axis in frame])
    read["queries"] = read["queries"].merge(read["cells"][["cell", "enrichment_kind", "N", "R"]], "left", "cell")
    for frame in read.values():
        frame["pair"] = [str(pair) for pair in frame[PAIR].astype(float).itertuples(index=False, name=None)]
    shown = tuple(pictures.read(path))
    keys = list(dict.fromkeys(read["queries"][[*PROBLEM, "training"]].itertuples(index=False, name=None)))
    several = {key[:2] for key in keys if len({one for one in keys if one[:2] == key[:2]}) > 1}
    labels = [f"{key[0]}, {key[2]}" if key[:2] in several else str(key[0]) for key in keys]
    for name, label, (*problem, training) in zip(file_names(labels), labels, keys, strict=True):
        mine = {
            # What a problem tells of its validation solutions belongs to no training set.
            table: frame[(frame[PROBLEM] == problem).all(axis=1) & frame["training"].isin([training, None])]
            for table, frame in read.items()
        }
        yield name, Data(label, **mine, pictures=tuple(one for one in shown if one.key == tuple(problem)))


def _tell_apart(axis: str, frames: list[pd.DataFrame]) -> None:
    """Number the labels of a plugin that occurs with different options."""
    columns = [axis, f"{axis}_options"]
    found = pd.concat([frame[columns].dropna().drop_duplicates() for frame in frames]).drop_duplicates()
    found["label"] = found[axis] + " (" + (found.groupby(axis).cumcount() + 1).astype(str) + ")"
    numbered = found[found.duplicated(axis, keep=False)].set_index(columns)["label"]
    for frame in frames:
        rows = frame[axis].isin(numbered.index.get_level_values(0))
        frame.loc[rows, axis] = numbered.loc[pd.MultiIndex.from_frame(frame.loc[rows, columns])].to_numpy()


def dimensions(rows: pd.DataFrame) -> str:
    """(N, R) of cells or queries of one pair, as a title."""
    sizes = rows[["N", "R"]].dropna()
    if sizes.empty:
        return "(N, R) unknown"
    low, high = sizes.min().astype(int), sizes.max().astype(int)
    return "(N, R) = ({}, {})".format(*(f"{a}" if a == b else f"{a}–{b}" for a, b in zip(low, high, strict=True)))


def by_dimensions(cells: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Cells by dual strategy and pair, with the title of each group."""
    groups = cells.groupby(["dual", "pair"], sort=False)
    return [(f"{dual}, {dimensions(group)}", group) for (dual, _), group in groups]


def by_strategy(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Rows by primal strategy and tolerance, with the label of each group."""
    for (primal, tolerance), group in rows.groupby(["primal", "primal_tol"], dropna=False):
        yield label(primal, tolerance), group


def label(name: Any, tolerance: Any = None, assembly: str = "full") -> str:
    """A primal strategy with its tolerance and, unless it is full, its assembly."""
    with_tolerance = str(name) if pd.isna(tolerance) else f"{name}, δ = {tolerance:g}"
    return with_tolerance if assembly in ("full", "") else f"{with_tolerance}, {assembly}"


def one_solver(queries: pd.DataFrame) -> pd.DataFrame:
    """One row per strategy, tolerance and query: inf-sup constants depend neither on solver nor on assembly."""
    return queries.drop_duplicates([*PRIMAL, "query"])


SOLVER_SHARE = 0.1
"""Cells whose QP solver makes a larger share of an error are not compared: the solver, not the strategy, decides."""


def solved_too_loosely(cells: pd.DataFrame) -> pd.Series:
    """Which cells are left out where strategies are compared."""
    return cells["solver_share_mean"].astype(float) >= SOLVER_SHARE


def best_solver(cells: pd.DataFrame) -> pd.DataFrame:
    """The timed cells of the solver and accuracy with the most ok queries, without those `solved_too_loosely`.

    Of several such solvers, the fastest.
    """
    timed = cells[cells["online_s"].notna() & ~solved_too_loosely(cells)]
    if timed.empty:
        return timed
    known = timed.groupby(["solver", "accuracy"]).agg(ok=("queries_ok", "sum"), seconds=("online_s", "mean"))
    solver, accuracy = known.sort_values(["ok", "seconds"], ascending=[False, True]).index[0]
    return timed[(timed["solver"] == solver) & (timed["accuracy"] == accuracy)]


def at_best_tolerance(rows: pd.DataFrame, score: pd.Series) -> pd.DataFrame:
    """Rows of every primal strategy at the tolerance of its largest score, and all rows without a tolerance.

    `score` has the index (primal, primal_tol); of equal scores the first counts.
    """
    best = score.sort_values(ascending=False, kind="stable").reset_index().drop_duplicates("primal")
    tolerances = best.set_index("primal")["primal_tol"]
    return rows[rows["primal_tol"].isna() | (rows["primal_tol"] == rows["primal"].map(tolerances))]


def longest(histories: pd.DataFrame) -> Iterator[tuple[Any, pd.DataFrame]]:
    """The longest history for each dual strategy.

    It contains the others: POD and cones are nested, so a looser tolerance stops at an earlier step.
    """
    for dual, group in histories.groupby("dual", dropna=False):
        yield dual, group[group["artefact"] == group.groupby("artefact")["step"].max().idxmax()]


def file_names(labels: list[str]) -> list[str]:
    """File names for labels, in their order, all different."""
    plain = [_file_name(label) for label in labels]
    found: list[str] = []
    for name in plain:
        numbered = (f"{name}-{k}" for k in count(1))
        taken = {*plain, *found}
        found.append(name if plain.count(name) == 1 else next(one for one in numbered if one not in taken))
    return found


def _file_name(label: str) -> str:
    """The letters and digits of a label; a file system counts bytes, and two labels are part of one name."""
    plain = re.sub(r"[^\w.=-]+", "-", label).strip("-.")[:60]
    return plain.encode()[:90].decode(errors="ignore") or "unnamed"
