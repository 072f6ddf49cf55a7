"""β_span of a growing primal space: against singular values at every dimension and every parameter."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from vibench.reduction.supremizers import constraint_classes
from vibench.stability.infsup import ProjectedSupremizers, beta_span


@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(1, 4), st.sampled_from([0.0, 1e-7, 1e-3, 1.0]))
def test_steps_are_the_smallest_constants_of_leading_parts(seed: int, first: int, count: int, small: float) -> None:
    """Columns that nearly coincide would lose digits in Gram matrices."""
    rng = np.random.default_rng(seed)
    one, other = sp.csr_array(rng.standard_normal((3, 5))), sp.csr_array(rng.standard_normal((3, 5)))
    classes = constraint_classes([one, 0.1 * one, other, -2.0 * other])
    projected = [rng.standard_normal((first + 5, count)) for _ in classes.representatives]
    for block in projected:
        block[:, -1] = block[:, 0] + small * block[:, -1]
    found = ProjectedSupremizers(projected, classes)
    direct = np.array(
        [
            [abs(c) * beta_span(projected[k][:rows]) for k, c in zip(classes.members, classes.factors, strict=True)]
            for rows in range(first, first + 6)
        ]
    )
    assert found.over_steps(first) == pytest.approx(direct.min(axis=1), rel=1e-12, abs=1e-14)
    assert found.beta_span() == pytest.approx(direct[-1], rel=1e-12)
    reachable = np.abs(classes.factors) * (1.0 + rng.random(2)[classes.members]) * (1.0 + direct.max())
    shares = (direct / reachable).min(axis=1)  # parameter by parameter: a ratio of minima would be another number
    assert found.stability_ratios(first, reachable) == pytest.approx(shares, rel=1e-12, abs=1e-14)
    assert found.first(first + 2).beta_span() == pytest.approx(direct[2], rel=1e-12)


def test_without_multipliers_nothing_is_unstable() -> None:
    classes = constraint_classes([sp.csr_array(np.ones((2, 3)))])
    assert ProjectedSupremizers([np.zeros((4, 0))], classes).over_steps(2).tolist() == [np.inf] * 3
    none = ProjectedSupremizers([np.zeros((4, 0))], classes)
    assert none.stability_ratios(2, np.array([np.inf])).tolist() == [1.0] * 3
