"""Calls of the library with wrong arguments: each is a `RequestError` of one line that names the argument."""

import inspect
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.sparse as sp
from packs import write_cable
from sample_run import write_sample_run

import vibench
from vibench import NumericalError, RequestError, Stop
from vibench.library import runs

VALUES = [
    None, float("nan"), float("inf"), -1, 0, 1.5, 2**70, True, 1j, "", "x", "\0", "x" * 5000, b"x", [], ["x"],
    [None], {}, {"x": 1}, ("png", "exe"), object(), len, np.zeros((2, 2)), np.array([np.nan, 1.0]), np.float64("nan"),
    np.int64(3), Path("/dev/null"), Path("nowhere"),
]  # fmt: skip
STUDY: dict[str, Any] = {
    "name": "x", "problem": ["radial-obstacle"], "solvers": ["piqp"], "dual": ["mcpg"], "primal": ["decorrelated"],
    "validation": 2, "tolerances": [{"N": [2], "R": [2]}],
}  # fmt: skip


class ReachedError(Exception):
    """The arguments were accepted, and what takes long began."""


Calls = dict[str, tuple[Callable[..., Any], dict[str, Any]]]


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Calls:
    """The functions that users call, with right arguments for all of their parameters."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runs, "run_study", Mock(side_effect=ReachedError))
    monkeypatch.setattr("vibench.report.html.page", lambda *_, **__: "")
    run = vibench.open_run(write_sample_run(Path("run")))
    pack = vibench.create("problem", "pack", {"path": str(write_cable(tmp_path / "cable"))})
    reduction = vibench.Reduction(pack, vibench.create("dual strategy", "mcpg"), None, Stop(size=2), Stop(size=2))
    model, mu = reduction.model, [5.0, 0.2]
    space, few = vibench.InnerProduct(sp.eye_array(5)), vibench.InnerProduct(sp.eye_array(3))
    A, B = sp.eye_array(5, format="csr"), sp.eye_array(3, 5, format="csr")
    vi = vibench.VariationalInequality(A, np.ones(5), B, np.ones(3))
    spaces: dict[str, Any] = {"snapshots": np.eye(3, 4), "W": few, "stop": Stop(size=1)}
    bases, coordinates = {"problem": "membrane", "dual": "wide"}, {"x": np.zeros(2), "alpha": np.zeros(2)}
    return {
        "open_run": (vibench.open_run, {"path": "run", "at": {}}),
        "run": (vibench.run, {
            "study": vibench.Study(**STUDY), "out": "o", "jobs": 1, "fresh": False, "retry": False, "executor": "local",
            "scheduler": None, "observer": None, "progress": False, "repeats": 1}),
        "read_study": (vibench.read_study, {"request": "quick", "overrides": {}}),
        "create": (vibench.create, {"kind": "problem", "name": "radial-obstacle", "options": {}}),
        "Run.table": (run.table, {"name": "cells"}),
        "Run.break_even": (run.break_even, {"error": "u", "within": 0.1}),
        "Run.figure": (run.figure, {"kind": "convergence", **bases}),
        "Run.write_tables": (run.write_tables, {"folder": "t"}),
        "Run.write_figures": (run.write_figures, {"folder": "f", "formats": ()}),
        "Run.report": (run.report, {"path": "r.html", "figures": False}),
        "Run.model": (run.model, {"cell": "0"}),
        "export_model": (vibench.export_model, {
            "model": model, "file": "m.npz", "tolerance": 1e-8, "evaluations": 64, "bases": True, "c": False}),
        "Model.high_fidelity": (model.high_fidelity, {"mu": mu}),
        "Model.reconstruct": (model.reconstruct, {"mu": mu, **coordinates}),
        "break_even": (vibench.break_even, {"offline_a": 1.0, "online_a": 0.1, "offline_b": 2.0, "online_b": 0.05}),
        "read_model_pack": (vibench.packs.read_model_pack, {"path": "cable"}),
        "pack_digest": (vibench.packs.pack_digest, {"path": "cable"}),
        "Reduction": (vibench.Reduction, {
            "problem": pack, "dual": reduction.dual, "primal": None, "modes": Stop(size=2), "generators": Stop(size=2),
            "tolerance": None, "training": None, "assembly": "full", "interpolation": 1e-9, "solver": "piqp",
            "accuracy": 1e-9, "formulation": reduction.formulation, "bounds": False, "on_failure": "stop"}),
        "Study": (vibench.Study, STUDY),
        "Stop": (Stop, {"tolerance": 0.1, "size": None}),
        "Stop of a size": (Stop, {"tolerance": None, "size": 3}),
        "pod": (vibench.pod, {"snapshots": np.eye(5, 4), "V": space, "stop": Stop(size=1)}),
        "greedy_cone": (vibench.greedy_cone, spaces),
        "project_on_cone": (vibench.project_on_cone, {"generators": np.eye(3, 2), "theta": np.ones(3), "W": few}),
        "supremizers": (vibench.supremizers, {"V": space, "B": sp.eye_array(3, 5), "eta": np.ones((3, 1))}),
        "solve_high_fidelity": (vibench.solve_high_fidelity, {"vi": vi, "stiffness": None, "start": None}),
        "solve_qp": (vibench.solve_qp, {
            "program": vi, "solver": "piqp", "accuracy": 1e-8, "extra": None, "factor": None, "start": None}),
        "InnerProduct": (vibench.InnerProduct, {"matrix": sp.eye_array(5), "name": "X", "factorisation": "superlu"}),
        **{f"InnerProduct.{name}": (getattr(space, name), {argument: np.ones(5)}) for name, argument in (
            ("apply", "u"), ("norm", "u"), ("whiten", "u"), ("riesz", "functional"),
            ("whiten_functional", "functional"), ("unwhiten", "y"))},
        "InnerProduct.gram": (space.gram, {"u": np.eye(5), "v": np.eye(5)}),
        "InnerProduct.orthonormalise": (space.orthonormalise, {"u": np.eye(5), "against": None}),
    }  # fmt: skip


def test_every_wrong_argument_is_refused_in_a_line(calls: Calls, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vibench.report.figures.draw_all", lambda *_, **__: ([], []))
    warnings.simplefilter("ignore")  # parameters outside the box
    refused, wrong = 0, list[str]()
    for name, (function, right) in calls.items():
        if name != "Study":
            parameters = inspect.signature(function).parameters
            assert {*right} == {*parameters}, f"{name} has other parameters"
        for parameter in right:
            for value in VALUES:
                try:
                    function(**{**right, parameter: value})
                except ReachedError:
                    continue
                except (RequestError, NumericalError) as error:
                    refused += 1
                    if "\n" in str(error):
                        wrong.append(f"{name}({parameter}={value!r:.30}): {error}")
                except Exception as error:  # noqa: BLE001  what is searched for
                    wrong.append(f"{name}({parameter}={value!r:.30}) raises {type(error).__name__}: {error}")
    assert wrong == [], "\n".join(wrong)
    assert refused > 800


def test_messages_name_the_argument_and_what_is_right(tmp_path: Path) -> None:
    run, V = vibench.open_run(write_sample_run(tmp_path)), vibench.InnerProduct(sp.eye_array(5))
    one, no_number = Stop(size=1), np.full((5, 1), np.nan)
    for call, words in (
        (lambda: run.write_figures(formats="x"), "formats of Run.write_figures is 'x', expected Sequence"),
        (lambda: vibench.run("x"), "study of run is 'x', expected Study"),
        (lambda: run.table(None), "name of Run.table is None, expected str"),
        (lambda: run.write_tables("/dev/null/x"), "'/dev/null/x' cannot be written: Not a directory"),
        (lambda: vibench.create("problems", "hertz"), "no kind of plugins is called 'problems'"),
        (lambda: vibench.pod(np.ones((4, 2)), V, one), "V of pod has n = 5, but that of snapshots is 4"),
        (lambda: vibench.pod(np.ones(5), V, one), "snapshots of pod has the shape (5,), expected (n, P)"),
        (lambda: vibench.project_on_cone(no_number, np.ones(5), V),
            "generators of project_on_cone has an entry that is not finite"),
        (lambda: vibench.pod(np.ones((5, 2)), V, 1), "stop of pod is 1, expected a Stop"),
        (lambda: V.norm(np.ones(4)), "an array of the shape (4,) is not of a space of dimension 5"),
        (lambda: Stop(tolerance="x"), "tolerance of Stop is 'x', expected a number of at least 0"),
        (lambda: vibench.InnerProduct("x"), "the Gram matrix is 'x', expected a matrix of real numbers"),
    ):  # fmt: skip
        with pytest.raises(RequestError, match=re.escape(words)):
            call()


def test_a_model_refuses_what_is_no_parameter(calls: Calls) -> None:
    model = calls["export_model"][1]["model"]
    for value in [None, "x", b"x", 1j, object(), [1.0], {"load": "x", "depth": 1.0}, float("nan"), 5.0]:
        with pytest.raises(RequestError, match=r"\Amu (is|has) "):
            model.solve(value)
