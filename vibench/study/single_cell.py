"""Studies of one cell: what makes a row of a results file again."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop
from vibench.study.cells import Cell
from vibench.study.parameter_sets import ParameterSet
from vibench.study.plugin import GivenPlugin, Plugin
from vibench.study.spec import Study
from vibench.study.values import OWN


def study_of_cell(cell: Cell, name: str, **settings: Any) -> Study:
    """The study that has one cell, whose key is that of the cell given.

    Parameters
    ----------
    cell
        The cell.
    name
        Name of the study.
    settings
        Settings of the study that do not determine its numbers: `timing_rounds`, `limits`.

    Raises
    ------
    RequestError
        If a plugin of the cell is not installed, or the name is none of a study.
    """
    problem, dual, primal = (
        _entry(plugin, label) for plugin, label in zip((cell.problem, cell.dual, cell.primal), cell.labels, strict=True)
    )
    tolerances: dict[str, Any] = dict([_stop("pod", "N", cell.pod), _stop("dual", "R", cell.cone)])
    if cell.primal_tol is not None:
        tolerances["primal"] = {cell.labels[2]: [cell.primal_tol]}
    content: dict[str, Any] = {
        "training": _entry_of_set(cell.training) or OWN,
        "name": name,
        "seed": cell.validation.seed,
        "validation": _entry_of_set(cell.validation) or cell.validation.count,
        "accuracy": [cell.accuracy],
        "solvers": [cell.solver],
        "problem": [problem],
        "dual": [dual],
        "primal": [primal],
        "assembly": [cell.assembly],
        "warm_start": cell.warm_start,
        "tolerances": [tolerances],
    }
    if cell.interpolation is not None:
        content["interpolation"] = cell.interpolation
    return Study(**content, **settings)


def _entry(plugin: Plugin, label: str) -> Any:
    given = plugin.registered
    name = given.given if isinstance(given, GivenPlugin) else plugin.name
    return {"name": name, "label": label, "options": json.loads(plugin.options)}


def _entry_of_set(parameters: ParameterSet) -> Any:
    """The entry of a sampling strategy; `None` of a set of the problem itself."""
    return None if parameters.sampling is None else _entry(parameters.sampling, parameters.label)


def _stop(tolerance: str, size: str, stop: Stop) -> tuple[str, list[float] | list[int]]:
    """Key and value of a grid of tolerances for a basis that stops at a tolerance or at a size."""
    return (tolerance, [stop.tolerance]) if stop.tolerance is not None else (size, [stop.size or 0])


def only_cell(cells: Sequence[Cell], key: str, where: str) -> Cell:
    """The cell whose key begins so.

    Raises
    ------
    RequestError
        If there is none, or several.
    """
    found = [cell for cell in cells if cell.key.startswith(key)]
    if len(found) != 1:
        raise RequestError(f"{len(found)} cells of {where} begin with '{key}', expected one")
    return found[0]
