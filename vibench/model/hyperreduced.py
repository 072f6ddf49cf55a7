"""Hyper-reduced models: equations (8) and (9) of the paper assembled online without arrays of mesh size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError
from vibench.interfaces.problem import MEMBERS, Contact, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.linalg.inner_product import orthonormal_range
from vibench.model.affine import AffineMember, Evaluation, coefficients, evaluated_members
from vibench.model.galerkin import Evaluated, ReducedModel, ReducedProblem
from vibench.reduction.supremizers import ContactCoordinates, Coordinates, SpannedCoordinates, supremizers

Samples = Mapping[str, Array]
"""Coefficients θ of the terms at one parameter, by member."""


@dataclass(frozen=True)
class ProjectedMember:
    """A member in reduced coordinates: Σ_q θ_q(mu) · terms_q, or a constant.

    Attributes
    ----------
    terms
        Flattened terms (Q×size); symmetric ones are stored as upper triangles.
    shape
        Shape of the member.
    constant
        Whether the only term is the member itself.
    unpack
        Positions of the entries of a symmetric matrix in its packed triangle (d²,); `None` for full storage.
    """

    terms: Array
    shape: tuple[int, ...]
    constant: bool
    unpack: Indices | None = None

    @classmethod
    def of(cls, terms: list[Array], member: AffineMember) -> ProjectedMember:
        """A member from its projected terms."""
        shape = terms[0].shape
        return cls(np.array([term.ravel() for term in terms]), shape, member.way is Evaluation.CONSTANT)

    @classmethod
    def symmetric(cls, terms: list[Array], member: AffineMember) -> ProjectedMember:
        """A symmetric member from its projected terms (d×d)."""
        d = terms[0].shape[0]
        upper = np.triu_indices(d)
        where = np.empty((d, d), dtype=np.intp)
        where[upper] = where.T[upper] = np.arange(len(upper[0]))
        packed = np.array([(0.5 * (term + term.T))[upper] for term in terms])
        return cls(packed, (d, d), member.way is Evaluation.CONSTANT, where.ravel())

    def at(self, theta: Array | None) -> Array:
        """The member with coefficients θ (Q,)."""
        if self.constant or theta is None:
            return self._constant_value
        return self._unpacked(theta @ self.terms)

    @cached_property
    def _constant_value(self) -> Array:
        return self._unpacked(self.terms[0])

    def _unpacked(self, flat: Array) -> Array:
        return (flat if self.unpack is None else flat[self.unpack]).reshape(self.shape)


@dataclass(frozen=True)
class ReducedOperators:
    """Offline data of a hyper-reduced model: a space Φ of dimension d and the members projected on it.

    Attributes
    ----------
    sampled_entries
        Entries of the members that are evaluated at a parameter: rows and columns by member.
    affine
        Members whose coefficients are those of `Problem.affine`.
    A, f
        Stiffness (d×d) and load (d,) on Φ.
    g
        Bound (R,); `None` where it is evaluated by `Problem.contact`.
    B
        Constraint (R×d) on the generators χ, or ((k+R)×d) on (η, χ) for a per-parameter enrichment; `None` where it is
        evaluated by `Problem.contact`.
    contact_basis
        Rows of Φ at the contact unknowns (|E|×d), for a fixed space and a constraint from `Problem.contact`.
    supremizer_coordinates
        Coordinates of Φ = V_N + supremizers for a per-parameter enrichment that varies in it, else `None`.
    basis
        Φ itself (n×d), for reconstruction, where it is neither of the above nor the model's fixed basis.
    factor
        Cholesky factor (lower, d×d) of a constant stiffness on a fixed space, for queries that solve the dual program.
        `None` for more than d or linearly dependent generators, with which the dual is singular.
    """

    sampled_entries: Mapping[str, tuple[Indices, Indices]]
    affine: tuple[str, ...]
    A: ProjectedMember
    f: ProjectedMember
    g: ProjectedMember | None
    B: ProjectedMember | None
    contact_basis: Array | None
    supremizer_coordinates: Coordinates | None
    basis: Array | None
    factor: Array | None


def reason_for_full_assembly(model: ReducedModel, members: Mapping[str, AffineMember]) -> str:
    """Why the model has to be assembled in full, as the paper does; "" if it can be hyper-reduced."""
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
    A = ProjectedMember.symmetric([Z.T @ np.asarray(term @ Z) for term in members["A"].terms], members["A"])
    contact = members["B"].way is Evaluation.CONTACT
    count, rank = model.generators.shape[1], model.span.shape[1]
    sampled, affine = evaluated_members(members)
    dual_is_regular = A.constant and coordinates is None and A.shape[0] >= count == rank > 0
    return ReducedOperators(
        sampled_entries=sampled,
        affine=affine,
        A=A,
        f=ProjectedMember.of([Z.T @ term for term in members["f"].terms], members["f"]),
        g=None
        if members["g"].way is Evaluation.CONTACT
        else ProjectedMember.of([model.generators.T @ term for term in members["g"].terms], members["g"]),
        B=None
        if contact
        else ProjectedMember.of([chi.T @ np.asarray(B @ Z) for B in members["B"].terms], members["B"]),
        contact_basis=np.ascontiguousarray(Z[problem.contact_dofs]) if contact and coordinates is None else None,
        supremizer_coordinates=coordinates,
        basis=basis,
        factor=scipy.linalg.cholesky(A.at(None), lower=True) if dual_is_regular else None,
    )


def _supremizer_space(model: ReducedModel, B: AffineMember, eta: Array) -> Coordinates:
    """Coordinates of V_N and of the supremizers of η at any parameter."""
    V, basis = model.problem.V, model.fixed_basis
    if B.way is Evaluation.CONTACT:
        assert model.problem.contact_dofs is not None  # implied by `Evaluation.CONTACT`
        return ContactCoordinates(V, basis, model.problem.contact_dofs)
    return SpannedCoordinates(V, basis, np.hstack([supremizers(V, term, eta) for term in B.terms]))


class HyperReducedModel:
    """A reduced model whose queries use no array of mesh size.

    Parameters
    ----------
    model
        The reduced model.
    operators
        Its offline data, from `hyper_reduce`.

    Attributes
    ----------
    model, problem, generators, fixed_basis
        The reduced model, and these of its attributes.
    kind
        How the enrichment depends on the parameter, in the coordinates of the queries.
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
        """The reduced problem at mu (d,).

        Raises
        ------
        NumericalError
            If the reduced problem has entries that are not finite.
        """
        samples, contact = self.coefficients(mu), self._contact(mu)
        members, space = self._members(samples, contact), self.space
        A, f, B, g = members.A, members.f, members.B, members.g
        Y = None
        if space is not None:
            count = len(B) - self.generators.shape[1]
            Y, B = np.hstack([space.plain, orthonormal_range(B[:count].T, space.plain)]), B[count:]
            A, f, B = Y.T @ (A @ Y), Y.T @ f, B @ Y
            A = 0.5 * (A + A.T)
            reconstruct = partial(_reconstructed, space, Y)
        else:
            reconstruct = partial(np.matmul, self.basis)
        if not all(np.isfinite(member.sum()) for member in (A, f, B, g)):
            raise NumericalError(f"the reduced problem has entries that are not finite at mu = {mu.tolist()}")
        evaluated = Evaluated(samples, contact, Y)
        return ReducedProblem(VariationalInequality(A, f, B, g), reconstruct, self._operators.factor, evaluated)

    def reconstruct(self, mu: Array, vi: VariationalInequality, x: Array) -> Array:  # noqa: ARG002
        """Vectors u = Z x (n×k) with coordinates x (N'×k) at mu, for reconstruction; it assembles again."""
        return self.assemble(mu).reconstruct(x)

    def declared_terms(self) -> dict[str, Array]:
        """Flat terms (Q×size) of the members declared affine, of A packed upper triangles, on Φ."""
        return {name: getattr(self._operators, name).terms for name in self._operators.affine}

    def members(self, mu: Array, samples: Samples) -> VariationalInequality:
        """A, f, B, g at mu (d,) on Φ, a space that does not depend on mu; B on (η, χ) where Φ has `space`.

        `samples` are the `coefficients` at mu, which whoever needs members on Φ evaluates for other purposes, too.
        """
        return self._members(samples, self._contact(mu))

    def _contact(self, mu: Array) -> Contact | None:
        """B and g at mu (d,) on the contact unknowns, where a member is projected from there."""
        return self.problem.contact(mu) if self._operators.B is None or self._operators.g is None else None

    def _members(self, samples: Samples, contact: Contact | None) -> VariationalInequality:
        operators, generators = self._operators, self.generators
        A, f = operators.A.at(samples.get("A")), operators.f.at(samples.get("f"))
        if operators.g is not None:
            g = operators.g.at(samples.get("g"))
        else:
            assert contact is not None  # from `_contact`
            g = np.asarray(generators.T @ contact.g)
        return VariationalInequality(A, f, self._constraint(samples, contact), g)

    @property
    def space(self) -> Coordinates | None:
        """Coordinates of Φ = V_N + supremizers where the enrichment varies in it; `None` for a fixed space."""
        return self._operators.supremizer_coordinates

    @property
    def basis(self) -> Array:
        """The vectors of Φ (n×d)."""
        if self.space is not None:
            return self.space.vectors(np.eye(self.space.plain.shape[0]))
        return self.fixed_basis if self._operators.basis is None else self._operators.basis

    def _constraint(self, samples: Samples, contact: Contact | None) -> Array:
        operators = self._operators
        if operators.B is not None:
            return operators.B.at(samples.get("B"))
        assert contact is not None  # evaluated by `members`
        if isinstance(self.space, ContactCoordinates):
            eta = self.model.enrichment.eta
            assert eta is not None  # implied by `supremizer_coordinates`
            return self.space.supremizers(np.asarray(contact.B.T @ np.hstack([eta, self.generators]))).T
        assert operators.contact_basis is not None  # set by `hyper_reduce`
        return np.asarray(self.model.generators.T @ (contact.B @ operators.contact_basis))


def _reconstructed(space: Coordinates, Y: Array, x: Array) -> Array:
    """Vectors (n×k) from coordinates (N'×k) in an orthonormal basis with coordinates Y (d×N')."""
    return space.vectors(Y @ x)
