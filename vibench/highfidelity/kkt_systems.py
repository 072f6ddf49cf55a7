"""KKT systems of the active set method: a condensed stiffness with the active constraints as equalities.

Dense work on all candidates of contact grows with the cube of their number, and most of them are never pressed. For
many candidates the system is that of the zone which contact reaches, found from a coarse problem whose multipliers are
constant on groups of neighbouring rows. Solutions do not depend on it: rows that touch other unknowns are checked by
products with every solution, and enlarge it where they are violated (`vibench.highfidelity.active_set`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.optimize import nnls
from scipy.sparse.csgraph import reverse_cuthill_mckee, structural_rank
from scipy.sparse.linalg import SuperLU, splu

from vibench.arrays import Array, Indices, Mask, SparseMatrix, times_dense
from vibench.interfaces.dual_sets import RAYS, DualSet
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg import EPS
from vibench.linalg.cholesky import OrderedFactor, SparseCholesky
from vibench.linalg.definite import MANY_UNKNOWNS, BlockDiagonal, Factor
from vibench.linalg.factorisations import DEFAULT, implementation
from vibench.linalg.inner_product import check_regular
from vibench.linalg.multigrid import MultigridFactor, NullSpaceSolver
from vibench.linalg.schur_complement import EliminationPattern, PrincipalSubmatrix, StaticCondensation
from vibench.qp.scaling import peak, row_norms
from vibench.qp.verification import Inverse, norms_by_solutions


def zone_of(B: SparseMatrix, rows: Mask) -> Indices:
    """Unknowns that some rows (m,) of B (m×n) and their neighbours touch, rising."""
    B = sp.csr_array(B)
    # With 15 % more rows the next parameters usually find their contact in the zone.
    wanted = min(len(rows), int(np.ceil(1.15 * np.sum(rows))))
    touching, reached = sp.csc_array(B), rows.copy()
    while True:
        unknowns: Indices = np.unique(B[reached].indices)
        if np.sum(reached) >= wanted:
            return np.asarray(unknowns)
        before = int(np.sum(reached))
        reached[touching[:, unknowns].indices] = True
        if np.sum(reached) == before:  # no neighbours are left
            return np.asarray(unknowns)


def watched(B: SparseMatrix, zone: Indices) -> Mask:
    """Rows (m,) of B (m×n) that touch no unknown outside of a zone."""
    outside, B = np.ones(B.shape[1], bool), sp.csr_array(B)
    outside[zone] = False
    rows = np.repeat(np.arange(B.shape[0]), np.diff(B.indptr))
    return np.asarray(np.bincount(rows, outside[B.indices], B.shape[0]) == 0.0)


def coarse_contact(solve: Callable[[Array], Array], vi: VariationalInequality) -> Mask:
    """Rows (m,) that are pressed in the coarse problem of `vi`, with whose stiffness `solve` solves."""
    B, m = sp.csr_array(vi.B), len(vi.g)
    order = reverse_cuthill_mckee(sp.csr_array(abs(B) @ abs(B).T), symmetric_mode=True)
    group = np.empty(m, np.intp)
    # Each of 64 groups takes one solution with A.
    group[order] = np.arange(m) * 64 // m
    finite = np.isfinite(vi.g)
    members = sp.csr_array((finite.astype(float), (group, np.arange(m))), shape=(64, m))
    coarse, bounds = members @ B, members @ np.where(finite, vi.g, 0.0)
    displacements = solve(np.column_stack([coarse.toarray().T, vi.f]))
    K, excess = coarse @ displacements[:, :-1], coarse @ displacements[:, -1] - bounds
    values, vectors = np.linalg.eigh(0.5 * (K + K.T))
    regular = values > EPS * len(values) * np.max(values, initial=0.0)
    root = np.sqrt(values[regular])
    try:
        forces, _ = nnls(root[:, None] * vectors[:, regular].T, (vectors[:, regular].T @ excess) / root)
    except RuntimeError:
        # Without convergence the rows that are violated without forces are a larger guess.
        forces = np.maximum(excess, 0.0)
    return np.asarray(forces[group] > 0.0)


class ActiveSolver(Protocol):
    """Solves with some constraints as equalities."""

    def __call__(self, active: Indices, fixed: Array | None = None) -> tuple[Array, Array]:
        """The u (c,) and λ (m,) with the active constraints as equalities; other multipliers are `fixed`, or vanish."""


class CondensedStiffness(Inverse):
    """A stiffness matrix A (n×n), sparse SPD, condensed on the unknowns that constraints involve.

    The pattern retains at least all unknowns that B touches; by default every unknown is retained. The `factorisation`
    eliminates the others, and factorises systems of active sets that have an order.
    """

    def __init__(
        self, A: SparseMatrix, pattern: EliminationPattern | None = None, factorisation: str = DEFAULT
    ) -> None:
        # Condensation does not pay where most unknowns are retained.
        if pattern is None or (pattern.whole is None and 2 * len(pattern.retained) > A.shape[0]):
            pattern = EliminationPattern(np.arange(A.shape[0]), np.zeros(0, np.intp), np.zeros(0, np.intp))
        self._A, self._pattern, self._factorisation = A, pattern, factorisation
        self._saddle: SaddlePointSolver | None = None
        self._last: tuple[Array, Array] | None = None
        self._by_inverse = pattern.is_dense
        self._condense()

    def _condense(self) -> None:
        self._condensed  # noqa: B018  eliminates now, which refuses a block that is not definite

    @cached_property
    def _condensed(self) -> StaticCondensation:
        return StaticCondensation(self._A, self._pattern, self._factorisation)

    @cached_property
    def factor(self) -> SparseCholesky:
        """The Cholesky factor of all of A."""
        return SparseCholesky(self._A, "A")

    def check_definite(self, name: str) -> None:
        """Raise a `NumericalError` that calls A by `name` if A is not positive definite.

        The elimination has factorised one block; A is definite exactly where the Schur complement is, too.
        """
        if self._saddle is None or not self._saddle.is_definite:
            check_regular(self._A, self.solve, name)

    def solve(self, right: Array) -> Array:
        """The solution A⁻¹ r for right-hand sides (n, k)."""
        load, particular = self._condensed.eliminate(right)
        return self._condensed.recover(self.compliance(load), particular)

    def dual_norms(self, functionals: Array) -> Array:
        """Norms ‖ℓ‖ (k,) in A⁻¹ of functionals (n, k)."""
        if self._saddle is not None and self._saddle.is_definite:
            return self._saddle.dual_norms(functionals)
        if self.dense:
            load, eliminated = self._condensed.eliminated_squares(functionals)
            retained = np.einsum("ik,ik->k", load, self._blocks @ load)
            return np.asarray(np.sqrt(np.maximum(eliminated + retained, 0.0)))
        return norms_by_solutions(functionals, self.solve(functionals))

    def holding(self, vi: VariationalInequality, rows: Indices) -> Array:
        """The u (n,) of `vi`, whose stiffness this is, with these rows as equalities and no other constraint."""
        try:
            return self.active_set_system(vi).holding(rows)[0]
        except (RuntimeError, np.linalg.LinAlgError):  # the rows are dependent
            return super().holding(vi, rows)

    @property
    def nbytes(self) -> int:
        """Memory, about, without `factor`."""
        return self._condensed.nbytes + (8 * len(self.retained) ** 2 if self._by_inverse else 0)

    @property
    def retained(self) -> Indices:
        """The retained unknowns (c,), rising."""
        return self._pattern.retained

    @property
    def order(self) -> Indices:
        """All unknowns (n,) in an order of little fill-in."""
        return np.concatenate([self._pattern.order, np.setdiff1d(self.retained, self._pattern.order)])

    @property
    def dense(self) -> bool:
        """Whether the Schur complement Ŝ is treated as a dense matrix."""
        return self._pattern.is_dense

    def serve_many(self, rows: int) -> None:
        """Prepare for many loads and the liftings of so many rows: where these need Ŝ⁻¹, loads are multiplied by it."""
        self._by_inverse = self._inverts_for(rows)

    def _inverts_for(self, rows: int) -> bool:
        # LAPACK inverts up to 1024 unknowns in less time than solutions for half as many rows take.
        return self.dense or len(self.retained) <= min(1024, 2 * rows)

    def compliance(self, load: Array) -> Array:
        """Product of Ŝ⁻¹ and loads (c,) or (c, k) of the retained unknowns."""
        if self._by_inverse:
            return self._blocks.times_sparse(load)
        return self._schur_factor.solve(load)

    def load(self, retained: Array) -> Array:
        """Product of a sparse Ŝ and retained unknowns (c,)."""
        return np.asarray(self._condensed.schur @ retained)

    @property
    def has_known_round_off(self) -> bool:
        """Whether there is a `schur_with_round_off`: only factors of SuperLU are known."""
        return self._factorisation == DEFAULT

    def schur_with_round_off(self, squares: Array) -> tuple[BlockDiagonal | SparseMatrix, float]:
        """A computed Ŝ, and its `StaticCondensation.round_off` against S² = diag(`squares`) (n,)."""
        condensed = self._condensed
        return condensed.dense_blocks if condensed.dense else condensed.schur, condensed.round_off(squares)

    def liftings(self, B: SparseMatrix) -> Array:
        """Product B Ŝ⁻¹ (m×c) for rows B (m×c) of the retained unknowns."""
        if self._inverts_for(B.shape[0]):
            return times_dense(B, self.inverse)
        return np.ascontiguousarray(self._schur_factor.solve(B.toarray().T).T)

    def represent(self, functionals: Array) -> tuple[Array, Array, Array]:
        """Condensed loads ℓ̂ (c, k) of functionals (n, k), Ŝ⁻¹ℓ̂ (c, k), and ℓ_iᵀA_ii⁻¹ℓ_i (k,), i being eliminated."""
        load, rest = self._condensed.eliminated_squares(functionals)
        return load, self.compliance(load), rest

    def extend(self, retained: Array) -> Array:
        """The vectors (n,) or (n, k) with these retained unknowns (c,) or (c, k) and no forces on the others."""
        return self._condensed.recover(retained, np.zeros((0, *retained.shape[1:])))

    @cached_property
    def _schur_factor(self) -> SparseCholesky:
        return SparseCholesky(self._condensed.schur, "A")

    @cached_property
    def inverse(self) -> Array:
        """The inverse Ŝ⁻¹ (c×c), for liftings where Ŝ is dense or small."""
        return self._blocks.toarray()

    @cached_property
    def _blocks(self) -> BlockDiagonal:
        return self._condensed.dense_blocks.inverse("A")

    def active_set_system(self, vi: VariationalInequality) -> ActiveSetSystem:
        """The KKT systems of the active sets of `vi`, whose stiffness must be this one."""
        condensed = self._condensed
        load, particular = condensed.condense_load(vi.f)
        whole = self._pattern.whole
        B = sp.csr_array(vi.B) if whole else self._pattern.on_retained(vi.B)
        solve_active: ActiveSolver
        if condensed.dense:
            if self._last is None or self._last[0] is not load:  # cached until the load changes
                self._last = load, self._blocks @ load
            solve_active = ComplianceSolver(self._blocks, self._last[1], B, vi.g)
        else:
            # A larger border takes longer than another factorisation.
            stiffness = self._A if whole else condensed.schur
            solve_active = SaddlePointSolver(stiffness, load, B, vi.g, 16, whole, self._factorisation)
            self._saddle = solve_active if whole else None
        recover = partial(condensed.recover, particular=particular)
        return ActiveSetSystem(B, vi.g, solve_active, recover, condensed.correct_eliminated, K=vi.K)


class ZoneStiffness(CondensedStiffness):
    """A stiffness matrix A, condensed on the zone that contact reaches, which is found and enlarged as needed.

    Programs are solved on the zone, right-hand sides with a factor of A. All retained unknowns, which are the interface
    of the pattern, are condensed only where they are asked for. `zone` has the unknowns of the zone, where another
    stiffness of the problem has found them.
    """

    def __init__(
        self, A: SparseMatrix, pattern: EliminationPattern, factorisation: str, zone: Indices | None = None
    ) -> None:
        self.zone = zone
        super().__init__(A, pattern, factorisation)

    def _condense(self) -> None:
        pass  # nothing is eliminated before it is asked for

    def solve(self, right: Array) -> Array:
        return self._solver.solve(right)

    @cached_property
    def _solver(self) -> Factor:
        return implementation(self._factorisation).factorise(self._A, "A")

    def dual_norms(self, functionals: Array) -> Array:
        return norms_by_solutions(functionals, self.solve(functionals))

    @cached_property
    def factor(self) -> SparseCholesky:
        return self._solver if isinstance(self._solver, SparseCholesky) else SparseCholesky(self._A, "A")

    @cached_property
    def _on_zone(self) -> tuple[StaticCondensation, BlockDiagonal]:
        """The stiffness condensed on the zone, and its inverse there."""
        assert self.zone is not None
        order = self._solver.order if isinstance(self._solver, SparseCholesky) else np.arange(self._A.shape[0])
        rest, positions = order[~np.isin(order, self.zone)], np.arange(len(self.zone))
        pattern = EliminationPattern(self.zone, np.concatenate([rest, self.zone]), positions)
        condensed = StaticCondensation(self._A, pattern, self._factorisation)
        return condensed, condensed.dense_blocks.inverse("A")

    def active_set_system(self, vi: VariationalInequality) -> ActiveSetSystem:
        if self.zone is None:
            self.zone = zone_of(vi.B, coarse_contact(self.solve, vi))
        zone, inside = self.zone, watched(vi.B, self.zone)
        B, (condensed, compliance) = sp.csr_array(sp.csc_array(vi.B)[:, zone]), self._on_zone
        load, particular = condensed.condense_load(vi.f)

        def enlarged(rows: Mask) -> ActiveSetSystem:
            self.zone = np.union1d(zone, zone_of(vi.B, rows | inside))
            vars(self).pop("_on_zone", None)
            return self.active_set_system(vi)

        solver = ComplianceSolver(compliance, compliance @ load, B, vi.g, inside)
        recover = partial(condensed.recover, particular=particular)
        beyond = Beyond(vi, inside, enlarged)
        return ActiveSetSystem(B, vi.g, solver, recover, condensed.correct_eliminated, beyond)


class MultigridStiffness(CondensedStiffness):
    """A stiffness matrix A that is solved by multigrid, and condensed only where that is asked for."""

    def _condense(self) -> None:
        self._solver = MultigridFactor(self._A, "A")

    def solve(self, right: Array) -> Array:
        return self._solver.solve(right)

    def check_definite(self, name: str) -> None:
        pass  # as far as it is noticed, the solver has refused to be made

    def dual_norms(self, functionals: Array) -> Array:
        # The error of a norm is the square of that of the solution.
        return norms_by_solutions(functionals, self._solver.solve_to(functionals, 1e-2))

    def active_set_system(self, vi: VariationalInequality) -> ActiveSetSystem:
        solver, nothing = NullSpaceSolver(self._A, vi.f, vi.B, vi.g), np.zeros(len(vi.f))
        return ActiveSetSystem(sp.csr_array(vi.B), vi.g, solver, np.copy, lambda _: nothing, K=vi.K, iterating=solver)


def condensed_stiffness(
    A: SparseMatrix, pattern: EliminationPattern, factorisation: str, before: CondensedStiffness | None = None,
    K: DualSet = RAYS,
) -> CondensedStiffness:  # fmt: skip
    """Condense A on the unknowns that constraints involve, or on the zone of them that contact reaches.

    `before` is the stiffness of another parameter of the problem, whose zone is the first one of this. Rows with an
    interval act everywhere: they have no zone.
    """
    if implementation(factorisation).is_iterative:
        return MultigridStiffness(A, pattern, factorisation)
    if not pattern.is_dense or len(pattern.interface) <= MANY_UNKNOWNS or K.blocks:
        return CondensedStiffness(A, pattern, factorisation)
    return ZoneStiffness(A, pattern, factorisation, before.zone if isinstance(before, ZoneStiffness) else None)


@dataclass(frozen=True)
class Beyond:
    """Constraints beyond the zone of a system: the variational inequality in all unknowns."""

    vi: VariationalInequality
    # Rows (m,) that touch no unknown beyond the zone; only these are active.
    watched: Mask
    # Gives the system of a larger zone in which some rows (m,) are watched, too.
    enlarged: Callable[[Mask], ActiveSetSystem]


@dataclass(frozen=True)
class ActiveSetSystem:
    """The variational inequality of one parameter in the c retained unknowns: B sparse (m×c), g (m,).

    `recover` and `correct_eliminated` are those of `StaticCondensation`, the first one at this load.
    """

    B: SparseMatrix
    g: Array
    solve_active: ActiveSolver
    recover: Callable[[Array], Array]
    correct_eliminated: Callable[[Array], Array]
    beyond: Beyond | None = None
    K: DualSet = RAYS
    # The solver, if its solutions are rough at first.
    iterating: NullSpaceSolver | None = None

    def watching(self, rows: Mask) -> ActiveSetSystem:
        """Return this system, or one of a larger zone in which some rows (m,) are watched, too."""
        if self.beyond is None or not np.any(rows & ~self.beyond.watched):
            return self
        return self.beyond.enlarged(rows)

    def holding(self, active: Indices) -> tuple[Array, Array]:
        """The u (n,) and λ (m,) with these constraints as equalities and no other multiplier; raises as solvers do."""
        rows = np.zeros(len(self.g), bool)
        rows[active] = True
        system = self.watching(rows)
        u, lam = system.solve_active(active)
        if system.iterating is not None:  # a set that stays is solved exactly
            u, lam = system.solve_active(active)
        return system.recover(u), lam


class SaddlePointSolver:
    """Solves the sparse KKT systems of successive active sets, with one step of iterative refinement.

    The system of one active set is factorised. Active sets that differ from it in at most `border` constraints reuse
    the factor, with a column per added constraint (its row of B) or removed one (a slack that sets its multiplier to
    zero).

    A is sparse SPD (c×c), B sparse (m×c). Where `order`, which extracts A in an elimination order, is given, systems
    are factorised in this order, with the multipliers last, without pivoting: of A that is a Cholesky factorisation,
    and what is left for the multipliers is −B_a A⁻¹B_aᵀ, negative definite where the rows are independent. Where it is
    not, as without an order, rows are exchanged.
    """

    def __init__(
        self, A: SparseMatrix, f: Array, B: SparseMatrix, g: Array, border: int,
        order: PrincipalSubmatrix | None = None, factorisation: str = DEFAULT,
    ) -> None:  # fmt: skip
        self._border, self._library = border, factorisation
        A, B, self._order = sp.csr_array(A), sp.csr_array(B), slice(None) if order is None else order.chosen
        if order is not None:
            A, f = order.of(A), f[self._order]
            B = sp.csr_array((B.data, order.places[B.indices], B.indptr), shape=B.shape)
        self._ordered = order is not None
        stiffness = np.abs(A.diagonal())
        # Scale unknowns and rows: displacements and forces of steel in metres differ by 1e11, and are compared.
        self._displacement = 1.0 / np.sqrt(np.where(stiffness > 0.0, stiffness, 1.0))
        B = _in_units(np.ones(len(g)), B, self._displacement)
        self._force = 1.0 / row_norms(B)
        self._A, self._f = _in_units(self._displacement, A, self._displacement), self._displacement * f
        self._load = self._f
        self._B, self._g = _in_units(self._force, B, np.ones(len(f))), self._force * g
        self._factorised_set, self._is_factorised = np.zeros(0, dtype=np.intp), np.zeros(len(g), bool)
        self._factorisation: _BorderedFactorisation | None = None

    def __call__(self, active: Indices, fixed: Array | None = None) -> tuple[Array, Array]:
        """The solution u (c,), λ (m,) of an `ActiveSolver`.

        Raises a `RuntimeError` if the system is exactly singular, or is so whatever the entries of B are.
        """
        solution, is_active = None, np.zeros(len(self._g), bool)
        is_active[active] = True
        self._load = self._f if fixed is None else self._f - self._B.T @ (fixed / self._force)
        if self._factorisation is not None and np.count_nonzero(is_active != self._is_factorised) <= self._border:
            solution = self._solve_bordered(self._factorisation, active, is_active)
        if solution is None:
            B = self._B[active]
            # SuperLU takes minutes for systems that cannot be regular, or destroys the heap.
            if structural_rank(B) < len(active):
                raise RuntimeError("the active constraints are dependent")
            # Keep this order: the set must stay that of the last factorisation where this one fails.
            zero = sp.csr_array((len(active), len(active)))  # blocks that are all CSR are stacked without triplets
            saddle = sp.block_array([[self._A, sp.csr_array(B.T)], [B, zero]], format="csr").T
            self._factorisation = _BorderedFactorisation(saddle, len(active) if self._ordered else None, self._library)
            self._factorised_set, self._is_factorised = active, is_active
            solution = self._solve_bordered(self._factorisation, active, is_active)
        assert solution is not None  # an empty border is always independent
        return solution if fixed is None else (solution[0], solution[1] + fixed)

    @property
    def is_definite(self) -> bool:
        """Whether a factorisation has shown that A is positive definite, and the rows of its active set independent."""
        return self._factorisation is not None and self._factorisation.ordered is not None

    def dual_norms(self, functionals: Array) -> Array:
        """Norms (k,) in A⁻¹ of functionals (c×k), from a factorisation that `is_definite`."""
        assert self._factorisation is not None  # as `is_definite` says
        assert self._factorisation.ordered is not None
        functionals = self._displacement[:, None] * functionals[self._order]
        return np.asarray(np.sqrt(np.maximum(self._factorisation.ordered.squares(functionals), 0.0)))

    def _solve_bordered(
        self, factorisation: _BorderedFactorisation, active: Indices, is_active: Mask
    ) -> tuple[Array, Array] | None:
        """The solution from the factorised set; `None` where the border is not clearly linearly independent.

        The constraints that are active are given by their numbers (k,) and as a mask (m,).
        """
        n, base = self._A.shape[0], self._factorised_set
        added, removed = active[~self._is_factorised[active]], np.flatnonzero(~is_active[base])
        border = np.zeros((n + len(base), len(added) + len(removed)))
        if len(added):
            border[:n, : len(added)] = self._B[added].toarray().T
        border[n + removed, len(added) + np.arange(len(removed))] = 1.0
        values = np.concatenate([self._g[added], np.zeros(len(removed))])
        names = [*added.tolist(), *(-1 - removed).tolist()]
        right = np.concatenate([self._load, self._g[base]])
        if (solved := factorisation.solve(names, border, right, values, self._load is not self._f)) is None:
            return None
        u, lam = np.empty(n), np.zeros(self._B.shape[0])
        u[self._order] = self._displacement * solved[0][:n]
        lam[base], lam[added] = solved[0][n:], solved[1][: len(added)]
        lam[base[removed]] = 0.0
        return u, self._force * lam


def _in_units(rows: Array, matrix: SparseMatrix, columns: Array) -> SparseMatrix:
    data = np.repeat(rows, np.diff(matrix.indptr)) * matrix.data * columns[matrix.indices]
    return sp.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)


class _BorderedFactorisation:
    """A factorisation of a symmetric system K (k×k), solved with borders of a few rows and columns.

    Raises a `RuntimeError` if it is exactly singular, or has no solution. A system that is singular up to round-off may
    still be consistent; its solution is verified by the active set method. `ordered` is the factor of a saddle point
    system whose `last` unknowns are multipliers, if all its pivots have their signs beyond round-off.
    """

    def __init__(self, matrix: SparseMatrix, last: int | None = None, factorisation: str = DEFAULT) -> None:
        self._matrix = matrix
        self.ordered: OrderedFactor | None = None
        self._unbordered: Array | None = None
        self._columns = dict[int, Array]()
        if last is not None:
            factor, size = implementation(factorisation).in_order(matrix), matrix.shape[0] - last
            # Rows have length 1 and A the diagonal 1: smaller pivots may consist of round-off alone.
            if np.all(factor.pivots[:size] > 16.0 * EPS * size) and np.all(factor.pivots[size:] < -1e-12):
                self.ordered = factor
        self._factor: OrderedFactor | SuperLU = self.ordered or splu(matrix)

    def solve(
        self, names: list[int], border: Array, right: Array, values: Array, is_new: bool
    ) -> tuple[Array, Array] | None:
        """The x (k,) and y (d,) with K x + C y = r and Cᵀx = s; `None` where Cᵀ K⁻¹ C is not clearly regular.

        `names` say which columns of C, and of borders before it, are the same; r is the same unless it `is_new`.
        """
        first = self._factor.solve(right) if is_new or self._unbordered is None else self._unbordered
        if not is_new:
            self._unbordered = first
        new = [k for k, name in enumerate(names) if name not in self._columns]
        if new:
            self._columns.update(zip([names[k] for k in new], self._factor.solve(border[:, new]).T, strict=True))
        solved = np.array([self._columns[name] for name in names]).reshape(len(names), len(right)).T
        schur = border.T @ solved
        if not _regular(schur, np.linalg.norm(border, axis=0) * np.linalg.norm(solved, axis=0)):
            return None

        def bordered(unbordered: Array, values: Array) -> tuple[Array, Array]:
            y = np.linalg.solve(schur, border.T @ unbordered - values)
            return unbordered - solved @ y, y

        x, y = bordered(first, values)
        rest = right - self._matrix @ x - border @ y
        # The constraints contradict each other, or round-off alone made their system regular.
        if self.ordered is None and not peak(rest) <= 1e-3 * peak(right):
            raise RuntimeError("the system has no solution")
        dx, dy = bordered(self._factor.solve(rest), values - border.T @ x)
        return x + dx, y + dy


def _regular(schur: Array, sizes: Array) -> bool:
    """Whether a symmetric matrix (d×d) is far from singular and its diagonal above the round-off of its terms."""
    if not len(schur):
        return True
    diagonal, round_off = np.abs(np.diag(schur)), 1e-12
    if np.any(diagonal <= round_off * sizes):
        return False
    scale = np.sqrt(diagonal)
    return bool(np.linalg.cond(schur / np.outer(scale, scale)) < 1.0 / np.sqrt(round_off))


class ComplianceSolver:
    """Solutions for active sets through the dense compliance B_a C B_aᵀ of their rows; multipliers are refined once.

    C is (c×c), `unconstrained` are the unknowns (c,) without constraints, B is sparse (m×c). Only some `rows` (m,) may
    be active, all by default.
    """

    def __init__(
        self, compliance: BlockDiagonal, unconstrained: Array, B: SparseMatrix, g: Array, rows: Mask | None = None
    ) -> None:
        self._compliance, self._unconstrained, self._B, self._g = compliance, unconstrained, B, g
        self._excess = B @ unconstrained - g
        self._rows = np.arange(len(g)) if rows is None else np.flatnonzero(rows)
        self._contact: Array | None = None

    def __call__(self, active: Indices, fixed: Array | None = None) -> tuple[Array, Array]:
        """The u (c,) and λ (m,) of an `ActiveSolver`; raises a `LinAlgError` where the rows are dependent."""
        rows, unconstrained, excess = self._B[active], self._unconstrained, self._excess
        lam = np.zeros(len(self._g)) if fixed is None else fixed.copy()
        if fixed is not None:
            unconstrained = unconstrained - self._compliance @ (self._B.T @ fixed)
            excess = self._B @ unconstrained - self._g
        if not len(active):
            return unconstrained, lam
        if len(active) > rows.shape[1]:
            raise np.linalg.LinAlgError("more constraints than unknowns are active")
        contact, excess = self._contact_of(active), excess[active]
        scale = 1.0 / np.sqrt(np.diag(contact))  # rows of any length
        factor = scipy.linalg.cho_factor(contact * np.outer(scale, scale), overwrite_a=True, check_finite=False)
        forces = scale * scipy.linalg.cho_solve(factor, scale * excess)
        forces += scale * scipy.linalg.cho_solve(factor, scale * (excess - contact @ forces))
        lam[active] = forces
        return unconstrained - self._compliance @ (rows.T @ forces), lam

    def _contact_of(self, active: Indices) -> Array:
        # Successive active sets share the matrix of all rows, which pays once a quarter of them are active.
        if self._contact is None and 4 * len(active) < len(self._rows):
            return self._compliance.congruent(self._B[active])
        if self._contact is None:
            self._contact = self._compliance.congruent(self._B[self._rows])
        places = np.searchsorted(self._rows, active)
        return self._contact[np.ix_(places, places)]
