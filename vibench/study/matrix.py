"""Reading studies, expanding them into cells, and the study of a single cell."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from vibench.errors import RequestError, placed
from vibench.files import read_regular
from vibench.interfaces.strategies import Stop
from vibench.model.bound_terms import CorrectionMode
from vibench.plugins.kinds import PluginKind
from vibench.plugins.options import inside
from vibench.plugins.plugin import GivenPlugin, Plugin
from vibench.plugins.registry import find, registered
from vibench.reduction.nested import NestedStrategy
from vibench.study.cells import NO_SUCH_AXIS, Cell
from vibench.study.parameter_sets import OWN, ParameterSet
from vibench.study.spec import Entry, FormulationEntry, ProblemEntry, SamplingEntry, Study, ToleranceTable


def find_study(request: str) -> Path:
    """File of a study, from its path or registered name; raises a `RequestError` if there is none."""
    path = Path(request)
    # Methods of Path raise an OSError if a name is too long for a file.
    is_file, exists = os.path.isfile(path), os.path.exists(path)  # noqa: PTH110, PTH113
    # A registered name wins over a folder, such as the one of a run of that study.
    if path.suffix != ".toml" and not is_file:
        if exists and request not in registered(PluginKind.STUDY):
            raise RequestError(f"study '{request}' is not a file")
        return Path(find(PluginKind.STUDY, request).load())
    if not is_file:
        raise RequestError(f"study file '{request}' {'is not a file' if exists else 'does not exist'}")
    return path


def read_study(request: str, overrides: Mapping[str, Sequence[Any]] | None = None) -> Study:
    """Read and check a study.

    Parameters
    ----------
    request
        Path of a TOML file, or the name of a registered study.
    overrides
        Values that replace those of the file: of the axes "problem", "formulation", "dual", "primal", "solvers" and
        "correction", of "validation", and of the tolerances "pod", "dual_tol" and "primal_tol" in every table. Empty
        sequences replace nothing.

    Raises
    ------
    RequestError
        If the file cannot be read or is not a valid study; the message names the file, the key and the expected value.
    """
    path = find_study(request)
    with placed(str(path)):
        content = read_toml(path)
    given = {key: list(values) for key, values in (overrides or {}).items() if values}
    source = str(path) if path == Path(request) else f"study '{request}'"
    # The fault may be in either of them.
    source += " with the options of the command line" if given else ""
    content = _replace_axes({"name": path.stem} | content, given)
    # Paths in the options of problems and sampling strategies are relative to the folder of the file.
    problems = _tables(content.get("problem"))
    sets = [_tables(table.get(key)) for table in [content, *problems] for key in ("training", "validation")]
    samplings = [(PluginKind.SAMPLING, entry) for entries in sets for entry in entries]
    for kind, entry in (*((PluginKind.PROBLEM, entry) for entry in problems), *samplings):
        _anchor_options(kind, entry, path.absolute().parent)
    with placed(source):
        return Study.model_validate(content)


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file, or a `RequestError`."""
    try:
        # Without the byte-order mark of some editors, which TOML does not know.
        text = read_regular(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"cannot be read as text: {error}") from None
    try:
        return tomllib.loads(text)
    # Syntax errors, but also numbers too long, and nesting too deep.
    except (ValueError, RecursionError) as error:
        raise RequestError(f"not valid TOML: {error}") from None


def _tables(entries: Any) -> list[dict[str, Any]]:
    return [entry for entry in (entries if isinstance(entries, list) else [entries]) if isinstance(entry, dict)]


def _anchor_options(kind: PluginKind, entry: dict[str, Any], folder: Path) -> None:
    plugin, given = find(kind, str(entry.get("name"))), entry.get("options")
    for options in (entry, given if isinstance(given, dict) else {}):
        # A name that nobody registers is refused later, with the other names of the study.
        for name in plugin.path_options if plugin.entries else ():
            value = options.get(name)
            if isinstance(value, str) and value and not value.startswith("/"):
                options[name] = inside(folder, value)


def _replace_axes(content: dict[str, Any], given: Mapping[str, list[Any]]) -> dict[str, Any]:
    """Unchecked content of a study file with the axes and tolerances of the command line."""
    for axis in ("problem", "formulation", "dual", "primal", "solvers"):
        if axis in given:
            content[axis] = [entry for name in given[axis] for entry in _entries_in(content.get(axis), name)]
    if "correction" in given:
        content["correction"] = given["correction"]
    if "validation" in given:
        (content["validation"],) = given["validation"]
    tables = content.get("tolerances")
    if isinstance(tables, list) and all(isinstance(table, dict) for table in tables):
        primal = content.get("primal")
        titles = [_tolerant_title(entry) for entry in (primal if isinstance(primal, list) else ())]
        for table in tables:
            for key, tolerance, size in (("pod", "pod", "N"), ("dual_tol", "dual", "R")):
                if key in given:
                    # A grid takes tolerances or sizes: those of the command line replace either.
                    table.pop(size, None)
                    table[tolerance] = given[key]
            if "primal_tol" in given:
                table["primal"] = dict.fromkeys(filter(None, titles), given["primal_tol"])
    return content


