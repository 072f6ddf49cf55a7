"""Reduced models by Galerkin projection of the assembled high-fidelity problem (paper, §2.2 and §2.3)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np

from vibench.arrays import Array, SparseMatrix, taken
from vibench.interfaces.problem import MEMBERS, Contact, Problem, VariationalInequality
from vibench.interfaces.strategies import Enrichment
from vibench.interfaces.validation import checked_assembly, first_assembly
from vibench.linalg.inner_product import orthonormal_range
from vibench.reduction.supremizers import ContactCoordinates, projected_supremizers, proportionality


@dataclass(frozen=True)
class Evaluated:
    """Data that a hyper-reduced assembly evaluates at one parameter; none for an assembly in full."""

    # Values of the sampled entries, by member.
    samples: Mapping[str, Array] = field(default_factory=dict)
    # The constraint on the contact unknowns, where B or g are evaluated there; valid until the problem evaluates
    # another one, which may be written into the same arrays.
    contact: Contact | None = None
    # Coordinates of the primal basis Z in the space Φ (of dimension `dim`) of the model, without those at the end that
    # are zero in all of Z; `None` where Z is Φ.
    coordinates: Array | None = None
    dim: int | None = None

    def in_space(self, x: Array) -> Array:
        """Coordinates (d,) in Φ from those (N',) in Z."""
        if self.coordinates is None or self.dim is None:
            return x
        y = np.zeros(self.dim)
        y[: len(self.coordinates)] = self.coordinates @ x
        return y


@dataclass(frozen=True)
class ReducedProblem:
    """The reduced variational inequality at one parameter."""

    # Dense A (N'×N'), f (N',), B (R×N'), g (R,) in coordinates of the primal basis and of the generators.
    program: VariationalInequality
    # From coordinates (N'×k) in the V-orthonormal primal basis Z at this parameter to vectors (n×k): u = Z x.
    reconstruct: Callable[[Array], Array]
    # Cholesky factor (lower, N'×N') of A, where it was computed offline.
    factor: Array | None = None
    evaluated: Evaluated = Evaluated()

    @property
    def basis(self) -> Array:
        """The basis Z (n×N')."""
        return self.reconstruct(np.eye(len(self.program.f)))


class ReducedModel:
    """A reduced primal space, V_N and its enrichment, with a reduced multiplier cone.

    `basis` is a V-orthonormal one of V_N (n×N), `fixed_basis` the part of the primal basis that does not depend on the
    parameter (n×(N+S)). `generators` are χ (m×R), unit norm in W, all with nonnegative coefficients: a free generator
    appears with both signs (`ReducedSet.rays`), and its two inequalities are an equality. `span` is a W-orthonormal
    basis of span χ (m×rank), from which per-parameter enrichments are computed.
    """

    def __init__(self, problem: Problem, basis: Array, enrichment: Enrichment, generators: Array, span: Array) -> None:
        self.problem, self.generators, self.span = problem, generators, span
        self.enrichment, self.kind = enrichment, enrichment.kind
        self.fixed_basis = basis if enrichment.vectors is None else np.hstack([basis, enrichment.vectors])

    def primal_basis(self, vi: VariationalInequality) -> Array:
        """V-orthonormal basis Z (n×N') at the parameter of `vi`; V_N comes first."""
        V, enrichment = self.problem.V, self.enrichment
        if (contact := self._contact) is not None:
            return np.hstack([self.fixed_basis, contact.vectors(self._added(contact, vi))])
        if enrichment.eta is not None:
            whitened = V.whiten_functional(np.asarray(vi.B.T @ enrichment.eta))  # coordinates of T(mu)η
        elif enrichment.supply is not None:
            added = taken(enrichment.supply(V, vi, self.span), "the supply of the enrichment", V.dim, "count")
            whitened = V.whiten(added)
        else:
            return self.fixed_basis
        return np.hstack([self.fixed_basis, V.unwhiten(orthonormal_range(whitened, self._whitened_basis))])

    def primal_bases(self, vis: Iterable[VariationalInequality]) -> Iterator[Array]:
        """`primal_basis` at many parameters: one array where what is added agrees but for round-off.

        That is so where B(mu) is one matrix times a positive number.
        """
        if (contact := self._contact) is None:
            yield from map(self.primal_basis, vis)
            return
        before: tuple[Array, Array] | None = None
        for added in self._added_at(contact, vis):
            if before is None or not (added is before[0] or _agree(added, before[0])):
                before = added, np.hstack([self.fixed_basis, contact.vectors(added)])
            yield before[1]

    def reconstruct(self, mu: Array, vi: VariationalInequality, x: Array) -> Array:  # noqa: ARG002
        """Vectors u = Z x (n×k) with coordinates x (N'×k) at mu, with `vi` assembled there."""
        if (contact := self._contact) is None:
            return np.asarray(self.primal_basis(vi) @ x)
        count = self.fixed_basis.shape[1]
        return np.asarray(self.fixed_basis @ x[:count] + contact.vectors(self._added(contact, vi) @ x[count:]))

    def reconstruct_all(self, vis: Iterable[VariationalInequality], xs: Sequence[Array]) -> Array:
        """The columns u = Z x (n×P) with coordinates x (N',), each at the parameter of its own inequality."""
        count, contact = self.fixed_basis.shape[1], self._contact
        if contact is None:
            return np.column_stack([self.primal_basis(vi) @ x for vi, x in zip(vis, xs, strict=True)])
        on = [added @ x[count:] for added, x in zip(self._added_at(contact, vis), xs, strict=True)]
        return np.asarray(self.fixed_basis @ np.column_stack([x[:count] for x in xs]) + contact.vectors(np.array(on).T))

    def project_supremizers(self, vi: VariationalInequality, eta: Array) -> Array:
        """ZᵀBᵀη (N'×k) for multipliers η (m×k) at the parameter of `vi`."""
        if (contact := self._contact) is None:
            return projected_supremizers(self.primal_basis(vi), vi.B, eta)
        Y = np.hstack([contact.plain, self._added(contact, vi)])
        return np.asarray(Y.T @ contact.supremizers(np.asarray(vi.B.T @ eta)[self.problem.contact_dofs]))

    def _added(self, contact: ContactCoordinates, vi: VariationalInequality) -> Array:
        """Orthonormal coordinates (d×S) of what the supremizers at the parameter of `vi` add to V_N."""
        loads = np.asarray(vi.B.T @ self.enrichment.eta)[self.problem.contact_dofs]
        return orthonormal_range(contact.supremizers(loads), contact.plain)

    def _added_at(self, contact: ContactCoordinates, vis: Iterable[VariationalInequality]) -> Iterator[Array]:
        """`_added` at many parameters: one array where B is a positive multiple of that of an earlier parameter.

        The first of these multiples shows whether round-off decides about the coordinates: then every one has its own.
        """
        first: tuple[SparseMatrix, Array] | None = None
        shared: bool | None = None
        for vi in vis:
            # Supremizers span the same space if B is a positive multiple of an earlier one.
            alike = first is not None and (proportionality(vi.B, first[0]) or 0.0) > 0.0
            if first is not None and alike and shared:
                yield first[1]
                continue
            own = self._added(contact, vi)
            if first is None or not alike:
                first, shared = (vi.B.copy(), own), None
            elif shared is None:
                shared = _agree(own, first[1])
            yield first[1] if shared else own

    @cached_property
    def _contact(self) -> ContactCoordinates | None:
        """Coordinates of contact size in which supremizers are orthonormalised; `None` where vectors (n,) are."""
        V, dofs = self.problem.V, self.problem.contact_dofs
        # A dense factor of most unknowns would cost more than vectors of all.
        if self.enrichment.eta is None or dofs is None or 2 * len(dofs) > V.dim:
            return None
        return ContactCoordinates(V, self.fixed_basis, dofs)

    @cached_property
    def _whitened_basis(self) -> Array:
        return self.problem.V.whiten(self.fixed_basis)

    def assemble(self, mu: Array) -> ReducedProblem:
        """Assemble at mu (d,) in full: high-fidelity matrices, checked, then their projections."""
        return self.reduce(checked_assembly(self.problem, mu))

    def reduce(self, vi: VariationalInequality) -> ReducedProblem:
        """Galerkin projection of an assembled variational inequality."""
        Z = self.primal_basis(vi)
        return ReducedProblem(project(vi, Z, self.generators), partial(np.matmul, Z))


def contact_at(problem: Problem, mu: Array) -> Contact:
    """The constraint at mu (d,) on the contact unknowns of a problem that has them."""
    contact = problem.contact(mu)
    assert contact is not None  # implied by `has_contact`
    return contact


def _agree(one: Array, other: Array) -> bool:
    # coordinates of supremizers of proportional B differ by less than 1e-12
    return one.shape == other.shape and float(np.max(np.abs(one - other), initial=0.0)) <= 1e-12


def projections(Z: Array, chi: Array) -> dict[str, Callable[[Any], Array]]:
    """Galerkin projections on span Z (n×N') and the cone of χ (m×R) by member, linear maps: dense A, f, B, g."""

    def stiffness(A: Any) -> Array:
        # Symmetrise: solvers factorise one triangle, verification uses both.
        projected = Z.T @ np.asarray(A @ Z)
        return np.asarray(0.5 * (projected + projected.T))

    return {
        "A": stiffness,
        "f": lambda f: Z.T @ f,
        "B": lambda B: np.asarray(chi.T @ np.asarray(B @ Z)),
        "g": lambda g: chi.T @ g,
    }


def project(
    vi: VariationalInequality, Z: Array, chi: Array, known: Mapping[str, Array] = MappingProxyType({})
) -> VariationalInequality:
    """Galerkin projection on span Z (n×N') and the cone of χ (m×R).

    `known` has projections of members, by name, that were made at another parameter.
    """
    made = projections(Z, chi).items()
    A, f, B, g = (known[name] if name in known else of(getattr(vi, name)) for name, of in made)
    return VariationalInequality(A, f, B, g)


def projected_members(
    problem: Problem, Z: Annotated[Array, "n", "N"], chi: Annotated[Array, "m", "R"], left_out: Collection[str] = ()
) -> Callable[[Array], dict[str, Array]]:
    """Return a function of mu (d,) for projections of members by name, on span Z (n×N') and the cone of χ (m×R).

    What is constant or declared affine is projected once, other B and g on the contact unknowns where the problem has
    them. A and f have to be constant or affine, or among those left out.
    """
    names = [name for name in MEMBERS if name not in left_out]
    of, (_, vi) = projections(Z, chi), first_assembly(problem)
    constant = {name: of[name](getattr(vi, name)) for name in names if name in problem.constant}
    affine = {n: problem.affine[n].mapped(of[n]) for n in names if n in problem.affine and n not in constant}
    left = [name for name in names if name not in constant and name not in affine]
    loads = problem.contact_loads(chi) if problem.has_contact and left else None
    on = None if loads is None else loads.on(Z[problem.contact_dofs])

    def at(mu: Array) -> dict[str, Array]:
        found = constant | {name: sums.at(mu) for name, sums in affine.items()}
        if not left:
            return found
        if loads is None or on is None:
            B, g = problem.constraint(mu)
            evaluated = {"B": of["B"](B), "g": of["g"](g)}
        else:
            varying, bounds = loads.varying(mu)
            evaluated = {"B": on(varying), "g": bounds}
        return found | {name: evaluated[name] for name in left}

    return at


def leading_part(program: VariationalInequality, size: int) -> VariationalInequality:
    """The program on the first `size` vectors of a nested basis, from the program on all of them."""
    A, B = (np.ascontiguousarray(member) for member in (program.A[:size, :size], program.B[:, :size]))
    return VariationalInequality(A, program.f[:size].copy(), B, program.g)
