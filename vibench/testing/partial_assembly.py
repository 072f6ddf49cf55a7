"""Checks of partial assembly: whatever a problem evaluates in another way is what it assembles in full."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.interfaces.problem import MEMBERS, Contact, Problem
from vibench.testing.checks import Note
from vibench.testing.comparisons import array_fault, at, copied, difference, entry, matrix_fault, peak
from vibench.testing.problem_case import Case
from vibench.testing.spaces import undeclarable

PARTIAL_RTOL = 1e-10
"""How far an entry may be from what is assembled in full, relative to the largest entry of the member."""

ENTRIES = 40
"""Entries of every member that are looked at."""


def on_contact(case: Case) -> Iterator[str]:
    """`contact_dofs`, `contact` and `constraint` say what B and g say."""
    problem, dofs = case.problem, case.problem.contact_dofs
    defined = type(problem).contact is not Problem.contact
    if dofs is None:
        if defined:
            yield "`contact` is defined and `contact_dofs` is not: nobody asks for it; say which unknowns B may touch"
    else:
        fault = _dofs_fault(dofs, problem.V.dim)
        if fault:
            yield fault
            return
        for mu, found in zip(case.mus, case.assembled, strict=True):
            outside = np.setdiff1d(found["B"].indices[found["B"].data != 0.0], dofs)
            if len(outside):
                yield f"B touches {len(outside)} unknowns outside `contact_dofs` {at(mu)}; the first is {outside[0]}"
                return
        if defined and (fault := _contact_fault(case, dofs)):
            yield fault
            return
    yield from _constraint_fault(case)
    if dofs is None:
        yield Note("not declared")


def _dofs_fault(dofs: object, n: int) -> str:
    if not isinstance(dofs, np.ndarray) or dofs.ndim != 1 or not np.issubdtype(dofs.dtype, np.integer):
        return f"`contact_dofs` is {getattr(dofs, 'dtype', type(dofs).__name__)}; expected a vector of indices"
    if len(dofs) and (dofs.min() < 0 or dofs.max() >= n):
        return f"`contact_dofs` runs from {dofs.min()} to {dofs.max()}; the unknowns are 0 to {n - 1}"
    if np.any(np.diff(dofs) <= 0):
        return "`contact_dofs` is not rising, with every unknown once"
    return ""


def _contact_fault(case: Case, dofs: Indices) -> str:
    for mu, found in zip(case.mus, case.assembled, strict=True):
        given = mu.copy()
        contact = case.problem.contact(given)
        if what := difference(given, mu):
            return f"contact changes the parameter it is given: {what} before; work on a copy of mu"
        if not isinstance(contact, Contact):
            return f"contact gives a {type(contact).__name__} {at(mu)}; expected a vibench.Contact"
        fault = matrix_fault("contact.B", contact.B, (case.problem.W.dim, len(dofs)))
        fault = fault or array_fault("contact.g", contact.g, (case.problem.W.dim,))
        if fault:
            return f"{fault} ({at(mu)})"
        full_B, full_g = sp.csr_array(found["B"][:, dofs]), found["g"]
        for name, part, full in (("B", copied(contact.B), full_B), ("g", contact.g, full_g)):
            if what := difference(part, full, PARTIAL_RTOL * peak(full)):
                return f"contact.{name} is not what is assembled in full {at(mu)}: {what}, counted on the contact"
    return ""


def _constraint_fault(case: Case) -> Iterator[str]:
    for mu, found in zip(case.mus, case.assembled, strict=True):
        B, g = case.problem.constraint(mu.copy())
        for name, part in (("B", B), ("g", g)):
            if what := difference(copied(part), found[name], PARTIAL_RTOL * peak(found[name])):
                yield f"{name} of `constraint` is not what is assembled in full {at(mu)}: {what}"
                return


def by_entries(case: Case) -> Iterator[str]:
    """`sampler` gives the entries that are assembled in full: of every member alone, and of all at once."""
    problem = case.problem
    yield from undeclarable("entrywise", problem.entrywise)
    names = [name for name in MEMBERS if name in problem.entrywise]
    if not names:
        if type(problem).sampler is not Problem.sampler:
            yield "`sampler` is defined and `entrywise` names no member: nobody asks for it"
        yield Note("not declared")
        return
    rng = np.random.default_rng(case.seed)
    wanted = {name: _places(name, case, rng) for name in names}
    for chosen in [*([name] for name in names), names]:
        fault = _sampler_fault(case, {name: wanted[name] for name in chosen})
        if fault:
            yield fault
            return


def _places(name: str, case: Case, rng: np.random.Generator) -> tuple[Indices, Indices]:
    """Some entries of the pattern of a member; of the symmetric A those on and above the diagonal."""
    values = case.assembled[0][name]
    if isinstance(values, np.ndarray):
        rows, columns = np.arange(len(values)), np.zeros(len(values), dtype=np.intp)
    else:
        pattern = sp.coo_array(sp.triu(values) if name == "A" else values)
        rows, columns = (np.asarray(axis, dtype=np.intp) for axis in pattern.coords)
    chosen = np.sort(rng.choice(len(rows), min(ENTRIES, len(rows)), replace=False))
    return rows[chosen], columns[chosen]


def _sampler_fault(case: Case, wanted: dict[str, tuple[Indices, Indices]]) -> str:
    sample = case.problem.sampler(wanted)
    for mu, found in zip(case.mus, case.assembled, strict=True):
        given = mu.copy()
        samples = sample(given)
        if what := difference(given, mu):
            return f"the sampler changes the parameter it is given: {what} before; work on a copy of mu"
        for name, (rows, columns) in wanted.items():
            if name not in samples:
                return f"the sampler gives nothing for {name}, which `entrywise` names"
            if fault := array_fault(f"what the sampler gives for {name}", samples[name], rows.shape):
                return f"{fault} ({at(mu)})"
            full = _entries(found[name], rows, columns)
            if what := _worst(samples[name], full, PARTIAL_RTOL * peak(found[name]), rows, columns, name):
                return f"the sampler gives another {name} than is assembled in full {at(mu)}: {what}"
    return ""


def _entries(value: object, rows: Indices, columns: Indices) -> Array:
    if isinstance(value, np.ndarray):
        return np.asarray(value[rows])
    return np.asarray(sp.csr_array(value)[rows, columns]).ravel()


def _worst(found: Array, full: Array, limit: float, rows: Indices, columns: Indices, name: str) -> str:
    apart = np.abs(found - full)
    if not len(apart) or apart.max() <= limit:
        return ""
    k = int(apart.argmax())
    place = (rows[k],) if name in "fg" else (rows[k], columns[k])
    return f"{entry(place)} is {found[k]:.6g} against {full[k]:.6g}"
