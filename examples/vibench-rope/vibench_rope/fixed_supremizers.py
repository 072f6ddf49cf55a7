"""Supremizers of a few parameters, added once and for all."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge

from vibench import Enrichment, Kind, Offline, PrimalStrategy, supremizers


class FixedSupremizers(PrimalStrategy):
    """V_N + span T(mu_k)χ, k = 1 … K: the enrichment of Haasdonk, Salomon and Wohlmuth (2012), made offline.

    Their B does not depend on the parameter, so neither does T, and one reference parameter is enough: the pair is as
    stable as with the supremizers of every query. Where B does depend on it, that holds at the references alone.

    Parameters
    ----------
    references
        Number K of reference parameters, spread evenly over the training set; its middle if there is one.
    """

    def __init__(self, references: Annotated[int, Ge(1)] = 1) -> None:
        self.references = references

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:  # noqa: ARG002
        """What the supremizers of the reference parameters add to V_N, orthonormalised."""
        V, count = offline.problem.V, len(offline.training)
        places = np.unique(np.linspace(0, count - 1, 2 * min(self.references, count) + 1)[1::2].round().astype(int))
        found = [supremizers(V, offline.problem.constraint(mu)[0], offline.span) for mu in offline.training[places]]
        return Enrichment(Kind.FIXED, vectors=V.orthonormalise(np.hstack(found), against=offline.basis))
