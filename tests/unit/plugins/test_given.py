"""Classes and objects on the axes of a study: what identifies them, what is refused, and how they reach workers."""

import importlib
import json
import linecache
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from textwrap import dedent
from typing import Any
from unittest.mock import Mock

import pytest
from fake_plugins import Wire
from running import refusal

import vibench
from vibench import RequestError
from vibench.execution.isolated import recall_reads, watch_first_use
from vibench.execution.supervisor import Supervisor
from vibench.plugins import plugin as module
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin, fingerprint_of, give
from vibench.stages.artefacts import Store
from vibench.study.cells import Cell
from vibench.study.matrix import expand, study_of_cell

SOURCE = """
    from functools import cache, cached_property
    import numpy as np

    LENGTH = 2.0
    NAMES = {"left", "right", "bottom", "top"}

    @cache
    def half(x):
        return x / 2.0

    def width():
        return half(LENGTH)

    class Base:
        def scaled(self, x):
            return 3.0 * x

    class Shape(Base):
        sides = 4

        def __init__(self, size=5):
            self.size, self.tags, self.values = size, {"a", "b", "c"}, np.arange(size)

        @cached_property
        def area(self):
            return sum(self.values) * width()

        @property
        def edges(self):
            return [side for side in sorted(NAMES) if side in {"left", "top"}]

        def circumference(self):
            return (lambda: self.scaled(self.sides * width()))()
"""


def notebook(source: str = SOURCE, cell: str = "<cell 1>") -> dict[str, Any]:
    """The names that a cell of a notebook defines, run as IPython runs it."""
    text = dedent(source)
    linecache.cache[cell] = (len(text), None, text.splitlines(keepends=True), cell)
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(text, cell, "exec", dont_inherit=True), names)
    return names


def hashed(source: str = SOURCE, what: str = "Shape()") -> str:
    return fingerprint_of(eval(what, notebook(source)))


EDITS = {
    "body of a method": ("self.sides * width()", "self.sides + width()"),
    "constant in a method": ('{"left", "top"}', '{"left", "bottom"}'), "inherited method": ("3.0 * x", "3.5 * x"),
    "global constant": ("LENGTH = 2.0", "LENGTH = 2.5"), "global set": ('"bottom", "top"}\n', '"bottom"}\n'),
    "function that a function calls": ("x / 2.0", "x / 4.0"), "attribute of the class": ("sides = 4", "sides = 5"),
    "default of an argument": ("size=5", "size=6"),
    "attribute of the object": ("np.arange(size)", "np.arange(size) + 1"),
    "computed when asked for": ("sum(self.values)", "max(self.values)"),
}  # fmt: skip


def test_fingerprints_change_with_exactly_the_edits_that_may_change_a_number() -> None:
    for what, (before, after) in EDITS.items():
        assert before in SOURCE
        assert hashed(SOURCE.replace(before, after)) != hashed(), what
    for what, (before, after) in {
        "comment": ("    LENGTH", "\n    # the length\n    LENGTH"),
        "line break": ("x / 2.0", "(x /\n                2.0)"),
        "a name that it does not use": ("    class Shape", "    OTHER = LENGTH\n\n    class Shape"),
    }.items():
        assert hashed(SOURCE.replace(before, after)) == hashed(), what
    names = notebook()
    used = names["Shape"]()
    assert used.area == 10.0
    assert fingerprint_of(used) == fingerprint_of(names["Shape"]())
    assert len({fingerprint_of(one) for one in (used, names["Shape"], names["Shape"](6))}) == 3


def test_processes_with_other_hash_seeds_agree(tmp_path: Path) -> None:
    """A script, `__main__`, and here a cell of a notebook in another file: one class, one fingerprint."""
    script = tmp_path / "script.py"
    last = "from vibench.plugins.plugin import fingerprint_of\nprint(fingerprint_of(Shape()))\n"
    script.write_text(f"{dedent(SOURCE)}\n{last}")
    seeds = ({"PYTHONHASHSEED": seed} for seed in ("1", "2"))
    run = [sys.executable, str(script)]
    printed = [subprocess.check_output(run, env=os.environ | seed, text=True).strip() for seed in seeds]
    assert printed == [hashed()] * 2


