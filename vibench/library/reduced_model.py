"""A reduced model exported by vibench: `Model(file).solve(mu)`. Needs NumPy and piqp or proxsuite, not vibench.

The model is min ½ xᵀA x − fᵀx subject to B x ≤ g, A x + Bᵀα = f with α ≥ 0; u = basis · x and λ = generators · α.
A, f, B, g are Σ_q θ_q(mu) · terms_q; the θ_q are sums of products of Chebyshev polynomials on the parameter box.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FORMAT = "vibench reduced model 1"
Residuals = tuple[float, float, float]


class Solution(NamedTuple):
    """Status, x, α, u and λ with bases, residuals, uᵀA u, and outputs by name.

    "ok" is a solution up to the accuracy in the file, "outside" one outside the box, "inaccurate" none, there or not;
    "failed" means that A is not positive definite or an array is not finite, and that the numbers are NaN.
    """

    status: str
    x: Array
    alpha: Array
    u: Array | None
    lam: Array | None
    residuals: Residuals
    energy: float
    outputs: Mapping[str, float] = MappingProxyType({})


class Model:
    """A reduced model from a file; `about` says where it comes from, `solver` is "piqp" or "proxqp"."""

    def __init__(self, file: str | Path, solver: str = "") -> None:
        if Path(file).exists() and not Path(file).is_file():  # a pipe may have no end
            raise ValueError(f"'{file}' is no regular file")
        with np.load(file, allow_pickle=False) as data:
            if "format" not in data or str(data["format"]) != FORMAT:
                raise ValueError(f"'{file}' is no {FORMAT}")
            self.data = {name: data[name] for name in data.files}
        self._check(str(file))
        self.about: dict[str, Any] = json.loads(str(self.data["about"]))
        self.lower, self.upper = self.data["lower"], self.data["upper"]
        self.solver = solver or self.about["solver"]
        if self.solver not in SOLVERS:
            raise ValueError(f"the solver is '{self.solver}', expected one of {', '.join(SOLVERS)}")
        self._outputs = [output["name"] for output in self.about["outputs"]["linear"]]
        self._last: tuple[bytes, dict[int, Array]] = b"", {}
        names = [key.removesuffix("_indices") for key in self.data if key.endswith("_indices")]
        constant = [name for name in names if not self.data[f"{name}_indices"].any()]
        self._constant: dict[str, Array] = {
            name: (self.data[f"{name}_coefficients"] @ self.data[f"{name}_terms"])[0] for name in constant
        }
        numbers: dict[bytes, int] = {}
        self._members = {name: self._prepared(name, numbers) for name in names}
        self._matrices: _Matrices | None = None  # of a program whose A and B do not depend on the parameter
        rows, columns = np.triu_indices(len(self.data["f_terms"][0]))
        self._packed = np.zeros((columns[-1] + 1, columns[-1] + 1), np.intp)  # where packed A has its entries
        self._packed[rows, columns] = self._packed[columns, rows] = np.arange(len(rows))

    def _prepared(self, name: str, numbers: dict[bytes, int]) -> tuple[list[int], NDArray[np.intp], list[Array]]:
        """Numbers of the products of a member, of what each matrix makes of them, their degrees, and the matrices."""
        # What several members have in common has one number.
        coefficients, terms = self.data[f"{name}_coefficients"], self.data[f"{name}_terms"]
        degrees = np.ascontiguousarray(self.data[f"{name}_indices"].T, dtype=np.intp)
        known = degrees.tobytes() + b"|" + coefficients.tobytes() in numbers  # θ of a member before
        together = not known and terms.size + coefficients.size >= len(coefficients) * terms.shape[1]
        matrices = [coefficients @ terms] if together else [coefficients, terms]
        parts = [degrees.tobytes(), *(matrix.tobytes() for matrix in matrices)]
        keys = (b"|".join(parts[: k + 1]) for k in range(len(parts)))
        return [numbers.setdefault(key, len(numbers)) for key in keys], degrees, matrices

    def _check(self, file: str) -> None:
        """Refuse numbers that are not finite, indices that NumPy counts from the end, and arrays that do not fit."""
        for name, array in self.data.items():
            text = name in {"format", "about"}
            if array.dtype.kind not in ("U" if text else "fiu") or (not text and not np.isfinite(array).all()):
                raise ValueError(f"'{file}' is damaged: the array {name} does not consist of finite numbers")
        low = self.data.get("lower", np.zeros(0))
        for name in [key.removesuffix("_indices") for key in self.data if key.endswith("_indices")]:
            of = [self.data.get(f"{name}_{part}", np.zeros(0)) for part in ("indices", "coefficients", "terms")]
            fits = [array.ndim for array in of] == [2, 2, 2] and of[0].shape == (len(of[1]), low.size)
            whole = fits and of[0].size and of[0].dtype.kind in "iu" and 0 <= of[0].min() <= of[0].max() <= 2**20
            if not whole or of[1].shape[1] != len(of[2]):
                raise ValueError(f"'{file}' is damaged: the arrays of {name} are no polynomial in {low.size} variables")
            self.data[f"{name}_indices"] = of[0].astype(np.int64)

    def program(self, mu: Sequence[float] | Array) -> tuple[Array, Array, Array, Array, Array]:
        """A, f, B, g at a parameter, and the coordinates Y of their unknowns in the basis; warns outside the box."""
        at = np.asarray(mu, dtype=float)
        if at.shape != self.lower.shape or not np.all(np.isfinite(at)):
            raise ValueError(f"mu is {at.tolist()}, expected {', '.join(self.about['parameters']['names'])}")
        if self._is_outside(at):
            warnings.warn(f"mu = {at.tolist()} is outside the box, where the model was not trained", stacklevel=3)
        packed, f, B, g = (self.member(name, at) for name in "AfBg")
        A, Y, B = packed[self._packed], np.eye(len(f)), B.reshape(-1, len(f))
        if "plain" in self.data:  # V_N in a larger space; the supremizers that enrich it are the first rows of B
            Y = _enriched(self.data["plain"], B[: len(B) - len(g)].T)
            A, f, B = Y.T @ A @ Y, Y.T @ f, B[len(B) - len(g) :] @ Y
        return A, f, B, g, Y

    def _is_outside(self, mu: Array) -> bool:
        return bool(((mu < self.lower) | (mu > self.upper)).any())

    def member(self, name: str, mu: Array) -> Array:
        """The sum of terms of this name at a parameter."""
        if name in self._constant:
            return self._constant[name]
        (numbers, degrees, matrices), (at, known) = self._members[name], self._last
        if at != mu.tobytes():
            self._last = _, known = mu.tobytes(), {}
        if numbers[0] not in known:
            unit = (2.0 * mu - self.lower - self.upper) / (self.upper - self.lower)
            unit = unit if (abs(unit) <= 1.0).all() else unit + 0j  # outside the box
            values = np.cos(np.arccos(unit)[:, None] * np.arange(degrees.max() + 1)).real
            known[numbers[0]] = values[0].take(degrees[0])
            for of_one, which in zip(values[1:], degrees[1:], strict=True):
                known[numbers[0]] *= of_one.take(which)
        for before, number, matrix in zip(numbers, numbers[1:], matrices, strict=False):
            if number not in known:
                known[number] = known[before] @ matrix
                known[number].setflags(write=False)
        return known[numbers[-1]]

    def solve(self, mu: Sequence[float] | Array) -> Solution:
        """The solution at a parameter, verified; look at its status."""
        A, f, B, g, Y = self.program(mu)
        x, alpha, found, status = np.full(len(f), np.nan), np.full(len(g), np.nan), (np.nan,) * 3, "failed"
        with suppress(np.linalg.LinAlgError):
            if not np.isfinite(A.sum() + f.sum() + B.sum() + g.sum()):
                raise np.linalg.LinAlgError("an array is not finite")
            of = self._matrices or _Matrices(A, B)
            if {"A", "B"} <= self._constant.keys() and "plain" not in self.data:
                self._matrices = of
            # In v = x − A⁻¹f the size of the program is what contact does, however large the load is.
            free = of.inverse.T @ (of.inverse @ f)
            free += of.inverse.T @ (of.inverse @ (f - A @ free))
            g = g / of.norms
            (v, forces), found = self._solved(of, g - of.B @ free, of.round_off * (of.sizes @ abs(free) + abs(g)))
            x, alpha, status = free + v, forces / of.norms, "ok"
            if not all(residual <= self.about["accuracy"] for residual in found):  # NaN is not
                status = "inaccurate"
            elif self._is_outside(np.asarray(mu, dtype=float)):
                status = "outside"
        energy, x = float(x @ A @ x), Y @ x
        u, lam = (self.data[n] @ v if n in self.data else None for n, v in (("basis", x), ("generators", alpha)))
        outputs = self.named(self.data["outputs_x"] @ x + self.data["outputs_alpha"] @ alpha) if self._outputs else {}
        return Solution(status, x, alpha, u, lam, found, energy, outputs)

    def named(self, values: Array) -> dict[str, float]:
        """Values of the outputs by name."""
        return dict(zip(self._outputs, values.tolist(), strict=True))

    def _solved(self, of: _Matrices, g: Array, noise: Array) -> tuple[tuple[Array, Array], Residuals]:
        """The solver's v and α without load for rows of B of norm 1, or those of its active set; residuals."""
        # `noise` is the round-off in g.
        A, B, f = of.A, of.B, np.zeros(len(of.A))
        if (g >= 0.0).all():  # no constraint acts
            return (f, np.zeros(len(g))), (0.0, 0.0, 0.0)
        length = float(-g.min())  # units in which the solver's tolerances are relative ones
        force = 1e-3 * length * float(A.trace()) / len(A)
        y, z = SOLVERS[self.solver](A * (length / force), f, B, g / length, self.about["settings"][self.solver])
        if not np.isfinite(y.sum() + z.sum()):
            y, z = (np.nan_to_num(vector, nan=0.0, posinf=0.0, neginf=0.0) for vector in (y, z))
        # forces below 1e-3 are often those of rows that touch without any: those that are missing come back
        best = _polished(of, g, (z > g / length - B @ y) & (z > 1e-3 * z.max(initial=0.0)))
        found, given = residuals(of, f, g, *best, noise), (length * y, force * np.maximum(z, 0.0))
        # residuals of some 1e-13 are round-off; NaN is not
        if all(residual <= 1e-13 for residual in found):
            return best, found
        pairs = (given, residuals(of, f, g, *given, noise)), (best, found)
        return min(pairs, key=lambda pair: float(np.nan_to_num(np.max(pair[1]), nan=np.inf)))


