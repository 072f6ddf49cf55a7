"""The task "calibration" of a study: what decisions of a chain cost a cell, and what they would be without bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench.calibration.data import Prior, Sensors, outputs_of, synthetic
from vibench.calibration.decisions import Decisions, Predict, Prediction, quickest_sensors
from vibench.calibration.metropolis import Metropolis
from vibench.offline.models import Model
from vibench.stages.artefacts import Store
from vibench.stages.base import Result, Row, Stage
from vibench.stages.cell_queries import CellQueries


@dataclass(frozen=True)
class CalibrationStage(Stage):
    """Metropolis chains by the model of a cell, at three levels of noise; the value is a row for each."""

    label = "calibration"

    queries: CellQueries
    # Key of the cell.
    cell: str

    @property
    def packages(self) -> frozenset[str]:
        return self.queries.packages

    @property
    def effort(self) -> float:
        # Of three chains a model without bounds asks every step.
        return 1200.0 if self.queries.certificate is None else 200.0

    def inputs(self) -> tuple[Stage, ...]:
        return self.queries.model_inputs

    def run(self, store: Store) -> Result:
        model, seed = self.queries.bounded_model(store), self.queries.validation_set.seed
        problem, box = model.problem, model.parameters
        sensors = tuple(output.name for output in outputs_of(problem))
        unbounded = model.certificate is None
        predict, by = (_unbounded(model, sensors), "model") if unbounded else quickest_sensors(model, sensors)
        rows: list[Row] = []
        exact = Sensors(problem)(box.sample(1, seed)[0])
        for noise in (0.03, 0.01, 0.003):
            data = synthetic(problem, exact, noise, seed)
            decisions = Decisions(problem, data, (predict,), 0.01, seed)
            # As many steps as show a decision in a hundred.
            chain = Metropolis(decisions, Prior.of(box), 100, seed)
            while chain.steps < 400:
                chain.step()
            counts = decisions.counts
            rows.append({
                "noise": noise, "steps": chain.steps, "decisions": counts.decisions,
                "asked": counts.undecided / max(counts.decisions, 1), "questions": len(decisions.answers),
                "audits": counts.audits, "wrong": counts.wrong, "claim": decisions.claim, "answered_by": by,
                "calibration_s": decisions.seconds, "hf_chain_s": decisions.high_fidelity_seconds,
            })  # fmt: skip
        return Result(tuple(rows))


def _unbounded(model: Model, sensors: tuple[str, ...]) -> Predict:
    """The outputs of a model without bounds: every decision is asked, and the wrong ones are counted."""

    def predict(mu: np.ndarray) -> Prediction:
        outputs = model.solve(mu).outputs
        return Prediction.without_bounds(np.array([outputs[name] for name in sensors], float))

    return predict
