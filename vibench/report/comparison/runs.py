"""Runs that are compared: their tables, read once, under names that tell them apart."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from vibench.qp.status import Status
from vibench.results.read import in_order, read_table
from vibench.results.sqlite import FILE, read_meta, study_of

AXES = ("problem", "formulation", "dual", "primal", "asked", "solver", "accuracy", "assembly", "correction")
"""Columns that tell cells apart in a comparison; "asked" has all tolerances, or sizes."""


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """A run by its results file and the name under which it is compared."""

    path: Path
    name: str

    @cached_property
    def cells(self) -> dict[str, dict[str, Any]]:
        """Rows of the table of cells in the order of the axes, by key."""
        rows = in_order(read_table(self.path, "cells")).to_dict("records")
        return {str(row["cell"]): {str(name): value for name, value in row.items()} for row in rows}

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Name and seed of the study, and its validation parameters: their number, or their sampling as JSON."""
        study = study_of(self.path, read_meta(self.path))
        validation = study.get("validation")
        shown = validation if isinstance(validation, int) else json.dumps(validation, sort_keys=True)
        return {"study": study.get("name"), "seed": study.get("seed"), "validation": shown}

    @property
    def ok(self) -> int:
        """Number of cells that are ok."""
        return sum(row["status"] == Status.OK for row in self.cells.values())

    @property
    def machines(self) -> list[str]:
        """Machines that measured its seconds."""
        return sorted({str(row["machine"]) for row in self.cells.values() if row["machine"]})

    @cached_property
    def versions(self) -> dict[str, str]:
        """Versions of Python, libraries and solvers; several, where its cells were run with several."""
        by_name: dict[str, set[str]] = {}
        for text in {row["versions"] for row in self.cells.values() if isinstance(row["versions"], str)}:
            for name, version in json.loads(text).items():
                by_name.setdefault(name, set()).add(str(version))
        return {name: ", ".join(sorted(several)) for name, several in sorted(by_name.items())}

    @cached_property
    def ok_queries(self) -> pd.DataFrame:
        """Rows of the ok queries, by cell and number."""
        queries = read_table(self.path, "queries")
        return queries[queries["status"] == Status.OK].set_index(["cell", "query"])

    def rounds(self, cell: str) -> Sequence[float]:
        """Seconds of a query in every round of timing of a cell."""
        return self._rounds.get(cell, [])

    @cached_property
    def _rounds(self) -> Mapping[str, list[float]]:
        timings = read_table(self.path, "timings").sort_values(["cell", "round"])
        return {str(cell): list(rows["total_s"]) for cell, rows in timings.groupby("cell")}

    def thresholds_of(self, cells: Collection[str]) -> pd.DataFrame:
        """Rows of the break-evens in which no other cells take part."""
        thresholds, keys = self._thresholds, set(cells)
        both = (thresholds[end].isin(keys) for end in ("cell_a", "cell_b"))
        of_a, of_b = both
        return thresholds[(of_a | thresholds["cell_a"].isna()) & of_b]

    @cached_property
    def _thresholds(self) -> pd.DataFrame:
        return read_table(self.path, "thresholds")

    def measured_beside(self, other: ComparedRun, unless: Sequence[ComparedRun]) -> list[str]:
        """Cells whose seconds compare with those of the other run, and with those of none of the runs `unless`."""
        found = {key: self.measured_by(key) for key in self.cells}
        return [
            key
            for key, instrument in found.items()
            if other.measured_by(key) == instrument and all(run.measured_by(key) != instrument for run in unless)
        ]

    def measured_by(self, cell: str) -> tuple[str, str] | None:
        """Machine and version of the benchmark protocol that measured a cell; `None` without it."""
        if cell not in self.cells:
            return None
        row = self.cells[cell]
        versions = json.loads(row["versions"]) if isinstance(row["versions"], str) else {}
        return str(row["machine"]), str(versions.get("protocol", ""))


def compared_runs(paths: Sequence[Path]) -> list[ComparedRun]:
    """The runs of some results files, each under a name of its own: as many folders of its path as that needs."""
    return [ComparedRun(path, name) for path, name in zip(paths, run_names(paths), strict=True)]


def run_names(paths: Sequence[Path]) -> list[str]:
    """Names of runs that are all different: the folder or the file, with folders before it where these are alike."""
    parts = [(path.resolve().parent if path.name == FILE else path.resolve().with_suffix("")).parts for path in paths]
    deepest = max(map(len, parts))
    for depth in range(1, deepest + 1):
        names = ["/".join(some[-depth:]) for some in parts]
        if len(set(names)) == len(set(parts)):
            break
    seen: dict[str, int] = {}
    for k, name in enumerate(names):  # one run may be named twice
        seen[name] = seen.get(name, 0) + 1
        names[k] = name if seen[name] == 1 else f"{name} ({seen[name]})"
    return names
