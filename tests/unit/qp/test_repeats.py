"""What is timed again is equivalent to what was timed, and new to whoever remembers answers."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from samples import carry_out, program_queries

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.strategies import Stop
from vibench.model.hyperreduced import HyperReducedModel
from vibench.plugins import registry
from vibench.plugins.plugin import Plugin
from vibench.qp.scaling import in_units, nearby, random_units
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution
from vibench.stages import snapshots, timing_rounds
from vibench.stages.artefacts import Store
from vibench.stages.cell_queries import CellQueries
from vibench.stages.enrichment import SingleEnrichment
from vibench.stages.offline import ConeStage, PODStage
from vibench.stages.query import ProgramQuery
from vibench.stages.snapshots import SnapshotStage
from vibench.stages.timing_rounds import TimingRounds
from vibench.study.parameter_sets import ParameterSet

PROBLEM = Plugin("problem", "obstacle", '{"resolution": 150}', "repeats")
EVERY = tuple(range(3))


def cell(interpolation: float | None, solver: str = "remembers", warm_start: bool = False) -> CellQueries:
    cone = ConeStage(PROBLEM, Plugin("dual strategy", "cpg", "{}", "repeats"), Stop(size=3))
    primal = Plugin("primal strategy", "decorrelated", "{}", "repeats")
    enrichment = SingleEnrichment(PODStage(PROBLEM, Stop(size=3)), cone, primal, None)
    validation = ParameterSet("validation", len(EVERY), 1)
    return program_queries(enrichment, interpolation, validation, solver, 1e-8, warm_start)


CELLS = (cell(None), cell(None, "other"), cell(1e-6), cell(1e-6, "other"))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    store = Store(tmp_path_factory.mktemp("artefacts"))
    for stage in TimingRounds(CELLS, (EVERY,) * len(CELLS), 1, first=0).inputs():
        if store.get(stage.key) is None:
            carry_out(stage, store)
    return store


class Remembers:
    """A solver that returns an earlier answer to a program that is the same to so many digits, or to the last bit."""

    def __init__(self, digits: int | None = None) -> None:
        self.known: dict[bytes, QPSolution] = {}
        self.digits, self.solved, self.remembered = digits, 0, 0

    def __call__(self, program: VariationalInequality, accuracy: float) -> QPSolution:
        data = (np.asarray(getattr(program, name)) for name in MEMBERS)
        key = b"".join((one if self.digits is None else one.round(self.digits) + 0.0).tobytes() for one in data)
        if key in self.known:
            self.remembered += 1
        else:
            self.solved += 1
            self.known[key] = solve_qp(program, "piqp", accuracy)
        return self.known[key]


def test_a_solver_that_remembers_programs_never_meets_one_again(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two cells of one problem and solver are in the rounds, whose programs are the same."""
    solver = Remembers()
    monkeypatch.setattr(registry, "qp_solver", lambda name: {name: solver})
    timed = TimingRounds(CELLS, (EVERY,) * len(CELLS), 12, first=0).run(store).value
    assert [len(one.rounds) for one in timed] == [12] * len(CELLS)
    assert solver.solved == len(CELLS) * (12 + 1)  # a query in every round, and the warm-up
    assert solver.remembered == 0


