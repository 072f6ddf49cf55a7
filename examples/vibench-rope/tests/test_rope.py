"""The rope against its tangent conditions, and against all contact sets of a small one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import brentq, fsolve

from vibench import MEMBERS, Array, HighFidelitySolver
from vibench_rope.rope import FIRM, Rope

PARAMETERS = [np.array(mu) for mu in ((0.05, 0.0), (0.1, 0.1), (0.15, 0.3))]
"""Parameters at which the contact set is one interval on each hill."""


def slope(mu: Array, x: float) -> float:
    """Slope of the obstacle."""
    return float(-0.2 * np.pi * (np.cos(np.pi * x) - 3.0 * np.cos(3.0 * np.pi * x)) + mu[1])


class Exact:
    """The solution without a mesh: u'' = 1/ν off contact, u = h and u' = h' at the ends of the contact."""

    def __init__(self, mu: Array) -> None:
        self.mu, self.soft = mu, float(mu[0])
        start = brentq(lambda a: self.h(a) - a * slope(mu, a) + a**2 / (2.0 * self.soft), 0.05, 0.235)
        end = brentq(lambda b: self.h(b) + (1.0 - b) * slope(mu, b) + (1.0 - b) ** 2 / (2.0 * FIRM), 0.765, 0.95)
        takes_off, lands = fsolve(self._gap, (0.28, 0.75), xtol=1e-13)
        self.contact = np.array([start, takes_off, lands, end])

    def h(self, x: float) -> float:
        return float(self.mu[1] * x - 0.5 - 0.2 * (np.sin(np.pi * x) - np.sin(3.0 * np.pi * x)))

    def u(self, x: Array) -> Array:
        """Deflection."""
        a, b, c, d = self.contact
        left = self.h(a) + slope(self.mu, a) * (x - a) + (x - a) ** 2 / (2.0 * self.soft)
        right = self.h(d) + slope(self.mu, d) * (x - d) + (x - d) ** 2 / (2.0 * FIRM)
        soft = self.h(b) + slope(self.mu, b) * (x - b) + (x - b) ** 2 / (2.0 * self.soft)
        firm = self.h(c) + slope(self.mu, c) * (x - c) + (x - c) ** 2 / (2.0 * FIRM)
        hanging = [x < a, (x > b) & (x <= 0.5), (x > 0.5) & (x < c), x > d]
        return np.select(hanging, [left, soft, firm, right], np.vectorize(self.h)(x))

    def _gap(self, ends: Array) -> tuple[float, float]:
        """Jumps of force and deflection at ½ between the two parabolas between the hills."""
        b, c = ends
        soft, firm = slope(self.mu, b) * (0.5 - b), slope(self.mu, c) * (0.5 - c)
        force = self.soft * slope(self.mu, b) + (0.5 - b) - FIRM * slope(self.mu, c) - (0.5 - c)
        below = self.h(b) + soft + (0.5 - b) ** 2 / (2.0 * self.soft)
        return force, below - self.h(c) - firm - (0.5 - c) ** 2 / (2.0 * FIRM)


@pytest.mark.parametrize("mu", PARAMETERS, ids=str)
def test_the_rope_leaves_the_hills_where_the_tangent_conditions_say(mu: Array) -> None:
    rope, exact = Rope(), Exact(mu)
    found = HighFidelitySolver(rope).solve(mu)
    touching = rope.x[found.lam > 0.0]
    left, right = touching[touching < 0.5], touching[touching > 0.5]
    ends = np.array([left[0], left[-1], right[0], right[-1]])
    np.testing.assert_allclose(ends, exact.contact, rtol=0.0, atol=1.5 * rope.step)


@pytest.mark.parametrize("mu", PARAMETERS, ids=str)
def test_the_deflection_converges_with_the_second_power_of_the_mesh_width(mu: Array) -> None:
    exact = Exact(mu)
    for half in (20, 40, 80, 160):
        rope = Rope(half)
        error = np.abs(HighFidelitySolver(rope).solve(mu).u - exact.u(rope.x)).max()
        assert error < 5.0 * rope.step**2, half


@pytest.mark.parametrize("mu", PARAMETERS, ids=str)
def test_hills_carry_the_rope_and_what_its_curvature_presses(mu: Array) -> None:
    rope = Rope()
    found, exact = HighFidelitySolver(rope).solve(mu), Exact(mu)
    a, b, c, d = exact.contact
    nu = np.where(rope.x < 0.5, mu[0], FIRM)
    curvature = 0.2 * np.pi**2 * (np.sin(np.pi * rope.x) - 9.0 * np.sin(3.0 * np.pi * rope.x))
    inside = ((rope.x > a + 0.02) & (rope.x < b - 0.02)) | ((rope.x > c + 0.02) & (rope.x < d - 0.02))
    assert inside.sum() > 2
    np.testing.assert_allclose(found.lam[inside], (1.0 - nu * curvature)[inside], rtol=1e-3)
    np.testing.assert_array_equal(found.lam[(rope.x < a - 0.01) | (rope.x > d + 0.01)], 0.0)


@pytest.mark.parametrize("mu", [*PARAMETERS, np.array([0.25, -0.05]), np.array([0.05, 0.5])], ids=str)
def test_a_small_rope_has_the_one_contact_set_that_satisfies_the_conditions(mu: Array) -> None:
    rope = Rope(half=5)
    vi = rope.assemble(mu)
    A, B = vi.A.toarray(), vi.B.toarray()
    answers = []
    for active in itertools.product([False, True], repeat=len(vi.g)):
        rows = B[list(active)]
        count = len(rows)
        system = np.block([[A, rows.T], [rows, np.zeros((count, count))]])
        solution = np.linalg.solve(system, np.concatenate([vi.f, vi.g[list(active)]]))
        u, lam = solution[: len(vi.f)], solution[len(vi.f) :]
        if np.all(B @ u <= vi.g + 1e-12) and np.all(lam >= -1e-12):
            answers.append((u, np.array(active)))
    assert len(answers) == 1
    found = HighFidelitySolver(rope).solve(mu)
    np.testing.assert_allclose(found.u, answers[0][0], rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(found.lam > 0.0, answers[0][1])


def test_nothing_varies_but_what_is_declared_to() -> None:
    rope = Rope(half=4)
    one, other = (rope.assemble(mu) for mu in PARAMETERS[:2])
    differences = {name: abs(getattr(one, name) - getattr(other, name)).max() for name in MEMBERS}
    assert rope.constant == {name for name, difference in differences.items() if difference == 0.0}
    assert set(rope.affine) == {name for name, difference in differences.items() if difference > 0.0}


@pytest.mark.parametrize("mu", PARAMETERS, ids=str)
def test_members_are_those_of_the_forms(mu: Array) -> None:
    """Element by element, with the stiffness of the half that the element lies in; g = −Δx h at the nodes."""
    rope, ends = Rope(half=4), np.linspace(0.0, 1.0, 9)
    stiffness = np.zeros((9, 9))
    for k in range(8):
        nu = mu[0] if k < 4 else FIRM
        stiffness[k : k + 2, k : k + 2] += nu / rope.step * np.array([[1.0, -1.0], [-1.0, 1.0]])
    vi, exact = rope.assemble(mu), Exact(mu)
    np.testing.assert_allclose(vi.A.toarray(), stiffness[1:-1, 1:-1], rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(vi.g, [-rope.step * exact.h(x) for x in ends[1:-1]], rtol=1e-13)
    np.testing.assert_allclose(vi.B.toarray(), -rope.step * np.eye(7), rtol=1e-13)
