"""What figures are drawn from: the tables of one results file, problem by problem."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from vibench.results import pictures, tables

PAIR = ["pod_tol", "pod_size", "dual_tol", "dual_size"]
"""What asks for a pair of dimensions (N, R)."""

TABLES = ("cells", "queries", "histories", "thresholds")
"""What figures need of the results."""

PRIMAL = ["primal", "primal_options", "primal_tol"]


@dataclass(frozen=True)
class Data:
    """The tables of one problem of a run; `queries` know the kind of their enrichment."""

    problem: str
    cells: pd.DataFrame
    queries: pd.DataFrame
    histories: pd.DataFrame
    thresholds: pd.DataFrame
    pictures: tuple[pictures.Shown, ...]

    def of_dual(self, dual: str) -> Data:
        """What belongs to one dual strategy."""
        frames = (self.cells, self.queries, self.histories, self.thresholds)
        cells, queries, histories, thresholds = (frame[frame["dual"] == dual] for frame in frames)
        return Data(self.problem, cells, queries, histories, thresholds, self.pictures)

    @property
    def duals(self) -> list[str]:
        """Dual strategies, in the order of the tables."""
        return [str(dual) for dual in self.queries["dual"].unique()]


def problems(path: Path) -> Iterator[tuple[str, Data]]:
    """Every problem of a results file that has queries, with the name its files begin with."""
    read = {name: tables.in_order(tables.read(path, name)) for name in TABLES}
    if read["queries"].empty:
        return
    for axis in ("dual", "primal"):
        _tell_apart(axis, [read[name] for name in ("cells", "queries", "histories")])
    kinds = read["cells"].set_index("cell")["enrichment_kind"]
    read["queries"]["enrichment_kind"] = read["queries"]["cell"].map(kinds)
    shown = tuple(pictures.read(path))
    keys = list(dict.fromkeys(zip(read["queries"]["problem"], read["queries"]["problem_options"], strict=True)))
    for name, key in zip(file_names([str(problem) for problem, _ in keys]), keys, strict=True):
        cells, queries, histories, thresholds = (
            frame[(frame["problem"] == key[0]) & (frame["problem_options"] == key[1])]
            for frame in map(read.__getitem__, TABLES)
        )
        mine = tuple(one for one in shown if one.key == key)
        yield name, Data(str(key[0]), cells, queries, histories, thresholds, mine)


def _tell_apart(axis: str, frames: list[pd.DataFrame]) -> None:
    """Number labels that a plugin bears with different options."""
    options: dict[str, dict[str, int]] = {}
    for frame in frames:
        for name, given in frame[[axis, f"{axis}_options"]].dropna().drop_duplicates().itertuples(index=False):
            options.setdefault(name, {}).setdefault(given, len(options[name]) + 1)
    shared = {name for name, known in options.items() if len(known) > 1}
    for frame in frames:
        rows = frame[axis].isin(shared)
        named = zip(frame.loc[rows, axis], frame.loc[rows, f"{axis}_options"], strict=True)
        frame.loc[rows, axis] = [f"{name} ({options[name][given]})" for name, given in named]


def pairs(frame: pd.DataFrame) -> list[tuple[Any, pd.DataFrame]]:
    """Rows by what asked for (N, R), in the order of the tables."""
    return list(frame.groupby(PAIR, dropna=False, sort=False))


def same(frame: pd.DataFrame, pair: tuple[Any, ...]) -> pd.Series:
    """Rows of one pair."""
    mask = pd.Series(True, index=frame.index)
    for name, value in zip(PAIR, pair, strict=True):
        mask &= frame[name].isna() if pd.isna(value) else frame[name] == value
    return mask


def pair_title(pair: tuple[Any, ...], cells: pd.DataFrame) -> str:
    """(N, R) as they came out, for the cells of a pair."""
    sizes = cells[same(cells, pair)][["N", "R"]].dropna()
    if sizes.empty:
        return "(N, R) unknown"
    low, high = sizes.min().astype(int), sizes.max().astype(int)
    return "(N, R) = ({}, {})".format(*(f"{a}" if a == b else f"{a}–{b}" for a, b in zip(low, high, strict=True)))


def label(name: Any, tolerance: Any = None, assembly: str = "full") -> str:
    """A primal strategy with its tolerance."""
    with_tolerance = str(name) if pd.isna(tolerance) else f"{name}, δ = {tolerance:g}"
    return with_tolerance if assembly in ("full", "") else f"{with_tolerance}, {assembly}"


def one_solver(queries: pd.DataFrame) -> pd.DataFrame:
    """One row per strategy, tolerance and query: inf-sup constants depend neither on solver nor on assembly."""
    return queries.drop_duplicates([*PRIMAL, "query"])


def best_solver(cells: pd.DataFrame) -> pd.DataFrame:
    """The cells of the solver that answered most queries well, the quickest of several."""
    timed = cells[cells["online_s"].notna()]
    if timed.empty:
        return timed
    known = timed.groupby("solver").agg(ok=("queries_ok", "sum"), seconds=("online_s", "mean"))
    return timed[timed["solver"] == known.sort_values(["ok", "seconds"], ascending=[False, True]).index[0]]


def longest(lines: pd.DataFrame, by: list[str]) -> list[tuple[tuple[Any, ...], pd.DataFrame]]:
    """The longest history of each group: a tolerance's history is the beginning of a tighter one's."""
    found = []
    for key, group in lines.groupby(by) if by else [((), lines)]:
        if group.empty:
            continue
        last = group.groupby("artefact")["step"].max().idxmax()
        found.append((key, group[group["artefact"] == last]))
    return found


def file_names(labels: list[str]) -> list[str]:
    """File names for labels, in their order, all different."""
    plain = [re.sub(r"[^\w.=-]+", "-", label).strip("-.")[:60] or "unnamed" for label in labels]
    return [name if plain.count(name) == 1 else f"{name}-{plain[:k].count(name) + 1}" for k, name in enumerate(plain)]
