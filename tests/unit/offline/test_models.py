import warnings
from itertools import product

import numpy as np
import pytest
from samples import SMALL, small_study, with_ways

import vibench
from vibench import MEMBERS
from vibench.interfaces.validation import validation_parameters
from vibench.model.bound_terms import BoundNote
from vibench.model.galerkin import ReducedProblem
from vibench.model.hyperreduced import HyperReducedModel
from vibench.offline import models
from vibench.offline.assemblies import assemblies
from vibench.offline.models import parameter_in
from vibench.offline.solution import html

CELLS = list(product(("online-supremizers", "offline-pga"), ("full", "reduced")))


@pytest.fixture(scope="module", params=CELLS, ids="-".join)
def model(small_run: vibench.Run, request: pytest.FixtureRequest) -> vibench.Model:
    rows = with_ways(small_run.cells).set_index(["problem", "primal", "assembly"])
    return small_run.model(rows.loc[("radial-obstacle", *request.param), "cell"])


@pytest.fixture(scope="module")
def mus(model: vibench.Model) -> np.ndarray:
    return validation_parameters(model.problem, SMALL.validation, SMALL.seed)


def test_a_model_answers_as_the_run_did(small_run: vibench.Run, model: vibench.Model, mus: np.ndarray) -> None:
    rows = small_run.queries[small_run.queries["cell"] == model.row["cell"]].set_index("query")
    for query, mu in enumerate(mus):
        solution, exact = model.solve(mu), model.high_fidelity(mu)
        assert solution.status == "ok"
        error_u = model.problem.V.norm(solution.u - exact.u) / model.problem.V.norm(exact.u)
        error_lambda = model.problem.W.norm(solution.lam - exact.lam) / model.problem.W.norm(exact.lam)
        assert error_u == pytest.approx(rows.loc[query, "error_u"], rel=1e-6)
        assert error_lambda == pytest.approx(rows.loc[query, "error_lambda"], rel=1e-6)
        assert solution.residuals.worst <= 1e-10
        bounds = solution.error_bounds
        assert bounds.u == pytest.approx(rows.loc[query, "bound_u"], rel=1e-3)
        assert bounds.u >= model.problem.V.norm(solution.u - exact.u)
        assert bounds.lam >= model.problem.W.norm(solution.lam - exact.lam)


def test_single_answers_have_seconds_reconstructions_and_tables_in_html(model: vibench.Model, mus: np.ndarray) -> None:
    solution = model.solve(dict(zip(model.parameters.names, mus[0].tolist(), strict=True)))
    assert np.array_equal(solution.mu, mus[0])
    u, lam = model.reconstruct(mus[0], solution.x, solution.alpha)
    assert np.allclose(u, solution.u, rtol=0.0, atol=1e-14 * np.abs(u).max())
    assert np.array_equal(lam, solution.lam)
    assert all(isinstance(seconds, float) and seconds >= 0.0 for seconds in (solution.assembly, solution.solution))
    loose = model.solve(mus[0], solver="proxqp", accuracy=1e-4)
    assert (loose.status, loose.residuals.worst <= 1e-4) == ("ok", True)
    assert np.allclose(loose.u, u, rtol=0.0, atol=1e-2 * np.abs(loose.u).max())
    assert repr(model).startswith("Model(problem='radial-obstacle', R=")
    assert " at 0x" not in repr(model)
    assert "<th>solver</th><td>piqp</td>" in model._repr_html_()
    shown = solution._repr_html_()
    assert "<th>status</th><td>ok</td>" in shown
    assert "<th>reason</th>" not in shown
    assert "<td>&lt;b&gt;</td>" in html("title", {"name": "<b>"})


def test_many_parameters_give_a_table(model: vibench.Model, mus: np.ndarray, certified: vibench.Run) -> None:
    table = model.solve_all(mus)
    assert np.array_equal(table[list(model.parameters.names)], mus)
    assert set(table["status"]) == {"ok"}
    assert table.loc[1, "residual"] <= model.accuracy
    for name, value in model.solve(mus[1]).outputs.items():
        assert table.loc[1, f"output:{name}"] == pytest.approx(value, rel=1e-6)
    with pytest.raises(vibench.RequestError, match=r"the parameters have the shape \(2,\), expected \(P, 2\)"):
        model.solve_all(mus[0])
    with pytest.raises(vibench.RequestError, match="`solve_all` takes an array of parameters"):
        model.solve(mus)
    bounded = certified.model(str(certified.cells.set_index("bounds").loc[1, "cell"]))
    table = bounded.solve_all(bounded.parameters.sample(2, seed=0), tolerance=0.5)
    assert {"bound_u_energy", "guarantee", "verdict"} <= set(table)


