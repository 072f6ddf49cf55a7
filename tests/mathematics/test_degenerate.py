"""Degenerate input through the whole chain: nothing to reduce, no contact, contact everywhere, copies, near copies."""

import importlib.metadata

import numpy as np
import pytest
from fake_plugins import Wire
from samples import SampleStore, carry_out, program_queries

from vibench import Array, NumericalError, Stop, VariationalInequality
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import find
from vibench.stages.base import value_of
from vibench.stages.cell_queries import CellRows
from vibench.stages.enrichment import SingleEnrichment
from vibench.stages.offline import ConeStage, PODStage
from vibench.study.parameter_sets import ParameterSet


def at_depth(name: str, depth: float) -> type[Wire]:
    return type(name, (Wire,), {"__module__": __name__, "__init__": lambda self: Wire.__init__(self, depth=depth)})


def trained_at(name: str, mus: object) -> type[Wire]:
    return type(name, (Wire,), {"__module__": __name__, "training_set": lambda self: np.array(mus, float)})


NoContact = at_depth("NoContact", 10.0)
# The support pushes the whole wire up.
AllInContact = at_depth("AllInContact", -0.1)
# The wire lies on its support from the beginning: u = 0 and all energies with it, λ the load.
Resting = at_depth("Resting", 0.0)
OneSnapshot = trained_at("OneSnapshot", [[6.0]])
NearlyParallel = trained_at("NearlyParallel", 6.0 * (1.0 + 1e-11 * np.arange(6.0))[:, None])
NoSnapshot = trained_at("NoSnapshot", np.zeros((0, 1)))
FlatSnapshots = trained_at("FlatSnapshots", [5.0, 6.0, 7.0])
LostSnapshot = trained_at("LostSnapshot", [[5.0], [np.nan]])


class Copies(Wire):
    """Its force comes in steps, so that parameters have the same snapshot."""

    def training_set(self) -> Array:
        return np.array([[7.1], [5.1], [7.2], [5.2], [5.3]])

    def assemble(self, mu: Array) -> VariationalInequality:
        return super().assemble(np.round(mu))


class NoLoad(Wire):
    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        return VariationalInequality(vi.A, 0.0 * vi.f, vi.B, vi.g)


class ShortValidation(Wire):
    def validation_set(self, count: int, seed: int) -> Array:
        return super().validation_set(count, seed)[1:]


CASES = [member for member in list(vars().values()) if isinstance(member, type) and issubclass(member, Wire)]
STRATEGIES = [
    (entry.group, entry.name, entry.value)
    for entry in importlib.metadata.distribution("vibench").entry_points
    if entry.group in {"vibench.dual_strategies", "vibench.primal_strategies"}
]


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> SampleStore:
    """Artefacts of all cells: snapshots and POD of a case are those of every strategy."""
    return SampleStore(tmp_path_factory.mktemp("degenerate"))


@pytest.fixture
def rows(register, store):
    problems = (("vibench.problems", case.__name__, f"{__name__}:{case.__name__}") for case in CASES)
    register(*problems, *STRATEGIES)

    def run(case: type[Wire], dual: str, primal: str) -> CellRows:
        problem = Plugin("problem", case.__name__, "{}", find(PluginKind.PROBLEM, case.__name__).code)
        stop = Stop(tolerance=1e-3 if dual == "nmf" else 1e-6)  # an iteration, which ends long before round-off
        cone = ConeStage(problem, Plugin("dual strategy", dual, "{}", "test"), stop)
        tolerance = None if primal in {"decorrelated", "online-supremizers"} else 0.5
        strategy = Plugin("primal strategy", primal, "{}", "test")
        enrichment = SingleEnrichment(PODStage(problem, Stop(tolerance=1e-6)), cone, strategy, tolerance)
        stage = program_queries(enrichment, None, ParameterSet("validation", 3, 1), "piqp", 1e-8)
        carry_out(stage, store)
        found: CellRows = value_of(store, stage)
        return found

    return run


SIZES = {
    NoContact: (1, 0), AllInContact: (1, 2), NoLoad: (0, 0),
    OneSnapshot: (1, 1), Copies: (2, 2), NearlyParallel: (1, 1),
}  # fmt: skip
"""N and R; two generators where everything is in contact: the pull of the ends does not grow with the load."""


@pytest.mark.parametrize("case", SIZES)
@pytest.mark.parametrize("dual", ["cpg", "mcpg"])
@pytest.mark.parametrize(
    "primal", ["decorrelated", pytest.param("online-supremizers", marks=pytest.mark.long), "offline-pga"]
)
def test_it_ends_in_ok_rows(rows, case: type[Wire], dual: str, primal: str) -> None:
    found = rows(case, dual, primal).cell
    assert (found["status"], found["queries_ok"]) == ("ok", 3)
    assert (found["N"], found["R"]) == SIZES[case]
    assert found["enrichment"] == (0 if primal == "decorrelated" else min(found["enrichment"], found["rank"]))
    if case is NoLoad:
        assert (found["queries_zero_u"], found["error_u_mean"], found["error_u_zero_max"]) == (3, None, 0.0)
    else:
        assert found["queries_zero_u"] == 0
        assert 0.0 <= found["error_u_mean"] < (1e-9 if case is NoContact else 0.1)
    if case in (NoContact, NoLoad):
        of_lambda = [found[name] for name in ("queries_zero_lambda", "error_lambda_mean", "error_lambda_zero_max")]
        assert of_lambda == [3, None, 0]
    else:
        assert found["queries_zero_lambda"] == 0
    if case is AllInContact and primal != "decorrelated":
        assert found["error_lambda_mean"] < 1e-6


OTHERS = ["angle-greedy", "dictionary", "enlarged-cpg", "nmf", "orthant", "pod-dual"]


@pytest.mark.parametrize("case", [NoContact, AllInContact])
@pytest.mark.parametrize(
    ("dual", "primal"),
    [*((dual, "infsup-greedy") for dual in OTHERS), ("mcpg", "infsup-greedy"), ("mcpg", "pod-supremizers")],
)
def test_other_strategies_end_in_ok_rows(rows, case: type[Wire], dual: str, primal: str) -> None:
    found = rows(case, dual, primal).cell
    assert (found["status"], found["queries_ok"]) == ("ok", 3)
    assert 0.0 <= found["error_u_mean"] < 0.1
    if case is NoContact:
        assert (found["R"], found["error_lambda_mean"], found["error_lambda_zero_max"]) == (0, None, 0.0)


@pytest.mark.parametrize("primal", ["decorrelated", "online-supremizers", "offline-pga"])
def test_a_solution_that_is_zero_up_to_round_off_is_a_snapshot(rows, primal: str) -> None:
    """All energies vanish, so the gap has nothing of its own size to be relative to."""
    found = rows(Resting, "mcpg", primal)
    assert found.cell["R"] == 1
    assert len(found.queries) == 3
    for query in found.queries:
        assert query["gap"] < 1e-3  # 1e-7 of the energy the load would gain without the support


def test_parameters_nobody_can_train_or_validate_on_are_refused(rows) -> None:
    for case, line in (
        (NoSnapshot, r"training_set: parameters of shape \(0, 1\); expected \(P, 1\)"),
        (FlatSnapshots, r"training_set: parameters of shape \(3,\); expected \(P, 1\)"),
        (LostSnapshot, "training_set: parameter 1 has 'force' = nan, which is not finite"),
        (ShortValidation, r"`validation_set` has shape \(2, 1\), expected \(3, 1\)"),
    ):
        with pytest.raises(NumericalError, match=line):
            rows(case, "cpg", "decorrelated")
