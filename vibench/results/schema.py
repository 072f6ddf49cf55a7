"""The tables of the results file: their columns, in order, with SQLite types."""

from __future__ import annotations

from collections.abc import Mapping

VERSION = 6
"""Schema version of a results file; a file of another version is refused."""

KEYS: Mapping[str, str] = {
    "problem": "TEXT",
    "problem_options": "TEXT",
    "dual": "TEXT",
    "dual_options": "TEXT",
    "primal": "TEXT",
    "primal_options": "TEXT",
    "pod_tol": "REAL",
    "pod_size": "INTEGER",
    "dual_tol": "REAL",
    "dual_size": "INTEGER",
    "primal_tol": "REAL",
    "solver": "TEXT",
    "assembly": "TEXT",
}
"""What names a cell. Where a study prescribes N or R, `pod_size` or `dual_size` is filled instead of the tolerance."""

CELLS: Mapping[str, str] = {
    "cell": "TEXT PRIMARY KEY",
    **KEYS,
    "model": "TEXT",
    "status": "TEXT NOT NULL",
    "reason": "TEXT",
    "queries": "INTEGER",
    "queries_ok": "INTEGER",
    "dim_V": "INTEGER",
    "dim_W": "INTEGER",
    "N": "INTEGER",
    "R": "INTEGER",
    "rank": "INTEGER",
    "gram_condition": "REAL",
    "enrichment": "INTEGER",
    "enrichment_kind": "TEXT",
    "interpolation_tol": "REAL",
    "interpolation_error": "REAL",
    "terms_A": "INTEGER",
    "terms_f": "INTEGER",
    "terms_B": "INTEGER",
    "terms_g": "INTEGER",
    "offline_snapshots_s": "REAL",
    "offline_pod_s": "REAL",
    "offline_cone_s": "REAL",
    "offline_enrichment_s": "REAL",
    "offline_assembly_s": "REAL",
    "offline_s": "REAL",
    "offline_wall_s": "REAL",
    "online_s": "REAL",
    "online_wall_s": "REAL",
    "online_assemble_s": "REAL",
    "online_solve_s": "REAL",
    "hf_s": "REAL",
    "beta_span_min": "REAL",
    "beta_cone_lower_min": "REAL",
    "beta_cone_upper_min": "REAL",
    "error_u_mean": "REAL",
    "error_u_max": "REAL",
    "error_lambda_mean": "REAL",
    "error_lambda_max": "REAL",
    "assembly_error_max": "REAL",
    "violation_max": "REAL",
    "residual_max": "REAL",
    "fallbacks": "TEXT",
    "peak_memory_mib": "REAL",
    "slowdown": "REAL",
    "disturbed": "INTEGER",
    "seed": "INTEGER",
    "study_hash": "TEXT",
    "code": "TEXT",
    "machine": "TEXT",
    "threads": "INTEGER",
    "versions": "TEXT",
    "definition": "TEXT",
}
"""`model` names the reduced model, which cells that differ in their solver alone share; `definition` is the cell in
JSON. `terms_…` counts the entries of a member that a reduced query samples, none where it does not depend on mu; it is
empty where the member is assembled on the contact, or in full."""

CONSTANTS = tuple(
    f"beta_{whose}{what}" for whose in ("", "full_", "plain_", "hf_") for what in ("span", "cone_lower", "cone_upper")
)
"""Inf-sup columns of a query: its own, of all of V, of V_N alone, of the high-fidelity pair."""

QUERIES: Mapping[str, str] = {
    "cell": "TEXT NOT NULL REFERENCES cells(cell) ON DELETE CASCADE",
    **KEYS,
    "query": "INTEGER",
    "form": "TEXT",
    "started_from": "INTEGER",
    "assembly_error": "REAL",
    "assemble_s": "REAL",
    "solve_s": "REAL",
    "total_s": "REAL",
    "total_wall_s": "REAL",
    "hf_s": "REAL",
    "error_u": "REAL",
    "error_lambda": "REAL",
    "error_energy": "REAL",
    "error_u_absolute": "REAL",
    "error_lambda_absolute": "REAL",
    "bound_u": "REAL",
    "bound_lambda": "REAL",
    "effectivity_u": "REAL",
    "effectivity_lambda": "REAL",
    "violation": "REAL",
    "complementarity": "REAL",
    **dict.fromkeys(CONSTANTS, "REAL"),
    "bounds": "TEXT",
    "status": "TEXT NOT NULL",
    "reason": "TEXT",
    "solver_status": "TEXT",
    "primal_residual": "REAL",
    "dual_residual": "REAL",
    "gap": "REAL",
    "iterations": "INTEGER",
    "repeatable": "INTEGER",
}
"""Beside these a query has mu_1, mu_2, …, as many as its problem has parameters. Bounds are absolute; an effectivity is
bound over absolute error. `form` is the one in which the program was solved, "primal" or "dual"; `started_from` the
query whose solution the solver started from, if any."""

SOLUTIONS: Mapping[str, str] = {
    "cell": "TEXT NOT NULL REFERENCES cells(cell) ON DELETE CASCADE",
    "query": "INTEGER",
    "x": "BLOB",
    "alpha": "BLOB",
    "slack_linear": "REAL",
    "slack_constant": "REAL",
}
"""What the solvers returned, as little-endian doubles, and what the accuracy leaves open."""

HISTORY_KEYS: Mapping[str, str] = {name: KEYS[name] for name in KEYS if name not in ("solver", "assembly")}

HISTORIES: Mapping[str, str] = {
    "artefact": "TEXT",
    "stage": "TEXT",
    **HISTORY_KEYS,
    "quantity": "TEXT",
    "step": "INTEGER",
    "value": "REAL",
}

THRESHOLDS: Mapping[str, str] = {
    **{name: KEYS[name] for name in KEYS if name not in ("primal", "primal_options", "primal_tol", "assembly")},
    "primal_a": "TEXT",
    "primal_tol_a": "REAL",
    "assembly_a": "TEXT",
    "primal_b": "TEXT",
    "primal_tol_b": "REAL",
    "assembly_b": "TEXT",
    "offline_a_s": "REAL",
    "online_a_s": "REAL",
    "offline_b_s": "REAL",
    "online_b_s": "REAL",
    "benefit_threshold": "REAL",
    "meaning": "TEXT",
}

DISAGREEMENTS: Mapping[str, str] = {
    **{name: KEYS[name] for name in KEYS if name != "solver"},
    "solver_a": "TEXT",
    "solver_b": "TEXT",
    "queries": "INTEGER",
    "difference_max": "REAL",
    "query_worst": "INTEGER",
    "allowed_worst": "REAL",
    "flagged": "INTEGER",
    "query_flagged": "INTEGER",
}
"""Every two solvers on one reduced model, over the queries both solved: relative differences of u in V."""

PICTURES: Mapping[str, str] = {
    "problem": "TEXT",
    "problem_options": "TEXT",
    "number": "INTEGER",
    "title": "TEXT",
    "names": "TEXT",
    "data": "BLOB",
    "reason": "TEXT",
}
"""High-fidelity solutions to look at (`vibench.results.pictures`), or why there is none."""

TABLES: Mapping[str, Mapping[str, str]] = {
    "cells": CELLS,
    "queries": QUERIES,
    "histories": HISTORIES,
    "thresholds": THRESHOLDS,
    "disagreements": DISAGREEMENTS,
}
"""The tables for reading; each is exported as CSV."""

STORED: Mapping[str, Mapping[str, str]] = {**TABLES, "solutions": SOLUTIONS, "pictures": PICTURES}
"""All tables of the results file."""
