"""Definiteness by a banded factorisation: proved up to round-off of the eigenvalue, never where there is none."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from vibench.linalg import banded
from vibench.linalg.banded import is_proved_by_band


@given(st.integers(0, 10**6), st.integers(1, 40), st.floats(-3.0, 3.0), st.integers(-9, 9))
def test_what_is_not_definite_is_not_proved(seed: int, n: int, shift: float, exponent: int) -> None:
    rng = np.random.default_rng(seed)
    dense = np.triu(rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.2))
    unit = 10.0 ** (exponent * rng.random(n))
    matrix = unit[:, None] * (dense + dense.T + shift * np.eye(n)) * unit
    scaled = np.linalg.eigvalsh(dense + dense.T + shift * np.eye(n))[0]
    proved = is_proved_by_band([sp.csr_array(matrix)])
    if scaled < 0.0:
        assert proved is False
    elif scaled > 1e-6:
        assert proved is True


def membrane(side: int) -> sp.csr_array:
    line = sp.diags_array([-np.ones(side - 1), 2.0 * np.ones(side), -np.ones(side - 1)], offsets=[-1, 0, 1])
    return sp.csr_array(sp.kron(line, sp.eye_array(side)) + sp.kron(sp.eye_array(side), line))


@pytest.mark.parametrize("relative", [1e-7, 1e-4])
def test_it_decides_closely_in_any_numbering_and_scaling(relative: float) -> None:
    side, rng = 30, np.random.default_rng(3)
    order, units = rng.permutation(side**2), sp.diags_array(10.0 ** rng.uniform(-4.0, 4.0, side**2))
    matrix, identity = (
        sp.csr_array(units @ M[order][:, order] @ units) for M in (membrane(side), sp.eye_array(side**2).tocsr())
    )
    smallest = 8.0 * np.sin(0.5 * np.pi / (side + 1.0)) ** 2
    assert is_proved_by_band([matrix, -(1.0 - relative) * smallest * identity]) is True
    assert is_proved_by_band([matrix, -(1.0 + relative) * smallest * identity]) is False
    assert is_proved_by_band([matrix, -(1.0 - 1e-13) * smallest * identity]) is False  # round-off may hide it


def test_wide_bands_are_left_to_sparse_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(banded, "MOST_WORK", 1e4)
    assert is_proved_by_band([membrane(12)]) is None
    assert is_proved_by_band([membrane(5)]) is True


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1.0, 0.0])
def test_a_diagonal_that_is_not_positive_proves_nothing(wrong: float) -> None:
    assert is_proved_by_band([sp.csr_array(np.diag([1.0, wrong]))]) is False


@pytest.mark.parametrize("kind", ["csr", "csc"])
def test_what_counts_of_parts_is_their_symmetric_half(kind: str) -> None:
    matrix = membrane(6)
    above = (sp.triu(matrix, 1) + 0.5 * sp.diags_array(matrix.diagonal())).asformat(kind)
    smallest = 8.0 * np.sin(0.5 * np.pi / 7.0) ** 2  # eigenvalue of the membrane
    shift = sp.eye_array(36, format="csc")
    assert is_proved_by_band([above, above, -0.99 * smallest * shift]) is True
    assert is_proved_by_band([above, above, -1.01 * smallest * shift]) is False


@pytest.mark.parametrize("turned", [False, True], ids=["sorted", "unsorted"])
def test_parts_of_one_pattern_are_summed_and_left_as_they_are(turned: bool) -> None:
    """As those of other patterns are, with the shift between two of its eigenvalues and with all of its sizes."""
    matrix = membrane(6)
    if turned:
        matrix = sp.csr_array(sp.csr_array(matrix[:, ::-1])[:, ::-1])
    shifted = -sp.csr_array((0.5 * matrix.data, matrix.indices, matrix.indptr))
    given = [part.copy() for part in (matrix, shifted)]
    assert is_proved_by_band([matrix, shifted]) is True
    assert is_proved_by_band([matrix, 2.0001 * shifted]) is False
    assert is_proved_by_band([1e16 * matrix, matrix, -1e16 * matrix]) is False  # round-off is that of the parts
    for part, before in zip((matrix, shifted), given, strict=True):
        assert np.array_equal(part.indices, before.indices)
        assert np.array_equal(part.data, before.data)
