"""Calls of the library with wrong arguments: each is a `RequestError` of one line that names the argument."""

import inspect
import re
import warnings
from collections.abc import Callable, Iterator
from enum import Enum
from numbers import Real
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.sparse as sp
from matplotlib.figure import Figure
from packs import manifest, write_cable, write_manifest, write_mesh
from sample_run import write_sample_run

import vibench
from vibench import NumericalError, RequestError, Stop, UnsupportedError, calibration, reduction, report, stability
from vibench.library import runs


class Hostile:
    """An object whose methods raise."""

    def __repr__(self) -> str:
        raise RuntimeError

    __array__ = __repr__


VALUES = [
    None, float("nan"), float("inf"), -float("inf"), -1, 0, 2, 1.5, 2**70, 10**5000, True, 1j, "", "x", "0.5", "\0",
    "x" * 5000, b"x", [], ["x"], ["0.5"], [None], [[1.0], [1.0, 2.0]], {}, {"x": 1}, set(), ("png", "exe"), object(),
    Hostile(), Hostile, len, (one for one in ()), np.zeros(0), np.array(1.0), np.zeros(7), np.zeros((2, 2)),
    np.zeros((2, 2, 2)), np.array([np.nan, 1.0]), np.array([np.inf, 1.0]), np.array([1j, 1.0]), np.array([None, 1.0]),
    np.ma.array([5.0, 0.2], mask=[True, False]), np.array(["2020-01-01"] * 2, "datetime64[D]"), np.array([True, False]),
    np.float64("nan"), np.int64(3), sp.eye_array(7), sp.csr_array([[np.nan] * 5] * 3), sp.csr_array([[1j]]),
    Path("/dev/null"), Path("nowhere"),
]  # fmt: skip
STUDY: dict[str, Any] = {
    "name": "x", "problem": ["radial-obstacle"], "solvers": ["piqp"], "dual": ["mcpg"], "primal": ["decorrelated"],
    "validation": 2, "tolerances": [{"N": [2], "R": [2]}],
}  # fmt: skip
# Made by vibench, by plugins in every query, whose answers are judged, or parts of a run.
NOT_CALLED = {
    "AffineSum.at",
    "AffineSum.coefficients",
    "AffineSum.mapped",
    "BreakEven",
    "CompiledModel",
    "CompiledProgram",
    "Contact",
    "ContactLoads",
    "ExportedModel",
    "FormulationAnswer",
    "HighFidelitySolution",
    "MeshFields",
    "Model",
    "Model.answered",
    "Model.bound_of",
    "Model.pair",
    "Model.settings",
    "Model.solving",
    "Model.status_of",
    "OfflinePhase",
    "Picture",
    "ProgramModel",
    "QPSolution",
    "QPSolver",
    "QuerySettings",
    "Solution",
    "Step",
    "Stop.reached",
    "VariationalInequality",
    "is_absent",
    # Of submodules: what is made there, a function that may raise, what needs ArviZ or a C compiler.
    "CaptionedFigure",
    "CompiledSensors",
    "Interval",
    "LazyMaximum.next",
    "ModelPack",
    "Prediction",
    "ProblemTables",
    "Sheet.label_ends",
    "draw_field",
    "draw_multiplier",
    "styled",
    "summary",
}
# Numbers that a figure leaves out, the infinite ones of nothing known; no models; styles, texts.
PARTLY_RIGHT = {
    "Data.interval.bounds", "Decisions.models", "Look.dashes", "Looks.series", "Prior.sd",
    "Series.variant", "constraint_classes.matrices", "plot.x", "plot.y", "scatter.x", "scatter.y", "save.formats",
}  # fmt: skip


class ReachedError(Exception):
    """The arguments were accepted, and what takes long began."""


