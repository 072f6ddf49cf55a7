"""Writing a site into a new folder, or into one that was written before: files of others are never touched."""

from __future__ import annotations

import hashlib
import json
import sqlite3
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from vibench.errors import RequestError
from vibench.files import PART, TEMPORARY
from vibench.text import parsed_json

CATALOGUE = "vibench-site.json"
"""File of a site that lists its files with their digests: what a later `vibench publish` may replace."""

FIRST_PAGE = "index.html"


def check(site: Path) -> None:
    """Refuse a folder that a site cannot be written into.

    Raises a `RequestError` if it is a file, or holds files and is no site, or its list of files cannot be read.
    """
    if site.is_dir():
        if any(site.iterdir()):
            _written(site)
    elif site.exists() or site.is_symlink():
        raise RequestError(f"'{site}' is not a folder; choose another for the site")


def write(site: Path, fill: Callable[[Path], None]) -> None:
    """Write a site: a new one appears whole, the files of an earlier one are replaced one by one, its first page last.

    The folder is new, empty, or written by this function; `fill` writes the files into one that it is given.

    Raises a `RequestError` if the folder holds files of others under names of the site, or cannot be written; nothing
    is changed then.
    """
    check(site)
    try:
        site.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=site.parent, prefix=TEMPORARY, suffix=PART) as scratch:
            new = Path(scratch) / "site"
            new.mkdir()
            fill(new)
            files = _digests(new)
            _write_catalogue(new, {name: [digest] for name, digest in files.items()})
            if site.is_dir() and any(site.iterdir()):
                _replace_files(site, new, files)
            else:
                new.replace(site)
    except (OSError, sqlite3.Error) as error:
        why = getattr(error, "strerror", None) or error
        raise RequestError(f"'{site}' cannot be written: {why}") from None


def _replace_files(site: Path, new: Path, files: Mapping[str, str]) -> None:
    """Replace the files of a site, remove those it has no more, and keep all others."""
    before = _written(site)
    for name in (*files, *before):
        _refuse_links(site, name)
    for name in files:
        if (site / name).exists() and _digest(site / name) not in (*before.get(name, ()), files[name]):
            raise RequestError(f"'{site / name}' was not written by vibench, or changed since; move it elsewhere")
    # Whatever interrupts the next steps: all files that they have written by then are in the catalogue.
    both = {name: [*before.get(name, ()), *([files[name]] if name in files else [])] for name in {**before, **files}}
    _write_catalogue(new, both)
    (new / CATALOGUE).replace(site / CATALOGUE)
    for name in sorted(files, key=lambda name: name == FIRST_PAGE):
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (new / name).replace(site / name)
    for name, digests in before.items():
        if name not in files and (site / name).is_file() and _digest(site / name) in digests:
            (site / name).unlink()
            _remove_empty(site, (site / name).parent)
    _write_catalogue(new, {name: [digest] for name, digest in files.items()})
    (new / CATALOGUE).replace(site / CATALOGUE)


def _refuse_links(site: Path, name: str) -> None:
    """Refuse names that lead out of the site, by themselves or through links."""
    parts = Path(name).parts
    if not parts or ".." in parts or Path(name).is_absolute():
        raise RequestError(f"'{site / CATALOGUE}' lists '{name}', which is not in the site; move the file elsewhere")
    for depth in range(1, len(parts) + 1):
        if site.joinpath(*parts[:depth]).is_symlink():
            raise RequestError(f"'{site.joinpath(*parts[:depth])}' is a symbolic link; move it elsewhere")


def _remove_empty(site: Path, folder: Path) -> None:
    while folder != site and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent


def _digests(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): _digest(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def _write_catalogue(folder: Path, files: Mapping[str, Sequence[str]]) -> None:
    content = {"format": "vibench-site 1", "files": dict(sorted(files.items()))}
    (folder / CATALOGUE).write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _written(site: Path) -> dict[str, list[str]]:
    """Files that vibench has written into a site, with the digests of what it wrote."""
    catalogue = site / CATALOGUE
    if not catalogue.is_file():
        raise RequestError(f"'{site}' is not empty and was not written by `vibench publish`; choose another folder")
    try:
        files = parsed_json(catalogue.read_text(encoding="utf-8"))["files"]
        return {str(name): [str(digest) for digest in digests] for name, digests in dict(files).items()}
    except (OSError, ValueError, KeyError, TypeError):
        raise RequestError(f"'{catalogue}' cannot be read as the list of the files of a site") from None
