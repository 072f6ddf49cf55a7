"""Offline data shared by the certificates of all reduced models of a problem: X, A against it, B₀, β_A and outputs.

**β_A.** With A ≼ γ X, β_A(µ)² is at least the smallest eigenvalue of B X⁻¹Bᵀ/γ against X_W. Hence β_A ≥ |θ| β₀/√γ
where B(µ) = θ(µ) B₀ is declared, and β_A ≥ β₀/√γ where X couples no two of several bodies and B(µ) is B₀ on some of
them, which is verified at the parameter. β₀² is the smallest eigenvalue of B₀X⁻¹B₀ᵀ against X_W, see
`vibench.stability.coercivity` for its proof.

**Outputs.** An output s(u, λ) = l(u) + m(λ) has the error l(e) + m(ε), e = u − u_N and ε = λ − λ_N, with

    |l(e)| ≤ ‖l‖_{A⁻¹} ‖e‖_A ≤ ‖l‖_{X⁻¹} ‖e‖_A / √α,
    |m(ε)| ≤ c ‖B₀ᵀε‖_{X⁻¹} ≤ c √γ/|θ| ‖Bᵀε‖_{A⁻¹},    c = √(zᵀS z) + ‖m − S z‖_{W⁻¹}/β₀,

for any z and S = B₀ X⁻¹B₀ᵀ, since β₀ ‖ε‖_W ≤ ‖B₀ᵀε‖_{X⁻¹}; θ = 1 where B₀ is B on some bodies. z = S⁻¹m makes c small
even if β₀ is, which the modes of ε on single elements decide.

**Round-off.** With S² = diag(X) and a proved σ, X ≽ σS², a difference between ±δS² is one between ±(δ/σ)X. So the
Schur complement Ŝ of a factorisation is that of X up to η = δ/σ (`FactoredElimination.backward_errors`), and for the
computed C the symmetric Ŝ^½CŜ^½ − I has at most the norm ν of any matrix similar to ŜC − I, hence

    (1 − μ) C ≼ EᵀX⁻¹E ≼ (1 + μ) C,    μ = (ν + η)/(1 − 2ν − 2η).

A declared sum A(µ) = Σ_q θ_q A_q differs from that of rotated terms, and from what is assembled, by matrices between
±Σ_q |θ_q| e_q X.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from math import inf, isqrt, sqrt

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.errors import UnsupportedError
from vibench.interfaces.dual_sets import BlockKind
from vibench.interfaces.outputs import Output
from vibench.interfaces.problem import Problem
from vibench.interfaces.validation import checked_assembly
from vibench.linalg import EPS, UNIT_ROUND_OFF
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.factorisations import implementation
from vibench.linalg.inner_product import InnerProduct
from vibench.model.affine import AffineMember, Evaluation, coefficients, evaluated_members
from vibench.model.bound_terms import BoundNote
from vibench.model.certificates.prepared_correction import constant_unknowns
from vibench.model.certificates.spectral import (
    SpectralBounds,
    TermRanges,
    combined,
    leading_terms,
    rotated,
    spectral_bounds,
)
from vibench.model.galerkin import contact_at
from vibench.model.proved_norms import dual_norm
from vibench.qp.verification import extended
from vibench.stability.coercivity import MARGINS, Constant, energy_inf_sup, largest_quotient, share_of_diagonal


class Guarantee(StrEnum):
    """Worth of a bound: proved, valid up to interpolation errors that were measured, or none."""

    CERTIFIED = "certified"
    VERIFIED = "verified"
    REFUTED = "refuted"
    NONE = "none"


@dataclass(frozen=True)
class OnlineInfSup:
    """Data of lower bounds of β_A(µ) at online cost."""

    # β₀; 0 where there is none.
    value: float
    # B₀ (m×k) on the contact unknowns.
    constraint: SparseMatrix
    # Contact unknowns (k,) on which B(µ) must be B₀; `None` where B(µ) = θ(µ) B₀ is declared.
    bodies: Mask | None
    # Which bound it is, or why there is none.
    note: str

    @cached_property
    def _known(self) -> tuple[Indices, Indices, Array]:
        """Rows, columns and values of B₀ on the bodies, without zeros, in the order of its rows."""
        entries = sp.csr_array(self.constraint, copy=True)
        entries.sum_duplicates()
        entries.eliminate_zeros()
        return (*sp.coo_array(entries).coords, entries.data)

    @property
    def entries(self) -> tuple[Mask, tuple[Indices, Indices, Array]]:
        """The bodies (k,), and the ends of the rows, columns and values of B₀ there, without zeros."""
        rows, columns, values = self._known
        bodies = np.zeros(self.constraint.shape[1], bool) if self.bodies is None else self.bodies
        ends = np.cumsum(np.bincount(rows, minlength=self.constraint.shape[0]))
        return bodies, (ends, columns, values)

    def lower_bound(self, theta: float, B: Callable[[], SparseMatrix], gamma: float) -> tuple[float, str]:
        """A lower bound of β_A(µ), 0 if there is none, and which it is or why there is none, from γ(µ).

        It takes θ(µ) where B(µ) = θ(µ) B₀ is declared, and elsewhere a function for B(µ) (m×k) on the contact unknowns.
        """
        if not self.value > 0.0:
            return 0.0, self.note
        if self.bodies is None:
            return abs(theta) * self.value / sqrt(gamma), self.note
        found, known = sp.csr_array(B()), self._known
        kept = self.bodies[found.indices]
        rows = np.repeat(np.arange(found.shape[0]), np.diff(found.indptr))
        entries = rows[kept], found.indices[kept], found.data[kept]
        # Mostly the same entries in the same order: a difference of sparse matrices takes ten times as long.
        if all(np.array_equal(one, other) for one, other in zip(entries, known, strict=True)):
            return self.value / sqrt(gamma), self.note
        difference = sp.csr_array(found - self.constraint)
        if np.any(difference.data[self.bodies[difference.indices]] != 0.0):  # NaN is not zero
            return 0.0, BoundNote.NOT_CONSTANT.value
        return self.value / sqrt(gamma), self.note


def online_inf_sup(
    X: InnerProduct, W: InnerProduct, contact: Indices, constraint: SparseMatrix, same: Mask | None
) -> OnlineInfSup:
    """Prove β₀ for B₀, which is a part of a matrix (m×k) on the contact unknowns (k,).

    `same` (k,) are the unknowns on which B was the same at the training parameters; `None` where B(µ) is declared to be
    a multiple of the matrix, which is B₀ then. Bodies are unknowns that X couples, directly or by others.
    """
    bodies, note = None, BoundNote.SCALED
    if same is not None:
        note = BoundNote.ON_BODIES
        body = connected_components(X.matrix, directed=False)[1][contact]
        bodies = ~np.isin(body, body[~same])
        constraint = sp.csr_array(constraint @ sp.diags_array(bodies.astype(float)))
        if not bodies.any():
            return OnlineInfSup(0.0, constraint, bodies, str(BoundNote.NO_BODY))
    entries = sp.coo_array(constraint)
    rows, columns = entries.coords
    B = sp.csr_array((entries.data, (rows, contact[columns])), shape=(constraint.shape[0], X.dim))
    beta = energy_inf_sup(X.matrix, B, W)
    proved = beta.proved and beta.value > 0.0
    note = note if proved else BoundNote.NOT_PROVED
    return OnlineInfSup(beta.value if proved else 0.0, constraint, bodies, str(note))


@dataclass(frozen=True)
class CertificateBase:
    """Offline data shared by the certificates of all reduced models of a problem."""

    # The inner product; that of A where it is constant.
    X: InnerProduct
    # C (k×k) of the contact unknowns E.
    compliance: Array
    # Terms of A, and what takes coefficients of its interpolation (Q,) to those of these; `None` for a constant A.
    terms: tuple[SparseMatrix, ...]
    rotation: Array | None
    # Bounds of A against X; `None` where A is X.
    spectral: SpectralBounds | None
    # Bounds of ‖f − f̃‖ in the dual norm of X and of the operator norm of A − Ã; zero where they are exact.
    load_error: float
    stiffness_error: float
    # Whether A and f are declared to be constant or affine sums, so that no bound rests on what was measured at some
    # parameters. An error that was measured to be zero proves nothing about other ones.
    is_exact: bool
    # B₀ (m×k) on the contact unknowns: what B is a multiple of where there are `bound_terms`; elsewhere B on the bodies
    # where that is the same at all training parameters, and zero on the others.
    constraint: SparseMatrix
    # The terms of g (m×Q) where B is a multiple of one matrix and g an exact sum; `None` elsewhere.
    bound_terms: Array | None
    # Lower bounds of β_A(µ).
    inf_sup: OnlineInfSup
    # σ and μ.
    share: Constant
    compliance_error: float
    # e_q (Q,) of the coefficients of A that a query evaluates; zero where A is no declared sum.
    term_errors: Array

    @property
    def guarantee(self) -> Guarantee:
        """Worth of the bounds of all models."""
        proved = self.share.proved and (self.spectral is None or self.spectral.proved)
        return Guarantee.CERTIFIED if proved and self.is_exact else Guarantee.VERIFIED

    @cached_property
    def one(self) -> Array:
        """The θ (1,) of constant members, allocated once: an allocation per member shows in the seconds of a query."""
        return np.ones(1)

    def coefficients(self, samples: Mapping[str, Array]) -> dict[str, Array]:
        """Coefficients θ of f, A and B from those that a query evaluated; those of A rotated, one if constant."""
        theta = {name: samples.get(name, self.one) for name in ("f", "A", "B")}
        if self.rotation is not None:
            theta["A"] = self.rotation @ theta["A"]
        return theta

    def spectrum(self, mu: Array, theta: Array, samples: Mapping[str, Array]) -> tuple[float, float, float]:
        """The bounds α(µ) and γ(µ), and that of Ã(µ)'s error, from the rotated θ of A (Q,) and what led to these."""
        if self.spectral is None:
            return 1.0, 1.0, self.stiffness_error
        lower, upper = self.spectral.evaluate(mu, theta, samples.get("A"))
        rounded = float(np.abs(samples.get("A", self.one)) @ self.term_errors)
        return lower - rounded, upper + rounded, self.stiffness_error + rounded


