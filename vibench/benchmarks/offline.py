"""Benchmarks of the offline phase: high-fidelity solutions, POD, cones, enrichments, separated members.

A function gives what is timed; its arguments beside the inputs are the axes of its benchmarks. What was reached is
computed from the results and from nothing that they claim.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from vibench.arrays import Array
from vibench.benchmarks.cases import PrimalChoice
from vibench.benchmarks.inputs import INTERPOLATION, StageInputs, solve_all
from vibench.benchmarks.measure import Info, Timing, largest_figures
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces.strategies import Cone, Enrichment
from vibench.interfaces.validation import check_cone, check_enrichment, checked_assembly
from vibench.linalg.inner_product import InnerProduct, project_out, singular_values
from vibench.model.affine import AffineMember, Evaluation, affine_decomposition
from vibench.model.galerkin import ReducedModel
from vibench.plugins.kinds import DUAL, PRIMAL
from vibench.plugins.registry import find
from vibench.qp.verification import Residuals
from vibench.reduction.cones import project_on_cone
from vibench.reduction.pod import POD, pod
from vibench.reduction.supremizers import supremizers

SOME = 9
"""Training parameters at which a figure is computed that takes long."""


def time_high_fidelity_solution(inputs: StageInputs) -> Timing:
    """One high-fidelity solution, by a solver that has solved nothing before."""
    problem, mu = inputs.problem, inputs.training[0]
    return Timing(
        "high-fidelity solution",
        lambda solver: solver.solve(mu),
        lambda solution: _judge_solutions([solution]),
        lambda: HighFidelitySolver(problem),
    )


def time_high_fidelity_sweep(inputs: StageInputs) -> Timing:
    """High-fidelity solutions at all training parameters."""
    problem, training = inputs.problem, inputs.training
    return Timing("high-fidelity sweep", lambda: solve_all(problem, training), _judge_solutions)


def _judge_solutions(solutions: Sequence[HighFidelitySolution]) -> Info:
    return {
        "solutions": len(solutions),
        "iterations": sum(s.iterations for s in solutions),
        "fallbacks": sum(bool(s.fallback) for s in solutions),
        "accuracy": largest_figures(residual_figures(s.residuals) for s in solutions),
    }


def residual_figures(residuals: Residuals) -> dict[str, float]:
    """Relative KKT residuals by their names in the file."""
    return {"primal_residual": residuals.primal, "dual_residual": residuals.dual, "gap": residuals.gap}


def time_pod(inputs: StageInputs) -> Timing:
    """POD of the snapshots."""
    V, u, stop = inputs.problem.V, inputs.snapshots.u, inputs.usual.modes

    def judge(modes: POD) -> Info:
        left = u - modes.basis @ V.gram(modes.basis, u)
        tail = np.linalg.norm(V.norm(left)) / np.linalg.norm(V.norm(u))
        return {"N": modes.basis.shape[1], "accuracy": {"tail": tail, "orthonormality": orthonormality(modes.basis, V)}}

    return Timing("POD", lambda: pod(u, V, stop), judge)


def orthonormality(Z: Array, V: InnerProduct) -> float:
    """Largest entry of ZᵀX_VZ − I."""
    return float(np.abs(V.gram(Z, Z) - np.eye(Z.shape[1])).max(initial=0.0))


def time_cone(inputs: StageInputs, dual: str) -> Timing:
    """A cone by one dual strategy; reached is the largest distance of a snapshot, relative to the largest norm."""
    W, lam, stop = inputs.problem.W, inputs.snapshots.lam, inputs.usual.generators
    strategy = find(DUAL, dual).create({})

    def judge(cone: Cone) -> Info:
        rays = check_cone(cone, W).rays
        largest = max((project_on_cone(rays, theta, W).distance for theta in lam.T), default=0.0)
        error = largest / (float(W.norm(lam).max(initial=0.0)) or 1.0)
        return {"R": cone.size, "fallbacks": len(cone.fallbacks), "accuracy": {"projection_error": error}}

    return Timing("cone", lambda: strategy.reduce(lam, W, stop), judge)


def time_enrichment(inputs: StageInputs, primal: PrimalChoice) -> Timing:
    """An enrichment by one primal strategy; reached is σ of equation (21), at some of the training parameters."""
    reduction, strategy = inputs.reduction(inputs.usual), find(PRIMAL, primal.name).create({})
    offline = reduction.offline

    def judge(enrichment: Enrichment) -> Info:
        check_enrichment(enrichment, offline.problem.V, offline.basis)
        model = reduction.given(enrichment=enrichment).projection
        some = np.unique(np.linspace(0, len(offline.training) - 1, SOME).round().astype(int))
        return {
            "N": offline.basis.shape[1],
            "R": model.generators.shape[1],
            "enrichment": 0 if enrichment.vectors is None else enrichment.vectors.shape[1],
            "kind": enrichment.kind.value,
            "fallbacks": len(enrichment.fallbacks),
            "accuracy": {"sigma": max(_sigma(model, offline.training[k]) for k in some)},
        }

    return Timing("enrichment", lambda: strategy.build(offline, primal.tolerance), judge)


def _sigma(model: ReducedModel, mu: Array) -> float:
    """Largest sine between a supremizer at mu (d,) and the enriched space."""
    V, vi = model.problem.V, checked_assembly(model.problem, mu)
    wanted = V.whiten(V.orthonormalise(supremizers(V, vi.B, model.span)))
    return float(singular_values(project_out(V.whiten(model.primal_basis(vi)), wanted)).max(initial=0.0))


def time_separation(inputs: StageInputs) -> Timing:
    """The members as sums of parameter-independent terms, or samples of them; reached is the interpolation error."""
    problem, training = inputs.problem, inputs.training

    def judge(members: Mapping[str, AffineMember]) -> Info:
        ways = {f"way_{name}": member.way.value for name, member in members.items()}
        terms = {f"terms_{name}": len(member.terms) for name, member in members.items()}
        return {**ways, **terms, "accuracy": {"interpolation_error": _interpolation_error(inputs, members)}}

    return Timing("separation", lambda: affine_decomposition(problem, training, INTERPOLATION), judge)


def _interpolation_error(inputs: StageInputs, members: Mapping[str, AffineMember]) -> float:
    """Largest relative error of a member at validation parameters, no further than the problem samples."""
    sampled = {name: m for name, m in members.items() if m.way is Evaluation.INTERPOLATED}
    if not sampled:
        return 0.0
    sampler = inputs.problem.sampler({name: (m.rows, m.columns) for name, m in sampled.items()})
    largest = 0.0
    for query in inputs.queries:
        for name, theta in sampler(query.mu).items():
            exact = getattr(query.vi, name)
            summed = sum(value * term for value, term in zip(theta, sampled[name].terms, strict=True))
            largest = max(largest, relative_difference(summed, exact))
    return largest


def relative_difference(value: Array, exact: Array) -> float:
    """Euclidean norm of the difference of two members, dense or sparse, relative to that of the second."""

    def norm(member: Array) -> float:
        return float(np.linalg.norm(member if isinstance(member, np.ndarray) else member.data))

    return norm(value - exact) / (norm(exact) or 1.0)


OFFLINE: tuple[Callable[..., Timing], ...] = (
    time_high_fidelity_solution,
    time_high_fidelity_sweep,
    time_pod,
    time_cone,
    time_enrichment,
    time_separation,
)
