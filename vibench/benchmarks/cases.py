"""What benchmarks are made of: registered problems at resolutions, registered strategies, sizes of reduced programs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop
from vibench.plugins.kinds import DUAL, FORMULATION, PRIMAL, PROBLEM, SOLVER
from vibench.plugins.registry import find, find_named, registered
from vibench.qp.solve import installed_solvers
from vibench.study.matrix import read_study

Resolution = str | int
"""A name that a problem knows, or a number of nodes."""

TOLERANCES = (0.5, 0.1)
"""Tolerances of the primal strategies that take one."""


@dataclass(frozen=True)
class TimedProblem:
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
class PrimalChoice:
    """A registered primal strategy and its tolerance, `None` where it takes none."""

    name: str
    tolerance: float | None

    def __str__(self) -> str:
        return self.name if self.tolerance is None else f"{self.name}-{self.tolerance:g}"


@dataclass(frozen=True)
class ReducedSpaces:
    """Where V_N and the reduced cone of a registered dual strategy stop."""

    modes: Stop
    generators: Stop
    dual: str


@dataclass(frozen=True)
class Setting:
    """What completes a model of which one part is timed: the last strategies and first tolerances of a study."""

    problems: tuple[str, ...]
    spaces: ReducedSpaces
    """Where V_N and the cone stop, and the dual strategy."""
    primal: PrimalChoice
    seconds: float
    """Wall seconds that the study allows for a stage."""


def setting(study: str) -> Setting:
    """The setting of a study, by its name or file.

    Raises a `RequestError` if there is no such study.
    """
    spec = read_study(study)
    table, dual, primal = spec.tolerances[0], spec.dual[-1], spec.primal[-1]
    modes = Stop(tolerance=table.pod[0]) if table.pod else Stop(size=(table.N or [0])[0])
    spaces = ReducedSpaces(modes, table.of_dual(dual)[0], dual.name)
    problems = tuple(dict.fromkeys(entry.name for entry in spec.problem))
    chosen = PrimalChoice(primal.name, table.of_primal(primal)[0])
    return Setting(problems, spaces, chosen, spec.limits.cell_seconds)


@dataclass(frozen=True)
class Size:
    """A reduced program by what is prescribed of it; the enrichment adds to N."""

    N: int
    R: int

    def __str__(self) -> str:
        return f"N{self.N}-R{self.R}"


SIZES = (Size(5, 5), Size(10, 12), Size(20, 30), Size(46, 60), Size(80, 70))
"""The reduced programs that QP solvers are timed on, as far as the snapshots of a problem give them."""

ACCURACIES = (1e-6, 1e-10)
"""What the QP solvers are asked for."""


def at_resolutions(problem: str, wanted: Sequence[Resolution]) -> list[TimedProblem]:
    """A problem at those of the resolutions that it knows; once, as it is, where it knows none of them."""
    cases = [TimedProblem(problem, resolution) for resolution in wanted if knows(problem, resolution)]
    return cases or [TimedProblem(problem, None)]


def knows(problem: str, resolution: Resolution) -> bool:
    """Whether a problem has such a resolution; one that cannot be loaded has none."""
    try:
        find(PROBLEM, problem).check_options({"resolution": resolution})
    except RequestError:
        return False
    return True


def takes_no_option(problem: str) -> bool:
    """Whether a problem needs no option, as a folder; one that cannot be loaded counts, its case then fails."""
    try:
        return not any(option.required for option in find(PROBLEM, problem).options.values())
    except RequestError:
        return True


def at_tolerances(names: Iterable[str]) -> list[PrimalChoice]:
    """Primal strategies, at all `TOLERANCES` if they take one."""
    return [PrimalChoice(name, tolerance) for name in names for tolerance in _tolerances(name)]


def _tolerances(primal: str) -> tuple[float | None, ...]:
    try:
        return TOLERANCES if find(PRIMAL, primal).load().takes_tolerance else (None,)
    except RequestError:  # its benchmarks fail, and say why
        return (None,)


TIMED = {kind.cli_name: kind for kind in (PROBLEM, PRIMAL, DUAL, FORMULATION, SOLVER)}
"""Kinds of plugins that benchmarks time, by the word for each."""


def chosen_plugins(plugins: Sequence[str]) -> dict[str, list[str]]:
    """Names of plugins by the word for their kind, from names as `vibench list` shows them, or KIND:NAME.

    Raises a `RequestError` if there is no such plugin, several have the name, or a solver is not installed.
    """
    chosen, solvers = dict[str, list[str]](), installed_solvers(registered(SOLVER))
    for text in plugins:
        plugin = find_named(text, TIMED, solvers)
        if plugin.kind is PROBLEM and not takes_no_option(plugin.name):
            raise RequestError(f"the {plugin} needs options, which `vibench bench` has no place for")
        chosen.setdefault(plugin.kind.cli_name, []).append(plugin.name)
    return chosen


def resolutions(texts: Sequence[str]) -> list[Resolution]:
    """Resolutions from texts.

    Raises a `RequestError` for the first one that no problem has.
    """
    wanted: list[Resolution] = [int(text) if text.isdigit() else text for text in texts]
    for resolution in wanted:
        if not any(knows(problem, resolution) for problem in registered(PROBLEM)):
            raise RequestError(f"no problem has the resolution {str(resolution)!r}")
    return wanted
