"""Benchmarks of the online phase: reduced assembly and what it needs, queries, QP solvers on programs of several sizes.

A function gives what is timed; its arguments beside the inputs are the axes of its benchmarks. What was reached is
computed from the results and from nothing that they claim.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import cycle

from vibench.arrays import Array
from vibench.benchmarks.cases import SIZES, PrimalChoice, ReducedSpaces, Size
from vibench.benchmarks.inputs import QUERIES, StageInputs, ValidationQuery
from vibench.benchmarks.measure import Info, Timing, largest_figures
from vibench.benchmarks.offline import orthonormality, relative_difference, residual_figures
from vibench.interfaces.problem import MEMBERS
from vibench.interfaces.strategies import Stop
from vibench.model.errors import errors
from vibench.model.galerkin import ReducedProblem, project
from vibench.model.hyperreduced import HyperReducedModel, ReducedOperators, hyper_reduce
from vibench.offline.assemblies import assemblies
from vibench.offline.models import AnyReducedModel
from vibench.plugins.registry import qp_solver
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution, verify

SMALLEST = 1e-8
"""Tolerance of the POD that has all modes which a reduced program may have."""


class LeftOutError(Exception):
    """There is nothing to time."""


def time_projection_of_members(inputs: StageInputs, primal: PrimalChoice) -> Timing:
    """What reduced assembly prepares for one enrichment."""
    _check_reduced(inputs, primal)
    reduction, members = inputs.reduction(inputs.usual, primal), inputs.members

    def judge(operators: ReducedOperators) -> Info:
        return _judge_programs(inputs, HyperReducedModel(reduction.given().projection, operators))

    return Timing(
        "projection of members",
        lambda model: hyper_reduce(model, members),
        judge,
        lambda: reduction.given().projection,
    )


def time_assembly_in_full(inputs: StageInputs, primal: PrimalChoice) -> Timing:
    """A reduced program from matrices of full size."""
    return _assembly(inputs, "assembly in full", inputs.reduction(inputs.usual, primal).given().projection)


def time_assembly_reduced(inputs: StageInputs, primal: PrimalChoice) -> Timing:
    """A reduced program from projected members."""
    _check_reduced(inputs, primal)
    return _assembly(inputs, "assembly, reduced", inputs.online(inputs.usual, primal).given().assembled)


def _check_reduced(inputs: StageInputs, primal: PrimalChoice) -> None:
    """Leave out a benchmark of reduced assembly where there is none."""
    if isinstance(why := inputs.online(inputs.usual, primal).operators, str):
        raise LeftOutError(f"queries have to be assembled in full: {why}")


def _assembly(inputs: StageInputs, group: str, model: AnyReducedModel) -> Timing:
    mus = in_turn(inputs)
    return Timing(group, lambda: model.assemble(next(mus)), lambda _: _judge_programs(inputs, model), together=QUERIES)


def _judge_programs(inputs: StageInputs, model: AnyReducedModel) -> Info:
    """Difference of the programs that a model assembles from the projections on its basis, which is orthonormal."""
    figures = []
    for query in inputs.queries:
        reduced = model.assemble(query.mu)
        exact = project(query.vi, reduced.basis, model.generators)
        pairs = ((getattr(reduced.program, name), getattr(exact, name)) for name in MEMBERS)
        off = orthonormality(reduced.basis, inputs.problem.V)
        figures.append({"difference": max(relative_difference(*pair) for pair in pairs), "orthonormality": off})
    return {**_shape(reduced), "accuracy": largest_figures(figures)}


def time_query(inputs: StageInputs, primal: PrimalChoice) -> Timing:
    """Assembly in the quickest way there is, and solution; reached are errors against high-fidelity solutions."""
    reduction = inputs.online(inputs.usual, primal).given()
    model, why = reduction.model, reduction.operators
    mus = in_turn(inputs)

    def query() -> QPSolution:
        reduced = model.reduced.assemble(next(mus))
        return solve_qp(reduced.program, model.solver, model.accuracy, factor=reduced.factor)

    def judge(_: QPSolution) -> Info:
        answers = [model.solve(query.mu) for query in inputs.queries]
        worst = max(answers, key=lambda answer: answer.status.severity)
        figures = [
            residual_figures(answer.residuals) | errors_of(inputs, query, answer.u, answer.lam)
            for query, answer in zip(inputs.queries, answers, strict=True)
            if answer.residuals is not None
        ]
        return {
            **_shape(model.reduced.assemble(inputs.queries[0].mu)), "solver": model.solver,
            "status": worst.status.value, "reason": worst.reason,
            "assembly": f"full: {why}" if isinstance(why, str) else "reduced",
            "accuracy": largest_figures(figures) if len(figures) == len(answers) else {},
        }  # fmt: skip

    return Timing("query", query, judge, together=QUERIES)


def in_turn(inputs: StageInputs) -> Iterator[Array]:
    """The validation parameters, again and again."""
    return cycle([query.mu for query in inputs.queries])


def errors_of(inputs: StageInputs, query: ValidationQuery, u: Array, lam: Array) -> dict[str, float]:
    """Relative errors of u and λ, scaled ones where the high-fidelity u or λ is zero."""
    energy = assemblies(inputs.problem).energy_at(query.mu)
    (error,) = errors(inputs.problem, [query.vi], [energy], query.exact, u[:, None], lam[:, None])
    measured = {"error_u": error.error_u, "error_lambda": error.error_lambda}
    scaled = {"error_u_scaled": error.error_u_scaled, "error_lambda_scaled": error.error_lambda_scaled}
    figures = {name: value for name, value in measured.items() if value is not None}
    return figures | {name: value for name, value in scaled.items() if name.removesuffix("_scaled") not in figures}


def time_solver(inputs: StageInputs, size: Size, solver: str, accuracy: float) -> Timing:
    """One reduced program, solved to an accuracy."""
    registered, spaces = qp_solver(solver), _spaces(inputs, size)
    N, R = inputs.dimensions(spaces)
    smaller = SIZES[: SIZES.index(size)]
    if smaller and inputs.dimensions(_spaces(inputs, smaller[-1])) == (N, R):
        raise LeftOutError(f"the snapshots of {inputs.case} give N = {N} and R = {R} at most")
    reduced = inputs.online(spaces, inputs.primal).given().assembled.assemble(inputs.queries[0].mu)

    def judge(answer: QPSolution) -> Info:
        status, reason, residuals = verify(reduced.program, answer, accuracy)
        return {
            "solver": solver, "asked": accuracy, "N": N, **_shape(reduced),
            "status": status.value, "reason": reason, "solver_status": answer.solver_status,
            "iterations": answer.iterations, "accuracy": {} if residuals is None else residual_figures(residuals),
        }  # fmt: skip

    return Timing(
        f"QP of N = {N}, R = {R}",
        lambda: solve_qp(reduced.program, solver, accuracy, registered, reduced.factor),
        judge,
    )


def _spaces(inputs: StageInputs, size: Size) -> ReducedSpaces:
    """ReducedSpaces of this size, as far as the snapshots give them."""
    modes = min(size.N, inputs.modes(Stop(tolerance=SMALLEST)))
    return ReducedSpaces(Stop(size=modes), Stop(size=size.R), inputs.usual.dual)


def _shape(reduced: ReducedProblem) -> dict[str, int | str]:
    """Unknowns N' and constraints R of a reduced program, and the form in which it is solved."""
    form = "primal" if reduced.factor is None else "dual"
    return {"dimension": len(reduced.program.f), "R": len(reduced.program.g), "form": form}


ONLINE: tuple[Callable[..., Timing], ...] = (
    time_projection_of_members,
    time_assembly_in_full,
    time_assembly_reduced,
    time_query,
    time_solver,
)
