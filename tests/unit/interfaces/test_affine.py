import math
import pickle
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from vibench import AffineProblem, AffineSum, Array, HighFidelitySolver, InnerProduct, ParameterBox, is_absent
from vibench.errors import NumericalError, RequestError
from vibench.interfaces.affine import CONSTANTS, FUNCTIONS, Expression, Theta
from vibench.interfaces.validation import checked_assembly
from vibench.model.affine import Evaluation, affine_decomposition
from vibench.testing import ConformanceError, check


def squared(mu: Array) -> float:
    return float(mu[0] ** 2)


class Strings(AffineProblem):
    """Two strings side by side over a floor, the second of them free of contact; A, f and g vary."""

    parameters = ParameterBox(("tension", "depth"), np.array([0.5, 0.1]), np.array([2.0, 0.3]), ("N", "m"))

    def __init__(self, nodes: int = 12, contact: int = 5) -> None:
        h, off = 1.0 / (nodes + 1), np.ones(nodes - 1)
        K = sp.diags_array([2.0 * np.ones(nodes), -off, -off], offsets=[0, 1, -1]) / h
        zero = sp.csr_array((nodes, nodes))
        first, second = sp.block_diag([K, zero]), sp.block_diag([zero, K])
        B = sp.csr_array((np.full(contact, -h), (np.arange(contact), np.arange(contact) + 2)), (contact, 2 * nodes))
        self.V = InnerProduct(sp.csr_array(sp.block_diag([K, K])))
        self.W = InnerProduct(sp.csr_array(sp.diags_array(np.full(contact, h))))
        load = np.full(2 * nodes, -h)
        A, g = [("tension", first), (squared, second), (0.5, second)], [("depth", np.full(contact, h))]
        self.declare(A=A, f=[("4 + sin(tension)", load)], B=B, g=g)

    def training_set(self) -> Array:
        return self.parameters.grid(4, 3)


def test_affine_declarations_pass_the_checks_or_are_named() -> None:
    check(Strings)
    with pytest.raises(ConformanceError, match="`affine` of f, is not that of `assemble`"):
        check(Wrong)


class Wrong(Strings):
    """Declares half of the load that it assembles."""

    def __init__(self) -> None:
        super().__init__()
        self.affine = {**self.affine, "f": self.affine["f"].mapped(lambda term: 0.5 * term)}


def test_declared_sums_are_members_and_terms_of_the_decomposition() -> None:
    problem, mu = Strings(), np.array([1.3, 0.2])
    vi = problem.assemble(mu)
    terms = [term.toarray() for term in problem.affine["A"].terms]
    assert np.allclose(vi.A.toarray(), 1.3 * terms[0] + (1.3**2 + 0.5) * terms[1], rtol=1e-15)
    assert np.allclose(vi.f, -(4.0 + math.sin(1.3)) / 13)
    assert np.allclose(vi.g, 0.2 / 13)
    assert problem.constant == {"B"}
    assert problem.contact_dofs.tolist() == [2, 3, 4, 5, 6]
    assert np.array_equal(problem.constraint(mu)[0].toarray(), vi.B.toarray())
    assert np.allclose(problem.affine["A"].coefficients(mu), [1.3, 1.69, 0.5])
    problem = Strings()
    members = affine_decomposition(problem, problem.training_set(), 1e-6)
    ways = {"A": (Evaluation.AFFINE, 3), "f": (Evaluation.AFFINE, 1), "B": (Evaluation.CONSTANT, 1)}
    ways["g"] = Evaluation.AFFINE, 1
    assert {name: (m.way, len(m.terms)) for name, m in members.items()} == ways
    assert all(m.error == 0.0 for m in members.values())
    wrong = AffineSum.of([("tension", problem.affine["f"].terms[0])], ["tension", "d"])
    problem.affine = {**problem.affine, "f": wrong}
    with pytest.raises(NumericalError, match=r"sum declared for f differs from the assembled f by 3\.1e-01 at mu"):
        affine_decomposition(problem, problem.training_set(), 1e-6)
    problem.affine = {"A": AffineSum.of([(1.0, sp.csr_array(sp.eye_array(3)))], ())}
    with pytest.raises(NumericalError, match=r"the affine sum of A has shape \(3, 3\), A itself \(24, 24\)"):
        affine_decomposition(problem, problem.training_set(), 1e-6)


