import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numerics import space

from vibench.interfaces.strategies import Stop
from vibench_strategies.cpg import CPG


@given(st.integers(0, 10_000))
def test_generators_are_normalised_snapshots(seed: int) -> None:
    W = space(7, seed)
    theta = np.random.default_rng(seed).random((7, 5))
    cone = CPG().reduce(theta, W, Stop(size=4))
    normalised = theta / W.norm(theta)
    for column in cone.generators.T:
        assert np.abs(normalised - column[:, None]).max(axis=0).min() < 1e-13
    assert not np.any(cone.free)
    assert cone.fallbacks == ()


def test_the_first_generator_is_the_largest_snapshot() -> None:
    W = space(4)
    theta = np.eye(4) / W.norm(np.eye(4)) * np.array([1.0, 3.0, 2.0, 0.5])
    cone = CPG().reduce(theta, W, Stop(size=1))
    assert np.argmax(cone.generators[:, 0]) == 1
