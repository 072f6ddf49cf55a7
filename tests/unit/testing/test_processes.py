import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import broken_variants
import fake_plugins
import pytest
from broken_variants import Bar
from fake_plugins import Wire
from running import PATIENCE, Main

from vibench import testing
from vibench.execution.isolated import NotImportableError
from vibench.testing.checks import CheckResult, ConformanceError, Verdict, call_in_other_process
from vibench.testing.problems import ProblemCase


def examined(plugin: type) -> dict[str, CheckResult]:
    return {each.check: each for each in testing.Examination(plugin, seconds=60.0).results()}


def test_results_are_those_of_this_process() -> None:
    here = [(each.check, each.verdict) for each in testing.examine(Wire)]
    assert [(name, each.verdict) for name, each in examined(Wire).items()] == here


def test_a_call_that_hangs_ends_the_checks_with_one_line(main: Main) -> None:
    code, out, err = main("check", "fake_plugins:Sleeps", "--seconds", "2")
    assert (code, err) == (1, "")
    failed = [line for line in out.splitlines() if line.startswith("failed")]
    assert len(failed) == 1
    assert failed[0].endswith(": stopped: the checks take longer than 2 s")
    assert out.splitlines()[-2].startswith("skipped  ")
    assert out.splitlines()[-2].endswith(", time: no time is left")


@pytest.mark.long
def test_a_check_that_ends_its_process_costs_those_that_need_it() -> None:
    for plugin, cause in ((fake_plugins.Segfaults, "SIGSEGV"), (fake_plugins.Exits, "exit code 3")):
        findings = examined(plugin)
        (failed,) = (each for each in findings.values() if each.verdict is Verdict.FAILED)
        assert failed.check == "one assembly"
        assert cause in failed.message
        assert findings["training set"].verdict is Verdict.PASSED
        assert findings["assembly"] == CheckResult("assembly", Verdict.SKIPPED, "it needs 'one assembly'")
        assert len(findings) == len(ProblemCase.checks)
    # what passed in a process that died later is remembered
    findings = examined(broken_variants.PaintsTheEnd)
    name = "picture and diagnostics"
    assert findings[name].message == "the worker process died with exit code 5"
    assert [one for one, each in findings.items() if each.verdict is not Verdict.PASSED] == [name]
    # a plugin that raises what Ctrl-C does fails its check
    (failed,) = (each for each in examined(fake_plugins.InterruptingCone).values() if each.verdict is Verdict.FAILED)
    assert failed.check == "cone"
    assert failed.message.startswith("KeyboardInterrupt")


TESTS = """
from functools import partial
from fake_plugins import BadCone, Exits, Wire
from broken_variants import Unannotated
from vibench.testing import parametrize_with_checks

@parametrize_with_checks(Exits, Unannotated, partial(Wire, nodes=6), partial(BadCone, how="negative"))
def test_conforms(check):
    check()
"""


@pytest.mark.long
def test_checks_are_tests_of_pytest(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    cases = "Exits-one assembly", "Wire-declarations", "Unannotated-options", "BadCone-cone", "BadCone-errors"
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", "-rA"]
    command += [f"test_mine.py::test_conforms[{name}]" for name in cases]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(folder for folder in sys.path if folder)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    for words in (
        "FAILED test_mine.py::test_conforms[Exits-one assembly] - ", "the worker process died with exit code 3",
        "PASSED test_mine.py::test_conforms[Wire-declarations]",
        "PASSED test_mine.py::test_conforms[Unannotated-options]",
        "ConformanceWarning: Unannotated, options: the option 'depth' has no annotation",
        "FAILED test_mine.py::test_conforms[BadCone-cone] - ", "negative coefficient", "it needs 'cone'",
    ):  # fmt: skip
        assert words in done.stdout, (words, done.stdout)


def test_a_slow_assembly_is_made_at_fewer_parameters() -> None:
    for seconds, points in ((1e-3, 7), (0.8, 7), (1.5, 4), (3.0, 2)):
        case = ProblemCase(Bar)
        case.__dict__["one_assembly"] = seconds
        assert len(case.mus) == points
        here = [check for check in ProblemCase.checks if check.name != "another process"]
        findings = {check.name: list(check.faults(case) or ()) for check in here}
        fewer = f"checks at {points} parameters instead of 7, and none for jumps, for lack of time"
        assert findings["one assembly"] == [f"takes {seconds:.2g} s", fewer][: 1 + (points < 7)]
        assert findings["continuity in mu"] == ["not looked for, for lack of time"][: points < 7]


def process() -> tuple[int, int]:
    return os.getpid(), hash("a text")


def fails() -> None:
    raise ArithmeticError("the wire snapped")


def test_other_processes_have_other_hashes_and_get_what_can_be_sent() -> None:
    there = call_in_other_process(process, seconds=PATIENCE)
    assert there[0] != os.getpid()
    assert there[1] != hash("a text")
    assert call_in_other_process(process, seconds=PATIENCE) == there
    with pytest.raises(ConformanceError, match="in another process it fails: ArithmeticError: the wire snapped"):
        call_in_other_process(fails, seconds=PATIENCE)

    class Local(Wire):
        pass

    code: dict[str, Any] = {"__name__": "made_up", "Wire": Wire}
    exec("class Mine(Wire):\n    pass", code)  # in a module that only this process has
    for unknown in (lambda: None, code["Mine"]):
        with pytest.raises(NotImportableError):
            call_in_other_process(unknown, seconds=PATIENCE)
    findings = {each.check: each for each in testing.examine(partial(Local, nodes=6))}
    assert findings["another process"].verdict is Verdict.PASSED
    assert findings["another process"].message.startswith("not compared: ")
