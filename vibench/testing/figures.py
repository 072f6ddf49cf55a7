"""The conformance checks of figure plugins: figures that are drawn and have captions, columns with a value per row."""

from __future__ import annotations

import inspect
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import pandas as pd

from vibench.interfaces.figures import EXTENSIBLE, DerivedColumn, FigurePlugin
from vibench.report.figures.data import Data, problems
from vibench.report.figures.plugins import draw_guarded, named
from vibench.report.figures.style import caption_of, styled
from vibench.results.plugin_columns import Copies, column_values, declared, name_faults
from vibench.results.read import read_table, results_file
from vibench.testing.case import Examined
from vibench.testing.checks import Check, Conformance, Doubt, Note
from vibench.testing.samples.sample_run import write_sample_run

NAME = "examined"
"""What the plugin is called in messages of the functions that draw."""


@dataclass(eq=False)
class FigureCase(Examined[FigurePlugin]):
    """A figure plugin and the results file that its figures and columns are made from.

    Parameters
    ----------
    create
        Its class; an instance is refused with a `TypeError`.
    run
        A run: its folder, its results file, or its name under `runs/`. By default a made-up one of two problems,
        membrane and plate, each with two dual strategies and three enrichments, in which a cell failed.
    seconds
        Longest wall time [s] of a figure or a column.
    """

    base = FigurePlugin
    run: str | Path | None = None

    @cached_property
    def folder(self) -> Path:
        """Folder of the made-up runs, which goes with the case."""
        folder = tempfile.mkdtemp(prefix="vibench-check-")
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        return Path(folder)

    @cached_property
    def path(self) -> Path:
        """The results file: of the run that is given, or of the made-up one."""
        return write_sample_run(self.folder / "run") if self.run is None else results_file(str(self.run))

    @cached_property
    def recorded(self) -> Copies:
        """The recorded tables, read before any column is timed."""
        return _read(self.path)

    @cached_property
    def empty(self) -> Copies:
        """The recorded tables of a run without cells."""
        return _read(write_sample_run(self.folder / "empty", empty=True))

    @cached_property
    def problems(self) -> list[Data]:
        """The tables of every problem of the run."""
        return [data for _, data in problems(self.path)]

    @cached_property
    def columns(self) -> tuple[DerivedColumn, ...]:
        """The columns that it declares."""
        return tuple(declared(NAME, self.plugin))

    def construction(self) -> Iterator[str]:
        """It is made without arguments."""
        yield from super().construction()
        constructor = getattr(self.create, "func", self.create)
        options = list(inspect.signature(constructor).parameters)
        if options:
            yield Doubt(f"it is created without arguments: nobody sets {', '.join(options)}")

    def drawings(self) -> Iterator[str]:
        """Every problem has figures, as functions by the ends of their names."""
        for data in self.problems:
            kinds = [kind for kind, _ in named(NAME, self.plugin, data)]
            yield Note(f"{data.problem}: {len(kinds)} figures")

    def figures(self) -> Iterator[str]:
        """Every figure is drawn or has nothing to show, has a caption, and changes no table."""
        drawn = 0
        for data in self.problems:
            before = _frames(data)
            for kind, draw in list(named(NAME, self.plugin, data)):
                with styled():
                    figure = self.clocked(f"figure '{kind}'", partial(draw_guarded, NAME, kind, draw))
                drawn += figure is not None
                if figure is not None and not caption_of(figure):
                    yield Doubt(
                        f"{data.problem}: figure '{kind}' has no caption: use Sheet of vibench.report, or a docstring"
                    )
            for name, frame in _frames(data).items():
                if not frame.equals(before[name]):
                    yield f"{data.problem}: drawing changes tables.{name}; work on a copy"
        yield Note(f"{drawn} figures drawn")

    def declarations(self) -> Iterator[str]:
        """Columns have names and headings that nothing else has."""
        yield from name_faults(NAME, self.columns)
        yield Note(", ".join(f"{one.name} of {one.table}" for one in self.columns) or "no columns")

    def values(self) -> Iterator[str]:
        """Columns have a value of their type for every row, also where there is none."""
        for recorded in (self.recorded, self.empty):
            for column in self.columns:
                entries = self.clocked(f"column '{column.name}'", partial(_values, column, recorded))
                if recorded is self.recorded and len(entries) and entries.isna().all():
                    yield Doubt(f"column '{column.name}' is empty in all {len(entries)} rows")

    def determinism(self) -> Iterator[str]:
        """A second call and another instance give the same figures and columns."""
        other = self.create()
        for data in self.problems:
            here, there = ([kind for kind, _ in named(NAME, plugin, data)] for plugin in (self.plugin, other))
            if here != there:
                yield f"{data.problem}: another instance has the figures {', '.join(there)}, not {', '.join(here)}"
        again = {column.name: column for column in declared(NAME, other)}
        if list(again) != [column.name for column in self.columns]:
            yield f"another instance has the columns {', '.join(again)}"
            return
        for column in self.columns:
            first = _values(column, self.recorded)
            for source, same in (("a second call", column), ("another instance", again[column.name])):
                entries = _values(same, self.recorded)
                if not entries.equals(first):
                    row = int((~(entries.eq(first) | (entries.isna() & first.isna()))).to_numpy().argmax())
                    yield (
                        f"{source} gives column '{column.name}' other values: {entries.iloc[row]} against "
                        f"{first.iloc[row]} in row {row}"
                    )
                    break

    def something(self) -> Iterator[str]:
        """There is a figure or a column of this run."""
        if not self.columns and not any(self.plugin.drawings(data) for data in self.problems):
            where = "this run" if self.run else "the made-up run, whose problems are membrane and plate"
            yield Doubt(f"neither figures nor columns of {where}: `--run RUN` checks on a run of yours")

    def _spent(self) -> Iterator[Note]:
        """What the slowest call took: there are many figures."""
        slowest = max((max(seconds) for seconds in self._times.values()), default=0.0)
        yield Note(f"at most {slowest:.2g} s each")


def _read(path: Path) -> Copies:
    """The tables of a results file that columns are made from."""
    recorded = Copies(partial(read_table, path))
    for table in EXTENSIBLE:
        recorded.of(table)
    return recorded


def _values(column: DerivedColumn, recorded: Copies) -> pd.Series:
    return column_values(NAME, column, recorded, recorded.of(column.table))


def _frames(data: Data) -> dict[str, pd.DataFrame]:
    """Copies of the tables that figures are drawn from."""
    return {name: getattr(data, name).copy() for name in ("cells", "queries", "histories", "thresholds")}


FIGURE = Conformance("figure", FigureCase, (
    Check("construction", FigureCase.construction),
    Check("drawings", FigureCase.drawings, ("construction",)),
    Check("figures", FigureCase.figures, ("drawings",)),
    Check("columns", FigureCase.declarations, ("construction",)),
    Check("values", FigureCase.values, ("columns",)),
    Check("determinism", FigureCase.determinism, ("figures", "values")),
    Check("something to show", FigureCase.something, ("drawings", "columns")),
    Check("time", FigureCase.duration, ("figures", "values")),
))  # fmt: skip
