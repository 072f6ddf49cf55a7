"""Partial slip against Cattaneo's and Mindlin's closed form, and reduced models in its dual set."""

from pathlib import Path

import numpy as np
import pytest

from vibench import DualStrategy, Formulation, Reduction, Snapshots, Stop, Study, UnsupportedError, run
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.model.error_bounds import corrected_pair
from vibench.offline.assemblies import assemblies
from vibench.offline.sample_problem import MovingSupport
from vibench_problems.tresca import Tresca
from vibench_strategies.cpg import CPG
from vibench_strategies.formulations.dual_program import DualProgram
from vibench_strategies.formulations.mixed import Mixed
from vibench_strategies.hull_greedy import HullGreedy
from vibench_strategies.offline_pga import OfflinePGA
from vibench_strategies.online_supremizers import OnlineSupremizers
from vibench_strategies.pod_dual import PODDual

SHIFTS = (0.2, 0.4, 0.6, 0.8, 0.95)


@pytest.fixture(scope="module")
def coarse() -> Tresca:
    return Tresca("coarse")


@pytest.fixture(scope="module")
def snapshots(coarse: Tresca) -> Snapshots:
    solver, mus = HighFidelitySolver(coarse), coarse.parameters.grid(4, 9)
    solved = [solver.solve(mu) for mu in mus]
    return Snapshots(mus, np.column_stack([s.u for s in solved]), np.column_stack([s.lam for s in solved]))


def differences(problem: Tresca, half_width: float = 1.0) -> list[tuple[float, float]]:
    """Differences of force (over its limit) and of stick half-width from the closed form, at five shifts."""
    solver, found = HighFidelitySolver(problem), []
    for shift in SHIFTS:
        mu = np.array([half_width, shift])
        solution, exact = solver.solve(mu), problem.exact(mu)
        pair = mu[None], solution.u[:, None], solution.lam[:, None]
        force, stick = (float(output.values(*pair)[0]) for output in problem.outputs)
        found.append((abs(force / problem.limit(mu) - exact.force), abs(stick - exact.stick)))
    return found


def test_force_and_stick_zone_are_those_of_the_closed_form(coarse: Tresca) -> None:
    # The half-width 0.63 lies inside an element.
    for half_width, most in ((1.0, 5e-3), (0.63, 1e-2)):
        for force, stick in differences(coarse, half_width):
            assert force < most
            assert stick <= 0.1
    exact = coarse.exact(np.array([1.0, -0.4]))
    assert exact.force == pytest.approx(-0.4273, abs=1e-3)
    assert exact.stick == pytest.approx(np.sqrt(1.0 - 0.4273), abs=1e-3)
    assert coarse.exact(np.array([0.7, 0.0])).stick == pytest.approx(0.7)


def test_errors_of_the_force_fall_with_the_mesh(coarse: Tresca) -> None:
    finer = Tresca("medium")
    means = [np.mean([force for force, _ in differences(problem)]) for problem in (coarse, finer)]
    assert means[1] < 0.5 * means[0]


@pytest.mark.long
def test_paper_size_is_within_an_element_of_the_closed_form() -> None:
    for force, stick in differences(Tresca("paper")):
        assert force < 5e-4
        assert stick <= 1.0 / 80.0


@pytest.mark.parametrize("dual", [PODDual(), HullGreedy()])
@pytest.mark.parametrize("primal", [OnlineSupremizers(), OfflinePGA()])
def test_reduced_multipliers_stay_in_the_set(coarse, snapshots, dual, primal) -> None:  # type: ignore[no-untyped-def]
    tolerance = 0.99 if primal.takes_tolerance else None
    phase = Reduction(
        coarse, dual, primal, Stop(size=10), Stop(size=5), tolerance, formulation=DualProgram(), accuracy=1e-7
    ).given(snapshots=snapshots)
    mu = np.array([0.8, 0.55])
    answer, reference = phase.model.solve(mu), HighFidelitySolver(coarse).solve(mu)
    assert answer.status.value == "ok"
    assert coarse.K.contains(answer.lam)
    assert coarse.V.norm(answer.u - reference.u) < 0.05 * coarse.V.norm(reference.u)
    assert coarse.W.norm(answer.lam - reference.lam) < 0.3 * coarse.W.norm(reference.lam)
    # The corrected pair solves the problem but for the residual.
    pair = corrected_pair(assemblies(coarse).at(mu), assemblies(coarse).energy_at(mu), answer.u, answer.lam)
    assert coarse.W.norm(pair.lam - reference.lam) < 0.2 * coarse.W.norm(answer.lam - reference.lam)


