"""Validation of what plugins return: each fault raises a `NumericalError` that names it and the expected value.

A fingerprint of an assembled problem is equal for equal numbers, and small enough to be stored with the solutions.
Declarations of a problem are believed only until the assembly at a parameter refutes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Annotated, Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask, read_only, real_matrix, real_vector, taken
from vibench.errors import NumericalError, at_parameter, placed
from vibench.interfaces.absent_rows import ABSENT, is_absent, settled_bounds
from vibench.interfaces.dual_sets import RAYS, DualSet
from vibench.interfaces.outputs import Output, Picture
from vibench.interfaces.problem import MEMBERS, Contact, Problem, VariationalInequality
from vibench.interfaces.strategies import Enrichment, ReducedSet, Sampling, check_sample
from vibench.linalg.inner_product import InnerProduct
from vibench.signatures import check_attributes, refuse_others, rule_of


def check_cone(cone: object, W: InnerProduct, K: DualSet = RAYS) -> ReducedSet:
    """A copy of a cone; refused if generators are not finite, of the right shape, of unit norm in W, or in W⁺ or free.

    Rows of K that are no rays may have any sign.
    """
    if not isinstance(cone, ReducedSet):
        raise NumericalError(f"the dual strategy returned a {type(cone).__name__}, expected a ReducedSet")
    chi = taken(cone.generators, "`generators` of the cone", W.dim, "count")
    errors, R = taken(cone.errors, "`errors` of the cone", "count"), chi.shape[1]
    if len(errors) not in (1, R + 1) or errors.min() < 0.0:
        expected = f"expected e(0) … e({R}), or e({R}) alone, none negative"
        raise NumericalError(f"`errors` of the cone has shape {errors.shape}; {expected}")
    norms = W.norm(chi)
    away = np.abs(norms - 1.0)
    # Strategies normalise by norms with round-off of their own: half of the digits are asked for.
    if away.max(initial=0.0) > 1e-8:
        worst = f"generator {away.argmax()} has norm {norms[away.argmax()]:.6g}"
        raise NumericalError(f"the generators do not all have unit norm in W: {worst}")
    # Free generators may have any sign.
    signed = np.where(cone.free | ~K.rays(W.dim)[:, None], 0.0, chi)
    if signed.min(initial=0.0) < 0.0:
        i, r = np.unravel_index(signed.argmin(), signed.shape)
        worst = f"the negative coefficient {signed[i, r]:.1e} and is not declared free"
        raise NumericalError(f"a generator has {worst}: look at coefficient {i} of generator {r}")
    gauges = None if cone.gauges is None else taken(cone.gauges, "`gauges` of the cone", R)
    if gauges is not None and (gauges.min(initial=1.0) <= 0.0 or cone.free.any()):
        raise NumericalError("`gauges` of the cone are not positive, or it has free generators, which no hull has")
    return ReducedSet(chi, errors, cone.free.copy(), tuple(map(str, cone.fallbacks)), gauges)


def check_enrichment(
    enrichment: object, V: Annotated[InnerProduct, "n"], basis: Annotated[Array, "n", "N"]
) -> Enrichment:
    """A copy of an enrichment; refused if fixed vectors are not finite, orthonormal in V and orthogonal to V_N."""
    if not isinstance(enrichment, Enrichment):
        raise NumericalError(f"the primal strategy returned a {type(enrichment).__name__}, expected an Enrichment")
    vectors, eta = enrichment.vectors, enrichment.eta
    if eta is not None:
        eta = taken(eta, "`eta` of the enrichment", "m", "count")
    if vectors is not None:
        vectors = taken(vectors, "`vectors` of the enrichment", V.dim, "count")
        off = V.gram(np.hstack([basis, vectors]), vectors)
        off[basis.shape[1] :] -= np.eye(vectors.shape[1])
        # As for norms of generators: vectors are orthonormal up to round-off.
        if np.max(np.abs(off), initial=0.0) > 1e-8:
            i, j = (int(k) for k in np.unravel_index(np.abs(off).argmax(), off.shape))
            other = f"mode {i} of V_N" if i < basis.shape[1] else f"vector {i - basis.shape[1]}"
            worst = f"the inner product of vector {j} with {other} is off by {off[i, j]:.1e}"
            fault = "the vectors of the enrichment are not orthonormal in V and orthogonal to V_N"
            raise NumericalError(f"{fault}: {worst}")
    return replace(enrichment, vectors=vectors, eta=eta, fallbacks=tuple(map(str, enrichment.fallbacks)))


def training_parameters(problem: Problem, sampling: Sampling | None = None) -> Array:
    """The training set (P×d), by default the problem's; refused if it is no set of parameters of the box."""
    if sampling is not None:
        return check_sample(problem.parameters, sampling.parameters(problem.parameters))
    with placed("training_set"):
        return check_sample(problem.parameters, problem.training_set())