def unsupported(problem: Problem, members: Mapping[str, AffineMember]) -> str:
    """Reason why reduced models of a problem cannot be certified at online cost; "" if they can."""
    K = problem.K
    if K.blocks and (K.kinds != {BlockKind.INTERVAL} or K.rays(problem.W.dim).any() or "A" not in problem.constant):
        known = "certificates know λ ≥ 0, and intervals in all rows where A is constant"
        return f"{known}; K has {K.names()}, A is {'' if 'A' in problem.constant else 'not '}constant"
    if not problem.has_contact:
        return "the problem does not assemble its constraint on its contact unknowns (`contact_dofs` and `contact`)"
    count = len(contact_unknowns(problem))
    # 4 GiB: the inverse is one such array, its factor another
    if 8 * count**2 > 2**32:
        needed = f"a dense matrix of {8e-9 * count**2:.0f} GB; the limit is 4.3 GB, {isqrt(2**29)} unknowns"
        return f"the constraint touches {count} unknowns, and certificates need their compliance, {needed}"
    if reason := "; ".join(members[name].reason for name in ("A", "f") if members[name].way is Evaluation.FULL):
        return reason
    if problem.parameters.listed is not None and not all(is_exact(problem, name, members[name]) for name in "Af"):
        why = "the problem has matrices at its listed parameters only: interpolation errors are measured at others"
        return f"A or f is interpolated, and {why}"
    return ""


