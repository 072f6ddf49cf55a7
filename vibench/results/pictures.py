"""Pictures of high-fidelity solutions: their rows in the results file, written and read."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from vibench.errors import RequestError
from vibench.interfaces.outputs import Picture
from vibench.results.sqlite import read_rows
from vibench.text import printable


def members(arrays: bool) -> list[str]:
    """Members of a picture that hold arrays, or those that are texts."""
    return [field.name for field in fields(Picture) if (field.type != "str") is arrays]


def picture_rows(drawn: Iterable[tuple[str, Picture]]) -> list[dict[str, Any]]:
    """Rows of the pictures table, one for every title and picture, without the columns that identify them."""
    rows = list[dict[str, Any]]()
    # Single precision, which is enough to draw.
    precision = {name: np.int32 if name == "triangles" else np.float32 for name in members(arrays=True)}
    for title, one in drawn:
        stream = io.BytesIO()
        np.savez_compressed(stream, **{name: getattr(one, name).astype(kind) for name, kind in precision.items()})
        names = json.dumps([getattr(one, text) for text in members(arrays=False)])
        rows.append({"title": title, "names": names, "data": stream.getvalue()})
    return rows


@dataclass(frozen=True)
class Shown:
    """A picture with its problem (label and options) and title, or the reason why there is none."""

    key: tuple[str, str]
    title: str
    picture: Picture | None
    reason: str


def read(path: Path) -> Iterator[Shown]:
    names, rows = read_rows(path, "pictures")
    for row in (dict(zip(names, values, strict=True)) for values in rows):
        key, title, reason = (row["problem"], row["problem_options"]), row["title"] or "", row["reason"] or ""
        if row["data"] is None:
            yield Shown(key, title, None, reason)
            continue
        with np.load(io.BytesIO(row["data"]), allow_pickle=False) as stored:
            kinds = {name: np.intp if name == "triangles" else float for name in members(arrays=True)}
            parts: dict[str, Any] = {name: stored[name].astype(kind) for name, kind in kinds.items()}
        texts = (printable(str(text)) for text in json.loads(row["names"]))
        try:
            picture = Picture(**parts | dict(zip(members(arrays=False), texts, strict=True)))
        except RequestError as error:
            yield Shown(key, title, None, str(error))
        else:
            yield Shown(key, title, picture, reason)