class _Matrices:
    """A, B with rows of norm 1, these norms, |B|, the inverse L⁻¹ of A's factor, L⁻¹Bᵀ, and norms of its columns."""

    # Also the round-off in sums over rows of B, their cosines, and the pairs of opposite rows.

    def __init__(self, A: Array, B: Array) -> None:
        norms = np.sqrt((B * B).sum(axis=1))
        norms[norms == 0.0] = 1.0
        B, eps = B / norms[:, None], float(np.finfo(float).eps)
        self.A, self.B, self.norms, self.sizes = A, B, norms, abs(B)
        self.inverse = np.linalg.inv(np.linalg.cholesky(A))
        self.whitened, self.cosines = self.inverse @ B.T, B @ B.T
        self.lengths = np.sqrt((self.whitened**2).sum(axis=0))
        self.round_off = 1.01 * eps * ((B != 0.0).sum(axis=1) + 2.0)
        close = np.argwhere(np.triu(self.cosines < -1.0 + 1e-12))
        # both rows were scaled to norm 1 with a rounding
        self.opposite = [pair for pair in close if abs(B[pair].sum(axis=0)).max() <= 8.0 * eps]


def residuals(of: _Matrices, f: Array, g: Array, x: Array, alpha: Array, noise: Array) -> Residuals:
    """With s = B x − g and norms in A⁻¹: max (s_i)₊/‖B_i‖F, ‖f − A x − Bᵀα‖/F, |αᵀs|/F².

    F is the larger of ‖Bᵀα‖ and max (B_i u₀ − g_i)₊/‖B_i‖, u₀ = A⁻¹f; without contact S, S² = xᵀA x + ‖Bᵀα‖².
    Opposite rows that are equalities hold in u₀, and their forces are neither in F nor in the gap. `noise` is the
    round-off (R,) in g.
    """
    A, B, white = of.A, of.B, of.inverse @ f
    Ax, force, s = A @ x, alpha @ B, B @ x - g
    rest, pull = (of.inverse @ np.array([f - Ax - force, force]).T).T
    S = float(np.hypot(np.sqrt(max(float(x @ Ax), 0.0)), np.linalg.norm(pull)))
    room = of.round_off * (of.sizes @ abs(x) + abs(g))
    way, room, is_open = _step(of, s, room), np.maximum(room, noise), g < np.inf
    tied = [pair for pair in of.opposite if abs(g[pair].sum()) <= room[pair].max() < np.inf]
    if tied:
        rows = np.array(tied)[:, 0]
        W = of.whitened[:, rows]
        white = white - W @ np.linalg.lstsq(W.T @ W, W.T @ white - g[rows], rcond=None)[0]
        pull = pull - W @ np.linalg.lstsq(W, pull, rcond=None)[0]
        is_open &= (abs(of.cosines[rows]) < 1.0 - 1e-12).all(axis=0)
        alpha = np.where(np.isin(np.arange(len(g)), tied), 0.0, alpha)
    free = of.inverse.T @ white
    least = _step(of, np.where(is_open, B @ free - g, 0.0), of.round_off * (of.sizes @ abs(free) + abs(g)) + noise)
    F = max(float(np.linalg.norm(pull)), least) if least else S
    return _ratio(way, F), _ratio(float(np.linalg.norm(rest)), F), _ratio(abs(float(alpha @ s)), F**2)


