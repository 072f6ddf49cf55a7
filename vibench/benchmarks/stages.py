"""Benchmarks of every stage, as tests of pytest with the fixtures `timing` and `inputs` of `vibench.benchmarks.plugin`.

The other arguments are the axes of a benchmark. What was reached is computed from the results and from nothing that
they claim.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from functools import partial, wraps
from itertools import cycle
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar, cast

import numpy as np
import pytest

from vibench.arrays import Array
from vibench.benchmarks import PrimalChoice, ReducedSpaces, Setting, Size, TimedProblem, Timing
from vibench.errors import UnsupportedError
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces import validation
from vibench.interfaces.formulations import FormulationAnswer, Snapshots
from vibench.interfaces.problem import MEMBERS, Problem, VariationalInequality
from vibench.interfaces.strategies import Enrichment, ReducedSet, Stop
from vibench.linalg.inner_product import InnerProduct, project_out, singular_values
from vibench.model.affine import AffineMember, Evaluation, affine_decomposition
from vibench.model.errors import ReferenceSolutions, errors
from vibench.model.galerkin import ReducedModel, ReducedProblem, project
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel, hyper_reduce
from vibench.offline.assemblies import assemblies
from vibench.offline.models import Model
from vibench.offline.reduction import Reduction, high_fidelity_sweep
from vibench.offline.solution import Solution
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import find, qp_solver
from vibench.qp.solve import form_of, solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, Residuals, verify
from vibench.reduction.cones import project_on_cone
from vibench.reduction.pod import POD, pod
from vibench.reduction.supremizers import supremizers

# CPU seconds: whoever else uses the machine counts less.
pytestmark = pytest.mark.benchmark(timer=time.process_time)

P = ParamSpec("P")
T = TypeVar("T")
Info = Mapping[str, Any]


class ValidationQuery(NamedTuple):
    """A validation parameter (d,), the matrices there, and the high-fidelity solution."""

    mu: Array
    vi: VariationalInequality
    exact: ReferenceSolutions


def _once(make: Callable[Concatenate[StageInputs, P], T]) -> Callable[Concatenate[StageInputs, P], T]:
    """Cache a method for all benchmarks, its exception, too: an input that cannot be made is not tried again."""

    @wraps(make)
    def made(self: StageInputs, /, *args: P.args, **kwargs: P.kwargs) -> T:
        key = (make.__name__, *args)
        if key not in self.made:
            self.made[key] = Future()
            try:
                self.made[key].set_result(make(self, *args, **kwargs))
            except (Exception, SystemExit) as error:  # noqa: BLE001  plugins are code of strangers
                self.made[key].set_exception(error)
        return cast("T", self.made[key].result())

    return made


class StageInputs:
    """The problem of a case, and what its stages need from those before, made once and never timed."""

    def __init__(self, case: TimedProblem, setting: Setting) -> None:
        self.case, self.usual, self.primal = case, setting.spaces, setting.primal
        self.interpolation = 1e-6
        self.made: dict[Hashable, Future[Any]] = {}
        self.sizes: dict[tuple[int, int], Size] = {}

    @property
    @_once
    def problem(self) -> Problem:
        options = {} if self.case.resolution is None else {"resolution": self.case.resolution}
        return cast("Problem", find(PluginKind.PROBLEM, self.case.problem).create(options))

    @property
    @_once
    def training(self) -> Array:
        return validation.training_parameters(self.problem)

    @property
    @_once
    def snapshots(self) -> Snapshots:
        return high_fidelity_sweep(self.problem, self.training)

    @property
    @_once
    def most_modes(self) -> int:
        return len(pod(self.snapshots.u, self.problem.V, Stop(tolerance=1e-8)).basis.T)

    @property
    @_once
    def members(self) -> Mapping[str, AffineMember]:
        return affine_decomposition(self.problem, self.training, self.interpolation)

    @property
    @_once
    def queries(self) -> list[ValidationQuery]:
        problem, snapshots = self.problem, self.snapshots
        mus = validation.validation_parameters(problem, 8, seed=2022)
        scales = float(problem.V.norm(snapshots.u).max()), float(problem.W.norm(snapshots.lam).max())
        exact = [ReferenceSolutions(s.u[:, None], s.lam[:, None], *scales) for s in solve_all(problem, mus)]
        return list(map(ValidationQuery, mus, [validation.checked_assembly(problem, mu) for mu in mus], exact))

    @_once
    def reduction(self, spaces: ReducedSpaces, primal: PrimalChoice | None = None) -> Reduction:
        """V_N and the cone at some spaces, and the enrichment where there is a primal strategy."""
        # `given()` makes the same reduction anew, whose models have nothing in store from earlier queries.
        dual = find(PluginKind.DUAL, spaces.dual).create({})
        strategy = None if primal is None else find(PluginKind.PRIMAL, primal.name).create({})
        reduction = Reduction(
            self.problem, dual, strategy, spaces.modes, spaces.generators, None if primal is None else primal.tolerance,
            assembly="reduced", interpolation=self.interpolation, solver="piqp", accuracy=1e-10,
        ).given(snapshots=self.snapshots, parameters=self.training)  # fmt: skip
        # POD and cone do not depend on the enrichment: all strategies share them.
        if primal is not None:
            before = self.reduction(spaces)
            reduction = reduction.given(pod=before.pod, cone=before.cone, multipliers=before.multipliers)
        made = {"pod": reduction.pod, "cone": reduction.cone, "multipliers": reduction.multipliers}
        return reduction.given(**made, enrichment=reduction.enrichment)

    @_once
    def online(self, spaces: ReducedSpaces, primal: PrimalChoice) -> Reduction:
        """The reduction with projected members, or with the reason why queries have to be assembled in full."""
        reduction = self.reduction(spaces, primal).given(members=self.members)
        return reduction.given(operators=reduction.operators)


def solve_all(problem: Problem, mus: Array) -> list[HighFidelitySolution]:
    return list(map(HighFidelitySolver(problem).solve, mus))


def test_high_fidelity_solution(timing: Timing, inputs: StageInputs) -> None:
    """One high-fidelity solution, by a solver that has solved nothing before."""
    mu, fresh = inputs.training[0], partial(HighFidelitySolver, inputs.problem)
    timing("high-fidelity solution", lambda solver: solver.solve(mu), lambda one: _judge_solutions([one]), fresh)


def test_high_fidelity_sweep(timing: Timing, inputs: StageInputs) -> None:
    """High-fidelity solutions at all training parameters."""
    problem, training = inputs.problem, inputs.training
    timing("high-fidelity sweep", lambda: solve_all(problem, training), _judge_solutions)


def _judge_solutions(solutions: Sequence[HighFidelitySolution]) -> Info:
    figures = largest_figures(residual_figures(s.residuals) for s in solutions)
    return {"fallbacks": sum(bool(s.fallback) for s in solutions), "accuracy": figures}


def residual_figures(residuals: Residuals) -> dict[str, float]:
    return {"primal_residual": residuals.primal, "dual_residual": residuals.dual, "gap": residuals.gap}


def test_pod(timing: Timing, inputs: StageInputs) -> None:
    V, u, stop = inputs.problem.V, inputs.snapshots.u, inputs.usual.modes

    def judge(modes: POD) -> Info:
        tail = np.linalg.norm(V.norm(u - modes.basis @ V.gram(modes.basis, u))) / np.linalg.norm(V.norm(u))
        return {"N": modes.basis.shape[1], "accuracy": {"tail": tail, "orthonormality": orthonormality(modes.basis, V)}}

    timing("POD", lambda: pod(u, V, stop), judge)


def orthonormality(Z: Array, V: InnerProduct) -> float:
    """Largest entry of ZᵀX_VZ − I."""
    return float(np.abs(V.gram(Z, Z) - np.eye(Z.shape[1])).max(initial=0.0))


def test_cone(timing: Timing, inputs: StageInputs, dual: str) -> None:
    """A cone by one dual strategy; reached is the largest distance of a snapshot, relative to the largest norm."""
    W, lam, stop = inputs.problem.W, inputs.snapshots.lam, inputs.usual.generators
    strategy = find(PluginKind.DUAL, dual).create({})

    def judge(cone: ReducedSet) -> Info:
        rays = validation.check_cone(cone, W).rays
        largest = max((project_on_cone(rays, theta, W).distance for theta in lam.T), default=0.0)
        error = largest / (float(W.norm(lam).max(initial=0.0)) or 1.0)
        return {"R": cone.size, "fallbacks": len(cone.fallbacks), "accuracy": {"projection_error": error}}

    timing("cone", lambda: strategy.reduce(lam, W, stop), judge)


def test_enrichment(timing: Timing, inputs: StageInputs, primal: PrimalChoice) -> None:
    """An enrichment by one primal strategy; reached is σ of equation (21), at some of the training parameters."""
    reduction, strategy = inputs.reduction(inputs.usual), find(PluginKind.PRIMAL, primal.name).create({})
    offline = reduction.offline

    def judge(enrichment: Enrichment) -> Info:
        validation.check_enrichment(enrichment, offline.problem.V, offline.basis)
        model = reduction.given(enrichment=enrichment).projection
        # σ costs a full assembly and an orthonormalisation at every parameter.
        some = np.unique(np.linspace(0, len(offline.training) - 1, 9).round().astype(int))
        figures = {"sigma": max(_sigma(model, offline.training[k]) for k in some)}
        size = 0 if enrichment.vectors is None else enrichment.vectors.shape[1]
        return {"enrichment": size, "fallbacks": len(enrichment.fallbacks), "accuracy": figures}

    timing("enrichment", lambda: strategy.build(offline, primal.tolerance), judge)


def _sigma(model: ReducedModel, mu: Array) -> float:
    """Largest sine between a supremizer at mu (d,) and the enriched space."""
    V, vi = model.problem.V, validation.checked_assembly(model.problem, mu)
    wanted = V.whiten(V.orthonormalise(supremizers(V, vi.B, model.span)))
    return float(singular_values(project_out(V.whiten(model.primal_basis(vi)), wanted)).max(initial=0.0))


def test_separation(timing: Timing, inputs: StageInputs) -> None:
    """The members as sums of parameter-independent terms, or samples of them; reached is the interpolation error."""
    problem, training = inputs.problem, inputs.training

    def judge(members: Mapping[str, AffineMember]) -> Info:
        sampled = {name: m for name, m in members.items() if m.way is Evaluation.INTERPOLATED}
        places = {name: (m.rows, m.columns) for name, m in sampled.items()}
        largest = 0.0
        # Affine members are exact.
        for query in inputs.queries if places else ():
            for name, theta in problem.sampler(places)(query.mu).items():
                summed = sum(value * term for value, term in zip(theta, sampled[name].terms, strict=True))
                largest = max(largest, relative_difference(summed, getattr(query.vi, name)))
        return {"accuracy": {"interpolation_error": largest}}

    timing("separation", lambda: affine_decomposition(problem, training, inputs.interpolation), judge)


def relative_difference(value: Array, exact: Array) -> float:
    """Euclidean norm of the difference of two members, dense or sparse, relative to that of the second."""

    def norm(member: Array) -> float:
        return float(np.linalg.norm(member if isinstance(member, np.ndarray) else member.data))

    return norm(value - exact) / (norm(exact) or 1.0)


def test_projection_of_members(timing: Timing, inputs: StageInputs, primal: PrimalChoice) -> None:
    """Projection of the members on one enriched space."""
    _check_reduced(inputs, primal)
    reduction, members = inputs.reduction(inputs.usual, primal), inputs.members

    timing(
        "projection of members",
        lambda model: hyper_reduce(model, members),
        lambda operators: _judge_programs(inputs, HyperReducedModel(reduction.given().projection, operators)),
        lambda: reduction.given().projection,
    )


def test_assembly_in_full(timing: Timing, inputs: StageInputs, primal: PrimalChoice) -> None:
    """A reduced program from matrices of full size."""
    _time_assembly(timing, inputs, "assembly in full", inputs.reduction(inputs.usual, primal).given().projection)


def test_assembly_reduced(timing: Timing, inputs: StageInputs, primal: PrimalChoice) -> None:
    """A reduced program from projected members."""
    _check_reduced(inputs, primal)
    _time_assembly(timing, inputs, "assembly, reduced", inputs.online(inputs.usual, primal).given().assembled)


def _check_reduced(inputs: StageInputs, primal: PrimalChoice) -> None:
    """Leave out a benchmark of reduced assembly where there is none."""
    if isinstance(why := inputs.online(inputs.usual, primal).operators, str):
        pytest.skip(f"queries have to be assembled in full: {why}")


def _time_assembly(timing: Timing, inputs: StageInputs, group: str, model: AnyReducedModel) -> None:
    mus, judge = _in_turn(inputs), lambda _: _judge_programs(inputs, model)
    timing(group, lambda: model.assemble(next(mus)), judge, in_turn=inputs.queries)


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


def test_query(timing: Timing, inputs: StageInputs, primal: PrimalChoice) -> None:
    """Assembly in the quickest way there is, and solution; reached are errors against high-fidelity solutions."""
    reduction, mus = inputs.online(inputs.usual, primal).given(), _in_turn(inputs)
    model = reduction.model

    def query() -> QPSolution:
        reduced = model.reduced.assemble(next(mus))
        return solve_qp(reduced.program, reduction.solver, model.accuracy, factor=reduced.factor)

    def judge(_: QPSolution) -> Info:
        return _judge_answers(inputs, model, lambda answer: answer.residuals)

    timing("query", query, judge, in_turn=inputs.queries)


def _judge_answers(inputs: StageInputs, model: Model, residuals: Callable[[Solution], Residuals | None]) -> Info:
    """The worst status, and the largest residuals and errors of answers at the validation parameters."""
    answers = [model.solve(query.mu) for query in inputs.queries]
    worst = max(answers, key=lambda answer: answer.status.severity)
    figures = []
    for query, answer in zip(inputs.queries, answers, strict=True):
        if (known := residuals(answer)) is not None:
            figures.append(residual_figures(known) | errors_of(inputs, query, answer.u, answer.lam))
    accuracy = largest_figures(figures) if len(figures) == len(answers) else {}
    return {"status": worst.status.value, "reason": worst.reason, "accuracy": accuracy}


def _in_turn(inputs: StageInputs) -> Iterator[Array]:
    return cycle([query.mu for query in inputs.queries])


def errors_of(inputs: StageInputs, query: ValidationQuery, u: Array, lam: Array) -> dict[str, float]:
    """Relative errors of u and λ, scaled ones where the high-fidelity u or λ is zero."""
    energy = assemblies(inputs.problem).energy_at(query.mu)
    (error,) = errors(inputs.problem, [query.vi], [energy], query.exact, u[:, None], lam[:, None])
    pairs = (("error_u", "error_u_scaled"), ("error_lambda", "error_lambda_scaled"))
    names = [scaled if getattr(error, relative) is None else relative for relative, scaled in pairs]
    return {name: getattr(error, name) for name in names}


def test_solver(timing: Timing, inputs: StageInputs, size: Size, solver: str, accuracy: float) -> None:
    """One reduced program, solved to an accuracy."""
    # The spaces of this size, as far as the snapshots give them.
    spaces = ReducedSpaces(Stop(size=min(size.N, inputs.most_modes)), Stop(size=size.R), inputs.usual.dual)
    N, R = inputs.reduction(spaces).pod.basis.shape[1], inputs.reduction(spaces).cone.size
    # The snapshots of a problem give so many dimensions; larger programs would be the same.
    if inputs.sizes.setdefault((N, R), size) != size:
        pytest.skip(f"the snapshots of {inputs.case} give N = {N} and R = {R} at most")
    reduced = inputs.online(spaces, inputs.primal).given().assembled.assemble(inputs.queries[0].mu)

    def judge(answer: QPSolution) -> Info:
        status, reason, residuals = verify(reduced.program, answer, accuracy)
        figures = {} if residuals is None else residual_figures(residuals)
        shape = {**_shape(reduced), "form": form_of(solver, reduced.factor, extra)}
        return {**shape, "N": N, "status": status.value, "reason": reason, "accuracy": figures}

    extra = qp_solver(solver)
    solve = partial(solve_qp, reduced.program, solver, accuracy, extra, reduced.factor)
    timing(f"QP of N = {N}, R = {R}", solve, judge)


def _shape(reduced: ReducedProblem) -> dict[str, int | str]:
    """Unknowns N' and constraints R of a reduced program, and the form in which it is solved."""
    form = "primal" if reduced.factor is None else "dual"
    return {"dimension": len(reduced.program.f), "R": len(reduced.program.g), "form": form}


