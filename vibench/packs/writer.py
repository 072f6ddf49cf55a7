"""Writing a model pack of any problem: constants and affine sums as it declares them, else one array per parameter."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.files import scratch
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.dual_sets import BlockKind, refuse_blocks
from vibench.interfaces.problem import MEMBERS, Problem
from vibench.interfaces.validation import checked_assembly, training_parameters, validation_parameters
from vibench.packs.manifest import FILE


def write_pack(
    problem: Problem, folder: Path, *, name: str, source: str, validation: int, seed: int, solutions: bool = False
) -> None:
    """Write a pack of a problem at its training set and its validation set into a new folder, whole or not at all."""
    # The manifest has `name` and `source`. `validation` parameters are drawn with `seed`; with `solutions` the problem
    # is solved at every parameter. Raises a `RequestError` if the folder exists.
    training = training_parameters(problem)
    listed = np.vstack([training, validation_parameters(problem, validation, seed)])
    with _new_folder(folder) as part:
        lines = ["format = 1", f"name = {toml_text(name)}", f"source = {toml_text(source)}", ""]
        box = problem.parameters
        _save(part / "parameters.npz", {"training": training, "validation": listed[len(training) :]})
        names, units = (", ".join(map(toml_text, texts)) for texts in (box.names, box.units))
        lines += ["[parameters]", f"names = [{names}]", f"units = [{units}]"]
        lines += [f"lower = {box.lower.tolist()}", f"upper = {box.upper.tolist()}"]
        lines += [f'{role} = "parameters.npz:{role}"' for role in ("training", "validation")] + [""]
        lines += _space_table(problem, part) + _operator_table(problem, listed, part) + _dual_set_tables(problem, part)
        if solutions:
            exact = list(map(HighFidelitySolver(problem).solve, listed))
            u, lam = (np.column_stack([getattr(one, name) for one in exact]) for name in ("u", "lam"))
            _save(part / "solutions.npz", {"u": u, "lam": lam})
            lines += ["[solutions]", 'u = "solutions.npz:u"', 'lam = "solutions.npz:lam"', ""]
        lines += _output_tables(problem, part)
        explanation = [
            "# u = argmin ½ uᵀA u − fᵀu subject to B u ≤ g, with A u + Bᵀλ = f and λ ≥ 0, on the free unknowns.",
            "# Listed parameters are numbered from 0: those of the training set, then those of the validation set.",
        ]
        if problem.K.blocks:
            explanation.insert(1, "# Rows of K are no inequalities: |λ| ≤ radius there, and λ maximises λᵀ(B u − g).")
        (part / FILE).write_text("\n".join([*explanation, *lines]) + "\n", encoding="utf-8")


@contextlib.contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder beside the one that is wanted, which takes its name at the end of the block."""
    if folder.is_symlink() or folder.exists():
        raise RequestError(f"'{folder}' exists; a pack is written into a new folder")
    if not folder.absolute().parent.is_dir():
        raise RequestError(f"'{folder.absolute().parent}' is not a folder")
    with scratch(folder.absolute().parent) as temporary:
        part = temporary / "pack"
        part.mkdir()
        yield part
        # At once: a folder of this name is complete, whenever the program stops.
        part.rename(folder)


def _space_table(problem: Problem, part: Path) -> list[str]:
    arrays: dict[str, Any] = {"X_V": problem.V.matrix, "X_W": problem.W.matrix}
    if problem.contact_dofs is not None:
        arrays["contact"] = problem.contact_dofs
    if type(problem).multiplier_integrals is not Problem.multiplier_integrals:
        arrays["integrals"] = problem.multiplier_integrals()
    _save(part / "spaces.npz", arrays)
    return ["[spaces]", *(f'{name} = "spaces.npz:{name}"' for name in arrays), ""]


def _operator_table(problem: Problem, listed: Array, part: Path) -> list[str]:
    arrays: dict[str, dict[str, Any]] = {name: {} for name in MEMBERS}
    # Without other members one assembly has all that is written.
    varies = not set(MEMBERS) <= {*problem.constant, *problem.affine}
    for k, mu in enumerate(listed if varies else listed[:1]):
        vi = checked_assembly(problem, mu)
        for name in MEMBERS:
            if name not in problem.affine and (k == 0 or name not in problem.constant):
                arrays[name][str(k)] = getattr(vi, name)
    entrywise = sorted((problem.entrywise | set(problem.affine)) - problem.constant)
    lines = ["[operators]", f"entrywise = [{', '.join(map(toml_text, entrywise))}]"]
    for name in MEMBERS:
        if name in problem.affine:
            # Its terms, and its coefficients at the listed parameters: functions have no place in a pack.
            declared = problem.affine[name]
            theta = np.column_stack([declared.coefficients(mu) for mu in listed])
            arrays[name] = {f"theta{q}": values for q, values in enumerate(theta)}
            arrays[name] |= {f"term{q}": term for q, term in enumerate(declared.terms)}
            entries = (f'{{ table = "{name}.npz:theta{q}", array = "{name}.npz:term{q}" }}' for q in range(len(theta)))
            line = f"{name}.affine = [{', '.join(entries)}]"
        else:
            line = f'{name} = "{name}.npz:0"' if name in problem.constant else f'{name}.each = "{name}.npz:{{}}"'
        _save(part / f"{name}.npz", arrays[name])
        lines.append(line)
    return [*lines, ""]


def _dual_set_tables(problem: Problem, part: Path) -> list[str]:
    """The tables of the rows whose multipliers are bounded."""
    refuse_blocks(problem.K, [BlockKind.INTERVAL], "a pack")
    lines: list[str] = []
    arrays: dict[str, Any] = {}
    for k, block in enumerate(problem.K.blocks):
        arrays |= {f"rows{k}": block.rows[:, 0], f"radius{k}": block.radii}
        lines += ["[[K]]", 'kind = "interval"', f'rows = "K.npz:rows{k}"', f'radius = "K.npz:radius{k}"', ""]
    if arrays:
        _save(part / "K.npz", arrays)
    return lines


def _output_tables(problem: Problem, part: Path) -> list[str]:
    """The tables of the linear outputs; a function has no place in a pack."""
    lines: list[str] = []
    arrays: dict[str, Array] = {}
    for k, output in enumerate(output for output in problem.outputs if output.linear):
        lines += ["[[outputs]]", f"name = {toml_text(output.name)}", f"unit = {toml_text(output.unit)}"]
        for key, values in (("u", output.u), ("lam", output.lam)):
            if values is not None:
                arrays[f"{key}{k}"] = values
                lines.append(f'{key} = "outputs.npz:{key}{k}"')
        lines.append("")
    if arrays:
        _save(part / "outputs.npz", arrays)
    return lines


def _save(file: Path, arrays: Mapping[str, Any]) -> None:
    """Write dense arrays, and the arrays of sparse matrices, their entries in their order."""
    parts: dict[str, Any] = {}
    for name, matrix in arrays.items():
        if isinstance(matrix, np.ndarray):
            parts[name] = matrix
            continue
        kept = matrix if matrix.format in ("csr", "csc") else sp.csr_array(matrix)
        parts |= {
            f"{name}/data": kept.data, f"{name}/indices": kept.indices, f"{name}/indptr": kept.indptr,
            f"{name}/shape": np.array(kept.shape), f"{name}/format": np.array(kept.format, dtype="S3"),
        }  # fmt: skip
    np.savez_compressed(file, allow_pickle=False, **parts)


def toml_text(value: str) -> str:
    """A text as a TOML string, which is one of JSON but for the character DEL."""
    return json.dumps(value).replace("\x7f", "\\u007f")
