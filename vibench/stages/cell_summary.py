"""The columns of a cell that are means, extremes and counts over its queries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vibench.arrays import Array
from vibench.model.errors import UNMEASURABLE
from vibench.qp.status import Status
from vibench.stages.base import Row


def summarise(rows: Sequence[Row]) -> Row:
    """The columns of a cell from those of its queries; means and maxima are over the queries with status ok."""
    fine = [row for row in rows if row["status"] == Status.OK]
    worst = max((Status(row["status"]) for row in rows), key=lambda status: status.severity)

    def mu(row: Row) -> str:
        return ", ".join(f"{row[name]:.4g}" for name in sorted(row) if name.startswith("mu_"))

    reasons = [f"mu=({mu(row)}): {row['reason']}" for row in rows if row["status"] == worst and row["reason"]]

    def column(name: str, among: Sequence[Row] = fine) -> Array:
        return np.array([row[name] for row in among if row.get(name) is not None], dtype=float)

    def mean(name: str) -> float | None:
        return float(column(name).mean()) if column(name).size else None

    def median(name: str) -> float | None:
        return float(np.median(column(name))) if column(name).size else None

    def largest(name: str, among: Sequence[Row] = fine) -> float | None:
        values = column(name, among)
        return float(values.max()) if values.size else None

    def smallest(name: str) -> float | None:
        return min((row[name] for row in rows if row.get(name) is not None), default=None)

    def fraction(source: str, name: str) -> float | None:
        # A quotient of means: that of single queries is noise where their errors are near round-off.
        measured = [row for row in fine if row.get(f"{source}_error_{name}") is not None]
        whole = sum(row[f"error_{name}"] for row in measured)
        measurable = whole > UNMEASURABLE * len(measured)
        return float(sum(row[f"{source}_error_{name}"] for row in measured) / whole) if measurable else None

    def contributions(source: str) -> Row:
        shares = [part for name in ("u", "lambda") if (part := fraction(source, name)) is not None]
        names = (f"{source}_error_u", f"{source}_error_lambda", f"{source}_share")
        return {f"{name}_max": largest(name) for name in names} | {f"{source}_share_mean": max(shares, default=None)}

    def errors(name: str) -> Row:
        # A query whose high-fidelity solution is zero has no relative error. Such queries are counted, and their
        # largest error on the scale of the training set has a column of its own.
        zero = [row for row in fine if row.get(f"zero_{name}")]
        return {
            f"error_{name}_mean": mean(f"error_{name}"),
            f"error_{name}_max": largest(f"error_{name}"),
            f"queries_zero_{name}": len(zero),
            f"error_{name}_zero_max": largest(f"error_{name}_scaled", zero),
        }

    bounds = (
        "u_energy", "u", "lambda_natural", "lambda", "online_u_energy", "online_lambda_natural", "online_lambda",
        "hsw_u", "hsw_lambda",
    )  # fmt: skip
    violated = column("bound_online_violated")
    residuals = [largest(name) for name in ("primal_residual", "dual_residual", "gap")]
    hf_residuals = [largest(name) for name in ("hf_primal_residual", "hf_dual_residual", "hf_gap")]
    return {
        "status": worst.value,
        "reason": f"{len(reasons)} of {len(rows)} queries, first {reasons[0]}" if reasons else "",
        "queries": len(rows),
        "queries_ok": len(fine),
        **errors("u"),
        **errors("lambda"),
        **{f"effectivity_{name}_median": median(f"effectivity_{name}") for name in bounds},
        "corrected_share": mean("corrected"),
        "reference_bound_max": largest("reference_bound", rows),
        # Zero violations are a result only of a cell with bounds.
        "bound_online_violations": int(violated.sum()) if violated.size else None,
        **contributions("solver"),
        **contributions("assembly"),
        "assembly_error_max": largest("assembly_error"),
        "violation_max": largest("violation"),
        "hf_residual_max": max((r for r in hf_residuals if r is not None), default=None),
        "error_u_predicted_mean": mean("error_u_predicted"),
        "residual_max": max((r for r in residuals if r is not None), default=None),
        "beta_span_min": smallest("beta_span"),
        "beta_cone_lower_min": smallest("beta_cone_lower"),
        "beta_cone_upper_min": smallest("beta_cone_upper"),
    }
