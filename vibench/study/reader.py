"""Reading study files: where they are, what the command line replaces, and the line that says what is wrong."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from vibench.errors import RequestError, unknown_name
from vibench.qp.solve import check_solver_name
from vibench.study import registry
from vibench.study.spec import Entry, Limits, Study, ToleranceTable


def find_study(request: str) -> Path:
    """File behind what the user called a study: a path, or the name of a registered one."""
    path = Path(request)
    if path.suffix != ".toml" and not _exists(path, Path.is_file):
        if _exists(path, Path.exists) and request not in registry.names("study"):
            raise RequestError(f"study '{request}' is not a file")
        return registry.study_path(request)
    if not path.is_file():
        raise RequestError(f"study file '{request}' {'is not a file' if path.exists() else 'does not exist'}")
    return path


def _exists(path: Path, kind: Callable[[Path], bool]) -> bool:
    try:
        return kind(path)
    except OSError:  # a name that no file can have
        return False


def load_study(request: str, overrides: Mapping[str, Sequence[Any]] | None = None) -> Study:
    """Read and check a study.

    Parameters
    ----------
    request
        Path of a TOML file, or the name of a registered study.
    overrides
        Axes to replace everywhere, keys "problem", "dual", "primal", "solvers", "pod", "dual_tol",
        "primal_tol"; empty sequences replace nothing.

    Raises
    ------
    RequestError
        With file, key, what was found and what is expected.
    """
    path = find_study(request)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"{path}: cannot be read as text: {error}") from None
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # beside syntax errors: numbers too long, nesting too deep
        raise RequestError(f"{path}: not valid TOML: {error}") from None
    given = {key: list(values) for key, values in (overrides or {}).items() if values}
    source = str(path) if path == Path(request) else f"study '{request}'"
    source += " with the options of the command line" if given else ""
    study = _validate(_replace_axes(content, given), source)
    _check_names(study, source)
    return study


def _replace_axes(content: dict[str, Any], given: Mapping[str, list[Any]]) -> dict[str, Any]:
    """The content of a study file with whole axes replaced, as the options of the command line ask."""
    content = dict(content)
    for axis in ("problem", "dual", "primal", "solvers"):
        if axis in given:
            content[axis] = [entry for name in given[axis] for entry in _entries_in(content.get(axis), name)]
    tables = content.get("tolerances")
    if isinstance(tables, list) and all(isinstance(table, dict) for table in tables):
        primal = content.get("primal")
        names = [_title(entry) for entry in primal if _takes_tolerance(entry)] if isinstance(primal, list) else []
        content["tolerances"] = [_replace_tolerances(dict(table), given, names) for table in tables]
    return content


def _replace_tolerances(table: dict[str, Any], given: Mapping[str, list[Any]], primal: list[str]) -> dict[str, Any]:
    for key, tolerance, size in (("pod", "pod", "N"), ("dual_tol", "dual", "R")):
        if key in given:
            table.pop(size, None)
            table[tolerance] = given[key]
    if "primal_tol" in given:
        table["primal"] = dict.fromkeys(primal, given["primal_tol"])
    return table


def _title(entry: Any) -> str:
    return str(entry.get("label", entry.get("name")) if isinstance(entry, dict) else entry)


def _takes_tolerance(entry: Any) -> bool:
    """Whether an entry of the primal axis names a strategy with a tolerance; nothing has been checked yet."""
    name = str(entry.get("name") if isinstance(entry, dict) else entry)
    known = name in registry.names("primal strategy")
    return known and bool(registry.load("primal strategy", name).takes_tolerance)


def _entries_in(axis: Any, name: str) -> list[Any]:
    """The axis entries with this name or label, their options included; the bare name where the file has none."""
    tables = [entry for entry in axis if isinstance(entry, dict)] if isinstance(axis, list) else []
    return [entry for entry in tables if name in (entry.get("name"), entry.get("label"))] or [name]


def _validate(content: dict[str, Any], source: str) -> Study:
    try:
        return Study.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        line = " ".join(f"{source}: {_complaint(first)}".split())
        raise RequestError(line) from None


def _complaint(error: Any) -> str:
    """What is wrong at which key of a study file, and what was expected there."""
    where = [part for part in error["loc"] if not str(part).startswith("<")]
    if error["type"] == "extra_forbidden":
        return _unknown_key(where)
    message = {"model_type": "expected a table", "missing": "required, but not given"}.get(error["type"], error["msg"])
    if error["type"] == "model_type" and where[0] in ("problem", "dual", "primal"):
        message = "expected a name, or a table with one"
    found = f" (found {error['input']!r:.80})" if isinstance(error["input"], str | int | float) else ""
    place = ".".join(str(part) for part in where)
    return f"{place + ': ' if place else ''}{message.removeprefix('Value error, ')}{found}"


MODELS: Mapping[str, type[BaseModel]] = {"tolerances": ToleranceTable, "limits": Limits}
"""What stands under a key of a study file; entries of an axis under the others."""


def _unknown_key(where: list[Any]) -> str:
    """The line for a key that is not known where it stands, the nearest of those that are suggested."""
    *path, key = where
    model: type[BaseModel] = Study if not path else MODELS.get(path[0], Entry)
    place = ".".join(str(part) for part in path)
    return f"{place + ': ' if place else ''}{unknown_name('key', ''.join(str(key).split()), model.model_fields)}"


def _check_names(study: Study, source: str) -> None:
    """Refuse names no plugin has, options it does not take and tolerances for nobody, or lacking for somebody."""
    try:
        for kind, axis in (
            ("problem", study.problem),
            ("dual strategy", study.dual),
            ("primal strategy", study.primal),
        ):
            for entry in axis:
                registry.check_options(kind, entry.name, entry.options)
        for solver in study.solver_names():
            check_solver_name(solver, registry.names("QP solver"))
            registry.qp_solver(solver)
        for table in study.tolerances:
            _check_tolerances(study, table)
    except RequestError as error:
        raise RequestError(f"{source}: {error}") from None


def _check_tolerances(study: Study, table: ToleranceTable) -> None:
    for kind, axis, tolerances in (
        ("dual strategy of this study", study.dual, table.dual),
        ("dual strategy of this study", study.dual, table.R),
        ("primal strategy of this study", study.primal, table.primal),
    ):
        known = {name for entry in axis for name in (entry.name, entry.title)}
        for name in tolerances if isinstance(tolerances, dict) else ():
            if name not in known and not _registered_elsewhere(kind, name):
                raise unknown_name(kind, name, known)
    for entry in study.dual:
        table.of_dual(entry)
    for entry in study.primal:
        if table.of_primal(entry) == [None] and not table.primal.keys().isdisjoint({entry.name, entry.title}):
            raise RequestError(f"tolerances.primal gives something for '{entry.title}', which takes no tolerance")


def _registered_elsewhere(kind: str, name: str) -> bool:
    """Whether a tolerance names a plugin that exists, though an option of the command line took it off the axis."""
    return name in registry.names(kind.removesuffix(" of this study"))
