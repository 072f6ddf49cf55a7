"""Reading study files: their location, the axes that the command line replaces, and error messages."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vibench.errors import RequestError
from vibench.study.kinds import PRIMAL, SAMPLING, STUDY
from vibench.study.registry import find, registered
from vibench.study.spec import Study


def find_study(request: str) -> Path:
    """File of a study, from its path or the name under which it is registered.

    Raises a `RequestError` if there is no such file or registered study.
    """
    path = Path(request)
    # os.path, since methods of Path raise OSError for names too long for a file.
    is_file, exists = os.path.isfile(path), os.path.exists(path)  # noqa: PTH110, PTH113
    if path.suffix != ".toml" and not is_file:
        if exists and request not in registered(STUDY):
            raise RequestError(f"study '{request}' is not a file")
        return Path(find(STUDY, request).load())
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
    _anchor(content, path.absolute().parent)
    try:
        return Study.model_validate(content)
    except RequestError as error:
        raise RequestError(f"{source}: {error}") from None


def _anchor(content: dict[str, Any], folder: Path) -> None:
    """Take the paths among the options of sampling strategies, in unchecked content, relative to a folder."""
    problems = content.get("problem")
    tables = [
        content,
        *(entry for entry in (problems if isinstance(problems, list) else []) if isinstance(entry, dict)),
    ]
    for table in tables:
        for key in ("training", "validation"):
            entries = table.get(key)
            for entry in entries if isinstance(entries, list) else [entries]:
                if isinstance(entry, dict):
                    _anchor_options(entry, folder)


def _anchor_options(entry: dict[str, Any], folder: Path) -> None:
    given = entry.get("options")
    for options in (entry, given if isinstance(given, dict) else {}):
        plugin = find(SAMPLING, str(entry.get("name")))
        options_of = plugin.options if plugin.entries and not plugin.conflict else {}
        for name in (name for name, option in options_of.items() if option.annotation is Path):
            if isinstance(options.get(name), str):
                options[name] = str(folder / options[name])


def _replace_axes(content: dict[str, Any], given: Mapping[str, list[Any]]) -> dict[str, Any]:
    """The content of a study file, not checked yet, with the axes and tolerances given on the command line."""
    for axis in ("problem", "dual", "primal", "solvers"):
        if axis in given:
            content[axis] = [entry for name in given[axis] for entry in _entries_in(content.get(axis), name)]
    tables = content.get("tolerances")
    if isinstance(tables, list) and all(isinstance(table, dict) for table in tables):
        primal = content.get("primal")
        names = (
            [_title_of_entry(entry) for entry in primal if _takes_tolerance(entry)] if isinstance(primal, list) else []
        )
        for table in tables:
            for key, tolerance, size in (("pod", "pod", "N"), ("dual_tol", "dual", "R")):
                if key in given:
                    table.pop(size, None)
                    table[tolerance] = given[key]
            if "primal_tol" in given:
                table["primal"] = dict.fromkeys(names, given["primal_tol"])
    return content


def _title_of_entry(entry: Any) -> str:
    return str(entry.get("label", entry.get("name")) if isinstance(entry, dict) else entry)


def _takes_tolerance(entry: Any) -> bool:
    """Whether an unchecked entry of the primal axis names a strategy that takes a tolerance."""
    plugin = find(PRIMAL, str(entry.get("name") if isinstance(entry, dict) else entry))
    return bool(plugin.entries and not plugin.conflict and plugin.load().takes_tolerance)


def _entries_in(axis: Any, name: str) -> list[Any]:
    """The entries of an unchecked axis that have this name or label; the name itself if there are none."""
    tables = [entry for entry in axis if isinstance(entry, dict)] if isinstance(axis, list) else []
    return [entry for entry in tables if name in (entry.get("name"), entry.get("label"))] or [name]
