import pickle
import sys
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from itertools import product
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import Varying

from vibench import AffineSum, HighFidelitySolver, NumericalError, Status, checked_assembly, solve_qp, supremizers
from vibench.interfaces.problem import MEMBERS, Contact, Problem, VariationalInequality
from vibench.interfaces.strategies import Enrichment, Kind
from vibench.linalg import singular_values
from vibench.model.affine import Evaluation, affine_decomposition
from vibench.model.galerkin import ReducedModel, project
from vibench.model.hyperreduced import HyperReducedModel, hyper_reduce, reason_for_full_assembly
from vibench.qp import verification
from vibench.stability import cone_basis
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle

KINDS = ("none", "fixed", "per-parameter")
WAYS = ("constant", "one", "several", "contact")
NEW = (np.array([0.13]), np.array([0.58]), np.array([0.97]))


class Rope(Varying):
    """A string whose members depend on mu in the ways asked for; every entry can be asked for.

    `constraint` says how B does: not at all, by a factor, in three terms, or by hats that move, given on the unknowns
    that they touch. A has one term or two, f two.
    """

    def __init__(self, constraint: str, stiffness: str = "several", n: int = 30, m: int = 8) -> None:
        super().__init__(n, m, 9)
        self.way, self.x = constraint, np.linspace(0.0, 1.0, n + 2)[1:-1]
        self.entrywise = frozenset({"A", "f"} if constraint == "contact" else MEMBERS)
        self._terms = {
            "A": [self._laplacian, 30.0 * sp.csr_array(sp.diags_array(1.0 + self.x))],
            "f": [-8.0 / (n + 1) * np.ones(n), -self.x],
            "B": [super(Rope, self).assemble(np.array([mu])).B for mu in (0.0, 0.4, 0.8)],
            "g": [0.05 * np.ones(m), 0.02 * np.arange(m)],
        }
        if stiffness == "constant":
            self._terms["A"].pop()
        self._terms["B"] = self._terms["B"][: 3 if constraint == "several" else 1]

    def factors(self, name: str, t: float) -> list[float]:
        found = {"f": [1.0, t], "g": [1.0, t], "A": [1.0, t**2], "B": [1.0, t, np.sin(3.0 * t)]}[name]
        return [1.0 + t**2] if name == "B" and self.way == "one" else found[: len(self._terms[name])]

    def assemble(self, mu: np.ndarray) -> VariationalInequality:
        t = float(mu[0])
        found = {
            name: sum(c * term for c, term in zip(self.factors(name, t), terms, strict=True))
            for name, terms in self._terms.items()
        }
        if self.way == "contact":
            vi = super().assemble(mu)
            found |= {"B": vi.B, "g": vi.g}
        return VariationalInequality(**found)

    @property
    def contact_dofs(self) -> np.ndarray | None:
        """Those within reach of hats that stay within 0.1 of where they are at mu = 0."""
        return np.flatnonzero(np.abs(self.x - 0.5) < 0.35 + 3.0 / (self._n + 1)) if self.way == "contact" else None

    def contact(self, mu: np.ndarray) -> Contact | None:
        vi = super().assemble(mu)
        return Contact(vi.B[:, self.contact_dofs], vi.g) if self.way == "contact" else None

    def sampler(self, wanted: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Callable[[np.ndarray], dict[str, Any]]:
        def at(term: Any, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
            return term[rows] if term.ndim == 1 else np.asarray(term[rows, columns]).ravel()

        entries = {name: np.array([at(term, *places) for term in self._terms[name]]) for name, places in wanted.items()}
        return lambda mu: {name: self.factors(name, float(mu[0])) @ terms for name, terms in entries.items()}


@cache
def rope(constraint: str, stiffness: str = "several") -> Rope:
    return Rope(constraint, stiffness)


@cache
def solutions(problem: Problem, mus: tuple[tuple[float, ...], ...]) -> tuple[np.ndarray, np.ndarray]:
    """U (n×P) and λ (m×P) at some parameters, the same for all kinds and sizes of reduced models."""
    solver = HighFidelitySolver(problem)
    found = [solver.solve(np.array(mu)) for mu in mus]
    both = np.column_stack([s.u for s in found]), np.column_stack([s.lam for s in found])
    for shared in both:
        shared.setflags(write=False)
    return both


@cache
def separation(problem: Problem) -> Mapping[str, Any]:
    return affine_decomposition(problem, problem.training_set(), 1e-11)


def reduced_model(
    problem: Problem, kind: str, modes: int = 3, generators: int = 2, mus: np.ndarray | None = None
) -> ReducedModel:
    """A reduced model from some solutions; the fixed enrichment is the supremizers at the first parameter."""
    mus = problem.training_set()[:5] if mus is None else mus
    u, lam = solutions(problem, tuple(map(tuple, mus.tolist())))
    lam = lam[:, lam.any(axis=0)][:, :generators]
    cone = cone_basis(lam / problem.W.norm(lam), problem.W)
    basis = problem.V.orthonormalise(u)[:, :modes]
    if kind == "none":
        enrichment = Enrichment(Kind.NONE)
    elif kind == "fixed":
        first = supremizers(problem.V, problem.assemble(mus[0]).B, cone.span)
        enrichment = Enrichment(Kind.FIXED, vectors=problem.V.orthonormalise(first, basis))
    else:
        enrichment = Enrichment(Kind.PER_PARAMETER, eta=cone.span)
    return ReducedModel(problem, basis, enrichment, cone.chi, cone.span)


def online(model: ReducedModel, members: Mapping[str, Any] | None = None) -> HyperReducedModel:
    members = members or separation(model.problem)
    assert reason_for_full_assembly(model, members) == ""
    return HyperReducedModel(model, hyper_reduce(model, members))


def assert_same_programs(
    model: ReducedModel, reduced: HyperReducedModel, accuracy: float = 1e-9, mus: Sequence[np.ndarray] = NEW
) -> None:
    """The program is that of the full assembly, projected on the same basis; the basis is as good.

    So are programs assembled with others. Their bases may be rotated, since round-off decides between equal pivots.
    """
    V, first = model.problem.V, model.fixed_basis
    for mu in mus:
        vi = checked_assembly(model.problem, mu)
        own, together = model.primal_basis(vi), reduced.assemble_all(np.array([mu, model.problem.parameters.lower, mu]))
        for found in (reduced.assemble(mu), *together[::2]):
            Z, exact = found.basis, project(vi, found.basis, model.generators)
            assert Z.shape == own.shape
            assert np.allclose(V.gram(Z, Z), np.eye(Z.shape[1]), atol=1e-10)
            assert np.allclose(Z[:, : first.shape[1]], first, atol=1e-10)
            assert np.allclose(singular_values(V.gram(Z, own)), 1.0, atol=max(1e-9, 10.0 * accuracy))
            for name in MEMBERS:
                one, other = getattr(found.program, name), getattr(exact, name)
                assert one.shape == other.shape
                assert np.linalg.norm(one - other) <= accuracy * np.linalg.norm(other), name
            assert np.array_equal(found.program.A, found.program.A.T)


SIZES = [("constant", 3, 2), ("several", 3, 2), ("constant", 3, 0), ("constant", 0, 2), ("constant", 0, 0)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("constraint", WAYS)
@pytest.mark.parametrize(("stiffness", "modes", "generators"), SIZES)
def test_programs_are_fully_assembled_ones(
    constraint: str, stiffness: str, modes: int, generators: int, kind: str
) -> None:
    """Also without modes or without generators."""
    model = reduced_model(rope(constraint, stiffness), kind, modes, generators)
    reduced, terms = online(model), {"constant": 1, "one": 1, "several": 3, "contact": 0}
    members = separation(model.problem)
    assert [len(members[name].terms) for name in "AB"] == [1 + (stiffness == "several"), terms[constraint]]
    assert_same_programs(model, reduced)
    query = reduced.assemble(NEW[0])
    answer = solve_qp(query.program, "piqp", 1e-10, factor=query.factor)
    assert verification.verify(query.program, answer, 1e-8)[0] is Status.OK


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("constraint", ["constant", "one", "several"])
@pytest.mark.parametrize("declared", ["ABfg", "Ag", "B"])
def test_declared_terms_give_the_program_up_to_round_off(constraint: str, kind: str, declared: str) -> None:
    problem = Rope(constraint)
    problem.affine = {
        name: AffineSum(tuple(problem._terms[name]), lambda mu, name=name: problem.factors(name, float(mu[0])))
        for name in declared
    }
    members = separation(problem)
    assert {name for name in MEMBERS if members[name].way is Evaluation.AFFINE} == set(declared)
    model = reduced_model(problem, kind)
    assert_same_programs(model, online(model), 1e-13 if declared == "ABfg" else 1e-9)


class Mixed(Rope):
    """Gives a constraint of three terms on the contact, too."""

    contact_dofs = property(lambda self: np.unique(sum(abs(term) for term in self._terms["B"]).indices))

    def contact(self, mu: np.ndarray) -> Contact:
        vi = self.assemble(mu)
        return Contact(vi.B[:, self.contact_dofs], vi.g)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("entrywise", "on_contact"), [("AfB", "g"), ("Afg", "B"), ("Af", "Bg"), ("AfBg", "")])
def test_members_on_the_contact_and_interpolated_ones_go_together(entrywise: str, on_contact: str, kind: str) -> None:
    problem = Mixed("several")
    problem.entrywise = frozenset(entrywise)
    members = separation(problem)
    assert {name for name in MEMBERS if members[name].way is Evaluation.CONTACT} == set(on_contact)
    model = reduced_model(problem, kind)
    assert_same_programs(model, online(model))


@given(st.integers(14, 40), st.integers(3, 9), st.integers(1, 5), st.integers(1, 5), st.sampled_from(WAYS))
@settings(max_examples=15)
def test_spaces_that_depend_on_mu_have_the_programs(
    n: int, m: int, modes: int, generators: int, constraint: str
) -> None:
    """Where supremizers of several terms are as many as unknowns, too."""
    model = reduced_model(Rope(constraint, n=n, m=m), "per-parameter", modes, generators, np.linspace(0, 1, 5)[:, None])
    assert_same_programs(model, online(model), 1e-8, NEW[:2])


def test_a_loose_tolerance_gives_a_program_that_is_as_inexact() -> None:
    problem = rope("several")
    model, members = reduced_model(problem, "none"), affine_decomposition(problem, problem.training_set(), 0.2)
    assert members["B"].error > 1e-3
    reduced, mu = online(model, members), NEW[0]
    exact = model.assemble(mu).program.B
    assert 1e-3 < np.linalg.norm(reduced.assemble(mu).program.B - exact) / np.linalg.norm(exact) < 0.5


def test_operators_travel() -> None:
    """Pickled ones give the same programs, and their factor is still that of A."""
    for constraint, kind in product(WAYS, KINDS):
        model = reduced_model(rope(constraint, "constant"), kind)
        operators = hyper_reduce(model, separation(model.problem))
        here, there = (HyperReducedModel(model, each) for each in (operators, pickle.loads(pickle.dumps(operators))))
        one, other = here.assemble(NEW[0]), there.assemble(NEW[0])
        assert all(np.array_equal(getattr(one.program, name), getattr(other.program, name)) for name in MEMBERS)
        assert np.allclose(one.basis, other.basis, atol=1e-12)
        if other.factor is not None:
            assert np.allclose(other.factor @ other.factor.T, other.program.A, rtol=1e-12)


@pytest.mark.parametrize(
    ("stiffness", "constraint", "kind", "modes", "dual"),
    [
        ("constant", "contact", "none", 4, True),
        ("constant", "contact", "none", 2, False),  # fewer unknowns than generators
        ("constant", "contact", "fixed", 2, True),
        ("constant", "one", "per-parameter", 2, True),  # one space of supremizers: it does not vary
        ("constant", "contact", "per-parameter", 4, False),
        ("constant", "several", "per-parameter", 4, False),
        ("several", "contact", "none", 4, False),
    ],
)
def test_constant_stiffness_gives_a_factor(stiffness: str, constraint: str, kind: str, modes: int, dual: bool) -> None:
    query = online(reduced_model(rope(constraint, stiffness), kind, modes, 3)).assemble(NEW[1])
    assert (query.factor is not None) == dual
    primal = solve_qp(query.program, "piqp", 1e-10)
    given = solve_qp(query.program, "piqp", 1e-10, factor=query.factor)
    assert verification.verify(query.program, given, 1e-8)[0] is Status.OK
    assert np.allclose(given.x, primal.x, atol=1e-7 * np.abs(primal.x).max())
    assert np.allclose(query.program.B.T @ given.alpha, query.program.B.T @ primal.alpha, atol=1e-6)


def test_what_stands_in_the_way_of_reduction_is_said() -> None:
    problem = Varying()
    members = affine_decomposition(problem, problem.training_set(), 1e-8)
    model = reduced_model(problem, "none", mus=problem.training_set())
    assert [reason.split()[0] for reason in reason_for_full_assembly(model, members).split("; ")] == ["A", "B", "g"]
    own = Enrichment(Kind.PER_PARAMETER, supply=lambda V, vi, span: supremizers(V, vi.B, span))
    roaming = ReducedModel(Rope("one"), model.fixed_basis, own, model.generators, model.span)
    fine = affine_decomposition(Rope("one"), problem.training_set(), 1e-8)
    assert reason_for_full_assembly(roaming, fine) == "the enrichment computes its own vectors at every mu"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("constraint", "member"), [("several", name) for name in MEMBERS] + [("contact", "contact"), ("contact", "A")]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.filterwarnings("ignore:invalid value encountered")
def test_values_that_are_not_finite_are_refused(
    monkeypatch: pytest.MonkeyPatch, constraint: str, member: str, kind: str, value: float
) -> None:
    problem = rope(constraint)
    reduced = online(reduced_model(problem, kind))
    sampler, contact = problem.sampler, problem.contact

    def spoiled(wanted):
        sample = sampler(wanted)
        factor = -value if member == "g" else value  # an infinite g constrains nothing, unless it is −∞
        return lambda mu: {name: found * (factor if name == member else 1.0) for name, found in sample(mu).items()}

    monkeypatch.setattr(problem, "sampler", spoiled)
    if member == "contact":
        monkeypatch.setattr(problem, "contact", lambda mu: Contact(contact(mu).B * value, contact(mu).g))
    with pytest.raises(NumericalError, match=r"not finite at mu = \[0\.58\]"):
        reduced.assemble(NEW[1])


@pytest.mark.parametrize(
    ("made", "ways"),
    [(Obstacle, ["INTERPOLATED", "INTERPOLATED", "AFFINE", "AFFINE"]), (Hertz, 2 * ["CONSTANT"] + 2 * ["CONTACT"])],
)
def test_reduced_queries_of_real_problems_are_as_good_as_full_ones(made: type[Problem], ways: list[str]) -> None:
    problem = made(300)
    training, solver, mus = problem.training_set(), HighFidelitySolver(problem), problem.validation_set(4, 5)
    members = affine_decomposition(problem, training, 1e-6)
    assert [members[member].way.name for member in MEMBERS] == ways
    exact, some = [solver.solve(mu) for mu in mus], training[np.linspace(0, len(training) - 1, 6).astype(int)]
    for kind in KINDS:
        model = reduced_model(problem, kind, 5, 4, some)
        reduced = online(model, members)
        assert_same_programs(model, reduced, 1e-5, mus)
        for mu, right in zip(mus, exact, strict=True):
            errors = []
            for query in (reduced.assemble(mu), model.assemble(mu)):
                answer = solve_qp(query.program, "piqp", 1e-9, factor=query.factor)
                assert verification.verify(query.program, answer, 1e-8)[0] is Status.OK
                u, lam = query.basis @ answer.x, model.generators @ answer.alpha
                errors.append([float(problem.V.norm(u - right.u)), float(problem.W.norm(lam - right.lam))])
            assert np.allclose(errors[0], errors[1], rtol=0.01)


def largest_step(work: Callable[[], object]) -> tuple[int, str]:
    """Largest memory in bytes that one line adds, and where; calls of Python are lines of their own."""
    largest, last, place = (0, ""), 0, ""

    def trace(frame: Any, event: str, _: object) -> Any:
        nonlocal largest, last, place
        _, peak = tracemalloc.get_traced_memory()
        largest = max(largest, (peak - last, place))
        tracemalloc.reset_peak()
        last, place = tracemalloc.get_traced_memory()[0], f"{frame.f_code.co_filename}:{frame.f_lineno}"
        return trace

    before = sys.gettrace()
    tracemalloc.start()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
        tracemalloc.stop()
    return largest


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["obstacle", "hertz", "rope"])
def test_a_query_makes_no_array_of_mesh_size(name: str, kind: str) -> None:
    """On meshes so large that their vectors stand out."""
    of = {"obstacle": (Obstacle, 1000, 5), "hertz": (Hertz, "coarse", 5), "rope": (partial(Rope, n=3000), "several", 1)}
    made, option, every = of[name]
    problem = made(option)
    training, generators = problem.training_set(), 2 if name == "hertz" else 4
    members = affine_decomposition(problem, training[::every], 1e-2)
    model = reduced_model(problem, kind, 4, generators, training[np.linspace(0, len(training) - 1, 5).astype(int)])
    reduced, mu = online(model, members), problem.validation_set(1, 0)[0]
    reduced.assemble(mu)  # what is set up once is set up
    found = largest_step(lambda: reduced.assemble(mu))
    assert 0 < found[0] < 8 * problem.V.dim, found
    assert largest_step(lambda: model.assemble(mu))[0] > 8 * problem.V.dim  # the instrument sees arrays of mesh size
