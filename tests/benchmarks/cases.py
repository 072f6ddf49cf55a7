"""What is timed: registered problems at resolutions, registered strategies, sizes of reduced programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop
from vibench.study import registry

Resolution = str | int
"""A name that a problem knows, or a number of nodes."""

TOLERANCES = (0.5, 0.1)
"""Tolerances of the primal strategies that take one."""


@dataclass(frozen=True)
class Case:
    """A registered problem at a resolution; `None` where it has no such option and is timed as it is."""

    problem: str
    resolution: Resolution | None

    def __str__(self) -> str:
        return self.problem if self.resolution is None else f"{self.problem}-{self.resolution}"

    @property
    def options(self) -> dict[str, Resolution]:
        """Options of the problem."""
        return {} if self.resolution is None else {"resolution": self.resolution}


@dataclass(frozen=True)
class Primal:
    """A registered primal strategy and its tolerance, `None` where it takes none."""

    name: str
    tolerance: float | None

    def __str__(self) -> str:
        return self.name if self.tolerance is None else f"{self.name}-{self.tolerance:g}"


@dataclass(frozen=True)
class Spaces:
    """Where V_N and the reduced cone of a registered dual strategy stop."""

    pod: Stop
    cone: Stop
    dual: str = "mcpg"


USUAL = Spaces(Stop(tolerance=1e-3), Stop(tolerance=1e-2))
"""Those of the study `quick`."""


@dataclass(frozen=True)
class Size:
    """A reduced program by what is prescribed of it; the enrichment adds to N."""

    case: Case
    N: int
    R: int

    def __str__(self) -> str:
        return f"{self.case}-N{self.N}-R{self.R}"

    @property
    def spaces(self) -> Spaces:
        """Spaces of these dimensions."""
        return Spaces(Stop(size=self.N), Stop(size=self.R))


ENRICHED = Primal("offline-pga", 0.5)
"""What completes the reduced models whose programs all QP solvers are timed on."""

SIZES = (
    *(Size(Case("obstacle", "medium"), N, R) for N, R in ((5, 5), (20, 10), (40, 30), (80, 50), (120, 70))),
    *(Size(Case("hertz", "medium"), N, R) for N, R in ((5, 5), (10, 12), (20, 30), (46, 60))),
)
"""Those of the obstacle problem are solved in N' unknowns; those of the Hertz problem through the dual, in R."""

ACCURACIES = (1e-6, 1e-10)
"""What the QP solvers are asked for."""


def problem_cases(problems: Sequence[str], wanted: Sequence[Resolution]) -> list[Case]:
    """Every problem at those of the resolutions that it knows; once, as it is, where it knows none of them."""
    found: list[Case] = []
    for name in problems:
        known = [Case(name, resolution) for resolution in wanted if knows(name, resolution)]
        found += known or [Case(name, None)]
    return found


def knows(problem: str, resolution: Resolution) -> bool:
    """Whether a problem has such a resolution; one that cannot be loaded has none."""
    try:
        registry.check_options("problem", problem, {"resolution": resolution})
    except RequestError:
        return False
    return True


def takes_no_option(problem: str) -> bool:
    """Whether a problem needs no option, as a folder; one that cannot be loaded counts, its case then fails."""
    try:
        return all(option.default for option in registry.options("problem", problem))
    except RequestError:
        return True


def primal_cases() -> list[Primal]:
    """Every registered primal strategy, at all `TOLERANCES` if it takes one."""
    return [Primal(name, tolerance) for name in registry.names("primal strategy") for tolerance in _tolerances(name)]


def _tolerances(primal: str) -> tuple[float | None, ...]:
    try:
        return TOLERANCES if registry.load("primal strategy", primal).takes_tolerance else (None,)
    except RequestError:  # its benchmarks fail, and say why
        return (None,)
