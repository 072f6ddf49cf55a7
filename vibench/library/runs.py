"""Runs from Python: a study is run, a finished run is opened."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pandas as pd

from vibench import interrupts
from vibench.errors import unknown_name
from vibench.execution.recorded_cell import recorded_cell
from vibench.execution.recording import REPORT
from vibench.execution.run import Observer, Options, run_study
from vibench.files import writing
from vibench.offline.models import Model
from vibench.results import formats, ranking, show
from vibench.results.read import cells_with_errors, in_order, read_table, results_file
from vibench.results.schema import TABLES
from vibench.results.sqlite import read_meta, study_of
from vibench.results.verdict import Verdict, verdicts
from vibench.signatures import Positive, bordered
from vibench.study.spec import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@bordered
class Run:
    """A run: its tables, figures and reduced models.

    Parameters
    ----------
    path
        The results file.
    at
        Where files and folders of its study are now, by name; by default where they were.
    """

    def __init__(self, path: Path, at: Mapping[str, str] = {}) -> None:
        self.path, self._at = path, at

    def __repr__(self) -> str:
        return f"Run('{self.path}')"

    def _repr_html_(self) -> str:
        shown = self.summary.to_html(index=False, na_rep="", float_format="{:.3g}".format, border=0)
        return f"<p>{escape(str(self.study['name']))}, {escape(str(self.path))}</p>{shown}"

    @cached_property
    def study(self) -> dict[str, Any]:
        """Facts common to all rows: name and seed of the study, and the number of validation parameters."""
        return study_of(self.path, read_meta(self.path))

    def table(self, name: str) -> pd.DataFrame:
        """A table of the results file in the order of the axes; a `RequestError` if there is no such table."""
        if name not in TABLES:
            raise unknown_name("table", name, TABLES)
        return in_order(read_table(self.path, name))

    @property
    def cells(self) -> pd.DataFrame:
        """A row per cell: dimensions, means of errors and constants, seconds."""
        return self.table("cells")

    @property
    def queries(self) -> pd.DataFrame:
        """A row per query of a cell: status, residuals, errors, constants, bounds, seconds."""
        return self.table("queries")

    @property
    def histories(self) -> pd.DataFrame:
        """A row per step of POD, cones and enrichments: errors, σ and β."""
        return self.table("histories")

    @property
    def thresholds(self) -> pd.DataFrame:
        """A row per pair of cells, or of the high-fidelity model and a cell: the break-even and its interval."""
        return self.table("thresholds")

    def break_even(self, error: str = "solution", within: Positive | None = None) -> pd.DataFrame:
        """The thresholds with the errors of both models, `error_a` and `error_b`; 0 of the high-fidelity model.

        Raises a `RequestError` if there is no such measure, or the largest error is not positive.

        Parameters
        ----------
        error
            Measure of the mean relative error: "u", "lambda", "solution" for the larger one of these, or "output:NAME"
            for a quantity of interest.
        within
            Largest error that both models may have; by default all rows are kept.
        """
        rows = ranking.with_errors(self.thresholds, *cells_with_errors(self.path, error))
        return rows if within is None else ranking.within(rows, within).reset_index(drop=True)

    def best(
        self, queries: Positive | None = None, error: Positive | None = None, measure: str = "solution"
    ) -> pd.DataFrame:
        """The best model of every problem: at every level of error that is reached, or within one.

        Raises a `RequestError` for a number that is not positive, an error without `queries`, or no such measure.

        Parameters
        ----------
        queries
            Number of queries: the model with the smallest total costs for so many, with the interval of these, the
            numbers of queries between which it is the cheapest, the fraction of draws in which it is, and the number of
            others that may be as cheap. By default the model with the fastest query.
        error
            Largest error that is allowed; needs `queries`. By default there is a row for every power of ten.
        measure
            Measure of the error, as in `break_even`.
        """
        # An empty measure is the default of the table, whose heading then needs no name.
        of_solution = "" if measure == "solution" else measure
        return show.look_up(self.path, "best", error=of_solution, largest=error, queries=queries).rows

    @property
    def verdict(self) -> list[Verdict]:
        """Whether reduction pays: for every problem the cost of a full solution, and the best model within 1 %."""
        return list(verdicts(self.cells, self.thresholds))

    @property
    def summary(self) -> pd.DataFrame:
        """The table that `vibench show` prints."""
        return formats.summary(read_table(self.path, "cells"))

    @property
    def findings(self) -> list[str]:
        """Sentences on what a reader has to know beside the numbers, what is alarming first."""
        from vibench.report.findings import findings  # noqa: PLC0415  of the layer above

        return findings(self.path)

    def figure(self, kind: str, problem: str | None = None) -> Figure:
        """One figure of the run, to be shown or saved: "answer", "solutions", "convergence", "bounds" or "solvers".

        `problem` is its label, not needed where the run has one. Raises a `RequestError` if there is no such figure,
        or the run has no data for it.
        """
        from vibench.report.figures import draw  # noqa: PLC0415  loads matplotlib

        return draw(self.path, kind, problem)

    def write_tables(self, folder: Path | str | None = None) -> list[Path]:
        """Write every table as CSV, and the summary as Markdown; into `tables` beside the results file by default."""
        target = self.path.parent / "tables" if folder is None else Path(folder)
        with writing(target):
            return show.export(self.path, target)

    def write_figures(
        self, folder: Path | str | None = None, formats: Sequence[Literal["png", "svg", "pdf"]] = ("png", "svg")
    ) -> list[Path]:
        """Write every figure, and their captions; into `figures` beside the results file by default.

        A figure that cannot be drawn is left out with a warning.
        """
        from vibench.report.figures import draw_all  # noqa: PLC0415  loads matplotlib

        target = self.path.parent / "figures" if folder is None else Path(folder)
        with writing(target):
            files, failures = draw_all(self.path, target, tuple(formats))
        for line in failures:
            warnings.warn(line, stacklevel=3)
        return files

    def report(self, path: Path | str | None = None, *, figures: bool = True) -> Path:
        """Write the report, one HTML page; into the folder of the run by default. Returns its path.

        Without pictures of the `figures` it is written in a fraction of the time; tables and plots are the same.
        """
        from vibench.report import html  # noqa: PLC0415  loads matplotlib

        return html.write(self.path, self.path.parent / REPORT if path is None else Path(path), figures=figures)

    def model(self, cell: str) -> Model:
        """The model of a cell, named by the beginning of its key; stages whose artefacts are missing are run again.

        Raises a `RequestError` if there is no such cell, it failed before it had a model, or other code computed it.
        """
        return recorded_cell(str(self.path), cell, self._at).model


def open_run(path: Path | str, *, at: Mapping[str, str] = {}) -> Run:
    """A finished run: its folder, its results file, or the name of a study that was run in this folder.

    Raises a `RequestError` if there is no results file, or it has another schema.

    Parameters
    ----------
    path
        Where it is.
    at
        Where files and folders of its study, such as packs, are now, by the name that its tables have of them.
    """
    return Run(results_file(str(path)), {name: str(Path(place).absolute()) for name, place in at.items()})


def run(
    study: Study,
    out: Path | str | None = None,
    *,
    jobs: int = 0,
    fresh: bool = False,
    retry: bool = False,
    executor: Literal["local", "dask"] = "local",
    scheduler: str | None = None,
    repeats: int = 0,
    observer: Observer | None = None,
    progress: bool = True,
) -> Run:
    """Run the cells of a study that have no row yet; an interrupted run is continued.

    Parameters
    ----------
    study
        The study, from `Study` or `read_study`.
    out
        Run folder; `runs/NAME` by default.
    jobs
        Worker processes; 0 for one per core. Numbers do not depend on it.
    fresh
        Remove earlier results of the study and compute everything again.
    retry
        Also redo cells that did not end ok.
    executor
        Where the work is done: "local" for processes of this machine, "dask" for a dask cluster.
    scheduler
        Address of the scheduler of an existing dask cluster; without one a cluster is started on this machine, for
        which a script needs the guard `if __name__ == "__main__"`.
    repeats
        Cold processes in which seconds are measured, at least, and how often offline stages are; by default what
        decides the comparisons of the study.
    observer
        Receives the events of the run, in place of the progress display.
    progress
        Whether to show the progress, in a terminal or a notebook.

    Raises
    ------
    RequestError
        If the folder or the cache cannot be used, or there would be too many worker processes.
    StorageError
        If something cannot be written; what was written before is kept.
    KeyboardInterrupt
        On Ctrl-C: what is finished is written, and the same call continues the run.
    """
    folder = Path("runs") / study.name if out is None else Path(out)
    options = Options(jobs, fresh, retry, executor, scheduler, repeats)
    following: AbstractContextManager[Observer] = nullcontext(observer or Observer())
    if observer is None and progress:
        from vibench.library.progress import ProgressDisplay  # noqa: PLC0415  loads rich

        following = ProgressDisplay()
    # After the first Ctrl-C a run ignores all others until everything is written.
    with following as follower, interrupts.restored():
        outcome = run_study(study, folder, follower, options)
    if outcome.interrupted:
        raise KeyboardInterrupt(f"{outcome.missing} cells have no row yet; the same call continues the run")
    return open_run(folder)
