"""Decisions by bounds are those of the high-fidelity model; false bounds are caught; words say what is proved."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from samples import pga_reduction

import vibench
from vibench.calibration import decisions
from vibench.calibration.data import Data, Prior, Sensors
from vibench.calibration.decisions import BoundedSensors, Decisions, Prediction, RefutedError
from vibench.calibration.metropolis import Metropolis, summary
from vibench.calibration.ranked import minimise
from vibench.errors import RequestError
from vibench.model.certificates.base import Guarantee, output_coefficients
from vibench.model.certificates.bounds import OnlineBound
from vibench.offline.models import CellSolver
from vibench.qp.verification import QPSolution
from vibench_problems.radial import Radial

TRUTH = np.array([0.17, 0.1])
NAMES = ("inner deflection", "middle deflection", "outer deflection")
NUMBERS = st.floats(-10.0, 10.0)
STEPS = 120


@cache
def radial() -> vibench.Model:
    return pga_reduction(Radial("coarse"), 1e-2, 1e-3, assembly="reduced", bounds=True).model


@cache
def bounded() -> BoundedSensors:
    return BoundedSensors(radial(), NAMES)


@cache
def data(noise: float) -> Data:
    exact = Sensors(radial().problem, NAMES)(TRUTH)
    errors = np.random.default_rng(1).standard_normal(3)
    return Data.independent(NAMES, exact * (1.0 + noise * errors), noise * np.abs(exact))


def chain(noise: float, steps: int, *models: Callable[[np.ndarray], Prediction], audit: float = 0.01) -> Metropolis:
    decided = Decisions(radial().problem, data(noise), models, audit, 0)
    made = Metropolis(decided, Prior.of(radial().parameters), steps // 5, 3)
    while made.steps < steps:
        made.step()
    return made


def with_covariance(root: np.ndarray) -> Data:
    covariance = root @ root.T + 0.1 * np.eye(3)
    return Data(NAMES, np.array([1.0, 2.0, 3.0]), 0.5 * (covariance + covariance.T))


@cache
def exact_chain(noise: float) -> Metropolis:
    """That of the high-fidelity model."""
    return chain(noise, STEPS)


@given(
    outputs=arrays(float, 3, elements=NUMBERS), share=arrays(float, 3, elements=st.floats(-1.0, 1.0)),
    bounds=arrays(float, 3, elements=st.floats(0.0, 5.0)), root=arrays(float, (3, 3), elements=st.floats(-1.0, 1.0)),
)  # fmt: skip
def test_the_misfit_of_outputs_within_their_bounds_is_in_the_interval(
    outputs: np.ndarray, share: np.ndarray, bounds: np.ndarray, root: np.ndarray
) -> None:
    measured = with_covariance(root)
    low, high = measured.interval(outputs, bounds)
    apart = outputs + share * bounds - measured.values
    misfit = 0.5 * apart @ np.linalg.solve(measured.covariance, apart)
    assert low * (1.0 - 1e-9) - 1e-9 <= misfit <= high * (1.0 + 1e-9) + 1e-9
    assert measured.interval(outputs, np.zeros(3)) == (measured.misfit(outputs),) * 2
    assert measured.interval(outputs, np.array([0.0, np.inf, 0.0])) == (0.0, np.inf)


def test_independent_noise_gives_the_interval_of_each_sensor_by_itself() -> None:
    measured = Data.independent(("a", "b"), np.array([1.0, 0.0]), np.array([0.5, 2.0]))
    assert measured.interval(np.array([3.0, 1.0]), np.array([1.0, 2.0])) == pytest.approx(
        (0.5 * 4.0, 0.5 * (36 + 2.25))
    )


@pytest.mark.parametrize("noise", [0.03, pytest.param(0.003, marks=pytest.mark.long)])
def test_chains_by_bounds_are_those_of_the_high_fidelity_model(noise: float) -> None:
    exact, found = exact_chain(noise), chain(noise, STEPS, bounded())
    counts = found.decisions.counts
    assert np.array_equal(found.states, exact.states)
    assert found.decisions.claim == "exact"
    assert counts.decisions == exact.decisions.counts.decisions
    assert counts.undecided < 0.2 * counts.decisions
    assert len(found.decisions.answers) < 0.5 * len(exact.decisions.answers)
    assert 0.1 < found.accepted.mean() < 0.6
    spent = [seconds for _, seconds in found.decisions.answers.values()]
    assert found.decisions.high_fidelity_seconds == pytest.approx(np.mean(spent) * len(exact.decisions.answers))


@given(
    outputs=arrays(float, 3, elements=NUMBERS), root=arrays(float, (3, 3), elements=st.floats(-1.0, 1.0)),
    functionals=arrays(float, (3, 4), elements=st.floats(-1.0, 1.0)), error=arrays(float, 4, elements=NUMBERS),
)  # fmt: skip
def test_the_misfit_of_outputs_with_correlated_errors_is_in_the_interval(
    outputs: np.ndarray, root: np.ndarray, functionals: np.ndarray, error: np.ndarray
) -> None:
    measured = with_covariance(root)
    functionals = functionals + 1e-3 * np.eye(3, 4)
    norms = np.linalg.norm(functionals, axis=1)
    bounds, correlation = norms * np.linalg.norm(error), functionals @ functionals.T / np.outer(norms, norms)
    low, high = measured.interval(outputs, bounds, correlation)
    misfit = measured.misfit(outputs + functionals @ error)
    assert low * (1.0 - 1e-9) - 1e-9 <= misfit <= high * (1.0 + 1e-9) + 1e-9
    wide = measured.interval(outputs, bounds)
    assert wide[0] <= low <= high <= wide[1]


def test_errors_of_two_equal_sensors_do_not_add_up_where_the_data_are_on_both_sides() -> None:
    # The linear term vanishes: ½ (e − 1)² + ½ (e + 1)² = 1 + e².
    measured = Data.independent(("a", "b"), np.array([1.0, -1.0]), np.ones(2))
    low, high = measured.interval(np.zeros(2), np.array([0.1, 0.1]), np.ones((2, 2)))
    assert (low, high) == pytest.approx((1.0, 1.01), abs=3e-4)
    assert measured.interval(np.zeros(2), np.array([0.1, 0.1])) == pytest.approx((0.81, 1.21))


def test_the_correlation_of_sensors_is_that_of_their_functionals() -> None:
    base, outputs = bounded().base, [output_coefficients(radial().problem, one)[0] for one in radial().problem.outputs]
    functionals = np.array(outputs)[: len(NAMES)]
    products = functionals @ np.linalg.solve(base.X.matrix.toarray(), functionals.T)
    expected = products / np.sqrt(np.outer(np.diag(products), np.diag(products)))
    np.testing.assert_allclose(bounded()(TRUTH).correlation, expected, rtol=1e-9)


def test_a_larger_model_is_queried_where_the_smaller_one_does_not_decide() -> None:
    true, asked = bounded(), []

    def small(mu: np.ndarray) -> Prediction:
        found = true(mu)
        return found._replace(outputs=1.002 * found.outputs, bounds=found.bounds + 0.004 * np.abs(found.outputs))

    def large(mu: np.ndarray) -> Prediction:
        asked.append(mu)
        return true(mu)

    both, alone = chain(0.01, STEPS, small, large, audit=0.0), chain(0.01, STEPS, small, audit=0.0)
    assert np.array_equal(both.states, exact_chain(0.01).states)
    assert both.decisions.counts.undecided == chain(0.01, STEPS, true, audit=0.0).decisions.counts.undecided
    assert both.decisions.counts.undecided < 0.5 * alone.decisions.counts.undecided
    assert 0 < len(asked) < 0.5 * both.decisions.counts.decisions
    with pytest.raises(RefutedError, match=r"the misfit is .* to .*, and .* to .* by another model"):
        chain(0.003, STEPS, small, lambda mu: (found := true(mu))._replace(outputs=1.1 * found.outputs))


def test_without_bounds_some_decisions_are_wrong_and_are_counted() -> None:
    coarse = bounded()

    def biased(mu: np.ndarray) -> Prediction:
        outputs, bounds, guarantee, _ = coarse(mu)
        # a model that is a percent off, and knows it
        return Prediction(1.01 * outputs, bounds + 0.01 * np.abs(outputs) + 1e-9, guarantee)

    found = chain(0.003, STEPS, biased)
    assert found.decisions.counts.wrong > 0
    assert np.array_equal(found.states, exact_chain(0.003).states)


def test_a_false_certificate_is_caught_by_an_audit_which_names_the_parameter() -> None:
    true = bounded()

    def false(mu: np.ndarray) -> Prediction:
        outputs, bounds, guarantee, _ = true(mu)
        return Prediction(outputs * 1.02, 1e-6 * bounds, guarantee)

    # almost nothing is undecided, so that only audits ask
    with pytest.raises(
        RefutedError, match=r"the bounds are refuted at mu = \[0\.1\d+, 0\.\d+\]: .* by the high-fidelity model"
    ):
        chain(0.01, 400, false, audit=0.05)
    unheard = chain(0.01, 30, false, audit=0.0)
    assert not unheard.decisions.answers


def test_verified_bounds_are_said_to_be_without_contradiction_only() -> None:
    true = bounded()
    found = chain(0.01, 60, lambda mu: true(mu)._replace(guarantee=Guarantee.VERIFIED), audit=0.2)
    assert found.decisions.counts.audits > 3
    assert found.decisions.claim == f"no contradiction in {found.decisions.counts.audits} audits"


def test_bounds_allow_for_the_accuracy_of_high_fidelity_solutions() -> None:
    outputs, bounds, guarantee, _ = bounded()(TRUTH)
    solution = radial().solve(TRUTH)
    alone = np.array([solution.output_bounds[name] for name in NAMES])
    np.testing.assert_allclose(outputs, [solution.outputs[name] for name in NAMES], rtol=1e-12)
    assert guarantee is Guarantee.CERTIFIED
    # by 3 √ε of the force, which is about that of the whole contact
    assert ((bounds > alone) & (bounds < alone + 1e-3 * np.abs(outputs))).all()
    exact = Sensors(radial().problem, NAMES)(TRUTH)
    assert (np.abs(exact - outputs) <= bounds).all()


def test_where_there_is_no_bound_the_high_fidelity_model_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    found = chain(0.01, 20, bounded())
    predict = BoundedSensors(radial(), NAMES)
    # the certificate finds no bound, or the solver no solution
    monkeypatch.setattr(predict, "certificate", SimpleNamespace(certify=lambda *_: (OnlineBound.none("why"), None)))
    without = chain(0.01, 20, predict)
    monkeypatch.setattr("vibench.offline.models.solve_qp", lambda *_: QPSolution(None, None, "failed"))
    for other in (without, chain(0.01, 20, predict)):
        assert other.decisions.counts.undecided == other.decisions.counts.decisions > 0
        assert other.decisions.claim == "exact"
        assert np.array_equal(other.states, found.states)


def test_queries_begin_with_the_last_solution_of_the_same_size(monkeypatch: pytest.MonkeyPatch) -> None:
    predict, starts, solve = BoundedSensors(radial(), NAMES), [], CellSolver.__call__

    def noted(solver: CellSolver, *program: object, **given: Any) -> QPSolution:
        starts.append(given["start"])
        return solve(solver, *program, **given)

    monkeypatch.setattr(CellSolver, "__call__", noted)
    one, other = predict(TRUTH), predict(TRUTH)
    np.testing.assert_allclose(one.outputs, other.outputs, rtol=1e-9)
    predict._last = np.zeros(1), starts[1][1]
    predict(TRUTH)
    assert starts[0] is starts[2] is None
    assert (starts[1][1] >= 0.0).all()


@cache
def compiled() -> decisions.CompiledSensors:
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    return decisions.CompiledSensors(bounded())


def test_the_c_program_has_the_bounds_of_vibench() -> None:
    assert bounded().model.certificate is not None
    for mu in radial().parameters.sample(20, 2):
        expected, found = bounded()(mu), compiled()(mu)
        assert (np.abs(found.outputs - expected.outputs) <= found.bounds + expected.bounds).all()
        # Corrected pairs have sharper ones, but for the accuracy of the high-fidelity solution.
        assert (found.bounds <= expected.bounds * 1.001).all()
        exact = Sensors(radial().problem, NAMES)(mu)
        assert (np.abs(exact - found.outputs) <= found.bounds).all()
        assert found.guarantee is Guarantee.CERTIFIED
    assert np.isinf(compiled()(radial().parameters.upper + 1.0).bounds).all()
    whole, other = chain(0.003, STEPS, compiled()), chain(0.003, STEPS, bounded())
    assert np.array_equal(whole.states, other.states)
    assert whole.decisions.claim == "exact"


def test_without_a_compiler_python_answers_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    predict, by = decisions.quickest_sensors(radial(), NAMES)
    assert isinstance(predict, BoundedSensors)
    assert by == "Python: the environment variable CC names the C compiler 'no-such-compiler', which is not found"
    with pytest.raises(RequestError, match="no linear output of the problem is called 'deflection'"):
        decisions.quickest_sensors(radial(), ("deflection",))


def test_what_has_no_bound_is_refused() -> None:
    with pytest.raises(RequestError, match="no linear output of the problem is called 'deflection'"):
        BoundedSensors(radial(), ("deflection",))
    with pytest.raises(RequestError, match="the model has no error bounds"):
        BoundedSensors(replace(radial(), certificate=None), NAMES)
    with pytest.raises(RequestError, match=r"audit of Decisions is 2\.0, expected a number from 0 to 1"):
        Decisions(radial().problem, data(0.01), (), 2.0, 0)


def test_cma_on_ranks_takes_the_path_of_the_high_fidelity_model() -> None:
    pytest.importorskip("cma")
    box, measured = radial().parameters, data(0.003)
    found, exact = (
        minimise(Decisions(radial().problem, measured, models, 0.01, 0), box, seed=4, iterations=8, tolx=1e-4)
        for models in ((bounded(),), ())
    )
    assert np.array_equal(found[0], exact[0])
    assert np.array_equal(found[1], exact[1])
    longer = minimise(
        Decisions(radial().problem, measured, [bounded()], 0.01, 0), box, seed=4, iterations=40, tolx=1e-4
    )
    outputs = Sensors(radial().problem, NAMES)(longer[0])
    assert (np.abs(outputs - measured.values) < 2.0 * np.sqrt(np.diag(measured.covariance))).all()


def test_earlier_answers_lead_to_the_same_chain_without_questions() -> None:
    whole = chain(0.003, STEPS, bounded())
    again = Decisions(radial().problem, data(0.003), [bounded()], 0.01, 0)
    again.earlier = dict(whole.decisions.answers)
    again._solved = None  # type: ignore[method-assign, assignment]  nothing is asked
    made = Metropolis(again, whole.prior, whole.burn_in, 3)
    while made.steps < STEPS:
        made.step()
    assert np.array_equal(made.states, whole.states)
    assert again.answers == whole.decisions.answers
    assert replace(again.counts, model_seconds=0.0) == replace(whole.decisions.counts, model_seconds=0.0)


def test_outside_the_box_nothing_is_claimed() -> None:
    decided = Decisions(radial().problem, data(0.01), [bounded()], 0.01, 0)
    outside = radial().parameters.upper + 0.001
    assert (decided.interval(outside).lower, decided.interval(outside).upper) == (0.0, np.inf)
    assert decided.interval(TRUTH).upper < np.inf


def test_the_posterior_is_that_of_the_closed_form() -> None:
    problem, measured = radial().problem, data(0.1)
    radii = [float(np.linalg.norm(problem.mesh.p[:, problem.free] @ output.u)) for output in problem.outputs]
    grid = problem.parameters.grid(81, 81)
    logs = np.array([-measured.misfit(problem.exact(mu).u(np.array(radii))) for mu in grid])
    # the trapezoidal rule on the box
    inside = np.where(np.isin(grid, [problem.parameters.lower, problem.parameters.upper]), 0.5, 1.0).prod(axis=1)
    weights = inside * np.exp(logs - logs.max())
    mean = weights @ grid / weights.sum()
    sd = np.sqrt(weights @ (grid - mean) ** 2 / weights.sum())
    found = summary(chain(0.1, 2000, bounded()))
    errors = found["error of mean"].to_numpy()
    assert (found["effective steps"] > 100).all()
    # a chance of 1e-4 for each mean; deviations have about the same relative error
    assert (np.abs(found["mean"] - mean) < 4.0 * errors).all()
    np.testing.assert_allclose(found["sd"], sd, rtol=4.0 * float((errors / found["sd"]).max()))


def test_a_normal_prior_is_truncated_to_the_box() -> None:
    box = radial().parameters
    prior = Prior.of(box, {"height": (0.5, 0.1)})
    inside = np.array([0.15, 0.1]), np.array([0.2, 0.2])
    assert prior.log_density(inside[1]) - prior.log_density(inside[0]) == pytest.approx(0.5 * (3.5**2 - 3.0**2))
    assert prior.log_density(np.array([0.21, 0.1])) == -np.inf
    with pytest.raises(RequestError, match="no parameter is called 'depth'"):
        Prior.of(box, {"depth": (0.0, 1.0)})
