"""The problems that stand for a stranger's are what they claim to be: checked by closed forms before they are run."""

import numpy as np
import pytest
from other_problems import Block, Put, Torsion

from vibench import HighFidelitySolver, Status, solve_qp
from vibench.qp import verify


def test_a_bar_is_elastic_until_its_sides_yield() -> None:
    """The slope in the middle of a side is 0.3377 times the twist; at the first node, h from it, u is h²/2 less."""
    for cells in (12, 24, 48):
        solver, yielding = HighFidelitySolver(Torsion(cells)), 1.0 / (0.3377 - 0.5 / cells)
        elastic, below, above, far = (solver.solve(np.array([c])) for c in (1.0, 0.99 * yielding, 1.01 * yielding, 8.0))
        assert not below.lam.any()
        assert np.allclose(below.u, 0.99 * yielding * elastic.u)
        assert 0 < (above.lam > 0.0).sum() < (far.lam > 0.0).sum()


@pytest.mark.parametrize("mu", [(0.25, 0.08), (0.3, 0.08), (0.25, 0.05)])
def test_a_put_is_worth_what_its_closed_form_says(mu: tuple[float, float]) -> None:
    errors = []
    for cells in (120, 240, 480):
        problem, at = Put(cells), np.array(mu)
        w = HighFidelitySolver(problem).solve(at).u
        value = (w - problem.exact(at)[1:-1]) / problem.symmetrised(at, np.ones(cells + 1))[1:-1]
        near = problem.x[1:-1] < 1.0  # the option is worth nothing at the end of the truncated interval
        errors.append(float(np.abs(value[near]).max()))
    assert errors[0] < 1e-3
    assert errors[2] < 5e-5


def test_a_block_does_not_know_its_units() -> None:
    """Twice the size and a thousand times the modulus: the same contact, displacements twice as large."""
    one, other = Block(), Block(modulus=1e3, size=2.0)
    mu = np.array([0.05, 0.45])
    here, there = (HighFidelitySolver(p).solve(at) for p, at in ((one, mu), (other, 2.0 * mu)))
    assert np.array_equal(here.lam > 0.0, there.lam > 0.0)
    assert 0 < (here.lam > 0.0).sum() < len(here.lam)
    assert np.allclose(there.u, 2.0 * here.u)
    assert np.allclose(there.lam, 1e3 * here.lam)


def test_above_the_block_nothing_happens() -> None:
    problem = Block(lowest=-0.02)
    found = HighFidelitySolver(problem).solve(np.array([-0.01, 0.5]))
    assert not found.u.any()
    assert not found.lam.any()
    vi = problem.assemble(np.array([-0.01, 0.5]))
    answer = solve_qp(vi, "piqp", 1e-8)
    assert verify(vi, answer, 1e-8)[:2] == (Status.OK, "")
    assert np.abs(answer.x).max() < 1e-10
