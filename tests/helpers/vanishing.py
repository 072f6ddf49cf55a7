"""A string whose fifth constraint vanishes in half of the box, declared in three ways."""

from typing import ClassVar

import numpy as np
import scipy.sparse as sp

from vibench import AffineProblem, Array, Contact, Indices, InnerProduct, ParameterBox, Problem, VariationalInequality

BOX = ParameterBox(("load", "share"), np.array([1.0, -1.0]), np.array([2.0, 1.0]), ("1", "1"))
N, DOFS = 24, np.arange(6, 16)
GAP = 2.0 + 0.15 * (np.arange(10) - 3.7) ** 2


def share(mu: Array) -> float:
    return max(0.0, float(mu[1]))


class Base(Problem):
    parameters = BOX

    def __init__(self, bound: float = 0.0) -> None:
        self.A = sp.diags_array([2.0 * np.ones(N), -np.ones(N - 1), -np.ones(N - 1)], offsets=[0, 1, -1], format="csr")
        self.V, self.W, self.bound = InnerProduct(self.A), InnerProduct(sp.eye_array(len(DOFS))), bound
        self.rows = -sp.eye_array(N, format="csr")[DOFS]

    def training_set(self) -> Array:
        return self.parameters.grid(3, 5)


class Vanishing(Base):
    """Assembled as a whole; `bound` is g where the row is zero."""

    constant: ClassVar[frozenset[str]] = frozenset({"A"})

    def assemble(self, mu: Array) -> VariationalInequality:
        scale, g = np.ones(len(DOFS)), GAP.copy()
        scale[4] = share(mu)
        g[4] = g[4] * scale[4] if scale[4] else self.bound
        B = sp.csr_array(sp.diags_array(scale) @ self.rows)
        return VariationalInequality(self.A, -0.1 * mu[0] * np.ones(N), B, g)


class OnContact(Vanishing):
    """The same, assembled on the unknowns that B touches, too."""

    entrywise: ClassVar[frozenset[str]] = frozenset({"f"})

    @property
    def contact_dofs(self) -> Indices:
        return DOFS

    def contact(self, mu: Array) -> Contact:
        vi = self.assemble(mu)
        return Contact(vi.B[:, DOFS], vi.g)

    def sampler(self, wanted):
        return lambda mu: {"f": -0.1 * mu[0] * np.ones(len(wanted["f"][0]))}


class Declared(Base, AffineProblem):
    """The same, declared as affine sums."""

    def __init__(self, bound: float = 0.0) -> None:
        Base.__init__(self, bound)
        only = np.eye(len(DOFS))[4]
        one = sp.csr_array(sp.diags_array(only) @ self.rows)
        B, g = [(1.0, self.rows - one), (share, one)], [(1.0, GAP * (1.0 - only)), (share, GAP * only)]
        self.declare(A=self.A, f=[("load", -0.1 * np.ones(N))], B=B, g=g)


class Tangled(Declared):
    """Its mesh is tangled at some of its fifteen training parameters, by their numbers."""

    def __init__(self, *wrong: int) -> None:
        super().__init__()
        self.wrong = self.training_set()[list(wrong)]

    def assemble(self, mu: Array) -> VariationalInequality:
        if (self.wrong == mu).all(axis=1).any():
            raise ValueError("mesh tangled")
        return super().assemble(mu)

    def contact(self, mu: Array) -> Contact | None:
        return None if (self.wrong == mu).all(axis=1).any() else super().contact(mu)


class TangledThird(Tangled):
    """The mesh is tangled at the third training parameter."""

    def __init__(self) -> None:
        super().__init__(2)
