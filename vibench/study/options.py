"""Options of plugins: the arguments of their constructors, checked against the annotations."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

from vibench.errors import RequestError, in_a_line, unknown_name

FINITE = ConfigDict(allow_inf_nan=False)
"""Options of plugins are finite."""


@dataclass(frozen=True)
class Option:
    """One option of a plugin: name, expected values in words, default as text ("" if it is required)."""

    name: str
    expected: str
    default: str


def options_of(plugin: type) -> list[Option]:
    """The options of a class."""
    return [
        Option(option, _expected(annotation), "" if default is inspect.Parameter.empty else repr(default))
        for option, (default, annotation) in _parameters(plugin).items()
    ]


def checked_arguments(plugin: type, what: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a class, converted to the types in its constructor's annotations; `what` is its name in messages.

    Raises
    ------
    RequestError
        If an option is unknown, missing, or not of its type.
    """
    parameters = _parameters(plugin)
    for option in given:
        if option not in parameters:
            raise unknown_name(f"option of {what}", option, parameters)
    checked = {}
    for option, (default, annotation) in parameters.items():
        if option in given:
            # In strict mode pydantic converts lists to tuples and texts to enumerations only from JSON.
            text = json.dumps(given[option], default=str)
            try:
                checked[option] = TypeAdapter(annotation, config=FINITE).validate_json(text, strict=True)
            except ValidationError:
                expected = _expected(annotation)
                raise RequestError(f"option '{option}' of {what} is {given[option]!r}; expected {expected}") from None
        elif default is inspect.Parameter.empty:
            raise RequestError(f"{what} needs the option '{option}' ({_expected(annotation)})")
    return checked


def canonical_options(plugin: type, what: str, given: Mapping[str, Any]) -> str:
    """Options of a class as canonical JSON, checked by `checked_arguments`, without those that equal their default."""
    parameters, checked = _parameters(plugin), checked_arguments(plugin, what, given)
    kept = {option: value for option, value in checked.items() if value != parameters[option][0]}
    return json.dumps(TypeAdapter(dict[str, Any]).dump_python(kept, mode="json"), sort_keys=True)


def path_options(plugin: type) -> list[str]:
    """Options of a class that are paths."""
    return [option for option, (_, annotation) in _parameters(plugin).items() if annotation is Path]


def doubtful_options(plugin: type) -> dict[str, str]:
    """What is doubtful of the options of a class, by name: no annotation, or a default that does not conform to it."""
    doubts = {}
    for option, (default, annotation) in _parameters(plugin).items():
        if annotation is Any:
            doubts[option] = "has no annotation that says what study files may set it to"
            continue
        try:
            expected = _expected(annotation)
            if default is not inspect.Parameter.empty:
                text = json.dumps(default, default=str)
                TypeAdapter(annotation, config=FINITE).validate_json(text, strict=True)
        except PydanticUserError as error:
            doubts[option] = f"has an annotation that no value of a study file conforms to: {in_a_line(error)}"
        except ValidationError:
            doubts[option] = f"has the default {default!r}; its annotation expects {expected}"
    return doubts


@cache
def _parameters(plugin: Any) -> Mapping[str, tuple[Any, Any]]:
    """Default and annotation of every named parameter of a constructor."""
    constructor = inspect.getattr_static(plugin, "__init__")
    if constructor is object.__init__:
        return {}
    try:
        hints = get_type_hints(constructor, include_extras=True)
    except Exception as error:  # noqa: BLE001  evaluating annotations runs third-party code
        raise RequestError(f"the options of {plugin.__name__} have annotations that fail: {in_a_line(error)}") from None
    parameters = list(inspect.signature(constructor).parameters.values())[1:]  # without self
    named = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return {p.name: (p.default, hints.get(p.name, Any)) for p in named}


def _expected(annotation: Any) -> str:
    """An annotation in words: "float > 0.0", "'coarse', 'fine' or int ≥ 150"."""
    schema = TypeAdapter(annotation).json_schema()
    return " or ".join(_words(part) for part in schema.get("anyOf", [schema]))


def _words(schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return ", ".join(repr(value) for value in schema["enum"])
    if "const" in schema:
        return repr(schema["const"])
    kind = str(schema.get("type", "any value"))
    python = {"integer": "int", "number": "float", "string": "str", "boolean": "bool", "array": "list"}.get(kind, kind)
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    bounds = [f"{sign} {schema[key]:g}" for key, sign in signs.items() if key in schema]
    return " ".join([python, " and ".join(bounds)]).strip()
