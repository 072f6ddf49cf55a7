"""Keys of stages change with all code that determines their numbers, and with no other code."""

import inspect
import shutil
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FrameType

import pytest
from samples import SampleStore, small_study

from vibench import Study, provenance
from vibench.calibration import Metropolis
from vibench.offline.assemblies import assemblies
from vibench.plugins import registry
from vibench.stages import timing_rounds
from vibench.stages.artefacts import Artefact, Store
from vibench.stages.base import ItemwiseStage, Result, Stage, build_problem
from vibench.stages.calibration import CalibrationStage
from vibench.stages.cell_queries import cell_queries
from vibench.stages.pictures import PictureStage
from vibench.stages.snapshots import fingerprint_here
from vibench.stages.timing_rounds import OfflineRepeat, TimingRounds
from vibench.study.matrix import expand

CORE = Path(provenance.__file__).parent

COMPILED = ["compiled"] if shutil.which("cc") else []

RANDOM = {"name": "random", "size": 60, "seed": 1}
GREEDY = {"name": "greedy", "candidates": 12, "tolerance": 0.5, "checked": 3}
TOLERANCES = {
    "pod": [1e-2], "dual": [1e-1],
    "primal": {"offline-pga": [0.5, 0.3], "infsup-greedy": [0.5], "pod-supremizers": [0.1]},
}  # fmt: skip

TRAINED = small_study(
    "trained", [{"name": "obstacle", "options": {"resolution": 150}}], training=[RANDOM], validation=2,
    dual=["mcpg"], tolerances=[TOLERANCES], assembly=["reduced"], bounds=[True],
    primal=["decorrelated", "online-supremizers", "offline-pga", "infsup-greedy", "pod-supremizers"],
)  # fmt: skip
ADAPTIVE = small_study(
    "adaptive", [{"name": "radial-obstacle", "options": {"resolution": "coarse"}}], training=[GREEDY], validation=2,
    dual=["orthant", "enlarged-cpg"], primal=["online-supremizers"], assembly=["full", "reduced"], bounds=[True],
    formulation=["mixed", *COMPILED],
)  # fmt: skip
"""Studies that need every sort of stage between them, and most of what plugins can do."""


def goals(study: Study) -> list[Stage]:
    """The last stages of a study."""
    cells = expand(study)
    ends = [cell_queries(cell, 20.0) for cell in cells]
    timing = TimingRounds(tuple(ends[:2]), ((0, 1),) * 2, 1, 0)
    # Chains take seconds: one study is enough.
    bounded = [end for end in ends if end.bounds] if study is ADAPTIVE else []
    chains = [CalibrationStage(end, "cell") for end in bounded[:1]]
    return [*ends, *chains, PictureStage(cells[0].problem, cells[0].training), timing]


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
    inside = path.is_relative_to(CORE) and code.co_name != "<module>"
    return ".".join(("vibench", *path.relative_to(CORE).with_suffix("").parts)) if inside else ""


def is_for_a_key(frame: FrameType | None) -> bool:
    """Whether a call serves to look up the key of an input, which counts by itself."""
    while frame is not None and frame.f_code is not Stage.key.func.__wrapped__.__code__:
        frame = frame.f_back
    return frame is not None


def traced(stage: Stage, store: Store) -> tuple[Result, set[str]]:
    """The result of a stage whose inputs are stored, and the modules of vibench whose functions ran for it."""
    codes: set[CodeType] = set()

    def note(frame: FrameType, _: str, __: object) -> None:
        # As it returns nothing it is told of calls alone, neither of lines nor of returns.
        if frame.f_code not in codes and not is_for_a_key(frame):
            codes.add(frame.f_code)

    before = sys.gettrace()
    sys.settrace(note)
    try:
        result = stage.run(store)
    finally:
        sys.settrace(before)
    return result, {module_of(code) for code in codes} - {""}


CARRIERS = (
    "stages.artefacts", "stages.base", "plugins", "study", "errors", "text", "provenance",
    "files", "signatures",
)  # fmt: skip
"""Packages and modules that only hand over what determines numbers."""


def counts_for(stage: Stage, module: str) -> bool:
    """Whether the code of a module is in the key of a stage, or of one of its inputs."""
    imported = vars(sys.modules[type(stage).__module__]).values()
    own = {f"{one.__module__}." for one in imported if getattr(one, "__module__", None)}
    layers = provenance.LAYERS[provenance.LAYERS.index("stages") + (not isinstance(stage, ItemwiseStage)) :]
    inside = f"{module}.".startswith((*own, *(f"vibench.{layer}." for layer in layers)))
    return inside or any(counts_for(one, module) for one in stage.inputs())


