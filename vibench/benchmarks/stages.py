"""What is timed: every stage of a problem with every strategy, and QP solvers on reduced programs of several sizes.

The arguments of a function beside the inputs are the axes of its benchmarks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import cycle

from vibench.arrays import Array
from vibench.benchmarks import accuracy as reached
from vibench.benchmarks.cases import SIZES, PrimalChoice, Size, Spaces
from vibench.benchmarks.inputs import INTERPOLATION, QUERIES, StageInputs, solve_all
from vibench.benchmarks.measure import Info, Timing
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.strategies import Cone, Enrichment, Stop
from vibench.interfaces.validation import check_cone, check_enrichment
from vibench.model.affine import affine_decomposition
from vibench.model.galerkin import ReducedProblem
from vibench.model.hyperreduced import HyperReducedModel, Operators, hyper_reduce
from vibench.offline.models import AnyReducedModel
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution
from vibench.reduction.pod import pod
from vibench.study.kinds import DUAL, PRIMAL
from vibench.study.registry import find, qp_solver

SOLVER, ACCURACY = "piqp", 1e-10
"""Of complete queries."""

SMALLEST = 1e-8
"""Tolerance of the POD that has all modes which a reduced program may have."""


class LeftOutError(Exception):
    """There is nothing to time."""


def time_high_fidelity_solution(inputs: StageInputs) -> Timing:
    """One high-fidelity solution, by a solver that has solved nothing before."""
    problem, mu = inputs.problem, inputs.training[0]
    return Timing(
        "high-fidelity solution",
        lambda solver: solver.solve(mu),
        lambda solution: reached.of_solutions(inputs, [solution]),
        lambda: HighFidelitySolver(problem),
    )


def time_high_fidelity_sweep(inputs: StageInputs) -> Timing:
    """High-fidelity solutions at all training parameters."""
    problem, training = inputs.problem, inputs.training
    return Timing(
        "high-fidelity sweep",
        lambda: solve_all(problem, training),
        lambda solutions: reached.of_solutions(inputs, solutions),
    )


def time_pod(inputs: StageInputs) -> Timing:
    """POD of the snapshots."""
    V, u, stop = inputs.problem.V, inputs.snapshots.u, inputs.usual.modes
    return Timing("POD", lambda: pod(u, V, stop), lambda basis: reached.of_pod(inputs, basis))


def time_cone(inputs: StageInputs, dual: str) -> Timing:
    """A cone by one dual strategy."""
    W, lam, stop = inputs.problem.W, inputs.snapshots.lam, inputs.usual.generators
    strategy = find(DUAL, dual).create({})

    def judge(cone: Cone) -> Info:
        return reached.of_cone(inputs, check_cone(cone, W))

    return Timing("cone", lambda: strategy.reduce(lam, W, stop), judge)


def time_enrichment(inputs: StageInputs, primal: PrimalChoice) -> Timing:
    """An enrichment by one primal strategy."""
    reduction, strategy = inputs.reduction(inputs.usual), find(PRIMAL, primal.name).create({})
    offline = reduction.offline

    def judge(enrichment: Enrichment) -> Info:
        check_enrichment(enrichment, offline.problem.V, offline.basis)
        return reached.of_enrichment(inputs, enrichment, reduction.given(enrichment=enrichment).projection)

    return Timing("enrichment", lambda: strategy.build(offline, primal.tolerance), judge)


def time_separation(inputs: StageInputs) -> Timing:
    """The members as sums of parameter-independent terms, or samples of them."""
    problem, training = inputs.problem, inputs.training
    return Timing(
        "separation",
        lambda: affine_decomposition(problem, training, INTERPOLATION),
        lambda members: reached.of_separation(inputs, members),
    )


def time_projection_of_members(inputs: StageInputs, primal: PrimalChoice) -> Timing:
    """What reduced assembly prepares for one enrichment."""
    reduction, members = inputs.reduction(inputs.usual, primal), inputs.members
    _check_reduced(inputs, primal)

    def judge(operators: Operators) -> Info:
        return reached.of_programs(inputs, HyperReducedModel(reduction.given().projection, operators))

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
    mus = _in_turn(inputs)
    return Timing(
        group,
        lambda: model.assemble(next(mus)),
        lambda _: reached.of_programs(inputs, model),
        together=QUERIES,
    )


def time_query(inputs: StageInputs, primal: PrimalChoice) -> Timing:
    """Assembly in the quickest way there is, and solution."""
    reduction = inputs.online(inputs.usual, primal)
    model, why = reduction.given().assembled, reduction.operators
    mus = _in_turn(inputs)

    def solve(reduced: ReducedProblem) -> QPSolution:
        return solve_qp(reduced.program, SOLVER, ACCURACY, factor=reduced.factor)

    def judge(_: QPSolution) -> Info:
        assembly = f"full: {why}" if isinstance(why, str) else "reduced"
        return {**reached.of_queries(inputs, model, solve, ACCURACY), "solver": SOLVER, "assembly": assembly}

    return Timing("query", lambda: solve(model.assemble(next(mus))), judge, together=QUERIES)


def _in_turn(inputs: StageInputs) -> Iterator[Array]:
    """The validation parameters, again and again."""
    return cycle([query.mu for query in inputs.queries])


def time_solver(inputs: StageInputs, size: Size, solver: str, accuracy: float) -> Timing:
    """One reduced program, solved to an accuracy."""
    registered = qp_solver(solver)
    spaces = _spaces(inputs, size)
    N, R = inputs.dimensions(spaces)
    smaller = SIZES[: SIZES.index(size)]
    if smaller and inputs.dimensions(_spaces(inputs, smaller[-1])) == (N, R):
        raise LeftOutError(f"the snapshots of {inputs.case} give N = {N} and R = {R} at most")
    model = inputs.online(spaces, inputs.primal).given().assembled
    reduced = model.assemble(inputs.queries[0].mu)
    form = "primal" if reduced.factor is None else "dual"

    def judge(answer: QPSolution) -> Info:
        figures = reached.of_answer(reduced.program, answer, accuracy)
        return {"solver": solver, "asked": accuracy, "form": form, "N": N, **figures}

    return Timing(
        f"QP of N = {N}, R = {R}",
        lambda: solve_qp(reduced.program, solver, accuracy, registered, reduced.factor),
        judge,
    )


def _spaces(inputs: StageInputs, size: Size) -> Spaces:
    """Spaces of this size, as far as the snapshots give them."""
    modes = min(size.N, inputs.modes(Stop(tolerance=SMALLEST)))
    return Spaces(Stop(size=modes), Stop(size=size.R), inputs.usual.dual)


BENCHMARKS: dict[str, Callable[..., Timing]] = {
    function.__name__.removeprefix("time_"): function
    for function in (
        time_high_fidelity_solution,
        time_high_fidelity_sweep,
        time_pod,
        time_cone,
        time_enrichment,
        time_separation,
        time_projection_of_members,
        time_assembly_in_full,
        time_assembly_reduced,
        time_query,
        time_solver,
    )
}
"""The functions by the names of their benchmarks."""
