"""Quantities of interest: numbers that a problem derives from a solution, such as a contact force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, in_a_line

OutputFunction = Callable[[Array, Array, Array], float]
"""From a parameter mu (d,) and a solution u (n,), λ (m,) to a number."""


@dataclass(frozen=True)
class Output:
    """A quantity of interest s: linear, s = uᵀ`u` + λᵀ`lam`, or else any function of (mu, u, λ).

    Attributes
    ----------
    name, unit
        Its name and its unit, "1" if it has none.
    u, lam
        Coefficients (n,) and (m,) of a linear output; one of the two may be missing.
    function
        The function of any other output.
    """

    name: str
    unit: str
    u: Array | None = None
    lam: Array | None = None
    function: OutputFunction | None = None

    def __post_init__(self) -> None:
        if self.linear == (self.function is not None):
            raise ValueError(f"the output '{self.name}' has either coefficients of u and λ, or a function")

    @property
    def linear(self) -> bool:
        """Whether it is linear in u and λ, with coefficients that do not depend on the parameter."""
        return self.u is not None or self.lam is not None

    def values(self, mus: Array, u: Array, lam: Array) -> Array:
        """Values (P,) of the output at parameters (P×d) and solutions, columns of u (n×P) and λ (m×P).

        Raises
        ------
        NumericalError
            If its coefficients have the wrong shape, its function fails, or a value is not finite.
        """
        if self.function is None:
            outputs = np.zeros(len(mus))
            for name, weights, columns in (("u", self.u, u), ("λ", self.lam, lam)):
                if weights is not None and np.shape(weights) != (len(columns),):
                    expected = f"expected ({len(columns)},)"
                    raise NumericalError(
                        f"the output '{self.name}' has coefficients of {name} of shape {np.shape(weights)}; {expected}"
                    )
                outputs += 0.0 if weights is None else weights @ columns
        else:
            outputs = np.array([self._value(mus[k], u[:, k], lam[:, k]) for k in range(len(mus))])
        for k in np.flatnonzero(~np.isfinite(outputs))[:1]:
            raise NumericalError(f"the output '{self.name}' is {outputs[k]} at mu = {mus[k].tolist()}")
        return outputs

    def _value(self, mu: Array, u: Array, lam: Array) -> float:
        assert self.function is not None  # `values` asks for no other
        try:
            return float(self.function(mu.copy(), u.copy(), lam.copy()))
        except Exception as error:
            raise NumericalError(f"the output '{self.name}' fails at mu = {mu.tolist()}: {in_a_line(error)}") from error
