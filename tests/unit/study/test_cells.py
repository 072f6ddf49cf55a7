import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from running import Changed, Main, Register, refused, succeeded
from samples import REMOVE, STUDY, changed, write_study

from vibench import RequestError, Stop
from vibench.execution.recorded_cell import recorded_study
from vibench.plugins import registry
from vibench.plugins.plugin import Plugin
from vibench.results import formats
from vibench.results.read import read_table
from vibench.results.sqlite import FILE
from vibench.study import cells as module
from vibench.study.cells import Cell, digest
from vibench.study.matrix import expand, read_study, study_of_cell
from vibench.study.parameter_sets import ParameterSet

Expand = Callable[[Mapping[str, Any]], list[Cell]]


@pytest.fixture
def cells_of(tmp_path: Path) -> Expand:
    return lambda content: expand(read_study(write_study(tmp_path, content)))


def test_the_matrix_is_the_product_of_the_axes_in_their_order_without_repeats(cells_of: Expand) -> None:
    cells = cells_of(STUDY)
    plain = [cell for cell in cells if cell.primal.name == "decorrelated"]
    assert len(plain) == 2 * 2 * 2  # pod × dual × solvers
    assert len(cells) - len(plain) == 2 * 2 * 2 * 3  # and × primal tolerances
    assert len({cell.key for cell in cells}) == len(cells)
    studies = ({"offline-pga": values} for values in ([0.5], [0.5, 0.4, 0.3, 0.2]))
    few, many = (cells_of(changed(STUDY, "tolerances", 0, "primal", to=given)) for given in studies)
    for cells in (few, many):
        plain = [cell for cell in cells if cell.primal.name == "decorrelated"]
        assert len(plain) == 8
        assert {cell.primal_tol for cell in plain} == {None}
    assert len(many) - len(few) == 3 * 8
    cells = cells_of(changed(STUDY, "primal", to=["decorrelated"]))
    assert [(cell.pod.tolerance, cell.dual.name, cell.solver) for cell in cells] == [
        (pod, dual, solver) for pod in (1e-2, 1e-3) for dual in ("cpg", "mcpg") for solver in ("piqp", "osqp")
    ]


def test_accuracies_and_corrections_are_axes_and_duplicates_merge(cells_of: Expand) -> None:
    cells = cells_of(changed(STUDY, "accuracy", to=[1e-4, 1e-7, 1e-10]))
    alone = cells_of(changed(STUDY, "accuracy", to=1e-4))
    assert len(cells) == 3 * len(alone)
    assert {cell.accuracy for cell in cells} == {1e-4, 1e-7, 1e-10}
    assert {cell.key for cell in alone} < {cell.key for cell in cells}
    assert len({str(cell) for cell in cells}) == len(cells)
    cells = cells_of(STUDY | {"correction": ["none", "feasible", "auto"]})
    alone = cells_of(STUDY)
    assert len(cells) == 3 * len(alone)
    assert [cell for cell in cells if cell.correction == "none"] == alone
    assert [cell.key for cell in cells if cell.correction == "none"] == [cell.key for cell in alone]
    assert all(("correction" in cell.definition) == (cell.correction != "none") for cell in cells)
    assert all(Cell.from_definition(cell.definition) == cell for cell in cells)
    assert len({str(cell) for cell in cells}) == len(cells)
    keys = [cell.key for cell in cells_of(STUDY)]
    obstacle = [{"name": "obstacle", "options": {"resolution": "coarse"} | options} for options in (
        {}, {"length": 1.0}, {"length": 1.0, "load": -1.0}, {"load": -1, "length": 1.0})]  # fmt: skip
    for axis, entries in (
        ("solvers", ["piqp", "osqp", "piqp"]), ("dual", ["cpg", "mcpg", "cpg", {"name": "cpg", "label": "the same"}]),
        ("problem", obstacle), ("tolerances", [*STUDY["tolerances"], *STUDY["tolerances"]]),
    ):  # fmt: skip
        assert [cell.key for cell in cells_of(changed(STUDY, axis, to=entries))] == keys, axis


