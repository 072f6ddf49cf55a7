from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench.linalg import proofs
from vibench.linalg.cholesky import symmetric_lu
from vibench.linalg.factorisations import DEFAULT, IMPLEMENTATIONS, implementation
from vibench.linalg.proofs import is_proved_definite, proved_positive


def with_eigenvalues(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.standard_normal((len(values), len(values))))
    return (q * values) @ q.T


@given(st.integers(0, 10_000), st.integers(1, 12), st.floats(-8.0, 0.0))
def test_no_more_positive_eigenvalues_are_proved_than_there_are(seed: int, n: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], n)
    matrix = with_eigenvalues(signs * 10.0 ** rng.uniform(exponent, 0.0, n), rng)
    parts = [sp.csc_array(matrix - np.eye(n)), sp.eye_array(n, format="csc")]
    assert proved_positive(parts, np.ones(n)) <= int(np.sum(signs > 0.0))


def test_definiteness_is_proved_in_any_scale_unless_round_off_hides_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The matrices are singular to within 1e-18; without a shift many factorisations end with positive pivots."""
    for n in (1, 5, 60):
        rng = np.random.default_rng(n)
        units = 10.0 ** rng.uniform(-6.0, 6.0, n)
        matrix = units[:, None] * spd(n, rng) * units
        scale = np.sqrt(np.diag(matrix))
        assert proved_positive([sp.csc_array(matrix)], scale) == n
        assert proved_positive([sp.csc_array(matrix)], scale, rng.permutation(n)) == n
        assert proved_positive([sp.csc_array(-matrix)], scale) == 0
    for factor in (1e100, 1e-100):
        matrix = factor * spd(20, np.random.default_rng(5))
        assert proved_positive([sp.csc_array(matrix)], np.sqrt(np.diag(matrix))) == 20
        smallest = np.linalg.eigvalsh(matrix)[0] * (1.0 + 1e-6)
        shifted = [sp.csc_array(matrix), -smallest * sp.eye_array(20, format="csc")]
        assert proved_positive(shifted, np.sqrt(np.diag(matrix))) == 19
    for _ in range(2):
        for seed in range(50):
            matrix = with_eigenvalues(np.array([1.0, 0.5, 1e-18, 0.3]), np.random.default_rng(seed))
            assert proved_positive([sp.csc_array(matrix)], np.ones(4)) < 4
        monkeypatch.setattr(proofs, "_first_shift", lambda _: 0.0)
    assert proved_positive([sp.csc_array((3, 3))], np.ones(3)) == 0


@given(st.integers(0, 10_000), st.integers(2, 6))
def test_the_error_of_a_factorisation_is_bounded(seed: int, n: int) -> None:
    """L D Lᵀ in rational arithmetic against the matrix: the row sums of the difference, scaled."""
    rng = np.random.default_rng(seed)
    matrix, scale = spd(n, rng, spread=1e6), rng.uniform(0.5, 2.0, n)
    lu = symmetric_lu(sp.csc_array(matrix), "MMD_AT_PLUS_A")
    lower, pivots = lu.L.toarray(), lu.U.diagonal()
    back, bound = np.argsort(lu.perm_c), proofs._factorisation_error(lu, 1.0 / scale)
    for i in range(n):
        total = Fraction(0)
        for j in range(n):
            product = sum(Fraction(lower[i, k]) * Fraction(pivots[k]) * Fraction(lower[j, k]) for k in range(n))
            difference = abs(product - Fraction(matrix[back[i], back[j]]))
            total += difference / (Fraction(scale[back[i]]) * Fraction(scale[back[j]]))
        assert float(total) <= bound[back[i]]


def test_patterns_and_indices_may_be_unsorted_and_unsymmetric() -> None:
    """Sums are symmetrised and shifted by other means then, with the same counts."""
    rng = np.random.default_rng(4)
    for n in (6, 40):
        full = spd(n, rng) - 2.0 * np.eye(n)
        full[np.diag_indices(n)] = 0.0
        expected = int(np.sum(np.linalg.eigvalsh(full) > 0.0))
        lopsided = np.tril(full, -1) * 2.0  # its symmetric part is that of `full`
        shift = 0.5 * sp.eye_array(n, format="csr")
        for parts in ([sp.csr_array(full)], [sp.csr_array(lopsided)], [sp.csc_array(lopsided), shift, -shift]):
            assert parts[0].diagonal().max() == 0.0
            assert proved_positive(parts, np.ones(n)) <= expected
        definite = [sp.csr_array(2.0 * np.tril(full, -1)), sp.csr_array(np.diag(np.abs(full).sum(axis=0) + 1.0))]
        assert proved_positive(definite, np.ones(n)) == n
        assert proved_positive([*definite, sp.csc_array(np.diag([np.nan] + [1.0] * (n - 1)))], np.ones(n)) == 0
    matrix = sp.csr_array(sp.csr_array(membrane(6)[:, ::-1])[:, ::-1])
    before = matrix.copy()
    assert proofs._proved_by_band([matrix])
    assert proofs._proved_by_band([matrix, -1.0001 * matrix]) is False
    assert np.array_equal(matrix.indices, before.indices)
    assert np.array_equal(matrix.data, before.data)


def membrane(side: int) -> sp.csr_array:
    line = sp.diags_array([-np.ones(side - 1), 2.0 * np.ones(side), -np.ones(side - 1)], offsets=[-1, 0, 1])
    return sp.csr_array(sp.kron(line, sp.eye_array(side)) + sp.kron(sp.eye_array(side), line))


Prove = Callable[[list[sp.csr_array]], bool | None]


@pytest.fixture(params=["band", *(name for name, one in IMPLEMENTATIONS.items() if not one.is_iterative)])
def prove(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Prove:
    """Every way to a proof: the band of the default, its inertia, and all other factorisations."""
    if request.param == "band":
        return proofs._proved_by_band
    chosen = implementation(request.param)
    if not chosen.is_installed:
        pytest.skip(f"{chosen.distribution} is not installed")
    monkeypatch.setattr(proofs, "_proved_by_band", lambda _: None)
    return lambda parts: is_proved_definite(parts, chosen)


def test_definite_matrices_are_told_closely_in_any_numbering_and_scaling(prove: Prove) -> None:
    side, rng = 16, np.random.default_rng(3)
    order, units = rng.permutation(side**2), sp.diags_array(10.0 ** rng.uniform(-4.0, 4.0, side**2))
    matrix, identity = (
        sp.csr_array(units @ M[order][:, order] @ units) for M in (membrane(side), sp.eye_array(side**2).tocsr())
    )
    smallest = float(8.0 * np.sin(0.5 * np.pi / (side + 1.0)) ** 2)
    # Round-off may hide the sign of the last one.
    for fraction, proved in ((1.0 - 1e-4, True), (1.0 - 1e-7, True), (1.0 + 1e-7, False), (1.0 - 1e-13, False)):
        assert prove([matrix, -fraction * smallest * identity]) is proved
    assert prove([matrix, -0.5 * matrix])
    assert prove([1e16 * matrix, matrix, -1e16 * matrix]) is False  # the round-off is that of the parts
    upper = sp.triu(matrix, 1) + 0.5 * sp.diags_array(matrix.diagonal())  # twice its symmetric part is the matrix
    for kind in ("csr", "csc"):
        halves = [upper.asformat(kind)] * 2
        assert prove([*halves, -0.99 * smallest * identity.asformat(kind)])
        assert prove([*halves, -1.01 * smallest * identity.asformat(kind)]) is False
    for wrong in (np.nan, np.inf, -1.0, 0.0):
        assert prove([sp.csr_array(np.diag([1.0, wrong]))]) is False


@given(st.integers(0, 10**6), st.integers(1, 40), st.floats(-3.0, 3.0), st.integers(-9, 9))
def test_random_bands_are_proved_exactly_where_definite(seed: int, n: int, shift: float, exponent: int) -> None:
    rng = np.random.default_rng(seed)
    dense = np.triu(rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.2))
    unit = 10.0 ** (exponent * rng.random(n))
    matrix = unit[:, None] * (dense + dense.T + shift * np.eye(n)) * unit
    scaled = np.linalg.eigvalsh(dense + dense.T + shift * np.eye(n))[0]
    proved = proofs._proved_by_band([sp.csr_array(matrix)])
    if abs(scaled) > 1e-6:
        assert proved is bool(scaled > 0.0)
    elif scaled < 0.0:
        assert proved is False


def test_wide_bands_are_left_to_a_sparse_factorisation_in_the_given_order(monkeypatch: pytest.MonkeyPatch) -> None:
    wide, orders = sp.csr_array(np.eye(600) + 1e-4), list[object]()
    plain = proofs.proved_positive
    monkeypatch.setattr(proofs, "proved_positive", lambda *given: orders.append(given[2]) or plain(*given))
    order = np.random.default_rng(0).permutation(600)
    assert is_proved_definite([membrane(12)], implementation(DEFAULT))
    assert not orders
    assert is_proved_definite([wide], implementation(DEFAULT), order)
    assert not is_proved_definite([wide, -1.07 * sp.eye_array(600).tocsr()], implementation(DEFAULT), order)
    assert all(one is order for one in orders)
    assert orders
