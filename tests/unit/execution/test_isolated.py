from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from samples import SOLVERS_OF_TESTS

from vibench import Status, solve_qp
from vibench.cli.doctor import wire
from vibench.execution.isolated import Trial, solver_trials
from vibench.plugins import registry


def attempts(solvers: Sequence[str], seconds: float = 60.0) -> dict[str, Trial]:
    return solver_trials(wire(), 1e-7, solvers, seconds)


@pytest.fixture
def _fakes(plugins_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(plugins_folder))
    registry.registered.cache_clear()
    yield
    registry.registered.cache_clear()


def test_the_program_has_constraints_of_both_sorts_and_is_solved() -> None:
    program = wire()
    free = np.linalg.solve(program.A, program.f)
    assert np.any(program.B @ free > program.g)
    answer = solve_qp(program, "piqp", 1e-7)
    assert answer.x is not None
    active = np.abs(program.B @ answer.x - program.g) < 1e-6 * program.g
    assert 0 < active.sum() < 12
    found = attempts(SOLVERS_OF_TESTS)
    assert tuple(found) == SOLVERS_OF_TESTS
    for trial in found.values():
        assert (trial.status, trial.reason) == (Status.OK, "")
        assert 0.0 < trial.residuals.worst <= 1e-7
        assert trial.seconds.cpu > 0.0


@pytest.mark.usefixtures("_fakes")
def test_what_goes_wrong_is_said_and_costs_nobody_else_a_trial() -> None:
    found = attempts(["wrong", "raises", "leaves", "segfaults", "careful", "dies", "chatty"])
    assert list(found) == ["wrong", "raises", "leaves", "segfaults", "careful", "dies", "chatty"]
    assert {name: trial.status for name, trial in found.items()} == {
        "wrong": Status.INACCURATE, "raises": Status.FAILED, "leaves": Status.ERROR, "segfaults": Status.CRASHED,
        "careful": Status.OK, "dies": Status.CRASHED, "chatty": Status.OK,
    }  # fmt: skip
    assert found["raises"].reason == "the solver returned nothing: RuntimeError: the solver gave in"
    assert "SystemExit" in found["leaves"].reason
    assert "7" in found["dies"].reason
    assert found["wrong"].residuals.worst > 1e-7
    found = attempts(["hangs", "piqp"], seconds=1.0)
    assert (found["hangs"].status, found["hangs"].solution) == (Status.TIMEOUT, None)
    assert "1 s" in found["hangs"].reason
    assert found["piqp"].status is Status.OK
