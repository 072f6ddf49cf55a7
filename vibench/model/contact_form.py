"""The inequality of one parameter on the unknowns that its constraints touch, and the energy norm there.

Let c be the retained unknowns of a condensed stiffness, i the eliminated ones, Ŝ the Schur complement. Every v is the
sum of a part that vanishes on c and of the extension of v_c with the smallest energy, which are orthogonal in A:

    ‖v‖²_A = ‖v − ext v_c‖²_A + v_cᵀŜ v_c,    ‖ℓ‖²_{A⁻¹} = ℓ_iᵀA_ii⁻¹ℓ_i + ℓ̂ᵀŜ⁻¹ℓ̂,    ℓ̂ = ℓ_c − A_ci A_ii⁻¹ ℓ_i.

Forces Bᵀη of the contact load c alone, and B v = B v_c: all that error bounds do with them is of contact size. What the
bounds of all pairs (u_N, λ_N) at one parameter share is computed once: D = Ŝ⁻¹Bᵀ, the compliance K = B Ŝ⁻¹Bᵀ = B A⁻¹Bᵀ
of the constraints, and its Cholesky factor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from cachetools import LRUCache

from vibench.arrays import Array, Indices, Mask, SparseMatrix, times_dense
from vibench.highfidelity.kkt_systems import ActiveSetSystem, CondensedStiffness
from vibench.interfaces.absent_rows import is_absent
from vibench.interfaces.problem import VariationalInequality
from vibench.qp.exact import Directions, Rows, rows_that_matter
from vibench.qp.scaling import near_rows
from vibench.qp.verification import round_off_of_terms


@dataclass(frozen=True)
class Representer:
    """The representer A⁻¹ℓ of a functional ℓ: its values on c (c,), the load ℓ̂ (c,), and `rest`, ℓ_iᵀA_ii⁻¹ℓ_i."""

    values: Array
    load: Array
    rest: float

    @property
    def norm(self) -> float:
        """‖ℓ‖ in A⁻¹, the energy norm of the representer."""
        return float(np.sqrt(max(self.rest + float(self.load @ self.values), 0.0)))

    def plus(self, values: Array, load: Array) -> Representer:
        """The sum with the representer of a force on c alone, from its values (c,) and its load (c,)."""
        return Representer(self.values + values, self.load + load, self.rest)


class ContactForm:
    """The constraints and the energy norm of one parameter on the c retained unknowns.

    `stiffness` is A, condensed on unknowns that include those that B touches. `shared` tells whether bounds of many
    pairs share D and K, `is_dense` whether these are computed. `B` and `sizes` are B on the retained unknowns, whose
    positions (c,) rise, and its absolute values, sparse (m×c).
    """

    def __init__(self, vi: VariationalInequality, stiffness: CondensedStiffness, *, shared: bool) -> None:
        self.vi, self._stiffness, self.retained = vi, stiffness, stiffness.retained
        self.B: SparseMatrix = sp.csr_array(sp.csc_array(vi.B)[:, self.retained])
        self.sizes: SparseMatrix = abs(self.B)
        # made once: SciPy takes longer for a transpose than for its product with a vector
        self._transposed = self.B.T
        m, c = self.B.shape
        # For a sparse Ŝ a D that is large, or not reused by the next pair, costs more than a sparse system per set.
        self.is_dense = stiffness.dense or (shared and m * c <= 2**18)
        # of all rows that matter, and of active sets, whose first one pairs share
        self._factors: LRUCache[bytes, _Factor] = LRUCache(4)

    @property
    def nbytes(self) -> int:
        """Approximate memory once everything is computed: B in two precisions, |B|, D, K, factors of K."""
        m, c = self.B.shape
        return 48 * int(self.B.nnz) + (8 * m * (c + 3 * m) if self.is_dense else 0)

    def values(self, u: Array) -> Array:
        """The retained unknowns (c,) of u (n,)."""
        return np.asarray(u[self.retained])

    def extended(self, values: Array) -> Array:
        """The vectors (n,) or (n, k) with these retained unknowns (c,) or (c, k) that have the smallest energy."""
        return self._stiffness.extend(values)

    @cached_property
    def directions(self) -> Directions:
        """Lengths of the rows, and which rays that are not absent are parallel."""
        return Directions.of(self.B, ~is_absent(self.vi.g) & self.vi.K.rays(len(self.vi.g)))

    @cached_property
    def near(self) -> Mask:
        """Constraints (m,) that solvers see, by `near_rows`."""
        return near_rows(self.vi)

    @cached_property
    def entries(self) -> Indices:
        """Numbers of entries (m,) of the rows."""
        return np.asarray(np.diff(self.B.indptr))

    @cached_property
    def stiffnesses(self) -> Array:
        """Upper bounds b A bᵀ / |b|⁴ (m,) of the stiffness 1 / b A⁻¹ bᵀ of a row, by Cauchy and Schwarz."""
        B, A = self.B, sp.csr_array(self.vi.A)[self.retained][:, self.retained]
        squares, energies = (np.asarray((B * other).sum(axis=1)) for other in (B, B @ A))
        return np.asarray(np.divide(energies, squares**2, out=np.zeros_like(squares), where=squares > 0.0))

    @cached_property
    def liftings(self) -> Array:
        """Dᵀ (m×c): few of its rows are needed at a time."""
        return self._stiffness.liftings(self.B)

    @cached_property
    def squares(self) -> Array:
        """The compliances b A⁻¹ bᵀ (m,) of single rows."""
        return np.asarray(self.B.multiply(self.liftings).sum(axis=1)).ravel()

    @cached_property
    def in_extended_precision(self) -> SparseMatrix:
        """The matrix B in extended precision, if the machine has one."""
        return self.B.astype(np.longdouble)

    @cached_property
    def compliance(self) -> Array:
        """The compliance K (m×m)."""
        # not symmetrised: then K η agrees to the last digit with B applied to the displacements D η
        return np.ascontiguousarray(times_dense(self.B, self.liftings.T))

    def representer(self, functional: Array) -> Representer:
        """The representer A⁻¹ℓ of a functional ℓ (n,)."""
        load, values, rest = self._stiffness.represent(functional[:, None])
        return Representer(values[:, 0], load[:, 0], float(rest[0]))

    def force_representer(self, multiplier: Array) -> Representer:
        """The representer of a force Bᵀη of a multiplier η (m,)."""
        load = np.asarray(self._transposed @ multiplier)
        values = self._displaced(multiplier) if self.is_dense else self._stiffness.compliance(load)
        return Representer(values, load, 0.0)

    def force_norm(self, multiplier: Array) -> float:
        """The norm ‖Bᵀη‖ in A⁻¹ of a multiplier η (m,): from K alone, where it is computed."""
        if not self.is_dense:
            return self.force_representer(multiplier).norm
        return float(np.sqrt(max(float(multiplier @ (self.compliance @ multiplier)), 0.0)))

    @cached_property
    def _matter(self) -> Rows:
        room = round_off_of_terms(self.entries, np.abs(self.vi.g))
        return rows_that_matter(self.B, self.vi.g, room, directions=self.directions, K=self.vi.K)

    @property
    def tied(self) -> Mask:
        """Rows (m,) that are equalities with another one."""
        return self._matter.tied

    def contact_energy(self, multiplier: Array) -> float:
        """F of a multiplier η (m,): the norm of its force in A⁻¹, but for what equalities hold."""
        if not len(self._matter.equalities):
            return self.force_norm(multiplier)
        held = replace(self.vi, f=np.asarray(self.vi.B.T @ multiplier), g=np.zeros_like(multiplier))
        u = self._stiffness.holding(held, self._matter.equalities)
        return float(np.sqrt(max(float(u @ (self.vi.A @ u)), 0.0)))

    @cached_property
    def least_contact(self) -> float:
        """F_low, a lower bound of F from the solution without constraints; 0 where none is violated there."""
        if len(self._matter.equalities):
            free = self.values(self._stiffness.holding(self.vi, self._matter.equalities))
        else:
            free = self.representer(self.vi.f).values
        excess = self.B @ free - self.vi.g
        doubtful = round_off_of_terms(self.entries, self.sizes @ np.abs(free) + np.abs(self.vi.g))
        reached = np.flatnonzero((excess > doubtful) & ~self._matter.implied)
        return self.largest_step(reached, excess[reached])

    def largest_step(self, rows: Indices, excess: Array) -> float:
        """The largest s_i / ‖B_i‖_{A⁻¹} over violated rows (k,), whose s are given.

        ‖B_i‖⁻¹ is bounded from above without A⁻¹, so that the rows with the largest bounds are enough.
        """
        if self.is_dense:
            return float(np.max(excess / np.sqrt(self.squares[rows]), initial=0.0))
        bounds = excess * np.sqrt(self.stiffnesses[rows])
        largest, order = 0.0, np.argsort(-bounds, kind="stable")
        # eight solutions at once: usually the first block has the largest step
        for start in range(0, len(order), 8):
            block = order[start : start + 8]
            if bounds[block[0]] <= largest:
                break
            loads = sp.csr_array(self.B)[rows[block]].toarray().T
            squares = np.einsum("ik,ik->k", loads, self._stiffness.compliance(loads))
            largest = max(largest, float(np.max(excess[block] / np.sqrt(squares))))
        return largest

    def _displaced(self, multiplier: Array) -> Array:
        """Displacements D η (c,) of a multiplier η (m,)."""
        pressed = np.flatnonzero(multiplier)
        # Use all rows unless two thirds of η are zero: copying the rows costs more than multiplying them.
        if 3 * len(pressed) > len(multiplier):
            return np.asarray(multiplier @ self.liftings)
        return np.asarray(multiplier[pressed] @ self.liftings[pressed])

    def load(self, values: Array, multiplier: Array) -> Array:
        """Ŝ v (c,) of retained unknowns v (c,), which a force Bᵀη of a multiplier η (m,) displaces up to round-off."""
        return np.asarray(self._transposed @ multiplier) if self.is_dense else self._stiffness.load(values)

    def norm(self, terms: Representer, largest: float) -> float:
        """The norm of a sum of terms whose norm is at most about `largest`."""
        # where more than four digits of the sum cancelled, solve again for its load, which has lost none
        if terms.norm >= 1e-4 * largest:
            return terms.norm
        return Representer(self._stiffness.compliance(terms.load), terms.load, terms.rest).norm

    def correction_system(self, rows: Indices, pressed: Array, least: Array) -> ActiveSetSystem:
        """The systems of min ½‖w‖²_A + ηᵀB w + σ_K(s − B w) for some rows (k,), with η (m,) and s (k,)."""
        vi, K = self.vi, self.vi.K.of(rows)
        if not self.is_dense:
            program = VariationalInequality(vi.A, -(vi.B.T @ pressed), -sp.csr_array(vi.B)[rows], -least, K=K)
            return self._stiffness.active_set_system(program)
        B = -(self.B if len(rows) == len(vi.g) else self.B[rows])

        def solve_active(active: Indices, fixed: Array | None = None) -> tuple[Array, Array]:
            # in terms of ν − η, which is small where η is nearly the multiplier: nothing cancels
            forces = np.zeros(len(rows)) if fixed is None else fixed.copy()
            chosen, released = rows[active], pressed.copy()
            released[rows] -= forces
            released[chosen] = 0.0
            w = -self._displaced(released)
            if len(active):
                added = self._factor(chosen).solve(least[active] + (B @ w)[active])
                forces[active] = pressed[chosen] + added
                w += added @ self.liftings[chosen]
            return w, forces

        return ActiveSetSystem(B, -least, solve_active, self.extended, np.asarray, K=K)

    def holding(self, rows: Indices, values: Array) -> Representer:
        """The representer of the force Bᵀξ of some rows (k,) with B A⁻¹Bᵀξ = B v there, v (c,) on retained unknowns.

        Raises a `RuntimeError` or a `LinAlgError` if the rows are linearly dependent.
        """
        prescribed, multiplier = (self.B @ values)[rows], np.zeros(self.B.shape[0])
        if self.is_dense:
            multiplier[rows] = self._factor(rows).solve(prescribed)
            return self.force_representer(multiplier)
        vi = self.vi
        program = VariationalInequality(vi.A, np.zeros_like(vi.f), sp.csr_array(vi.B)[rows], -prescribed)
        moved, multiplier[rows] = self._stiffness.active_set_system(program).solve_active(np.arange(len(rows)))
        return Representer(-moved, -self.load(moved, -multiplier), 0.0)

    def _factor(self, rows: Indices) -> _Factor:
        """A factor of K in some rows (k,), cached: active sets and kept rows are often those of the pair before."""
        key = rows.tobytes()
        if key not in self._factors:
            if len(rows) == self.B.shape[0]:
                compliance = self.compliance
            elif "compliance" in vars(self):
                compliance = self.compliance[np.ix_(rows, rows)]
            else:  # all of K would cost more than these rows
                compliance = np.asarray(self.B[rows] @ self.liftings[rows].T)
            self._factors[key] = _Factor(compliance)
        return self._factors[key]


class _Factor:
    """The Cholesky factor of a compliance (k×k) in units of its diagonal, which serve rows of any length."""

    def __init__(self, compliance: Array) -> None:
        self._compliance, self._unit = compliance, 1.0 / np.sqrt(np.diag(compliance))
        self._factor = scipy.linalg.cho_factor(compliance * self._unit * self._unit[:, None], overwrite_a=True)

    def solve(self, prescribed: Array) -> Array:
        forces = self._solve_once(prescribed)
        # one step of refinement: rows that are nearly parallel lose half of the digits in the factor
        return forces + self._solve_once(prescribed - self._compliance @ forces)

    def _solve_once(self, right: Array) -> Array:
        solved = scipy.linalg.cho_solve(self._factor, self._unit * right, overwrite_b=True, check_finite=False)
        return np.asarray(self._unit * solved)
