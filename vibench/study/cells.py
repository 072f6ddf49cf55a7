"""The matrix of a study: its cells, each identified by what determines its numbers."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop
from vibench.provenance import NUMERICAL, core_code, solver_version
from vibench.reduction.nested import NestedStrategy
from vibench.study import registry
from vibench.study.parameter_sets import size_of_set

if TYPE_CHECKING:  # worker processes have no use for the schema of study files
    from vibench.study.entries import Entry, ProblemEntry
    from vibench.study.spec import Study, ToleranceTable


def digest(content: Any) -> str:
    """Short hash of JSON content, independent of the order of keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Plugin:
    """A plugin with its options as canonical JSON, and the version of its code and data (`registry.code_and_data`)."""

    kind: str
    name: str
    options: str
    code: str

    @classmethod
    def from_entry(cls, kind: str, entry: Entry) -> Plugin:
        """Plugin of an entry of an axis."""
        options = registry.canonical_options(kind, entry.name, entry.options)
        return cls(kind, entry.name, options, "").as_installed()

    def as_installed(self) -> Plugin:
        """The same with the version of the code that is installed, and of the files its options name, now.

        Raises
        ------
        RequestError
            If it is not installed, or one of its files cannot be read.
        """
        return replace(self, code=registry.code_and_data(self.kind, self.name, json.loads(self.options)))

    def create(self) -> Any:
        """A new instance."""
        return registry.create(self.kind, self.name, json.loads(self.options))

    @property
    def check(self) -> str:
        """The command that checks the plugin with these options."""
        word = next(word for word, kind in registry.WORDS.items() if kind == self.kind)
        options = (f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in json.loads(self.options).items())
        return shlex.join(["vibench", "check", f"{word}:{self.name}", *(f"--option={text}" for text in options)])


PLUGINS = ("problem", "dual", "primal", "training", "validation_sampling")
"""Fields of a `Cell` that are plugins; the last two are `None` for sets of the problem itself."""

OWN = "own"
"""Name of the training and the validation set that a problem itself has."""

CERTIFIED = "certified"
"""Assembly of queries that are assembled as reduced ones, and have certificates."""


@dataclass(frozen=True)
class Axes:
    """Values on the axes of a study; `None` on an axis that does not matter.

    `training` holds the sampling strategy of the training set, which is `None` for the problem's own set, and nothing
    where that axis does not matter.
    """

    problem: Plugin | None = None
    dual: Plugin | None = None
    primal: Plugin | None = None
    pod: Stop | None = None
    cone: Stop | None = None
    primal_tol: float | None = None
    training: tuple[Plugin | None, ...] = ()


@dataclass(frozen=True)
class Cell:
    """One cell: problem × training set × dual × primal strategy × tolerances × QP solver × accuracy × assembly.

    `training` and `validation_sampling` are the sampling strategies of its sets, `None` for the problem's own ones;
    `validation` is the number of validation parameters. `interpolation` is the tolerance of reduced assembly, `None`
    for full assembly; certified queries are assembled as reduced ones. `labels` of problem, dual and primal strategy
    and `set_labels` of training and validation are no part of the identity; nor are `nested_tolerances`, all tolerances
    of a nested primal strategy in the study, whose enrichments are stages of one.
    """

    problem: Plugin
    dual: Plugin
    primal: Plugin
    pod: Stop
    cone: Stop
    primal_tol: float | None
    solver: str
    assembly: str
    interpolation: float | None
    warm_start: bool
    seed: int
    validation: int
    accuracy: float
    labels: tuple[str, str, str]
    nested_tolerances: tuple[float, ...] = ()
    training: Plugin | None = None
    validation_sampling: Plugin | None = None
    set_labels: tuple[str, str] = (OWN, OWN)

    @cached_property
    def key(self) -> str:
        """Hash of everything but the code that determines the cell's numbers."""
        content = asdict(self)
        del content["labels"], content["nested_tolerances"], content["set_labels"]
        for name in PLUGINS:
            if content[name] is None:
                del content[name]
            else:
                del content[name]["code"]
        return digest(content)

    @property
    def definition(self) -> str:
        """The cell as JSON, which `from_definition` reads."""
        return json.dumps(asdict(self), sort_keys=True, ensure_ascii=False)

    @classmethod
    def from_definition(cls, text: str) -> Cell:
        """The cell of a definition, with the code of its plugins as installed.

        Raises
        ------
        RequestError
            If a plugin is not installed, or a file that its options name cannot be read.
        """
        content = json.loads(text)
        for name in PLUGINS:  # older definitions have no sampling strategies
            content[name] = Plugin(**content[name]).as_installed() if content.get(name) else None
        for axis in ("pod", "cone"):
            content[axis] = Stop(**content[axis])
        labels = ("labels", "nested_tolerances", "set_labels")
        return cls(**content | {name: tuple(content[name]) for name in labels if name in content})

    @property
    def axes(self) -> Axes:
        """The axes of the cell, without solver and assembly."""
        return Axes(self.problem, self.dual, self.primal, self.pod, self.cone, self.primal_tol, (self.training,))

    @property
    def plugins(self) -> tuple[Plugin, ...]:
        """Its plugins, the solver aside."""
        return tuple(found for name in PLUGINS if (found := getattr(self, name)) is not None)

    @property
    def code(self) -> str:
        """Hash of the code that computes the cell: the numerical rooms of the core, its plugins and its solver."""
        plugins_used = [plugin.code for plugin in self.plugins]
        registered = self.solver in registry.names("QP solver")
        solver = registry.code("QP solver", self.solver) if registered else solver_version(self.solver)
        return digest([core_code(*NUMERICAL), *plugins_used, solver])

    def __str__(self) -> str:
        problem, dual, primal = self.labels
        problem += f" ({self.set_labels[0]})" if self.training is not None else ""
        tolerance = "" if self.primal_tol is None else f" {self.primal_tol:g}"
        pod, cone = (
            f"{size}={stop.size}" if stop.tolerance is None else f"{stop.tolerance:g}"
            for size, stop in (("N", self.pod), ("R", self.cone))
        )
        assembly = "" if self.assembly == "full" else f" · {self.assembly}"
        return f"{problem} · {dual} · {primal}{tolerance} · {pod}, {cone} · {self.solver} {self.accuracy:g}{assembly}"


