"""Bounds of outputs hold, and are infinite where those that they rest on are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from samples import with_ways

import vibench
from vibench.errors import NumericalError
from vibench.interfaces.outputs import Output
from vibench.model.certificates.base import output_weights
from vibench.model.certificates.bounds import OnlineBound, output_error_bound


@pytest.fixture(scope="module")
def model(small_run: vibench.Run) -> vibench.Model:
    rows = with_ways(small_run.cells).set_index(["problem", "primal", "assembly"])
    return small_run.model(str(rows.loc[("obstacle", "decorrelated", "certified"), "cell"]))


def test_the_bound_of_an_output_of_lambda_is_at_most_that_in_w_and_far_below_where_it_is_smooth(
    model: vibench.Model,
) -> None:
    assert model.certificate is not None
    problem, base = model.problem, model.certificate.base
    force = Output("force", "N", lam=problem.W.apply(np.ones(problem.W.dim)))
    assert force.lam is not None
    in_W = float(np.linalg.norm(problem.W.whiten_functional(force.lam))) / base.inf_sup.value
    of_u, of_lam = output_weights(problem, base, force)
    assert of_u == 0.0
    assert 0.0 < of_lam < 0.2 * in_W


def test_there_is_no_bound_without_those_of_u_and_lambda(model: vibench.Model) -> None:
    assert model.certificate is not None
    base, bound = model.certificate.base, model.solve(model.parameters.lower).bound
    assert bound is not None
    assert output_error_bound((2.0, 0.0), base, bound) == pytest.approx(2.0 * bound.u_energy / bound.coercivity**0.5)
    assert output_error_bound((2.0, 1.0), base, replace(bound, inf_sup=0.0, lam=np.inf)) == np.inf
    assert output_error_bound((2.0, 0.0), base, replace(bound, inf_sup=0.0, lam=np.inf)) < np.inf
    assert output_error_bound((0.0, 0.0), base, OnlineBound.none("why")) == np.inf
    unproved = replace(base, inf_sup=replace(base.inf_sup, value=0.0, note="why"))
    assert output_weights(model.problem, unproved, Output("s", "1", lam=np.ones(model.problem.W.dim)))[1] == np.inf
    with pytest.raises(NumericalError, match="coefficients of λ of shape"):
        output_weights(model.problem, base, Output("s", "1", lam=np.ones(1)))
