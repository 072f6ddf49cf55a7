import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from vibench.arrays import times_dense


@given(
    st.integers(0, 10**6), st.integers(0, 6), st.integers(1, 6), st.integers(1, 3), st.integers(0, 3),
    st.sampled_from(["csr", "csc", "coo"]),
)  # fmt: skip
def test_products_are_those_of_dense_matrices(seed: int, m: int, c: int, k: int, entries: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    columns = [rng.choice(c, min(entries, c), replace=False) for _ in range(m)]
    sparse = np.zeros((m, c))
    for row, chosen in zip(sparse, columns, strict=True):
        row[chosen] = rng.standard_normal(len(chosen))
    dense = rng.standard_normal((c, k))
    found = times_dense(sp.csr_array(sparse).asformat(kind), dense)
    assert found.shape == (m, k)
    np.testing.assert_allclose(found, sparse @ dense, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1]], ids=["diagonal", "permuted"])
@pytest.mark.parametrize("kind", ["csr", "csc"])
def test_what_is_multiplied_is_left_as_it_is(order: list[int], kind: str) -> None:
    dense = np.arange(9.0).reshape(3, 3)
    found = times_dense(sp.csr_array(2.0 * np.eye(3)[order]).asformat(kind), dense)
    np.testing.assert_array_equal(found, 2.0 * dense[order])
    found[:] = 0.0
    np.testing.assert_array_equal(dense, np.arange(9.0).reshape(3, 3))