def test_constraints_may_touch_all_unknowns_or_none() -> None:
    class Everywhere(Strings):
        def __init__(self) -> None:
            super().__init__()
            self.W = InnerProduct(sp.csr_array(sp.eye_array(24)))
            self.declare(A=self.V.matrix, f=np.ones(24), B=sp.csr_array(sp.eye_array(24)), g=[("depth", np.ones(24))])

    problem, mu = Everywhere(), np.array([1.0, 0.2])
    assert np.array_equal(problem.contact_dofs, np.arange(24))
    assert np.array_equal(problem.contact(mu).g, np.full(24, 0.2))
    solution = HighFidelitySolver(problem).solve(mu)
    assert solution.u.max() == pytest.approx(0.2)
    problem.declare(A=problem.V.matrix, f=np.ones(24), B=sp.csr_array((24, 24)), g=np.ones(24))
    assert problem.contact_dofs is None
    assert problem.contact(mu) is None


@given(data=st.data())
@settings(max_examples=12, deadline=None)
def test_a_sum_of_sparse_matrices_is_that_of_dense_ones(data: st.DataObject) -> None:
    shape, count = (data.draw(st.integers(1, 5)), data.draw(st.integers(1, 5))), data.draw(st.integers(1, 4))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    dense = [rng.standard_normal(shape) * (rng.random(shape) < 0.4) for _ in range(count)]
    theta = rng.standard_normal(count)
    total = AffineSum(tuple(sp.csr_array(term) for term in dense), lambda mu: mu[0] * theta)
    found = total.at(np.array([2.0]))
    expected = sum(2.0 * t * term for t, term in zip(theta, dense, strict=True))
    assert np.allclose(found.toarray(), expected, rtol=1e-14, atol=1e-14)
    rows, columns = np.unravel_index(np.arange(shape[0] * shape[1]), shape)
    assert np.allclose(total.entries(rows, columns)(np.array([2.0])), np.ravel(expected), rtol=1e-14, atol=1e-14)


def test_wrong_declarations_and_coefficients_are_refused() -> None:
    for declared, error, message in (
        ({"f": np.ones(23)}, NumericalError, r"f has shape \(23,\); the spaces V and W require \(24,\)"),
        ({"f": [("tensoin", np.ones(24))]}, RequestError, "no parameter is called 'tensoin'; did you mean 'tension'"),
        ({"f": [(1.0, np.ones(24)), (1.0, np.ones(23))]}, NumericalError, r"shapes \[\(24,\), \(23,\)\]"),
        ({"f": []}, NumericalError, r"shapes \[\]; expected one shape"),
    ):
        problem = Strings()
        members: dict[str, Any] = dict(problem._members) | declared
        with pytest.raises(error, match=message):
            problem.declare(**members)
    total = AffineSum((np.ones(2), np.ones(2)), lambda mu: mu)
    with pytest.raises(NumericalError, match="2 terms need as many finite coefficients, found at mu"):
        total.coefficients(np.ones(3))
    with pytest.raises(NumericalError, match="finite"):
        total.coefficients(np.array([1.0, np.nan]))
    total = AffineSum.of([("x**2", np.ones(2)), (3.0, np.arange(2.0))], ("x",))
    again = pickle.loads(pickle.dumps(total))
    assert np.array_equal(again.at(np.array([2.0])), [4.0, 7.0])


def declared(g: object) -> AffineProblem:
    """Two unknowns above a table, the second one without, with a parameter between −1 and 1."""

    class Table(AffineProblem):
        parameters = ParameterBox(("tilt",), np.array([-1.0]), np.array([1.0]), ("1",))
        V = W = InnerProduct(sp.eye_array(2))

        def training_set(self) -> Array:
            return self.parameters.grid(3)

    problem = Table()
    problem.declare(A=2.0 * sp.eye_array(2), f=-9.0 * np.ones(2), B=-sp.eye_array(2), g=g)
    return problem


INFINITE = np.array([0.0, np.inf])


