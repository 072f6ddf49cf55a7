from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying, spd

from vibench.errors import NumericalError
from vibench.interfaces.affine import AffineSum
from vibench.interfaces.problem import MEMBERS, Contact, VariationalInequality
from vibench.model.affine import Evaluation, affine_decomposition, coefficients, decomposed, held_out_error

NEW = np.array([0.37])


class Counting(Varying):
    """Counts what is assembled; its constraint touches few unknowns."""

    def __init__(self, count: int = 7) -> None:
        super().__init__(count=count)
        self.assembled: list[float] = []
        self.contacts: list[float] = []

    def assemble(self, mu: np.ndarray) -> VariationalInequality:
        self.assembled.append(float(mu[0]))
        return super().assemble(mu)


class Touching(Counting):
    """Gives its constraint on the unknowns it touches."""

    contact_dofs = property(lambda self: np.arange(2, 28))

    def contact(self, mu: np.ndarray) -> Contact:
        self.contacts.append(float(mu[0]))
        vi = super().assemble(mu)
        self.assembled.pop()
        return Contact(vi.B[:, self.contact_dofs], vi.g)


class Summed(Varying):
    """A(mu) = Σ mu^q A_q and B(mu) = B_0 + max(0, mu − ½) B_1, zeros not stored, so that their patterns change."""

    entrywise = frozenset({"A", "B"})

    def __init__(self, seed: int = 0, powers: int = 3, count: int = 9) -> None:
        super().__init__(12, 5, count)
        rng = np.random.default_rng(seed)
        self.powers = [
            spd(12, rng) * (abs(np.subtract.outer(np.arange(12), np.arange(12))) <= q) for q in range(powers)
        ]
        halves = rng.random((5, 12)) < 0.5
        self.constraints = [rng.random((5, 12)) * halves, rng.random((5, 12)) * ~halves]

    def assemble(self, mu: np.ndarray) -> VariationalInequality:
        vi = super().assemble(mu)
        A = sum(mu[0] ** q * term for q, term in enumerate(self.powers))
        B = self.constraints[0] + max(0.0, mu[0] - 0.5) * self.constraints[1]
        return VariationalInequality(sp.csr_array(A), vi.f, sp.csr_array(B), vi.g)


def declaring(base: type[Varying], **declarations: frozenset[str]) -> type[Varying]:
    """A problem class that declares more."""
    return type("Declaring", (base,), declarations)


def dense(member: object) -> np.ndarray:
    return member if isinstance(member, np.ndarray) else member.toarray()  # type: ignore[attr-defined]


def rebuilt(member, value) -> np.ndarray:
    """Σ θ_q · terms_q with θ_q the entries of a member that is known."""
    value = dense(value)
    sampled = value[member.rows] if value.ndim == 1 else value[member.rows, member.columns]
    return sum(theta * dense(term) for theta, term in zip(sampled, member.terms, strict=True))


def test_what_is_declared_constant_is_assembled_once_and_believed() -> None:
    problem = declaring(Counting, constant=frozenset(MEMBERS))()
    training = problem.training_set()
    members = affine_decomposition(problem, training, 1e-8)
    assert problem.assembled == [training[0, 0]]
    first = Varying().assemble(training[0])
    for name in MEMBERS:  # although they do vary
        assert members[name].way is Evaluation.CONSTANT
        assert np.array_equal(dense(members[name].terms[0]), dense(getattr(first, name)))
        assert len(members[name].rows) == 0
    # where only the constraint varies nothing else is assembled
    problem = declaring(Touching, constant=frozenset({"A", "f"}))()
    members = affine_decomposition(problem, training, 1e-8)
    assert problem.assembled == [training[0, 0]]
    assert problem.contacts == training.ravel().tolist()
    ways = [Evaluation.CONSTANT, Evaluation.CONSTANT, Evaluation.CONTACT, Evaluation.CONTACT]
    assert [(name, member.way) for name, member in members.items()] == [*zip("AfBg", ways, strict=True)]


