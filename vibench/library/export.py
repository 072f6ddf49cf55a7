"""Export of a reduced model: one file with its operators, and a runtime that needs no vibench."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import PackageNotFoundError, metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError, in_a_line, requested
from vibench.files import write_atomically, writing
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.interfaces.validation import training_parameters
from vibench.library import c_source, exported_certificate, exported_outputs
from vibench.library.reduced_model import FORMAT, SOLVERS
from vibench.model.affine import affine_decomposition, check_affine
from vibench.model.certificates.base import Guarantee, contact_unknowns
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.chebyshev import AffinePolynomial, interpolate_on_box
from vibench.model.hyperreduced import HyperReducedModel, hyper_reduce
from vibench.offline.models import AnyReducedModel, Model
from vibench.provenance import distribution_version
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import MARGIN
from vibench.study.cells import Cell

RUNTIME = "reduced_model.py"
"""The runtime, written beside the exported files."""

BOUNDS = "reduced_model_certificate.py"
"""The same with error bounds, written where there are some."""

TOLERANCE = 1e-11
"""Largest relative error of a polynomial where nothing else is asked for; solutions then agree to 1e-9 and better."""

EVALUATIONS = 4096
"""Points of the largest grid on which the members are interpolated, where nothing else is asked for."""

RECORDED = (
    "cell", "problem", "problem_options", "training", "training_options", "dual", "dual_options", "primal",
    "primal_options", "pod_tol", "pod_size", "dual_tol", "dual_size", "primal_tol", "solver", "accuracy", "assembly",
    "correction", "queries", "queries_ok", "snapshots", "N", "R", "enrichment", "error_u_mean", "error_u_max",
    "error_lambda_mean", "error_lambda_max", "assembly_error_max", "seed", "validation", "validation_options", "code",
    "versions", "definition",
)  # fmt: skip
"""Columns of the cell that an exported model repeats."""


@dataclass(frozen=True)
class ExportedModel:
    """A reduced model as an exported file holds it.

    Attributes
    ----------
    members
        A as packed upper triangle (row by row), f, B and g, as polynomials on the parameter box.
    arrays
        The other arrays of the file.
    about
        Everything else in it.
    thetas
        What the certificate evaluates at a parameter, if there is one.
    """

    members: Mapping[str, AffinePolynomial]
    arrays: Mapping[str, Array]
    about: Mapping[str, Any]
    thetas: Mapping[str, AffinePolynomial] = field(default_factory=dict)

    @property
    def error(self) -> float:
        """Largest relative error of a member at random parameters."""
        return max(found.error for found in (*self.members.values(), *self.thetas.values()))


@requested
def export_model(
    model: Model,
    file: Path | str,
    tolerance: float = TOLERANCE,
    evaluations: int = EVALUATIONS,
    bases: bool = True,
    c: bool = False,
) -> ExportedModel:
    """Write a reduced model to `file`, its runtime beside it and, if asked, its C source.

    Parameters
    ----------
    model
        The model.
    file
        Its name ends in .npz.
    tolerance
        Largest relative error of the polynomials that take the place of A, f, B and g.
    evaluations
        Points of the largest grid of parameters at which these are evaluated.
    bases
        Whether the file has the primal basis and the generators, from which u and λ are reconstructed.
    c
        Whether to write a C99 source and its header, under the same name, too.

    Raises
    ------
    RequestError
        If polynomials do not reach the tolerance, the model has no form of this kind, or a file exists.
    """
    file = Path(file)
    if file.suffix != ".npz":
        raise RequestError(f"'{file}': the model is written as an npz file, whose name must end in .npz")
    if not 0.0 < tolerance < 1.0:
        raise RequestError(f"the tolerance of the interpolation is {tolerance:g}, expected a number between 0 and 1")
    if evaluations < 1:
        raise RequestError(f"evaluations is {evaluations}, expected a number of parameters")
    if file.parent.exists() and not file.parent.is_dir():
        raise RequestError(f"'{file.parent}' is no folder")
    scripts = [RUNTIME] if exported_certificate.reason_for_none(model.certificate) else [RUNTIME, BOUNDS]
    runtime = {file.with_name(name): (files("vibench.library") / name).read_bytes() for name in scripts}
    sources = [file.with_suffix(".c"), file.with_suffix(".h")] if c else []
    _refuse_to_overwrite([file, *sources], runtime)
    found = exported(model, tolerance, evaluations, bases, c)
    contents = {file: _npz(found), **runtime}
    if c:
        texts = c_source.source(found.members, found.arrays, found.about, file.stem, found.thetas)
        contents |= {path: text.encode() for path, text in zip(sources, texts, strict=True)}
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        for path, content in contents.items():
            write_atomically(path, content)
    return found


def _refuse_to_overwrite(new: list[Path], scripts: Mapping[Path, bytes]) -> None:
    """Refuse files that exist, but for scripts with the same content."""
    for path in new:
        if path.exists():
            raise RequestError(f"'{path}' exists; remove it, or choose another name")
    for script, content in scripts.items():
        if script.exists() and (not script.is_file() or script.read_bytes() != content):
            raise RequestError(f"'{script}' exists and is not the runtime of this version; choose another folder")


def exported(
    model: Model, tolerance: float = TOLERANCE, evaluations: int = EVALUATIONS, bases: bool = True, c: bool = False
) -> ExportedModel:
    """The model as `export_model` writes it."""
    box = model.parameters
    why = exported_certificate.reason_for_none(model.certificate)
    certificate = None if why else model.certificate
    try:
        queried = declared_model(model.reduced)
        if c and isinstance(queried, HyperReducedModel) and queried.space is not None:
            raise RequestError("the enrichment changes the basis at every parameter; C sources are for fixed bases")
        first = members_of(queried, box.lower, coefficients_of(queried, box.lower))
        if not len(first.f) or not len(first.g):
            raise RequestError("the model has no unknowns or no constraints")
        terms = declared_terms(queried)
        evaluate = partial(_evaluated, queried, len(first.f), frozenset(terms), certificate)
        polynomials = interpolate_on_box(evaluate, box.lower, box.upper, tolerance, evaluations, terms=terms)
    except NumericalError as error:
        raise RequestError(f"the model cannot be evaluated in the whole parameter box: {error}") from None
    except (ArithmeticError, ValueError, LookupError) as error:  # what the code of a problem raises
        raise RequestError(f"the model cannot be evaluated in the whole parameter box: {in_a_line(error)}") from None
    _refuse_inaccurate(polynomials, tolerance, evaluations)
    members = {name: polynomials.pop(name) for name in MEMBERS}
    about = _about(model, members) | {"certificate": Guarantee.NONE.value, "no_bounds": why}
    arrays = {"lower": box.lower, "upper": box.upper}
    if isinstance(queried, HyperReducedModel) and queried.space is not None:
        arrays["plain"] = queried.space.plain
    basis = queried.basis if isinstance(queried, HyperReducedModel) else queried.fixed_basis
    if bases:
        arrays |= {"basis": basis, "generators": queried.generators}
    arrays |= exported_outputs.arrays(model, basis, queried.generators, certificate)
    if certificate is not None:
        unknowns = contact_unknowns(model.problem) if bases else None
        arrays |= exported_certificate.arrays(certificate, polynomials | members, unknowns)
        about["certificate"] = exported_certificate.guarantee(certificate, model.problem.constant).value
    return ExportedModel(members, arrays, about, polynomials)


def declared_model(queried: AnyReducedModel) -> AnyReducedModel:
    """The model without high-fidelity assembly where its problem declares all members constant or affine sums.

    Their terms are projected, whatever the assembly of the cell was; any other model is returned as it is.

    Raises
    ------
    NumericalError
        If a declared sum differs from the assembled member.
    """
    if isinstance(queried, HyperReducedModel):
        return queried
    problem = queried.problem
    training = training_parameters(problem)
    if queried.enrichment.supply is not None or not set(MEMBERS) <= {*problem.constant, *problem.affine}:
        check_affine(problem, training)
        return queried
    members = affine_decomposition(problem, training, tolerance=TOLERANCE)  # nothing is left to interpolate
    return HyperReducedModel(queried, hyper_reduce(queried, members))


def declared_terms(queried: AnyReducedModel) -> dict[str, Array]:
    """Flat terms (Q×size) of the members declared affine, of A packed upper triangles, on a fixed space."""
    if isinstance(queried, HyperReducedModel):
        return queried.declared_terms()
    Z, chi, problem = queried.fixed_basis, queried.generators, queried.problem
    upper = np.triu_indices(Z.shape[1])
    projected: Mapping[str, Callable[[Any], Array]] = {
        "A": lambda term: (0.5 * (Z.T @ (term @ Z) + (Z.T @ (term @ Z)).T))[upper],
        "f": lambda term: Z.T @ term,
        "B": lambda term: chi.T @ (term @ Z),
        "g": lambda term: chi.T @ term,
    }
    declared = {name: sums for name, sums in problem.affine.items() if name not in problem.constant}
    return {name: np.stack([np.ravel(projected[name](t)) for t in sums.terms]) for name, sums in declared.items()}


def coefficients_of(queried: AnyReducedModel, mu: Array) -> Mapping[str, Array]:
    """θ (Q,) at a parameter of the members that are sums of terms, as far as the model evaluates them."""
    if isinstance(queried, HyperReducedModel):
        return queried.coefficients(mu)
    problem = queried.problem
    return {name: sums.coefficients(mu) for name, sums in problem.affine.items() if name not in problem.constant}


def members_of(queried: AnyReducedModel, mu: Array, theta: Mapping[str, Array]) -> VariationalInequality:
    """A, f, B, g at a parameter with these coefficients, on a space that does not depend on it.

    Raises
    ------
    RequestError
        If the model has no such space.
    """
    if isinstance(queried, HyperReducedModel):
        return queried.members(mu, theta)
    if queried.kind is Kind.PER_PARAMETER:
        raise RequestError(
            "the enrichment changes the basis at every parameter, the cell assembles in full, and its problem does not "
            'declare all members constant or affine; export the same cell with assembly = "reduced"'
        )
    return queried.assemble(mu).program


def _evaluated(
    queried: AnyReducedModel, size: int, declared: frozenset[str], certificate: OnlineCertificate | None, mu: Array
) -> dict[str, Array]:
    """The members as flat arrays, of declared affine ones θ; and what the certificate evaluates."""
    theta = coefficients_of(queried, mu)
    found = _packed(queried, size, mu, theta)
    beside = {} if certificate is None else exported_certificate.thetas(certificate, theta)
    return found | {name: theta[name] for name in declared} | beside


def _packed(queried: AnyReducedModel, size: int, mu: Array, theta: Mapping[str, Array]) -> dict[str, Array]:
    """The members as flat arrays; of A the upper triangle."""
    found = members_of(queried, mu, theta)
    if len(found.f) != size:
        raise RequestError(f"the reduced program has {len(found.f)} unknowns at mu = {mu.tolist()}, {size} elsewhere")
    arrays = {name: np.asarray(getattr(found, name)) for name in MEMBERS}
    arrays["A"] = 0.5 * (arrays["A"] + arrays["A"].T)[np.triu_indices(size)]
    if not all(np.all(np.isfinite(array)) for array in arrays.values()):
        raise NumericalError(f"it has entries that are not finite at mu = {mu.tolist()}")
    return {name: array.ravel() for name, array in arrays.items()}


def _refuse_inaccurate(members: Mapping[str, AffinePolynomial], tolerance: float, evaluations: int) -> None:
    missed = {name: member for name, member in members.items() if member.error > tolerance}
    if not missed:
        return
    worst = max(missed, key=lambda name: missed[name].error)
    error, degrees = missed[worst].error, ", ".join(map(str, missed[worst].degrees))
    raise RequestError(
        f"{worst} depends on mu through the code of the problem, which the file cannot hold, and polynomials of degree "
        f"({degrees}) reach a relative error of {error:.1e}, not {tolerance:.0e}; `--interpolate {1.05 * error:.1e}` "
        f"exports this approximation, more `--evaluations` than {evaluations} may reach a better one"
    )


def _about(model: Model, members: Mapping[str, AffinePolynomial]) -> dict[str, Any]:
    """What the file says in words: parameters, solver, errors, provenance."""
    box, row, accuracy, solver = model.parameters, model.row, model.accuracy, model.solver
    definition = row.get("definition")  # none of a model that is of no run
    origin = Cell.from_definition(str(definition)).problem.registered.origin if definition else ""
    return {
        "parameters": {"names": list(box.names), "units": list(box.units)},
        "solver": solver if solver in SOLVERS else next(iter(SOLVERS)),
        "settings": {name: SETTINGS[name].at(MARGIN * accuracy) for name in SOLVERS},
        "accuracy": accuracy,
        "members": {
            name: {"degrees": list(member.degrees), "terms": len(member.terms), "error": member.error}
            for name, member in members.items()
        },
        "outputs": exported_outputs.descriptions(model.problem),
        "cell": {name: _plain(row[name]) for name in RECORDED if name in row},
        "exported_by": f"vibench {distribution_version('vibench')}",
        "source": {"distribution": origin, "licence": model.problem.licence or _licence(origin.partition(" ")[0])},
    }


def _plain(value: Any) -> Any:
    """A value of a row as JSON can hold it."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _licence(distribution: str) -> str:
    """Licence that a distribution declares."""
    try:
        declared = metadata(distribution)
    except PackageNotFoundError:
        return "unknown"
    return next((str(declared[key]) for key in ("License-Expression", "License") if key in declared), "unknown")


def _npz(model: ExportedModel) -> bytes:
    arrays: dict[str, Any] = {"format": np.array(FORMAT), "about": np.array(json.dumps(dict(model.about)))}
    arrays |= model.arrays
    for name, member in (*model.members.items(), *model.thetas.items()):
        arrays |= {f"{name}_indices": member.indices, f"{name}_coefficients": member.coefficients}
        arrays |= {f"{name}_terms": member.terms}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()
