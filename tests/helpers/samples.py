"""Test data of the tests that do no numerics: study files, rows of the results, third-party packages."""

import copy
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import fake_plugins
import pandas as pd

import vibench
from vibench import Stop
from vibench.plugins.plugin import Plugin
from vibench.results.schema import STORED
from vibench.stages.artefacts import Artefact, Store
from vibench.stages.base import Stage
from vibench.stages.cell_queries import CellQueries
from vibench.stages.enrichment import EnrichmentStage, SingleEnrichment
from vibench.stages.formulation import FormulationStage
from vibench.stages.offline import ConeStage, PODStage
from vibench.study.parameter_sets import ParameterSet

STUDY: Mapping[str, Any] = {
    "name": "sample", "seed": 7, "validation": 3, "accuracy": 1e-7, "solvers": ["piqp", "osqp"],
    "dual": ["cpg", "mcpg"], "primal": ["decorrelated", "offline-pga"],
    "problem": [{"name": "obstacle", "options": {"resolution": "coarse"}}],
    "tolerances": [{"pod": [1e-2, 1e-3], "dual": [1e-1], "primal": {"offline-pga": [0.5, 0.3, 0.1]}}],
}  # fmt: skip

RECORDED: Mapping[str, Any] = {"name": "sample", "seed": 1, "validation": 4, "accuracy": 1e-7}

SOLVERS_OF_TESTS = ("cvxopt", "osqp", "piqp", "proxqp")
"""Those of the dependencies and of the extra `test`. Others that are installed may be too inexact for a test."""

ROUNDS = 3

QUICK_ROUNDS = 6
"""Those of the run of `quick` that tests share: with fewer there is no interval of a median."""

REMOVE = object()


def changed(content: Mapping[str, Any], *path: str | int, to: Any) -> dict[str, Any]:
    """A copy of a study's content with one value replaced, added or (`REMOVE`) taken away."""
    result = copy.deepcopy(dict(content))
    place: Any = result
    for step in path[:-1]:
        place = place[step]
    if to is REMOVE:
        del place[path[-1]]
    elif isinstance(place, list) and path[-1] == len(place):
        place.append(to)
    else:
        place[path[-1]] = to
    return result


def toml(content: Mapping[str, Any]) -> str:
    return "".join(f"{_quoted(key)} = {_value(value)}\n" for key, value in content.items())


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_quoted(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, int | float) else value.isoformat()


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def write_study(folder: Path, content: Mapping[str, Any] = STUDY, name: str = "study.toml") -> str:
    path = folder / name
    path.write_text(toml(content), encoding="utf-8")
    return str(path)


def filled(table: str) -> dict[str, Any]:
    samples = {"TEXT": "text", "REAL": 0.5, "INTEGER": 3, "BLOB": b""}
    return {name: samples[column.kind.split()[0]] for name, column in STORED[table].items()}


def cell_row(cell: str = "c1", **columns: Any) -> dict[str, Any]:
    row = filled("cells") | {"cell": cell, "status": "ok", "enrichment_kind": "fixed", "versions": "{}"}
    return row | {"formulation": "mixed", "bounds": 0} | columns


def row_of(cell: str, error: float | None, online: float | None, **more: Any) -> dict[str, Any]:
    """What `cells_of` needs of a cell: its error of λ and its seconds of a query."""
    return {"cell": cell, "error_lambda_mean": error, "online_s": online, **more}


def cells_of(*rows: dict[str, Any]) -> pd.DataFrame:
    """Cells that differ in what is given alone, and are stable, exact in u and ok otherwise."""
    common = {
        "problem": "box", "problem_options": "{}", "status": "ok", "error_u_mean": 1e-9, "solver_share_mean": 1e-6,
        "assembly_share_mean": None, "beta_span_min": 0.1, "offline_s": 1.0,
    }  # fmt: skip
    return pd.DataFrame([cell_row(**common | row) for row in rows], columns=list(STORED["cells"]))


def query_rows(cell: str = "c1", count: int = 2, **columns: Any) -> list[dict[str, Any]]:
    """Rows of the queries table in which every column is filled, for a problem with two parameters."""
    varying = ({"cell": cell, "query": k, "mu_1": 0.1 * k, "mu_2": 2.0 + k, "status": "ok"} for k in range(count))
    return [filled("queries") | mine | columns for mine in varying]


FAKES: Mapping[str, Mapping[str, str]] = {
    "vibench.problems": {"wire": "Wire", "wire-raises": "Raises", "wire-broken": "Broken", "wire-sleeps": "Sleeps"},
    "vibench.dual_strategies": {"cone-needs": "NeedyCone", "cone-raises": "RaisingCone", "cone-waits": "WaitingCone"},
    "vibench.primal_strategies": {"enrichment-counts": "CountingEnrichment"},
    "vibench.qp_solvers": {"counts": "numpy_count"} | {name.replace("_", "-"): name for name in (
        "careful", "raises", "gives_up", "wrong", "dies", "leaves", "hangs", "segfaults", "dies_sometimes", "dies_once",
        "chatty",
    )},
}  # fmt: skip
"""What the third-party package registers: group → name → member of `fake_plugins`."""


