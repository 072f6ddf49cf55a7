"""Errors of quantities of interest: those of reduced solutions against those of high-fidelity ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.outputs import Output
from vibench.model.errors import UNMEASURABLE
from vibench.qp.scaling import ratio

OutputErrors = dict[str, Any]
"""An output of one query: name and unit, `value`, `reference`, `error` (relative, `None` for a zero) and `scaled`."""


def scales(outputs: Sequence[Output], mus: Array, u: Array, lam: Array) -> tuple[float, ...]:
    """The largest absolute value of every output over solutions, those of the training set."""
    return tuple(float(np.max(np.abs(output.values(mus, u, lam)), initial=0.0)) for output in outputs)


def output_errors(
    outputs: Sequence[Output],
    mus: Array,
    reduced: tuple[Array, Array],
    reference: tuple[Array, Array],
    scale: Sequence[float],
) -> list[list[OutputErrors]]:
    """Every output at parameters (P×d), from solutions (u, λ) as columns, reduced ones and high-fidelity ones.

    An output that is at most `UNMEASURABLE` of its scale is zero: there is no contact, for instance. A relative error
    would divide round-off by round-off, and is `None`; the error over the scale is not.
    """
    found: list[list[OutputErrors]] = [[] for _ in mus]
    for output, largest in zip(outputs, scale, strict=True):
        pairs = zip(output.values(mus, *reduced), output.values(mus, *reference), strict=True)
        for row, (value, exact) in zip(found, pairs, strict=True):
            error = abs(float(value - exact))
            relative = None if abs(exact) <= UNMEASURABLE * largest else error / abs(float(exact))
            own = {"value": float(value), "reference": float(exact), "error": relative}
            row.append({"output": output.name, "unit": output.unit} | own | {"scaled": ratio(error, largest)})
    return found


def summarise_outputs(
    outputs: Sequence[Output], scale: Sequence[float], queries: Sequence[Sequence[OutputErrors]]
) -> list[Mapping[str, Any]]:
    """Rows of the outputs table of a cell: means and maxima over its ok queries, zeros counted apart."""
    rows: list[Mapping[str, Any]] = []
    for k, (output, largest) in enumerate(zip(outputs, scale, strict=True)):
        mine = [query[k] for query in queries]
        relative = [one["error"] for one in mine if one["error"] is not None]
        zero, scaled = [one["scaled"] for one in mine if one["error"] is None], [one["scaled"] for one in mine]
        rows.append({
            "output": output.name, "unit": output.unit, "linear": int(output.linear), "scale": largest,
            "queries_ok": len(mine), "error_mean": float(np.mean(relative)) if relative else None,
            "error_max": max(relative, default=None), "queries_zero": len(zero),
            "error_zero_max": max(zero, default=None),
            "error_scaled_mean": float(np.mean(scaled)) if scaled else None,
            "error_scaled_max": max(scaled, default=None),
        })  # fmt: skip
    return rows
