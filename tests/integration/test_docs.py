import contextlib
import copy
import importlib
import importlib.util
import inspect
import io
import json
import pkgutil
import re
import sys
import tomllib
import unicodedata
import urllib.parse
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
from running import Main, Register, Vibench, rows, succeeded
from samples import toml

import vibench
from vibench import RequestError, read_study
from vibench.cli.main import app
from vibench.execution import run as execution
from vibench.execution.timing_plan import OfflinePlan, TimingPlan
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import registered
from vibench.results import formats, schema
from vibench.study.spec import Entry, Limits, ProblemEntry, SamplingEntry, Study, ToleranceTable
from vibench.testing import check

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
RESULTS = [ROOT / "README.md", *sorted((ROOT / "results").rglob("*.md"))]
PAGES = sorted(DOCS.rglob("*.md"))
EXTEND = [DOCS / "problem.md", DOCS / "method.md"]

BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path) -> list[tuple[str, str, str]]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reference", DOCS / "reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of the pages, as an installer would lay it out, with its study beside it."""
    folder = tmp_path_factory.mktemp("documented")
    (folder / "vibench_mine").mkdir()
    (folder / "vibench_mine" / "__init__.py").touch()
    parts: dict[str, str] = {}
    for page in EXTEND:
        for _, title, text in blocks(page):
            if title:
                parts[title] = parts.get(title, "") + text
    for title, text in parts.items():
        place = folder / "vibench_mine" if title.endswith(".py") else folder
        (place / title).write_text(text, encoding="utf-8")
    project = tomllib.loads(parts["pyproject.toml"])["project"]
    information = folder / "vibench_mine-0.1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 0.1.0\n")
    lines: list[str] = []
    for group, entries in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    (information / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def importable(package: Path, register: Register, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(package))
    yield
    for name in [name for name in sys.modules if name.split(".")[0] == "vibench_mine"]:
        del sys.modules[name]


@pytest.mark.usefixtures("importable")
@pytest.mark.parametrize(("code", "size"), [("dolfinx", {"cells": 8}), ("ngsolve", {"size": 0.15})])
def test_the_membrane_of_another_code_is_a_problem(code: str, size: dict[str, Any]) -> None:
    pytest.importorskip(code, reason=f"{code} is not installed: its example is not run")
    check(partial(importlib.import_module(f"vibench_mine.membrane_{code}").Membrane, **size))


@pytest.mark.usefixtures("importable")
def test_kratos_gives_its_matrices() -> None:
    pytest.importorskip("KratosMultiphysics.ConvectionDiffusionApplication", reason="Kratos is not installed")
    import KratosMultiphysics as Kratos  # noqa: PLC0415  where it is installed

    model, settings = Kratos.Model(), Kratos.ConvectionDiffusionSettings()
    part = model.CreateModelPart("membrane")
    settings.SetUnknownVariable(Kratos.TEMPERATURE)
    settings.SetDiffusionVariable(Kratos.CONDUCTIVITY)
    settings.SetVolumeSourceVariable(Kratos.HEAT_FLUX)
    part.ProcessInfo.SetValue(Kratos.CONVECTION_DIFFUSION_SETTINGS, settings)
    for variable in (Kratos.TEMPERATURE, Kratos.CONDUCTIVITY, Kratos.HEAT_FLUX):
        part.AddNodalSolutionStepVariable(variable)
    for number, place in enumerate([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], start=1):
        node = part.CreateNewNode(number, *place, 0.0)
        node.SetSolutionStepValue(Kratos.CONDUCTIVITY, 1.0)
        node.SetSolutionStepValue(Kratos.HEAT_FLUX, 6.0)
        node.AddDof(Kratos.TEMPERATURE)
    for number, corners in enumerate([[1, 2, 3], [1, 3, 4]], start=1):
        part.CreateNewElement("LaplacianElement2D3N", number, corners, part.CreateNewProperties(number))
    A, f = importlib.import_module("vibench_mine.kratos_matrices").assembled(part)
    turned = np.roll(np.eye(4), 1, axis=0)
    assert np.allclose(A.toarray(), np.eye(4) - 0.5 * turned - 0.5 * turned.T)
    assert np.allclose(f, [2.0, 1.0, 2.0, 1.0])


@pytest.mark.long
def test_the_plugins_of_the_pages_run_through_a_benchmark(package: Path, vibench: Vibench, tmp_path: Path) -> None:
    study = tomllib.loads((package / "mine.toml").read_text())
    registered = tomllib.loads((package / "pyproject.toml").read_text())["project"]["entry-points"]
    assert {*registered, PluginKind.STUDY.entry_points} == {kind.entry_points for kind in PluginKind}
    for axis, group in (("dual", "vibench.dual_strategies"), ("primal", "vibench.primal_strategies")):
        assert set(study[axis]) == set(registered[group])
    (tmp_path / "mine.toml").write_text(toml(study | {"timing_rounds": 1}), encoding="utf-8")
    done = vibench(tmp_path, "run", "mine.toml", "--jobs", "1", plugins=package)
    assert done.returncode == 0, done.stderr
    assert "no check of constants, bounds and solvers failed" in done.stdout
    cells = rows(tmp_path / "runs" / "mine")
    assert {(cell["status"], cell["reason"]) for cell in cells} == {("ok", "")}
    penalised = [cell for cell in cells if cell["formulation"] == "penalised"]
    assert {cell["problem"] for cell in penalised} == {"cable", "declared-cable", "separable-cable"}
    axes = ("dual", "primal", "solver", "assembly")
    assert {tuple(cell[axis] for axis in axes) for cell in penalised} == {("–", "–", "–", "full")}
    cells = [cell for cell in cells if cell["formulation"] == "mixed"]
    assert len(cells) == 3 * 2 * 4 * 2
    kinds = dict.fromkeys(("centre", "pivoted"), "fixed")
    kinds |= dict.fromkeys(("at-every-query", "unconstrained"), "per-parameter")
    assert {cell["primal"]: cell["enrichment_kind"] for cell in cells} == kinds
    for cell in cells:
        can_be_reduced = cell["problem"] != "cable" and cell["primal"] != "unconstrained"
        assert (cell["fallbacks"] == "") is can_be_reduced, cell
        assert cell["beta_span_min"] > 0.0
    assert sum(row["flagged"] for row in rows(tmp_path / "runs" / "mine", "disagreements")) == 0


def test_columns_fields_and_tables_of_the_reference_are_complete(reference: ModuleType) -> None:
    everything = [column for of_table in schema.STORED.values() for column in of_table.values()]
    for column in [*everything, schema.column_of("queries", "mu_1")]:
        assert column.unit in reference.UNITS
        assert column.meaning.strip().endswith((".", "…"))
    assert {column.unit for name, column in schema.STORED["queries"].items() if name.endswith("_s")} == {"s"}
    axes = ("formulation", "formulation_a", "formulation_b")
    several = {"accuracy": [1e-7, 1e-10], "training": ["own", "another"], "meaning": "undecided", "correction": "auto"}
    several |= {"certificate": "certified", **{name: ["mixed", "another"] for name in axes}}
    zero = {"queries_zero_u": [0, 1], "queries_zero_lambda": [0, 1]}
    for table, name, view, more in (
        ("cells", "summary", formats.summary, zero), ("thresholds", "benefits", formats.break_even_table, {}),
    ):  # fmt: skip
        frame = pd.DataFrame(several | more)  # with one value for all, or none, they have no columns
        empty = frame.reindex(columns=list(schema.STORED[table])).astype({"accuracy": float})
        headings = re.findall(r"^\| (?!column|---)([^|]+?) \|", reference.GENERATED[name](), re.MULTILINE)
        assert list(view(empty).columns) == headings
        assert len(headings) == len(set(headings)) > 10
    page = reference.study_fields()
    for model in (Study, ToleranceTable, Entry, ProblemEntry, SamplingEntry, Limits):
        for name, field in model.model_fields.items():
            assert field.description, name
            line = rf"^\| `{name}` \| .+ \| .* \| {re.escape(field.description)} \|$"
            assert re.search(line, page, re.MULTILINE), name
    for table, stored in schema.STORED.items():
        shared, _, own = reference.GENERATED[table]().rpartition("\n\n")
        names = re.findall(r"`([^`]+)`", shared) + re.findall(r"^\| `([^`]+)` ", own, re.MULTILINE)
        assert sorted(names) == sorted([*stored, *(["mu_1, mu_2, …"] if table == "queries" else [])])
        assert all(stored[name] == schema.STORED["cells"][name] for name in re.findall(r"`([^`]+)`", shared))
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert set(re.findall(r"<!-- generated: ([\w-]+) -->", text)) == set(reference.GENERATED)
    assert len(reference.PLACE.findall(text)) == text.count("<!-- generated: ")
    study = (DOCS / "study.md").read_text(encoding="utf-8")
    assert reference.filled(study.replace("| `seed` |", "| `seeds` |")) == reference.filled(study)


def test_the_api_reference_has_every_public_name_and_described_parameters_exist() -> None:
    listed = re.findall(r"^::: vibench\.([\w.]+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    grouped = [f"{group}.{name}" for group in vibench.GROUPS for name in getattr(vibench, group).__all__]
    assert sorted(listed) == sorted([*(set(vibench.__all__) - set(vibench.GROUPS)), *grouped])
    # Those of numpydoc sections are in the signature.
    modules = [getattr(vibench, group) for group in vibench.GROUPS]
    described = 0
    for name, public in [(name, getattr(one, name)) for one in (vibench, *modules) for name in one.__all__]:
        section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w+\n-+$|\Z)", inspect.getdoc(public) or "", re.M | re.S)
        if section and (inspect.isfunction(public) or inspect.isclass(public)):
            heads = re.findall(r"^(\S.*)$", section[1], re.MULTILINE)
            names = {one.strip() for head in heads for one in head.split(",")}
            assert names <= set(inspect.signature(public).parameters), name
            described += 1
    assert described > 10


LINKED = re.compile(r"\]\(([^)#\s]+\.md)")


def test_the_site_leads_to_every_page() -> None:
    """Every page that the menu does not have is linked from one that it leads to."""
    listed = set(re.findall(r"^ +- [^:\n]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M))
    pages = {page.resolve() for page in [*PAGES, *RESULTS[1:]]}
    reached, new = set[Path](), {(DOCS / page).resolve() if (DOCS / page).exists() else ROOT / page for page in listed}
    while new:
        reached |= new
        links = [(page.parent / link).resolve() for page in new for link in LINKED.findall(page.read_text("utf-8"))]
        new = (set(links) & pages) - reached
    assert pages - reached == set()


STUDY_PAGE = blocks(DOCS / "study.md")
EXAMPLE = next(text for _, title, text in STUDY_PAGE if title == "my-study.toml")
RULES = [(one[2], refused[2]) for one, refused in pairwise(STUDY_PAGE) if (one[0], refused[0]) == ("toml", "text")]


def test_the_example_of_the_reference_is_a_study_and_its_rules_are_rules(tmp_path: Path) -> None:
    path = tmp_path / "my-study.toml"
    path.write_text(EXAMPLE, encoding="utf-8")
    read_study(str(path))
    assert set(tomllib.loads(EXAMPLE)) == set(Study.model_fields)
    assert len(RULES) >= 5
    for change, refused in RULES:
        content: dict[str, Any] = copy.deepcopy(tomllib.loads(EXAMPLE)) | tomllib.loads(change)
        path.write_text(toml(content), encoding="utf-8")
        with pytest.raises(RequestError) as caught:
            read_study(str(path))
        assert str(caught.value) == f"{path}: {refused.strip()}"


@pytest.mark.usefixtures("few_rounds", "importable")
@pytest.mark.parametrize(
    ("page", "texts", "written"),
    [
        ("problem.md", 3, {"runs"}),
        ("method.md", 0, set()),
        pytest.param("report.md", 5, {"runs", "tables", "decision.html", "answer.svg"}, marks=pytest.mark.long),
        ("measurement.md", 0, set()),
        pytest.param("tolerances.md", 2, {"runs"}, marks=pytest.mark.long),
        ("calibration.md", 3, set()),
        ("methods.md", 36, {"points.npy"}),
    ],
)
def test_a_page_is_true(
    page: str, texts: int, written: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its examples build on each other; what one prints is in the block that follows it."""
    monkeypatch.chdir(tmp_path)
    parts, names = blocks(DOCS / page), {"__name__": "documentation"}
    compared = 0
    for (language, title, code), (following, _, text) in pairwise([*parts, ("", "", "")]):
        if language != "python" or title:  # a title is the name of a file of the package
            continue
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(code, "<documentation>", "exec"), names)
        if following == "text":
            assert printed.getvalue().endswith(text), code
            compared += 1
    assert compared == texts
    assert {file.name for file in tmp_path.iterdir()} == written