def is_exact(problem: Problem, name: str, member: AffineMember) -> bool:
    """Tell whether a member is declared constant or an affine sum, and has no interpolation error.

    One that did not vary over the training set is treated as a constant and may be none.
    """
    return member.way is Evaluation.AFFINE or (member.way is Evaluation.CONSTANT and name in problem.constant)


def contact_unknowns(problem: Problem) -> Indices:
    """Contact unknowns E (k,) of a problem that certificates support."""
    assert problem.contact_dofs is not None  # `unsupported` refuses problems without
    return problem.contact_dofs


def certificate_base(problem: Problem, members: Mapping[str, AffineMember], training: Array) -> CertificateBase:
    """Prepare certificates of reduced models of a problem whose members have been decomposed over `training` (P×d).

    Raises an `UnsupportedError` if `unsupported` gives a reason.
    """
    if reason := unsupported(problem, members):
        raise UnsupportedError(reason)
    A, f, dofs = members["A"], members["f"], contact_unknowns(problem)
    constant = is_exact(problem, "A", A) and A.way is Evaluation.CONSTANT
    centre = 0.5 * (problem.parameters.lower + problem.parameters.upper)
    at_centre = A.terms[0] if constant else checked_assembly(problem, centre).A
    X = InnerProduct(at_centre, "A", problem.factorisation)
    terms, rotation, spectral, leading = list(A.terms), None, None, len(A.terms)
    evaluate = coefficients(problem, *evaluated_members({"A": A, "f": f}))
    share, term_errors = share_of_diagonal(X), np.zeros(len(A.terms))

    def declared(mu: Array) -> Array:
        return evaluate(mu).get("A", np.ones(1))

    def missed(mu: Array) -> float:
        return left_out + float(np.abs(declared(mu)) @ term_errors)

    if not constant:
        samples = np.column_stack([declared(mu) for mu in training])
        rotation, terms = T, _ = rotated(A.terms, samples)
        leading = len(terms) if is_exact(problem, "A", A) else leading_terms(T @ samples)
        if A.way is Evaluation.AFFINE:
            term_errors = _term_errors(A.terms, T, terms, X) / share.value
    load, stiffness, left_out = _interpolation_errors(problem, X, members, evaluate, rotation, terms, leading)
    if not constant:
        ranges = TermRanges.of(A.terms, declared(centre), X, missed(centre)) if A.way is Evaluation.AFFINE else None
        spectral = spectral_bounds(problem, X, terms[:leading], lambda mu: T @ declared(mu), missed, ranges)
    factor = implementation(X.factorisation).eliminate_with_factor(X.matrix, dofs, "A")
    # Eᵀ X⁻¹ E is the inverse of a Schur complement: no solution of mesh size for each contact unknown
    schur, squares = factor.schur_blocks(), X.matrix.diagonal()
    C = schur.inverse("A").toarray()
    error = _compliance_error(schur, C, np.sqrt(squares[dofs]), factor.backward_errors(squares)[0] / share.value)
    constraint, bound, inf_sup = _constant_constraint(problem, members, X, C, training)
    exact = all(is_exact(problem, name, members[name]) for name in "Af")
    return CertificateBase(
        X, C, tuple(terms), rotation, spectral, load, stiffness, exact, constraint, bound, inf_sup, share, error,
        term_errors,
    )  # fmt: skip