def test_formulation(timing: Timing, inputs: StageInputs, formulation: str) -> None:
    """The offline part of a formulation, and its model."""
    build = _formulated(inputs, formulation)
    timing("formulation", build, lambda model: _judge_answers(inputs, model, _high_fidelity_residuals))


def test_formulated_query(timing: Timing, inputs: StageInputs, formulation: str) -> None:
    """A query of a formulation; reached are errors, and residuals of the high-fidelity problem."""
    # Another parameter in every call: a formulation that keeps its last answer gains nothing.
    model, mus = _formulated(inputs, formulation)(), _in_turn(inputs)

    def query() -> FormulationAnswer:
        return model.online.solve(next(mus), model.settings()[0])

    def judge(_: FormulationAnswer) -> Info:
        return _judge_answers(inputs, model, _high_fidelity_residuals)

    timing("query of a formulation", query, judge, in_turn=inputs.queries)


def _formulated(inputs: StageInputs, formulation: str) -> Callable[[], Model]:
    """Return a function that builds a formulation on the offline phase of the setting, where it can be built."""
    offline, made = inputs.online(inputs.usual, inputs.primal), find(PluginKind.FORMULATION, formulation).create({})

    def build() -> Model:
        model = offline.with_formulation(made).model
        model.online  # noqa: B018  is made
        return model

    try:
        build()
    except UnsupportedError as error:
        pytest.skip(str(error))
    return build


def _high_fidelity_residuals(answer: Solution) -> Residuals | None:
    return None if answer.x is None or answer.status is Status.NONFINITE else answer.high_fidelity_residuals


def largest_figures(several: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the largest of every figure, NaN where one is."""
    largest: dict[str, float] = {}
    for figures in several:
        largest |= {name: float(np.maximum(value, largest.get(name, -np.inf))) for name, value in figures.items()}
    return largest
