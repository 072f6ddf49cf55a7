"""Tables of the documentation that are made from the code: fields of study files, columns of the results.

`python docs/reference.py` writes them into the pages, between `<!-- generated: NAME -->` and `<!-- end: NAME -->`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from typer.main import get_command

from vibench.cli.main import app
from vibench.packs.manifest import Manifest
from vibench.plugins.options import keys, places
from vibench.results.ranking import added_columns
from vibench.results.schema import STORED, Column, column_of, shown_columns
from vibench.study.spec import Study

UNITS: Mapping[str, str] = {
    "": "text, or a number that counts or names something",
    "1": "a pure number",
    "s": "CPU seconds of one process; wall seconds where the meaning says so",
    "ms": "milliseconds of the same kind",
    "MiB": "2²⁰ bytes",
    "µ": "the unit that the problem declares for the parameter",
    "u": "the unit of the displacement",
    "V": "the unit of the norm of V",
    "V²": "the square of that unit",
    "W": "the unit of the norm of W",
    "b/AW": "the unit of b(v, η) divided by those of the energy norm and of the norm of W",
    "A/V²": "the unit of the energy divided by the square of that of the norm of V",
    "A": "the unit of the energy norm, the norm of A(µ)",
    "A²": "the unit of the energy",
    "b": "the unit of b(v, η), which is that of the energy",
    "b/VW": "the unit of b(v, η) divided by those of the norms of V and W",
    "o": "the unit of the output, in the column unit",
}
"""The units and what they stand for; those of V, W and b depend on the problem."""


def study_fields() -> str:
    """A table of fields for a study file, and one for every table that stands in it."""
    return _models(Study.model_json_schema())


def pack_fields() -> str:
    """The same for the manifest of a model pack."""
    return _models(Manifest.model_json_schema())


def _models(schema: Mapping[str, Any]) -> str:
    rows: dict[str, list[tuple[str, ...]]] = {}
    for key in keys(schema, lambda model: f"[table](#{model.lower()})"):
        default = "**required**" if key.required else f"`{key.default}`" * bool(key.default)
        rows.setdefault(key.table, []).append((f"`{key.name}`", key.expected, default, key.meaning))
    parts = []
    for model, fields in rows.items():
        if model:
            title = ", ".join(f"`{key}`" for key in places(schema, model))
            parts.append(f"## {title} {{ #{model.lower()} }}\n\n{schema['$defs'][model]['description']}")
        parts.append(markdown(("key", "what is expected", "default", "meaning"), fields))
    return "\n\n".join(parts)


def units() -> str:
    """What the units stand for."""
    return markdown(("unit", "what it stands for"), [(unit or "–", text) for unit, text in UNITS.items()])


def columns(table: str) -> str:
    """The columns of a table of the results, with type, unit and meaning; what `cells` has, too, by name only."""
    described = dict(STORED[table])
    if table == "queries":
        described["mu_1, mu_2, …"] = column_of("queries", "mu_1")
    shared = [name for name, c in described.items() if table != "cells" and STORED["cells"].get(name) == c]
    rows = [
        (f"`{name}`", c.kind.split()[0].lower(), c.unit or "–", c.meaning)
        for name, c in described.items() if name not in shared
    ]  # fmt: skip
    head = f"As in [cells](#cells): {', '.join(f'`{name}`' for name in shared)}.\n\n" if shared else ""
    return head + markdown(("column", "type", "unit", "meaning"), rows)


def summary() -> str:
    """The columns of the summary."""
    return _for_reading(STORED["cells"])


def benefits() -> str:
    """The columns of the break-evens for reading."""
    return _for_reading(STORED["thresholds"])


def best() -> str:
    """What the table of the cheapest models has beside columns of the cells."""
    return _for_reading(added_columns())


def _for_reading(table: Mapping[str, Column]) -> str:
    rows = [
        (c.heading, "ms" if c.heading.endswith("[ms]") else c.unit or "–", c.meaning)
        for c in shown_columns(table).values()
    ]
    return markdown(("column", "unit", "meaning"), rows)


def commands() -> str:
    """What each command does, with its arguments and options."""
    group: Any = get_command(app)
    parts = []
    for name in sorted(group.commands):
        command = group.get_command(None, name)
        if not command.hidden:
            names = [p.opts if p.opts[0].startswith("-") else [p.metavar or p.name.upper()] for p in command.params]
            rows = [(f"`{', '.join(of)}`", p.help or "") for of, p in zip(names, command.params, strict=True)]
            parts.append(f"## {name}\n\n{command.help}\n\n{markdown(('option', 'meaning'), rows)}")
    return "\n\n".join(parts)


def markdown(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    cells = [list(head), *map(list, rows)]
    cells.insert(1, ["---"] * len(cells[0]))
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in row) + " |" for row in cells)


GENERATED = {
    "commands": commands, "study": study_fields,
    "pack": pack_fields, "units": units, "summary": summary, "best": best, "benefits": benefits,
} | {table: lambda table=table: columns(table) for table in STORED}  # fmt: skip
"""What may stand in a page, by name."""

PLACE = re.compile(r"<!-- generated: ([\w-]+) -->\n.*?<!-- end: \1 -->", re.DOTALL)


def filled(page: str) -> str:
    """The text of a page with its generated parts as they are made today."""

    def made(place: re.Match[str]) -> str:
        return f"<!-- generated: {place[1]} -->\n\n{GENERATED[place[1]]()}\n\n<!-- end: {place[1]} -->"

    return PLACE.sub(made, page)


def main() -> None:
    """Write the generated parts of all pages."""
    for path in sorted(Path(__file__).parent.rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        if (made := filled(text)) != text:
            path.write_text(made, encoding="utf-8")


if __name__ == "__main__":
    main()
