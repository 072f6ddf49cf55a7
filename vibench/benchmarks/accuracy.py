"""What stages have reached: figures computed from their results and from nothing that they claim."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from vibench.arrays import Array
from vibench.benchmarks.inputs import StageInputs, ValidationQuery, spread
from vibench.benchmarks.measure import Info
from vibench.highfidelity.active_set import HighFidelitySolution
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.strategies import Cone, Enrichment
from vibench.interfaces.validation import checked_assembly
from vibench.linalg.inner_product import InnerProduct, project_out, singular_values
from vibench.model.affine import AffineMember, Evaluation
from vibench.model.errors import errors
from vibench.model.galerkin import ReducedModel, ReducedProblem, project
from vibench.offline.assemblies import assemblies
from vibench.offline.models import AnyReducedModel
from vibench.qp import verification
from vibench.qp.verification import QPSolution
from vibench.reduction import cones
from vibench.reduction.pod import POD
from vibench.reduction.supremizers import supremizers

SOME = 9
"""Training parameters at which a figure is computed that takes long."""

RESIDUALS = {"primal": "primal_residual", "dual": "dual_residual", "gap": "gap"}


def about(inputs: StageInputs, **more: object) -> dict[str, object]:
    """Problem, resolution and dimensions of the spaces; whatever else is to be said."""
    case, problem = inputs.case, inputs.problem
    found = {"problem": case.problem, "resolution": case.resolution, "n": problem.V.dim, "m": problem.W.dim}
    return found | more


def of_solutions(inputs: StageInputs, solutions: Sequence[HighFidelitySolution]) -> Info:
    """Of high-fidelity solutions."""
    return about(
        inputs,
        solutions=len(solutions),
        iterations=sum(s.iterations for s in solutions),
        fallbacks=sum(bool(s.fallback) for s in solutions),
        accuracy=worst(_residuals(s.residuals) for s in solutions),
    )


def of_pod(inputs: StageInputs, found: POD) -> Info:
    """Of V_N."""
    V, u = inputs.problem.V, inputs.snapshots.u
    left = u - found.basis @ V.gram(found.basis, u)
    tail = np.linalg.norm(V.norm(left)) / np.linalg.norm(V.norm(u))
    accuracy = {"tail": tail, "orthonormality": orthonormality(found.basis, V)}
    return about(inputs, N=found.basis.shape[1], accuracy=accuracy)


def orthonormality(Z: Array, V: InnerProduct) -> float:
    """Largest entry of ZᵀX_VZ − I."""
    return float(np.abs(V.gram(Z, Z) - np.eye(Z.shape[1])).max(initial=0.0))


def of_cone(inputs: StageInputs, found: Cone) -> Info:
    """Of a reduced cone: the largest distance of a snapshot, relative to the largest norm."""
    W, lam = inputs.problem.W, inputs.snapshots.lam
    largest = max((cones.project_on_cone(found.rays, theta, W).distance for theta in lam.T), default=0.0)
    error = largest / (float(W.norm(lam).max(initial=0.0)) or 1.0)
    return about(inputs, R=found.size, fallbacks=len(found.fallbacks), accuracy={"projection_error": error})


def of_enrichment(inputs: StageInputs, found: Enrichment, model: ReducedModel) -> Info:
    """Of an enrichment: σ of equation (21), the largest at some of the training parameters."""
    sigma = max(_sigma(model, mu) for mu in spread(inputs.training, SOME))
    added = 0 if found.vectors is None else found.vectors.shape[1]
    return about(
        inputs,
        N=model.fixed_basis.shape[1] - added,
        R=model.generators.shape[1],
        enrichment=added,
        kind=found.kind.value,
        fallbacks=len(found.fallbacks),
        accuracy={"sigma": sigma},
    )


def _sigma(model: ReducedModel, mu: Array) -> float:
    """Largest sine between a supremizer at mu (d,) and the enriched space."""
    V, vi = model.problem.V, checked_assembly(model.problem, mu)
    wanted = V.whiten(V.orthonormalise(supremizers(V, vi.B, model.span)))
    return float(singular_values(project_out(V.whiten(model.primal_basis(vi)), wanted)).max(initial=0.0))


def of_separation(inputs: StageInputs, found: Mapping[str, AffineMember]) -> Info:
    """Of separated members: terms and ways; errors at validation parameters, no further than the problem samples."""
    ways = {f"way_{name}": member.way.value for name, member in found.items()}
    terms = {f"terms_{name}": len(member.terms) for name, member in found.items()}
    return about(inputs, **ways, **terms, accuracy={"interpolation_error": _interpolation_error(inputs, found)})


def _interpolation_error(inputs: StageInputs, found: Mapping[str, AffineMember]) -> float:
    sampled = {name: m for name, m in found.items() if m.way is Evaluation.INTERPOLATED}
    if not sampled:
        return 0.0
    sampler = inputs.problem.sampler({name: (m.rows, m.columns) for name, m in sampled.items()})
    largest = 0.0
    for query in inputs.queries:
        for name, theta in sampler(query.mu).items():
            exact = getattr(query.vi, name)
            summed = sum(value * term for value, term in zip(theta, sampled[name].terms, strict=True))
            largest = max(largest, _norm(summed - exact) / (_norm(exact) or 1.0))
    return largest


def _norm(member: Array) -> float:
    """Euclidean norm of the entries."""
    return float(np.linalg.norm(member if isinstance(member, np.ndarray) else member.data))


def of_programs(inputs: StageInputs, model: AnyReducedModel) -> Info:
    """Of the programs that a model assembles: difference from the projections on its basis, which is orthonormal."""
    accuracy, program = [], None
    for query in inputs.queries:
        reduced = model.assemble(query.mu)
        Z, program = reduced.basis, reduced.program
        exact = project(query.vi, Z, model.generators)
        difference = max(_difference(getattr(program, name), getattr(exact, name)) for name in MEMBERS)
        accuracy.append({"difference": difference, "orthonormality": orthonormality(Z, inputs.problem.V)})
    return about(inputs, **_shape(program), accuracy=worst(accuracy))


def _difference(found: Array, exact: Array) -> float:
    return float(np.linalg.norm(found - exact)) / (float(np.linalg.norm(exact)) or 1.0)


Solve = Callable[[ReducedProblem], QPSolution]


def of_queries(inputs: StageInputs, model: AnyReducedModel, solve: Solve, accuracy: float) -> Info:
    """Of queries at all validation parameters: errors against high-fidelity solutions, residuals, the worst status."""
    figures, statuses, reduced = [], [], None
    for query in inputs.queries:
        reduced = model.assemble(query.mu)
        answer = solve(reduced)
        status, reason, residuals = verification.verify(reduced.program, answer, accuracy)
        statuses.append((status.severity, status.value, reason))
        if residuals is not None and answer.x is not None and answer.alpha is not None:
            u, lam = reduced.basis @ answer.x, model.generators @ answer.alpha
            figures.append(_residuals(residuals) | _errors(inputs, query, u, lam))
    _, worst_status, why = max(statuses)
    form = "primal" if reduced is None or reduced.factor is None else "dual"
    shape = _shape(None if reduced is None else reduced.program)
    complete = worst(figures) if len(figures) == len(statuses) else {}
    return about(inputs, **shape, form=form, status=worst_status, reason=why, accuracy=complete)


def _errors(inputs: StageInputs, query: ValidationQuery, u: Array, lam: Array) -> dict[str, float]:
    energy = assemblies(inputs.problem).energy_at(query.mu)
    (found,) = errors(inputs.problem, [query.vi], [energy], query.exact, u[:, None], lam[:, None])
    known = {"error_u": found.error_u, "error_lambda": found.error_lambda}
    scaled = {"error_u_scaled": found.error_u_scaled, "error_lambda_scaled": found.error_lambda_scaled}
    measured = {name: value for name, value in known.items() if value is not None}
    return measured | {name: value for name, value in scaled.items() if name.removesuffix("_scaled") not in measured}


def of_answer(program: VariationalInequality, answer: QPSolution, accuracy: float) -> Info:
    """Of what a QP solver answers."""
    status, reason, residuals = verification.verify(program, answer, accuracy)
    return {
        **_shape(program),
        "status": status.value,
        "reason": reason,
        "solver_status": answer.solver_status,
        "iterations": answer.iterations,
        "accuracy": {} if residuals is None else _residuals(residuals),
    }


def _shape(program: VariationalInequality | None) -> dict[str, int]:
    """Unknowns N' and constraints R of a reduced program."""
    return {} if program is None else {"dimension": len(program.f), "R": len(program.g)}


def _residuals(found: verification.Residuals) -> dict[str, float]:
    return {name: getattr(found, part) for part, name in RESIDUALS.items()}


def worst(figures: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """The largest of every figure."""
    found: dict[str, float] = {}
    for some in figures:
        for name, value in some.items():
            found[name] = max(found.get(name, value), value) if value == value else value  # noqa: PLR0124  NaN
    return found
