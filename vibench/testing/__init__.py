"""Conformance checks for authors of plugins: every property that vibench assumes of a problem or a strategy.

In a test of a plugin's own package:

    def test_the_cable_conforms() -> None:
        vibench.testing.check_problem(Cable)

`check_…` raises one `ConformanceError` that lists every failure; `examine_…`, like the command `vibench check`, returns
the findings. The first argument is a class, or a function that makes an instance such as `partial(Cable, nodes=20)`,
because two instances are compared.
"""

from __future__ import annotations

from vibench.testing.checks import SECONDS, ConformanceError, Finding, Verdict
from vibench.testing.duals import check_dual, examine_dual
from vibench.testing.primals import check_primal, examine_primal
from vibench.testing.problems import check_problem, examine_problem
from vibench.testing.sample import MovingSupport, sample_offline, sample_snapshots

__all__ = [
    "SECONDS", "ConformanceError", "Finding", "MovingSupport", "Verdict", "check_dual", "check_primal", "check_problem",
    "examine_dual", "examine_primal", "examine_problem", "sample_offline", "sample_snapshots",
]  # fmt: skip
