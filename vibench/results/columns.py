"""The one table of the columns of the results: SQLite type, unit, meaning, and where each is shown.

The schema of the results file, the documentation and the tables for reading follow from it: a new column is one entry
here and the line that fills it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

VERSION = 12
"""Schema version of a results file; a file of another version is refused."""

TEXT, REAL, INTEGER, BLOB = "TEXT", "REAL", "INTEGER", "BLOB"
KEY, MEMBER = "TEXT PRIMARY KEY", "TEXT NOT NULL REFERENCES cells(cell) ON DELETE CASCADE"


class Column(NamedTuple):
    """A column of a table.

    Attributes
    ----------
    kind
        SQLite type, with its constraints.
    unit, meaning
        For the documentation; units stand in `UNITS`.
    heading, place
        Heading and place in the table for reading that is made of this one; "" where the column is not shown there.
    whole
        Whether a text is JSON, which is never cut.
    """

    kind: str
    unit: str
    meaning: str
    heading: str = ""
    place: int = 0
    whole: bool = False


UNITS: Mapping[str, str] = {
    "": "text, or a number that counts or names something",
    "1": "a pure number",
    "s": "CPU seconds of one process; wall seconds where the meaning says so",
    "ms": "milliseconds of the same kind",
    "MiB": "2²⁰ bytes",
    "µ": "the unit that the problem declares for the parameter",
    "u": "the unit of the displacement",
    "V": "the unit of the norm of V",
    "V²": "the square of that unit",
    "W": "the unit of the norm of W",
    "b/AW": "the unit of b(v, η) divided by those of the energy norm and of the norm of W",
    "A/V²": "the unit of the energy divided by the square of that of the norm of V",
    "A": "the unit of the energy norm, the norm of A(µ)",
    "A²": "the unit of the energy",
    "b": "the unit of b(v, η), which is that of the energy",
    "b/VW": "the unit of b(v, η) divided by those of the norms of V and W",
    "o": "the unit of the output, in the column unit",
}
"""The units and what they stand for; those of V, W and b depend on the problem."""

KEYS: Mapping[str, Column] = {
    "problem": Column(TEXT, "", "Problem: its label in the study, or its name.", "problem", 1),
    "problem_options": Column(TEXT, "", "Options of the problem that are not at their default, as JSON.", whole=True),
    "training": Column(TEXT, "", "Training set: own, or the label or name of its sampling strategy.", "training", 2),
    "training_options": Column(
        TEXT, "", "Options of the sampling strategy that are not at their default, as JSON.", whole=True
    ),
    "dual": Column(TEXT, "", "Dual strategy: its label in the study, or its name.", "dual", 4),
    "dual_options": Column(
        TEXT, "", "Options of the dual strategy that are not at their default, as JSON.", whole=True
    ),
    "primal": Column(TEXT, "", "Primal strategy: its label in the study, or its name.", "primal", 5),
    "primal_options": Column(
        TEXT, "", "Options of the primal strategy that are not at their default, as JSON.", whole=True
    ),
    "pod_tol": Column(REAL, "1", "Tolerance δ_POD of the POD; empty where the study prescribes N.", "δ_POD", 2),
    "pod_size": Column(INTEGER, "", "Prescribed N; empty where the study gives a tolerance."),
    "dual_tol": Column(REAL, "1", "Tolerance δ_dual of the cone; empty where the study prescribes R.", "δ_dual", 3),
    "dual_size": Column(INTEGER, "", "Prescribed R; empty where the study gives a tolerance."),
    "primal_tol": Column(REAL, "1", "Tolerance δ of the primal strategy; empty for strategies that take none.", "δ", 6),
    "solver": Column(TEXT, "", "QP solver.", "solver", 7),
    "accuracy": Column(REAL, "1", "Relative accuracy prescribed to the solver.", "accuracy", 8),
    "assembly": Column(
        TEXT, "", "Assembly of the queries: full, reduced, or certified: reduced with bounds.", "assembly", 9
    ),
}
"""What names a cell. Where a study prescribes N or R, `pod_size` or `dual_size` is filled instead of the tolerance."""


def _medians(*names: str) -> dict[str, Column]:
    return {
        f"effectivity_{name}_median": Column(REAL, "1", f"Median effectivity of bound_{name} over the ok queries.")
        for name in names
    }


CELLS: Mapping[str, Column] = {
    "cell": Column(
        KEY,
        "",
        "Hash of everything that determines the numbers of the cell, except the code; commands accept its beginning.",
        "cell",
        0,
    ),
    **KEYS,
    "model": Column(TEXT, "", "Hash of the reduced model; cells that differ only in the solver share it."),
    "status": Column(
        f"{TEXT} NOT NULL", "", "Worst status of its queries, or of a stage that they need.", "status", 10
    ),
    "reason": Column(TEXT, "", "Why the cell is not ok: the first query with this status, and its fault."),
    "queries": Column(INTEGER, "", "Number of queries, one per validation parameter."),
    "queries_ok": Column(INTEGER, "", "Number of queries with status ok; means and maxima are over these.", "ok", 10),
    "snapshots": Column(
        INTEGER, "", "High-fidelity solutions that the training took: parameters of the training set.", "solved", 11
    ),
    "dim_V": Column(INTEGER, "", "Dimension n of V."),
    "dim_W": Column(INTEGER, "", "Dimension m of W."),
    "N": Column(INTEGER, "", "Dimension N of V_N.", "N", 11),
    "R": Column(INTEGER, "", "Number R of generators of the cone.", "R", 12),
    "rank": Column(INTEGER, "", "Numerical rank of the generators: dimension of their span."),
    "rank_gap": Column(
        REAL,
        "1",
        "Smallest singular value that counts towards the rank, divided by the next one or the threshold; "
        "near 1 the rank is doubtful.",
    ),
    "gram_condition": Column(
        REAL, "1", "Condition number of the Gram matrix of the generators in W, from their singular values."
    ),
    "enrichment": Column(
        INTEGER, "", "Vectors added to V_N; for an enrichment per parameter, the rank of the generators.", "added", 13
    ),
    "enrichment_kind": Column(TEXT, "", "none, fixed or per-parameter."),
    "interpolation_tol": Column(
        REAL, "1", "Tolerance of the interpolation in reduced assembly; empty with full assembly."
    ),
    "interpolation_error": Column(REAL, "1", "Largest relative interpolation error of a member over the training set."),
    "terms_A": Column(
        INTEGER,
        "",
        "Terms of A in a reduced query, each with a coefficient to evaluate; 0 if A is constant, empty if assembled.",
    ),
    "terms_f": Column(INTEGER, "", "Likewise for f."),
    "terms_B": Column(INTEGER, "", "Likewise for B; empty if B is assembled on the contact unknowns."),
    "terms_g": Column(INTEGER, "", "Likewise for g."),
    "offline_snapshots_s": Column(REAL, "s", "High-fidelity solutions at the training parameters, with one set-up."),
    "offline_selection_s": Column(
        REAL, "s", "Choice of the training parameters by error bounds, a part of the time before; 0 for fixed sets."
    ),
    "offline_pod_s": Column(REAL, "s", "POD."),
    "offline_cone_s": Column(REAL, "s", "Dual strategy, with the orthonormal basis of the span."),
    "offline_enrichment_s": Column(REAL, "s", "Primal strategy."),
    "offline_assembly_s": Column(REAL, "s", "Preparation of reduced assembly; 0 with full assembly."),
    "offline_certificate_s": Column(REAL, "s", "Preparation of certificates at online cost; 0 without."),
    "offline_s": Column(
        REAL,
        "s",
        "Offline time of this cell alone: the sum of these without `offline_selection_s`, a part of the first.",
        "offline [s]",
        22,
    ),
    "offline_low_s": Column(
        REAL,
        "s",
        "The same at the speed of the fastest timing rounds (2.5 % quantile), since offline work is timed only once.",
    ),
    "offline_high_s": Column(REAL, "s", "The same at the speed of the slowest timing rounds (97.5 % quantile)."),
    "offline_wall_s": Column(REAL, "s", "The same sum in wall seconds."),
    "online_s": Column(
        REAL,
        "s",
        "One query, assembly, solution and certificate: median over the rounds of the mean over ok queries.",
        "online [ms]",
        23,
    ),
    "online_q1_s": Column(REAL, "s", "Lower quartile over the rounds."),
    "online_q3_s": Column(REAL, "s", "Upper quartile over the rounds."),
    "online_wall_s": Column(REAL, "s", "The same as online_s, in wall seconds."),
    "online_assemble_s": Column(REAL, "s", "Assembly of a query: median over the rounds."),
    "online_solve_s": Column(REAL, "s", "Solution of a query by the solver: median over the rounds."),
    "online_certify_s": Column(
        REAL, "s", "Certificate of a query: median over the rounds; empty without certificates."
    ),
    "timing_rounds": Column(INTEGER, "", "Number of timing rounds; empty if the cell has not been timed yet."),
    "timing_reason": Column(TEXT, "", "Why rounds are missing."),
    "hf_setup_s": Column(
        REAL,
        "s",
        "Set-up of the high-fidelity solver, once: the time by which the first solution exceeds its repetition.",
    ),
    "hf_s": Column(REAL, "s", "One high-fidelity solution after the set-up: median over the validation parameters."),
    "hf_low_s": Column(REAL, "s", "Lower end of the 95 % interval of this median over the validation parameters."),
    "hf_high_s": Column(REAL, "s", "Upper end of this interval."),
    "beta_span_min": Column(
        REAL, "b/VW", "Smallest β over the span of the generators, over the validation parameters.", "min β span", 14
    ),
    "beta_cone_lower_min": Column(
        REAL, "b/VW", "Smallest certified lower bound of β over their cone.", "min β cone", 15
    ),
    "beta_cone_upper_min": Column(REAL, "b/VW", "Smallest upper bound of β over their cone."),
    "share_training": Column(
        REAL, "1", "Smallest ratio of β over the span to that of the whole of V, over the training parameters."
    ),
    "share_validation": Column(REAL, "1", "The same over the validation parameters."),
    "share_guaranteed": Column(
        REAL, "1", "√(1 − σ²), which bounds the share at training parameters where the strategy records σ."
    ),
    "error_u_mean": Column(REAL, "1", "Mean relative error of u in V over the ok queries with u ≠ 0.", "error u", 16),
    "error_u_max": Column(REAL, "1", "Largest relative error of u in V over these queries."),
    "queries_zero_u": Column(
        INTEGER, "", "Ok queries with zero_u = 1, which means and maxima of the error of u leave out.", "u = 0", 17
    ),
    "error_u_zero_max": Column(REAL, "1", "Largest error_u_scaled of these queries.", "error, u = 0", 18),
    "error_lambda_mean": Column(
        REAL, "1", "Mean relative error of λ in W over the ok queries with λ ≠ 0.", "error λ", 19
    ),
    "error_lambda_max": Column(REAL, "1", "Largest relative error of λ in W over these queries."),
    "queries_zero_lambda": Column(
        INTEGER, "", "Ok queries with zero_lambda = 1, which means and maxima of the error of λ leave out.", "λ = 0", 20
    ),
    "error_lambda_zero_max": Column(REAL, "1", "Largest error_lambda_scaled of these queries.", "error, λ = 0", 21),
    **_medians(
        "u_energy", "u", "lambda_natural", "lambda", "online_u_energy", "online_lambda_natural", "hsw_u", "hsw_lambda"
    ),
    "certificate": Column(TEXT, "", "Bounds at online cost: certified, verified, or none.", "certificate", 10),
    "bound_online_violations": Column(
        INTEGER, "", "Ok queries where bound_online_violated is 1; empty without a certificate."
    ),
    "solver_error_u_max": Column(REAL, "1", "Largest contribution of the QP solver to the relative error of u."),
    "solver_error_lambda_max": Column(REAL, "1", "Largest contribution of the QP solver to the relative error of λ."),
    "solver_share_max": Column(REAL, "1", "Largest ratio of this contribution to the error, over the queries."),
    "solver_share_mean": Column(
        REAL,
        "1",
        "Mean contribution of the QP solver divided by the mean error of u or λ; cells are compared only below 0.1.",
    ),
    "assembly_error_max": Column(REAL, "1", "Largest difference of a member of a reduced program from its projection."),
    "violation_max": Column(REAL, "u", "Largest constraint violation of a reduced solution."),
    "residual_max": Column(REAL, "1", "Largest of all recomputed residuals."),
    "fallbacks": Column(TEXT, "", "Steps that deviate from their algorithm, and what was done instead."),
    "peak_memory_mib": Column(REAL, "MiB", "Peak resident memory of the worker process."),
    "slowdown": Column(REAL, "1", "Time of the calibration next to the rounds, divided by its best in that process."),
    "disturbed": Column(
        INTEGER, "", "1 if the slowdown exceeds 1.3, or the wall seconds exceed 1.5 times the CPU seconds; else 0."
    ),
    "seed": Column(INTEGER, "", "Seed of the study."),
    "validation": Column(TEXT, "", "Validation set: own, or the label or name of its sampling strategy."),
    "validation_options": Column(
        TEXT, "", "Options of that strategy that are not at their default, as JSON.", whole=True
    ),
    "study_hash": Column(TEXT, "", "Hash of the study file."),
    "code": Column(TEXT, "", "Hash of the code of the core, the plugins and the solver."),
    "machine": Column(TEXT, "", "Machines that measured the seconds."),
    "threads": Column(INTEGER, "", "Threads of every timed process."),
    "versions": Column(TEXT, "", "Versions of Python, libraries and solver, as JSON.", whole=True),
    "definition": Column(TEXT, "", "Definition of the cell as JSON.", whole=True),
}


def _constants(prefix: str, whose: str) -> dict[str, Column]:
    return {
        f"{prefix}span": Column(REAL, "b/VW", f"β over the span of the generators, {whose}."),
        f"{prefix}cone_lower": Column(REAL, "b/VW", f"Certified lower bound of β over the cone, {whose}."),
        f"{prefix}cone_upper": Column(REAL, "b/VW", f"Upper bound of β over the cone, {whose}."),
    }


CONSTANTS: Mapping[str, Column] = {
    **_constants("beta_", "of the reduced pair"),
    **_constants("beta_full_", "with the whole of V"),
    **_constants("beta_plain_", "with V_N alone"),
    **_constants("beta_hf_", "of the high-fidelity pair, whose generators are all basis functions"),
}
"""Inf-sup columns of a query."""


def _effectivities(*names: str) -> dict[str, Column]:
    return {
        f"effectivity_{name}": Column(
            REAL,
            "1",
            f"bound_{name} divided by the absolute error; empty where the relative error in V or W, or the scaled one "
            "if there is none, is at most 1e-8.",
        )
        for name in names
    }


QUERIES: Mapping[str, Column] = {
    "cell": Column(MEMBER, "", "The cell it belongs to."),
    **KEYS,
    "query": Column(INTEGER, "", "Number of the validation parameter, from 0."),
    "form": Column(TEXT, "", "Form in which the program was solved: primal or dual."),
    "started_from": Column(INTEGER, "", "Query from whose solution the solver started; empty for a cold start."),
    "assembly_error": Column(REAL, "1", "Largest relative difference of a member of the program from its projection."),
    "assemble_s": Column(REAL, "s", "Assembly of the reduced program: median over the rounds."),
    "solve_s": Column(REAL, "s", "The solver: median over the rounds."),
    "certify_s": Column(REAL, "s", "The certificate: median over the rounds; empty without one."),
    "total_s": Column(REAL, "s", "Sum of the three."),
    "total_wall_s": Column(REAL, "s", "The same in wall seconds."),
    "hf_s": Column(
        REAL,
        "s",
        "High-fidelity solution at this parameter, with assembly but without set-up: median of the repetitions.",
    ),
    "zero_u": Column(
        INTEGER, "", "1 if the high-fidelity ‖u‖ is at most 1e-8 of the largest in the training set, else 0."
    ),
    "zero_lambda": Column(INTEGER, "", "Likewise for ‖λ‖; 1 means that there is no contact."),
    "error_u": Column(REAL, "1", "‖u − u_N‖ / ‖u‖ in V; empty where zero_u is 1."),
    "error_lambda": Column(REAL, "1", "‖λ − λ_N‖ / ‖λ‖ in W; empty where zero_lambda is 1."),
    "error_u_energy": Column(REAL, "1", "The error of u in the norm of A(µ), relative; empty where zero_u is 1."),
    "error_lambda_natural": Column(
        REAL, "1", "‖Bᵀ(λ − λ_N)‖ / ‖Bᵀλ‖ in the norm of A(µ)⁻¹; empty where zero_lambda is 1."
    ),
    "error_u_absolute": Column(REAL, "V", "‖u − u_N‖ in V."),
    "error_lambda_absolute": Column(REAL, "W", "‖λ − λ_N‖ in W."),
    "error_u_energy_absolute": Column(REAL, "A", "‖u − u_N‖ in the norm of A(µ)."),
    "error_lambda_natural_absolute": Column(REAL, "A", "‖Bᵀ(λ − λ_N)‖ in the norm of A(µ)⁻¹, an energy norm, too."),
    "error_u_scaled": Column(REAL, "1", "‖u − u_N‖ over the largest ‖u‖ of the training set."),
    "error_lambda_scaled": Column(REAL, "1", "‖λ − λ_N‖ over the largest ‖λ‖ of the training set."),
    "solver_error_u": Column(
        REAL,
        "1",
        "Distance of u from the solution of the reduced program to round-off, relative to ‖u‖; empty if error_u is "
        "empty or there is no such solution.",
    ),
    "solver_error_lambda": Column(
        REAL, "1", "Likewise for λ; also empty if the tight constraints are dependent, so that λ is not unique."
    ),
    "solver_share": Column(
        REAL,
        "1",
        "The larger of these two, each divided by its error of u or λ; empty if both errors are at most 1e-8.",
    ),
    "bound_u_energy": Column(REAL, "A", "Bound √(ρ² + ω² + 2κ) of error_u_energy_absolute."),
    "bound_u": Column(REAL, "V", "Bound of error_u_absolute: bound_u_energy divided by √α; see bound_note."),
    "bound_lambda_natural": Column(REAL, "A", "Bound of error_lambda_natural_absolute."),
    "bound_lambda": Column(
        REAL,
        "W",
        "Bound of error_lambda_absolute: bound_lambda_natural divided by β_A; infinite if no β_A > 0 is proved.",
    ),
    **_effectivities("u_energy", "u", "lambda_natural", "lambda"),
    "bound_rho": Column(REAL, "A", "ρ, the residual in the norm of A(µ)⁻¹."),
    "bound_rho_range": Column(
        REAL, "A", "ρ_B, the part of ρ in the range of Bᵀ, which bounds λ; ρ itself where constraints are dependent."
    ),
    "bound_omega": Column(REAL, "A", "ω, the norm of the correction w of the constraint violation."),
    "bound_kappa": Column(REAL, "A²", "κ = λ_Nᵀ(B w − s), the complementarity of w and λ_N."),
    "bound_note": Column(
        TEXT, "", "Why there are no bounds, or which of their constants is estimated; empty if they are proved."
    ),
    "certificate": Column(
        TEXT, "", "Bounds at online cost: certified, verified up to interpolation errors that were measured, or none."
    ),
    "bound_online_u_energy": Column(REAL, "A", "Bound of error_u_energy_absolute at online cost."),
    "bound_online_lambda_natural": Column(REAL, "A", "Bound of error_lambda_natural_absolute at online cost."),
    **_effectivities("online_u_energy", "online_lambda_natural"),
    "bound_online_rho": Column(REAL, "A", "Its bound of ρ."),
    "bound_online_omega": Column(REAL, "A", "Its bound of ω."),
    "bound_online_kappa": Column(REAL, "A²", "Its κ."),
    "coercivity_online": Column(
        REAL, "1", "Lower bound of A(µ) against A at the centre of the parameters; 1 where A is constant."
    ),
    "bound_online_violated": Column(
        INTEGER, "", "1 where an error is above its bound by more than 1e-10 of the solution, else 0; empty without."
    ),
    "bound_online_note": Column(
        TEXT,
        "",
        "Why there are no bounds at online cost, or no prepared correction was feasible and the best one was computed.",
    ),
    "bound_hsw_u": Column(
        REAL,
        "V",
        "Bound Δ_u of Haasdonk, Salomon and Wohlmuth with an estimated β_HF; infinite if β_HF over the span is 0.",
    ),
    "bound_hsw_lambda": Column(REAL, "W", "Their bound Δ_λ of the error of λ, with the same constant."),
    **_effectivities("hsw_u", "hsw_lambda"),
    "coercivity": Column(REAL, "A/V²", "α, a lower bound of the smallest vᵀA(µ)v / ‖v‖²."),
    "coercivity_proved": Column(INTEGER, "", "1 if a factorisation proves it, 0 if it is a Lanczos estimate."),
    "continuity": Column(REAL, "A/V²", "γ_a, an upper bound of the largest vᵀA(µ)v / ‖v‖²."),
    "continuity_proved": Column(INTEGER, "", "1 if a factorisation proves it, 0 if it is a Lanczos estimate."),
    "beta_energy": Column(
        REAL, "b/AW", "β_A, proved lower bound of the inf-sup constant of V in the norm of A(µ) and W over the span."
    ),
    "outputs": Column(
        TEXT,
        "",
        "Quantities of interest as JSON: value, high-fidelity reference, relative error, error over the scale.",
        whole=True,
    ),
    "violation": Column(
        REAL, "u", "Largest (B u_N − g)₊, each row divided by the integral of its multiplier function."
    ),
    "complementarity": Column(REAL, "b", "λᵀ(B u_N − g), λ the high-fidelity multiplier."),
    **CONSTANTS,
    "bounds": Column(TEXT, "", "Bounds that determine the interval of the reduced pair, lower/upper."),
    "status": Column(
        f"{TEXT} NOT NULL", "", "ok, inaccurate, nonfinite, infeasible, failed, timeout, crashed or error."
    ),
    "reason": Column(TEXT, "", "Why the status is not ok."),
    "solver_status": Column(TEXT, "", "Status reported by the solver."),
    "primal_residual": Column(REAL, "1", "Primal residual, recomputed, relative."),
    "dual_residual": Column(REAL, "1", "Dual residual, recomputed, relative."),
    "gap": Column(REAL, "1", "Duality gap, recomputed, relative."),
    "iterations": Column(INTEGER, "", "Iterations reported by the solver."),
    "repeatable": Column(
        INTEGER, "", "1 if a second solution was identical to the last bit, else 0; empty if there was none."
    ),
}

TIMINGS: Mapping[str, Column] = {
    "cell": Column(MEMBER, "", "The cell it belongs to."),
    **KEYS,
    "round": Column(INTEGER, "", "Number of the round, from 0; the rounds of cells that are compared are interleaved."),
    "queries": Column(INTEGER, "", "Number of ok queries solved in the round."),
    "assemble_s": Column(REAL, "s", "Assembly of a query: mean over these, or with full assembly that of one of them."),
    "solve_s": Column(REAL, "s", "Solution of a query by the solver: mean over these."),
    "certify_s": Column(REAL, "s", "Certificate of a query: mean over these; empty without one."),
    "total_s": Column(REAL, "s", "Sum of the three."),
    "total_wall_s": Column(REAL, "s", "The same in wall seconds."),
    "slowdown": Column(REAL, "1", "Time of the calibration next to the round, divided by its best in that process."),
}

PARAMETER = Column(REAL, "µ", "The k-th parameter.")
"""What mu_1, mu_2, … of the queries are, as many as the problem has parameters."""


def _without(*names: str) -> dict[str, Column]:
    return {name: column for name, column in KEYS.items() if name not in names}


HISTORY_KEYS = _without("solver", "accuracy", "assembly")

HISTORIES: Mapping[str, Column] = {
    "artefact": Column(TEXT, "", "Hash of the stage it comes from."),
    "stage": Column(
        TEXT,
        "",
        "pod, cone, enrichment or selection; training or validation for diagnostics of the problem.",
    ),
    **HISTORY_KEYS,
    "quantity": Column(TEXT, "", "Name of the quantity."),
    "step": Column(INTEGER, "", "Step of the algorithm, or number of the parameter."),
    "value": Column(REAL, "1", "The value; inf-sup constants are in the unit of β, diagnostics in their own units."),
}

THRESHOLDS: Mapping[str, Column] = {
    **_without("primal", "primal_options", "primal_tol", "assembly"),
    "cell_a": Column(TEXT, "", "Cell of model a; empty for the high-fidelity model."),
    "cell_b": Column(TEXT, "", "Cell of model b."),
    "primal_a": Column(TEXT, "", "Model a: its primal strategy, or high-fidelity.", "a", 11),
    "primal_tol_a": Column(REAL, "1", "Tolerance of the primal strategy of a."),
    "assembly_a": Column(TEXT, "", "Assembly of the queries of a.", "assembly a", 12),
    "primal_b": Column(TEXT, "", "Model b: its primal strategy.", "b", 13),
    "primal_tol_b": Column(REAL, "1", "Tolerance of the primal strategy of b.", "δ of b", 15),
    "assembly_b": Column(TEXT, "", "Assembly of the queries of b.", "assembly b", 14),
    "offline_a_s": Column(REAL, "s", "Offline seconds of a.", "offline a [s]", 16),
    "online_a_s": Column(REAL, "s", "Seconds of a query of a.", "online a [ms]", 17),
    "offline_b_s": Column(REAL, "s", "Offline seconds of b.", "offline b [s]", 18),
    "online_b_s": Column(REAL, "s", "Seconds of a query of b.", "online b [ms]", 19),
    "benefit_threshold": Column(
        REAL,
        "1",
        "Number n* of queries at break-even; empty if there is none or it is undecided.",
        "break-even",
        20,
    ),
    "threshold_low": Column(REAL, "1", "Lower end of the 95 % interval of n*; if undecided, the smallest n*."),
    "threshold_high": Column(REAL, "1", "Upper end of the 95 % interval of n*.", "interval", 21),
    "meaning": Column(
        TEXT,
        "",
        "Queries for which b is cheaper than a in total: from n* on, until n*, never or at once; or undecided.",
    ),
}

DISAGREEMENTS: Mapping[str, Column] = {
    **_without("solver"),
    "solver_a": Column(TEXT, "", "One solver."),
    "solver_b": Column(TEXT, "", "The other."),
    "queries": Column(INTEGER, "", "Number of queries that both solved."),
    "difference_max": Column(REAL, "1", "Largest distance of their u in V, relative to that of solver_a."),
    "query_worst": Column(INTEGER, "", "Query with this difference."),
    "allowed_worst": Column(REAL, "1", "Largest difference that the accuracy allows there, relative."),
    "flagged": Column(INTEGER, "", "Number of queries with a difference larger than the accuracy allows."),
    "query_flagged": Column(INTEGER, "", "First of these queries."),
}

SOLUTIONS: Mapping[str, Column] = {
    "cell": Column(MEMBER, "", "The cell it belongs to."),
    "query": Column(INTEGER, "", "Number of the validation parameter."),
    "x": Column(BLOB, "V", "Coefficients in the V-orthonormal primal basis, little-endian doubles."),
    "alpha": Column(BLOB, "W", "Coefficients of the generators, little-endian doubles."),
    "slack_linear": Column(REAL, "V", "Linear coefficient l of the distance that the accuracy leaves open."),
    "slack_constant": Column(REAL, "V²", "Constant c in the square of that distance."),
}

OUTPUTS: Mapping[str, Column] = {
    "cell": Column(MEMBER, "", "The cell it belongs to.", "cell", 0),
    **KEYS,
    "output": Column(TEXT, "", "Quantity of interest, as its problem names it.", "output", 10),
    "unit": Column(TEXT, "", "Its unit.", "unit", 11),
    "linear": Column(INTEGER, "", "1 where it is linear in u and λ with fixed coefficients, else 0."),
    "scale": Column(REAL, "o", "Its largest absolute value over the training set.", "scale", 12),
    "queries_ok": Column(INTEGER, "", "Ok queries, over which means and maxima are."),
    "error_mean": Column(REAL, "1", "Mean relative error, where the output is not zero.", "error", 13),
    "error_max": Column(REAL, "1", "Largest relative error, likewise.", "largest", 14),
    "queries_zero": Column(INTEGER, "", "Ok queries where it is at most 1e-8 of its scale: no contact, for instance."),
    "error_zero_max": Column(REAL, "1", "Largest error of these, over the scale."),
    "error_scaled_mean": Column(REAL, "1", "Mean error over the scale, of all ok queries.", "error / scale", 15),
    "error_scaled_max": Column(REAL, "1", "Largest error over the scale, likewise."),
}

PICTURES: Mapping[str, Column] = {
    "problem": Column(TEXT, "", "Problem: its label in the study, or its name."),
    "problem_options": Column(TEXT, "", "Options of the problem that are not at their default, as JSON.", whole=True),
    "number": Column(INTEGER, "", "Number of the picture."),
    "title": Column(TEXT, "", "The parameter, as text."),
    "names": Column(TEXT, "", "Names of the field and of the multiplier with their units, as JSON.", whole=True),
    "data": Column(BLOB, "", "Mesh, field and multiplier in single precision, a compressed archive of NumPy."),
    "reason": Column(TEXT, "", "Why there is no picture, if it could not be made."),
}

TABLES: Mapping[str, Mapping[str, Column]] = {
    "cells": CELLS,
    "queries": QUERIES,
    "histories": HISTORIES,
    "timings": TIMINGS,
    "thresholds": THRESHOLDS,
    "disagreements": DISAGREEMENTS,
    "outputs": OUTPUTS,
}
"""The tables for reading; each is exported as CSV."""

STORED: Mapping[str, Mapping[str, Column]] = {**TABLES, "solutions": SOLUTIONS, "pictures": PICTURES}
"""All tables of the results file."""


def shown_columns(table: Mapping[str, Column]) -> dict[str, Column]:
    """The columns of a table that are shown in the table for reading made of it, in the order of their places."""
    return dict(sorted(((name, c) for name, c in table.items() if c.heading), key=lambda item: item[1].place))
