"""A-posteriori error bounds from an exact identity, without inf-sup, coercivity or continuity constants.

Let (u, λ) solve (7), u_N be any vector and λ_N ≥ 0 any multiplier; e = u − u_N, ε = λ − λ_N, r = f − A u_N − Bᵀλ_N and
s = B u_N − g. For any w with B w ≥ s, with ρ = ‖r‖_{A⁻¹}, ω = ‖w‖_A and κ = λ_Nᵀ(B w − s),

    ‖e‖²_A + ‖Bᵀε‖²_{A⁻¹} + 2 λ_Nᵀ(g − B u) = ρ² + 2 λᵀs − 2 λ_Nᵀs,                                        (i)
    ‖e‖_A ≤ Δ_A = √(ρ² + ω² + 2κ),        ‖Bᵀε‖_{A⁻¹} ≤ min(√(Δ_A² + 2 rᵀw), ω + Δ_A)                     (ii)

as docs/mathematics.md shows, "Error bounds". The second bound is twice the duality gap of λ_N and the feasible u_N − w.
It is evaluated as ‖r + A w‖²_{A⁻¹} + 2κ: Δ_A² + 2 rᵀw loses half of the digits, and all of them where λ is small beside
the error of u_N. It holds for u_N + d, too, where A d + Bᵀξ = r and B d = 0, with ρ_B = ‖Bᵀξ‖_{A⁻¹} ≤ ρ in place of ρ,
by any d for which w is feasible. Constants enter in the norms of V and W alone, ‖e‖_V ≤ Δ_A / √α and
‖ε‖_W ≤ ‖Bᵀε‖_{A⁻¹} / β_A.

Δ_A is smallest for w = argmin ½‖w‖²_A + λ_NᵀB w subject to B w ≥ s, found by the active set method; the optimality of w
is not verified, its feasibility is (`vibench.model.bound_terms`). ρ, ρ_B, ω and κ are upper bounds of what they are in
exact arithmetic (`vibench.model.proved_norms`). Where there are equalities (ii) holds for w', with ω + η, with
‖r + A w‖_{A⁻¹} + η in the duality gap, and with 2 λ_Nᵀ|B(w' − w)| added to 2κ. λ is not unique there: β_A is zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot, inf

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Mask
from vibench.errors import NumericalError
from vibench.highfidelity.active_set import active_set_iterations
from vibench.interfaces.absent_rows import is_absent
from vibench.interfaces.dual_sets import BlockKind
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg import EPS, UNIT_ROUND_OFF
from vibench.linalg.inner_product import InnerProduct
from vibench.model.bound_terms import BoundNote, BoundTerms, Equalities, first_margin, outside_note
from vibench.model.contact_form import ContactForm, Representer
from vibench.model.errors import EnergyNorm, solutions, with_one_stiffness
from vibench.model.proved_norms import ProvedNorms
from vibench.qp.exact import Rows, least_distance_solution, rows_that_matter
from vibench.qp.scaling import ratio
from vibench.qp.verification import extended
from vibench.stability.coercivity import Constant, share_of_diagonal

# largest error bound of a high-fidelity solution, relative to it in the energy norms
REFERENCE = 1e-6


@dataclass(frozen=True)
class ErrorBounds:
    """Absolute error bounds of one reduced solution, infinite where there are none."""

    # Bounds of ‖u − u_N‖ in the norms of A and of V.
    u_energy: float
    u: float
    # Bounds of ‖Bᵀ(λ − λ_N)‖ in the norm of A⁻¹ and of ‖λ − λ_N‖ in the norm of W.
    lambda_natural: float
    lam: float
    # ρ, ρ_B and ω, in the unit of `u_energy`, and κ in that of its square.
    rho: float
    rho_range: float
    omega: float
    kappa: float
    # Why there are none, or none in W, or which constant in them is estimated; "" where all are proved.
    note: str = ""

    @classmethod
    def none(cls, note: str) -> ErrorBounds:
        """No bounds, and why."""
        return cls(inf, inf, inf, inf, inf, inf, inf, inf, str(note))


@dataclass(frozen=True)
class _Pair:
    """One pair u_N (n,) and λ_N ≥ 0 (m,), its residual r and p ≈ A⁻¹r (n,), a proved α, and its correction."""

    u: Array
    lam: Array
    r: Array
    p: Array
    energy: EnergyNorm
    alpha: float
    correction: Correction


def error_bounds(
    V: InnerProduct, vis: Sequence[VariationalInequality], energies: Sequence[EnergyNorm],
    constants: Sequence[tuple[Constant, Constant]], u: Array, lam: Array, pressed: Mask | None = None,
    residuals: Sequence[Array] | None = None,
) -> list[ErrorBounds]:  # fmt: skip
    """Bounds (ii) of reduced u (n×P) and λ (m×P), column by column, from lower bounds of α and β_A at each parameter.

    `pressed` (m×P) are rows that multipliers press where these are known: ν is nearly λ, so that corrections of all
    pairs at one parameter start there, and from one factor. `residuals` (n,) are those of the pairs, where known. Pairs
    with one A share the work with it.
    """
    u, lam, starts = u.T, lam.T, [None] * len(vis) if pressed is None else list(pressed.T)
    residuals = residuals or [residual(*one) for one in zip(vis, u, lam, strict=True)]
    found, pairs = [ErrorBounds.none(BoundNote.NO_CORRECTION)] * len(vis), dict[int, _Pair]()
    share, solved = share_of_diagonal(V), solutions(energies, residuals)
    for k, (vi, energy, (alpha, _), start) in enumerate(zip(vis, energies, constants, starts, strict=True)):
        if not vi.K.contains(lam[k]):
            found[k] = ErrorBounds.none(outside_note(vi.K))
        elif np.any(lam[k][is_absent(vi.g)]):
            found[k] = ErrorBounds.none(BoundNote.ON_ABSENT_ROW)
        elif not alpha.value * share.value > 0.0:
            found[k] = ErrorBounds.none(BoundNote.ROUND_OFF)
        elif (correction := find_correction(vi, energy, u[k], lam[k], start)) is not None:
            pairs[k] = _Pair(u[k], lam[k], residuals[k], solved[k], energy, alpha.value, correction)
    floor = share.value * V.matrix.diagonal()
    for numbers in with_one_stiffness(energies):
        norms, some = ProvedNorms(energies[numbers[0]].A, precise=False), [k for k in numbers if k in pairs]
        # A solution takes half as long among sixteen as alone, and no less among more.
        for block in (some[first : first + 8] for first in range(0, len(some), 8)):
            for k, terms in zip(block, _terms_of([pairs[k] for k in block], norms, floor), strict=True):
                proved = terms if terms.accurate else _refined(pairs[k], terms, norms.precise, floor)
                found[k] = proved.bounds(*constants[k], share.proved)
    return found


def bound_errors_at(
    V: InnerProduct, vi: VariationalInequality, energy: EnergyNorm, alpha: Constant, beta: Constant, u: Array,
    lam: Array,
) -> ErrorBounds:  # fmt: skip
    """Bounds (ii) of one reduced u (n,) and λ (m,), from lower bounds of α and of β_A."""
    return error_bounds(V, [vi], [energy], [(alpha, beta)], u[:, None], lam[:, None])[0]


def residual(vi: VariationalInequality, u: Array, lam: Array) -> Array:
    """The residual r = f − A u − Bᵀλ (n,)."""
    return np.asarray(vi.f - vi.A @ u - vi.B.T @ lam)


@dataclass(frozen=True)
class _ProvedTerms:
    """Upper bounds of the terms for u and for λ; infinite where η is not proved.

    `rest` is the computed r − A p (n,), `missed` bounds its norm in A⁻¹, and `share` is the largest one that round-off
    may have in the square of a norm of A.
    """

    of_u: BoundTerms
    of_lam: BoundTerms
    rest: Array
    missed: float
    share: float
    note: str

    @property
    def accurate(self) -> bool:
        """Whether round-off is in the last digits of the bounds only."""
        return self.missed <= 1e-3 * self.of_lam.dual and self.share <= 1e-6

    def bounds(self, alpha: Constant, beta: Constant, proved: bool) -> ErrorBounds:
        """The bounds (ii); `proved` tells whether the lower bound of the norm of V is."""
        of_u, of_lam, estimated = self.of_u, self.of_lam, not (alpha.proved and proved)
        in_V = of_u.primal / float(np.sqrt(alpha.value))
        in_W = of_lam.dual / beta.value if beta.value > 0.0 else inf
        found = [BoundNote.ESTIMATED] * estimated + [BoundNote.NOT_UNIQUE] * (not beta.value > 0.0)
        notes = [*found, self.note] if self.note else found
        terms = of_u.rho, of_lam.rho, of_u.omega, of_u.kappa
        return ErrorBounds(of_u.primal, in_V, of_lam.dual, in_W, *terms, "; ".join(notes))


def _refined(pair: _Pair, found: _ProvedTerms, norms: ProvedNorms, floor: Array) -> _ProvedTerms:
    """The terms from those in double precision, by norms in extended precision, with p refined while that helps."""
    vi = pair.correction.contact.vi
    pair = replace(pair, r=vi.f - norms.A @ pair.u - extended(vi.B).T @ pair.lam)
    for attempt in range(3):
        (terms,) = _terms_of([pair], norms, floor)
        if attempt and not terms.missed < 0.5 * found.missed:
            break
        found = terms
        if found.accurate:
            break
        pair = replace(pair, p=extended(pair.p) + pair.energy.stiffness.solve(found.rest[:, None])[:, 0])
    return found


def _terms_of(pairs: Sequence[_Pair], norms: ProvedNorms, floor: Array) -> Iterator[_ProvedTerms]:
    """The terms of k pairs with one A ≽ α diag(`floor`), whose residuals are in the precision of the norms."""
    count, contact = len(pairs), pairs[0].correction.contact
    u, r, p = (np.column_stack([getattr(pair, name) for pair in pairs]) for name in ("u", "r", "p"))
    on_contact = list(contact.values(p).astype(float).T)
    held = [_held(pair.correction, values) for pair, values in zip(pairs, on_contact, strict=True)]
    # where there is no h its column is not used
    ends = [values if h is None else h for h, values in zip(held, on_contact, strict=True)]
    parts = contact.extended(np.column_stack([*(pair.correction.values for pair in pairs), *ends])).astype(p.dtype)
    for k in (k for k, h in enumerate(held) if h is on_contact[k]):  # h is p there
        parts[contact.retained, count + k] = contact.values(p[:, k])
    vectors = np.empty((len(p), 4 * count), p.dtype)
    vectors[:, :count], vectors[:, count : 3 * count] = p, parts
    np.add(parts[:, :count], parts[:, count:], out=vectors[:, 3 * count :])
    products = norms.A @ vectors
    rest, sizes = np.asarray(r - products[:, :count], float), norms.magnitude @ (np.abs(u) + np.abs(p).astype(float))
    for k, (own, lam) in enumerate((pair.correction.contact, pair.lam) for pair in pairs):
        sizes[:, k] += np.abs(own.vi.f)
        sizes[own.retained, k] += own.sizes.T @ lam
    columns = max(int(np.max(np.bincount(pair.correction.contact.B.indices), initial=0)) for pair in pairs)
    missed = norms.dual_norms(rest, sizes, columns, floor) / np.sqrt([pair.alpha for pair in pairs])
    lengths, shares = (values.reshape(4, count).T for values in norms.energies(vectors, products))
    for k, pair in enumerate(pairs):
        beyond = float(missed[k]) if pair.correction.constraints.proves_distances(norms) else inf
        start, share, of_lam = contact.values(pair.u), float(np.max(shares[k])), None
        rho, omega, rho_range, feasible = lengths[k].tolist()
        if held[k] is not None:
            step, terms = contact.values(p[:, k] - parts[:, count + k]), (rho_range + beyond, omega, feasible + beyond)
            of_lam = _moved_terms(pair, start, step, norms.unit / UNIT_ROUND_OFF, terms)
        if of_lam is None:
            along = p[:, [k]] + parts[:, [k]]
            (feasible,), (lost,) = norms.energies(along, norms.A @ along)
            share = max(share, float(lost))
        correction, terms = pair.correction, (rho + beyond, omega, float(feasible) + beyond)
        of_u = _with_round_off(correction, start, np.abs(start), pair.lam, correction.eta, terms)
        yield _ProvedTerms(of_u, of_u if of_lam is None else of_lam, rest[:, k], beyond, share, correction.note)


def _moved_terms(
    pair: _Pair, start: Array, step: Array, unit: float, terms: tuple[float, float, float]
) -> BoundTerms | None:
    """The terms for λ, those of u + d, d = p − h, with the displacement h of the forces that hold B d = 0.

    The residual r − A d = r − A p + A h is the part of r in the range of Bᵀ. Any d will do for which w is feasible:
    `None` if it is not. `start` and `step` are contact values (c,) of u and d, and `unit` is the round-off in d.
    """
    moved = (start + step).astype(float)
    # what is rounded in d counts as a part of its terms
    size = np.abs(moved) + unit * np.abs(step).astype(float)
    lacking, eta = pair.correction.constraints.lacking(moved, pair.correction.values, size)
    return _with_round_off(pair.correction, moved, size, pair.lam, eta, terms) if np.all(lacking <= 0.0) else None


def _held(correction: Correction, p: Array) -> Array | None:
    """The displacement h (c,) for p (c,) of the forces that hold B d = 0; `None` where rows are dependent."""
    contact = correction.contact
    # any d will do for which w is feasible: far rows are left out, and the check covers them
    rows = correction.constraints.rows.kept[contact.near[correction.constraints.rows.kept]]
    if len(rows) == contact.B.shape[0] == contact.B.shape[1]:
        # as many rows as unknowns: B d = 0 leaves nothing of d there
        return p
    try:
        return contact.holding(rows, p).values
    except (RuntimeError, np.linalg.LinAlgError):  # an exactly singular system
        return None


def _with_round_off(
    correction: Correction, u: Array, size: Array, lam: Array, eta: float, norms: tuple[float, float, float]
) -> BoundTerms:
    """Upper bounds of the terms for contact values u (c,), from norms ‖r‖_{A⁻¹}, ‖w‖_A and ‖r + A w‖_{A⁻¹}.

    `size` (c,) bounds the terms of u.
    """
    contact, w, equalities = correction.contact, correction.values, correction.constraints.equalities
    kappa = contact.vi.K.gap(lam, _slack(contact, u, w), _round_off(contact, size, w)) * (1.0 + (len(lam) + 16.0) * EPS)
    if equalities is not None:
        kappa += eta * float(lam @ equalities.reach)
    rho, omega, feasible = norms
    return BoundTerms(rho, omega + eta, kappa, (feasible + eta) ** 2 + 2.0 * kappa)


def reference_bound(vi: VariationalInequality, energy: EnergyNorm, u: Array, lam: Array) -> float:
    """Δ_A / F of a high-fidelity solution u (n,) and λ ≥ 0 (m,), or over S without contact; infinite without a w.

    Residuals say less: what is κ in Δ_A is only the square of an error. `vi` and `energy` are of the same parameter.
    Raises a `NumericalError` if it is above `REFERENCE`, and Δ_A above what the round-off of B u − g leaves open.
    """
    if (correction := find_correction(vi, energy, u, lam)) is None:
        return inf
    bound, contact = bound_terms(correction, u, lam).primal, correction.contact
    size = contact.contact_energy(lam)
    if not bound <= REFERENCE * size and not contact.least_contact:
        size = hypot(energy.norm(u), contact.force_norm(lam))
    round_off = np.nan_to_num(_round_off(contact, np.abs(contact.values(u)), correction.values), posinf=0.0)
    # 2κ is at most twice λᵀ times the first margin and the round-off itself, where w was found at once
    open_by_round_off = np.sqrt(4.0 * vi.K.gap(lam, np.zeros_like(lam), first_margin(round_off)))
    if not bound <= max(REFERENCE * size, open_by_round_off):
        what = f"the error bound of the high-fidelity solution is {ratio(bound, size):.1e} of it in the energy norm"
        raise NumericalError(f"{what}, above {REFERENCE:.0e}")
    return ratio(bound, size)


@dataclass(frozen=True)
class CorrectedPair:
    """The pair v = u_N − w (n,) and ν ≥ 0 (m,), and ω and ρ of u_N and λ_N: it is more accurate where ω > ρ.

    v is feasible, ν complementary to it, and the residual of both is r: they solve (7) with the load f − r. The errors
    are bounded by `bound_errors_at`, as those of any other pair; nothing but the residual is left there.
    """

    u: Array
    lam: Array
    omega: float
    rho: float


def corrected_pair(vi: VariationalInequality, energy: EnergyNorm, u: Array, lam: Array) -> CorrectedPair | None:
    """The pair that the correction of u_N (n,) and λ_N ≥ 0 (m,) leads to; `None` without one."""
    if (correction := find_correction(vi, energy, u, lam)) is None:
        return None
    terms = bound_terms(correction, u, lam)
    return CorrectedPair(u - correction.w, vi.K.project(correction.nu), terms.omega, terms.rho)


@dataclass(frozen=True)
class Constraints:
    """The rows of one inequality that matter, and those of them that are equalities."""

    contact: ContactForm
    rows: Rows
    equalities: Equalities | None

    @classmethod
    def classify(cls, energy: EnergyNorm, contact: ContactForm, u: Array, lam: Array) -> Constraints:
        """Choose rows for a correction of u_N with retained unknowns u (c,) and λ_N (m,)."""
        vi = contact.vi
        # opposite rows with less room than 1e-12 of the terms of s are an equality: no margin would fit between them
        room = 1e-12 * (contact.sizes @ np.abs(u) + np.abs(vi.g))
        rows, equalities = rows_that_matter(contact.B, vi.g, room, lam, contact.directions, vi.K), None
        if rows.equal.any():
            K = energy.factor.solve_factor_transposed(sp.csr_array(vi.B)[rows.equalities].toarray().T)
            equalities = Equalities.from_rows(K, lambda y: contact.values(energy.factor.solve_factor(y)), contact.B)
        return cls(contact, rows, equalities)

    def moved(self, u: Array, w: Array, forces: Array) -> tuple[Array, Array]:
        """The correction w (c,) with the equalities held, and the forces (m,) that it follows from as w from others."""
        if self.equalities is None:
            return w, forces
        missing, moved = _slack(self.contact, u, w)[self.rows.equalities], forces.copy()
        moved[self.rows.equalities[self.equalities.chosen]] -= self.equalities.forces(missing)
        return w - self.equalities.step(missing), moved

    def lacking(self, u: Array, w: Array, size: Array) -> tuple[Array, float]:
        """Upper bounds (m,) of what rows lack of B w' ≥ s in exact arithmetic, and η, a bound of ‖w' − w‖_A.

        `size` (c,) bounds the terms of u.
        """
        slack, round_off = _slack(self.contact, u, w), _round_off(self.contact, size, w)
        if self.equalities is None:
            return np.where(self.rows.implied, 0.0, round_off - slack), 0.0
        equal = self.rows.equalities
        eta = self.equalities.distance((np.abs(slack) + round_off)[equal])
        lacking = np.where(self.rows.implied, 0.0, round_off - slack + eta * self.equalities.reach)
        # Equalities that depend on the chosen ones hold with them. Where one misses by 10⁴ times the round-off they
        # contradict each other, and the problem has no solution.
        missed = np.abs(slack[equal]) > 1e4 * round_off[equal]
        missed[self.equalities.chosen] = False
        lacking[equal[missed]] = np.inf
        return lacking, eta

    def proves_distances(self, norms: ProvedNorms) -> bool:
        """Tell whether η is proved: its factor of two covers ‖M y‖_A ≤ 3/2 |y| and |B_E M y| ≥ 3/4 σ_min |y|."""
        if (E := self.equalities) is None:
            return True
        chosen, M, unit = self.rows.equalities[E.chosen], E.liftings, 1.0 / E.lengths[:, None]
        missed = np.linalg.norm(unit * (self.contact.B[chosen] @ M) - E.factor.T)
        lost = unit * (self.contact.sizes[chosen] @ np.abs(M)) * (self.contact.entries[chosen] + 8.0)[:, None]
        far = float(missed + EPS * (np.linalg.norm(lost) + 16.0 * len(chosen) ** 2))
        return far <= 0.25 * E.smallest and norms.largest(extended(self.contact.extended(E.liftings))) <= 1.5


@dataclass(frozen=True)
class Correction:
    """Correction w with B w ≥ s also in exact arithmetic, and ν ≥ 0 (m,) with A w = Bᵀ(ν − λ_N).

    As A(u_N − w) + Bᵀν = f − r and ν is complementary to B(u_N − w) ≤ g, u_N − w and ν solve (7) with the load f − r:
    up to the residual of (u_N, λ_N), ν is the high-fidelity multiplier. It is only approximate if w is. Where there are
    equalities B w ≥ s holds for a w' with ‖w' − w‖_A ≤ `eta`.

    `values` are the retained unknowns (c,) of w, the extension of these with the smallest energy; `load` is A w there.
    """

    values: Array
    load: Array
    nu: Array
    eta: float
    constraints: Constraints
    note: str = ""

    @property
    def contact(self) -> ContactForm:
        """The inequality on the retained unknowns."""
        return self.constraints.contact

    @cached_property
    def w(self) -> Array:
        """The correction w (n,)."""
        return self.contact.extended(self.values)


def bound_terms(correction: Correction, u: Array, lam: Array) -> BoundTerms:
    """The terms with a correction of u_N (n,) and λ_N ≥ 0 (m,), without a bound of their round-off.

    A⁻¹(r + A w) = A⁻¹r + w.
    """
    contact, eta, equalities = correction.contact, correction.eta, correction.constraints.equalities
    riesz = contact.representer(residual(contact.vi, u, lam))
    kappa = contact.vi.K.gap(lam, _slack(contact, contact.values(u), correction.values))
    if equalities is not None:
        kappa += eta * float(lam @ equalities.reach)
    omega = Representer(correction.values, correction.load, 0.0).norm + eta
    feasible = contact.norm(riesz.plus(correction.values, correction.load), riesz.norm) + eta
    return BoundTerms(riesz.norm, omega, kappa, feasible**2 + 2.0 * kappa)


def find_correction(
    vi: VariationalInequality, energy: EnergyNorm, u: Array, lam: Array, pressed: Mask | None = None
) -> Correction | None:
    """Find a correction of u_N (n,) and λ_N ≥ 0 (m,) that is close to the best one; `None` if none was found.

    Active sets start at the rows `pressed` (m,), by default those that λ_N presses.
    """
    contact = energy.contact_form(vi)
    u = contact.values(u)
    constraints = Constraints.classify(energy, contact, u, lam)
    kept, equal = constraints.rows.kept, constraints.rows.equal
    excess, rays = (contact.B @ u - vi.g)[kept], vi.K.rays(len(vi.g))[kept]
    # Only rays have something to satisfy, and so a margin, which no equality has.
    strict = rays & ~equal
    margin = np.where(strict, first_margin(_round_off(contact, np.abs(u), np.zeros_like(u)))[kept], 0.0)
    # the largest multiplier s / b A⁻¹bᵀ that a row b w ≥ s would have alone, from above
    alone = float(np.max(excess * contact.stiffnesses[kept], initial=0.0, where=rays))
    lengths = np.sqrt(contact.stiffnesses[kept])
    # multipliers 10⁸ times larger are those of dependent constraints, solved in round-off
    largest = 1e8 * max(np.max(lam, initial=0.0), alone)
    starts, doubtful = [chosen[kept] for chosen in (pressed, vi.K.free(lam)) if chosen is not None], None
    # Other blocks than intervals have no active sets: w = 0 serves.
    for _ in range(4 if vi.K.kinds <= {BlockKind.INTERVAL} else 0):
        for values, forces in _minimisers(constraints, energy, lam, excess + margin, starts, largest):
            multipliers = np.zeros(len(vi.g))
            multipliers[kept] = forces
            w, multipliers = constraints.moved(u, values, multipliers)
            lacking, eta = constraints.lacking(u, w, np.abs(u))
            if not np.all(lacking <= 0.0):  # NaN is not
                # w is solved for as a whole: what one row lacks by its round-off others may lack in the next attempt
                missed = np.nan_to_num(lacking[kept], nan=0.0, posinf=0.0) * lengths
                margin = np.maximum(margin, np.where(strict, 2.0 * np.max(missed, initial=0.0) / lengths, 0.0))
                continue
            nu, load = constraints.rows.multipliers(forces, len(vi.g)), contact.load(w, multipliers - lam)
            correction = Correction(w, load, nu, eta, constraints)
            if np.max(forces[strict], initial=0.0) <= largest:
                return correction
            doubtful = correction
        # ten times the margin: four attempts reach far beyond any round-off that is left
        margin = 10.0 * margin
    if doubtful is None and vi.K.blocks and not np.any(excess[rays] + margin[rays] > 0.0):
        zero = np.zeros_like(u)
        doubtful = Correction(zero, zero, lam, 0.0, constraints, BoundNote.UNCORRECTED)
    return doubtful


def _minimisers(
    constraints: Constraints, energy: EnergyNorm, lam: Array, least: Array, starts: Sequence[Mask], largest: float
) -> Iterator[tuple[Array, Array]]:
    """Minimisers of ½‖w‖²_A + λᵀB w with B w ≥ s in the k kept rows, on retained unknowns (c,), and forces (k,).

    Up to round-off, by active sets, then as a least distance problem: active sets of constraints that are dependent but
    for round-off may have a w that is feasible and huge, with a multiplier above `largest`. `least` is s (k,).
    """
    contact, kept, equal = constraints.contact, constraints.rows.kept, constraints.rows.equal
    system = contact.correction_system(kept, lam, least)
    for active in (*starts, np.zeros_like(equal)):
        settled = active_set_iterations(system, active, equal)
        if settled is not None:
            yield settled[:2]
            if np.max(settled[1][~equal], initial=0.0) <= largest:
                return
    vi = contact.vi
    if vi.K.blocks:
        if (settled := active_set_iterations(system, starts[-1], equal, one_by_one=True)) is not None:
            yield settled[:2]
        return
    program = VariationalInequality(vi.A, -(vi.B.T @ lam), -sp.csr_array(vi.B)[kept], -least)
    if (nearest := least_distance_solution(program, energy.factor, equal, starts[-1])) is not None:
        yield contact.values(nearest[0]), nearest[1]


def _slack(contact: ContactForm, u: Array, w: Array) -> Array:
    """The slack B w − s (m,), from retained unknowns (c,)."""
    return np.asarray(contact.B @ w - (contact.B @ u - contact.vi.g))


def _round_off(contact: ContactForm, size: Array, w: Array) -> Array:
    """Bound (m,) of the round-off in `_slack`, from a bound (c,) of the terms of u."""
    # a row of k terms and four operations more has at most γ_{k+4} < 1.01 (k + 4) u times its terms (Higham 2002, §3.1)
    terms = contact.sizes @ (np.abs(w) + size) + np.abs(contact.vi.g)
    return np.asarray(1.01 * (contact.entries + 4.0) * UNIT_ROUND_OFF * terms)
