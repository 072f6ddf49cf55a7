"""Enlarged cone: the generators of CPG, each without its part in the cone of the others."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge

from vibench import Array, DualStrategy, InnerProduct, ReducedSet, Stop, greedy_cone, no_free, project_on_cone
from vibench.reduction import subtract_cone_component
from vibench_strategies.snapshot_cones import projection_errors

ROUND_OFF = 1e-9
"""A part of smaller norm is not subtracted from its generator; a generator this close to the others is dropped."""


class EnlargedCPG(DualStrategy):
    """A cone that contains that of CPG and has no more generators, as discussed in Remark 4.4 of Niakh et al. (2022).

    Each generator ν of CPG in turn is replaced by ν − Υ ≥ 0, where Υ is its part in the cone of the others (line 9 of
    Algorithm 2). Since ν = (ν − Υ) + Υ, the cone can only grow. Sweeps are repeated until no generator changes.
    """

    def __init__(self, sweeps: Annotated[int, Ge(1)] = 100) -> None:
        self.sweeps = sweeps

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Sweep over the generators of CPG; a generator in the cone of the others is dropped."""
        chi, notes = greedy_cone(snapshots, W, stop).generators, list[str]()
        for sweep in range(1, self.sweeps + 1):
            changed, i = False, 0
            while i < chi.shape[1]:
                others = np.delete(chi, i, axis=1)
                if project_on_cone(others, chi[:, i], W).distance <= ROUND_OFF:
                    changed, chi = True, others  # i stays: it is now the index of the next generator
                    continue
                rest, note = subtract_cone_component(chi[:, i], others, W)
                notes += [f"sweep {sweep}, generator {i + 1}: {note}"] if note else []
                if W.norm(chi[:, i] - rest) > ROUND_OFF:
                    changed, chi = True, np.insert(others, i, rest / W.norm(rest), axis=1)
                i += 1
            if not changed:
                break
        else:
            notes.append(f"generators still changed in sweep {self.sweeps}")
        return ReducedSet(chi, projection_errors(chi, snapshots, W), no_free(chi.shape[1]), tuple(notes))
