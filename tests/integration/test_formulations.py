from pathlib import Path
from typing import Any

import numpy as np
import pytest
from broken_formulations import Misbehaves
from fake_plugins import Wire
from formulations import Coarse, Nearest, Program

from vibench import RequestError, Run, Study, open_run, run
from vibench.results.consistency import violations
from vibench.study.matrix import expand

REASONS = {"raises": ("error", "ArithmeticError: no pivot"), "dies": ("crashed", "died with signal SIGKILL")}
"""What `Misbehaves` does at forces above 6, those of queries 0 and 2, and what becomes of it."""


def study(**axes: Any) -> Study:
    content = {
        "name": "formulations", "seed": 3, "validation": 4, "problem": [Wire], "dual": ["cpg", "mcpg"],
        "primal": ["decorrelated", "online-supremizers"], "solvers": ["piqp", "osqp"], "timing_rounds": 2,
        "timing_rounds_min": 1, "tolerances": [{"pod": [1e-3], "dual": [1e-2, 1e-3]}],
    }  # fmt: skip
    return Study(**content | axes)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The mixed formulation, the same as a plugin, one without axes, and one of every way to fail halfway."""
    bad = [{"name": Misbehaves, "label": how, "options": {"how": how}} for how in REASONS]
    asked = study(
        formulation=["mixed", Program, Nearest, *bad], dual=["cpg"], primal=["online-supremizers"], solvers=["piqp"],
        assembly=["full", "reduced"], tolerances=[{"pod": [1e-3], "dual": [1e-2]}],
    )  # fmt: skip
    return run(asked, tmp_path_factory.mktemp("formulations"), jobs=1)


def test_axes_that_a_formulation_does_not_have_are_neither_repeated_nor_needed() -> None:
    ways = {"assembly": ["full", "reduced"], "bounds": [True], "correction": ["none", "auto"]}
    cells = expand(study(formulation=["mixed", Program, Nearest], **ways))
    count = {label: sum(cell.formulation_label == label for cell in cells) for label in ("mixed", "Program", "Nearest")}
    assert count == {"mixed": 2 * 2 * 2 * 2 * 2 * 2, "Program": 2 * 2 * 2 * 2 * 2, "Nearest": 1}
    (nearest,) = (cell for cell in cells if cell.formulation_label == "Nearest")
    assert (nearest.dual, nearest.primal, nearest.pod, nearest.cone, nearest.solver, nearest.accuracy) == (None,) * 6
    assert str(nearest) == "Wire · Nearest"
    assert {cell.assembly for cell in cells if cell.formulation_label == "Program"} == {"full", "reduced"}
    tolerances: Any = [{"pod": [1e-3], "dual": [1e-2]}]
    content: Any = {"name": "one", "validation": 4, "problem": [Wire], "tolerances": tolerances}
    assert len(expand(Study(formulation=[Nearest], **content))) == 1
    with pytest.raises(RequestError, match="primal: required, but not given"):
        Study(formulation=["mixed", Nearest], **content)


@pytest.mark.long
def test_all_are_judged_by_the_same_bounds_and_misbehaviour_costs_its_rows(found: Run) -> None:
    queries = found.table("queries")
    ok = queries[queries["status"] == "ok"]
    assert set(ok["formulation"]) == {"mixed", "Program", "Nearest", *REASONS}
    assert violations(queries, found.table("cells").set_index("cell")["enrichment_kind"]) == []
    for error, bound in (("u_energy", "u_energy"), ("lambda_natural", "lambda_natural"), ("u", "u")):
        assert (ok[f"error_{error}_absolute"] <= ok[f"bound_{bound}"] * (1.0 + 1e-9)).all()
    (nearest,) = found.table("cells").query("formulation == 'Nearest'").to_dict("records")
    assert (nearest["dual"], nearest["primal"], nearest["solver"]) == ("–", "–", "–")
    assert (nearest["multiplier"], nearest["error_u_predicted_mean"]) == ("residual", 0.5)
    assert np.isnan(nearest["beta_span_min"])
    queries = found.table("queries").query("assembly == 'full'")
    for how, (status, reason) in REASONS.items():
        rows = queries[queries["formulation"] == how].set_index("query")
        upper = rows["mu_1"] >= 6.0
        assert 0 < upper.sum() < len(rows)
        assert (rows.loc[~upper, "status"] == "ok").all()
        assert set(rows.loc[upper, "status"]) == {status}
        assert all(reason in text for text in rows.loc[upper, "reason"])
    queries = found.table("queries").set_index(["formulation", "assembly", "query"]).sort_index()
    own, other = queries.loc["mixed"], queries.loc["Program"]
    assert (own["status"] == "ok").all()
    assert (other["status"] == "ok").all()
    names = [name for name in own if name.startswith(("error_", "bound_", "hf_", "effectivity_", "primal_r", "dual_r"))]
    kept = [name for name in names if name not in ("hf_s", "bound_note") and own[name].notna().all()]
    assert {"error_u", "error_lambda_natural", "bound_u_energy", "hf_dual_residual", "primal_residual"} <= set(kept)
    for name in kept:
        np.testing.assert_allclose(other[name].astype(float), own[name].astype(float), rtol=1e-9, atol=1e-14)


def test_a_new_formulation_with_programs_runs_as_the_mixed_one(tmp_path: Path) -> None:
    """It has its rows for all solvers, ways of assembly, bounds and corrections, and its columns."""
    asked = Study(
        name="coarse", validation=2, problem=[{"name": "radial-obstacle", "options": {"resolution": 150}}],
        formulation=["mixed", Coarse], dual=["mcpg"], primal=["offline-pga"], solvers=["piqp", "osqp"], accuracy=[1e-6],
        assembly=["full", "reduced"], bounds=[False, True], correction=["none", "feasible"], warm_start=True,
        timing_rounds=1, timing_rounds_min=1,
        tolerances=[{"pod": [1e-2], "dual": [1e-1], "primal": {"offline-pga": [0.5]}}],
    )  # fmt: skip
    done = run(asked, tmp_path / "run", jobs=1, progress=False)
    way = ["solver", "assembly", "bounds", "correction"]
    for table, index in (("cells", way), ("queries", [*way, "query"])):
        frame = done.table(table).set_index("formulation")
        mixed, coarse = (frame.loc[name].set_index(index).sort_index() for name in ("mixed", "Coarse"))
        assert set(mixed["status"]) == set(coarse["status"]) == {"ok"}
        # Errors of λ in relative reduced form may be missing where the coarse model has no contact, no other column.
        assert [*mixed.columns[mixed.notna().any()]] == [*coarse.columns[coarse.notna().any()]]
        assert set(mixed.index) == set(coarse.index)
    cells = done.cells.set_index("formulation")
    assert set(cells.loc["Coarse", "R"]) == {-(-int(cells.loc["mixed", "R"].iloc[0]) // 2)}
    assert (cells.loc["Coarse", "online_assemble_s"] > 0.0).all()
    assert (cells.loc["Coarse", "bound_online_violations"].dropna() == 0).all()


@pytest.mark.long
def test_formulations_are_timed_with_all_of_it_and_answer_again(found: Run) -> None:
    cells = found.table("cells").set_index(["formulation", "assembly"])
    for key in (("mixed", "full"), ("Program", "full"), ("Nearest", "full")):
        assert cells.loc[key, "timed_rounds"] == 2
        assert cells.loc[key, "online_s"] > 0.0
    assert cells.loc[("mixed", "full"), "offline_formulation_s"] == 0.0
    assert cells.loc[("Nearest", "full"), "offline_formulation_s"] > 0.0
    compared = found.table("thresholds")
    of_model = compared["cell_a"].isna()
    assert set(compared.loc[of_model, "formulation_b"]) >= {"mixed", "Program", "Nearest"}
    others = compared[~of_model & (compared["formulation_a"] == "mixed")].groupby("formulation_b")["cell_a"]
    known = cells.reset_index().groupby("formulation")["cell"].agg(set)
    assert {"Program", "Nearest"} <= set(others.groups)
    assert all(set(mine) <= known["mixed"] for _, mine in others)
    cells = found.table("cells").set_index("formulation")
    key, mixed = cells.loc["Nearest", "cell"], cells.loc["mixed", "cell"].iloc[0]
    again = open_run(found.path).model(key).solve([5.0])
    exact = open_run(found.path).model(mixed).high_fidelity([5.0])
    assert again.status == "ok"
    assert again.high_fidelity_residuals.worst < 1.0
    problem = Wire()
    assert problem.V.norm(again.u - exact.u) <= again.error_bounds.u
    nearest = open_run(found.path).model(key)
    with pytest.raises(RequestError, match="the formulation Nearest has no program"):
        nearest.reduced  # noqa: B018
    with pytest.raises(RequestError, match="the formulation Nearest uses no QP solver"):
        nearest.solve([5.0], solver="piqp")
