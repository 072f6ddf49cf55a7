from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from numerics import Varying, space, spd

from vibench.errors import NumericalError
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.linalg.schur_complement import EliminationPattern
from vibench.stability import coercivity
from vibench.stability.coercivity import MARGINS, Constant, energy_inf_sup
from vibench.stability.contact_infsup import SchurFromAbove


def condensed(A: sp.csc_array, retained: np.ndarray) -> tuple[SchurFromAbove, CondensedStiffness]:
    stiffness = CondensedStiffness(A, EliminationPattern.of(A, retained))
    return SchurFromAbove(A, stiffness.eliminated, stiffness.retained), stiffness


@pytest.mark.parametrize("seed", range(4))
def test_the_factor_is_above_the_schur_complement_and_close_to_it(seed: int) -> None:
    """Also of a stiff matrix in which round-off is largest; eigenvalues are those against the complement itself."""
    rng, retained = np.random.default_rng(seed), np.array([1, 4, 7, 8])
    scale = 10.0 ** rng.uniform(-6.0, 6.0, 12)
    A = spd(12, rng, 1e4) * np.outer(scale, scale)
    others = np.setdiff1d(np.arange(12), retained)
    exact = A[np.ix_(retained, retained)] - A[np.ix_(retained, others)] @ np.linalg.solve(
        A[np.ix_(others, others)], A[np.ix_(others, retained)]
    )
    above, _ = condensed(sp.csc_array(A), retained)
    unit = 1.0 / np.sqrt(np.diag(exact))
    scaled = [matrix * np.outer(unit, unit) for matrix in (above.factor.T @ above.factor, exact)]
    ratios = scipy.linalg.eigvalsh(*scaled)
    assert ratios[0] > 1.0  # by the shift, which is above the round-off of this test
    assert ratios[-1] < 1.0 + 1e-6


@pytest.mark.parametrize("few", [coercivity.FEW, 2])
def test_the_constant_is_proved_as_closely_as_by_sparse_matrices(monkeypatch: pytest.MonkeyPatch, few: int) -> None:
    monkeypatch.setattr(coercivity, "FEW", few)
    problem = Varying(n=40)
    vi = problem.assemble(np.array([0.3]))
    retained = np.unique(vi.B.indices)
    above, stiffness = condensed(sp.csc_array(vi.A), retained)
    B = sp.csr_array(sp.csc_array(vi.B)[:, stiffness.retained])
    compliance = vi.B @ np.linalg.solve(vi.A.toarray(), vi.B.toarray().T)
    exact = float(np.sqrt(scipy.linalg.eigvalsh(compliance, problem.W.matrix.toarray())[0]))
    found = above.energy_inf_sup(B, stiffness.liftings(B), problem.W)
    assert found.proved
    assert (1.0 - 2.0 * MARGINS[0]) * exact <= found.value <= exact
    assert found.value == pytest.approx(energy_inf_sup(vi.A, vi.B, problem.W).value, rel=1e-6)
    # whatever D is, nothing above β_A is proved
    rough = stiffness.liftings(B) * (1.0 + 0.05 * np.random.default_rng(0).standard_normal(B.shape))
    assert above.energy_inf_sup(B, rough, problem.W).value <= exact


def test_an_estimate_that_is_too_large_costs_sharpness_or_the_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Varying()
    vi = problem.assemble(np.array([0.3]))
    above, stiffness = condensed(sp.csc_array(vi.A), np.unique(vi.B.indices))
    B = sp.csr_array(sp.csc_array(vi.B)[:, stiffness.retained])
    close = above.energy_inf_sup(B, stiffness.liftings(B), problem.W).value
    estimate = coercivity.smallest_quotient
    for factor, expected in ((1.05, close * 1.05 / 1.1 * (1.0 + MARGINS[0])), (1.6, 0.0)):
        monkeypatch.setattr(
            "vibench.stability.contact_infsup.smallest_quotient", lambda K, W, f=factor: f**2 * estimate(K, W)
        )
        found = above.energy_inf_sup(B, stiffness.liftings(B), problem.W)
        assert found == Constant(pytest.approx(expected), True)


def test_dependent_constraints_have_no_constant_and_no_constraints_an_infinite_one() -> None:
    problem = Varying()
    vi = problem.assemble(np.array([0.3]))
    above, stiffness = condensed(sp.csc_array(vi.A), np.unique(vi.B.indices))
    B = sp.csr_array(sp.csc_array(sp.vstack([vi.B[:7], vi.B[:1]]))[:, stiffness.retained])
    assert above.energy_inf_sup(B, stiffness.liftings(B), problem.W) == Constant(0.0, True)
    none = sp.csr_array((0, B.shape[1]))
    assert above.energy_inf_sup(none, np.zeros(none.shape), space(1)) == Constant(np.inf, True)


@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (2, 3)])
def test_a_matrix_that_is_not_definite_has_no_factor(pair: tuple[int, int]) -> None:
    """Whether the two unknowns that make it so are eliminated, retained, or one of each."""
    A = np.eye(4)
    A[pair], A[pair[::-1]] = 2.0, 2.0
    for matrix in (A, np.diag([1.0, 1.0, 1.0, 0.0])):
        with pytest.raises(NumericalError, match="not positive definite"):
            SchurFromAbove(sp.csc_array(matrix), np.array([0, 1]), np.array([2, 3]))
