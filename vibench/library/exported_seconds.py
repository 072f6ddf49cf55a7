"""How long queries of an exported model take, beside those of the model and its high-fidelity solutions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.library import reduced_model
from vibench.offline.models import Model
from vibench.timing import timed

Call = Callable[[Array], Any]
"""A query at a parameter mu (d,)."""

SCRIPT, LIBRARY, HIGH_FIDELITY = "script", "model.solve", "high-fidelity solution"


def in_turns(calls: Mapping[str, Call], mus: Array) -> dict[str, float]:
    """Median CPU seconds of calls by name at parameters (P×d), at each one after the other, once more at the first."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for mu in (mus[0], *mus):
        for name, call in calls.items():
            seconds[name].append(timed(partial(call, mu))[1].cpu)
    return {name: float(np.median(found[1:])) for name, found in seconds.items()}


def queries(model: Model, file: Path) -> dict[str, Call]:
    """The script of an exported file and its model, which give u, λ and the outputs.

    A certified model also answers with bounds, and with corrected solutions.
    """
    plain = replace(model, certificate=None)
    found: dict[str, Call] = {SCRIPT: reduced_model.Model(file).solve, LIBRARY: partial(_whole, plain, False)}
    if model.certificate is not None:
        found |= {
            f"{LIBRARY}, {what}": partial(_whole, model, what == "corrected") for what in ("with bounds", "corrected")
        }
    return found


def _whole(model: Model, corrected: bool, mu: Array) -> None:
    solution = model.solve(mu, corrected=corrected)
    if solution.x is not None and solution.alpha is not None:
        _ = solution.answer, solution.outputs, solution.output_bounds


def in_words(model: Model, file: Path, count: int = 5) -> str:
    """Median CPU milliseconds of queries of the script at `count` parameters, and of high-fidelity solutions there."""
    calls: dict[str, Call] = {SCRIPT: reduced_model.Model(file).solve, HIGH_FIDELITY: model.high_fidelity}
    seconds = in_turns(calls, model.parameters.sample(count, seed=0))
    script, high_fidelity = (f"{1e3 * seconds[name]:.2g} ms" for name in calls)
    return f"a query takes {script}; the {HIGH_FIDELITY} {high_fidelity}"
