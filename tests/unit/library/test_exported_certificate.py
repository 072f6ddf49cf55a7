"""What the exported script with error bounds computes on its own, against the code that it repeats."""

from __future__ import annotations

import numpy as np
import pytest

from vibench.library import reduced_model_certificate
from vibench.model.certificates import contact_correction as complementarity


def test_the_script_has_the_correction_where_exchanging_all_at_once_cycles() -> None:
    cycled = 0
    for seed in range(2000):
        rng = np.random.default_rng(seed)
        size = int(rng.integers(1, 12))
        Q = np.linalg.qr(rng.standard_normal((size, size)))[0]
        M, lam, excess = (
            Q @ np.diag(np.geomspace(1.0, 1e3, size)) @ Q.T,
            rng.random(size) * (seed % 2),
            rng.standard_normal(size),
        )
        M = 0.5 * (M + M.T)
        model = object.__new__(reduced_model_certificate.Model)
        model._data = {"inverse": M, "compliance": np.linalg.inv(M)}
        fixed = lam + M @ excess
        expected = complementarity.complementary(fixed, lambda rows, M=M: M[rows], excess <= 0.0)
        for released in (excess <= 0.0, np.zeros(size, bool), np.ones(size, bool)):  # systems with M, and with M⁻¹
            nu, where = model._complementary(1.0, excess, lam, released)
            assert nu == pytest.approx(expected, abs=1e-9 * np.abs(fixed).max())
            assert model._complementary(1.0, excess, lam, where)[0] == pytest.approx(nu, abs=1e-9 * np.abs(fixed).max())
        descended = fixed + M @ reduced_model_certificate._descent(M, fixed)
        cycled += not np.array_equal(nu, expected)
        assert descended == pytest.approx(expected, abs=1e-9 * np.abs(fixed).max())
    assert cycled