METHODS = DOCS / "methods.md"
ENTRY = re.compile(r'^<a id="([a-z]+)-(\d{4})"></a>(.+)$', re.MULTILINE)
BIBLIOGRAPHY = ENTRY.findall(METHODS.read_text(encoding="utf-8"))
CITED = re.compile(r"\b([A-Z][a-z][\w'’]+)(?:, [A-Z][\w'’]+)* and [A-Z][\w'’]+ \(?((?:19|20)\d\d)\b")


def test_strategies_have_formulas_and_whatever_is_cited_is_in_the_bibliography() -> None:
    sections = re.split(r"^##+ (.+)$", METHODS.read_text(encoding="utf-8"), flags=re.MULTILINE)
    described = {name: text for title, text in pairwise(sections[1:]) for name in title.split(", ")}
    kinds = PluginKind.DUAL, PluginKind.FORMULATION, PluginKind.PRIMAL, PluginKind.SAMPLING
    names = [name for kind in kinds for name, plugin in registered(kind).items() if not plugin.package]
    assert len(names) > 16
    for name in names:
        text = described[name]
        assert f'"{name}"' in text or "reduction.enrichment" in text, name
        assert "$$" in text, name
        assert "```python" in text, name
        # a product of points, a list and a file need no source
        assert re.search(r"\]\(#[a-z]+-\d{4}\)", text) or name in {"grid", "random", "list", "file", "pod-dual"}, name
    known = {(name, year) for name, year, _ in BIBLIOGRAPHY}
    sources = [*PAGES, ROOT / "README.md"]
    for folder in ("vibench", "strategies", "problems"):
        sources += sorted((ROOT / folder).rglob("*.py"))
    cited = {
        (unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower().rstrip("'"), year)
        for source in sources
        for name, year in CITED.findall(" ".join(source.read_text(encoding="utf-8").split()))
    }
    assert len(cited) > 15
    assert cited - known == set()
    assert len(BIBLIOGRAPHY) > 30
    assert sorted(BIBLIOGRAPHY, key=lambda entry: entry[:2]) == BIBLIOGRAPHY
    for name, year, text in BIBLIOGRAPHY:
        assert f"({year})" in text
        link = re.search(r"\[doi:(10\.\d{4,5}/[^\]]+)\]\(https://doi\.org/([^)]+)\)|\[arXiv:", text)
        assert link or name == "conover", text
        assert link is None or not link[1] or urllib.parse.unquote(link[2]) == link[1]


