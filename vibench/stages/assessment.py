"""Errors, bounds and residuals of the answers u_N, λ_N of queries, the same for every model, and their summary."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model import errors as measured
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee
from vibench.model.certificates.bounds import OnlineBound
from vibench.model.error_bounds import ErrorBounds, error_bounds
from vibench.model.errors import UNMEASURABLE, ReferenceSolutions
from vibench.model.galerkin import ReducedModel
from vibench.model.hsw_bounds import HSWBounds, hsw_bounds
from vibench.model.hyperreduced import AnyReducedModel
from vibench.offline.assemblies import assemblies
from vibench.offline.solution import Answer, Corrector
from vibench.qp.exact import ExactSolution
from vibench.qp.scaling import ratio
from vibench.qp.status import Status
from vibench.results.schema import STORED
from vibench.stability.coercivity import Stability
from vibench.stages.base import Row


def pair_columns(
    problem: Problem, mus: Array, vis: Sequence[VariationalInequality], u: Array, lam: Array,
    reference: ReferenceSolutions, constants: Sequence[Stability],
) -> list[Row]:  # fmt: skip
    """Columns of answers u (n×P), λ (m×P) at parameters (P×d): errors, their bounds, residuals and outputs."""
    energies = [assemblies(problem).energy_at(mu) for mu in mus]
    forces = measured.of_stiffness(energies, u)
    residuals = [vi.f - force - vi.B.T @ of_lam for vi, force, of_lam in zip(vis, forces.T, lam.T, strict=True)]
    proved = [(one.coercivity, one.energy_inf_sup) for one in constants]
    bounds = error_bounds(problem.V, vis, energies, proved, u, lam, problem.K.free(reference.lam), residuals)
    hsw = hsw_bounds(problem, vis, constants, u, lam, residuals)
    errors = measured.errors(problem, vis, energies, reference, u, lam)
    rows = [_columns(*one) for one in zip(errors, bounds, hsw, strict=True)]
    outputs = measured.output_errors(problem.outputs, mus, (u, lam), reference)
    sizes = measured.energy_norms(u, forces).tolist()
    pairs = zip(rows, bounds, outputs, sizes, vis, energies, u.T, lam.T, strict=True)
    for row, bound, of_query, size, vi, energy, of_u, of_lam in pairs:
        hf = measured.high_fidelity_residuals(vi, energy, of_u, of_lam, bound.rho, size)
        row |= {"hf_primal_residual": hf.primal, "hf_dual_residual": hf.dual, "hf_gap": hf.gap, "outputs": of_query}
    return rows


def _columns(error: measured.Errors, bounds: ErrorBounds, hsw: HSWBounds | None) -> Row:
    row: Row = asdict(error) | {"bound_note": bounds.note}
    # Errors below round-off have no effectivity. Those of zero solutions are relative to the largest training solution.
    of_u = (error.error_u_scaled if error.error_u is None else error.error_u) > UNMEASURABLE
    of_lam = (error.error_lambda_scaled if error.error_lambda is None else error.error_lambda) > UNMEASURABLE
    # A bound, whether its error is measurable, and the error.
    checked: dict[str, tuple[float, bool, float]] = {}
    if np.isfinite(bounds.u_energy):
        row |= {f"bound_{name}": getattr(bounds, name) for name in ("rho", "rho_range", "omega", "kappa")}
        checked |= {
            "u_energy": (bounds.u_energy, of_u, error.error_u_energy_absolute),
            "u": (bounds.u, of_u, error.error_u_absolute),
            "lambda_natural": (bounds.lambda_natural, of_lam, error.error_lambda_natural_absolute),
            "lambda": (bounds.lam, of_lam, error.error_lambda_absolute),
        }
    if hsw is not None:
        checked["hsw_u"] = hsw.u, of_u, error.error_u_absolute
        checked["hsw_lambda"] = hsw.lam, of_lam, error.error_lambda_absolute
    for name, (bound, measurable, absolute) in checked.items():
        row[f"bound_{name}"] = bound
        if measurable:
            row[f"effectivity_{name}"] = ratio(bound, absolute)
    return row


def online_columns(bound: OnlineBound, error: Row) -> Row:
    """The bounds at online cost, and the effectivities of those whose bounds at high-fidelity cost have one."""
    row: Row = {"certificate": bound.guarantee.value, "bound_online_note": bound.note}
    if bound.guarantee is Guarantee.NONE:
        return row
    violated, bounds = False, {"u_energy": bound.u_energy, "lambda_natural": bound.lambda_natural}
    # The bound in W divides by a lower bound of β_A, which may be zero.
    if bound.inf_sup > 0.0:
        bounds["lambda"] = bound.lam
    for name, value in bounds.items():
        absolute, relative = error[f"error_{name}_absolute"], error[f"error_{name}"]
        row[f"bound_online_{name}"] = value
        if f"effectivity_{name}" in error:
            row[f"effectivity_online_{name}"] = ratio(value, absolute)
        violated |= bool(is_violated(absolute, value, absolute / relative if relative else value))
    row |= {"bound_online_rho": bound.rho, "bound_online_omega": bound.omega, "bound_online_kappa": bound.kappa}
    row |= {"beta_energy_online": bound.inf_sup, "beta_energy_online_note": bound.inf_sup_note}
    return row | {"coercivity_online": bound.coercivity, "bound_online_violated": int(violated)}


def refutation(row: Row) -> Row:
    """Status and reason of an ok query whose error exceeds its bound plus the accuracy of the reference, or nothing."""
    # Such a query shows that something is false on which the bound rests, a declaration of the problem or a proof.
    for name in ("u_energy", "lambda_natural"):
        absolute, bound = row.get(f"error_{name}_absolute"), row.get(f"bound_online_{name}")
        force = row.get("error_lambda_natural")
        if row["status"] != Status.OK or absolute is None or bound is None:
            continue
        contact = row["error_lambda_natural_absolute"] / force if force else absolute
        # The reference itself is known to its own bound, relative to what contact does.
        if is_violated(absolute - (row.get("reference_bound") or 0.0) * contact, bound, contact):
            what = f"the error of {'u' if name == 'u_energy' else 'λ'} is {absolute / bound:.2g} times its bound"
            certificate = "it rests on something false here, such as a declaration; `vibench check` compares these"
            return {"status": Status.REFUTED.value, "reason": f"{what}: {certificate}"}
    return {}


def is_violated(error: Array | float, bound: Array | float, size: Array | float) -> Any:
    """Whether errors exceed their bounds by more than round-off of solutions of a `size`; true for NaN."""
    return np.logical_not(error <= bound + 1e-10 * size)


def error_columns(
    corrector: Corrector, mus: Array, solutions: Sequence[tuple[Array, Array]], reference: ReferenceSolutions,
    constants: Sequence[Stability], exact: Sequence[ExactSolution | None],
    projected: Sequence[ExactSolution | None] = (),
) -> list[Row]:  # fmt: skip
    """Errors of answers to solutions (x, α), one per parameter of `mus` (P×d), their error bounds and effectivities."""
    # `exact` are the same programs solved to round-off: the difference is the error of the solver. `projected` are the
    # programs assembled in full, solved to round-off, where those of the queries are not: the difference from `exact`
    # is the error of reduced assembly. A `corrector` with a certificate adds bounds at online cost.
    if not solutions:
        return []
    model, problem = corrector.model, corrector.model.problem
    vis = [assemblies(problem).at(mu) for mu in mus]
    u, lam = _reconstructed(model, mus, vis, solutions)
    queries = zip(mus, solutions, u.T, lam.T, strict=True)
    answers = [corrector.answer(mu, *solution, *pair) for mu, solution, *pair in queries]
    if any(answer.is_corrected for answer in answers):
        u, lam = (np.column_stack([getattr(answer, name) for answer in answers]) for name in ("u", "lam"))
    rows = pair_columns(problem, mus, vis, u, lam, reference, constants)
    for row, answer in zip(rows, answers, strict=True):
        if corrector.mode is not CorrectionMode.NONE:
            row["corrected"], row["correction_share"] = int(answer.is_corrected), answer.share
            row["correction_note"] = answer.note
        if answer.bound is not None:
            row.update(online_columns(answer.bound, row))
    sizes = zip(problem.V.norm(reference.u), problem.W.norm(reference.lam), strict=True)
    programs = zip(solutions, exact, projected or [None] * len(rows), strict=True)
    for row, mu, answer, norms, ((x, alpha), own, galerkin) in zip(rows, mus, answers, sizes, programs, strict=True):
        # A program that cannot be solved to round-off separates no errors.
        if own is None:
            continue
        pairs = {"solver": (ExactSolution(x, alpha, unique=True), own)}
        if galerkin is not None:
            pairs["assembly"] = own, galerkin
        for source, (one, other) in pairs.items():
            row.update(_contribution(source, corrector, mu, answer.is_corrected, norms, row, one, other))
    return rows


def _reconstructed(
    model: AnyReducedModel, mus: Array, vis: Sequence[VariationalInequality], solutions: Sequence[tuple[Array, Array]]
) -> tuple[Array, Array]:
    """The columns u_N (n×P) and λ_N (m×P) of solutions (x, α)."""
    lam = model.generators @ np.column_stack([alpha for _, alpha in solutions])
    if model.kind is Kind.PER_PARAMETER:
        if isinstance(model, ReducedModel):
            return model.reconstruct_all(vis, [x for x, _ in solutions]), lam
        queries = zip(mus, vis, solutions, strict=True)
        return np.hstack([model.reconstruct(mu, vi, x[:, None]) for mu, vi, (x, _) in queries]), lam
    # A fixed basis reconstructs all solutions at once.
    return model.reconstruct(mus[0], vis[0], np.column_stack([x for x, _ in solutions])), lam


def _contribution(
    source: str, corrector: Corrector, mu: Array, corrected: bool, norms: tuple[float, float], row: Row,
    one: ExactSolution, other: ExactSolution,
) -> Row:  # fmt: skip
    """Contribution of a source of error, the difference of two solutions of a query, relative to `norms` of u and λ."""
    parts, problem = dict[str, float](), corrector.model.problem
    if corrected:
        pairs = [_corrected(corrector, mu, solution) for solution in (one, other)]
        if not all(pair.is_corrected for pair in pairs):
            return parts
        of_u = float(problem.V.norm(pairs[0].u - pairs[1].u))
        of_lam = float(problem.W.norm(pairs[0].lam - pairs[1].lam))
    else:
        # The basis is orthonormal in V.
        of_u = float(np.linalg.norm(one.x - other.x))
        of_lam = float(problem.W.norm(corrector.model.generators @ (one.alpha - other.alpha)))
    if row["error_u"] is not None:
        parts["u"] = ratio(of_u, norms[0])
    # Two multipliers of a program with many do not differ by an error.
    if row["error_lambda"] is not None and one.unique and other.unique:
        parts["lambda"] = ratio(of_lam, norms[1])
    names = [name for name in ("u", "lambda") if (row[f"error_{name}"] or 0.0) > UNMEASURABLE]
    share = max((parts.get(name, 0.0) / row[f"error_{name}"] for name in names), default=None)
    return {f"{source}_error_{name}": part for name, part in parts.items()} | {f"{source}_share": share}


def _corrected(corrector: Corrector, mu: Array, solution: ExactSolution) -> Answer:
    # Corrected whatever ω and ρ are: both solutions must take the same way.
    corrector = replace(corrector, mode=CorrectionMode.FEASIBLE)
    model, vi = corrector.model, assemblies(corrector.model.problem).at(mu)
    u = np.asarray(model.reconstruct(mu, vi, solution.x[:, None])[:, 0])
    alpha = np.maximum(solution.alpha, 0.0)
    return corrector.answer(mu, solution.x, alpha, u, model.generators @ alpha)


def summarise(rows: Sequence[Row]) -> Row:
    """The columns of a cell from those of its queries; means and maxima are over the queries with status ok."""
    fine = [row for row in rows if row["status"] == Status.OK]

    def mu(row: Row) -> str:
        return ", ".join(f"{row[name]:.4g}" for name in sorted(row) if name.startswith("mu_"))

    def column(name: str, among: Sequence[Row] = fine) -> Array:
        return np.array([row[name] for row in among if row.get(name) is not None], dtype=float)

    def over(statistic: Callable[[Array], Any], name: str, among: Sequence[Row] = fine) -> float | None:
        values = column(name, among)
        return float(statistic(values)) if values.size else None

    def largest(*names: str) -> float | None:
        return max((value for name in names if (value := over(np.max, name)) is not None), default=None)

    def fraction(source: str, name: str) -> float | None:
        # A quotient of means: that of single queries is noise where their errors are near round-off.
        known = [row for row in fine if row.get(f"{source}_error_{name}") is not None]
        whole = sum(row[f"error_{name}"] for row in known)
        measurable = whole > UNMEASURABLE * len(known)
        return float(sum(row[f"{source}_error_{name}"] for row in known) / whole) if measurable else None

    def contributions(source: str) -> Row:
        shares = [part for name in ("u", "lambda") if (part := fraction(source, name)) is not None]
        names = (f"{source}_error_u", f"{source}_error_lambda", f"{source}_share")
        return {f"{name}_max": largest(name) for name in names} | {f"{source}_share_mean": max(shares, default=None)}

    def errors(name: str) -> Row:
        # A query whose high-fidelity solution is zero has no relative error. Such queries are counted, and their
        # largest error on the scale of the training set has a column of its own.
        zero = [row for row in fine if row.get(f"zero_{name}")]
        return {
            f"error_{name}_mean": over(np.mean, f"error_{name}"), f"error_{name}_max": largest(f"error_{name}"),
            f"queries_zero_{name}": len(zero), f"error_{name}_zero_max": over(np.max, f"error_{name}_scaled", zero),
        }  # fmt: skip

    # The worst status is that of the cell; its reason has all of them, with their counts.
    kinds = sorted({Status(row["status"]) for row in rows}, key=lambda status: -status.severity)
    broken = {kind: [row for row in rows if row["status"] == kind] for kind in kinds if kind is not Status.OK}
    counted = ", ".join(f"{len(mine)} of {len(rows)} {kind.value}" for kind, mine in broken.items())
    firsts = [f"mu=({mu(mine[0])}): {mine[0]['reason']}" for mine in broken.values()]
    if len(broken) == 1:
        counted = counted.replace(kinds[0].value, "queries")
    violated = column("bound_online_violated")
    medians = [name for name in STORED["cells"] if name.startswith("effectivity_")]
    smallest = ("beta_span", "beta_cone_lower", "beta_cone_upper")
    return {
        "status": kinds[0].value, "reason": f"{counted}, first {'; '.join(firsts)}" if broken else "",
        "queries": len(rows), "queries_ok": len(fine),
        **errors("u"), **errors("lambda"), **contributions("solver"), **contributions("assembly"),
        **{name: over(np.median, name.removesuffix("_median")) for name in medians},
        "corrected_share": over(np.mean, "corrected"),
        "reference_bound_max": over(np.max, "reference_bound", rows),
        # Zero violations are a result only of a cell with bounds.
        "bound_online_violations": int(violated.sum()) if violated.size else None,
        "assembly_error_max": largest("assembly_error"), "violation_max": largest("violation"),
        "hf_residual_max": largest("hf_primal_residual", "hf_dual_residual", "hf_gap"),
        "residual_max": largest("primal_residual", "dual_residual", "gap"),
        "error_u_predicted_mean": over(np.mean, "error_u_predicted"),
        **{f"{name}_min": over(np.min, name, rows) for name in smallest},
    }  # fmt: skip
