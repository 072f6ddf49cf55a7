"""The results of a chain: a table, a file for ArviZ, a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vibench.arrays import Array
from vibench.calibration.metropolis import Metropolis
from vibench.files import write_atomically

if TYPE_CHECKING:
    import pandas as pd


def effective_size(values: Array) -> float:
    """Number of independent values that a chain (T,) is worth for its mean (Goodman and Weare 2010).

    T over the autocorrelation time, summed up to the first lag that is five of these times.
    """
    centred = values - values.mean()
    if not centred.any():
        return 1.0
    spectrum = np.abs(np.fft.rfft(centred, 2 * len(centred))) ** 2
    correlation = np.fft.irfft(spectrum)[: len(centred)]
    times = 2.0 * np.cumsum(correlation / correlation[0]) - 1.0
    first = np.flatnonzero(np.arange(len(times)) >= 5.0 * times)
    return float(len(values) / max(times[first[0] if len(first) else -1], 1.0))


def summary(chain: Metropolis) -> pd.DataFrame:
    """A row for each parameter: mean, its Monte Carlo error, standard deviation, quantiles, effective size."""
    import pandas as pd  # noqa: PLC0415  the chain itself needs no tables

    box, states = chain.prior.box, chain.states[chain.burn_in + 1 :]
    rows: list[dict[str, Any]] = []
    for name, unit, values in zip(box.names, box.units, states.T, strict=True):
        size, spread = effective_size(values), float(values.std(ddof=1))
        low, high = np.quantile(values, [0.05, 0.95]).tolist()
        rows.append({
            "parameter": name, "unit": unit, "mean": float(values.mean()), "error of mean": spread / np.sqrt(size),
            "sd": spread, "5 %": low, "95 %": high, "effective steps": round(size),
        })  # fmt: skip
    return pd.DataFrame(rows)


def write_for_arviz(chain: Metropolis, file: Path) -> None:
    """Write the chain as JSON, which `arviz.from_json` reads; the steps of the burn-in are `warmup_posterior`."""
    box, data = chain.prior.box, chain.decisions.data
    groups: dict[str, Any] = {}
    for before, part in (("warmup_", slice(1, chain.burn_in + 1)), ("", slice(chain.burn_in + 1, None))):
        states, accepted = chain.states[part], chain.accepted[slice(part.start - 1, part.stop and part.stop - 1)]
        groups[f"{before}posterior"] = {
            name: [column.tolist()] for name, column in zip(box.names, states.T, strict=True)
        }
        groups[f"{before}sample_stats"] = {"accepted": [accepted.tolist()]}
    groups["observed_data"] = dict(zip(data.sensors, data.values.tolist(), strict=True))
    write_atomically(file, json.dumps(groups).encode())


def draw(chain: Metropolis, file: Path) -> None:
    """Draw the marginal distributions and the traces of a chain."""
    from matplotlib.figure import Figure  # noqa: PLC0415  the chain itself needs no pictures

    box, states = chain.prior.box, chain.states
    figure = Figure(figsize=(3.2 * box.dim, 4.6), layout="constrained")
    for column, (name, unit) in enumerate(zip(box.names, box.units, strict=True)):
        top, below = (figure.add_subplot(2, box.dim, row * box.dim + column + 1) for row in range(2))
        top.hist(states[chain.burn_in + 1 :, column], bins=40, density=True, color="tab:blue")
        below.plot(states[:, column], linewidth=0.5, color="tab:blue")
        below.axvspan(0, chain.burn_in, color="0.9")
        label = name.replace("_", " ") + (f" [{unit}]" if unit != "1" else "")
        top.set(xlabel=label, yticks=[], ylabel="density" if column == 0 else "")
        below.set(xlabel="step (grey: burn-in)", ylabel=label)
    figure.savefig(file, dpi=150)
