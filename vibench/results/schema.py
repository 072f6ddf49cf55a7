"""The one table of the columns of the results: SQLite type, unit, meaning, and where each is shown.

The schema of the results file, the documentation and the tables for reading follow from it: a new column is one entry
here and the line that fills it.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any, NamedTuple, TypeAlias

Row: TypeAlias = Mapping[str, Any]
"""A row of a table: column → value."""

# Increase it with every change of the schema: a results file of another version is refused.
VERSION = 24


class SqlType(StrEnum):
    """SQLite type of a column."""

    TEXT = "TEXT"
    REAL = "REAL"
    INTEGER = "INTEGER"
    BLOB = "BLOB"

    @property
    def is_number(self) -> bool:
        return self in (SqlType.REAL, SqlType.INTEGER)


class Column(NamedTuple):
    """A column of a table."""

    kind: SqlType
    unit: str  # explained in the documentation; "" for texts, counts and names
    meaning: str
    heading: str = ""  # in the table for reading; "" if the column is not shown there
    place: int | None = None  # position in that table
    constraint: str = ""  # in SQL
    is_json: bool = False  # such a text is never cut


def real(unit: str, meaning: str, heading: str = "", place: int | None = None) -> Column:
    return Column(SqlType.REAL, unit, meaning, heading, place)


def integer(meaning: str, heading: str = "", place: int | None = None) -> Column:
    return Column(SqlType.INTEGER, "", meaning, heading, place)


def text(meaning: str, heading: str = "", place: int | None = None, *, constraint: str = "") -> Column:
    return Column(SqlType.TEXT, "", meaning, heading, place, constraint)


def as_json(meaning: str) -> Column:
    return Column(SqlType.TEXT, "", meaning, is_json=True)


def blob(unit: str, meaning: str) -> Column:
    return Column(SqlType.BLOB, unit, meaning)


def column_of(table: str, name: str) -> Column:
    """A column by its table and name; parameters mu_1, mu_2, … of queries are as many as the problem has."""
    return STORED[table].get(name) or real("µ", "The k-th parameter; tables for reading have its name as heading.")


def shown_columns(table: Mapping[str, Column]) -> dict[str, Column]:
    """The columns of a table that are shown in the table for reading made of it, in the order of their places."""
    return dict(sorted(((name, c) for name, c in table.items() if c.heading), key=lambda item: item[1].place or 0))


# The name of a cell. Where a study prescribes N or R, `pod_size` or `dual_size` is filled instead of the tolerance.
KEYS: Mapping[str, Column] = {
    "problem": text("Problem: its label in the study, or its name.", "problem", 1),
    "problem_options": as_json("Options of the problem that are not at their default, as JSON."),
    "training": text("Training set: own, or the label or name of its sampling strategy.", "training", 2),
    "training_options": as_json("Options of the sampling strategy that are not at their default, as JSON."),
    "formulation": text("Formulation: mixed, or the label or name of a plugin.", "formulation", 3),
    "formulation_options": as_json("Options of the formulation that are not at their default, as JSON."),
    "dual": text("Dual strategy: its label in the study, or its name; – where there is no cone.", "dual", 4),
    "dual_options": as_json("Options of the dual strategy that are not at their default, as JSON."),
    "primal": text("Primal strategy: its label in the study, or its name; – where nothing is enriched.", "primal", 5),
    "primal_options": as_json("Options of the primal strategy that are not at their default, as JSON."),
    "pod_tol": real("1", "Tolerance δ_POD of the POD; empty where the study prescribes N.", "δ_POD", 2),
    "pod_size": integer("Prescribed N; empty where the study gives a tolerance."),
    "dual_tol": real("1", "Tolerance δ_dual of the cone; empty where the study prescribes R.", "δ_dual", 3),
    "dual_size": integer("Prescribed R; empty where the study gives a tolerance."),
    "primal_tol": real("1", "Tolerance δ of the primal strategy; empty for strategies that take none.", "δ", 6),
    "solver": text("QP solver; – stands for that of a formulation.", "solver", 7),
    "accuracy": real("1", "Relative accuracy prescribed to the solver; empty if there is none.", "accuracy", 8),
    "assembly": text("Assembly of queries: full or reduced.", "assembly", 9),
    "bounds": integer("1 if queries have error bounds at online cost, else 0.", "bounds", 9),
    "correction": text("Which solutions are corrected: none, feasible (all), auto (where ω > ρ); errors are of the "
        "corrected pair.", "correction", 10),
}  # fmt: skip


def _keys_without(*names: str) -> dict[str, Column]:
    return {name: column for name, column in KEYS.items() if name.removesuffix("_options") not in names}


def _cell() -> Column:
    return text("The cell it belongs to.", constraint="NOT NULL REFERENCES cells(cell) ON DELETE CASCADE")


def _infsup_constants(prefix: str, pair: str) -> dict[str, Column]:
    return {
        f"{prefix}span": real("b/VW", f"β over the span of the generators, {pair}."),
        f"{prefix}cone_lower": real("b/VW", f"Certified lower bound of β over the cone, {pair}."),
        f"{prefix}cone_upper": real("b/VW", f"Upper bound of β over the cone, {pair}."),
    }


def _effectivities(*names: str) -> dict[str, Column]:
    small = "the relative error in V or W, or the scaled one if there is none, is at most 1e-8"
    meaning = f"divided by the absolute error; empty where {small}."
    return {f"effectivity_{name}": real("1", f"bound_{name} {meaning}{_of_sum(name)}") for name in names}


def _of_sum(bound: str) -> str:
    """The sentence by which effectivities of bounds of u are read."""
    sentence = " The bound is of the sum with λ: this is large where the error of λ is, as without enrichment."
    return sentence * (bound in {"u_energy", "u", "online_u_energy"})


# All tables of the results file, by name.
STORED: Mapping[str, Mapping[str, Column]] = {
    "cells": {
        "cell": text("Hash of everything that determines the numbers of the cell, except the code; commands accept its "
            "beginning.", "cell", 0, constraint="PRIMARY KEY"),
        **KEYS,
        "model": text("Hash of the reduced model; cells that differ only in the solver share it."),
        "status": text("Worst status of its queries, or of a stage they need.", "status", 10, constraint="NOT NULL"),
        "reason": text("Why the cell is not ok: the first query with this status, and its fault."),
        "queries": integer("Number of queries, one per validation parameter."),
        "queries_ok": integer("Number of queries with status ok; means and maxima are over these.", "ok", 10),
        "snapshots": integer("High-fidelity solutions of the training, one per training parameter.", "solved", 11),
        "skipped": integer("Training parameters without a solution, left out by `on_failure` = skip."),
        "dim_V": integer("Dimension n of V."),
        "dim_W": integer("Dimension m of W."),
        "N": integer("Dimension N of V_N; of other formulations most coefficients of u, those added apart.", "N", 11),
        "R": integer("Number R of generators of the cone; of other formulations most coefficients of λ.", "R", 12),
        "rank": integer("Numerical rank of the generators: dimension of their span."),
        "rank_gap": real("1", "Smallest singular value in the rank over the next or the threshold; doubtful near 1."),
        "gram_condition": real("1", "Condition number of the Gram matrix of the generators in W, by singular values."),
        "enrichment": integer("Vectors added to V_N; for an enrichment per parameter, the rank.", "added", 13),
        "enrichment_kind": text("none, fixed or per-parameter."),
        "multiplier": text("Where λ comes from: solved (unknowns of the query), recovered from u, or residual: the λ ≥ "
            "0 with the smallest residual, found outside the seconds of the query."),
        "interpolation_tol": real("1", "Tolerance of the interpolation in reduced assembly; empty with full assembly."),
        "interpolation_error": real("1", "Largest relative interpolation error of a member over the training set."),
        "terms_A": integer("Terms of A in a query, each with a coefficient; 0 if constant, empty if assembled."),
        "terms_f": integer("Likewise for f."),
        "terms_B": integer("Likewise for B; empty if B is assembled on the contact unknowns."),
        "terms_g": integer("Likewise for g."),
        "correction_cost": text("Cost of a correction: online, with a certificate, or high-fidelity; empty without."),
        "corrected_share": real("1", "Share of the ok queries that are corrected; empty without corrections."),
        "offline_snapshots_s": real("s", "High-fidelity training solutions, failed ones too, with one set-up."),
        "offline_selection_s": real("s", "Greedy choice of parameters, part of offline_snapshots_s; 0 for fixed sets."),
        "offline_pod_s": real("s", "POD."),
        "offline_cone_s": real("s", "Dual strategy, with the orthonormal basis of the span."),
        "offline_enrichment_s": real("s", "Primal strategy."),
        "offline_formulation_s": real("s", "What a formulation builds; 0 for mixed."),
        "offline_assembly_s": real("s", "Preparation of reduced assembly or a compiled program; 0 with full assembly."),
        "offline_certificate_s": real("s", "Preparation of certificates at online cost; 0 without."),
        "offline_s": real("s", "Offline time of the cell: sum of these but `offline_selection_s`.", "offline [s]", 22),
        "offline_low_s": real("s", "Lower end of its 95 % interval, from the scatter of repeated stages of the run."),
        "offline_high_s": real("s", "Upper end of this interval."),
        "offline_repeats": integer("Offline stages of the cell, of at least a millisecond, timed more than once."),
        "offline_wall_s": real("s", "The same sum in wall seconds."),
        "online_s": real("s", "One query with assembly, certificate and correction, mean over the ok queries: "
            "geometric mean over the blocks of the median over their rounds, each divided by its pace.",
            "online [ms]", 23),
        "online_q1_s": real("s", "Lower quartile over the rounds."),
        "online_q3_s": real("s", "Upper quartile over the rounds."),
        "online_wall_s": real("s", "The same as online_s, in wall seconds."),
        "online_assemble_s": real("s", "Assembly of a query: median over the rounds."),
        "online_solve_s": real("s", "Solution of a query by the solver: median over the rounds."),
        "online_certify_s": real("s", "Certificate and correction of a query: median over the rounds; empty without."),
        "online_reconstruct_s": real("s", "Reconstruction of u and λ by a formulation: median over the rounds; part "
            "of `online_solve_s` where they are more than a linear map of its coefficients."),
        "timing_rounds": integer("Maximal number of timing rounds of the study; empty if the timing is not finished."),
        "timed_rounds": integer("Rounds that were timed: they end when all comparisons of the cell are decided."),
        "timing_reason": text("Why rounds are missing."),
        "hf_setup_s": real("s", "Set-up of the high-fidelity solver, once: the time by which the first solution "
            "exceeds its repetition from a known contact set."),
        "hf_s": real("s", "One high-fidelity solution after the set-up, mean over the validation parameters: online_s "
            "times the gain in the rounds; where none was timed in them, in the sweep over these parameters."),
        "beta_span_min": real("b/VW", "Smallest β over the span, over the validation parameters.", "min β span", 14),
        "beta_cone_lower_min": real("b/VW", "Smallest certified lower bound of β over their cone.", "min β cone", 15),
        "beta_cone_upper_min": real("b/VW", "Smallest upper bound of β over their cone."),
        "share_training": real("1", "Smallest ratio of β over the span to that of V, over the training parameters."),
        "share_validation": real("1", "The same over the validation parameters."),
        "share_guaranteed": real("1", "√(1 − σ²), which bounds the share at training parameters where σ is recorded."),
        "error_u_mean": real("1", "Mean relative error of u in V over the ok queries with u ≠ 0.", "error u", 16),
        "error_u_max": real("1", "Largest relative error of u in V over these queries."),
        "queries_zero_u": integer("Ok queries with zero_u = 1, left out of means and maxima of error_u.", "u = 0", 17),
        "error_u_zero_max": real("1", "Largest error_u_scaled of these queries.", "error, u = 0", 18),
        "error_lambda_mean": real("1", "Mean relative error of λ in W over the ok queries with λ ≠ 0.", "error λ", 19),
        "error_lambda_max": real("1", "Largest relative error of λ in W over these queries."),
        "queries_zero_lambda": integer("Ok queries with zero_lambda = 1, likewise for the error of λ.", "λ = 0", 20),
        "error_lambda_zero_max": real("1", "Largest error_lambda_scaled of these queries.", "error, λ = 0", 21),
        **{f"effectivity_{name}_median":
           real("1", f"Median effectivity of bound_{name} over the ok queries.{_of_sum(name)}")
           for name in (
            "u_energy", "u", "lambda_natural", "lambda", "online_u_energy", "online_lambda_natural", "online_lambda",
            "hsw_u", "hsw_lambda",
        )},
        "certificate": text("Bounds at online cost: certified, verified, refuted, or none.", "certificate", 10),
        "bound_online_violations": integer("Ok queries where bound_online_violated is 1; empty without a certificate."),
        "reference_bound_max": real("1", "Largest reference_bound of the queries."),
        "solver_error_u_max": real("1", "Largest contribution of the QP solver to the relative error of u."),
        "solver_error_lambda_max": real("1", "Largest contribution of the QP solver to the relative error of λ."),
        "solver_share_max": real("1", "Largest ratio of this contribution to the error, over the queries."),
        "solver_share_mean": real("1", "Mean contribution over mean error of u or λ; cells are compared below 0.1."),
        "assembly_error_max": real("1", "Largest difference of a member of a reduced program from its projection."),
        "assembly_error_u_max": real("1", "Largest contribution of reduced assembly to the relative error of u."),
        "assembly_error_lambda_max": real("1", "Largest contribution of reduced assembly to the relative error of λ."),
        "assembly_share_max": real("1", "Largest ratio of this contribution to the error, over the queries."),
        "assembly_share_mean": real("1", "Mean contribution over mean error of u or λ; cells are compared below 0.1."),
        "violation_max": real("u", "Largest constraint violation of a reduced solution."),
        "residual_max": real("1", "Largest of all natural residuals of quadratic programs."),
        "hf_residual_max": real("1", "Largest natural residual of the high-fidelity problem over the ok queries."),
        "error_u_predicted_mean": real("V", "Mean of error_u_predicted over the ok queries."),
        "fallbacks": text("Steps that deviate from their algorithm, and what was done instead."),
        "peak_memory_mib": real("MiB", "Peak resident memory of the worker process."),
        "slowdown": real("1", "CPU time of the calibration next to the rounds, over its lowest tenth in that process."),
        "disturbed": integer("1 if the slowdown exceeds 1.3, else 0."),
        "seed": integer("Seed of the study."),
        "validation": text("Validation set: own, or the label or name of its sampling strategy."),
        "validation_options": as_json("Options of that strategy that are not at their default, as JSON."),
        "study_hash": text("Hash of the study file."),
        "code": text("Hash of the code of the core, the plugins and the solver."),
        "machine": text("Machines that measured the seconds."),
        "threads": integer("Threads of every timed process."),
        "versions": as_json("Versions of Python, libraries and solver, as JSON."),
        "definition": as_json("Definition of the cell as JSON."),
    },
    "queries": {
        "cell": _cell(),
        **KEYS,
        "query": integer("Number of the validation parameter, from 0."),
        "form": text("Form in which it was solved: primal, dual, least distance or compiled; formulation for plugins."),
        "started_from": integer("Query from whose solution the solver started; empty for a cold start."),
        "assembly_error": real("1", "Largest relative difference of a member of the program from its projection."),
        "assemble_s": real("s", "Assembly of the reduced program: median over the rounds."),
        "solve_s": real("s", "The solver: median over the rounds."),
        "certify_s": real("s", "The certificate and the correction: median over the rounds; empty without either."),
        "reconstruct_s": real("s", "As `online_reconstruct_s`, of this query: median over the rounds."),
        "total_s": real("s", "Sum of the three."),
        "total_wall_s": real("s", "The same in wall seconds."),
        "corrected": integer("1 if the corrected pair is returned, 0 if the reduced one; empty without corrections."),
        "correction_share": real("1", "ω/ρ of the reduced solution, above which auto corrects at 1; empty if unknown."),
        "correction_note": text("Why the solution is not corrected although a correction was requested."),
        "reference_bound": real("1", "Bound of the energy error of the high-fidelity solution, relative to "
            "‖Bᵀλ‖_A⁻¹; at most 1e-6, or what round-off of B u − g leaves open; empty where no correction is found."),
        "hf_s": real("s", "High-fidelity solution, with assembly but without set-up: median of the repetitions."),
        "zero_u": integer("1 if the high-fidelity ‖u‖ is at most 1e-8 of the largest in the training set, else 0."),
        "zero_lambda": integer("Likewise for ‖λ‖; 1 means that there is no contact."),
        "error_u": real("1", "‖u − u_N‖ / ‖u‖ in V; empty where zero_u is 1."),
        "error_lambda": real("1", "‖λ − λ_N‖ / ‖λ‖ in W; empty where zero_lambda is 1."),
        "error_u_energy": real("1", "The error of u in the norm of A(µ), relative; empty where zero_u is 1."),
        "error_lambda_natural": real("1", "‖Bᵀ(λ − λ_N)‖ / ‖Bᵀλ‖ in the norm of A(µ)⁻¹; empty where zero_lambda is 1."),
        "error_u_absolute": real("V", "‖u − u_N‖ in V."),
        "error_lambda_absolute": real("W", "‖λ − λ_N‖ in W."),
        "error_u_energy_absolute": real("A", "‖u − u_N‖ in the norm of A(µ)."),
        "error_lambda_natural_absolute": real("A", "‖Bᵀ(λ − λ_N)‖ in the norm of A(µ)⁻¹; unit of the energy norm."),
        "error_u_scaled": real("1", "‖u − u_N‖ over the largest ‖u‖ of the training set."),
        "error_lambda_scaled": real("1", "‖λ − λ_N‖ over the largest ‖λ‖ of the training set."),
        "solver_error_u": real("1", "Distance of u from the solution of the reduced program to round-off, relative to "
            "‖u‖; empty if error_u is empty or there is no such solution."),
        "solver_error_lambda": real("1", "Likewise for λ; also empty where tight constraints are dependent."),
        "solver_share": real("1", "The larger of these over the error of u or λ; empty if both are at most 1e-8."),
        "assembly_error_u": real("1", "Distance of u from that with assembly in full, both solved to round-off, "
            "relative to ‖u‖; empty with full assembly, or if error_u is empty or there are no such solutions."),
        "assembly_error_lambda": real("1", "Likewise for λ; also empty if λ is not unique."),
        "assembly_share": real("1", "The larger of these over the error of u or λ; empty if both are at most 1e-8."),
        "bound_u_energy": real("A", "Bound √(ρ² + ω² + 2κ) of error_u_energy_absolute."),
        "bound_u": real("V", "Bound of error_u_absolute: bound_u_energy divided by √α; see bound_note."),
        "bound_lambda_natural": real("A", "Bound of error_lambda_natural_absolute."),
        "bound_lambda": real("W", "Bound of error_lambda_absolute: bound_lambda_natural divided by β_A; infinite if no "
            "β_A > 0 is proved."),
        **_effectivities("u_energy", "u", "lambda_natural", "lambda"),
        "bound_rho": real("A", "ρ, the residual in the norm of A(µ)⁻¹."),
        "bound_rho_range": real("A", "ρ_B, the part of ρ in the range of Bᵀ, for λ; ρ if constraints are dependent."),
        "bound_omega": real("A", "ω, the norm of the correction w of the constraint violation."),
        "bound_kappa": real("A²", "κ = λ_Nᵀ(B w − s), the complementarity of w and λ_N."),
        "bound_note": text("Why there are no bounds, or none of λ in W, or which constant is estimated; else empty."),
        "certificate": text("Bounds at online cost: certified, verified (interpolation is measured), refuted or none."),
        "bound_online_u_energy": real("A", "Bound of error_u_energy_absolute at online cost."),
        "bound_online_lambda_natural": real("A", "Bound of error_lambda_natural_absolute at online cost."),
        "bound_online_lambda": real("W", "Bound of error_lambda_absolute; if empty, see beta_energy_online_note."),
        **_effectivities("online_u_energy", "online_lambda_natural", "online_lambda"),
        "bound_online_rho": real("A", "Its bound of ρ."),
        "bound_online_omega": real("A", "Its bound of ω."),
        "bound_online_kappa": real("A²", "Its κ."),
        "coercivity_online": real("1", "Lower bound of A(µ) against A at the central parameter; 1 if A is constant."),
        "beta_energy_online": real("b/AW", "Lower bound of β_A at online cost; 0 where there is none."),
        "beta_energy_online_note": text("Which lower bound of β_A this is, or why there is none."),
        "bound_online_violated": integer("1 if an error exceeds its bound by more than 1e-10 of the solution, else 0."),
        "bound_online_note": text("Why there are no bounds at online cost, or no prepared correction was feasible and "
            "the best one was computed."),
        "bound_hsw_u": real("V", "Bound Δ_u of Haasdonk, Salomon and Wohlmuth with an estimated β_HF; infinite if 0."),
        "bound_hsw_lambda": real("W", "Their bound Δ_λ of the error of λ, with the same constant."),
        **_effectivities("hsw_u", "hsw_lambda"),
        "coercivity": real("A/V²", "α, a lower bound of the smallest vᵀA(µ)v / ‖v‖²."),
        "coercivity_proved": integer("1 if a factorisation proves it, 0 if it is a Lanczos estimate."),
        "continuity": real("A/V²", "γ_a, an upper bound of the largest vᵀA(µ)v / ‖v‖²."),
        "continuity_proved": integer("1 if a factorisation proves it, 0 if it is a Lanczos estimate."),
        "beta_energy": real("b/AW", "β_A, proved lower bound of β over the span, of V in the norm of A(µ) and W."),
        "outputs": as_json("Quantities of interest as JSON: value, reference, relative error, error over the scale."),
        "violation": real("u", "Largest (B u_N − g)₊, each row divided by the integral of its multiplier function."),
        "complementarity": real("b", "λᵀ(B u_N − g), λ the high-fidelity multiplier."),
        **_infsup_constants("beta_", "of the reduced pair"),
        **_infsup_constants("beta_full_", "with the whole of V"),
        **_infsup_constants("beta_plain_", "with V_N alone"),
        **_infsup_constants("beta_hf_", "of the high-fidelity pair, whose generators are all basis functions"),
        "beta_bounds": text("Bounds that determine the interval of the reduced pair, lower/upper."),
        "status": text("ok, inaccurate, nonfinite, infeasible, refuted, failed, timeout, crashed or error.",
            constraint="NOT NULL"),
        "reason": text("Why the status is not ok."),
        "solver_status": text("Status reported by the solver."),
        "primal_residual": real("1", "Natural primal residual: a correction of one row over what contact does."),
        "dual_residual": real("1", "Natural dual residual: its norm in A⁻¹ over the energy norm of what contact does."),
        "gap": real("1", "Natural gap: |αᵀs| over the energy of what contact does."),
        "hf_primal_residual": real("1", "Natural primal residual of u_N in the high-fidelity problem."),
        "hf_dual_residual": real("1", "Natural dual residual of u_N and λ_N in the high-fidelity problem."),
        "hf_gap": real("1", "Natural gap of u_N and λ_N in the high-fidelity problem."),
        "error_u_predicted": real("V", "Estimate of error_u_absolute by the formulation; empty where it makes none."),
        "iterations": integer("Iterations reported by the solver."),
        "repeatable": integer("1 if a second solution was identical to the last bit, else 0; empty if there was none."),
    },
    "histories": {
        "artefact": text("Hash of the stage it comes from."),
        "stage": text("pod, cone, enrichment or selection; training or validation for diagnostics of the problem."),
        **_keys_without("formulation", "solver", "accuracy", "assembly", "bounds", "correction"),
        "quantity": text("Name of the quantity."),
        "step": integer("Step of the algorithm, or number of the parameter."),
        "value": real("1", "The value; inf-sup constants are in the unit of β, diagnostics in their own units."),
    },
    "timings": {
        "cell": _cell(),
        **KEYS,
        "round": integer("Number of the round, from 0; the rounds of cells that are compared are interleaved."),
        "queries": integer("Number of ok queries solved in the round."),
        "assemble_s": real("s", "Assembly of a query: mean over these, or with full assembly that of one of them."),
        "solve_s": real("s", "Solution of a query by the solver: mean over these."),
        "certify_s": real("s", "Certificate and correction of a query: mean over these; empty without either."),
        "reconstruct_s": real("s", "As `online_reconstruct_s`: mean over these."),
        "total_s": real("s", "Sum of the three."),
        "total_wall_s": real("s", "The same in wall seconds."),
        "block": text("Block of rounds, which cells timed together share; each block is a process of its own."),
        "hf_s": real("s", "High-fidelity solution, mean over the round: that of the block at the pace of the round."),
        "pace": real("1", "Median factor by which timings of this round exceed those of the block's other rounds."),
        "slowdown": real("1", "CPU time of the calibration next to the round, over its lowest tenth in that process."),
    },
    "thresholds": {
        **_keys_without("formulation", "primal", "primal_tol", "assembly", "bounds"),
        "cell_a": text("Cell of model a; empty for the high-fidelity model."),
        "cell_b": text("Cell of model b."),
        "formulation_a": text("Formulation of a; mixed for the high-fidelity model, too.", "formulation against", 13),
        "formulation_b": text("Formulation of b.", "formulation", 10),
        "primal_a": text("Model a: its primal strategy, or high-fidelity.", "against", 13),
        "primal_tol_a": real("1", "Tolerance of the primal strategy of a."),
        "assembly_a": text("Assembly of the queries of a.", "assembly against", 15),
        "bounds_a": integer("1 if the queries of a have bounds.", "bounds against", 15),
        "primal_b": text("Model b: its primal strategy.", "model", 11),
        "primal_tol_b": real("1", "Tolerance of the primal strategy of b.", "δ", 12),
        "assembly_b": text("Assembly of the queries of b.", "assembly", 14),
        "bounds_b": integer("1 if the queries of b have bounds.", "bounds", 14),
        "offline_a_s": real("s", "Offline seconds of a.", "offline against [s]", 18),
        "online_a_s": real("s", "Seconds of a query of a, in the rounds both share.", "online against [ms]", 18),
        "offline_b_s": real("s", "Offline seconds of b.", "offline [s]", 16),
        "online_b_s": real("s", "Seconds of a query of b, in the rounds both share.", "online [ms]", 17),
        "gain": real("1", "Seconds of a query of a divided by those of b, paired within rounds.", "gain", 19),
        "gain_low": real("1", "Lower end of the 95 % interval of the gain."),
        "gain_high": real("1", "Upper end of this interval."),
        "benefit_threshold": real("1", "Queries n* at break-even; empty if none are claimed.", "break-even", 20),
        "threshold_low": real("1", "Lower end of the 95 % interval of n*; if undecided, the smallest n*."),
        "threshold_high": real("1", "Upper end of the 95 % interval of n*; tables to read show both.", "interval", 21),
        "meaning": text("When b is cheaper than a in total: from n* on, until n*, never or at once; as fast where the "
            "seconds of their queries differ by less than a factor of 1.25; or undecided."),
        "rounds_missing": integer("Further rounds that would decide it; empty if none would.", "more rounds", 22),
    },
    "disagreements": {
        **_keys_without("solver", "correction"),
        "solver_a": text("One solver."),
        "solver_b": text("The other."),
        "queries": integer("Number of queries that both solved."),
        "difference_max": real("1", "Largest distance of their u in V, relative to that of solver_a."),
        "query_worst": integer("Query with this difference."),
        "allowed_worst": real("1", "Largest difference that the accuracy allows there, relative."),
        "flagged": integer("Number of queries with a difference larger than the accuracy allows."),
        "query_flagged": integer("First of these queries."),
    },
    "outputs": {
        "cell": _cell()._replace(heading="cell", place=0),
        **KEYS,
        "output": text("Quantity of interest, as its problem names it.", "output", 10),
        "unit": text("Its unit.", "unit", 11),
        "linear": integer("1 where it is linear in u and λ with fixed coefficients, else 0."),
        "scale": real("o", "Its largest absolute value over the training set.", "scale", 12),
        "queries_ok": integer("Number of ok queries; means and maxima are over these."),
        "error_mean": real("1", "Mean relative error, where the output is not zero.", "error", 13),
        "error_max": real("1", "Largest relative error, likewise.", "largest", 14),
        "queries_zero": integer("Ok queries where it is at most 1e-8 of its scale: no contact, for instance."),
        "error_zero_max": real("1", "Largest error of these, over the scale."),
        "error_scaled_mean": real("1", "Mean error over the scale, of all ok queries.", "error / scale", 15),
        "error_scaled_max": real("1", "Largest error over the scale, likewise."),
    },
    "calibrations": {
        "cell": _cell()._replace(heading="cell", place=0),
        **KEYS,
        "noise": real("1", "Standard deviation of the noise of all sensors, a share of their values.", "noise", 10),
        "steps": integer("Steps of the chain, a quarter of which is its burn-in.", "steps", 11),
        "decisions": integer("Its decisions: proposals in the parameter box.", "decisions", 12),
        "asked": real("1", "Share of the decisions that bounds left open, for the high-fidelity model.", "asked", 13),
        "questions": integer("High-fidelity solutions, with those for audits.", "questions", 14),
        "audits": integer("Decisions by bounds that the high-fidelity model was asked all the same."),
        "wrong": integer("Decisions that the reduced model takes wrongly without bounds.", "wrong", 15),
        "claim": text("exact, for certified bounds, or no contradiction in so many audits.", "claim", 16),
        "answered_by": text("C program, Python and why, or the model without bounds.", "answers", 19),
        "calibration_s": real("s", "Queries and questions of the chain.", "chain [s]", 17),
        "hf_chain_s": real("s", "The high-fidelity chain, at the mean of the questions.", "high-fidelity [s]", 18),
        "reason": text("Why there is no chain."),
    },
    "solutions": {
        "cell": _cell(),
        "query": integer("Number of the validation parameter."),
        "x": blob("V", "Coefficients in the V-orthonormal primal basis, little-endian doubles."),
        "alpha": blob("W", "Coefficients of the generators, little-endian doubles."),
        "slack_linear": real("V", "Linear coefficient l of the distance that the accuracy leaves open."),
        "slack_constant": real("V²", "Constant c in the square of that distance."),
    },
    "pictures": {
        "problem": text("Problem: its label in the study, or its name."),
        "problem_options": as_json("Options of the problem that are not at their default, as JSON."),
        "number": integer("Number of the picture."),
        "title": text("The parameter, as text."),
        "names": as_json("Names of the field and of the multiplier with their units, as JSON."),
        "data": blob("", "Mesh, field and multiplier in single precision, a compressed archive of NumPy."),
        "reason": text("Why there is no picture, if it could not be made."),
    },
}  # fmt: skip

# The tables for reading; each is exported as CSV.
TABLES = tuple(name for name in STORED if name not in ("solutions", "pictures"))