@pytest.mark.parametrize("theta", ["tilt", "2 + tilt", "-1", lambda mu: 1.0, -1.0, 0.0])
def test_an_infinite_entry_needs_a_coefficient_that_is_a_positive_constant(theta: Theta) -> None:
    line = "g: row 1 of term 1 is infinite, and its coefficient is no positive constant: give the infinite entries a"
    with pytest.raises(NumericalError, match=f"^{line}"):
        declared([(1.0, np.ones(2)), (theta, INFINITE)])
    with pytest.raises(NumericalError, match="row 1 of term 0 is infinite"):
        AffineSum((INFINITE,), lambda mu: np.ones(1))


@pytest.mark.parametrize(("theta", "other"), [(1.0, -2.0), (1e-9, "tilt"), (3e7, "-1e3 * tilt"), ("2 * pi", -2.0)])
def test_an_absent_row_is_absent_whatever_is_added_to_it(theta: Theta, other: Theta) -> None:
    problem = declared([(1.0, np.array([1.0, 0.0])), (theta, INFINITE), (other, np.array([0.0, 1e30]))])
    twice = declared([(theta, INFINITE + np.array([1.0, 0.0])), (1.0, INFINITE)])
    for mu in problem.training_set():
        assert problem.assemble(mu).g[0] == 1.0
        for each in (problem, twice):
            assert is_absent(each.assemble(mu).g).tolist() == [False, True]
        exact = HighFidelitySolver(problem).solve(mu)
        np.testing.assert_allclose(exact.u, [-1.0, -4.5], rtol=1e-14)
        assert exact.lam[1] == 0.0


def test_infinite_loads_are_refused() -> None:
    problem = declared(np.ones(2))
    for f in (-INFINITE, INFINITE):
        problem.declare(A=2.0 * sp.eye_array(2), f=f, B=-sp.eye_array(2), g=np.ones(2))
        with pytest.raises(NumericalError, match="f has entries"):
            checked_assembly(problem, np.zeros(1))


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


@settings(max_examples=15)
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
    "__import__('os').system('true')": "not a function's name", "().__class__.__base__": "an attribute",
    "a.real": "an attribute", "open(a)": "no function of expressions is called 'open'",
    "exp.__call__(a)": "not a function's name", "(lambda: a)()": "not a function's name", "lambda: a": "a lambda",
    "[a][0]": "an index", "a if b else 1": "a condition", "a < b": "a comparison", "a and b": "a logical operation",
    "a // b": "an operator that is not", "a ^ 2": r"powers are written \*\*", "~a": "an operator that is not",
    "'a' * 9": "a text", "True": "contains True", "f'{a}'": "something else", "{a: b}": "something else",
    "(a := 1)": "something else", "a; b": "not an expression", "a b": "not an expression", "": "not an expression",
    "\0": "not an expression", "(" * 900 + "a" + ")" * 900: "not an expression", "-" * 5000 + "a": "5000|5001",
    "-" * 1500 + "a": "nested more than 200 deep|not an expression", "+".join(["a"] * 500): "nested more than 200 deep",
    "'\\d'": "a text", "c": "no parameter is called 'c'", "exp": "needs arguments",
    "exp(a, b)": "does not take 2 arguments", "min(a)": "does not take 1 argument", "exp(x=a)": "not a function's name",
    "exp(*a)": "something else", "1j": "a text|something else", "1" + "0" * 400: "too large",
}  # fmt: skip


def test_what_is_not_arithmetic_not_finite_or_no_name_is_refused() -> None:
    for text, message in HOSTILE.items():
        with pytest.raises(RequestError, match=message):
            Expression.parse(text, NAMES)
    roots = "(-a)**0.5", "max(a, (-b)**1.5)", "abs((-a)**0.5)"
    for text in ("1 / (a - 1)", "log(-a)", "9**9**9**9", *roots, "exp(1000)", "1e308 * 10 * a"):
        with pytest.raises(NumericalError, match="at a = 1, b = 2"):
            Expression.parse(text, NAMES)((1.0, 2.0))
    for name in (*CONSTANTS, *FUNCTIONS, "\uff45"):
        line = r"is a (constant|function) of expressions; give the parameter another name"
        with pytest.raises(RequestError, match=line):
            Expression.parse("1", ("a", name))
    assert Expression.parse("2 * \u00b5", ["\u03bc"])([3.0]) == Expression.parse("2 * \u03bc", ["\u00b5"])([3.0]) == 6.0
    with pytest.raises(RequestError, match="two parameters have the same name: \u03bc, \u03bc"):
        Expression.parse("1", ("\u00b5", "\u03bc"))
