from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying, spd

from vibench import MEMBERS, AffineSum, Contact, NumericalError, VariationalInequality
from vibench.model.affine import Evaluation, affine_decomposition, coefficients, decomposed, held_out_error, interpolate

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
        apart = abs(np.subtract.outer(np.arange(12), np.arange(12)))
        self.powers = [spd(12, rng) * (apart <= q) for q in range(powers)]
        halves = rng.random((5, 12)) < 0.5
        self.constraints = [rng.random((5, 12)) * halves, rng.random((5, 12)) * ~halves]

    def assemble(self, mu: np.ndarray) -> VariationalInequality:
        vi = super().assemble(mu)
        A = sum(mu[0] ** q * term for q, term in enumerate(self.powers))
        B = self.constraints[0] + max(0.0, mu[0] - 0.5) * self.constraints[1]
        return VariationalInequality(sp.csr_array(A), vi.f, sp.csr_array(B), vi.g)


def declaring(base: type[Varying], **declarations: frozenset[str]) -> type[Varying]:
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
            return replace(vi, f=vi.f * (1.0 + 1e-11 * mu[0]))

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
    # contact says nothing of A
    ways = {"A": Evaluation.FULL, "f": Evaluation.CONSTANT, "B": Evaluation.CONTACT, "g": Evaluation.CONTACT}
    assert {name: member.way for name, member in members.items()} == ways
    assert members["B"].terms == members["g"].terms == ()
    assert members["B"].reason == ""
    for how, declared, way in (("entrywise", "g", Evaluation.INTERPOLATED), ("constant", "Afg", Evaluation.CONSTANT)):
        problem = declaring(Touching, **{how: frozenset(declared)})()
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
    bumped = [kind(one + 1e-3 * one.multiply(np.arange(one.shape[1]) == 3)) for one in map(sp.csr_array, new)]
    assert 1e-5 < held_out_error(name, member, bumped, V) < 1e-2


def test_a_function_of_several_members_is_evaluated_once() -> None:
    shared = Mock(side_effect=lambda mu: [1.0 + mu[0]])
    problem, vector = Varying(), (np.ones(3),)
    problem.affine = {"B": AffineSum((sp.csr_array(np.ones((2, 3))),), shared), "g": AffineSum(vector, shared)}
    problem.affine["f"] = AffineSum(vector, lambda mu: [2.0 * mu[0]])
    found = coefficients(problem, {}, ("B", "g", "f"))(np.array([3.0]))
    assert {name: theta.tolist() for name, theta in found.items()} == {"B": [4.0], "g": [4.0], "f": [6.0]}
    assert shared.call_count == 1


def test_an_assembly_that_is_not_finite_is_refused() -> None:
    class Broken(Varying):
        def assemble(self, mu: np.ndarray) -> VariationalInequality:
            vi = super().assemble(mu)
            return replace(vi, f=vi.f * (np.nan if mu[0] > 0.5 else 1.0))

    with pytest.raises(NumericalError, match=r"f has entries that are not finite at mu = \[0\.66"):
        affine_decomposition(Broken(), Broken().training_set(), 1e-8)


seeds = st.integers(0, 10_000)
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)


def of_rank(rank: int, seed: int, size: int = 30, count: int = 9) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((size, rank)) @ rng.standard_normal((rank, count))


def family(seed: int, size: int = 40, count: int = 20) -> np.ndarray:
    """Vectors (size×count) that depend on a parameter smoothly, a bump that moves."""
    start = np.random.default_rng(seed).random()
    x, mu = np.linspace(0.0, 1.0, size), np.linspace(start, start + 0.4, count)
    return 3.0 / (1.0 + 20.0 * (x[:, None] - mu) ** 2)


def largest_error(snapshots: np.ndarray, points: np.ndarray, modes: np.ndarray) -> float:
    rebuilt = [sum(v[p] * mode for p, mode in zip(points, modes.T, strict=True)) for v in snapshots.T]
    errors = [np.linalg.norm(v - w) for v, w in zip(snapshots.T, rebuilt, strict=True)]
    return float(max(errors) / max(np.linalg.norm(v) for v in snapshots.T))


