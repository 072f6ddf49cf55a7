import datetime
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from running import refusal
from samples import REMOVE, STUDY, changed, toml, write_study

from vibench import RequestError, Study
from vibench.study.matrix import expand, find_study, read_study

JARGON = ("list[", "dict[", "literal[", "constrained", "instance of")
"""Words of the validation library that mean nothing to the author of a study file."""


def test_correct_studies_are_read_as_written_by_path_or_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = read_study(write_study(tmp_path))
    assert (study.name, study.seed, study.validation, study.accuracy) == ("sample", 7, 3, [1e-7])
    assert study.solver_names() == ["piqp", "osqp"]
    assert [entry.name for entry in study.dual] == ["cpg", "mcpg"]
    assert study.problem[0].options == {"resolution": "coarse"}
    assert study.tolerances[0].primal == {"offline-pga": [0.5, 0.3, 0.1]}
    assert study.limits.query_seconds == 20.0
    study = read_study(write_study(tmp_path, changed(STUDY, "solvers", to="available")))
    assert {"piqp", "proxqp", "osqp"} <= set(study.solver_names())
    path = write_study(tmp_path)
    assert (find_study(path), find_study("quick").name) == (Path(path), "quick.toml")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "quick").mkdir()  # what `vibench run --out quick` leaves
    assert read_study("quick").name == "quick"


def test_the_writer_of_the_tests_writes_toml() -> None:
    assert tomllib.loads(toml(STUDY)) == STUDY


TABLE = ("tolerances", 0)

