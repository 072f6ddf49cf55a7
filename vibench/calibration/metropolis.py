"""Metropolis' random walk, all of whose decisions are those of the high-fidelity model, and what it says."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vibench.arrays import Array, Mask
from vibench.calibration.data import Prior
from vibench.calibration.decisions import Decisions
from vibench.errors import foreign
from vibench.signatures import Count, Seed, bordered_constructor

if TYPE_CHECKING:
    import pandas as pd


@bordered_constructor
class Metropolis:
    """A chain of parameters whose distribution tends to the posterior (Metropolis et al. 1953).

    Steps are normal, in the coordinates of the unit cube. During the burn-in their covariance is that of the chain so
    far (Haario, Saksman and Tamminen 2001), times a factor that makes a third of them accepted (Roberts and Rosenthal
    2009); afterwards both are fixed. Random numbers are the same ones whatever is decided.
    """

    def __init__(self, decisions: Decisions, prior: Prior, burn_in: Count, seed: Seed) -> None:
        self.decisions, self.prior, self.burn_in = decisions, prior, burn_in
        self._random = np.random.default_rng(seed)
        box, start = prior.box, np.clip(prior.mean, prior.box.lower, prior.box.upper)
        self._visited, self._accepted = [start], list[bool]()
        # Steps of a twentieth of the box at first.
        self._mean, self._scatter, self._log_scale = box.to_unit(start), 0.05**2 * np.eye(box.dim), 0.0

    @property
    def states(self) -> Array:
        """The chain (T+1×d), from its start on."""
        return np.array(self._visited)

    @property
    def accepted(self) -> Mask:
        """Which steps (T,) were accepted."""
        return np.array(self._accepted, bool)

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return len(self._accepted)

    def step(self) -> None:
        """Propose a parameter, and move there or stay."""
        box, present = self.prior.box, self._visited[-1]
        normal, uniform = self._random.standard_normal(box.dim), self._random.random()
        root = np.linalg.cholesky(self._scatter + 1e-12 * np.eye(box.dim))
        proposal = present + np.exp(self._log_scale) * (root @ normal) * box.widths
        # The logarithm of a uniform number in (0, 1].
        density, less = self.prior.log_density, self.decisions.less
        gain = density(proposal) - density(present) - np.log1p(-uniform)
        moves = bool(gain > -np.inf) and less(proposal, present, float(gain))
        self._visited.append(proposal if moves else present)
        self._accepted.append(moves)
        if self.steps <= self.burn_in:
            self._adapt(moves)

    def _adapt(self, moved: bool) -> None:
        weight, away = 1.0 / (self.steps + 10.0), self.prior.box.to_unit(self._visited[-1]) - self._mean
        self._mean = self._mean + weight * away
        self._scatter = (1.0 - weight) * (self._scatter + weight * np.outer(away, away))
        self._log_scale += (float(moved) - 0.33) / np.sqrt(self.steps)


def arviz() -> Any:
    """The package ArviZ; an `UnsupportedError` if it is not installed."""
    with foreign("the package arviz, of the extra 'calibration', cannot be used"), warnings.catch_warnings():
        # It announces its next version whenever it is imported.
        warnings.simplefilter("ignore", FutureWarning)
        import arviz  # noqa: PLC0415  an extra
    return arviz


def summary(chain: Metropolis, file: Path | None = None) -> pd.DataFrame:
    """A row for each parameter: mean, its Monte Carlo error, standard deviation, quantiles, effective steps.

    ArviZ computes them, and writes the chain into `file` (NetCDF) with its burn-in, acceptance and data.
    """
    import pandas as pd  # noqa: PLC0415  the chain itself needs no tables

    az, box, data, start = arviz(), chain.prior.box, chain.decisions.data, chain.burn_in
    states, rows = chain.states[1:], []
    if file is not None:
        parts = slice(None, start), slice(start, None)
        named = [{name: [part] for name, part in zip(box.names, states[s].T, strict=True)} for s in parts]
        stats = [{"accepted": [chain.accepted[s]]} for s in parts]
        az.from_dict(
            warmup_posterior=named[0], posterior=named[1], warmup_sample_stats=stats[0], sample_stats=stats[1],
            observed_data=dict(zip(data.sensors, data.values, strict=True)), save_warmup=True,
        ).to_netcdf(str(file))  # fmt: skip
    for name, unit, values in zip(box.names, box.units, states[start:].T, strict=True):
        low, high = np.quantile(values, [0.05, 0.95])
        moments = {"mean": values.mean(), "error of mean": float(az.mcse(values)), "sd": values.std(ddof=1)}
        rows.append({"parameter": name, "unit": unit, **moments, "5 %": low, "95 %": high})
        rows[-1]["effective steps"] = round(float(az.ess(values)))
    return pd.DataFrame(rows)


def draw(chain: Metropolis, file: Path) -> None:
    """Draw the marginal distributions and the traces of a chain."""
    from matplotlib.figure import Figure  # noqa: PLC0415  the chain itself needs no pictures

    box, states = chain.prior.box, chain.states
    figure = Figure(figsize=(3.2 * box.dim, 4.6), layout="constrained")
    panels = figure.subplots(2, box.dim, squeeze=False).T
    for (top, below), name, unit, values in zip(panels, box.names, box.units, states.T, strict=True):
        top.hist(values[chain.burn_in + 1 :], bins=40, density=True)
        below.plot(values, linewidth=0.5)
        below.axvspan(0, chain.burn_in, color="0.9")
        label = name.replace("_", " ") + (f" [{unit}]" if unit != "1" else "")
        top.set(xlabel=label, ylabel="density", yticks=[])
        below.set(xlabel="step (grey: burn-in)", ylabel=label)
    figure.savefig(file, dpi=150)
