"""Checks of what a problem assembles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.linalg

from vibench.arrays import Array, SparseMatrix
from vibench.errors import NumericalError
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.linalg.inner_product import InnerProduct
from vibench.model.affine import CONSTANT_RTOL
from vibench.testing.checks import Note, raised
from vibench.testing.comparisons import (
    Members,
    array_fault,
    asymmetry,
    at,
    copied,
    difference,
    matrix_fault,
    members,
    peak,
    pickled,
    why_not_pickled,
)
from vibench.testing.continuity import find_jump
from vibench.testing.problem_case import Case
from vibench.testing.spaces import undeclarable

SYMMETRY_RTOL = 1e-12
"""How far a symmetric matrix may be from its transpose, relative to its largest entry."""

DENSE = 2000
"""Largest matrix whose eigenvalues are computed for a message."""


def assembly(case: Case) -> Iterator[str]:
    """Types, shapes, finite values."""
    n, m = case.problem.V.dim, case.problem.W.dim
    shapes = {"A": (n, n), "f": (n,), "B": (m, n), "g": (m,)}
    for mu in case.mus:
        try:
            vi = case.assemble(mu)
        except Exception as error:  # noqa: BLE001  a problem is code of strangers
            yield f"assemble fails {at(mu)}: {raised(error)}"
            return
        if not isinstance(vi, VariationalInequality):
            yield f"assemble gives a {type(vi).__name__} {at(mu)}; expected a vibench.VariationalInequality"
            return
        found = [
            fault
            for name, shape in shapes.items()
            if (fault := (array_fault if name in "fg" else matrix_fault)(name, getattr(vi, name), shape))
        ]
        if vi.lift is not None and (fault := array_fault("lift", vi.lift, np.shape(vi.lift))):
            found.append(fault)
        yield from (f"{fault} ({at(mu)})" for fault in found)
        if found:
            return
    yield Note(f"n = {n}, m = {m}, at {len(case.mus)} parameters")


def no_mutation(case: Case) -> Iterator[str]:
    """Neither the parameter nor anything handed out before is changed."""
    problem, box = case.problem, case.problem.parameters
    held = {
        "X_V": problem.V.matrix,
        "X_W": problem.W.matrix,
        "parameters.lower": box.lower,
        "parameters.upper": box.upper,
    }
    before = {name: copied(value) for name, value in held.items()}
    vi = problem.assemble(case.mus[0].copy())
    kept = members(vi)
    for mu in case.mus[1:]:
        given = mu.copy()
        problem.assemble(given)
        if what := difference(given, mu):
            yield f"assemble changes the parameter it is given: {what} before; work on a copy of mu"
            break
    for name, value in kept.items():
        if what := difference(copied(getattr(vi, name)), value):
            yield f"{name} of one parameter changes when another one is assembled: {what} before; hand out copies"
    for name, value in before.items():
        if what := difference(copied(held[name]), value):
            yield f"assembling changes {name}: {what} before"


def symmetry(case: Case) -> Iterator[str]:
    """A is symmetric."""
    for mu, found in zip(case.mus, case.assembled, strict=True):
        if what := asymmetry(found["A"], SYMMETRY_RTOL):
            yield f"A is not symmetric {at(mu)}: {what}"
            return


def definiteness(case: Case) -> Iterator[str]:
    """A is positive definite."""
    for mu, found in zip(case.mus, case.assembled, strict=True):
        try:
            InnerProduct(found["A"], "A")
        except NumericalError as error:
            yield f"{error} {at(mu)}{_smallest_eigenvalue(found['A'])}"
            return


def _smallest_eigenvalue(matrix: SparseMatrix) -> str:
    if matrix.shape[0] > DENSE:
        return ""
    values, vectors = scipy.linalg.eigh(matrix.toarray(), subset_by_index=(0, 0))
    largest = int(np.argmax(np.abs(vectors[:, 0])))
    return f": its smallest eigenvalue is {values[0]:.3g}, with an eigenvector that is largest at unknown {largest}"


def determinism(case: Case) -> Iterator[str]:
    """The same again, to the last bit and in whatever order: of the same instance, and of another."""
    other = case.create()
    for how, problem in (("when it is assembled again", case.problem), ("in another instance", other)):
        found = set()
        for mu, before in reversed(list(zip(case.mus, case.assembled, strict=True))):
            again = case.members(mu, problem)
            for name in MEMBERS:
                what = "" if name in found else difference(again[name], before[name])
                if what:
                    found.add(name)
                    yield f"{name} is not the same {how} {at(mu)}: {what}"
        if found:
            return
    for name in ("V", "W"):
        if what := difference(getattr(other, name).matrix, getattr(case.problem, name).matrix):
            yield f"X_{name} is not the same in another instance: {what}"


def independence(case: Case) -> Iterator[str]:
    """What is declared `constant` is."""
    declared = case.problem.constant
    yield from undeclarable("constant", declared)
    for name in (name for name in MEMBERS if name in declared):
        first = case.assembled[0][name]
        for mu, found in zip(case.mus, case.assembled, strict=True):
            if what := difference(found[name], first, CONSTANT_RTOL * peak(first)):
                where = f"the one {at(mu)}, the other {at(case.mus[0])}"
                yield f"{name} is declared `constant` and depends on mu: {what}, {where}"
                break


def continuity(case: Case) -> Iterator[str]:
    """No member jumps on lines through the box: a diagonal, a line between random points, one along every axis."""
    largest = {name: max(peak(found[name]) for found in case.assembled) for name in MEMBERS}
    scales = {name: s for name, s in largest.items() if s > 0.0 and name not in case.problem.constant}
    lower, upper, centre, *others = case.mus
    lines = [(lower, upper), (others[0], others[1])]
    if len(lower) > 1:
        along = np.eye(len(lower), dtype=bool)
        lines += [(np.where(axis, lower, centre), np.where(axis, upper, centre)) for axis in along]
    for start, end in lines if scales else []:
        fault = _jump(case, scales, start, end)
        if fault:
            yield fault
            return


def _jump(case: Case, scales: dict[str, float], start: Array, end: Array) -> str:
    def evaluate(t: float) -> Members:
        return case.members(start + t * (end - start))

    jump = find_jump(evaluate, scales)
    if jump is None:
        return ""
    left, right = (start + t * (end - start) for t in (jump.left, jump.right))
    step = float(np.linalg.norm(right - left))
    return f"{jump.member} jumps {at(right)}: {jump.what} over a step of {step:.0e}, however small the step"


def pickling(case: Case) -> Iterator[str]:
    """A copy that travelled does the same."""
    if what := why_not_pickled(case.problem):
        yield what
        return
    copy = pickled(case.problem)
    for mu, before in zip(case.mus, case.assembled, strict=True):
        found = case.members(mu, copy)
        for name in MEMBERS:
            if what := difference(found[name], before[name]):
                yield f"{name} is not the same after pickling {at(mu)}: {what}"
                return
