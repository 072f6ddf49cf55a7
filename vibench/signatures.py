"""The border of the public surface: arguments are what the annotations of a function say, or a `RequestError`.

A condition that no class expresses is a `Rule` in an `Annotated` type. Texts in such a type name axes: axes of one name
have one size in a call. Of a space this is the dimension, of a tuple the length. "k?" is an axis that may be missing,
"r+1" one with one entry more than r. "<m" are indices of the axis m.
"""

from __future__ import annotations

import functools
import inspect
import sys
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin

import numpy as np

from vibench.errors import RequestError, VibenchError, unknown_name
from vibench.text import shown

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Rule:
    """Condition on values in words and as a predicate; names of axes, parts or items with some, the axis of indices."""

    right: str
    holds: Callable[[Any], bool]
    axes: tuple[str, ...] = ()
    parts: tuple[tuple[str, Rule], ...] = ()
    items: Rule | None = None
    indexed: str = ""


Share = Annotated[float, Rule("a number between 0 and 1", lambda value: 0.0 < value < 1.0)]
Positive = Annotated[float, Rule("a positive finite number", lambda value: value > 0.0)]
NotNegative = Annotated[float, Rule("a number of at least 0", lambda value: value >= 0.0)]
# No memory holds arrays of a larger size.
Count = Annotated[int, Rule("a whole number of at least 0", lambda value: 0 <= value < 2**31)]
AtLeastOne = Annotated[int, Rule("a whole number of at least 1", lambda value: 1 <= value < 2**31)]
Seed = Annotated[int, Rule("a whole number of at least 0", lambda value: value >= 0)]


class Judged:
    """In an `Annotated` type: the function judges values by itself."""


def bordered(
    called: F, owner: type | None = None, declared: Callable[..., Any] | None = None, *, outside: bool = False
) -> F:
    """Check the arguments of a function, or of the constructor and the public methods of a class.

    A `RequestError` names the argument, what it is and what is right, and the nearest right name of an unknown one.
    The annotations are those of the function itself, or of the one that has `declared` it. Calls from within vibench,
    which are timed, are not checked if only those from `outside` are, as of methods.
    """
    if isinstance(called, type):
        for name, member in list(vars(called).items()):
            if isinstance(member, classmethod) and name[0] != "_":
                setattr(called, name, classmethod(bordered(member.__func__)))
        return cast(F, bordered_constructor(bordered_methods(called)))
    # Annotations may name what is defined below the function.
    signature = functools.cache(lambda: _Signature(called, owner, declared or called))

    @functools.wraps(called)
    def call(*given: Any, **named: Any) -> Any:
        # By the module of the caller: a check takes longer than many a method.
        if not (outside and sys._getframe(1).f_globals.get("__name__", "").startswith("vibench.")):
            signature().check(given, named)
        return called(*given, **named)

    return cast(F, call)


def bordered_methods(kind: type[T]) -> type[T]:
    """Check the arguments of the public methods of a class, whose constructor is called too often."""
    for name, member in list(vars(kind).items()):
        if isinstance(member, types.FunctionType) and name[0] != "_":
            setattr(kind, name, bordered(member, kind, outside=True))
    return kind


def bordered_constructor(kind: type[T]) -> type[T]:
    """Check the arguments of the constructor of a class, whose methods are called too often."""
    kind.__init__ = bordered(kind.__init__)  # type: ignore[method-assign]
    return kind


def bordered_overrides(kind: type, module: str) -> None:
    """Check the arguments of methods of a class by the annotations of those in a module that they override."""
    bases = [base for base in kind.__mro__[1:] if base.__module__ == module]
    for name, member in list(vars(kind).items()) if kind.__module__ != module else ():
        owner = next((base for base in bases if name in vars(base) and name[0] != "_"), None)
        declared = None if owner is None else vars(owner)[name]
        if isinstance(member, types.FunctionType) and isinstance(declared, types.FunctionType):
            setattr(kind, name, bordered(member, owner, declared, outside=True))


