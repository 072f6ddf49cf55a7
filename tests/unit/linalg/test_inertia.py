from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench.linalg import inertia
from vibench.linalg.cholesky import symmetric_lu
from vibench.linalg.inertia import proved_positive


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


@pytest.mark.parametrize("n", [1, 5, 60])
def test_definiteness_is_proved_in_any_order_and_scale(n: int) -> None:
    rng = np.random.default_rng(n)
    units = 10.0 ** rng.uniform(-6.0, 6.0, n)
    matrix = units[:, None] * spd(n, rng) * units
    scale = np.sqrt(np.diag(matrix))
    assert proved_positive([sp.csc_array(matrix)], scale) == n
    assert proved_positive([sp.csc_array(matrix)], scale, rng.permutation(n)) == n
    assert proved_positive([sp.csc_array(-matrix)], scale) == 0


@pytest.mark.parametrize("shift", [inertia.FIRST_SHIFT, 0.0])
def test_what_round_off_hides_is_not_proved(monkeypatch: pytest.MonkeyPatch, shift: float) -> None:
    """Singular to within 1e-18, where a factorisation may end with positive pivots; without a shift many do."""
    monkeypatch.setattr(inertia, "FIRST_SHIFT", shift)
    for seed in range(50):
        rng = np.random.default_rng(seed)
        matrix = with_eigenvalues(np.array([1.0, 0.5, 1e-18, 0.3]), rng)
        assert proved_positive([sp.csc_array(matrix)], np.ones(4)) < 4
    assert proved_positive([sp.csc_array((3, 3))], np.ones(3)) == 0


@given(st.integers(0, 10_000), st.integers(2, 6))
def test_the_error_of_a_factorisation_is_bounded(seed: int, n: int) -> None:
    """L D Lᵀ in rational arithmetic against the matrix: the row sums of the difference, scaled."""
    rng = np.random.default_rng(seed)
    matrix, scale = spd(n, rng, spread=1e6), rng.uniform(0.5, 2.0, n)
    lu = symmetric_lu(sp.csc_array(matrix), "MMD_AT_PLUS_A")
    lower, pivots = lu.L.toarray(), lu.U.diagonal()
    back = np.argsort(lu.perm_c)
    bound = inertia._factorisation_error(lu, 1.0 / scale)
    for i in range(n):
        total = Fraction(0)
        for j in range(n):
            product = sum(Fraction(lower[i, k]) * Fraction(pivots[k]) * Fraction(lower[j, k]) for k in range(n))
            difference = abs(product - Fraction(matrix[back[i], back[j]]))
            total += difference / (Fraction(scale[back[i]]) * Fraction(scale[back[j]]))
        assert float(total) <= bound[back[i]]


def test_patterns_may_be_neither_symmetric_nor_hold_the_diagonal() -> None:
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


@pytest.mark.parametrize("factor", [1e100, 1e-100])
def test_counts_do_not_depend_on_units(factor: float) -> None:
    matrix = factor * spd(20, np.random.default_rng(5))
    assert proved_positive([sp.csc_array(matrix)], np.sqrt(np.diag(matrix))) == 20
    smallest = np.linalg.eigvalsh(matrix)[0] * (1.0 + 1e-6)
    shifted = [sp.csc_array(matrix), -smallest * sp.eye_array(20, format="csc")]
    assert proved_positive(shifted, np.sqrt(np.diag(matrix))) == 19
