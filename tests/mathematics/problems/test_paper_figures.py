"""Twins of the paper's figures: they show the numbers of the run and of the paper, and judge by both."""

import re
import shutil
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from running import Changed, execute

from vibench import HighFidelitySolver
from vibench.report import ProblemTables, problem_tables
from vibench.results.read import read_table
from vibench.results.sqlite import FILE
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import theory
from vibench_problems.obstacle import RADIUS, Obstacle
from vibench_problems.paper import published
from vibench_problems.paper.__main__ import main
from vibench_problems.paper.claims import Agreement, compared, exceptions, holds, typeset
from vibench_problems.paper.evidence import Evidence, reached
from vibench_problems.paper.figures import PAGE, drawings
from vibench_problems.paper.sections import figure_claims, sections

FIXED = "primal = 'offline-pga'"
TABLES = ("queries", "cells", "histories")


def as_published(problem: str, sizes: str, loose: float, tight: float) -> list[str]:
    """SQL that makes the model of one tolerance one of the paper's pair, at its two tolerances."""
    statements = []
    for table in TABLES:
        stage = " AND stage IN ('enrichment', 'cone', 'pod')" * (table == "histories")
        statements.append(f"UPDATE {table} SET {sizes} WHERE problem = '{problem}'{stage}")
        statements.append(f"UPDATE {table} SET primal_tol = {loose} WHERE problem = '{problem}' AND {FIXED}")
    for table in ("queries", "histories"):
        mine = f"SELECT * FROM {table} WHERE problem = '{problem}' AND {FIXED}"
        statements += [f"CREATE TABLE again AS {mine}", f"UPDATE again SET primal_tol = {tight}"]
        statements += [f"INSERT INTO {table} SELECT * FROM again", "DROP TABLE again"]
    return statements


HERTZ = as_published("hertz", "pod_tol = NULL, pod_size = 46, dual_tol = NULL, dual_size = 12", 0.4, 0.3)
OBSTACLE = as_published("obstacle", "pod_tol = 0.001", 0.5, 0.001)


def tables_of(path: Path, problem: str) -> ProblemTables:
    (data,) = [one for _, one in problem_tables(path) if one.problem == problem]
    return data


def twins(path: Path, problem: str) -> dict[str, Callable[[], Any]]:
    return {f"figure-{number}": draw for number, draw in drawings(tables_of(path, problem)).items()}


def line_called(axes: Axes, label: str) -> np.ndarray:
    (line,) = [line for line in axes.get_lines() if line.get_label() == label]
    return np.asarray(line.get_xydata(), float)