def install_fakes(folder: Path) -> Path:
    """Lay the third-party package out in a folder as an installer would; returns the folder."""
    return install(folder, fake_plugins, FAKES)


def install(folder: Path, module: ModuleType, members: Mapping[str, Mapping[str, str]]) -> Path:
    """Lay a package of one module out in a new folder; `members` is what it registers, as `FAKES`."""
    folder.mkdir(parents=True)
    shutil.copy(str(module.__file__), folder)
    name = module.__name__
    information = folder / f"{name}-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 1.0\n")
    lines: list[str] = []
    for group, registered in members.items():
        lines += [f"[{group}]", *(f"{plugin} = {name}:{member}" for plugin, member in registered.items())]
    (information / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


def wire_study(**axes: Any) -> dict[str, Any]:
    content = {
        "name": "wire", "seed": 3, "validation": 3, "solvers": ["piqp"], "dual": ["cpg"], "primal": ["decorrelated"],
        "problem": ["wire"], "tolerances": [{"pod": [1e-3], "dual": [1e-2]}], "timing_rounds": ROUNDS,
    }  # fmt: skip
    return content | axes


class SampleStore(Store):
    """A store that has the values of all stages: those that are not stored are kept in memory."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.kept: dict[str, Artefact] = {}

    def get(self, key: str) -> Artefact | None:
        return self.kept.get(key) or super().get(key)


def carry_out(stage: Stage, store: SampleStore) -> None:
    """Run a stage after all it needs, as the runner does."""
    for needed in stage.inputs():
        if store.get(needed.key) is None:
            carry_out(needed, store)
    result = stage.run(store)
    if stage.stored:
        store.put(stage.key, result.value, result.seconds, result.histories)
    else:
        store.kept[stage.key] = Artefact(result.value, result.seconds, result.histories, "here")


def store_of(folder: Path, stages: Iterable[Stage]) -> SampleStore:
    """A store with the values of some stages and of all that they need."""
    store = SampleStore(folder)
    for stage in stages:
        if store.get(stage.key) is None:
            carry_out(stage, store)
    return store


def small_study(name: str, problem: Sequence[Mapping[str, Any]], **axes: Any) -> vibench.Study:
    """A study of few modes and generators, solved to 1e-10 and timed once."""
    given = {
        "dual": ["mcpg"], "primal": ["decorrelated"], "assembly": ["reduced"], "solvers": ["piqp"], "accuracy": 1e-10,
        "tolerances": [{"pod": [1e-2], "dual": [1e-1]}], "validation": 1, "timing_rounds": 1,
    }  # fmt: skip
    return vibench.Study(name=name, problem=problem, **given | axes)


SMALL = small_study(
    "small",
    [{"name": "radial-obstacle", "options": {"resolution": 200}}, {"name": "obstacle", "options": {"resolution": 150}}],
    primal=["decorrelated", "online-supremizers", "offline-pga"], assembly=["full", "reduced"], bounds=[False, True],
    tolerances=[{"pod": [1e-2], "dual": [1e-1], "primal": {"offline-pga": [0.5]}}], validation=3,
)  # fmt: skip


def with_ways(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows whose assembly is "certified" where they have bounds: one name for each way of a query."""
    return rows.assign(assembly=rows["assembly"].mask(rows["bounds"] == 1, "certified"))


def program_queries(
    enrichment: EnrichmentStage, interpolation: float | None, validation: ParameterSet, solver: str, accuracy: float,
    warm_start: bool = False, bounds: bool = False,
) -> CellQueries:  # fmt: skip
    pod, cone = enrichment.pod, enrichment.cone
    mixed = Plugin("formulation", "mixed", "{}", "test")
    built = FormulationStage(pod.problem, mixed, pod.training, pod, cone, enrichment, interpolation)
    return CellQueries(built, validation, solver, accuracy, 20.0, warm_start, bounds)


def mixed_cell(
    problem: Plugin, pod: Stop, dual: str, cone: Stop, primal: str, validation: ParameterSet, *,
    tolerance: float | None = None, interpolation: float | None = None, solver: str = "piqp", accuracy: float = 1e-8,
    bounds: bool = False,
) -> CellQueries:  # fmt: skip
    """The queries of a cell of the mixed formulation, with strategies by their names."""
    reduced = ConeStage(problem, Plugin("dual strategy", dual, "{}", "test"), cone)
    strategy = Plugin("primal strategy", primal, "{}", "test")
    enrichment = SingleEnrichment(PODStage(problem, pod), reduced, strategy, tolerance)
    return program_queries(enrichment, interpolation, validation, solver, accuracy, bounds=bounds)


def pga_reduction(
    problem: vibench.Problem, generators: float | vibench.Stop, modes: float | vibench.Stop = 1e-4, *,
    primal: str = "offline-pga", tolerance: float | None = 0.5, **more: Any,
) -> vibench.Reduction:  # fmt: skip
    """A reduction with modes and cones by mCPG up to tolerances, and offline PGA or another primal strategy."""
    strategies = vibench.create("dual strategy", "mcpg"), vibench.create("primal strategy", primal)
    stops = (each if isinstance(each, vibench.Stop) else vibench.Stop(each) for each in (modes, generators))
    return vibench.Reduction(problem, *strategies, *stops, tolerance=tolerance, **more)
