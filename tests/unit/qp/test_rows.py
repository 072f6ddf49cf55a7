from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from vibench.interfaces.problem import VariationalInequality
from vibench.qp.exact import rows_that_matter


def test_of_parallel_rows_the_tightest_is_kept_and_opposite_ones_without_room_are_an_equality() -> None:
    lines = "1 2 0; -2 -4 0; 0 0 1; 0 0 -3; 1 0 0; 5 0 0; 0 1e-9 0; 0 0 0; 0.1 0.2 0; 0 0 7; -1 1 1"
    B = sp.csr_array([[float(entry) for entry in line.split()] for line in lines.split(";")])
    g = np.array([1.0, -2.0, 5.0, 1.0, 2.0, 3.0, np.inf, 1.0, 0.1, 35.0, 0.0])
    rows = rows_that_matter(B, g, 1e-12 * np.abs(g), preferred=np.zeros(11))
    assert rows.kept.tolist() in ([0, 2, 3, 5, 7, 10], [0, 3, 5, 7, 9, 10])
    assert rows.equal.tolist() == [True, False, False, False, False, False]
    assert (rows.opposite[0], rows.ratio[0]) == (1, 0.5)
    assert rows.implied.nonzero()[0].tolist() == [0, 1, 6, 8]
    pressed = np.zeros(11)
    pressed[1] = 1.0
    other = rows_that_matter(B, g, 1e-12 * np.abs(g), preferred=pressed)
    assert other.kept[0] == 1
    assert other.opposite[0] in {0, 8}
    room = rows_that_matter(B, g + 1e-3 * np.isin(np.arange(11), [0, 8]), 1e-12 * np.abs(g))
    assert not room.equal.any()


@given(st.integers(0, 10_000))
def test_multipliers_of_the_rows_that_matter_are_the_same_forces_on_all_rows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    B, scale = rng.standard_normal((5, 7)), rng.uniform(0.1, 10.0, (2, 5))
    B, g = np.vstack([B, -scale[0, :, None] * B, scale[1, :, None] * B]), rng.standard_normal(5)
    g = np.concatenate([g, -scale[0] * g, scale[1] * (g + 1.0)])
    order = rng.permutation(15)
    vi = VariationalInequality(sp.eye_array(7), np.zeros(7), sp.csr_array(B[order]), g[order])
    rows = rows_that_matter(vi.B, vi.g, 1e-12 * np.abs(vi.g))
    assert len(rows.kept) == 5
    assert rows.equal.all()
    assert rows.implied.all()
    forces = rng.standard_normal(5)
    lam = rows.multipliers(forces, 15)
    assert np.all(lam >= 0.0)
    np.testing.assert_allclose(vi.B.T @ lam, rows.program(vi).B.T @ forces, rtol=0.0, atol=1e-12)


def test_rows_that_differ_are_kept() -> None:
    B = np.random.default_rng(0).standard_normal((4, 6))
    B[1] = B[0] * (1.0 + 1e-9 * np.arange(6))
    B[2] = -B[0] * (1.0 - 1e-9 * np.arange(6))
    rows = rows_that_matter(sp.csr_array(B), np.zeros(4), np.ones(4))
    assert rows.kept.tolist() == [0, 1, 2, 3]
    assert not rows.equal.any()
