"""What becomes of a query."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """What became of a query, from good to bad; the order is the severity a cell inherits."""

    OK = "ok"
    INACCURATE = "inaccurate"
    NONFINITE = "nonfinite"
    INFEASIBLE = "infeasible"
    FAILED = "failed"
    TIMEOUT = "timeout"
    CRASHED = "crashed"
    ERROR = "error"
    UNAVAILABLE = "unavailable"

    @property
    def severity(self) -> int:
        """Position in the order above."""
        return list(Status).index(self)
