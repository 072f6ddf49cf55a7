from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from running import Register
from samples import SampleStore, mixed_cell, store_of

from vibench import MEMBERS, Stop, checked_assembly
from vibench.model.affine import Evaluation
from vibench.model.galerkin import ReducedModel, project
from vibench.model.hyperreduced import HyperReducedModel
from vibench.plugins.plugin import Plugin
from vibench.results.ranking import too_loose
from vibench.results.schema import STORED
from vibench.stages.base import value_of
from vibench.stages.cell_queries import CellQueries
from vibench.stages.formulation import AffineDecomposition
from vibench.stages.offline import PODStage
from vibench.study.parameter_sets import ParameterSet

OBSTACLE = Plugin("problem", "obstacle", '{"resolution": 200}', "test")
RADIAL = Plugin("problem", "radial-obstacle", '{"resolution": 300}', "test")
HERTZ = Plugin("problem", "hertz", '{"resolution": 300}', "test")
WIRE = Plugin("problem", "wire", "{}", "test")
UNEVEN = Plugin("problem", "uneven", "{}", "test")
TOLERANCE = 1e-6
QUERIES = 3


def cell(problem: Plugin, primal: str, interpolation: float | None, tolerance: float | None = None) -> CellQueries:
    kinds, validation = (Stop(size=6), "mcpg", Stop(size=3), primal), ParameterSet("validation", QUERIES, 3)
    return mixed_cell(problem, *kinds, validation, tolerance=tolerance, interpolation=interpolation)


CELLS = {
    "obstacle": cell(OBSTACLE, "decorrelated", TOLERANCE),
    "obstacle, fixed": cell(OBSTACLE, "offline-pga", TOLERANCE, 0.5),
    "obstacle, full": cell(OBSTACLE, "decorrelated", None), "obstacle, loose": cell(OBSTACLE, "decorrelated", 1e-2),
    "radial": cell(RADIAL, "online-supremizers", TOLERANCE), "hertz": cell(HERTZ, "decorrelated", TOLERANCE),
    "hertz, per-parameter": cell(HERTZ, "online-supremizers", TOLERANCE),
    "hertz, full": cell(HERTZ, "decorrelated", None),
}  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    return store_of(tmp_path_factory.mktemp("assembly"), CELLS.values())


@pytest.fixture
def wire_store(register: Register, tmp_path: Path) -> SampleStore:
    """A store with cells in reduced and full assembly of two problems: neither declares anything, one is uneven."""
    register(
        ("vibench.problems", "wire", "fake_plugins:Wire"), ("vibench.problems", "uneven", "fake_plugins:UnevenWire"),
        ("vibench.dual_strategies", "mcpg", "vibench_strategies.mcpg:ModifiedCPG"),
        ("vibench.primal_strategies", "decorrelated", "vibench_strategies.decorrelated:Decorrelated"),
    )  # fmt: skip
    return store_of(tmp_path, (wire(*kind) for kind in product((TOLERANCE, None), (WIRE, UNEVEN))))


def wire(interpolation: float | None, problem: Plugin = WIRE) -> CellQueries:
    found = cell(problem, "decorrelated", interpolation)
    pod, cone = PODStage(problem, Stop(tolerance=1e-2)), replace(found.built.enrichment.cone, stop=Stop(tolerance=1e-2))
    enrichment = replace(found.built.enrichment, pod=pod, cone=cone)
    return replace(found, built=replace(found.built, enrichment=enrichment, pod=enrichment.pod, cone=enrichment.cone))


def test_what_interpolation_misses_or_nothing_declares_is_measured_and_told(wire_store: SampleStore) -> None:
    one, other = (value_of(wire_store, wire(interpolation, UNEVEN)) for interpolation in (TOLERANCE, None))
    assert one.cell["interpolation_error"] < 1e-12  # the training set sees nothing of it
    assert one.cell["assembly_error_max"] > 0.01
    assert one.cell["fallbacks"].startswith("reduced assembly differs from the Galerkin projection by up to")
    assert other.cell["fallbacks"] == ""
    for row, right in zip(one.queries, other.queries, strict=True):
        # exact programs, so that a triangle inequality holds between the errors and the contribution
        assert abs(row["error_u"] - right["error_u"]) <= row["assembly_error_u"] * (1.0 + 1e-6)
        assert row["assembly_share"] >= row["assembly_error_u"] / row["error_u"]
    assert one.cell["assembly_share_mean"] > 0.1
    cells = pd.DataFrame([dict.fromkeys(STORED["cells"]) | rows.cell for rows in (one, other)])
    assert too_loose(cells, "assembly").tolist() == [True, False]
    why = "f depends on mu and the problem does not evaluate it entry by entry"
    stage = wire(TOLERANCE)
    members = value_of(wire_store, AffineDecomposition(WIRE, TOLERANCE))
    assert [members[name].way for name in MEMBERS] == [
        Evaluation.CONSTANT, Evaluation.FULL, Evaluation.CONSTANT, Evaluation.CONSTANT,
    ]  # fmt: skip
    rows, full = value_of(wire_store, stage), value_of(wire_store, wire(None))
    assert rows.cell["status"] == "ok"
    assert rows.cell["fallbacks"] == f"assembled in full: {why}"
    assert full.cell["fallbacks"] == ""
    assert isinstance(stage.built.model(wire_store).reduced, ReducedModel)
    assert {name for name in rows.cell if name.startswith("terms_")} == {"terms_A", "terms_B", "terms_g"}
    for one, other in zip(rows.queries, full.queries, strict=True):
        assert (one["assembly_error"], one["form"], one["error_u"]) == (0.0, "primal", other["error_u"])


