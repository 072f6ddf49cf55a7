"""Supremizers at a few reference parameters, computed once offline."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge

from vibench import Enrichment, Kind, Offline, PrimalStrategy, supremizers


class FixedSupremizers(PrimalStrategy):
    """V_N + span T(mu_k)χ, k = 1 … K: the enrichment of Haasdonk, Salomon and Wohlmuth (2012), computed offline.

    Their B does not depend on the parameter, so neither does T, and one reference parameter is enough: the pair is as
    stable as with the supremizers of every query. Where B depends on mu, this holds at the reference parameters only.

    Parameters
    ----------
    references
        Number K of reference parameters, spread evenly over the training set.
    """

    def __init__(self, references: Annotated[int, Ge(1)] = 1) -> None:
        self.references = references

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:  # noqa: ARG002
        """Orthonormalise the supremizers at the reference parameters against V_N."""
        V, count = offline.problem.V, len(offline.training)
        # The midpoints of K equal parts of the training set; one reference is the middle of the set.
        places = np.unique(np.linspace(0, count - 1, 2 * min(self.references, count) + 1)[1::2].round().astype(int))
        found = [supremizers(V, offline.problem.constraint(mu)[0], offline.span) for mu in offline.training[places]]
        return Enrichment(Kind.FIXED, vectors=V.orthonormalise(np.hstack(found), against=offline.basis))
