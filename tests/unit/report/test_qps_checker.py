"""The script of exported test sets, which is written apart from the verification, defines the same residuals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench import VariationalInequality
from vibench.qp import kkt_residuals
from vibench.report.qps_checker import residuals


@given(
    seed=st.integers(0, 10_000), load=st.sampled_from([0.0, 1e-16, 1.0]), closed=st.sampled_from([0.0, 1.0]),
    share=st.sampled_from([0.0, 1e-7, 1.0]), unit=st.integers(-9, 9),
)  # fmt: skip
def test_residuals_are_those_of_verification(seed: int, load: float, closed: float, share: float, unit: int) -> None:
    """With a load, with one that is round-off, without; of solutions of any size, zero included."""
    rng = np.random.default_rng(seed)
    P, q, G = 10.0**unit * spd(5, rng), load * rng.standard_normal(5), rng.standard_normal((3, 5))
    h, x, z = rng.random(3) - closed, share * rng.standard_normal(5), share * 10.0**unit * rng.random(3)
    found = kkt_residuals(VariationalInequality(P, -q, G, h), x, z)
    assert residuals(P, q, G, h, x, z, 0.0) == pytest.approx([found.primal, found.dual, found.gap], rel=1e-9, abs=1e-15)