def validation_parameters(problem: Problem, count: int, seed: int, sampling: Sampling | None = None) -> Array:
    """The validation set (count×d), by default the problem's; refused if it has the wrong shape or is not finite."""
    if sampling is not None:
        return check_sample(problem.parameters, sampling.parameters(problem.parameters))
    box = problem.parameters
    mus = taken(np.asanyarray(problem.validation_set(count, seed)), "`validation_set`", count, box.dim)
    for k, i in np.argwhere(box.outside(mus))[:1]:
        where = f"'{box.names[i]}' outside [{box.lower[i]:g}, {box.upper[i]:g}]"
        raise NumericalError(f"validation_set leaves the box: parameter {k}, {mus[k].tolist()}, has {where}")
    return mus


def in_float64(vi: VariationalInequality) -> VariationalInequality:
    """The same with sparse matrices and vectors of float64; raises a `NumericalError` for what has no such form."""
    if not isinstance(vi, VariationalInequality):
        raise NumericalError(f"`assemble` returned a {type(vi).__name__}, expected a VariationalInequality")
    A, B, f, g = real_matrix(vi.A, "A"), real_matrix(vi.B, "B"), real_vector(vi.f, "f"), real_vector(vi.g, "g")
    lift = None if vi.dirichlet_lift is None else real_vector(vi.dirichlet_lift, "dirichlet_lift")
    if A is vi.A and B is vi.B and f is vi.f and g is vi.g and lift is vi.dirichlet_lift:
        return vi
    return VariationalInequality(A, f, B, g, lift, vi.K)


def settled(vi: VariationalInequality) -> VariationalInequality:
    """The same with `settled_bounds`, for which it raises a `NumericalError`."""
    rays = vi.K.rays(len(vi.g))
    g = settled_bounds(vi.B, vi.g, rays)
    if (absent := is_absent(g) & ~rays).any():
        row = int(np.flatnonzero(absent)[0])
        raise NumericalError(f"g is infinite in row {row}, whose multiplier has a bound; leave that row out of K")
    return vi if g is vi.g else replace(vi, g=g)