@pytest.fixture
def few_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs are timed in one round, and nothing offline twice: for tests that look at no seconds."""

    def plan(goals: Any, rounds: int, writer: Any, fewest: int, share: float) -> TimingPlan:
        return TimingPlan(goals, min(rounds, 1), writer, min(fewest, 1), share)

    monkeypatch.setattr(execution, "TimingPlan", plan)
    monkeypatch.setattr(OfflinePlan, "repeats", lambda self, cells: [])


@pytest.mark.usefixtures("few_rounds")
def test_the_problem_and_the_strategy_of_the_readme_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are short, and what they print has the rows that the page shows."""
    monkeypatch.chdir(tmp_path)
    codes = [code for language, _, code in blocks(ROOT / "README.md") if language == "python"]
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        for code in codes:
            exec(compile(code, "<README>", "exec"), names)
    (shown,) = (text for language, _, text in blocks(ROOT / "README.md") if language == "text")
    there, here = ([line.split()[:3] for line in text.splitlines()] for text in (shown, printed.getvalue()))
    assert here[-len(there) :] == there
    assert set(names["run"].cells["status"]) == {"ok"}
    assert all(len([line for line in code.splitlines() if line]) <= 20 for code in codes)


@pytest.mark.long
@pytest.mark.usefixtures("few_rounds")
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((ROOT / "examples" / "decision.ipynb").read_text(encoding="utf-8"))
    codes = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    for code in codes:
        exec(compile(code, "<notebook>", "exec"), names)
    assert names["solution"].status == "ok"
    assert names["chosen"]["primal"] in set(names["run"].cells["primal"])


