"""Errors and residuals of pairs u_N and λ_N: against high-fidelity solutions, and of the high-fidelity problem itself.

The natural residuals are those of `vibench.qp.verification` for the high-fidelity program, whatever model found the
pair, in matrices of contact size: with their unit F, the energy that contact adds, and s = B u − g,

    primal max_i (s_i)₊ / ‖B_i‖_{A⁻¹} / F,    dual ‖f − A u − Bᵀλ‖_{A⁻¹} / F,    gap |λᵀs| / F².
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, TypeVar, cast

import numpy as np

from vibench.arrays import Array, Mask, SparseMatrix
from vibench.highfidelity.active_set import solve_unverified
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.absent_rows import is_absent
from vibench.interfaces.outputs import Output
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.linalg.cholesky import SparseCholesky
from vibench.model.contact_form import ContactForm
from vibench.qp.scaling import ratio
from vibench.qp.verification import Residuals, accurate_residuals, complementarity, round_off_of_terms

T = TypeVar("T")

# Relative errors below, and solutions below this fraction of the largest training solution, are treated as zero:
# high-fidelity solutions have residuals up to 1e-10, so that either may be an error of theirs.
UNMEASURABLE = 1e-8


@dataclass(frozen=True)
class EnergyNorm:
    """The energy norm of a sparse SPD A(µ) (n×n) at one parameter, and its dual norm.

    `stiffness` is A condensed on the unknowns that constraints involve. `shared` tells whether the errors of many
    solutions are measured with it: data that they share is worth more work then.
    """

    A: SparseMatrix
    stiffness: CondensedStiffness
    shared: bool = False
    _contact_forms: list[ContactForm] = field(default_factory=list, repr=False, compare=False)

    @property
    def nbytes(self) -> int:
        """Approximate memory once everything is computed."""
        return self.stiffness.nbytes + self.contact_nbytes

    @property
    def contact_nbytes(self) -> int:
        """Approximate memory of the constraints' part of it."""
        return sum(one.nbytes for one in self._contact_forms)

    def contact_form(self, vi: VariationalInequality) -> ContactForm:
        """The constraints of `vi`, whose A this is, on contact; the last one is cached."""
        if not self._contact_forms or self._contact_forms[0].vi is not vi:
            self._contact_forms[:] = [ContactForm(vi, self.stiffness, shared=self.shared)]
        return self._contact_forms[0]

    def norm(self, v: Array) -> float:
        """The norm ‖v‖_A of v (n,)."""
        return float(np.sqrt(max(float(v @ (self.A @ v)), 0.0)))

    @property
    def factor(self) -> SparseCholesky:
        """The Cholesky factor of A, computed where it is needed."""
        return self.stiffness.factor

    def dual_norm(self, functional: Array) -> float:
        """The norm ‖ℓ‖_{A⁻¹} of a functional (n,)."""
        return float(np.sqrt(max(float(functional @ self.factor.solve(functional)), 0.0)))


def of_stiffness(energies: Sequence[EnergyNorm], vectors: Array) -> Array:
    """Products A v (n×P) of vectors (n×P), each at its own parameter; those of one A in one block."""
    product = np.empty_like(vectors)
    for numbers in with_one_stiffness(energies):
        product[:, numbers] = energies[numbers[0]].A @ vectors[:, numbers]
    return product


