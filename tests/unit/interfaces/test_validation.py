import re
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.sparse as sp
from broken_problems import Declared
from broken_variants import ByElements
from fake_plugins import Wire
from numerics import Varying

from vibench import AffineProblem, Array, InnerProduct, Output, ParameterBox, Reduction, VariationalInequality, create
from vibench.errors import NumericalError, RequestError
from vibench.highfidelity.active_set import solve_high_fidelity
from vibench.interfaces.affine import AffineSum
from vibench.interfaces.problem import Contact, ContactLoads, Problem
from vibench.interfaces.strategies import Stop
from vibench.interfaces.validation import ReferenceAssembly, checked_assembly, contradictions, validation_parameters

MU = np.array([0.5])

# Entries are numbers of single precision, and most of them integers.
CONVERTED: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "COO": (sp.coo_array, np.asarray), "COO matrix": (sp.coo_matrix, np.asarray), "DIA": (sp.dia_array, np.asarray),
    "LIL": (sp.lil_array, np.asarray), "DOK": (sp.dok_array, np.asarray), "BSR": (sp.bsr_array, np.asarray),
    "CSC": (sp.csc_array, np.asarray), "CSR matrix": (sp.csr_matrix, np.asarray),
    "dense": (lambda M: M.toarray(), np.asarray), "np.matrix": (sp.csr_matrix.todense, np.asarray),
    "integers": (lambda M: M.astype(int), lambda v: v.astype(int)),
    "float32": (lambda M: M.astype(np.float32), lambda v: v.astype(np.float32)),
    "long double": (lambda M: M.astype(np.longdouble), lambda v: v.astype(np.longdouble)),
}  # fmt: skip
REFUSED: dict[str, tuple[Callable[[Any], Any], str]] = {
    "list": (lambda v: v.toarray().tolist() if sp.issparse(v) else v.tolist(), "is a list, expected a"),
    "none": (lambda v: None, "is a NoneType, expected a"),
    "complex": (lambda v: v * 1j, "is complex"),
    "objects": (
        lambda v: (v.toarray() if sp.issparse(v) else v).astype(object), "has entries of the type object, expected real"
    ),
    "masked": (
        lambda v: np.ma.masked_less(v.toarray() if sp.issparse(v) else v, -1.0), "is a masked array, expected numbers"
    ),
}  # fmt: skip


class Chain(Varying):
    """Springs above a table, in integers but for the load; `kinds` gives matrices and vectors their types."""

    def __init__(self, kinds: tuple[Callable[[Any], Any], Callable[[Any], Any]] = (sp.csr_array, np.asarray)) -> None:
        super().__init__(n=10, m=10, count=4)
        self.V = InnerProduct(sp.csr_array(sp.eye_array(10)))
        self.W, self.kinds = self.V, kinds

    def assemble(self, mu: Array) -> VariationalInequality:
        matrix, vector = self.kinds
        A = sp.diags_array([4.0 * np.ones(10), -np.ones(9), -np.ones(9)], offsets=[0, 1, -1])
        B, f = -sp.eye_array(10), -np.round(8.0 * (1.0 + mu[0])) * np.ones(10)
        A, B = matrix(sp.csr_matrix(A)), matrix(sp.csr_matrix(B))
        return VariationalInequality(A, vector(f), B, vector(3.0 + 0.0 * f))


@pytest.mark.parametrize("kind", CONVERTED)
def test_unambiguous_types_give_the_numbers_of_float64(kind: str) -> None:
    problem, usual = Chain(CONVERTED[kind]), Chain()
    vi = checked_assembly(problem, MU)
    for name in ("A", "f", "B", "g"):
        value = getattr(vi, name)
        assert value.dtype == np.float64
        assert name in "fg" or isinstance(value, sp.csr_array | sp.csc_array)
    exact = solve_high_fidelity(problem.assemble(MU))
    np.testing.assert_allclose(exact.u, solve_high_fidelity(usual.assemble(MU)).u, rtol=1e-13)
    assert np.any(exact.lam > 0.0)
    dual, primal = create("dual strategy", "cpg"), create("primal strategy", "online-supremizers")
    sizes = Stop(size=2), Stop(size=2)
    found, same = (Reduction(each, dual, primal, *sizes).model.solve(MU) for each in (problem, usual))
    assert found.status == "ok"
    np.testing.assert_allclose(found.lam, same.lam, rtol=0.0, atol=1e-9)
    assert found.error_bounds.u_energy == pytest.approx(same.error_bounds.u_energy, rel=1e-6)