WRONG: Mapping[str, tuple[tuple[str | int, ...], Any, tuple[str, ...]]] = {
    # what is wrong: (where, the wrong value, words that say the key and what is expected)
    "name empty": (("name",), "", ("name", "1 character")),
    "name of no text": (("name",), 3, ("name", "string", "3")),
    "name that leaves the folder": (("name",), "../elsewhere", ("name", "letters")),
    "name that hides": (("name",), ".hidden", ("name", "letters")),
    "seed negative": (("seed",), -1, ("seed", "greater than or equal to 0", "-1")),
    "seed a truth value": (("seed",), True, ("seed", "integer")),
    "seed text": (("seed",), "7", ("seed", "integer", "'7'")),
    "seed beyond what a table holds": (("seed",), 2**63, ("seed", "less")),
    "validation zero": (("validation",), 0, ("validation", "greater than or equal to 1")),
    "accuracy nan": (("accuracy",), float("nan"), ("accuracy", "finite")),
    "accuracy zero": (("accuracy",), 0.0, ("accuracy", "greater than")),
    "accuracy too loose": (("accuracy",), 0.5, ("accuracy", "less than")),
    "accuracies none": (("accuracy",), [], ("accuracy", "at least 1")),
    "accuracies with one too loose": (("accuracy",), [1e-7, 0.5], ("accuracy.1", "less than", "0.5")),
    "solvers empty": (("solvers",), [], ("solvers", "at least 1")),
    "solvers one word": (("solvers",), "piqp", ("solvers", "'available'", "list", "'piqp'")),
    "solvers of numbers": (("solvers",), [3], ("solvers", "string")),
    "correction unknown": (("correction",), ["all"], ("correction", "'none', 'feasible' or 'auto'", "'all'")),
    "correction empty": (("correction",), [], ("correction", "at least 1")),
    "solver unknown": (("solvers",), ["pipq"], ("QP solver", "'pipq'", "did you mean 'piqp'")),
    "primal missing": (("primal",), REMOVE, ("primal", "required")),
    "dual empty": (("dual",), [], ("dual", "at least 1")),
    "dual unknown": (("dual",), ["mcgp"], ("dual strategy", "'mcgp'", "did you mean 'mcpg'")),
    "dual without name": (("dual",), [{"label": "x"}], ("dual.0.name", "required")),
    "dual label a number": (("dual",), [{"name": "cpg", "label": 3}], ("dual.0.label", "string")),
    "dual options no table": (("dual",), [{"name": "cpg", "options": 3}], ("dual.0.options", "found 3")),
    "dual with options it has not": (("dual",), [{"name": "cpg", "options": {"x": 1}}], ("dual strategy 'cpg'", "'x'")),
    "dual with a mistyped key": (("dual",), [{"name": "cpg", "lable": "x"}], ("'lable'", "did you mean 'label'")),
    "primal unknown": (("primal",), ["decorelated"], ("primal strategy", "did you mean 'decorrelated'")),
    "assembly unknown": (("assembly",), ["fast"], ("assembly.0", "'full'", "'fast'")),
    "assembly empty": (("assembly",), [], ("assembly", "at least 1")),
    "problem missing": (("problem",), REMOVE, ("problem", "required")),
    "problem empty": (("problem",), [], ("problem", "at least 1")),
    "problem unknown": (("problem",), ["obstcale"], ("problem", "'obstcale'", "did you mean 'obstacle'")),
    "option unknown": (("problem", 0, "options"), {"resolutoin": 1}, ("obstacle", "did you mean 'resolution'")),
    "option of wrong type": (("problem", 0, "options"), {"length": "one"}, ("length", "'one'", "float > 0")),
    "option out of range": (("problem", 0, "options"), {"length": -1.0}, ("length", "-1.0", "float > 0")),
    "option of no choice": (("problem", 0, "options"), {"resolution": "huge"}, ("resolution", "'huge'", "'coarse'")),
    "option too small": (("problem", 0, "options"), {"resolution": 5}, ("resolution", "5", "int ≥ 150")),
    "option a date": (("problem", 0, "options"), {"load": datetime.date(2022, 1, 1)}, ("load", "float")),
    "tolerances missing": (("tolerances",), REMOVE, ("tolerances", "required")),
    "tolerances empty": (("tolerances",), [], ("tolerances", "at least 1")),
    "tolerances no list": (("tolerances",), {"pod": [1e-3]}, ("tolerances", "list")),
    "pod nan": ((*TABLE, "pod"), [float("nan")], ("tolerances.0.pod.0", "finite")),
    "pod zero": ((*TABLE, "pod"), [0.0], ("tolerances.0.pod.0", "greater than 0")),
    "pod one": ((*TABLE, "pod"), [1.0], ("tolerances.0.pod.0", "less than 1")),
    "pod text": ((*TABLE, "pod"), ["small"], ("tolerances.0.pod.0", "number", "'small'")),
    "pod no list": ((*TABLE, "pod"), 1e-3, ("tolerances.0.pod", "list", "0.001")),
    "pod missing": ((*TABLE, "pod"), REMOVE, ("tolerances.0", "'pod'", "'N'")),
    "pod and N": ((*TABLE, "N"), [3], ("tolerances.0", "either 'pod'", "'N'")),
    "dual tolerance nan": ((*TABLE, "dual"), [float("nan")], ("tolerances.0.dual", "finite")),
    "dual tolerance missing": ((*TABLE, "dual"), REMOVE, ("tolerances.0", "'dual'", "'R'")),
    "dual tolerance and R": ((*TABLE, "R"), [3], ("tolerances.0", "either 'dual'", "'R'")),
    "dual tolerance of one": ((*TABLE, "dual"), {"cpg": [0.0]}, ("tolerances.0.dual", "cpg", "greater than 0")),
    "dual tolerance of a stranger": ((*TABLE, "dual"), {"mcgp": [0.1]}, ("dual strategy", "did you mean 'mcpg'")),
    "primal tolerance zero": ((*TABLE, "primal"), {"offline-pga": [0.0]}, ("primal.offline-pga.0", "greater than 0")),
    "primal tolerance of a stranger": ((*TABLE, "primal"), {"offline-gpa": [0.5]}, ("did you mean 'offline-pga'",)),
    "primal tolerance for one that takes none": (
        (*TABLE, "primal"),
        {"decorrelated": [0.5], "offline-pga": [0.5]},
        ("tolerances.primal", "'decorrelated'", "takes no tolerance"),
    ),
    "primal tolerance for nobody": ((*TABLE, "primal"), [0.5], ("tolerances.0.primal",)),
    "limits no table": (("limits",), 3, ("limits", "found 3")),
    "limit zero": (("limits",), {"query_seconds": 0.0}, ("limits.query_seconds", "greater than 0")),
    "limit text": (("limits",), {"memory_gib": "8"}, ("limits.memory_gib", "number", "'8'")),
    "limit beyond every machine": (("limits",), {"memory_gib": 1e300}, ("limits.memory_gib", "less than")),
    "limit unknown": (("limits",), {"query_second": 1.0}, ("'query_second'", "did you mean 'query_seconds'")),
    "key unknown": (("sed",), 7, ("'sed'", "did you mean 'seed'")),
    "key unknown, in angle brackets": (("<list>",), 7, ("'<list>'", "known: ")),
    "key unknown in a table, an angle bracket": ((*TABLE, "<"), [], ("'<'", "known: ")),
    "key unknown in a table": ((*TABLE, "pods"), [1e-3], ("'pods'", "did you mean 'pod'")),
}  # fmt: skip