@functools.cache
def public(function: Callable[..., Any], module: str) -> Callable[..., Any]:
    """The `bordered` function as one of a module, by which it is pickled; vibench itself calls the function."""
    inner = inspect.unwrap(function)
    # What a context manager wraps is a generator, and no context.
    call: Callable[..., Any] = bordered(function if inspect.isgeneratorfunction(inner) else inner)
    call.__module__ = module
    return call


class _Signature:
    """The rules of the arguments of a function, compiled from its annotations."""

    def __init__(self, function: Callable[..., Any], owner: type | None, declared: Callable[..., Any]) -> None:
        self._signature, self._title = inspect.signature(function), function.__qualname__.removesuffix(".__init__")
        # Annotations of results may be names for the type checker alone.
        hinted = {name: hint for name, hint in declared.__annotations__.items() if name != "return"}
        given = types.SimpleNamespace(__annotations__=hinted)
        hints = typing.get_type_hints(given, inspect.unwrap(declared).__globals__, include_extras=True)
        parameters = self._signature.parameters.values()
        self._several = any(one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD) for one in parameters)
        several = [one.name for one in parameters if one.kind is one.VAR_POSITIONAL and one.name in hints]
        hints |= {name: types.GenericAlias(tuple, (hints[name], ...)) for name in several}
        self._rules = {one.name: (rule_of(hints.get(one.name, Any)), one.default) for one in parameters}
        if owner is not None:
            # A constructor may call what overrides a method before all parts of the object are there.
            rule, whole = rule_of(owner), declared is function and not inspect.isabstract(owner)
            self._rules["self"] = rule if whole else replace(rule, holds=lambda _: True), None
        self._positional = [one.name for one in parameters if one.kind < one.VAR_POSITIONAL]
        self._required = {one.name for one in parameters if one.default is one.empty}
        parts = [(name, "", rule) for name, (rule, _) in self._rules.items()]
        parts += [(name, part, inner) for name, _, rule in parts for part, inner in rule.parts]
        self._indices = [(name, part, rule.indexed) for name, part, rule in parts if rule.indexed]

    def check(self, given: tuple[Any, ...], named: dict[str, Any]) -> None:
        arguments = dict(zip(self._positional, given, strict=False), **named)
        fits = len(arguments) == len(given) + len(named) and not self._several
        if not fits or not self._required <= arguments.keys() or (named and not named.keys() <= self._rules.keys()):
            arguments = self._bound(given, named)
        sizes: dict[str, tuple[int, str]] = {}
        for name, value in arguments.items():
            rule, default = self._rules[name]
            if not rule.right or value is default:
                continue
            if not rule.holds(value):
                refuse_others(f"{name} of {self._title}", value, rule)
            for axis, count, part in _sizes(name, value, rule) if rule.axes or rule.parts or rule.items else ():
                known, whose = sizes.setdefault(axis, (count, part))
                if known != count:
                    what = f"{part} of {self._title} has {axis} = {count}"
                    raise RequestError(f"{what}, but that of {whose} is {known}")
        for name, part, axis in self._indices:
            value = getattr(arguments.get(name), part, None) if part else arguments.get(name)
            indices, (count, _) = np.asarray([] if value is None else value), sizes.get(axis, (sys.maxsize, ""))
            for wrong in indices[(indices < 0) | (indices >= count)].ravel()[:1]:
                right = f"at least 0{f' and below {axis} = {count}' * (axis in sizes)}"
                raise RequestError(f"{part or name} of {self._title} has the index {wrong}, expected {right}")

    def _bound(self, given: tuple[Any, ...], named: dict[str, Any]) -> dict[str, Any]:
        try:
            return self._signature.bind(*given, **named).arguments
        except TypeError as error:
            for name in sorted(named.keys() - self._rules.keys()):
                raise unknown_name(f"argument of {self._title}", name, self._rules) from None
            raise RequestError(f"{self._title}: {error}") from None


