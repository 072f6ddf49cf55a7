"""Export of a reduced model: one file with its operators, its bounds in C, and a runtime that needs no vibench."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from vibench.errors import RequestError
from vibench.files import write_atomically, writing
from vibench.library.fmu import fmu
from vibench.library.reduced_model import FORMAT, SOLVERS
from vibench.model.bound_terms import CorrectionMode
from vibench.model.chebyshev import AffinePolynomial
from vibench.offline.exported import ExportedModel, exported, linear_outputs
from vibench.offline.models import Model
from vibench.offline.polynomials import EVALUATIONS, TOLERANCE
from vibench.provenance import distribution_version
from vibench.qp.settings import SETTINGS
from vibench.signatures import AtLeastOne, Share, bordered
from vibench.study.cells import Cell


@bordered
def export_model(
    model: Model,
    file: Path | str,
    tolerance: Share = TOLERANCE,
    evaluations: AtLeastOne = EVALUATIONS,
    bases: bool = True,
    c: bool = False,
) -> ExportedModel:
    """Write a reduced model to `file`, its runtime beside it and, if asked, its C source.

    Parameters
    ----------
    model
        The model.
    file
        Its name ends in .npz, or in .fmu: an FMU (FMI 2.0, co-simulation) is one file with the C source and no bases.
    tolerance
        Largest relative error of the polynomials that take the place of A, f, B and g.
    evaluations
        Points of the largest grid of parameters at which these are evaluated; four times as many of coefficients.
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
    if file.suffix not in {".npz", ".fmu"}:
        raise RequestError(f"'{file}': the model is written as an npz file, whose name must end in .npz, or .fmu")
    if file.parent.exists() and not file.parent.is_dir():
        raise RequestError(f"'{file.parent}' is no folder")
    # The script that is written beside arrays evaluates them without vibench.
    script, sources = file.with_name("reduced_model.py"), [file.with_suffix(end) for end in (".c", ".h") if c]
    contents = {script: (files("vibench.library") / script.name).read_bytes()}
    if is_fmu := file.suffix == ".fmu":
        bases, c, sources, contents = False, True, [], {}
    for path in (file, *sources):
        if path.exists():
            raise RequestError(f"'{path}' exists; remove it, or choose another name")
    if contents and script.exists() and (not script.is_file() or script.read_bytes() != contents[script]):
        raise RequestError(f"'{script}' exists and is not the runtime of this version; choose another folder")
    found = exported(model, tolerance, evaluations, bases, c)
    found = replace(found, about={**found.about, **_about(model, found.members)})
    given = found.arrays, found.about, file.stem
    texts = list(found.source(file.stem) if c else ())
    if found.code is not None:  # the script does not evaluate it
        contents.pop(script, None)
    # The modes stand in the order of the numbers that the certificate in C takes.
    contents[file] = fmu(texts[0], *given, [*CorrectionMode].index(model.correction)) if is_fmu else _npz(found)
    contents |= {path: text.encode() for path, text in zip(sources, texts, strict=False)}
    # All contents are computed before the first is written: a failure leaves no file.
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        for path, content in contents.items():
            write_atomically(path, content)
    return found


def _about(model: Model, members: Mapping[str, AffinePolynomial]) -> dict[str, Any]:
    """The texts of the file: parameters, solver, errors, provenance."""
    # Columns of the cell that are repeated.
    recorded = (
        "cell", "problem", "problem_options", "training", "training_options", "dual", "dual_options", "primal",
        "primal_options", "pod_tol", "pod_size", "dual_tol", "dual_size", "primal_tol", "solver", "accuracy",
        "assembly", "bounds", "correction", "queries", "queries_ok", "snapshots", "N", "R", "enrichment",
        "error_u_mean", "error_u_max", "error_lambda_mean", "error_lambda_max", "assembly_error_max", "seed",
        "validation", "validation_options", "code", "versions", "definition",
    )  # fmt: skip
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
        # The file cannot hold outputs that code computes: it names them.
        "outputs": {
            "linear": [{"name": output.name, "unit": output.unit} for output in linear_outputs(model.problem)],
            "left_out": [output.name for output in model.problem.outputs if not output.linear],
        },
        # A model of no run has the name of its problem alone.
        "cell": {"problem": type(model.problem).__name__} | {n: _plain(row[n]) for n in recorded if n in row},
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
    # The script refuses bases without members.
    kind = FORMAT if model.code is None else "vibench bases 1"
    arrays: dict[str, Any] = {"format": np.array(kind), "about": np.array(json.dumps(dict(model.about)))}
    # the script bounds no errors, and of a certificate only the C source needs more than its `lift`
    left_out = {n for n in model.arrays if n.startswith(("certificate_", "start_")) and n != "certificate_lift"}
    arrays |= {name: array for name, array in model.arrays.items() if name not in left_out}
    for name, member in model.members.items():
        arrays |= {f"{name}_indices": member.indices, f"{name}_coefficients": member.coefficients}
        arrays |= {f"{name}_terms": member.terms}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()