@pytest.fixture
def right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Right arguments by name, where there are several meanings with the name of the callable."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runs, "run_study", Mock(side_effect=ReachedError))
    monkeypatch.setattr(runs, "recorded_cell", Mock(side_effect=ReachedError))
    monkeypatch.setattr("vibench.report.html.page", lambda *_, **__: "")
    monkeypatch.setattr("vibench.report.figures.draw_all", lambda *_, **__: ([], []))
    run = vibench.open_run(write_sample_run(Path("run")))
    more = {"mesh": write_mesh(folder := write_cable(tmp_path / "cable"), "m.vtu", "")}
    more |= {"outputs": [{"name": "mean", "unit": "m", "u": "vectors.npz:mass"}]}
    write_manifest(folder, manifest() | more)
    pack = vibench.create("problem", "pack", {"path": str(folder)})
    size, mu, two = Stop(size=2), np.array([5.0, 0.2]), ("a", "b")
    mcpg = vibench.create("dual strategy", "mcpg")
    phase = vibench.Reduction(pack, mcpg, None, size, size, assembly="reduced", bounds=True)
    model, solver, sums = phase.model, vibench.HighFidelitySolver(pack), vibench.AffineSum((mu,), np.ones)
    space, few, B = vibench.InnerProduct(sp.eye_array(5)), vibench.InnerProduct(sp.eye_array(3)), sp.eye_array(3, 5)
    vi = vibench.VariationalInequality(sp.eye_array(5, format="csr"), np.ones(5), B.tocsr(), np.ones(3))
    disc = vibench.Blocks(vibench.BlockKind.DISC, np.array([[0, 1]]), np.ones(1))
    output, K = vibench.Output("X", "1", u=np.ones(5)), vibench.DualSet((disc,))
    assembled, two_rows = pack.assemble(mu), np.ones(2)
    own: dict[str, Any] = {f"Study.{name}": value for name, value in STUDY.items()}
    own |= {
        "InnerProduct.gram.u": np.ones((5, 1)), "InnerProduct.gram.v": np.ones((5, 1)), "Reduction.generators": size,
        "InnerProduct.orthonormalise.u": np.ones((5, 1)), "Output.u": mu, "Output.lam": mu,
        "InnerProduct.name": "X", "Output.name": "X", "Output.unit": "X", "Run.table.name": "cells",
        "create.kind": "problem", "Run.figure.problem": "membrane", "Run.break_even.error": "u",
        "create.name": "radial-obstacle", "run.observer": None, "Reduction.tolerance": None, "Reduction.primal": None,
        "InnerProduct.factorised_by.name": "superlu", "Study.training": ["own"], "Study.formulation": ["mixed"],
        "Stop.tolerance": None, "Snapshots.mu": np.ones((4, 2)), "Enrichment.kind": vibench.Kind.NONE,
        "Enrichment.eta": None, "export_vtu.file": "m.vtu", "Run.path": Path("run"),
        "Reduction.enriched.tolerance": None, "Model.solve.tolerance": None, "Model.solve_all.tolerance": None,
        "greedy_cone.snapshots": np.eye(3, 4), "Snapshots.u": np.eye(5, 4), "Snapshots.lam": np.eye(3, 4),
        "solve_qp.start": None, "Offline.generators": size,
        "HighFidelitySolver.condensed.vi": assembled, "HighFidelitySolver.solve_assembled.vi": assembled,
        "HighFidelitySolver.solve_from.vi": assembled, "HighFidelitySolver.solve_from.nearest": None,
        "HighFidelitySolver.solve_next.vi": assembled, "HighFidelitySolver.verify.vi": assembled,
        "Blocks.gap.error": two_rows, "Blocks.gap.unit": 0.0, "Output.values.mus": np.ones((2, 1)),
        "Output.values.u": np.ones((5, 2)), "Output.values.lam": np.ones((3, 2)),
        "ParameterBox.units": two, "check_enrichment.basis": phase.pod.basis, "check_enrichment.V": pack.V,
        "mcpg.reduce.snapshots": np.eye(3, 4), "offline-pga.build.offline": phase.offline,
        "offline-pga.build.tolerance": 0.5, "check_cone.W": pack.W,
        "Run.report.path": Path("r.html"), "Offline.basis": phase.pod.basis,
        "Offline.span": phase.cone.generators, "Offline.training": mu[None], "pack_digest.path": str(folder),
        "read_model_pack.path": str(folder), "foreign.kind": RequestError, "foreign.what": "a library",
    }  # fmt: skip
    others, further = of_submodules(model, tmp_path)
    made = (run, model, phase, space, size, solver, sums, pack.parameters, disc, K, output, vi, *others)
    return own | further | {
        "instances": {type(one): one for one in made},
        "B": B, "V": space, "W": few, "Z": np.eye(pack.V.dim, 2), "accuracy": 1e-8, "alpha": np.zeros(2), "at": {},
        "basis": np.eye(5, 2), "bounds": False, "cell": "0", "change": np.negative, "chi": np.eye(pack.W.dim, 2),
        "coarse": pack, "columns": np.arange(2), "cone": phase.cone, "corrected": False, "count": 2, "counts": 2,
        "dual": phase.dual, "error": 0.1, "errors": mu, "enrichment": phase.enrichment,
        "eta": np.ones((3, 1)), "evaluations": 64, "fallbacks": (), "reduced": model.reduced, "history": {},
        "primal": vibench.create("primal strategy", "decorrelated"), "skipped": (), "file": "m.npz", "folder": "f",
        "formulation": vibench.create("formulation", "mixed"), "free": np.zeros(2, bool), "functional": np.ones(5),
        "g": np.array([1.0, np.inf]), "formats": (), "generators": np.eye(3, 2), "interpolation": 1e-9,
        "jobs": 1, "kind": "convergence", "listed": None, "left_out": set(), "limits": {},
        "log": pack.parameters.names[:1], "lower": mu, "matrix": sp.eye_array(5), "measure": "u", "model": model,
        "modes": size, "mu": mu, "mus": mu[None], "name": pack.parameters.names[0], "names": two, "offline_a": 1.0,
        "offline_b": 2.0, "online_a": 0.1, "online_b": 0.1, "options": {}, "out": "o", "overrides": {},
        "pairs": [(1.0, mu)], "path": "run", "points": mu[None], "coarse_points": mu[None], "problem": pack,
        "program": vi, "queries": 10.0, "repeats": 1, "request": "quick", "rows": np.arange(2), "scheduler": "x",
        "seed": 0, "size": 2, "snapshots": np.eye(5, 4), "solver": "piqp", "span": np.eye(3, 2), "stop": size,
        "study": vibench.Study(**STUDY), "terms": (mu,), "theta": np.ones(3), "thetas": np.ones, "tolerance": 1e-8,
        "training": None, "u": np.ones(5), "unit": mu[None], "units": two, "upper": mu + 1.0, "vi": vi, "within": 0.1,
        "x": np.zeros(2), "y": np.ones(5), "lam": two_rows, "slack": two_rows, "values": two_rows, "round_off": None,
        "solution": solver.solve(mu), "unverified": solver.solve_assembled(mu, assembled),
        "ContactSource.text": "", "ContactSource.tables": {"rows": 2},
        "ContactSource.entries": 1, "Blocks.kind": vibench.BlockKind.DISC, "Blocks.rows": np.array([[0, 1]]),
        "Blocks.radii": np.ones(1), "DualSet.blocks": (),
    }  # fmt: skip


