"""Conformance checks for authors of plugins: what vibench assumes of problems, strategies, samplings and QP solvers.

In a test of a plugin's own package:

    @vibench.testing.parametrize_with_checks(Cable)
    def test_the_cable_conforms(check):
        check()

The argument is a class, or a function that makes an instance such as `partial(Cable, nodes=20)`, because two instances
are compared; a QP solver is the function itself. `check` makes all checks at once and raises one `ConformanceError`
that lists every failure; `examine`, like the command `vibench check`, returns the results.
"""

from vibench.offline.sample_problem import MovingSupport, sample_offline, sample_reduction, sample_snapshots
from vibench.testing.checks import (
    SECONDS,
    CheckResult,
    ConformanceError,
    ConformanceWarning,
    Examination,
    Verdict,
    check,
    examine,
    parametrize_with_checks,
)

__all__ = [
    "SECONDS", "CheckResult", "ConformanceError", "ConformanceWarning", "Examination", "MovingSupport", "Verdict",
    "check", "examine", "parametrize_with_checks", "sample_offline", "sample_reduction", "sample_snapshots",
]  # fmt: skip
