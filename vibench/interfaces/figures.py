"""The interface of figure plugins: figures of a run beside those that vibench draws."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

if TYPE_CHECKING:  # worker processes load this module and no tables or figures
    import pandas as pd
    from matplotlib.figure import Figure

Drawing = Callable[[], "Figure | None"]
"""Draws one figure; `None` where there is nothing to draw."""


class ProblemTables(Protocol):
    """What figures are drawn from: the tables of one problem of a run."""

    @property
    def problem(self) -> str:
        """Label of the problem in the study."""

    @property
    def problem_name(self) -> str:
        """Name under which its plugin is registered."""

    @property
    def problem_options(self) -> Mapping[str, Any]:
        """Its options that are not at their default."""

    @property
    def machine(self) -> str:
        """Machines that measured the seconds."""

    @property
    def cells(self) -> pd.DataFrame:
        """A row per cell; the documentation lists the columns of all tables."""

    @property
    def queries(self) -> pd.DataFrame:
        """A row per query of a cell, with `N`, `R` and `enrichment_kind` of its cell."""

    @property
    def histories(self) -> pd.DataFrame:
        """A row per step of POD, cones and enrichments, and per diagnostic of the problem."""

    @property
    def thresholds(self) -> pd.DataFrame:
        """A row per pair of cells that break-even compares."""


class FigurePlugin(ABC):
    """Figures of a plugin, drawn with every run for which it returns any. It is created without arguments."""

    requires: ClassVar[tuple[str, ...]] = ()
    """Optional distributions it cannot do without; where one is not installed its figures are not drawn."""
    publication: ClassVar[str] = ""
    """Publication whose figures it draws again; such figures are drawn by `vibench figures --paper` alone."""

    @abstractmethod
    def drawings(self, tables: ProblemTables) -> Mapping[str, Drawing]:
        """Functions that draw the figures of one problem, by the end of their file names; empty if there are none.

        Called again in every process that draws: it should do no work itself. A figure that is a
        `vibench.CaptionedFigure` brings its caption; of any other the caption is the docstring of its function.
        """