def of_submodules(model: vibench.Model, folder: Path) -> tuple[list[Any], dict[str, Any]]:
    """Objects of submodules whose methods are called, and right arguments of what is there."""
    pack, (two, three) = model.problem, (vibench.InnerProduct(sp.eye_array(size)) for size in (5, 3))
    (folder / "data.toml").write_text("[sensors.mean]\nvalue = 1.0\nnoise = 0.1\n")
    data, prior = calibration.read_data(folder / "data.toml", pack)
    decisions, layout = calibration.Decisions(pack, data, (), 0.0, 0), report.Layout(1.0, 1.0)
    axes, cone = Figure().subplots(), stability.cone_basis(np.eye(3, 2), three)
    growing, lazy = reduction.GrowingCone(np.eye(3, 4), three), reduction.LazyDistances(np.eye(3, 4))
    instances = [
        data, prior, decisions, growing, lazy, reduction.Cubature(2, 3), reduction.LazyMaximum(np.ones(4)),
        report.Sheet(1, 1), report.HIGH_FIDELITY_LOOK,
    ]  # fmt: skip
    arguments: dict[str, dict[str, Any]] = {
        "BoundedSensors": {"names": ("mean",)}, "Cubature.add": {"conditions": np.ones((2, 3)), "weight": 1.0},
        "Data": {"sensors": ("a",), "values": np.ones(1), "covariance": np.eye(1)},
        "Data.interval": {"outputs": np.ones(1), "bounds": np.ones(1)}, "Data.misfit": {"outputs": np.ones(1)},
        "Decisions": {"data": data, "models": (), "audit": 0.5},
        "Decisions.less": {"a": prior.mean, "b": prior.mean},
        "GrowingCone": {"snapshots": np.eye(3, 4), "W": three},
        "GrowingCone.add": {"direction": np.ones(3), "note": ""},
        "LazyDistances": {"whitened": np.eye(3, 4)}, "LazyDistances.residual": {"q": 0},
        "LazyDistances.widen": {"generators": np.eye(3, 1), "taken": None}, "LazyMaximum": {"first": np.ones(4)},
        "LazyMaximum.bound": {"bounds": np.ones(4)}, "LazyMaximum.exclude": {"index": 0},
        "Layout": {"width": 1.0, "height": 1.0}, "Look": {"colour": "k", "marker": "o", "rank": 0},
        "Looks": {"series": [report.Series("a")]}, "Metropolis": {"decisions": decisions, "prior": prior, "burn_in": 2},
        "Prior": {"box": prior.box, "mean": prior.mean, "sd": np.ones(2)}, "Series": {"name": "a"},
        "Sheet": {"rows": 1, "columns": 1, "layout": layout}, "Sheet.panel": {"row": 0, "column": 0},
        "cone_basis": {"chi": np.eye(3, 2), "W": three}, "beta_span": {"on_span": np.eye(3, 2)},
        "constraint_classes": {"matrices": [sp.eye_array(3, 5).tocsr()]},
        "cubature": {"conditions": np.ones((2, 3)), "tolerance": 0.1}, "inf_sup_full": {"V": two, "cone": cone},
        "hull_distances": {"points": np.eye(3, 2), "targets": np.ones((3, 1))},
        "inf_sup_on": {"Z": np.eye(5, 2), "cone": cone},
        "kkt_residuals": {"x": np.ones(5), "alpha": np.zeros(3), "inverse": None},
        "minimise": {"decisions": decisions, "box": prior.box, "iterations": 1, "tolx": 0.1},
        "name_axes": {"axes": axes, "places": [np.ones((2, 1))], "unit": "m"},
        "orthonormal_range": {"y": np.eye(5, 2)}, "problem_tables": {"path": Path("run"), "known": {}},
        "project_out": {"space": np.eye(5, 2)}, "projected_supremizers": {"Z": np.eye(5, 2)},
        "read_data": {"path": folder / "data.toml"}, "refuse_negative": {"snapshots": np.eye(3)},
        "save": {"figure": Figure(), "folder": Path(), "name": "n", "formats": ("png",)},
        "singular_values": {"a": np.eye(5, 2)}, "svd": {"a": np.eye(5, 2)},
        "subtract_cone_component": {"theta": np.ones(3), "generators": np.eye(3, 2)},
        "supremizer_coordinates": {"matrices": [sp.eye_array(3, 5).tocsr()], "V": two},
        "verify": {"answer": vibench.QPSolution(np.ones(5), np.zeros(3), "solved"), "accuracy": 1e-8},
    }  # fmt: skip
    line = {"axes": axes, "x": np.ones(2), "y": np.ones(2), "look": report.HIGH_FIDELITY_LOOK, "label": None}
    arguments |= {"plot": line, "scatter": line}
    return instances, {f"{name}.{one}": value for name, given in arguments.items() for one, value in given.items()}


