"""Statements with numbers or inequalities in §§2 to 4, on both problems."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from vibench import Array, Problem, ReducedSet, Reduction, Stop, project_on_cone
from vibench_problems.paper.claims import Claim, below, holds, number, span, text, unknown
from vibench_problems.paper.constants import HF
from vibench_problems.paper.evidence import MODIFIED, PLAIN, Evidence, last, stopped
from vibench_problems.paper.offline import STABLE
from vibench_problems.paper.published import Pair

MUCH_SMALLER = 0.5
"""A dimension is much smaller than another if it is at most this share of it."""

ZERO = 1e-7
"""Distances from Gram matrices below this are round-off."""

RANK = 1e-10
"""Singular values below this share of the largest do not count for a dimension."""


def statements(evidence: Evidence) -> Iterator[Claim]:
    """All claims for one problem."""
    name = type(evidence.problem).__name__
    yield from enrichment(evidence, name)
    yield from criterion(evidence, name)
    yield from cones(evidence, name)
    yield accuracy(evidence, name)


def enrichment(evidence: Evidence, name: str) -> Iterator[Claim]:
    """Online supremizers, and the space of PGA."""
    paper, pairs, reduction = evidence.paper, evidence.pairs, evidence.reduction
    online = evidence.queries[evidence.queries["enrichment_kind"] == "per-parameter"]
    on, reference = online["beta_span"], online[f"{HF}span"]
    yield holds(
        f"{name}, (18)",
        "β_on ≥ β_HF ≥ β₀ > 0",
        f"β_on {span(on)}, β_HF {span(reference)}",
        below(reference, on) and reference.min() > 0.0,
        paper="at all µ",
        why="Over the span, at all validation parameters.",
    )
    sizes = [evidence.size(pair) for pair in pairs]
    generators = [R for _, R in sizes]
    supremizers = [int(evidence.cell(pair, "per-parameter")["enrichment"]) for pair in pairs]
    yield number(f"{name}, §2.3", "as many supremizers as generators, three pairs", generators, supremizers)
    sums = {R: supremizer_dimension(reduction, stopped(reduction, Stop(size=R))) for R in set(generators)}
    added = [int(_pga(evidence, pair)["enrichment"]) for pair in pairs]
    whole = [sums[R] for R in generators]
    loose = [int(_pga(evidence, pair, loose=True)["enrichment"]) for pair in pairs]
    yield holds(
        f"{name}, (20), (28)",
        "dimension of S_red much smaller than that of S_R",
        f"{text(added)} of {text(whole)}",
        all(k <= MUCH_SMALLER * n for k, n in zip(added, whole, strict=True)),
        why=f"δ_PGA = {paper.tight:g}; S_R of all training parameters; a share of {MUCH_SMALLER:g} counts.",
        cause=f"At the looser δ_PGA of the paper, {text([pair.loose for pair in pairs])}, the dimensions are "
        f"{text(loose)}.",
    )
    sigma = [list(evidence.growth(pair, "sigma").values()) for pair in pairs]
    parameters, dim = len(reduction.snapshots.mu), evidence.problem.V.dim
    bounds = [min(parameters * R, dim - N) for N, R in sizes]
    yield holds(
        f"{name}, Lemma 3.2",
        "max σ decreases; at most min(m R, dim V − N) steps",
        f"{text(added)} steps to {paper.tight:g}",
        all(np.all(np.diff(values) <= 1e-9) for values in sigma)
        and all(k <= n for k, n in zip(added, bounds, strict=True)),
        paper=f"bounds {text(bounds)}",
        why="m training parameters; three pairs.",
    )
    yield outside_training(evidence, name)


def _pga(evidence: Evidence, pair: Pair, *, loose: bool = False) -> pd.Series:
    return evidence.cell(pair, "fixed", pair.loose if loose else evidence.paper.tight)


def supremizer_dimension(reduction: Reduction, cone: ReducedSet) -> int:
    """Dimension of the sum of the spaces S_R(µ) over the training set, equation (20)."""
    problem, chi = reduction.problem, cone.generators
    loads = np.hstack([np.asarray(problem.constraint(mu)[0].T @ chi) for mu in reduction.snapshots.mu])
    values = np.linalg.svd(loads[np.any(loads != 0.0, axis=1)], compute_uv=False)
    return int(np.count_nonzero(values > RANK * values[0]))


def outside_training(evidence: Evidence, name: str) -> Claim:
    """Stability at parameters that PGA has not seen."""
    cells = evidence.cells
    fixed = cells[(cells["dual"] == MODIFIED) & (cells["enrichment_kind"] == "fixed")]
    short = fixed[fixed["share_validation"] < fixed["share_guaranteed"] * (1.0 - 1e-6)]
    return holds(
        f"{name}, §3",
        "stability at all µ ∈ D is to be expected from a rich D_train",
        f"at least {fixed['share_validation'].min():.3g} of β_on over D_valid",
        fixed["share_validation"].min() > STABLE,
        paper="β_off > 0",
        why=f"All {len(fixed)} cells of mCPG, over the span. The share √(1 − σ²), which PGA guarantees over D_train, "
        f"is not reached over D_valid in {len(short)} of them.",
    )


def criterion(evidence: Evidence, name: str) -> Iterator[Claim]:
    """The criterion (23) for the tolerances that the paper uses, and the bound (24)."""
    problem, pairs, reduction = evidence.problem, evidence.pairs, evidence.reduction
    middle = reduction.snapshots.mu[len(reduction.snapshots.mu) // 2]
    cones = [stopped(reduction, Stop(size=evidence.size(pair)[1])) for pair in pairs]
    reduced = [singular_values(problem, middle, problem.W.orthonormalise(cone.generators)) for cone in cones]
    limits = [float(values[-1] / values[0]) for values in reduced]
    tight = [evidence.paper.tight for _ in pairs]
    for kind, used in (("tight", tight), ("looser", [pair.loose for pair in pairs])):
        yield holds(
            f"{name}, (23), (28)",
            f"the {kind} δ_PGA satisfies σ < β_on / c_S",
            f"β_on / c_S = {text(limits)}",
            all(one < other for one, other in zip(used, limits, strict=True)),
            paper=text(used),
            why="Over the span, at the middle of D_train.",
            cause="(23) is sufficient but not necessary: β_off ≥ √(1 − σ²) β_on for every σ < 1.",
        )
    sigma = [last(evidence.growth(pair, "sigma")) for pair in pairs]
    bounds = [(1.0 - s / limit) / (1.0 + s) for s, limit in zip(sigma, limits, strict=True)]
    shares = [float(_pga(evidence, pair)["share_training"]) for pair in pairs]
    yield holds(
        f"{name}, (24)",
        "β_off ≥ (β_on − c_S σ) / (1 + σ), relative to β_on",
        text(shares),
        all(share >= limit * (1.0 - 1e-9) for share, limit in zip(shares, bounds, strict=True)),
        paper=f"at least {text(bounds)}",
        why="Over the span, the tight δ_PGA; smallest shares over D_train. A negative bound is void.",
    )
    values = singular_values(problem, middle, problem.W.unwhiten(np.eye(problem.W.dim)))
    large, small = float(values[0] / values[-1]), float(values[-1] / values[0])
    yield holds(
        f"{name}, §3",
        "δ_PGA < β₀⁻¹ C₀ is enough for (23)",
        f"β₀⁻¹ C₀ = {large:.3g}, β₀ / C₀ = {small:.3g}",
        large <= small,
        paper="β₀⁻¹ C₀",
        why="At the middle of D_train.",
        cause="Every δ_PGA below 1 satisfies it. From (23) follows δ_PGA < β₀ / C₀.",
    )


def singular_values(problem: Problem, mu: Array, basis: Array) -> Array:
    """Singular values of b(mu) on V and on W-orthonormal multipliers (m×k); the extreme ones are c and β."""
    image = problem.V.whiten_functional(np.asarray(problem.constraint(mu)[0].T @ basis))
    return np.asarray(np.linalg.svd(image, compute_uv=False))


def cones(evidence: Evidence, name: str) -> Iterator[Claim]:
    """Algorithm 2 and its comparison with CPG."""
    reduction, W = evidence.reduction, evidence.problem.W
    two, plain = (stopped(reduction, Stop(size=2), dual) for dual in (MODIFIED, PLAIN))
    lost = max(project_on_cone(two.rays, nu, W).distance for nu in plain.generators.T)
    yield holds(
        f"{name}, Fig. 1",
        "the cone of CPG lies in that of mCPG for r = 2",
        f"distance {lost:.1g}",
        lost <= ZERO,
        why="Both select the same two snapshots.",
    )
    lam, errors = reduction.snapshots.lam, reduction.cone.errors
    yield holds(
        f"{name}, Lemma 4.5",
        "e_r decreases to e_Q = 0",
        f"{errors[-1]:.1g} at r = {reduction.cone.size}",
        np.all(np.diff(errors) <= 1e-12) and errors[-1] <= ZERO and reduction.cone.size <= lam.shape[1],
        paper=f"Q = {lam.shape[1]}",
        why="All snapshots are reproduced to round-off.",
    )
    generators = stopped(reduction, Stop(size=evidence.size(evidence.pairs[0])[1])).generators
    outside = max(project_on_cone(lam / W.norm(lam), nu, W).distance for nu in generators.T)
    yield holds(
        f"{name}, Remark 4.3",
        "generators of mCPG lie in the cone of the selected snapshots",
        f"up to {outside:.2g} away from the cone of all",
        outside <= ZERO,
        cause="They lie in W⁺, but not always in that cone: (1, 1, 0) and (1, 2, 1) give (0, 1, 1).",
    )
    conditions, settings = _by_dual(evidence, "gram_condition", "none")
    yield holds(
        f"{name}, §4, Remark 4.3",
        "the Gram matrix of mCPG is better conditioned than that of CPG",
        "; ".join(f"{b:.1g} against {a:.1g}" for a, b in conditions),
        all(b < a for a, b in conditions),
        why=f"{settings}.",
    )


def accuracy(evidence: Evidence, name: str) -> Claim:
    """Errors of the reduced models of the two cones."""
    errors, settings = _by_dual(evidence, "error_lambda_mean", "per-parameter")
    return holds(
        f"{name}, Remark 4.4",
        "reduced models are more accurate with mCPG than with CPG",
        "; ".join(f"{b:.2g} against {a:.2g}" for a, b in errors),
        all(b < a for a, b in errors),
        why=f"Mean relative error of λ with online supremizers, {settings}.",
        cause="A smaller training error (34) does not bound the errors at other parameters.",
    )


def _by_dual(evidence: Evidence, quantity: str, kind: str) -> tuple[list[tuple[float, float]], str]:
    """Values of CPG and of mCPG at the pairs of tolerances or sizes of the study, and these pairs."""
    cells = evidence.cells[evidence.cells["enrichment_kind"] == kind]
    settings = [
        f"N = {row['pod_size']:.0f}, R = {row['dual_size']:.0f}"
        if pd.notna(row["dual_size"])
        else f"δ_POD = {row['pod_tol']:g}, δ = {row['dual_tol']:g}"
        for row in cells.to_dict("records")
    ]
    each = list(dict.fromkeys(settings))
    wide = cells.assign(setting=settings).pivot(index="setting", columns="dual", values=quantity).loc[each]
    return list(zip(wide[PLAIN].astype(float), wide[MODIFIED].astype(float), strict=True)), "; ".join(each)


def software(evidence: Sequence[Evidence]) -> Iterator[Claim]:
    """What the computations were made with."""
    largest = max(one.cells["residual_max"].max() for one in evidence)
    why = f"Every residual is recomputed; they are at most {largest:.1g}."
    yield unknown("§5", "QP solver", "cvxopt", "PIQP", why)
    why = "Results and not seconds are compared."
    yield unknown("§5", "high-fidelity model", "Freefem++ and Python", "scikit-fem, active sets", why)
