"""The keys of a TOML file in words, from its schema: what is expected, what stands for a missing one, what it means."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

KINDS = {"integer": "int", "number": "float", "string": "text", "boolean": "true or false"}
SIGNS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


class Key(NamedTuple):
    """A key of a file."""

    table: str
    """Name of the model of the table it stands in; "" for the file itself."""
    name: str
    expected: str
    """What its value may be."""
    required: bool
    default: str
    """What stands for a missing one, as JSON; "" if that is nothing."""
    meaning: str


def keys(schema: Mapping[str, Any], link: Callable[[str], str] = lambda _: "table") -> Iterator[Key]:
    """The keys of a file and of the tables in it; `link` writes what refers to the table of a model."""
    for table, model in {"": schema, **schema["$defs"]}.items():
        required = model.get("required", [])
        for name, field in model["properties"].items():
            words = _words(field, link)
            yield Key(table, name, words, name in required, _default(field.get("default")), field["description"])


def places(schema: Mapping[str, Any], model: str) -> list[str]:
    """The keys that hold a table of a model."""
    reference = json.dumps(f"#/$defs/{model}")
    tables = [schema, *schema["$defs"].values()]
    held = [key for table in tables for key, field in table["properties"].items() if reference in json.dumps(field)]
    return list(dict.fromkeys(held))


def _default(value: Any) -> str:
    if value in (None, "", {}) or (isinstance(value, dict) and "query_seconds" in value):
        return ""
    if isinstance(value, list) and value and isinstance(value[0], dict):  # entries, which may be given by their names
        value = [entry["name"] for entry in value]
    return json.dumps(value)


def _words(schema: Mapping[str, Any], link: Callable[[str], str]) -> str:
    """What a schema expects, in words."""
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(_words(part, link) for part in schema[key] if part.get("type") != "null")
    if "$ref" in schema:
        return link(schema["$ref"].rsplit("/", 1)[-1])
    if "enum" in schema or "const" in schema:
        return " or ".join(f"`{json.dumps(value)}`" for value in schema.get("enum", [schema.get("const")]))
    if schema["type"] == "array":
        return f"list of {_words(schema['items'], link)}"
    if schema["type"] == "object":
        values = schema["additionalProperties"]
        return "table" if values is True else f"table: name = {_words(values, link)}"
    bounds = [f"{sign} {_number(schema[key])}" for key, sign in SIGNS.items() if key in schema]
    return " ".join([KINDS[schema["type"]], " and ".join(bounds)]).strip()


def _number(value: float) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