def expand(study: Study) -> list[Cell]:
    """All cells of a study without duplicates, in the order of its axes.

    Raises
    ------
    RequestError
        If the matrix is empty, or a strategy that takes a tolerance has none.
    """
    cells: dict[str, Cell] = {}
    for problem, table in product(study.problem, study.tolerances):
        nested = {entry.title: _nested_tolerances(entry, table) for entry in study.primal}
        sets = _sets(study, problem)
        for trained, (dual, pod, cone, primal, tolerance) in product(sets, _combinations(study, table)):
            for assembly, solver, accuracy in product(study.assembly, study.solver_names(), study.accuracy):
                cell = Cell(
                    problem=Plugin.from_entry("problem", problem),
                    dual=Plugin.from_entry("dual strategy", dual),
                    primal=Plugin.from_entry("primal strategy", primal),
                    pod=pod,
                    cone=cone,
                    primal_tol=tolerance,
                    solver=solver,
                    assembly=assembly,
                    interpolation=None if assembly == "full" else study.interpolation,
                    warm_start=study.warm_start,
                    seed=study.seed,
                    accuracy=accuracy,
                    labels=(problem.title, dual.title, primal.title),
                    nested_tolerances=nested[primal.title],
                    validation=trained.validation,
                    training=trained.training,
                    validation_sampling=trained.validation_sampling,
                    set_labels=trained.labels,
                )
                cells.setdefault(cell.key, cell)
    if not cells:
        raise RequestError(f"study '{study.name}': the matrix is empty")
    return list(cells.values())


@dataclass(frozen=True)
class _Sets:
    """A training set and the validation set of a problem, as in the fields of a `Cell`."""

    training: Plugin | None
    validation: int
    validation_sampling: Plugin | None
    labels: tuple[str, str]


def _sets(study: Study, problem: ProblemEntry) -> list[_Sets]:
    """The training sets of a problem in a study, each with the validation set."""
    built, asked = Plugin.from_entry("problem", problem), study.validation_of(problem)
    if isinstance(asked, int):
        count, checked, label = asked, None, OWN
    else:
        checked, label = Plugin.from_entry("sampling strategy", asked), asked.title
        count = size_of_set(built, checked)
    return [
        _Sets(
            None if entry.name == OWN else Plugin.from_entry("sampling strategy", entry),
            count,
            checked,
            (entry.title, label),
        )
        for entry in study.training_of(problem)
    ]


def _nested_tolerances(primal: Entry, table: ToleranceTable) -> tuple[float, ...]:
    kind = "primal strategy"
    if registry.conflict(kind, primal.name) or not issubclass(registry.load(kind, primal.name), NestedStrategy):
        return ()
    return tuple(sorted({value for value in table.of_primal(primal) if value is not None}, reverse=True))


def _combinations(study: Study, table: ToleranceTable) -> Iterator[tuple[Entry, Stop, Stop, Entry, float | None]]:
    pods = [Stop(tolerance=value) for value in table.pod or []] + [Stop(size=value) for value in table.N or []]
    for pod, dual, primal in product(pods, study.dual, study.primal):
        for cone, tolerance in product(table.of_dual(dual), table.of_primal(primal)):
            yield dual, pod, cone, primal, tolerance