@pytest.mark.parametrize("member", ["A", "f", "B", "g"])
@pytest.mark.parametrize("kind", REFUSED)
def test_other_types_are_named(kind: str, member: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (change, message), problem, usual = REFUSED[kind], Chain(), Chain()
    members = vars(usual.assemble(MU))
    wrong = members | {member: change(members[member])}
    monkeypatch.setattr(problem, "assemble", lambda mu: VariationalInequality(**wrong))
    with pytest.raises(NumericalError, match=rf"at mu = \[0.5\]: {member} {message}"):
        checked_assembly(problem, MU)


@pytest.mark.parametrize("kind", CONVERTED)
def test_constraints_on_the_contact_norms_and_declared_terms_are_converted_too(kind: str) -> None:
    matrix, vector = CONVERTED[kind]
    eye = sp.csr_matrix(sp.eye_array(5))
    contact = Contact(matrix(eye), vector(np.ones(5)))
    assert (contact.B.dtype, contact.g.dtype) == (np.float64, np.float64)
    norm = InnerProduct(matrix(eye))
    assert norm.matrix.dtype == np.float64

    class Declared(AffineProblem):
        parameters = ParameterBox(("load",), np.array([1.0]), np.array([2.0]), ("1",))
        V = W = norm
        training_set = None

    problem = Declared()
    problem.declare(A=matrix(4.0 * eye), f=[("load", vector(-np.ones(5)))], B=matrix(-eye), g=vector(np.zeros(5)))
    vi = problem.assemble(MU)
    assert checked_assembly(problem, MU).A is vi.A
    # an infinite bound of single precision is an absent row
    vi = VariationalInequality(None, np.ones(1), None, np.array([np.inf, 1.0], np.float32))
    assert vi.g.tolist() == [1e100, 1.0]


def test_what_a_problem_raises_names_the_parameter(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Chain()
    monkeypatch.setattr(problem, "assemble", Mock(side_effect=ValueError("mesh tangled")))
    with pytest.raises(NumericalError, match=r"^at mu = \[0.5\]: ValueError: mesh tangled$"):
        checked_assembly(problem, MU)


def variant(base: type[Problem], **members: Any) -> Problem:
    return type("Variant", (base,), {"__module__": __name__, **members})()


def contact_of(B: float = 1.0, g: float = 1.0, above: float = 0.0) -> Any:
    """The contact of a wire, wrong by these factors above a force."""

    def contact(self: Any, mu: np.ndarray) -> Contact:
        right = Declared.contact(self, mu)
        return Contact(B * right.B, g * right.g) if mu[0] > above else right

    return contact


def loads_of(loads: float = 1.0, bounds: float = 1.0) -> Any:
    def contact_loads(self: Any, eta: np.ndarray) -> ContactLoads:
        right = Problem.contact_loads(self, eta)
        varying = lambda mu: tuple(f * one for f, one in zip((loads, bounds), right.varying(mu), strict=True))  # noqa: E731
        return ContactLoads(right.fixed, varying, 0)

    return contact_loads


def sampler_of(method: str, wrong: str) -> Any:
    def sampler(self: Any, wanted: Any) -> Any:
        right = getattr(super(type(self), self), method)(wanted)
        return lambda mu: {name: (1.01 if name == wrong else 1.0) * one for name, one in right(mu).items()}

    return sampler


def sum_of(name: str, theta: Any) -> dict[str, AffineSum]:
    """A member of a wire as one term with this coefficient at a force."""
    at_six = getattr(Wire().assemble(np.array([6.0])), name)
    return {name: AffineSum((at_six,), lambda mu: np.array([theta(mu[0])]))}


def bumpy(self: Any, mu: np.ndarray) -> VariationalInequality:
    """A wire whose load is proportional to the force at its training parameters, and not between them."""
    vi = Wire.assemble(self, mu)
    return replace(vi, f=vi.f * (1.0 + 0.5 * (abs(2.0 * mu[0] % 1.0 - 0.5) < 0.3)))


WRONG = {
    "`contact`, g": variant(Declared, contact=contact_of(g=1.2)),
    "`contact`, B": variant(Declared, contact=contact_of(B=1.2)),
    "`contact`, g at some parameters": variant(Declared, contact=contact_of(g=1.2, above=5.0)),
    "`contact_loads`, Bᵀη": variant(Declared, contact_loads=loads_of(loads=0.9)),
    "`contact_loads`, ηᵀg": variant(Declared, contact_loads=loads_of(bounds=0.9)),
    "`sampler` of A": variant(Declared, sampler=sampler_of("sampler", "A")),
    "`sampler` of f": variant(Declared, sampler=sampler_of("sampler", "f")),
    "`affine` of f": variant(Wire, affine=sum_of("f", lambda force: force / 6.0 + 0.1 * (force > 5.0))),
    "`affine` of A": variant(Wire, affine=sum_of("A", lambda force: 1.0 + 1e-6 * force)),
    "`element_sampler` of A": variant(ByElements, element_sampler=sampler_of("element_sampler", "A")),
    "`affine` of g": variant(Wire, affine=sum_of("g", lambda force: force / 6.0)),
    "`affine` of f at some parameters": variant(Wire, affine=sum_of("f", lambda force: force / 6.0), assemble=bumpy),
}
RIGHT = [Declared(), variant(Declared, contact_loads=loads_of()), ByElements(), Wire(),
         variant(Wire, affine=sum_of("f", lambda force: force / 6.0))]  # fmt: skip


def middle(problem: Problem) -> np.ndarray:
    return 0.45 * problem.parameters.lower + 0.55 * problem.parameters.upper


@pytest.mark.parametrize("what", WRONG)
def test_what_assembly_does_not_confirm_is_named_with_its_parameter(what: str) -> None:
    problem = WRONG[what]
    mu = middle(problem)
    (said, *_) = contradictions(problem, mu, problem.assemble(mu))
    assert said.startswith(what.removesuffix(" at some parameters"))
    with pytest.raises(NumericalError, match=rf"refuted at mu = \[{mu[0]}.*\]: `"):
        ReferenceAssembly(problem).refuse_false_declarations(mu, problem.assemble(mu))
    between = what == "`affine` of f at some parameters"  # where bounds alone look
    reduction = Reduction(problem, None, None, None, None, assembly="reduced", bounds=between)
    with pytest.raises(NumericalError, match=r"refuted at mu = \[.*\]: `"):
        reduction.snapshots  # noqa: B018


WIRE = Wire()
RETURNS: dict[str, tuple[dict[str, Any], str]] = {
    "members of a text": ({"constant": "Af"}, "`constant` of Variant is 'Af', expected a set of a text"),
    "no members": ({"affine": None}, "`affine` of Variant is None, expected a mapping"),
    "other members": ({"entrywise": {"X"}}, "`entrywise` names 'X', expected members among A, f, B, g"),
    "no box": ({"parameters": [4.0, 8.0]}, "parameters in problem of Reduction is [4.0, 8.0], expected a"),
    "no outputs": ({"outputs": None}, "`outputs` of the problem is None, expected a sequence of an Output"),
    "two outputs": ({"outputs": [Output("x", "1", u=np.ones(12))] * 2}, "two outputs have the same name: x"),
    "floats": ({"contact_dofs": np.arange(3.0)}, "`contact_dofs` of the problem is array([0., 1., 2.]), expected"),
    "far": ({"contact_dofs": np.array([3, 12])}, "`contact_dofs` ranges from 3 to 12, expected unknowns from 0 to 11"),
    "falling": ({"contact_dofs": np.array([3, 2], np.uint8)}, "`contact_dofs` is not strictly increasing"),
    "too few": ({"contact_dofs": np.arange(3)}, "B touches 9 unknowns outside the declared contact_dofs"),
    "integrals": ({"multiplier_integrals": lambda _: -np.ones(12)}, "`multiplier_integrals` is -1 at entry 0"),
    "a pair": ({"contact": lambda s, mu: (s.mass, np.ones(12))}, "what `contact` returned has the type tuple"),
    "a writer": ({"contact": lambda s, mu: mu.fill(0.0)}, "ValueError: "),
    "one entry": ({"sampler": lambda s, w: lambda mu: {"f": np.ones(1)}}, "f of `sampler` has shape (1,), expected ("),
    "no entry": ({"sampler": lambda s, w: lambda mu: {}}, "f of `sampler` has the type NoneType, expected an array ("),
    "no sampler": ({"sampler": lambda s, w: None}, "TypeError: 'NoneType' object is not callable"),
    "a tuple": ({"assemble": lambda s, mu: (mu, mu)}, "`assemble` returned a tuple, expected a VariationalInequality"),
    "reasons": ({"refuse": lambda s, mu, u, lam: "a\nb"}, "at mu = [4.0]: a b"),
    "a thief": ({"refuse": lambda s, mu, u, lam: u.fill(0.0)}, "ValueError: "),
    "a start": ({"start": lambda s, mu, nearest: [True] * 12}, "start returns [True, True, True"),
    "far away": ({"validation_set": lambda s, n, seed: np.full((n, 1), 9.0)}, "has 'force' outside [4, 8]"),
}  # fmt: skip


@pytest.mark.parametrize("what", RETURNS)
def test_what_a_problem_returns_is_taken_or_named_in_a_line(what: str) -> None:
    members, words = RETURNS[what]
    declared = {"constant": frozenset({"A", "B", "g"}), "contact": Declared.contact, "entrywise": frozenset({"f"})}
    declared |= {"sampler": Declared.sampler, "contact_dofs": np.arange(12)}
    # Without `contact` the contact unknowns alone are a declaration.
    base = Wire if what == "too few" else type("Base", (Wire,), {"__module__": __name__, **declared})
    problem = variant(base, **members)
    with pytest.raises((NumericalError, RequestError), match=re.escape(words)) as caught:  # noqa: PT012
        Reduction(problem, None, None, None, None, assembly="reduced").snapshots  # noqa: B018
        validation_parameters(problem, 2, 0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", [None, "x", np.zeros(2), np.zeros((1, 1)), np.array([np.nan]), [5.0]])
def test_methods_of_a_plugin_refuse_wrong_arguments(given: Any) -> None:
    for call in (WIRE.assemble, WIRE.constraint, lambda mu: Declared().picture(mu, np.ones(12), np.ones(12))):
        with pytest.raises(RequestError, match="mu of "):
            call(given)


def test_decorators_that_an_author_puts_on_a_method_are_kept() -> None:
    calls = list[Array]()

    def counted(method: Callable[[Chain, Array], VariationalInequality]) -> Callable[..., VariationalInequality]:
        return wraps(method)(lambda self, mu: calls.append(mu) or method(self, mu))

    checked_assembly(type("Counted", (Chain,), {"assemble": counted(Chain.assemble)})(), MU)
    assert calls == [MU]


def test_what_is_true_is_confirmed_whatever_the_units_and_absent_rows() -> None:
    for problem in RIGHT:
        mu = middle(problem)
        vi = problem.assemble(mu)
        assert not [*contradictions(problem, mu, vi)]
        ReferenceAssembly(problem).refuse_false_declarations(mu, vi)
    absent = variant(Declared, contact=lambda self, mu: Contact(-self.mass, np.where(np.arange(12) == 3, np.inf, 0.0)))
    vi = absent.assemble(mu := middle(absent))
    said = [*contradictions(absent, mu, vi)]
    assert [one.split(",")[0] for one in said] == ["`contact`"]
    assert sp.issparse(vi.B)