def test_members_that_do_not_vary_are_found_whatever_is_declared() -> None:
    class Trembling(Varying):
        def assemble(self, mu: np.ndarray) -> VariationalInequality:
            vi = super().assemble(mu)
            return VariationalInequality(vi.A, vi.f * (1.0 + 1e-11 * mu[0]), vi.B, vi.g)

    for base in (Varying, declaring(Varying, entrywise=frozenset({"f"}))):
        member = affine_decomposition(base(), base().training_set(), 1e-8)["f"]
        assert member.way is Evaluation.CONSTANT
        assert np.array_equal(member.terms[0], Varying().assemble(NEW).f)
        assert member.error == 0.0
    assert affine_decomposition(Trembling(), Trembling().training_set(), 1e-8)["f"].way is Evaluation.FULL


def test_by_a_factor_is_one_term() -> None:
    problem = declaring(Varying, entrywise=frozenset({"A"}))()
    member = affine_decomposition(problem, problem.training_set(), 1e-12)["A"]
    assert member.way is Evaluation.INTERPOLATED
    assert len(member.terms) == len(member.rows) == len(member.columns) == 1
    A = problem.assemble(NEW).A
    assert np.allclose(rebuilt(member, A), A.toarray(), rtol=1e-12)


@given(st.integers(0, 10_000), st.integers(2, 4))
def test_sums_of_few_terms_are_rebuilt_in_full(seed: int, powers: int) -> None:
    """A symmetric matrix, and an asymmetric constraint whose pattern changes."""
    problem = Summed(seed, powers)
    training = problem.training_set()
    assert len({problem.assemble(mu).B.nnz for mu in training}) == 2
    members = affine_decomposition(problem, training, 1e-12)
    for name, count in (("A", powers), ("B", 2)):
        assert members[name].way is Evaluation.INTERPOLATED
        assert len(members[name].terms) == count
    assert np.all(members["A"].rows <= members["A"].columns)
    for term in members["A"].terms:
        assert np.array_equal(dense(term), dense(term).T)
    for mu in (NEW, np.array([0.5]), np.array([0.93])):
        vi = problem.assemble(mu)
        assert np.allclose(rebuilt(members["A"], vi.A), vi.A.toarray(), atol=1e-9 * np.abs(vi.A).max())
        assert np.allclose(rebuilt(members["B"], vi.B), vi.B.toarray(), atol=1e-13)


def test_patterns_of_equal_size_in_different_places_are_told_apart() -> None:
    class Moving(Varying):
        entrywise = frozenset({"B"})

        def assemble(self, mu: np.ndarray) -> VariationalInequality:
            vi = super().assemble(mu)
            row = np.arange(self._m)
            B = sp.csr_array((np.full(self._m, 2.0), (row, row + (3 if mu[0] > 0.5 else 0))), shape=vi.B.shape)
            return VariationalInequality(vi.A, vi.f, B, vi.g)

    problem = Moving()
    member = affine_decomposition(problem, problem.training_set(), 1e-12)["B"]
    assert len(member.terms) == 2
    for mu in problem.training_set():
        B = problem.assemble(mu).B
        assert np.allclose(rebuilt(member, B), B.toarray(), atol=1e-14)


def test_vectors_are_interpolated_and_meet_the_tolerance() -> None:
    problem = declaring(Varying, entrywise=frozenset({"g"}))()
    for tolerance in (1e-1, 1e-2):
        member = affine_decomposition(problem, problem.training_set(), tolerance)["g"]
        assert member.way is Evaluation.INTERPOLATED
        assert not member.columns.any()
        values = [problem.assemble(mu).g for mu in problem.training_set()]
        rows = np.abs(np.array(values)).max(axis=0)  # every row relative to itself
        errors = [np.linalg.norm((rebuilt(member, g) - g) / rows) for g in values]
        assert np.isclose(member.error, max(errors) / max(np.linalg.norm(g / rows) for g in values), rtol=1e-6)
        assert 0.0 < member.error <= tolerance


def test_a_constraint_with_contact_is_left_to_it_unless_it_is_constant_or_interpolated() -> None:
    members = affine_decomposition(Touching(), Touching().training_set(), 1e-8)
    assert (members["B"].way, members["g"].way) == (Evaluation.CONTACT, Evaluation.CONTACT)
    assert members["B"].terms == members["g"].terms == ()
    assert members["B"].reason == ""
    assert members["A"].way is Evaluation.FULL  # contact says nothing of A
    assert members["f"].way is Evaluation.CONSTANT
    for declared, way in (
        ({"entrywise": frozenset({"g"})}, Evaluation.INTERPOLATED),
        ({"constant": frozenset({"A", "f", "g"})}, Evaluation.CONSTANT),
    ):
        problem = declaring(Touching, **declared)()
        members = affine_decomposition(problem, problem.training_set(), 1e-2)
        assert (members["B"].way, members["g"].way) == (Evaluation.CONTACT, way)


