import importlib.metadata
from collections.abc import Iterator
from dataclasses import replace
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

SLOW = dict.fromkeys((
    "bearing", "bulge", "compiled", "enlarged-cpg", "greedy", "hertz", "hertz3d", "hyper-reduced", "infsup-greedy",
    "nmf", "obstacle", "regression", "tresca", "two-spheres",
), pytest.mark.long)  # fmt: skip

BUILT_IN = [
    pytest.param(word, entry.name, marks=SLOW.get(entry.name, ()))
    for word, kind in CHECKED.items()
    for entry in importlib.metadata.distribution("vibench").entry_points.select(group=kind.entry_points)
]


def unlisted(folder: Path) -> Path:
    write_manifest(write_cable(folder), manifest({"parameters.validation": ...}))
    return folder


@pytest.mark.parametrize(("word", "name"), BUILT_IN)
def test_a_built_in_plugin_passes_every_check(word: str, name: str, tmp_path: Path) -> None:
    given: dict[str, object] = {}
    if word == "problem":
        given = {"resolution": 1350 if name == "hertz3d" else "coarse"}
        if name == "pack":
            given = {"path": str(unlisted(tmp_path / "cable"))}
    if word == "sampling":
        given = sampling_options(name, tmp_path)
    options = find(CHECKED[word], name).check_options(given)
    findings = testing.examine(partial(find(CHECKED[word], name).load(), **options))
    skipped = [finding for finding in findings if finding.verdict is Verdict.SKIPPED]
    assert [str(finding) for finding in findings if finding.verdict is not Verdict.PASSED] == list(map(str, skipped))
    # The constraint of the sample problem is not smooth enough in mu for polynomials.
    assert [finding.check for finding in skipped[:1]] == (["build"] if name == "compiled" else [])
    unsupported = "does not support the problem: the model cannot be exported to C"
    assert all(unsupported in each.message for each in skipped[:1])


def sampling_options(name: str, folder: Path) -> dict[str, object]:
    (folder / "points.csv").write_text("height,position\n0.5,-1\n900,2\n")
    return {
        "grid": {"counts": [3]}, "list": {"points": [0.5, 2.0]}, "file": {"path": str(folder / "points.csv")},
        "greedy": {"candidates": 64, "tolerance": 0.2}, "sweep": {"size": 7},
        "load-steps": {"parameter": "height", "loadings": 3, "steps": 4, "seed": 3},
    }.get(name, {"size": 7, "seed": 3, "log": []})  # fmt: skip


@pytest.mark.parametrize(
    ("plugin", "code", "title", "lines", "counts"),
    [
        ("problem:radial-obstacle", 0,
         "problem 'radial-obstacle', at resolution coarse (--option resolution=… for another)", [],
         " passed, 0 failed, 0 skipped"),
        ("solver:osqp", 0, "QP solver 'osqp'", [], "9 passed, 0 failed, 0 skipped"),
        ("broken_problems:Jumps", 1, "problem 'broken_problems:Jumps'",
         ["failed   continuity in mu: g jumps at mu = [5.432"], "21 passed, 1 failed, 0 skipped"),
        ("broken_formulations:NeverConverges", 1, "formulation 'broken_formulations:NeverConverges'",
         ["failed   answers: ", "skipped  pairs: it needs 'answers'"], "5 passed, 1 failed, 10 skipped"),
        ("broken_variants:other_sign", 1, "QP solver 'broken_variants:other_sign'",
         ["failed   signs of multipliers: multipliers have the other sign"], "5 passed, 1 failed, 3 skipped"),
        ("broken_variants:Unannotated", 0, "problem 'broken_variants:Unannotated'",
         ["warning  options: the option 'depth' has no annotation",
          "the option 'cells' has the default 6.5; its annotation expects int"],
         "passed, 1 warning, 0 failed, 0 skipped"),
    ],
)  # fmt: skip
def test_every_check_has_a_line(plugin: str, code: int, title: str, lines: list[str], counts: str, main: Main) -> None:
    found, out, err = main("check", plugin)
    assert (found, err) == (code, "")
    assert out.splitlines()[0] == title
    assert [line for line in lines if line not in out] == []
    assert sum(line.startswith("failed") for line in out.splitlines()) == code
    assert out.splitlines()[-1].endswith(counts)


def test_plugins_broken_elsewhere_are_correct_on_data_of_one_s_own_too() -> None:
    strategies = broken_strategies.Greedy, broken_strategies.LastErrorAlone, broken_strategies.Supremizing
    for plugin in (broken_problems.Declared, testing.MovingSupport, Varying, *strategies):
        testing.check(plugin)
    for cls in (broken_problems.Declared, broken_strategies.Greedy, broken_strategies.Supremizing):
        with pytest.raises(TypeError, match=f"pass {cls.__name__}"):
            testing.check(cls())  # two instances are compared
    with pytest.raises(testing.ConformanceError) as caught:
        testing.check(broken_problems.Worse)
    title, *lines = str(caught.value).splitlines()
    assert title == "Worse fails 2 of 22 checks"
    assert [line.split(":")[0] for line in lines] == ["training set", "pickling"]
    snapshots, W = testing.sample_snapshots()
    misses = testing.examine(broken_strategies.Misses, snapshots=snapshots[:, :2], W=W, tolerances=[1e-9], sizes=[1])
    assert failures(misses) == {}  # two generators are all there is
    sample = testing.sample_offline()
    offline = replace(sample, span=sample.span[:, :2])
    findings = testing.examine(broken_strategies.Supremizing, offline=offline, tolerances=[0.2, 0.8])
    counts = next(finding.message for finding in findings if finding.check == "enrichment")
    assert counts == "tolerance 0.8: fixed, 2 vectors; tolerance 0.2: fixed, 2 vectors"
    with pytest.raises(TypeError, match="both snapshots and W"):
        testing.check(broken_strategies.Greedy, snapshots=snapshots)


