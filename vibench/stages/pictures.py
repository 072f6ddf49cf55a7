"""Pictures of a few high-fidelity solutions of a problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vibench.errors import NumericalError
from vibench.interfaces.outputs import Picture
from vibench.plugins.plugin import Plugin
from vibench.results.pictures import members
from vibench.stages.artefacts import Store, storable
from vibench.stages.base import Result, Stage, build_problem
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
            picture = problem.picture(solutions.mu[k], solutions.u[:, k], solutions.lam[:, k])
            if picture is not None:
                named = zip(box.names, solutions.mu[k], box.units, strict=True)
                texts = (f"{name} = {mu:.3g}" + f" {unit}" * (unit not in ("", "1")) for name, mu, unit in named)
                pictures.append((", ".join(texts), _checked(picture)))
        return Result(tuple(pictures))


def _checked(picture: Picture) -> Picture:
    """A picture whose arrays hold real numbers and fit together, and whose names are texts."""
    mistyped = [name for name in members(arrays=True) if getattr(picture, name).dtype.kind not in "fiu"]
    mistyped += [name for name in members(arrays=False) if not isinstance(getattr(picture, name), str)]
    if mistyped:
        raise NumericalError(f"the problem's picture has {' and '.join(mistyped)} of the wrong type")
    points, corners, positions = picture.points, picture.triangles, picture.positions
    count = points.shape[-1]
    mesh = corners.shape[0] == 3 and bool(np.all((corners >= 0) & (corners < count)))
    fits = {
        "points": points.ndim == 2 and len(points) in (1, 2), "triangles": len(points) == 1 or mesh,
        "values": picture.values.shape == (count,), "positions": positions.ndim == 2 and len(positions) in (1, 2),
        "multiplier": picture.multiplier.shape == positions.shape[-1:],
    }  # fmt: skip
    wrong = [name for name, right in fits.items() if not right]
    if wrong:
        raise NumericalError(f"the problem's picture has {' and '.join(wrong)} of the wrong shape")
    # Copy: the next picture may reuse the arrays.
    own: dict[str, Any] = {name: getattr(picture, name).copy() for name in members(arrays=True)}
    return replace(picture, **own | {name: one_line(getattr(picture, name)) for name in members(arrays=False)})
