"""Pictures of a few high-fidelity solutions of a problem."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vibench.interfaces.outputs import Picture
from vibench.interfaces.validation import checked_picture
from vibench.plugins.plugin import Plugin
from vibench.results.pictures import members
from vibench.stages.artefacts import Store, storable
from vibench.stages.base import Result, Stage, build_problem, faults_of
from vibench.stages.snapshots import gather, solution_stages
from vibench.study.cells import Axes
from vibench.study.parameter_sets import OWN_TRAINING, ParameterSet
from vibench.text import one_line

storable(Picture)


@dataclass(frozen=True)
class PictureStage(Stage):
    """Pictures of a few training solutions of a problem."""

    label = "pictures"

    problem: Plugin
    training: ParameterSet = OWN_TRAINING

    @property
    def axes(self) -> Axes:
        # Without the training set: all pictures of a problem are those of one.
        return Axes(problem=self.problem)

    def inputs(self) -> tuple[Stage, ...]:
        return solution_stages(self.problem, self.training)

    def run(self, store: Store) -> Result:
        """Titles and pictures at the solutions nearest to the lower corner, centre and upper corner of the box."""
        problem, solutions = build_problem(self.problem), gather(store, self.inputs())
        box, pictures = problem.parameters, []
        unit = (solutions.mu - box.lower) / np.where(box.upper > box.lower, box.upper - box.lower, 1.0)
        nearest = (int(np.argmin(np.linalg.norm(unit - corner, axis=1))) for corner in (0.0, 0.5, 1.0))
        # Few training parameters may be nearest to several of these: draw each once.
        for k in dict.fromkeys(nearest):
            with faults_of(self.problem):
                picture = checked_picture(problem, solutions.mu[k], solutions.u[:, k], solutions.lam[:, k])
            if picture is not None:
                named = zip(box.names, solutions.mu[k], box.units, strict=True)
                texts = (f"{name} = {mu:.3g}" + f" {unit}" * (unit not in ("", "1")) for name, mu, unit in named)
                names: dict[str, Any] = {name: one_line(getattr(picture, name)) for name in members(arrays=False)}
                # Copy: the next picture may reuse the arrays.
                pictures.append((", ".join(texts), deepcopy(replace(picture, **names))))
        return Result(tuple(pictures))