def _compliance_error(schur: BlockDiagonal, compliance: Array, scale: Array, eta: float) -> float:
    """The bound μ of C (k×k) from the computed Schur complement, S (k,) on the contact unknowns, and η."""
    distance = 0.0
    for unknowns, block in schur.blocks:
        own, of_C = scale[unknowns], compliance[np.ix_(unknowns, unknowns)]
        left = (block @ of_C - np.eye(len(own))) / own[:, None] * own
        sums = float(np.max((np.abs(block) @ (1.0 / own)) / own))
        rounded = 1.01 * EPS * (len(own) + 4.0) * sums * float(np.linalg.norm(own[:, None] * of_C * own))
        distance = max(distance, float(np.linalg.norm(left)) + rounded)
    distance += eta
    return distance / (1.0 - 2.0 * distance) if distance < 0.25 else inf


def _term_errors(declared: Sequence[SparseMatrix], T: Array, terms: Sequence[SparseMatrix], X: InnerProduct) -> Array:
    """Bounds (Q,) of the largest row sums of S⁻¹|A_q − Σ_p T_pq A'_p|S⁻¹, and of round-off in sums of the terms."""
    unit = 1.0 / np.sqrt(X.matrix.diagonal())

    def row_sums(matrix: SparseMatrix) -> float:
        return float(np.max((abs(sp.csr_array(matrix)) @ unit) * unit, initial=0.0))

    turned, of_terms = [extended(sp.csr_array(term)) for term in terms], np.array([row_sums(term) for term in terms])
    errors, unit_of_sums = [], 1.01 * UNIT_ROUND_OFF * (len(declared) + 3.0)
    for term, weights in zip(declared, T.T, strict=True):
        missed = extended(sp.csr_array(term)) - sum(t * one for t, one in zip(extended(weights), turned, strict=True))
        sums = row_sums(term) + float(np.abs(weights) @ of_terms)
        errors.append(row_sums(missed.astype(float)) + unit_of_sums * sums)
    return np.array(errors)


def _constant_constraint(
    problem: Problem, members: Mapping[str, AffineMember], X: InnerProduct, compliance: Array, training: Array
) -> tuple[SparseMatrix, Array | None, OnlineInfSup]:
    """The matrix B₀, the terms of g, and the bounds of β_A of a `CertificateBase`."""
    B, g, contact = members["B"], members["g"], contact_unknowns(problem)
    multiple = sp.csr_array(B.terms[0])[:, contact] if len(B.terms) == 1 and is_exact(problem, "B", B) else None
    if multiple is not None and is_exact(problem, "g", g):
        return multiple, np.column_stack(g.terms), online_inf_sup(X, problem.W, contact, multiple, None)
    # copies: a problem may write the next constraint into the same arrays
    constraints = [contact_at(problem, mu).B.copy() for mu in training]
    same = constant_unknowns(compliance, constraints)
    constraint = sp.csr_array(sp.csr_array(constraints[0]) @ sp.diags_array(same.astype(float)))
    of_inf_sup = (constraint, same) if multiple is None else (multiple, None)
    return constraint, None, online_inf_sup(X, problem.W, contact, *of_inf_sup)


