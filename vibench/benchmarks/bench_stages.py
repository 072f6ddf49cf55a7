"""Every stage of every registered problem at every resolution asked for, with every registered strategy."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from vibench.arrays import Array
from vibench.benchmarks import reached
from vibench.benchmarks.cases import Primal
from vibench.benchmarks.material import INTERPOLATION, QUERIES, Material, model_with, solve_all
from vibench.benchmarks.measure import MARKS, Info, measure
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.strategies import Cone, Enrichment
from vibench.interfaces.validation import check_cone, check_enrichment
from vibench.model.affine import affine_decomposition
from vibench.model.galerkin import ReducedProblem
from vibench.model.hyperreduced import HyperReducedModel, Operators, hyper_reduce
from vibench.offline.models import AnyReducedModel
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution
from vibench.reduction.pod import pod
from vibench.study import registry

pytestmark = MARKS

SOLVER, ACCURACY = "piqp", 1e-10
"""Of complete queries."""


def test_high_fidelity_solution(benchmark: BenchmarkFixture, material: Material) -> None:
    """One, by a solver that has solved nothing before."""
    problem, mu = material.problem, material.training[0]
    measure(
        benchmark,
        "high-fidelity solution",
        lambda solver: solver.solve(mu),
        lambda found: reached.of_solutions(material, [found]),
        lambda: HighFidelitySolver(problem),
    )


def test_high_fidelity_sweep(benchmark: BenchmarkFixture, material: Material) -> None:
    """All training parameters."""
    problem, training = material.problem, material.training
    measure(
        benchmark,
        "high-fidelity sweep",
        lambda: solve_all(problem, training),
        lambda found: reached.of_solutions(material, found),
    )


def test_pod(benchmark: BenchmarkFixture, material: Material) -> None:
    """POD of the snapshots."""
    problem, (u, _) = material.problem, material.snapshots
    measure(
        benchmark, "POD", lambda: pod(u, problem.V, material.usual.pod), lambda found: reached.of_pod(material, found)
    )


def test_cone(benchmark: BenchmarkFixture, material: Material, dual: str) -> None:
    """A cone by one dual strategy."""
    W, (_, lam) = material.problem.W, material.snapshots
    strategy = registry.create("dual strategy", dual, {})

    def judge(found: Cone) -> Info:
        return reached.of_cone(material, check_cone(found, W))

    measure(benchmark, "cone", lambda: strategy.reduce(lam, W, material.usual.cone), judge)


def test_enrichment(benchmark: BenchmarkFixture, material: Material, primal: Primal) -> None:
    """An enrichment by one primal strategy."""
    offline = material.offline()
    strategy = registry.create("primal strategy", primal.name, {})

    def judge(found: Enrichment) -> Info:
        check_enrichment(found, offline.problem.V, offline.basis)
        return reached.of_enrichment(material, found, model_with(offline, found))

    measure(benchmark, "enrichment", lambda: strategy.build(offline, primal.tolerance), judge)


def test_separation(benchmark: BenchmarkFixture, material: Material) -> None:
    """The members as sums of parameter-independent terms, or samples of them."""
    problem, training = material.problem, material.training
    measure(
        benchmark,
        "separation",
        lambda: affine_decomposition(problem, training, INTERPOLATION),
        lambda found: reached.of_separation(material, found),
    )


def test_projection_of_members(benchmark: BenchmarkFixture, material: Material, primal: Primal) -> None:
    """What reduced assembly prepares for one enrichment."""
    members = material.members
    why = material.operators(primal)
    if isinstance(why, str):
        pytest.skip(f"queries have to be assembled in full: {why}")

    def judge(found: Operators) -> Info:
        return reached.of_programs(material, HyperReducedModel(material.model(primal), found))

    measure(
        benchmark,
        "projection of members",
        lambda model: hyper_reduce(model, members),
        judge,
        lambda: material.model(primal),
    )


def test_assembly_in_full(benchmark: BenchmarkFixture, material: Material, primal: Primal) -> None:
    """A reduced program from matrices of full size."""
    _assembly(benchmark, "assembly in full", material, material.model(primal))


def test_assembly_reduced(benchmark: BenchmarkFixture, material: Material, primal: Primal) -> None:
    """A reduced program from projected members."""
    model, why = material.online(primal)
    if why:
        pytest.skip(f"queries have to be assembled in full: {why}")
    _assembly(benchmark, "assembly, reduced", material, model)


def _assembly(benchmark: BenchmarkFixture, group: str, material: Material, model: AnyReducedModel) -> None:
    mus = _in_turn(material)
    measure(
        benchmark,
        group,
        lambda: model.assemble(next(mus)),
        lambda _: reached.of_programs(material, model),
        together=QUERIES,
    )


def test_query(benchmark: BenchmarkFixture, material: Material, primal: Primal) -> None:
    """Assembly in the quickest way there is, and solution."""
    model, why = material.online(primal)
    mus = _in_turn(material)

    def solve(reduced: ReducedProblem) -> QPSolution:
        return solve_qp(reduced.program, SOLVER, ACCURACY, factor=reduced.factor)

    def judge(_: QPSolution) -> Info:
        assembly = f"full: {why}" if why else "reduced"
        return {**reached.of_queries(material, model, solve, ACCURACY), "solver": SOLVER, "assembly": assembly}

    measure(benchmark, "query", lambda: solve(model.assemble(next(mus))), judge, together=QUERIES)


def _in_turn(material: Material) -> Iterator[Array]:
    """The validation parameters, again and again."""
    return cycle([query.mu for query in material.queries])
