"""The matrix of a study: the cells that its axes and tolerances make."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import TypeAlias, TypeVar

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop
from vibench.reduction.nested import NestedStrategy
from vibench.study.cells import Cell
from vibench.study.entries import Entry
from vibench.study.kinds import DUAL, PRIMAL, PROBLEM, PluginKind
from vibench.study.plugin import Plugin
from vibench.study.spec import Study, ToleranceTable


def expand(study: Study) -> list[Cell]:
    """All cells of a study without duplicates, in the order of its axes.

    Raises
    ------
    RequestError
        If the matrix is empty, or a strategy that takes a tolerance has none.
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