def test_what_is_wrong_is_said_in_one_line_without_the_key_itself(tmp_path: Path) -> None:
    cases = [(changed(STUDY, *where, to=value), words) for where, value, words in WRONG.values()]
    for size, tolerance in (("N", "pod"), ("R", "dual")):
        for value, word in (([0], "greater than"), ([1.5], "integer"), ([], "at least 1")):
            content = changed(changed(STUDY, *TABLE, tolerance, to=REMOVE), *TABLE, size, to=value)
            cases.append((content, (f"tolerances.0.{size}", word)))
    cases.append((changed(STUDY, "see\nd", to=1), ("did you mean 'seed'",)))
    for content, words in cases:
        path = write_study(tmp_path, content)
        line = refusal(read_study, path)
        assert line.startswith(f"{path}: ")
        message = line.removeprefix(path)
        assert [word for word in words if word.lower() not in message.lower()] == [], line
        assert [word for word in JARGON if word in message] == [], line
    places = (((), "pod"), ((), "resolution"), (("limits",), "seed"), (TABLE, "name"))
    for where, key in places:
        line = refusal(read_study, write_study(tmp_path, changed(changed(STUDY, "limits", to={}), *where, key, to=1)))
        assert f"'{key}'" in line
        assert f"did you mean '{key}'" not in line


def test_the_smallest_study_names_its_problem(tmp_path: Path) -> None:
    """What is left out is that of the study `default`; tolerances are left out with the strategies that they name."""
    path = tmp_path / "smallest.toml"
    path.write_text('problem = ["obstacle"]\n')
    study, usual = read_study(str(path)), read_study("default")
    assert study.name == "smallest"
    for key in ("validation", "solvers", "dual", "primal", "tolerances", "assembly"):
        assert getattr(study, key) == getattr(usual, key)
    path.write_text('problem = ["obstacle"]\ndual = ["cpg"]\n')
    assert "tolerances" in refusal(read_study, str(path))


def test_what_a_study_does_not_name_serves_the_dual_sets_of_its_problems(tmp_path: Path) -> None:
    path, coarse = tmp_path / "smallest.toml", '{ name = "tresca", options = { resolution = 4 } }'
    chosen = {
        '"obstacle"': ("mixed", "mcpg"), coarse: ("dual-program", "hull-greedy"),
        f'"obstacle", {coarse}': ("dual-program", "hull-greedy"),
    }  # fmt: skip
    for problems, names in chosen.items():
        path.write_text(f"problem = [{problems}]\n")
        study = read_study(str(path))
        assert tuple(one.name for one in (*study.formulation, *study.dual)) == names
        assert {(cell.formulation.name, cell.dual.name) for cell in expand(study) if cell.dual} == {names}
    # What is named stays, and the rest is chosen.
    problem = [{"name": "tresca", "options": {"resolution": 4}}]
    named = read_study("default", {"problem": problem, "dual": ["pod-dual"]})
    assert [one.name for one in (*named.formulation, *named.dual)] == ["dual-program", "pod-dual"]
    named = read_study("default", {"problem": problem, "formulation": ["mixed"]})
    assert [one.name for one in (*named.formulation, *named.dual)] == ["mixed", "hull-greedy"]


def test_what_is_no_file_of_a_study_or_invalid_toml_is_refused(tmp_path: Path) -> None:
    missing = str(tmp_path / "nowhere.toml")
    assert f"'{missing}' does not exist" in refusal(read_study, missing)
    for name in ("folder", "folder.toml"):
        (tmp_path / name).mkdir()
        assert f"{name}' is not a file" in refusal(read_study, str(tmp_path / name))
    assert "did you mean 'quick'" in refusal(read_study, "qiuck")
    assert "study" in refusal(read_study, "a" * 300)  # too long for the name of a file
    for content in (b"\x00\x01\xff\xfe", b"\x89PNG\r\n\x1a\n", b"name = 'gr\xf6sse'"):
        path = tmp_path / "study.toml"
        path.write_bytes(content)
        assert refusal(read_study, str(path)).startswith(f"{path}: ")
    path = tmp_path / "study.toml"
    for text in INVALID.values():
        path.write_text(text)
        line = refusal(read_study, str(path))
        assert line.startswith(f"{path}: ")
        assert "TOML" in line
    path.write_text('name = "a"\nseed = = 3\n')
    assert "line 2" in refusal(read_study, str(path))


INVALID = {
    "no value": "seed =", "a key twice": "seed = 1\nseed = 2", "a table that becomes a list": "[problem]\n[[problem]]",
    "no key": "= 3", "an open string": "name = 'a", "an endless number": "seed = " + "1" * 5000,
    "endless nesting": "a = " + "[" * 9999,
}  # fmt: skip


