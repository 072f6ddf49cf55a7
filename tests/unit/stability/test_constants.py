from itertools import product

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from numerics import Varying, space, spd

from vibench import InnerProduct, NumericalError, VariationalInequality
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.linalg import proofs
from vibench.linalg.schur_complement import EliminationPattern
from vibench.stability import coercivity, contact_infsup
from vibench.stability.coercivity import MARGINS, Constant, coercivity_and_continuity, energy_inf_sup
from vibench.stability.contact_infsup import ContactInfSup, multiple_of


def varying(n: int = 8) -> tuple[VariationalInequality, InnerProduct, float]:
    """A variational inequality, X_W, and its β_A from dense matrices."""
    problem = Varying(n=n)
    vi = problem.assemble(np.array([0.3]))
    compliance = vi.B @ np.linalg.solve(vi.A.toarray(), vi.B.toarray().T)
    return vi, problem.W, float(np.sqrt(scipy.linalg.eigvalsh(compliance, problem.W.matrix.toarray())[0]))


def assert_just_below(found: Constant, exact: float) -> None:
    """It is proved, and as close as the smallest margin allows."""
    assert found.proved
    assert (1.0 - 2.0 * MARGINS[0]) * exact <= found.value <= exact


def assert_close(A: np.ndarray, V: InnerProduct) -> None:
    """Both constants are proved, outside of the spectrum, and near to its ends."""
    low, high = coercivity_and_continuity(sp.csc_array(A), V)
    values = scipy.linalg.eigh(A, V.matrix.toarray(), eigvals_only=True)
    assert_just_below(low, values[0])
    assert high.proved
    assert values[-1] <= high.value <= (1.0 + 2.0 * MARGINS[0]) * values[-1]


def test_proved_constants_enclose_the_spectrum_closely() -> None:
    for n in (1, 2, 3, 40):
        assert_close(spd(n, np.random.default_rng(n)), space(n, 5))
    rng, V = np.random.default_rng(5), space(80, 5)
    A = V.matrix.toarray() + 0.3 * spd(80, rng, 10.0) / 10.0
    values = scipy.linalg.eigh(A, V.matrix.toarray(), eigvals_only=True)
    assert_close(A, V)
    for indefinite, X in ((A - 2.0 * values[-1] * V.matrix.toarray(), V), (np.diag([1.0, -1.0, 1.0, 1.0]), space(4))):
        with pytest.raises(NumericalError, match="not positive definite"):
            coercivity_and_continuity(sp.csc_array(indefinite), X)


def test_wrong_estimates_cost_accuracy_sharpness_or_the_proof_in_this_order(monkeypatch: pytest.MonkeyPatch) -> None:
    low = coercivity.moved(lambda accuracy: 2.0 * (1.0 + 5.0 * accuracy), -1.0, lambda a: a <= 2.0)
    high = coercivity.moved(lambda accuracy: 2.0 / (1.0 + 5.0 * accuracy), 1.0, lambda c: c >= 2.0)
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
    vi, W, exact = varying(30)
    found = energy_inf_sup(vi.A, vi.B, W)
    assert_just_below(found, exact)
    # dependent constraints have no constant
    assert energy_inf_sup(vi.A, sp.csr_array(sp.vstack([vi.B[:7], vi.B[:1]])), W) == Constant(0.0, True)
    nothing = energy_inf_sup(sp.eye_array(3, format="csc"), sp.csr_array((0, 3)), space(1))
    assert nothing == Constant(np.inf, True)
    monkeypatch.delattr(coercivity, "symmetric_lu")  # which systems that cannot be regular may crash
    twice = sp.csr_array(sp.vstack([sp.eye_array(30), -sp.eye_array(30)]))
    assert energy_inf_sup(vi.A, twice, space(60)) == Constant(0.0, True)


