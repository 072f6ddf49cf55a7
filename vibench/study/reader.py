"""Reading study files: their location, the axes that the command line replaces, and error messages."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from vibench.errors import NumericalError, RequestError, unknown_name
from vibench.interfaces.validation import validation_parameters
from vibench.qp.settings import SETTINGS
from vibench.study import registry
from vibench.study.spec import Entry, Limits, Study, ToleranceTable


def find_study(request: str) -> Path:
    """File of a study, from its path or the name under which it is registered.

    Raises
    ------
    RequestError
        If there is no such file or registered study.
    """
    path = Path(request)
    # os.path, since methods of Path raise OSError for names too long for a file.
    is_file, exists = os.path.isfile(path), os.path.exists(path)  # noqa: PTH110, PTH113
    if path.suffix != ".toml" and not is_file:
        if exists and request not in registry.names("study"):
            raise RequestError(f"study '{request}' is not a file")
        return registry.study_path(request)
    if not is_file:
        raise RequestError(f"study file '{request}' {'is not a file' if exists else 'does not exist'}")
    return path


def load_study(request: str, overrides: Mapping[str, Sequence[Any]] | None = None) -> Study:
    """Read and check a study.

    Parameters
    ----------
    request
        Path of a TOML file, or the name of a registered study.
    overrides
        Values that replace those of the file: of the axes "problem", "dual", "primal" and "solvers", and of the
        tolerances "pod", "dual_tol" and "primal_tol" in every table. Empty sequences replace nothing.

    Raises
    ------
    RequestError
        If the file cannot be read or is not a valid study; the message names the file, the key and the expected value.
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
    content = _replace_axes(content, given)
    try:
        study = Study.model_validate(content)
        _check_names(study)
    except ValidationError as error:
        line = f"{source}: {_message(error.errors(include_url=False)[0])}"
        raise RequestError(" ".join(line.split())) from None
    except RequestError as error:
        raise RequestError(f"{source}: {error}") from None
    return study


def _replace_axes(content: dict[str, Any], given: Mapping[str, list[Any]]) -> dict[str, Any]:
    """The content of a study file, not checked yet, with the axes and tolerances given on the command line."""
    for axis in ("problem", "dual", "primal", "solvers"):
        if axis in given:
            content[axis] = [entry for name in given[axis] for entry in _entries_in(content.get(axis), name)]
    tables = content.get("tolerances")
    if isinstance(tables, list) and all(isinstance(table, dict) for table in tables):
        primal = content.get("primal")
        names = [_title(entry) for entry in primal if _takes_tolerance(entry)] if isinstance(primal, list) else []
        for table in tables:
            for key, tolerance, size in (("pod", "pod", "N"), ("dual_tol", "dual", "R")):
                if key in given:
                    table.pop(size, None)
                    table[tolerance] = given[key]
            if "primal_tol" in given:
                table["primal"] = dict.fromkeys(names, given["primal_tol"])
    return content


def _title(entry: Any) -> str:
    return str(entry.get("label", entry.get("name")) if isinstance(entry, dict) else entry)


def _takes_tolerance(entry: Any) -> bool:
    """Whether an unchecked entry of the primal axis names a strategy that takes a tolerance."""
    name = str(entry.get("name") if isinstance(entry, dict) else entry)
    known = name in registry.names("primal strategy")
    return known and bool(registry.load("primal strategy", name).takes_tolerance)


def _entries_in(axis: Any, name: str) -> list[Any]:
    """The entries of an unchecked axis that have this name or label; the name itself if there are none."""
    tables = [entry for entry in axis if isinstance(entry, dict)] if isinstance(axis, list) else []
    return [entry for entry in tables if name in (entry.get("name"), entry.get("label"))] or [name]


MODELS: Mapping[str, type[BaseModel]] = {"tolerances": ToleranceTable, "limits": Limits}
"""Models of the tables in a study file, by their key; those under other keys are entries of an axis."""


def _message(error: Any) -> str:
    """The key of a study file that is wrong, the expected value and the one found."""
    # The last part of an unexpected key's path is the key itself, whatever its first character.
    outer = error["loc"][:-1] if error["type"] == "extra_forbidden" else error["loc"]
    where = [part for part in outer if not str(part).startswith("<")]
    message, found = error["msg"].removeprefix("Value error, "), ""
    if isinstance(error["input"], str | int | float):
        found = f" (found {error['input']!r:.80})"
    match error["type"]:
        case "extra_forbidden":
            model: type[BaseModel] = MODELS.get(where[0], Entry) if where else Study
            message, found = str(unknown_name("key", "".join(str(error["loc"][-1]).split()), model.model_fields)), ""
        case "missing":
            message = "required, but not given"
        case "model_type":
            of_plugin = where[0] in ("problem", "dual", "primal")
            message = "expected a name, or a table with one" if of_plugin else "expected a table"
    place = ".".join(str(part) for part in where)
    return f"{place + ': ' if place else ''}{message}{found}"


def _check_names(study: Study) -> None:
    """Check names and options of plugins, and that exactly the strategies which take a tolerance have one."""
    axes = {"problem": study.problem, "dual strategy": study.dual, "primal strategy": study.primal}
    for kind, axis in axes.items():
        for entry in axis:
            registry.check_options(kind, entry.name, entry.options)
    for entry in study.problem:
        _check_data(study, entry)
    known = {*SETTINGS, *registry.names("QP solver")}
    for solver in study.solver_names():
        if solver not in known:  # installed or not
            raise unknown_name("QP solver", solver, known)
        registry.qp_solver(solver)
    for table in study.tolerances:
        _check_tolerances(study, table)


def _check_data(study: Study, entry: Entry) -> None:
    """Build a problem that reads files: what is wrong with them is found before a run, and not in all of its cells."""
    if not registry.data_digest("problem", entry.name, entry.options):
        return
    problem = registry.create("problem", entry.name, entry.options)
    try:
        validation_parameters(problem, study.validation, study.seed)
    except NumericalError as error:
        raise RequestError(f"problem '{entry.title}': {error}") from None


def _check_tolerances(study: Study, table: ToleranceTable) -> None:
    for kind, axis, tolerances in (
        ("dual strategy", study.dual, table.dual),
        ("dual strategy", study.dual, table.R),
        ("primal strategy", study.primal, table.primal),
    ):
        # A tolerance may name a plugin that an option of the command line removed from the axis.
        known = {name for entry in axis for name in (entry.name, entry.title)}
        for name in tolerances if isinstance(tolerances, dict) else ():
            if name not in known and name not in registry.names(kind):
                raise unknown_name(f"{kind} of this study", name, known)
    for entry in study.dual:
        table.of_dual(entry)
    for entry in study.primal:
        if table.of_primal(entry) == [None] and not table.primal.keys().isdisjoint({entry.name, entry.title}):
            raise RequestError(f"tolerances.primal gives something for '{entry.title}', which takes no tolerance")