def _tolerant_title(entry: Any) -> str:
    """Title of an unchecked entry of the primal axis if its strategy takes a tolerance, else ""."""
    table = entry if isinstance(entry, dict) else {"name": entry}
    plugin = find(PluginKind.PRIMAL, str(table.get("name")))
    takes_tolerance = plugin.entries and not plugin.conflict and plugin.load().takes_tolerance
    return str(table.get("label", table.get("name"))) if takes_tolerance else ""


def _entries_in(axis: Any, name: str) -> list[Any]:
    """Entries of an unchecked axis with this name or label; the name itself if there are none."""
    tables = [entry for entry in axis if isinstance(entry, dict)] if isinstance(axis, list) else []
    return [entry for entry in tables if name in (entry.get("name"), entry.get("label"))] or [name]


def expand(study: Study) -> list[Cell]:
    """All cells of a study without duplicates, in the order of its axes."""
    cells: dict[str, Cell] = {}
    problems = [
        (entry, plugin, study.training_sets(entry), study.validation_set(entry).sized(plugin))
        for entry, plugin in _made(PluginKind.PROBLEM, study.problem)
    ]
    duals, primals = _made(PluginKind.DUAL, study.dual), _made(PluginKind.PRIMAL, study.primal)
    formulations = _made(PluginKind.FORMULATION, study.formulation)
    for (problem, plugin, sets, validation), table in product(problems, study.tolerances):
        # Nested enrichments of one table are grown once, to the smallest of their tolerances.
        nested = {entry.title: _nested_tolerances(entry, table) for entry in study.primal}
        for training, (entry, formulation) in product(sets, formulations):
            uses = entry.uses
            offline = _combinations(duals, primals, table, uses)
            for (dual, pod, cone, primal, tolerance), solved in product(offline, _solved(study, entry)):
                (assembly, bounds), correction, solver, accuracy = solved
                cell = Cell(
                    problem=plugin, dual=None if dual is None else dual[1],
                    primal=None if primal is None else primal[1], pod=pod, cone=cone, primal_tol=tolerance,
                    solver=solver, assembly=assembly, interpolation=None if assembly == "full" else study.interpolation,
                    warm_start=study.warm_start and entry.kind.takes_start, accuracy=accuracy, bounds=bounds,
                    correction=correction, training=training, validation=validation,
                    labels=(problem.title, _title(dual), _title(primal)), formulation=formulation,
                    nested_tolerances=() if primal is None else nested[primal[0].title], formulation_label=entry.title,
                )  # fmt: skip
                # Files are known by their names: two of one name would be one cell.
                if (same := cells.setdefault(cell.key, cell)) is not cell and same.code != cell.code:
                    what = f"two cells are called '{cell}', but have files of one name in different folders"
                    remedy = "rename one of them, or put the folders beside the study"
                    raise RequestError(f"study '{study.name}': {what}: {remedy}")
    if not cells:
        raise RequestError(f"study '{study.name}': the matrix is empty")
    return list(cells.values())


EntryT = TypeVar("EntryT", bound=Entry)
_Made: TypeAlias = tuple[EntryT, Plugin]


def _made(kind: PluginKind, entries: Sequence[EntryT]) -> list[_Made[EntryT]]:
    """The entries of an axis, each with its plugin, since titles may coincide."""
    return [(entry, entry.plugin(kind)) for entry in entries]


def _nested_tolerances(primal: Entry, table: ToleranceTable) -> tuple[float, ...]:
    plugin = primal.registered(PluginKind.PRIMAL)
    if plugin.conflict or not issubclass(plugin.load(), NestedStrategy):
        return ()
    return tuple(sorted({value for value in table.of_primal(primal) if value is not None}, reverse=True))


def _title(made: _Made[Entry] | None) -> str:
    return NO_SUCH_AXIS if made is None else made[0].title


_Offline: TypeAlias = tuple[_Made[Entry] | None, Stop | None, Stop | None, _Made[Entry] | None, float | None]