def called(instances: dict[type, Any]) -> Iterator[tuple[str, Callable[..., Any]]]:
    """All public functions, constructors and methods, but for those of abstract classes, by name."""
    modules = (vibench, *(getattr(vibench, group) for group in vibench.GROUPS))
    for name, found in ((name, getattr(module, name)) for module in modules for name in module.__all__):
        if inspect.isfunction(found):
            yield name, found
        elif inspect.isclass(found) and not issubclass(found, Exception | Enum) and not inspect.isabstract(found):
            yield name, found
            for method, member in vars(found).items() if found in instances else ():
                if inspect.isfunction(member) and method[0] != "_":
                    yield f"{name}.{method}", getattr(instances[found], method)
    for kind, name, method in (("dual", "mcpg", "reduce"), ("primal", "offline-pga", "build")):
        yield f"{name}.{method}", getattr(vibench.create(f"{kind} strategy", name), method)


def fits(value: Any, right: Any, parameter: inspect.Parameter) -> bool:
    """Whether a value is like the right one, by another way than that of the checks."""
    if value is None or right is None or callable(right):
        return "None" in str(parameter.annotation) or (callable(right) and callable(value)) or value is right
    if isinstance(right, np.ndarray):
        kinds = "b" if right.dtype == bool else "iuf"
        plain = isinstance(value, np.ndarray) and not isinstance(value, np.ma.MaskedArray) and value.ndim > 0
        return plain and value.dtype.kind in kinds and (bool(np.isfinite(value).all()) or np.inf in right)
    if isinstance(right, int | float) and not isinstance(right, bool):
        return isinstance(value, Real) and not isinstance(value, bool) and abs(value) < float("inf")
    kinds = {str: str | Path, Path: str | Path, tuple: tuple | list, list: tuple | list, set: set | dict | list | tuple}
    return isinstance(value, kinds.get(type(right), type(right)))


