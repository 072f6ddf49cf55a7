import datetime
import importlib.metadata
import sys
import types
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import fake_plugins
import pytest
from annotated_types import Ge, Gt, Le, Lt, MinLen
from running import Register, refusal
from samples import FAKES, install

from vibench import DualStrategy, read_study
from vibench.plugins import registry
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import find, registered
from vibench.study.spec import Entry

HERE = __name__


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


class Idle(DualStrategy):
    def reduce(self, snapshots: Any, W: Any, stop: Any) -> Any:
        raise NotImplementedError


class Choosy(Idle):
    """A strategy with an option of every sort.

    More about it.
    """

    def __init__(
        self,
        weight: Annotated[float, Gt(0.0), Lt(1.0)],
        count: Annotated[int, Ge(1), Le(9)] = 3,
        mode: Literal["slow", "fast"] = "slow",
        grid: Literal["coarse", "fine"] | Annotated[int, Ge(2)] = "coarse",
        exact: bool = False,
        names: Annotated[list[str], MinLen(1)] = ["a"],  # noqa: B006  read only
        point: tuple[float, float] = (0.0, 0.0),
        colour: Colour = Colour.RED,
        anything: Any = None,
    ) -> None:
        self.given = {
            "weight": weight, "count": count, "mode": mode, "grid": grid, "exact": exact, "names": names,
            "point": point, "colour": colour, "anything": anything,
        }  # fmt: skip


class Plain(Idle):
    pass


class Heir(Choosy):
    pass


@dataclass
class Record(Idle):
    width: Annotated[float, Gt(0.0)] = 1.0


class Open(Idle):
    def __init__(self, width: float = 1.0, **others: float) -> None:
        self.given = {"width": width, **others}


def no_strategy() -> None:
    """A function where a class is asked for."""


GROUP = PluginKind.DUAL.entry_points


@pytest.fixture
def _own(register: Register) -> None:
    members = ("Choosy", "Plain", "Heir", "Record", "Open")
    register(*((GROUP, member.lower(), f"{HERE}:{member}") for member in members))


@pytest.mark.parametrize("kind", [PluginKind.PROBLEM, PluginKind.DUAL, PluginKind.PRIMAL])
def test_built_in_plugins_are_found_with_a_summary_and_options_with_defaults(kind: PluginKind) -> None:
    entries = importlib.metadata.distribution("vibench").entry_points.select(group=kind.entry_points)
    assert entries
    for entry in entries:
        assert entry.name in registered(kind)
        assert issubclass(find(kind, entry.name).load(), kind.base)
        assert find(kind, entry.name).origin == f"vibench {importlib.metadata.version('vibench')}"
    for name, plugin in registered(kind).items():
        assert (plugin.load().__doc__ or "").strip()
        assert all(option.expected for option in plugin.options.values())
        required = [option.name for option in plugin.options.values() if option.required]
        assert required == (["path"] if name == "pack" else [])
        assert plugin.check_options(dict.fromkeys(required, "text")) == dict.fromkeys(required, Path("text"))


