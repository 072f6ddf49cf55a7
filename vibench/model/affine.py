"""Affine decomposition of A, f, B, g: declared, or by empirical interpolation of their entries."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.interfaces.absent_rows import is_absent, without_infinities, zero_rows
from vibench.interfaces.affine import AffineSum, entries_of
from vibench.interfaces.problem import MEMBERS, Problem, Sampler
from vibench.interfaces.validation import checked_assembly
from vibench.linalg.inner_product import InnerProduct, svd
from vibench.qp.scaling import ratio

# Tolerance of empirical interpolation where none is given.
INTERPOLATION_RTOL = 1e-6


class Evaluation(StrEnum):
    """Way in which a member is evaluated at a parameter."""

    CONSTANT = "constant"
    AFFINE = "affine"
    INTERPOLATED = "interpolated"
    CONTACT = "contact"
    FULL = "full"


@dataclass(frozen=True)
class AffineMember:
    """One of A, f, B, g with its affine decomposition Σ_q θ_q(mu) · terms_q, if it has one."""

    way: Evaluation
    # Matrices or vectors; one for a constant member, none where there is no decomposition.
    terms: tuple[Any, ...]
    # Positions (Q,) of the entries whose values at mu are the θ_q of an interpolated member; `columns` is zero for
    # vectors. The θ_q of a declared affine member are those of `Problem.affine`.
    rows: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    columns: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    # Largest relative error over the training set.
    error: float = 0.0
    # Why it has to be assembled in full; "" otherwise.
    reason: str = ""

    def interpolated(self, value: Any) -> Any:
        """The sum of the terms of a constant or an interpolated member for its value at a parameter."""
        if self.way is Evaluation.CONSTANT:
            return self.terms[0]
        theta = entries_of(value, self.rows, self.columns)
        return sum(coefficient * term for coefficient, term in zip(theta, self.terms, strict=True))


def affine_decomposition(problem: Problem, training: Array, tolerance: float) -> dict[str, AffineMember]:
    """The members "A", "f", "B", "g", each with its cheapest evaluation.

    Declared constants are not checked here. Declared affine sums are exact; they are compared with the assembly at the
    first, the middle and the last training parameter. The others are assembled at all training parameters. Members that
    do not vary there are constants, too. Members that the problem evaluates entry by entry are interpolated where that
    takes few terms; a matrix that is one matrix times a function of mu takes one. Else B and g are left to
    `Problem.contact`, if the problem has it. `training` is (P×d), `tolerance` the largest relative interpolation error.
    Raises a `NumericalError` if an assembly is invalid, or a declared affine sum differs from it.
    """
    first = checked_assembly(problem, training[0]).copy()
    check_affine(problem, training)
    varying = [name for name in MEMBERS if name not in problem.constant and name not in problem.affine]
    assembled = assembled_members(problem, training, varying) if varying else {}
    vanish, vanishing = [zero_rows(B) for B in assembled.get("B", ())], ""
    # What interpolation leaves of a row of B that vanishes at some parameters would be a constraint of its error.
    if (sometimes := np.any([rows ^ vanish[0] for rows in vanish], axis=0)).any():
        vanishing = f"row {int(np.argmax(sometimes))} of B is zero at some parameters and not at others"
    members: dict[str, AffineMember] = {}
    for name in MEMBERS:
        if name in problem.constant:
            members[name] = AffineMember(Evaluation.CONSTANT, (getattr(first, name),))
        elif name in problem.affine:
            members[name] = AffineMember(Evaluation.AFFINE, problem.affine[name].terms)
        elif vanishing and name in ("B", "g"):
            members[name] = _exact(vanishing, problem.has_contact)
        else:
            entrywise = name in problem.entrywise
            members[name] = decomposed(name, assembled[name], problem.V, tolerance, entrywise, problem.has_contact)
    return members


def evaluated_members(parts: Mapping[str, AffineMember]) -> tuple[dict[str, tuple[Indices, Indices]], tuple[str, ...]]:
    """Rows and columns of the entries that are evaluated at a parameter, by member, and the members declared affine."""
    sampled = {name: (m.rows, m.columns) for name, m in parts.items() if m.way is Evaluation.INTERPOLATED}
    return sampled, tuple(name for name, m in parts.items() if m.way is Evaluation.AFFINE)


def coefficients(
    problem: Problem, sampled: Mapping[str, tuple[Indices, Indices]], declared: Sequence[str]
) -> Callable[[Array], Mapping[str, Array]]:
    """The function that evaluates θ (Q,) at mu (d,) of members with sampled entries and of those declared affine."""
    sampler: Sampler = problem.sampler(sampled) if sampled else lambda _: {}
    sums: list[tuple[AffineSum, list[str]]] = []
    for name in declared:
        of = problem.affine[name]
        for first, names in sums:
            # Members that share a function share its values: it is evaluated once.
            if of.thetas is first.thetas and len(of.terms) == len(first.terms):
                names.append(name)
                break
        else:
            sums.append((of, [name]))

    def evaluate(mu: Array) -> Mapping[str, Array]:
        values = {name: without_infinities(sample) for name, sample in sampler(mu).items()}
        for first, names in sums:
            values |= dict.fromkeys(names, first.coefficients(mu))
        return values

    return evaluate


def check_affine(problem: Problem, training: Array) -> None:
    """Raise a `NumericalError` for an affine sum that is not the assembled member.

    They are compared at the first, the middle and the last parameter (P×d).
    """
    for mu in training[[0, len(training) // 2, -1]] if problem.affine else ():
        vi = checked_assembly(problem, mu)
        for name, declared in problem.affine.items():
            exact, summed = getattr(vi, name), declared.at(mu)
            if summed.shape != exact.shape:
                raise NumericalError(f"the affine sum of {name} has shape {summed.shape}, {name} itself {exact.shape}")
            # Absent rows are huge numbers in g, which would hide the differences of all others.
            if name == "g":
                exact, summed = (np.where(is_absent(exact) & is_absent(summed), 0.0, each) for each in (exact, summed))
            away, size = float(abs(summed - exact).max()), float(abs(exact).max())
            # 1e-9: sums and assemblies differ by round-off, wrong declarations by much more
            if not away <= 1e-9 * size:
                what = f"by {away:.1e} at mu = {mu.tolist()}, where its largest entry is {size:.1e}"
                raise NumericalError(f"the affine sum declared for {name} differs from the assembled {name} {what}")


def assembled_members(problem: Problem, mus: Iterable[Array], names: Sequence[str]) -> Mapping[str, list[Any]]:
    """Copies of the named members at parameters (d,); the constraint alone is assembled where B and g are enough."""
    assembled: dict[str, list[Any]] = {name: [] for name in names}
    for mu in mus:
        if set(names) <= {"B", "g"}:
            values = dict(zip(("B", "g"), problem.constraint(mu), strict=True))
        else:
            vi = checked_assembly(problem, mu)
            values = {name: getattr(vi, name) for name in names}
        for name in names:
            # copy: the problem may reuse its arrays for the next parameter
            assembled[name].append(values[name].copy())
    return assembled


def decomposed(
    name: str, values: Sequence[Any], V: InnerProduct, tolerance: float, entrywise: bool = True, contact: bool = False
) -> AffineMember:
    """The decomposition of a member of which nothing is declared, from its values at the training parameters.

    Unknowns are measured in units of the norms of their basis functions in V, rows of B and g by their largest entry,
    so that neither the scaling of an unknown nor that of a constraint matters. `tolerance` is the largest relative
    interpolation error there. `entrywise` tells whether the problem evaluates the member entry by entry, `contact`
    whether it has `Problem.contact`.
    """
    if name == "g" and (sometimes := np.any([is_absent(g) ^ is_absent(values[0]) for g in values], axis=0)).any():
        return _exact(f"row {int(np.argmax(sometimes))} of g is infinite at some parameters and not at others", contact)
    entries = _Entries(values, symmetric=name == "A")
    weights = entries.weights(name, _units(V))
    spread = float(np.max(weights * np.ptp(entries.values, axis=1), initial=0.0))
    largest = float(np.max(weights * np.abs(entries.values).max(axis=1, initial=0.0), initial=0.0))
    # one parameter cannot show what varies; otherwise constants are those up to the round-off of the largest entry
    if len(values) > 1 and spread <= 1e-13 * largest:
        return AffineMember(Evaluation.CONSTANT, (values[0],))
    reason = f"{name} depends on mu and the problem does not evaluate it entry by entry"
    if entrywise and len(values) > 1:
        interpolation = interpolate(weights[:, None] * entries.values, tolerance)
        points = interpolation.points
        # as many terms as parameters would only repeat the training set: more than three quarters prove nothing
        if len(points) <= max(1.0, 0.75 * len(values)):
            modes = interpolation.modes * weights[points] / weights[:, None]
            terms = tuple(entries.assembled(mode) for mode in modes.T)
            rows, columns = entries.rows[points], entries.columns[points]
            return AffineMember(Evaluation.INTERPOLATED, terms, rows, columns, interpolation.error)
        reason = f"{name} depends on mu, and interpolation needs {len(points)} terms for {len(values)} parameters"
    return _exact(reason, contact and name in ("B", "g"))


def _exact(reason: str, contact: bool) -> AffineMember:
    """A member that is evaluated on the contact unknowns where the problem has them, else assembled in full."""
    return AffineMember(Evaluation.CONTACT, ()) if contact else AffineMember(Evaluation.FULL, (), reason=reason)


def held_out_error(name: str, member: AffineMember, values: Sequence[Any], V: InnerProduct) -> float:
    """Largest error of a member with samples or one term, at parameters outside the training set.

    `values` are the assembled ones there; the error is Euclidean, relative to the longest of them, in the units in
    which `decomposed` interpolates.
    """
    if not member.terms or not values:
        return 0.0
    units = _units(V)
    assembled = np.column_stack([_rows(name, value, units) for value in values])
    differences = np.column_stack([_rows(name, value - member.interpolated(value), units) for value in values])
    if name in ("B", "g"):
        largest = assembled.max(axis=1, keepdims=True)
        largest[largest == 0.0] = 1.0
        assembled, differences = assembled / largest, differences / largest
    return ratio(float(np.linalg.norm(differences, axis=0).max()), float(np.linalg.norm(assembled, axis=0).max()))


def is_missed(tolerance: float, error: float) -> bool:
    """Tell whether an error outside the training set is so far above the tolerance that it is reported."""
    # Interpolation holds its tolerance at training parameters; below ten times that, errors between them are usual.
    return error > 10.0 * tolerance


def _units(V: InnerProduct) -> Array:
    """Units (n,) of the unknowns: one over the norms of their basis functions."""
    return np.asarray(1.0 / np.sqrt(V.matrix.diagonal()))


def _rows(name: str, member: Any, units: Array) -> Array:
    """Euclidean norms of the rows (k,) of a member, a matrix or a vector, with unknowns in these units."""
    if name in ("A", "B"):
        member = sp.linalg.norm(sp.csr_array(member).multiply(units).tocsr(), axis=1)
    return np.asarray(units * np.abs(member) if name in ("A", "f") else np.abs(member))


class _Entries:
    """The entries of a member at all training parameters, as columns (k×P) on the union of their sparsity patterns."""

    def __init__(self, values: Sequence[Any], symmetric: bool) -> None:
        self._shape, self._symmetric = values[0].shape, symmetric
        self._vector = isinstance(values[0], np.ndarray)
        if self._vector:
            self.values = np.column_stack(values)
            self.rows, self.columns = np.arange(len(self.values)), np.zeros(len(self.values), np.intp)
        else:
            self.values = self._of_matrices(values)

    def weights(self, name: str, units: Array) -> Array:
        """Factors (k,) of the entries: unknowns have the units (n,), rows of constraints that of their largest."""
        weights = np.ones(len(self.rows))
        if name in ("A", "f"):
            weights *= units[self.rows]
        if name in ("A", "B"):
            weights *= units[self.columns]
        # Rows may have any scale, or be far: each is measured by its own largest entry.
        if name in ("B", "g"):
            largest = np.zeros(self._shape[0])
            np.maximum.at(largest, self.rows, weights * np.abs(self.values).max(axis=1, initial=0.0))
            weights /= np.where(largest > 0.0, largest, 1.0)[self.rows]
        return weights

    def _of_matrices(self, matrices: Sequence[SparseMatrix]) -> Array:
        rows = [sp.csr_array(sp.triu(matrix) if self._symmetric else matrix) for matrix in matrices]
        for matrix in rows:
            matrix.sum_duplicates()
        entries = [sp.coo_array(matrix) for matrix in rows]
        width = self._shape[1]
        keys = [entry.coords[0].astype(np.int64) * width + entry.coords[1] for entry in entries]
        pattern = keys[0] if all(np.array_equal(keys[0], key) for key in keys) else np.unique(np.concatenate(keys))
        self.rows, self.columns = pattern // width, pattern % width
        if pattern is keys[0]:
            return np.column_stack([entry.data for entry in entries])
        values = np.zeros((len(pattern), len(entries)))
        for k, (key, entry) in enumerate(zip(keys, entries, strict=True)):
            np.add.at(values[:, k], np.searchsorted(pattern, key), entry.data)
        return values

    def assembled(self, values: Array) -> Any:
        """The vector or matrix with these entries (k,)."""
        if self._vector:
            return values
        matrix = sp.csr_array((values, (self.rows, self.columns)), shape=self._shape)
        return matrix + sp.triu(matrix, 1).T if self._symmetric else matrix


@dataclass(frozen=True)
class Interpolation:
    """Empirical interpolation v(mu) ≈ Σ_q v(mu)[points_q] · modes_q from a few entries of the vector."""

    # Interpolation points: entries (Q,), rising.
    points: Indices
    # Cardinal modes (k×Q): mode q is 1 at its own point and 0 at the others.
    modes: Array
    # Largest relative Euclidean error over the snapshots.
    error: float


def interpolate(snapshots: Array, tolerance: float) -> Interpolation:
    """Discrete empirical interpolation of vectors (k×P), not all zero, to a tolerance.

    The modes are those of a singular value decomposition, the points those of a pivoted QR factorisation of the modes
    (Q-DEIM, Drmač and Gugercin 2016; of matrices, matrix DEIM, Negri, Manzoni and Amsallem 2015). The tolerance bounds
    the error of every column, relative to the longest. The number of terms is found by bisection; errors are not
    monotone in it, so a smaller number may exist.
    """
    scale = float(np.linalg.norm(snapshots, axis=0).max())
    q, r = np.linalg.qr(snapshots)
    left, sigma, right = svd(r)
    # squared error of projecting every column on k modes
    squares = np.cumsum(((sigma[:, None] * right) ** 2)[::-1], axis=0)[::-1]
    projection = np.append(np.sqrt(squares.max(axis=1)), 0.0) / scale
    rank = max(1, int(np.count_nonzero(sigma > np.finfo(float).eps * sigma[0])))
    # interpolation is never better than projection
    low = min(rank, max(1, int(np.argmax(projection <= tolerance))))

    def with_terms(count: int) -> Interpolation:
        modes = q @ left[:, :count]
        _, _, pivots = scipy.linalg.qr(modes.T, mode="economic", pivoting=True)
        points = np.sort(pivots[:count])
        cardinal = np.linalg.solve(modes[points].T, modes.T).T
        errors = np.linalg.norm(snapshots - cardinal @ snapshots[points], axis=0)
        return Interpolation(points, cardinal, float(errors.max()) / scale)

    # gallop upwards, since the projection error is a close guess
    best, step, high = with_terms(low), 1, low
    while best.error > tolerance and high < rank:
        low, high, step = high + 1, min(high + step, rank), 2 * step
        best = with_terms(high)
    while best.error <= tolerance and low < high:
        middle = (low + high) // 2
        candidate = with_terms(middle)
        if candidate.error <= tolerance:
            best, high = candidate, middle
        else:
            low = middle + 1
    return best