@pytest.mark.long
@pytest.mark.parametrize("study", [TRAINED, ADAPTIVE], ids=lambda study: study.name)
def test_what_a_stage_runs_is_in_its_code(study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every stage is run with a note of the functions that are called; little is taken from what others have cached."""
    monkeypatch.setattr(timing_rounds, "QUERY_SUBSETS", 1)
    # A chain of twenty steps, at each level of noise, runs the code that one of 400 does.
    monkeypatch.setattr(Metropolis, "steps", property(lambda chain: 20 * len(chain.accepted)))
    store, missing = SampleStore(tmp_path), dict[str, set[str]]()
    for stage in stages_of(study):
        for cache in (build_problem, fingerprint_here, assemblies):
            cache.cache_clear()  # type: ignore[attr-defined]
        result, ran = traced(stage, store)
        store.kept[stage.key] = Artefact(result.value, result.seconds, result.histories, "here")
        carriers = tuple(f"vibench.{name}." for name in CARRIERS)
        unseen = {module for module in ran if not f"{module}.".startswith(carriers) and not counts_for(stage, module)}
        if unseen:
            missing.setdefault(type(stage).__name__, set()).update(unseen)
        assert ran, stage
    assert missing == {}


def concrete(kind: type) -> Iterator[type[Stage]]:
    for one in kind.__subclasses__():
        if one.__module__.startswith("vibench.stages") and not inspect.isabstract(one):
            yield one
        yield from concrete(one)


@pytest.mark.skipif(not COMPILED, reason="NO C COMPILER (cc): programs are not compiled")
def test_every_sort_of_stage_is_among_them() -> None:
    """But repeats, which run the code of the stages in their keys."""
    kinds = set(concrete(Stage)) - {OfflineRepeat}
    assert {type(stage) for stage in [*stages_of(TRAINED), *stages_of(ADAPTIVE)]} == kinds


def test_the_layers_are_those_of_the_import_contract_in_its_order() -> None:
    """A new package of the core is either a layer that determines numbers or among those that only carry them."""
    contracts = tomllib.loads((CORE.parent / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    order = [name for row in contracts[0]["layers"] for name in row.split(" | ")]
    layers = [layer for layer in provenance.LAYERS if "." not in layer]
    assert layers == sorted(layers, key=order.index)
    assert set(order) - set(layers) == {
        "cli", "benchmarks", "testing", "library", "report", "execution", "results", "study", "plugins",
        "provenance", "files", "interrupts", "signatures", "errors", "text", "guardian", "process",
    }  # fmt: skip
    assert [layer for layer in provenance.LAYERS if not [*CORE.glob(f"{layer.replace('.', '/')}*")]] == []


@pytest.fixture
def edit(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Function after which a module of vibench seems to have another line."""
    caches = (provenance.numerical_code, Stage.code.__func__, Stage.key.func)  # type: ignore[attr-defined]

    def forget() -> None:
        for cached in caches:
            cached.cache_clear()
        registry.registered.cache_clear()

    def change(module: str) -> None:
        edited = CORE / f"{module.replace('.', '/')}.py"
        assert edited.is_file()
        read = Path.read_bytes
        monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + b"# edited" * (path == edited))
        forget()

    yield change
    monkeypatch.undo()
    forget()


def keys() -> dict[str, set[str]]:
    """The keys of the stages with every label."""
    found: dict[str, set[str]] = {}
    for stage in stages_of(TRAINED):
        found.setdefault(stage.label, set()).add(stage.key)
    return found


def test_an_edit_changes_the_keys_of_what_it_may_determine_and_no_other(edit: Callable[[str], None]) -> None:
    """A stage does not depend on the modules of other stages, unless these are its inputs."""
    before, codes = keys(), {cell.code for cell in expand(TRAINED)}
    for module in ("report.html", "results.schema", "study.spec", "plugins.registry", "errors", "text", "cli.main"):
        edit(module)
        assert (keys(), {cell.code for cell in expand(TRAINED)}) == (before, codes), module
    edit("stages.base")
    assert keys() == before
    edit("stages.query")  # determines the queries, and nothing before them
    after = keys()
    assert {label for label in before if before[label].isdisjoint(after[label])} == {"queries", "timing"}
    assert {label for label in before if before[label] == after[label]} == {*before} - {"queries", "timing"}
    before = after
    edit("stages.enrichment")
    after = keys()
    assert {label for label in before if before[label].isdisjoint(after[label])} >= {"enrichment", "assembly"}
    assert {label for label in before if before[label] == after[label]} >= {"high-fidelity solutions", "POD", "cone"}
    for module in ("highfidelity.active_set", "study.parameter_sets", "results.consistency", "timing"):
        edit(module)
        assert all(before[label].isdisjoint(after) for label, after in keys().items()), module
        assert codes.isdisjoint(cell.code for cell in expand(TRAINED))
