"""The matrix of a study: the cells that its axes and tolerances make."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TypeAlias, TypeVar

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop
from vibench.reduction.nested import NestedStrategy
from vibench.study import registry
from vibench.study.cells import Cell
from vibench.study.entries import Entry, ProblemEntry
from vibench.study.parameter_sets import size_of_set
from vibench.study.plugin import Plugin
from vibench.study.spec import Study, ToleranceTable
from vibench.study.values import OWN


def expand(study: Study) -> list[Cell]:
    """All cells of a study without duplicates, in the order of its axes.

    Raises
    ------
    RequestError
        If the matrix is empty, or a strategy that takes a tolerance has none.
    """
    cells: dict[str, Cell] = {}
    problems = [(entry, plugin, _sets(study, entry, plugin)) for entry, plugin in _made("problem", study.problem)]
    duals, primals = _made("dual strategy", study.dual), _made("primal strategy", study.primal)
    for (problem, plugin, sets), table in product(problems, study.tolerances):
        nested = {entry.title: _nested_tolerances(entry, table) for entry in study.primal}
        for trained, (dual, pod, cone, primal, tolerance) in product(sets, _combinations(duals, primals, table)):
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
                    seed=study.seed,
                    accuracy=accuracy,
                    labels=(problem.title, dual[0].title, primal[0].title),
                    nested_tolerances=nested[primal[0].title],
                    validation=trained.validation,
                    training=trained.training,
                    validation_sampling=trained.validation_sampling,
                    set_labels=trained.labels,
                )
                cells.setdefault(cell.key, cell)
    if not cells:
        raise RequestError(f"study '{study.name}': the matrix is empty")
    return list(cells.values())


EntryT = TypeVar("EntryT", bound=Entry)
_Made: TypeAlias = tuple[EntryT, Plugin]


def _made(kind: str, entries: Sequence[EntryT]) -> list[_Made[EntryT]]:
    """The entries of an axis, each with its plugin: titles need not tell them apart."""
    return [(entry, Plugin.from_entry(kind, entry)) for entry in entries]


@dataclass(frozen=True)
class _Sets:
    """A training set and the validation set of a problem, as in the fields of a `Cell`."""

    training: Plugin | None
    validation: int
    validation_sampling: Plugin | None
    labels: tuple[str, str]


def _sets(study: Study, problem: ProblemEntry, plugin: Plugin) -> list[_Sets]:
    """The training sets of a problem in a study, each with the validation set."""
    asked = study.validation_of(problem)
    if isinstance(asked, int):
        count, checked, label = asked, None, OWN
    else:
        checked, label = Plugin.from_entry("sampling strategy", asked), asked.title
        count = size_of_set(plugin, checked)
    return [
        _Sets(
            None if entry.name == OWN else Plugin.from_entry("sampling strategy", entry),
            count,
            checked,
            (entry.title, label),
        )
        for entry in study.training_of(problem)
    ]


def _nested_tolerances(primal: Entry, table: ToleranceTable) -> tuple[float, ...]:
    kind = "primal strategy"
    if registry.conflict(kind, primal.name) or not issubclass(registry.load(kind, primal.name), NestedStrategy):
        return ()
    return tuple(sorted({value for value in table.of_primal(primal) if value is not None}, reverse=True))


def _combinations(
    duals: Sequence[_Made[Entry]], primals: Sequence[_Made[Entry]], table: ToleranceTable
) -> Iterator[tuple[_Made[Entry], Stop, Stop, _Made[Entry], float | None]]:
    pods = [Stop(tolerance=value) for value in table.pod or []] + [Stop(size=value) for value in table.N or []]
    for pod, dual, primal in product(pods, duals, primals):
        for cone, tolerance in product(table.of_dual(dual[0]), table.of_primal(primal[0])):
            yield dual, pod, cone, primal, tolerance