@pytest.mark.parametrize("which", [0, 2])
def test_an_answer_to_a_similar_program_is_not_timed(which: int, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    solver = Remembers(digits=1)
    monkeypatch.setattr(registry, "qp_solver", lambda name: {name: solver})
    # which queries a round begins with depends on measured seconds; units of some let the first answer pass
    monkeypatch.setattr(timing_rounds, "parts_alike", lambda _, parts: (EVERY,) * parts)
    with pytest.raises(NumericalError, match=r"residual .* above 3e-07.*does the solver remember answers"):
        TimingRounds(CELLS[which : which + 1], (EVERY,), 12, first=0).run(store)
    assert solver.remembered == 1


def test_reduced_programs_are_assembled_nowhere_twice(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A problem may keep what it computed for a parameter."""
    monkeypatch.setattr(registry, "qp_solver", lambda name: {name: Remembers()})
    visited = visits(monkeypatch, HyperReducedModel, "assemble")
    TimingRounds(CELLS, (EVERY,) * len(CELLS), 12, first=0).run(store)
    assert len(visited) == len(set(visited)) == 2 * (12 + 1)
    assert len({tuple(np.round(mu, 6)) for mu in visited}) == len(EVERY)


@pytest.mark.parametrize("role", ["training", "validation"])
def test_a_high_fidelity_solution_is_repeated_next_to_its_parameter(
    role: Literal["training", "validation"], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    visited = visits(monkeypatch, snapshots, "checked_assembly")
    snapshots._set_up.cache_clear()  # with the set-up, beside which a training solution is repeated
    found = SnapshotStage(PROBLEM, ParameterSet(role, 6, 3), 0).run(Store(tmp_path)).value
    repeated = {mu for mu in visited if visited.count(mu) > 1}
    repeated -= {tuple(PROBLEM.create().training_set()[0])}  # where the fingerprint is taken
    for mu in repeated:  # once more for verification, when all that is timed there has been
        last = len(visited) - 1 - visited[::-1].index(mu)
        assert visited.count(mu) == 2
        assert not any(np.allclose(later, mu, rtol=0.0, atol=1e-8) for later in visited[last + 1 :])
    assert len(set(visited)) > len(found.mu)
    assert {tuple(mu) for mu in found.mu} <= set(visited)
    problem = PROBLEM.create()
    for mu, u, lam in zip(found.mu, found.u.T, found.lam.T, strict=True):
        vi = problem.assemble(mu)
        assert np.abs(vi.A @ u - vi.f + vi.B.T @ lam).max() < 1e-12 * np.abs(vi.A @ u).max()


def visits(monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> list[tuple[float, ...]]:
    """Parameters at which something is assembled from now on."""
    found: list[tuple[float, ...]] = []
    plain: Callable[..., object] = getattr(owner, name)

    def noted(assembled: object, mu: Array) -> object:
        found.append(tuple(mu))
        return plain(assembled, mu)

    monkeypatch.setattr(owner, name, noted)
    return found


@given(st.integers(1, 6), st.integers(0, 5), st.sampled_from([1e-4, 1e-7, 1e-10]), st.integers(0, 2**32))
def test_in_other_units_it_is_the_same_program(n: int, m: int, accuracy: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, B, g = rng.standard_normal((2 * n, n)), rng.standard_normal((m, n)), rng.random(m)
    A = root.T @ root
    program = VariationalInequality(A, rng.standard_normal(n), np.vstack([B, -B]), np.hstack([g, -g]))
    d, again, other = (random_units(n, accuracy, seed, k) for k in (1, 1, 2))
    assert np.array_equal(d, again)
    assert not np.array_equal(d, other)
    assert 0.0 < np.abs(d - 1.0).max() <= 1e3 * accuracy
    scaled = in_units(program, d)
    assert np.array_equal(scaled.A, scaled.A.T)
    assert np.array_equal(scaled.B[:m], -scaled.B[m:])
    x = rng.standard_normal(n)
    assert np.allclose(scaled.A @ x, d * (A @ (d * x)), rtol=1e-12, atol=1e-12)
    assert np.allclose(scaled.B @ x, program.B @ (d * x), rtol=1e-12, atol=1e-12)
    assert scaled.f @ x == pytest.approx(program.f @ (d * x), abs=1e-12)
    assert np.array_equal(scaled.g, program.g)
    repeated = ProgramQuery(program, np.linalg.cholesky(A), "piqp", accuracy).repeated(seed)
    assert np.allclose(repeated.factor @ repeated.factor.T, repeated.program.A, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("reduced", [False, True], ids=["primal", "dual"])
def test_a_warm_start_is_in_the_units_of_its_program(reduced: bool, store: Store) -> None:
    """Started from its own solution, a query is solved at once; from the one in other units it would not be."""
    queries = CELLS[2 if reduced else 0].queries(store)
    plain = queries.query(1, "osqp", 1e-8, warm_start=False)
    started = ProgramQuery(plain.program, plain.factor, "osqp", 1e-8, (1, plain.program)).repeated(1, 2)
    assert np.array_equal(started.start[1].A, started.program.A)
    answer, _ = started.prepare(nullcontext)()
    cold, _ = plain.repeated(1, 2).prepare(nullcontext)()
    assert answer.iterations <= cold.iterations


@given(st.integers(0, 2**32), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_parameter_nearby_is_in_the_box(seed: int, one: float, other: float) -> None:
    box = ParameterBox(("a", "b"), np.array([-1.0, 1e6]), np.array([0.0, 3e6]), ("1", "1"))
    mu = box.lower + np.array([one, other]) * (box.upper - box.lower)
    found = nearby(box, mu, seed)
    assert np.all(box.lower <= found)
    assert np.all(found <= box.upper)
    assert not np.array_equal(found, mu)
    assert np.allclose(found, mu, rtol=1e-9, atol=1e-9)


def test_the_factor_of_a_program_in_other_units_is_lower_triangular() -> None:
    A = np.array([[2.0, 1.0], [1.0, 3.0]])
    program = VariationalInequality(A, np.ones(2), np.eye(2), np.ones(2))
    repeated = ProgramQuery(program, scipy.linalg.cholesky(A, lower=True), "piqp", 1e-7).repeated(5)
    assert repeated.factor[0, 1] == 0.0
