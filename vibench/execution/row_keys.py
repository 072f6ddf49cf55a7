"""The columns that name a cell or a history in the results."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from vibench.interfaces.strategies import Stop
from vibench.stages.base import Stage
from vibench.stages.offline import ConeStage, EnrichmentStage, PODStage
from vibench.stages.pictures import PictureStage
from vibench.stages.snapshots import HighFidelity
from vibench.study.cells import Cell, Plugin


def cell_columns(cell: Cell) -> dict[str, Any]:
    """The key columns of a cell."""
    problem, dual, primal = cell.labels
    return {
        **_plugin("problem", cell.problem, problem),
        **_plugin("dual", cell.dual, dual),
        **_plugin("primal", cell.primal, primal),
        **_stop("pod", cell.pod),
        **_stop("dual", cell.cone),
        "primal_tol": cell.primal_tol,
        "solver": cell.solver,
        "assembly": cell.assembly,
    }


class HistoryNames:
    """Key columns of histories: of those axes the stage depends on, labelled as the cells are."""

    def __init__(self, cells: Iterable[Cell]) -> None:
        self._labels: dict[Plugin, str] = {}
        for cell in cells:
            for plugin, label in zip((cell.problem, cell.dual, cell.primal), cell.labels, strict=True):
                self._labels.setdefault(plugin, label)

    def columns(self, stage: Stage) -> dict[str, Any]:
        """The columns for one stage; those of axes it does not depend on are left out."""
        match stage:
            case HighFidelity() | PictureStage():
                return self._named("problem", stage.problem)
            case PODStage():
                return self._named("problem", stage.problem) | _stop("pod", stage.stop)
            case ConeStage():
                named = self._named("problem", stage.problem) | self._named("dual", stage.dual)
                return named | _stop("dual", stage.stop)
            case EnrichmentStage():
                named = self.columns(stage.pod) | self.columns(stage.cone) | self._named("primal", stage.primal)
                return named | {"primal_tol": stage.tolerance}
        return {}

    def _named(self, axis: str, plugin: Plugin) -> dict[str, Any]:
        return _plugin(axis, plugin, self._labels[plugin])


def _plugin(axis: str, plugin: Plugin, label: str) -> dict[str, Any]:
    return {axis: label, f"{axis}_options": plugin.options}


def _stop(axis: str, stop: Stop) -> dict[str, Any]:
    return {f"{axis}_tol": stop.tolerance, f"{axis}_size": stop.size}
