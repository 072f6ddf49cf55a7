"""Local bases: clusters of training parameters or of contact sets, each with spaces and a cone of its own."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Ge
from scipy.cluster.vq import kmeans2

from vibench import (
    POD,
    Array,
    Formulation,
    FormulationAnswer,
    FormulationModel,
    Indices,
    ParameterBox,
    Problem,
    QuerySettings,
    Snapshots,
    Stop,
    UnsupportedError,
    pod,
)
from vibench_strategies.formulations.reduced_programs import PhasesModel, largest_dimension, solved

if TYPE_CHECKING:
    from vibench import OfflinePhase

INDEPENDENT = 1e-10
"""Relative tail of the POD of a cluster below which there are no further modes."""


class Local(Formulation):
    """Mixed models with local bases, as Amsallem, Zahr and Farhat (2012) and Le Berre et al. (2022) have them.

    k-means makes clusters of the training parameters, or of the contact sets of their solutions. A quadratic polynomial
    of the parameter for each cluster, the largest of which names the cluster, chooses at the query: that of the nearest
    centroid, or a least squares fit of the clusters of contact sets. The snapshots of a cluster are those that
    the polynomials give it, so that queries are answered by the spaces trained around them. POD, cone and enrichment
    are those of the study for the snapshots of one cluster.

    Parameters
    ----------
    clusters
        Their number; those without a snapshot are left out.
    by
        What is clustered: "parameters", by their distance relative to the box, or "contact" sets, by the size of their
        symmetric difference.
    seed
        Of the first centroids.
    """

    def __init__(
        self,
        clusters: Annotated[int, Ge(1)] = 4,
        by: Literal["parameters", "contact"] = "parameters",
        seed: Annotated[int, Ge(0)] = 0,
    ) -> None:
        self.clusters, self.by, self.seed = clusters, by, seed

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        """The polynomials, and POD, cone and enrichment of every cluster."""
        weights, owners = self._chosen(offline.problem, offline.snapshots)
        steps = []
        for number in range(weights.shape[1]):
            part = _restricted(offline, owners == number)
            if part.modes is not None and part.modes.size is not None:
                # a cluster may have fewer modes than asked for
                all_modes = pod(part.snapshots.u, part.problem.V, Stop(tolerance=INDEPENDENT))
                part = part.given(pod=POD(all_modes.basis[:, : part.modes.size], all_modes.errors))
            if part.enrichment.supply is not None:
                raise UnsupportedError("local bases cannot be stored for an enrichment that supplies its own vectors")
            part.assembled  # noqa: B018  reduced operators are prepared offline
            steps.append({name: getattr(part, name) for name in ("pod", "cone", "enrichment")})
        return {"weights": weights, "owners": owners, "steps": steps}

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        """The models of the clusters."""
        known = enumerate(built["steps"])
        parts = [_restricted(offline, built["owners"] == number).given(**steps) for number, steps in known]
        return LocalModel(offline.problem.parameters, built["weights"], parts)

    def _chosen(self, problem: Problem, snapshots: Snapshots) -> tuple[Array, Indices]:
        """Coefficients (features×K) of the polynomials, and the largest of them at training parameters (P,)."""
        places = problem.parameters.to_unit(snapshots.mu)
        features = np.array([_features(place) for place in places])
        if self.by == "parameters":
            centroids = _clusters(places, self.clusters, self.seed)[0]
            # |µ − c|² is smallest where µ·c − |c|²/2 is largest
            weights = np.zeros((features.shape[1], len(centroids)))
            weights[0], weights[1 : 1 + centroids.shape[1]] = -0.5 * np.sum(centroids**2, axis=1), centroids.T
        else:
            measures = np.sqrt(np.maximum(problem.multiplier_integrals(), 0.0))
            labels = _clusters(np.where(snapshots.lam.T > 0.0, measures, 0.0), self.clusters, self.seed)[1]
            one_hot = (labels[:, None] == np.unique(labels)).astype(float)
            weights = np.linalg.lstsq(features, one_hot, rcond=None)[0]
        present, owners = np.unique([_largest(place, weights) for place in places], return_inverse=True)
        return np.ascontiguousarray(weights[:, present]), owners


class LocalModel(PhasesModel):
    """Models of clusters, one of which answers a query."""

    def __init__(self, box: ParameterBox, weights: Array, parts: Sequence[OfflinePhase]) -> None:
        super().__init__(parts)
        # `to_unit` would check in every query what comes from a study.
        self._lower, self._widths, self._weights = box.lower, box.widths, weights
        self.enrichment = self.dimension - max(parts, key=largest_dimension).pod.basis.shape[1]
        lines = [(*part.cone.fallbacks, *part.enrichment.fallbacks) for part in parts]
        self.fallbacks = tuple(f"cluster {number}: {line}" for number, of in enumerate(lines) for line in of)

    def phase(self, mu: Array) -> int:
        """The cluster that answers at mu (d,), at the cost of one polynomial for each."""
        return _largest((mu - self._lower) / self._widths, self._weights)

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        """The mixed program of the cluster, solved by the QP solver of the cell."""
        reduced = self.assembled(mu)
        return solved(settings, reduced.program, reduced.factor)


def _largest(place: Array, weights: Array) -> int:
    """Which polynomial is the largest at a place (d,)."""
    return int(np.argmax(_features(place) @ weights))


def _features(place: Array) -> Array:
    """1, a place (d,) and the products of its coordinates, of which polynomials are sums."""
    i, j = _pairs(len(place))
    return np.concatenate([[1.0], place, place[i] * place[j]])


@cache
def _pairs(d: int) -> tuple[Indices, Indices]:
    """Cached: numbers of the coordinates of all products of two."""
    return np.triu_indices(d)


def _clusters(points: Array, count: int, seed: int) -> tuple[Array, Indices]:
    """Centroids and the number (P,) of the nearest one, by k-means; as many as there are different points at most."""
    count = min(count, len(np.unique(points, axis=0)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a cluster without points is left out
        centroids, labels = kmeans2(points, count, 100, minit="++", rng=np.random.default_rng(seed))
    kept = np.unique(labels)
    return centroids[kept], np.searchsorted(kept, labels)


def _restricted(offline: OfflinePhase, mask: Any) -> OfflinePhase:
    """The reduction for some of the snapshots; sums of terms are those of all."""
    all_of = offline.snapshots
    known: dict[str, Any] = {"snapshots": Snapshots(all_of.mu[mask], all_of.u[:, mask], all_of.lam[:, mask])}
    if offline.assembly != "full":
        known |= {"members": offline.members}
    return replace(offline).given(**known)
