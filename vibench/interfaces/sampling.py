"""The interface of sampling strategies: plugins that choose the training or the validation parameters of a study."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.interfaces.problem import ParameterBox

LISTED_RTOL = 1e-9
"""Largest distance of a parameter from a listed one, relative to the widths of the box."""


class Sampling(ABC):
    """Chooses parameters. Constructor arguments are the plugin's options; every random choice has a seed among them.

    Options annotated as `pathlib.Path` are relative to the folder of the study file.
    """

    requires: ClassVar[tuple[str, ...]] = ()
    """Optional distributions it cannot do without; where one is not installed its cells are unavailable."""

    @classmethod
    def data_digest(cls, **options: Any) -> str:  # noqa: ARG003
        """Digest of the files that the options name, "" if they name none; it is part of the keys of all results."""
        return ""

    @abstractmethod
    def parameters(self, box: ParameterBox) -> Array:
        """Parameters (P×d) in the box, the same in every process.

        Raises
        ------
        RequestError
            If the options do not fit the box, or a file cannot be read.
        """


class Trainer(ABC):
    """What an adaptive sampling strategy trains: a reduced model that grows with every high-fidelity solution."""

    @abstractmethod
    def solve(self, mu: Array, bound: float = float("nan")) -> None:
        """Solve at mu (d,) and add the solution to the training set; `bound`, the reason to do so, is recorded."""

    @abstractmethod
    def bound(self, mu: Array) -> float:
        """Relative error of the model of all solutions so far at mu (d,): at least its bounds; infinite without them.

        An estimate of the error of λ in W is taken where it is larger than the bounds of u and λ.
        """


class AdaptiveSampling(Sampling):
    """Chooses training parameters one after the other, by what the solutions so far know; `parameters` are candidates.

    It makes no validation set.
    """

    @abstractmethod
    def train(self, box: ParameterBox, trainer: Trainer) -> None:
        """Call `trainer.solve` at every training parameter, at one at least, in an order that is always the same."""


def check_sample(box: ParameterBox, found: object) -> Array:
    """The parameters (P×d) that a sampling strategy returned, refused if they are none of the box.

    Raises
    ------
    RequestError
        If they have the wrong shape, are not finite, lie outside the box, occur twice, or are not among the listed
        ones of a problem that has no other.
    """
    mus = np.asarray(found, float)
    if mus.ndim != 2 or mus.shape[1] != box.dim or not len(mus):
        raise RequestError(f"parameters of shape {mus.shape}; expected (P, {box.dim}), a row for each, with P > 0")
    for k, i in np.argwhere(~np.isfinite(mus))[:1]:
        raise RequestError(f"parameter {k} has '{box.names[i]}' = {mus[k, i]}, which is not finite")
    for k, i in np.argwhere(box.outside(mus))[:1]:
        bounds = f"[{box.lower[i]:g}, {box.upper[i]:g}]"
        raise RequestError(f"parameter {k} has '{box.names[i]}' = {mus[k, i]:g}, outside the box {bounds}")
    if box.listed is not None:
        _check_listed(box, box.listed, mus)
    first = np.unique(mus, axis=0, return_index=True)[1]
    for k in sorted(set(range(len(mus))) - set(first.tolist()))[:1]:
        raise RequestError(f"parameter {k}, {mus[k].tolist()}, occurs twice")
    return mus


def _check_listed(box: ParameterBox, listed: Array, mus: Array) -> None:
    widths = np.where(box.upper > box.lower, box.upper - box.lower, np.maximum(np.abs(box.lower), 1.0))
    for k, mu in enumerate(mus):
        if not np.any(np.all(np.abs(listed - mu) <= LISTED_RTOL * widths, axis=1)):
            raise RequestError(
                f"parameter {k}, {mu.tolist()}, is none of the {len(listed)} listed ones, and the problem has matrices "
                "at these only: name some of them"
            )
