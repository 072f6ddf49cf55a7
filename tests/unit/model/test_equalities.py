from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench.model.bound_terms import Equalities


@given(st.integers(0, 10_000), st.booleans(), st.sampled_from([1.0, 1e-8]))
def test_what_holds_the_equalities_is_within_the_distance_and_moves_no_row_by_more_than_its_reach(
    seed: int, dependent: bool, apart: float
) -> None:
    rng = np.random.default_rng(seed)
    X, B, lengths = spd(7, rng, 100.0), rng.standard_normal((6, 7)), 10.0 ** rng.uniform(-8.0, 8.0, 6)
    B[1] = B[0] + apart * rng.standard_normal(7)
    if dependent:
        B[2] = rng.standard_normal(2) @ B[:2]
    B *= lengths[:, None]
    F = np.linalg.cholesky(X).T
    K, unwhiten = np.linalg.solve(F.T, B[:3].T), lambda y: np.linalg.solve(F, y)
    held = Equalities.from_rows(K, unwhiten, B)
    assert len(held.chosen) == (2 if dependent else 3)
    wanted = B[:3] @ rng.standard_normal(7)  # consistent
    d = held.step(wanted)
    np.testing.assert_allclose(B[:3] @ d / lengths[:3], wanted / lengths[:3], rtol=0.0, atol=1e-6)
    eta = held.distance(np.abs(wanted))
    assert np.sqrt(d @ X @ d) <= eta
    assert np.all(np.abs(B @ d) <= held.reach * eta * (1.0 + 1e-9))
    other = d + unwhiten(np.linalg.svd(K)[0][:, -1])  # holds them, too
    assert other @ X @ other >= d @ X @ d
