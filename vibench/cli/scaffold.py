"""Packages with a new plugin, written from the templates."""

from __future__ import annotations

import re
import tempfile
from importlib.resources import files
from pathlib import Path
from string import Template

from vibench.errors import RequestError, StorageError
from vibench.provenance import distribution_version
from vibench.study.kinds import SOLVER, PluginKind
from vibench.study.registry import find

NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
MAX_LENGTH = 40

RESERVED = ("problems", "strategies")
"""Names whose packages would have the names of those that come with vibench."""


def write_package(kind: PluginKind, name: str, parent: Path) -> Path:
    """Write a package with one plugin, completely or not at all; returns its folder `parent/vibench-NAME`.

    The parent folder is created if necessary.

    Raises a `RequestError` if the name is invalid or taken, or the folder exists, and a `StorageError` if a file cannot
    be written.
    """
    check_name(kind, name)
    target = parent / f"vibench-{name}"
    if target.exists() or target.is_symlink():
        raise RequestError(f"'{target}' exists already; choose another name, or another folder with --out")
    if parent.exists() and not parent.is_dir():
        raise RequestError(f"--out '{parent}' is a file; expected a folder")
    contents = _contents(kind, name)
    try:
        parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"--out '{parent}' cannot be made: {error.strerror or error}") from None
    try:
        with tempfile.TemporaryDirectory(dir=parent, prefix=".vibench-new-") as scratch:
            draft = Path(scratch) / target.name
            for path, text in contents.items():
                (draft / path).parent.mkdir(parents=True, exist_ok=True)
                (draft / path).write_text(text, encoding="utf-8")
            draft.rename(target)
    except OSError as error:
        raise StorageError(f"'{target}' cannot be written: {error.strerror or error}") from None
    return target


def check_name(kind: PluginKind, name: str) -> None:
    """Raise a `RequestError` for a name that no package can have, or that another plugin of the kind has."""
    if not NAME.fullmatch(name) or len(name) > MAX_LENGTH:
        raise RequestError(
            f"'{name}' cannot be the name of a plugin: expected lower case letters and digits, in words joined by '-', "
            f"a letter first, {MAX_LENGTH} characters at most, such as 'my-{kind.cli_name}'"
        )
    if name in RESERVED:
        raise RequestError(f"'{name}' cannot be the name of a plugin: vibench itself has a package of that name")
    if origin := find(kind, name).origin:
        raise RequestError(f"there is a {kind} '{name}' already, in {origin}; choose another name")


def module_file(folder: Path, kind: PluginKind, name: str) -> Path:
    """The module of a package that contains the plugin."""
    return folder / "src" / _package(name) / f"{kind.module}.py"


def _package(name: str) -> str:
    return f"vibench_{name.replace('-', '_')}"


def _contents(kind: PluginKind, name: str) -> dict[str, str]:
    """Texts of the files of a package by path."""
    package, word = _package(name), kind.cli_name
    camel, snake = "".join(word.capitalize() for word in name.split("-")), name.replace("-", "_")
    words = {
        "name": name,
        "package": package,
        "module": kind.module,
        "cls": f"solve_{snake}" if kind is SOLVER else camel + word.capitalize(),
        "kind": word,
        "title": str(kind),
        "group": kind.entry_points,
        "test": snake,
        "column": f"{snake}_speed_up",
        "version": distribution_version("vibench"),
    }
    sources = {
        "pyproject.toml": "pyproject.toml",
        "README.md": f"README-{word}.md",
        f"src/{package}/__init__.py": "__init__.py",
        f"src/{package}/{kind.module}.py": f"{word}.py",
        f"tests/test_{words['test']}.py": f"test_{word}.py",
    }
    folder = files("vibench.cli") / "templates"
    return {
        path: Template((folder / f"{source}.template").read_text(encoding="utf-8")).substitute(words)
        for path, source in sources.items()
    }
