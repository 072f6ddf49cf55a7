"""Export of a reduced model: one file with its operators, and a runtime that needs no vibench."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import PackageNotFoundError, metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError, requested
from vibench.files import write_atomically, writing
from vibench.interfaces.problem import MEMBERS
from vibench.library import exported_certificate
from vibench.library.reduced_model import FORMAT, SOLVERS
from vibench.model.certificates.base import Guarantee, contact_unknowns
from vibench.model.chebyshev import AffinePolynomial
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel
from vibench.offline import c_source
from vibench.offline.c_source import ExactMember
from vibench.offline.models import Model
from vibench.offline.polynomials import EVALUATIONS, TOLERANCE, InaccurateError, declared_terms, member_polynomials
from vibench.provenance import distribution_version
from vibench.qp.settings import SETTINGS
from vibench.study.cells import Cell

# The script that is written beside exported files.
RUNTIME = "reduced_model.py"

# Columns of the cell that an exported model repeats.
RECORDED = (
    "cell", "problem", "problem_options", "training", "training_options", "dual", "dual_options", "primal",
    "primal_options", "pod_tol", "pod_size", "dual_tol", "dual_size", "primal_tol", "solver", "accuracy", "assembly",
    "bounds",
    "correction", "queries", "queries_ok", "snapshots", "N", "R", "enrichment", "error_u_mean", "error_u_max",
    "error_lambda_mean", "error_lambda_max", "assembly_error_max", "seed", "validation", "validation_options", "code",
    "versions", "definition",
)  # fmt: skip


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
        Polynomials of the θ that the certificate evaluates at a parameter, if there is one.
    exact
        Members and θ of a C source whose coefficients are declared as expressions.
    """

    members: Mapping[str, AffinePolynomial]
    arrays: Mapping[str, Array]
    about: Mapping[str, Any]
    thetas: Mapping[str, AffinePolynomial] = field(default_factory=dict)
    exact: Mapping[str, ExactMember] = field(default_factory=dict)

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
    runtime = {file.with_name(RUNTIME): (files("vibench.library") / RUNTIME).read_bytes()}
    sources = [file.with_suffix(".c"), file.with_suffix(".h")] if c else []
    _refuse_to_overwrite([file, *sources], runtime)
    found = exported(model, tolerance, evaluations, bases, c)
    contents = {file: _npz(found), **runtime}
    if c:
        texts = c_source.source(found.members, found.arrays, found.about, file.stem, found.thetas, found.exact)
        contents |= {path: text.encode() for path, text in zip(sources, texts, strict=True)}
    # All contents are computed before the first is written: a failure leaves no file.
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
    if not why and not c:
        why = "only C programs have them; export to a name that ends in .c"
    certificate = None if why else model.certificate
    beside = None if certificate is None else partial(exported_certificate.thetas, certificate)
    rotated = {} if certificate is None else exported_certificate.rotated(certificate)
    try:
        queried, polynomials = member_polynomials(
            model.reduced, tolerance, evaluations, fixed=c, beside=beside, rotated=rotated
        )
    except InaccurateError as error:
        raise RequestError(
            f"{error}; `--tolerance {1.05 * error.error:.1e}` exports this approximation; more evaluations than "
            f"{evaluations}, an argument of `vibench.export_model`, may reach a better one"
        ) from None
    members = {name: polynomials.pop(name) for name in MEMBERS}
    about = _about(model, members) | {"certificate": Guarantee.NONE.value, "no_bounds": why}
    arrays = {"lower": box.lower, "upper": box.upper}
    if isinstance(queried, HyperReducedModel) and queried.space is not None:
        arrays["plain"] = queried.space.plain
    basis = queried.basis if isinstance(queried, HyperReducedModel) else queried.fixed_basis
    if bases:
        arrays |= {"basis": basis, "generators": queried.generators}
    arrays |= exported_certificate.output_arrays(model, basis, queried.generators, certificate)
    exact = exact_members(queried, members) if c else {}
    if certificate is not None:
        exact |= exported_certificate.exact_thetas(certificate, exact)
        unknowns = contact_unknowns(model.problem) if bases else None
        arrays |= exported_certificate.arrays(certificate, polynomials | members, exact, unknowns)
        about["certificate"] = exported_certificate.guarantee(certificate, {*model.problem.constant, *exact}).value
    return ExportedModel(members, arrays, about, polynomials, exact)


def exact_members(queried: AnyReducedModel, members: Mapping[str, AffinePolynomial]) -> dict[str, ExactMember]:
    """The members that a model evaluates by declared sums whose coefficients are all expressions."""
    sums = ((name, queried.problem.affine[name]) for name in declared_terms(queried))
    found = ((name, ExactMember.from_sum(declared, members[name].terms)) for name, declared in sums)
    return {name: member for name, member in found if member is not None}


def _about(model: Model, members: Mapping[str, AffinePolynomial]) -> dict[str, Any]:
    """What the file says in words: parameters, solver, errors, provenance."""
    box, row, accuracy, solver = model.parameters, model.row, model.accuracy, model.solver
    # A model that belongs to no run has no definition.
    definition = row.get("definition")
    origin = Cell.from_definition(str(definition)).problem.registered.origin if definition else ""
    return {
        "parameters": {"names": list(box.names), "units": list(box.units)},
        "solver": solver if solver in SOLVERS else next(iter(SOLVERS)),
        "settings": {name: SETTINGS[name].at(accuracy) for name in SOLVERS},
        "accuracy": accuracy,
        "members": {
            name: {"degrees": list(member.degrees), "terms": len(member.terms), "error": member.error}
            for name, member in members.items()
        },
        "outputs": exported_certificate.output_descriptions(model.problem),
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
    # A model of no run has no distribution; importlib refuses its empty name.
    except (PackageNotFoundError, ValueError):
        return "unknown"
    return next((str(declared[key]) for key in ("License-Expression", "License") if key in declared), "unknown")


def _npz(model: ExportedModel) -> bytes:
    arrays: dict[str, Any] = {"format": np.array(FORMAT), "about": np.array(json.dumps(dict(model.about)))}
    # the script bounds no errors, and of a certificate only the C source needs more than its `lift`
    arrays |= {
        name: array
        for name, array in model.arrays.items()
        if name == "certificate_lift" or not name.startswith("certificate_")
    }
    for name, member in model.members.items():
        arrays |= {f"{name}_indices": member.indices, f"{name}_coefficients": member.coefficients}
        arrays |= {f"{name}_terms": member.terms}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()
