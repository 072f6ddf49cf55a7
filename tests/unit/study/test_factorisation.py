from unittest import mock

import numpy as np
import pytest

from vibench import HighFidelitySolver, RequestError, Study, create
from vibench.execution.run import unavailable
from vibench.highfidelity import kkt_systems
from vibench.linalg import factorisations, inner_product
from vibench.linalg.factorisations import IMPLEMENTATIONS
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import find
from vibench.reduction import supremizers
from vibench.study.matrix import expand

STUDY = {
    "name": "s", "validation": 2, "solvers": ["piqp"], "dual": ["mcpg"], "primal": ["decorrelated"],
    "problem": ["obstacle"], "tolerances": [{"N": [2], "R": [2]}],
}  # fmt: skip


def solved(name: str, options: dict[str, object]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    problem = create("problem", name, options)
    mu = problem.training_set()[3]
    solver = HighFidelitySolver(problem)
    with mock.patch.object(kkt_systems, "MANY_UNKNOWNS", 0):
        solution = solver.solve(mu)
    B = problem.assemble(mu).B
    contact = np.unique(B.tocsr().indices)
    space = supremizers.ContactCoordinates(problem.V, np.zeros((problem.V.dim, 0)), contact)
    load = (B.T @ solution.lam)[contact]
    return solution.u, solution.lam, space.vectors(space.supremizers(load[:, None]))


@pytest.mark.parametrize("name", ["hertz", "obstacle"])
@pytest.mark.parametrize("factorisation", [one for one in IMPLEMENTATIONS if one != "superlu"])
def test_the_numbers_are_those_of_the_default(name: str, factorisation: str) -> None:
    if not IMPLEMENTATIONS[factorisation].is_installed:
        pytest.skip("not installed")
    options = {"resolution": 300}
    found = solved(name, options | {"factorisation": factorisation})
    for own, default in zip(found, solved(name, options), strict=True):
        np.testing.assert_allclose(own, default, atol=1e-9 * np.abs(default).max())


@pytest.mark.parametrize("factorisation", [*IMPLEMENTATIONS])
def test_only_who_is_chosen_factorises_a_problem_that_is_made(factorisation: str) -> None:
    """In space the default would take longer for X_V than all that follows."""
    if not IMPLEMENTATIONS[factorisation].is_installed:
        pytest.skip("not installed")
    with mock.patch.object(inner_product, "SparseCholesky", wraps=inner_product.SparseCholesky) as default:
        problem = create("problem", "obstacle", {"resolution": 300, "factorisation": factorisation})
        problem.V.riesz(np.ones(problem.V.dim))
    by_default = [call.args[0].shape[0] for call in default.call_args_list].count(problem.V.dim)
    assert by_default == (1 if factorisation == "superlu" else 0)


def test_a_study_chooses_for_its_problems_and_a_problem_for_itself() -> None:
    problems = ["obstacle", {"name": "hertz", "options": {"factorisation": "cholmod"}}]
    study = Study.model_validate(STUDY | {"problem": problems, "factorisation": "pardiso"})
    chosen = [problem.plugin(PluginKind.PROBLEM).arguments["factorisation"] for problem in study.problem]
    assert chosen == ["pardiso", "cholmod"]
    default = Study.model_validate(STUDY | {"factorisation": "superlu"}).problem[0].plugin(PluginKind.PROBLEM)
    assert default == Study.model_validate(STUDY).problem[0].plugin(PluginKind.PROBLEM)  # and so are its keys
    assert default != study.problem[0].plugin(PluginKind.PROBLEM)
    with pytest.raises(RequestError, match=r"factorisation.*superlo"):
        Study.model_validate(STUDY | {"factorisation": "superlo"})
    with pytest.raises(RequestError, match=r"superlo.*superlu"):
        create("problem", "obstacle", {"factorisation": "superlo"})


def test_available_and_missing_implementations_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    # It can be imported here, too.
    monkeypatch.setitem(vars(factorisations.IMPLEMENTATIONS["pardiso"]), "fault", "")

    def plugin() -> Plugin:
        return Plugin.of(find(PluginKind.PROBLEM, "hertz"), {"factorisation": "available"})

    with mock.patch.object(factorisations, "distribution_version", return_value=""):
        assert "factorisation" not in plugin().arguments  # SuperLU, the default
    with mock.patch.object(factorisations, "distribution_version", return_value="1.0"):
        assert plugin().arguments["factorisation"] == "pardiso"
    (cell,) = expand(Study.model_validate(STUDY | {"factorisation": "pardiso"}))
    with mock.patch.object(factorisations, "distribution_version", return_value=""):
        assert "`pip install pypardiso`" in unavailable(cell)
    with mock.patch.object(factorisations, "distribution_version", return_value="1.0"):
        assert unavailable(cell) == ""
