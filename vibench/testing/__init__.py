"""Conformance checks for authors of plugins: what vibench assumes of problems, strategies, samplings and QP solvers.

In a test of a plugin's own package:

    def test_the_cable_conforms() -> None:
        vibench.testing.check_problem(Cable)

`check_…` raises one `ConformanceError` that lists every failure; `examine_…`, like the command `vibench check`, returns
the results. The first argument is a class, or a function that makes an instance such as `partial(Cable, nodes=20)`,
because two instances are compared. A QP solver is the function itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vibench.testing.checks import SECONDS, CheckResult, Conformance, ConformanceError, Verdict
from vibench.testing.duals import DUAL
from vibench.testing.figures import FIGURE
from vibench.testing.primals import PRIMAL
from vibench.testing.problems import PROBLEM
from vibench.testing.sample_problem import MovingSupport, sample_offline, sample_snapshots
from vibench.testing.samplings import SAMPLING
from vibench.testing.solvers import SOLVER

KINDS: Mapping[str, Conformance[..., Any]] = {
    one.kind: one for one in (PROBLEM, DUAL, PRIMAL, SAMPLING, SOLVER, FIGURE)
}
"""The checks of every kind of plugins, by its word on the command line."""

check_dual, examine_dual = DUAL.check, DUAL.examine
check_figure, examine_figure = FIGURE.check, FIGURE.examine
check_primal, examine_primal = PRIMAL.check, PRIMAL.examine
check_problem, examine_problem = PROBLEM.check, PROBLEM.examine
check_sampling, examine_sampling = SAMPLING.check, SAMPLING.examine
check_solver, examine_solver = SOLVER.check, SOLVER.examine

__all__ = [
    "KINDS", "SECONDS", "CheckResult", "ConformanceError", "MovingSupport", "Verdict", "check_dual", "check_figure",
    "check_primal", "check_problem", "check_sampling", "check_solver", "examine_dual", "examine_figure",
    "examine_primal", "examine_problem", "examine_sampling", "examine_solver", "sample_offline", "sample_snapshots",
]  # fmt: skip
