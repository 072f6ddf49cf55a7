"""Shepard's interpolation is exact at the training parameters, and a convex combination between them."""

from __future__ import annotations

import numpy as np
import pytest

from vibench import Reduction, Stop
from vibench_rope.rope import Rope
from vibench_rope.shepard import Shepard


@pytest.fixture(scope="module")
def offline() -> Reduction:
    """The snapshots of a coarse rope, all of which V_N holds to round-off."""
    rope = Rope(half=8)
    return Reduction(rope, None, None, Stop(tolerance=1e-10), None)


def test_a_training_parameter_has_its_snapshot(offline: Reduction) -> None:
    model, snapshots = offline.with_formulation(Shepard()).model, offline.snapshots
    found = model.solve(snapshots.mu[7])
    assert found.status == "ok"
    np.testing.assert_allclose(found.u, snapshots.u[:, 7], rtol=0.0, atol=1e-8)
    np.testing.assert_array_equal(found.lam, snapshots.lam[:, 7])


@pytest.mark.parametrize("power", [1.0, 3.0, 40.0])
def test_between_them_it_is_a_convex_combination(power: float, offline: Reduction) -> None:
    found = offline.with_formulation(Shepard(power)).model.solve([0.11, 0.23])
    weights = found.alpha
    assert weights is not None
    assert weights.min() >= 0.0
    assert weights.sum() == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(found.lam, offline.snapshots.lam @ weights, rtol=0.0, atol=1e-14)
    assert found.error_bounds.u >= 0.0
