import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from numerics import Varying, space, spd

from vibench.errors import NumericalError
from vibench.stability import coercivity
from vibench.stability.coercivity import MARGINS, Constant, coercivity_and_continuity, energy_inf_sup, moved


def assert_close(constants: tuple[Constant, Constant], values: np.ndarray) -> None:
    """Both constants are proved, outside of the spectrum, and near to its ends."""
    low, high = constants
    assert low.proved
    assert (1.0 - 2.0 * MARGINS[0]) * values[0] <= low.value <= values[0]
    assert high.proved
    assert values[-1] <= high.value <= (1.0 + 2.0 * MARGINS[0]) * values[-1]


def test_proved_constants_enclose_the_spectrum_closely() -> None:
    for n in (1, 2, 3, 40):
        A, V = spd(n, np.random.default_rng(n)), space(n, 5)
        values = scipy.linalg.eigh(A, V.matrix.toarray(), eigvals_only=True)
        assert_close(coercivity_and_continuity(sp.csc_array(A), V), values)
    rng, V = np.random.default_rng(5), space(80, 5)
    A = V.matrix.toarray() + 0.3 * spd(80, rng, 10.0) / 10.0
    values = scipy.linalg.eigh(A, V.matrix.toarray(), eigvals_only=True)
    assert_close(coercivity_and_continuity(sp.csc_array(A), V), values)
    for indefinite, X in ((A - 2.0 * values[-1] * V.matrix.toarray(), V), (np.diag([1.0, -1.0, 1.0, 1.0]), space(4))):
        with pytest.raises(NumericalError, match="not positive definite"):
            coercivity_and_continuity(sp.csc_array(indefinite), X)


def test_wrong_estimates_cost_accuracy_sharpness_or_the_proof_in_this_order(monkeypatch: pytest.MonkeyPatch) -> None:
    low = moved(lambda accuracy: 2.0 * (1.0 + 5.0 * accuracy), -1.0, lambda a: a <= 2.0)
    high = moved(lambda accuracy: 2.0 / (1.0 + 5.0 * accuracy), 1.0, lambda c: c >= 2.0)
    assert low == Constant(pytest.approx(2.0 * (1.0 + 5e-5) / (1.0 + MARGINS[0]), rel=1e-12), True)
    assert high == Constant(pytest.approx(2.0 / (1.0 + 5e-5) * (1.0 + MARGINS[0]), rel=1e-12), True)
    A, V = spd(40, np.random.default_rng(1)), space(40, 5)
    values = scipy.linalg.eigh(A, V.matrix.toarray(), eigvals_only=True)
    for missed, margin in ((1.005, 1e-2), (1.05, 1e-1), (1.4, 0.5), (2.0, None)):
        wrong = missed * values[0], values[-1] / missed
        monkeypatch.setattr(coercivity.Quotients, "lowest", lambda *_, wrong=wrong: wrong[0])
        monkeypatch.setattr(coercivity.Quotients, "highest", lambda *_, wrong=wrong: wrong[1])
        low, high = coercivity_and_continuity(sp.csc_array(A), V)
        assert low.proved == high.proved == (margin is not None)
        if margin is not None:
            assert low.value == pytest.approx(wrong[0] / (1.0 + margin))
            assert high.value == pytest.approx(wrong[1] * (1.0 + margin))
            assert low.value <= values[0]
            assert high.value >= values[-1]


@pytest.mark.parametrize("few", [coercivity.FEW, 2])
def test_the_inf_sup_constant_in_the_energy_norm_is_proved_closely(monkeypatch: pytest.MonkeyPatch, few: int) -> None:
    """By a dense matrix, and by Lanczos iterations."""
    monkeypatch.setattr(coercivity, "FEW", few)
    problem = Varying()
    vi = problem.assemble(np.array([0.3]))
    compliance = vi.B @ np.linalg.solve(vi.A.toarray(), vi.B.toarray().T)
    exact = float(np.sqrt(scipy.linalg.eigvalsh(compliance, problem.W.matrix.toarray())[0]))
    found = energy_inf_sup(vi.A, vi.B, problem.W)
    assert found.proved
    assert (1.0 - 2.0 * MARGINS[0]) * exact <= found.value <= exact
    # dependent constraints have no constant
    assert energy_inf_sup(vi.A, sp.csr_array(sp.vstack([vi.B[:7], vi.B[:1]])), problem.W) == Constant(0.0, True)
    nothing = energy_inf_sup(sp.eye_array(3, format="csc"), sp.csr_array((0, 3)), space(1))
    assert nothing == Constant(np.inf, True)


def test_multipliers_of_a_constraint_on_everything_are_eliminated_early(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bearing with 2,856 constraints took 12 s at every parameter, of dense Schur complements."""
    count = 32
    line = sp.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(count, count))
    A = sp.csc_array(sp.kron(line, sp.eye_array(count)) + sp.kron(sp.eye_array(count), line))
    n, rng = count**2, np.random.default_rng(3)
    kept = np.sort(rng.permutation(n)[: n // 2])
    B = sp.csr_array(-sp.eye_array(n, format="csr") + 0.3 * sp.eye_array(n, k=1, format="csr"))[kept]
    W = space(len(kept))
    entries = list[int]()
    factorise = coercivity.symmetric_lu

    def watched(matrix: sp.csc_array, permutation: str) -> object:
        entries.append((lu := factorise(matrix, permutation)).L.nnz)
        return lu

    monkeypatch.setattr(coercivity, "symmetric_lu", watched)
    found = energy_inf_sup(A, B, W)
    compliance = B @ np.linalg.inv(A.toarray()) @ B.T.toarray()
    exact = float(np.sqrt(scipy.linalg.eigvalsh(compliance, W.matrix.toarray())[0]))
    assert found.proved
    assert (1.0 - 2.0 * MARGINS[0]) * exact <= found.value <= exact
    beside = max(entries)
    monkeypatch.setattr(coercivity, "FEW_PER_UNKNOWN", 1.0)
    assert energy_inf_sup(A, B, W).value == pytest.approx(found.value, rel=1e-9)
    assert 3 * beside < max(entries)