def test_separations_serve_all_models_and_tolerances_and_varying_members_show_in_columns(store: SampleStore) -> None:
    """With contact, B and g have no terms: they are assembled on the contact. Of the radial problem g alone varies."""
    tight, loose = (value_of(store, CELLS[name]).cell for name in ("obstacle", "obstacle, loose"))
    assert loose["terms_A"] < tight["terms_A"]
    assert TOLERANCE < loose["interpolation_error"] <= 1e-2
    assert loose["assembly_error_max"] > 10.0 * tight["assembly_error_max"]
    for name in ("obstacle", "hertz"):
        reduced, full = value_of(store, CELLS[name]), value_of(store, CELLS[f"{name}, full"])
        for a, b in zip(reduced.queries, full.queries, strict=True):
            for column in ("error_u", "error_lambda", "beta_span"):
                assert a[column] == pytest.approx(b[column], rel=0.01), (name, column)
    for name in ("hertz", "hertz, per-parameter"):
        found = CELLS[name].assembly.columns(store)
        expected = {"interpolation_tol": TOLERANCE, "interpolation_error": 0.0, "terms_A": 0, "terms_f": 0}
        assert found == expected
        assert all(row["assembly_error"] < 1e-11 for row in value_of(store, CELLS[name]).queries)
    columns = CELLS["radial"].assembly.columns(store)
    assert {name: columns[f"terms_{name}"] for name in MEMBERS} == {"A": 0, "f": 0, "B": 0, "g": 2}
    primal = {"obstacle", "obstacle, full", "hertz, full", "hertz, per-parameter"}
    for name in (*primal, "radial", "hertz"):
        rows = value_of(store, CELLS[name])
        assert rows.cell["status"] == "ok"
        assert {row["form"] for row in rows.queries} == {"primal" if name in primal else "dual"}, name
    one, other = (CELLS[name].built.reduction for name in ("obstacle", "obstacle, fixed"))
    assert one.key != other.key
    assert one.decomposition.key == other.decomposition.key
    assert one.decomposition.key != CELLS["obstacle, loose"].built.reduction.decomposition.key
    assert one.decomposition.key != CELLS["hertz"].built.reduction.decomposition.key
    assert one.decomposition.inputs() == ()
    assert one.decomposition in CELLS["obstacle"].inputs()
    assert CELLS["obstacle"].assembly.key != CELLS["obstacle, full"].assembly.key
    for name in ("obstacle", "hertz", "radial"):
        reduction = CELLS[name].built.reduction
        spent = [store.get(stage.key).seconds.cpu for stage in (reduction.decomposition, reduction)]
        assert min(spent) > 0.0
        row = value_of(store, CELLS[name]).cell
        assert row["offline_assembly_s"] == pytest.approx(sum(spent))
        parts = ("snapshots", "pod", "cone", "enrichment", "assembly")
        assert row["offline_s"] == pytest.approx(sum(row[f"offline_{part}_s"] for part in parts))


@pytest.mark.parametrize("name", ["obstacle", "radial", "hertz", "hertz, per-parameter"])
def test_the_error_of_an_assembly_is_that_of_the_worst_member(store: SampleStore, name: str) -> None:
    stage, model = CELLS[name].assembly, CELLS[name].built.model(store).reduced
    assert not isinstance(CELLS[name].built.model(store).offline.operators, str)
    assert isinstance(model, HyperReducedModel)
    mus = model.problem.validation_set(QUERIES, 3)
    for mu, error in zip(mus, value_of(store, stage).errors, strict=True):
        found = model.assemble(mu)
        exact = project(checked_assembly(model.problem, mu), found.basis, model.generators)
        pairs = [(getattr(found.program, member), getattr(exact, member)) for member in MEMBERS]
        worst = max(np.linalg.norm(a - b) / (np.linalg.norm(b) or 1.0) for a, b in pairs)
        assert np.isclose(error, worst, rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize("name", ["obstacle, full", "hertz, full"])
def test_assembly_in_full_has_no_offline_part_and_no_error(store: SampleStore, name: str) -> None:
    stage, rows = CELLS[name].assembly, value_of(store, CELLS[name])
    assert (stage.columns(store), stage.built.reduction) == ({}, None)
    assert isinstance(stage.built.model(store).reduced, ReducedModel)
    assert (rows.cell["offline_assembly_s"], rows.cell["assembly_share_mean"]) == (0.0, None)
    assert "interpolation_tol" not in rows.cell
    assert [row["assembly_error"] for row in rows.queries] == [0.0] * QUERIES