def checked_assembly(problem: Problem, mu: Annotated[Array, "d"]) -> VariationalInequality:
    """`problem.assemble(mu)` in sparse matrices and vectors of float64.

    Raises a `NumericalError`, with mu, the member, the fault and the expected value, if it fails, shapes are wrong,
    values not real and finite, or out of range.
    """
    with at_parameter(mu):
        vi = in_float64(problem.assemble(mu))
    n, m = problem.V.dim, problem.W.dim
    for name, value, shape in (("A", vi.A, (n, n)), ("f", vi.f, (n,)), ("B", vi.B, (m, n)), ("g", vi.g, (m,))):
        if value.shape != shape:
            where = f"shape {value.shape} at mu = {mu.tolist()}"
            raise NumericalError(f"{name} has {where}; the spaces V and W require {shape}")
        entries = value if isinstance(value, np.ndarray) else value.data
        peak = max(np.max(entries, initial=0.0), -np.min(entries, initial=0.0))
        if not np.isfinite(peak):
            infinite = "; +inf, which means that a row constrains nothing, is allowed" if name == "g" else ""
            raise NumericalError(f"{name} has entries that are not finite at mu = {mu.tolist()}{infinite}")
        # Not even cubes of entries beyond 1e100, or of inverses of smaller ones, are numbers. Rows of g may be far.
        largest = 1e100
        # An infinite entry of an affine sum is nearly as large.
        too_large = peak >= 0.5 * ABSENT and name != "g"
        too_small = 0.0 < peak < 1.0 / largest and name in ("A", "B")
        if too_large or too_small:
            remedy = f"choose units in which they are between {1.0 / largest:.0e} and {largest:.0e}"
            found = f"{name} has entries of up to {peak:.0e} at mu = {mu.tolist()}"
            raise NumericalError(f"{found}; products of such numbers over- or underflow: {remedy}")
    if vi.K != problem.K:
        found = f"the assembly at mu = {mu.tolist()} has {vi.K.names()} as K, or other rows or radii of these"
        raise NumericalError(f"{found}; `problem.K` has {problem.K.names()}, and both have to be equal")
    if not vi.K.kinds <= set(problem.blocks):
        written = ", ".join(f"BlockKind.{kind.name}" for kind in sorted(vi.K.kinds))
        raise NumericalError(f"K has {vi.K.names()}, which the class does not declare: blocks = ({written},)")
    with at_parameter(mu):
        return settled(vi)


@dataclass(frozen=True)
class Fingerprint:
    """Products M v of A, B, X_V and X_W with a fixed vector v, and f and g themselves; `scales` are largest entries.

    The entries of v are distinct, so that a permutation of unknowns changes the products.
    """

    products: Mapping[str, Array]
    scales: Mapping[str, float]

    def deviations(self, other: Fingerprint) -> Iterator[str]:
        """The arrays that differ from those of another assembly, each with its row that differs most."""
        for name, mine in self.products.items():
            theirs = other.products[name]
            if mine.shape != theirs.shape:
                yield f"{name} has {len(mine)} rows against {len(theirs)}"
                continue
            gap = np.abs(mine - theirs)
            # Other processors may round otherwise; other meshes differ by 1. Negated, so that NaN differs, too.
            if not np.max(gap, initial=0.0) <= 1e-9 * max(self.scales[name], other.scales[name]):
                yield f"row {int(np.argmax(np.where(np.isnan(gap), np.inf, gap)))} of {name} differs"


def fingerprint(problem: Problem, mu: Array, vi: VariationalInequality) -> Fingerprint:
    """The fingerprint of `vi`, the assembly at mu (d,), of the `contact` there, and of the inner products."""
    arrays, box = {name: getattr(vi, name) for name in MEMBERS}, problem.parameters
    arrays |= {"X_V": problem.V.matrix, "X_W": problem.W.matrix, "the box": np.append(box.lower, box.upper)}
    if problem.has_contact:
        arrays["B of `contact`"] = checked_contact(problem, read_only(mu)).B
    return _fingerprint(arrays)


def _fingerprint(arrays: Mapping[str, Any]) -> Fingerprint:
    products = {name: _probed(array) for name, array in arrays.items()}
    sizes = ((name, array.data if sp.issparse(array) else array) for name, array in arrays.items())
    # Entries of g of absent rows are far larger than all others.
    sizes = ((name, array[~is_absent(array)] if name == "g" else array) for name, array in sizes)
    return Fingerprint(products, {name: float(np.max(np.abs(size), initial=0.0)) for name, size in sizes})


def _probed(array: Any) -> Array:
    """A copy of a vector, or the product of a matrix with a vector that is the same in every process."""
    if array.ndim == 1:
        return np.array(array)
    # Between 1 and 2, so that no entry is lost beside another one.
    return np.asarray(array @ (1.0 + np.random.default_rng(0).random(array.shape[1])))