def _step(of: _Matrices, s: Array, room: Array) -> float:
    """The largest s_i/‖B_i‖ of rows that are violated by more than round-off; infinite for a row of zeros."""
    rows = (s > room).nonzero()[0]
    with np.errstate(divide="ignore"):
        return float((s[rows] / of.lengths[rows]).max(initial=0.0))


def _ratio(size: float, scale: float) -> float:
    return 0.0 if size == 0.0 else size / scale if scale else np.inf


def _polished(of: _Matrices, g: Array, active: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The solution without load up to round-off: equations on an active set, which changes until signs are right."""
    A, B, sizes, inverse, whitened = of.A, of.B, of.sizes, of.inverse, of.whitened
    k = np.sqrt(A.trace() / len(A))
    for step in range(20 + 4 * len(g)):
        chosen = active.nonzero()[0]
        rows, W, x, alpha = B[chosen], whitened[:, chosen], np.zeros(len(A)), np.zeros(len(g))
        rest, missed, root = np.zeros(len(A)), g[chosen], _root(W.T @ W)
        if root is not None:
            for _ in range(2):  # the second time with the residuals, up to round-off
                forces = (root @ (W.T @ rest - missed)) @ root
                alpha[chosen] += forces
                x += (rest - W @ forces) @ inverse
                rest, missed = -inverse @ (A @ x + alpha[chosen] @ rows), g[chosen] - rows @ x
        else:
            system = np.block([[A / k, k * rows.T], [k * rows, np.zeros((len(chosen), len(chosen)))]])
            solved = np.linalg.lstsq(system, np.append(np.zeros(len(A)), k * g[chosen]), rcond=None)[0]
            x, alpha[chosen] = solved[: len(A)], k**2 * solved[len(A) :]
        excess = B @ x - g
        violated = excess > 1e-12 * (sizes @ abs(x) + abs(g))
        pulling = alpha < -1e-12 * abs(alpha).max(initial=0.0)
        if not (violated | pulling).any():
            break
        one = np.arange(len(g)) == (np.argmin(alpha) if pulling.any() else np.argmax(excess))
        active = violated | (active & ~pulling) if step < 20 else active ^ one  # all at once may cycle
    return x, np.maximum(alpha, 0.0)


def _root(gram: Array) -> Array | None:
    """R with RᵀR = G⁻¹ for the products G of vectors, each at an angle of 1e-5 at least to those before it, or none."""
    sizes = np.sqrt(gram.diagonal())
    with suppress(np.linalg.LinAlgError):
        if sizes.all():
            factor = np.linalg.cholesky(gram / (sizes[:, None] * sizes))
            return np.linalg.inv(factor) / sizes if (factor.diagonal() > 1e-5).all() else None
    return None


def _enriched(plain: Array, vectors: Array) -> Array:
    """Orthonormal columns `plain`, and an orthonormal basis of what vectors add to them."""
    rest = (vectors - plain @ (plain.T @ vectors)) / np.linalg.norm(vectors, axis=0)
    if not np.all(np.isfinite(rest)):  # far outside the box
        return plain
    left, sigma, _ = np.linalg.svd(rest, full_matrices=False)
    return np.linalg.qr(np.hstack([plain, left[:, sigma > 1e-12]]))[0]


def _piqp(A: Array, f: Array, B: Array, g: Array, settings: Mapping[str, Any]) -> tuple[Array, Array]:
    import piqp  # noqa: PLC0415

    solver = piqp.DenseSolver()
    for name, value in settings.items():
        setattr(solver.settings, name, value)
    solver.setup(A, -f, np.zeros((0, len(f))), np.zeros(0), B, None, g, None, None)
    solver.solve()
    return solver.result.x, solver.result.z_u


def _proxqp(A: Array, f: Array, B: Array, g: Array, settings: Mapping[str, Any]) -> tuple[Array, Array]:
    from proxsuite import proxqp  # noqa: PLC0415

    result = proxqp.dense.solve(A, -f, None, None, B, None, g, **settings)
    return result.x, result.z


SOLVERS = {"piqp": _piqp, "proxqp": _proxqp}
