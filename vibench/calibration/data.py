"""Measured data, their noise, and the prior of the parameters: what a calibration is given."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy.linalg
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError, fault_line, placed, unknown_name
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.formulations import Snapshots
from vibench.interfaces.outputs import Output
from vibench.interfaces.parameters import ParameterBox, outside
from vibench.interfaces.problem import Problem
from vibench.offline.exported import linear_outputs
from vibench.packs.writer import toml_text
from vibench.signatures import Rule, bordered, is_plain
from vibench.study.matrix import read_toml

# Infinite where nothing is known.
Sizes = Annotated[
    Any, Rule("an array of numbers of at least 0", lambda a: is_plain(a) and a.dtype.kind in "fiu" and (a >= 0.0).all())
]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _Sensor(_Table):
    value: FiniteFloat
    noise: FiniteFloat | str | None = None
    unit: str | None = None


class _Normal(_Table):
    mean: FiniteFloat
    sd: Annotated[FiniteFloat, Field(gt=0.0)]


class _File(_Table):
    sensors: Annotated[dict[str, _Sensor], Field(min_length=1)]
    covariance: list[list[FiniteFloat]] | None = None
    prior: dict[str, _Normal] = {}


@bordered
@dataclass(frozen=True)
class Data:
    """Measured values d of outputs, with normal noise.

    Attributes
    ----------
    sensors
        Names of the outputs, one for each value.
    values
        d (k,), in the units of the outputs.
    covariance
        That of the noise (k×k); a `RequestError` if it is not symmetric positive definite.
    """

    sensors: Annotated[tuple[str, ...], "k"]
    values: Annotated[Array, "k"]
    covariance: Annotated[Array, "k", "k"]

    def __post_init__(self) -> None:
        try:
            root = np.linalg.cholesky(self.covariance)
        except np.linalg.LinAlgError:
            raise RequestError("the covariance of the noise is not positive definite") from None
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-12, atol=0.0):
            raise RequestError("the covariance of the noise is not symmetric")
        object.__setattr__(self, "_whitening", scipy.linalg.solve_triangular(root, np.eye(len(root)), lower=True))

    @classmethod
    def independent(
        cls, sensors: Annotated[Sequence[str], "k"], values: Annotated[Array, "k"], noise: Annotated[Array, "k"]
    ) -> Data:
        """Data whose errors are independent, with the standard deviations `noise` (k,)."""
        return cls(tuple(sensors), np.asarray(values, float), np.diag(np.asarray(noise, float) ** 2))

    def misfit(self, outputs: Annotated[Array, "k"]) -> float:
        """½ (s − d)ᵀ C⁻¹ (s − d) of outputs s (k,): the negative logarithm of the likelihood, up to a constant."""
        return self.interval(outputs, np.zeros(len(outputs)))[0]

    def interval(
        self, outputs: Annotated[Array, "k"], bounds: Annotated[Sizes, "k"],
        correlation: Annotated[Array, "k", "k"] | None = None,
    ) -> tuple[float, float]:  # fmt: skip
        """The least and the largest misfit that outputs (k,) with errors e within `bounds` b (k,) may have.

        With a `correlation` R (k×k) they satisfy (gᵀe)² ≤ cᵀRc for any g (k,) and c = (g_i b_i), too.
        """
        if not np.isfinite(bounds).all():
            return 0.0, np.inf
        whitening: Array = self._whitening  # type: ignore[attr-defined]
        # With C = LLᵀ, each component of L⁻¹(s − d) moves by at most the sum of |L⁻¹| times the bounds.
        apart, reach = whitening @ (outputs - self.values), np.abs(whitening) @ bounds
        least, most = np.maximum(np.abs(apart) - reach, 0.0), np.abs(apart) + reach
        lower, upper = 0.5 * float(least @ least), 0.5 * float(most @ most)
        if correlation is None:
            return lower, upper
        # The misfit moves by a linear term, and by a quadratic one that is not negative. A correlation is known to a
        # tenth of 1e-6 (`vibench.calibration.decisions`).
        c, middle = (apart @ whitening) * bounds, 0.5 * float(apart @ apart)
        linear = sqrt(max(0.0, float(c @ correlation @ c)) + 1e-6 * float(np.abs(c).sum()) ** 2)
        return max(lower, middle - linear), min(upper, middle + linear + 0.5 * float(reach @ reach))


@bordered
@dataclass(frozen=True)
class Prior:
    """The prior on a parameter box: normal and truncated to the box, uniform where the deviation `sd` is infinite."""

    box: Annotated[ParameterBox, "d"]
    mean: Annotated[Array, "d"]
    sd: Annotated[Sizes, "d"]

    @classmethod
    def of(cls, box: ParameterBox, normal: Mapping[str, tuple[float, float]] = {}) -> Prior:
        """The prior that is normal in the named components, with these means and standard deviations."""
        mean, sd = 0.5 * (box.lower + box.upper), np.full(box.dim, np.inf)
        for name, pair in normal.items():
            i = box.index(name)
            mean[i], sd[i] = pair
        return cls(box, mean, sd)

    def log_density(self, mu: Annotated[Array, "d"]) -> float:
        """Its logarithm at mu (d,), up to a constant; −∞ outside the box."""
        if outside(self.box, mu).any():
            return -np.inf
        return -0.5 * float(np.sum(((mu - self.mean) / self.sd) ** 2))


def outputs_of(problem: Problem, names: Sequence[str] | None = None) -> tuple[Output, ...]:
    """Linear outputs of a problem, all or by their names: others have no bound; a `RequestError` if there is none."""
    if not (known := {output.name: output for output in linear_outputs(problem)}):
        raise RequestError("the problem has no linear outputs, which sensors have to be")
    for name in names or ():
        if name not in known:
            raise unknown_name("linear output of the problem", name, known)
    return tuple(known[name] for name in names or known)


class Sensors:
    """Linear outputs of high-fidelity solutions, all or by their names.

    Solutions are as accurate as bounds allow for: their natural residuals are at most `accuracy`.
    """

    # A hundredth of what is verified elsewhere, and a hundred times what is usual: bounds grow by twice its root.
    accuracy = 1e-12

    def __init__(self, problem: Problem, names: Sequence[str] | None = None) -> None:
        self._outputs, self._solver = outputs_of(problem, names), HighFidelitySolver(problem)

    def __call__(self, mu: Array) -> Array:
        """The outputs (k,) at mu (d,); a `NumericalError` if the solution is less accurate."""
        found = self._solver.solve(mu)
        if not found.residuals.worst <= self.accuracy:
            left = f"{found.residuals.worst:.1e} at mu = {mu.tolist()}, above {self.accuracy:.0e}"
            raise NumericalError(f"the high-fidelity solution has the natural residual {left}")
        return np.array([one.values(mu[None], found.u[:, None], found.lam[:, None])[0] for one in self._outputs])


def read_data(path: Path, problem: Problem) -> tuple[Data, Prior]:
    """The data and the prior of a TOML file; a `RequestError` names the file, the key and what would be right."""
    with placed(str(path)):
        content = read_toml(path)
        try:
            file = _File.model_validate(content)
        except ValidationError as fault:
            raise RequestError(fault_line(fault, _File)) from None
        names, sensors, count = tuple(file.sensors), file.sensors.values(), len(file.sensors)
        for output, sensor in zip(outputs_of(problem, names), sensors, strict=True):
            if sensor.unit not in (None, output.unit):
                raise RequestError(f"sensors.{output.name}.unit is '{sensor.unit}', the output has '{output.unit}'")
        prior = Prior.of(problem.parameters, {name: (one.mean, one.sd) for name, one in file.prior.items()})
        values = np.array([sensor.value for sensor in sensors])
        if (covariance := file.covariance) is None:
            return Data.independent(names, values, np.array(list(map(_deviation, names, sensors)))), prior
        if [len(row) for row in covariance] != [count] * count:
            raise RequestError(f"covariance has not the shape ({count}, {count}) of the sensors")
        for name, sensor in file.sensors.items():
            if sensor.noise is not None:
                raise RequestError(f"sensors.{name}.noise: with a covariance the sensors have no noise of their own")
        return Data(names, values, np.array(covariance, float)), prior


def _deviation(name: str, sensor: _Sensor) -> float:
    found = sensor.noise
    if isinstance(found, str):
        with placed(f"sensors.{name}.noise"):
            found = share(found) * abs(sensor.value)
    if found is None or not found > 0.0:
        raise RequestError(f"sensors.{name}.noise: expected a standard deviation, or a share of a value that is not 0")
    return found


def share(text: str) -> float:
    """The number of a text such as "1 %"; a `RequestError` if it is no positive percentage."""
    found = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*%\s*", text)
    if found is None or not float(found[1]) > 0.0:
        raise RequestError(f"{text!r} is no positive percentage, such as 1%")
    return float(found[1]) / 100.0


def synthetic(problem: Problem, exact: Array, noise: float, seed: int) -> Data:
    """All linear outputs, exact values (k,) with random errors, whose deviations are a share of these values."""
    names = tuple(output.name for output in outputs_of(problem))
    deviations = noise * np.abs(exact)
    errors = np.random.default_rng(seed).standard_normal(len(exact))
    return Data.independent(names, exact + deviations * errors, deviations)


def as_toml(data: Data, problem: Problem) -> str:
    """The file of data with independent errors."""
    outputs, deviations = outputs_of(problem, data.sensors), np.sqrt(np.diag(data.covariance))
    lines = []
    for output, value, deviation in zip(outputs, data.values.tolist(), deviations.tolist(), strict=True):
        name, unit = map(toml_text, (output.name, output.unit))
        lines += [f"[sensors.{name}]", f"value = {value!r}", f"noise = {deviation!r}", f"unit = {unit}", ""]
    return "\n".join(lines)


def refuse_unreachable(data: Data, problem: Problem, solved: Snapshots) -> None:
    """Raise a `RequestError` for a value far from all that its sensor has at training parameters."""
    noises = np.sqrt(np.diag(data.covariance))
    for output, value, noise in zip(outputs_of(problem, data.sensors), data.values, noises, strict=True):
        reached = output.values(solved.mu, solved.u, solved.lam)
        low, high = reached.min(), reached.max()
        # The box may reach a little farther than the training parameters do.
        slack = 0.1 * (high - low) + 5.0 * noise
        if not low - slack <= value <= high + slack:
            found = f"'{output.name}' is {value:.4g}, and the parameter box gives {low:.4g} to {high:.4g}"
            raise RequestError(f"{found}; is the unit right?")
