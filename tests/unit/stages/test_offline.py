from dataclasses import replace
from pathlib import Path
from statistics import mean, median
from typing import Literal

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from samples import SampleStore, carry_out, mixed_cell, store_of

from vibench import Array, Kind, NumericalError, Problem, Status, Stop, VariationalInequality, timing
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.plugins.plugin import Plugin
from vibench.reduction.nested import Milestone
from vibench.stability.coercivity import Stability
from vibench.stages import snapshots
from vibench.stages.assessment import summarise
from vibench.stages.base import Failed, value_of
from vibench.stages.cell_queries import CellQueries
from vibench.stages.enrichment import NestedEnrichment
from vibench.stages.infsup_constants import ReferenceConstants
from vibench.stages.offline import ConstraintMatrices, PODStage
from vibench.stages.snapshots import SnapshotStage, gather, solution_stages
from vibench.study.parameter_sets import CHUNKS, OWN_TRAINING, ParameterSet, chunk_of
from vibench.timing import NO_TIME, Seconds

PROBLEM = Plugin("problem", "obstacle", '{"resolution": 200}', "test")
VALIDATION = ParameterSet("validation", 9, 3)


def cell(primal: str, tolerance: float | None, solver: str = "piqp") -> CellQueries:
    pod, cone = Stop(tolerance=1e-2), Stop(tolerance=5e-2)
    return mixed_cell(PROBLEM, pod, "mcpg", cone, primal, VALIDATION, tolerance=tolerance, solver=solver)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    kinds = (("decorrelated", None), ("online-supremizers", None), ("offline-pga", 0.5))
    return store_of(tmp_path_factory.mktemp("stages"), (cell(*kind) for kind in kinds))


def test_keys_say_what_determines_a_stage_and_nothing_else() -> None:
    one = cell("offline-pga", 0.5)
    assert one.key == cell("offline-pga", 0.5).key
    other_solver = cell("offline-pga", 0.5, "osqp")
    assert other_solver.key != one.key
    assert other_solver.assembly.key == one.assembly.key
    assert replace(one, accuracy=1e-9).assembly.key == one.assembly.key
    looser = cell("offline-pga", 0.6)
    assert looser.assembly.key != one.assembly.key
    assert looser.built.enrichment.pod.key == one.built.enrichment.pod.key
    edited = replace(PROBLEM, code="edited")
    assert PODStage(edited, Stop(size=3)).key != PODStage(PROBLEM, Stop(size=3)).key
    pods = (PODStage(PROBLEM, Stop(size=size)) for size in (3, 4))
    assert len({stage.key for stage in (*pods, *solution_stages(PROBLEM, OWN_TRAINING))}) == 2 + CHUNKS


