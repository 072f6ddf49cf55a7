"""What a site says of one run: where it comes from, its cells, and the commands that make them again."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import pandas as pd

from vibench.interfaces.formulations import MIXED
from vibench.plugins.kinds import STUDY
from vibench.plugins.registry import registered
from vibench.report.comparison.runs import ComparedRun
from vibench.report.figures.data import way
from vibench.results.formats import asked, cell_text, solver_text
from vibench.results.sqlite import FILE

FILTERED = ("study", "problem", "dual", "primal", "solver", "machine", "vibench")
"""What the list of runs is filtered by."""

SHOWN_CELLS = ("N", "R", "enrichment", "error_u_mean", "error_lambda_mean", "online_s", "offline_s")
"""Columns of the cells on the page of a run, beside those that name a cell."""


@dataclass(frozen=True, eq=False)
class PublishedRun:
    """A run and the folder of the site that is about it."""

    run: ComparedRun
    folder: str
    """Name of its folder below `runs/`: letters, digits, "-", "_" and "." only."""
    note: str = ""
    """A remark on where the file comes from, "" where there is none."""

    @cached_property
    def values(self) -> dict[str, list[str]]:
        """What the run is found by: all values that its cells have of each of `FILTERED`."""
        axes = {
            axis: sorted({str(row[axis]) for row in self.run.cells.values()})
            for axis in ("problem", "dual", "primal", "solver")
        }
        versions = self.run.versions.get("vibench", "")
        study = str(self.run.identity["study"])
        return {"study": [study], **axes, "machine": self.run.machines, "vibench": versions.split(", ")}

    @property
    def code(self) -> str:
        """Hashes of the code of its cells."""
        return ", ".join(sorted({str(row["code"]) for row in self.run.cells.values() if row["code"]}))

    @property
    def facts(self) -> Iterator[tuple[str, str]]:
        """Where the numbers come from."""
        rows = self.run.cells.values()
        yield "study", "{study}, seed {seed}, validation parameters: {validation}".format(**self.run.identity)
        for axis in ("problem", "dual", "primal", "solver"):
            yield axis, ", ".join(self.values[axis])
        counts = pd.Series([row["status"] for row in rows], dtype=object).value_counts()
        yield "cells", f"{len(rows)}: " + ", ".join(f"{count} {status}" for status, count in counts.items())
        yield "machine", "; ".join(self.run.machines)
        disturbed = sum(row["disturbed"] == 1 for row in rows)
        yield (
            "seconds",
            f"CPU seconds on one thread; {disturbed} of {len(rows)} cells were timed on a disturbed machine",
        )
        yield "versions", ", ".join(f"{name} {text}" for name, text in self.run.versions.items() if text)
        yield "code", self.code
        yield "study file", ", ".join(sorted({str(row["study_hash"]) for row in rows if row["study_hash"]}))
        if self.note:
            yield "note", self.note

    @property
    def provenance(self) -> dict[str, Any]:
        """The same for programs."""
        return {
            **self.run.identity,
            "cells": len(self.run.cells),
            "ok": self.run.ok,
            "machines": self.run.machines,
            "versions": self.run.versions,
            "code": self.code.split(", "),
            "values": self.values,
            "note": self.note,
        }

    @property
    def commands(self) -> list[tuple[str, str]]:
        """Commands on the run as a whole, and what they do; they are meant for the folder of the results file."""
        study = str(self.run.identity["study"])
        commands = [("pip install -r requirements.txt", "the versions that computed it")]
        if study in registered(STUDY):
            commands.append((f"vibench run {shlex.quote(study)}", "the whole study, on your machine"))
        commands.append((f"vibench compare {FILE} YOUR-RUN", "your run beside this one"))
        return commands

    def cells(self) -> list[dict[str, Any]]:
        """The cells of the run with the command that makes each of them again, in the order of the axes."""
        return [
            {
                "key": key,
                "axes": [
                    str(row["problem"]), str(row["dual"]), f"{_formulation(row)}{row['primal']}{_tolerance(row)}",
                    f"{asked(row, 'pod')}, {asked(row, 'dual')}", solver_text(row),
                    way(row["assembly"], row["correction"]) or "full",
                ],
                "status": str(row["status"]),
                "numbers": [cell_text(row[name]) for name in SHOWN_CELLS],
                "command": f"vibench run {FILE} --cell {shlex.quote(key)} --out again",
            }
            for key, row in self.run.cells.items()
        ]  # fmt: skip


def _formulation(row: Mapping[str, Any]) -> str:
    return "" if row["formulation"] == MIXED else f"{row['formulation']}: "


def _tolerance(row: Mapping[str, Any]) -> str:
    return "" if pd.isna(row["primal_tol"]) else f" {row['primal_tol']:g}"


def folder_names(names: Sequence[str]) -> list[str]:
    """Names of folders for runs of these names: what a link needs no escapes for, all different in any case."""
    folders: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "run"
        taken = {other.lower() for other in folders}
        same = (plain if k == 1 else f"{plain}-{k}" for k in range(1, len(names) + 2))
        folders.append(next(one for one in same if one.lower() not in taken))
    return folders
