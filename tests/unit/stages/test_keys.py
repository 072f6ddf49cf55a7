"""Keys of stages change with all code that determines their numbers, and with no other code."""

from __future__ import annotations

import inspect
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Set
from itertools import chain
from pathlib import Path
from types import CodeType, FrameType

import pytest
from samples import SampleStore, small_study

from vibench import dependencies
from vibench.dependencies import CARRIERS, CELL, COUNTED, code_used, modules_used
from vibench.offline.assemblies import assemblies
from vibench.plugins import registry
from vibench.plugins.kinds import DUAL, PRIMAL, PROBLEM, SAMPLING
from vibench.plugins.plugin import Plugin
from vibench.rounds import timing_rounds
from vibench.rounds.offline_repeats import OfflineRepeat
from vibench.rounds.timing_rounds import TimingRounds
from vibench.stages.base import Result, Stage, build_problem
from vibench.stages.cell_queries import cell_queries
from vibench.stages.formulations.building import FormulationStage
from vibench.stages.formulations.queries import FormulationQueries
from vibench.stages.pictures import PictureStage
from vibench.stages.snapshots import fingerprint_here
from vibench.storage.artefacts import Artefact, Store
from vibench.study.matrix import expand
from vibench.study.spec import Study

COMPILED = ["compiled"] if shutil.which("cc") else []

RANDOM = {"name": "random", "size": 60, "seed": 1}
GREEDY = {"name": "greedy", "candidates": 30, "tolerance": 0.5, "checked": 10}
TOLERANCES = {
    "pod": [1e-2], "dual": [1e-1],
    "primal": {"offline-pga": [0.5, 0.3], "infsup-greedy": [0.5], "pod-supremizers": [0.1]},
}  # fmt: skip

TRAINED = small_study(
    "trained", [{"name": "obstacle", "options": {"resolution": 160}}], training=[RANDOM], validation=2,
    dual=["mcpg"], tolerances=[TOLERANCES], assembly=["full", "certified"],
    primal=["decorrelated", "online-supremizers", "offline-pga", "infsup-greedy", "pod-supremizers"],
)  # fmt: skip
ADAPTIVE = small_study(
    "adaptive", [{"name": "radial-obstacle", "options": {"resolution": "coarse"}}], training=[GREEDY], validation=2,
    dual=["orthant", "enlarged-cpg"], primal=["online-supremizers"], assembly=["full", "certified", *COMPILED],
)  # fmt: skip
"""Studies that need every sort of stage between them, and most of what plugins can do."""


def goals(study: Study) -> list[Stage]:
    """The last stages of a study."""
    cells = expand(study)
    ends = [cell_queries(cell, 20.0) for cell in cells]
    timing = TimingRounds(tuple(ends[:2]), ((0, 1),) * 2, 1)
    return [*ends, PictureStage(cells[0].problem, cells[0].training), timing]


def stages_of(study: Study) -> list[Stage]:
    """All stages of a study, each after those it needs."""
    found: dict[Stage, None] = {}

    def add(stage: Stage) -> None:
        if stage not in found:
            for needed in stage.inputs():
                add(needed)
            found[stage] = None

    for goal in goals(study):
        add(goal)
    return list(found)


def module_of(code: CodeType) -> str:
    path = Path(code.co_filename)
    inside = path.is_relative_to(dependencies.CORE) and code.co_name != "<module>"
    return ".".join(("vibench", *path.relative_to(dependencies.CORE).with_suffix("").parts)) if inside else ""


def is_for_a_key(frame: FrameType | None) -> bool:
    """Whether a call serves to look up the key of an input, which counts by itself."""
    while frame is not None and frame.f_code is not Stage.key.func.__code__:
        frame = frame.f_back
    return frame is not None


def traced(stage: Stage, store: Store) -> tuple[Result, set[str]]:
    """The result of a stage whose inputs are stored, and the modules of vibench whose functions ran for it."""
    codes: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code not in codes and not is_for_a_key(frame):
            codes.add(frame.f_code)

    sys.setprofile(note)
    try:
        result = stage.run(store)
    finally:
        sys.setprofile(None)
    return result, {module_of(code) for code in codes} - {""}


def is_carrier(module: str) -> bool:
    return module != COUNTED and any(f"{module}.".startswith(f"{one}.") for one in CARRIERS)


def modules_behind(stage: Stage) -> Set[str]:
    """The modules whose code is in the key of a stage, by its own code or by that of its plugins."""
    roots = stage.code() or CELL
    plugins = {plugin.registered.reference for plugin in stage.plugins}
    used = (modules_used(reference, whole=True) for reference in plugins)
    return modules_used(*roots, whole=roots is CELL).union(*used)


