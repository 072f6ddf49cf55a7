"""What every column of every table holds, and in which unit: the one source of what is said about them elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from vibench.results.schema import HISTORY_KEYS


class Column(NamedTuple):
    """Unit and meaning of a column."""

    unit: str
    meaning: str


UNITS: Mapping[str, str] = {
    "": "text, or a number that counts or names something",
    "1": "a pure number",
    "s": "CPU seconds of one thread, unless wall seconds are said",
    "ms": "thousandths of these",
    "MiB": "2²⁰ bytes",
    "µ": "the parameter's own unit, which its problem declares",
    "u": "the unit of the displacement",
    "V": "the unit of the norm of V",
    "V²": "its square",
    "W": "the unit of the norm of W",
    "b": "the unit of b(v, η), as that of the energy",
    "b/VW": "that of b(v, η) over those of the norms of V and W",
}
"""The units and what they stand for; those of V, W and b depend on the problem."""

_KEYS: Mapping[str, Column] = {
    "problem": Column("", "Problem: its label in the study, or its name."),
    "problem_options": Column("", "Options of the problem that are not at their default, as JSON."),
    "dual": Column("", "Dual strategy, likewise."),
    "dual_options": Column("", "Its options, likewise."),
    "primal": Column("", "Primal strategy, likewise."),
    "primal_options": Column("", "Its options, likewise."),
    "pod_tol": Column("1", "Tolerance δ_POD of the POD; empty where the study prescribes N."),
    "pod_size": Column("", "Prescribed N; empty where the study gives a tolerance."),
    "dual_tol": Column("1", "Tolerance δ_dual of the cone; empty where the study prescribes R."),
    "dual_size": Column("", "Prescribed R; empty where the study gives a tolerance."),
    "primal_tol": Column("1", "Tolerance δ of the primal strategy; empty for strategies that take none."),
    "solver": Column("", "QP solver."),
    "assembly": Column("", "How queries are assembled: full or reduced."),
}

_CELLS: Mapping[str, Column] = {
    "cell": Column("", "Hash of everything that determines the cell's numbers, the code aside; what `replay` takes."),
    **_KEYS,
    "model": Column("", "Hash of the reduced model; cells that differ in their solver alone share it."),
    "status": Column("", "The worst status of its queries, or what became of a stage they need."),
    "reason": Column("", "Why it is not ok: the first query with this status and what was wrong there."),
    "queries": Column("", "Queries asked: one per validation parameter."),
    "queries_ok": Column("", "Queries that are ok; means and maxima are over these."),
    "dim_V": Column("", "Dimension n of V."),
    "dim_W": Column("", "Dimension m of W."),
    "N": Column("", "Dimension of V_N."),
    "R": Column("", "Generators of the cone."),
    "rank": Column("", "Numerical rank of the generators: dimension of their span."),
    "gram_condition": Column("", "Condition number of the Gram matrix of the generators in W."),
    "enrichment": Column("", "Vectors added to V_N; of an enrichment per parameter, the rank of the generators."),
    "enrichment_kind": Column("", "none, fixed or per-parameter."),
    "interpolation_tol": Column(
        "1", "Tolerance of the interpolation in reduced assembly; empty where it is not asked for."
    ),
    "interpolation_error": Column("1", "Largest relative interpolation error of a member over the training set."),
    "terms_A": Column("", "Entries of A that a reduced query samples; 0 where A is constant, empty where not sampled."),
    "terms_f": Column("", "The same of f."),
    "terms_B": Column("", "The same of B; empty, too, where it is assembled on the contact."),
    "terms_g": Column("", "The same of g."),
    "offline_snapshots_s": Column("s", "High-fidelity solutions over the training set."),
    "offline_pod_s": Column("s", "POD."),
    "offline_cone_s": Column("s", "Dual strategy, with the orthonormal basis of the span."),
    "offline_enrichment_s": Column("s", "Primal strategy."),
    "offline_assembly_s": Column("s", "What reduced assembly prepares; 0 in full."),
    "offline_s": Column("s", "Sum of the five above, what the cell alone would have taken."),
    "offline_wall_s": Column("s", "The same sum in wall seconds."),
    "online_s": Column("s", "One query, assembly and solution: mean over the ok queries of their medians."),
    "online_wall_s": Column("s", "The same in wall seconds."),
    "online_assemble_s": Column("s", "Its share of assembly."),
    "online_solve_s": Column("s", "Its share of the solver."),
    "hf_s": Column("s", "One high-fidelity solution: mean over the validation parameters."),
    "beta_span_min": Column("b/VW", "Smallest β over the span of the generators, over the validation parameters."),
    "beta_cone_lower_min": Column("b/VW", "Smallest certified lower bound of β over their cone."),
    "beta_cone_upper_min": Column("b/VW", "Smallest upper bound of β over their cone."),
    "error_u_mean": Column("1", "Mean relative error of u in V."),
    "error_u_max": Column("1", "Largest relative error of u in V."),
    "error_lambda_mean": Column("1", "Mean relative error of λ in W."),
    "error_lambda_max": Column("1", "Largest relative error of λ in W."),
    "assembly_error_max": Column("1", "Largest difference of a member of a reduced program from its projection."),
    "violation_max": Column("u", "Largest constraint violation of a reduced solution."),
    "residual_max": Column("1", "Largest of all recomputed residuals."),
    "fallbacks": Column("", "Every step that could not be done as its algorithm says."),
    "peak_memory_mib": Column("MiB", "Peak of the resident memory of the worker process."),
    "slowdown": Column("1", "Seconds of the calibration beside the queries, over its best in that process."),
    "disturbed": Column("", "1 where the slowdown is above 1.3, or wall seconds above 1.5 times the CPU seconds."),
    "seed": Column("", "Seed of the study."),
    "study_hash": Column("", "Hash of the whole study file as it was read."),
    "code": Column("", "Hash of the code: core, plugins, solver."),
    "machine": Column("", "Machines that measured the seconds."),
    "threads": Column("", "Threads of every timed process."),
    "versions": Column("", "Versions of Python, libraries and solver, as JSON."),
    "definition": Column("", "The whole cell as JSON."),
}


def _constants(prefix: str, whose: str) -> dict[str, Column]:
    return {
        f"{prefix}span": Column("b/VW", f"β over the span of the generators, {whose}."),
        f"{prefix}cone_lower": Column("b/VW", f"Certified lower bound of β over the cone, {whose}."),
        f"{prefix}cone_upper": Column("b/VW", f"Upper bound of β over the cone, {whose}."),
    }


_CELL = Column("", "The cell it belongs to.")

_QUERIES: Mapping[str, Column] = {
    "cell": _CELL,
    **_KEYS,
    "query": Column("", "Number of the validation parameter, from 0."),
    "form": Column("", "Form in which the program was solved: primal or dual."),
    "started_from": Column("", "Query whose solution the solver started from, if any."),
    "assembly_error": Column("1", "Largest relative difference of a member of the program from its projection."),
    "assemble_s": Column("s", "Assembly of the reduced program."),
    "solve_s": Column("s", "The solver: median of the repeats."),
    "total_s": Column("s", "Sum of the two."),
    "total_wall_s": Column("s", "The same in wall seconds."),
    "hf_s": Column("s", "The high-fidelity solution at this parameter, assembly included."),
    "error_u": Column("1", "‖u − u_N‖ / ‖u‖ in V."),
    "error_lambda": Column("1", "‖λ − λ_N‖ / ‖λ‖ in W."),
    "error_energy": Column("1", "The error of u in the norm of A(µ), relative."),
    "error_u_absolute": Column("V", "‖u − u_N‖ in V."),
    "error_lambda_absolute": Column("W", "‖λ − λ_N‖ in W."),
    "bound_u": Column("V", "Certified bound Δ_u of the error of u; infinite where β_HF over the span is 0."),
    "bound_lambda": Column("W", "Certified bound Δ_λ of the error of λ."),
    "effectivity_u": Column("1", "bound_u / error_u_absolute; empty for relative errors up to 1e-8."),
    "effectivity_lambda": Column("1", "bound_lambda / error_lambda_absolute, likewise."),
    "violation": Column("u", "Largest (B u_N − g)₊, every row over the integral of its multiplier function."),
    "complementarity": Column("b", "λᵀ(B u_N − g), λ the high-fidelity multiplier."),
    **_constants("beta_", "of the reduced pair"),
    **_constants("beta_full_", "with the whole of V"),
    **_constants("beta_plain_", "with V_N alone"),
    **_constants("beta_hf_", "of the high-fidelity pair, whose generators are all basis functions"),
    "bounds": Column("", "Which bounds gave the interval of the reduced pair, lower/upper."),
    "status": Column("", "ok, inaccurate, nonfinite, infeasible, failed, timeout, crashed or error."),
    "reason": Column("", "Why it is not ok."),
    "solver_status": Column("", "What the solver says of itself."),
    "primal_residual": Column("1", "Recomputed, relative."),
    "dual_residual": Column("1", "Recomputed, relative."),
    "gap": Column("1", "Recomputed, relative."),
    "iterations": Column("", "Iterations the solver reports."),
    "repeatable": Column("", "1 where all repeats gave the same answer to the last bit."),
}

PARAMETER = Column("µ", "The k-th parameter.")
"""What mu_1, mu_2, … of the queries are, as many as the problem has parameters."""

_HISTORIES: Mapping[str, Column] = {
    "artefact": Column("", "Hash of the stage it comes from."),
    "stage": Column("", "pod, cone or enrichment; training or validation for what a problem tells of its solutions."),
    **{name: _KEYS[name] for name in HISTORY_KEYS},
    "quantity": Column("", "What the values are."),
    "step": Column("", "Step of the algorithm, or number of the parameter."),
    "value": Column("1", "The value; constants are in the unit of β, diagnostics in one of their own."),
}

_THRESHOLDS: Mapping[str, Column] = {
    **{name: text for name, text in _KEYS.items() if not name.startswith("primal") and name != "assembly"},
    "primal_a": Column("", "Way a: a primal strategy, or high-fidelity."),
    "primal_tol_a": Column("1", "Its tolerance."),
    "assembly_a": Column("", "How its queries are assembled."),
    "primal_b": Column("", "Way b, which is compared with it."),
    "primal_tol_b": Column("1", "Its tolerance."),
    "assembly_b": Column("", "How its queries are assembled."),
    "offline_a_s": Column("s", "Offline seconds of a."),
    "online_a_s": Column("s", "Seconds of a query of a."),
    "offline_b_s": Column("s", "Offline seconds of b."),
    "online_b_s": Column("s", "Seconds of a query of b."),
    "benefit_threshold": Column("1", "Number n* of queries; empty where b is cheaper always or never."),
    "meaning": Column("", "When b is cheaper than a in total: from n* on, until n*, never, or at once."),
}

_DISAGREEMENTS: Mapping[str, Column] = {
    **{name: text for name, text in _KEYS.items() if name != "solver"},
    "solver_a": Column("", "One solver."),
    "solver_b": Column("", "The other."),
    "queries": Column("", "Queries that both solved."),
    "difference_max": Column("1", "Largest distance of their u in V, relative to that of solver_a."),
    "query_worst": Column("", "Query where it is found."),
    "allowed_worst": Column("1", "What the accuracy allows there, relative."),
    "flagged": Column("", "Queries where they are farther apart than the accuracy allows."),
    "query_flagged": Column("", "The first of these."),
}

_SOLUTIONS: Mapping[str, Column] = {
    "cell": _CELL,
    "query": Column("", "Number of the validation parameter."),
    "x": Column("V", "Coefficients in the V-orthonormal primal basis, little-endian doubles."),
    "alpha": Column("W", "Coefficients of the generators, likewise."),
    "slack_linear": Column("V", "Share l of the distance that the accuracy leaves open."),
    "slack_constant": Column("V²", "Share c of its square."),
}

_PICTURES: Mapping[str, Column] = {
    "problem": _KEYS["problem"],
    "problem_options": _KEYS["problem_options"],
    "number": Column("", "Number of the picture."),
    "title": Column("", "Its parameter."),
    "names": Column("", "What the field and the multiplier are, with their units, as JSON."),
    "data": Column("", "Mesh, field and multiplier in single precision, a compressed archive of NumPy."),
    "reason": Column("", "Why there is none, where there should be."),
}

COLUMNS: Mapping[str, Mapping[str, Column]] = {
    "cells": _CELLS,
    "queries": _QUERIES,
    "histories": _HISTORIES,
    "thresholds": _THRESHOLDS,
    "disagreements": _DISAGREEMENTS,
    "solutions": _SOLUTIONS,
    "pictures": _PICTURES,
}
"""The columns of the tables of `vibench.results.schema.STORED`."""

SUMMARY: Mapping[str, Column] = {
    "problem": _KEYS["problem"],
    "δ_POD": Column("1", "Tolerance of the POD, or N=… where the study prescribes that."),
    "δ_dual": Column("1", "Tolerance of the cone, or R=…"),
    "dual": _KEYS["dual"],
    "primal": _KEYS["primal"],
    "δ": Column("1", "Tolerance of the primal strategy."),
    "solver": _KEYS["solver"],
    "assembly": _KEYS["assembly"],
    "ok": Column("", "Queries that are ok out of all, and the status if that is another."),
    "N": _CELLS["N"],
    "R": _CELLS["R"],
    "added": _CELLS["enrichment"],
    "min β span": _CELLS["beta_span_min"],
    "min β cone": _CELLS["beta_cone_lower_min"],
    "error u": _CELLS["error_u_mean"],
    "error λ": _CELLS["error_lambda_mean"],
    "offline [s]": _CELLS["offline_s"],
    "online [ms]": Column("ms", _CELLS["online_s"].meaning),
}
"""The columns of the summary, one line per cell."""

BENEFITS: Mapping[str, Column] = {
    **{name: SUMMARY[name] for name in ("problem", "δ_POD", "δ_dual", "dual", "solver")},
    "a": _THRESHOLDS["primal_a"],
    "assembly a": _THRESHOLDS["assembly_a"],
    "b": _THRESHOLDS["primal_b"],
    "assembly b": _THRESHOLDS["assembly_b"],
    "δ of b": _THRESHOLDS["primal_tol_b"],
    "offline a [s]": _THRESHOLDS["offline_a_s"],
    "online a [ms]": Column("ms", _THRESHOLDS["online_a_s"].meaning),
    "offline b [s]": _THRESHOLDS["offline_b_s"],
    "online b [ms]": Column("ms", _THRESHOLDS["online_b_s"].meaning),
    "b pays": Column("1", "When b is cheaper in total: from so many queries on, until so many, never, or at once."),
}
"""The columns of the benefit thresholds for reading."""
