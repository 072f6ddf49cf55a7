"""Formulations beside plain versions of them that are written from their papers, on a small Hertz contact."""

import numpy as np
import plain_formulations as plain
import pytest
from samples import pga_reduction

from vibench import FormulationAnswer, HighFidelitySolver, QuerySettings, Reduction, create
from vibench.offline.models import CellSolver
from vibench.signatures import _Signature

ACCURACY = 1e-9
SOLVE = CellSolver("piqp", ACCURACY)


@pytest.fixture(scope="module")
def discs() -> Reduction:
    pytest.importorskip("sklearn")  # of both versions of `regression`
    problem = create("problem", "hertz", {"resolution": 300})
    return pga_reduction(problem, 1e-2, 1e-3, assembly="reduced", accuracy=ACCURACY)


@pytest.mark.parametrize(("name", "options", "plainly", "tolerance"), [
    ("penalty", {}, plain.penalty, 1e-6),
    ("proximal", {}, lambda discs: plain.proximal(discs, ACCURACY), 1e-3),
    ("sparse-dictionary", {}, lambda discs: plain.sparse_dictionary(discs, ACCURACY), 1e-6),
    ("regression", {}, plain.gaussian_regression, 1e-3),
    ("regression", {"kind": "radial"}, plain.radial_regression, 1e-6),
])  # fmt: skip
def test_answers_are_plain_ones(
    discs: Reduction, name: str, options: dict[str, str], plainly: object, tolerance: float
) -> None:
    model, query = discs.with_formulation(create("formulation", name, options)).model, plainly(discs)
    for mu in discs.problem.validation_set(4, 0):
        found = model.solve(mu)
        u, lam = model.online.reconstruct(mu, FormulationAnswer(*query(mu)[:2]))
        assert found.status == "ok"
        assert discs.problem.V.norm(found.u - u) <= tolerance * discs.problem.V.norm(u)
        assert discs.problem.W.norm(found.lam - lam) <= 10.0 * tolerance * discs.problem.W.norm(lam)
        if found.uncertainty is not None:
            assert found.uncertainty == pytest.approx(query(mu)[2], rel=0.1)


@pytest.mark.parametrize("name", ["mixed", "penalty", "proximal", "sparse-dictionary", "local", "regression"])
def test_what_is_timed_passes_no_public_border(discs: Reduction, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its arguments were checked where they came from: a check takes as long as a query of `regression`."""
    model = discs.with_formulation(create("formulation", name)).model
    mu, settings = discs.problem.validation_set(1, 0)[0], QuerySettings(ACCURACY, SOLVE)
    model.online.solve(mu, settings)
    solver, vi = HighFidelitySolver(discs.problem), discs.problem.assemble(mu)
    monkeypatch.setattr(_Signature, "check", lambda self, *_: pytest.fail(f"{self._title} checks its arguments"))
    model.online.solve(mu, settings)
    HighFidelitySolver.solve_next.__wrapped__(solver, mu, vi)


def test_a_plain_hyper_reduced_query_has_the_same_answer_on_the_same_domain(discs: Reduction) -> None:
    model = discs.with_formulation(create("formulation", "hyper-reduced", {"integrate": "all"})).model
    tested, (rows, weights) = np.zeros_like(discs.cone.generators), model.built["rows"]
    tested[rows] = weights[:, None] * discs.cone.generators[rows]
    query = plain.hyper_reduced(discs, SOLVE, model.built["vectors"], model.built["elements"], tested)
    for mu in discs.problem.validation_set(4, 0):
        found, (x, alpha) = model.solve(mu), query(mu)
        assert np.allclose(found.x, x, atol=1e-6 * np.abs(x).max())
        assert np.allclose(found.alpha, alpha, atol=1e-5 * alpha.max())


def test_local_spaces_are_about_as_accurate_as_plain_ones(discs: Reduction) -> None:
    model, query, errors = discs.with_formulation(create("formulation", "local")).model, plain.local(discs, SOLVE), []
    V = discs.problem.V
    for mu in discs.problem.validation_set(8, 0):
        exact, (x, _, reconstruct, _) = model.high_fidelity(mu).u, query(mu)
        errors.append([V.norm(model.solve(mu).u - exact), V.norm(reconstruct(x[:, None])[:, 0] - exact)])
    ours, plain_errors = np.mean(errors, axis=0)
    assert ours <= 1.5 * plain_errors
