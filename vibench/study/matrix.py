"""The matrix of a study: the cells that its axes and tolerances make, and the study that one cell makes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, TypeAlias, TypeVar

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop
from vibench.reduction.nested import NestedStrategy
from vibench.study.cells import Cell
from vibench.study.entries import Entry
from vibench.study.kinds import DUAL, PRIMAL, PROBLEM, PluginKind
from vibench.study.parameter_sets import OWN, ParameterSet
from vibench.study.plugin import GivenPlugin, Plugin
from vibench.study.spec import Study, ToleranceTable


def expand(study: Study) -> list[Cell]:
    """All cells of a study without duplicates, in the order of its axes.

    Raises a `RequestError` if the matrix is empty, or a strategy that takes a tolerance has none.
    """
    cells: dict[str, Cell] = {}
    problems = [
        (entry, plugin, study.training_sets(entry), study.validation_set(entry).sized(plugin))
        for entry, plugin in _made(PROBLEM, study.problem)
    ]
    duals, primals = _made(DUAL, study.dual), _made(PRIMAL, study.primal)
    for (problem, plugin, sets, validation), table in product(problems, study.tolerances):
        nested = {entry.title: _nested_tolerances(entry, table) for entry in study.primal}
        for training, (dual, pod, cone, primal, tolerance) in product(sets, _combinations(duals, primals, table)):
            for assembly, solver, accuracy in product(study.assembly, study.solver_names(), study.accuracy):
                cell = Cell(
                    problem=plugin,
                    dual=dual[1],
                    primal=primal[1],
                    pod=pod,
                    cone=cone,
                    primal_tol=tolerance,
                    solver=solver,
                    assembly=assembly,
                    interpolation=None if assembly == "full" else study.interpolation,
                    warm_start=study.warm_start,
                    accuracy=accuracy,
                    training=training,
                    validation=validation,
                    labels=(problem.title, dual[0].title, primal[0].title),
                    nested_tolerances=nested[primal[0].title],
                )
                cells.setdefault(cell.key, cell)
    if not cells:
        raise RequestError(f"study '{study.name}': the matrix is empty")
    return list(cells.values())


EntryT = TypeVar("EntryT", bound=Entry)
_Made: TypeAlias = tuple[EntryT, Plugin]


def _made(kind: PluginKind, entries: Sequence[EntryT]) -> list[_Made[EntryT]]:
    """The entries of an axis, each with its plugin: titles need not tell them apart."""
    return [(entry, entry.plugin(kind)) for entry in entries]


def _nested_tolerances(primal: Entry, table: ToleranceTable) -> tuple[float, ...]:
    plugin = primal.registered(PRIMAL)
    if plugin.conflict or not issubclass(plugin.load(), NestedStrategy):
        return ()
    return tuple(sorted({value for value in table.of_primal(primal) if value is not None}, reverse=True))


def _combinations(
    duals: Sequence[_Made[Entry]], primals: Sequence[_Made[Entry]], table: ToleranceTable
) -> Iterator[tuple[_Made[Entry], Stop, Stop, _Made[Entry], float | None]]:
    pods = [Stop(tolerance=value) for value in table.pod or []] + [Stop(size=value) for value in table.N or []]
    for pod, dual, primal in product(pods, duals, primals):
        for cone, tolerance in product(table.of_dual(dual[0]), table.of_primal(primal[0])):
            yield dual, pod, cone, primal, tolerance


def study_of_cell(cell: Cell, name: str, **settings: Any) -> Study:
    """The study that has one cell, whose key is that of the cell given.

    Other settings are those that do not determine its numbers: `timing_rounds`, `limits`.

    Raises a `RequestError` if a plugin of the cell is not installed, or the name is none of a study.
    """
    problem, dual, primal = (
        _plugin_entry(plugin, label)
        for plugin, label in zip((cell.problem, cell.dual, cell.primal), cell.labels, strict=True)
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


def _plugin_entry(plugin: Plugin, label: str) -> Any:
    given = plugin.registered
    name = given.given if isinstance(given, GivenPlugin) else plugin.name
    return {"name": name, "label": label, "options": json.loads(plugin.options)}


def _entry_of_set(parameters: ParameterSet) -> Any:
    """The entry of a sampling strategy; `None` of a set of the problem itself."""
    return None if parameters.sampling is None else _plugin_entry(parameters.sampling, parameters.label)


def _stop(tolerance: str, size: str, stop: Stop) -> tuple[str, list[float] | list[int]]:
    """Key and value of a grid of tolerances for a basis that stops at a tolerance or at a size."""
    return (tolerance, [stop.tolerance]) if stop.tolerance is not None else (size, [stop.size or 0])


def only_cell(cells: Sequence[Cell], key: str, where: str) -> Cell:
    """The cell whose key begins so.

    Raises a `RequestError` if there is none, or several.
    """
    matching = [cell for cell in cells if cell.key.startswith(key)]
    if len(matching) != 1:
        raise RequestError(f"{len(matching)} cells of {where} begin with '{key}', expected one")
    return matching[0]
