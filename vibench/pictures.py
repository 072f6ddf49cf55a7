"""Pictures of high-fidelity solutions: made by a stage of a run, kept in its results file, read back for figures."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from vibench import tables
from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.matrix import Plugin
from vibench.problem import ParameterBox, Picture
from vibench.stage import Result, Stage, build_problem
from vibench.store import Store
from vibench.sweeps import gather, training

CORNERS = (0.0, 0.5, 1.0)
"""Where in the box of parameters solutions are looked at: its lower corner, its middle and its upper corner."""

ARRAYS = tuple(field.name for field in fields(Picture) if not field.name.endswith("name"))


@dataclass(frozen=True)
class PictureStage(Stage):
    """Pictures of a few training solutions of a problem."""

    problem: Plugin

    def inputs(self) -> tuple[Stage, ...]:
        """The training sweep."""
        return training(self.problem)

    def run(self, store: Store) -> Result:
        """Titles and pictures, in the order of `CORNERS`; none of a problem that has no picture."""
        problem, found = build_problem(self.problem), gather(store, self.inputs())
        drawn = []
        for k in _nearest(problem.parameters, found.mu):
            picture = problem.picture(found.mu[k], found.u[:, k], found.lam[:, k])
            if picture is not None:
                drawn.append((_title(problem.parameters, found.mu[k]), _checked(picture)))
        return Result(tuple(drawn))


def _nearest(box: ParameterBox, mus: Array) -> list[int]:
    """Training parameters (P×d) nearest to the corners and the middle of their box, each once."""
    width = np.where(box.upper > box.lower, box.upper - box.lower, 1.0)
    unit = (mus - box.lower) / width
    return list(dict.fromkeys(int(np.argmin(np.linalg.norm(unit - corner, axis=1))) for corner in CORNERS))


def _title(box: ParameterBox, mu: Array) -> str:
    named = zip(box.names, mu, box.units, strict=True)
    return ", ".join(f"{name} = {value:.3g}" + f" {unit}" * (unit not in ("", "1")) for name, value, unit in named)


def _checked(picture: Picture) -> Picture:
    """A picture whose arrays fit together.

    Raises
    ------
    NumericalError
        Naming the member that does not.
    """
    count, places = picture.points.shape[-1], picture.positions.shape[-1]
    corners = picture.triangles
    mesh = corners.shape[0] == 3 and bool(np.all((corners >= 0) & (corners < count)))
    fits = {
        "points": picture.points.ndim == 2 and len(picture.points) in (1, 2),
        "triangles": len(picture.points) == 1 or mesh,
        "values": picture.values.shape == (count,),
        "positions": picture.positions.ndim == 2 and len(picture.positions) in (1, 2),
        "multiplier": picture.multiplier.shape == (places,),
    }
    wrong = [name for name, right in fits.items() if not right]
    if wrong:
        raise NumericalError(f"the problem's picture has {' and '.join(wrong)} of the wrong shape")
    return picture


def rows(stage: PictureStage, label: str, drawn: tuple[tuple[str, Picture], ...]) -> list[dict[str, Any]]:
    """Rows of the pictures table."""
    keys = {"problem": label, "problem_options": stage.problem.options}
    return [
        keys | {"number": k, "title": title, "names": json.dumps([one.name, one.multiplier_name]), "data": _packed(one)}
        for k, (title, one) in enumerate(drawn)
    ]


def missing(stage: PictureStage, label: str, reason: str) -> list[dict[str, Any]]:
    """The row that says why there is no picture."""
    return [{"problem": label, "problem_options": stage.problem.options, "number": 0, "reason": reason}]


@dataclass(frozen=True)
class Shown:
    """A picture read back: whose it is, its title, and why it is not there if it is not."""

    key: tuple[str, str]
    title: str
    picture: Picture | None
    reason: str


def read(path: Path) -> Iterator[Shown]:
    """The pictures of a results file."""
    for row in tables.read(path, "pictures").to_dict("records"):
        picture = _unpacked(row["data"], row["names"]) if isinstance(row["data"], bytes) else None
        key = (str(row["problem"]), str(row["problem_options"]))
        title, reason = (text if isinstance(text, str) else "" for text in (row["title"], row["reason"]))
        yield Shown(key, title, picture, reason)


def _packed(picture: Picture) -> bytes:
    """The arrays, in single precision, compressed."""
    stream = io.BytesIO()
    small = {name: getattr(picture, name) for name in ARRAYS}
    kept = {name: value.astype(np.int32 if name == "triangles" else np.float32) for name, value in small.items()}
    np.savez_compressed(stream, **kept)
    return stream.getvalue()


def _unpacked(data: bytes, names: str) -> Picture:
    with np.load(io.BytesIO(data), allow_pickle=False) as found:
        arrays = {name: found[name].astype(np.intp if name == "triangles" else float) for name in ARRAYS}
    name, multiplier_name = json.loads(names)
    return Picture(**arrays, name=name, multiplier_name=multiplier_name)
