"""Expressions of θ: the values are Python's; what is not arithmetic is refused and never run."""

import math
import pickle

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vibench.errors import NumericalError, RequestError
from vibench.interfaces.affine import CONSTANTS, FUNCTIONS, Expression

NAMES = ("a", "b")
numbers = st.floats(0.0, 1e3).map(repr) | st.integers(0, 50).map(str)
leaves = numbers | st.sampled_from([*NAMES, *CONSTANTS])
one = [name for name in FUNCTIONS if name not in ("min", "max", "atan2")]


def larger(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return (
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", "**"]), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})")
        | st.tuples(st.sampled_from("+-"), inner).map("".join)
        | st.tuples(st.sampled_from(one), inner).map(lambda t: f"{t[0]}({t[1]})")
        | st.tuples(st.sampled_from(["min", "max", "atan2"]), inner, inner).map(lambda t: f"{t[0]}({t[1]}, {t[2]})")
    )


@settings(max_examples=40)
@given(st.recursive(leaves, larger, max_leaves=8), st.floats(-10.0, 10.0), st.floats(-10.0, 10.0))
def test_safe_expressions_have_the_values_of_python(text: str, a: float, b: float) -> None:
    expression = pickle.loads(pickle.dumps(Expression.parse(text, NAMES)))
    try:
        expected = eval(text, {"__builtins__": {}}, {**FUNCTIONS, **CONSTANTS, "a": a, "b": b})
        finite = not isinstance(expected, complex) and math.isfinite(expected)
    except (ArithmeticError, ValueError, TypeError):  # the smaller of complex numbers, among others
        finite = False
    try:
        found = expression((a, b))
    except NumericalError:
        # Python's whole numbers have no largest one; here they are floats.
        assert not finite or "**" in text
        return
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-300)


HOSTILE = {
    "__import__('os').system('true')": "not a function's name",
    "().__class__.__base__": "an attribute",
    "a.real": "an attribute",
    "open(a)": "no function of expressions is called 'open'",
    "exp.__call__(a)": "not a function's name",
    "(lambda: a)()": "not a function's name",
    "lambda: a": "a lambda",
    "[a][0]": "an index",
    "a if b else 1": "a condition",
    "a < b": "a comparison",
    "a and b": "a logical operation",
    "a // b": "an operator that is not",
    "a ^ 2": r"powers are written \*\*",
    "~a": "an operator that is not",
    "'a' * 9": "a text",
    "True": "contains True",
    "f'{a}'": "something else",
    "{a: b}": "something else",
    "(a := 1)": "something else",
    "a; b": "not an expression",
    "a b": "not an expression",
    "": "not an expression",
    "\0": "not an expression",
    "(" * 900 + "a" + ")" * 900: "not an expression",
    "-" * 5000 + "a": "5000|5001",
    "-" * 1500 + "a": "nested more than 200 deep|not an expression",
    "+".join(["a"] * 500): "nested more than 200 deep",
    "'\\d'": "a text",
    "c": "no parameter is called 'c'",
    "exp": "needs arguments",
    "exp(a, b)": "does not take 2 arguments",
    "min(a)": "does not take 1 argument",
    "exp(x=a)": "not a function's name",
    "exp(*a)": "something else",
    "1j": "a text|something else",
    "1" + "0" * 400: "too large",
}


def test_what_is_not_arithmetic_not_finite_or_no_name_is_refused() -> None:
    for text, message in HOSTILE.items():
        with pytest.raises(RequestError, match=message):
            Expression.parse(text, NAMES)
    for text in (
        "1 / (a - 1)",
        "log(-a)",
        "9**9**9**9",
        "(-a)**0.5",
        "max(a, (-b)**1.5)",
        "abs((-a)**0.5)",
        "exp(1000)",
        "1e308 * 10 * a",
    ):
        with pytest.raises(NumericalError, match="at a = 1, b = 2"):
            Expression.parse(text, NAMES)((1.0, 2.0))
    for name in (*CONSTANTS, *FUNCTIONS, "\uff45"):
        with pytest.raises(
            RequestError, match=r"is a (constant|function) of expressions; give the parameter another name"
        ):
            Expression.parse("1", ("a", name))
    assert Expression.parse("2 * \u00b5", ["\u03bc"])([3.0]) == Expression.parse("2 * \u03bc", ["\u00b5"])([3.0]) == 6.0
    with pytest.raises(RequestError, match="two parameters have the same name: \u03bc, \u03bc"):
        Expression.parse("1", ("\u00b5", "\u03bc"))
