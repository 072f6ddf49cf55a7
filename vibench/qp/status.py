"""The status of a query."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """Status of a query, by increasing severity; a cell has the most severe one of its queries."""

    OK = "ok"
    INACCURATE = "inaccurate"
    NONFINITE = "nonfinite"
    INFEASIBLE = "infeasible"
    REFUTED = "refuted"
    FAILED = "failed"
    TIMEOUT = "timeout"
    CRASHED = "crashed"
    ERROR = "error"
    UNAVAILABLE = "unavailable"

    @property
    def severity(self) -> int:
        """Position in the order above."""
        return list(Status).index(self)
