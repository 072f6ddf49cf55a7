"""Benchmarks of plugins by pytest-benchmark: problems at resolutions, strategies, sizes of reduced programs."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from itertools import product
from typing import Any, NamedTuple

from vibench.errors import RequestError, VibenchError
from vibench.execution.supervisor import manner_of_death
from vibench.guardian import guarded, new_environment
from vibench.interfaces.strategies import Stop
from vibench.plugins.kinds import CHECKED, PluginKind
from vibench.plugins.registry import find, find_named, registered
from vibench.qp.solve import installed_solvers
from vibench.study.matrix import read_study

Resolution = str | int  # a name that a problem knows, or a number of nodes
Timing = Callable[..., None]  # the fixture `timing`: see `vibench.benchmarks.plugin`


class TimedProblem(NamedTuple):
    """A registered problem at a resolution; `None` where it has no such option and is timed as it is."""

    problem: str
    resolution: Resolution | None

    def __str__(self) -> str:
        return self.problem if self.resolution is None else f"{self.problem}-{self.resolution}"


class PrimalChoice(NamedTuple):
    """A registered primal strategy and its tolerance, `None` where it takes none."""

    name: str
    tolerance: float | None

    def __str__(self) -> str:
        return self.name if self.tolerance is None else f"{self.name}-{self.tolerance:g}"


class ReducedSpaces(NamedTuple):
    """Where V_N and the reduced cone of a registered dual strategy stop."""

    modes: Stop
    generators: Stop
    dual: str


class Size(NamedTuple):
    """A reduced program by its prescribed dimensions; the enrichment adds to N."""

    N: int
    R: int

    def __str__(self) -> str:
        return f"N{self.N}-R{self.R}"


class Setting(NamedTuple):
    """Strategies and tolerances that complete a model of which one part is timed; `seconds` is the limit of a stage."""

    problems: tuple[str, ...]
    spaces: ReducedSpaces
    primal: PrimalChoice
    seconds: float


def setting(study: str) -> Setting:
    """Return the last strategies and first tolerances of a study, by its name or file, or raise a `RequestError`."""
    spec = read_study(study)
    table, dual, primal = spec.tolerances[0], spec.dual[-1], spec.primal[-1]
    modes = Stop(tolerance=table.pod[0]) if table.pod else Stop(size=(table.N or [0])[0])
    spaces = ReducedSpaces(modes, table.of_dual(dual)[0], dual.name)
    problems = tuple(dict.fromkeys(entry.name for entry in spec.problem))
    return Setting(problems, spaces, PrimalChoice(primal.name, table.of_primal(primal)[0]), spec.limits.cell_seconds)


def chosen_plugins(plugins: Sequence[str]) -> dict[str, list[str]]:
    """Group names of plugins, as `vibench list` shows them, or KIND:NAME, by kind; a `RequestError` refuses others."""
    # Samplings and studies are no part of what is timed.
    kinds = {word: kind for word, kind in CHECKED.items() if kind is not PluginKind.SAMPLING}
    chosen, solvers = dict[str, list[str]](), installed_solvers(registered(PluginKind.SOLVER))
    for text in plugins:
        plugin = find_named(text, kinds, solvers)
        if plugin.kind is PluginKind.PROBLEM and not _takes_no_option(plugin.name):
            raise RequestError(f"the {plugin} needs options, which `vibench bench` has no place for")
        chosen.setdefault(plugin.kind.cli_name, []).append(plugin.name)
    return chosen


def resolutions(texts: Sequence[str]) -> list[Resolution]:
    """Read resolutions; raises a `RequestError` for the first one that no problem has."""
    wanted: list[Resolution] = [int(text) if text.isdigit() else text for text in texts]
    for resolution in wanted:
        if not any(_knows(problem, resolution) for problem in registered(PluginKind.PROBLEM)):
            raise RequestError(f"no problem has the resolution {str(resolution)!r}")
    return wanted


def cases(
    axes: Sequence[str], chosen: Mapping[str, Sequence[str]], resolutions: Sequence[Resolution], setting: Setting
) -> list[tuple[TimedProblem, *tuple[Any, ...]]]:
    """Problems and choices of a benchmark with these axes, if a chosen plugin takes part; all where none is chosen."""
    if chosen and not chosen.keys() & {"problem", *axes}:
        return []
    # Whoever names a plugin waits for it: two problems of a study are enough then, and QP solvers use one resolution.
    every = setting.problems if chosen else filter(_takes_no_option, registered(PluginKind.PROBLEM))
    timed = []
    for name in chosen.get("problem", every):
        known = [TimedProblem(name, one) for one in resolutions if _knows(name, one)]
        timed += (known or [TimedProblem(name, None)])[: 1 if "size" in axes else None]
    return list(product(timed, *(_choices(axis, chosen) for axis in axes)))


def _choices(axis: str, chosen: Mapping[str, Sequence[str]]) -> Iterable[Any]:
    """The sizes and accuracies of programs, and the plugins that are chosen, or registered."""
    if axis == "size":
        return [Size(5, 5), Size(10, 12), Size(20, 30), Size(46, 60), Size(80, 70)]
    if axis == "accuracy":
        return [1e-6, 1e-10]
    own = registered(CHECKED[axis])
    names = chosen.get(axis, installed_solvers(own) if axis == "solver" else own)
    return [one for name in names for one in _at_tolerances(name)] if axis == "primal" else names


def run_pytest(options: Sequence[str]) -> None:
    """Run the benchmarks by pytest with options of `vibench.benchmarks.plugin` in a process of its own."""
    folder = str(files("vibench.benchmarks"))
    arguments = ["-c", f"{folder}/pytest.ini", "--rootdir", folder, "-p", "pytest_benchmark.plugin"]
    arguments += ["-p", "no:terminal", "--benchmark-quiet", "--progress", *options, f"{folder}/stages.py"]
    # Nothing but these options counts: neither those nor the plugins that somebody else's tests have.
    environment = {name: value for name, value in new_environment().items() if not name.startswith("PYTEST_")}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    process = guarded("pytest", *arguments, environment=environment)
    done = subprocess.run(**process, stdout=subprocess.DEVNULL, check=False)
    if done.returncode not in (0, 1, 5):  # passed, some failed, there are none
        raise VibenchError(f"the process of the benchmarks failed with {manner_of_death(done.returncode)}")


def _knows(problem: str, resolution: Resolution) -> bool:
    """Return if a problem has such a resolution; one that cannot be loaded has none."""
    try:
        find(PluginKind.PROBLEM, problem).check_options({"resolution": resolution})
    except RequestError:
        return False
    return True


def _takes_no_option(problem: str) -> bool:
    """Return if a problem needs no option, as a folder; one that cannot be loaded counts: its benchmarks then fail."""
    try:
        return not any(option.required for option in find(PluginKind.PROBLEM, problem).options.values())
    except RequestError:
        return True


def _at_tolerances(primal: str) -> list[PrimalChoice]:
    try:
        tolerances = (0.5, 0.1) if find(PluginKind.PRIMAL, primal).load().takes_tolerance else (None,)
    except RequestError:  # its benchmarks fail, and say why
        tolerances = (None,)
    return [PrimalChoice(primal, tolerance) for tolerance in tolerances]