def _combinations(
    duals: Sequence[_Made[Entry]], primals: Sequence[_Made[Entry]], table: ToleranceTable, uses: Sequence[str]
) -> list[_Offline]:
    """Strategies and tolerances of the offline phase, with `None` on each axis that a formulation does not use."""
    pods = [Stop(tolerance=value) for value in table.pod or []] + [Stop(size=value) for value in table.N or []]
    axes: Mapping[str, Sequence[Any]] = {"pod": pods, "dual": duals, "primal": primals}
    chosen = product(*(entries if axis in uses else [None] for axis, entries in axes.items()))
    return [
        (dual, pod, cone, primal, tolerance)
        for pod, dual, primal in chosen
        for cone in ([None] if dual is None else table.of_dual(dual[0]))
        for tolerance in ([None] if primal is None else table.of_primal(primal[0]))
    ]


def _solved(study: Study, entry: FormulationEntry) -> list[tuple[tuple[str, bool], str, str | None, float | None]]:
    """Assembly and bounds, correction, solver and accuracy of queries, as far as a formulation has these axes."""
    kind, uses = entry.kind, entry.uses
    assemblies = study.assembly if "assembly" in uses else [kind.assembled]
    bounded = study.bounds if kind.has_certificate else [False]
    # Queries in full have no bounds at online cost, whatever is asked for.
    ways = dict.fromkeys((how, bounds and how == "reduced") for how in assemblies for bounds in bounded)
    corrections = study.correction if kind.has_program else [CorrectionMode.NONE.value]
    solvers = study.solver_names() if "solvers" in uses else [None]
    accuracies = study.accuracy if "accuracy" in uses else [None]
    return list(product(ways, corrections, solvers, accuracies))


def study_of_cell(cell: Cell, name: str, **settings: Any) -> Study:
    """The study of a single cell, with the same key."""
    # `settings` do not determine its numbers: `timing_rounds`, `timing_rounds_min`, `timing_budget`, `limits`.
    tolerances: dict[str, Any] = dict([_stop("pod", "N", cell.pod), _stop("dual", "R", cell.cone)])
    if cell.primal_tol is not None:
        tolerances["primal"] = {cell.labels[2]: [cell.primal_tol]}
    content: dict[str, Any] = {
        "name": name, "seed": cell.validation.seed, "training": _entry_of_set(cell.training) or OWN,
        "validation": _entry_of_set(cell.validation) or cell.validation.count, "warm_start": cell.warm_start,
        "formulation": [_plugin_entry(cell.formulation, cell.formulation_label)], "tolerances": [tolerances],
        "assembly": [cell.assembly], "bounds": [cell.bounds], "correction": [cell.correction],
    }  # fmt: skip
    axes = {"problem": cell.problem, "dual": cell.dual, "primal": cell.primal}
    for (axis, plugin), label in zip(axes.items(), cell.labels, strict=True):
        content |= {} if plugin is None else {axis: [_plugin_entry(plugin, label)]}
    content |= {} if cell.accuracy is None else {"accuracy": [cell.accuracy]}
    content |= {} if cell.solver is None else {"solvers": [cell.solver]}
    content |= {} if cell.interpolation is None else {"interpolation": cell.interpolation}
    return Study(**content, **settings)


def _plugin_entry(plugin: Plugin, label: str, **keys: Any) -> Any:
    given = plugin.registered
    name = given.given if isinstance(given, GivenPlugin) else plugin.name
    kinds: dict[str, type[Entry]] = {PluginKind.PROBLEM: ProblemEntry, PluginKind.FORMULATION: FormulationEntry}
    entry = (kinds | {PluginKind.SAMPLING: SamplingEntry}).get(plugin.kind, Entry)
    content = {"name": name, "label": label, "options": json.loads(plugin.options)} | keys
    return entry.model_validate(content).at(json.loads(plugin.places))


def _entry_of_set(parameters: ParameterSet) -> Any:
    """The entry of a sampling strategy; `None` for the problem's own set, of which all parameters have solutions."""
    skipping: dict[str, Any] = {"on_failure": "skip"} if parameters.skips else {}
    if parameters.sampling is None:
        return SamplingEntry(name=OWN, label=parameters.label, **skipping) if skipping else None
    return _plugin_entry(parameters.sampling, parameters.label, **skipping)


def _stop(tolerance: str, size: str, stop: Stop | None) -> tuple[str, list[float] | list[int]]:
    """Key and value in a grid of tolerances for a basis that stops at a tolerance or at a size."""
    # There is no basis, but the grid needs a value.
    if stop is None:
        return size, [1]
    return (tolerance, [stop.tolerance]) if stop.tolerance is not None else (size, [stop.size or 0])
