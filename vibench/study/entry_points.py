"""Entry points of all installed distributions, of which one may have a file that cannot be read."""

from __future__ import annotations

import importlib.metadata
from functools import cache
from importlib.metadata import Distribution, EntryPoint

from vibench.errors import in_a_line


def entry_points(*, group: str) -> list[EntryPoint]:
    """The entry points of a group, without those of `unreadable` distributions."""
    return [entry for entry in _readable()[0] if entry.group == group]


def unreadable() -> dict[str, str]:
    """Distributions whose entry points cannot be read, each with the reason in a line."""
    return _readable()[1]


@cache
def _readable() -> tuple[tuple[EntryPoint, ...], dict[str, str]]:
    found: dict[str, tuple[EntryPoint, ...]] = {}
    broken: dict[str, str] = {}
    for distribution in importlib.metadata.distributions():
        name = _name(distribution)
        if name in found or name in broken:  # the first on the path is the one that is imported
            continue
        try:
            found[name] = tuple(distribution.entry_points)
        except Exception as error:  # noqa: BLE001  importlib.metadata raises whatever its parser does
            broken[name] = f"its entry_points.txt cannot be read: {in_a_line(error)}"
    return tuple(entry for entries in found.values() for entry in entries), broken


def _name(distribution: Distribution) -> str:
    try:
        return str(distribution.metadata["Name"])
    except Exception:  # noqa: BLE001  as above
        return str(distribution)
