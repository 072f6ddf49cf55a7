from itertools import product

import numpy as np
import pandas as pd
import pytest
from samples import small_study, with_ways

import vibench
from vibench.interfaces.validation import validation_parameters
from vibench.model.bound_terms import BoundNote, CorrectionMode
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.offline import solution as module
from vibench.offline.assemblies import assemblies
from vibench.offline.solution import Corrector

RESOLUTIONS = {"obstacle": "coarse", "hertz": 300}
BOUNDS = ("u_energy", "u", "lambda_natural", "lambda", "online_u_energy", "online_lambda_natural", "online_lambda")
ERRORS = {name: f"error_{name.removeprefix('online_')}_absolute" for name in BOUNDS}
MODEL = ["problem", "pod_tol", "assembly"]


@pytest.fixture(scope="module", params=["hertz", pytest.param("obstacle", marks=pytest.mark.long)])
def corrected(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> vibench.Run:
    problem = {"name": request.param, "options": {"resolution": RESOLUTIONS[request.param]}}
    study = small_study(
        "corrected", [problem], primal=["offline-pga"], assembly=["reduced"], bounds=[False, True],
        validation=4, timing_rounds=1,
        correction=["none", "feasible", "auto"],
        tolerances=[{"pod": [1e-2, 1e-4], "dual": [1e-2], "primal": {"offline-pga": [0.5]}}],
    )  # fmt: skip
    return vibench.run(study, tmp_path_factory.mktemp("corrected") / "run", progress=False, jobs=1)


def by(run: vibench.Run, correction: str) -> pd.DataFrame:
    rows = with_ways(run.queries[run.queries["correction"] == correction])
    return rows.set_index([*MODEL, "query"]).sort_index()


@pytest.mark.long
def test_corrected_rows_are_feasible_within_bounds_and_say_what_they_cost(corrected: vibench.Run) -> None:
    assert (corrected.cells["status"] == "ok").all()
    rows, plain = by(corrected, "feasible"), by(corrected, "none")
    assert (rows["corrected"] == 1).all()
    assert (rows["violation"] <= 1e-12 * plain["error_u_absolute"].max()).all()
    assert plain["violation"].max() > 1e-6
    for name, error in ERRORS.items():
        bound = rows[f"bound_{name}"].dropna()
        assert len(bound) == len(rows) // (1 + name.startswith("online"))
        assert (rows.loc[bound.index, error] <= bound * (1.0 + 1e-9)).all(), name
    assert (corrected.cells["bound_online_violations"].dropna() == 0.0).all()
    assert (rows["bound_online_omega"].dropna() == 0.0).all()
    at_mesh = rows.index.get_level_values("assembly") == "reduced"
    assert (rows["bound_omega"][at_mesh] <= 1e-9 * plain["bound_omega"].max()).all()
    if "obstacle" in set(corrected.cells["problem"]):
        finer = rows.loc[("obstacle", 1e-4)]["error_lambda"] / plain.loc[("obstacle", 1e-4)]["error_lambda"]
        assert finer.median() < 0.2
    cells = with_ways(corrected.cells).set_index(["assembly", "correction"]).sort_index()
    for assembly, correction in product(("reduced", "certified"), ("none", "feasible", "auto")):
        mine = cells.loc[[(assembly, correction)]]
        asked = {"reduced": "high-fidelity", "certified": "online"}[assembly] if correction != "none" else ""
        assert set(mine["correction_cost"]) == {asked}
        assert mine["corrected_share"].isna().all() == (correction == "none")
        assert mine["online_certify_s"].notna().all() == (asked != "" or assembly == "certified")
    rounds = corrected.table("timings")  # medians over them, and means of their paces, need not be in this order
    assert (rounds["certify_s"].fillna(0.0) < rounds["total_s"]).all()


def test_auto_corrects_where_the_violation_dominates_the_bound_and_leaves_the_others(corrected: vibench.Run) -> None:
    rows, plain, pairs = (by(corrected, name) for name in ("auto", "none", "feasible"))
    assert (rows["corrected"] == (rows["correction_share"] > 1.0)).all()
    assert set(rows["corrected"]) == {0, 1}
    # The bounds at online cost are of the pair, whose violation is zero, not of the reduced solution.
    assert (pairs["bound_online_omega"].dropna() == 0.0).all()
    assert plain["bound_online_omega"].max() > 0.0
    at_mesh = rows.index.get_level_values("assembly") == "reduced"
    assert np.allclose(rows["correction_share"][at_mesh], (plain["bound_omega"] / plain["bound_rho"])[at_mesh])
    online = (plain["bound_online_omega"] / plain["bound_online_rho"])[~at_mesh]
    assert np.allclose(rows["correction_share"][~at_mesh], online)
    for name in ("error_u", "error_lambda", "violation", "bound_lambda", "bound_online_lambda", "solver_error_lambda"):
        expected = pairs[name].where(rows["corrected"] == 1, plain[name])
        assert np.allclose(rows[name], expected, rtol=1e-12, equal_nan=True), name
    cells = with_ways(corrected.cells).set_index([*MODEL, "correction"])
    shares = rows.groupby(MODEL)["corrected"].mean()
    for model, share in shares.items():
        assert cells.loc[(*model, "auto"), "corrected_share"] == share


def test_models_answer_as_their_cells_and_bounds_hold_where_unseen(corrected: vibench.Run) -> None:
    cells = with_ways(corrected.cells).set_index(["pod_tol", "assembly", "correction"])
    (problem,) = set(cells["problem"])
    for tolerance, assembly in product((1e-2, 1e-4), ("reduced", "certified")):
        model = corrected.model(cells.loc[(tolerance, assembly, "feasible"), "cell"])
        V, W = model.problem.V, model.problem.W
        recorded = by(corrected, "feasible").loc[(problem, tolerance, assembly)]
        for query, mu in enumerate(validation_parameters(model.problem, 1, 0)):
            solution, exact = model.solve(mu), model.high_fidelity(mu)
            assert W.norm(exact.lam - solution.lam) == pytest.approx(recorded.loc[query, "error_lambda_absolute"], 1e-4)
            assert not np.array_equal(solution.lam, model.solve(mu, corrected=False).lam)
        for mu in model.parameters.sample(6, seed=8):
            solution, exact = model.solve(mu), model.high_fidelity(mu)
            vi, norm = assemblies(model.problem).at(mu), assemblies(model.problem).energy_at(mu)
            assert solution.answer.is_corrected
            assert np.max(vi.B @ solution.u - vi.g) <= 1e-12 * np.abs(vi.g).max()
            found = [solution.error_bounds] if solution.bound is None else [solution.error_bounds, solution.bound]
            for bound in found:
                assert norm.norm(exact.u - solution.u) <= bound.u_energy * (1.0 + 1e-9)
                assert norm.dual_norm(vi.B.T @ (exact.lam - solution.lam)) <= bound.lambda_natural * (1.0 + 1e-9)
                assert W.norm(exact.lam - solution.lam) <= bound.lam * (1.0 + 1e-9)
            assert V.norm(exact.u - solution.u) <= found[0].u * (1.0 + 1e-9)


def test_a_query_that_cannot_be_corrected_says_why(corrected: vibench.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The answer is the reduced solution then."""
    model = corrected.model(corrected.cells["cell"].iloc[0])
    corrector, mu = Corrector(model.reduced, None, CorrectionMode.FEASIBLE), model.parameters.sample(1, seed=3)[0]
    u, lam = np.zeros(model.problem.V.dim), np.zeros(model.problem.W.dim)
    assert corrector.in_full(mu, u, lam - 1.0)[2:] == (None, False, None, BoundNote.NOT_IN_CONE)
    monkeypatch.setattr(module, "corrected_pair", lambda *_: None)
    assert corrector.in_full(mu, u, lam).note == BoundNote.NO_CORRECTION
    model = corrected.model(with_ways(corrected.cells).set_index("assembly").loc["certified", "cell"].iloc[0])
    solution = model.solve(model.parameters.sample(1, seed=3)[0], corrected=False)
    corrector = Corrector(model.reduced, model.certificate, CorrectionMode.FEASIBLE)
    monkeypatch.setattr(OnlineCertificate, "_corrected_pair", lambda *_: None)
    answer = corrector.answer(solution.mu, solution.x, solution.alpha, solution.u, solution.lam)
    assert not answer.is_corrected
    assert answer.bound == solution.bound
    assert answer.note.startswith("the certificate found a correction, but no multiplier ν ≥ 0")
