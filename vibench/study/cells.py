"""The cells of a matrix, each identified by what determines its numbers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from vibench.errors import RequestError, unknown_name
from vibench.interfaces.strategies import Stop
from vibench.model.bound_terms import CorrectionMode
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import default_formulation, find
from vibench.provenance import numerical_code
from vibench.study.parameter_sets import OWN, OWN_TRAINING, ParameterSet


def digest(content: Any) -> str:
    """Short hash of JSON content, independent of the order of keys."""
    # Canonical: no order of keys, no blanks, no characters that depend on an encoding.
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# Entry of tables on an axis that the formulation of a cell does not have.
NO_SUCH_AXIS = "–"


@dataclass(frozen=True)
class Axes:
    """Values on the axes of a study; `None` on an axis that does not matter."""

    problem: Plugin | None = None
    dual: Plugin | None = None
    primal: Plugin | None = None
    pod: Stop | None = None
    cone: Stop | None = None
    primal_tol: float | None = None
    training: ParameterSet | None = None


@dataclass(frozen=True)
class Cell:
    """A problem, strategies, tolerances, a QP solver, and how queries are assembled and corrected."""

    # `interpolation` is the tolerance of reduced assembly, `None` for full assembly; `bounds` need the former. What the
    # `formulation` does not use is `None`. `labels` of problem, dual and primal strategy are no part of the identity,
    # nor are those of the parameter sets; nor are `nested_tolerances`, all tolerances of a nested primal strategy in
    # the study, whose enrichments are stages of one.

    problem: Plugin
    dual: Plugin | None
    primal: Plugin | None
    pod: Stop | None
    cone: Stop | None
    primal_tol: float | None
    solver: str | None
    assembly: str
    interpolation: float | None
    warm_start: bool
    accuracy: float | None
    validation: ParameterSet
    labels: tuple[str, str, str]
    formulation: Plugin
    nested_tolerances: tuple[float, ...] = ()
    training: ParameterSet = OWN_TRAINING
    bounds: bool = False
    correction: str = CorrectionMode.NONE.value
    formulation_label: str = ""

    @cached_property
    def key(self) -> str:
        """Hash of everything that determines the numbers of the cell except for the code."""
        content = self._content()
        # Labels and places change no number, and the code is compared by itself.
        del content["labels"], content["nested_tolerances"], content["set_labels"], content["formulation_label"]
        for name in ("dual", "primal", "training", "validation_sampling"):
            if content[name] is None:
                del content[name]
        for part in content.values():
            if isinstance(part, dict) and "code" in part:
                del part["code"], part["places"]
        return digest(content)

    @property
    def definition(self) -> str:
        """The cell as JSON, which `from_definition` reads."""
        return json.dumps(self._content(), sort_keys=True, ensure_ascii=False)

    def _content(self) -> dict[str, Any]:
        """The cell as stored in results files, where five entries describe its parameter sets."""
        content = asdict(self)
        training, validation = content.pop("training"), content.pop("validation")
        # Keys of cells without correction are those from before there was a choice.
        if self.correction == CorrectionMode.NONE:
            del content["correction"]
        if self.training.skips:
            content["training_skips"] = True
        return content | {
            "seed": validation["seed"], "validation": validation["count"], "training": training["sampling"],
            "validation_sampling": validation["sampling"], "set_labels": (training["label"], validation["label"]),
        }  # fmt: skip

    @classmethod
    def from_definition(cls, text: str, places: Mapping[str, str] = {}) -> Cell:
        """The cell of a definition, with the code of its plugins as installed, and new `places` of files by name."""
        content = json.loads(text)
        recorded = ((name, part) for name, part in content.items() if isinstance(part, dict) and "code" in part)
        plugins = {name: Plugin(**part) for name, part in recorded}
        known = {name for one in plugins.values() if places for name in one.paths.values()}
        for name in sorted(places.keys() - known):
            raise unknown_name("file or folder of the cell", name, known)
        # In the committed results `mixed` and `compiled` were no plugins, and these were assemblies.
        if content.get("formulation") is None:
            name = "compiled" if content["assembly"] == "compiled" else default_formulation()
            plugins["formulation"] = Plugin.of(find(PluginKind.FORMULATION, name), {}, {})
            content["formulation_label"] = name
        if content["assembly"] in ("certified", "compiled"):
            content["bounds"], content["assembly"] = content["assembly"] == "certified", "reduced"
        # The problem first: its error is the one to mend.
        for name in sorted(plugins, key=lambda name: name != "problem"):
            content[name] = _installed(plugins[name].moved(places))
        for axis in ("pod", "cone"):
            content[axis] = None if content[axis] is None else Stop(**content[axis])
        for name in ("labels", "nested_tolerances"):
            content[name] = tuple(content.get(name, ()))
        trained, validated = content.pop("set_labels", (OWN, OWN))
        skips = content.pop("training_skips", False)
        content["training"] = ParameterSet("training", 0, 0, content.get("training"), trained, skips)
        count, seed, sampling = (content.pop(name, None) for name in ("validation", "seed", "validation_sampling"))
        return cls(**content | {"validation": ParameterSet("validation", count, seed, sampling, validated)})

    @property
    def axes(self) -> Axes:
        return Axes(self.problem, self.dual, self.primal, self.pod, self.cone, self.primal_tol, self.training)

    @property
    def plugins(self) -> tuple[Plugin, ...]:
        """All plugins but the solver."""
        samplings = (one.sampling for one in (self.training, self.validation) if one.sampling is not None)
        chosen = (one for one in (self.dual, self.primal) if one is not None)
        return (self.problem, *chosen, self.formulation, *samplings)

    @property
    def code(self) -> str:
        """Hash of the code that computes the cell: of vibench, its plugins and its solver."""
        codes = [plugin.code for plugin in self.plugins]
        codes += [] if self.solver is None else [find(PluginKind.SOLVER, self.solver).code]
        return digest([numerical_code(), *codes])

    def __str__(self) -> str:
        problem, dual, primal = self.labels
        problem += f" ({self.training.label})" if self.training.sampling is not None else ""
        tolerance = "" if self.primal_tol is None else f" {self.primal_tol:g}"
        given = [(size, stop) for size, stop in (("N", self.pod), ("R", self.cone)) if stop is not None]
        stops = [f"{size}={one.size}" if one.tolerance is None else f"{one.tolerance:g}" for size, one in given]
        accuracy = "" if self.accuracy is None else f"{self.accuracy:g}"
        formulation = "" if self.formulation_label == default_formulation() else self.formulation_label
        cone, enriched = "" if self.dual is None else dual, "" if self.primal is None else f"{primal}{tolerance}"
        solver = " ".join(filter(None, [self.solver, accuracy]))
        way = "" if self.assembly == "full" else f"{self.assembly}{' with bounds' * self.bounds}"
        corrected = "" if self.correction == CorrectionMode.NONE else f"corrected: {self.correction}"
        parts = (problem, formulation, cone, enriched, ", ".join(stops), solver, way, corrected)
        return " · ".join(filter(None, parts))


def _installed(plugin: Plugin) -> Plugin:
    """A recorded plugin with the installed code; an error about its files names the option for their new place."""
    try:
        return plugin.as_installed()
    except RequestError as error:
        if plugin.registered.entries and plugin.paths:
            name = next(iter(plugin.paths.values()))
            raise RequestError(f"{error}; if it was moved, say where it is now: --at {name}=PATH") from None
        raise
