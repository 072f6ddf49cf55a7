from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from decimals import ExactProgram, exactly
from hypothesis import given
from hypothesis import strategies as st

from vibench import VariationalInequality
from vibench.model.proved_norms import ProvedNorms
from vibench.qp.verification import extended


def stiff(seed: int, n: int, exponent: float) -> VariationalInequality:
    """An inequality with a condition number of up to 1e14, in any units of the unknowns."""
    rng = np.random.default_rng(seed)
    turned, _ = np.linalg.qr(rng.standard_normal((n, n)))
    units = 10.0 ** rng.uniform(-3.0, 3.0, n)
    A = units[:, None] * ((turned * np.geomspace(10.0**exponent, 1.0, n)) @ turned.T) * units
    B, f = rng.standard_normal((2, n)) * units, rng.standard_normal(n) * units
    return VariationalInequality(sp.csc_array(0.5 * (A + A.T)), f, sp.csr_array(B), np.ones(2))


@pytest.mark.parametrize("precise", [False, True])
@given(st.integers(0, 10_000), st.integers(2, 7), st.floats(-13.0, 0.0))
def test_norms_are_not_below_those_of_exact_arithmetic(precise: bool, seed: int, n: int, exponent: float) -> None:
    """Of A, for vectors near its kernel, and of A⁻¹, for what a computed A⁻¹r misses."""
    vi, rng = stiff(seed, n, exponent), np.random.default_rng(seed)
    program, floor, zeros = ExactProgram(vi), vi.A.diagonal() / n, (exactly(np.zeros(n)), exactly(np.zeros(2)))
    norms = ProvedNorms(vi.A, precise=precise)
    random = rng.standard_normal((n, 2)) * vi.A.diagonal()[:, None] ** -0.5
    random[:, 0] = np.linalg.solve(vi.A.toarray(), rng.standard_normal(n))
    vectors = extended(random) if precise else random
    lengths, _ = norms.energies(vectors, norms.A @ vectors)
    for vector, length in zip(random.T, lengths, strict=True):
        assert program.errors(zeros, vector, np.zeros(2))[0] <= length
    assert norms.largest(random) >= lengths.max() * (1.0 - 1e-6)
    u, lam = rng.standard_normal(n), rng.random(2)
    p = np.linalg.solve(vi.A.toarray(), vi.f - vi.A @ u - vi.B.T @ lam)
    q = vi.f - norms.A @ u - (extended(vi.B) if precise else vi.B).T @ lam - norms.A @ p
    sizes = np.abs(vi.f) + norms.magnitude @ (np.abs(u) + np.abs(p)) + abs(vi.B).T @ lam
    (missed,) = norms.dual_norms(np.asarray(q, float)[:, None], sizes[:, None], 2, floor)
    rest = np.array([Fraction(value) for value in vi.f.tolist()])
    for matrix, vectors in ((vi.A.toarray(), (u, p)), (vi.B.toarray().T, (lam,))):
        exact = np.array([[Fraction(value) for value in row] for row in matrix.tolist()])
        rest -= sum(exact @ np.array([Fraction(value) for value in vector.tolist()]) for vector in vectors)
    assert sum(float(r * r) / t for r, t in zip(rest, floor, strict=True)) <= missed**2