@pytest.mark.parametrize("study", [TRAINED, ADAPTIVE], ids=lambda study: study.name)
def test_what_runs_in_a_stage_is_what_its_code_is_read_from(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every stage is run with a note of the functions that are called; little is taken from what others have cached."""
    monkeypatch.setattr(timing_rounds, "SHARE", 1)
    store, missing = SampleStore(tmp_path), dict[str, set[str]]()
    for stage in stages_of(study):
        for cache in (build_problem, fingerprint_here, assemblies):
            cache.cache_clear()  # type: ignore[attr-defined]
        result, ran = traced(stage, store)
        store.kept[stage.key] = Artefact(result.value, result.seconds, result.histories, "here")
        unseen = {module for module in ran - modules_behind(stage) if not is_carrier(module)}
        if unseen:
            missing.setdefault(type(stage).__name__, set()).update(unseen)
        assert ran, stage
    assert missing == {}


def concrete(kind: type) -> Iterator[type[Stage]]:
    for one in kind.__subclasses__():
        if one.__module__.startswith(("vibench.stages", "vibench.rounds")) and not inspect.isabstract(one):
            yield one
        yield from concrete(one)


def test_the_key_of_a_formulation_has_the_code_that_makes_its_model() -> None:
    """The plugin's own code, and what that uses, is in its version."""
    used = modules_used(*FormulationStage.code())
    assert {
        f"vibench.{name}" for name in ("offline.formulated", "offline.reduction", "stages.formulations.building")
    } <= used


@pytest.mark.skipif(not COMPILED, reason="NO C COMPILER (cc): programs are not compiled")
def test_every_sort_of_stage_is_among_them() -> None:
    """But repeats, which run the code of the stages in their keys, and formulations, which are plugins."""
    kinds = set(concrete(Stage)) - {OfflineRepeat, FormulationStage, FormulationQueries}
    assert {type(stage) for stage in [*stages_of(TRAINED), *stages_of(ADAPTIVE)]} == kinds


NUMERICAL = (
    "linalg", "interfaces", "qp", "reduction", "stability", "highfidelity", "model", "offline", "stages", "rounds",
    "fem", "arrays", "timing", "packs", "study.parameter_sets",
    "results.solver_agreement", "results.pictures",  # what is kept of a solution and of a picture
)  # fmt: skip


def test_no_code_counts_that_only_requests_records_or_shows() -> None:
    used = set(modules_used(*CELL, whole=True))
    used |= set(chain.from_iterable(modules_used(*kind.code()) for kind in concrete(Stage)))
    for kind in (PROBLEM, DUAL, PRIMAL, SAMPLING):
        for plugin in registry.registered(kind).values():
            used |= modules_used(plugin.reference, whole=True)
    packages = {f"vibench.{name}" for name in NUMERICAL}
    strangers = [module for module in used if not any(f"{module}.".startswith(f"{one}.") for one in packages)]
    assert strangers == []
    assert not [module for module in used if is_carrier(module)]
    assert {module.split(".")[1] for module in used} >= {name.split(".")[0] for name in NUMERICAL}


SOLUTIONS, MATRICES = "high-fidelity solutions", "constraint matrices"
CONSTANTS, REFERENCE = "high-fidelity constants", "high-fidelity inf-sup constants"
SHOWN = (
    "report.html", "results.schema", "results.break_even", "study.spec", "plugins.registry", "errors", "text",
    "storage.artefacts", "storage.serialisation", "stages.base", "provenance", "execution.run", "cli.main",
    "library.runs",
)  # fmt: skip
EDITS: Mapping[str, tuple[set[str], set[str]]] = {
    "highfidelity.active_set": ({SOLUTIONS, "POD", "cone", "assembly"}, {MATRICES, "affine decomposition"}),
    "reduction.pod": ({"POD", "enrichment", "assembly"}, {SOLUTIONS, "cone", "training constants", "pictures"}),
    "reduction.cones": ({"cone", "enrichment", "assembly"}, {SOLUTIONS, "POD"}),
    "stability.infsup": ({"cone", "enrichment", REFERENCE}, {SOLUTIONS, "POD", MATRICES, CONSTANTS}),
    "stability.conic_infsup": ({REFERENCE}, {SOLUTIONS, "POD", "cone", "enrichment", "assembly", CONSTANTS}),
    "stability.coercivity": ({CONSTANTS}, {MATRICES, REFERENCE}),
    "model.hyperreduced": ({"hyper-reduction", "assembly"}, {SOLUTIONS, "POD", "cone", "enrichment"}),
    "qp.exact": ({"exact reduced solutions", SOLUTIONS, "POD", "cone", "enrichment"}, set()),
    "study.parameter_sets": ({SOLUTIONS, "affine decomposition", "assembly"}, set()),
    **dict.fromkeys(SHOWN, (set(), {SOLUTIONS, "POD", "cone", "enrichment", "assembly", "queries", "pictures"})),
}
"""Modules, the labels of stages whose keys change with an edit of them, and of some whose keys do not."""


@pytest.fixture
def edit(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Function after which a module of vibench seems to have another line."""
    source = dependencies._source

    def change(module: str) -> None:
        assert source(module), f"there is no module {module}"
        monkeypatch.setattr(dependencies, "_source", lambda m: source(m) + b"# edited" * (m == module))
        code_used.cache_clear()
        registry.registered.cache_clear()

    yield change
    monkeypatch.undo()
    code_used.cache_clear()
    registry.registered.cache_clear()


def keys() -> dict[str, set[str]]:
    """The keys of the stages with every label."""
    found: dict[str, set[str]] = {}
    for stage in stages_of(TRAINED):
        found.setdefault(stage.label, set()).add(stage.key)
    return found


@pytest.mark.parametrize("module", EDITS)
def test_an_edit_changes_the_keys_of_what_it_determines_and_no_other(module: str, edit: Callable[[str], None]) -> None:
    before, codes = keys(), {cell.code for cell in expand(TRAINED)}
    edit(f"vibench.{module}")
    after, (changed, kept) = keys(), EDITS[module]
    assert {label for label in changed if before[label] & after[label]} == set()
    assert {label for label in kept if before[label] != after[label]} == set()
    assert codes.isdisjoint(cell.code for cell in expand(TRAINED)) == bool(changed)


def test_what_a_plugin_uses_of_the_core_is_in_its_code(edit: Callable[[str], None]) -> None:
    plugins = {name: Plugin(DUAL, name, "{}", "").as_installed() for name in ("mcpg", "pod-dual")}
    edit("vibench.reduction.cone_parts")
    assert plugins["mcpg"].as_installed() != plugins["mcpg"]
    assert plugins["pod-dual"].as_installed() == plugins["pod-dual"]
