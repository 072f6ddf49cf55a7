"""Packages with a new plugin, studies and model packs, written from the templates."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template

from vibench.errors import RequestError, StorageError
from vibench.files import scratch
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import find
from vibench.provenance import distribution_version


def write_package(kind: PluginKind, name: str, parent: Path) -> Path:
    """Write a package with one plugin, completely or not at all; returns its folder `parent/vibench-NAME`."""
    # Raises a `RequestError` if the name is invalid or taken, or the folder exists, a `StorageError` if a write fails.
    check_name(kind, name)
    package, word = _package(name), kind.cli_name
    camel, snake = "".join(word.capitalize() for word in name.split("-")), name.replace("-", "_")
    words = {
        "name": name, "package": package, "module": kind.module, "kind": word, "title": str(kind),
        "cls": f"solve_{snake}" if kind is PluginKind.SOLVER else camel + word.capitalize(),
        "group": kind.entry_points, "test": snake, "version": distribution_version("vibench"),
    }  # fmt: skip
    sources = {
        "pyproject.toml": "pyproject.toml",
        "README.md": f"README-{word}.md",
        f"src/{package}/__init__.py": "__init__.py",
        f"src/{package}/{kind.module}.py": f"{word}.py",
        f"tests/test_{snake}.py": f"test_{word}.py",
    }
    return _write(parent / f"vibench-{name}", {path: _filled(source, words) for path, source in sources.items()})


def write_start(what: str, name: str, parent: Path) -> Path:
    """Write a study file `parent/NAME.toml`, or a model pack `parent/NAME`; returns its path. Errors as above."""
    _check_words(name, what, what)
    words = {"name": name, "file": f"{name}.toml"}
    if what == "study":
        if find(PluginKind.STUDY, name).entries:
            raise RequestError(f"there is a study '{name}' already; choose another name")
        return _write(parent / f"{name}.toml", {"": _filled("study.toml", words)})
    return _write(parent / name, {"pack.toml": _filled("pack.toml", words), "write.py": _filled("pack.py", words)})


def _write(target: Path, contents: Mapping[str, str]) -> Path:
    """Write a folder of texts, or one file where the only path is "", completely or not at all."""
    parent = target.parent
    if target.exists() or target.is_symlink():
        raise RequestError(f"'{target}' exists already; choose another name, or another folder with --out")
    if parent.exists() and not parent.is_dir():
        raise RequestError(f"--out '{parent}' is a file; expected a folder")
    try:
        parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"--out '{parent}' cannot be made: {error.strerror or error}") from None
    # A draft is renamed when it is complete, so that a full disk leaves nothing half written.
    try:
        with scratch(parent) as folder:
            draft = folder / target.name
            for path, text in contents.items():
                (draft / path).parent.mkdir(parents=True, exist_ok=True)
                (draft / path).write_text(text, encoding="utf-8")
            draft.rename(target)
    except OSError as error:
        raise StorageError(f"'{target}' cannot be written: {error.strerror or error}") from None
    return target


def check_name(kind: PluginKind, name: str) -> None:
    """Raise a `RequestError` for a name that no package can have, or that another plugin of the kind has."""
    _check_words(name, "plugin", kind.cli_name)
    # Packages of these names would take the place of those that come with vibench.
    if name in ("problems", "strategies"):
        raise RequestError(f"'{name}' cannot be the name of a plugin: vibench itself has a package of that name")
    if origin := find(kind, name).origin:
        raise RequestError(f"there is a {kind} '{name}' already, in {origin}; choose another name")


def _check_words(name: str, what: str, such_as: str) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name) or len(name) > 40:
        expected = "lower case letters and digits, in words joined by '-', a letter first, 40 characters at most"
        raise RequestError(f"'{name}' cannot be the name of a {what}: expected {expected}, such as 'my-{such_as}'")


def module_file(folder: Path, kind: PluginKind, name: str) -> Path:
    """The module of a package that contains the plugin."""
    return folder / "src" / _package(name) / f"{kind.module}.py"


def _package(name: str) -> str:
    return f"vibench_{name.replace('-', '_')}"


def _filled(template: str, words: Mapping[str, str]) -> str:
    text = (files("vibench.cli") / "templates" / f"{template}.template").read_text(encoding="utf-8")
    return Template(text).substitute(words)
