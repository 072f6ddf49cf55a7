"""Statements with numbers or inequalities in §§2 to 4, on both problems."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from claims.computed import Snapshots, generator_lost, singular_values
from claims.runs import DUAL, PAPER, Pair, Run
from claims.verdicts import Claim, below, holds, number, span, text, unknown
from vibench.interfaces.strategies import Stop
from vibench.reduction.cones import project_on_cone

MUCH_SMALLER = 0.5
"""A dimension is much smaller than another if it is at most this share of it."""

ZERO = 1e-7
"""Distances from Gram matrices below this are round-off."""


def statements(run: Run, snapshots: Snapshots) -> Iterator[Claim]:
    """All claims for one problem."""
    name = type(snapshots.problem).__name__
    pairs = run.pairs()
    yield from enrichment(run, snapshots, pairs, name)
    yield from criterion(run, snapshots, pairs, name)
    yield from cones(run, snapshots, name)
    yield accuracy(run, name)


def enrichment(run: Run, snapshots: Snapshots, pairs: Sequence[Pair], name: str) -> Iterator[Claim]:
    """Online supremizers, and the space of PGA."""
    on, reference = (run.constants_by_cell("per-parameter", f"beta_{which}") for which in ("span", "hf_span"))
    yield holds(
        f"{name}, (18): β_on ≥ β_HF ≥ β₀ > 0",
        "at all µ",
        f"β_on {span(on)}, β_HF {span(reference)}",
        below(reference, on) and reference.min() > 0.0,
        why="Over the span, at all validation parameters.",
    )
    yield number(
        f"{name}, §2.3: as many supremizers as generators, three pairs",
        [int(pair.plain["R"]) for pair in pairs],
        [int(pair.online["enrichment"]) for pair in pairs],
    )
    distinct = {int(pair.plain["R"]): snapshots for pair in pairs}
    sums = {R: snapshots.supremizer_dimension(snapshots.cone(Stop(size=R)).generators) for R in distinct}
    added = [int(pair.offline["enrichment"]) for pair in pairs]
    whole = [sums[int(pair.plain["R"])] for pair in pairs]
    yield holds(
        f"{name}, (20), (28): dimension of S_red much smaller than that of S_R",
        "yes",
        f"{text(added)} of {text(whole)}",
        all(k <= MUCH_SMALLER * n for k, n in zip(added, whole, strict=True)),
        why=f"δ_PGA = {PAPER[run.study][1]:g}; S_R of all training parameters; a share of {MUCH_SMALLER:g} counts.",
        cause=f"At the looser δ_PGA of the paper, {text([float(p.loose['primal_tol']) for p in pairs])}, the "
        f"dimensions are {text([int(p.loose['enrichment']) for p in pairs])}.",
    )
    sigma = [list(run.enrichment(pair.offline, "sigma").values()) for pair in pairs]
    bounds = [min(len(snapshots.training) * int(p.plain["R"]), int(p.plain["dim_V"] - p.plain["N"])) for p in pairs]
    yield holds(
        f"{name}, Lemma 3.2: max σ decreases; at most min(m R, dim V − N) steps",
        f"bounds {text(bounds)}",
        f"{text(added)} steps to {PAPER[run.study][1]:g}",
        all(np.all(np.diff(values) <= 1e-9) for values in sigma)
        and all(k <= n for k, n in zip(added, bounds, strict=True)),
        why="m training parameters; three pairs.",
    )
    yield outside_training(run, name)


def outside_training(run: Run, name: str) -> Claim:
    """Stability at parameters that PGA has not seen."""
    fixed = run.cells[(run.cells["dual"] == DUAL) & (run.cells["enrichment_kind"] == "fixed")]
    short = fixed[fixed["share_validation"] < fixed["share_guaranteed"] * (1.0 - 1e-6)]
    return holds(
        f"{name}, §3: stability at all µ ∈ D is to be expected from a rich D_train",
        "β_off > 0",
        f"at least {fixed['share_validation'].min():.3g} of β_on over D_valid",
        fixed["share_validation"].min() > 0.1,
        why=f"All {len(fixed)} cells of mCPG, over the span. The share √(1 − σ²), which PGA guarantees over D_train, "
        f"is not reached over D_valid in {len(short)} of them.",
    )


def criterion(run: Run, snapshots: Snapshots, pairs: Sequence[Pair], name: str) -> Iterator[Claim]:
    """The criterion (23) for the tolerances that the paper uses."""
    problem, middle = snapshots.problem, snapshots.training[len(snapshots.training) // 2]
    reduced = [singular_values(problem, middle, snapshots.cone(Stop(size=int(p.plain["R"]))).generators) for p in pairs]
    limits = [float(values[-1] / values[0]) for values in reduced]
    for kind, cells in (("tight", [p.offline for p in pairs]), ("looser", [p.loose for p in pairs])):
        used = [float(cell["primal_tol"]) for cell in cells]
        yield holds(
            f"{name}, (23), (28): the {kind} δ_PGA satisfies σ < β_on / c_S",
            text(used),
            f"β_on / c_S = {text(limits)}",
            all(one < other for one, other in zip(used, limits, strict=True)),
            why="Over the span, at the middle of D_train.",
            cause="(23) is sufficient but not necessary: β_off ≥ √(1 − σ²) β_on for every σ < 1.",
        )
    yield bound(run, pairs, limits, name)
    whole = singular_values(problem, middle)
    large, small = float(whole[0] / whole[-1]), float(whole[-1] / whole[0])
    yield holds(
        f"{name}, §3: δ_PGA < β₀⁻¹ C₀ is enough for (23)",
        "β₀⁻¹ C₀",
        f"β₀⁻¹ C₀ = {large:.3g}, β₀ / C₀ = {small:.3g}",
        large <= small,
        why="At the middle of D_train.",
        cause="Every δ_PGA below 1 satisfies it. From (23) follows δ_PGA < β₀ / C₀.",
    )


def bound(run: Run, pairs: Sequence[Pair], limits: Sequence[float], name: str) -> Claim:
    """The lower bound (24), relative to β_on, at the tight tolerance."""
    sigma = [list(run.enrichment(pair.offline, "sigma").values())[-1] for pair in pairs]
    bounds = [(1.0 - s / limit) / (1.0 + s) for s, limit in zip(sigma, limits, strict=True)]
    shares = [float(pair.offline["share_training"]) for pair in pairs]
    return holds(
        f"{name}, (24): β_off ≥ (β_on − c_S σ) / (1 + σ), relative to β_on",
        f"at least {text(bounds)}",
        text(shares),
        all(share >= limit * (1.0 - 1e-9) for share, limit in zip(shares, bounds, strict=True)),
        why="Over the span, the tight δ_PGA; smallest shares over D_train. A negative bound is void.",
    )


def cones(run: Run, snapshots: Snapshots, name: str) -> Iterator[Claim]:
    """Algorithm 2 and its comparison with CPG."""
    lost = generator_lost(snapshots, 2)
    yield holds(
        f"{name}, Fig. 1: the cone of CPG lies in that of mCPG for r = 2",
        "yes",
        f"distance {lost:.1g}",
        lost <= ZERO,
        why="Both select the same two snapshots.",
    )
    whole = snapshots.cone(Stop(tolerance=0.0))
    yield holds(
        f"{name}, Lemma 4.5: e_r decreases to e_Q = 0",
        f"Q = {snapshots.lam.shape[1]}",
        f"{whole.errors[-1]:.1g} at r = {whole.size}",
        bool(np.all(np.diff(whole.errors) <= 1e-12))
        and whole.errors[-1] <= ZERO
        and whole.size <= snapshots.lam.shape[1],
        why="All snapshots are reproduced to round-off.",
    )
    rays = snapshots.lam / snapshots.problem.W.norm(snapshots.lam)
    generators = snapshots.cone(Stop(size=int(run.pairs()[0].plain["R"]))).generators
    outside = max(project_on_cone(rays, nu, snapshots.problem.W).distance for nu in generators.T)
    yield holds(
        f"{name}, Remark 4.3: generators of mCPG lie in the cone of the selected snapshots",
        "yes",
        f"up to {outside:.2g} away from the cone of all",
        outside <= ZERO,
        cause="They lie in W⁺, but not always in that cone: (1, 1, 0) and (1, 2, 1) give (0, 1, 1).",
    )
    conditions = _by_dual(run, "gram_condition")
    yield holds(
        f"{name}, §4, Remark 4.3: the Gram matrix of mCPG is better conditioned than that of CPG",
        "yes",
        "; ".join(f"{b:.1g} against {a:.1g}" for a, b in conditions),
        all(b < a for a, b in conditions),
        why=f"{_labels(run)}.",
    )


def accuracy(run: Run, name: str) -> Claim:
    """Errors of the reduced models of the two cones."""
    errors = _by_dual(run, "error_lambda_mean", "per-parameter")
    return holds(
        f"{name}, Remark 4.4: reduced models are more accurate with mCPG than with CPG",
        "yes",
        "; ".join(f"{b:.2g} against {a:.2g}" for a, b in errors),
        all(b < a for a, b in errors),
        why=f"Mean relative error of λ with online supremizers, {_labels(run)}.",
        cause="A smaller training error (34) does not bound the errors at other parameters.",
    )


def _by_dual(run: Run, quantity: str, kind: str = "none") -> list[tuple[float, float]]:
    """Values of CPG and of mCPG at the pairs of tolerances or sizes of the study."""
    chosen = run.cells[run.cells["enrichment_kind"] == kind].assign(setting=_settings)
    wide = chosen.pivot(index="setting", columns="dual", values=quantity).loc[list(dict.fromkeys(chosen["setting"]))]
    return list(zip(wide["cpg"].astype(float), wide["mcpg"].astype(float), strict=True))


def _labels(run: Run) -> str:
    return "; ".join(dict.fromkeys(_settings(run.cells[run.cells["enrichment_kind"] == "none"])))


def _settings(frame: pd.DataFrame) -> list[str]:
    return [
        f"N = {row['pod_size']:.0f}, R = {row['dual_size']:.0f}"
        if pd.notna(row["dual_size"])
        else f"δ_POD = {row['pod_tol']:g}, δ = {row['dual_tol']:g}"
        for row in frame.to_dict("records")
    ]


def software(runs: Sequence[Run]) -> Iterator[Claim]:
    """What the computations were made with."""
    largest = max(run.cells["residual_max"].max() for run in runs)
    yield unknown("§5: QP solver", "cvxopt", "PIQP", f"Every residual is recomputed; they are at most {largest:.1g}.")
    yield unknown(
        "§5: high-fidelity model",
        "Freefem++ and Python",
        "scikit-fem, active sets",
        "Results and not seconds are compared.",
    )