MODULE = re.compile(r"\b(?:problems/|strategies/)?vibench(?:_problems|_strategies)?/[\w/]+\.py\b")
NAME = re.compile(r"`vibench\.(\w+(?:\.\w+)*)`")


def test_every_module_name_and_script_on_a_page_exists() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in [*PAGES, *RESULTS])
    assert [path for path in MODULE.findall(text) if not (ROOT / path).is_file()] == []
    groups = {kind.entry_points.removeprefix("vibench.") for kind in PluginKind}
    for name in set(NAME.findall(text)) - groups:
        assert pkgutil.resolve_name(f"vibench.{name}") is not None
    scripts = set(SCRIPT.findall("".join(page.read_text(encoding="utf-8") for page in WRITTEN)))
    assert len(scripts) > 10
    assert [script for script in sorted(scripts) if not (ROOT / script).is_file()] == []


FENCED = re.compile(r"^```\w*[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^(?: {4}|\t)(.*)$", re.MULTILINE)
INLINE = re.compile(r"`([^`]+)`")
COMMAND = re.compile(r"^\s*(?:\.venv/bin/)?vibench (-{0,2}[a-z-]+)(.*)$")
SCRIPT = re.compile(r"\bpython ([\w-]+/[\w/.-]+\.py)\b")
WRITTEN = [ROOT / "CONTRIBUTING.md", *PAGES, *RESULTS]


