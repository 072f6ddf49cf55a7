"""Comparison of runs: what is equal, and what moved by more than a limit, a solver's accuracy and the spread allow."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vibench.errors import RequestError, unknown_name
from vibench.report import differences
from vibench.report.differences import AXES, ChangeKind, ComparedRun, Difference
from vibench.results import formats
from vibench.results.schema import STORED
from vibench.timing import FEWEST_ROUNDS, median_interval


@dataclass(frozen=True)
class Comparison:
    """The differences of runs from earlier ones.

    Every run is compared with the first one; its seconds, cell by cell, with the first one of the same machine and
    benchmark protocol.
    """

    runs: tuple[ComparedRun, ...]
    pairs: Mapping[tuple[str, str], Sequence[Difference]]  # by the names of a run and of the earlier one
    notes: tuple[str, ...]

    @cached_property
    def changes(self) -> pd.DataFrame:
        """Changes for better or worse, a row per column of a cell, in the order of the cells."""
        columns = ["run", "against", *AXES, "what", "before", "after", "ratio", "ratio_low", "ratio_high", "verdict"]
        rows, moved = [], (ChangeKind.CHANGED, ChangeKind.BETTER, ChangeKind.WORSE)
        for (run, against), one in ((names, one) for names, found in self.pairs.items() for one in found):
            if one.verdict in moved:
                ends = dict(zip(("ratio_low", "ratio_high"), one.interval or (np.nan, np.nan), strict=True))
                values = {"before": formats.cell_text(one.before), "after": formats.cell_text(one.after)}
                about = {"run": run, "against": against, "what": one.what, "verdict": one.verdict.value}
                rows.append(about | _named(one.cell) | values | {"ratio": one.ratio} | ends)
        return pd.DataFrame(rows, columns=[*columns, "cell"])

    @property
    def regressions(self) -> int:
        return int((self.changes["verdict"] == ChangeKind.WORSE).sum())

    def table(self, name: str) -> pd.DataFrame:
        """One of the tables "changes", "columns", "runs" and "cells"."""
        made = {"changes": "changes", "columns": "by_column", "runs": "by_run", "cells": "present"}
        frame: pd.DataFrame = getattr(self, made[name])
        return frame

    @property
    def verdicts(self) -> pd.DataFrame:
        """A row per run and problem with a model within the error of a verdict: its seconds, and when it pays."""
        axes = ["formulation", "dual", "primal", "solver"]
        found = [(run.name, one, one.best) for run in self.runs for one in run.verdicts]
        rows = [
            (run, one.problem, *(cell[axis] for axis in axes), 1e3 * one.full_s, 1e3 * cell["online_s"], one.break_even)
            for run, one, cell in found
            if cell and one.within
        ]
        return pd.DataFrame(rows, columns=["run", "problem", *axes, "full [ms]", "query [ms]", "pays"])

    @property
    def by_column(self) -> pd.DataFrame:
        """A row per column and pair of runs: how many cells have which verdict; the median ratio and its interval."""
        rows = []
        for (run, against), found in self.pairs.items():
            by_what = defaultdict[str, list[Difference]](list)
            for one in found:
                by_what[one.what].append(one)
            for what, moves in by_what.items():
                counts = {verdict.value: sum(d.verdict == verdict for d in moves) for verdict in ChangeKind}
                ratios = [d.ratio for d in moves if np.isfinite(d.ratio) and d.ratio > 0.0]
                low, high = median_interval(ratios) if len(ratios) >= FEWEST_ROUNDS else (float("nan"), float("nan"))
                middle = float(np.median(ratios)) if ratios else float("nan")
                farthest = max(ratios, key=lambda ratio: abs(np.log(ratio)), default=float("nan"))
                numbers = {"ratio": middle, "ratio_low": low, "ratio_high": high, "farthest_ratio": farthest}
                about = {"what": what, "run": run, "against": against, "cells": len(moves)}
                rows.append(about | counts | numbers)
        # The order in which columns are compared; break-even is last.
        order = ["cell", "queries_ok", "status", "N", "R", "rank", "enrichment", "beta_span_min", "beta_cone_lower_min"]
        order += [*differences.ERRORS, "error_u_zero_max", "error_lambda_zero_max", "offline_s", "online_s"]
        places = {what: place for place, what in enumerate(order)}
        by = {"kind": "stable", "ignore_index": True, "key": lambda whats: whats.map(places).fillna(len(order))}
        return pd.DataFrame(rows).sort_values("what", **by)

    @property
    def by_run(self) -> pd.DataFrame:
        """A row per run: its study, cells (those of the first run's code, too), machine, and versions that differ."""
        first, everywhere = self.runs[0], set.intersection(*(set(run.cells) for run in self.runs))
        names = dict.fromkeys(name for run in self.runs for name in run.versions)
        differing = [name for name in names if len({run.versions.get(name, "") for run in self.runs}) > 1]
        rows = []
        for run in self.runs:
            alone = set(run.cells).difference(*(one.cells for one in self.runs if one is not run))
            same = sum(run.cells[key]["code"] == row["code"] for key, row in first.cells.items() if key in run.cells)
            rows.append({
                "run": run.name, **run.identity, "cells": len(run.cells), "ok": run.ok, "in all runs": len(everywhere),
                "only here": len(alone), "machine": "; ".join(run.machines), "same code": same,
                **{name: run.versions.get(name, "") for name in differing},
            })  # fmt: skip
        return pd.DataFrame(rows)

    @property
    def present(self) -> pd.DataFrame:
        """A row per cell that is not in all runs, and in which of them it is."""
        return self._across(range(1, len(self.runs)), lambda run, key: "yes" if key in run.cells else "no")

    def values(self, column: str) -> pd.DataFrame:
        """One column of the table of cells in every run, a row per cell that several runs have.

        Raises a `RequestError` if there is no such column.
        """
        if column not in STORED["cells"]:
            raise unknown_name("column of cells", column, STORED["cells"])
        counts = range(2, len(self.runs) + 1)
        return self._across(counts, lambda run, key: run.cells.get(key, {}).get(column))

    def _across(self, counts: Collection[int], value: Callable[[ComparedRun, str], Any]) -> pd.DataFrame:
        """A row per cell that so many runs have, with a value from every run."""
        having = defaultdict[str, list[ComparedRun]](list)
        for run in self.runs:
            for key in run.cells:
                having[key].append(run)
        chosen = {key: some[0].cells[key] for key, some in having.items() if len(some) in counts}
        rows = [_named(cell) | {run.name: value(run, key) for run in self.runs} for key, cell in chosen.items()]
        return pd.DataFrame(rows, columns=[*AXES, "cell", *(run.name for run in self.runs)])


def compare(paths: Sequence[Path], limit: float) -> Comparison:
    """Compare results files with the first one, cell by cell; cells of the same definition are the same cell.

    Changes for the worse are: a missing cell, fewer ok queries, a more severe status, an error, seconds or a dimension
    that grew by more than the factor `limit` ≥ 1, a constant that shrank by more than this factor, and a break-even
    that moved by more than this factor because the reduced model itself became slower.

    An error has not changed where the difference is at most the sum of what the QP solver contributed to it in the two
    runs. Seconds are compared only where one machine measured both, and have changed only where the 95 % interval of
    their ratio, from resampled rounds, does not contain 1; with fewer than six rounds they are undecided.

    Raises a `RequestError` if there are fewer than two files, or one cannot be read.
    """
    if len(paths) < 2:
        raise RequestError(f"{len(paths)} run is given, expected two or more to compare")
    runs = differences.compared_runs(paths)
    first, *others = runs
    by_pair = defaultdict[tuple[str, str], list[Difference]](list)
    notes: list[str] = []
    for k, run in enumerate(others, start=1):
        of_run = f"{run.name}: " if len(others) > 1 else ""
        shared = [key for key in first.cells if key in run.cells]
        found = by_pair[run.name, first.name]
        gone = [first.cells[key] for key in first.cells if key not in run.cells]
        new = [run.cells[key] for key in run.cells if key not in first.cells]
        found += [Difference(cell, "cell", "present", "gone", ChangeKind.WORSE) for cell in gone]
        found += [Difference(cell, "cell", "", "new", ChangeKind.CHANGED) for cell in new]
        means = _on_common_queries(first, run, shared)
        for key in shared:
            # Means over different queries are no comparison.
            one, two = first.cells[key] | means[0].get(key, {}), run.cells[key] | means[1].get(key, {})
            found += differences.number_differences(one, two, limit)
        notes.append(f"{of_run}{len(shared)} cells are in both runs")
        if means[0]:
            notes.append(f"{of_run}errors of {len(means[0])} of them are compared on the queries that are ok in both")
        compared = 0
        for earlier in runs[:k]:
            # Seconds of a cell are compared once, with the first run of the same machine and protocol.
            same = run.measured_beside(earlier, unless=runs[: runs.index(earlier)])
            compared += len(same)
            if same:
                by_pair[run.name, earlier.name] += differences.timing_differences(earlier, run, same, limit)
        if compared < len([key for key in run.cells if any(key in earlier.cells for earlier in runs[:k])]):
            notes.append(f"{of_run}times and break-even of different machines or protocols are not compared")
    notes += _agreements(runs)
    return Comparison(tuple(runs), dict(by_pair), tuple(notes))


def _agreements(runs: Sequence[ComparedRun]) -> list[str]:
    """A line on how often intervals of break-evens overlap, over all pairs of runs of one machine."""
    found = list[differences.Agreement]()
    for k, run in enumerate(runs):
        for earlier in runs[:k]:
            if same := run.measured_beside(earlier, unless=()):
                found.append(differences.agreement(earlier.thresholds_of(same), run.thresholds_of(same)))
    if not found:
        return []
    total = differences.Agreement(*map(sum, zip(*found, strict=True)))
    return [
        f"intervals of break-evens overlap in {total.overlapping} of {total.both} pairs",
        f"{total.opposite} of {total.decided} break-evens that two runs decide contradict each other",
    ]


Means = dict[str, dict[str, float]]  # columns of cells, by key


def _on_common_queries(one: ComparedRun, two: ComparedRun, shared: Sequence[str]) -> tuple[Means, Means]:
    """Means and maxima over the queries that are ok in both runs, of the cells where those differ."""
    different = set(one.ok_queries.index.symmetric_difference(two.ok_queries.index).get_level_values("cell"))
    keys = [key for key in shared if key in different]
    both = one.ok_queries.index.intersection(two.ok_queries.index)
    both_means: list[Means] = []
    for run in (one, two):
        common = run.ok_queries[run.ok_queries.index.isin(both)].groupby("cell")
        means = {column: common[name].agg(how).reindex(keys) for column, (name, how) in differences.ERRORS.items()}
        both_means.append({key: {column: float(values[key]) for column, values in means.items()} for key in keys})
    return both_means[0], both_means[1]


def _named(cell: Mapping[str, Any]) -> dict[str, Any]:
    tolerance = "" if pd.isna(cell["primal_tol"]) else f", δ {cell['primal_tol']:g}"
    asked = f"{formats.asked(cell, 'pod')}, {formats.asked(cell, 'dual')}{tolerance}"
    return {name: cell[name] for name in (*AXES, "cell") if name != "asked"} | {"asked": asked}
