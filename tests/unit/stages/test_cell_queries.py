from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import SampleStore, carry_out, mixed_cell

from vibench import ParameterBox, Stop, VariationalInequality
from vibench.offline.assemblies import Assemblies
from vibench.plugins.plugin import Plugin
from vibench.qp import verification
from vibench.qp.solve import solve_qp, takes_start
from vibench.stages import cell_queries
from vibench.stages.assessment import error_columns
from vibench.stages.base import value_of
from vibench.stages.cell_queries import CellQueries
from vibench.stages.query import path_before, query_before
from vibench.study.parameter_sets import ParameterSet

BOX = ParameterBox(("a", "b"), np.array([0.0, 0.0]), np.array([1.0, 100.0]), ("1", "1"))
PROBLEM = Plugin("problem", "radial-obstacle", '{"resolution": 200}', "test")


def cell(problem: Plugin, solver: str, accuracy: float, dual: str = "cpg", *, bounds: bool = False) -> CellQueries:
    kinds = Stop(size=4), dual, Stop(size=3), "decorrelated", ParameterSet("validation", 4, 1)
    interpolation = 1e-6 if bounds else None
    return mixed_cell(problem, *kinds, interpolation=interpolation, solver=solver, accuracy=accuracy, bounds=bounds)


@given(st.integers(0, 10_000), st.integers(1, 12))
def test_a_path_visits_every_parameter_once_and_goes_on_to_the_nearest(seed: int, count: int) -> None:
    mus = BOX.sample(count, seed)
    before = path_before(mus, BOX)
    after = {one: k for k, one in enumerate(before) if one is not None}
    path = [0]
    while path[-1] in after:
        path.append(after[path[-1]])
    assert before[0] is None
    assert sorted(path) == list(range(count))
    scaled = mus / BOX.upper
    for step, (here, there) in enumerate(pairwise(path)):
        apart = np.linalg.norm(scaled[path[step + 1 :]] - scaled[here], axis=1)
        assert np.linalg.norm(scaled[there] - scaled[here]) == pytest.approx(apart.min())


def test_rows_say_which_query_of_the_path_they_started_from(tmp_path: Path) -> None:
    problem = PROBLEM.create()
    walk = Plugin("sampling strategy", "random-walk", '{"size": 5, "seed": 1}', "test")
    assert query_before(ParameterSet("validation", 5, 1, walk), problem) == [None, 0, 1, 2, 3]
    own = ParameterSet("validation", 5, 1)
    assert query_before(own, problem) == path_before(own.of(problem), problem.parameters) != [None, 0, 1, 2, 3]
    stage, store, started = cell(PROBLEM, "osqp", 1e-6), SampleStore(tmp_path), {}
    for warm, solver in ((False, "osqp"), (True, "osqp"), (True, "piqp")):
        asked = replace(stage, warm_start=warm, solver=solver)
        carry_out(asked, store)
        rows = value_of(store, asked).queries
        assert {row["status"] for row in rows} == {"ok"}
        started[warm, solver] = [row.get("started_from") for row in rows]
    assert started[False, "osqp"] == started[True, "piqp"] == [None] * 4
    assert started[True, "osqp"] == path_before(problem.validation_set(4, 1), problem.parameters)
    assert started[True, "osqp"].count(None) == 1


@pytest.mark.parametrize(("solver", "dual"), [*product(["daqp", "piqp", "proxqp", "osqp"], [False, True])])
def test_a_start_changes_the_way_and_not_the_answer(solver: str, dual: bool) -> None:
    rng = np.random.default_rng(2)
    A = np.diag(1.0 + rng.random(5))
    program = VariationalInequality(A, rng.standard_normal(5), rng.standard_normal((3, 5)), -0.1 * rng.random(3))
    factor = np.linalg.cholesky(A) if dual else None
    cold = solve_qp(program, solver, 1e-8, factor=factor)
    warm = solve_qp(program, solver, 1e-8, factor=factor, start=cold)
    assert verification.kkt_residuals(program, warm.x, warm.alpha).worst <= 1e-8
    assert np.allclose(warm.x, cold.x, atol=1e-6)
    assert takes_start(solver) == (solver != "piqp")
    if solver == "osqp" and not dual:
        assert warm.iterations <= cold.iterations


def test_a_query_whose_assessment_fails_costs_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage, store = cell(PROBLEM, "piqp", 1e-6), SampleStore(tmp_path)
    carry_out(stage, store)
    whole, bad = value_of(store, stage), float(PROBLEM.create().validation_set(4, 1)[2, 0])

    def unlucky(model: object, mus: np.ndarray, *others: object) -> list[dict[str, object]]:
        if bad in mus[:, 0]:
            raise ArithmeticError("nothing to compare with")
        return error_columns(model, mus, *others)

    monkeypatch.setattr(cell_queries, "error_columns", unlucky)
    found = stage.run(store).value
    assert [row["status"] for row in found.queries] == ["ok", "ok", "error", "ok"]
    assert "in the assessment: ArithmeticError: nothing to compare with" in found.queries[2]["reason"]
    assert found.cell["queries_ok"] == 3
    for k in (0, 1, 3):
        assert found.queries[k]["error_u"] == pytest.approx(whole.queries[k]["error_u"], rel=1e-9)


@pytest.mark.parametrize("certified", [pytest.param(False, marks=pytest.mark.long), True])
def test_a_large_cell_is_assessed_in_parts(certified: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Factors of as many parameters as fit are held at a time; rows are those of all at once."""
    problem = Plugin("problem", "hertz", '{"resolution": "coarse"}', "test")
    store, stage = SampleStore(tmp_path), cell(problem, "piqp", 1e-8, "mcpg", bounds=certified)
    carry_out(stage, store)
    whole, sizes = value_of(store, stage), []
    monkeypatch.setattr(Assemblies, "together", lambda *_: 3)
    monkeypatch.setattr(cell_queries, "error_columns", lambda *a: (sizes.append(len(a[1])), error_columns(*a))[1])
    found = stage.run(store).value
    assert sizes == [3, 1]
    online = ("bound_online_u_energy",) if certified else ()
    for row, expected in zip(found.queries, whole.queries, strict=True):
        for name in ("error_u", "bound_u_energy", "hf_dual_residual", *online):
            assert row[name] == pytest.approx(expected[name], rel=1e-9)
    if (certificate := stage.certificate) is not None:  # the data of mesh size are there once for all models
        assert certificate.certificate(store).base is value_of(store, certificate.base)
        assert "base" not in value_of(store, certificate)
