"""Conformance checks: correct plugins pass; every fault is found by the check made for it, and by no other."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import broken_problems
import broken_strategies
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import Varying
from packs import manifest, write_cable, write_manifest
from running import Main, failures, refused

from vibench import testing
from vibench.plugins.kinds import CHECKED
from vibench.plugins.registry import create, find
from vibench.testing import solvers
from vibench.testing.case import difference, find_jump
from vibench.testing.checks import Check, Doubt, Note, Verdict

Case = tuple[str, list[str]]
"""The one check that fails, and parts of its message."""

THE_TWELVE: Mapping[str, Case] = {
    "broken_problems:Asymmetric": (
        "symmetry of A", ["A is not symmetric at mu = [4.0]", "entry (2, 3) is -12.996 against -13 in the transpose"],
    ),
    "broken_problems:Indefinite": (
        "definiteness of A", ["A is not positive definite at mu = [8.0]", "its smallest eigenvalue is -"],
    ),
    "broken_problems:NotFinite": ("assembly", ["f is not finite: entry 7 is nan", "at mu = [8.0]"]),
    "broken_problems:WrongShape": ("assembly", ["B has shape (12, 11)", "expected (12, 12)"]),
    "broken_problems:IndefiniteNorm": (
        "construction", ["X_V: ", "is not positive definite", "broken_problems.py, line", "self.V = InnerProduct("],
    ),
    "broken_problems:Jumps": ("continuity in mu", ["g jumps at mu = [5.432", "entry ", "0.0153846 against 0.0155385"]),
    "broken_problems:Random": ("determinism", ["at mu = [", "a second call gives different values of f: entry "]),
    "broken_problems:ChangesTheParameter": (
        "no mutation", ["assemble changes its argument mu: entry (0, 0) is 0 against 4 before", "work on copies"],
    ),
    "broken_strategies:NegativeGenerators": (
        "cone", ["negative coefficient", "not declared free", "look at coefficient 3 of generator"],
    ),
    "broken_strategies:Misses": (
        "tolerance", ["tolerance 0.1 is missed: with 7 generators", "of snapshot 15 is 0.194", "claimed error is 0."],
    ),
    "broken_problems:FalselyConstant": (
        "independence of mu", ["f is declared `constant` but depends on mu", "entry 0", "at mu = [8.0]"],
    ),
    "broken_problems:PartlyWrong": (
        "assembly on the contact", ["g of `contact` differs from that of `assemble` at mu = [4.0]: entry 0 is"],
    ),
}  # fmt: skip

MORE_PROBLEMS: Mapping[str, Case] = {
    "InfiniteMatrix": ("assembly", ["B is not finite: entry (5, 5) is inf"]),
    "Integers": ("assembly", ["g has dtype int64", "expected float64"]),
    "Column": ("assembly", ["f has shape (12, 1); expected (12,)"]),
    "Dense": ("assembly", ["A is a ndarray", "scipy.sparse.csr_array(A)"]),
    "RowList": ("assembly", ["B has the sparse format lil; expected CSR or CSC"]),
    "NoInequality": ("assembly", ["assemble returns a tuple", "expected a vibench.VariationalInequality"]),
    "Raises": ("assembly", ["assemble fails at mu = [8.0]: ArithmeticError: the wire snapped", "line ", "raise"]),
    "IndefiniteDualNorm": ("construction", ["X_W is not positive definite", "self.W = "]),
    "NormChangedLater": ("spaces", ["X_V is not positive definite", "changed after"]),
    "NoSpace": ("spaces", ["V is a csr_array", "InnerProduct"]),
    "NoConstraint": ("spaces", ["W has dimension 0", "no constraint"]),
    "NoMeasure": ("spaces", ["multiplier_integrals has the value 0"]),
    "JumpsAtTheCentre": ("continuity in mu", ["A jumps at mu = [6"]),
    "Remembers": ("determinism", ["a second call gives different values of f"]),
    "CountsInstances": ("determinism", ["another instance gives different values of g"]),
    "OneBuffer": ("no mutation", ["assemble changes f of an earlier result: entry 0", "return new arrays"]),
    "ConstantOfNothing": ("independence of mu", ["`constant` names 'a'; expected A, f, B, g"]),
    "ConstantText": ("independence of mu", ["`constant` is the string 'A'", "frozenset({'A'})"]),
    "NoContact": ("assembly on the contact", ["contact returns a NoneType at mu = [4.0]"]),
    "LoadsWrong": ("assembly on the contact", ["Bᵀη of `contact_loads` differs from that of `assemble`"]),
    "LoadsReachFarther": ("assembly on the contact", ["more than `reach` of `contact_loads`"]),
    "ContactOfNothing": ("assembly on the contact", ["`contact` is defined but `contact_dofs` is not"]),
    "ContactChangesTheParameter": ("assembly on the contact", ["contact changes its argument mu: entry 0 is 5"]),
    "Overlooked": ("assembly on the contact", ["B touches 1 unknowns outside `contact_dofs`", "the first is 0"]),
    "Falling": ("assembly on the contact", ["`contact_dofs` is not strictly increasing"]),
    "SamplesWrong": ("assembly by entries", ["f of `sampler` differs", "at mu = [4.0]: entry 4 is 1 against -0.307"]),
    "SamplesNothing": ("assembly by entries", ["NotImplementedError", "has no sampler"]),
    "OneSample": ("training set", ["training_set has mu = [5.0] alone", "at least two"]),
    "Outside": ("training set", ["leaves the box: parameter 0, at mu = [3.0]", "'force' outside [4, 8]"]),
    "Flat": ("training set", ["training_set has shape (6,), expected (P, 1)"]),
    "OtherValidation": ("validation set", ["not the same for the same seed", "default_rng(seed)"]),
    "BackwardsBox": ("parameters", ["lower bound 8 of the parameter 'force' is above its upper bound 4"]),
    "NamedByText": ("parameters", ["the parameters' names are 'force'; expected a tuple"]),
    "Unpicklable": ("pickling", ["cannot be pickled", "attribute load"]),
    "WrongSign": ("high-fidelity solution", ["no constraint is active at any of 9", "B u ≤ g"]),
    "OutOfReach": ("high-fidelity solution", ["no solution at mu = [8.0]", "more than the wire bears"]),
    "PaintsNothing": ("picture and diagnostics", ["picture.values has shape (11,); expected (12,)", "points 0 to 12"]),
    "InsideOut": ("picture and diagnostics", ["mesh_fields.cells['tetra']: 1 of 1 cells are inside out or flat"]),
    "OutputsOfOneName": ("outputs", ["two outputs have the same name: force, force"]),
    "OutputOfNothing": ("outputs", ["the output 'peak' fails at mu = [4.0]: ValueError: zero-size array"]),
    "OutputOfAnotherSize": ("outputs", ["the output 'force' has coefficients of λ of shape (13,); expected (12,)"]),
    "Unfinished": ("construction", ["abstract class Unfinished", "assemble"]),
}  # fmt: skip

MORE_STRATEGIES: Mapping[str, Case] = {
    "Boasts": ("errors", ["tolerance 0.3: the claimed error e(1) is 0.4139", "error of the snapshots is 0.8278"]),
    "OneErrorTooFew": ("cone", ["errors has shape (3,); expected e(0) … e(3), or e(3) alone"]),
    "Long": ("cone", ["do not all have unit norm", "generator 0 has norm 2"]),
    "Oversized": ("size", ["size 1 was prescribed; the cone has 2 generators"]),
    "Draws": ("determinism", ["size 3: a second call gives different values of generators: entry ("]),
    "Normalises": ("no mutation", ["reduce changes the snapshots: entry (", "work on copies"]),
    "DividesByZero": ("snapshots without contact", ["with a zero snapshot", "not finite, the first in column 0"]),
    "UnpicklableDual": ("pickling", ["cannot be pickled", "attribute weight"]),
    "NotOrthogonal": ("enrichment", ["not orthonormal in V and orthogonal to V_N: the ", " of vector "]),
    "AsksForATolerance": ("tolerance", ["without a tolerance", "TypeError", "set takes_tolerance = True"]),
    "NeedsNone": ("tolerance", ["takes_tolerance is True, but build(offline, None) returns an enrichment"]),
    "Fewer": ("tighter tolerances", ["tolerance 0.1 gives 0 vectors, fewer than the", "of tolerance 0.5"]),
    "KindOfTwo": ("kind", ["the kind depends on the tolerance: none at tolerance 0.9, fixed at"]),
    "DrawsVectors": ("determinism", ["a second call gives different values of vectors: entry ("]),
    "ChangesTheBasis": ("no mutation", ["build changes offline.basis: entry (", "work on copies"]),
    "NoMultiplier": ("model without contact", ["AssertionError: no multiplier", "broken_strategies.py, line"]),
    "SuppliesFunction": ("pickling", ["the Enrichment cannot be stored", "is not a function in broken_strategies"]),
    "SuppliesAVector": ("enrichment", ["the supply at mu = [-0.1, 0.0] has shape (40,); expected (40, 40)"]),
    "Restarts": ("nested growth", ["the vectors of tolerance 0.5 are not the first ones of tolerance 0.1"]),
}  # fmt: skip


def assert_found(found: Mapping[str, str], case: Case) -> None:
    check, words = case
    assert list(found) == [check]
    assert [word for word in words if word not in found[check]] == [], found[check]


@pytest.mark.parametrize("plugin", THE_TWELVE)
def test_a_fault_is_found_by_its_check_alone(plugin: str) -> None:
    module, _, name = plugin.partition(":")
    cls = getattr({"broken_problems": broken_problems, "broken_strategies": broken_strategies}[module], name)
    assert_found(failures(testing.examine(cls)), THE_TWELVE[plugin])


@pytest.mark.parametrize("plugin", ["broken_problems:Jumps", "broken_strategies:Misses"])
def test_the_command_catches_a_fault_and_names_it(plugin: str, main: Main) -> None:
    code, out, err = main("check", plugin)
    assert (code, err) == (1, "")
    found = dict(
        line.removeprefix("failed   ").split(": ", 1) for line in out.splitlines() if line.startswith("failed")
    )
    assert_found(found, THE_TWELVE[plugin])
    assert out.splitlines()[-1].endswith("skipped")
    assert " 1 failed" in out.splitlines()[-1]


@pytest.mark.parametrize("name", MORE_PROBLEMS)
def test_a_fault_of_a_problem_is_found_by_its_check_alone(name: str) -> None:
    assert_found(failures(testing.examine(getattr(broken_problems, name))), MORE_PROBLEMS[name])


@pytest.mark.parametrize("name", MORE_STRATEGIES)
def test_a_fault_of_a_strategy_is_found_by_its_check_alone(name: str) -> None:
    assert_found(failures(testing.examine(getattr(broken_strategies, name))), MORE_STRATEGIES[name])


BUILT_IN = [
    (word, entry.name)
    for word, kind in CHECKED.items()
    for entry in importlib.metadata.distribution("vibench").entry_points.select(group=kind.entry_points)
]


def unlisted(folder: Path) -> Path:
    """A pack whose validation parameters are drawn in the box."""
    content = manifest()
    del content["parameters"]["validation"]
    write_manifest(write_cable(folder), content)
    return folder


@pytest.mark.parametrize(("word", "name"), BUILT_IN)
def test_a_built_in_plugin_passes_every_check(word: str, name: str, tmp_path: Path) -> None:
    given: dict[str, object] = {}
    if word == "problem":
        given = {"path": str(unlisted(tmp_path / "cable"))} if name == "pack" else {"resolution": "coarse"}
    if word == "sampling":
        given = sampling_options(name, tmp_path)
    options = find(CHECKED[word], name).check_options(given)
    findings = testing.examine(partial(find(CHECKED[word], name).load(), **options))
    assert [str(finding) for finding in findings if finding.verdict is not Verdict.PASSED] == []


def sampling_options(name: str, folder: Path) -> dict[str, object]:
    (folder / "points.csv").write_text("height,position\n0.5,-1\n900,2\n")
    return {
        "grid": {"counts": [3]},
        "list": {"points": [0.5, 2.0]},
        "file": {"path": str(folder / "points.csv")},
        "greedy": {"candidates": 64, "tolerance": 0.2},
        "sweep": {"size": 7},
        "load-steps": {"parameter": "height", "loadings": 3, "steps": 4, "seed": 3},
    }.get(name, {"size": 7, "seed": 3, "log": []})


def test_the_command_takes_a_coarse_mesh_and_says_so(main: Main) -> None:
    code, out, err = main("check", "problem:obstacle")
    assert (code, err) == (0, ""), out
    assert out.startswith("problem 'obstacle', at resolution coarse (--option resolution=… for another)\n")
    assert out.splitlines()[-1].endswith("passed, 0 failed, 0 skipped")


def test_the_command_checks_solvers(main: Main) -> None:
    code, out, err = main("check", "solver:osqp")
    assert (code, err) == (0, ""), out
    assert out.startswith("QP solver 'osqp'\n")
    code, out, err = main("check", "broken_variants:other_sign")
    assert (code, err) == (1, "")
    assert "failed   signs of multipliers: multipliers have the other sign" in out


def test_a_warning_does_not_fail_the_command(main: Main) -> None:
    code, out, err = main("check", "broken_variants:Unannotated")
    assert (code, err) == (0, "")
    assert "warning  options: the option 'depth' has no annotation" in out
    assert "the option 'cells' has the default 6.5; its annotation expects int" in out
    assert out.splitlines()[-1].endswith("passed, 1 warning, 0 failed, 0 skipped")


def test_the_plugins_that_are_broken_elsewhere_are_correct() -> None:
    for problem in (broken_problems.Declared, testing.MovingSupport, Varying):
        testing.check(problem)
    for dual in (broken_strategies.Greedy, broken_strategies.LastErrorAlone):
        testing.check(dual)
    testing.check(broken_strategies.Supremizing)


def test_one_error_lists_all_failures() -> None:
    with pytest.raises(testing.ConformanceError) as caught:
        testing.check(broken_problems.Worse)
    lines = str(caught.value).splitlines()
    assert lines[0] == "Worse fails 2 of 26 checks"
    assert [line.split(":")[0] for line in lines[1:]] == ["training set", "pickling"]


def test_an_instance_is_refused_because_two_are_compared() -> None:
    for instance in (broken_problems.Declared(), broken_strategies.Greedy(), broken_strategies.Supremizing()):
        with pytest.raises(TypeError, match=f"pass the class {type(instance).__name__}"):
            testing.check(instance)


def test_snapshots_and_a_model_of_one_s_own_are_used() -> None:
    snapshots, W = testing.sample_snapshots()
    misses = testing.examine(broken_strategies.Misses, snapshots=snapshots[:, :2], W=W, tolerances=[1e-9], sizes=[1])
    assert failures(misses) == {}  # two generators are all there is
    offline = testing.sample_offline(modes=3, generators=2)
    findings = testing.examine(broken_strategies.Supremizing, offline=offline, tolerances=[0.2, 0.8])
    counts = next(finding.message for finding in findings if finding.check == "enrichment")
    assert counts == "tolerance 0.8: fixed, 2 vectors; tolerance 0.2: fixed, 2 vectors"
    with pytest.raises(TypeError, match="both snapshots and W"):
        testing.check(broken_strategies.Greedy, snapshots=snapshots)


@pytest.mark.parametrize("plugin", [broken_strategies.Greedy, broken_problems.Declared, broken_strategies.Supremizing])
def test_a_call_that_takes_longer_than_the_limit_fails(plugin: type) -> None:
    assert "above the limit of 0 s" in failures(testing.examine(plugin, seconds=0.0))["time"]


@pytest.mark.parametrize(
    ("walls", "remarks"),
    [
        ((0.5,), [(Note, "takes 0.5 s")]),
        ((5.0, 0.25), [(Note, "takes 0.25 s")]),  # the first time the machine was busy
        ((5.0, 4.0), [(Doubt, "6 unknowns takes 4 s"), (Note, "takes 4 s")]),
        ((500.0,), [(str, "takes 500 s, above the limit of 120 s"), (Note, "takes 5e+02 s")]),
    ],
)
def test_a_solver_is_slow_that_takes_long_twice(
    walls: tuple[float, ...], remarks: list[tuple[type, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([reading for wall in walls for reading in (0.0, wall)])
    monkeypatch.setattr(solvers.time, "perf_counter", lambda: next(clock))
    found = list(solvers.SolverCase(lambda *_: None).duration())
    assert [(type(remark), text in remark) for remark, (_, text) in zip(found, remarks, strict=True)] == [
        (kind, True) for kind, _ in remarks
    ]
    assert next(clock, None) is None


def violation(case: object) -> Iterator[str]:
    yield "one"
    raise testing.ConformanceError("two")


def test_a_check_is_skipped_when_one_that_it_needs_did_not_pass() -> None:
    findings = list[testing.CheckResult]()
    for check in (
        Check("first", lambda case: ["wrong"]),
        Check("second", lambda case: [Note("fine")], ("first",)),
        Check("third", lambda case: ["wrong", "too"], ("second",)),
        Check("fourth", lambda case: [Note(case)]),
        Check("fifth", lambda case: 1 / 0, ("fourth",)),
        Check("sixth", violation),
        Check("seventh", lambda case: list("abcdefg")),
    ):
        findings.append(check.result("fine", findings))
    verdicts = ["failed", "skipped", "skipped", "passed", "failed", "failed", "failed"]
    assert [finding.verdict.value for finding in findings] == verdicts
    assert [finding.message for finding in findings[:4]] == ["wrong", "it needs 'first'", "it needs 'second'", "fine"]
    assert findings[4].message.startswith("ZeroDivisionError")
    assert "test_conformance.py, line" in findings[4].message
    assert [finding.message for finding in findings[5:]] == ["one; two", "a; b; c; d; e; and more"]


def bent(t: float, kink: float, slope: float, size: float) -> dict[str, object]:
    """A vector and a sparse matrix that have a kink, and where the vector jumps if `size` is not zero."""
    value = np.sin(3.0 * t) + slope * abs(t - kink) + (size if t > kink else 0.0)
    return {"f": np.array([1.0, value]), "A": sp.csr_array(np.diag([1.0 + t**2, abs(t - kink)]))}


@settings(max_examples=30)
@given(st.floats(0.001, 0.999), st.floats(-2.0, 2.0), st.floats(0.02, 3.0), st.sampled_from([-1.0, 1.0]))
def test_a_jump_is_found_wherever_it_is(kink: float, slope: float, size: float, sign: float) -> None:
    jump = find_jump(lambda t: bent(t, kink, slope, sign * size), {"f": 1.0, "A": 1.0})
    assert jump is not None
    assert jump.name == "f"
    assert jump.left <= kink <= jump.right <= jump.left + 2.0**-30
    assert difference(jump.values[0]["f"], jump.values[-1]["f"]).startswith("entry 1 is ")


@settings(max_examples=20)
@given(st.floats(0.0, 1.0), st.floats(-5.0, 5.0))
def test_a_kink_is_no_jump(kink: float, slope: float) -> None:
    assert find_jump(lambda t: bent(t, kink, slope, 0.0), {"f": 1.0, "A": 1.0}) is None


@settings(max_examples=20)
@given(st.floats(0.1, 0.9))
def test_a_root_is_no_jump(place: float) -> None:
    assert find_jump(lambda t: {"g": np.array([np.sqrt(abs(t - place))])}, {"g": 1.0}) is None


def test_a_jump_that_is_too_small_is_not_looked_for() -> None:
    assert find_jump(lambda t: {"g": np.array([1.0 + 0.9e-3 * (t > 0.3)])}, {"g": 1.0}) is None


class TestRequests:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["obstcale"], ["no plugin is called 'obstcale'", "did you mean 'obstacle'"]),
            (["dual:obstacle"], ["no dual strategy is called 'obstacle'", "known:", "mcpg"]),
            (["no_module:Rope"], ["'no_module:Rope'", "cannot be imported", "no_module"]),
            (["broken_problems:Jmups"], ["no plugin of the module broken_problems", "did you mean 'Jumps'"]),
            (
                ["running:Path"],
                ["'running:Path'", "no subclass of Problem, Sampling, PrimalStrategy, DualStrategy, Form"],
            ),
            (["some thing:Rope"], ["neither KIND:NAME", "solver", "MODULE:NAME"]),
            (["broken_variants:UnknownAnnotation"], ["annotations that fail: NameError", "'Depth'"]),
            (["solver:piqq"], ["no QP solver is called 'piqq'", "did you mean 'piqp'"]),
            (["solver:piqp", "--option", "eps=1"], ["QP solver 'piqp' has no options"]),
            (["obstacle", "--option", "resolution"], ["'resolution'", "KEY=VALUE"]),
            (["obstacle", "--option", "resolution=3"], ["option 'resolution' of problem 'obstacle' is 3", "int ≥ 150"]),
            (["obstacle", "--option", "resoltion=coarse"], ["did you mean 'resolution'"]),
            (["fake_plugins:BadCone"], ["dual strategy 'fake_plugins:BadCone' needs the option 'how'"]),
            ([], ["PLUGIN"]),
        ],
    )
    def test_a_plugin_that_is_not_there_is_refused_in_one_line(
        self, arguments: list[str], words: list[str], main: Main
    ) -> None:
        refused(main("check", *arguments), *words)

    def test_a_name_of_two_plugins_is_refused_until_the_kind_is_given(self, main: Main, register) -> None:
        register(
            ("vibench.problems", "twin", "broken_problems:Declared"),
            ("vibench.dual_strategies", "twin", "broken_strategies:Greedy"),
        )
        refused(main("check", "twin"), "several plugins are called 'twin'", "problem:twin or dual:twin")
        assert main("check", "dual:twin")[1].startswith("dual strategy 'twin'")

    def test_options_reach_the_plugin(self, main: Main) -> None:
        _, out, _ = main("check", "fake_plugins:Wire", "--option", "nodes=20", "--option", "depth=0.1")
        assert "n = 20, m = 20" in out
        code, out, _ = main("check", "fake_plugins:BadCone", "--option", "how=negative")
        assert code == 1
        assert "failed   cone: " in out

    def test_another_resolution_than_coarse_is_taken_where_it_is_asked_for(self, main: Main) -> None:
        code, out, _ = main("check", "obstacle", "--option", "resolution=200")
        assert code == 0
        assert out.splitlines()[0] == "problem 'obstacle'"
        n = create("problem", "obstacle", {"resolution": 200}).V.dim
        assert f"n = {n}, " in out

    def test_a_class_in_the_current_folder_is_found(self, main: Main, tmp_path) -> None:
        source = "from broken_strategies import Greedy\n\nclass Mine(Greedy):\n    '''Mine.'''\n"
        (tmp_path / "here" / "lying_around.py").write_text(source)
        code, out, _ = main("check", "lying_around:Mine")
        assert code == 0
        assert out.startswith("dual strategy 'lying_around:Mine'")


def test_every_broken_plugin_is_tried() -> None:
    tried = {name.split(":")[1] for name in THE_TWELVE} | set(MORE_PROBLEMS) | set(MORE_STRATEGIES)
    sound = {"Declared", "Changed", "Greedy", "LastErrorAlone", "Supremizing", "Worse"}
    for module in (broken_problems, broken_strategies):
        own = {name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__}
        classes = {name for name in own if isinstance(vars(module)[name], type) and not name.startswith("_")}
        assert classes - sound <= tried