def test_tables_add_up_once_and_sizes_take_the_place_of_tolerances_by_strategy_and_label(cells_of: Expand) -> None:
    first = STUDY["tolerances"][0]
    second = {"pod": [1e-3, 1e-4], "dual": [1e-1, 1e-2], "primal": {"offline-pga": [0.5]}}
    both = {cell.key for cell in cells_of(changed(STUDY, "tolerances", to=[first, second]))}
    alone = [{cell.key for cell in cells_of(changed(STUDY, "tolerances", to=[table]))} for table in (first, second)]
    assert both == alone[0] | alone[1]
    assert alone[0] & alone[1]
    table = {"N": [5, 6, 7], "R": [3], "primal": {"offline-pga": [0.5]}}
    cells = cells_of(changed(STUDY, "tolerances", to=[table]))
    assert len(cells) == 3 * 2 * 2 * 2
    assert {cell.pod for cell in cells} == {Stop(size=5), Stop(size=6), Stop(size=7)}
    assert {cell.cone for cell in cells} == {Stop(size=3)}
    for key, values in (("dual", [0.1, 0.2, 0.3]), ("R", [1, 2, 3])):
        table = {"pod": [1e-3], key: {"cpg": values[:1], "mcpg": values[1:]}, "primal": {"offline-pga": [0.5]}}
        found = {(cell.dual.name, cell.cone) for cell in cells_of(changed(STUDY, "tolerances", to=[table]))}
        first, *others = (Stop(**{"tolerance" if key == "dual" else "size": value}) for value in values)
        assert found == {("cpg", first), *(("mcpg", other) for other in others)}
    content = changed(STUDY, "dual", to=[{"name": "cpg", "label": "plain"}, "mcpg"])
    content = changed(content, "tolerances", 0, "dual", to={"plain": [0.1], "mcpg": [0.2]})
    assert {(cell.labels[1], cell.cone.tolerance) for cell in cells_of(content)} == {("plain", 0.1), ("mcpg", 0.2)}


def test_every_strategy_that_takes_a_tolerance_must_be_given_one(cells_of: Expand) -> None:
    for key, values, words in (
        ("primal", REMOVE, r"study.toml: tolerances\.primal.*'offline-pga'.*tolerance"),
        ("primal", {}, r"tolerances\.primal.*'offline-pga'.*tolerance"),
        ("dual", {"cpg": [0.1]}, r"tolerances\.dual.*'mcpg'"),
        ("dual", {}, r"tolerances\.dual.*'m?cpg'"),
    ):
        with pytest.raises(RequestError, match=words):
            cells_of(changed(STUDY, "tolerances", 0, key, to=values))


def test_former_words_are_translated_and_named(cells_of: Expand) -> None:
    for before, now in (
        ({"assembly": ["full", "certified"]}, {"assembly": ["full", "reduced"], "bounds": [True]}),
        ({"assembly": ["reduced", "certified"]}, {"assembly": ["reduced"], "bounds": [False, True]}),
        ({"assembly": ["compiled"]}, {"assembly": ["reduced"], "formulation": ["compiled"]}),
        (
            {"assembly": ["full", "compiled", "certified"]},
            {"assembly": ["full", "reduced"], "bounds": [True], "formulation": ["mixed", "compiled"]},
        ),
    ):
        with pytest.warns(UserWarning, match=r"^assembly = .* is of before; write now: .*") as noted:
            translated = cells_of(STUDY | before)
        assert len(noted) == 1
        assert [cell.key for cell in translated] == [cell.key for cell in cells_of(STUDY | now)]
        assert {cell.bounds for cell in translated if cell.assembly == "full"} <= {False}
        assert {cell.validation.seed for cell in translated} == {STUDY["seed"]}


SAMPLE = Cell(
    problem=Plugin("problem", "p", '{"a": 1}', "package 1"),
    dual=Plugin("dual strategy", "d", "{}", "package 1"),
    primal=Plugin("primal strategy", "q", "{}", "package 1"),
    formulation=Plugin("formulation", "m", "{}", "package 1"),
    pod=Stop(tolerance=1e-3), cone=Stop(size=4), primal_tol=0.5, solver="piqp", assembly="full", interpolation=None,
    warm_start=False, accuracy=1e-7, validation=ParameterSet("validation", 8, 1), labels=("P", "D", "Q"),
)  # fmt: skip

