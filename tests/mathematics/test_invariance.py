"""Results do not depend on how a problem is written down: units, scales of rows and unknowns, their order, far rows."""

import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from packs import write_cable
from running import Register
from samples import SampleStore, carry_out, program_queries
from transformed import Transformed

from vibench import Stop
from vibench.plugins.plugin import Plugin
from vibench.stages.base import value_of
from vibench.stages.cell_queries import CellRows
from vibench.stages.enrichment import SingleEnrichment
from vibench.stages.offline import ConeStage, PODStage
from vibench.study.parameter_sets import ParameterSet

BASES: Mapping[str, dict[str, Any]] = {
    "obstacle": {"resolution": 100}, "radial-obstacle": {"resolution": 100}, "hertz": {"resolution": 200}, "pack": {},
}  # fmt: skip
SOLVERS = ("piqp", "proxqp", "cvxopt", "osqp")
QUERIES = 2
WHOLE = ("status", "N", "R", "enrichment", "queries_ok", "fallbacks")
"""What is the same."""

NUMBERS = (
    "beta_span", "beta_cone_lower", "beta_cone_upper", "beta_full_span", "error_u", "error_lambda", "error_u_energy",
    "error_lambda_natural",
)  # fmt: skip
"""What agrees to 1e-6."""

ONLINE = ("effectivity_online_u_energy", "effectivity_online_lambda_natural")
"""Bounds at online cost are there, and bounds, whatever the units; how sharp they are may depend on them."""

Rows = Callable[..., CellRows]


@pytest.fixture
def rows(register: Register, tmp_path: Path) -> Rows:
    """Function that gives the rows of a certified cell of a transformed problem."""
    register(
        ("vibench.problems", "transformed", "transformed:Transformed"),
        ("vibench.dual_strategies", "mcpg", "vibench_strategies.mcpg:ModifiedCPG"),
        ("vibench.primal_strategies", "offline-pga", "vibench_strategies.offline_pga:OfflinePGA"),
    )
    pack = write_cable(tmp_path / "pack")

    @cache
    def store_of(base: str, transformation: str) -> SampleStore:
        return SampleStore(tmp_path / f"store{len(list(tmp_path.iterdir()))}")

    @cache
    def of(base: str, solver: str, transformation: str) -> CellRows:
        options = {"path": str(pack)} if base == "pack" else BASES[base]
        given = json.dumps({"base": base, "options": options, **json.loads(transformation)})
        problem, mcpg = Plugin("problem", "transformed", given, "1"), Plugin("dual strategy", "mcpg", "{}", "1")
        pga = Plugin("primal strategy", "offline-pga", "{}", "1")
        cone = ConeStage(problem, mcpg, Stop(tolerance=1e-2))
        enrichment = SingleEnrichment(PODStage(problem, Stop(tolerance=1e-2)), cone, pga, 0.5)
        # OSQP, a first-order method, is given an accuracy that it reaches; its errors depend on scaling up to that
        accuracy = 1e-6 if solver == "osqp" else 1e-10
        stage = program_queries(enrichment, 1e-3, ParameterSet("validation", QUERIES, 3), solver, accuracy, bounds=True)
        store = store_of(base, transformation)
        carry_out(stage, store)
        return value_of(store, stage)

    return lambda base, solver, **transformation: of(base, solver, json.dumps(transformation))


transformations = st.fixed_dictionaries({
    "length": st.integers(-9, 9), "force": st.integers(-9, 9), "rows": st.sampled_from([0.0, 8.0]),
    "unknowns": st.sampled_from([0.0, 3.0]), "far": st.sampled_from([0.0, 1e20]), "seed": st.integers(0, 100),
})  # fmt: skip


# The active set method leaves radial problems whose unknowns differ by 1e3 in length to another one, and says so.
@pytest.mark.parametrize(
    ("base", "solver", "unknowns"),
    [
        ("radial-obstacle", "proxqp", 0.0),
        ("pack", "osqp", 3.0),
        pytest.param("hertz", "cvxopt", 3.0, marks=pytest.mark.long),
    ],
)
def test_the_same_problem_has_the_same_rows(base: str, solver: str, unknowns: float, rows: Rows) -> None:
    """Written down in one other way; `-m long` draws more."""
    how = {"length": 7, "force": -5, "rows": 8.0, "unknowns": unknowns, "far": 1e20, "seed": 1}
    assert_the_same(base, rows, how, solver)


@pytest.mark.long
@pytest.mark.parametrize("base", BASES)
@settings(
    max_examples=20, phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(how=transformations, solver=st.sampled_from(SOLVERS))
def test_it_has_them_however_it_is_written_down(base: str, rows: Rows, how: dict[str, Any], solver: str) -> None:
    assert_the_same(base, rows, how | {"unknowns": 0.0} if base == "radial-obstacle" else how, solver)


def assert_the_same(base: str, rows: Rows, how: dict[str, Any], solver: str) -> None:
    before, after = rows(base, solver), rows(base, solver, **how)
    assert [after.cell[name] for name in WHOLE] == [before.cell[name] for name in WHOLE]
    assert before.cell["status"] == "ok"
    compared = dict.fromkeys(NUMBERS, (1e-4, 1e-2) if solver == "osqp" else (1e-8, 1e-6))
    if solver != "osqp":  # a quotient of small numbers
        compared["effectivity_u_energy"] = (0.0, 1e-4)
    for one, other in zip(before.queries, after.queries, strict=True):
        assert other["status"] == one["status"]
        for name, (absolute, relative) in compared.items():
            if one.get(name) is None:
                assert other.get(name) is None, name
            else:
                assert other.get(name) == pytest.approx(one[name], rel=relative, abs=absolute), name
        for name in ONLINE:
            assert (one.get(name) is None) == (other.get(name) is None), name
            assert other.get(name) is None or other[name] >= 1.0 - 1e-6, name


def test_the_problem_is_another_one_to_a_solver() -> None:
    """Or the test above compares a problem with itself."""
    how = {"length": 3, "force": 2, "rows": 8.0, "unknowns": 3.0, "far": 1e20}
    one, other = Transformed("obstacle", BASES["obstacle"]), Transformed("obstacle", BASES["obstacle"], **how)
    mu = one.parameters.lower
    assert other.assemble(mu).g.max() == 1e20
    assert abs(other.assemble(mu).B).max() > 1e6 * abs(one.assemble(mu).B).max()
    assert abs(other.assemble(mu).A).max() > 1e6 * abs(one.assemble(mu).A).max()