def refuse_others(what: str, value: Any, rule: Rule, error: type[VibenchError] = RequestError) -> None:
    """Raise an error that names a value for which a rule does not hold."""
    if rule.holds(value):
        return
    if all(hasattr(value, name) for name, _ in rule.parts):
        for name, inner in rule.parts:
            refuse_others(f"{name} in {what}", getattr(value, name), inner, error)
    if rule.axes and is_plain(value) and not _has_axes(value, rule.axes):
        raise error(f"{what} has the shape {value.shape}, expected {rule.right}")
    if rule.axes and is_plain(value) and value.dtype.kind == "f" and len(wrong := np.argwhere(~np.isfinite(value))):
        raise error(f"{what} has an entry that is not finite, first at {wrong[0].tolist()}")
    raise error(f"{what} is {shown(value)}, expected {rule.right}")


def check_attributes(made: Any, base: type, error: type[VibenchError] = RequestError) -> None:
    """Raise an error if an attribute of an object of a plugin is not what the annotations of a class say."""
    for name, rule in _attributes(base).items():
        refuse_others(f"`{name}` of {type(made).__name__}", getattr(made, name, None), rule, error)


@functools.cache
def _attributes(base: type) -> dict[str, Rule]:
    hints = typing.get_type_hints(base, include_extras=True).items()
    return {name: rule_of(get_args(hint)[0] if get_origin(hint) is typing.ClassVar else hint) for name, hint in hints}