def test_multipliers_of_a_constraint_on_everything_are_eliminated_early(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bearing with 2,856 constraints took 12 s at every parameter, of dense Schur complements."""
    count = 24
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
    assert_just_below(found, exact)
    beside = max(entries)
    monkeypatch.setattr(coercivity, "FEW_PER_UNKNOWN", 1.0)
    assert energy_inf_sup(A, B, W).value == pytest.approx(found.value, rel=1e-9)
    assert 3 * beside < max(entries)


def condensed(A: sp.csc_array, retained: np.ndarray, lost: float = 0.0) -> tuple[ContactInfSup, CondensedStiffness]:
    stiffness = CondensedStiffness(A, EliminationPattern.of(A, retained))
    squares = A.diagonal()
    schur, _ = stiffness.schur_with_round_off(squares)
    return ContactInfSup(schur, squares[stiffness.retained], lost), stiffness


def test_the_round_off_in_a_schur_complement_is_bounded() -> None:
    """Also of a stiff matrix, in which it is largest; eigenvalues are those of the difference against S²."""
    retained, others = np.array([1, 4, 7, 8]), np.setdiff1d(np.arange(12), [1, 4, 7, 8])
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scale = 10.0 ** rng.uniform(-6.0, 6.0, 12)
        A = spd(12, rng, 1e4) * np.outer(scale, scale)
        taken = A[np.ix_(retained, others)] @ np.linalg.solve(A[np.ix_(others, others)], A[np.ix_(others, retained)])
        exact, matrix, squares = A[np.ix_(retained, retained)] - taken, sp.csc_array(A), np.diag(A)
        stiffness = CondensedStiffness(matrix, EliminationPattern.of(matrix, retained))
        schur, round_off = stiffness.schur_with_round_off(squares)
        unit = 1.0 / np.sqrt(squares)
        fraction = np.linalg.eigvalsh(A * np.outer(unit, unit))[0]  # σ
        assert 1e-16 < round_off < 1e-13
        difference = (schur.toarray() - exact) * np.outer(unit[retained], unit[retained])
        # of Schur complements it is larger than of A, by the square of the extension
        assert np.max(np.abs(np.linalg.eigvalsh(difference))) <= round_off / fraction


@pytest.mark.parametrize("few", [coercivity.FEW, 2])
def test_the_constant_is_proved_as_closely_as_by_sparse_matrices(monkeypatch: pytest.MonkeyPatch, few: int) -> None:
    monkeypatch.setattr(coercivity, "FEW", few)
    vi, W, exact = varying(40)
    contact, stiffness = condensed(sp.csc_array(vi.A), np.unique(vi.B.indices))
    B = sp.csr_array(sp.csc_array(vi.B)[:, stiffness.retained])
    found = contact.energy_inf_sup(B, stiffness.liftings(B), W)
    assert_just_below(found, exact)
    assert found.value == pytest.approx(energy_inf_sup(vi.A, vi.B, W).value, rel=1e-6)
    # whatever D is, nothing above β_A is proved
    for size in (1e-8, 1e-4, 0.05):
        rough = stiffness.liftings(B) * (1.0 + size * np.random.default_rng(0).standard_normal(B.shape))
        assert contact.energy_inf_sup(B, rough, W).value <= exact


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-4, 0.05])
def test_liftings_on_all_unknowns_prove_it_without_a_factorisation(size: float) -> None:
    """Whoever computed them: whatever D is, nothing above β_A is proved, and of an exact one as much as otherwise."""
    vi, W, exact = varying(40)
    _, stiffness = condensed(sp.csc_array(vi.A), np.unique(vi.B.indices))
    rng, on = np.random.default_rng(0), stiffness.retained
    extend = lambda D: stiffness.extend(D) * (1.0 + size * rng.standard_normal((len(vi.f), D.shape[1])))  # noqa: E731
    liftings = stiffness.liftings(sp.csr_array(sp.csc_array(vi.B)[:, on]))
    found = ContactInfSup(vi.A, vi.A.diagonal(), 0.0, extend).energy_inf_sup(vi.B, liftings, W)
    assert found.value <= exact
    if size == 0.0:
        assert found.proved
        assert found.value == pytest.approx(energy_inf_sup(vi.A, vi.B, W).value, rel=1e-6)


@pytest.mark.parametrize("angle", [0.3, 0.9])
def test_a_known_inverse_proves_it_from_the_compliance_alone(angle: float) -> None:
    """As closely as by residuals of this B where Ĉ is accurate; of an inaccurate one never more than β_A."""
    vi, W, _ = varying(40)
    A = sp.csc_array(vi.A)
    stiffness = CondensedStiffness(A, EliminationPattern.of(A, np.unique(vi.B.indices)))
    retained = stiffness.retained
    schur, squares = stiffness.schur_with_round_off(A.diagonal())[0].toarray(), A.diagonal()[retained]
    rng = np.random.default_rng(0)
    matrix = np.where(vi.B.toarray()[:, retained] != 0.0, rng.uniform(-1.0, angle, (len(vi.g), len(retained))), 0.0)
    B, accurate = sp.csr_array(matrix), np.linalg.inv(schur)
    exact = np.sqrt(scipy.linalg.eigvalsh(B @ accurate @ B.T.toarray(), W.matrix.toarray())[0])
    sizes = np.abs(accurate) * rng.standard_normal(accurate.shape)
    for size in (0.0, 1e-13, 1e-9, 1e-6, 1e-3):
        inverse = accurate + 0.5 * size * (sizes + sizes.T)
        contact = ContactInfSup(sp.csc_array(schur), squares, 0.0, inverse=inverse)
        liftings = np.asarray(B @ inverse)
        found, by_liftings = contact.of_inverse(B, B @ liftings.T, W), contact.energy_inf_sup(B, liftings, W)
        assert found.value <= exact
        if size <= 1e-13:
            assert found.proved
            assert found.value == pytest.approx(by_liftings.value, rel=1e-6)
    # too soft an inverse gives too large a compliance, which E takes back or refuses
    contact = ContactInfSup(sp.csc_array(schur), squares, 0.0, inverse=1.01 * accurate)
    assert contact.of_inverse(B, B @ np.asarray(B @ (1.01 * accurate)).T, W).value <= exact


def test_too_large_estimates_or_too_soft_complements_cost_sharpness_or_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ŝ of a matrix P with A ≼ P / (1 − δ/σ), here exactly so: without δ/σ more than β_A would be proved."""
    vi, W, exact = varying(40)
    for lost in (1e-2, 0.4):
        softer = sp.csc_array((1.0 - lost) * vi.A)
        contact, stiffness = condensed(softer, np.unique(vi.B.indices), lost)
        B = sp.csr_array(sp.csc_array(vi.B)[:, stiffness.retained])
        found = contact.energy_inf_sup(B, stiffness.liftings(B), W)
        assert 0.0 < found.value <= exact
        assert condensed(softer, np.unique(vi.B.indices))[0].energy_inf_sup(B, stiffness.liftings(B), W).value > exact
    assert condensed(vi.A, np.unique(vi.B.indices), 0.6)[0].energy_inf_sup(B, stiffness.liftings(B), W).value == 0.0
    vi, W, _ = varying()
    contact, stiffness = condensed(sp.csc_array(vi.A), np.unique(vi.B.indices))
    B = sp.csr_array(sp.csc_array(vi.B)[:, stiffness.retained])
    # dependent constraints have no constant, no constraints an infinite one
    dependent, none = sp.csr_array(sp.vstack([B[:7], B[:1]])), sp.csr_array((0, B.shape[1]))
    assert contact.energy_inf_sup(dependent, stiffness.liftings(dependent), W) == Constant(0.0, True)
    assert contact.energy_inf_sup(none, np.zeros(none.shape), space(1)) == Constant(np.inf, True)
    close, estimate = contact.energy_inf_sup(B, stiffness.liftings(B), W).value, coercivity.smallest_root
    for factor, expected in ((1.05, close * 1.05 / 1.1 * (1.0 + MARGINS[0])), (1.6, 0.0)):
        wrong = lambda K, W, f=factor: lambda accuracy: f * estimate(K, W)(accuracy)  # noqa: E731
        monkeypatch.setattr("vibench.stability.contact_infsup.smallest_root", wrong)
        found = contact.energy_inf_sup(B, stiffness.liftings(B), W)
        assert found == Constant(pytest.approx(expected), True)


def test_fractions_of_diagonals_are_near_the_largest_and_wrong_ones_unproved(monkeypatch: pytest.MonkeyPatch) -> None:
    # Of a mesh in space it takes gigabytes, where a Cholesky factor does.
    monkeypatch.delattr(proofs, "symmetric_lu")
    for n in (3, 40):
        X = space(n, 7)
        unit = 1.0 / np.sqrt(X.matrix.diagonal())
        largest = float(np.linalg.eigvalsh(X.matrix.toarray() * np.outer(unit, unit))[0])
        share = coercivity.share_of_diagonal(X)
        assert share.proved
        assert largest / 1.6 < share.value <= largest
    assert contact_infsup._proved_positive(np.eye(4) + 0.25, 1e-3)
    assert not contact_infsup._proved_positive(np.eye(4) + 0.25, 1.0)  # more is left out than the smallest eigenvalue
    for wrong, place in product([np.nan, np.inf, 0.0, -1.0], [(0, 0), (3, 3), (2, 1)]):
        matrix = np.eye(4) + 0.25
        matrix[place] = matrix[place[::-1]] = wrong if place[0] == place[1] or not np.isfinite(wrong) else 2.0
        assert not contact_infsup._proved_positive(matrix, 1e-3)


def string(n: int = 400, m: int = 140) -> tuple[sp.csc_array, np.ndarray, InnerProduct]:
    """The stiffness of a string, the unknowns in its middle, and the inner product of multipliers there."""
    A = sp.csc_array(sp.diags_array([2.0 * np.ones(n), -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1]) * (n + 1))
    mass = sp.diags_array([4.0 * np.ones(m), np.ones(m - 1), np.ones(m - 1)], offsets=[0, 1, -1]) / (6.0 * m)
    return A, np.arange(m) + (n - m) // 2, InnerProduct(mass)


@pytest.mark.parametrize("theta", [-0.3, 2.0])
def test_constraints_that_are_a_multiple_of_the_norm_need_no_liftings(theta: float) -> None:
    """β_A is proved as closely, also with round-off of A that is not negligible; nothing above it is."""
    A, retained, W = string()
    mass = W.matrix.toarray()
    compliance = np.linalg.inv(A.toarray())[np.ix_(retained, retained)]
    exact = abs(theta) * np.sqrt(scipy.linalg.eigvalsh(mass @ compliance @ mass, mass)[0])
    B = sp.csr_array(theta * W.matrix)
    assert multiple_of(B, W) == pytest.approx(theta)
    for lost in (0.0, 0.1):
        contact, stiffness = condensed(A, retained, lost)
        found = contact.of_multiple(theta, B, W)
        closest = np.sqrt(1.0 - 1.01 * lost) * exact
        assert (1.0 - 2.0 * MARGINS[0]) * closest <= found.value <= (1.0 + 1e-12) * closest
        by_liftings = contact.energy_inf_sup(B, stiffness.liftings(B), W).value
        assert found.value >= (1.0 - 2.0 * MARGINS[0]) * by_liftings
        assert 0.9 * closest <= by_liftings <= exact  # columns of D are taken 128 at a time
        # whatever θ is taken for, what is proved is a bound
        wrong = contact.of_multiple(1.5 * theta, B, W)
        assert wrong is None or wrong.value <= exact
    # others are not taken for a multiple
    B, few, other = sp.csr_array(2.0 * W.matrix), InnerProduct(W.matrix[:10, :10]), sp.csr_array(2.0 * W.matrix)
    other.data[3] *= 1.0 + 1e-9
    for matrix, X in ((sp.csr_array(2.0 * few.matrix), few), (sp.csr_array(sp.hstack([B, B])), W), (other, W)):
        assert multiple_of(matrix, X) == 0.0
