"""Hyper-reduced models: equations (8) and (9) of the paper assembled online without arrays of mesh size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import isfinite
from types import MappingProxyType

import numpy as np
import scipy.linalg
from scipy.linalg.lapack import dgeqp3, dorgqr

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError
from vibench.interfaces.problem import MEMBERS, Contact, ContactLoads, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.linalg.inner_product import RANK_RTOL
from vibench.model.affine import AffineMember, Evaluation, coefficients, evaluated_members
from vibench.model.galerkin import Evaluated, ReducedModel, ReducedProblem, contact_at, projections
from vibench.reduction.supremizers import LoadCoordinates, PlainCoordinates, SpannedCoordinates, supremizers

# coefficients θ of the terms at one parameter, by member
Samples = Mapping[str, Array]


@dataclass(frozen=True)
class ProjectedMember:
    """A member in reduced coordinates: Σ_q θ_q(mu) · terms_q, or a constant."""

    # Flattened terms (Q×size); symmetric ones are stored as upper triangles.
    terms: Array
    shape: tuple[int, ...]
    # Whether the only term is the member itself.
    constant: bool
    # Positions of the entries of a symmetric matrix in its packed triangle (d²,); `None` for full storage.
    unpack: Indices | None = None

    @classmethod
    def from_terms(cls, terms: list[Array], member: AffineMember) -> ProjectedMember:
        """Make a member from its projected terms."""
        return cls(np.array([term.ravel() for term in terms]), terms[0].shape, member.way is Evaluation.CONSTANT)

    @classmethod
    def symmetric(cls, terms: list[Array], member: AffineMember) -> ProjectedMember:
        """Make a symmetric member from its projected terms (d×d)."""
        d = terms[0].shape[0]
        upper = np.triu_indices(d)
        where = np.empty((d, d), dtype=np.intp)
        where[upper] = where.T[upper] = np.arange(len(upper[0]))
        packed = np.array([(0.5 * (term + term.T))[upper] for term in terms])
        return cls(packed, (d, d), member.way is Evaluation.CONSTANT, where.ravel())

    def evaluate(self, theta: Array | None) -> Array:
        """The member with coefficients θ (Q,)."""
        if self.constant or theta is None:
            return self._constant_value
        # for one term a matrix product takes three times as long as a scaling
        return self._unpacked(theta[0] * self.terms[0] if len(self.terms) == 1 else theta @ self.terms)

    def evaluate_all(self, thetas: Sequence[Array]) -> Array:
        """The member with each of P coefficients θ (Q,), in one product (P×shape)."""
        return self._unpacked(np.stack(thetas) @ self.terms)

    @cached_property
    def _constant_value(self) -> Array:
        return self._unpacked(self.terms[0])

    def _unpacked(self, flat: Array) -> Array:
        """Members (…×shape) from their flat entries (…×size)."""
        whole = flat if self.unpack is None else flat.take(self.unpack, axis=-1)
        return whole.reshape(*flat.shape[:-1], *self.shape)


@dataclass(frozen=True)
class ReducedOperators:
    """Offline data of a hyper-reduced model: a space Φ of dimension d and the members projected on it."""

    # Entries of the members that are evaluated at a parameter: rows and columns by member.
    sampled_entries: Mapping[str, tuple[Indices, Indices]]
    # Members whose coefficients are those of `Problem.affine`.
    affine: tuple[str, ...]
    # Stiffness (d×d), load (d,) and bound (R,), where `Problem.contact_loads` does not evaluate it.
    A: ProjectedMember
    f: ProjectedMember
    g: ProjectedMember | None
    # Constraint (R×d) on the generators χ, or ((k+R)×d) on (η, χ) for a per-parameter enrichment; `None` as for g.
    B: ProjectedMember | None
    # Rows of Φ at the contact unknowns (|E|×d), for a fixed space and a constraint from `Problem.contact_loads`.
    contact_basis: Array | None
    # Coordinates of Φ = V_N + supremizers for a per-parameter enrichment that varies in it.
    supremizer_coordinates: PlainCoordinates | None
    # Φ itself (n×d), for reconstruction, where it is neither of the above nor the model's fixed basis.
    basis: Array | None
    # Cholesky factor (lower, d×d) of a constant stiffness on a fixed space, for queries that solve the dual program.
    # `None` for more than d or linearly dependent generators, with which the dual is singular.
    factor: Array | None


@dataclass(frozen=True)
class ContactTerms:
    """B and g on Φ from Bᵀη on some contact unknowns and ηᵀg, for multipliers η that give χ = η C."""

    # η (m×t), and C (t×R), or `None` where χ are the last columns of η; all others are those of the enrichment.
    tested: Array
    combination: Array | None
    # R.
    generators: int
    # ηᵀB Φ is `fixed` (t×d) and the transpose of the rows of Bᵀη from `first` on times `reached` (j×d).
    first: int
    fixed: Array
    reached: Array


def reason_for_full_assembly(model: ReducedModel, members: Mapping[str, AffineMember]) -> str:
    """Reason why the model has to be assembled in full, as in the paper; "" if it can be hyper-reduced."""
    if model.enrichment.supply is not None:
        return "the enrichment computes its own vectors at every mu"
    return "; ".join(members[name].reason for name in MEMBERS if members[name].way is Evaluation.FULL)


def hyper_reduce(model: ReducedModel, members: Mapping[str, AffineMember]) -> ReducedOperators:
    """Project the affine members of a problem on the space of its reduced model; see `reason_for_full_assembly`."""
    problem, chi, eta = model.problem, model.generators, model.enrichment.eta
    # where B has one term, all supremizer spaces coincide and the enrichment is a fixed one
    coordinates = None if eta is None or len(members["B"].terms) == 1 else _supremizer_space(model, members["B"], eta)
    Z = basis = None
    if coordinates is not None and eta is not None:
        Z, chi = coordinates.vectors(np.eye(coordinates.plain.shape[0])), np.hstack([eta, chi])
    elif eta is not None:
        B = members["B"].terms[0]
        basis = Z = model.primal_basis(VariationalInequality(A=None, f=np.zeros(0), B=B, g=np.zeros(0)))
    else:
        Z = model.fixed_basis
    of = projections(Z, chi) | {"g": lambda g: model.generators.T @ g}
    projected = {name: [of[name](term) for term in member.terms] for name, member in members.items()}
    A = ProjectedMember.symmetric(projected["A"], members["A"])
    f = ProjectedMember.from_terms(projected["f"], members["f"])
    # Without terms they are evaluated on the contact unknowns.
    g, B = (ProjectedMember.from_terms(projected[n], members[n]) if projected[n] else None for n in ("g", "B"))
    on_contact = np.ascontiguousarray(Z[problem.contact_dofs]) if B is None and coordinates is None else None
    count, rank = model.generators.shape[1], model.span.shape[1]
    sampled, affine = evaluated_members(members)
    # The dual program needs A⁻¹ and independent generators; then queries solve it with one factor.
    dual_is_regular = A.constant and coordinates is None and A.shape[0] >= count == rank > 0
    factor = scipy.linalg.cholesky(A.evaluate(None), lower=True) if dual_is_regular else None
    return ReducedOperators(
        sampled_entries=sampled, affine=affine, A=A, f=f, g=g, B=B, contact_basis=on_contact,
        supremizer_coordinates=coordinates, basis=basis, factor=factor,
    )  # fmt: skip


def _supremizer_space(model: ReducedModel, B: AffineMember, eta: Array) -> PlainCoordinates:
    """Coordinates of V_N and of the supremizers of η at any parameter."""
    V, basis = model.problem.V, model.fixed_basis
    if B.way is Evaluation.CONTACT:
        assert model.problem.contact_dofs is not None  # implied by `Evaluation.CONTACT`
        loads = model.problem.contact_loads(_tested(model, eta)[0])
        return LoadCoordinates(V, basis, model.problem.contact_dofs, loads)
    return SpannedCoordinates(V, basis, np.hstack([supremizers(V, term, eta) for term in B.terms]))


def _tested(model: ReducedModel, eta: Array) -> tuple[Array, Array | None]:
    """Multipliers whose contact loads give those of (η, χ): η and C, where χ = η C up to round-off, or all of them."""
    combination = _combination(model, eta)
    W, chi = model.problem.W, model.generators
    # Combinations that miss χ by more than round-off would change the bounds: then χ has loads of its own.
    missed = W.norm(chi - eta @ combination) > 1e-14 * W.norm(chi)
    return (np.hstack([eta, chi]), None) if missed.any() else (eta, combination)


def _combination(model: ReducedModel, eta: Array) -> Array:
    """The matrix C (k×R) for which η C is nearest to the generators χ in W."""
    W = model.problem.W
    return np.asarray(np.linalg.lstsq(W.whiten(eta), W.whiten(model.generators), rcond=None)[0])


class HyperReducedModel:
    """A reduced `model` whose queries use no array of mesh size, from its offline data, those of `hyper_reduce`.

    `kind` says how the enrichment depends on the parameter in the coordinates of the queries.
    """

    def __init__(self, model: ReducedModel, operators: ReducedOperators) -> None:
        self.model, self._operators = model, operators
        self.problem, self.generators, self.fixed_basis = model.problem, model.generators, model.fixed_basis
        self.kind = Kind.FIXED if operators.supremizer_coordinates is None else Kind.PER_PARAMETER

    @cached_property
    def coefficients(self) -> Callable[[Array], Samples]:
        """The function of mu (d,) that evaluates θ (Q,) of all members that are sums of terms."""
        return coefficients(self.problem, self._operators.sampled_entries, self._operators.affine)

    def assemble(self, mu: Array) -> ReducedProblem:
        """The reduced problem at mu (d,); raises a `NumericalError` if it has entries that are not finite."""
        samples, contact = self.coefficients(mu), None
        if self._loads is not None and self._loads.from_contact is not None:
            # a certificate needs the constraint, too: pass on the one that the loads come from
            contact = contact_at(self.problem, mu)
            varying: tuple[Array, Array] | None = self._loads.from_contact(contact)
        else:
            varying = self._varying(mu)
        return self._in_basis(mu, samples, self._members(samples, varying), contact)

    def assemble_all(self, mus: Array) -> list[ReducedProblem]:
        """The reduced problems at mus (P×d): those of `assemble` up to round-off, sums of terms in one product each."""
        if not len(mus):
            return []
        samples = [self.coefficients(mu) for mu in mus]
        sums = {name: getattr(self._operators, name) for name in MEMBERS}
        varying = {name: of for name, of in sums.items() if of is not None and not of.constant and name in samples[0]}
        values = {name: of.evaluate_all([each[name] for each in samples]) for name, of in varying.items()}
        assembled = []
        for k, (mu, own) in enumerate(zip(mus, samples, strict=True)):
            members = self._members(own, self._varying(mu), {name: value[k] for name, value in values.items()})
            # without the constraints, whose arrays a problem may reuse at the next parameter
            assembled.append(self._in_basis(mu, own, members, None))
        return assembled

    def _in_basis(
        self, mu: Array, samples: Samples, members: VariationalInequality, contact: Contact | None
    ) -> ReducedProblem:
        """The reduced problem at mu (d,) of members on Φ."""
        space, program, Y = self.space, members, None
        if space is not None:
            A, f, B, Y = _enriched(members, space.plain)
            program = VariationalInequality(A, f, B, members.g)
            reconstruct = partial(_reconstructed, space, Y)
        else:
            reconstruct = partial(np.matmul, self.basis)
        known = space is None and self._operators.A.constant
        stiffness = self._sum_of_stiffness if known else program.A.sum()
        if not isfinite(stiffness + program.f.sum() + program.B.sum() + program.g.sum()):
            raise NumericalError(f"the reduced problem has entries that are not finite at mu = {mu.tolist()}")
        evaluated = Evaluated(samples, contact, Y, None if space is None else len(space.plain))
        return ReducedProblem(program, reconstruct, self._operators.factor, evaluated)

    @cached_property
    def _sum_of_stiffness(self) -> float:
        """Cached sum of the entries of a constant A, so that queries skip its finiteness check."""
        return float(self._operators.A.evaluate(None).sum())

    def reconstruct(self, mu: Array, vi: VariationalInequality, x: Array) -> Array:  # noqa: ARG002
        """Vectors u = Z x (n×k) with coordinates x (N'×k) at mu, for reconstruction; it assembles again."""
        return self.assemble(mu).reconstruct(x)

    def declared_terms(self) -> dict[str, Array]:
        """Flat terms (Q×size) of the members declared affine, of A packed upper triangles, on Φ."""
        return {name: getattr(self._operators, name).terms for name in self._operators.affine}

    def contact_terms(self) -> ContactTerms | None:
        """Parts of B and g on Φ where both are evaluated on the contact unknowns; `None` elsewhere."""
        if self._operators.B is not None or self._operators.g is not None:
            return None
        (tested, combination), loads = self._tested, self._loads
        assert loads is not None  # where there is no B
        if isinstance(self.space, LoadCoordinates):
            fixed, reached = self.space.terms
        else:
            assert self._operators.contact_basis is not None  # of a fixed space
            basis = self._operators.contact_basis
            fixed, reached = loads.fixed.T @ basis, basis[loads.reached]
        # What is fixed of the loads that vary is evaluated with these.
        fixed = fixed - loads.fixed[loads.reached].T @ reached
        return ContactTerms(tested, combination, self.generators.shape[1], loads.first, fixed, reached)

    def members(self, mu: Array, samples: Samples) -> VariationalInequality:
        """Members at mu (d,) on Φ, a space that does not depend on mu; B on (η, χ) where Φ has `space`.

        `samples` are the `coefficients` at mu, which callers evaluate for other purposes, too.
        """
        members = self._members(samples, self._varying(mu))
        # The last coordinates of supremizers may be zero, and have no columns.
        missing = len(members.f) - members.B.shape[1]
        return replace(members, B=np.pad(members.B, ((0, 0), (0, missing)))) if missing else members

    def _varying(self, mu: Array) -> tuple[Array, Array] | None:
        """The varying contact loads and the bounds at mu (d,), where a member is projected from contact unknowns."""
        return None if self._loads is None else self._loads.varying(mu)

    @cached_property
    def _loads(self) -> ContactLoads | None:
        """The contact loads of the generators; for a space that varies in Φ of η, and of χ unless these give it."""
        if self._operators.B is not None and self._operators.g is not None:
            return None
        return self.problem.contact_loads(self._tested[0])

    @cached_property
    def _tested(self) -> tuple[Array, Array | None]:
        """The multipliers whose contact loads are evaluated, and C with χ = η C; `None` if they end with χ."""
        eta, space = self.model.enrichment.eta, self.space
        if eta is None or not isinstance(space, LoadCoordinates):
            return self.generators, None
        if space.multipliers == eta.shape[1]:  # as `hyper_reduce` decided
            return eta, _combination(self.model, eta)
        return np.hstack([eta, self.generators]), None

    def _members(
        self, samples: Samples, varying: tuple[Array, Array] | None, known: Mapping[str, Array] = MappingProxyType({})
    ) -> VariationalInequality:
        """The members on Φ but for `known` ones; of a varying space B has what supremizers use alone."""
        operators, count = self._operators, self.generators.shape[1]
        A = known["A"] if "A" in known else operators.A.evaluate(samples.get("A"))
        f = known["f"] if "f" in known else operators.f.evaluate(samples.get("f"))
        if operators.g is not None:
            g = known["g"] if "g" in known else operators.g.evaluate(samples.get("g"))
        else:
            assert varying is not None  # from `_varying`
            combination, bounds = self._tested[1], varying[1]
            g = bounds[len(bounds) - count :] if combination is None else bounds @ combination
        return VariationalInequality(A, f, known["B"] if "B" in known else self._constraint(samples, varying), g)

    @property
    def space(self) -> PlainCoordinates | None:
        """Coordinates of Φ = V_N + supremizers where the enrichment varies in it; `None` for a fixed space."""
        return self._operators.supremizer_coordinates

    @property
    def basis(self) -> Array:
        """The vectors of Φ (n×d)."""
        if self.space is not None:
            return self.space.vectors(np.eye(self.space.plain.shape[0]))
        return self.fixed_basis if self._operators.basis is None else self._operators.basis

    def _constraint(self, samples: Samples, varying: tuple[Array, Array] | None) -> Array:
        operators = self._operators
        if operators.B is not None:
            return operators.B.evaluate(samples.get("B"))
        assert varying is not None  # from `_varying`
        loads = varying[0]
        if isinstance(self.space, LoadCoordinates):
            coordinates, combination = self.space.supremizers(loads).T, self._tested[1]
            return coordinates if combination is None else np.vstack([coordinates, combination.T @ coordinates])
        return self._constraint_of(loads)

    @cached_property
    def _constraint_of(self) -> Callable[[Array], Array]:
        loads, basis = self._loads, self._operators.contact_basis
        assert loads is not None
        assert basis is not None  # set by `hyper_reduce`
        return loads.on(basis)


def _enriched(members: VariationalInequality, plain: Array) -> tuple[Array, Array, Array, Array]:
    """Members A (N'×N'), f (N',), B (R×N') in an orthonormal basis of V_N and the supremizers of η, and that basis.

    `members` are on Φ, B on (η, χ) as far as its columns are not zero; V_N has the first coordinates `plain` (d×N). The
    basis has coordinates Y (d'×N'). What supremizers add is orthonormalised as by `orthonormal_range`, for which their
    coordinates in V_N have to be left out and no more.
    """
    A, f, B, count = members.A, members.f, members.B, len(members.B) - len(members.g)
    used, N = B.shape[1], plain.shape[1]
    # Unit columns: the pivots of the factorisation tell dependent supremizers, whatever their forces are.
    lengths = np.sqrt(np.einsum("ij,ij->i", B[:count], B[:count]))
    added = B[:count, N:].T[:, lengths > 0.0] / lengths[lengths > 0.0]
    added = _pivoted_range(added) if added.size else added[:, :0]
    Y = np.zeros((used, N + added.shape[1]))
    Y[:N, :N], Y[N:, N:] = np.eye(N), added
    rest = A[N:used, N:used] @ added
    projected = np.empty((Y.shape[1], Y.shape[1]))
    projected[:N, :N], projected[:N, N:], projected[N:, N:] = A[:N, :N], A[:N, N:used] @ added, added.T @ rest
    projected[N:, :N] = projected[:N, N:].T
    projected[N:, N:] = 0.5 * (projected[N:, N:] + projected[N:, N:].T)
    return projected, np.append(f[:N], f[N:used] @ added), np.hstack([B[count:, :N], B[count:, N:] @ added]), Y


def _pivoted_range(y: Array) -> Array:
    """Orthonormal basis (n×r) of unit columns (n×k), as `orthonormal_range` computes it.

    `scipy.linalg.qr` asks LAPACK for the sizes of its work arrays, which takes as long as the factorisation itself.
    """
    count = min(y.shape)
    reflectors, _, tau, *_ = dgeqp3(y, overwrite_a=True)
    kept = np.abs(np.diagonal(reflectors)) > RANK_RTOL
    q, *_ = dorgqr(reflectors[:, :count], tau, overwrite_a=True)
    return np.asarray(q[:, kept])


def _reconstructed(space: PlainCoordinates, Y: Array, x: Array) -> Array:
    """Vectors (n×k) from coordinates (N'×k) in an orthonormal basis with coordinates Y (d'×N')."""
    return space.vectors(Y @ x)


AnyReducedModel = ReducedModel | HyperReducedModel
"""A model that assembles the reduced program at a parameter."""
