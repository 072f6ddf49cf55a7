"""The conformance checks of problems: spaces, parameters, what is assembled, high-fidelity solutions, pictures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.highfidelity import active_set
from vibench.interfaces.outputs import MeshFields, Output, Picture
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import MEMBERS
from vibench.interfaces.validation import training_parameters, validation_parameters
from vibench.linalg.inner_product import InnerProduct, singular_values
from vibench.model.affine import INTERPOLATION_RTOL, MISSED, assembled_members, decomposed, held_out_error
from vibench.stability.coercivity import extreme_quotients
from vibench.testing import assembly
from vibench.testing.assembly import AssemblyCase
from vibench.testing.case import array_fault, at, difference, unmutated
from vibench.testing.checks import Check, ConformanceError, Doubt, Note


def spaces(case: AssemblyCase) -> Iterator[str]:
    """X_V and X_W are symmetric positive definite; the integrals of the multiplier basis are positive."""
    for name in ("V", "W"):
        space = getattr(case.plugin, name, None)
        if not isinstance(space, InnerProduct):
            yield f"{name} is a {type(space).__name__}; expected a vibench.InnerProduct"
        elif space.dim == 0:
            yield f"{name} has dimension 0; {'no unknown is free' if name == 'V' else 'there is no constraint'}"
        elif fault := array_fault(f"X_{name}", space.matrix, (space.dim, space.dim), sparse=True):
            yield fault
        else:
            try:
                InnerProduct(space.matrix, f"X_{name}")
            except NumericalError as error:
                yield f"{error}: the matrix was changed after the InnerProduct was made"
    integrals = case.plugin.multiplier_integrals()
    if fault := array_fault("multiplier_integrals", integrals, (case.plugin.W.dim,)):
        yield fault
    elif np.any(integrals <= 0.0):
        k = int(np.argmin(integrals))
        yield (
            f"multiplier_integrals has the value {integrals[k]:.2g} at entry {k}; expected the positive integrals of "
            "the multiplier basis: override the method if the basis does not sum to one"
        )


def parameters(case: AssemblyCase) -> Iterator[str]:
    """`parameters` is a box with names, units and ordered bounds."""
    box = case.plugin.parameters
    if not isinstance(box, ParameterBox):
        raise ConformanceError(f"parameters is a {type(box).__name__}; expected a vibench.ParameterBox")
    if isinstance(box.names, str) or not box.names or not all(isinstance(name, str) and name for name in box.names):
        raise ConformanceError(f"the parameters' names are {box.names!r}; expected a tuple of strings, one for each")
    if len(set(box.names)) < box.dim:
        yield f"two parameters have the same name: {', '.join(box.names)}"
    if isinstance(box.units, str) or len(box.units) != box.dim:
        yield f"the parameters' units are {box.units!r}; expected a tuple of {box.dim}, '1' for a number"
    faults = [array_fault(f"parameters.{name}", getattr(box, name), (box.dim,)) for name in ("lower", "upper")]
    yield from filter(None, faults)
    for name, low, high in () if any(faults) else zip(box.names, box.lower, box.upper, strict=True):
        if low > high:
            yield f"the lower bound {low:g} of the parameter '{name}' is above its upper bound {high:g}"


def training_set(case: AssemblyCase) -> Iterator[str]:
    """Training parameters lie in the box, are reproducible, and there are at least two."""
    mus = training_parameters(case.plugin)
    yield from _outside("training_set", mus, case.plugin.parameters)
    if len(np.unique(mus, axis=0)) < 2:
        yield f"training_set has mu = {mus[0].tolist()} alone; expected at least two different parameters"
    if what := difference(training_parameters(case.plugin), mus):
        yield f"training_set differs in a second call: {what} before"
    yield Note(f"{len(mus)} parameters")


def validation_set(case: AssemblyCase) -> Iterator[str]:
    """Validation parameters lie in the box and are reproducible."""
    mus = validation_parameters(case.plugin, 5, seed=0)
    yield from _outside("validation_set", mus, case.plugin.parameters)
    if what := difference(validation_parameters(case.plugin, len(mus), seed=0), mus):
        yield f"validation_set is not the same for the same seed: {what} before; draw from default_rng(seed)"


def _outside(name: str, mus: Array, box: ParameterBox) -> Iterator[str]:
    for k, i in np.argwhere(box.outside(mus))[:1]:
        interval = f"[{box.lower[i]:g}, {box.upper[i]:g}]"
        yield f"{name} leaves the box: parameter {k}, {at(mus[k])}, has '{box.names[i]}' outside {interval}"


def constants(case: AssemblyCase) -> Iterator[str]:
    """α and γ_a of A, β_HF and γ_b of B are of a moderate ratio.

    Norms of V that bound A from both sides, such as energy and H¹ norms, have a ratio γ_a/α that does not depend on the
    mesh. Diagonal matrices in their place have one of O(h⁻²), and so have a mass matrix and any norm without gradients;
    one in another order of the unknowns has a larger one. The ratio is compared with that of the diagonal of A.
    """
    where, arrays = next(iter(case.results.items()))
    A, V, W = arrays["A"], case.plugin.V, case.plugin.W
    lowest, highest = extreme_quotients(A, V)
    yield Note(f"{where}: α = {lowest:.3g}, γ_a = {highest:.3g}")
    low, high = extreme_quotients(A, InnerProduct(sp.diags_array(A.diagonal(), format="csc")))
    ratio, diagonal = highest / lowest, high / low
    # A good norm stays below this fraction already on coarse meshes; a ratio up to 10 is never doubted.
    if ratio > max(10.0, 0.8 * diagonal):
        yield Doubt(
            f"γ_a/α = {ratio:.2g}, as large as with the diagonal of A in place of X_V ({diagonal:.2g}): probably X_V "
            "has the unknowns in another order than A, or is a norm without gradients, such as a mass matrix"
        )
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


def high_fidelity_solution(case: AssemblyCase) -> Iterator[str]:
    """High-fidelity solutions exist; their multipliers lie in W⁺ and are not all zero."""
    mus, solver = training_parameters(case.plugin), active_set.HighFidelitySolver(case.plugin)
    solved: list[active_set.HighFidelitySolution] = []
    contacts = 0
    # Five evenly spread parameters; those between them only while no constraint is active.
    spread = [k for count in (5, 50) for k in np.linspace(0, len(mus) - 1, count).round().astype(int)]
    least = min(5, case.points)
    for k in dict.fromkeys(spread):
        if len(solved) >= least and (contacts or case.late):
            break
        try:
            answer = solver.solve(mus[k].copy())
        except NumericalError as error:
            raise ConformanceError(f"no solution {at(mus[k])}: {error}") from error
        # Exactly: the active set method leaves no negative multipliers.
        if np.min(answer.lam) < 0.0:
            yield f"the multiplier is not in W⁺ {at(mus[k])}: entry {np.argmin(answer.lam)} is {np.min(answer.lam):.1e}"
            return
        solved.append(answer)
        contacts += bool(np.any(answer.lam > 0.0))
    if not contacts:
        yield (
            f"no constraint is active at any of {len(solved)} training parameters, so that all multipliers are zero; "
            "check that B u ≤ g is the admissible side"
        )
    elif all(np.all(each.lam > 0.0) for each in solved):
        yield Doubt(
            f"every constraint is active at each of {len(solved)} training parameters; check the signs of B and g"
        )
    worst, fallbacks = max(each.residuals.worst for each in solved), sum(bool(each.fallback) for each in solved)
    initial = f", {fallbacks} started from an interior-point solution" if fallbacks else ""
    yield Note(f"residuals up to {worst:.0e}, contact at {contacts} of {len(solved)} parameters{initial}")


def interpolation(case: AssemblyCase) -> Iterator[str]:
    """Interpolated members are also right at parameters outside the training set."""
    problem, mus = case.plugin, training_parameters(case.plugin)
    names = [name for name in MEMBERS if name in problem.entrywise - problem.constant - set(problem.affine)]
    # A quarter of the time is left to this check.
    if not names or case.one_assembly * (len(mus) + 5) > 0.25 * case.seconds:
        yield Note("an assembly takes too long" if names else "no member is interpolated")
        return
    assembled = assembled_members(problem, [*mus, *validation_parameters(problem, 5, seed=0)], names)
    for name, values in assembled.items():
        member = decomposed(name, values[: len(mus)], problem.V, INTERPOLATION_RTOL, contact=problem.has_contact)
        if not member.terms:
            yield Note(f"{name} is not interpolated: {member.reason or 'its terms are too many'}")
            continue
        error = held_out_error(name, member, values[len(mus) :], problem.V)
        yield Note(f"{name}: {len(member.terms)} terms, error {error:.0e}")
        if error > MISSED * INTERPOLATION_RTOL:
            yield Doubt(
                f"{name}, interpolated over {len(mus)} training parameters to {INTERPOLATION_RTOL:g}, has an error of "
                f"{error:.1e} at validation parameters: reduced assembly needs more training parameters"
            )


def pictures(case: AssemblyCase) -> Iterator[str]:
    """`diagnostics` are finite numbers; `picture` and `mesh_fields` are well formed and leave the solution as it is."""
    mu = training_parameters(case.plugin)[0]
    for name, value in case.plugin.diagnostics(mu.copy()).items():
        if not isinstance(name, str) or not np.isscalar(value) or not np.isfinite(float(value)):  # type: ignore[arg-type]
            yield f"diagnostics returns {value!r} for {name!r} {at(mu)}; expected a finite number for a name"
    solved = active_set.HighFidelitySolver(case.plugin).solve(mu.copy())
    u, lam = solved.u.copy(), solved.lam.copy()
    picture = unmutated("picture", {"u": u, "lam": lam}, lambda: case.plugin.picture(mu.copy(), u, lam))
    if picture is None:
        yield Note("no picture")
    elif not isinstance(picture, Picture):
        yield f"picture returns a {type(picture).__name__}; expected a vibench.Picture or None"
    elif faults := list(_picture_faults(picture, len(lam))):
        yield from faults
        return
    mesh = unmutated("mesh_fields", {"u": u, "lam": lam}, lambda: case.plugin.mesh_fields(mu.copy(), u, lam))
    if isinstance(mesh, MeshFields):
        yield from (f"mesh_fields.{fault}" for fault in mesh.faults())
        yield Note(", ".join(f"{len(corners)} {name}" for name, corners in mesh.cells.items()))
    elif mesh is not None:
        yield f"mesh_fields returns a {type(mesh).__name__}; expected a vibench.MeshFields or None"


def _picture_faults(picture: Picture, m: int) -> Iterator[str]:
    count, line = np.shape(picture.points)[-1], np.shape(picture.points)[:1] == (1,)
    expected = {"points": (1 if line else 2, count), "values": (count,), "multiplier": (m,),
                "positions": (1 if np.shape(picture.positions)[:1] == (1,) else 2, m)}  # fmt: skip
    for name, shape in expected.items():
        if fault := array_fault(f"picture.{name}", getattr(picture, name), shape):
            yield fault
    triangles = np.zeros((3, 0), dtype=int) if line else np.asarray(picture.triangles)
    if triangles.ndim != 2 or len(triangles) != 3 or not np.issubdtype(triangles.dtype, np.integer):
        yield f"picture.triangles has dtype {triangles.dtype} and shape {triangles.shape}; expected indices (3, t)"
    elif triangles.size and (triangles.min() < 0 or triangles.max() >= count):
        yield f"picture.triangles refers to points {triangles.min()} to {triangles.max()}; there are {count}"


def quantities_of_interest(case: AssemblyCase) -> Iterator[str]:
    """Quantities of interest have names and units, and finite values that a second call repeats."""
    declared, mu = case.plugin.outputs, training_parameters(case.plugin)[:1]
    strange = [type(one).__name__ for one in declared if not isinstance(one, Output)]
    if strange:
        yield f"outputs holds a {strange[0]}; expected objects of vibench.Output"
        return
    for one in declared:
        if not all(isinstance(text, str) and text.strip() for text in (one.name, one.unit)):
            yield f"an output has the name {one.name!r} and the unit {one.unit!r}; expected texts, '1' for a number"
    names = [one.name for one in declared]
    if len(set(names)) < len(names):
        yield f"two outputs have the same name: {', '.join(map(str, names))}"
    solved = active_set.HighFidelitySolver(case.plugin).solve(mu[0].copy())
    u, lam = solved.u[:, None], solved.lam[:, None]
    for one, again in zip(declared, case.plugin.outputs, strict=True):
        # A reduced solution may have no contact.
        for columns in ((u, lam), (0.0 * u, 0.0 * lam)):
            if one.values(mu, *columns) != again.values(mu, *columns):
                yield f"the output '{one.name}' differs in a second call {at(mu[0])}"
    yield Note(f"{', '.join(names)}" if names else "no outputs")


class ProblemCase(AssemblyCase):
    """A problem under examination."""

    checks = (
        Check("construction", AssemblyCase.construction),
        Check("options", AssemblyCase.options, ("construction",)),
        Check("spaces", spaces, ("construction",)),
        Check("parameters", parameters, ("construction",)),
        Check("training set", training_set, ("parameters",)),
        Check("validation set", validation_set, ("parameters",)),
        Check("one assembly", assembly.one_assembly, ("spaces", "parameters")),
        Check("assembly", assembly.assembly, ("one assembly",)),
        Check("no mutation", assembly.no_mutation, ("assembly",)),
        Check("symmetry of A", assembly.symmetry, ("assembly",)),
        Check("definiteness of A", assembly.definiteness, ("symmetry of A",)),
        Check("determinism", AssemblyCase.determinism, ("assembly",)),
        Check("another process", AssemblyCase.another_process, ("determinism",)),
        Check("coercivity and inf-sup", constants, ("definiteness of A", "determinism")),
        Check("independence of mu", assembly.independence, ("determinism",)),
        Check("continuity in mu", assembly.continuity, ("independence of mu",)),
        Check("assembly on the contact", assembly.on_contact, ("determinism",)),
        Check("affine sums", assembly.affine, ("determinism",)),
        Check("assembly by entries", assembly.by_entries, ("determinism",)),
        Check("assembly by elements", assembly.by_elements, ("determinism",)),
        Check("interpolation", interpolation,
              ("training set", "validation set", "independence of mu", "assembly by entries")),
        Check("pickling", AssemblyCase.pickling, ("determinism",)),
        Check("high-fidelity solution", high_fidelity_solution,
              ("training set", "definiteness of A", "independence of mu", "assembly on the contact")),
        Check("picture and diagnostics", pictures, ("high-fidelity solution",)),
        Check("outputs", quantities_of_interest, ("high-fidelity solution",)),
        Check("time", AssemblyCase.duration, ("assembly",)),
    )  # fmt: skip
