"""Every QP solver on reduced programs of several sizes, asked for a moderate and for a high accuracy."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from benchmarks import reached
from benchmarks.cases import ACCURACIES, ENRICHED, Case, Size
from benchmarks.material import Material
from benchmarks.measure import MARKS, Info, measure
from vibench.model.galerkin import ReducedProblem
from vibench.qp.solution import QPSolution
from vibench.qp.solve import solve_qp
from vibench.study import registry

pytestmark = MARKS


def reduced_problem(material: Material, size: Size) -> ReducedProblem:
    """The reduced problem of a size at the first validation parameter."""
    model, _ = material.online(ENRICHED, size.spaces)
    return model.assemble(material.queries[0].mu)


@pytest.mark.parametrize("accuracy", ACCURACIES, ids="{:.0e}".format)
def test_solver(
    benchmark: BenchmarkFixture, materials: Callable[[Case], Material], size: Size, solver: str, accuracy: float
) -> None:
    registered = registry.qp_solver(solver)
    reduced = reduced_problem(materials(size.case), size)
    form = "primal" if reduced.factor is None else "dual"

    def judge(answer: QPSolution) -> Info:
        found = reached.of_answer(reduced.program, answer, accuracy)
        return {"solver": solver, "asked": accuracy, "form": form, "N": size.N, **found}

    measure(
        benchmark,
        f"QP of {size}",
        lambda: solve_qp(reduced.program, solver, accuracy, registered, reduced.factor),
        judge,
    )
