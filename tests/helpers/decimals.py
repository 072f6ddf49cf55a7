"""Solutions of variational inequalities in decimal arithmetic of 100 digits, which are more than 300 bits.

Data are taken as the doubles that they are. What is returned satisfies the optimality conditions in this arithmetic, so
that it is the solution, however the guess of the active set was found.
"""

from collections.abc import Iterator
from decimal import Decimal, localcontext
from itertools import product
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee

from vibench import VariationalInequality

DIGITS = 100
ZERO = Decimal(10) ** -60
"""Pivots, slacks and multipliers below this share of their terms are zero."""

STEPS = 60

exactly = np.frompyfunc(Decimal, 1, 1)


class ExactProgram:
    """One inequality, A factorised; rows with an infinite g constrain nothing."""

    def __init__(self, vi: VariationalInequality) -> None:
        A, B = sp.csr_array(vi.A), sp.csr_array(vi.B)
        self._order = np.asarray(reverse_cuthill_mckee(A, symmetric_mode=True), int)
        permuted = sp.coo_array(A[self._order][:, self._order])
        self._band = int(np.max(np.abs(permuted.coords[0] - permuted.coords[1]), initial=0))
        self._n, self.present = len(vi.f), np.isfinite(vi.g)
        self._rows = [
            (B.indices[a:b], exactly(B.data[a:b].astype(object)))
            for a, b in zip(B.indptr[:-1], B.indptr[1:], strict=True)
        ]
        self._g = exactly(np.where(self.present, vi.g, 0.0).astype(object))
        with localcontext() as context:
            context.prec = DIGITS
            self._factorise(permuted)
            self._free = self._solve(exactly(vi.f.astype(object)))
        self._images: dict[int, Any] = {}

    def _factorise(self, permuted: sp.coo_array) -> None:
        """L and D of A = L D Lᵀ in the band."""
        n, band = self._n, self._band
        lower = np.full((n, band + 1), Decimal(0), object)  # entry (i, j) of column j at [j, i − j]
        for i, j, value in zip(*permuted.coords, permuted.data, strict=True):
            if i >= j:
                lower[j, i - j] += Decimal(float(value))
        for k in range(n):
            column = lower[k, 1 : min(band, n - 1 - k) + 1] / lower[k, 0]
            for step in np.flatnonzero(column):
                rest = column[step:]
                lower[k + 1 + step, : len(rest)] -= lower[k, 0] * column[step] * rest
            lower[k, 1 : 1 + len(column)] = column
        self._lower = lower

    def _solve(self, right: Any) -> Any:
        x, lower, n = right[self._order].copy(), self._lower, self._n
        for k in range(n):
            if x[k]:
                count = min(self._band, n - 1 - k)
                x[k + 1 : k + 1 + count] -= x[k] * lower[k, 1 : 1 + count]
        x = x / lower[:, 0]
        for k in range(n - 2, -1, -1):
            count = min(self._band, n - 1 - k)
            x[k] -= lower[k, 1 : 1 + count] @ x[k + 1 : k + 1 + count]
        result = np.empty_like(x)
        result[self._order] = x
        return result

    def _times(self, row: int, x: Any) -> Decimal:
        indices, values = self._rows[row]
        return sum((v * x[i] for i, v in zip(indices, values, strict=True)), Decimal(0))

    def _image(self, row: int) -> Any:
        if row not in self._images:
            functional = np.full(self._n, Decimal(0), object)
            indices, values = self._rows[row]
            for i, v in zip(indices, values, strict=True):
                functional[i] += v
            self._images[row] = self._solve(functional)
        return self._images[row]

    def _on_active(self, active: list[int]) -> tuple[Any, Any]:
        """U and λ with the active rows as equalities; rows that depend on others have no multiplier."""
        S = np.array([[self._times(i, self._image(j)) for j in active] for i in active], object).reshape(
            len(active), len(active)
        )
        right = np.array([self._times(i, self._free) - self._g[i] for i in active], object)
        lam = np.full(len(self._rows), Decimal(0), object)
        size, order, pivots = S.diagonal().copy(), list(range(len(active))), []
        L = S.copy()
        for _ in range(len(active)):
            left = [k for k in order if k not in pivots]
            best = max(left, key=lambda k: L[k, k] / size[k] if size[k] else Decimal(0))
            if not L[best, best] > ZERO * size[best]:
                break
            pivots.append(best)
            for k in left:
                if k != best and L[k, best]:
                    factor = L[k, best] / L[best, best]
                    L[k] = L[k] - factor * L[best]
                    right[k] -= factor * right[best]
        values: dict[int, Decimal] = {}
        for number in range(len(pivots) - 1, -1, -1):
            k = pivots[number]
            known = sum((L[k, j] * values[j] for j in pivots[number + 1 :]), Decimal(0))
            values[k] = (right[k] - known) / L[k, k]
        u = self._free.copy()
        for k, value in values.items():
            lam[active[k]] = value
            u = u - value * self._image(active[k])
        return u, lam

    def _wrong(self, u: Any, lam: Any) -> tuple[np.ndarray, np.ndarray]:
        excess = np.array([self._times(i, u) - self._g[i] for i in range(len(self._rows))], object)
        pairs = (zip(*row, strict=True) for row in self._rows)
        terms = abs(self._g) + np.array([sum((abs(v * u[j]) for j, v in row), Decimal(0)) for row in pairs], object)
        largest = max((abs(value) for value in lam), default=Decimal(0))
        return (excess > ZERO * terms) & self.present, lam < -ZERO * largest

    def solve(self, guess: np.ndarray) -> tuple[Any, Any]:
        """U (n,) and λ (m,) as decimal numbers: active sets from a guess (m,), then all of them where rows are few."""
        with localcontext() as context:
            context.prec = DIGITS
            for active in self._sets(guess):
                u, lam = self._on_active(np.flatnonzero(active).tolist())
                violated, pulling = self._wrong(u, lam)
                if not violated.any() and not pulling.any():
                    return u, lam
                self._next = violated | (active & ~pulling & (lam != Decimal(0)))
        raise AssertionError("no active set")

    def errors(self, exact: tuple[Any, Any], u: np.ndarray, lam: np.ndarray) -> tuple[float, float]:
        """The errors of u (n,) in the energy norm and of λ (m,) in the natural norm, from the solution."""
        with localcontext() as context:
            context.prec = DIGITS
            pairs = zip(exact, (u, lam), strict=True)
            e, epsilon = (one - exactly(np.asarray(of, float).astype(object)) for one, of in pairs)
            force = np.full(self._n, Decimal(0), object)
            for (indices, values), each in zip(self._rows, epsilon, strict=True):
                for i, value in zip(indices, values, strict=True):
                    force[i] += value * each
            return float(self._energy(e).sqrt()), float((force @ self._solve(force)).sqrt())

    def _energy(self, x: Any) -> Decimal:
        """The square of the energy norm, by the factor."""
        lower, n, x = self._lower, self._n, x[self._order]
        total = Decimal(0)
        for k in range(n):
            count = min(self._band, n - 1 - k)
            total += lower[k, 0] * (x[k] + lower[k, 1 : 1 + count] @ x[k + 1 : k + 1 + count]) ** 2
        return total

    def _sets(self, guess: np.ndarray) -> Iterator[np.ndarray]:
        self._next = guess & self.present
        for _ in range(STEPS):
            yield self._next
        if np.count_nonzero(self.present) <= 12:
            for bits in product([False, True], repeat=int(np.count_nonzero(self.present))):
                active = np.zeros(len(self._rows), bool)
                active[self.present] = bits
                yield active


def exact_decimal(vi: VariationalInequality, guess: np.ndarray) -> tuple[Any, Any]:
    """The solution U (n,), λ (m,) of `vi` as decimal numbers."""
    return ExactProgram(vi).solve(guess)


def relative_errors(vi: VariationalInequality, u: np.ndarray, lam: np.ndarray) -> tuple[float, float]:
    """Errors of u (n,) in the energy norm and of λ (m,) in the natural norm, relative to the solution of `vi`."""
    program = ExactProgram(vi)
    exact = program.solve(lam > 0.0)
    errors, sizes = program.errors(exact, u, lam), program.errors(exact, 0.0 * u, 0.0 * lam)
    return errors[0] / sizes[0], errors[1] / max(sizes[1], np.finfo(float).tiny)


def difference(exact: Any, approximate: np.ndarray) -> np.ndarray:
    with localcontext() as context:
        context.prec = DIGITS
        return np.asarray(exact - exactly(np.asarray(approximate, float).astype(object)), dtype=float)