def check_declarations(problem: Problem) -> None:
    """Raise an error if what a problem is declared to have, as by its annotations, is something else."""
    check_attributes(problem, Problem, NumericalError)
    hints: dict[str, Any] = {"outputs": Sequence[Output], "contact_dofs": Annotated[Indices, "k"] | None}
    hints |= {"element_dofs": Annotated[Indices, "k", "e"]} if problem.elementwise else {}
    for name, hint in hints.items():
        refuse_others(f"`{name}` of the problem", getattr(problem, name), rule_of(hint), NumericalError)
    members = {"constant": MEMBERS, "affine": MEMBERS, "entrywise": MEMBERS, "elementwise": ("A", "f")}
    for name, known in members.items():
        for other in sorted(set(getattr(problem, name)) - set(known)):
            raise NumericalError(f"`{name}` names '{other}', expected members among {', '.join(known)}")
    for one, again in combinations(problem.outputs, 2):
        if one.name == again.name:
            raise NumericalError(f"two outputs have the same name: {one.name}")
    integrals = taken(problem.multiplier_integrals(), "`multiplier_integrals`", problem.W.dim)
    for k in np.flatnonzero(integrals <= 0.0)[:1]:
        expected = "expected positive integrals: override the method if the basis does not sum to one"
        raise NumericalError(f"`multiplier_integrals` is {integrals[k]:.2g} at entry {k}; {expected}")
    for name in ("contact_dofs", "element_dofs")[: 1 + bool(problem.elementwise)]:
        # An unknown that is prescribed has the number -1 in an element.
        dofs, least = getattr(problem, name), -1 if name == "element_dofs" else 0
        if dofs is not None and dofs.size and not least <= dofs.min() <= dofs.max() < problem.V.dim:
            expected = f"expected unknowns from {least} to {problem.V.dim - 1}"
            raise NumericalError(f"`{name}` ranges from {dofs.min()} to {dofs.max()}, {expected}")
        if dofs is not None and not least and np.any(np.diff(dofs.astype(np.int64)) <= 0):
            raise NumericalError("`contact_dofs` is not strictly increasing")


def checked_picture(problem: Problem, mu: Array, u: Array, lam: Array) -> Picture | None:
    """`problem.picture` of a solution, into which it cannot write; a `NumericalError` if it is no picture of λ."""
    picture = problem.picture(read_only(mu), read_only(u), read_only(lam))
    refuse_others("what `picture` returned", picture, rule_of(Picture | None), NumericalError)
    if picture is not None and picture.multiplier.shape != lam.shape:
        raise NumericalError(f"picture.multiplier has shape {picture.multiplier.shape}; expected {lam.shape}")
    return picture


def checked_contact(problem: Problem, mu: Array) -> Contact:
    """`problem.contact(mu)` of a problem that has some; a `NumericalError` if it is none, or of another size."""
    assert problem.contact_dofs is not None  # implied by `has_contact`
    contact, shape = problem.contact(mu), (problem.W.dim, len(problem.contact_dofs))
    if not isinstance(contact, Contact) or contact.B.shape != shape:
        what = f"B of shape {contact.B.shape}" if isinstance(contact, Contact) else f"the type {type(contact).__name__}"
        raise NumericalError(f"what `contact` returned has {what}, expected a Contact with B of shape {shape}")
    return contact


