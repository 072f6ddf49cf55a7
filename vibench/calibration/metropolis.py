"""Metropolis' random walk, all of whose decisions are those of the high-fidelity model."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from vibench.arrays import Array, Mask
from vibench.calibration.data import Prior
from vibench.calibration.decisions import Counts, Decisions
from vibench.errors import RequestError
from vibench.model.certificates.base import Guarantee
from vibench.signatures import constructed


@constructed
class Metropolis:
    """A chain of parameters whose distribution tends to the posterior (Metropolis et al. 1953).

    Steps are normal, in the coordinates of the unit cube. During the burn-in their covariance is that of the chain so
    far (Haario, Saksman and Tamminen 2001), times a factor that makes a third of them accepted (Roberts and Rosenthal
    2009); afterwards both are fixed. Random numbers are the same ones whatever is decided.
    """

    def __init__(self, decisions: Decisions, prior: Prior, burn_in: int, seed: int) -> None:
        self.decisions, self.prior, self.burn_in = decisions, prior, burn_in
        self._random = np.random.default_rng(seed)
        self._visited, self._accepted = [prior.start], [True]
        # Steps of a twentieth of the box at first.
        d = prior.box.dim
        self._mean, self._scatter, self._log_scale = prior.box.to_unit(prior.start), 0.05**2 * np.eye(d), 0.0

    @property
    def states(self) -> Array:
        """The chain (T+1×d), from its start on."""
        return np.array(self._visited)

    @property
    def accepted(self) -> Mask:
        """Which steps (T,) were accepted."""
        return np.array(self._accepted[1:])

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return len(self._visited) - 1

    def step(self) -> None:
        """Propose a parameter, and move there or stay."""
        box, present = self.prior.box, self._visited[-1]
        normal, uniform = self._random.standard_normal(box.dim), self._random.random()
        root = np.linalg.cholesky(self._scatter + 1e-12 * np.eye(box.dim))
        proposal = present + np.exp(self._log_scale) * (root @ normal) * box.widths
        # The logarithm of a uniform number in (0, 1].
        gain = self.prior.log_density(proposal) - self.prior.log_density(present) - np.log1p(-uniform)
        moves = bool(gain > -np.inf) and self.decisions.less(proposal, present, float(gain))
        self._visited.append(proposal if moves else present)
        self._accepted.append(moves)
        if self.steps <= self.burn_in:
            self._adapt(moves)

    def _adapt(self, moved: bool) -> None:
        weight, away = 1.0 / (self.steps + 10.0), self.prior.box.to_unit(self._visited[-1]) - self._mean
        self._mean = self._mean + weight * away
        self._scatter = (1.0 - weight) * (self._scatter + weight * np.outer(away, away))
        self._log_scale += (float(moved) - 0.33) / np.sqrt(self.steps)

    def saved(self) -> dict[str, Array]:
        """Arrays from which `restore` continues the chain as if nothing had happened."""
        decisions = self.decisions
        texts = {
            "random": self._random.bit_generator.state, "audits": decisions.random.bit_generator.state,
            "counts": asdict(decisions.counts), "guarantee": decisions.guarantee.value,
        }  # fmt: skip
        asked = np.array([np.frombuffer(key) for key in decisions.answers]).reshape(-1, self.prior.box.dim)
        return {
            "states": self.states, "accepted": np.array(self._accepted), "mean": self._mean, "scatter": self._scatter,
            "log_scale": np.array(self._log_scale), "asked": asked, "misfits": np.array([*decisions.answers.values()]),
            "about": np.array(json.dumps(texts)),
        }  # fmt: skip

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Continue a chain that was `saved`; a `RequestError` if the arrays are not those of one."""
        try:
            texts = json.loads(str(saved["about"]))
            self._random.bit_generator.state = texts["random"]
            self.decisions.random.bit_generator.state = texts["audits"]
            counts = {one.name: texts["counts"][one.name] for one in fields(Counts)}
            self.decisions.guarantee = Guarantee(texts["guarantee"])
            states = np.asarray(saved["states"], float).reshape(-1, self.prior.box.dim)
            self._mean, self._scatter = np.asarray(saved["mean"], float), np.asarray(saved["scatter"], float)
            self._log_scale, self._accepted = float(saved["log_scale"]), [bool(one) for one in saved["accepted"]]
            answers = zip(np.asarray(saved["asked"], float), np.asarray(saved["misfits"], float), strict=True)
            self.decisions.answers = {mu.tobytes(): float(misfit) for mu, misfit in answers}
        except (KeyError, ValueError, TypeError) as error:
            raise RequestError(f"the chain cannot be continued: {error!r}") from None
        self._visited, self.decisions.counts = list(states), Counts(**counts)