def test_an_imported_module_counts_with_its_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_shapes.py").write_text(dedent(SOURCE))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_shapes", raising=False)
    source = "import my_shapes\nclass Mine:\n    def f(self):\n        return my_shapes.width()\n"
    before = hashed(source, "Mine"), hashed(source, "my_shapes.Shape")
    (tmp_path / "my_shapes.py").write_text(dedent(SOURCE) + "# edited\n")
    after = hashed(source, "Mine"), hashed(source, "my_shapes.Shape")
    assert set(before).isdisjoint(after)


@pytest.fixture(scope="module")
def names() -> dict[str, Any]:
    source = """
        import threading
        from fake_plugins import Wire

        lock = threading.Lock()

        class Mine(Wire):
            def __init__(self, nodes: int = 12, thing=None):
                super().__init__(nodes)
                self.thing = thing

        class Locked(Mine):
            def assemble(self, mu):
                with lock:
                    return super().assemble(mu)
    """
    return notebook(source)


def study(**axes: Any) -> vibench.Study:
    usual: dict[str, Any] = {
        "name": "given", "validation": 3, "solvers": ["piqp"], "problem": [Wire], "dual": ["cpg"],
        "primal": ["decorrelated"], "tolerances": [{"pod": [1e-2], "dual": [1e-2]}], "timing_rounds": 1,
    }  # fmt: skip
    return vibench.Study(**usual | axes)


REFUSED: Mapping[str, tuple[str, ...]] = {
    "{'problem': [Mine(thing=threading.Lock())]}": (
        "problem 'Mine' cannot be sent to worker processes", "cannot pickle '_thread.lock' object", "keep such objects",
    ),
    "{'problem': [Locked]}": ("problem 'Locked' cannot be sent to worker processes", "'_thread.lock'"),
    "{'problem': [threading.Thread]}": ("expected a name, or a class or an object of vibench.Problem", "class Thread"),
    "{'dual': [Mine]}": ("dual strategy: expected", "vibench.DualStrategy, found the class Mine"),
    "{'dual': [Mine()]}": ("dual strategy: expected", "vibench.DualStrategy, found a Mine"),
    "{'training': [Mine]}": ("sampling strategy: expected", "vibench.Sampling"),
    "{'validation': Mine}": ("sampling strategy: expected", "vibench.Sampling"),
    "{'problem': [lambda: Mine()]}": ("vibench.Problem, found a function",),
    "{'problem': [Mine(12), Mine(13)]}": ("several plugins", "problem 'Mine'", "label"),
    "{'problem': [Mine, {'name': Wire, 'label': 'Mine'}]}": ("several plugins", "problem 'Mine'", "label"),
    "{'problem': [{'name': Mine, 'label': 'obstacle'}, 'obstacle']}": ("several plugins", "problem 'obstacle'"),
    "{'problem': [{'name': Mine(), 'options': {'nodes': 9}}]}": ("problem 'Mine' is an object", "give its class"),
    "{'problem': [{'name': Mine, 'options': {'nods': 9}}]}": ("problem 'Mine'", "did you mean 'nodes'"),
    "{'problem': [{'name': Mine, 'options': {'nodes': 'x'}}]}": ("option 'nodes' of problem 'Mine'", "int"),
    "{'problem': [3]}": ("problem.0", "expected a name"),
}  # fmt: skip


