"""Declarations of a problem compared with its assembly: they are believed only until a parameter refutes them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask
from vibench.interfaces.absent_rows import is_absent
from vibench.interfaces.problem import MEMBERS, Problem, VariationalInequality


def contradictions(problem: Problem, mu: Array, vi: VariationalInequality, *, elements: bool = True) -> Iterator[str]:
    """Differences of declarations from `vi`, the assembly at mu (d,): the declaration, the member and how much.

    Matrices are compared by their products with a random vector, which hides no entry. `elements` tells whether members
    declared `elementwise` are integrated, which takes as long as an assembly.
    """
    rng = np.random.default_rng(0)
    v = 1.0 + rng.random(len(vi.f))
    present = ~is_absent(vi.g)
    products = {"A": vi.A @ v, "f": vi.f, "B": vi.B @ v, "g": np.where(present, vi.g, 0.0)}
    found = [(f"`affine` of {name}", name, *_sum(problem, name, mu, v, present)) for name in problem.affine]
    if elements and problem.elementwise:
        found += [(f"`element_sampler` of {name}", name, *sums) for name, sums in _integrated(problem, mu, v).items()]
    if problem.has_contact and (contact := problem.contact(mu.copy())) is not None:
        dofs = problem.contact_dofs
        found += [("`contact`, B", "B", contact.B @ v[dofs], 0.0)]
        found += [("`contact`, g", "g", np.where(is_absent(contact.g) & ~present, 0.0, contact.g), 0.0)]
        if type(problem).contact_loads is not Problem.contact_loads:
            eta = rng.random((len(vi.g), 2)) * present[:, None]
            loads, bounds = problem.contact_loads(eta).at(mu.copy())
            products |= {"Bᵀη": (vi.B.T @ eta)[dofs], "ηᵀg": eta.T @ products["g"]}
            found += [("`contact_loads`, Bᵀη", "Bᵀη", loads, 0.0), ("`contact_loads`, ηᵀg", "ηᵀg", bounds, 0.0)]
    for what, member, declared, scale in found:
        yield from _difference(what, products[member], declared, scale)
    yield from _sampled(problem, mu, vi, rng)


def _difference(what: str, assembled: Array, declared: Array, scale: float) -> Iterator[str]:
    """The sentence that they differ by more than round-off of their entries, or of terms of this size."""
    size = max(float(np.max(np.abs(assembled), initial=0.0)), scale)
    gap = np.abs(assembled - declared)
    # Negated, so that what is no number differs, too.
    if not np.max(gap, initial=0.0) <= 1e-9 * size:
        place = np.unravel_index(int(np.argmax(np.where(np.isnan(gap), np.inf, gap))), gap.shape)
        yield f"{what}, is not that of `assemble`: row {int(place[0])} differs by {np.max(gap) / (size or 1.0):.1e}"


def _sum(problem: Problem, name: str, mu: Array, v: Array, present: Mask) -> tuple[Array, float]:
    """The declared sum of a member, or its product with v (n,), and the size of its terms."""
    declared = problem.affine[name]
    theta = declared.coefficients(mu.copy())
    terms = [np.where(present, term, 0.0) if name == "g" else term @ v if name in "AB" else term
             for term in declared.terms]  # fmt: skip
    parts = [np.asarray(value * term, dtype=float) for value, term in zip(theta, terms, strict=True)]
    return sum(parts[1:], parts[0]), max(float(np.max(np.abs(part), initial=0.0)) for part in parts)


def _integrated(problem: Problem, mu: Array, v: Array) -> dict[str, tuple[Array, float]]:
    """Members summed over all elements, matrices times v (n,)."""
    dofs = problem.element_dofs
    known = dofs >= 0
    values = problem.element_sampler(np.arange(dofs.shape[1]))(mu.copy())
    local = np.where(known, v[dofs], 0.0)
    found = dict[str, tuple[Array, float]]()
    for name in sorted(problem.elementwise):
        parts = np.einsum("jab,bj->aj", values[name], local) if name == "A" else np.asarray(values[name]).T
        total = np.asarray(np.bincount(dofs[known], weights=parts[known], minlength=len(v)), float)
        found[name] = total, float(np.max(np.abs(parts), initial=0.0))
    return found


def _sampled(problem: Problem, mu: Array, vi: VariationalInequality, rng: np.random.Generator) -> Iterator[str]:
    """The sentence that entries of `sampler` differ, of a few random ones of every member."""
    members = {name: getattr(vi, name) for name in MEMBERS if name in problem.entrywise}
    wanted, expected = dict[str, tuple[Indices, Indices]](), dict[str, Array]()
    for name, member in members.items():
        rows, columns, values = _entries(member)
        chosen = rng.choice(len(values), min(32, len(values)), replace=False) if len(values) else np.zeros(0, np.intp)
        wanted[name], expected[name] = (rows[chosen], columns[chosen]), values[chosen]
    samples = problem.sampler(wanted)(mu.copy()) if wanted else {}
    for name, values in expected.items():
        scale = float(np.max(np.abs(_entries(members[name])[2]), initial=0.0))
        yield from _difference(f"`sampler` of {name}", values, np.asarray(samples[name]), scale)


def _entries(member: Any) -> tuple[Indices, Indices, Array]:
    """Rows, columns and values of the entries of a sparse matrix or of a vector, those of absent rows left out."""
    if sp.issparse(member):
        triplets = sp.coo_array(member)
        return triplets.row, triplets.col, triplets.data
    rows = np.flatnonzero(~is_absent(member))
    return rows, np.zeros_like(rows), member[rows]
