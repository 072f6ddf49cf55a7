from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from samples import with_ways

import vibench
from vibench import NumericalError, Output, RequestError
from vibench.model.certificates.base import output_weights
from vibench.model.certificates.bounds import OnlineBound, output_error_bound
from vibench.model.errors import ReferenceSolutions, output_errors, output_scales, summarise_outputs

MUS = np.array([[1.0], [2.0], [3.0]])
U, LAM = np.array([[1.0, 2.0, 0.0], [1.0, 1.0, 0.0]]), np.array([[0.0, 4.0, 0.0]])
TOTAL = Output("total", "m", u=np.array([1.0, 1.0]), lam=np.array([0.5]))
LARGEST = Output("largest", "1", function=lambda mu, u, lam: mu[0] * u.max() + lam.sum())
FLOATS = st.floats(-1e3, 1e3)


def test_values_are_what_the_coefficients_or_the_function_give() -> None:
    assert TOTAL.values(MUS, U, LAM).tolist() == [2.0, 5.0, 0.0]
    assert LARGEST.values(MUS, U, LAM).tolist() == [1.0, 8.0, 0.0]
    assert (TOTAL.linear, LARGEST.linear) == (True, False)
    assert output_scales((TOTAL, LARGEST), MUS, U, LAM) == (5.0, 8.0)


@given(u=arrays(float, (2, 3), elements=FLOATS), v=arrays(float, (2, 3), elements=FLOATS), t=FLOATS)
def test_a_linear_output_is_linear(u: np.ndarray, v: np.ndarray, t: float) -> None:
    together = TOTAL.values(MUS, u + t * v, LAM * (1.0 + t))
    apart = TOTAL.values(MUS, u, LAM) + t * TOTAL.values(MUS, v, LAM)
    np.testing.assert_allclose(together, apart, atol=1e-8)


def test_errors_are_relative_but_for_zeros_which_are_counted_apart() -> None:
    reduced = U + np.array([[0.2, 0.0, 0.1], [0.0, -0.5, 0.0]]), LAM
    exact = ReferenceSolutions(U, LAM, 1.0, 1.0, output_scales((TOTAL,), MUS, U, LAM))
    found = output_errors((TOTAL,), MUS, reduced, exact)
    rows = [row for (row,) in found]
    assert [row["error"] for row in rows] == [pytest.approx(0.1), pytest.approx(0.1), None]
    assert [row["scaled"] for row in rows] == [pytest.approx(x) for x in (0.04, 0.1, 0.02)]
    assert (rows[1]["value"], rows[1]["reference"], rows[1]["unit"]) == (4.5, 5.0, "m")
    (summary,) = summarise_outputs((TOTAL,), (5.0,), found)
    assert summary == {
        "output": "total", "unit": "m", "linear": 1, "scale": 5.0, "queries_ok": 3,
        "error_mean": pytest.approx(0.1), "error_max": pytest.approx(0.1), "queries_zero": 1,
        "error_zero_max": pytest.approx(0.02), "error_scaled_mean": pytest.approx(0.16 / 3),
        "error_scaled_max": pytest.approx(0.1),
    }  # fmt: skip


def test_an_output_that_vanishes_on_the_whole_training_set_has_absolute_errors() -> None:
    zero = ReferenceSolutions(0.0 * U[:, :1], LAM[:, :1], 1.0, 1.0, (0.0,))
    (row,), *_ = output_errors((TOTAL,), MUS[:1], (U[:, :1], LAM[:, :1]), zero)
    assert (row["error"], row["scaled"]) == (None, 2.0)
    # without an ok query there are no errors
    (row,) = summarise_outputs((TOTAL,), (5.0,), [])
    assert (row["error_mean"], row["error_scaled_max"], row["queries_ok"]) == (None, None, 0)


@pytest.mark.parametrize(
    ("output", "words"),
    [
        (Output("long", "m", u=np.ones(3)), r"'long' has coefficients of u of shape \(3,\); expected \(2,\)"),
        (Output("wide", "m", lam=np.ones(2)), r"'wide' has coefficients of λ of shape \(2,\); expected \(1,\)"),
        (Output("fails", "m", function=lambda *_: 1 / 0), r"'fails' fails at mu = \[1.0\]: ZeroDivisionError"),
        (Output("none", "m", function=lambda *_: None), "'none' fails at .*TypeError"),  # type: ignore[arg-type, return-value]
        (Output("nan", "m", function=lambda mu, *_: np.nan if mu[0] > 1 else 0.0), r"'nan' is nan at mu = \[2.0\]"),
    ],
)
def test_what_is_wrong_is_named(output: Output, words: str) -> None:
    with pytest.raises(NumericalError, match=words):
        # As vibench itself calls it; coefficients of others are compared with what they are given.
        Output.values.__wrapped__(output, MUS, U, LAM)


def test_an_output_is_linear_or_a_function_which_cannot_change_the_solution() -> None:
    given = U.copy()
    Output("greedy", "1", function=lambda mu, u, lam: np.multiply(u, 0.0, out=u).sum()).values(MUS, given, LAM)
    assert np.array_equal(given, U)
    for more in ({}, {"u": np.ones(2), "function": lambda *_: 0.0}):
        with pytest.raises(RequestError, match="the output 's' has either coefficients of u and λ, or a function"):
            Output("s", "1", **more)


@pytest.fixture(scope="module")
def model(small_run: vibench.Run) -> vibench.Model:
    rows = with_ways(small_run.cells).set_index(["problem", "primal", "assembly"])
    return small_run.model(str(rows.loc[("obstacle", "decorrelated", "certified"), "cell"]))


def test_the_bound_of_an_output_of_lambda_is_far_below_that_in_w_where_it_is_smooth(model: vibench.Model) -> None:
    problem, base = model.problem, model.certificate.base
    force = Output("force", "N", lam=problem.W.apply(np.ones(problem.W.dim)))
    in_W = float(np.linalg.norm(problem.W.whiten_functional(force.lam))) / base.inf_sup.value
    of_u, of_lam = output_weights(problem, base, force)
    assert of_u == 0.0
    assert 0.0 < of_lam < 0.2 * in_W


def test_there_is_no_bound_without_those_of_u_and_lambda(model: vibench.Model) -> None:
    base, bound = model.certificate.base, model.solve(model.parameters.lower).bound
    assert output_error_bound((2.0, 0.0), base, bound) == pytest.approx(2.0 * bound.u_energy / bound.coercivity**0.5)
    assert output_error_bound((2.0, 1.0), base, replace(bound, inf_sup=0.0, lam=np.inf)) == np.inf
    assert output_error_bound((2.0, 0.0), base, replace(bound, inf_sup=0.0, lam=np.inf)) < np.inf
    assert output_error_bound((0.0, 0.0), base, OnlineBound.none("why")) == np.inf
    unproved = replace(base, inf_sup=replace(base.inf_sup, value=0.0, note="why"))
    assert output_weights(model.problem, unproved, Output("s", "1", lam=np.ones(model.problem.W.dim)))[1] == np.inf
    with pytest.raises(NumericalError, match="coefficients of λ of shape"):
        output_weights(model.problem, base, Output("s", "1", lam=np.ones(1)))
