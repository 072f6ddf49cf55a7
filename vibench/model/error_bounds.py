"""A-posteriori error bounds from an exact identity, without inf-sup, coercivity or continuity constants.

At one parameter let (u, λ) solve (7), let u_N be any vector and λ_N ≥ 0 any multiplier. With e = u − u_N, ε = λ − λ_N,
the residual r = f − A u_N − Bᵀλ_N and s = B u_N − g, subtracting the equations gives A e + Bᵀε = r. Hence

    ρ² := ‖r‖²_{A⁻¹} = ‖e‖²_A + ‖Bᵀε‖²_{A⁻¹} + 2 (B e)ᵀε,

and B e = (B u − g) − s with λᵀ(B u − g) = 0 makes (B e)ᵀε = λ_Nᵀ(g − B u) − λᵀs + λ_Nᵀs. This is the identity

    ‖e‖²_A + ‖Bᵀε‖²_{A⁻¹} + 2 λ_Nᵀ(g − B u) = ρ² + 2 λᵀs − 2 λ_Nᵀs,                                        (i)

all of whose terms on the left are nonnegative. Only λᵀs on the right is unknown. Let B w ≥ s, and let

    ω = ‖w‖_A,    κ = λ_Nᵀ(B w − s) ≥ 0.

As λ ≥ 0, λᵀs ≤ λᵀB w = λ_NᵀB w + (Bᵀε)ᵀw, and (i) becomes ‖e‖²_A + ‖Bᵀε‖²_{A⁻¹} ≤ ρ² + 2κ + 2 (Bᵀε)ᵀw, where
2 (Bᵀε)ᵀw ≤ ‖Bᵀε‖²_{A⁻¹} + ω² gives the first of the bounds

    ‖e‖_A ≤ Δ_A = √(ρ² + ω² + 2κ),        ‖Bᵀε‖_{A⁻¹} ≤ min(√(Δ_A² + 2 rᵀw), ω + Δ_A).                   (ii)

Completing the square instead, ‖e‖²_A + (‖Bᵀε‖_{A⁻¹} − ω)² ≤ Δ_A², the last one. The second is twice the duality gap
of λ_N and the feasible v = u_N − w, which bounds ‖u − v‖²_A + ‖Bᵀε‖²_{A⁻¹}: (i) at v has the residual r + A w and the
excess B v − g = s − B w ≤ 0, for which λᵀ(B v − g) ≤ 0. It is evaluated as ‖r + A w‖²_{A⁻¹} + 2κ: Δ_A² + 2 rᵀw loses
half of the digits, and all of them where λ is small beside the error of u_N.

Only the part of r in the range of Bᵀ concerns λ. In the inner product of A⁻¹ the rest is A d with B d = 0, hence

    r = r_B + A d,    r_B = Bᵀξ,    ρ_B := ‖r_B‖_{A⁻¹} ≤ ρ,

and u_N + d has the same violation s as u_N, and the residual r_B beside λ_N. (ii) for this pair bounds the same ε with
ρ_B in the place of ρ. It leaves the bound of e as it is: e − d = A⁻¹(r_B − Bᵀε) is orthogonal to d in A, so that
‖e‖²_A = ‖d‖²_A + ‖e − d‖²_A and ρ² = ‖d‖²_A + ρ_B². Constants enter in the norms of V and W alone:

    ‖e‖_V ≤ Δ_A / √α,        ‖ε‖_W ≤ ‖Bᵀε‖_{A⁻¹} / β_A.

Δ_A is smallest for w = argmin ½‖w‖²_A + λ_NᵀB w subject to B w ≥ s, which has the structure of (7): stiffness A, load
−Bᵀλ_N, constraints −B w ≤ −s. The active set method starts from supp λ_N, where B w = s makes κ = 0. Any w with B w ≥ s
is valid, however it was found: optimality is not verified, feasibility is. s is raised by a margin above the round-off
of B u_N − g and of B w, and the w that is used satisfies the constraints by more than the bound of that round-off. Any
d for which w is feasible at u_N + d, too, gives a bound of ε; d = 0 where w is not feasible, or where constraints are
dependent and d is lost in round-off. The norms ρ, ρ_B and ω and the product κ are evaluated in floating-point
arithmetic without such a bound.

Equalities, a row and its opposite, leave no room for a margin. A w' that holds them is within η of the computed w
(`vibench.model.equalities`), and satisfies the other rows where w does by a margin. (ii) holds for w', with ω + η, with
‖r + A w‖_{A⁻¹} + η in the duality gap, and with 2 λ_Nᵀ|B(w' − w)| added to 2κ. λ is not unique there, nor is it where
other rows are dependent: β_A is zero, and its error is bounded in the norm ‖Bᵀε‖_{A⁻¹} alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Mask
from vibench.errors import NumericalError
from vibench.highfidelity.active_set import active_set_iterations
from vibench.interfaces.problem import VariationalInequality, is_absent
from vibench.linalg.inertia import UNIT
from vibench.model.equalities import Equalities
from vibench.model.errors import Energy
from vibench.qp.exact import least_distance_solution
from vibench.qp.rows import Rows, rows_that_matter
from vibench.qp.scaling import near_rows, ratio
from vibench.stability.coercivity import Constant, Stability

NO_ROOM = 1e-12
"""Opposite rows are an equality where there is less room between them than this share of the terms of B u_N − g."""

IMPLIED = 1e4
"""Equalities that depend on others hold with them up to this multiple of round-off, or the problem has no solution."""

REFERENCE = 1e-6
"""Largest error bound of a high-fidelity solution, relative to it in the energy norms."""

MARGIN = 4.0
"""The first margin of s, as a multiple of the round-off in s."""

IMPLAUSIBLE = 1e8
"""Multipliers this many times those that rows alone would have are of dependent constraints, solved in round-off."""

CANCELLED = 1e-4
"""A representer A⁻¹ℓ that is a sum of terms, whose norm is below this share of theirs, is computed anew from ℓ."""

ATTEMPTS = 4
"""Margins that are tried, each at least ten times the one before."""


@dataclass(frozen=True)
class ErrorBounds:
    """Absolute error bounds of one reduced solution, infinite where there are none.

    Attributes
    ----------
    u_energy, u
        Bounds of ‖u − u_N‖ in the norms of A and of V.
    lambda_natural, lam
        Bounds of ‖Bᵀ(λ − λ_N)‖ in the norm of A⁻¹ and of ‖λ − λ_N‖ in the norm of W.
    rho, rho_range, omega, kappa
        ρ, ρ_B and ω, in the unit of `u_energy`, and κ in that of its square.
    note
        Why there are none, or none in W, or which constant in them is estimated; "" where all are proved.
    """

    u_energy: float
    u: float
    lambda_natural: float
    lam: float
    rho: float
    rho_range: float
    omega: float
    kappa: float
    note: str = ""

    @classmethod
    def none(cls, note: str) -> ErrorBounds:
        """No bounds, and why."""
        inf = float("inf")
        return cls(inf, inf, inf, inf, inf, inf, inf, inf, note)


NOT_IN_CONE = "λ_N has negative coefficients"
ON_ABSENT_ROW = "λ_N is not zero on a row whose g is infinite"
NO_CORRECTION = "no w with B w ≥ s was found"
ESTIMATED = "α is estimated"
NOT_UNIQUE = "λ has no bound in W: no β_A > 0 is proved, as where rows are dependent or equalities"


def error_bounds(
    vis: Sequence[VariationalInequality],
    energies: Sequence[Energy],
    constants: Sequence[Stability],
    u: Array,
    lam: Array,
) -> list[ErrorBounds]:
    """Bounds (ii) of reduced u (n×P) and λ (m×P), column by column at the parameters of `vis`."""
    given = zip(vis, energies, constants, u.T, lam.T, strict=True)
    return [bound_errors_at(vi, energy, c.coercivity, c.energy_inf_sup, *one) for vi, energy, c, *one in given]


def bound_errors_at(
    vi: VariationalInequality, energy: Energy, alpha: Constant, beta: Constant, u: Array, lam: Array
) -> ErrorBounds:
    """Bounds (ii) of one reduced u (n,) and λ (m,), from lower bounds of α and of β_A."""
    if np.min(lam, initial=0.0) < 0.0:
        return ErrorBounds.none(NOT_IN_CONE)
    if np.any(lam[is_absent(vi.g)]):
        return ErrorBounds.none(ON_ABSENT_ROW)
    corrected = find_correction(vi, energy, u, lam)
    if corrected is None:
        return ErrorBounds.none(NO_CORRECTION)
    of_u = terms(corrected, vi, energy, u, lam)
    with_d = _with_constrained_residual(of_u, corrected, vi, energy, u, lam)
    of_lam = min((of_u, *with_d), key=lambda terms: terms.rho)
    in_V = of_u.primal / float(np.sqrt(alpha.value))
    in_W = of_lam.dual / beta.value if beta.value > 0.0 else float("inf")
    terms_of_both = of_u.rho, of_lam.rho, of_u.omega, of_u.kappa
    notes = [ESTIMATED] * (not alpha.proved) + [NOT_UNIQUE] * (not beta.value > 0.0)
    return ErrorBounds(of_u.primal, in_V, of_lam.dual, in_W, *terms_of_both, "; ".join(notes))


def reference_bound(vi: VariationalInequality, energy: Energy, u: Array, lam: Array) -> float:
    """Δ_A / S of a high-fidelity solution u (n,) and λ ≥ 0 (m,), S² = ‖u‖²_A + ‖Bᵀλ‖²_{A⁻¹}; infinite without a w.

    Residuals say less: what is κ in Δ_A is only the square of an error. `vi` and `energy` are of the same parameter.

    Raises
    ------
    NumericalError
        If it is above `REFERENCE`, and Δ_A above what the round-off of B u − g leaves open.
    """
    correction = find_correction(vi, energy, u, lam)
    if correction is None:
        return float("inf")
    bound = terms(correction, vi, energy, u, lam).primal
    size = float(np.hypot(energy.norm(u), energy.norm_of_force(vi.B.T @ lam)))
    open_by_round_off = np.sqrt(4.0 * MARGIN * float(lam @ np.nan_to_num(_round_off(vi, u, correction.w), posinf=0.0)))
    if not bound <= max(REFERENCE * size, open_by_round_off):
        raise NumericalError(
            f"the error bound of the high-fidelity solution is {ratio(bound, size):.1e} of it in the energy norm, "
            f"above {REFERENCE:.0e}"
        )
    return ratio(bound, size)


class CorrectionMode(StrEnum):
    """Which solutions are corrected: none, all, or those whose violation dominates the bound, ω > ρ."""

    NONE = "none"
    FEASIBLE = "feasible"
    AUTO = "auto"

    def applies(self, omega: float, rho: float) -> bool:
        """Whether a solution with these ω and ρ is corrected."""
        return self is CorrectionMode.FEASIBLE or (self is CorrectionMode.AUTO and omega > rho)


@dataclass(frozen=True)
class CorrectedPair:
    """v = u_N − w (n,) and ν ≥ 0 (m,), and the ω and ρ of u_N and λ_N: the pair is more accurate where ω > ρ.

    v is feasible, ν complementary to it, and the residual of both is r: they solve (7) with the load f − r. The errors
    are bounded by `bound_errors_at`, as those of any other pair; nothing but the residual is left there.
    """

    u: Array
    lam: Array
    omega: float
    rho: float


def corrected_pair(vi: VariationalInequality, energy: Energy, u: Array, lam: Array) -> CorrectedPair | None:
    """The pair that the correction of u_N (n,) and λ_N ≥ 0 (m,) leads to; `None` without one."""
    correction = find_correction(vi, energy, u, lam)
    if correction is None:
        return None
    rho = energy.dual_norm(vi.f - vi.A @ u - vi.B.T @ lam)
    omega = energy.norm(correction.w) + correction.eta
    return CorrectedPair(u - correction.w, np.maximum(correction.nu, 0.0), omega, rho)


@dataclass(frozen=True)
class Terms:
    """The terms of (ii), with A⁻¹r (n,) and ‖r + A w‖_{A⁻¹}, and the bounds that need no constants."""

    riesz: Array
    rho: float
    omega: float
    kappa: float
    feasible_rho: float

    @property
    def primal(self) -> float:
        """Δ_A."""
        return float(np.sqrt(self.rho**2 + self.omega**2 + 2.0 * self.kappa))

    @property
    def dual(self) -> float:
        """The bound of ‖Bᵀε‖ in the norm of A⁻¹."""
        gap = self.feasible_rho**2 + 2.0 * self.kappa  # twice the duality gap
        return min(float(np.sqrt(gap)), self.omega + self.primal)


@dataclass(frozen=True)
class Constraints:
    """The rows of one inequality that matter, and those of them that are equalities."""

    vi: VariationalInequality
    rows: Rows
    equalities: Equalities | None

    @classmethod
    def of(cls, vi: VariationalInequality, energy: Energy, u: Array, lam: Array) -> Constraints:
        """As a correction of u_N (n,) and λ_N (m,) reads them."""
        room = NO_ROOM * (abs(sp.csr_array(vi.B)) @ np.abs(u) + np.abs(vi.g))
        rows, equalities = rows_that_matter(vi.B, vi.g, room, lam), None
        if rows.equal.any():
            K = energy.factor.solve_factor_transposed(sp.csr_array(vi.B)[rows.kept[rows.equal]].toarray().T)
            equalities = Equalities.of(K, energy.factor.solve_factor, vi.B)
        return cls(vi, rows, equalities)

    def moved(self, u: Array, w: Array) -> Array:
        """The correction w (n,) with the equalities held."""
        return w if self.equalities is None else w - self.equalities.step(_slack(self.vi, u, w)[self.rows.equalities])

    def lacking(self, u: Array, w: Array) -> tuple[Array, float]:
        """What rows may lack of B w' ≥ s in exact arithmetic (m,), and η, a bound of ‖w' − w‖_A."""
        slack, round_off, eta, equal = _slack(self.vi, u, w), _round_off(self.vi, u, w), 0.0, self.rows.equalities
        lacking = np.where(self.rows.implied, 0.0, round_off - slack)
        if self.equalities is not None:
            eta = self.equalities.distance((np.abs(slack) + round_off)[equal])
            lacking = np.where(self.rows.implied, 0.0, lacking + eta * self.equalities.reach)
            missed = np.abs(slack[equal]) > IMPLIED * round_off[equal]
            missed[self.equalities.chosen] = False
            lacking[equal[missed]] = np.inf
        return lacking, eta


@dataclass(frozen=True)
class Correction:
    """A w (n,) with B w ≥ s also in exact arithmetic, and ν ≥ 0 (m,) with A w = Bᵀ(ν − λ_N).

    As A(u_N − w) + Bᵀν = f − r and ν is complementary to B(u_N − w) ≤ g, u_N − w and ν solve (7) with the load f − r:
    up to the residual of (u_N, λ_N), ν is the high-fidelity multiplier. It is approximate where w is. Where there are
    equalities B w ≥ s holds for a w' with ‖w' − w‖_A ≤ `eta`.
    """

    w: Array
    nu: Array
    eta: float
    constraints: Constraints


def terms(
    correction: Correction,
    vi: VariationalInequality,
    energy: Energy,
    u: Array,
    lam: Array,
    near: tuple[Array, float] | None = None,
) -> Terms:
    """The terms with a correction of u (n,) and λ ≥ 0 (m,).

    `near` are A⁻¹r (n,) and the ρ of the pair that it follows from; by default A⁻¹r is computed. No other solution with
    A is needed, since A⁻¹(r + A w) = A⁻¹r + w.
    """
    w, eta, equalities = correction.w, correction.eta, correction.constraints.equalities
    residual, kappa = vi.f - vi.A @ u - vi.B.T @ lam, max(0.0, float(lam @ _slack(vi, u, w)))
    if equalities is not None:
        kappa += eta * float(lam @ equalities.reach)
    if near is None:
        riesz = energy.riesz(residual)
        rho = float(np.sqrt(max(float(residual @ riesz), 0.0)))
        largest = rho
    else:
        riesz, largest = near
        rho = _dual_norm(energy, residual, riesz, largest)
    of_feasible = _dual_norm(energy, residual + vi.A @ w, riesz + w, largest) + eta
    return Terms(riesz, rho, energy.norm(w) + eta, kappa, of_feasible)


def _dual_norm(energy: Energy, functional: Array, riesz: Array, largest: float) -> float:
    """‖ℓ‖_{A⁻¹} of a functional ℓ (n,) from A⁻¹ℓ (n,), a sum of terms whose norm is at most about `largest`."""
    norm = float(np.sqrt(max(float(functional @ riesz), 0.0)))
    return norm if norm >= CANCELLED * largest else energy.dual_norm(functional)


def _with_constrained_residual(
    of_u: Terms, correction: Correction, vi: VariationalInequality, energy: Energy, u: Array, lam: Array
) -> Iterator[Terms]:
    """The terms for u + d, whose residual is the part of r in the range of Bᵀ, if w is feasible for it and d exists.

    d is A⁻¹r without the displacement of the forces ξ that hold B d = 0; they load the contact alone.
    """
    constraints = correction.constraints
    rows = constraints.rows.kept[near_rows(vi)[constraints.rows.kept]]  # any d will do for which w is feasible
    B = sp.csr_array(vi.B)[rows]
    program = VariationalInequality(vi.A, np.zeros_like(u), B, -(B @ of_u.riesz))
    system = energy.stiffness.active_set_system(program)
    try:
        held = system.recover(system.solve_active(np.arange(len(rows)))[0])
    except (RuntimeError, np.linalg.LinAlgError):  # an exactly singular system
        return
    d = of_u.riesz + held
    lacking, eta = constraints.lacking(u + d, correction.w)
    if np.all(lacking <= 0.0):
        yield terms(replace(correction, eta=eta), vi, energy, u + d, lam, (-held, of_u.rho))


def find_correction(vi: VariationalInequality, energy: Energy, u: Array, lam: Array) -> Correction | None:
    """A correction of s = B u − g that is close to the best one; `None` if none was found.

    Parameters
    ----------
    vi, energy
        A, f, B and g at one parameter, and the factorisations of A.
    u, lam
        u_N (n,) and λ_N ≥ 0 (m,).
    """
    constraints = Constraints.of(vi, energy, u, lam)
    kept, equal = constraints.rows.kept, constraints.rows.equal
    B, excess = sp.csr_array(vi.B)[kept], (vi.B @ u - vi.g)[kept]
    margin = np.where(equal, 0.0, MARGIN * _round_off(vi, u, np.zeros_like(u))[kept])
    largest = IMPLAUSIBLE * max(np.max(lam, initial=0.0), _largest_multiplier(replace(vi, B=B), excess))
    doubtful = None
    for _ in range(ATTEMPTS):
        raised = VariationalInequality(vi.A, -(vi.B.T @ lam), -B, -(excess + margin))
        for w, forces in _minimisers(raised, energy, equal, lam[kept] > 0.0, largest):
            moved = constraints.moved(u, w)
            lacking, eta = constraints.lacking(u, moved)
            if not np.all(lacking <= 0.0):  # NaN is not
                margin = np.maximum(margin, 2.0 * np.nan_to_num(lacking[kept], nan=0.0, posinf=0.0))
                continue
            found = Correction(moved, constraints.rows.multipliers(forces, len(vi.g)), eta, constraints)
            if np.max(forces[~equal], initial=0.0) <= largest:
                return found
            doubtful = found
        margin = 10.0 * margin
    return doubtful


def _minimisers(
    program: VariationalInequality, energy: Energy, equal: Mask, start: Mask, largest: float
) -> Iterator[tuple[Array, Array]]:
    """Solutions and multipliers of the program, up to round-off: by active sets, then as a least distance problem.

    Active sets of constraints that are dependent but for round-off may have a w that is feasible and huge, with a
    multiplier above `largest`: the other follows it.
    """
    system = energy.stiffness.active_set_system(program)
    for active in (start, np.zeros_like(start)):
        settled = active_set_iterations(system, active, equal)
        if settled is not None:
            yield system.recover(settled[0]), settled[1]
            if np.max(settled[1][~equal], initial=0.0) <= largest:
                return
    if (nearest := least_distance_solution(program, energy.factor, equal, start)) is not None:
        yield nearest


def _largest_multiplier(vi: VariationalInequality, excess: Array) -> float:
    """An upper bound of the largest multiplier s / b A⁻¹ bᵀ that a row b w ≥ s of the excess s (m,) would have alone.

    It is at most s b A bᵀ / |b|⁴, by the inequality of Cauchy and Schwarz.
    """
    B = sp.csr_array(vi.B)
    squares, energies = (np.asarray((B * other).sum(axis=1)) for other in (B, B @ vi.A))
    shares = np.divide(energies, squares**2, out=np.zeros_like(squares), where=squares > 0.0)
    return float(np.max(excess * shares, initial=0.0))


def _slack(vi: VariationalInequality, u: Array, w: Array) -> Array:
    """B w − s (m,)."""
    return np.asarray(vi.B @ w - (vi.B @ u - vi.g))


def _round_off(vi: VariationalInequality, u: Array, w: Array) -> Array:
    """Bound (m,) of the round-off in `_slack` (Higham 2002, §3.1)."""
    B = sp.csr_array(vi.B)
    terms = np.diff(B.indptr) + 4.0
    return np.asarray(1.01 * terms * UNIT * (abs(B) @ (np.abs(w) + np.abs(u)) + np.abs(vi.g)))
