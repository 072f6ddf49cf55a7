from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from vibench.results.consistency import violations
from vibench.results.read import read_table


@pytest.fixture(scope="module")
def cells(quick_run: Path) -> pd.DataFrame:
    return read_table(quick_run / "results.sqlite", "cells").set_index("cell")


@pytest.fixture(scope="module")
def queries(quick_run: Path, cells: pd.DataFrame) -> pd.DataFrame:
    frame = read_table(quick_run / "results.sqlite", "queries")
    return frame.assign(kind=frame["cell"].map(cells["enrichment_kind"]))


def test_every_cell_has_accurate_queries_that_keep_the_invariants(cells: pd.DataFrame, queries: pd.DataFrame) -> None:
    assert len(cells) == 2 * 2 * 3 * 3
    assert set(cells["problem"]) == {"obstacle", "hertz"}
    assert set(cells["primal"]) == {"decorrelated", "online-supremizers", "offline-pga"}
    assert cells[["problem", "dual", "primal", "primal_tol", "solver"]].duplicated().sum() == 0
    assert (cells["queries"] == 8).all()
    ok = queries[queries["status"] == "ok"]
    assert len(ok) > 0.9 * len(queries)
    assert ok[["primal_residual", "dual_residual", "gap"]].max().max() <= 1e-7
    assert (queries[queries["status"] != "ok"]["reason"] != "").all()
    assert ok["error_u"].max() < 0.01
    # Inf-sup constants do not depend on the solver at all, errors of u only in the digits of the accuracy.
    keys = ["problem", "dual", "primal", "primal_tol", "query"]
    spread = ok.groupby(keys, dropna=False)[["error_u", "beta_span"]].agg(lambda values: values.max() - values.min())
    assert spread["beta_span"].max() == 0.0
    assert spread["error_u"].max() < 3e-4
    assert violations(queries, cells["enrichment_kind"]) == []
    for kind, prefix in (("per-parameter", "beta_full_"), ("none", "beta_plain_")):
        some = queries[queries["kind"] == kind]
        for what in ("span", "cone_lower", "cone_upper"):
            assert np.allclose(some[f"beta_{what}"], some[f"{prefix}{what}"], rtol=1e-8, atol=1e-14)
    short = cells["N"] + cells["enrichment"] < cells["rank"]
    assert short.any()
    assert not short.all()
    vanishes = queries["beta_span"].to_numpy() == 0.0  # exactly, below the rank
    assert np.array_equal(vanishes, short.loc[queries["cell"]].to_numpy())


def test_enrichments_and_cones_keep_their_promise(queries: pd.DataFrame, quick_run: Path, cells: pd.DataFrame) -> None:
    """Obstacle: all parameters share one supremizer space, so the bound of the training set holds everywhere."""
    fixed = queries[(queries["kind"] == "fixed") & (queries["problem"] == "obstacle")]
    bound = np.sqrt(1.0 - fixed["primal_tol"] ** 2)
    assert (fixed["beta_span"] >= bound * fixed["beta_full_span"] * (1.0 - 1e-9)).all()
    assert (fixed["beta_cone_upper"] >= bound * fixed["beta_full_cone_lower"] * (1.0 - 1e-9)).all()
    histories = read_table(quick_run / "results.sqlite", "histories")
    keys = ["problem", "dual", "primal", "primal_tol", "step"]
    own, full = (
        histories[histories["quantity"] == quantity].set_index(keys)["value"].sort_index()
        for quantity in ("beta_span_training", "beta_full_span_training")
    )
    assert len(own) == 2 * (125 + 81)
    bound = np.sqrt(1.0 - own.index.get_level_values("primal_tol").to_numpy() ** 2)
    assert np.all(own.to_numpy() >= bound * full.to_numpy() * (1.0 - 1e-9))
    for problem in ("obstacle", "hertz"):
        sizes = cells[cells["problem"] == problem].groupby("dual")["R"].first()
        assert sizes["mcpg"] <= sizes["cpg"]
        orth = histories[(histories["quantity"] == "e_orth") & (histories["problem"] == problem)]
        common = orth.groupby("dual")["step"].max().min()
        medians = orth[(orth["step"] > 0) & (orth["step"] <= common)].groupby("dual")["value"].median()
        assert medians["mcpg"] > medians["cpg"]