def test_a_call_is_slow_that_takes_long_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    for plugin in (broken_strategies.Greedy, broken_problems.Declared, broken_strategies.Supremizing):
        assert "above the limit of 0 s" in failures(testing.examine(plugin, seconds=0.0))["time"]
    for walls, remarks in (
        ((0.5,), [(Note, "takes 0.5 s")]),
        ((5.0, 0.25), [(Note, "takes 0.25 s")]),  # the first time the machine was busy
        ((5.0, 4.0), [(Doubt, "6 unknowns takes 4 s"), (Note, "takes 4 s")]),
        ((500.0,), [(str, "takes 500 s, above the limit of 120 s"), (Note, "takes 5e+02 s")]),
    ):
        clock = iter([reading for wall in walls for reading in (0.0, wall)])
        with monkeypatch.context() as patched:
            patched.setattr("vibench.timing.perf_counter", lambda clock=clock: next(clock))
            found = list(solvers.SolverCase(lambda *_: None).duration())
        for remark, (kind, text) in zip(found, remarks, strict=True):
            assert type(remark) is kind
            assert text in remark
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


@settings(max_examples=12)
@given(st.floats(0.001, 0.999), st.floats(-2.0, 2.0), st.floats(0.02, 3.0), st.sampled_from([-1.0, 1.0]))
def test_a_jump_is_found_wherever_it_is(kink: float, slope: float, size: float, sign: float) -> None:
    jump = find_jump(lambda t: bent(t, kink, slope, sign * size), {"f": 1.0, "A": 1.0})
    assert jump.name == "f"
    assert jump.left <= kink <= jump.right <= jump.left + 2.0**-30
    assert difference(jump.values[0]["f"], jump.values[-1]["f"], 0.0).startswith("entry 1 is ")


@settings(max_examples=10)
@given(st.floats(0.0, 1.0), st.floats(-5.0, 5.0))
def test_a_kink_a_root_or_a_small_jump_is_no_jump(place: float, slope: float) -> None:
    assert find_jump(lambda t: bent(t, place, slope, 0.0), {"f": 1.0, "A": 1.0}) is None
    place = 0.1 + 0.8 * place
    assert find_jump(lambda t: {"g": np.array([np.sqrt(abs(t - place))])}, {"g": 1.0}) is None
    assert find_jump(lambda t: {"g": np.array([1.0 + 0.9e-3 * (t > 0.3)])}, {"g": 1.0}) is None


def test_a_plugin_that_is_not_there_is_refused_in_one_line(main: Main) -> None:
    for arguments, words in (
        ("obstcale", ["no plugin is called 'obstcale'", "did you mean 'obstacle'"]),
        ("dual:obstacle", ["no dual strategy is called 'obstacle'", "known:", "mcpg"]),
        ("no_module:Rope", ["'no_module:Rope'", "cannot be imported", "no_module"]),
        ("broken_problems:Jmups", ["no plugin of the module broken_problems", "did you mean 'Jumps'"]),
        ("running:Path", ["'running:Path'", "no subclass of Problem, Sampling, PrimalStrategy, DualStrategy, Form"]),
        ("some\tthing:Rope", ["neither KIND:NAME", "solver", "MODULE:NAME"]),
        ("broken_variants:UnknownAnnotation", ["annotations that fail: NameError", "'Depth'"]),
        ("solver:piqq", ["no QP solver is called 'piqq'", "did you mean 'piqp'"]),
        ("solver:piqp --option eps=1", ["QP solver 'piqp' has no options"]),
        ("obstacle --option resolution", ["'resolution'", "KEY=VALUE"]),
        ("obstacle --option resolution=3", ["option 'resolution' of problem 'obstacle' is 3", "int ≥ 150"]),
        ("obstacle --option resoltion=coarse", ["did you mean 'resolution'"]),
        ("fake_plugins:BadCone", ["dual strategy 'fake_plugins:BadCone' needs the option 'how'"]),
        ("sampling:grid", ["needs the option 'counts'"]),
        ("", ["PLUGIN"]),
    ):
        refused(main("check", *filter(None, arguments.split(" "))), *words)


def test_options_reach_the_plugin_of_the_kind_that_is_given(main: Main, tmp_path: Path, register) -> None:
    _, out, _ = main("check", "fake_plugins:Wire", "--option", "nodes=20", "--option", "depth=0.1")
    assert "n = 20, m = 20" in out
    code, out, _ = main("check", "fake_plugins:BadCone", "--option", "how=negative")
    assert code == 1
    assert "failed   cone: " in out
    code, out, _ = main("check", "radial-obstacle", "--option", "resolution=200")
    assert (code, out.splitlines()[0]) == (0, "problem 'radial-obstacle'")
    assert f"n = {create('problem', 'radial-obstacle', {'resolution': 200}).V.dim}, " in out
    # a class in the current folder
    source = "from broken_strategies import Greedy\n\nclass Mine(Greedy):\n    '''Mine.'''\n"
    (tmp_path / "here" / "lying_around.py").write_text(source)
    code, out, _ = main("check", "lying_around:Mine")
    assert code == 0
    assert out.startswith("dual strategy 'lying_around:Mine'")
    twins = {"problems": "broken_problems:Declared", "dual_strategies": "broken_strategies:Greedy"}
    register(*((f"vibench.{group}", "twin", value) for group, value in twins.items()))
    refused(main("check", "twin"), "several plugins are called 'twin'", "problem:twin or dual:twin")
    assert main("check", "dual:twin")[1].startswith("dual strategy 'twin'")
