"""A fixed enrichment contains the supremizers of every parameter if B is constant, of the references otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from vibench import (
    Array,
    Enrichment,
    Offline,
    Problem,
    ReducedSet,
    VariationalInequality,
    check_enrichment,
    no_free,
    supremizers,
)
from vibench_rope.fixed_supremizers import FixedSupremizers
from vibench_rope.rope import Rope


class Weighted(Rope):
    """A rope whose constraint varies with the tilt, and not by a factor."""

    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        return replace(vi, B=vi.B @ sp.diags_array(np.exp(mu[1] * self.x)))

    def contact(self, mu: Array) -> None:
        """Nothing: its constraint is that of `assemble`."""


def offline(problem: Problem) -> Offline:
    """Two modes, three generators, nine training parameters."""
    rng = np.random.default_rng(4)
    basis = problem.V.orthonormalise(rng.standard_normal((problem.V.dim, 2)))
    chi = rng.random((problem.W.dim, 3))
    chi /= problem.W.norm(chi)
    cone = ReducedSet(chi, np.zeros(4), no_free(3))
    return Offline(problem, basis, cone, problem.W.orthonormalise(chi), problem.parameters.grid(3, 3))


def lacking(given: Offline, added: Enrichment, mu: Array) -> float:
    """Largest relative projection error of a supremizer at mu on the enriched space."""
    V, wanted = given.problem.V, supremizers(given.problem.V, given.problem.constraint(mu)[0], given.cone.generators)
    assert added.vectors is not None
    space = np.hstack([given.basis, added.vectors])
    return float(np.max(V.norm(wanted - space @ V.gram(space, wanted)) / V.norm(wanted)))


def test_one_reference_serves_every_parameter_of_the_rope() -> None:
    given = offline(Rope(half=10))
    added = check_enrichment(FixedSupremizers().build(given, None), given.problem.V, given.basis)
    assert added.vectors is not None
    assert added.vectors.shape[1] == 3
    assert max(lacking(given, added, mu) for mu in given.problem.parameters.sample(5, 1)) < 1e-12


@pytest.mark.parametrize(
    ("references", "places"), [(1, [4]), (2, [2, 6]), (3, [1, 4, 7]), (9, range(9)), (50, range(9))]
)
def test_where_the_constraint_varies_the_references_are_served(references: int, places: Sequence[int]) -> None:
    given = offline(Weighted(half=30))
    added = check_enrichment(FixedSupremizers(references).build(given, None), given.problem.V, given.basis)
    served = [k for k, mu in enumerate(given.training) if lacking(given, added, mu) < 1e-10]
    tilts = {given.training[k][1] for k in places}
    assert served == [k for k, mu in enumerate(given.training) if mu[1] in tilts]
