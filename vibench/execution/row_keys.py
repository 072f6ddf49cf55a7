"""The key columns of the results: of cells, and of the rows and histories of a stage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from vibench.interfaces.strategies import Stop
from vibench.study.cells import Axes, Cell, Plugin


def cell_columns(cell: Cell) -> dict[str, Any]:
    """The key columns of a cell."""
    labels = dict(zip((cell.problem, cell.dual, cell.primal), cell.labels, strict=True))
    return {**axis_columns(cell.axes, labels), "solver": cell.solver, "assembly": cell.assembly}


def labels_of(cells: Iterable[Cell]) -> dict[Plugin, str]:
    """The names of a study's plugins in its results: their labels in the first cell that has them."""
    found: dict[Plugin, str] = {}
    for cell in cells:
        for plugin, label in zip((cell.problem, cell.dual, cell.primal), cell.labels, strict=True):
            found.setdefault(plugin, label)
    return found


def axis_columns(axes: Axes, labels: Mapping[Plugin, str]) -> dict[str, Any]:
    """The key columns of some axes; unset axes have none."""
    columns: dict[str, Any] = {}
    for name, plugin in (("problem", axes.problem), ("dual", axes.dual), ("primal", axes.primal)):
        if plugin is not None:
            columns |= {name: labels[plugin], f"{name}_options": plugin.options}
    for name, stop in (("pod", axes.pod), ("dual", axes.cone)):
        if stop is not None:
            columns |= _stop(name, stop)
    return columns if axes.primal is None else columns | {"primal_tol": axes.primal_tol}


def _stop(axis: str, stop: Stop) -> dict[str, Any]:
    return {f"{axis}_tol": stop.tolerance, f"{axis}_size": stop.size}