@functools.cache
def rule_of(hint: Any) -> Rule:
    """The rule of a type; of a protocol only the names of its methods are tested."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _annotated(rule_of(parts[0]), parts[1:])
    if origin in (typing.Union, types.UnionType):
        ones = [rule_of(part) for part in parts]
        axes, inside = (tuple(k for one in ones for k in getattr(one, name)) for name in ("axes", "parts"))
        words = " or ".join(one.right for one in ones)
        return Rule(words, lambda value: any(one.holds(value) for one in ones), axes, inside)
    if origin is typing.Literal:
        return Rule(" or ".join(map(repr, parts)), lambda value: isinstance(value, str | bool) and value in parts)
    return _rule_of_class(hint) if origin is None else _rule_of_items(origin, parts)


def _annotated(inner: Rule, marks: tuple[Any, ...]) -> Rule:
    if Judged in marks:
        return rule_of(Any)
    texts, rules = [m for m in marks if isinstance(m, str)], [m for m in marks if isinstance(m, Rule)]
    axes, indexed = tuple(m for m in texts if m[0] != "<"), "".join(m[1:] for m in texts if m[0] == "<")
    shape = f"({', '.join(axes)}{',' * (len(axes) == 1)})"
    shape = f" of the shape {f'({axes[0]},) or ' * ('?' in shape)}{shape.replace('?', '')}" if axes else ""

    def holds(value: Any) -> bool:
        return inner.holds(value) and _has_axes(value, axes) and all(rule.holds(value) for rule in rules)

    return Rule((rules[-1] if rules else inner).right + shape, holds, axes, (), inner.items, indexed)


def _rule_of_items(origin: Any, parts: tuple[Any, ...]) -> Rule:
    """The rule of a type with types of its items."""
    if origin is np.ndarray:
        kinds, what = {
            np.float64: ("fiu", "finite numbers"), np.intp: ("iu", "indices"), np.bool_: ("b", "truth values"),
        }[get_args(parts[1])[0]]  # fmt: skip
        return Rule(f"an array of {what}", lambda value: is_plain(value) and _is_finite(value, kinds))
    if origin is type:
        return Rule(f"a subclass of {parts[0].__name__}", lambda v: isinstance(v, type) and issubclass(v, parts[0]))
    # Types of a tuple of some length are not looked at.
    if not (isinstance(origin, type) and issubclass(origin, Collection)) or (origin is tuple and ... not in parts):
        return Rule("a function", callable) if origin is Callable else _rule_of_class(origin)
    is_mapping = issubclass(origin, Mapping)
    rules = [rule_of(part) for part in parts[: 1 + is_mapping]]

    def holds(value: Any) -> bool:
        # A text is a sequence of texts.
        fits = isinstance(value, origin) and (is_mapping or not isinstance(value, str | bytes | np.ndarray))
        items = (value.items() if is_mapping else zip(value)) if fits else ()
        return fits and all(rule.holds(one) for item in items for rule, one in zip(rules, item, strict=True))

    return Rule(f"a {origin.__name__.lower()} of {rules[-1].right}", holds, items=rules[0] if rules[0].axes else None)


def _rule_of_class(kind: Any) -> Rule:
    scalars = {
        float: Rule("a finite number", lambda v: isinstance(v, Real) and not isinstance(v, bool) and _in_range(v)),
        int: Rule("a whole number", lambda value: isinstance(value, Integral) and not isinstance(value, bool)),
        bool: Rule("True or False", lambda value: isinstance(value, bool | np.bool_)),
        # No path and no name holds this character.
        str: Rule("a text", lambda value: isinstance(value, str) and "\0" not in value),
        types.NoneType: Rule("None", lambda value: value is None),
    }  # fmt: skip
    if kind in scalars or kind is Any or not isinstance(kind, type):
        return scalars.get(kind) or Rule("", lambda _: True)
    if getattr(kind, "_is_protocol", False):
        return Rule("a function", callable) if "__call__" in vars(kind) else _rule_of_protocol(kind)
    hints = typing.get_type_hints(kind, include_extras=True) if kind.__module__.startswith("vibench") else {}
    parts = tuple((name, rule) for name, rule in ((n, rule_of(hint)) for n, hint in hints.items()) if rule.axes)

    def holds(value: Any) -> bool:
        return isinstance(value, kind) and all(rule.holds(getattr(value, name, None)) for name, rule in parts)

    return Rule(f"{'an' if kind.__name__[0] in 'AEIOU' else 'a'} {kind.__name__}", holds, parts=parts)


def _rule_of_protocol(kind: Any) -> Rule:
    names = [name for name, member in vars(kind).items() if inspect.isfunction(member) and name[0] != "_"]
    return Rule(f"an object with {', '.join(names)}", lambda value: all(hasattr(value, name) for name in names))


def _in_range(number: Any) -> bool:
    # Whole numbers may be beyond the range of floats.
    return bool(abs(number) <= sys.float_info.max)


def is_plain(value: Any) -> bool:
    """Whether a value is an array; a masked one has numbers where it has none."""
    return isinstance(value, np.ndarray) and not isinstance(value, np.ma.MaskedArray)


def _is_finite(array: Any, kinds: str) -> bool:
    return array.dtype.kind in kinds and (array.dtype.kind != "f" or bool(np.isfinite(array).all()))


def _has_axes(value: Any, axes: tuple[str, ...]) -> bool:
    count = getattr(value, "ndim", len(axes))
    fits = not axes or count == len(axes) or (axes[0] == "…" and count > 0)
    return fits or (axes[-1][-1] == "?" and count == len(axes) - 1)


def _sizes(name: str, value: Any, rule: Rule) -> Iterator[tuple[str, int, str]]:
    """The sizes of the axes of an argument, and of its parts."""
    if rule.axes and not isinstance(value, Real | None):
        shape = (value.dim,) if hasattr(value, "dim") else getattr(value, "shape", None) or (len(value),)
        axes = rule.axes[: len(shape)] if rule.axes[-1][-1] == "?" else rule.axes
        for axis, count in zip(reversed(axes), reversed(shape), strict=False):
            if axis != "…":
                less = axis.endswith("+1")
                yield axis.rstrip("?").removesuffix("+1"), count - less, f"{name}{' without the last' * less}"
    if rule.items is not None:
        for k, item in enumerate(value):
            yield from _sizes(f"{name}[{k}]", item, rule.items)
    for part, inner in rule.parts if value is not None else ():
        whose = "the object" if name == "self" else name
        yield from _sizes(f"{part.strip('_')} in {whose}", getattr(value, part, None), inner)
