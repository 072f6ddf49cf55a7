"""The interface of figure plugins: figures of a run beside those that vibench draws, and columns of its tables."""

from __future__ import annotations

import re
from abc import ABC
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

if TYPE_CHECKING:  # worker processes load this module and no tables or figures
    import pandas as pd
    from matplotlib.figure import Figure

Drawing = Callable[[], "Figure | None"]
"""Draws one figure; `None` where there is nothing to draw."""


class RecordedTables(Protocol):
    """The tables of the cells of a run, or of one problem of it."""

    @property
    def cells(self) -> pd.DataFrame:
        """A row per cell; the documentation lists the columns of all tables."""

    @property
    def queries(self) -> pd.DataFrame:
        """A row per query of a cell."""

    @property
    def histories(self) -> pd.DataFrame:
        """A row per step of POD, cones and enrichments, and per diagnostic of a problem."""

    @property
    def thresholds(self) -> pd.DataFrame:
        """A row per pair of cells that break-even compares."""


class ProblemTables(RecordedTables, Protocol):
    """What figures are drawn from: the tables of one problem of a run.

    Rows of `queries` have `N`, `R` and `enrichment_kind` of their cell, too.
    """

    @property
    def problem(self) -> str:
        """Label of the problem in the study."""

    @property
    def problem_name(self) -> str:
        """Name under which the plugin of the problem is registered."""

    @property
    def problem_options(self) -> Mapping[str, Any]:
        """Options of the problem that are not at their default."""

    @property
    def machine(self) -> str:
        """Machines that measured the seconds."""


class RunTables(RecordedTables, Protocol):
    """What derived columns are computed from: the recorded tables of a whole run, without columns of plugins.

    Each access gives a copy, whose rows have the order in which values are expected.
    """

    @property
    def timings(self) -> pd.DataFrame:
        """A row per timing round of a cell."""

    @property
    def outputs(self) -> pd.DataFrame:
        """A row per cell and quantity of interest."""


EXTENSIBLE = ("cells", "queries", "histories", "timings", "thresholds", "outputs")
"""Tables that plugins may add columns to: those of `RunTables`."""

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,59}")


@dataclass(frozen=True)
class DerivedColumn:
    """A column that a plugin adds to a table of the results, computed whenever the table is read.

    Attributes
    ----------
    name
        Letters, digits and underscores; no column of the results has this name.
    meaning
        One sentence that says what it is.
    values
        From the tables of a run to the values, one for each row of the table in its order; the same ones at every call.
        A number that is missing is `None` or NaN.
    table
        The table: one of `EXTENSIBLE`.
    kind
        `float`, `int` or `str`.
    unit
        Unit of a number, "1" for a pure one; "" for a text, or a number that counts.
    heading
        Heading in the summary, or in the table of break-even points; "" for a column that stands in no summary.
    better
        Whether a smaller or a larger number is better where runs are compared; "" if neither is.

    Raises
    ------
    ValueError
        If an attribute is none of these.
    """

    name: str
    meaning: str
    values: Callable[[RunTables], Sequence[Any] | pd.Series]
    table: str = "cells"
    kind: type = float
    unit: str = "1"
    heading: str = ""
    better: Literal["", "smaller", "larger"] = ""

    def __post_init__(self) -> None:
        what = f"the column {self.name!r}"
        if not isinstance(self.name, str) or not NAME.fullmatch(self.name):
            raise ValueError(f"{what} has a name that is not made of letters, digits and underscores, a letter first")
        if self.table not in EXTENSIBLE:
            raise ValueError(f"{what} is for the table {self.table!r}, expected one of {', '.join(EXTENSIBLE)}")
        if self.kind not in (float, int, str):
            raise ValueError(f"{what} has the kind {self.kind!r}, expected float, int or str")
        if self.better not in ("", "smaller", "larger") or (self.better and self.kind is str):
            raise ValueError(f"{what} is better where it is {self.better!r}, expected 'smaller' or 'larger' of numbers")
        if not callable(self.values):
            raise ValueError(f"{what} has {type(self.values).__name__} for its values, expected a function")


class FigurePlugin(ABC):  # noqa: B024  a plugin has figures, columns, or both
    """Figures and columns of a plugin, for every run for which it has any. It is created without arguments."""

    requires: ClassVar[tuple[str, ...]] = ()
    """Optional distributions it cannot do without; where one is not installed it has no figures and no columns."""
    publication: ClassVar[str] = ""
    """Publication whose figures it draws again; such figures are drawn by `vibench figures --paper` alone."""

    def drawings(self, tables: ProblemTables) -> Mapping[str, Drawing]:  # noqa: ARG002
        """Functions that draw the figures of one problem, by the end of their file names; empty if there are none.

        Called again in every process that draws: it should do no work itself. A figure that is a
        `vibench.report.CaptionedFigure` brings its caption; of any other the caption is the docstring of its function.
        """
        return {}

    def columns(self) -> Sequence[DerivedColumn]:
        """Columns that it adds to tables of the results; called whenever a table is read, so it should do no work."""
        return ()