def _interpolation_errors(
    problem: Problem, X: InnerProduct, members: Mapping[str, AffineMember],
    evaluate: Callable[[Array], Mapping[str, Array]], rotation: Array | None, terms: Sequence[SparseMatrix],
    leading: int,
) -> tuple[float, float, float]:  # fmt: skip
    """Bounds of the errors of f̃, of Ã, and of Ã of its leading terms alone, from random parameters.

    Rotation and terms are those of a `CertificateBase`.
    """
    A, f = members["A"], members["f"]
    exact = {name: is_exact(problem, name, member) for name, member in (("A", A), ("f", f))}
    if all(exact.values()):
        return 0.0, 0.0, 0.0
    load = stiffness = left_out = 0.0
    # 16 random parameters, by a seed that no sampling of training or validation sets uses
    mus = problem.parameters.sample(16, 21)
    thetas = [evaluate(mu) for mu in mus]
    if not exact["A"]:
        assert rotation is not None  # that of an A which is not exactly constant
        theta = rotation @ np.column_stack([one.get("A", np.ones(1)) for one in thetas])
        sums = list(zip(combined(terms, theta), combined(terms[:leading], theta[:leading]), strict=True))
    for k, mu in enumerate(mus):
        vi = checked_assembly(problem, mu)
        if not exact["f"]:
            coefficients = thetas[k].get("f", np.ones(1))
            interpolated = sum(t * term for t, term in zip(coefficients, f.terms, strict=True))
            load = max(load, float(np.linalg.norm(X.whiten_functional(vi.f - interpolated))))
        if not exact["A"]:
            missed, without_last = (largest_quotient(vi.A - part, X) for part in sums[k])
            stiffness, left_out = max(stiffness, missed), max(left_out, without_last)
    # Twice the largest errors: other parameters may have larger ones. Quotients are estimated from below.
    factor = 2.0 * (1.0 + MARGINS[0])
    return 2.0 * load, factor * stiffness, factor * left_out


def output_coefficients(problem: Problem, output: Output) -> tuple[Array, Array]:
    """Coefficients (n,) of u and (m,) of λ of a linear output; raises a `NumericalError` for those of another shape."""
    sizes = problem.V.dim, problem.W.dim
    output.values(problem.parameters.lower[None], *(np.zeros((size, 1)) for size in sizes))
    pairs = zip((output.u, output.lam), sizes, strict=True)
    of_u, of_lam = (np.zeros(size) if weights is None else np.asarray(weights, float) for weights, size in pairs)
    return of_u, of_lam


def output_weights(problem: Problem, base: CertificateBase, output: Output) -> tuple[float, float]:
    """The weights ‖l‖_{X⁻¹} and c of a linear output; c is infinite where no β₀ is proved."""
    of_u, of_lam = output_coefficients(problem, output)
    beta, B = base.inf_sup.value, base.inf_sup.constraint
    in_u = dual_norm(base.X, of_u, 0.0)
    if not of_lam.any():
        return in_u, 0.0
    if not beta > 0.0:
        return in_u, inf
    C, S = base.compliance, np.asarray(B @ np.asarray(B @ base.compliance).T)
    S, bounds = 0.5 * (S + S.T), [dual_norm(problem.W, of_lam, 0.0) / beta]
    with suppress(np.linalg.LinAlgError):  # rows that are dependent up to round-off
        z = scipy.linalg.cho_solve(scipy.linalg.cho_factor(S), of_lam)
        load, root = np.asarray(B.T @ z), np.sqrt(np.diag(C))
        values, reach = C @ load, float(root @ (abs(B).T @ np.abs(z)))
        # the round-off in sums over rows and columns of B₀ and over C, and what C misses
        unit = 1.01 * EPS * (len(z) + 2.0 * len(load) + 8.0)
        size = sqrt((max(0.0, float(load @ values)) + unit * reach**2) * (1.0 + base.compliance_error))
        rest = dual_norm(problem.W, of_lam - B @ values, unit * (reach * (abs(B) @ root) + np.abs(of_lam)))
        bounds.append(size * (1.0 + 2.0 * base.compliance_error) + rest / beta)
    return in_u, min(bounds)
