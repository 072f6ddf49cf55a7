"""Strangers' problems, each wrong in one way that an author might well get wrong, and QP solvers that are.

Where the docstring of a class says nothing else, `vibench check` names the mistake.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from broken_problems import built, changed, variant
from other_problems import Block, Put, Torsion, nodal

import vibench
from vibench import Array, Contact, Indices, InnerProduct, Problem, QPSolution, Sampler, VariationalInequality


class Own(Problem):
    """A problem whose author assembles what others declare."""

    def __init__(self, declared: Problem) -> None:
        self._declared, self.parameters, self.V, self.W = declared, declared.parameters, declared.V, declared.W

    def training_set(self) -> Array:
        return self._declared.training_set()

    def assemble(self, mu: Array) -> VariationalInequality:
        return self._declared.assemble(mu)


class Bar(Own):
    """A small bar under torsion."""

    constant: ClassVar[frozenset[str]] = frozenset({"A", "B", "g"})

    def __init__(self) -> None:
        super().__init__(Torsion(cells=6))
        self._weights = self._declared.assemble(np.ones(1)).f


class Option(Put):
    def __init__(self) -> None:
        super().__init__(cells=24)


class Cube(Own):
    constant: ClassVar[frozenset[str]] = frozenset({"A", "f", "B"})
    entrywise: ClassVar[frozenset[str]] = frozenset({"g"})

    def __init__(self) -> None:
        super().__init__(Block(cells=2))

    def sampler(self, wanted: Mapping[str, tuple[Indices, Indices]]) -> Sampler:
        return lambda mu: {"g": self._declared.assemble(mu).g[wanted["g"][0]]}


class ByElements(Option):
    """The put, whose stiffness is integrated interval by interval."""

    elementwise: ClassVar[frozenset[str]] = frozenset({"A"})

    @property
    def element_dofs(self) -> Indices:
        left = np.arange(-1, self.V.dim)
        return np.stack([left, np.where(left + 1 < self.V.dim, left + 1, -1)])

    def element_sampler(self, elements: Indices) -> Sampler:
        step = self.x[1] - self.x[0]
        K, M = np.array([[1.0, -1.0], [-1.0, 1.0]]) / step, np.array([[2.0, 1.0], [1.0, 2.0]]) * (step / 6.0)

        def sample(mu: Array) -> dict[str, Array]:
            half, kappa = 0.5 * mu[0] ** 2, mu[1] / mu[0] ** 2 - 0.5
            return {"A": np.tile(half * K + (mu[1] + half * kappa**2) * M, (len(elements), 1, 1))}

        return sample


class OtherElements(ByElements):
    """The prescribed values at both ends have the number of an unknown."""

    @property
    def element_dofs(self) -> Indices:
        return np.maximum(super().element_dofs, 0)


class AllElements(ByElements):
    """Whatever elements are asked for, it integrates over all."""

    def element_sampler(self, elements: Indices) -> Sampler:
        return super().element_sampler(np.arange(self.V.dim + 1))


_changed, _built, _variant = (partial(make, __name__) for make in (changed, built, variant))

# The reaction has the wrong sign, which matters where the rate is large and the volatility small.
IndefiniteSomewhere = _changed(
    "IndefiniteSomewhere", "A", lambda A, mu, put: sp.csr_array(A - 1.6 * mu[1] * put._M[1:-1, 1:-1]), Option
)
# u ≥ −ψ in place of u ≤ ψ: no constraint is ever active.
WrongSide = _changed("WrongSide", "B", lambda B, mu, bar: -B, Bar)
# g has the wrong sign: u ≤ −ψ, which sticks everywhere.
NegativeGap = _changed("NegativeGap", "g", lambda g, mu, bar: -g, Bar)
# B, declared constant, turns with the place of the apex.
ConstantConstraint = _changed("ConstantConstraint", "B", lambda B, mu, _: sp.csr_array(B * (1.0 + 0.1 * mu[1])), Cube)
NoisyLoad = _changed("NoisyLoad", "f", lambda f, mu, _: f * (1.0 + 1e-6 * np.random.default_rng().random(len(f))), Bar)
# The load has an entry for the nodes on the boundary, too.
LoadOnAllNodes = _changed("LoadOnAllNodes", "f", lambda f, mu, bar: np.full(49, mu[0] / 36.0), Bar)
# κ is the root of a complex number.
ComplexStiffness = _changed("ComplexStiffness", "A", lambda A, mu, put: sp.csr_array(A.astype(complex)), Option)
# The twist is not used.
IgnoresTheParameter = _changed("IgnoresTheParameter", "f", lambda f, mu, bar: 6.0 * bar._weights, Bar)

EuclideanNorm = _built("EuclideanNorm", Cube, V=lambda cube: InnerProduct(sp.eye_array(cube.V.dim, format="csc")))
# X_W is that of all nodes, and not of those of the top.
DualNormOfAllNodes = _built("DualNormOfAllNodes", Cube, W=lambda cube: InnerProduct(sp.eye_array(27, format="csc")))


ConstantStiffness = _variant("ConstantStiffness", Option, constant=frozenset({"A"}))
# Ends the process where a picture is asked for.
PaintsTheEnd = _variant("PaintsTheEnd", Bar, picture=lambda *_: os._exit(5))


class SkewStiffness(Option):
    """The Black–Scholes operator with its first derivative, not symmetrised."""

    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        ones = np.ones(self.V.dim - 1)
        drift = sp.csr_array(sp.diags_array([ones, -ones], offsets=[1, -1])) * (0.5 * (mu[1] - 0.5 * mu[0] ** 2))
        return replace(vi, A=sp.csr_array(vi.A + drift))


class PermutedNorm(Option):
    def __init__(self) -> None:
        super().__init__()
        order = np.random.default_rng(0).permutation(self.V.dim)
        self.V = InnerProduct(self.V.matrix[order][:, order])


class SingularDualNorm(Bar):
    """The corners of X_W have no weight."""

    def __init__(self) -> None:
        super().__init__()
        self.W = InnerProduct(nodal(np.where(np.arange(self.W.dim) == 0, 0.0, self._weights)))


class RepeatedConstraint(Cube):
    """The last constraint is the first one again."""

    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        rows = np.arange(self.W.dim)
        rows[-1] = 0
        return replace(vi, B=vi.B[rows], g=vi.g[rows])


class NamesOfNodes(Bar):
    """The unknowns are numbered in the order of a set of texts, which differs between processes."""

    def __init__(self) -> None:
        super().__init__()
        names = {f"node {k}" for k in range(self.V.dim)}
        self._order = order = [int(name.split()[1]) for name in names]
        self.V = InnerProduct(self.V.matrix[order][:, order])

    def assemble(self, mu: Array) -> VariationalInequality:
        vi, order = super().assemble(mu), self._order
        return replace(vi, A=vi.A[order][:, order], g=vi.g[order])


class NotANumberInACorner(Option):
    """The root of a negative number where the rate is largest."""

    def assemble(self, mu: Array) -> VariationalInequality:
        with np.errstate(invalid="ignore"):
            factor = np.sqrt(0.07999 - mu[1]) / np.sqrt(abs(0.07999 - mu[1]))
        vi = super().assemble(mu)
        return replace(vi, g=vi.g * factor)


class OtherContact(Cube):
    """The constraint on the contact alone has its rows in another order."""

    @property
    def contact_dofs(self) -> Indices:
        return np.unique(self._declared.assemble(self.parameters.lower).B.indices)

    def contact(self, mu: Array) -> Contact:
        vi = self._declared.assemble(mu)
        return Contact(sp.csr_array(vi.B[:, self.contact_dofs])[::-1], vi.g)


class DependsOnTheCallBefore(Option):
    """The lift is that of the parameter before."""

    last: Array | None = None

    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        before, self.last = (vi if self.last is None else super().assemble(self.last)), mu.copy()
        return replace(vi, f=before.f)


class ShiftsTheParameter(Bar):
    """Works with the twist beyond 1, in place."""

    def assemble(self, mu: Array) -> VariationalInequality:
        mu -= 1.0
        return super().assemble(mu + 1.0)


class UnknownAnnotation(Bar):
    def __init__(self, depth: Depth = 1.0) -> None:  # type: ignore[name-defined]  # noqa: F821
        super().__init__()


class Unannotated(Bar):
    """Options that nothing checks, and one whose default is none of its values."""

    def __init__(self, depth=1.0, cells: int = 6.5) -> None:  # type: ignore[no-untyped-def, assignment]
        super().__init__()


def exact(program: VariationalInequality, accuracy: float) -> QPSolution:
    return vibench.solve_qp(program, "piqp", accuracy)


def other_sign(program: VariationalInequality, accuracy: float) -> QPSolution:
    found = exact(program, accuracy)
    return replace(found, alpha=None if found.alpha is None else -found.alpha)


def ignores_the_accuracy(program: VariationalInequality, accuracy: float) -> QPSolution:
    return exact(program, 1e-3)


def ignores_the_bounds(program: VariationalInequality, accuracy: float) -> QPSolution:
    """The solution of A x = f."""
    return QPSolution(np.linalg.solve(program.A, program.f), np.zeros(len(program.g)), "solved")


def draws(program: VariationalInequality, accuracy: float) -> QPSolution:
    found = exact(program, accuracy)
    return replace(found, x=found.x + 1e-5 * np.random.default_rng().random(len(found.x)))


def raises_where_infeasible(program: VariationalInequality, accuracy: float) -> QPSolution:
    found = exact(program, accuracy)
    if "INFEASIBLE" in found.solver_status:
        raise ArithmeticError("no point is admissible")
    return found


BUFFER = np.zeros(1000)


def one_buffer(program: VariationalInequality, accuracy: float) -> QPSolution:
    found = exact(program, accuracy)
    if found.x is None:
        return found
    BUFFER[: len(found.x)] = found.x
    return replace(found, x=BUFFER[: len(found.x)])


@cache
def _kept(contents: tuple[Any, ...], accuracy: float) -> QPSolution:
    A, f, B, g = (np.frombuffer(data).reshape(shape) for data, shape in contents)
    for _ in range(20):  # slow enough that a look-up is much quicker
        found = exact(VariationalInequality(A, f, B, g), accuracy)
    return found


def memoises(program: VariationalInequality, accuracy: float) -> QPSolution:
    arrays = (program.A, program.f, program.B, program.g)
    return _kept(tuple((np.ascontiguousarray(a).tobytes(), a.shape) for a in arrays), accuracy)


KEPT: dict[int, QPSolution] = {}


def knows_by_address(program: VariationalInequality, accuracy: float) -> QPSolution:
    key = program.f.ctypes.data
    if key not in KEPT:
        KEPT[key] = exact(program, accuracy)
        ADDRESSES.append(program.f)  # so that no other vector gets the address
    return KEPT[key]


ADDRESSES: list[Array] = []


def no_solution(program: VariationalInequality, accuracy: float) -> Any:
    found = exact(program, accuracy)
    return found.x, found.alpha