def test_every_wrong_argument_is_refused_in_a_line(right: dict[str, Any]) -> None:
    warnings.simplefilter("ignore")  # parameters outside the box
    refused, wrong = 0, list[str]()
    for name, function in (one for one in called(right["instances"]) if one[0] not in NOT_CALLED):
        parameters = inspect.signature(function).parameters
        own = {one: parameter for one, parameter in parameters.items() if parameter.kind is not parameter.VAR_KEYWORD}
        preset = {one: right.get(one, parameter.default) for one, parameter in own.items()}
        known = {one: right.get(f"{name}.{one}", value) for one, value in preset.items()}
        # Wrong values tell nothing where the right ones are refused, which are tried first.
        for parameter, value in [("", None), *((one, value) for one in known for value in VALUES)]:
            given = known | ({parameter: value} if parameter else {})
            what = f"{name}({parameter}=a {type(value).__name__})"
            counts = [given.pop("counts"), 2] if "counts" in given else []
            for written in (Path("m.npz"), Path("m.vtu")):
                written.unlink(missing_ok=True)
            try:
                function(*counts, **given)
            except ReachedError:
                pass
            except (RequestError, NumericalError, UnsupportedError) as error:
                refused += 1
                wrong += [f"{what}: {error}"] * (not parameter or "\n" in str(error))
                continue
            except Exception as error:  # noqa: BLE001  what is searched for
                wrong.append(f"{what} raises {type(error).__name__}: {error}")
                continue
            partly = f"{name}.{parameter}" in PARTLY_RIGHT
            if parameter and not partly and not fits(value, known[parameter], parameters[parameter]):
                wrong.append(f"{what} is accepted")
    assert wrong == [], "\n".join(wrong)
    assert refused > 8000


