"""Conformance checks for authors of plugins: what vibench assumes of problems, strategies, samplings and QP solvers.

In a test of a plugin's own package:

    def test_the_cable_conforms() -> None:
        vibench.testing.check_problem(Cable)

`check_…` raises one `ConformanceError` that lists every failure; `examine_…`, like the command `vibench check`, returns
the results. The first argument is a class, or a function that makes an instance such as `partial(Cable, nodes=20)`,
because two instances are compared. A QP solver is the function itself.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from vibench.testing.checks import SECONDS, CheckResult, ConformanceError, Verdict
from vibench.testing.duals import DUAL
from vibench.testing.formulations import FORMULATION
from vibench.testing.primals import PRIMAL
from vibench.testing.problems import PROBLEM
from vibench.testing.samples.sample_problem import MovingSupport, sample_offline, sample_reduction, sample_snapshots
from vibench.testing.samplings import SAMPLING
from vibench.testing.solvers import SOLVER

if TYPE_CHECKING:
    from vibench.testing.figures import FIGURE

    check_figure, examine_figure = FIGURE.check, FIGURE.examine

check_dual, examine_dual = DUAL.check, DUAL.examine
check_formulation, examine_formulation = FORMULATION.check, FORMULATION.examine
check_primal, examine_primal = PRIMAL.check, PRIMAL.examine
check_problem, examine_problem = PROBLEM.check, PROBLEM.examine
check_sampling, examine_sampling = SAMPLING.check, SAMPLING.examine
check_solver, examine_solver = SOLVER.check, SOLVER.examine

__all__ = [
    "SECONDS", "CheckResult", "ConformanceError", "MovingSupport", "Verdict", "check_dual", "check_figure",
    "check_formulation", "check_primal", "check_problem", "check_sampling", "check_solver", "examine_dual",
    "examine_figure", "examine_formulation", "examine_primal", "examine_problem", "examine_sampling", "examine_solver",
    "sample_offline", "sample_reduction", "sample_snapshots",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import the checks of figures when they are first asked for: they load pandas and matplotlib."""
    if name in ("check_figure", "examine_figure"):
        return getattr(import_module("vibench.testing.figures").FIGURE, name.removesuffix("_figure"))
    raise AttributeError(f"module 'vibench.testing' has no attribute {name!r}")
