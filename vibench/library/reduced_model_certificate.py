"""Error bounds of a reduced model exported by vibench: `Model(file).solve(mu, tolerance=1e-2)`, by `reduced_model.py`.

u_N and λ_N ≥ 0 are compared with u and λ of the high-fidelity problem. The errors of the polynomials that replace its
θ_q, as measured in the parameter box, are in the bounds; outside the box there are none. With X that does not depend on
mu, α X ≼ A(mu) ≼ γ X, the residual r, and w such that B w ≥ s = B u_N − g,

    ‖u − u_N‖²_A ≤ Δ² = ρ²/α + γ ω² + 2κ,    ρ = ‖r‖_{X⁻¹},    ω = ‖w‖_X,    κ = λ_Nᵀ(B w − s),
    ‖Bᵀ(λ − λ_N)‖_{A⁻¹} ≤ min(√(Δ² + 2 rᵀw), ω √γ + Δ);    see "Bounds at online cost" in the documentation of vibench.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from math import inf, sqrt
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
UNIT, TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)
STEPS, ATTEMPTS, MARGIN = 30, 4, 4.0


class Bound(NamedTuple):
    """Bounds of ‖u − u_N‖_A, ‖Bᵀ(λ − λ_N)‖_{A⁻¹}, ‖u − u_N‖_A / ‖u‖_A; "certified", "verified", or "none" and why."""

    u_energy: float
    lambda_natural: float
    relative: float
    guarantee: str
    note: str = ""


class Lifting(NamedTuple):
    """Of a w: θ (ν − λ)/γ on the loaded rows, ‖w‖, bounds of B w − s, and in which loaded rows that may be positive."""

    load: Array
    norm: float
    slack: Array
    released: Mask


class Certified(NamedTuple):
    """A `Solution` of `reduced_model.py`, its bounds, and whether `relative` keeps the tolerance."""

    solution: Any
    bound: Bound
    verdict: str


class Model:
    """A reduced model from a file with error bounds; `plain` is that of `reduced_model.py`."""

    def __init__(self, file: str | Path, solver: str = "") -> None:
        self.plain = import_module(__name__.removesuffix("_certificate")).Model(file, solver)
        self.guarantee, start, data = str(self.plain.about["certificate"]), "certificate_", self.plain.data
        if why := self.plain.about["no_bounds"]:
            raise ValueError(f"'{file}' has no error bounds: {why}")
        self._known: tuple[bytes, tuple[float, float]] = b"", (1.0, 1.0)  # the spectrum at the last parameter
        slack = 1e-12 * np.maximum(abs(data["lower"]), abs(data["upper"]))
        self._box = data["lower"] - slack, data["upper"] + slack
        self._data: dict[str, Array] = {name.removeprefix(start): data[name] for name in data if name.startswith(start)}
        self._data["outputs_x"] = data.get("outputs_x", np.zeros((0, 0)))
        self._data["bound_sizes"] = abs(self._data["bounds"])
        compliance = self._data["responses"][self._data["rows"]]
        self._data["compliance"] = 0.5 * (compliance + compliance.T)

    def solve(self, mu: Sequence[float] | Array, tolerance: float | None = None, corrected: bool = False) -> Certified:
        """The solution at a parameter and its bounds; the tolerance is of the relative error of u in the norm of A.

        With `corrected`, `u` and `lam` of the solution and the bounds are those of the corrected pair u_N − w and ν,
        which satisfies the constraints, c X w = Bᵀ(ν − λ_N) with c = ½ (α + γ); x and α are as they are without. Where
        there is no bound nothing is corrected. A file without bases has ν alone.
        """
        if tolerance is not None and not 0.0 < tolerance < inf:
            raise ValueError(f"the tolerance is {tolerance}, expected a positive finite number")
        solution = self.plain.solve(mu)
        at = np.asarray(mu, dtype=float)
        bound, rho, lifting = self._bound(at, solution.x, solution.alpha, solution.energy)
        if corrected and lifting is not None:
            solution, bound = self._pair(at, solution, bound, rho, lifting)
        solution = solution._replace(output_bounds=self.plain.named(self._of_outputs(at, bound)))
        kept = tolerance is not None and solution.status == "ok" and bound.relative <= tolerance
        verdict = "no tolerance" if tolerance is None else bound.guarantee if kept else "not certified"
        return Certified(solution, bound, verdict)

    def _pair(self, mu: Array, solution: Any, bound: Bound, rho: float, found: Lifting | None) -> tuple[Any, Bound]:
        """The corrected pair of a solution with bounds, ρ/√α and the w `found` for them, and its own bounds."""
        A, B, g = (self.plain.member(f"theta_{name}", mu) for name in "ABg")
        (lower, upper), lam, theta = self._spectrum(mu, A), self._data["generators"] @ solution.alpha, float(B[0])
        c, rows = 0.5 * (lower + upper), self._data["rows"]
        if found is not None and c != upper:
            found = self._lifting(theta, g, solution.x, lam, c, found.released)
        if found is None:
            none = "no corrected pair was found at this parameter: the solution is that of the reduced model"
            return solution, bound._replace(note=none)
        a, norm, slack, _ = found
        nu = lam.copy()
        nu[rows] = np.maximum(lam[rows] + (c / theta) * a, 0.0)
        missed = float(self._data["constraint_error"]) / abs(theta) * c  # of θ in c X w = Bᵀ(ν − λ_N)
        rho += (0.5 * (upper - lower) + missed) / sqrt(lower) * norm
        both = sqrt(rho**2 + 2.0 * max(0.0, float(nu @ slack)))
        least = bound.u_energy / bound.relative if bound.relative > 0.0 else 0.0  # of ‖u‖
        u = None if solution.u is None or "lift" not in self._data else solution.u - self._data["lift"] @ a
        own = Bound(both, both, both / least if least > 0.0 else inf, bound.guarantee)
        outputs = solution.outputs
        if outputs:
            of_x, of_lam, of_a = (self._data[f"outputs_{name}"] for name in ("x", "lam", "shift"))
            outputs = self.plain.named(of_x @ solution.x + of_lam @ nu - of_a @ a)
        return solution._replace(u=u, lam=nu, outputs=outputs), own

    def _of_outputs(self, mu: Array, bound: Bound) -> Array:
        """Bounds of the errors of outputs, from those of u and λ."""
        weights = self._data.get("outputs_weights", np.zeros((0, 2)))
        if bound.guarantee == "none" or not len(weights):
            return np.full(len(weights), inf)
        A, B = self.plain.member("theta_A", mu), self.plain.member("theta_B", mu)
        (lower, upper), least = self._spectrum(mu, A), abs(float(B[0])) - float(self._data["constraint_error"])
        force = bound.lambda_natural * sqrt(upper) / least if least > 0.0 else inf
        of_lam = np.array([weight * force if weight > 0.0 else 0.0 for weight in weights[:, 1]])
        return np.asarray(weights[:, 0] * bound.u_energy / sqrt(lower) + of_lam)

    def _bound(self, mu: Array, y: Array, alpha: Array, energy: float) -> tuple[Bound, float, Lifting | None]:
        """Bounds of a solution: u_N has the coordinates y in the basis, λ_N is generators · α, `energy` is ‖u_N‖²_A.

        And ρ/√α, and the w in them; none without bounds.
        """
        data, lam = self._data, self._data["generators"] @ alpha
        if not np.isfinite(y.sum() + lam.sum()):
            return _none("there is no solution")
        if lam.min(initial=0.0) < 0.0:
            return _none("λ_N has negative coefficients")
        if ((mu < self._box[0]) | (mu > self._box[1])).any():
            return _none("mu is outside the parameter box")
        A, f, B, g = (self.plain.member(f"theta_{name}", mu) for name in "AfBg")
        lower, upper = self._spectrum(mu, A)
        error = float(data["stiffness_error"])
        lifting = self._lifting(float(B[0]), g, y, lam, upper) if lower > error else None
        if lifting is None:
            which = "α > 0" if lower <= error else "w with B w ≥ s"
            return _none(f"no {which} was found at this parameter")
        a, norm, slack, _ = lifting
        along, kappa = a @ data["directions"], max(0.0, float(lam @ slack))
        z = np.concatenate([f, (-A[:, None] * y).ravel(), (-B[:, None] * alpha).ravel()])
        kept = z[data["kept"]]
        coordinates, scaled = data["factor"] @ kept, data["inverse_scale"] * kept
        beside = float(data["remainder"]) * sqrt(scaled @ scaled)
        of_energy = float(data["energy_error"] * (y @ y))
        of_u = sqrt(max(0.0, energy + of_energy) / (lower - error))
        lacking = float(data["norms"] @ abs(z)) + float(data["load_error"]) + error * of_u
        lacking += float(data["constraint_error"] * (data["multiplier_norms"] @ abs(alpha)))
        rho = sqrt(coordinates @ coordinates + beside**2) + lacking
        omega = norm * sqrt(upper)
        square = rho**2 / lower + omega**2 + 2.0 * kappa
        found = sqrt(square)
        work = float(along @ coordinates) + (beside + lacking) * norm
        least = sqrt(max(0.0, energy - of_energy - error * of_u**2)) - found
        natural = min(sqrt(max(0.0, square + 2.0 * work)), omega + found)
        relative = found / least if least > 0.0 else inf
        return Bound(found, natural, relative, self.guarantee), rho / sqrt(lower), lifting

    def _spectrum(self, mu: Array, theta: Array) -> tuple[float, float]:
        """α and γ from the values at the anchors around mu, a grid of the parameter box."""
        data, at = self._data, mu.tobytes()
        if "anchors" not in data:
            return 1.0, 1.0
        if self._known[0] == at:
            return self._known[1]
        count, where, weights = int(data["count"]), [0], [1.0]
        for at, low, high in zip(mu, data["lower"], data["upper"], strict=True) if count > 1 else ():
            place = min(max((at - low) / max(high - low, TINY), 0.0), 1.0) * (count - 1)
            first = min(int(place), count - 2)
            where = [k * count + first + end for k in where for end in (0, 1)]
            weights = [weight * share for weight in weights for share in (first + 1.0 - place, place - first)]
        found = np.array(weights) @ data["anchors"][where]
        lacking = float(abs(theta - found[2:]) @ data["term_norms"]) + 2.0 * float(data["spectral_error"])
        self._known = at, (float(found[0]) - lacking, float(found[1]) + lacking)
        return self._known[1]

    def _lifting(
        self, theta: float, of_g: Array, y: Array, lam: Array, gamma: float, released: Mask | None = None
    ) -> Lifting | None:
        """A w with B w ≥ s in spite of all errors; `released` says where B w > s at a γ nearby."""
        data, unit = self._data, 1.01 * float(self._data["terms"]) * UNIT
        if theta == 0.0:
            return None
        rows, size = data["rows"], abs(theta) * data["sizes"]
        excess = theta * (data["basis"] @ y) - data["bounds"] @ of_g
        share, of_y = float(data["constraint_error"]) / abs(theta), sqrt(y @ y) * size[:, 0]
        error = share * of_y + data["bound_errors"]
        uncertain = error + unit * (of_y + data["bound_sizes"] @ abs(of_g))
        margin, here = MARGIN * uncertain, lam[rows]
        for _ in range(ATTEMPTS):
            scale, wanted = gamma / theta**2, (excess + margin)[rows]
            released = here * data["diagonal"] <= -scale * wanted if released is None else released
            nu, released = self._complementary(scale, wanted, here, released)
            a = (theta / gamma) * (np.maximum(nu, 0.0) - here)
            values = data["responses"] @ a
            slack = theta * values - excess
            of_w = float(data["reach"] @ abs(a)) * size[:, 1]
            lacking = uncertain + (unit + share) * of_w - slack
            if lacking.max() <= 0.0:
                norm = sqrt(max(0.0, float(a @ values[rows])))
                return Lifting(a, norm, slack + error + share * of_w, released)
            margin = margin + 2.0 * np.maximum(lacking, 0.0)
        return None

    def _complementary(self, scale: float, excess: Array, lam: Array, released: Mask) -> tuple[Array, Mask]:
        """ν = λ + scale · M (s + v) with ν, v ≥ 0 and νᵀv = 0, by the primal-dual active set method; where v ≥ 0.

        A system is one with M for v where that is released, or one with M⁻¹ for ν elsewhere, whichever is smaller.
        """
        inverse, compliance = self._data["inverse"], self._data["compliance"]
        fixed: Array | None = None
        load: Array | None = None
        for _ in range(STEPS):
            K, held = released.nonzero()[0], (~released).nonzero()[0]
            if len(K) <= len(held):
                rows, fixed = inverse[K], lam + scale * (inverse @ excess) if fixed is None else fixed
                v = np.linalg.solve(rows[:, K], -fixed[K])
                nu: Array = fixed + v @ rows
                nu[K] = 0.0
                wanted = nu < 0.0
                wanted[K] = v >= 0.0
            else:
                rows, load = compliance[held], compliance @ lam + scale * excess if load is None else load
                nu = np.zeros(len(lam))
                nu[held] = np.linalg.solve(rows[:, held], load[held])
                wanted = nu[held] @ rows >= load
                wanted[held] = nu[held] < 0.0
            if np.array_equal(wanted, released):
                return nu, released
            released = wanted
        fixed = lam + scale * (inverse @ excess)
        return fixed + inverse @ _descent(inverse, fixed), released  # it cycles


def _none(why: str) -> tuple[Bound, float, Lifting | None]:
    return Bound(inf, inf, inf, "none", why), inf, None


def _descent(M: Array, fixed: Array) -> Array:
    """The minimiser v ≥ 0 of ½ vᵀM v + ν₀ᵀv (Lawson and Hanson 1974, chapter 23), for which M v + ν₀ = ν."""
    size, unit = len(fixed), np.sqrt(M.diagonal())
    v, positive, passed = np.zeros(size), np.zeros(size, bool), np.zeros(size, bool)
    for _ in range(20 * size):
        nu = (fixed + M @ v + UNIT * size * (abs(fixed) + abs(M) @ v)) / unit
        entering = int(np.argmin(np.where(positive | passed, 0.0, nu)))
        if positive[entering] or passed[entering] or nu[entering] >= 0.0:
            break
        before, positive[entering] = v, True
        while np.any(positive):
            K, z = positive.nonzero()[0], np.zeros(size)
            z[K] = np.linalg.solve(M[np.ix_(K, K)], -fixed[K])
            blocking = positive & (z <= 0.0)
            if v is before and blocking[entering]:  # round-off made its sign
                positive[entering], passed[entering] = False, True
                break
            if not np.any(blocking):
                v, passed = z, np.zeros(size, bool)
                break
            steps = np.where(blocking, v / np.where(blocking, v - z, 1.0), np.inf)
            v = v + steps.min() * (z - v)
            positive &= (steps > steps.min()) & (v > 0.0)
            v[~positive] = 0.0
    return v
