from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from running import Main, Vibench, refused, succeeded

from vibench import open_run

meshio = pytest.importorskip("meshio")


def first_cell(run: Path) -> str:
    return str(pd.read_csv(run / "tables" / "cells.csv")["cell"].iloc[0])


def test_a_solution_of_a_run_is_exported(quick_run: Path, main: Main) -> None:
    cell = first_cell(quick_run)
    model = open_run(quick_run).model(cell)
    mu = 0.5 * (model.parameters.lower + model.parameters.upper)
    text = ",".join(map(repr, mu.tolist()))
    out = succeeded(main("export", str(quick_run), cell, "fields.vtu", "--mu", text))
    assert "fields.vtu" in out
    written = meshio.read("fields.vtu")
    expected = model.problem.mesh_fields(mu, model.solve(mu).u, model.solve(mu).lam)
    for quantity, values in expected.at_points.items():
        assert np.allclose(written.point_data[f"{quantity}, reduced"], values, rtol=1e-9, atol=1e-12, equal_nan=True)


def test_impossible_exports_are_refused(quick_run: Path, vibench: Vibench, tmp_path: Path, main: Main) -> None:
    cell = first_cell(quick_run)
    upper = open_run(quick_run).model(cell).parameters.upper
    done = vibench(tmp_path, "export", str(quick_run), cell, "out.vtu", "--mu", str(1.001 * upper[0]))
    assert done.returncode == 0, done.stderr
    said = "vibench: radius: outside the parameter domain, where the model was not trained"
    assert set(done.stderr.splitlines()) == {said}
    for arguments, said in (
        ("{cell} fields.vtu --mu -1e9,-.5", "mu is [-1000000000.0, -0.5], expected finite numbers (radius)"),
        ("{cell} fields.vtu --mu -x,0.1", "--mu is '-x,0.1', expected numbers separated by commas"),
        ("model.npz", "expected DIR, a folder for programs, or CELL FILE"),
        ("3f9a programs", "expected DIR, a folder for programs, or CELL FILE"),
        ("3f9a model.npz --mu 1", "--mu has no meaning for 'model.npz'"),
        ("3f9a fields.vtu --no-bases --tolerance 1e-3", "--tolerance, --no-bases has no meaning for"),
        ("3f9a model.c --sequence", "--sequence has no meaning for 'model.c'"),
    ):
        words = arguments.format(cell=first_cell(quick_run)).split()
        refused(main("export", str(quick_run), *words), said)
