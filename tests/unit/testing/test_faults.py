from collections.abc import Mapping
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest
from broken_problems import OneBuffer
from formulations import Nearest, Program
from other_problems import Block, Put, Torsion
from samples import SOLVERS_OF_TESTS

from vibench import testing
from vibench.testing.checks import Verdict
from vibench.testing.solvers import of_qpsolvers

FAULTS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "broken_problems": {
        "Asymmetric": ("symmetry of A",
            "A is not symmetric at mu = [4.0]", "entry (2, 3) is -12.996 against -13 in the transpose"),
        "Indefinite": ("definiteness of A", "A is not positive definite at mu = [8.0]", "its smallest eigenvalue is -"),
        "IndefiniteNorm": ("construction",
            "is not positive definite", "broken_problems.py, line", "self.V = InnerProduct("),
        "Jumps": ("continuity in mu", "g jumps at mu = [5.432", "entry ", "0.0153846 against 0.0155385"),
        "PartlyWrong": ("declarations", "refuted at mu = [4.0]: `contact`, g, is not that of `assemble`: row "),
        "InfiniteMatrix": ("assembly", "B has entries that are not finite at mu = [4.0]"),
        "Column": ("assembly", "f has shape (12, 1) at mu = [4.0]; the spaces V and W require (12,)"),
        "NoInequality": ("assembly", "`assemble` returned a tuple, expected a VariationalInequality"),
        "Raises": ("assembly", "at mu = [8.0]: ArithmeticError: the wire snapped", "line ", "raise"),
        "NoSpace": ("construction", "`V` of NoSpace is <Compressed", "expected an InnerProduct"),
        "NoConstraint": ("spaces", "W has dimension 0", "no constraint"),
        "NoMeasure": ("spaces", "`multiplier_integrals` is 0 at entry"),
        "JumpsAtTheCentre": ("continuity in mu", "A jumps at mu = [6"),
        "CountsInstances": ("determinism", "another instance gives different values of g"),
        "ConstantOfNothing": ("spaces", "`constant` names 'a', expected members among A, f, B, g"),
        "ConstantText": ("construction", "`constant` of ConstantText is 'A', expected a set of a text"),
        "NoContact": ("declarations", "what `contact` returned has the type NoneType"),
        "LoadsWrong": ("declarations", "`contact_loads`, Bᵀη, is not that of `assemble`"),
        "LoadsReachFarther": ("declarations", "`contact_loads` vary on more rows at mu = [4.0] than their `reach`"),
        "ContactOfNothing": ("declarations", "`contact` is defined but `contact_dofs` is not"),
        "ContactChangesTheParameter": ("declarations", "ValueError: output array is read-only (broken_p"),
        "Overlooked": ("declarations", "B of shape (12, 12), expected a Contact with B of shape (12, 11)"),
        "Falling": ("spaces", "`contact_dofs` is not strictly increasing"),
        "SamplesWrong": ("declarations", "refuted at mu = [4.0]: `sampler` of f, is not that of `assemble`: row 4"),
        "SamplesNothing": ("declarations", "NotImplementedError", "has no sampler"),
        "SourceWrong": ("constraint in C", "g of `contact_source` differs from that of `assemble`"),
        "OneSample": ("training set", "training_set has mu = [5.0] alone", "at least two"),
        "Twice": ("training set", "training_set: parameter 2, [5.0], occurs twice"),
        "Outside": ("training set", "training_set: parameter 0 has 'force' = 3, outside the box [4, 8]"),
        "Flat": ("training set", "training_set: parameters of shape (6,); expected (P, 1)"),
        "OtherValidation": ("validation set", "not the same for the same seed", "default_rng(seed)"),
        "Unpicklable": ("pickling", "cannot be pickled", "attribute load"),
        "OutOfReach": ("high-fidelity solution", "no solution: at mu = [8.0]", "more than the wire bears"),
        "PaintsNothing": ("picture and diagnostics", "has n = 11, but that of V in the object is 12"),
        "InsideOut": ("picture and diagnostics", "mesh_fields.cells['tetra']: 1 of 1 cells are inside out or flat"),
        "OutputsOfOneName": ("spaces", "two outputs have the same name: force"),
        "OutputOfNothing": ("outputs", "the output 'peak' fails at mu = [4.0]: ValueError: zero-size array"),
        "OutputOfAnotherSize": ("outputs", "the output 'force' has coefficients of λ of shape (13,); expected (12,)"),
        "Unfinished": ("construction", "abstract class Unfinished", "assemble"),
    },
    "broken_strategies": {
        "NegativeGenerators": ("cone",
            "negative coefficient", "not declared free", "look at coefficient 3 of generator"),
        "Misses": ("tolerance",
            "tolerance 0.1 is missed by 7 generators", "of snapshot 15 is 0.194", "which claim 0."),
        "Boasts": ("errors", "tolerance 0.3: the projection error e(1) is 0.8278", "not 0.4139"),
        "OneErrorTooFew": ("cone", "`errors` of the cone has shape (3,); expected e(0) … e(3), or e(3) alone"),
        "Oversized": ("size", "size 1 was prescribed; the cone has 2 generators"),
        "Draws": ("determinism", "size 3: a second call gives different values of generators: entry ("),
        "Normalises": ("cone", "ValueError: output array is read-only (broken_strategies.py, line", "snapshots /= "),
        "DividesByZero": ("snapshots without contact", "generators of ReducedSet has an entry that is not finite"),
        "UnpicklableDual": ("pickling", "cannot be pickled", "attribute weight"),
        "NotOrthogonal": ("enrichment", "not orthonormal in V and orthogonal to V_N: the ", " of vector "),
        "AsksForATolerance": ("tolerance", "without a tolerance", "TypeError", "set takes_tolerance = True"),
        "NeedsNone": ("tolerance", "takes_tolerance is True, but build(offline, None) returns an enrichment"),
        "Fewer": ("tighter tolerances", "tolerance 0.1 gives 0 vectors, fewer than the", "of tolerance 0.5"),
        "KindOfTwo": ("kind", "the kind depends on the tolerance: none at tolerance 0.9, fixed at"),
        "DrawsVectors": ("determinism", "a second call gives different values of vectors: entry ("),
        "ChangesTheBasis": ("tolerance", "ValueError: output array is read-only", "offline.basis[:, 0] *= -1.0"),
        "NoMultiplier": ("model without contact", "AssertionError: no multiplier", "broken_strategies.py, line"),
        "SuppliesFunction": ("pickling", "the Enrichment cannot be stored", "is not a function in broken_strategies"),
        "SuppliesAVector": ("enrichment", "the supply at mu = [-0.1, 0.0] has shape (40,), expected (40, count)"),
        "Restarts": ("nested growth", "the vectors of tolerance 0.5 are not the first ones of tolerance 0.1"),
    },
    "broken_formulations": {
        "AxisThatIsNone": ("axes", "uses = ('pod', 'cones')", "expected a tuple of pod, dual, primal"),
        "EnrichesNothing": ("axes", "'primal' needs 'pod' and 'dual'"),
        "MultiplierInWords": ("construction", "`multiplier` of MultiplierInWords is 'somehow', expected a Multiplier"),
        "BuildsAList": ("build", "what `build` returned is [", "expected a mapping"),
        "BuildsAFunction": ("build", "what `build` returns as 'tangent' cannot be stored", "function"),
        "MakesADictionary": ("model", "made a dict, expected a FormulationModel"),
        "NotANumber": ("pairs", "at mu = [", "x or alpha of the answer is not finite"),
        "NeverConverges": ("answers", "no answer at 6 parameters is ok", "inaccurate"),
        "SaysNotWhy": ("answers", "the outcome is failed, without a reason"),
        "SolverOfItsOwnAccord": ("answers", "solves a quadratic program without 'solvers' among its axes"),
        "RemembersItsScale": ("coefficients", "reconstructed from x and alpha by another model, u differs: entry "),
        "Rolls": ("determinism", "a second call gives different values of u: entry "),
        "StepsOn": ("answers", "ValueError: output array is read-only"),
        "WrongSide": ("errors", "a training parameter, the error of u is 2 of it: zero would be nearer"),
        "NoProgram": ("axes in use", "uses declares 'solvers', but no query calls `settings.solve_qp`"),
        "Unpicklable": ("pickling", "cannot be pickled", "attribute weight"),
    },
    "broken_variants": {
        "SkewStiffness": ("symmetry of A", "A is not symmetric at mu = ["),
        "IndefiniteSomewhere": ("definiteness of A", "A is not positive definite at mu = ["),
        "WrongSide": ("high-fidelity solution", "no constraint is active at any of", "is B u ≤ g the admissible side?"),
        "NegativeGap": ("high-fidelity solution", "every constraint is active at each of 5 training"),
        "PermutedNorm": ("coercivity and inf-sup", "X_V has the unknowns in another order than A"),
        "EuclideanNorm": ("coercivity and inf-sup", "a norm without gradients, such as a mass matrix"),
        "SingularDualNorm": ("construction", "self.W = "),
        "RepeatedConstraint": ("coercivity and inf-sup", "1 rows of B depend linearly on the others"),
        "ConstantStiffness": ("declarations", "declared `constant` depends on mu: row ", " of A differs at mu = ["),
        "ConstantConstraint": ("declarations", "declared `constant` depends on mu: row ", " of B differs at mu = ["),
        "NamesOfNodes": ("another process", "look for the order of sets"),
        "NoisyLoad": ("determinism", "at mu = [", "a second call gives different values of f: entry "),
        "NotANumberInACorner": ("assembly", "g has entries that are not finite at mu = [0.35, 0.08]"),
        "LoadOnAllNodes": ("assembly", "f has shape (49,) at mu = ", "require (25,)"),
        "DualNormOfAllNodes": ("assembly", "B has shape (9, 54) at mu = ", "require (27, 54)"),
        "IgnoresTheParameter": ("independence of mu", "nothing depends on the parameter 'twist'"),
        "ComplexStiffness": ("assembly", "A is complex; vibench is for real problems"),
        "OtherElements": ("declarations", "`element_sampler` of A, is not that of `assemble`"),
        "AllElements": ("declarations", "A of `element_sampler` has shape (24, 2, 2), expected (12, 2, 2)"),
        "OtherContact": ("declarations", "`contact`, ", " is not that of `assemble`"),
        "DependsOnTheCallBefore": ("determinism", "a second call gives different values of f"),
        "ShiftsTheParameter": ("assembly", "ValueError: output array is read-only", "mu -= 1.0"),
        "Unannotated": ("options", "the option 'depth' has no annotation"),
        "other_sign": ("signs of multipliers", "multipliers have the other sign"),
        "ignores_the_accuracy": ("known solutions", "some constraints are active: inaccurate, "),
        "ignores_the_bounds": ("known solutions", "primal residual"),
        "draws": ("determinism", "a second call gives another x"),
        "raises_where_infeasible": ("infeasible program", "it raises ArithmeticError: no point is admissible"),
        "one_buffer": ("independent calls", "a later call overwrites x of an earlier solution"),
        "memoises": ("repeated programs", "solutions are kept, and their times say nothing"),
        "knows_by_address": ("independent calls", "the solution is that of the program before"),
        "no_solution": ("answer", "the solver returned a tuple, expected a QPSolution"),
    },
}  # fmt: skip
"""By module and plugin: the check that finds its fault, and parts of the message."""


