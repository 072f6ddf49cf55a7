"""The conformance checks of problems: spaces, parameters, all ways to assemble A, f, B and g, solutions, pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array, read_only
from vibench.errors import NumericalError, UnsupportedError, placed
from vibench.highfidelity import active_set
from vibench.interfaces import validation
from vibench.interfaces.outputs import MeshFields
from vibench.interfaces.problem import MEMBERS, Problem
from vibench.interfaces.validation import checked_assembly, training_parameters, validation_parameters
from vibench.linalg.inner_product import InnerProduct, singular_values
from vibench.model.affine import INTERPOLATION_RTOL, assembled_members, decomposed, held_out_error, is_missed
from vibench.offline.compiled import compiled_contact, compiler
from vibench.signatures import refuse_others, rule_of
from vibench.stability.coercivity import Quotients
from vibench.testing.case import (
    Arrays,
    Case,
    at,
    copies,
    difference,
    differences,
    find_jump,
    largest_entry,
)
from vibench.testing.checks import Check, ConformanceError, Doubt, Note
from vibench.timing import timed


@dataclass(eq=False)
class ProblemCase(Case[Problem, Array, Arrays]):
    """A problem and the arrays it assembles, at fewer parameters where these would take longer than `seconds`."""

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

    @cached_property
    def mus(self) -> Array:
        """Parameters (7×d): two corners of the box, its centre, and four random ones; only the first if it is slow."""
        box = self.plugin.parameters
        fixed = np.stack([box.lower, box.upper, 0.5 * (box.lower + box.upper)])
        return read_only(np.concatenate([fixed, box.sample(4, seed=0)])[: self.points])

    @cached_property
    def arguments(self) -> dict[str, Array]:
        return {at(mu): mu for mu in self.mus}

    def evaluate(self, argument: Array, plugin: Problem | None = None) -> Arrays:
        """Copies of A, f, B and g at a parameter (d,), and of X_V and X_W."""
        problem = plugin or self.plugin
        vi = validation.in_float64(self.clocked("an assembly", lambda: problem.assemble(argument)))
        members = {name: getattr(vi, name) for name in MEMBERS}
        return copies({**members, "X_V": problem.V.matrix, "X_W": problem.W.matrix})

    def arrays(self, result: Arrays) -> Arrays:
        return result


def one_assembly(case: ProblemCase) -> Iterator[str]:
    """The first assembly is timed; at how many parameters the others can be made follows."""
    points = case.points
    with suppress(Exception):  # the next check says what a plugin raises
        yield Note(f"takes {case.one_assembly:.2g} s")
    if points < 7:
        yield Note(f"checks at {points} parameters instead of 7, and none for jumps, for lack of time")


def assembly(case: ProblemCase) -> Iterator[str]:
    """Members are what a run takes: real and finite, of the right types and shapes."""
    for mu in case.mus:
        checked_assembly(case.plugin, mu)
    yield Note(f"n = {case.plugin.V.dim}, m = {case.plugin.W.dim}, at {len(case.mus)} parameters")


def symmetry(case: ProblemCase) -> None:
    """A is symmetric."""
    for where, arrays in case.results.items():
        # The round-off that `linalg.inner_product.asymmetry` allows.
        if what := difference(arrays["A"], arrays["A"].T, 1e-12 * largest_entry(arrays["A"])):
            raise ConformanceError(f"A is not symmetric {where}: {what} in the transpose")


def definiteness(case: ProblemCase) -> None:
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


def independence(case: ProblemCase) -> Iterator[str]:
    """Every parameter has an effect."""
    # A parameter has an effect if anything changes from the centre of the box to a side of it.
    box = case.plugin.parameters
    centre = 0.5 * (box.lower + box.upper)
    for number, name in enumerate(box.names if case.points == 7 else ()):
        moved = np.where(np.arange(box.dim) == number, box.upper, centre)
        varies = box.upper[number] > box.lower[number]
        if varies and not any(differences(case.evaluate(moved), case.evaluate(centre), case.round_off)):
            yield Doubt(f"nothing depends on the parameter '{name}'")


def continuity(case: ProblemCase) -> Iterator[str]:
    """Members do not jump on lines in the box: a diagonal, one between random points, one along every axis."""
    listed = case.plugin.parameters.listed is not None
    if listed or case.points < 7:
        yield Note(f"not looked for, {'since there are listed parameters only' if listed else 'for lack of time'}")
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
            what = f"{difference(first, last, 0.0)} over a step of {step:.0e}"
            raise ConformanceError(f"{jump.name} jumps {where}: {what}")


def declarations(case: ProblemCase) -> Iterator[str]:
    """Members as they are declared, and B and g on the contact, are those of `assemble`, as a run checks."""
    problem, kind = case.plugin, type(case.plugin)
    if problem.contact_dofs is None and kind.contact is not Problem.contact:
        yield "`contact` is defined but `contact_dofs` is not, so it is never used; name the unknowns B may touch"
    if not problem.entrywise and kind.sampler is not Problem.sampler:
        yield "`sampler` is defined but `entrywise` names no member, so it is never used"
    yield Note(", ".join(f"{name}: {len(one.terms)} terms" for name, one in problem.affine.items()) or "not affine")
    reference = validation.ReferenceAssembly(problem)
    for mu in case.mus:
        reference.refuse_false_declarations(mu, checked_assembly(problem, mu))


def in_c(case: ProblemCase) -> Iterator[str]:
    """The constraint that C code evaluates is that of `assemble`."""
    problem, dofs = case.plugin, case.plugin.contact_dofs
    if dofs is None or not problem.has_contact or (source := problem.contact_source()) is None:
        yield Note("not declared")
        return
    try:
        compiler()
    except UnsupportedError as error:
        yield Note(f"`contact_source` is not compared: {error}")
        return
    try:
        evaluate = compiled_contact(source, (problem.W.dim, len(dofs)))
    except UnsupportedError as error:
        raise ConformanceError(f"`contact_source`: {error}") from error
    for where, mu in case.arguments.items():
        if (contact := evaluate(mu)) is None:
            raise ConformanceError(f"`contact_source` has no constraint {where}, where `contact` has one")
        full, columns = case.results[where], "B[:, contact_dofs]"
        expected = {columns: full["B"][:, dofs], "g": full["g"]}
        for name, what in differences({columns: contact.B, "g": contact.g}, expected, 1e-12):
            raise ConformanceError(f"{name} of `contact_source` differs from that of `assemble` {where}: {what}")


def spaces(case: ProblemCase) -> Iterator[str]:
    """The problem has what it declares: a box, inner products X_V and X_W, members, indices, and outputs."""
    validation.check_declarations(case.plugin)
    for name, none in (("V", "no unknown is free"), ("W", "there is no constraint")):
        if getattr(case.plugin, name).dim == 0:
            yield f"{name} has dimension 0; {none}"


def training_set(case: ProblemCase) -> Iterator[str]:
    """Training parameters lie in the box, are reproducible, and there are at least two."""
    mus = training_parameters(case.plugin)
    if len(mus) < 2:
        yield f"training_set has mu = {mus[0].tolist()} alone; expected at least two different parameters"
    if what := difference(training_parameters(case.plugin), mus, 0.0):
        yield f"training_set differs in a second call: {what} before"
    yield Note(f"{len(mus)} parameters")


def validation_set(case: ProblemCase) -> Iterator[str]:
    """Validation parameters lie in the box and are reproducible."""
    mus = validation_parameters(case.plugin, 5, seed=0)
    if what := difference(validation_parameters(case.plugin, len(mus), seed=0), mus, 0.0):
        yield f"validation_set is not the same for the same seed: {what} before; draw from default_rng(seed)"


def constants(case: ProblemCase) -> Iterator[str]:
    """α and γ_a of A, β_HF and γ_b of B are of a moderate ratio."""
    where, arrays = next(iter(case.results.items()))
    A, V, W = arrays["A"], case.plugin.V, case.plugin.W
    of_norm, of_diagonal = Quotients(A, V), Quotients(A, InnerProduct(sp.diags_array(A.diagonal(), format="csc")))
    lowest, highest = of_norm.lowest(1e-3), of_norm.highest(1e-3)
    yield Note(f"{where}: α = {lowest:.3g}, γ_a = {highest:.3g}")
    ratio, diagonal = highest / lowest, of_diagonal.highest(1e-3) / of_diagonal.lowest(1e-3)
    # The ratio of a norm that bounds A from both sides does not depend on the mesh; that of diagonal matrices, of a
    # mass matrix and of any norm without gradients is O(h⁻²), and another order of the unknowns makes it larger still.
    # A good norm stays below 0.8 of the diagonal's ratio on coarse meshes; a ratio up to 10 is never doubted.
    if ratio > max(10.0, 0.8 * diagonal):
        why = "the unknowns in another order than A, or is a norm without gradients, such as a mass matrix"
        yield Doubt(f"γ_a/α = {ratio:.2g}, as with the diagonal of A as X_V ({diagonal:.2g}): probably X_V has {why}")
    if W.dim > 1000:
        yield Note("β_HF is not computed for more than 1000 constraints")
        return
    values = singular_values(V.whiten_functional(np.asarray(arrays["B"].T @ W.unwhiten(np.eye(W.dim)))))
    beta = float(values[-1]) if len(values) == W.dim else 0.0
    yield Note(f"β_HF = {beta:.3g}, γ_b = {values[0]:.3g}")
    # Rows whose singular values are at the level of round-off are linearly dependent.
    negligible = 1e-10 * values[0]
    if beta <= negligible:
        dependent = W.dim - int(np.sum(values > negligible))
        yield Doubt(f"β_HF/γ_b = {beta / values[0]:.1g}: {dependent} rows of B depend linearly on the others")


def high_fidelity_solution(case: ProblemCase) -> Iterator[str]:
    """High-fidelity solutions exist; their multipliers lie in K and are not all zero."""
    mus, solver = training_parameters(case.plugin), active_set.HighFidelitySolver(case.plugin)
    solved, contacts = list[active_set.HighFidelitySolution](), 0
    # Five evenly spread parameters; those between them only while no constraint is active.
    spread = [k for count in (5, 50) for k in np.linspace(0, len(mus) - 1, count).round().astype(int)]
    for k in dict.fromkeys(spread):
        if len(solved) >= min(5, case.points) and (contacts or case.late):
            break
        with placed("no solution", NumericalError):
            answer = solver.solve(mus[k])
        solved.append(answer)
        contacts += bool(answer.lam.any())
    if not contacts:
        yield f"no constraint is active at any of {len(solved)} training parameters; is B u ≤ g the admissible side?"
    elif all(np.all(each.lam > 0.0) for each in solved):
        yield Doubt(f"every constraint is active at each of {len(solved)} training parameters; are the signs right?")
    worst, fallbacks = max(each.residuals.worst for each in solved), sum(bool(each.fallback) for each in solved)
    initial = f", {fallbacks} started from an interior-point solution" if fallbacks else ""
    yield Note(f"residuals up to {worst:.0e}, contact at {contacts} of {len(solved)} parameters{initial}")


def interpolation(case: ProblemCase) -> Iterator[str]:
    """Interpolated members are also right at parameters outside the training set."""
    problem, mus = case.plugin, training_parameters(case.plugin)
    names = [name for name in MEMBERS if name in problem.entrywise - problem.constant - set(problem.affine)]
    # A quarter of the time is left to this check.
    if not names or case.one_assembly * (len(mus) + 5) > 0.25 * case.seconds:
        yield Note("an assembly takes too long" if names else "no member is interpolated")
        return
    for name, values in assembled_members(problem, [*mus, *validation_parameters(problem, 5, seed=0)], names).items():
        member = decomposed(name, values[: len(mus)], problem.V, INTERPOLATION_RTOL, contact=problem.has_contact)
        if not member.terms:
            yield Note(f"{name} is not interpolated: {member.reason or 'its terms are too many'}")
            continue
        error = held_out_error(name, member, values[len(mus) :], problem.V)
        yield Note(f"{name}: {len(member.terms)} terms, error {error:.0e}")
        if is_missed(INTERPOLATION_RTOL, error):
            where = f"interpolated over {len(mus)} training parameters"
            yield Doubt(f"{name}, {where}, has an error of {error:.1e} at validation parameters: it needs more of them")


def pictures(case: ProblemCase) -> Iterator[str]:
    """`diagnostics` are finite numbers; `picture` and `mesh_fields` are well formed."""
    mu = training_parameters(case.plugin)[0]
    diagnostics = case.plugin.diagnostics(mu)
    refuse_others(f"what `diagnostics` returned {at(mu)}", diagnostics, rule_of(Mapping[str, float]))
    solved = active_set.HighFidelitySolver(case.plugin).solve(mu)
    # Whoever writes into them says so by an error at that line.
    u, lam = read_only(solved.u), read_only(solved.lam)
    if validation.checked_picture(case.plugin, mu, u, lam) is None:
        yield Note("no picture")
    mesh = case.plugin.mesh_fields(mu, u, lam)
    refuse_others("what `mesh_fields` returned", mesh, rule_of(MeshFields | None))
    if mesh is not None:
        yield from (f"mesh_fields.{fault}" for fault in mesh.faults())
        yield Note(", ".join(f"{len(corners)} {name}" for name, corners in mesh.cells.items()))


def quantities_of_interest(case: ProblemCase) -> Iterator[str]:
    """Quantities of interest have names and units, and finite values that a second call repeats."""
    declared, mu = case.plugin.outputs, training_parameters(case.plugin)[:1]
    solved = active_set.HighFidelitySolver(case.plugin).solve(mu[0])
    u, lam = solved.u[:, None], solved.lam[:, None]
    for one, again in zip(declared, case.plugin.outputs, strict=True):
        # A reduced solution may have no contact.
        for columns in ((u, lam), (0.0 * u, 0.0 * lam)):
            if one.values(mu, *columns) != again.values(mu, *columns):
                yield f"the output '{one.name}' differs in a second call {at(mu[0])}"
    yield Note(f"{', '.join(one.name for one in declared) or 'no outputs'}")


ProblemCase.checks = (
    Check("construction", ProblemCase.construction), Check("options", ProblemCase.options, ("construction",)),
    Check("spaces", spaces, ("construction",)),
    Check("training set", training_set, ("spaces",)), Check("validation set", validation_set, ("spaces",)),
    Check("one assembly", one_assembly, ("spaces",)), Check("assembly", assembly, ("one assembly",)),
    Check("symmetry of A", symmetry, ("assembly",)),
    Check("definiteness of A", definiteness, ("symmetry of A",)),
    Check("determinism", ProblemCase.determinism, ("assembly",)),
    Check("another process", ProblemCase.another_process, ("determinism",)),
    Check("coercivity and inf-sup", constants, ("definiteness of A", "determinism")),
    Check("independence of mu", independence, ("determinism",)),
    Check("continuity in mu", continuity, ("independence of mu",)),
    Check("declarations", declarations, ("determinism", "spaces", "training set")),
    Check("constraint in C", in_c, ("declarations",)),
    Check("interpolation", interpolation,
          ("training set", "validation set", "independence of mu", "declarations")),
    Check("pickling", ProblemCase.pickling, ("determinism",)),
    Check("high-fidelity solution", high_fidelity_solution,
          ("training set", "definiteness of A", "independence of mu", "declarations")),
    Check("picture and diagnostics", pictures, ("high-fidelity solution",)),
    Check("outputs", quantities_of_interest, ("high-fidelity solution",)),
    Check("time", ProblemCase.duration, ("assembly",)),
)  # fmt: skip