def test_a_table_assembles_as_queries(model: vibench.Model, mus: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes, solved, real = list[int](), list[ReducedProblem](), models.Model._solution
    if isinstance(model.reduced, HyperReducedModel):
        mus = np.vstack([model.parameters.sample(257, seed=1), mus])
        together = model.reduced.assemble_all
        monkeypatch.setattr(model.reduced, "assemble_all", lambda some: [sizes.append(len(some)), together(some)][1])
    kept = lambda self, at, reduced, *rest: [solved.append(reduced), real(self, at, reduced, *rest)][1]  # noqa: E731
    monkeypatch.setattr(models.Model, "_solution", kept)
    table = model.solve_all(mus)
    assert sizes == ([256, len(mus) - 256] if len(mus) > 256 else [])
    assert len(table) == len(solved) == len(mus)
    for mu, reduced in zip(mus, solved, strict=True):
        alone = model.reduced.assemble(mu).program
        for name in MEMBERS:
            one, other = getattr(alone, name), getattr(reduced.program, name)
            assert np.allclose(one, other, rtol=0.0, atol=1e-13 * np.abs(one).max()), name


def test_parameters_outside_their_domain_are_warned_of_and_what_is_none_refused(model: vibench.Model) -> None:
    box = model.parameters
    with pytest.warns(UserWarning, match="^height, curvature: outside the parameter domain"):
        model.solve(box.upper + 0.1 * (box.upper - box.lower))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.solve(box.upper)
    for mu, line in (
        ([1.0, 2.0, 3.0, 4.0], "expected finite numbers"),
        ([float("nan")] * 2, "expected finite numbers"),
        ({"height": 1.0}, "mu has the components \\['height'\\], expected"),
    ):
        with pytest.raises(vibench.RequestError, match=line):
            model.solve(mu)  # type: ignore[arg-type]
    micro, letter = "\u00b5", "\u03bc"
    box = vibench.ParameterBox((micro, "e"), np.array([1.0, 1.0]), np.array([2.0, 2.0]), ("1", "1"))
    assert box.logarithmic([letter, micro]) == [0]
    assert list(parameter_in(box, {letter: 1.5, "e": 2.0})) == [1.5, 2.0]
    with pytest.raises(vibench.RequestError, match="mu has the components"):
        parameter_in(box, {letter: 1.5, micro: 1.5, "e": 2.0})


def test_missing_solutions_are_named(model: vibench.Model, mus: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(vibench.RequestError, match="no QP solver is called 'piqpp'; did you mean 'piqp'"):
        model.solve(mus[0], solver="piqpp")
    monkeypatch.setattr("vibench.offline.models.installed_solvers", lambda _: ["piqp"])
    with pytest.raises(vibench.RequestError, match="the QP solver 'proxqp' is not installed"):
        model.solve(mus[0], solver="proxqp")
    nothing = vibench.QPSolution(None, None, "gave up")
    monkeypatch.setattr("vibench.offline.models.solve_qp", lambda *_: nothing)
    solution = model.solve(mus[0])
    assert solution.status != "ok"
    for vector in ("u", "lam"):
        with pytest.raises(vibench.RequestError, match="there is no solution at mu"):
            getattr(solution, vector)


@pytest.fixture(scope="module")
def certified(tmp_path_factory: pytest.TempPathFactory) -> vibench.Run:
    problem = {"name": "hertz", "options": {"resolution": 300}}
    study = small_study("certified", [problem], assembly=["reduced"], bounds=[False, True], validation=3)
    return vibench.run(study, tmp_path_factory.mktemp("certified") / "run", progress=False, jobs=1)


def test_certificates_bound_errors_and_tolerances_need_them(certified: vibench.Run) -> None:
    row = with_ways(certified.cells).set_index("assembly").loc["certified"]
    assert (row["certificate"], row["bound_online_violations"]) == ("certified", 0)
    assert row["offline_certificate_s"] > 0.0
    assert row["online_certify_s"] > 0.0
    model = certified.model(row["cell"])
    rows = certified.queries[certified.queries["cell"] == row["cell"]].set_index("query")
    for query, mu in enumerate(validation_parameters(model.problem, 3, 0)):
        solution = model.solve(mu)
        assert solution.verdict == "no tolerance"
        assert solution.bound.u_energy == pytest.approx(rows.loc[query, "bound_online_u_energy"], rel=1e-6)
        assert rows.loc[query, "error_u_energy_absolute"] <= solution.bound.u_energy
        relative = solution.bound.relative
        assert rows.loc[query, "error_u_energy"] <= relative
        assert model.solve(mu, tolerance=1.01 * relative).verdict == "certified"
        assert model.solve(mu, tolerance=0.99 * relative).verdict == "not certified"
        rough = model.solve(mu, accuracy=1e-14, tolerance=1.01 * relative)  # more than the solver reaches, or less
        assert rough.verdict == ("certified" if rough.status == "ok" else "not certified")
        # relative to ‖u − A⁻¹f‖_A, of which the certificate knows a lower bound
        vi, norm = model.problem.assemble(mu), assemblies(model.problem).energy_at(mu)
        contact, bound = norm.dual_norm(vi.B.T @ model.high_fidelity(mu).lam), solution.bound
        of_contact = model.solve(mu, tolerance=10.0, of="contact").bound.relative
        assert 1.0 <= of_contact * contact / max(bound.u_energy, bound.lambda_natural) < 3.0
        assert model.solve(mu, tolerance=1.01 * of_contact, of="contact").verdict == "certified"
        assert model.solve(mu, tolerance=0.99 * of_contact, of="contact").verdict == "not certified"
    rows = certified.queries[certified.queries["cell"] == row["cell"]]
    assert set(rows["beta_energy_online_note"]) == {BoundNote.ON_BODIES}
    assert (rows["beta_energy_online"] <= rows["beta_energy"] * (1.0 + 1e-2)).all()  # both are moved outwards
    assert (rows["bound_online_lambda"] >= rows["error_lambda_absolute"]).all()
    assert row["effectivity_online_lambda_median"] == pytest.approx(rows["effectivity_online_lambda"].median())
    assert 1.0 <= row["effectivity_online_lambda_median"] < 20.0
    model = certified.model(with_ways(certified.cells).set_index("assembly").loc["reduced", "cell"])
    assert model.solve([1.0]).bound is None
    for wrong, line in (
        ({"tolerance": 1e-2}, "no error bounds"), ({"tolerance": 0.0}, "expected a positive finite number"),
        ({"of": "body"}, "is 'body', expected 'solution' or 'contact'"),
    ):  # fmt: skip
        with pytest.raises(vibench.RequestError, match=line):
            model.solve([1.0], **wrong)


def test_corrected_solutions_satisfy_the_constraints_and_have_bounds_of_their_own(certified: vibench.Run) -> None:
    model = certified.model(with_ways(certified.cells).set_index("assembly").loc["certified", "cell"])
    for mu in model.parameters.sample(5, seed=4):
        plain, corrected, exact = model.solve(mu), model.solve(mu, corrected=True), model.high_fidelity(mu)
        vi, norm = model.problem.assemble(mu), assemblies(model.problem).energy_at(mu)
        assert (plain.correction is None, corrected.correction is None) == (True, False)
        assert np.array_equal(corrected.x, plain.x)
        assert not np.array_equal(corrected.lam, plain.lam)
        assert np.min(corrected.lam) >= 0.0
        assert np.max(vi.B @ corrected.u - vi.g) <= 1e-12 * np.abs(vi.g).max()
        force = vi.B.T @ (exact.lam - corrected.lam)
        assert norm.norm(exact.u - corrected.u) <= corrected.bound.u_energy
        assert norm.dual_norm(force) <= corrected.bound.lambda_natural
        assert model.problem.W.norm(exact.lam - corrected.lam) <= corrected.bound.lam
        bounds = corrected.error_bounds  # at high-fidelity cost, of the corrected pair
        assert norm.norm(exact.u - corrected.u) <= bounds.u_energy <= corrected.bound.u_energy * (1.0 + 1e-3)
    uncertified = certified.model(with_ways(certified.cells).set_index("assembly").loc["reduced", "cell"])
    at_mesh_size = uncertified.solve(mu, corrected=True)  # without a certificate: the same, A is constant
    assert (at_mesh_size.bound, at_mesh_size.answer.is_corrected) == (None, True)
    assert model.problem.W.norm(at_mesh_size.lam - corrected.lam) <= 1e-6 * model.problem.W.norm(exact.lam)