def test_overrides_replace_whole_axes_and_keep_entries_with_their_name_or_label(tmp_path: Path) -> None:
    given = {"dual": ["mcpg"], "primal": ["online-supremizers"], "solvers": ["proxqp"], "problem": ["obstacle"]}
    given["correction"] = ["auto"]
    study = read_study(write_study(tmp_path), given)
    assert [entry.name for entry in study.dual] == ["mcpg"]
    assert [entry.name for entry in study.primal] == ["online-supremizers"]
    assert (study.solver_names(), study.correction) == (["proxqp"], ["auto"])
    study = read_study(write_study(tmp_path), {"problem": ["obstacle"]})
    assert study.problem[0].options == {"resolution": "coarse"}
    entries = [{"name": "obstacle", "label": size, "options": {"resolution": size}} for size in ("coarse", "medium")]
    path = write_study(tmp_path, changed(STUDY, "problem", to=[*entries, "hertz"]))
    assert [entry.title for entry in read_study(path, {"problem": ["obstacle"]}).problem] == ["coarse", "medium"]
    (medium,) = read_study(path, {"problem": ["medium"]}).problem
    assert (medium.title, medium.options) == ("medium", {"resolution": "medium"})
    path = write_study(tmp_path)
    plain, replaced = read_study(path), read_study(path, {"pod": [0.5], "dual": []})
    assert replaced.tolerances[0].pod == [0.5]
    assert replaced.model_dump(exclude={"tolerances"}) == plain.model_dump(exclude={"tolerances"})
    assert replaced.tolerances[0].dual == plain.tolerances[0].dual


def test_overrides_replace_tolerances_in_every_table_and_with_their_strategy(tmp_path: Path) -> None:
    second = {"N": [4], "R": {"cpg": [2], "mcpg": [3]}, "primal": {"offline-pga": [0.9]}}
    path = write_study(tmp_path, changed(STUDY, "tolerances", 1, to=second))
    study = read_study(path, {"pod": [0.5], "dual_tol": [0.25, 0.125], "primal_tol": [0.75]})
    assert len(study.tolerances) == 2
    for table in study.tolerances:
        assert (table.pod, table.N) == ([0.5], None)
        assert (table.dual, table.R) == ([0.25, 0.125], None)
        assert table.primal == {"offline-pga": [0.75]}
    for table in ({}, {"primal": {}}):
        content = changed(STUDY, "tolerances", to=[{"pod": [1e-3], "dual": [1e-1]} | table])
        path = write_study(tmp_path, changed(content, "primal", to=["decorrelated"]))
        cells = expand(read_study(path, {"primal": ["offline-pga"], "primal_tol": [0.5]}))
        assert {cell.primal_tol for cell in cells} == {0.5}
    content = changed(STUDY, *TABLE, "dual", to={"cpg": [0.1]})
    cells = expand(read_study(write_study(tmp_path, content), {"dual": ["mcpg"], "dual_tol": [0.2]}))
    assert {(cell.dual.name, cell.cone.tolerance) for cell in cells} == {("mcpg", 0.2)}


def test_wrong_overrides_are_refused_and_said_to_be_overrides(tmp_path: Path) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"pod": [float("nan")]}, "finite"), ({"dual_tol": [0.0]}, "greater than 0"),
        ({"primal_tol": [-1.0]}, "greater than 0"), ({"solvers": ["oqsp"]}, "did you mean 'osqp'"),
        ({"problem": ["obstcale"]}, "did you mean 'obstacle'"),
        ({"primal": ["decorelated"]}, "did you mean 'decorrelated'"),
    ]  # fmt: skip
    for overrides, words in cases:
        line = refusal(read_study, write_study(tmp_path), overrides)
        assert "options of the command line" in line
        assert words in line


WORDS = ["cpg", "mcpg", "obstacle", "piqp", "decorrelated", "offline-pga", "available", "full", "coarse"]
SCALARS = st.one_of(
    st.just(REMOVE), st.booleans(), st.integers(-(10**20), 10**20), st.floats(), st.text(max_size=8), st.dates(),
    st.sampled_from(WORDS),
)  # fmt: skip
KEYS = st.text(max_size=6) | st.sampled_from(["pod", "N", "dual", "R", "primal", "name", "label", "options", "limits"])
VALUES = st.recursive(
    SCALARS.filter(lambda value: value is not REMOVE),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=6,
)


def places(value: Any, here: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    steps = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    return [path for key, inner in steps for path in [(*here, key), *places(inner, (*here, key))]]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_mutation_of_a_study_raises_anything_but_a_refusal(data: st.DataObject, tmp_path: Path) -> None:
    content: dict[str, Any] = changed(STUDY, "limits", to={"query_seconds": 5.0})
    for _ in range(data.draw(st.integers(1, 2))):
        where = data.draw(st.sampled_from(places(content) or [("name",)]))
        added = data.draw(st.booleans()) and isinstance(where[-1], str)
        path = (*where[:-1], data.draw(KEYS)) if added else where
        content = changed(content, *path, to=data.draw(VALUES if added else SCALARS | VALUES))
    line = ""
    try:
        study = read_study(write_study(tmp_path, content))
        assert isinstance(study, Study)
        assert expand(study)
    except RequestError as error:
        line = str(error)
    assert line.isprintable()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_no_file_raises_anything_but_a_refusal(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_bytes(content)
    assert refusal(read_study, str(path)).startswith(f"{path}: ")
