"""Options of plugins, which are the arguments of their constructors, and keys of TOML files, in words."""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from inspect import Parameter
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

from vibench.errors import RequestError, foreign, in_a_line, unknown_name
from vibench.text import shown


class Option(NamedTuple):
    """One option of a plugin, an argument of its constructor; `preset` is its default or `Parameter.empty`."""

    name: str
    annotation: Any
    preset: Any

    def __str__(self) -> str:
        return f"{self.name}: {self.expected}" + f" = {shown(self.preset)}" * (not self.required)

    @property
    def required(self) -> bool:
        return self.preset is Parameter.empty

    @property
    def expected(self) -> str:
        """The annotation in words: "float > 0.0", "'coarse', 'fine' or int ≥ 150"."""
        schema = TypeAdapter(self.annotation).json_schema()
        return " or ".join(_in_words(part) for part in schema.get("anyOf", [schema]))

    def read(self, value: Any) -> Any:
        """A value, converted to the type of the annotation; a `ValidationError` if it does not conform to it."""
        # In strict mode pydantic converts lists to tuples and texts to enumerations only from JSON.
        text, finite = json.dumps(value, default=str), ConfigDict(allow_inf_nan=False)
        return TypeAdapter(self.annotation, config=finite).validate_json(text, strict=True)

    @property
    def doubt(self) -> str:
        """A fault of its declaration: no annotation, or a default that does not conform to it; "" if none."""
        if self.annotation is Any:
            return "has no annotation that says what study files may set it to"
        try:
            expected = self.expected
            if not self.required:
                self.read(self.preset)
        except PydanticUserError as error:
            return f"has an annotation that no value of a study file conforms to: {in_a_line(error)}"
        except ValidationError:
            return f"has the default {shown(self.preset)}; its annotation expects {expected}"
        return ""


def inside(folder: Path, path: str) -> str:
    """The path of a file in the folder of a study, separated as in the syntax of rsync for `named_path`."""
    return f"{folder}/./{path}"


def named_path(path: Any) -> tuple[Any, Any]:
    """The name of a file or a folder in results, and its absolute path; twice the value if it is no path."""
    # The name is the path from the folder of the study, or from the current one. For other places it is the last part:
    # results neither depend on the place of a study nor reveal it.
    path = os.fspath(path) if isinstance(path, os.PathLike) else path
    if not isinstance(path, str) or not path:
        return path, path
    relative = os.path.normpath(path.rpartition("/./")[2])
    absolute = os.path.abspath(path)  # noqa: PTH100  links stay
    # A path out of the folder of the study would reveal where that is.
    elsewhere = Path(relative).parts[:1] in ((), ("/",), ("..",))
    return Path(absolute).name if elsewhere else relative, absolute


@cache
def options_of(plugin: Any) -> Mapping[str, Option]:
    """The options of a class, by name; raises a `RequestError` if an annotation cannot be evaluated."""
    constructor = inspect.getattr_static(plugin, "__init__")
    if constructor is object.__init__:
        return {}
    with foreign(f"the options of {plugin.__name__} have annotations that fail", RequestError):
        hints = get_type_hints(constructor, include_extras=True)
    # The first parameter is self.
    parameters = list(inspect.signature(constructor).parameters.values())[1:]
    named = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return {p.name: Option(p.name, hints.get(p.name, Any), p.default) for p in named}


def checked_arguments(plugin: type, what: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a class, called `what` in messages, converted to the types of its constructor's annotations."""
    options, checked = options_of(plugin), {}
    # Unknown names first: a misspelt option would otherwise be reported as missing.
    for name in given:
        if name not in options:
            raise unknown_name(f"option of {what}", name, options)
    for name, option in options.items():
        if name in given:
            try:
                checked[name] = option.read(given[name])
            except Exception:  # noqa: BLE001  pydantic's error, or what texts and numbers of strangers raise
                expected = option.expected
                raise RequestError(f"option '{name}' of {what} is {shown(given[name])}; expected {expected}") from None
        elif option.required:
            raise RequestError(f"{what} needs the option '{name}' ({option.expected})")
    return checked


def options_as_json(options: Mapping[str, Any]) -> str:
    return json.dumps(TypeAdapter(dict[str, Any]).dump_python(dict(options), mode="json"), sort_keys=True)


def _bounds(schema: Mapping[str, Any]) -> str:
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    values = ((sign, schema[key]) for key, sign in signs.items() if key in schema)
    return " and ".join(f"{sign} {f'{value:g}' if isinstance(value, float) else value}" for sign, value in values)


def _in_words(schema: Mapping[str, Any]) -> str:
    """The value of a Python argument that a schema expects."""
    if "enum" in schema:
        return ", ".join(repr(value) for value in schema["enum"])
    if "const" in schema:
        return repr(schema["const"])
    kind = str(schema.get("type", "any value"))
    python = {"integer": "int", "number": "float", "string": "str", "boolean": "bool", "array": "list"}.get(kind, kind)
    return f"{python} {_bounds(schema)}".strip()


class Key(NamedTuple):
    """A key of a TOML file, in words."""

    table: str  # name of the model of its table, "" for the file itself
    name: str
    expected: str
    required: bool
    default: str  # as JSON, "" where there is none
    meaning: str


def keys(schema: Mapping[str, Any], link: Callable[[str], str] = lambda _: "table") -> Iterator[Key]:
    """The keys of a file and of its tables; `link` makes the reference to the table of a model."""
    for table, model in {"": schema, **schema["$defs"]}.items():
        required = model.get("required", [])
        for name, field in model["properties"].items():
            words, preset = _expected(field, link), field.get("default")
            # A name may stand for an entry.
            if isinstance(preset, list) and preset and isinstance(preset[0], dict):
                preset = [entry["name"] for entry in preset]
            absent = preset in (None, "", {}) or (isinstance(preset, dict) and "query_seconds" in preset)
            default = "" if absent else json.dumps(preset)
            yield Key(table, name, words, name in required, default, field["description"])


def places(schema: Mapping[str, Any], model: str) -> list[str]:
    """The keys whose values are tables of a model."""
    reference, tables = json.dumps(f"#/$defs/{model}"), [schema, *schema["$defs"].values()]
    fields = [field for table in tables for field in table["properties"].items()]
    return list(dict.fromkeys(key for key, field in fields if reference in json.dumps(field)))


def _expected(schema: Mapping[str, Any], link: Callable[[str], str]) -> str:
    """The value of a TOML key that a schema expects."""
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(_expected(part, link) for part in schema[key] if part.get("type") != "null")
    if "$ref" in schema:
        return link(schema["$ref"].rsplit("/", 1)[-1])
    if "enum" in schema or "const" in schema:
        return " or ".join(f"`{json.dumps(value)}`" for value in schema.get("enum", [schema.get("const")]))
    if schema["type"] == "array":
        return f"list of {_expected(schema['items'], link)}"
    if schema["type"] == "object":
        values = schema["additionalProperties"]
        return "table" if values is True else f"table: name = {_expected(values, link)}"
    kinds = {"integer": "int", "number": "float", "string": "text", "boolean": "true or false"}
    return f"{kinds[schema['type']]} {_bounds(schema)}".strip()
