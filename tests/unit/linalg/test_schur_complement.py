import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying, spd

from vibench import HighFidelitySolver, NumericalError, VariationalInequality
from vibench.highfidelity import active_set
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.linalg.schur_complement import EliminationPattern, PrincipalSubmatrix, StaticCondensation


def sparse_spd(n: int, rng: np.random.Generator) -> sp.csc_array:
    """A sparse SPD matrix in which most unknowns couple to few others."""
    links = sp.random_array((n, n), density=1.0 / n, rng=rng)
    return sp.csc_array(links @ links.T + sp.eye_array(n))


@given(st.integers(0, 10_000), st.integers(0, 12))
def test_equilibrium_with_given_retained_unknowns(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    A, f = sparse_spd(12, rng), rng.standard_normal(12)
    retained = np.sort(rng.permutation(12)[:count])
    others = np.setdiff1d(np.arange(12), retained)
    condensed = StaticCondensation(A, EliminationPattern.of(A, retained))
    inner = np.linalg.inv((dense := A.toarray())[np.ix_(others, others)])
    taken = dense[np.ix_(retained, others)] @ inner
    schur = dense[np.ix_(retained, retained)] - taken @ dense[np.ix_(others, retained)]
    assert np.allclose(condensed.schur.toarray(), schur)
    load, particular = condensed.condense_load(f)
    assert np.allclose(load, f[retained] - taken @ f[others])
    assert np.allclose(condensed.condense_load(2.0 * f)[0], 2.0 * load)  # not that of the load before
    u = condensed.recover(u_retained := rng.standard_normal(count), particular)
    assert np.allclose(u[retained], u_retained)
    assert np.allclose((dense @ u - f)[others], 0.0, atol=1e-10)
    disturbed = u + rng.standard_normal(12) * np.isin(np.arange(12), others)
    corrected = disturbed + condensed.correct_eliminated(f - dense @ disturbed)
    assert np.array_equal(corrected[retained], disturbed[retained])
    assert np.allclose((dense @ corrected - f)[others], 0.0, atol=1e-10)


def test_retained_unknowns_alone_have_columns() -> None:
    A, retained = sparse_spd(12, np.random.default_rng(3)), np.array([2, 3, 7, 11])
    pattern, B = EliminationPattern.of(A, retained), np.zeros((3, 12))
    B[[0, 0, 2], [7, 2, 11]] = 1.0, 2.0, 3.0
    found = pattern.on_retained(given_rows := sp.csr_array(B))
    assert np.array_equal(found.toarray(), B[:, retained])
    found.data[:] = 0.0
    assert np.array_equal(given_rows.toarray(), B)
    B[1, 4] = 1.0
    with pytest.raises(NumericalError, match="touches unknowns that are to be eliminated"):
        pattern.on_retained(sp.csr_array(B))
    problem = Declaring(n=60)
    problem.first = 14
    with pytest.raises(NumericalError, match="B touches 1 unknowns outside the declared contact_dofs, the first is 13"):
        HighFidelitySolver(problem).solve(problem.training_set()[0])


@given(st.integers(0, 10_000), st.integers(0, 12))
def test_submatrices_follow_their_matrix_through_changes_of_its_sparsity(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(12)[:count]
    submatrix, A = PrincipalSubmatrix(chosen), sp.csr_array(sparse_spd(12, rng))
    unsorted = A[::-1][:, rng.permutation(12)]
    for matrix in (A, 2.0 * A, unsorted, A, sp.csr_array(sparse_spd(12, rng))):
        found = submatrix.of(matrix)
        assert np.array_equal(found.toarray(), matrix.toarray()[np.ix_(chosen, chosen)])
        found.data[:] = np.nan
        for used in (found, matrix):  # as libraries do
            used.sort_indices()


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_condensed_systems_have_the_solutions_of_the_whole_ones(seed: int, constrained: int) -> None:
    rng = np.random.default_rng(seed)
    A, retained = sparse_spd(14, rng), np.sort(rng.permutation(14)[:constrained])
    B = np.zeros((constrained, 14))
    B[:, retained] = np.triu(spd(constrained, rng))
    vi = VariationalInequality(A, rng.standard_normal(14), sp.csr_array(B), 0.2 * rng.random(constrained))
    whole = active_set.solve_high_fidelity(vi)
    stiffness = CondensedStiffness(A, EliminationPattern.of(A, retained))
    condensed = active_set.solve_high_fidelity(vi, stiffness, start=rng.random(constrained) > 0.5)
    assert np.allclose(condensed.u, whole.u, atol=1e-9)
    assert np.allclose(condensed.lam, whole.lam, atol=1e-9)


class Declaring(Varying):
    first = 8
    contact_dofs = property(lambda self: np.arange(self.first, 52))


@pytest.mark.parametrize("problem", [Declaring(n=60), Varying(n=60)], ids=["declared", "not declared"])
def test_successive_solves_give_the_solutions_of_single_ones(problem: Varying) -> None:
    solver, iterations = HighFidelitySolver(problem), []
    for mu in problem.training_set():
        found, alone = solver.solve(mu), active_set.solve_high_fidelity(problem.assemble(mu))
        assert np.allclose(found.u, alone.u, atol=1e-10)
        assert np.array_equal(found.lam > 0.0, alone.lam > 0.0)
        iterations.append((found.iterations, alone.iterations))
    warm, cold = np.sum(iterations[1:], axis=0)
    assert warm < cold