def test_what_cannot_be_evaluated_apart_is_assembled_in_full_and_the_reason_names_it() -> None:
    class Vague(Touching):
        """Does not say which unknowns it touches."""

        contact_dofs = None

    for problem, name in ((Varying(), "A"), (Varying(), "B"), (Varying(), "g"), (Vague(), "B")):
        member = affine_decomposition(problem, problem.training_set(), 1e-8)[name]
        assert member.way is Evaluation.FULL
        assert member.reason == f"{name} depends on mu and the problem does not evaluate it entry by entry"
        assert member.terms == ()


def test_members_that_interpolation_does_not_compress_are_not_interpolated() -> None:
    """It may take three quarters of the training parameters."""
    problem = declaring(Counting, entrywise=frozenset({"B"}))()
    member = affine_decomposition(problem, problem.training_set(), 1e-10)["B"]
    assert member.way is Evaluation.FULL
    assert member.reason == "B depends on mu, and interpolation needs 7 terms for 7 parameters"
    touching = declaring(Touching, entrywise=frozenset({"B"}))()
    assert affine_decomposition(touching, touching.training_set(), 1e-10)["B"].way is Evaluation.CONTACT
    assert affine_decomposition(problem, problem.training_set(), 0.3)["B"].way is Evaluation.INTERPOLATED
    for powers, way in ((3, Evaluation.INTERPOLATED), (4, Evaluation.FULL)):
        summed = Summed(powers=powers, count=4)
        assert affine_decomposition(summed, summed.training_set(), 1e-11)["A"].way is way


@pytest.mark.parametrize("kind", [sp.csr_array, sp.csr_matrix, sp.coo_matrix])
@pytest.mark.parametrize("name", ["A", "B"])
def test_errors_outside_the_training_set_are_measured_whatever_the_kind_of_matrix(name: str, kind: type) -> None:
    problem = Summed()
    values, V = [kind(getattr(problem.assemble(mu), name)) for mu in problem.training_set()], problem.V
    member = decomposed(name, values, V, 1e-10)
    new = [kind(getattr(problem.assemble(mu), name)) for mu in (np.array([0.33]), np.array([0.77]))]
    assert held_out_error(name, member, new, V) < 1e-9
    bumped = [
        kind(matrix + 1e-3 * matrix.multiply(np.arange(matrix.shape[1]) == 3)) for matrix in map(sp.csr_array, new)
    ]
    assert 1e-5 < held_out_error(name, member, bumped, V) < 1e-2


def test_a_function_of_several_members_is_evaluated_once() -> None:
    asked: list[float] = []

    def shared(mu: np.ndarray) -> list[float]:
        asked.append(float(mu[0]))
        return [1.0 + mu[0]]

    problem = Varying()
    matrix, vector = sp.csr_array(np.ones((2, 3))), np.ones(3)
    problem.affine = {
        "B": AffineSum((matrix,), shared),
        "g": AffineSum((vector,), shared),
        "f": AffineSum((vector,), lambda mu: [2.0 * mu[0]]),
    }
    found = coefficients(problem, {}, ("B", "g", "f"))(np.array([3.0]))
    assert {name: theta.tolist() for name, theta in found.items()} == {"B": [4.0], "g": [4.0], "f": [6.0]}
    assert asked == [3.0]


def test_an_assembly_that_is_not_finite_is_refused() -> None:
    class Broken(Varying):
        def assemble(self, mu: np.ndarray) -> VariationalInequality:
            vi = super().assemble(mu)
            return VariationalInequality(vi.A, vi.f * (np.nan if mu[0] > 0.5 else 1.0), vi.B, vi.g)

    with pytest.raises(NumericalError, match=r"f has entries that are not finite at mu = \[0\.66"):
        affine_decomposition(Broken(), Broken().training_set(), 1e-8)
