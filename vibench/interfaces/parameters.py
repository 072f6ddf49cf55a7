"""The parameter domain of a problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from vibench.arrays import Array, Mask, read_only
from vibench.errors import RequestError, unknown_name
from vibench.signatures import AtLeastOne, Count, Seed, bordered
from vibench.text import normal_name


@bordered
@dataclass(frozen=True)
class ParameterBox:
    """The parameter domain D: a box.

    Attributes
    ----------
    names
        One name per parameter.
    lower, upper
        Bounds (d,).
    units
        One unit per parameter, "1" if dimensionless.
    listed
        The only parameters (L×d) at which the problem can be assembled; `None` if it can be everywhere in the box.
    """

    names: Annotated[tuple[str, ...], "d"]
    lower: Annotated[Array, "d"]
    upper: Annotated[Array, "d"]
    units: Annotated[tuple[str, ...], "d"]
    listed: Annotated[Array, "L", "d"] | None = None

    def __post_init__(self) -> None:
        # Problems share their box with all plugins.
        for name in ("lower", "upper"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        if len({*map(normal_name, self.names)} - {""}) < self.dim:
            raise RequestError(f"names of ParameterBox are {', '.join(self.names)}, expected different ones")
        if (self.lower > self.upper).any():
            raise RequestError(f"lower bounds {self.lower.tolist()} are above the upper ones {self.upper.tolist()}")

    @property
    def dim(self) -> int:
        """Number d of parameters."""
        return len(self.names)

    @property
    def widths(self) -> Array:
        """Widths (d,) by which distances of parameters are measured; never zero."""
        # A parameter that does not vary is measured by its size, one near zero by 1.
        return np.where(self.upper > self.lower, self.upper - self.lower, np.maximum(np.abs(self.lower), 1.0))

    def grid(self, *counts: AtLeastOne) -> Array:
        """Regular grid (P×d) with `counts` points per direction; the last parameter varies fastest."""
        if len(counts) != self.dim:
            raise RequestError(f"{len(counts)} counts of a grid for {self.dim} parameters, expected one for each")
        axes = [np.linspace(a, b, k) for a, b, k in zip(self.lower, self.upper, counts, strict=True)]
        return np.stack([m.ravel() for m in np.meshgrid(*axes, indexing="ij")], axis=1)

    def sample(self, count: Count, seed: Seed) -> Array:
        """`count` uniform random points (count×d), the same for the same seed."""
        uniform = np.random.default_rng(seed).random((count, self.dim))
        return np.asarray(self.lower + uniform * (self.upper - self.lower))

    def outside(self, mus: Annotated[Array, "…", "d"]) -> Mask:
        """Which components of points (…×d) lie outside the box, by more than round-off."""
        return outside(self, mus)

    def from_unit(self, unit: Annotated[Array, "P", "d"], log: Sequence[str] = ()) -> Array:
        """The points (P×d) of the box at the places `unit` (P×d) of the unit cube, some parameters on a log scale.

        Raises a `RequestError` if `log` names no parameter, or one whose lower bound is not positive.
        """
        linear = np.asarray(self.lower + unit * (self.upper - self.lower))
        for i in self.logarithmic(log):
            low, high = np.log(self.lower[i]), np.log(self.upper[i])
            # The exponential of a logarithm may leave the box by round-off.
            linear[:, i] = np.clip(np.exp(low + unit[:, i] * (high - low)), self.lower[i], self.upper[i])
        return linear

    def to_unit(self, mus: Annotated[Array, "…", "d"]) -> Array:
        """The places (…×d) of points (…×d) in the unit cube; the inverse of `from_unit` without `log`."""
        return np.asarray((mus - self.lower) / self.widths)

    def logarithmic(self, log: Sequence[str]) -> list[int]:
        """Numbers of the parameters that `log` names; with the errors of `from_unit`."""
        chosen = list(dict.fromkeys(map(self.index, log)))
        for name, low in ((self.names[i], self.lower[i]) for i in chosen):
            if low <= 0.0:
                raise RequestError(f"'{name}' cannot have a log scale: its lower bound is {low:g}, expected > 0")
        return chosen

    def index(self, name: str) -> int:
        """Number of the parameter with this name; raises a `RequestError` if there is none."""
        # Names look the same in several Unicode forms, such as the micro sign and μ.
        known = {normal_name(one): number for number, one in enumerate(self.names)}
        if normal_name(name) not in known:
            raise unknown_name("parameter", name, self.names)
        return known[normal_name(name)]


def outside(box: ParameterBox, mus: Array) -> Mask:
    """As `ParameterBox.outside`, of parameters that are known to be some."""
    # Bounds and parameters are often computed, or read from decimals: the last digits must not refuse one.
    slack = 1e-12 * np.maximum(np.abs(box.lower), np.abs(box.upper))
    return np.asarray((mus < box.lower - slack) | (mus > box.upper + slack))
