"""Benchmarks of formulations: what they build offline, and their queries, judged as every other model is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from vibench.benchmarks.inputs import QUERIES, StageInputs
from vibench.benchmarks.measure import Info, Timing, largest_figures
from vibench.benchmarks.offline import residual_figures
from vibench.benchmarks.online import LeftOutError, errors_of, in_turn
from vibench.errors import UnsupportedError
from vibench.interfaces.formulations import Formulation, FormulationAnswer, axes_of
from vibench.offline.formulated import Formulated
from vibench.offline.reduction import Reduction
from vibench.plugins.kinds import FORMULATION
from vibench.plugins.registry import find


def time_formulation(inputs: StageInputs, formulation: str) -> Timing:
    """What a formulation builds, and its model."""
    made: Formulation = find(FORMULATION, formulation).create({})
    offline = _phase(inputs, made)
    _built(made, offline)

    def judge(built: Formulated) -> Info:
        return _judge(inputs, built)

    return Timing("formulation", lambda: _built(made, offline), judge)


def time_formulated_query(inputs: StageInputs, formulation: str) -> Timing:
    """A query of a formulation; reached are errors, and residuals of the high-fidelity problem."""
    made: Formulation = find(FORMULATION, formulation).create({})
    built, mus = _built(made, _phase(inputs, made)), in_turn(inputs)

    def query() -> FormulationAnswer:
        return built.model.solve(next(mus), built.asked()[0])

    return Timing("query of a formulation", query, lambda _: _judge(inputs, built), together=QUERIES)


def _phase(inputs: StageInputs, formulation: Formulation) -> Reduction:
    """The offline phase with the steps that a formulation uses, assembled in the quickest way there is."""
    uses = axes_of(formulation, f"formulation {type(formulation).__qualname__}")
    whole = inputs.online(inputs.usual, inputs.primal)
    given: dict[str, Any] = {"snapshots": whole.snapshots, "parameters": whole.parameters}
    given |= {"pod": whole.pod} if "pod" in uses else {}
    given |= {"cone": whole.cone, "multipliers": whole.multipliers} if "dual" in uses else {}
    given |= {"enrichment": whole.enrichment, "operators": whole.operators} if "primal" in uses else {}
    given |= {"members": whole.members} if "assembly" in uses else {}
    without: dict[str, Any] = {} if "primal" in uses else {"primal": None, "tolerance": None}
    without |= {} if "dual" in uses else {"dual": None, "generators": None}
    without |= {} if "pod" in uses else {"modes": None}
    without |= {} if "assembly" in uses else {"assembly": "full"}
    return replace(whole, **without).given(**given)


def _built(formulation: Formulation, offline: Reduction) -> Formulated:
    """The formulation on an offline phase, its model made."""
    try:
        built = offline.formulated(formulation)
    except UnsupportedError as error:
        raise LeftOutError(str(error)) from None
    built.model  # noqa: B018  is made
    return built


def _judge(inputs: StageInputs, built: Formulated) -> Info:
    """Status, residuals and errors of its answers at the validation parameters."""
    answers = [built.solve(query.mu) for query in inputs.queries]
    worst = max(answers, key=lambda answer: answer.status.severity)
    figures: list[Mapping[str, float]] = [
        residual_figures(answer.residuals) | errors_of(inputs, query, answer.u, answer.lam)
        for query, answer in zip(inputs.queries, answers, strict=True)
        if answer.verdict.pair is not None
    ]
    return {
        "N": built.model.dimension, "R": built.model.generators, "status": worst.status.value, "reason": worst.reason,
        "accuracy": largest_figures(figures) if len(figures) == len(answers) else {},
    }  # fmt: skip


FORMULATIONS: tuple[Callable[..., Timing], ...] = (time_formulation, time_formulated_query)
"""The benchmarks."""
