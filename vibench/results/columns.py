"""The one table of the columns of the results: SQLite type, unit, meaning, and where each is shown.

The schema of the results file, the documentation and the tables for reading follow from it: a new column is one entry
here and the line that fills it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

VERSION = 11
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
    "s": "CPU seconds of one process, unless wall seconds are said",
    "ms": "thousandths of these",
    "MiB": "2²⁰ bytes",
    "µ": "the parameter's own unit, which its problem declares",
    "u": "the unit of the displacement",
    "V": "the unit of the norm of V",
    "V²": "its square",
    "W": "the unit of the norm of W",
    "b/AW": "that of b(v, η) over those of the energy norm and the norm of W",
    "A/V²": "that of the energy over the square of that of the norm of V",
    "A": "the unit of the energy norm, the norm of A(µ)",
    "A²": "its square, that of the energy",
    "b": "the unit of b(v, η), as that of the energy",
    "o": "the unit of the output, in the column unit",
    "b/VW": "that of b(v, η) over those of the norms of V and W",
}
"""The units and what they stand for; those of V, W and b depend on the problem."""

KEYS: Mapping[str, Column] = {
    "problem": Column(TEXT, "", "Problem: its label in the study, or its name.", "problem", 1),
    "problem_options": Column(TEXT, "", "Options of the problem that are not at their default, as JSON.", whole=True),
    "training": Column(TEXT, "", "Training set: own, or the label or name of its sampling strategy.", "training", 2),
    "training_options": Column(TEXT, "", "Options of the sampling strategy, likewise.", whole=True),
    "dual": Column(TEXT, "", "Dual strategy, likewise.", "dual", 4),
    "dual_options": Column(TEXT, "", "Its options, likewise.", whole=True),
    "primal": Column(TEXT, "", "Primal strategy, likewise.", "primal", 5),
    "primal_options": Column(TEXT, "", "Its options, likewise.", whole=True),
    "pod_tol": Column(REAL, "1", "Tolerance δ_POD of the POD; empty where the study prescribes N.", "δ_POD", 2),
    "pod_size": Column(INTEGER, "", "Prescribed N; empty where the study gives a tolerance."),
    "dual_tol": Column(REAL, "1", "Tolerance δ_dual of the cone; empty where the study prescribes R.", "δ_dual", 3),
    "dual_size": Column(INTEGER, "", "Prescribed R; empty where the study gives a tolerance."),
    "primal_tol": Column(REAL, "1", "Tolerance δ of the primal strategy; empty for strategies that take none.", "δ", 6),
    "solver": Column(TEXT, "", "QP solver.", "solver", 7),
    "accuracy": Column(REAL, "1", "Relative accuracy prescribed to it.", "accuracy", 8),
    "assembly": Column(TEXT, "", "How queries are assembled: full or reduced.", "assembly", 9),
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
        "Hash of everything that determines the cell's numbers, the code aside; `replay` takes it, or its beginning.",
        "cell",
        0,
    ),
    **KEYS,
    "model": Column(TEXT, "", "Hash of the reduced model; cells that differ in their solver alone share it."),
    "status": Column(f"{TEXT} NOT NULL", "", "The worst status of its queries, or of a stage they need.", "status", 10),
    "reason": Column(TEXT, "", "Why it is not ok: the first query with this status and what was wrong there."),
    "queries": Column(INTEGER, "", "Queries asked: one per validation parameter."),
    "queries_ok": Column(INTEGER, "", "Queries that are ok; means and maxima are over these.", "ok", 10),
    "snapshots": Column(
        INTEGER, "", "High-fidelity solutions that the training took: parameters of the training set.", "solved", 11
    ),
    "dim_V": Column(INTEGER, "", "Dimension n of V."),
    "dim_W": Column(INTEGER, "", "Dimension m of W."),
    "N": Column(INTEGER, "", "Dimension of V_N.", "N", 11),
    "R": Column(INTEGER, "", "Generators of the cone.", "R", 12),
    "rank": Column(INTEGER, "", "Numerical rank of the generators: dimension of their span."),
    "rank_gap": Column(
        REAL,
        "1",
        "Last singular value that counts for the rank over the next, or the threshold; near 1 the rank is in doubt.",
    ),
    "gram_condition": Column(
        REAL, "1", "Condition number of the Gram matrix of the generators in W, from their singular values."
    ),
    "enrichment": Column(
        INTEGER, "", "Vectors added to V_N; of an enrichment per parameter, the rank of the generators.", "added", 13
    ),
    "enrichment_kind": Column(TEXT, "", "none, fixed or per-parameter."),
    "interpolation_tol": Column(
        REAL, "1", "Tolerance of the interpolation in reduced assembly; empty where it is not asked for."
    ),
    "interpolation_error": Column(REAL, "1", "Largest relative interpolation error of a member over the training set."),
    "terms_A": Column(
        INTEGER, "", "Entries of A that a reduced query samples; 0 where A is constant, empty where not sampled."
    ),
    "terms_f": Column(INTEGER, "", "The same of f."),
    "terms_B": Column(INTEGER, "", "The same of B; empty, too, where it is assembled on the contact."),
    "terms_g": Column(INTEGER, "", "The same of g."),
    "offline_snapshots_s": Column(REAL, "s", "High-fidelity solutions over the training set, with one set-up."),
    "offline_pod_s": Column(REAL, "s", "POD."),
    "offline_cone_s": Column(REAL, "s", "Dual strategy, with the orthonormal basis of the span."),
    "offline_enrichment_s": Column(REAL, "s", "Primal strategy."),
    "offline_assembly_s": Column(REAL, "s", "What reduced assembly prepares; 0 in full."),
    "offline_s": Column(REAL, "s", "Sum of the five above, what the cell alone would have taken.", "offline [s]", 22),
    "offline_low_s": Column(
        REAL, "s", "The same at the quickest of the rounds of timing: it is measured once, at whatever speed."
    ),
    "offline_high_s": Column(REAL, "s", "The same at the slowest of them; 2.5 and 97.5 % quantiles."),
    "offline_wall_s": Column(REAL, "s", "The same sum in wall seconds."),
    "online_s": Column(
        REAL,
        "s",
        "One query, assembly and solution: median over the rounds of the mean over ok queries.",
        "online [ms]",
        23,
    ),
    "online_q1_s": Column(REAL, "s", "Lower quartile over the rounds."),
    "online_q3_s": Column(REAL, "s", "Upper quartile over the rounds."),
    "online_wall_s": Column(REAL, "s", "One query in wall seconds, likewise."),
    "online_assemble_s": Column(REAL, "s", "Assembly of a query: median over the rounds."),
    "online_solve_s": Column(REAL, "s", "Solution of a query by the solver: median over the rounds."),
    "timing_rounds": Column(INTEGER, "", "Rounds of timing asked; empty where the cell was not timed yet."),
    "timing_reason": Column(TEXT, "", "Why rounds are missing."),
    "hf_setup_s": Column(
        REAL, "s", "Set-up of the high-fidelity solver, once: what the first solution takes beyond its repetition."
    ),
    "hf_s": Column(REAL, "s", "One high-fidelity solution after the set-up: median over the validation parameters."),
    "hf_low_s": Column(REAL, "s", "Lower end of the 95 % interval of this median over the validation parameters."),
    "hf_high_s": Column(REAL, "s", "Its upper end."),
    "beta_span_min": Column(
        REAL, "b/VW", "Smallest β over the span of the generators, over the validation parameters.", "min β span", 14
    ),
    "beta_cone_lower_min": Column(
        REAL, "b/VW", "Smallest certified lower bound of β over their cone.", "min β cone", 15
    ),
    "beta_cone_upper_min": Column(REAL, "b/VW", "Smallest upper bound of β over their cone."),
    "share_training": Column(
        REAL, "1", "Smallest share of β over the span in that of the whole of V, over the training parameters."
    ),
    "share_validation": Column(REAL, "1", "The same over the validation parameters."),
    "share_guaranteed": Column(
        REAL, "1", "√(1 − σ²), which bounds the share at training parameters where the strategy records σ."
    ),
    "error_u_mean": Column(REAL, "1", "Mean relative error of u in V, where it is not zero.", "error u", 16),
    "error_u_max": Column(REAL, "1", "Largest relative error of u in V, likewise."),
    "queries_zero_u": Column(
        INTEGER, "", "Ok queries where zero_u is 1: no mean or maximum of u counts them.", "u = 0", 17
    ),
    "error_u_zero_max": Column(REAL, "1", "Largest error_u_scaled of these.", "error, u = 0", 18),
    "error_lambda_mean": Column(REAL, "1", "Mean relative error of λ in W, where it is not zero.", "error λ", 19),
    "error_lambda_max": Column(REAL, "1", "Largest relative error of λ in W, likewise."),
    "queries_zero_lambda": Column(
        INTEGER, "", "Ok queries where zero_lambda is 1: no mean or maximum of λ counts them.", "λ = 0", 20
    ),
    "error_lambda_zero_max": Column(REAL, "1", "Largest error_lambda_scaled of these.", "error, λ = 0", 21),
    **_medians("u_energy", "u", "lambda_natural", "lambda", "hsw_u", "hsw_lambda"),
    "solver_error_u_max": Column(REAL, "1", "Largest part of the error of u that the QP solver makes."),
    "solver_error_lambda_max": Column(REAL, "1", "Largest part of the error of λ that it makes."),
    "solver_share_max": Column(REAL, "1", "Largest share of an error that it makes, over the queries."),
    "solver_share_mean": Column(
        REAL, "1", "Mean of what it makes over the mean error of u or λ; cells are compared only where it is below 0.1."
    ),
    "assembly_error_max": Column(REAL, "1", "Largest difference of a member of a reduced program from its projection."),
    "violation_max": Column(REAL, "u", "Largest constraint violation of a reduced solution."),
    "residual_max": Column(REAL, "1", "Largest of all recomputed residuals."),
    "fallbacks": Column(TEXT, "", "Every step that could not be done as its algorithm says."),
    "peak_memory_mib": Column(REAL, "MiB", "Peak of the resident memory of the worker process."),
    "slowdown": Column(REAL, "1", "Seconds of the calibration beside the rounds, over its best in that process."),
    "disturbed": Column(
        INTEGER, "", "1 where the slowdown is above 1.3, or wall seconds above 1.5 times the CPU seconds."
    ),
    "seed": Column(INTEGER, "", "Seed of the study."),
    "validation": Column(TEXT, "", "Validation set: own, or the label or name of its sampling strategy."),
    "validation_options": Column(
        TEXT, "", "Options of that strategy that are not at their default, as JSON.", whole=True
    ),
    "study_hash": Column(TEXT, "", "Hash of the whole study file as it was read."),
    "code": Column(TEXT, "", "Hash of the code: core, plugins, solver."),
    "machine": Column(TEXT, "", "Machines that measured the seconds."),
    "threads": Column(INTEGER, "", "Threads of every timed process."),
    "versions": Column(TEXT, "", "Versions of Python, libraries and solver, as JSON.", whole=True),
    "definition": Column(TEXT, "", "The whole cell as JSON.", whole=True),
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
            f"bound_{name} over the absolute error; empty up to 1e-8 of the relative error in V or W, or of the scaled "
            "one where that is empty.",
        )
        for name in names
    }


QUERIES: Mapping[str, Column] = {
    "cell": Column(MEMBER, "", "The cell it belongs to."),
    **KEYS,
    "query": Column(INTEGER, "", "Number of the validation parameter, from 0."),
    "form": Column(TEXT, "", "Form in which the program was solved: primal or dual."),
    "started_from": Column(INTEGER, "", "Query whose solution the solver started from, if any."),
    "assembly_error": Column(REAL, "1", "Largest relative difference of a member of the program from its projection."),
    "assemble_s": Column(REAL, "s", "Assembly of the reduced program: median over the rounds."),
    "solve_s": Column(REAL, "s", "The solver: median over the rounds."),
    "total_s": Column(REAL, "s", "Sum of the two."),
    "total_wall_s": Column(REAL, "s", "The same in wall seconds."),
    "hf_s": Column(
        REAL, "s", "The high-fidelity solution at this parameter, assembly included, set-up not: median of the repeats."
    ),
    "zero_u": Column(
        INTEGER, "", "1 where the high-fidelity ‖u‖ is at most 1e-8 of the largest of the training set, else 0."
    ),
    "zero_lambda": Column(INTEGER, "", "The same of ‖λ‖: 1 where there is no contact."),
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
        "Distance of u from the reduced program solved to round-off, over ‖u‖; empty where error_u is, or not solved.",
    ),
    "solver_error_lambda": Column(
        REAL, "1", "The same of λ; empty, too, where the tight constraints are dependent and λ is not unique."
    ),
    "solver_share": Column(
        REAL, "1", "The larger of these two over the error of u or λ; empty where both errors are at most 1e-8."
    ),
    "bound_u_energy": Column(REAL, "A", "Bound √(ρ² + ω² + 2κ) of error_u_energy_absolute."),
    "bound_u": Column(REAL, "V", "Bound of error_u_absolute: the one before over √α; see bound_note."),
    "bound_lambda_natural": Column(REAL, "A", "Bound of error_lambda_natural_absolute."),
    "bound_lambda": Column(
        REAL, "W", "Bound of error_lambda_absolute: the one before over β_A; infinite where no β_A > 0 is proved."
    ),
    **_effectivities("u_energy", "u", "lambda_natural", "lambda"),
    "bound_rho": Column(REAL, "A", "ρ, the residual in the norm of A(µ)⁻¹."),
    "bound_omega": Column(REAL, "A", "ω, the norm of the lifting w of the constraint violation."),
    "bound_kappa": Column(REAL, "A²", "κ = λ_Nᵀ(B w − s), its complementarity."),
    "bound_note": Column(
        TEXT, "", "Why there are no bounds, or which constant in them is estimated; empty where they are proved."
    ),
    "bound_hsw_u": Column(
        REAL,
        "V",
        "Bound Δ_u of Haasdonk, Salomon and Wohlmuth, β_HF in it estimated; infinite where β_HF over the span is 0.",
    ),
    "bound_hsw_lambda": Column(REAL, "W", "Their bound Δ_λ of the error of λ, likewise."),
    **_effectivities("hsw_u", "hsw_lambda"),
    "coercivity": Column(REAL, "A/V²", "α, a lower bound of the smallest vᵀA(µ)v / ‖v‖²."),
    "coercivity_proved": Column(INTEGER, "", "1 where a factorisation proves it, 0 where it is a Lanczos estimate."),
    "continuity": Column(REAL, "A/V²", "γ_a, an upper bound of the largest one."),
    "continuity_proved": Column(INTEGER, "", "1 where a factorisation proves it, 0 where it is a Lanczos estimate."),
    "beta_energy": Column(
        REAL, "b/AW", "β_A, proved lower bound of the inf-sup constant of V in the norm of A(µ) and W over the span."
    ),
    "outputs": Column(
        TEXT,
        "",
        "Quantities of interest as JSON: value, high-fidelity reference, relative error, error over the scale.",
        whole=True,
    ),
    "violation": Column(REAL, "u", "Largest (B u_N − g)₊, every row over the integral of its multiplier function."),
    "complementarity": Column(REAL, "b", "λᵀ(B u_N − g), λ the high-fidelity multiplier."),
    **CONSTANTS,
    "bounds": Column(TEXT, "", "Which bounds gave the interval of the reduced pair, lower/upper."),
    "status": Column(
        f"{TEXT} NOT NULL", "", "ok, inaccurate, nonfinite, infeasible, failed, timeout, crashed or error."
    ),
    "reason": Column(TEXT, "", "Why it is not ok."),
    "solver_status": Column(TEXT, "", "What the solver says of itself."),
    "primal_residual": Column(REAL, "1", "Recomputed, relative."),
    "dual_residual": Column(REAL, "1", "Recomputed, relative."),
    "gap": Column(REAL, "1", "Recomputed, relative."),
    "iterations": Column(INTEGER, "", "Iterations the solver reports."),
    "repeatable": Column(
        INTEGER, "", "1 where a second solution was the same to the last bit; empty if there was none."
    ),
}

TIMINGS: Mapping[str, Column] = {
    "cell": Column(MEMBER, "", "The cell it belongs to."),
    **KEYS,
    "round": Column(INTEGER, "", "Number of the round, from 0; rounds of cells that are compared are interleaved."),
    "queries": Column(INTEGER, "", "Ok queries that were solved in it."),
    "assemble_s": Column(REAL, "s", "Assembly of a query: mean over these; in full, that of one of them."),
    "solve_s": Column(REAL, "s", "Solution of a query by the solver: mean over these."),
    "total_s": Column(REAL, "s", "Sum of the two."),
    "total_wall_s": Column(REAL, "s", "The same in wall seconds."),
    "slowdown": Column(REAL, "1", "Seconds of the calibration beside it, over its best in that process."),
}

PARAMETER = Column(REAL, "µ", "The k-th parameter.")
"""What mu_1, mu_2, … of the queries are, as many as the problem has parameters."""


def _without(*names: str) -> dict[str, Column]:
    return {name: column for name, column in KEYS.items() if name not in names}


HISTORY_KEYS = _without("solver", "accuracy", "assembly")

HISTORIES: Mapping[str, Column] = {
    "artefact": Column(TEXT, "", "Hash of the stage it comes from."),
    "stage": Column(
        TEXT, "", "pod, cone or enrichment; training or validation for what a problem tells of its solutions."
    ),
    **HISTORY_KEYS,
    "quantity": Column(TEXT, "", "What the values are."),
    "step": Column(INTEGER, "", "Step of the algorithm, or number of the parameter."),
    "value": Column(REAL, "1", "The value; constants are in the unit of β, diagnostics in one of their own."),
}

THRESHOLDS: Mapping[str, Column] = {
    **_without("primal", "primal_options", "primal_tol", "assembly"),
    "cell_a": Column(TEXT, "", "Cell of way a; empty for the high-fidelity model."),
    "cell_b": Column(TEXT, "", "Cell of way b."),
    "primal_a": Column(TEXT, "", "Way a: a primal strategy, or high-fidelity.", "a", 11),
    "primal_tol_a": Column(REAL, "1", "Its tolerance."),
    "assembly_a": Column(TEXT, "", "How its queries are assembled.", "assembly a", 12),
    "primal_b": Column(TEXT, "", "Way b, which is compared with it.", "b", 13),
    "primal_tol_b": Column(REAL, "1", "Its tolerance.", "δ of b", 15),
    "assembly_b": Column(TEXT, "", "How its queries are assembled.", "assembly b", 14),
    "offline_a_s": Column(REAL, "s", "Offline seconds of a.", "offline a [s]", 16),
    "online_a_s": Column(REAL, "s", "Seconds of a query of a.", "online a [ms]", 17),
    "offline_b_s": Column(REAL, "s", "Offline seconds of b.", "offline b [s]", 18),
    "online_b_s": Column(REAL, "s", "Seconds of a query of b.", "online b [ms]", 19),
    "benefit_threshold": Column(
        REAL,
        "1",
        "Number n* of queries; empty where there is none or it is undecided.",
        "break-even",
        20,
    ),
    "threshold_low": Column(REAL, "1", "Lower end of its 95 % interval; of what is undecided, the smallest n*."),
    "threshold_high": Column(REAL, "1", "Upper end of its 95 % interval.", "interval", 21),
    "meaning": Column(
        TEXT, "", "When b is cheaper than a in total: from n* on, until n*, never, or at once; or undecided."
    ),
}

DISAGREEMENTS: Mapping[str, Column] = {
    **_without("solver"),
    "solver_a": Column(TEXT, "", "One solver."),
    "solver_b": Column(TEXT, "", "The other."),
    "queries": Column(INTEGER, "", "Queries that both solved."),
    "difference_max": Column(REAL, "1", "Largest distance of their u in V, relative to that of solver_a."),
    "query_worst": Column(INTEGER, "", "Query where it is found."),
    "allowed_worst": Column(REAL, "1", "What the accuracy allows there, relative."),
    "flagged": Column(INTEGER, "", "Queries where they are farther apart than the accuracy allows."),
    "query_flagged": Column(INTEGER, "", "The first of these."),
}

SOLUTIONS: Mapping[str, Column] = {
    "cell": Column(MEMBER, "", "The cell it belongs to."),
    "query": Column(INTEGER, "", "Number of the validation parameter."),
    "x": Column(BLOB, "V", "Coefficients in the V-orthonormal primal basis, little-endian doubles."),
    "alpha": Column(BLOB, "W", "Coefficients of the generators, likewise."),
    "slack_linear": Column(REAL, "V", "Share l of the distance that the accuracy leaves open."),
    "slack_constant": Column(REAL, "V²", "Share c of its square."),
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
    "title": Column(TEXT, "", "Its parameter."),
    "names": Column(TEXT, "", "What the field and the multiplier are, with their units, as JSON.", whole=True),
    "data": Column(BLOB, "", "Mesh, field and multiplier in single precision, a compressed archive of NumPy."),
    "reason": Column(TEXT, "", "Why there is none, where there should be."),
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
