"""Solutions condensed on the zone that contact reaches are those condensed on all candidates, however it was found."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
import scipy.sparse as sp

from vibench import create
from vibench.highfidelity import kkt_systems
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.highfidelity.kkt_systems import ZoneStiffness, watched, zone_of
from vibench.interfaces.problem import Problem

MUS = np.array([[0.7], [1.3], [0.9]])


@pytest.fixture(scope="module")
def hertz() -> Problem:
    return create("problem", "hertz", {"resolution": 300})


def one_row(factor: object, vi: object) -> np.ndarray:
    return np.arange(len(vi.g)) == 0  # type: ignore[attr-defined]


def nowhere(factor: object, vi: object) -> np.ndarray:
    return np.zeros(len(vi.g), bool)  # type: ignore[attr-defined]


@pytest.mark.parametrize("constant", [True, False], ids=["constant", "varying"])
@pytest.mark.parametrize("guess", [None, one_row, nowhere], ids=["coarse problem", "one row", "nothing"])
def test_solutions_do_not_depend_on_the_zone(hertz: Problem, guess: object, constant: bool) -> None:
    expected = [HighFidelitySolver(hertz).solve(mu) for mu in MUS]
    with mock.patch.multiple(kkt_systems, MANY_UNKNOWNS=0, coarse_contact=guess or kkt_systems.coarse_contact):
        with mock.patch.object(type(hertz), "constant", frozenset({"A", "f"} if constant else ())):
            solver = HighFidelitySolver(hertz)
            zones = []
            for mu, single in zip(MUS, expected, strict=True):
                found = solver.solve(mu)
                assert isinstance(solver._stiffness, ZoneStiffness)
                zones.append(solver._stiffness.zone)
                assert np.array_equal(found.lam > 0.0, single.lam > 0.0)
                assert found.fallback == ""
                np.testing.assert_allclose(found.u, single.u, atol=1e-11 * np.abs(single.u).max())
                np.testing.assert_allclose(found.lam, single.lam, atol=1e-9 * single.lam.max())
                reached = np.unique(sp.csr_array(hertz.assemble(mu).B)[found.lam > 0.0].indices)
                assert np.isin(reached, zones[-1]).all()
        force = hertz.assemble(MUS[-1]).B.T @ found.lam
        energy = force @ np.linalg.solve(hertz.assemble(MUS[-1]).A.toarray(), force)
        assert solver._stiffness.dual_norms(force[:, None]) == pytest.approx(np.sqrt(energy), rel=1e-9)
        assert solver._stiffness.compliance(force[hertz.contact_dofs]) @ force[hertz.contact_dofs] == pytest.approx(
            energy, rel=1e-9
        )
    assert len(zones[-1]) < len(hertz.contact_dofs)
    assert np.isin(zones[0], zones[-1]).all()


def test_a_zone_has_the_unknowns_of_rows_and_of_their_neighbours() -> None:
    B = sp.eye_array(10, 11, format="csr") - sp.eye_array(10, 11, k=1, format="csr")
    rows = np.isin(np.arange(10), [4, 5])
    zone = zone_of(B, rows)
    assert zone.tolist() == [3, 4, 5, 6, 7]
    assert np.flatnonzero(watched(B, zone)).tolist() == [3, 4, 5, 6]
    assert zone_of(B, np.ones(10, bool)).tolist() == list(range(11))
    assert zone_of(B, np.zeros(10, bool)).tolist() == []
    apart = sp.block_diag([np.ones((1, 2)), np.ones((1, 2))], format="csr")
    assert zone_of(apart, np.array([True, False])).tolist() == [0, 1]  # nothing is next to it
