"""Coefficients θ(µ) as expressions in the parameters: parsed into a whitelist of arithmetic, never run as code."""

from __future__ import annotations

import ast
import math
import operator
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from vibench.errors import NumericalError, RequestError, unknown_name
from vibench.text import normal_name

CONSTANTS: Mapping[str, float] = {"pi": math.pi, "e": math.e}

FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "abs": abs, "min": min, "max": max, "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "sin": math.sin,
    "cos": math.cos, "tan": math.tan, "asin": math.asin, "acos": math.acos, "atan": math.atan, "atan2": math.atan2,
    "sinh": math.sinh, "cosh": math.cosh, "tanh": math.tanh,
}  # fmt: skip

ARGUMENTS: Mapping[str, range] = {"min": range(2, 100), "max": range(2, 100), "atan2": range(2, 3)}
"""Numbers of arguments of the functions that do not take exactly one."""

BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: math.pow,  # not Python's own, which leaves the real numbers where the base is negative
}  # fmt: skip

UNARY: Mapping[type[ast.unaryop], Callable[[float], float]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}

LONGEST = 2000
"""Characters of an expression."""

DEEPEST = 200
"""Levels of an expression; a sum has as many as terms."""


def normal_names(names: Iterable[str]) -> tuple[str, ...]:
    """Names of parameters in the Unicode form NFKC, in which the micro sign is a μ; names in expressions have it, too.

    Raises
    ------
    RequestError
        If two names are the same then, or one is that of a constant or function of expressions.
    """
    normal = tuple(normal_name(name) for name in names)
    if len(set(normal)) < len(normal):
        raise RequestError(f"two parameters have the same name: {', '.join(normal)}")
    for name in normal:
        if name in CONSTANTS or name in FUNCTIONS:
            kind = "constant" if name in CONSTANTS else "function"
            raise RequestError(f"'{name}' is a {kind} of expressions; give the parameter another name")
    return normal


@dataclass(frozen=True)
class Expression:
    """An arithmetic expression in the parameters, such as "scale**2 * sin(pi * x)"; `parse` makes one."""

    text: str
    names: tuple[str, ...]
    """The parameters, in the order of their values."""

    @classmethod
    def parse(cls, text: str, names: Sequence[str]) -> Expression:
        """Check an expression.

        Raises a `RequestError` if it is not arithmetic on numbers, `names`, `CONSTANTS` and `FUNCTIONS`, or for what
        `normal_names` refuses.
        """
        names = normal_names(names)
        _check(_tree(text), text, names)
        return cls(text, names)

    def __call__(self, mu: Iterable[float]) -> float:
        """The value at mu (d,).

        Raises a `NumericalError` if it is not a finite real number.
        """
        values = dict(zip(self.names, map(float, mu), strict=True))
        where = f"'{self.text}' at {', '.join(f'{name} = {value:g}' for name, value in values.items())}"
        try:
            result = _value(_tree(self.text), {**values, **CONSTANTS})
        except (ArithmeticError, ValueError) as error:
            raise NumericalError(f"{where}: {error}") from None
        if not math.isfinite(result):
            raise NumericalError(f"{where} is {result}, which is not finite")
        return result


@lru_cache(maxsize=1000)
def _tree(text: str) -> ast.expr:
    if len(text) > LONGEST:
        raise RequestError(f"the expression '{text[:40]}…' has {len(text)} characters, at most {LONGEST} are read")
    try:
        with warnings.catch_warnings(action="ignore"):  # of texts that are refused below
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else "nested too deeply, or not text"
        raise RequestError(f"'{text}' is not an expression: {reason}") from None
    level: list[ast.AST] = [tree]
    for _ in range(DEEPEST):
        level = [child for node in level for child in ast.iter_child_nodes(node)]
    if level:
        raise RequestError(f"the expression '{text[:40]}…' is nested more than {DEEPEST} deep")
    return tree


def _check(node: ast.expr, text: str, names: Sequence[str]) -> None:
    """Refuse everything that is not in the whitelist."""
    match node:
        case ast.Constant(value=bool() as value):
            raise RequestError(f"'{text}' contains {value}; expected arithmetic")
        case ast.Constant(value=int() | float() as value):
            try:
                float(value)
            except OverflowError:
                raise RequestError(f"'{text}' contains a number too large for double precision") from None
        case ast.Name(id=name):
            if name not in CONSTANTS and name not in names:
                hint = f"{name} is a function, it needs arguments in brackets" if name in FUNCTIONS else None
                raise RequestError(f"'{text}': {hint or unknown_name('parameter', name, names)}")
        case ast.BinOp(left=left, op=op, right=right) if type(op) in BINARY:
            _check(left, text, names)
            _check(right, text, names)
        case ast.UnaryOp(op=op, operand=operand) if type(op) in UNARY:
            _check(operand, text, names)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            _check_call(name, arguments, text, names)
        case _:
            what = WORDS.get(type(node), "something else")
            hint = "; powers are written **" if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor) else ""
            raise RequestError(f"'{text}' contains {what}; expected arithmetic on numbers and parameters{hint}")


def _check_call(name: str, arguments: Sequence[ast.expr], text: str, names: Sequence[str]) -> None:
    if name not in FUNCTIONS:
        raise RequestError(f"'{text}': {unknown_name('function of expressions', name, FUNCTIONS)}")
    if len(arguments) not in ARGUMENTS.get(name, (1,)):
        raise RequestError(f"'{text}': {name} does not take {len(arguments)} arguments")
    for argument in arguments:
        _check(argument, text, names)


WORDS: Mapping[type[ast.expr], str] = {
    ast.Attribute: "an attribute", ast.Call: "the call of something that is not a function's name",
    ast.Subscript: "an index", ast.Lambda: "a lambda", ast.Compare: "a comparison", ast.IfExp: "a condition",
    ast.BoolOp: "a logical operation", ast.BinOp: "an operator that is not one of + - * / **",
    ast.UnaryOp: "an operator that is not one of + - * / **", ast.Constant: "a text",
}  # fmt: skip
"""What the nodes that are refused most often are called."""


def _value(node: ast.expr, values: Mapping[str, float]) -> float:
    """Value of a checked expression; numbers are floats, so that no power takes longer than another."""
    match node:
        case ast.Constant(value=int() | float() as value):
            return float(value)
        case ast.Name(id=name):
            return values[name]
        case ast.BinOp(left=left, op=op, right=right):
            return BINARY[type(op)](_value(left, values), _value(right, values))
        case ast.UnaryOp(op=op, operand=operand):
            return UNARY[type(op)](_value(operand, values))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name](*(_value(argument, values) for argument in arguments))
    raise NumericalError("the expression was not checked")