def test_chunks_make_up_the_sweep_in_order(store: SampleStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = gather(store, solution_stages(PROBLEM, OWN_TRAINING))
    problem = PROBLEM.create()
    assert np.array_equal(found.mu, problem.training_set())
    assert found.u.shape == (problem.V.dim, 125)
    assert len(found.seconds) == len(found.fallbacks) == 125
    assert all(s.cpu > 0.0 for s in found.seconds)
    validation = gather(store, solution_stages(PROBLEM, VALIDATION))
    assert np.array_equal(validation.mu, problem.validation_set(9, 3))
    own_store, chunks = SampleStore(tmp_path), solution_stages(PROBLEM, ParameterSet("validation", 3, 1))
    for chunk in chunks:  # few parameters leave some of them empty
        carry_out(chunk, own_store)
    assert gather(own_store, chunks).mu.shape == (3, 3)
    steps = {}
    for chunk in solution_stages(PROBLEM, OWN_TRAINING):
        for history in store.get(chunk.key).histories:
            assert history.quantity == "aspect_ratio"
            steps |= {history.first_step + k: v for k, v in enumerate(history.values)}
    assert sorted(steps) == list(range(125))
    assert min(steps.values()) >= 1.0
    monkeypatch.setattr(problem, "diagnostics", lambda mu: {})
    monkeypatch.setattr(snapshots, "build_problem", lambda plugin: problem)
    assert SnapshotStage(PROBLEM, ParameterSet("validation", 2, 0), 0).run(store).histories == ()


def test_histories_and_models_are_those_of_the_offline_stages(store: SampleStore) -> None:
    stage = cell("offline-pga", 0.5).built.enrichment
    pod = {h.quantity: h.values for h in store.get(stage.pod.key).histories}
    cone = {h.quantity: h.values for h in store.get(stage.cone.key).histories}
    added = {h.quantity: h.values for h in store.get(stage.key).histories}
    vectors = value_of(store, stage).vectors.shape[1]
    assert (len(pod["error"]), len(cone["e_orth"]) + 1) == (126, len(cone["error"]))
    few = replace(stage.cone, stop=Stop(tolerance=1e-30)).run(store).value.cone
    assert "misses its tolerance 1e-30" in few.fallbacks[-1]
    assert len(added["sigma"]) == len(added["beta_span_min"]) == vectors + 1
    own, full = np.array(added["beta_span_training"]), np.array(added["beta_full_span_training"])
    assert len(own) == len(full) == 125
    assert np.all(own >= np.sqrt(1.0 - 0.5**2) * full * (1.0 - 1e-9))
    assert np.isclose(min(own), added["beta_span_min"][-1])
    enrichment = cell("online-supremizers", None).built.enrichment
    model, basis = enrichment.reduction(store).projection, value_of(store, enrichment.pod).basis
    prepared = value_of(store, enrichment.cone).prepared
    assert model.kind is Kind.PER_PARAMETER
    query = model.assemble(np.array([1.05, 0.01, -0.03]))
    assert query.basis.shape[1] == basis.shape[1] + prepared.rank
    assert query.program.B.shape == (prepared.chi.shape[1], query.basis.shape[1])


@pytest.mark.parametrize("interpolation", [None, 1e-6])
def test_a_cell_of_a_nested_strategy_is_the_cell_built_alone(store: SampleStore, interpolation: float | None) -> None:
    """Snapshots, POD and cone are the same stages; everything from the enrichment on has keys of its own."""
    single = cell("offline-pga", 0.5)
    alone = replace(single, built=replace(single.built, interpolation=interpolation))
    parts = alone.built.enrichment
    enrichment = NestedEnrichment(parts.pod, parts.cone, parts.primal, parts.tolerance, (0.3, 0.5, 0.9))
    grown = replace(alone, built=replace(alone.built, enrichment=enrichment, pod=enrichment.pod, cone=enrichment.cone))
    assert len({stage.key for stage in (enrichment, grown, parts, alone)}) == 4
    for one in (alone, grown):
        carry_out(one, store)
    expected, found = value_of(store, alone).cell, value_of(store, grown).cell
    assert found["enrichment"] == expected["enrichment"] > 0
    assert isinstance(value_of(store, enrichment), Milestone)  # the vectors are stored once, with the growth
    for name in ("error_u_mean", "error_lambda_mean", "beta_span_min", "beta_cone_upper_min"):
        assert found[name] == pytest.approx(expected[name], rel=1e-6), name
    assert found["assembly_error_max"] < 1e-5
    histories = [{h.quantity: h.values for h in store.get(stage.key).histories} for stage in (parts, enrichment)]
    assert histories[0].keys() == histories[1].keys()
    for quantity, values in histories[0].items():
        assert histories[1][quantity] == pytest.approx(values, rel=1e-9), quantity
    if interpolation is None:
        programs = [c.assembly.programs(store).programs for c in (alone, grown)]
        for one, other in zip(*programs, strict=True):
            assert np.allclose(one.A, other.A, rtol=1e-10, atol=1e-13)
            assert np.allclose(one.B, other.B, rtol=1e-10, atol=1e-13)


def test_rows_have_seconds_errors_and_proved_bounds(store: SampleStore) -> None:
    for primal, tolerance, kind in (
        ("decorrelated", None, "none"), ("online-supremizers", None, "per-parameter"), ("offline-pga", 0.5, "fixed"),
    ):  # fmt: skip
        rows = value_of(store, cell(primal, tolerance))
        assert (rows.cell["enrichment_kind"], rows.cell["status"]) == (kind, "ok")
        assert rows.cell["queries"] == rows.cell["queries_ok"] == len(rows.queries) == 9
        parts = ("snapshots", "pod", "cone", "enrichment", "assembly")
        assert rows.cell["offline_s"] == pytest.approx(sum(rows.cell[f"offline_{part}_s"] for part in parts))
        snapshots = sum((store.get(chunk.key).seconds for chunk in solution_stages(PROBLEM, OWN_TRAINING)), NO_TIME)
        training, validation = (gather(store, solution_stages(PROBLEM, one)) for one in (OWN_TRAINING, VALIDATION))
        assert snapshots.cpu == pytest.approx(sum(seconds.cpu for seconds in training.seconds))
        setup = median(seconds.cpu for seconds in (*training.setups, *validation.setups))
        assert rows.cell["offline_snapshots_s"] == pytest.approx(snapshots.cpu + setup)
        assert rows.cell["hf_setup_s"] == pytest.approx(setup)
        assert rows.cell["hf_s"] == pytest.approx(mean(seconds.cpu for seconds in validation.seconds))
        assert [row["hf_s"] for row in rows.queries] == [seconds.cpu for seconds in validation.seconds]
        enrichment = store.get(cell(primal, tolerance).built.enrichment.key)
        assert rows.cell["offline_enrichment_s"] == enrichment.seconds.cpu
        chi = value_of(store, cell(primal, tolerance).built.enrichment.cone).cone.generators
        gram = chi.T @ (PROBLEM.create().W.matrix @ chi)
        assert rows.cell["gram_condition"] == pytest.approx(np.linalg.cond(gram), rel=1e-6)
        expected = {"none": 0, "per-parameter": rows.cell["rank"]}
        if kind in expected:
            assert rows.cell["enrichment"] == expected[kind]
        for row in rows.queries:
            assert row["error_u"] < 0.05
            assert max(row["primal_residual"], row["dual_residual"], row["gap"]) <= 1e-8
    rows = value_of(store, cell("offline-pga", 0.5))
    for row in rows.queries:
        assert (row["bound_note"], row["coercivity_proved"], row["continuity_proved"]) == ("", 1, 1)
        terms = row["bound_rho"] ** 2 + row["bound_omega"] ** 2 + 2.0 * row["bound_kappa"]
        assert row["bound_u_energy"] == pytest.approx(np.sqrt(terms))
        assert row["bound_u"] == pytest.approx(row["bound_u_energy"] / np.sqrt(row["coercivity"]))
        assert row["bound_lambda"] == pytest.approx(row["bound_lambda_natural"] / row["beta_energy"])
        for name in ("u_energy", "u", "lambda_natural", "lambda"):
            assert row[f"effectivity_{name}"] == row[f"bound_{name}"] / row[f"error_{name}_absolute"] >= 1.0
        assert row["effectivity_hsw_u"] == row["bound_hsw_u"] / row["error_u_absolute"] >= 1.0
        assert row["effectivity_hsw_lambda"] == row["bound_hsw_lambda"] / row["error_lambda_absolute"] >= 1.0
    for name in ("u_energy", "hsw_lambda"):
        middle = np.median([row[f"effectivity_{name}"] for row in rows.queries])
        assert rows.cell[f"effectivity_{name}_median"] == middle


def test_constants_are_of_every_parameter_and_solver_errors_of_every_row(store: SampleStore) -> None:
    constants = ReferenceConstants(ConstraintMatrices(PROBLEM, VALIDATION)).gather(store)
    mus = PROBLEM.create().validation_set(9, 3)
    pairs = zip(constants, mus, strict=True)
    scaled = [c.inf_sup.span / mu[0] ** 2 for c, mu in pairs if isinstance(c, Stability)]  # B = mu_1² times one matrix
    assert np.allclose(scaled, scaled[0], rtol=1e-9)
    assert scaled[0] > 0.0
    problem = PROBLEM.create()
    for c, mu in zip(constants, mus, strict=True):
        assert isinstance(c, Stability)
        vi = problem.assemble(mu)
        values = scipy.linalg.eigh(vi.A.toarray(), problem.V.matrix.toarray(), eigvals_only=True)
        assert c.coercivity.proved
        assert 0.998 * values[0] <= c.coercivity.value <= values[0]
        assert c.continuity.proved
        assert values[-1] <= c.continuity.value <= 1.002 * values[-1]
        compliance = vi.B @ np.linalg.solve(vi.A.toarray(), vi.B.toarray().T)
        smallest = scipy.linalg.eigvalsh(compliance, problem.W.matrix.toarray())[0]
        assert 0.998 * np.sqrt(smallest) <= c.energy_inf_sup.value <= np.sqrt(smallest)
    # Exactly as much as separates it from the program solved to round-off; a tight accuracy leaves next to nothing.
    loose = replace(cell("offline-pga", 0.5, "osqp"), accuracy=1e-3).run(store).value
    tight = replace(cell("offline-pga", 0.5, "piqp"), accuracy=1e-10).run(store).value
    assert tight.cell["solver_share_max"] < 1e-3 < loose.cell["solver_share_max"]
    for one, other in zip(loose.queries, tight.queries, strict=True):
        for name in ("u", "lambda"):
            apart = abs(one[f"error_{name}"] - other[f"error_{name}"])
            assert apart <= one[f"solver_error_{name}"] + 1e-6 * other[f"error_{name}"]
        share = max(one[f"solver_error_{name}"] / one[f"error_{name}"] for name in ("u", "lambda"))
        assert one["solver_share"] == pytest.approx(share)


class Factorising(HighFidelitySolver):
    """A solver whose first solution takes 10 s longer than the others, which take 1 s each, by a clock of its own."""

    now = 0.0
    without_contact_set = 0.0

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self._is_set_up = False

    def solve_assembled(self, mu: Array, vi: VariationalInequality) -> HighFidelitySolution:
        Factorising.now += (1.0 if self._is_set_up else 11.0) + (0.0 if self._solved else self.without_contact_set)
        self._is_set_up = True
        return super().solve_assembled(mu, vi)


@pytest.mark.parametrize("extra", [pytest.param(0.0, marks=pytest.mark.long), 5.0])
@pytest.mark.parametrize(("role", "count"), [("training", 0), ("validation", 4), ("validation", 18)])
def test_the_set_up_and_a_start_without_contact_set_are_no_part_of_the_seconds_of_a_solution(
    role: Literal["training", "validation"], count: int, extra: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Whatever the number of parameters that share it: break-even would depend on the number of queries otherwise."""
    made = []
    monkeypatch.setattr(Factorising, "without_contact_set", extra)
    monkeypatch.setattr(snapshots, "HighFidelitySolver", lambda problem: made.append(1) or Factorising(problem))
    monkeypatch.setattr(snapshots, "_set_up", {})
    for clock in ("process_time", "perf_counter"):
        monkeypatch.setattr(timing, clock, lambda: Factorising.now)
    alone = SnapshotStage(PROBLEM, ParameterSet(role, count, 3), 0).run(SampleStore(tmp_path))
    for chunk in (1, 0):  # which share the set-up of this process
        found = SnapshotStage(PROBLEM, ParameterSet(role, count, 3), chunk).run(SampleStore(tmp_path))
        assert found.value.setups == alone.value.setups == (Seconds(10.0 + extra, 10.0 + extra),)
        assert set(found.value.seconds) == {Seconds(1.0, 1.0)}
        assert found.seconds == Seconds(float(len(found.value.mu)), float(len(found.value.mu)))
    assert len(made) == 1
    np.testing.assert_array_equal(found.value.u, alone.value.u)  # whatever was solved before


def test_slow_queries_and_losses_are_named(tmp_path: Path, store: SampleStore, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = PODStage(PROBLEM, Stop(size=2))
    with pytest.raises(NumericalError, match=stage.key):
        value_of(SampleStore(tmp_path), stage)
    impatient = replace(cell("decorrelated", None), query_seconds=1e-9)
    rows = impatient.run(store).value
    assert (rows.cell["status"], rows.cell["queries_ok"]) == ("timeout", 0)
    assert "the limit is 1e-09 s" in rows.queries[0]["reason"]
    stage = cell("offline-pga", 0.5)
    first, *_ = stage.reference.energy
    monkeypatch.setattr(store, "lost", {first.key: Failed(Status.TIMEOUT, "too long")})
    rows = stage.run(store).value.queries
    lost = chunk_of(np.arange(9.0)[:, None], 0)[1].size
    assert [row["status"] for row in rows] == ["timeout"] * lost + ["ok"] * (9 - lost)
    assert {row["reason"] for row in rows[:lost]} == {"in high-fidelity constants: too long"}
    before = value_of(store, stage).queries
    for row, other in zip(rows[lost:], before[lost:], strict=True):
        assert row["bound_u"] == pytest.approx(other["bound_u"], rel=1e-13)
    assert not any("coercivity" in row for row in rows[:lost])


def query(status: str, error: float | None = 1.0, **columns) -> dict:
    base = {"status": status, "reason": "" if status == "ok" else f"it was {status}", "mu_1": 0.5}
    constants = {f"beta_{what}": 0.2 for what in ("span", "cone_lower", "cone_upper")}
    return base | constants | {"error_u": error} | columns


def test_means_are_over_the_ok_queries_and_the_reason_counts_every_status() -> None:
    found = summarise([query("ok", 1.0), query("ok", 3.0), query("inaccurate", 100.0), query("failed", None)])
    assert found["status"] == "failed"
    words = "1 of 4 failed, 1 of 4 inaccurate, first mu=(0.5): it was failed; mu=(0.5): it was inaccurate"
    assert found["reason"] == words
    assert summarise([query("failed")] * 2)["reason"] == "2 of 2 queries, first mu=(0.5): it was failed"
    assert (found["queries"], found["queries_ok"]) == (4, 2)
    assert (found["error_u_mean"], found["error_u_max"]) == (2.0, 3.0)
    found = summarise([query("nonfinite", None)])
    assert (found["error_u_mean"], found["residual_max"], found["beta_span_min"]) == (None, None, 0.2)


QUERIES = st.tuples(st.booleans(), st.booleans(), st.booleans(), st.floats(1e-6, 1e6), st.floats(0, 1))


@given(st.lists(QUERIES, min_size=1))
def test_what_is_zero_is_counted_apart_and_enters_no_mean(drawn: list[tuple[bool, bool, bool, float, float]]) -> None:
    rows = [
        query(
            "ok" if ok else "inaccurate", None if zero_u else error, error_u_scaled=scaled,
            error_lambda=None if zero_lam else error, error_lambda_scaled=scaled, zero_u=int(zero_u),
            zero_lambda=int(zero_lam),
        )
        for ok, zero_u, zero_lam, error, scaled in drawn
    ]  # fmt: skip
    found = summarise(rows)
    for name, kind in (("u", 1), ("lambda", 2)):
        errors = [one[3] for one in drawn if one[0] and not one[kind]]
        scaled = [one[4] for one in drawn if one[0] and one[kind]]
        assert found[f"queries_zero_{name}"] == len(scaled)
        assert found[f"error_{name}_zero_max"] == (max(scaled) if scaled else None)
        assert found[f"error_{name}_max"] == (max(errors) if errors else None)
        mean = found[f"error_{name}_mean"]
        assert mean == pytest.approx(sum(errors) / len(errors)) if errors else mean is None
