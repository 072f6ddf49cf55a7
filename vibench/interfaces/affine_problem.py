"""Problems all of whose members are constant or affine: they are declared, and need no assembly of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, real_matrix, real_vector
from vibench.errors import NumericalError
from vibench.interfaces.affine import AffineSum, Theta, Thetas
from vibench.interfaces.problem import MEMBERS, Contact, Problem, VariationalInequality
from vibench.signatures import bordered

Declaration: TypeAlias = Any | Sequence[tuple[Theta, Any]] | AffineSum
"""A constant matrix or vector, the pairs (θ_q, term_q) of an affine sum, or the sum."""

Coefficients: TypeAlias = Callable[[Array], Any]


class AffineProblem(Problem):
    """A problem whose members A, f, B and g are constant or affine in functions of the parameter.

    A subclass sets `parameters`, `V` and `W`, calls `declare` in its constructor, and defines `training_set`. Assembly,
    full and reduced, follows: reduced assembly uses the terms and is exact, without interpolation.
    """

    @bordered
    def declare(
        self, *, A: Declaration, f: Declaration, B: Declaration, g: Declaration,
        free: Annotated[Indices, "n"] | None = None, dirichlet_lift: Declaration | None = None,
    ) -> None:  # fmt: skip
        """Declare the members.

        Each is a constant, sparse matrix or vector, or a list of pairs (θ_q, term_q). θ_q is a number, an expression in
        the names of the parameters, such as "load * cos(angle)", or a function of mu (d,). Raises a `RequestError` for
        another expression, and a `NumericalError` if a member has a wrong shape, or an infinite entry of g a
        coefficient that is no positive constant.

        Parameters
        ----------
        A
            Sparse, symmetric (N×N).
        f
            Load (N,).
        B
            Constraint, sparse (m×N); A u + Bᵀλ = f with λ ≥ 0.
        g
            Bound (m,).
        free
            Unknowns (n,) that are not prescribed, rising. The members are declared for all N unknowns and restricted to
            these. By default N = n.
        dirichlet_lift
            Prescribed values (N,) of the other unknowns, any values elsewhere; zero by default. The unknowns of the
            model are those of u minus this lift: f − A·lift and g − B·lift take the place of f and g.
        """
        n, m = self.V.dim, self.W.dim
        given = {"A": A, "f": f, "B": B, "g": g}
        if dirichlet_lift is not None:
            given["dirichlet_lift"] = dirichlet_lift
        sums: dict[str, AffineSum] = {}
        for name, member in given.items():
            try:
                sums[name] = self._sum(member)
            except NumericalError as error:
                raise NumericalError(f"{name}: {error}") from None
        # With `free` the members are declared for all unknowns, before Dirichlet conditions.
        N = n if free is None else int(np.shape(sums["A"].terms[0])[0])
        if free is not None and (len(free) != n or np.max(free, initial=-1) >= N):
            raise NumericalError(f"there are {len(free)} free unknowns of {N}; V has the dimension {n}")
        shapes = {"A": (N, N), "f": (N,), "B": (m, N), "g": (m,), "dirichlet_lift": (N,)}
        for name, each in sums.items():
            if (shape := np.shape(each.terms[0])) != shapes[name]:
                raise NumericalError(f"{name} has shape {shape}; the spaces V and W require {shapes[name]}")
            sums[name] = each.mapped(partial(real_matrix if name in ("A", "B") else real_vector, name=name))
        if dirichlet_lift is not None:
            sums["f"] = _minus(sums["f"], sums["A"], sums["dirichlet_lift"])
            sums["g"] = _minus(sums["g"], sums["B"], sums["dirichlet_lift"])
        if free is not None:
            sums["A"] = sums["A"].mapped(lambda term: sp.csr_array(term[free][:, free]))
            sums["f"] = sums["f"].mapped(lambda term: term[free])
            sums["B"] = sums["B"].mapped(lambda term: sp.csr_array(term[:, free]))
        self._members = {name: _constant_or_sum(each) for name, each in sums.items()}
        constants = [name for name in MEMBERS if not isinstance(self._members[name], AffineSum)]
        # Declared by classes of other problems; here by what was declared.
        self.constant = frozenset(constants)  # type: ignore[misc]
        self.affine = {name: sums[name] for name in MEMBERS if name not in self.constant}
        # Error bounds need the contact unknowns however many they are; solvers decide whether to condense on them.
        touched = np.unique(np.concatenate([term.indices for term in sums["B"].terms])).astype(np.intp)
        self._contact_dofs = touched if len(touched) else None
        self._contact_columns = _constant_or_sum(sums["B"].mapped(lambda term: sp.csr_array(term[:, touched])))

    def _sum(self, member: Declaration) -> AffineSum:
        if isinstance(member, AffineSum):
            return member
        return AffineSum.of(member if isinstance(member, list | tuple) else [(1.0, member)], self.parameters.names)

    def assemble(self, mu: Array) -> VariationalInequality:
        """The declared members at mu (d,), in the free unknowns."""
        return VariationalInequality(**{name: _at(member, mu) for name, member in self._members.items()})

    @property
    def contact_dofs(self) -> Indices | None:
        """Unknowns that B touches at some parameter; `None` where there are none."""
        return self._contact_dofs

    def contact(self, mu: Array) -> Contact | None:
        """B on `contact_dofs`, and g."""
        if self._contact_dofs is None:
            return None
        return Contact(_at(self._contact_columns, mu), _at(self._members["g"], mu))


def _of_product(first: Coefficients, second: Coefficients, third: Coefficients, mu: Array) -> Array:
    """Coefficients θ of first − second·third at mu: the first ones, then minus the products of the others."""
    return np.concatenate([first(mu), -np.outer(second(mu), third(mu)).ravel()])


def _minus(total: AffineSum, matrix: AffineSum, vector: AffineSum) -> AffineSum:
    products = [A @ v for A in matrix.terms for v in vector.terms]
    thetas = total.thetas, matrix.thetas, vector.thetas
    # A combination of constants stays a constant; constant coefficients are evaluated at no parameter.
    if all(isinstance(theta, Thetas) and theta.constant for theta in thetas):
        nowhere = np.zeros(0)
        minus = -np.outer(matrix.coefficients(nowhere), vector.coefficients(nowhere)).ravel()
        return AffineSum((*total.terms, *products), Thetas((*total.coefficients(nowhere), *minus)))
    return AffineSum((*total.terms, *products), partial(_of_product, *thetas))


def _constant_or_sum(member: AffineSum) -> Any:
    """The sum, or its value where no coefficient depends on the parameter."""
    if not (isinstance(member.thetas, Thetas) and member.thetas.constant):
        return member
    nowhere = np.zeros(0)
    # The declared array itself: a copy would take the memory of the largest matrices twice.
    if len(member.terms) == 1 and member.coefficients(nowhere)[0] == 1.0:
        return member.terms[0]
    return member.at(nowhere)


def _at(member: Any, mu: Array) -> Any:
    return member.at(mu) if isinstance(member, AffineSum) else member