def test_without_an_enrichment_that_is_needed_the_answer_says_so(coarse: Tresca, snapshots: Snapshots) -> None:
    phase = Reduction(coarse, PODDual(), None, Stop(size=3), Stop(size=5), formulation=DualProgram())
    with pytest.raises(UnsupportedError, match="5 multipliers of a section need as many vectors, not 3: enrich V_N"):
        phase.given(snapshots=snapshots).model.solve(np.array([0.8, 0.55]))


@pytest.mark.parametrize("dual", [HullGreedy(), PODDual()])
def test_every_solver_meets_the_default_accuracy(dual: DualStrategy, coarse: Tresca, snapshots: Snapshots) -> None:
    # More generators than the snapshots need: they are nearly dependent.
    phase = Reduction(coarse, dual, OnlineSupremizers(), Stop(size=10), Stop(size=12), formulation=DualProgram())
    model, mus = phase.given(snapshots=snapshots).model, coarse.validation_set(3, 5)
    exact = [model.solving("daqp").solve(mu) for mu in mus]
    for solver in ("daqp", "piqp", "osqp", "proxqp"):
        for mu, other in zip(mus, exact, strict=True):
            answer = model.solving(solver).solve(mu)
            assert answer.status.value == "ok", (solver, answer.reason)
            assert coarse.V.norm(answer.u - other.u) < 1e-3 * coarse.V.norm(other.u)


def test_for_contact_the_dual_program_answers_as_the_mixed_one() -> None:
    def model(formulation: Formulation):  # type: ignore[no-untyped-def]
        sizes = Stop(size=5), Stop(size=4)
        return Reduction(MovingSupport(), CPG(), OnlineSupremizers(), *sizes, formulation=formulation).model

    mixed, dual = model(Mixed()).solve([0.03, 0.02]), model(DualProgram()).solve([0.03, 0.02])
    assert dual.status.value == mixed.status.value == "ok"
    assert np.allclose(dual.lam, mixed.lam, atol=1e-6 * np.abs(mixed.lam).max())
    assert np.allclose(dual.u, mixed.u, atol=1e-6 * np.abs(mixed.u).max())


def test_what_knows_contact_alone_says_so(coarse: Tresca, snapshots: Snapshots) -> None:
    sizes = Stop(size=3), Stop(size=3)
    with pytest.raises(UnsupportedError, match="CPG knows λ ≥ 0 alone; K has intervals"):
        Reduction(coarse, CPG(), None, *sizes).given(snapshots=snapshots).cone  # noqa: B018
    mixed = Reduction(coarse, PODDual(), None, *sizes, formulation=Mixed()).given(snapshots=snapshots)
    with pytest.raises(UnsupportedError, match="the formulation Mixed knows λ ≥ 0 alone; K has intervals"):
        mixed.model.solve([0.8, 0.5])
    reduced = Reduction(coarse, PODDual(), None, *sizes, assembly="reduced").given(snapshots=snapshots)
    coarse.constant, declared = frozenset({"f"}), coarse.constant  # type: ignore[misc]
    try:
        with pytest.raises(UnsupportedError, match="in all rows where A is constant; K has intervals, A is not const"):
            reduced.certificate  # noqa: B018
    finally:
        coarse.constant = declared  # type: ignore[misc]