SAMPLING = Plugin("sampling strategy", "s", "{}", "package 1")
FORMULATION = Plugin("formulation", "f", "{}", "package 1")

OTHER: Mapping[str, Mapping[str, Any]] = {
    "problem": {"problem": replace(SAMPLE.problem, name="other")},
    "problem options": {"problem": replace(SAMPLE.problem, options='{"a": 2}')},
    "dual": {"dual": replace(SAMPLE.dual, name="other")},
    "dual options": {"dual": replace(SAMPLE.dual, options='{"a": 2}')},
    "primal": {"primal": replace(SAMPLE.primal, name="other")},
    "primal options": {"primal": replace(SAMPLE.primal, options='{"a": 2}')}, "pod": {"pod": Stop(tolerance=1e-4)},
    "pod size": {"pod": Stop(size=4)}, "cone": {"cone": Stop(size=5)}, "cone tolerance": {"cone": Stop(tolerance=0.1)},
    "primal_tol": {"primal_tol": 0.6}, "no primal_tol": {"primal_tol": None}, "solver": {"solver": "osqp"},
    "assembly": {"assembly": "reduced"}, "bounds": {"bounds": True}, "correction": {"correction": "auto"},
    "interpolation": {"interpolation": 1e-6}, "warm start": {"warm_start": True},
    "seed": {"validation": ParameterSet("validation", 8, 2)},
    "validation": {"validation": ParameterSet("validation", 9, 1)}, "accuracy": {"accuracy": 1e-8},
    "training": {"training": ParameterSet("training", 0, 0, SAMPLING)},
    "training options": {"training": ParameterSet("training", 0, 0, replace(SAMPLING, options='{"a": 1}'))},
    "validation sampling": {"validation": ParameterSet("validation", 8, 1, SAMPLING)},
    "formulation": {"formulation": FORMULATION},
    "formulation options": {"formulation": replace(FORMULATION, options='{"a": 1}')},
}  # fmt: skip


def test_keys_depend_on_all_members_that_determine_numbers_and_not_on_labels_or_code() -> None:
    covered = {name for change in OTHER.values() for name in change}
    assert covered | {"labels", "nested_tolerances", "formulation_label"} == {field.name for field in fields(Cell)}
    assert len({SAMPLE.key, *(replace(SAMPLE, **change).key for change in OTHER.values())}) == 1 + len(OTHER)
    named = {name: replace(getattr(SAMPLE, name), label="x") for name in ("training", "validation")}
    assert replace(SAMPLE, labels=("x", "y", "z"), **named).key == SAMPLE.key
    newer = {axis: replace(getattr(SAMPLE, axis), code="package 2") for axis in ("problem", "dual", "primal")}
    assert replace(SAMPLE, **newer).key == SAMPLE.key
    assert str(SAMPLE) == "P · D · Q 0.5 · 0.001, R=4 · piqp 1e-07"
    assert str(replace(SAMPLE, primal_tol=None)) == "P · D · Q · 0.001, R=4 · piqp 1e-07"


def test_code_changes_with_its_parts(monkeypatch: pytest.MonkeyPatch, register: Register, tmp_path: Path) -> None:
    """Plugins, core and solver."""
    whole = replace(SAMPLE, formulation=FORMULATION)
    for role in ("training", "validation"):
        whole = replace(whole, **{role: replace(getattr(whole, role), sampling=SAMPLING)})
    codes = [whole.code]
    for axis in ("problem", "dual", "primal", "formulation", "training", "validation"):
        part = getattr(whole, axis)
        sampled = isinstance(part, ParameterSet)
        other = replace(part, sampling=replace(SAMPLING, code="2")) if sampled else replace(part, code="2")
        codes.append(replace(whole, **{axis: other}).code)
    for owner, function in ((module, "numerical_code"), (registry, "solver_version")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, function, lambda *_, **__: "another version")
            registry.registered.cache_clear()
            codes.append(whole.code)
    registry.registered.cache_clear()
    assert len(set(codes)) == len(codes)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_solver.py").write_text("def solve(program, accuracy): ...\n")
    register(("vibench.qp_solvers", "mine", "own_solver:solve"))
    mine = replace(SAMPLE, solver="mine")
    before = mine.code, SAMPLE.code
    (tmp_path / "own_solver.py").write_text("def solve(program, accuracy): return None\n")
    register(("vibench.qp_solvers", "mine", "own_solver:solve"))
    assert mine.code != before[0]
    assert SAMPLE.code == before[1]


