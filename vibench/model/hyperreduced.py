"""Reduced models whose queries touch no array of mesh size (equations (8) and (9) of the paper, assembled online)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError
from vibench.interfaces.problem import MEMBERS, Contact, Problem, Sampler, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.linalg.dense import orthonormal_range
from vibench.model.affine import Evaluation, Member
from vibench.model.galerkin import ReducedModel, ReducedProblem
from vibench.reduction.supremizers import ContactCoordinates, Coordinates, SpannedCoordinates, supremizers

Samples = Mapping[str, Array]
"""Values of sampled entries at one parameter, by member."""


@dataclass(frozen=True)
class Projected:
    """A member in reduced coordinates: Σ_q θ_q(mu) · terms_q, or a constant.

    Attributes
    ----------
    terms
        Flattened terms (Q×size), packed where they are symmetric.
    shape
        Shape of the member.
    constant
        Whether the only term is the member itself.
    unpack
        Where the entries of a symmetric matrix are in its packed form (d²,); `None` where nothing is packed.
    """

    terms: Array
    shape: tuple[int, ...]
    constant: bool
    unpack: Indices | None = None

    @classmethod
    def of(cls, terms: list[Array], member: Member) -> Projected:
        """Pack projected terms."""
        shape = terms[0].shape
        return cls(np.array([term.ravel() for term in terms]), shape, member.way is Evaluation.CONSTANT)

    @classmethod
    def symmetric(cls, terms: list[Array], member: Member) -> Projected:
        """Pack projected symmetric terms (d×d)."""
        d = terms[0].shape[0]
        upper = np.triu_indices(d)
        where = np.empty((d, d), dtype=np.intp)
        where[upper] = where.T[upper] = np.arange(len(upper[0]))
        packed = np.array([(0.5 * (term + term.T))[upper] for term in terms])
        return cls(packed, (d, d), member.way is Evaluation.CONSTANT, where.ravel())

    def at(self, theta: Array | None) -> Array:
        """The member where its samples are θ (Q,)."""
        if self.constant or theta is None:
            return self._only
        return self._unpacked(theta @ self.terms)

    @cached_property
    def _only(self) -> Array:
        return self._unpacked(self.terms[0])

    def _unpacked(self, flat: Array) -> Array:
        return (flat if self.unpack is None else flat[self.unpack]).reshape(self.shape)


@dataclass(frozen=True)
class Operators:
    """What a query without arrays of mesh size needs: a space Φ of dimension d, and the members on it.

    Attributes
    ----------
    wanted
        Entries of the members to be sampled at a parameter: rows and columns by member.
    A, f
        Stiffness (d×d) and load (d,) on Φ.
    g
        Bound (R,); `None` where it comes with the contact.
    B
        Constraint on generators and on Φ (R×d), or on (η, χ) and Φ for enrichments that vary ((k+R)×d); `None` where it
        comes with the contact.
    on_contact
        Φ on the contact unknowns (|E|×d), where a fixed space meets a constraint assembled there.
    varying
        Coordinates of Φ where the enrichment varies in it, else `None`.
    basis
        Φ itself (n×d), for reconstruction, where it is neither `varying` nor the model's fixed basis.
    factor
        Cholesky factor (lower, d×d) of a stiffness that does not depend on the parameter, on a fixed space of no fewer
        dimensions than there are generators, which are independent.
    """

    wanted: Mapping[str, tuple[Indices, Indices]]
    A: Projected
    f: Projected
    g: Projected | None
    B: Projected | None
    on_contact: Array | None
    varying: Coordinates | None
    basis: Array | None
    factor: Array | None


def why_in_full(model: ReducedModel, members: Mapping[str, Member]) -> str:
    """Why queries of a model have to be assembled in full; "" if they have not."""
    if model.enrichment.supply is not None:
        return "the enrichment varies with mu in a way of its own"
    return "; ".join(members[name].why for name in MEMBERS if members[name].way is Evaluation.FULL)


def project_members(model: ReducedModel, members: Mapping[str, Member]) -> Operators:
    """Project the members of a problem on what its reduced model lives in; see `why_in_full`."""
    problem, chi, eta = model.problem, model.generators, model.enrichment.eta
    varying = None if eta is None or len(members["B"].terms) == 1 else _supremizer_space(model, members["B"], eta)
    Z = basis = None
    if varying is not None and eta is not None:
        Z, chi = varying.vectors(np.eye(varying.plain.shape[0])), np.hstack([eta, chi])
    elif eta is not None:
        B = members["B"].terms[0]
        basis = Z = model.primal_basis(VariationalInequality(A=None, f=np.zeros(0), B=B, g=np.zeros(0)))
    else:
        Z = model.fixed_basis
    A = Projected.symmetric([Z.T @ np.asarray(term @ Z) for term in members["A"].terms], members["A"])
    contact = members["B"].way is Evaluation.CONTACT
    count, rank = model.generators.shape[1], model.span.shape[1]
    through_dual = A.constant and varying is None and A.shape[0] >= count == rank > 0  # or the dual is singular
    return Operators(
        wanted={name: (m.rows, m.columns) for name, m in members.items() if m.way is Evaluation.INTERPOLATED},
        A=A,
        f=Projected.of([Z.T @ term for term in members["f"].terms], members["f"]),
        g=_bound(members["g"], model.generators),
        B=None if contact else Projected.of([chi.T @ np.asarray(B @ Z) for B in members["B"].terms], members["B"]),
        on_contact=np.ascontiguousarray(Z[problem.contact_dofs]) if contact and varying is None else None,
        varying=varying,
        basis=basis,
        factor=scipy.linalg.cholesky(A.at(None), lower=True) if through_dual else None,
    )


def _bound(member: Member, chi: Array) -> Projected | None:
    return None if member.way is Evaluation.CONTACT else Projected.of([chi.T @ term for term in member.terms], member)


def _supremizer_space(model: ReducedModel, B: Member, eta: Array) -> Coordinates:
    """Coordinates of V_N and of the supremizers of η at any parameter."""
    V, basis = model.problem.V, model.fixed_basis
    if B.way is Evaluation.CONTACT:
        assert model.problem.contact_dofs is not None  # what this way means
        return ContactCoordinates(V, basis, model.problem.contact_dofs)
    return SpannedCoordinates(V, basis, np.hstack([supremizers(V, term, eta) for term in B.terms]))


class OnlineModel:
    """A reduced model ready for queries that touch no array of mesh size.

    Parameters
    ----------
    model
        The model it makes queries of.
    operators
        Its members, projected.
    """

    def __init__(self, model: ReducedModel, operators: Operators) -> None:
        self.model = model
        self._operators = operators

    @property
    def problem(self) -> Problem:
        """The high-fidelity problem."""
        return self.model.problem

    @cached_property
    def _sampler(self) -> Sampler:
        wanted = self._operators.wanted
        return self.problem.sampler(wanted) if wanted else lambda _: {}

    @property
    def generators(self) -> Array:
        """χ (m×R)."""
        return self.model.generators

    @property
    def fixed_basis(self) -> Array:
        """The part of the primal basis that does not depend on the parameter (n×(N+S))."""
        return self.model.fixed_basis

    @property
    def kind(self) -> Kind:
        """How the enrichment depends on the parameter, in the coordinates that queries work in."""
        return Kind.FIXED if self._operators.varying is None else Kind.PER_PARAMETER

    def assemble(self, mu: Array) -> ReducedProblem:
        """The reduced problem at mu (d,).

        Raises
        ------
        NumericalError
            If values that are not finite come out.
        """
        operators = self._operators
        samples = self._sampler(mu)
        contact = self.problem.contact(mu) if operators.B is None or operators.g is None else None
        A, f = operators.A.at(samples.get("A")), operators.f.at(samples.get("f"))
        g = operators.g.at(samples.get("g")) if operators.g is not None else _on_generators(self.model, contact)
        if operators.varying is not None:
            Y, B = self._enriched(operators.varying, samples, contact)
            A, f, B = _congruent(A, Y), Y.T @ f, B @ Y
            lift = partial(_lifted, operators.varying, Y)
        else:
            B = self._constraint(samples, contact)
            Z = operators.basis if operators.basis is not None else self.model.fixed_basis
            lift = partial(np.matmul, Z)
        if not all(np.isfinite(member.sum()) for member in (A, f, B, g)):
            raise NumericalError(f"the reduced problem has entries that are not finite at mu = {mu.tolist()}")
        return ReducedProblem(VariationalInequality(A, f, B, g), lift, operators.factor)

    def lift(self, mu: Array, vi: VariationalInequality, x: Array) -> Array:  # noqa: ARG002
        """Vectors u = Z x (n×k) with coordinates x (N'×k) at mu, which only a reconstruction needs."""
        return self.assemble(mu).lift(x)

    def _constraint(self, samples: Samples, contact: Contact | None) -> Array:
        operators = self._operators
        if operators.B is not None:
            return operators.B.at(samples.get("B"))
        assert contact is not None and operators.on_contact is not None  # noqa: PT018  what `project_members` provides
        return np.asarray(self.model.generators.T @ (contact.B @ operators.on_contact))

    def _enriched(self, space: Coordinates, samples: Samples, contact: Contact | None) -> tuple[Array, Array]:
        """Orthonormal coordinates Y (d×N') of V_N and the supremizers, and the constraint (R×d) in coordinates."""
        eta = self.model.enrichment.eta
        assert eta is not None  # only such an enrichment varies in a space of coordinates
        if isinstance(space, ContactCoordinates) and contact is not None:
            represented = space.supremizers(np.asarray(contact.B.T @ np.hstack([eta, self.model.generators])))
        else:
            assert self._operators.B is not None
            represented = self._operators.B.at(samples.get("B")).T
        k = eta.shape[1]
        added = orthonormal_range(represented[:, :k], space.plain)
        return np.hstack([space.plain, added]), represented[:, k:].T


def _lifted(space: Coordinates, Y: Array, x: Array) -> Array:
    """Vectors (n×k) from coordinates (N'×k) in an orthonormal basis with coordinates Y (d×N')."""
    return space.vectors(Y @ x)


def _on_generators(model: ReducedModel, contact: Contact | None) -> Array:
    assert contact is not None  # what `OnlineModel.assemble` asked for
    return np.asarray(model.generators.T @ contact.g)


def _congruent(A: Array, Y: Array) -> Array:
    found = Y.T @ (A @ Y)
    return np.asarray(0.5 * (found + found.T))
