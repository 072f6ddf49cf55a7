"""The cells of a matrix, each identified by what determines its numbers."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from vibench.interfaces.strategies import Stop
from vibench.provenance import NUMERICAL, core_code, solver_version
from vibench.study import registry
from vibench.study.plugin import Plugin
from vibench.study.values import OWN


def digest(content: Any) -> str:
    """Short hash of JSON content, independent of the order of keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


PLUGINS = ("problem", "dual", "primal", "training", "validation_sampling")
"""Fields of a `Cell` that are plugins; the last two are `None` for sets of the problem itself."""


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
