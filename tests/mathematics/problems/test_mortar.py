from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from vibench.errors import NumericalError
from vibench_problems.mortar import Pairing


@dataclass(frozen=True)
class Sides:
    slave: sp.csr_array
    master: sp.csr_array
    gap: np.ndarray


def coupling(slave: np.ndarray, master: np.ndarray, quadrature: str | int) -> Sides:
    found = Pairing(slave, quadrature).couple(master)
    assert found.jump.has_canonical_format
    return Sides(-found.jump[:, : slave.shape[1]], found.jump[:, slave.shape[1] :], found.gap)


def polygons(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A slave of eight edges and a master that reaches beyond it, with kinks at other abscissae."""
    rng = np.random.default_rng(seed)
    slave = np.stack([np.concatenate([[0.0], np.cumsum(0.05 + rng.random(8))]), rng.random(9)])
    steps = np.cumsum(0.05 + rng.random(30))
    master = np.stack([np.concatenate([[0.0], steps * slave[0, -1] * 1.1 / steps[-1]]), -rng.random(31)])
    return slave, master


def quadrature(slave: np.ndarray, master: np.ndarray, function) -> np.ndarray:
    """Integrals of a function of the abscissa over the macro-edges along the slave's arc length, by brute force."""
    lengths = np.linalg.norm(np.diff(slave, axis=1), axis=0)
    found = np.zeros((slave.shape[1] - 1) // 2)
    for edge, length in enumerate(lengths):
        t = (np.arange(20_000) + 0.5) / 20_000
        x = slave[0, edge] + t * (slave[0, edge + 1] - slave[0, edge])
        found[edge // 2] += length * function(x).mean()
    return found


@given(st.integers(0, 1000))
def test_values_that_are_linear_are_integrated_exactly(seed: int) -> None:
    slave, master = polygons(seed)
    found = coupling(slave, master, "exact")
    lengths = np.linalg.norm(np.diff(slave, axis=1), axis=0).reshape(-1, 2).sum(axis=1)
    for side, nodes in ((found.slave, slave), (found.master, master)):
        assert np.allclose(side @ np.ones(nodes.shape[1]), lengths)
        assert np.allclose(side @ (1.0 + 2.0 * nodes[0]), found.slave @ (1.0 + 2.0 * slave[0]))


def test_exact_integrals_against_brute_force_and_gauss_points_tend_to_them() -> None:
    slave, master = polygons(3)
    values = np.random.default_rng(0).random(master.shape[1])
    exact = coupling(slave, master, "exact")
    brute = quadrature(slave, master, lambda x: np.interp(x, master[0], values))
    assert np.allclose(exact.master @ values, brute, rtol=1e-6)
    gap = quadrature(slave, master, lambda x: np.interp(x, *slave) - np.interp(x, *master))
    assert np.allclose(exact.gap, gap, rtol=1e-6)
    errors = [np.abs(coupling(slave, master, k).gap - exact.gap).max() for k in (1, 2, 20)]
    assert errors[2] < errors[0]
    assert errors[2] < 0.02 * np.abs(exact.gap).max()
    assert errors[1] > 0.0


def test_matching_nodes_are_exact_with_two_gauss_points() -> None:
    slave, _ = polygons(5)
    master = slave + np.array([[0.0], [-0.5]])
    one, two = coupling(slave, master, "exact"), coupling(slave, master, 2)
    assert np.allclose(one.master.toarray(), two.master.toarray())
    assert np.allclose(one.gap, 0.5 * one.slave @ np.ones(9))


def test_a_master_that_is_too_short_is_refused() -> None:
    slave, master = polygons(1)
    with pytest.raises(NumericalError, match=r"the pairing ends at x = .* the radius of disc 2 is too small"):
        coupling(slave, 0.5 * master, "exact")
