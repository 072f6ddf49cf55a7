from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from vibench.interfaces.problem import VariationalInequality
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers, solve_qp


@pytest.mark.parametrize("solver", sorted(SETTINGS))
def test_a_tighter_accuracy_never_asks_for_less(solver: str) -> None:
    loose, tight = SETTINGS[solver].at(1e-4), SETTINGS[solver].at(1e-8)
    assert loose.keys() == tight.keys()
    for key, value in tight.items():
        if isinstance(value, float) and not isinstance(loose[key], bool):
            assert value <= loose[key]


@pytest.mark.parametrize("solver", sorted(set(SETTINGS) & set(installed_solvers())))
def test_settings_are_words_the_installed_solver_understands(solver: str) -> None:
    vi = VariationalInequality(np.eye(2), np.ones(2), np.array([[1.0, 1.0]]), np.array([1.0]))
    answer = solve_qp(vi, solver, 1e-6)
    assert np.allclose(answer.x, 0.5, atol=1e-4)
    assert np.allclose(answer.alpha, 0.5, atol=1e-4)
    assert answer.solver_status


def test_reports_are_found_wherever_a_solver_leaves_them() -> None:
    info = SimpleNamespace(status="fine", iter=np.array([7, 0]))
    solution = SimpleNamespace(extras={"info": info, "iterations": np.array([7, 0])}, found=True)
    assert SETTINGS["osqp"].report(solution) == ("fine", 7)
    assert SETTINGS["quadprog"].report(solution) == ("found", 7)
    assert SETTINGS["highs"].report(SimpleNamespace(extras={}, found=False)) == ("not found", None)