@pytest.mark.parametrize("dual", [HullGreedy(), PODDual()])
def test_supremizers_leave_no_residual_and_corrections_give_the_solution(
    coarse: Tresca, snapshots: Snapshots, dual: DualStrategy
) -> None:
    # In the energy norm u = -A⁻¹ Bᵀ λ is in V_N for all λ of the reduced set.
    phase = Reduction(coarse, dual, OnlineSupremizers(), Stop(size=5), Stop(size=5), formulation=DualProgram())
    model, mu = phase.given(snapshots=snapshots).model, np.array([0.8, 0.55])
    answer, exact, kept = model.solve(mu), HighFidelitySolver(coarse).solve(mu), assemblies(coarse)
    vi, energy = kept.at(mu), kept.energy_at(mu)
    assert energy.dual_norm(vi.A @ answer.u + vi.B.T @ answer.lam) < 1e-9 * energy.norm(exact.u)
    assert coarse.W.norm(answer.lam - exact.lam) > 0.01 * coarse.W.norm(exact.lam)
    pair = corrected_pair(vi, energy, answer.u, answer.lam)
    assert pair is not None
    assert coarse.W.norm(pair.lam - exact.lam) < 1e-9 * coarse.W.norm(exact.lam)


@pytest.mark.parametrize("dual", [HullGreedy(), pytest.param(PODDual(), marks=pytest.mark.long)])
def test_bounds_at_online_cost_hold_and_are_sharp(dual: DualStrategy, coarse: Tresca, snapshots: Snapshots) -> None:
    phase = Reduction(coarse, dual, OnlineSupremizers(), Stop(size=5), Stop(size=6), assembly="reduced", bounds=True)
    model, solver, found = phase.given(snapshots=snapshots).model, HighFidelitySolver(coarse), []
    for mu in coarse.validation_set(12, 3):
        exact, answer, energy = solver.solve(mu), model.solve(mu), assemblies(coarse).energy_at(mu)
        assert answer.bound.guarantee == "certified"
        force = energy.dual_norm(assemblies(coarse).at(mu).B.T @ (exact.lam - answer.lam))
        errors = energy.norm(exact.u - answer.u), force
        found.append((answer.bound.u_energy / errors[0], answer.bound.lambda_natural / errors[1]))
        outputs, bounds = answer.outputs, answer.output_bounds
        of_exact = coarse.outputs[0].values(mu[None], exact.u[:, None], exact.lam[:, None])[0]
        assert abs(of_exact - outputs["tangential force"]) <= bounds["tangential force"]
    assert np.min(found) >= 1.0
    assert np.median(found) < 2.0


def test_a_study_with_bounds_records_and_times_them(tmp_path: Path) -> None:
    problem = {"name": "tresca", "options": {"resolution": 4, "growth": 2.0}}
    study = Study(
        name="bounded", problem=[problem], dual=["pod-dual", "mcpg"], primal=["online-supremizers"], validation=4,
        tolerances=[{"N": [3], "R": [3]}], assembly=["reduced"], bounds=[True], solvers=["daqp"], timing_rounds=1,
        timing_rounds_min=1, training=[{"name": "grid", "options": {"counts": [3, 4]}}],
    )  # fmt: skip
    found = run(study, tmp_path, jobs=1)
    cell, other = found.cells.set_index("dual").loc[["pod-dual", "mcpg"]].to_dict("records")
    assert (cell["status"], cell["certificate"], cell["bound_online_violations"]) == ("ok", "certified", 0)
    assert cell["online_certify_s"] > 0.0
    assert (found.queries["effectivity_online_u_energy"].dropna() >= 1.0).all()
    assert (other["status"], "knows λ ≥ 0 alone" in other["reason"]) == ("unavailable", True)


def test_the_friction_coefficient_may_be_a_parameter() -> None:
    problem = Tresca(6, friction="parameter")
    assert problem.parameters.dim == 3
    weak, strong = (problem.exact(np.array([0.8, 0.6, f])) for f in (0.3, 0.5))
    assert strong.stick > weak.stick