def contradictions(problem: Problem, mu: Array, vi: VariationalInequality, *, elements: bool = True) -> Iterator[str]:
    """Differences of declarations from `vi`, the assembly at mu (d,): the declaration, the member and how much.

    Matrices are compared by their products with a random vector, which hides no entry. `elements` tells whether members
    declared `elementwise` are integrated, which takes as long as an assembly.
    """
    # Whoever writes into it says so by an error at that line.
    mu, rng, n, dofs = read_only(mu), np.random.default_rng(0), len(vi.f), problem.contact_dofs
    v, present = 1.0 + rng.random(n), ~is_absent(vi.g)
    products = {"A": vi.A @ v, "f": vi.f, "B": vi.B @ v, "g": np.where(present, vi.g, 0.0)}
    found = [(f"`affine` of {name}", name, *_sum(problem, name, mu, v, present)) for name in problem.affine]
    if elements and problem.elementwise:
        found += [(f"`element_sampler` of {name}", name, *sums) for name, sums in _integrated(problem, mu, v).items()]
    if dofs is not None and problem.has_contact:
        contact, count = checked_contact(problem, mu), len(dofs)
        bounds = taken(contact.g, "g of `contact`", len(vi.g))
        found += [("`contact`, B", "B", contact.B @ v[dofs], 0.0)]
        found += [("`contact`, g", "g", np.where(is_absent(bounds) & ~present, 0.0, bounds), 0.0)]
        if type(problem).contact_loads is not Problem.contact_loads:
            eta = rng.random((len(vi.g), 2)) * present[:, None]
            made = problem.contact_loads(eta)
            if len(made.varying(mu)[0]) > made.reached.stop - made.first:
                raise NumericalError(f"`contact_loads` vary on more rows at mu = {mu.tolist()} than their `reach`")
            loads, of_bounds = made.at(mu)
            products |= {"Bᵀη": (vi.B.T @ eta)[dofs], "ηᵀg": eta.T @ products["g"]}
            found += [("`contact_loads`, Bᵀη", "Bᵀη", taken(loads, "Bᵀη of `contact_loads`", count, 2), 0.0)]
            found += [("`contact_loads`, ηᵀg", "ηᵀg", taken(of_bounds, "ηᵀg of `contact_loads`", 2), 0.0)]
    for what, member, declared, scale in found:
        yield from _difference(what, products[member], declared, scale)
    yield from _sampled(problem, mu, vi, rng)


def _difference(
    what: str, assembled: Array, declared: Array, scale: float, rows: Indices | None = None
) -> Iterator[str]:
    """The sentence that they differ by more than round-off of their entries, or of terms of this size."""
    size = max(float(np.max(np.abs(assembled), initial=0.0)), scale)
    gap = np.abs(assembled - declared)
    # Negated, so that what is no number differs, too.
    if not np.max(gap, initial=0.0) <= 1e-9 * size:
        place = np.unravel_index(int(np.argmax(np.where(np.isnan(gap), np.inf, gap))), gap.shape)
        row = place[0] if rows is None else rows[place[0]]
        yield f"{what}, is not that of `assemble`: row {row} differs by {np.max(gap) / (size or 1.0):.1e}"


def _sum(problem: Problem, name: str, mu: Array, v: Array, present: Mask) -> tuple[Array, float]:
    """The declared sum of a member, or its product with v (n,), and the size of its terms."""
    declared = problem.affine[name]
    theta = declared.coefficients(mu)
    terms = [np.where(present, term, 0.0) if name == "g" else term @ v if name in "AB" else term
             for term in declared.terms]  # fmt: skip
    parts = [np.asarray(value * term, dtype=float) for value, term in zip(theta, terms, strict=True)]
    return sum(parts[1:], parts[0]), max(float(np.max(np.abs(part), initial=0.0)) for part in parts)


def _integrated(problem: Problem, mu: Array, v: Array) -> dict[str, tuple[Array, float]]:
    """Members summed over all elements, matrices times v (n,)."""
    dofs, v = problem.element_dofs, np.append(v, 0.0)
    found = {name: (np.zeros(len(v)), 0.0) for name in sorted(problem.elementwise)}
    # Every other element, so that a sampler which ignores the choice is found.
    for chosen in (np.arange(first, dofs.shape[1], 2) for first in (0, 1)):
        values, own = problem.element_sampler(chosen)(mu), dofs[:, chosen]
        for name, (total, scale) in found.items():
            size = (len(dofs),) * (2 if name == "A" else 1)
            parts = taken(values.get(name), f"{name} of `element_sampler`", len(chosen), *size)
            # Prescribed values, at -1, count as zeros.
            parts = np.einsum("jab,bj->aj", parts, v[own]) if name == "A" else parts.T
            added = np.bincount(own.ravel() % len(v), weights=parts.ravel(), minlength=len(v))
            found[name] = total + added, max(scale, float(np.max(np.abs(parts), initial=0.0)))
    return {name: (total[:-1], scale) for name, (total, scale) in found.items()}


