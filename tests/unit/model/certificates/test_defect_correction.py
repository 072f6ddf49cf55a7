from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import exact, spd

from vibench import Contact, VariationalInequality
from vibench.linalg import EPS
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.certificates.contact_correction import ContactCompliance

N, M = 9, 4
CONTACT = np.arange(2, 8)


class Pair:
    """A random inequality in the inner product X, and u_N, λ_N ≥ 0 away from its solution."""

    def __init__(self, seed: int, size: float, pressure: float, spread: float, soft: bool = False) -> None:
        """A = L M Lᵀ with X = L Lᵀ and the eigenvalues of M between 1 and `spread`; errors of u may be the softest."""
        rng = np.random.default_rng(seed)
        self.X = spd(N, rng, 30.0)
        half, self.spectrum = np.linalg.cholesky(self.X), (1.0, spread)
        scaled = spd(N, rng, spread)
        A = half @ scaled @ half.T
        B = np.zeros((M, N))
        B[:, CONTACT] = rng.standard_normal((M, len(CONTACT)))
        self.vi = VariationalInequality(0.5 * (A + A.T), rng.standard_normal(N), B, rng.uniform(-0.3, 0.1, M))
        u, lam = exact(self.vi)
        away = np.linalg.solve(half.T, np.linalg.eigh(scaled)[1][:, 0]) if soft else rng.standard_normal(N)
        self.u_N = u + size * away
        self.lam_N = np.maximum(lam + pressure * rng.standard_normal(M), 0.0)
        self.lam_N[self.lam_N < 1e-4] = 0.0  # below 1e-6 of their slack multipliers are left as they are
        e, force = u - self.u_N, B.T @ (lam - self.lam_N)
        self.errors = float(np.sqrt(e @ A @ e)), float(np.sqrt(force @ np.linalg.solve(A, force)))
        self.u, self.lam = u, lam
        self.scale = 1.0 + float(np.linalg.norm(self.u_N) + np.linalg.norm(self.lam_N))
        self.rng = rng

    def bounds(self, kept: int = N) -> tuple[float, float]:
        """Where `kept` random coordinates of the residual are known, and of what it lacks the norm."""
        X, (A, f, B, g) = self.X, (self.vi.A, self.vi.f, self.vi.B, self.vi.g)
        half = np.linalg.cholesky(X)
        rotated = np.linalg.qr(self.rng.standard_normal((N, N)))[0]
        coordinates = rotated.T @ np.linalg.solve(half, f - A @ self.u_N - B.T @ self.lam_N)
        directions = np.linalg.solve(half, np.eye(N)[:, CONTACT]).T @ rotated
        compliance = ContactCompliance(np.linalg.inv(X)[np.ix_(CONTACT, CONTACT)], np.arange(len(CONTACT)), 0.0)
        on_contact, contact = (self.u_N[CONTACT], np.zeros(len(CONTACT))), Contact(sp.csr_array(B[:, CONTACT]), g)
        certificate: Any = SimpleNamespace(
            compliance=compliance, contact_directions=directions[:, :kept], margin=0.0, _on_contact=lambda _: on_contact
        )
        query: Any = SimpleNamespace(lam=self.lam_N, contact=contact, lower=self.spectrum[0], upper=self.spectrum[1])
        shown = coordinates[:kept], float(np.linalg.norm(coordinates[kept:]))
        return OnlineCertificate._defect_corrected(certificate, query, *shown)

    def round_off(self) -> float:
        """What bounds may have more than the errors: the roots of λ times the margins, and of the round-off in ‖w‖²."""
        B, C, e = self.vi.B, np.linalg.inv(self.X), self.lam - self.lam_N
        reach = np.sqrt(np.diag(C))
        terms = abs(B) @ (np.abs(self.u) + np.abs(self.u_N) + 2.0 * self.errors[0] * reach) + np.abs(self.vi.g)
        # Rows lack 1e-13 of their diagonal and round-off of s; a margin is 20 times that, or 200 if it is raised again.
        margin = 200.0 * (1e-13 * np.diag(B @ C @ B.T) * np.abs(e) + 20.0 * EPS * terms)
        roots = np.sqrt(2.0 * self.lam @ margin) + np.sqrt(50.0 * EPS) * (reach @ np.abs(B.T @ e))
        return float(roots + 1e-12 * self.scale)


SIZES = st.sampled_from([0.0, 1e-3, 1.0])


@pytest.mark.parametrize("soft", [False, True])
@given(st.integers(0, 10_000), SIZES, SIZES, st.sampled_from([1.0, 1.5, 20.0]), st.sampled_from([N, 5, 0]))
@settings(max_examples=15)
def test_no_error_exceeds_its_bound(
    soft: bool, seed: int, size: float, pressure: float, spread: float, kept: int
) -> None:
    """Also where most of the residual is known by its norm alone, and where A is least of what X is."""
    pair = Pair(seed, size, pressure, spread, soft)
    for error, bound in zip(pair.errors, pair.bounds(kept), strict=True):
        assert error <= bound + 1e-7 * pair.scale


@given(st.integers(0, 10_000), SIZES, SIZES)
@settings(max_examples=15)
def test_bounds_are_errors_where_the_stiffness_is_the_inner_product(seed: int, size: float, pressure: float) -> None:
    pair = Pair(seed, size, pressure, 1.0)
    assert pair.bounds() == pytest.approx(pair.errors, rel=1e-5, abs=pair.round_off())


def test_a_small_error_of_one_of_both_has_a_small_bound() -> None:
    """The bound of the sum is as large as the other one."""
    nearly = 1.0 + 1e-3
    for size, pressure in ((1.0, 1e-4), (1e-4, 1.0)):
        of_u, of_lam = Pair(3, size, pressure, nearly).bounds()
        small, large = sorted((of_u, of_lam))
        assert small < 0.05 * large
        assert (of_u > of_lam) == (size > pressure)