def test_messages_name_the_argument_and_what_is_right(tmp_path: Path) -> None:
    run, V = vibench.open_run(write_sample_run(tmp_path)), vibench.InnerProduct(sp.eye_array(5))
    one, no_number, K = Stop(size=1), np.full((5, 1), np.nan), vibench.DualSet.intervals(np.array([3]), 1.0)
    for call, words in (
        (lambda: run.write_figures(formats="x"), "formats of Run.write_figures is 'x', expected a sequence of 'png'"),
        (lambda: run.figure("convergence", "membran"), "no problem is called 'membran'; did you mean 'membrane'"),
        (lambda: Stop(toleranc=0.1), "no argument of Stop is called 'toleranc'; did you mean 'tolerance'"),
        (lambda: vibench.Reduction.given(None, snapshot=None), "no step of a Reduction is called 'snapshot'; did you"),
        (lambda: vibench.ParameterBox(("a",), np.ones(1), np.zeros(1), ("1",)), "[1.0] are above the upper ones [0.0]"),
        (vibench.no_free, "no_free: missing a required argument: 'count'"),
        (lambda: vibench.run("x"), "study of run is 'x', expected a Study"),
        (lambda: run.table(None), "name of Run.table is None, expected a text"),
        (lambda: run.write_tables("/dev/null/x"), "'/dev/null/x' cannot be written: Not a directory"),
        (lambda: vibench.create("problems", "hertz"), "no kind of plugins is called 'problems'"),
        (lambda: vibench.pod(np.ones((4, 2)), V, one), "V of pod has n = 5, but that of snapshots is 4"),
        (lambda: vibench.pod(np.ones(5), V, one), "snapshots of pod has the shape (5,), expected an array of"),
        (lambda: vibench.project_on_cone(no_number, np.ones(5), V),
            "generators of project_on_cone has an entry that is not finite"),
        (lambda: vibench.pod(np.ones((5, 2)), V, 1), "stop of pod is 1, expected a Stop"),
        (lambda: vibench.create("problem", "pack", {"path": 10**5000}), "is an int; expected str"),
        (lambda: vibench.export_model(evaluations=0, model=V, file=V), "is 0, expected a whole number of at least 1"),
        (lambda: V.norm(np.ones(4)), "an array of the shape (4,) is not of a space of dimension 5"),
        (lambda: Stop(tolerance="x"), "tolerance of Stop is 'x', expected a number of at least 0"),
        (lambda: K.project(np.ones(3)), "3 rows are too few for a dual set with blocks in 4"),
        (lambda: K.blocks[0].support(np.ones(3)), "has the index 3, expected at least 0 and below m = 3"),
        (lambda: vibench.DualSet.intervals(-np.ones(1, int), 1.0), "of Blocks has the index -1, expected at least 0"),
        (lambda: reduction.LazyDistances(np.eye(5)).widen(np.eye(5)),
            "generators without the last of LazyDistances.widen has r = 4, but that of generators in the object is 0"),
        (lambda: vibench.linalg.project_out(np.eye(5, 2), np.ones(4)), "has n = 4, but that of space is 5"),
        (lambda: vibench.linalg.project_out(np.eye(5, 2), np.ones((5, 1, 1))), "of the shape (n,) or (n, k)"),
        (lambda: reduction.supremizer_coordinates(V, np.eye(5), [sp.eye_array(3, 5), sp.eye_array(3, 4)], np.eye(3)),
            "matrices[1] of supremizer_coordinates has n = 4, but that of V is 5"),
        (lambda: vibench.InnerProduct("x"), "the Gram matrix is 'x', expected a matrix of real numbers"),
    ):  # fmt: skip
        with pytest.raises(RequestError, match=re.escape(words)):
            call()
