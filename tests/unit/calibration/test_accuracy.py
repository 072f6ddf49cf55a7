"""How far solutions are from the exact one whose natural residuals are given: the δ of calibrations."""

import numpy as np
import pytest
from samples import pga_reduction

import vibench
from vibench.calibration.data import Sensors
from vibench.calibration.decisions import BoundedSensors
from vibench.errors import NumericalError
from vibench.qp.exact import exact_solution
from vibench.qp.verification import kkt_residuals
from vibench_problems.radial import Radial

NAMES = ("inner deflection", "outer deflection")


def test_errors_are_at_most_186_roots_of_the_natural_residual() -> None:
    rng, largest, seen = np.random.default_rng(0), 0.0, 0
    for _ in range(300):
        n, m = rng.integers(4, 7), rng.integers(1, 4)
        root, B = rng.standard_normal((n, n)), rng.standard_normal((m, n))
        A = root @ root.T + 0.1 * np.eye(n)
        program = vibench.VariationalInequality(A, rng.standard_normal(n), B, -rng.random(m))
        exact = exact_solution(program)
        assert exact is not None
        u, lam = exact.x, exact.alpha
        # Multipliers of rows that are hardly out of contact are what residuals tell the least of.
        size = 10.0 ** rng.uniform(-7, -2)
        other = np.maximum(lam + size * rng.standard_normal(m), 0.0)
        computed = np.linalg.solve(A, program.f - B.T @ other) + 0.1 * size**2 * rng.standard_normal(n)
        epsilon = kkt_residuals(program, computed, other).worst
        if not 0.0 < epsilon < 1e-4:
            continue
        lengths = np.sqrt(np.einsum("ij,ij->i", B, np.linalg.solve(A, B.T).T))
        P = max(np.sqrt(u @ A @ u), lam @ lengths)
        d, force = computed - u, B.T @ (other - lam)
        error = max(np.sqrt(d @ A @ d), np.sqrt(force @ np.linalg.solve(A, force)))
        largest, seen = max(largest, error / (np.sqrt(epsilon) * P)), seen + 1
    assert seen > 100
    assert 0.01 < largest <= 1.86


def test_the_distance_needs_no_constraint_where_it_is_a_multiple_of_one_matrix() -> None:
    phase = pga_reduction(Radial("coarse"), 1e-1, 1e-2, assembly="reduced", bounds=True)
    by_multiple, by_constraint = BoundedSensors(phase.model, NAMES), BoundedSensors(phase.model, NAMES)
    by_constraint._is_scaled = False
    for mu in phase.model.parameters.sample(3, 1):
        one, other = by_multiple(mu), by_constraint(mu)
        np.testing.assert_allclose(one.bounds, other.bounds, rtol=1e-12)


def test_less_accurate_solutions_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    ask = Sensors(Radial("coarse"), NAMES)
    monkeypatch.setattr(Sensors, "accuracy", 1e-20)
    with pytest.raises(NumericalError, match=r"has the natural residual .* at mu = \[0\.17, 0\.1\], above 1e-20"):
        ask(np.array([0.17, 0.1]))
