"""Whether reduction pays: for every problem the cost of a full solution, and the best model within an error."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pandas as pd

from vibench.interfaces.strategies import Kind
from vibench.plugins.registry import default_formulation
from vibench.results import formats
from vibench.results.break_even import Meaning
from vibench.results.ranking import contenders, errors_of_solution
from vibench.results.schema import Row
from vibench.study.cells import NO_SUCH_AXIS


@dataclass(frozen=True)
class Verdict:
    """The answer for one problem; its text is two sentences.

    `best` is the row of the cells table with the fastest query within the error; where none is, of the smallest error.
    It is `None` where no cell would be compared, whatever its error. `enriching` is the factor by which the best fixed
    enrichment divides the mean error of λ at its POD and cone; `None` where a run has no model with it or without.
    """

    problem: str
    error: float  # largest mean relative error, of u in V and of λ in W, that the best model may have
    full_s: float  # CPU seconds of a full solution
    best: Row | None
    within: bool  # whether the errors of `best` are within `error`
    pays: Row | None  # of the thresholds table, of `best` against the full model
    enriching: float | None

    def __str__(self) -> str:
        limit = f"{100.0 * self.error:g} %"
        full = f"{self.problem}: a full solution takes {_time(self.full_s)}"
        if self.best is None:
            return f"{full}. No model of this run takes part in a comparison; `vibench show RUN --table best` says why."
        errors = f"{_percent(self.best['error_u_mean'])} for u and {_percent(self.best['error_lambda_mean'])} for λ"
        if not self.within:
            closest = f"No model is within {limit} for both u and λ; the closest is {self.model}, with {errors}"
            remedy = "More training parameters, or smaller tolerances of POD and cone, may help"
            return f"{full}. {closest}. {self._payment}. {remedy}."
        cost = f"a query of the best model within {limit} takes {_time(self.best['online_s'])}"
        certified = {"certified": "with proved error bounds", "verified": "with error bounds verified at samples"}
        proof = certified.get(str(self.best["certificate"]), "without error bounds")
        advice = "" if self.enriching is None else "; enriching V does not help here"
        # Smaller factors are found where there are as many modes as generators, and change no decision.
        if self.enriching is not None and self.enriching >= 1.5:
            advice = f"; enriching V divides the error of λ by {self.enriching:.2g} here"
        return f"{full}, {cost}: {self.model}, {proof}. {self._payment}{advice}."

    @property
    def model(self) -> str:
        """The best model in words: its strategies, its numbers of modes and generators, its solver."""
        cell = self.best or {}
        usual = cell["formulation"] == default_formulation()
        parts = [] if usual else [str(cell["formulation"])]
        if cell["primal"] != NO_SUCH_AXIS:
            parts.append(f"{cell['primal']} on the cone of {cell['dual']}")
        for count, noun in ((cell["N"], "modes"), (cell["R"], "generators")):
            parts += [] if pd.isna(count) else [f"{count:.0f} {noun}"]
        parts += [] if cell["solver"] == NO_SUCH_AXIS else [str(cell["solver"])]
        return ", ".join(parts)

    @property
    def break_even(self) -> str:
        """From how many queries the best model pays, such as "from 25"; "" where that was not measured."""
        return "" if self.pays is None else formats.break_even(self.pays["meaning"], self.pays["benefit_threshold"])

    @property
    def _payment(self) -> str:
        """From how many queries the best model pays, the beginning of a sentence."""
        row = self.pays
        if row is None:
            return "When it pays was not measured"
        low, high, number = row["threshold_low"], row["threshold_high"], row["benefit_threshold"]
        interval = "" if pd.isna(low) or pd.isna(high) else f" (95 % interval: {low:.0f} to {high:.0f})"
        return {
            Meaning.FROM: f"It pays from {number:.0f} queries on{interval}",
            Meaning.UNTIL: f"It is cheaper up to {number:.0f} queries{interval}",
            Meaning.AT_ONCE: "It is cheaper from the first query on",
            Meaning.NEVER: "It never pays",
            Meaning.AS_FAST: "It does not pay: its queries are as slow as full solutions",
            Meaning.UNDECIDED: "Whether it pays is undecided at this scatter of seconds",
        }[Meaning(row["meaning"])]


def verdicts(cells: pd.DataFrame, thresholds: pd.DataFrame) -> Iterator[Verdict]:
    """The verdict of every problem of a run, from its tables of cells and of thresholds."""
    # A per cent of u and of λ is what a designer calls accurate.
    error = 0.01
    against_full = thresholds[thresholds["cell_a"].isna()].set_index("cell_b")
    errors = errors_of_solution(cells)
    for (problem, _), mine in cells.groupby(["problem", "problem_options"], dropna=False, sort=False):
        if (full := mine["hf_s"].astype(float)).isna().all():
            continue
        rivals = contenders(mine)
        fine = rivals[errors[rivals.index] <= error]
        # Seconds of a query and of a full solution are timed in the same rounds, when the machine has one speed.
        ranked = fine["online_s"].astype(float) / fine["hf_s"].astype(float) if len(fine) else errors[rivals.index]
        best = None if rivals.empty else rivals.loc[ranked.idxmin()].to_dict()
        pays = against_full.loc[best["cell"]].to_dict() if best and best["cell"] in against_full.index else None
        seconds = float(best["hf_s"]) if best else float(full.median())
        helps = _enriching(best, rivals) if best else None
        yield Verdict(str(problem), error, seconds, best, len(fine) > 0, pays, helps)


def _enriching(best: Row, cells: pd.DataFrame) -> float | None:
    """The factor of `Verdict.enriching`, among the cells of one problem."""
    axes = ("training", "training_options", "formulation", "dual", "dual_options", "pod_tol", "pod_size", "dual_tol",
            "dual_size", "correction")  # fmt: skip
    alike = cells
    for name in axes:
        alike = alike[alike[name].isna() if pd.isna(best[name]) else alike[name] == best[name]]
    of = {kind: alike.loc[alike["enrichment_kind"] == kind, "error_lambda_mean"] for kind in (Kind.NONE, Kind.FIXED)}
    plain, enriched = (float(values.min()) for values in of.values())
    return plain / enriched if enriched > 0.0 and not math.isnan(plain) else None


def _time(seconds: Any) -> str:
    value = float(seconds)
    return f"{formats.cell_text(value)} s" if value >= 1.0 else f"{formats.cell_text(1e3 * value)} ms"


def _percent(error: Any) -> str:
    return "an unknown error" if pd.isna(error) else f"{100.0 * float(error):.2g} %"
