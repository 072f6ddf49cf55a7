"""High-fidelity solutions of the variational inequality (7) by a verified primal–dual active set method."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask, SparseMatrix, read_only
from vibench.errors import NumericalError, at_parameter
from vibench.highfidelity.kkt_systems import ActiveSetSystem, CondensedStiffness, condensed_stiffness
from vibench.interfaces.dual_sets import BlockKind, DualSet, refuse_blocks
from vibench.interfaces.problem import NestedStart, OfBox, Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly, in_float64, settled
from vibench.linalg import EPS
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.inner_product import InnerProduct, check_positive_definite, check_symmetric, factorised_later
from vibench.linalg.schur_complement import FEW_PER_UNKNOWN, EliminationPattern
from vibench.qp import verification
from vibench.qp.exact import Directions, least_distance_solution, rows_that_matter
from vibench.qp.scaling import peak, ratio, row_norms
from vibench.qp.solve import solve_qp
from vibench.signatures import bordered, rule_of
from vibench.text import one_line, shown

Iterated = tuple[Array, Array, int]  # u (n,), λ (m,) and the number of linear systems
# Largest natural residual of a snapshot (`vibench.qp.verification`).
ACCURACY = 1e-10


@dataclass(frozen=True)
class ActiveSetSolution:
    """Displacement u (n,) and multiplier λ (m,) at one parameter, not verified yet; λ is exactly zero off contact.

    `fallback` says what was used besides the active set method, "" if nothing; `iterations` counts its linear systems.
    """

    u: Annotated[Array, "n"]
    lam: Annotated[Array, "m"]
    fallback: str
    iterations: int


@dataclass(frozen=True)
class HighFidelitySolution(ActiveSetSolution):
    """Verified solution of (7) at one parameter; its natural KKT residuals are at most `ACCURACY`."""

    residuals: verification.Residuals


@bordered
class HighFidelitySolver:
    """Solves one problem at many parameters, each from the contact set of the nearest one solved, or its `start`.

    The primal–dual active set method (Hintermüller, Ito, Kunisch 2002) solves the equality-constrained system of the
    current active set until the set no longer changes. If the sets cycle, the method restarts from the active set of an
    interior-point solution; it never returns that solution itself, since greedy cones need multipliers with exact zeros
    off the contact set. Systems are condensed on the constrained unknowns where these are few. The elimination order is
    computed once, and a stiffness that does not depend on the parameter is factorised once, as the problem declares by
    `constant` and `contact_dofs`. `condensing` tells whether systems are condensed on the constrained unknowns in any
    case: error bounds are of that size.
    """

    # What arguments of methods fit.
    _V: Annotated[InnerProduct, "n"]
    _W: Annotated[InnerProduct, "m"]
    _width: Annotated[Array, "d"]

    def __init__(self, problem: Problem, *, condensing: bool = False) -> None:
        self._problem, self._condensing, self._V, self._W = problem, condensing, problem.V, problem.W
        self._constrained = problem.contact_dofs if problem.contact_dofs is not None else np.zeros(0, dtype=np.intp)
        self._pattern: EliminationPattern | None = None
        self._stiffness: CondensedStiffness | None = None
        # The constant stiffness that was found symmetric positive definite.
        self._coercive: CondensedStiffness | None = None
        self._width = np.maximum(problem.parameters.upper - problem.parameters.lower, np.finfo(float).tiny)
        self._coarse: HighFidelitySolver | None = None
        self._solved: list[Array] = []
        self._active: list[Mask] = []

    def solve(self, mu: OfBox) -> HighFidelitySolution:
        """Assemble and solve at mu (d,).

        Raises a `NumericalError` if the assembly is invalid, the solution does not reach `ACCURACY`, the problem
        refuses it, or B touches unknowns outside the declared `contact_dofs`.
        """
        return self.solve_next(mu, checked_assembly(self._problem, mu))

    def solve_next(self, mu: OfBox, vi: VariationalInequality) -> HighFidelitySolution:
        """As `solve`, of what vibench itself has assembled: checks would take a tenth of a solution that is timed."""
        solution = self.verify(mu, vi, self.solve_assembled(mu, vi))
        self.remember(mu, solution)
        return solution

    def solve_assembled(self, mu: OfBox, vi: VariationalInequality) -> ActiveSetSolution:
        """Solve the variational inequality `vi` assembled at mu (d,); unless remembered, no other starts from it.

        Raises a `NumericalError` that names mu, and what A lacks if that is the cause.
        """
        nearest: Mask | None = None
        if self._active:
            distances = np.linalg.norm((np.array(self._solved) - mu) / self._width, axis=1)
            nearest = self._active[int(np.argmin(distances))]
        return self.solve_from(nearest, mu, vi)

    def solve_from(self, nearest: Mask | None, mu: OfBox, vi: VariationalInequality) -> ActiveSetSolution:
        """As `solve_assembled`, from the contact set of another parameter (m,) or from none."""
        refuse_blocks(vi.K, [BlockKind.INTERVAL], "the active set method")
        with at_parameter(mu), _explained(vi, f"A at mu = {mu.tolist()}"):
            return solve_unverified(vi, self.condensed(vi), self._start(mu, nearest))

    def verify(self, mu: OfBox, vi: VariationalInequality, unverified: ActiveSetSolution) -> HighFidelitySolution:
        """The solution of `vi`, which has to be the variational inequality solved last, at mu (d,), verified.

        Raises a `NumericalError` that names mu if A is not symmetric positive definite, which a constant one is asked
        once, the residuals are above `ACCURACY`, or the problem refuses the solution.
        """
        name = f"A at mu = {mu.tolist()}"
        with at_parameter(mu), _explained(vi, name):
            stiffness = self._stiffness or self.condensed(vi)
            if self._coercive is not stiffness:
                check_symmetric(vi.A, name)
                stiffness.check_definite(name)
                self._coercive = stiffness if "A" in self._problem.constant else None
            solution = verified(vi, stiffness, unverified)
            if reason := self._problem.refuse(mu, read_only(solution.u), read_only(solution.lam)):
                raise NumericalError(one_line(str(reason)))
            return solution

    def remember(self, mu: OfBox, solution: ActiveSetSolution) -> None:
        """Let later solutions start from the contact set of this one, at mu (d,)."""
        self._solved.append(mu)
        self._active.append(read_only(self._problem.K.free(solution.lam)))

    def forget(self) -> None:
        """Forget all solutions, so that no later one starts from them; factorisations stay."""
        self._solved.clear()
        self._active.clear()

    def _start(self, mu: Array, nearest: Mask | None) -> Mask | None:
        """The initial active set, which the problem derives from the contact set of the nearest parameter."""
        with factorised_later():
            start, m = self._problem.start(mu.copy(), nearest), self._W.dim
            if isinstance(start, NestedStart) and (self._coarse is None or self._coarse._problem is not start.coarse):
                start.coarse.factorised_by(self._problem.factorisation)
                self._coarse = HighFidelitySolver(start.coarse)
        if isinstance(start, NestedStart):
            assert self._coarse is not None
            # Remember nothing there: the start must depend on the parameter alone.
            coarse = self._coarse.solve_assembled(mu, checked_assembly(start.coarse, mu))
            return start.coarse.K.free(coarse.lam)[start.nearest]
        if start is not None and not (rule_of(Mask).holds(start) and start.shape == (m,)):
            raise NumericalError(f"start returns {shown(start)}; expected truth values ({m},), a NestedStart, or None")
        return start

    def condensed(self, vi: VariationalInequality) -> CondensedStiffness:
        """The stiffness of `vi` condensed on the constrained unknowns; one object where A is constant."""
        touched = np.zeros(vi.B.shape[1], bool)
        touched[sp.csr_array(vi.B).indices] = True
        touched[self._constrained] = False
        outside = np.flatnonzero(touched)
        if len(outside):
            if self._problem.contact_dofs is not None:
                undeclared = f"{len(outside)} unknowns outside the declared contact_dofs, the first is {outside[0]}"
                raise NumericalError(f"B touches {undeclared}")
            self._constrained, self._pattern = np.union1d(self._constrained, outside), None
        if self._pattern is None:
            self._pattern, self._stiffness = self._elimination(vi), None
        if self._stiffness is None or "A" not in self._problem.constant:
            before, factorisation = self._stiffness, self._problem.factorisation
            self._stiffness = condensed_stiffness(vi.A, self._pattern, factorisation, before, vi.K)
        return self._stiffness

    def _elimination(self, vi: VariationalInequality) -> EliminationPattern:
        """The unknowns to eliminate: none where A varies, few rows constrain, and no dense matrix would be left.

        One factorisation per parameter is then enough for the first system, its borders and the verification.
        """
        factorisation = self._problem.factorisation
        pattern = EliminationPattern.of(vi.A, self._constrained, factorisation)
        # The multipliers are the last unknowns of this sparse factorisation, which is dense there.
        few = len(vi.g) <= min(1000, FEW_PER_UNKNOWN * len(vi.f))
        if self._condensing or "A" in self._problem.constant or pattern.is_dense or not few:
            return pattern
        return EliminationPattern.of_none(vi.A)


def solve_high_fidelity(
    vi: VariationalInequality, stiffness: CondensedStiffness | None = None, start: Annotated[Mask, "m"] | None = None
) -> HighFidelitySolution:
    """Solve one variational inequality, with sparse A and B, to `ACCURACY`; see `HighFidelitySolver`.

    `stiffness` is A condensed already, by default it is used as it is; `start` is the initial active set (m,), empty by
    default. Raises a `NumericalError` if A is not symmetric positive definite, or neither the active set method nor its
    fallback reaches `ACCURACY`.
    """
    vi = settled(in_float64(vi))
    refuse_blocks(vi.K, [BlockKind.INTERVAL], "the active set method")
    check_symmetric(vi.A, "A")
    with _explained(vi, "A"):
        stiffness = stiffness or CondensedStiffness(vi.A)
        unverified = solve_unverified(vi, stiffness, start)
        stiffness.check_definite("A")
        return verified(vi, stiffness, unverified)


@contextmanager
def _explained(vi: VariationalInequality, name: str) -> Iterator[None]:
    """Say what A, called by `name`, lacks where it is the cause of a failure in the block."""
    try:
        yield
    except (NumericalError, RuntimeError, np.linalg.LinAlgError):
        check_positive_definite(vi.A, name)
        raise


def solve_unverified(
    vi: VariationalInequality, stiffness: CondensedStiffness, start: Mask | None = None
) -> ActiveSetSolution:
    """Solve one variational inequality up to round-off; arguments are those of `solve_high_fidelity`.

    Raises a `NumericalError` if neither the active set method nor its fallback finds a solution.
    """
    # Opposite rows whose bounds differ by round-off are an equality.
    reading = rows_that_matter(vi.B, vi.g, 1e-14 * np.abs(vi.g), K=vi.K)
    program = reading.program(vi)
    system = stiffness.active_set_system(program)
    starts = [] if start is None else [start[reading.kept]]
    for active in [*starts, np.zeros(len(reading.kept), bool)]:
        if settled := _solution_everywhere(system, active, reading.equal):
            u, forces, iterations = settled
            fallback = ""
            break
    else:
        _refuse_contradictions(program, reading.kept)
        (u, forces, iterations), fallback = _without_cycling(program, reading.equal, system)
    lam = reading.multipliers(forces, len(vi.g))
    # A large rigid displacement amplifies round-off in the eliminated unknowns; a stiff problem does so everywhere.
    if system.iterating is None and _is_inaccurate(vi, u, lam):
        u = u + system.correct_eliminated(vi.f - vi.A @ u - vi.B.T @ lam)
        if _is_inaccurate(vi, u, lam):
            u, lam = _refined(vi, stiffness, u, lam)
    return ActiveSetSolution(u, lam, fallback, iterations)


def verified(
    vi: VariationalInequality, stiffness: CondensedStiffness, unverified: ActiveSetSolution
) -> HighFidelitySolution:
    """A solution with its natural residuals, refined where these are above `ACCURACY`.

    Raises a `NumericalError` if they are still above it then.
    """
    solution = _refined_to_accuracy(vi, stiffness, unverified)
    if not solution.residuals.worst <= ACCURACY:
        # Condensation may lose more digits than refinement wins back.
        plain = CondensedStiffness(vi.A)
        again = solve_unverified(vi, plain, vi.K.free(solution.lam))
        fallback = "; ".join(filter(None, (unverified.fallback, "solved without condensation")))
        solution = _refined_to_accuracy(vi, plain, replace(again, fallback=fallback))
    if not solution.residuals.worst <= ACCURACY:
        left = f"{solution.residuals.worst:.1e}, above {ACCURACY:.0e}"
        raise NumericalError(f"the high-fidelity solution has the natural residual {left}")
    return solution


def _refined_to_accuracy(
    vi: VariationalInequality, stiffness: CondensedStiffness, unverified: ActiveSetSolution
) -> HighFidelitySolution:
    """The solution after as many steps of iterative refinement as `ACCURACY` takes, at most three."""
    u, lam = unverified.u, unverified.lam
    residuals = verification.kkt_residuals(vi, u, lam, stiffness, ACCURACY)
    for _ in range(3):
        if residuals.worst <= ACCURACY:
            break
        u, lam = _refined(vi, stiffness, u, lam)
        residuals = verification.kkt_residuals(vi, u, lam, stiffness, ACCURACY)
    return HighFidelitySolution(u, lam, unverified.fallback, unverified.iterations, residuals)


def _refuse_contradictions(vi: VariationalInequality, numbers: Indices) -> None:
    """Raise a `NumericalError` with the `numbers` of two opposite rows of B that no u satisfies together."""
    found = Directions.of(sp.csr_array(vi.B), vi.K.rays(len(vi.g)))
    bounds = vi.g[found.members] / found.lengths[found.members]
    gaps = np.where(np.bincount(found.group, found.side) == 0.0, np.bincount(found.group, bounds), 0.0)
    if len(gaps) and gaps.min() < -1e-6 * np.abs(bounds).max():
        i, j = numbers[found.members[found.group == np.argmin(gaps)]]
        raise NumericalError(f"rows {i} and {j} of B are opposite, and no u satisfies both of their bounds g")


def _without_cycling(vi: VariationalInequality, equal: Mask, system: ActiveSetSystem) -> tuple[Iterated, str]:
    """The solution where active sets cycle, or are linearly dependent, and the name of the fallback."""
    if vi.K.blocks:
        if (settled := _solution_everywhere(system, np.zeros(len(vi.g), bool), equal, one_by_one=True)) is None:
            raise NumericalError("no active set solves the high-fidelity problem; is it feasible?")
        return settled, "the active set cycled; its rows were changed one by one"
    answer, guess = solve_qp(vi, "piqp", ACCURACY), np.zeros(len(vi.g), bool)
    if not equal.any() and answer.alpha is not None and np.all(np.isfinite(answer.alpha)):
        weights = answer.alpha * row_norms(vi.B)
        guess = weights > 1e-8 * np.max(weights, initial=0.0)
        settled = _solution_everywhere(system, guess)
        if settled is not None:
            return settled, "the active set cycled; first guess by piqp"
    if (exact := least_distance_solution(vi, SparseCholesky(vi.A, "A"), equal, guess)) is None:
        raise NumericalError("no active set solves the high-fidelity problem; is it feasible?")
    return (*exact, 0), "the active set cycled; solved as a least distance problem"


def _is_inaccurate(vi: VariationalInequality, u: Array, lam: Array) -> bool:
    """Whether the largest entry of the residual, relative to those of its terms, is more than round-off."""
    Au, force = vi.A @ u, vi.B.T @ lam
    return ratio(peak(Au - vi.f + force), max(peak(Au), peak(vi.f), peak(force))) > 5e-11


def _refined(vi: VariationalInequality, stiffness: CondensedStiffness, u: Array, lam: Array) -> tuple[Array, Array]:
    """One step of iterative refinement on the active set, with residuals in extended precision."""
    residual, excess = verification.accurate_residuals(vi, u, lam)
    active = np.flatnonzero(vi.K.free(lam))
    system = stiffness.active_set_system(replace(vi, f=residual, g=-excess))
    try:
        change, forces = system.holding(active)
    except (RuntimeError, np.linalg.LinAlgError):
        # The constraints are dependent, and nothing better is known.
        return u, lam
    return u + change, vi.K.project(lam + forces)


def _solution_everywhere(
    system: ActiveSetSystem, active: Mask, equal: Mask | None = None, *, one_by_one: bool = False
) -> Iterated | None:
    """The u (n,), λ (m,) and iterations of the active set method; `None` where it finds no solution.

    Rows beyond the zone of the system are checked when those in it are settled, and enlarge it where they are violated.
    """
    iterations = 0
    while True:
        system = system.watching(active if equal is None else active | equal)
        if (settled := active_set_iterations(system, active, equal, one_by_one=one_by_one)) is None:
            return None
        u, lam, iterations = system.recover(settled[0]), settled[1], iterations + settled[2]
        if system.beyond is None:
            return u, lam, iterations
        B, g = sp.csr_array(system.beyond.vi.B), system.beyond.vi.g
        violated = ~system.beyond.watched & (B @ u - g > _unit(B) * (abs(B) @ np.abs(u) + np.abs(g)))
        if not violated.any():
            return u, lam, iterations
        active = (lam > 0.0) | violated  # only contact has a zone


def _unit(B: SparseMatrix) -> Array:
    """Round-off (m,) of B u − g, relative to the sum of its terms, that counts as no violation."""
    # A violation is at least four times the bound of the round-off of its row.
    return np.asarray(4.0 * EPS * (np.diff(B.indptr) + 2.0))


def active_set_iterations(
    system: ActiveSetSystem, active: Mask, equal: Mask | None = None, *, one_by_one: bool = False
) -> Iterated | None:
    """Run the primal–dual active set method from an initial active set (m,): u (c,), λ (m,) and iterations.

    Constraints that are `equal` (m,) stay active, whatever the sign of their multiplier. The result is `None` if the
    sets cycle or one of them has linearly dependent constraints. Signs are decided row by row, against the round-off of
    the row itself, and multipliers are compared as forces: no result depends on the scaling of a row, or on a far one.

    A row with an interval has three states: it is active, or λ = ±c, on the side of B u − g. With `one_by_one` only the
    last row that has to change does, which ends for independent rows (Murty 1974), however slowly.
    """
    seen: set[bytes] = set()
    always = np.zeros_like(active) if equal is None else equal
    active, m = active | always, len(active)
    B, g, weights, c = system.B, system.g, row_norms(system.B), system.K.radii(m)
    sizes, unit, slips = abs(B), _unit(B), np.isfinite(c)
    fixed = np.zeros(m) if slips.any() else None
    for iteration in range(1, max(100, (10 if one_by_one else 1) * m) + 1):  # the contact set may move node by node
        try:
            u, lam = system.solve_active(np.flatnonzero(active), fixed)
        except (RuntimeError, np.linalg.LinAlgError):  # an exactly singular system
            return None
        forces, excess = weights * lam, B @ u - g
        off = unit * (sizes @ np.abs(u) + np.abs(g)) + (system.iterating.noise if system.iterating else 0.0)
        violated = ~active & (excess > off)
        if system.beyond is not None:
            violated &= system.beyond.watched
        # A force that is round-off does not hold a row in contact.
        in_contact = active & (forces > 1e-14 * np.max(np.abs(forces), initial=0.0))
        following = violated | in_contact | always
        if fixed is not None:
            following, held = _three_states(system.K, active, fixed, lam, excess, off, following)
            changed = np.flatnonzero((following != active) | (held != fixed))
            if one_by_one and len(changed):
                following = np.where(np.arange(m) == changed[-1], following, active)
                held = np.where(np.arange(m) == changed[-1], held, fixed)
            key = following.tobytes() + held.tobytes()
        else:
            held, changed, key = None, np.flatnonzero(following != active), following.tobytes()
        if system.iterating is None or system.iterating.is_exact:
            if not len(changed):
                return u, lam, iteration
            if key in seen:
                return None
            seen.add(key)
        active, fixed = following, held
    return None


def _three_states(
    K: DualSet, active: Mask, fixed: Array, lam: Array, excess: Array, off: Array, rays: Mask
) -> tuple[Mask, Array]:
    """The next active rows (m,), those of rays being known, and the multipliers (m,) of rows that slip.

    `excess` is B u − g and `off` (m,) the round-off in it.
    """
    c, following, held = K.radii(len(lam)), rays.copy(), np.zeros_like(fixed)
    slips = np.isfinite(c)
    # λ = ±c up to round-off is both states: the present one stays.
    beyond = slips & active & (np.abs(lam) > c * (1.0 + 1e-12))
    held[beyond] = np.copysign(c, lam)[beyond]
    moving = slips & ~active & (np.abs(excess) > off)
    # A row that moves against its force sticks; one without a force gets it.
    right = moving & ((fixed == 0.0) | (fixed * excess > 0.0))
    held[right] = np.copysign(c, excess)[right]
    still = slips & ~active & ~moving & (fixed != 0.0)
    held[still] = fixed[still]
    following[slips] = ~(beyond | right | still)[slips]
    return following, held
