"""Enlarged cone: the generators of CPG, each widened by what the others have in it."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge

from vibench import (
    Array,
    Cone,
    DualStrategy,
    InnerProduct,
    Stop,
    greedy_cone,
    no_free,
    project_on_cone,
    projection_errors,
)
from vibench_strategies.mcpg import part_in_cone

ROUND_OFF = 1e-9
"""A generator that loses less than this share of its norm stays as it is; one no farther from the others is dropped."""


class EnlargedCPG(DualStrategy):
    """A cone around a given one with no more generators, the idea that Remark 4.4 of Niakh et al. (2022) compares with.

    Each generator ν of CPG in turn leaves its best part Υ in the cone of the others, with ν − Υ ≥ 0, behind (line 9 of
    Algorithm 2). Since ν = (ν − Υ) + Υ the cone only grows. Sweeps go on until nothing moves.
    """

    def __init__(self, sweeps: Annotated[int, Ge(1)] = 100) -> None:
        self.sweeps = sweeps

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> Cone:
        """CPG, then sweeps over its generators; one that the others contain is dropped."""
        chi, notes = greedy_cone(snapshots, W, stop).generators, list[str]()
        for sweep in range(1, self.sweeps + 1):
            moved, i = False, 0
            while i < chi.shape[1]:
                others = np.delete(chi, i, axis=1)
                if project_on_cone(others, chi[:, i], W).distance <= ROUND_OFF:
                    moved, chi = True, others
                    continue
                part, note = part_in_cone(chi[:, i], others, W)
                notes += [f"sweep {sweep}, generator {i + 1}: {note}"] if note else []
                if W.norm(part) > ROUND_OFF:
                    rest = chi[:, i] - part
                    moved, chi = True, np.insert(others, i, rest / W.norm(rest), axis=1)
                i += 1
            if not moved:
                break
        else:
            notes.append(f"generators still moved in sweep {self.sweeps}")
        return Cone(chi, projection_errors(chi, snapshots, W), no_free(chi.shape[1]), tuple(notes))