def energy_norms(vectors: Array, products: Array) -> Array:
    """Norms ‖v‖_A (P,) of vectors (n×P), from A v (n×P)."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("ik,ik->k", vectors, products), 0.0)))


def with_one_stiffness(energies: Sequence[EnergyNorm]) -> list[list[int]]:
    """Numbers of the energies that share a stiffness."""
    numbers: dict[int, list[int]] = {}
    for k, energy in enumerate(energies):
        numbers.setdefault(id(energy.stiffness), []).append(k)
    return list(numbers.values())


def solutions(energies: Sequence[EnergyNorm], functionals: Sequence[Array]) -> list[Array]:
    """The solutions A⁻¹ℓ (n,) for functionals (n,), each at its own parameter; those of one A in one block."""
    found: dict[int, Array] = {}
    for numbers in with_one_stiffness(energies):
        of_one = energies[numbers[0]].stiffness.solve(np.column_stack([functionals[k] for k in numbers]))
        found |= dict(zip(numbers, of_one.T, strict=True))
    return [found[k] for k in range(len(energies))]


@dataclass(frozen=True)
class ReferenceSolutions:
    """High-fidelity solutions, columns of u (n×P) and λ (m×P), and what is largest over the training set.

    `scale_u` and `scale_lam` are norms in V and W, `scale_outputs` absolute values of the problem's outputs.
    """

    u: Array
    lam: Array
    scale_u: float
    scale_lam: float
    scale_outputs: tuple[float, ...] = ()
    # many models are compared with the same solutions: their norms, energies and outputs are cached
    _cache: dict[Any, Any] = field(init=False, default_factory=dict, repr=False, compare=False)

    def restrict(self, numbers: Sequence[int]) -> ReferenceSolutions:
        """The solutions at some of the parameters; of all of them the same object, with its cache."""
        if list(numbers) == list(range(self.u.shape[1])):
            return self
        return replace(self, u=self.u[:, numbers], lam=self.lam[:, numbers])

    def norms(self, problem: Problem) -> tuple[Array, Array]:
        """Norms ‖u‖_V and ‖λ‖_W (P,)."""
        return self._once("norms", lambda: (problem.V.norm(self.u), problem.W.norm(self.lam)))

    def energies(self, number: int, vi: VariationalInequality, energy: EnergyNorm) -> tuple[float, float]:
        """Norms of u in A and of Bᵀλ in A⁻¹ of one solution, whose inequality is `vi`."""
        u, lam = self.u[:, number], self.lam[:, number]
        return self._once(number, lambda: (energy.norm(u), energy.contact_form(vi).force_norm(lam)))

    def values(self, outputs: Sequence[Output], mus: Array) -> list[Array]:
        """Values (P,) of the outputs of the problem at their parameters (P×d)."""
        return self._once("outputs", lambda: [output.values(mus, self.u, self.lam) for output in outputs])

    def _once(self, name: str | int, compute: Callable[[], T]) -> T:
        if name not in self._cache:
            self._cache[name] = compute()
        return cast("T", self._cache[name])


@dataclass(frozen=True)
class Errors:
    """Errors of one reduced solution against the high-fidelity one at the same parameter, named as in the results."""

    # Relative, in the norms of V and of W; `None` where u or λ, respectively, is zero: see `zeros`.
    error_u: float | None
    error_lambda: float | None
    # Relative, ‖u − u_N‖ in the norm of A(mu), and ‖Bᵀ(λ − λ_N)‖ in that of A(mu)⁻¹ over ‖Bᵀλ‖.
    error_u_energy: float | None
    error_lambda_natural: float | None
    # These four without the division.
    error_u_absolute: float
    error_lambda_absolute: float
    error_u_energy_absolute: float
    error_lambda_natural_absolute: float
    # The first two over the largest training norms, or as they are where those are zero.
    error_u_scaled: float
    error_lambda_scaled: float
    # Largest (B u_N − g)₊, each row over the integral of its multiplier function [unit of u].
    violation: float
    # The product λᵀ(B u_N − g) with the high-fidelity λ; with λ_N it would only repeat the gap of the QP solver.
    complementarity: float


def zeros(problem: Problem, reference: ReferenceSolutions) -> tuple[Mask, Mask]:
    """Masks of u (P,) and λ (P,) that are zero: at most `UNMEASURABLE` of the largest norm over the training set.

    Without contact λ is zero, and u too where there is no load; a relative error would divide round-off by round-off.
    """
    norm_u, norm_lam = reference.norms(problem)
    return norm_u <= UNMEASURABLE * reference.scale_u, norm_lam <= UNMEASURABLE * reference.scale_lam


def errors(
    problem: Problem, vis: Sequence[VariationalInequality], energies: Sequence[EnergyNorm],
    reference: ReferenceSolutions, u: Array, lam: Array,
) -> list[Errors]:  # fmt: skip
    """Errors of reduced u (n×P) and λ (m×P), column by column at the parameters of `vis`."""
    V, W = problem.V, problem.W
    du, dlam = u - reference.u, lam - reference.lam
    (norm_u, norm_lam), (zero_u, zero_lam) = reference.norms(problem), zeros(problem, reference)
    error_u, error_lam, integrals = V.norm(du), W.norm(dlam), problem.multiplier_integrals()
    excesses = [vi.B @ u[:, k] - vi.g for k, vi in enumerate(vis)]
    in_energies, rows = energy_norms(du, of_stiffness(energies, du)), []
    for k, (vi, energy) in enumerate(zip(vis, energies, strict=True)):
        in_energy, natural = float(in_energies[k]), energy.contact_form(vi).force_norm(dlam[:, k])
        energy_u, natural_lam = reference.energies(k, vi, energy)
        rows.append(
            Errors(
                # A relative error of a zero would divide round-off by round-off: the scaled one tells how large it is.
                error_u=None if zero_u[k] else ratio(float(error_u[k]), float(norm_u[k])),
                error_lambda=None if zero_lam[k] else ratio(float(error_lam[k]), float(norm_lam[k])),
                error_u_energy=None if zero_u[k] else ratio(in_energy, energy_u),
                error_lambda_natural=None if zero_lam[k] else ratio(natural, natural_lam),
                error_u_absolute=float(error_u[k]),
                error_lambda_absolute=float(error_lam[k]),
                error_u_energy_absolute=in_energy,
                error_lambda_natural_absolute=natural,
                error_u_scaled=ratio(float(error_u[k]), reference.scale_u),
                error_lambda_scaled=ratio(float(error_lam[k]), reference.scale_lam),
                violation=float(np.max(excesses[k] / integrals, initial=0.0)),
                complementarity=float(reference.lam[:, k] @ excesses[k]),
            )
        )
    return rows


# an output of one query: name and unit, `value`, `reference`, `error` (relative, `None` for a zero) and `scaled`
OutputErrors = dict[str, Any]


def output_scales(outputs: Sequence[Output], mus: Array, u: Array, lam: Array) -> tuple[float, ...]:
    """The largest absolute value of every output over solutions, those of the training set."""
    return tuple(float(np.max(np.abs(output.values(mus, u, lam)), initial=0.0)) for output in outputs)


def output_errors(
    outputs: Sequence[Output], mus: Array, reduced: tuple[Array, Array], reference: ReferenceSolutions
) -> list[list[OutputErrors]]:
    """Every output at parameters (P×d), from reduced solutions (u, λ) as columns and from high-fidelity ones.

    An output that is at most `UNMEASURABLE` of its scale is zero: there is no contact, for instance. A relative error
    would divide round-off by round-off, and is `None`; the error over the scale is not.
    """
    rows: list[list[OutputErrors]] = [[] for _ in mus]
    known = zip(outputs, reference.scale_outputs, reference.values(outputs, mus), strict=True)
    for output, largest, exact_values in known:
        pairs = zip(output.values(mus, *reduced), exact_values, strict=True)
        for row, (value, exact) in zip(rows, pairs, strict=True):
            error = abs(float(value - exact))
            # an output may vanish, as a force without contact
            relative = None if abs(exact) <= UNMEASURABLE * largest else error / abs(float(exact))
            own = {"value": float(value), "reference": float(exact), "error": relative}
            row.append({"output": output.name, "unit": output.unit} | own | {"scaled": ratio(error, largest)})
    return rows


def summarise_outputs(
    outputs: Sequence[Output], scale: Sequence[float], queries: Sequence[Sequence[OutputErrors]]
) -> list[Mapping[str, Any]]:
    """Rows of the outputs table of a cell: means and maxima over its ok queries, zeros counted apart."""
    rows: list[Mapping[str, Any]] = []
    for k, (output, largest) in enumerate(zip(outputs, scale, strict=True)):
        mine = [query[k] for query in queries]
        relative = [one["error"] for one in mine if one["error"] is not None]
        zero, scaled = [one["scaled"] for one in mine if one["error"] is None], [one["scaled"] for one in mine]
        rows.append({
            "output": output.name, "unit": output.unit, "linear": int(output.linear), "scale": largest,
            "queries_ok": len(mine), "error_mean": float(np.mean(relative)) if relative else None,
            "error_max": max(relative, default=None), "queries_zero": len(zero),
            "error_zero_max": max(zero, default=None),
            "error_scaled_mean": float(np.mean(scaled)) if scaled else None,
            "error_scaled_max": max(scaled, default=None),
        })  # fmt: skip
    return rows


def high_fidelity_residuals(
    vi: VariationalInequality, energy: EnergyNorm, u: Array, lam: Array, rho: float = inf, u_energy: float | None = None
) -> Residuals:
    """Residuals of u (n,) and λ (m,).

    `rho` is ‖f − A u − Bᵀλ‖_{A⁻¹} where that is known, and finite, `u_energy` is ‖u‖_A where that is.
    """
    on = energy.contact_form(vi)
    values = on.values(u)
    if not np.isfinite(rho):
        residual, _ = accurate_residuals(vi, u, lam)
        rho = on.representer(residual).norm
    excess = np.asarray(on.in_extended_precision @ values.astype(np.longdouble) - vi.g, dtype=float)
    # u_N may miss contact altogether: F_low is that of the unconstrained solution.
    least = on.least_contact
    unit = max(on.contact_energy(lam), least)
    if not least:
        unit = float(np.hypot(energy.norm(u) if u_energy is None else u_energy, on.force_norm(lam)))
    rounded = round_off_of_terms(on.entries, on.sizes @ np.abs(values) + np.abs(vi.g))
    violated = np.flatnonzero((excess > rounded) & vi.K.rays(len(rounded)))
    # s may be infinite where λ is zero; the force of an equality times round-off is no gap.
    gap = complementarity(vi.K, np.where(on.tied, 0.0, lam), excess)
    return Residuals.relative(on.largest_step(violated, excess[violated]), rho, gap, unit)


def residual_multiplier(vi: VariationalInequality, energy: EnergyNorm, u: Array) -> Array:
    """The λ ∈ K (m,) whose residual f − A u − Bᵀλ is the smallest in the norm of A⁻¹.

    Of rays its KKT conditions are those of the variational inequality with the load f − A u and g = 0 where it is
    finite: A w + Bᵀλ = f − A u, B w ≤ 0, λ ≥ 0 and λᵀB w = 0. Raises a `NumericalError` if none is found.
    """
    homogeneous = replace(vi, f=vi.f - vi.A @ u, g=np.where(is_absent(vi.g), vi.g, 0.0))
    return vi.K.project(solve_unverified(homogeneous, energy.stiffness).lam)