@given(seeds, st.integers(1, 7), st.integers(1, 20))
def test_every_mode_is_one_at_its_own_point_and_zero_at_the_others(seed: int, size: int, count: int) -> None:
    snapshots = np.random.default_rng(seed).standard_normal((size, count))
    found = interpolate(snapshots, 1e-12)
    assert np.all(np.diff(found.points) > 0)
    assert found.modes.shape == (size, len(found.points))
    assert np.allclose(found.modes[found.points], np.eye(len(found.points)), atol=1e-9)


@given(seeds, st.integers(1, 6))
def test_in_a_space_of_few_dimensions_as_many_entries_tell_every_vector(seed: int, rank: int) -> None:
    known = of_rank(rank, seed)
    found = interpolate(known, 1e-10)
    assert len(found.points) == rank
    new = known @ np.random.default_rng(seed + 1).standard_normal(known.shape[1])
    assert np.allclose(found.modes @ new[found.points], new, atol=1e-8 * np.abs(new).max())


@given(seeds, st.floats(1e-9, 0.9))
def test_training_vectors_are_met_to_the_tolerance_and_the_error_is_what_it_says(seed: int, tolerance: float) -> None:
    snapshots = family(seed)
    found = interpolate(snapshots, tolerance)
    assert found.error <= tolerance
    assert np.isclose(found.error, largest_error(snapshots, found.points, found.modes), rtol=1e-3, atol=1e-14)


@given(seeds)
def test_tighter_tolerances_take_more_terms_and_none_while_the_tail_of_the_singular_values_is_small(seed: int) -> None:
    snapshots = family(seed)
    sigma = np.linalg.svd(snapshots, compute_uv=False) / np.linalg.norm(snapshots, axis=0).max()
    counts = [len(interpolate(snapshots, tolerance).points) for tolerance in TOLERANCES]
    assert np.all(np.diff(counts) >= 0)
    assert counts[-1] > counts[0]
    for tolerance, count in zip(TOLERANCES, counts, strict=True):
        assert np.linalg.norm(sigma[count - 1 :]) > tolerance


def test_a_term_is_added_where_few_terms_approximate_well_enough_but_do_not_interpolate_so() -> None:
    """(1.1, 1, …, 1) ± 0.1 in the entry that is sampled: projection errs by 0.05, interpolation from it by 0.09."""
    middle, change = np.append(1.1, np.ones(8)), np.append(0.1, np.zeros(8))
    tiny = 1e-3 * np.eye(9)[5]
    snapshots = np.column_stack([middle + change, middle - change, middle + tiny])
    assert np.sqrt(2.0) * 0.1 < 0.06 * np.linalg.norm(snapshots, axis=0).max()
    one, two = interpolate(snapshots, 0.1), interpolate(snapshots, 0.06)
    assert (len(one.points), len(two.points)) == (1, 2)
    assert 0.06 < one.error < 0.1
    assert 1e-5 < two.error < 1e-3


@pytest.mark.parametrize("rank", [1, 3, 6])
def test_a_tolerance_nobody_can_reach_ends_with_all_there_is(rank: int) -> None:
    known = of_rank(rank, seed=rank)
    found = interpolate(known, 0.0)
    assert rank <= len(found.points) <= known.shape[1]
    assert 0.0 < found.error < 1e-12


def test_errors_are_relative_to_the_longest_vector_and_zeros_do_no_harm() -> None:
    snapshots = np.diag([1e6, 1.0, 0.0])
    loose = interpolate(snapshots, 2e-6)
    assert (loose.points.tolist(), loose.error) == ([0], pytest.approx(1e-6))
    assert len(interpolate(snapshots, 0.5e-6).points) == 2
    rng = np.random.default_rng(0)
    shape = rng.standard_normal(15)
    found = interpolate(np.outer(shape, np.append(rng.uniform(-10.0, 10.0, 6), 0.0)), 1e-12)
    assert found.points.tolist() == [np.argmax(np.abs(shape))]  # proportional vectors need one term, the largest
    assert np.allclose(found.modes[:, 0], shape / shape[found.points[0]])