@pytest.fixture(scope="module")
def both(quick_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = Path(shutil.copy(quick_run / FILE, tmp_path_factory.mktemp("published")))
    execute(path.parent, *OBSTACLE, *HERTZ)
    return path


@pytest.fixture(scope="module")
def drawn(both: Path) -> dict[str, Any]:
    return {name: draw() for problem in ("obstacle", "hertz") for name, draw in twins(both, problem).items()}


def test_every_figure_from_3_to_15_has_a_twin(drawn: dict[str, Any]) -> None:
    assert list(drawn) == [f"figure-{number}" for number in range(3, 16)]
    for name, figure in drawn.items():
        number = name.removeprefix("figure-")
        assert figure.get_suptitle().startswith(f"Figure {number}: "), name
        assert figure.caption, name
        assert figure.published, name
        assert figure.compared.startswith(("Agrees: ", "Differs: ", "Cannot be compared: ")), name


def test_a_run_without_the_pairs_of_the_paper_has_fewer_and_no_page(quick_run: Path) -> None:
    without = {"obstacle": {"figure-7", "figure-8"}, "hertz": {"figure-13", "figure-14", "figure-15"}}
    for problem, missing in without.items():
        found = twins(quick_run / "results.sqlite", problem)
        assert {name for name in missing if found[name]() is None} == missing
    obstacle, hertz = (tables_of(quick_run / "results.sqlite", name) for name in ("obstacle", "hertz"))
    with pytest.raises(ValueError, match=r"the run of obstacle has no models for \(19, 50\), \(51, 70\), \(89, 50\)"):
        sections(obstacle, hertz, hertz, {})


def test_a_problem_with_another_parameter_is_not_the_paper_s(changed: Changed) -> None:
    given = """iif(problem = 'hertz', '{"approach": "parameter"}', '{"bulge": true}')"""
    path = changed(*(f"UPDATE {table} SET problem_options = {given}" for table in TABLES))
    assert twins(path, "obstacle") == twins(path, "hertz") == {}


def test_projection_errors_stand_beside_the_published_sizes(quick_run: Path) -> None:
    path = quick_run / "results.sqlite"
    figure = twins(path, "obstacle")["figure-5"]()
    left, right = figure.axes
    crosses = "paper: size for a tolerance"
    np.testing.assert_array_equal(line_called(left, crosses), [(19, 1e-3), (51, 1e-4), (89, 1e-6)])
    np.testing.assert_array_equal(line_called(right, crosses), [(50, 1e-2), (70, 1e-3)])
    cells = read_table(path, "cells")
    mine = cells[(cells["problem"] == "obstacle") & (cells["dual"] == "mcpg")].iloc[0]
    assert f"N for δ_POD = 0.001: {mine['N']}" in figure.compared
    assert f"R for δ_mCPG = 0.01: {mine['R']}" in figure.compared
    assert "R for δ_mCPG = 0.001: none" in figure.compared.partition("Cannot be compared: ")[2]
    assert "N for δ_POD = 0.001: 19; " in figure.published


def test_a_violated_inequality_differs(changed: Changed) -> None:
    path = changed(*OBSTACLE)
    statement = "β_on ≥ β_off ≥ β_dec and β_on ≥ β_HF, (19, 50), δ_PGA = 0.5"
    everywhere = f"{statement}: over the span at all 8, over the cone at all 8"
    assert everywhere in twins(path, "obstacle")["figure-8"]().compared.partition("Differs: ")[0]
    path = changed(*OBSTACLE, "UPDATE queries SET beta_hf_span = 2.0 * beta_full_span WHERE query = 3")
    text = twins(path, "obstacle")["figure-8"]().compared
    assert f"{statement}: over the span not at all, over the cone at all 8" in text.partition("Differs: ")[2]


NO_ORDER, VANISHES = "no order between β_off and β_HF", "N < R implies β_dec = 0, (19, 50), over the cone as in (14)"


@pytest.mark.parametrize(
    ("statement", "values", "verdict"),
    [
        # All tolerances of a run together say nothing of a figure that shows some of them.
        (NO_ORDER, "beta_hf_span = iif(primal_tol = 0.5, 0.5 * beta_span, beta_hf_span)", "differs"),
        (NO_ORDER, "beta_hf_span = iif(primal_tol = 0.5, 1.5 * beta_span, beta_hf_span)", "differs"),
        (NO_ORDER, "beta_hf_span = iif(primal_tol = 0.5, (0.5 + query % 2) * beta_span, beta_hf_span)", "agrees"),
        (VANISHES, "beta_plain_cone_lower = 0.01, beta_plain_cone_upper = 0.02", "differs"),
        (VANISHES, "beta_plain_cone_lower = 0.0, beta_plain_cone_upper = 0.02", "cannot be compared"),
        (VANISHES, "beta_plain_cone_lower = 0.0, beta_plain_cone_upper = 0.0", "agrees"),
    ],
)
def test_a_claim_is_judged_by_its_figure(statement: str, values: str, verdict: str, changed: Changed) -> None:
    data = tables_of(changed(*OBSTACLE, f"UPDATE queries SET {values}"), "obstacle")
    assert [one.verdict.value for one in figure_claims(Evidence(data)) if one.statement == statement] == [verdict]


def test_figures_and_the_page_of_claims_have_the_same_verdicts(both: Path, drawn: dict[str, Any]) -> None:
    judged = [list(figure_claims(Evidence(tables_of(both, problem)))) for problem in ("obstacle", "hertz")]
    assert min(map(len, judged)) > 15
    for claim in chain(*judged):
        (number,) = re.findall(r"Fig\. (\d+)", claim.place)
        said = drawn[f"figure-{number}"].compared
        before, found, after = said.partition(f"{typeset(f'{claim.statement}: {claim.ours}')}")
        assert found, claim.name
        groups = re.findall("|".join(verdict.capitalize() for verdict in Agreement), before)
        assert groups[-1].lower() == claim.verdict.value
        assert after[0] in ";."


def test_constants_of_the_third_pair_are_over_the_only_parameter(both: Path, drawn: dict[str, Any]) -> None:
    figure = drawn["figure-13"]
    queries = read_table(both, "queries")
    mine = queries.query("problem == 'hertz' and dual == 'mcpg' and primal_tol == 0.4 and solver == 'piqp'")
    mine = mine.sort_values("mu_1")
    expected = mine[["mu_1", "beta_plain_span"]].to_numpy(float)
    np.testing.assert_allclose(line_called(figure.axes[0], "β_dec over the span"), expected)
    (panel, *_) = drawn["figure-15"].axes
    np.testing.assert_allclose(line_called(panel, "β_off"), mine[["mu_1", "beta_span"]].to_numpy(float))


def test_the_greedy_algorithm_is_that_of_the_histories(both: Path, drawn: dict[str, Any]) -> None:
    figure = drawn["figure-14"]
    sigma, least, _ = figure.axes
    histories = read_table(both, "histories")
    mine = histories.query("problem == 'hertz' and dual == 'mcpg' and primal_tol == 0.3")
    for panel, quantity in ((sigma, "sigma"), (least, "beta_span_min")):
        steps = mine[mine["quantity"] == quantity].sort_values("step")[["step", "value"]].to_numpy(float)
        shown = line_called(panel, "offline-pga, δ = 0.3")
        np.testing.assert_array_equal(shown[np.isfinite(shown[:, 1])], steps[steps[:, 1] > 1e-12])
    assert "PGA converges to δ_PGA = 0.3: σ = 0.4" in figure.compared.partition("Differs: ")[2]  # δ was 0.5


def test_the_membrane_is_that_of_figure_4(drawn: dict[str, Any]) -> None:
    figure = drawn["figure-4"]
    problem = Obstacle("coarse")
    mu = np.array(published.MEMBRANE)
    assert RADIUS * mu[0] == pytest.approx(0.18)
    found = HighFidelitySolver(problem).solve(mu)
    left, right = (axes.collections[0] for axes in figure.axes[:2])
    assert left.get_clim()[0] == pytest.approx(float(problem.picture(mu, found.u, found.lam).values.min()), rel=1e-6)
    assert right.get_clim() == (0.0, pytest.approx(float(found.lam.max()), rel=1e-6))
    assert f"{np.count_nonzero(found.lam > 0.0)} of {problem.W.dim} multipliers positive" in figure.compared


def test_five_pressures_lie_in_one_panel_with_hertz_s_theory(drawn: dict[str, Any]) -> None:
    figure = drawn["figure-10"]
    problem = Hertz("coarse")
    panel = figure.axes[1]
    ellipses = [line for line in panel.get_lines() if line.get_label() == "Hertz's theory"]
    assert len(ellipses) == len(published.RADII) == 5
    for radius, ellipse in zip(published.RADII, ellipses, strict=True):
        found = HighFidelitySolver(problem).solve(np.array([radius]))
        np.testing.assert_allclose(line_called(panel, f"λ(µ), µ = {radius:g} m")[:, 1], found.lam, rtol=1e-9)
        exact = theory(problem, np.array([radius]), found.u)
        x, pressure = np.asarray(ellipse.get_xydata(), float).T
        np.testing.assert_allclose((x / exact.half_width) ** 2 + (pressure / exact.peak) ** 2, 1.0, rtol=1e-12)


def test_claims_are_sorted_by_their_verdicts() -> None:
    conditions = {"a": True, "b": np.False_, "c": None, "d": np.True_}
    claims = [holds("Fig. 1", name, "x", condition) for name, condition in conditions.items()]
    assert compared(claims) == "Agrees: a: x; d: x. Differs: b: x. Cannot be compared: c: x."
    assert reached({0: 1.0, 3: 0.1, 4: 0.05}, 0.1) == 3
    assert np.isnan(reached({0: 1.0}, 0.1))
    assert exceptions({1: 1.0, 2: 3.0, 9: 1.0}, {1: 1.0, 2: 2.0}) == [2]


def test_the_command_draws_the_figures_of_runs_and_a_page(
    quick_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    again = tmp_path / "again" / "results.sqlite"
    again.parent.mkdir()
    again.write_bytes((quick_run / "results.sqlite").read_bytes())
    for problem in ("membrane", "discs"):
        monkeypatch.setattr(f"vibench_problems.paper.figures.{problem}.solution", lambda _: None)
    assert main([str(quick_run), str(again.parent), "--out", str(tmp_path / "drawn"), "--format", "svg"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert f"page: {tmp_path / 'drawn' / PAGE}" in printed
    assert "figure-4-again: again has no data for it" in printed
    page = (tmp_path / "drawn" / PAGE).read_text(encoding="utf-8")
    assert page.index("## Figure 5\n") < page.index("## Figure 5 again") < page.index("## Figure 11\n")
    assert "Run quick, problem obstacle: resolution = coarse.\n\n**Published.** N for δ\\_POD = 0.001: 19; " in page
    assert {file.stem for file in (tmp_path / "drawn").glob("*.svg")} >= {"figure-5", "figure-5-again", "figure-9"}


def test_a_run_of_no_paper_is_refused(tmp_path: Path, changed: Changed, capsys: pytest.CaptureFixture[str]) -> None:
    remaining = (f"DELETE FROM {table} WHERE problem = 'hertz'" for table in TABLES)
    others = (f"UPDATE {table} SET problem_options = '{{\"bulge\": true}}'" for table in TABLES)
    assert main([str(changed(*remaining, *others)), "--out", str(tmp_path / "drawn")]) == 2
    assert "error: no problem of the paper in changed" in capsys.readouterr().err
    assert not (tmp_path / "drawn").exists()