def test_entries_of_one_title_are_told_apart_by_options(cells_of: Expand) -> None:
    cells = cells_of(changed(STUDY, "problem", to=["obstacle", {"name": "obstacle", "options": {"length": 2.0}}]))
    assert {cell.problem.options for cell in cells} == {"{}", '{"length": 2.0}'}
    assert {cell.labels[0] for cell in cells} == {"obstacle"}
    problem = cells_of(changed(STUDY, "problem", 0, "options", to={"resolution": 200, "load": -2.0}))[0].problem
    made = problem.create()
    assert made.load == -2.0
    assert 150 <= made.nodes <= 250


@given(st.dictionaries(st.text(max_size=5), st.integers() | st.floats(allow_nan=False) | st.text(max_size=5)))
def test_a_digest_does_not_depend_on_the_order_of_keys(content: dict[str, Any]) -> None:
    assert digest(content) == digest(dict(reversed(content.items())))


def test_digests_tell_contents_apart() -> None:
    contents = [None, "", [], {}, 0, 1, "1", [1], {"1": 1}, {"1": "1"}]
    assert len({digest(content) for content in contents}) == len(contents)


@pytest.mark.parametrize("name", ["quick", "benefit", "hertz-quadrature", "paper-hertz"])
def test_a_study_of_one_cell_has_the_same_cell(name: str) -> None:
    """With prescribed sizes, tolerances by strategy, options, labels and reduced assembly."""
    cells = expand(read_study(name))
    for cell in (*cells[:4], *cells[-4:], *cells[:: max(len(cells) // 8, 1)]):
        (again,) = expand(study_of_cell(cell, name))
        assert (again.key, str(again), again.code) == (cell.key, str(cell), cell.code)


def test_a_row_is_made_again_from_its_results_file_or_an_older_definition(quick_run: Path, main: Main) -> None:
    named = str(quick_run.with_suffix(".toml"))
    cell = expand(read_study(named))[0]
    older = json.loads(cell.definition)
    for name in ("training", "validation_sampling", "set_labels", "formulation", "formulation_label", "bounds"):
        del older[name]
    assert Cell.from_definition(json.dumps(older)) == cell
    certified = Cell.from_definition(json.dumps(older | {"assembly": "certified"}))
    assert (certified.assembly, certified.bounds) == ("reduced", True)
    row = read_table(quick_run / FILE, "cells").iloc[3]
    study = recorded_study(str(quick_run / FILE), row["cell"][:6])
    assert [cell.key for cell in expand(study)] == [row["cell"]]
    assert (study.name, study.timing_rounds) == ("quick", row["timing_rounds"])
    for source, key in ((str(quick_run / FILE), row["cell"][:6]), (named, row["cell"])):
        out = succeeded(main("run", source, "--cell", key, "--dry-run"))
        assert out == f"{row['cell']}  {formats.name_of_cell(row)}\n1 cells\n"


def test_a_cell_is_found_by_its_beginning_or_refused(quick_run: Path, changed: Changed, main: Main) -> None:
    results = str(quick_run / FILE)
    refused(main("run", results, "--cell", "xyz"), "0 cells", "begin with 'xyz'", "expected one")
    refused(main("run", "quick", "--cell", "xyz"), "0 cells of 'quick' begin", "`vibench run quick --dry-run` lists")
    ((digit, count),) = Counter(cell.key[0] for cell in expand(read_study("quick"))).most_common(1)
    refused(main("run", "quick", "--cell", digit, "--dry-run"), f"{count} cells of 'quick' begin with '{digit}'")
    refused(main("run", results, "--cell", "a", "--solver", "piqp"), "leave out solvers")
    for definition in ("", "[]", "{}", '{"problem": 3}'):
        broken = changed(f"UPDATE cells SET definition = '{definition}'")
        key = read_table(broken, "cells")["cell"].iloc[0]
        refused(main("run", str(broken), "--cell", key), key, "cannot be read")
