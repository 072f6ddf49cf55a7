"""The checks of formulations: right ones pass; every fault is found by the check made for it, and by no other."""

from __future__ import annotations

from collections.abc import Mapping

import broken_formulations
import pytest
from formulations import Nearest, Program
from running import Main, failures

from vibench import Formulation, testing

FAULTS: Mapping[str, tuple[str, list[str]]] = {
    "AxisThatIsNone": ("axes", ["uses = ('pod', 'cones')", "expected a tuple of some of pod, dual, primal"]),
    "EnrichesNothing": ("axes", ["'primal' needs 'pod' and 'dual'"]),
    "MultiplierInWords": ("axes", ["multiplier is 'somehow'", "vibench.Multiplier"]),
    "BuildsAList": ("build", ["`build` returned a list, expected a mapping"]),
    "BuildsAFunction": ("build", ["what `build` returns as 'tangent' cannot be stored", "function"]),
    "MakesADictionary": ("model", ["made a dict, expected a FormulationModel"]),
    "WithoutDimension": ("model", ["`dimension` of the model is None, expected a whole number"]),
    "AnswersInATuple": ("answers", ["`solve` returns a tuple; expected a vibench.FormulationAnswer"]),
    "NotANumber": ("answers", ["at mu = [", "x is not finite: entry 2"]),
    "NeverConverges": ("answers", ["no answer at 6 parameters is ok", "inaccurate"]),
    "SaysNotWhy": ("answers", ["the outcome is failed, without a reason"]),
    "MoreThanDeclared": ("answers", ["alpha has ", " coefficients, more than `generators` of the model, 3"]),
    "SolverOfItsOwnAccord": ("answers", ["solves a quadratic program without 'solvers' among its axes"]),
    "OfAnotherSize": (
        "pairs",
        ["`reconstruct` returned a u of float64 and the shape (39,), expected float64 and (40,)"],
    ),
    "Pulls": ("pairs", ["a broken answer: λ has negative coefficients, as -"]),
    "ForgetsTheMultiplier": ("pairs", ["`reconstruct` returned no λ, and the formulation declares `solved`"]),
    "RemembersItsScale": ("coefficients", ["reconstructed from x and alpha by another model, u differs: entry "]),
    "Rolls": ("determinism", ["a second call gives different values of x: entry "]),
    "StepsOn": ("no mutation", ["solve changes its argument mu: entry "]),
    "WrongSide": ("errors", ["a training parameter, the error of u is 2 of it: zero would be nearer"]),
    "NoProgram": ("axes in use", ["uses declares 'solvers', but no query calls `settings.solve_qp`"]),
    "Unpicklable": ("pickling", ["cannot be pickled", "attribute weight"]),
}


@pytest.mark.parametrize("formulation", [Program, Nearest])
def test_a_formulation_that_is_right_passes(formulation: type[Formulation]) -> None:
    assert failures(testing.examine(formulation)) == {}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_by_its_check_alone(name: str) -> None:
    check, words = FAULTS[name]
    found = failures(testing.examine(getattr(broken_formulations, name)))
    assert list(found) == [check], found
    assert [word for word in words if word not in found[check]] == [], found[check]


def test_the_command_names_the_fault(main: Main) -> None:
    code, out, err = main("check", "broken_formulations:Pulls")
    assert (code, err) == (1, "")
    assert "failed   pairs: " in out
    assert "skipped  determinism: it needs 'pairs'" in out
