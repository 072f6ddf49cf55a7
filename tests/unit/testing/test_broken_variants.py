"""Strangers' problems with a mistake, and QP solvers with one: each is named by the check that is made for it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import broken_variants
import pytest
from other_problems import Block, Put, Torsion
from samples import SOLVERS_OF_TESTS

from vibench import testing
from vibench.testing.checks import Verdict
from vibench.testing.solvers import of_qpsolvers

PROBLEMS: Mapping[str, tuple[str, str]] = {
    "SkewStiffness": ("symmetry of A", "A is not symmetric at mu = ["),
    "IndefiniteSomewhere": ("definiteness of A", "A is not positive definite at mu = ["),
    "WrongSide": ("high-fidelity solution", "check that B u ≤ g is the admissible side"),
    "NegativeGap": (
        "high-fidelity solution",
        "every constraint is active at each of 5 training",
    ),
    "PermutedNorm": ("coercivity and inf-sup", "X_V has the unknowns in another order than A"),
    "MassNorm": ("coercivity and inf-sup", "a norm without gradients, such as a mass matrix"),
    "EuclideanNorm": ("coercivity and inf-sup", "a norm without gradients"),
    "SingularDualNorm": ("construction", "X_W: "),
    "RepeatedConstraint": ("coercivity and inf-sup", "1 rows of B depend linearly on the others"),
    "ConstantStiffness": ("independence of mu", "A is declared `constant` but depends on mu"),
    "ConstantConstraint": ("independence of mu", "B is declared `constant` but depends on mu"),
    "RandomMesh": ("determinism", "another instance gives different values of A"),
    "NamesOfNodes": ("another process", "look for the order of sets"),
    "NoisyLoad": ("determinism", "a second call gives different values of f"),
    "OneVector": ("no mutation", "assemble changes f of an earlier result"),
    "NotANumberInACorner": ("assembly", "g is not finite: entry 0 is nan (at mu = [0.35, 0.08])"),
    "LoadOnAllNodes": ("assembly", "f has shape (49,); expected (25,)"),
    "DualNormOfAllNodes": ("assembly", "B has shape (9, 54); expected (27, 54)"),
    "IgnoresTheParameter": ("independence of mu", "nothing depends on the parameter 'twist'"),
    "UpsideDownBox": ("parameters", "the lower bound 8 of the parameter 'twist' is above its upper bound 1"),
    "ComplexStiffness": ("assembly", "A has dtype complex128; expected float64"),
    "IntegerBound": ("assembly", "f has dtype int64; expected float64"),
    "OtherSamples": ("assembly by entries", "g of `sampler` differs from that of `assemble`"),
    "OtherElements": ("assembly by elements", "A of `element_sampler` differs from that of `assemble`"),
    "AllElements": ("assembly by elements", "A of the element sampler has shape (24, 2, 2); expected (12, 2, 2)"),
    "OtherContact": ("assembly on the contact", "of `contact` differs from that of `assemble`"),
    "DependsOnTheCallBefore": ("determinism", "a second call gives different values of f"),
    "ShiftsTheParameter": ("no mutation", "assemble changes its argument mu"),
    "Unannotated": ("options", "the option 'depth' has no annotation"),
}
"""The check that names the mistake, and words of its message."""

SOLVERS: Mapping[str, tuple[str, str]] = {
    "other_sign": ("signs of multipliers", "multipliers have the other sign"),
    "ignores_the_accuracy": ("known solutions", "some constraints are active: inaccurate, "),
    "ignores_the_bounds": ("known solutions", "primal residual"),
    "overwrites": ("no mutation", "the solver changes g: entry "),
    "draws": ("determinism", "a second call gives another x"),
    "raises_where_infeasible": ("infeasible program", "it raises ArithmeticError: no point is admissible"),
    "one_buffer": ("independent calls", "a later call overwrites x of an earlier solution"),
    "memoises": ("repeated programs", "solutions are kept, and their times say nothing"),
    "knows_by_address": ("independent calls", "the solution is that of the program before"),
    "no_solution": ("answer", "the solver returned a tuple, expected a QPSolution"),
}


def messages(findings: list[testing.CheckResult]) -> dict[str, str]:
    return {found.check: found.message for found in findings if found.verdict in (Verdict.FAILED, Verdict.WARNING)}


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_mistake_in_a_problem_is_named(name: str) -> None:
    check, words = PROBLEMS[name]
    found = messages(testing.examine(getattr(broken_variants, name)))
    assert words in found.get(check, ""), found


@pytest.mark.parametrize("name", SOLVERS)
def test_a_mistake_in_a_solver_is_named(name: str) -> None:
    check, words = SOLVERS[name]
    found = messages(testing.examine(getattr(broken_variants, name)))
    assert words in found.get(check, ""), found


def test_every_broken_variant_is_tried() -> None:
    sound = {"Bar", "ByElements", "Option", "Cube", "exact"}
    elsewhere = {"PaintsTheEnd": "test_processes.py", "UnknownAnnotation": "test_conformance.py"}
    for name, file in elsewhere.items():
        assert name in Path(__file__).with_name(file).read_text(encoding="utf-8")
    module = broken_variants.__name__
    own = {name for name, value in vars(broken_variants).items() if getattr(value, "__module__", "") == module}
    assert {name for name in own if not name.startswith("_")} - sound == {*PROBLEMS, *SOLVERS, *elsewhere}


@pytest.mark.parametrize(
    "create", [partial(Torsion, 6), partial(Put, 24), partial(Block, 2), partial(Block, 2, 2e11, 1e-3)]
)
def test_what_is_right_passes_without_a_warning(create) -> None:
    findings = testing.examine(create)
    assert messages(findings) == {}
    constants = next(found.message for found in findings if found.check == "coercivity and inf-sup")
    assert [symbol for symbol in ("α = ", "γ_a = ", "β_HF = ") if symbol not in constants] == []


@pytest.mark.parametrize("solver", SOLVERS_OF_TESTS)
def test_the_solvers_of_the_dependencies_pass(solver: str) -> None:
    assert messages(testing.examine(partial(of_qpsolvers, solver=solver))) == {}
