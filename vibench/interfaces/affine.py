"""Affine members Σ_q θ_q(mu) · terms_q: matrices or vectors whose dependence on the parameter is declared.

Coefficients θ_q may be expressions in the parameters, parsed into a whitelist of arithmetic and never run as code.
"""

from __future__ import annotations

import ast
import math
import operator
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix, frozen, read_only, real_vector
from vibench.errors import NumericalError, RequestError, unknown_name
from vibench.interfaces.absent_rows import ABSENT, is_absent
from vibench.signatures import bordered, bordered_constructor
from vibench.text import normal_name

CONSTANTS: Mapping[str, float] = {"pi": math.pi, "e": math.e}

FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "abs": abs, "min": min, "max": max, "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "sin": math.sin,
    "cos": math.cos, "tan": math.tan, "asin": math.asin, "acos": math.acos, "atan": math.atan, "atan2": math.atan2,
    "sinh": math.sinh, "cosh": math.cosh, "tanh": math.tanh,
}  # fmt: skip

BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    # not the power of Python, which leaves the real numbers where the base is negative
    ast.Pow: math.pow,
}  # fmt: skip


def normal_names(names: Iterable[str]) -> tuple[str, ...]:
    """Names of parameters in the Unicode form NFKC, as in expressions: the micro sign becomes a μ.

    Raises a `RequestError` if two names are the same then, or one is that of a constant or function of expressions.
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
    """An arithmetic expression in the parameters, such as "scale**2 * sin(pi * x)"; `parse` makes one.

    `names` are the parameters, in the order of their values.
    """

    text: str
    names: tuple[str, ...]

    @property
    def constant(self) -> float | None:
        """Its value if that depends on no parameter, else `None`."""
        used = {node.id for node in ast.walk(_tree(self.text)) if isinstance(node, ast.Name)}
        return None if used.intersection(self.names) else self(np.zeros(len(self.names)))

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


# Cached: an expression is evaluated at every parameter.
@lru_cache(maxsize=1000)
def _tree(text: str) -> ast.expr:
    # Texts may come from anybody: a long one would take the time and the memory of the parser.
    if len(text) > 2000:
        raise RequestError(f"the expression '{text[:40]}…' has {len(text)} characters, at most 2000 are read")
    try:
        # Python warns of texts that are refused below.
        with warnings.catch_warnings(action="ignore"):
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else "nested too deeply, or not text"
        raise RequestError(f"'{text}' is not an expression: {reason}") from None
    level: list[ast.AST] = [tree]
    # Evaluation is recursive; a sum has as many levels as terms.
    for _ in range(200):
        level = [child for node in level for child in ast.iter_child_nodes(node)]
    if level:
        raise RequestError(f"the expression '{text[:40]}…' is nested more than 200 deep")
    return tree


def _check(node: ast.expr, text: str, names: Sequence[str]) -> None:
    match node:
        # A truth value is an integer for Python, but none for a reader.
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
        case ast.UnaryOp(op=op, operand=operand) if isinstance(op, ast.UAdd | ast.USub):
            _check(operand, text, names)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            _check_call(name, arguments, text, names)
        case _:
            words: dict[type[ast.expr], str] = {
                ast.Attribute: "an attribute", ast.Call: "the call of something that is not a function's name",
                ast.Subscript: "an index", ast.Lambda: "a lambda", ast.Compare: "a comparison",
                ast.IfExp: "a condition", ast.BoolOp: "a logical operation", ast.Constant: "a text",
                ast.BinOp: "an operator that is not one of + - * / **",
                ast.UnaryOp: "an operator that is not one of + - * / **",
            }  # fmt: skip
            what = words.get(type(node), "something else")
            hint = "; powers are written **" if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor) else ""
            raise RequestError(f"'{text}' contains {what}; expected arithmetic on numbers and parameters{hint}")


def _check_call(name: str, arguments: Sequence[ast.expr], text: str, names: Sequence[str]) -> None:
    if name not in FUNCTIONS:
        raise RequestError(f"'{text}': {unknown_name('function of expressions', name, FUNCTIONS)}")
    least, most = (2, 100) if name in ("min", "max") else (2, 2) if name == "atan2" else (1, 1)
    if not least <= len(arguments) <= most:
        raise RequestError(f"'{text}': {name} does not take {len(arguments)} arguments")
    for argument in arguments:
        _check(argument, text, names)


def _value(node: ast.expr, values: Mapping[str, float]) -> float:
    match node:
        # Floats, so that no power takes longer than another.
        case ast.Constant(value=int() | float() as value):
            return float(value)
        case ast.Name(id=name):
            return values[name]
        case ast.BinOp(left=left, op=op, right=right):
            return BINARY[type(op)](_value(left, values), _value(right, values))
        case ast.UnaryOp(op=op, operand=operand):
            value = _value(operand, values)
            return -value if isinstance(op, ast.USub) else value
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name](*(_value(argument, values) for argument in arguments))
    raise NumericalError("the expression was not checked")


Theta = float | str | Callable[[Array], float]
"""A coefficient: a number, an expression in the names of the parameters such as "load * sin(angle)", or a function."""


@dataclass(frozen=True)
class Thetas:
    """Coefficients given one by one; a call returns their values (Q,) at a parameter (d,)."""

    functions: tuple[float | Callable[[Array], float], ...]

    @property
    def constant(self) -> bool:
        """Whether all are numbers."""
        return not any(callable(theta) for theta in self.functions)

    def number(self, q: int) -> float | None:
        """The coefficient of a term if it is a number, or says that it is a constant one; else `None`."""
        theta = self.functions[q]
        constant: float | None = getattr(theta, "constant", None) if callable(theta) else theta
        return constant

    def __call__(self, mu: Array) -> Array:
        """Evaluate all at mu (d,)."""
        return np.array([theta(mu) if callable(theta) else theta for theta in self.functions], float)


@bordered_constructor
@dataclass(frozen=True)
class AffineSum:
    """A member Σ_q θ_q(mu) · terms_q of a variational inequality.

    Attributes
    ----------
    terms
        Vectors of one length, or sparse matrices of one shape; at least one. An infinite entry of a vector, of a row
        that constrains nothing, belongs to a term whose coefficient is a positive number.
    thetas
        Function from mu (d,) to θ (Q,). A problem can be copied to another process only if this function can: a lambda
        cannot.

    Raises a `NumericalError` if there is no term, the terms differ in their shapes, or an infinite entry has another
    coefficient.
    """

    terms: tuple[Any, ...]
    thetas: Callable[[Array], Any]

    def __post_init__(self) -> None:
        shapes = list(dict.fromkeys(np.shape(term) for term in self.terms))
        if len(shapes) != 1 or len({sp.issparse(term) for term in self.terms}) != 1:
            raise NumericalError(f"the terms of an affine sum have the shapes {shapes}; expected one shape for all")
        if len(shapes[0]) == 1 and not sp.issparse(self.terms[0]):
            terms = tuple(real_vector(term, "a term of an affine sum") for term in self.terms)
            object.__setattr__(self, "terms", tuple(map(read_only, _with_absent_rows(terms, self.thetas))))
        elif sp.issparse(self.terms[0]):
            # Shallow copies: the arrays of the caller remain as they are.
            object.__setattr__(self, "terms", tuple(frozen(copy(term)) for term in self.terms))

    @classmethod
    @bordered
    def of(cls, pairs: Sequence[tuple[Theta, Any]], names: Sequence[str]) -> AffineSum:
        """The sum of pairs (θ_q, term_q); expressions are in these names of the parameters.

        Raises a `RequestError` if an expression is not arithmetic on numbers and these names.
        """
        thetas = tuple(Expression.parse(theta, names) if isinstance(theta, str) else theta for theta, _ in pairs)
        return cls(tuple(term for _, term in pairs), Thetas(thetas))

    def coefficients(self, mu: Array) -> Array:
        """θ(mu) (Q,); raises a `NumericalError` if they are not as many finite numbers as there are terms."""
        theta = np.asarray(self.thetas(mu), float)
        if theta.shape != (len(self.terms),) or not np.isfinite(theta).all():
            where = f"at mu = {mu.tolist()}: {theta.tolist()}"
            raise NumericalError(f"{len(self.terms)} terms need as many finite coefficients, found {where}")
        return theta

    def at(self, mu: Array) -> Any:
        """The sum at mu (d,); a matrix has the union of the patterns of the terms at every mu."""
        theta = self.coefficients(mu)
        if isinstance(self.terms[0], np.ndarray):
            return self._columns @ theta
        # The same pattern at every mu, so that factorisations keep their symbolic analysis.
        pattern, values = self._stacked
        return sp.csr_array((values @ theta, pattern.indices, pattern.indptr), shape=pattern.shape)

    @cached_property
    def _columns(self) -> Array:
        """The terms of a vector (n×Q)."""
        return np.stack(self.terms, axis=-1)

    @cached_property
    def _stacked(self) -> tuple[SparseMatrix, SparseMatrix]:
        """The union of the patterns, and the entries of the terms on it (k×Q)."""
        coo = [sp.coo_array(term) for term in self.terms]
        rows, columns = (np.concatenate([term.coords[axis] for term in coo]) for axis in (0, 1))
        shape = self.terms[0].shape
        pattern = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)
        # Entries of the pattern are sorted by row and column: their place is found by bisection.
        keys = np.repeat(np.arange(shape[0]), np.diff(pattern.indptr)) * shape[1] + pattern.indices
        places = np.searchsorted(keys, rows.astype(np.int64) * shape[1] + columns)
        number = np.repeat(np.arange(len(coo)), [term.nnz for term in coo])
        data = np.concatenate([term.data for term in coo])
        return pattern, sp.csr_array((data, (places, number)), shape=(len(keys), len(coo)))

    @bordered
    def entries(self, rows: Indices, columns: Indices) -> Callable[[Array], Array]:
        """Function that evaluates these entries (k,) at mu; `columns` is not used for vectors."""
        values = np.stack([entries_of(term, rows, columns) for term in self.terms], axis=-1)
        return lambda mu: np.asarray(values @ self.coefficients(mu))

    @bordered
    def mapped(self, change: Callable[[Any], Any]) -> AffineSum:
        """The sum with a linear map applied to every term."""
        return AffineSum(tuple(change(term) for term in self.terms), self.thetas)


def _with_absent_rows(terms: tuple[Array, ...], thetas: Callable[[Array], Any]) -> tuple[Array, ...]:
    """The terms of a sum that is `ABSENT` in all rows where one of them is infinite, whatever the others are."""
    infinite = [is_absent(term) for term in terms]
    rows = np.any(infinite, axis=0)
    if not rows.any():
        return terms
    made, left = [np.where(rows, 0.0, term) for term in terms], rows.copy()
    for q in (q for q, mask in enumerate(infinite) if mask.any()):
        theta = thetas.number(q) if isinstance(thetas, Thetas) else None
        # A coefficient that changes its sign would make a bound of −∞ of one of +∞.
        if theta is None or not theta > 0.0:
            row = int(np.argmax(infinite[q]))
            remedy = "give the infinite entries a term of their own, with the coefficient 1"
            fault = f"row {row} of term {q} is infinite, and its coefficient is no positive constant"
            raise NumericalError(f"{fault}: {remedy}")
        made[q][infinite[q] & left] = ABSENT / theta
        left &= ~infinite[q]
    return tuple(made)


def entries_of(array: Any, rows: Indices, columns: Indices) -> Array:
    """Entries (k,) of a vector or a sparse matrix."""
    if isinstance(array, np.ndarray):
        return array[rows]
    # SciPy returns a matrix of one row, or a sparse array, for some formats.
    return np.asarray(sp.csr_array(array)[rows, columns]).ravel()
