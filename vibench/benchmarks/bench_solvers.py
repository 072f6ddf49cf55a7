"""Every QP solver on reduced programs of several sizes, asked for a moderate and for a high accuracy."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from vibench.benchmarks import reached
from vibench.benchmarks.cases import ACCURACIES, DIMENSIONS, Case, Primal, Size, Spaces
from vibench.benchmarks.material import Material
from vibench.benchmarks.measure import MARKS, Info, measure
from vibench.interfaces.strategies import Stop
from vibench.model.galerkin import ReducedProblem
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution
from vibench.study import registry

pytestmark = MARKS


SMALLEST = 1e-8
"""Tolerance of the POD that has all modes which a reduced program may have."""


def spaces(material: Material, size: Size) -> Spaces:
    """Spaces of this size, as far as the snapshots give them."""
    dual = material.usual.dual
    modes = material.pod(Spaces(Stop(tolerance=SMALLEST), material.usual.cone, dual)).basis.shape[1]
    return Spaces(Stop(size=min(size.N, modes)), Stop(size=size.R), dual)


def dimensions(material: Material, size: Size) -> tuple[int, int]:
    """N and R of these spaces."""
    found = spaces(material, size)
    return material.pod(found).basis.shape[1], material.cone(found).cone.size


def reduced_problem(material: Material, size: Size, primal: Primal) -> ReducedProblem:
    """The reduced problem of a size at the first validation parameter; one that a smaller size gives is left out."""
    N, R = dimensions(material, size)
    smaller = DIMENSIONS[: DIMENSIONS.index((size.N, size.R))]
    if smaller and dimensions(material, Size(size.case, *smaller[-1])) == (N, R):
        pytest.skip(f"the snapshots of {size.case} give N = {N} and R = {R} at most")
    model, _ = material.online(primal, spaces(material, size))
    return model.assemble(material.queries[0].mu)


@pytest.mark.parametrize("accuracy", ACCURACIES, ids="{:.0e}".format)
def test_solver(
    benchmark: BenchmarkFixture,
    materials: Callable[[Case], Material],
    completing: Primal,
    size: Size,
    solver: str,
    accuracy: float,
) -> None:
    """One reduced program, solved to an accuracy."""
    registered = registry.qp_solver(solver)
    reduced = reduced_problem(materials(size.case), size, completing)
    N, R = dimensions(materials(size.case), size)
    form = "primal" if reduced.factor is None else "dual"

    def judge(answer: QPSolution) -> Info:
        found = reached.of_answer(reduced.program, answer, accuracy)
        return {"solver": solver, "asked": accuracy, "form": form, "N": N, **found}

    measure(
        benchmark,
        f"QP of N = {N}, R = {R}",
        lambda: solve_qp(reduced.program, solver, accuracy, registered, reduced.factor),
        judge,
    )
