"""Problems all of whose members are constant or affine: they are declared, and need no assembly of their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError
from vibench.interfaces.affine import AffineSum, Theta
from vibench.interfaces.problem import MEMBERS, Contact, Problem, VariationalInequality

Declaration: TypeAlias = Any | Sequence[tuple[Theta, Any]] | AffineSum
"""A constant matrix or vector, the pairs (θ_q, term_q) of an affine sum, or the sum."""

MAX_CONTACT_SHARE = 0.5
"""Unknowns of the constraint are declared where they are at most this share of all; else condensation gains nothing."""


class AffineProblem(Problem):
    """A problem whose members A, f, B and g are constant or affine in functions of the parameter.

    A subclass sets `parameters`, `V` and `W`, calls `declare` in its constructor, and defines `training_set`. Assembly,
    full and reduced, follows: reduced assembly uses the terms and is exact, without interpolation.
    """

    def declare(
        self, *, A: Declaration, f: Declaration, B: Declaration, g: Declaration, lift: Declaration | None = None
    ) -> None:
        """Declare the members.

        Each is a constant, sparse matrix or vector, or a list of pairs (θ_q, term_q). θ_q is a number, an expression in
        the names of the parameters, such as "load * cos(angle)", or a function of mu (d,).

        Parameters
        ----------
        A
            Sparse, symmetric (n×n).
        f
            Load (n,), with the contribution of the lift.
        B
            Constraint, sparse (m×n); A u + Bᵀλ = f with λ ≥ 0.
        g
            Bound (m,), with the contribution of the lift.
        lift
            Lifting of inhomogeneous Dirichlet data, for pictures.

        Raises
        ------
        RequestError
            If an expression is not arithmetic in the names of the parameters.
        NumericalError
            If a member has a wrong shape.
        """
        n, m = self.V.dim, self.W.dim
        shapes = {"A": (n, n), "f": (n,), "B": (m, n), "g": (m,)}
        given = dict(zip(MEMBERS, (A, f, B, g), strict=True))
        self._members = {name: self._declared(name, member, shapes[name]) for name, member in given.items()}
        self._lift = None if lift is None else self._declared("lift", lift, None)
        constants = [name for name, member in self._members.items() if not isinstance(member, AffineSum)]
        # Declared by classes of other problems; here by what was declared.
        self.constant = frozenset(constants)  # type: ignore[misc]
        self.affine = {name: member for name, member in self._members.items() if isinstance(member, AffineSum)}
        B_terms = self.affine["B"].terms if "B" in self.affine else (self._members["B"],)
        touched = np.unique(np.concatenate([sp.coo_array(term).coords[1] for term in B_terms]))
        self._contact_dofs = touched if 0 < len(touched) <= MAX_CONTACT_SHARE * n else None
        if self._contact_dofs is not None:
            self._contact_columns = _mapped(self._members["B"], lambda term: sp.csr_array(term)[:, touched])

    def _declared(self, name: str, member: Declaration, shape: tuple[int, ...] | None) -> Any:
        """A constant or an `AffineSum` of this shape."""
        if isinstance(member, list | tuple):
            member = AffineSum.of(member, self.parameters.names)
        terms = member.terms if isinstance(member, AffineSum) else (member,)
        if shape is not None and np.shape(terms[0]) != shape:
            found = f"shape {np.shape(terms[0])}"
            raise NumericalError(f"{name} has {found}; the spaces V and W require {shape}")
        return _mapped(member, lambda term: sp.csr_array(term) if sp.issparse(term) else np.asarray(term, float))

    def assemble(self, mu: Array) -> VariationalInequality:
        """The declared members at mu (d,)."""
        return VariationalInequality(
            **{name: _at(self._members[name], mu) for name in MEMBERS}, lift=_at(self._lift, mu)
        )

    @property
    def contact_dofs(self) -> Indices | None:
        """The unknowns that B touches at some parameter; `None` where these are most of the unknowns."""
        return self._contact_dofs

    def contact(self, mu: Array) -> Contact | None:
        """B on `contact_dofs`, and g."""
        if self._contact_dofs is None:
            return None
        return Contact(_at(self._contact_columns, mu), _at(self._members["g"], mu))


def _mapped(member: Any, change: Any) -> Any:
    return member.mapped(change) if isinstance(member, AffineSum) else change(member)


def _at(member: Any, mu: Array) -> Any:
    return member.at(mu) if isinstance(member, AffineSum) else member
