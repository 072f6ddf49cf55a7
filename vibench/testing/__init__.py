"""Conformance checks for authors of plugins: what vibench assumes of problems, strategies, samplings and QP solvers.

In a test of a plugin's own package:

    def test_the_cable_conforms() -> None:
        vibench.testing.check_problem(Cable)

`check_…` raises one `ConformanceError` that lists every failure; `examine_…`, like the command `vibench check`, returns
the findings. The first argument is a class, or a function that makes an instance such as `partial(Cable, nodes=20)`,
because two instances are compared. A QP solver is the function itself.
"""

from __future__ import annotations

from vibench.testing.checks import SECONDS, ConformanceError, Finding, Verdict
from vibench.testing.duals import check_dual, examine_dual
from vibench.testing.figures import check_figure, examine_figure
from vibench.testing.primals import check_primal, examine_primal
from vibench.testing.problems import check_problem, examine_problem
from vibench.testing.samples.model import MovingSupport, sample_offline, sample_snapshots
from vibench.testing.samplings import check_sampling, examine_sampling
from vibench.testing.solvers import check_solver, examine_solver

__all__ = [
    "SECONDS", "ConformanceError", "Finding", "MovingSupport", "Verdict", "check_dual", "check_figure", "check_primal",
    "check_problem", "check_sampling", "check_solver", "examine_dual", "examine_figure", "examine_primal",
    "examine_problem", "examine_sampling",
    "examine_solver", "sample_offline", "sample_snapshots",
]  # fmt: skip