def test_registered_studies_and_solvers_are_used(register: Register, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "quick" in registered(PluginKind.STUDY)
    for name in (name for name, study in registered(PluginKind.STUDY).items() if not study.package):
        assert Path(find(PluginKind.STUDY, name).load()).is_file()
        assert read_study(name).name == name
    monkeypatch.setitem(sys.modules, "lost_study", types.SimpleNamespace(path=Path("/nowhere/lost.toml")))
    register(("vibench.studies", "lost", "lost_study:path"))
    assert "/nowhere/lost.toml" in refusal(read_study, "lost")
    solvers = (("mine", f"{HERE}:no_strategy"), ("broken", "no_such_module:solve"))
    register(*built_in(), *(("vibench.qp_solvers", name, value) for name, value in solvers))
    assert read_study("quick").solver_names()
    assert read_study("quick", {"solvers": ["mine"]}).solver_names() == ["mine"]
    assert registry.qp_solver("mine") == {"mine": no_strategy}
    assert registry.qp_solver("piqp") == {}


def test_a_name_of_two_packages_or_of_a_solver_of_qpsolvers_is_refused(register: Register) -> None:
    """Installed or not: results of another machine may be named after the real one."""
    register(
        *((GROUP, "plain", f"{HERE}:{one}") for one in ("Plain", "Choosy")),
        *((GROUP, "heir", f"{HERE}:Heir") for _ in range(2)),  # one entry point that is found twice is no conflict
    )
    line = refusal(find(PluginKind.DUAL, "plain").load)
    assert line.startswith("two packages provide the dual strategy 'plain'")
    assert f"{HERE}:Plain" in line
    assert f"{HERE}:Choosy" in line
    assert find(PluginKind.DUAL, "plain").conflict == line
    assert find(PluginKind.DUAL, "heir").load() is Heir
    assert list(registered(PluginKind.DUAL)) == ["heir", "plain"]
    assert "two packages" in refusal(lambda: find(PluginKind.DUAL, "plain").missing)
    plugin = Entry(name="plain", options={"mode": "slow"}).plugin(PluginKind.DUAL)
    assert plugin.options == '{"mode": "slow"}'
    assert "two packages" in refusal(plugin.create)
    register(*(("vibench.qp_solvers", name, f"{HERE}:no_strategy") for name in ("piqp", "ecos", "mine")))
    for name in ("piqp", "ecos"):
        line = refusal(registry.qp_solver, name)
        assert line.startswith(f"two packages provide the QP solver '{name}'")
        assert f"qpsolvers, unknown ({HERE}:no_strategy)" in line
    assert registry.qp_solver("mine") == {"mine": no_strategy}
    assert find(PluginKind.SOLVER, "osqp").conflict == ""


def test_names_are_sorted_each_distribution_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    for folder in ("one", "other"):
        monkeypatch.syspath_prepend(str(install(tmp_path / folder, fake_plugins, FAKES)))
    assert find(PluginKind.SOLVER, "careful").conflict == ""
    assert find(PluginKind.SOLVER, "careful").origin == "fake-plugins 1.0"
    register(*((GROUP, name, f"{HERE}:Plain") for name in ("plain", "other")))
    assert list(registered(PluginKind.DUAL)) == ["other", "plain"]
    assert registered(PluginKind.PROBLEM) == {}
    assert "known: none" in refusal(find(PluginKind.PROBLEM, "plain").load)
    line = refusal(find(PluginKind.DUAL, "plian").load)
    assert "no dual strategy is called 'plian'; did you mean 'plain'? (known: other, plain)" in line
    assert "did you mean" not in refusal(find(PluginKind.DUAL, "xyzzy").load)
    assert find(PluginKind.DUAL, "plain").origin == "unknown"  # it is in no distribution


UNLOADABLE = [
    (PluginKind.DUAL, "no_such_module:Plain", "no_such_module"),
    (PluginKind.DUAL, f"{HERE}:NoSuchClass", "NoSuchClass"),
    (PluginKind.DUAL, f"{HERE}:no_strategy", "not a subclass of DualStrategy"),
    (PluginKind.DUAL, f"{HERE}:HERE", "not a subclass of DualStrategy"),
    (PluginKind.DUAL, "vibench.interfaces.strategies:PrimalStrategy", "not a subclass of DualStrategy"),
    (PluginKind.SOLVER, f"{HERE}:HERE", "is not callable"),
    (PluginKind.STUDY, f"{HERE}:no_strategy", "is not the path of a study file"),
]


def test_a_broken_entry_point_is_named(register: Register, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    failing = {"raises": "raise OSError('no licence')", "divides": "1 / 0", "syntax": "def f(:"}
    for name, code in failing.items():
        (tmp_path / f"plugin_that_{name}.py").write_text(f"{code}\n")
    cases = [*UNLOADABLE, *((PluginKind.DUAL, f"plugin_that_{name}:Plain", "cannot be loaded") for name in failing)]
    register(*((kind.entry_points, f"broken-{number}", value) for number, (kind, value, _) in enumerate(cases)))
    for number, (kind, value, words) in enumerate(cases):
        line = refusal(find(kind, f"broken-{number}").load)
        assert [word for word in (f"'broken-{number}'", value, words) if word not in line] == [], line


def built_in() -> list[tuple[str, str, str]]:
    return [
        (entry.group, entry.name, entry.value)
        for entry in importlib.metadata.distribution("vibench").entry_points
        if entry.group.startswith("vibench.")
    ]


ACCEPTED = [
    {}, {"count": 9}, {"mode": "fast"}, {"grid": "fine"}, {"grid": 7}, {"exact": True}, {"names": ["x", "y"]},
    {"anything": {"deep": [1]}},
]  # fmt: skip


@pytest.mark.usefixtures("_own")
def test_options_that_fit_reach_the_constructor_and_others_are_refused_with_what_is_expected() -> None:
    """TOML knows neither tuples nor enumerations; a float may be written as an integer."""
    for options in ({"weight": 0.5} | more for more in ACCEPTED):
        made = find(PluginKind.DUAL, "choosy").create(options)
        assert {name: made.given[name] for name in options} == options
    made = Plugin(PluginKind.DUAL, "choosy", '{"weight": 0.5, "point": [1.0, 2.0], "colour": "blue"}', "").create()
    assert (made.given["point"], made.given["colour"]) == ((1.0, 2.0), Colour.BLUE)
    assert isinstance(find(PluginKind.DUAL, "record").check_options({"width": 2})["width"], float)
    for options, words in REFUSED:
        line = refusal(find(PluginKind.DUAL, "choosy").check_options, options)
        assert [word for word in ("'choosy'", *words) if word not in line] == [], line
    listed = {name: str(option).partition(": ")[2] for name, option in find(PluginKind.DUAL, "choosy").options.items()}
    assert listed | {
        "weight": "float > 0 and < 1", "count": "int ≥ 1 and ≤ 9 = 3", "mode": "'slow', 'fast' = 'slow'",
        "grid": "'coarse', 'fine' or int ≥ 2 = 'coarse'", "exact": "bool = False", "anything": "any value = None",
    } == listed  # fmt: skip


REFUSED = [
    ({"weight": 0.0}, ("'weight'", "0.0", "float > 0 and < 1")), ({"weight": 1.5}, ("'weight'", "1.5", "< 1")),
    ({"weight": "half"}, ("'weight'", "'half'", "float")), ({"weight": True}, ("'weight'", "True", "float")),
    ({"weight": float("nan")}, ("'weight'", "nan", "float")),
    ({"weight": 0.5, "count": 10}, ("'count'", "10", "int ≥ 1 and ≤ 9")),
    ({"weight": 0.5, "count": 2.0}, ("'count'", "2.0", "int")),
    ({"weight": 0.5, "mode": "quick"}, ("'mode'", "'quick'", "'slow', 'fast'")),
    ({"weight": 0.5, "grid": 1}, ("'grid'", "1", "'coarse', 'fine' or int ≥ 2")),
    ({"weight": 0.5, "exact": 1}, ("'exact'", "1", "bool")), ({"weight": 0.5, "names": []}, ("'names'", "list")),
    ({"weight": 0.5, "names": [1]}, ("'names'", "list")),
    ({"weight": 0.5, "exact": datetime.date(2022, 1, 1)}, ("'exact'", "bool")),
    ({"weight": 0.5, "wieght": 0.5}, ("'wieght'", "did you mean 'weight'")),
    ({}, ("'weight'", "needs", "float > 0 and < 1")), ({"weight": 0.5, "point": [1.0]}, ("'point'",)),
    ({"weight": 0.5, "point": [1.0, "x"]}, ("'point'",)), ({"weight": 0.5, "colour": "green"}, ("'colour'",)),
]  # fmt: skip


@pytest.mark.usefixtures("_own")
def test_constructors_may_be_missing_inherited_generated_or_open() -> None:
    assert find(PluginKind.DUAL, "plain").options == {}
    assert isinstance(find(PluginKind.DUAL, "plain").create({}), Plain)
    assert "known: none" in refusal(find(PluginKind.DUAL, "plain").check_options, {"x": 1})
    assert find(PluginKind.DUAL, "heir").options == find(PluginKind.DUAL, "choosy").options
    assert find(PluginKind.DUAL, "heir").create({"weight": 0.5}).given["weight"] == 0.5
    assert find(PluginKind.DUAL, "record").create({"width": 2.0}) == Record(2.0)
    assert "float > 0" in refusal(find(PluginKind.DUAL, "record").check_options, {"width": -1.0})
    assert find(PluginKind.DUAL, "open").create({"width": 2.0}).given == {"width": 2.0}


def test_code_follows_sources(register: Register, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "edited_plugin"
    package.mkdir()
    (package / "__init__.py").write_text("from vibench import DualStrategy\nclass Plain(DualStrategy): ...\n")
    (package / "helper.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    register((GROUP, "edited", "edited_plugin:Plain"), (GROUP, "plain", f"{HERE}:Plain"))
    codes = [find(PluginKind.DUAL, "edited").code, find(PluginKind.DUAL, "plain").code]
    (package / "helper.py").write_text("x = 2\n")
    registry.registered.cache_clear()
    assert find(PluginKind.DUAL, "edited").code != codes[0]
    assert find(PluginKind.DUAL, "plain").code == codes[1]
