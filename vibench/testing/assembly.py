"""Checks of what a problem assembles: A, f, B and g, in full, on the contact alone, by entries and by elements."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError
from vibench.interfaces.problem import MEMBERS, Contact, Problem, VariationalInequality
from vibench.linalg.inner_product import SYMMETRY_RTOL, InnerProduct
from vibench.testing.case import (
    Arrays,
    Case,
    array_fault,
    at,
    copies,
    difference,
    differences,
    find_jump,
    largest_entry,
    unmutated,
)
from vibench.testing.checks import ConformanceError, Doubt, Note, plugin_line, raised
from vibench.timing import timed


@dataclass(eq=False)
class AssemblyCase(Case[Problem, Array, Arrays]):
    """A problem, parameters, and the arrays it assembles.

    All checks together take `seconds`, about: where an assembly is slow, they are made at fewer parameters.
    """

    base = Problem
    # The largest difference between two ways to assemble, relative to the largest entry of the member.
    round_off = 1e-10

    @cached_property
    def one_assembly(self) -> float:
        box, problem = self.plugin.parameters, self.plugin
        return timed(lambda: problem.assemble(0.5 * (box.lower + box.upper)))[1].wall

    @cached_property
    def points(self) -> int:
        """Number of parameters, such that all checks take about half of the time limit: 7, or 2 at least."""
        try:
            seconds = self.one_assembly
        except Exception:  # noqa: BLE001  the check "assembly" says what a plugin raises
            return 7
        # All checks but the search for jumps make about ten assemblies at each parameter.
        return int(min(max(0.5 * self.seconds / max(10.0 * seconds, 1e-8), 2), 7))

    @property
    def in_time(self) -> bool:
        """Whether there is time for all parameters, and for the search for jumps."""
        return self.points == 7

    @cached_property
    def mus(self) -> Array:
        """Parameters (7×d): two corners of the box, its centre, and four random ones; only the first if it is slow."""
        box = self.plugin.parameters
        fixed = np.stack([box.lower, box.upper, 0.5 * (box.lower + box.upper)])
        return np.concatenate([fixed, box.sample(4, seed=0)])[: self.points]

    @cached_property
    def arguments(self) -> dict[str, Array]:
        return {at(mu): mu for mu in self.mus}

    def evaluate(self, argument: Array, plugin: Problem | None = None) -> Arrays:
        """Copies of A, f, B and g at a parameter (d,), and of X_V and X_W."""
        problem, mu = plugin or self.plugin, argument.copy()
        vi = self.clocked("an assembly", lambda: problem.assemble(mu))
        members = {name: getattr(vi, name) for name in MEMBERS}
        return copies({**members, "X_V": problem.V.matrix, "X_W": problem.W.matrix})

    def arrays(self, result: Arrays) -> Arrays:
        return result

    def construction(self) -> Iterator[str]:
        """An instance can be made; a refused Gram matrix is named."""
        try:
            yield from super().construction()
        except NumericalError as error:
            place = plugin_line(error)
            names = [f"X_{name}: " for name in "VW" if f"self.{name} =" in place and f"X_{name}" not in str(error)]
            raise ConformanceError(f"{''.join(names)}{error} ({place})") from error


def one_assembly(case: AssemblyCase) -> Iterator[str]:
    """The first assembly is timed; at how many parameters the others can be made follows."""
    in_time = case.in_time
    with suppress(Exception):  # the next check says what a plugin raises
        yield Note(f"takes {case.one_assembly:.2g} s")
    if not in_time:
        yield Note(f"checks at {case.points} parameters instead of 7, and none for jumps, for lack of time")


def assembly(case: AssemblyCase) -> Iterator[str]:
    """Members have the right types and shapes, and finite values."""
    n, m = case.plugin.V.dim, case.plugin.W.dim
    shapes = {"A": (n, n), "f": (n,), "B": (m, n), "g": (m,)}
    for mu in case.mus:
        try:
            vi: object = case.plugin.assemble(mu.copy())
        except Exception as error:  # a plugin may raise anything
            raise ConformanceError(f"assemble fails {at(mu)}: {raised(error)}") from error
        if not isinstance(vi, VariationalInequality):
            yield f"assemble returns a {type(vi).__name__} {at(mu)}; expected a vibench.VariationalInequality"
            return
        lift = {} if vi.dirichlet_lift is None else {"dirichlet_lift": np.shape(vi.dirichlet_lift)}
        faults = [array_fault(name, getattr(vi, name), s, sparse=name in "AB") for name, s in (shapes | lift).items()]
        yield from (f"{fault} ({at(mu)})" for fault in faults if fault)
        if any(faults):
            return
    yield Note(f"n = {n}, m = {m}, at {len(case.mus)} parameters")


def no_mutation(case: AssemblyCase) -> None:
    """`assemble` changes neither its argument nor earlier results, spaces or bounds."""
    problem, mus = case.plugin, case.mus.copy()
    earlier = problem.assemble(case.mus[0].copy())
    arrays = {"its argument mu": mus, **{f"{name} of an earlier result": getattr(earlier, name) for name in MEMBERS}}
    arrays |= {"X_V": problem.V.matrix, "X_W": problem.W.matrix}
    arrays |= {"parameters.lower": problem.parameters.lower, "parameters.upper": problem.parameters.upper}
    unmutated("assemble", arrays, lambda: [problem.assemble(mu) for mu in mus])


def symmetry(case: AssemblyCase) -> None:
    """A is symmetric."""
    for where, arrays in case.results.items():
        if what := difference(arrays["A"], arrays["A"].T, SYMMETRY_RTOL * largest_entry(arrays["A"])):
            raise ConformanceError(f"A is not symmetric {where}: {what} in the transpose")


def definiteness(case: AssemblyCase) -> None:
    """A is positive definite."""
    for where, arrays in case.results.items():
        try:
            # The factorisation proves it, as in a run.
            InnerProduct(arrays["A"], "A")
        except NumericalError as error:
            eigenvalue = ""
            if case.plugin.V.dim <= 2000:  # a dense eigenvalue problem
                values, vectors = scipy.linalg.eigh(arrays["A"].toarray(), subset_by_index=(0, 0))
                unknown = np.abs(vectors[:, 0]).argmax()
                eigenvalue = f": its smallest eigenvalue is {values[0]:.3g}; the eigenvector peaks at unknown {unknown}"
            raise ConformanceError(f"{error} {where}{eigenvalue}") from error


def independence(case: AssemblyCase) -> Iterator[str]:
    """Members declared `constant` do not depend on the parameter; every parameter has an effect."""
    yield from _undeclarable("constant", case.plugin.constant)
    first = at(case.mus[0])
    for name in (name for name in MEMBERS if name in case.plugin.constant):
        reference = case.results[first][name]
        for where, arrays in case.results.items():
            # 1e-13: the round-off with which reduced assembly tells constants, too
            if what := difference(arrays[name], reference, 1e-13 * largest_entry(reference)):
                yield f"{name} is declared `constant` but depends on mu: {what} ({where} and {first})"
                break
    yield from _without_effect(case) if case.in_time else ()


def _without_effect(case: AssemblyCase) -> Iterator[str]:
    """Parameters that can be moved from the centre of the box to a side of it, and nothing changes."""
    box = case.plugin.parameters
    centre = 0.5 * (box.lower + box.upper)
    for number, name in enumerate(box.names):
        moved = np.where(np.arange(box.dim) == number, box.upper, centre)
        if box.upper[number] > box.lower[number] and not any(
            differences(case.evaluate(moved), case.evaluate(centre), case.round_off)
        ):
            yield Doubt(f"nothing depends on the parameter '{name}'")


def continuity(case: AssemblyCase) -> Iterator[str]:
    """Members do not jump on lines in the box: a diagonal, one between random points, one along every axis."""
    if not case.in_time:
        yield Note("not looked for, for lack of time")
        return
    # A member that vanishes has no scale, and constant ones were compared already.
    largest = {name: max(largest_entry(arrays[name]) for arrays in case.results.values()) for name in MEMBERS}
    scales = {name: s for name, s in largest.items() if s > 0.0 and name not in case.plugin.constant}

    def point(start: Array, end: Array, t: float) -> Arrays:
        return case.evaluate(start + t * (end - start))

    lower, upper, centre, *others = case.mus
    # A jump may follow one parameter, or a combination of several that only a random line crosses.
    lines = [(lower, upper), (others[0], others[1])]
    if len(lower) > 1:
        along = np.eye(len(lower), dtype=bool)
        lines += [(np.where(axis, lower, centre), np.where(axis, upper, centre)) for axis in along]
    for number, (start, end) in enumerate(lines if scales else []):
        if case.late:
            yield Note(f"looked for on {number} of {len(lines)} lines, for lack of time")
            return
        if jump := find_jump(partial(point, start, end), scales, lambda: case.late):
            first, _, last = (arrays[jump.name] for arrays in jump.values)
            step = (jump.right - jump.left) * float(np.linalg.norm(end - start))
            where = at(start + jump.right * (end - start))
            raise ConformanceError(f"{jump.name} jumps {where}: {difference(first, last)} over a step of {step:.0e}")


def on_contact(case: AssemblyCase) -> Iterator[str]:
    """`contact_dofs`, `contact` and `constraint` agree with B and g."""
    problem, dofs = case.plugin, case.plugin.contact_dofs
    defined = type(problem).contact is not Problem.contact
    if dofs is None:
        yield Note("not declared")
        if defined and problem.contact(case.mus[0].copy()) is not None:
            yield "`contact` is defined but `contact_dofs` is not, so it is never used; name the unknowns B may touch"
    elif fault := _dofs_fault(dofs, problem.V.dim):
        raise ConformanceError(f"`contact_dofs` {fault}")
    for where, mu in case.arguments.items():
        full = case.results[where]
        if dofs is not None:
            outside = np.setdiff1d(full["B"].indices[full["B"].data != 0.0], dofs)
            if len(outside):
                what = f"{len(outside)} unknowns outside `contact_dofs` {where}; the first is {outside[0]}"
                raise ConformanceError(f"B touches {what}")
            if defined:
                _check_contact(case, dofs, mu, full)
        B, g = problem.constraint(mu.copy())
        _compare(case, "constraint", mu, {"B": B, "g": g}, full)


def _dofs_fault(dofs: object, n: int) -> str:
    if not isinstance(dofs, np.ndarray) or dofs.ndim != 1 or not np.issubdtype(dofs.dtype, np.integer):
        return f"is {getattr(dofs, 'dtype', type(dofs).__name__)}; expected a vector of indices"
    if len(dofs) and (dofs.min() < 0 or dofs.max() >= n):
        return f"ranges from {dofs.min()} to {dofs.max()}; the unknowns are 0 to {n - 1}"
    return (
        "is not strictly increasing; expected sorted indices without repetition" if np.any(np.diff(dofs) <= 0) else ""
    )


def _check_contact(case: AssemblyCase, dofs: Indices, mu: Array, full: Arrays) -> None:
    given, columns = mu.copy(), "B[:, contact_dofs]"
    contact = unmutated("contact", {"its argument mu": given}, partial(case.plugin.contact, given))
    if not isinstance(contact, Contact):
        raise ConformanceError(f"contact returns a {type(contact).__name__} {at(mu)}; expected a vibench.Contact")
    _compare(case, "contact", mu, {columns: contact.B, "g": contact.g}, full | {columns: full["B"][:, dofs]})
    if type(case.plugin).contact_loads is not Problem.contact_loads:
        _check_contact_loads(case, dofs, mu, full)


def _check_contact_loads(case: AssemblyCase, dofs: Indices, mu: Array, full: Arrays) -> None:
    """Loads of multipliers on all rows, on a part of them, and none are those of B and g."""
    # Multipliers on all rows, on the first half of them, and on none.
    eta = np.random.default_rng(0).random((len(full["g"]), 3)) * [1.0, 1.0, 0.0]
    eta[len(eta) // 2 :, 1] = 0.0
    for chosen in (eta, eta[:, 1:]):
        loads = case.plugin.contact_loads(chosen)
        varying, bounds = loads.varying(mu.copy())
        if len(varying) > loads.reached.stop - loads.reached.start:
            raise ConformanceError(f"loads vary on {len(varying)} rows {at(mu)}, more than `reach` of `contact_loads`")
        B_eta = loads.fixed.copy()
        B_eta[loads.first : loads.first + len(varying)] += varying
        expected = {"Bᵀη": full["B"][:, dofs].T @ chosen, "ηᵀg": chosen.T @ full["g"]}
        _compare(case, "contact_loads", mu, {"Bᵀη": B_eta, "ηᵀg": bounds}, expected)


def affine(case: AssemblyCase) -> Iterator[str]:
    """Sums declared in `affine` agree with `assemble`."""
    problem = case.plugin
    yield from _undeclarable("affine", problem.affine)
    declared = {name: each for name, each in problem.affine.items() if name in MEMBERS}
    if not declared:
        yield Note("not declared")
        return
    yield Note(", ".join(f"{name}: {len(each.terms)} terms" for name, each in declared.items()))
    for where, mu in case.arguments.items():
        for name, each in declared.items():
            try:
                summed = each.at(mu.copy())
            except NumericalError as error:
                raise ConformanceError(f"the affine sum of {name} {where}: {error}") from error
            _compare(case, "affine", mu, {name: summed}, case.results[where])


def by_entries(case: AssemblyCase) -> Iterator[str]:
    """`sampler` agrees with `assemble` on entries of every member alone, and of all at once."""
    problem = case.plugin
    yield from _undeclarable("entrywise", problem.entrywise)
    names = [name for name in MEMBERS if name in problem.entrywise]
    if not names:
        yield Note("not declared")
        if type(problem).sampler is not Problem.sampler:
            yield "`sampler` is defined but `entrywise` names no member, so it is never used"
        return
    rng, pattern = np.random.default_rng(0), case.results[at(case.mus[0])]
    wanted = {name: _places(name, pattern[name], rng) for name in names}
    # A run samples one member or several in one call.
    for chosen in [*([name] for name in names), names]:
        _check_sampler(case, {name: wanted[name] for name in chosen})


def by_elements(case: AssemblyCase) -> Iterator[str]:
    """`element_sampler` agrees with `assemble`: summed over all elements, and on some of them with those of all."""
    problem = case.plugin
    yield from _undeclarable("elementwise", problem.elementwise)
    names = [name for name in MEMBERS if name in problem.elementwise]
    if not names:
        yield Note("not declared")
        return
    if set(names) - {"A", "f"}:
        yield f"`elementwise` names {', '.join(names)}; only A and f are integrated element by element"
        return
    dofs, n = problem.element_dofs, problem.V.dim
    if dofs.ndim != 2 or dofs.dtype.kind not in "iu" or dofs.min(initial=0) < -1 or dofs.max(initial=0) >= n:
        yield f"element_dofs has shape {dofs.shape} and dtype {dofs.dtype}; expected (k, e), whole, from -1 to {n - 1}"
        return
    k, count = dofs.shape
    some = np.arange(0, count, max(2, count // 40))
    of_all, of_some = problem.element_sampler(np.arange(count)), problem.element_sampler(some)
    for where, mu in case.arguments.items():
        full, parts = of_all(mu.copy()), of_some(mu.copy())
        for name in names:
            shape = (k, k) if name == "A" else (k,)
            for sampled, number in ((full, count), (parts, len(some))):
                if name not in sampled:
                    raise ConformanceError(f"the element sampler returns no {name}, which `elementwise` names")
                if fault := array_fault(f"{name} of the element sampler", sampled[name], (number, *shape)):
                    raise ConformanceError(f"{fault} ({at(mu)})")
            _compare(case, "element_sampler", mu, {name: _summed(name, full[name], dofs, n)}, case.results[where])
            if what := difference(parts[name], full[name][some], case.round_off * largest_entry(full[name])):
                raise ConformanceError(f"{name} on some elements differs from that on all of them {at(mu)}: {what}")


def _summed(name: str, parts: Array, dofs: Indices, n: int) -> object:
    """The matrix (n×n) or the vector (n,) of parts (e×k×k) or (e×k) on elements."""
    if name == "f":
        kept = dofs.T >= 0
        return np.bincount(dofs.T[kept], weights=parts[kept], minlength=n)
    rows, columns = np.broadcast_arrays(dofs.T[:, :, None], dofs.T[:, None, :])
    # −1 stands for a node without an unknown.
    kept = (rows >= 0) & (columns >= 0)
    return sp.csr_array(sp.coo_array((parts[kept], (rows[kept], columns[kept])), shape=(n, n)))


def _places(name: str, values: object, rng: np.random.Generator) -> tuple[Indices, Indices]:
    """Rows and columns of entries in the pattern of a member; of the symmetric A on and above the diagonal."""
    if isinstance(values, np.ndarray):
        rows, columns = np.arange(len(values)), np.zeros(len(values), dtype=np.intp)
    else:
        pattern = sp.coo_array(sp.triu(values) if name == "A" else values)
        rows, columns = (np.asarray(axis, dtype=np.intp) for axis in pattern.coords)
    chosen = np.sort(rng.choice(len(rows), min(40, len(rows)), replace=False))
    return rows[chosen], columns[chosen]


def _check_sampler(case: AssemblyCase, wanted: dict[str, tuple[Indices, Indices]]) -> None:
    sample = case.plugin.sampler(wanted)
    for where, mu in case.arguments.items():
        full, given = case.results[where], mu.copy()
        samples = unmutated("the sampler", {"its argument mu": given}, partial(sample, given))
        for name, (rows, columns) in wanted.items():
            if name not in samples:
                raise ConformanceError(f"the sampler returns no {name}, which `entrywise` names")
            if fault := array_fault(f"{name} of the sampler", samples[name], rows.shape):
                raise ConformanceError(f"{fault} ({at(mu)})")
            # A full copy with the sampled entries, so that the message names their place in the member.
            sampled = copies({name: full[name]})
            sampled[name][(rows, columns) if name in "AB" else rows] = samples[name]
            _compare(case, "sampler", mu, sampled, full)


def _compare(case: AssemblyCase, function: str, mu: Array, arrays: Arrays, full: Arrays) -> None:
    """Raise a `ConformanceError` for the first array whose type, shape or values are not those of `assemble` at mu."""
    for name, array in arrays.items():
        if fault := array_fault(f"{name} of `{function}`", array, full[name].shape, sparse=sp.issparse(full[name])):
            raise ConformanceError(f"{fault} ({at(mu)})")
    for name, what in differences(copies(arrays), {name: full[name] for name in arrays}, case.round_off):
        raise ConformanceError(f"{name} of `{function}` differs from that of `assemble` {at(mu)}: {what}")


def _undeclarable(declaration: str, names: Iterable[str]) -> Iterator[str]:
    """Faults of `constant`, `entrywise` or `elementwise`: names that are not members."""
    if isinstance(names, str):
        raise ConformanceError(f"`{declaration}` is the string {names!r}; expected a set: frozenset({{{names!r}}})")
    for name in sorted(set(names) - set(MEMBERS)):
        yield f"`{declaration}` names '{name}'; expected {', '.join(MEMBERS)}"