def commands(page: Path) -> Iterator[tuple[str, str]]:
    """Name and arguments of every command of vibench on a page: in blocks, indented lines and inline code."""
    text = page.read_text(encoding="utf-8")
    prose = FENCED.sub("", text)
    lines = "\n".join([*FENCED.findall(text), *INDENTED.findall(prose)]).splitlines()
    for line in [*lines, *(" ".join(code.split()) for code in INLINE.findall(prose))]:
        for part in re.split(r" && |; |(?<=\S)  +|#", line):  # what stands apart is a comment
            if found := COMMAND.match(part):
                yield found[1], found[2]


def test_every_command_of_the_pages_exists_with_its_options(main: Main) -> None:
    known = {command.name or command.callback.__name__.replace("_", "-") for command in app.registered_commands}
    found = [command for page in WRITTEN for command in commands(page)]
    assert len(found) > 100
    asked = {(name, option) for name, rest in found for option in ["", *re.findall(r"--[a-z-]+", rest)]}
    general = {name for name, _ in asked if name.startswith("-")}
    assert [option for option in general if option not in main("--help")[1]] == []
    asked = {(name, option) for name, option in asked if name not in general}
    assert {name for name, _ in asked} <= known
    for name in sorted({name for name, _ in asked}):
        printed = succeeded(main(name, "--help"))
        assert [option for command, option in asked if command == name and option not in printed] == []