def _sampled(problem: Problem, mu: Array, vi: VariationalInequality, rng: np.random.Generator) -> Iterator[str]:
    """The sentence that entries of `sampler` differ, of a few random ones of every member."""
    members = {name: getattr(vi, name) for name in MEMBERS if name in problem.entrywise}
    wanted, expected = dict[str, tuple[Indices, Indices]](), dict[str, Array]()
    for name, member in members.items():
        rows, columns, values = _entries(member)
        chosen = np.sort(rng.permutation(len(values))[:32])
        wanted[name], expected[name] = (rows[chosen], columns[chosen]), values[chosen]
    samples = problem.sampler(wanted)(mu) if wanted else {}
    for name, values in expected.items():
        scale = float(np.max(np.abs(_entries(members[name])[2]), initial=0.0))
        sampled = taken(samples.get(name), f"{name} of `sampler`", len(values))
        yield from _difference(f"`sampler` of {name}", values, sampled, scale, wanted[name][0])


def _entries(member: Any) -> tuple[Indices, Indices, Array]:
    """Rows, columns and values of the entries of a sparse matrix or of a vector, those of absent rows left out."""
    if sp.issparse(member):
        triplets = sp.coo_array(member)
        return triplets.row, triplets.col, triplets.data
    rows = np.flatnonzero(~is_absent(member))
    return rows, np.zeros_like(rows), member[rows]


class ReferenceAssembly:
    """The `first_assembly` of a problem, as this returned it; assemblies at other parameters are compared with it."""

    def __init__(self, problem: Problem) -> None:
        check_declarations(problem)
        (mu, self._vi), self._problem, self._compared = first_assembly(problem), problem, 0
        with at_parameter(mu):
            self.fingerprint = fingerprint(problem, mu, self._vi)

    def refuse_false_declarations(self, mu: Array, vi: VariationalInequality) -> None:
        """Raise a `NumericalError` if a declaration, such as `constant`, `affine` or `contact`, differs from `vi`."""
        # The same object needs no product; `refuse_rewritten_constants` tells if its entries were replaced.
        names = [name for name in self._problem.constant if getattr(vi, name) is not getattr(self._vi, name)]
        for deviation in _fingerprint({name: getattr(vi, name) for name in names}).deviations(self.fingerprint):
            where = f"at mu = {mu.tolist()} from that at the first training parameter"
            raise NumericalError(f"a member declared `constant` depends on mu: {deviation} {where}")
        # Integration over all elements takes as long as an assembly: a few parameters of a chunk have to do.
        self._compared += 1
        with at_parameter(mu):
            difference = next(contradictions(self._problem, mu, vi, elements=self._compared <= 4), "")
        if difference:
            raise NumericalError(f"refuted at mu = {mu.tolist()}: {difference}")

    def refuse_at_random(self, count: int, seed: int) -> None:
        """Compare at random parameters, unless the problem has validation parameters of its own.

        With k parameters a declaration is false in at most 3/k of the box, at 95 %. A set of the problem's own may
        avoid parts of the box, which are not entered then.
        """
        if type(self._problem).validation_set is Problem.validation_set:
            for mu in self._problem.parameters.sample(count, seed):
                self.refuse_false_declarations(mu, checked_assembly(self._problem, mu))

    def refuse_rewritten_constants(self) -> None:
        """Raise a `NumericalError` if later assemblies have written other entries into a member declared `constant`."""
        constants = {name: getattr(self._vi, name) for name in self._problem.constant}
        for deviation in _fingerprint(constants).deviations(self.fingerprint):
            raise NumericalError(f"a member declared `constant` is overwritten by later assemblies: {deviation}")


def first_assembly(problem: Problem) -> tuple[Array, VariationalInequality]:
    """The first of the problem's own training parameters (d,) with an assembly, and that; raises that of the first."""
    errors = list[NumericalError]()
    for mu in training_parameters(problem):
        try:
            return mu, checked_assembly(problem, mu)
        except NumericalError as error:
            errors.append(error)
    raise errors[0]
