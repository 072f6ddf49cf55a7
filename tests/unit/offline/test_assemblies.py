"""What a problem assembles, kept while there is room for it."""

from __future__ import annotations

import numpy as np
from numerics import Varying

from vibench.offline.assemblies import Assemblies


def test_assemblies_are_kept_up_to_a_limit_and_those_of_longest_ago_go_first() -> None:
    problem = Varying()
    one, two, three = (np.array([value]) for value in (0.2, 0.5, 0.8))
    given_before = problem.assemble(one)
    size = 12 * (given_before.A.nnz + given_before.B.nnz) + given_before.f.nbytes + given_before.g.nbytes
    kept = Assemblies(problem, limit=int(2.5 * size))
    first = kept.at(one)
    second = kept.at(two)
    assert kept.at(one) is first
    assert kept.at(two) is second
    kept.at(one)
    kept.at(three)  # for which the second has to go
    assert kept.at(one) is first
    assert kept.at(two) is not second
