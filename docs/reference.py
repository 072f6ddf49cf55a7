"""Tables of the documentation that are made from the code: fields of study files, columns of the results."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from vibench.packs.manifest import Manifest
from vibench.results.columns import CELLS, PARAMETER, STORED, THRESHOLDS, UNITS, Column, shown_columns
from vibench.study.spec import Study

KINDS = {"integer": "int", "number": "float", "string": "text", "boolean": "true or false"}
SIGNS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


def study_fields() -> str:
    """A table of fields for a study file, and one for every table that stands in it."""
    return _models(Study.model_json_schema())


def pack_fields() -> str:
    """The same for the manifest of a model pack."""
    return _models(Manifest.model_json_schema())


def _models(schema: Mapping[str, Any]) -> str:
    parts = [_fields(schema)]
    for name, part in schema["$defs"].items():
        title = _title(name, [schema, *schema["$defs"].values()])
        parts.append(f"## {title} {{ #{name.lower()} }}\n\n{part['description']}\n\n{_fields(part)}")
    return "\n\n".join(parts)


def _title(model: str, places: Iterable[Mapping[str, Any]]) -> str:
    reference = json.dumps(f"#/$defs/{model}")
    keys = [key for place in places for key, field in place["properties"].items() if reference in json.dumps(field)]
    return ", ".join(f"`{key}`" for key in dict.fromkeys(keys))


def _fields(model: Mapping[str, Any]) -> str:
    required = model.get("required", [])
    rows = [
        (
            f"`{key}`",
            _words(field),
            "**required**" if key in required else _default(field.get("default")),
            field["description"],
        )
        for key, field in model["properties"].items()
    ]
    return markdown(("key", "what is expected", "default", "meaning"), rows)


def _default(value: Any) -> str:
    if value in (None, "", {}) or (isinstance(value, dict) and "query_seconds" in value):
        return ""
    if isinstance(value, list) and value and isinstance(value[0], dict):  # entries, which may be given by their names
        value = [entry["name"] for entry in value]
    return f"`{json.dumps(value)}`"


def _words(schema: Mapping[str, Any]) -> str:
    """What a schema expects, in words."""
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(_words(part) for part in schema[key] if part.get("type") != "null")
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[-1]
        return f"[table](#{name.lower()})"
    if "enum" in schema or "const" in schema:
        return " or ".join(f"`{json.dumps(value)}`" for value in schema.get("enum", [schema.get("const")]))
    if schema["type"] == "array":
        return f"list of {_words(schema['items'])}"
    if schema["type"] == "object":
        values = schema["additionalProperties"]
        return "table" if values is True else f"table: name = {_words(values)}"
    bounds = [f"{sign} {_number(schema[key])}" for key, sign in SIGNS.items() if key in schema]
    return " ".join([KINDS[schema["type"]], " and ".join(bounds)]).strip()


def _number(value: float) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def units() -> str:
    """What the units stand for."""
    return markdown(("unit", "what it stands for"), [(unit or "–", text) for unit, text in UNITS.items()])


def columns(table: str) -> str:
    """The columns of a table of the results, with SQLite's type, unit and meaning."""
    described = dict(STORED[table])
    if table == "queries":
        described["mu_1, mu_2, …"] = PARAMETER
    rows = [(f"`{name}`", c.kind.split()[0].lower(), c.unit or "–", c.meaning) for name, c in described.items()]
    return markdown(("column", "type", "unit", "meaning"), rows)


def summary() -> str:
    """The columns of the summary."""
    return _for_reading(CELLS)


def benefits() -> str:
    """The columns of the break-evens for reading."""
    return _for_reading(THRESHOLDS)


def _for_reading(table: Mapping[str, Column]) -> str:
    rows = [
        (c.heading, "ms" if c.heading.endswith("[ms]") else c.unit or "–", c.meaning)
        for c in shown_columns(table).values()
    ]
    return markdown(("column", "unit", "meaning"), rows)


def markdown(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    cells = [list(head), *map(list, rows)]
    cells.insert(1, ["---"] * len(cells[0]))
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in row) + " |" for row in cells)


GENERATED = {"study": study_fields, "pack": pack_fields, "units": units, "summary": summary, "benefits": benefits} | {
    table: lambda table=table: columns(table) for table in STORED
}
"""What may stand in a page as `<!-- generated: NAME -->`."""