def messages(plugin: object) -> dict[str, str]:
    results = testing.examine(plugin)
    return {each.check: each.message for each in results if each.verdict in (Verdict.FAILED, Verdict.WARNING)}


@pytest.mark.parametrize(("module", "name"), [(module, name) for module, several in FAULTS.items() for name in several])
def test_a_fault_is_found_by_its_check(module: str, name: str) -> None:
    check, *words = FAULTS[module][name]
    found = messages(getattr(import_module(module), name))
    assert [word for word in words if word not in found.get(check, "")] == [], found
    # The variants of strangers' problems may violate more than one requirement.
    assert module == "broken_variants" or list(found) == [check], found


def test_every_broken_plugin_is_tried() -> None:
    sound = {
        "Declared", "variant", "changed", "built", "Greedy", "LastErrorAlone", "Supremizing", "Worse", "one_vector",
        "OneBuffer", "Own", "Bar", "ByElements", "Option", "Cube", "exact", "Misbehaves", "MisbehavingModel",
    }  # fmt: skip
    elsewhere = {"PaintsTheEnd": "test_processes.py", "UnknownAnnotation": "test_conformance.py"}
    for name, file in elsewhere.items():
        assert name in Path(__file__).with_name(file).read_text(encoding="utf-8")
    for module, tried in FAULTS.items():
        contents = vars(import_module(module)).items()
        own = {name for name, value in contents if getattr(value, "__module__", "") == module and name[0] != "_"}
        assert own - sound - elsewhere.keys() == tried.keys(), module


@pytest.mark.parametrize(
    "plugin",
    [
        OneBuffer, Program, Nearest, partial(Torsion, 6), partial(Put, 24), partial(Block, 2),
        partial(Block, 2, 2e11, 1e-3),
        *(partial(of_qpsolvers, solver=solver) for solver in SOLVERS_OF_TESTS),
    ],
)  # fmt: skip
def test_what_is_right_passes_without_a_warning(plugin: object) -> None:
    assert messages(plugin) == {}
    if isinstance(plugin, partial) and plugin.func is Torsion:
        constants = next(one.message for one in testing.examine(plugin) if one.check == "coercivity and inf-sup")
        assert all(symbol in constants for symbol in ("α = ", "γ_a = ", "β_HF = "))