def test_what_cannot_be_run_or_imported_is_refused(names: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    for axes, words in REFUSED.items():
        line = refusal(study, **eval(axes, names | {"Wire": Wire}))
        assert [word for word in words if word not in line] == [], line
    lost = give(PluginKind.PROBLEM, "wire", Wire)
    monkeypatch.setitem(sys.modules, "fake_plugins", None)
    monkeypatch.delitem(lost.__dict__, "given")
    with pytest.raises(RequestError, match="problem 'wire' cannot be received by a worker process: ModuleNotFound"):
        lost.create({})


def test_a_problem_is_that_of_the_study_s_time_and_its_class_keeps_its_global_names(names: dict[str, Any]) -> None:
    """Cloudpickle would give it copies of them where it is loaded in the process that defines it."""
    mine = names["Mine"]()
    asked = study(problem=[mine])
    mine.depth = 7.0
    (cell,) = expand(asked)
    assert cell.problem.create().depth == 0.2
    assert cell.problem.create() is not cell.problem.create()
    (other,) = expand(study(problem=[mine]))
    assert (other.key, other.problem.name) == (cell.key, "Mine")
    assert other.code != cell.code
    before = names["Mine"].__init__
    (cell,) = expand(study(problem=[names["Mine"]()]))
    assert type(cell.problem.create()) is names["Mine"]
    assert names["Mine"].__init__ is before


def test_labels_and_options_tell_objects_and_classes_apart(names: dict[str, Any]) -> None:
    Mine = names["Mine"]
    labelled = [{"name": Mine(nodes), "label": f"{nodes} nodes"} for nodes in (6, 8)]
    cells = expand(study(problem=[Mine, {"name": Mine, "options": {"nodes": 9}}, *labelled, Mine]))
    assert [(cell.labels[0], cell.problem.options) for cell in cells] == [
        ("Mine", "{}"), ("Mine", '{"nodes": 9}'), ("6 nodes", "{}"), ("8 nodes", "{}"),
    ]  # fmt: skip
    assert len({cell.key for cell in cells}) == 4
    assert Plugin(PluginKind.DUAL, "x", '{"how": "y"}', "").check == "vibench check dual:x --option=how=y"
    assert [cell.problem.create().V.dim for cell in cells] == [12, 9, 6, 8]


def test_a_definition_holds_no_object_and_a_pickle_does(names: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """It is found again by what made it, and refused in a line where that is not: another process, edited code."""
    (cell,) = expand(study(problem=[names["Mine"](9)]))
    content = json.loads(cell.definition)
    assert content["problem"] == asdict(cell.problem)
    assert set(content["problem"]) == {"kind", "name", "options", "code", "places"}
    again = Cell.from_definition(cell.definition)
    assert (again.key, again.code) == (cell.key, cell.code)
    (remade,) = expand(study_of_cell(again, "given"))
    assert (remade.key, remade.problem.create().V.dim) == (cell.key, 9)
    sent = pickle.dumps(cell.problem)
    monkeypatch.setattr(module, "_given", {})
    with pytest.raises(RequestError, match=r"problem 'Mine' is a class or an object that .* another process"):
        Cell.from_definition(cell.definition)
    received = pickle.loads(sent)
    assert received == cell.problem
    assert pickle.loads(pickle.dumps(received)) == received  # a worker of dask sends it on
    assert received.registered.package == "__main__"


WHOLE = """
    import builtins, importlib, os
    from pathlib import Path
    import fake_plugins
    import numpy as np

    class Reading(fake_plugins.Wire):
        def __init__(self):
            super().__init__(9)
            self.name = os.getenv("READS_GET", "") + os.environ["READS_ITEM"] * ("READS_ASKED" in os.environ)
            self.table, self.text = np.loadtxt("table.txt"), Path("text.json").read_text()
            eval(compile("import reads_evaluated", "<cell>", "exec"))
            Path("written.txt").write_text(str(os.getpid()))
            self.pid = Path("written.txt").read_text()

        def assemble(self, mu):
            import reads_statement
            from reads_package import inner
            globals()["importlib"].import_module("reads_by_name")
            getattr(builtins, "exec")(open("script.py").read(), {})
            try:
                return open("later.txt")
            except FileNotFoundError:
                return super().assemble(mu)
"""
FILES = [
    "reads_whole.py", "table.txt", "text.json", "reads_evaluated.py", "reads_statement.py", "reads_package/inner.py",
    "reads_package/__init__.py", "reads_by_name.py", "reads_second.py", "script.py", "later.txt",
]  # fmt: skip
LATE = """
    import numpy, vibench
    class Dual(vibench.DualStrategy):
        def reduce(self, *_): import late_dual
    class Primal(vibench.PrimalStrategy):
        def build(self, *_): import late_primal
    class Sampling(vibench.Sampling):
        def parameters(self, *_): import late_sampling
    class Model(vibench.FormulationModel):
        dimension = 1
        def solve(self, *_): import late_solve; return vibench.FormulationAnswer(numpy.ones(1))
        def reconstruct(self, *_): import late_reconstruct
    class Formulation(vibench.Formulation):
        uses = ()
        def build(self, *_): import late_build; return {}
        def model(self, *_): import late_model; return Model()
"""


def test_what_is_read_in_the_first_use_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows stayed when what a method imports was edited, or what it opens, or a variable that it asks for."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names, store, told = [f"READS_{one}" for one in ("GET", "ITEM", "ASKED")], Store(tmp_path / "store"), list[str]()
    for name in FILES[:-1]:
        content = {"reads_by_name.py": "import reads_second", "reads_whole.py": dedent(WHOLE)}.get(name, "1")
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
    for name in names:
        monkeypatch.setenv(name, "1")
    plugin = Plugin.of(give(PluginKind.PROBLEM, "reading", importlib.import_module("reads_whole").Reading), {})
    with closing(Supervisor()) as supervisor:
        watch = partial(watch_first_use, note=told.append, supervisor=supervisor, seconds=60.0)
        assert recall_reads([plugin], store, watch)
        again = watch(plugin, ["table.txt", "text.json"])
    assert told.pop().startswith("the problem 'reading' reads table.txt and 1 more, changed since: what it")
    (read,), before = plugin.registered.reads.values(), plugin.as_installed()
    own = {str(tmp_path / name) for name in FILES} | {f"${name}" for name in names}
    for one in (read, again):
        assert own == {name for name in one if not name.startswith(str(Path(__file__).parents[2]))}
    for name in FILES:
        content = (tmp_path / name).read_text() if name != "later.txt" else None
        (tmp_path / name).write_text(f"{content}# edited")
        assert plugin.as_installed() != before, name
        (tmp_path / name).unlink() if content is None else (tmp_path / name).write_text(content)
        assert plugin.as_installed() == pickle.loads(pickle.dumps(plugin)).as_installed() == before
    monkeypatch.setenv(names[0], "2")
    assert plugin.as_installed() != before
    read.clear()
    assert recall_reads([plugin], store, lambda _, changed: told.extend(changed) or again)
    assert (told, plugin.as_installed() != before) == ([f"${names[0]}"], True)


def test_what_strategies_and_formulations_import_late_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "late_whole.py").write_text(dedent(LATE))
    files, read = [tmp_path / f"{name}.py" for name in re.findall(r"late_\w+", LATE)], set[str]()
    for file in files:
        file.touch()
    with closing(Supervisor()) as supervisor:
        for kind, name in (("DUAL", "Dual"), ("PRIMAL", "Primal"), ("SAMPLING", "Sampling"), ("FORMULATION",) * 2):
            given = getattr(importlib.import_module("late_whole"), name.title())
            plugin = Plugin.of(give(PluginKind[kind], name, given), {})
            read |= {*(watch_first_use(plugin, [], note=print, supervisor=supervisor, seconds=60.0) or ())}
    assert {*map(str, files)} <= read


def test_a_run_recalls_what_its_own_plugins_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before it plans, with a process that watches those never used before."""
    asked = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("vibench.execution.run.recall_reads", lambda plugins, *more: asked([*plugins], *more))
    with pytest.raises(KeyboardInterrupt):
        vibench.run(study(), tmp_path / "run", jobs=1, progress=False)
    (plugins, _, watch) = asked.call_args.args
    assert ([one.name for one in plugins], watch.func) == (["Wire"], watch_first_use)
