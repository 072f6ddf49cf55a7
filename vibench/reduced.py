"""The reduced model: project, solve, reconstruct (paper, §2.2 and §2.3; MATH in the documentation, §4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.factor import SparseCholesky
from vibench.linalg import orthonormal_range
from vibench.problem import Problem, VariationalInequality, checked_assembly
from vibench.space import InnerProduct
from vibench.strategy import Enrichment, Kind
from vibench.supremizer import ContactCoordinates, contact_factor


@dataclass(frozen=True)
class ReducedProblem:
    """The reduced variational inequality at one parameter.

    Attributes
    ----------
    program
        Dense A (N'×N'), f (N',), B (R×N'), g (R,) in coordinates of the primal basis and of the generators.
    make_basis
        Gives the primal basis, which only a reconstruction needs.
    factor
        Cholesky factor (lower, N'×N') of A, where it is known beforehand.
    """

    program: VariationalInequality
    make_basis: Callable[[], Array]
    factor: Array | None = None

    @property
    def basis(self) -> Array:
        """V-orthonormal primal basis Z (n×N') at this parameter: u = Z x."""
        return self.make_basis()


class ReducedModel:
    """V_N + enrichment against a reduced cone.

    Parameters
    ----------
    problem
        The high-fidelity problem.
    basis
        V-orthonormal basis of V_N (n×N).
    enrichment
        What the primal strategy adds.
    generators
        χ (m×R), unit norm in W.
    span
        W-orthonormal basis of span χ (m×rank), what per-parameter enrichments are computed from.

    Attributes
    ----------
    fixed_basis
        The part of the primal basis that does not depend on the parameter (n×(N+S)).
    """

    def __init__(self, problem: Problem, basis: Array, enrichment: Enrichment, generators: Array, span: Array) -> None:
        self.problem = problem
        self.generators = generators
        self.span = span
        self.enrichment = enrichment
        self.fixed_basis = basis if enrichment.vectors is None else np.hstack([basis, enrichment.vectors])

    @property
    def kind(self) -> Kind:
        """How the enrichment depends on the parameter."""
        return self.enrichment.kind

    def primal_basis(self, vi: VariationalInequality) -> Array:
        """V-orthonormal basis Z (n×N') at the parameter of `vi`; V_N comes first."""
        V, enrichment = self.problem.V, self.enrichment
        if enrichment.eta is not None and self.problem.contact_dofs is not None:
            contact = self._contact
            loads = np.asarray(vi.B.T @ enrichment.eta)[self.problem.contact_dofs]
            added = contact.vectors(orthonormal_range(contact.supremizers(loads), contact.plain))
            return np.hstack([self.fixed_basis, added])
        if enrichment.eta is not None:
            whitened = V.whiten_functional(np.asarray(vi.B.T @ enrichment.eta))  # those of T(mu)η
        elif enrichment.supply is not None:
            added = enrichment.supply(V, vi, self.span)
            if added.ndim != 2 or added.shape[0] != V.dim:
                raise NumericalError(
                    f"the enrichment supplied vectors of shape {added.shape}, expected ({V.dim}, count)"
                )
            whitened = V.whiten(added)
        else:
            return self.fixed_basis
        return np.hstack([self.fixed_basis, V.unwhiten(orthonormal_range(whitened, self._whitened_basis))])

    def basis_at(self, mu: Array, vi: VariationalInequality) -> Array:  # noqa: ARG002
        """The primal basis at mu, where `vi` is assembled."""
        return self.primal_basis(vi)

    @cached_property
    def _contact(self) -> ContactCoordinates:
        """Coordinates of V_N and of all supremizers of a problem that says what its constraint touches."""
        V, dofs = self.problem.V, self.problem.contact_dofs
        assert dofs is not None  # asked for in this case alone
        return ContactCoordinates(V, self.fixed_basis, dofs, _factor_of(V, dofs.astype(np.intp).tobytes()))

    @cached_property
    def _whitened_basis(self) -> Array:
        return self.problem.V.whiten(self.fixed_basis)

    def assemble(self, mu: Array) -> ReducedProblem:
        """Assemble at mu (d,) in full, as the paper does: high-fidelity matrices, then their projections.

        Raises
        ------
        NumericalError
            If what the problem assembles has the wrong shape or values that are not finite.
        """
        return self.reduce(checked_assembly(self.problem, mu))

    def reduce(self, vi: VariationalInequality) -> ReducedProblem:
        """Project what the problem assembled at a parameter."""
        Z = self.primal_basis(vi)
        return ReducedProblem(project(vi, Z, self.generators), lambda: Z)


@lru_cache(maxsize=1)
def _factor_of(V: InnerProduct, dofs: bytes) -> tuple[SparseCholesky, Array]:
    """X_V with the contact last: like V itself the same for all models of a problem."""
    return contact_factor(V, np.frombuffer(dofs, np.intp))


def project(vi: VariationalInequality, Z: Array, chi: Array) -> VariationalInequality:
    """Galerkin projection on span Z (n×N') and the cone of χ (m×R): dense A, f, B, g."""
    A = Z.T @ np.asarray(vi.A @ Z)
    return VariationalInequality(A=0.5 * (A + A.T), f=Z.T @ vi.f, B=chi.T @ np.asarray(vi.B @ Z), g=chi.T @ vi.g)
