import csv
import importlib.metadata
import io
import re
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from running import Main, Register, refused, succeeded
from samples import STUDY, changed, write_study

import vibench_problems
from vibench import Status
from vibench.cli.main import explained_words, renamed
from vibench.plugins import kinds, registry
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import find, registered
from vibench.qp.settings import SETTINGS
from vibench.report.differences import ChangeKind
from vibench.results.break_even import Meaning
from vibench.results.ranking import added_columns
from vibench.results.read import read_table
from vibench.results.schema import STORED, TABLES
from vibench.results.sqlite import FILE
from vibench.study.matrix import expand, read_study
from vibench.study.spec import ProblemEntry, Study
from vibench.text import printable


@pytest.fixture
def _nothing_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vibench.execution.run._Run.execute", Mock(side_effect=AssertionError("a stage was run")))


@pytest.mark.usefixtures("_nothing_starts")
def test_a_wrong_request_is_refused_in_one_line(main: Main, quick_run: Path, tmp_path: Path) -> None:
    show = ["show", str(quick_run)]
    for arguments, words in (
        (["run", "qick"], ["no study is called 'qick'", "did you mean 'quick'"]),
        (["run", "no.toml"], ["no.toml", "does not exist"]), (["run", "--sovler", "piqp"], ["--sovler"]),
        (["run", "--dual"], ["--dual"]), (["run", "quick", "quick"], ["quick"]),
        (["run", "--jobs", "many"], ["--jobs"]), (["run", "--jobs", "-1"], ["--jobs"]),
        (["run", "--pod-tol", "small"], ["--pod-tol"]), (["run", "--pod-tol", "0"], ["pod", "greater than 0"]),
        (["run", "--dual-tol", "nan"], ["dual", "finite"]), (["run", "--primal-tol", "2"], ["primal", "less than 1"]),
        (["run", "--problem", "obstcale"], ["did you mean 'obstacle'"]),
        (["run", "--dual", "mcgp"], ["did you mean 'mcpg'"]),
        (["run", "--primal", "decorelated"], ["did you mean 'decorrelated'"]),
        (["run", "--solver", "oqsp"], ["did you mean 'osqp'"]), (["rnu"], ["rnu"]), (["--colour"], ["--colour"]),
        (["list", "problem"], ["did you mean 'problems'"]), (["show"], ["RUN"]),
        (["show", "nothing"], ["no results in 'nothing'", FILE]),
        ([*show, "--table", "summray"], ["did you mean 'summary'"]),
        ([*show, "--format", "xml"], ["--format", "xml", "markdown"]), ([*show, "--tabel", "cells"], ["--tabel"]),
        ([*show, "--columns", "online ms"], ["did you mean 'online [ms]'?"]),
        (["show", "/".join(["d" * 100] * 6)], ["no results in"]), (["list", "x" * 5000], ["x… (5000 characters)'"]),
    ):  # fmt: skip
        refused(main(*arguments), *words)
    run, long = str(quick_run), "x" * 5000
    for named in (["show", run, long], ["show", long], ["replay", run, long], ["compare", run, long]):
        assert len(refused(main(*named), "x… (5000 characters)'")) < 500 + len(run), named
    assert list(Path.cwd().iterdir()) == []
    in_place = STUDY | {"tolerances": {"pod": [0.01], "dual": [0.1]}}
    for content, words in (
        (changed(STUDY, "sed", to=3), ["did you mean 'seed'"]),
        (changed(STUDY, "see\nd", to=3), ["did you mean"]),
        (changed(STUDY, "tolerances", 0, "primal", to={}), ["tolerances.primal", "offline-pga"]),
        (in_place, ["tolerances: expected a list of tables: write [[tolerances]] in place of"]),
    ):
        path = write_study(tmp_path, content)
        refused(main("run", path), path, *words)


def test_taken_places_and_other_results_are_refused_and_kept(main: Main, quick_run: Path, tmp_path: Path) -> None:
    Path("taken").touch()
    refused(main("run", "--out", "taken"), "'taken'", "is a file")
    refused(main("run", "--out", "taken/below"), "taken/below", "cannot be written")
    refused(main("run", "--out", "a" * 300), "output folder")
    if Path("/proc").is_dir():  # a folder nobody can write to
        refused(main("run", "--out", "/proc/vibench"), "/proc/vibench", "cannot be written")
    Path("runs").mkdir()
    Path("runs/quick").touch()  # the folder of the study
    refused(main("run"), "runs/quick", "is a file")
    for content in (None, "hello", "SQLite format 3\0 and then nothing"):
        folder = Path(f"full{len(content or '')}")
        folder.mkdir()
        (folder / "notes.txt").write_text("precious")
        if content:
            (folder / FILE).write_text(content)
        for fresh in ([], ["--fresh"]) if content is None else ([],):
            refused(main("run", "--out", folder.name, *fresh), folder.name, FILE if content else "not empty")
        assert (folder / "notes.txt").read_text() == "precious"
        assert content is None or (folder / FILE).read_text() == content
    shutil.copytree(quick_run, "other")
    for fresh in ([], ["--fresh"]):
        refused(main("run", write_study(tmp_path), "--out", "other", *fresh), "other", "study", "quick", "sample")
        assert len(read_table(Path("other", FILE), "cells")) == len(expand(read_study("quick")))
    text = Path(find(kinds.PluginKind.STUDY, "quick").load()).read_text(encoding="utf-8")
    path = tmp_path / "seeded.toml"
    path.write_text(text.replace("seed = 2022", "seed = 2023"), encoding="utf-8")
    refused(main("run", str(path), "--out", "other"), "seed 2022 instead of 2023")


@pytest.mark.usefixtures("_nothing_starts")
@pytest.mark.parametrize(("option", "group"), [("--problem", "problems"), ("--solver", "qp_solvers")])
def test_a_plugin_that_cannot_be_loaded_is_refused(option: str, group: str, main: Main, register: Register) -> None:
    entries = importlib.metadata.distribution("vibench").entry_points
    ours = [(entry.group, entry.name, entry.value) for entry in entries if entry.group.startswith("vibench.")]
    register(*ours, (f"vibench.{group}", "broken", "no_such_module:member"))
    refused(main("run", option, "broken"), "'broken'", "no_such_module")
    if group == "problems":  # the others are listed beside it
        out = succeeded(main("list", "problems"))
        assert {"obstacle", "broken"} <= set(out.split())
        assert "no_such_module" in out


OWN = """
from vibench_problems.radial import Radial
class Own(Radial):
    "A problem of one's own."
"""


def test_a_problem_alone_is_run_with_the_usual_choices(main: Main, tmp_path: Path) -> None:
    """By its name or as a class in a file; a wrong one, or a pack that is none, is refused in a line."""
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "broken.py").write_text("1 / 0\n")
    (tmp_path / "pack.toml").write_text("")
    for problem, label in (("obstacle", "obstacle"), (f"{tmp_path}/own.py:Own", "Own")):
        assert succeeded(main("run", "--problem", problem, "--dry-run")).count(f"  {label} · mcpg · ") == 8
    ended = Mock(side_effect=KeyboardInterrupt)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vibench.execution.run.run_study", ended)
        main("run", "--problem", f"{tmp_path}/own.py:Own")
    assert ended.call_args.args[:2][1] == Path("runs/Own")
    for problem, said in (
        (f"{tmp_path}/own.py:Onw", "did you mean 'Own'"), (f"{tmp_path}/broken.py:Own", "division by zero"),
        (str(tmp_path), "pack.toml: format: required"), ("a" * 5000, "(5000 characters)"),
    ):  # fmt: skip
        refused(main("run", "--problem", problem, "--dry-run"), said)


def test_a_strategy_in_a_file_is_a_row_of_a_run(main: Main, tmp_path: Path) -> None:
    (tmp_path / "cone.py").write_text("import vibench_strategies.mcpg as m\nclass Mine(m.ModifiedCPG):\n    pass\n")
    duals = ["--dual", "mcpg", "--dual", f"{tmp_path}/cone.py:Mine"]
    out = succeeded(main("run", "--problem", "obstacle", *duals, "--dry-run"))
    assert (out.count("obstacle · mcpg · "), out.count("obstacle · Mine · ")) == (8, 8)
    refused(main("run", "--dual", f"{tmp_path}/cone.py:Mien", "--dry-run"), "did you mean 'Mine'")


def test_dry_runs_list_the_matrix_and_lists_their_plugins(main: Main, tmp_path: Path) -> None:
    labelled = write_study(tmp_path, changed(STUDY, "problem", 0, "label", to="a\n0 cells\x1b[2J"))
    for study, words in (("quick", ""), (labelled, r"a\n0 cells\u001b[2J · ")):
        out = succeeded(main("run", study, "--dry-run"))
        cells = expand(read_study(study))
        *lines, last = out.splitlines()
        assert [line.split()[0] for line in lines] == [cell.key for cell in cells]
        assert all(words in line for line in lines)  # a label of several lines makes no lines of its own
        assert words or lines == [f"{cell.key}  {cell}" for cell in cells]
        assert last == f"{len(cells)} cells"
    assert list(Path.cwd().iterdir()) == []
    out = succeeded(main("list"))
    assert [name for kind in PluginKind for name in registered(kind) if name not in out] == []
    options = find(kinds.PluginKind.PROBLEM, "obstacle").options
    assert [name for name in options if f" {name}" not in out] == []
    _, out, _ = main("list", "problems")
    assert [name for name in options if f"{name}: " not in out] == []
    text = " ".join(out.split())
    assert "'coarse', 'medium'" in text
    assert "mu_1: radius from 0.7 to 1.3 m" in text
    assert "mu_1: scale from 0.8 to 1.2 mu_2: centre_x from -0.05 to 0.05 m" in text
    assert "unknowns" not in text
    lists = [kind.plural for kind in PluginKind]
    for what, kind in zip(lists, PluginKind, strict=True):
        out = succeeded(main("list", what))
        assert out.startswith(what)
        assert all(name in out for name in registered(kind))
        assert [title for title in lists if re.search(rf"^{title}(,|$)", out, re.MULTILINE)] == [what]
        if what == "studies":
            shipped = (Path(vibench_problems.__path__[0]) / "studies").glob("*.toml")
            assert {file.stem for file in shipped} <= set(registered(kind))
            assert f"{len(expand(read_study('quick')))} cells" in out
        if what == "solvers":
            shown = {line.split()[0]: line for line in out.splitlines() if line.split()}
            assert set(SETTINGS) <= set(shown)
            assert not any("not installed" in shown[name] for name in ("piqp", "proxqp", "osqp"))


def test_interrupts_are_told_and_errors_shown(main: Main, quick_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vibench.report.figures.draw_all", Mock(side_effect=KeyboardInterrupt))
    code, out, _ = main("figures", str(quick_run), "--out", "pictures")
    assert code == 130
    assert "interrupted while drawing: results and tables are complete" in out
    assert f"`vibench figures {quick_run}`" in out
    monkeypatch.setattr("vibench.study.matrix.read_study", Mock(side_effect=ZeroDivisionError))
    with pytest.raises(ZeroDivisionError):
        main("run")


def test_runs_end_with_whether_they_pay_and_show_every_table_in_every_form(main: Main, quick_run: Path) -> None:
    printed, frame = (quick_run / "printed.txt").read_text(encoding="utf-8"), read_table(quick_run / FILE, "cells")
    assert f"{len(frame)} cells, all ok; no check of constants, bounds and solvers failed\n" in printed
    assert [f"\n{problem}: a full solution takes " in printed for problem in ("obstacle", "hertz")] == [True, True]
    assert str(quick_run / FILE) in printed
    assert "next:\n  vibench report " in printed
    assert len(printed.splitlines()) < 100
    assert "\x1b" not in printed
    out = succeeded(main("show", str(quick_run)))
    assert sum(any(solver in line for solver in frame["solver"].unique()) for line in out.splitlines()) == len(frame)
    assert "…" not in out
    for table in ("summary", "benefits", *TABLES):
        out = succeeded(main("show", str(quick_run), "--table", table, "--format", "csv"))
        rows = list(csv.DictReader(io.StringIO(out)))
        source = {"summary": "cells", "benefits": "thresholds"}.get(table, table)
        assert len(rows) == len(read_table(quick_run / FILE, source))
        # The study has no task.
        assert rows or table == "calibrations"
        if table == source and rows:
            assert [name for name in rows[0] if not name.startswith("mu_")] == list(STORED[table])
    for table in ("summary", "benefits", "cells"):
        lines = main("show", str(quick_run), "--table", table, "--format", "markdown")[1].splitlines()
        assert all(line.startswith("|") and line.endswith("|") for line in lines)
        assert len({line.count("|") for line in lines}) == 1
    for form in ("markdown", "latex", "json"):
        out = main("show", str(quick_run), "--where", "solver = 'osqp'", "--format", form)[1]
        assert "osqp" in out
        assert "piqp" not in out
    Path("runs").mkdir()
    Path("runs/quick").symlink_to(quick_run)
    lines = main("show", "quick", "--format", "csv")[1].splitlines()
    assert len(lines) == 1 + len(read_table(quick_run / FILE, "cells"))


@pytest.mark.parametrize("run", ["[/b]", "//x", "//x/y", "file:x", "a\x1b[2J\nb", "\udcff", "x?mode=rwc", ""])
def test_a_run_of_an_odd_name_that_is_not_there_is_refused(run: str, main: Main) -> None:
    line = refused(main("show", run), "no results in")
    assert line.rstrip("\n").isprintable()
    refused(main("report", run))
    refused(main("compare", run, run))
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize("name", ["[red]a[bold] :warning:", "a\x1b[2J", "file:x?mode=memory#y", "a%20b", "\udcff"])
def test_a_run_of_an_odd_name_is_shown(name: str, main: Main, quick_run: Path) -> None:
    Path(name).symlink_to(quick_run)
    for run in (name, f"./{name}", str(Path(name).absolute()), f"/{Path(name).absolute()}"):
        out = succeeded(main("show", run))
        assert out.startswith(f"{printable(name)}: summary")
        assert all(line.isprintable() for line in out.splitlines())


def test_help_is_there_for_every_word_and_former_commands_still_work(main: Main, quick_run: Path) -> None:
    _, out, err = main()
    assert [name for name in ("run", "list", "show") if f"\n  {name} " not in out + err] == []
    assert main("help", "show") == main("show", "--help")
    assert main("help")[1] == main("--help")[1]
    for arguments in (["-h"], ["run", "-h"]):
        assert main(*arguments)[1].startswith("Usage: ")
    assert main("--version")[1].startswith(f"vibench {importlib.metadata.version('vibench')}")
    known = "no command, key, column, status, plugin or term is called 'shwo'; did you mean 'show'?"
    refused(main("help", "shwo"), known)
    said = {
        "supremizer": "Supremizer: T(µ)η, the displacement", "as fast": "Break-even: ", "tolerance": "tolerances, in ",
        "feasible": "Correction: ", "certified": "Certificate: certified, v", "κ": "ρ, ω, κ: residual",
        "mcpg": "mcpg, a dual strategy of vibench", "piqp": "piqp, a QP solver", "quick": "quick, a study of vibench",
        "best": "best, a table of a run: `vibench show RUN --table best`",
        "diff": "`vibench diff` is now `vibench compare --table changes --strict`",
    }  # fmt: skip
    for word, line in said.items():
        assert any(one.startswith(line) for one in main("help", word)[1].splitlines()), word
    known = {word for words, _ in explained_words() for word in words}
    assert {*Status, *ChangeKind, *Meaning, *registered(PluginKind.DUAL), *TABLES} - known == set()
    out = succeeded(main("help", "training"))
    meanings = [model.model_fields["training"].description for model in (Study, ProblemEntry)]
    of_file, of_entry, columns, of_study = out.splitlines()
    assert of_file.startswith('training, in a study file (list of table, default ["own"]): ')
    assert of_entry.startswith("training, in problem of a study file (")
    assert [line.partition("): ")[2] for line in (of_file, of_entry)] == meanings
    in_all = [table for table, described in STORED.items() if "training" in described]
    assert of_study.startswith("training, a study of vibench")
    assert columns == (f"training, in {', '.join(in_all)}: {STORED['cells']['training'].meaning}")
    for name in ("online_s", "online [ms]"):
        assert f"online_s [s], in cells: {STORED['cells']['online_s'].meaning}" in main("help", name)[1].splitlines()
    names = {"total_s": "total_s", "total [s]": "total_s", "total": "total_s", "until": "cheapest_until"}
    for name, column in names.items() | {("certified error", "certified_error"), ("sure", "probability")}:
        added = added_columns()[column]
        unit = f" [{added.unit}]" * bool(added.unit)
        assert f"{column}{unit}, in best: {added.meaning}" in main("help", name)[1].splitlines()
    for old, new in (
        ("diff a b --limit 2", "compare a b --limit 2 --table changes --strict"),
        ("import my-model", "pack my-model"),
        ("cones my-model --dual cpg", "pack my-model --dual cpg --cones"),
        ("export-qps quick set --sequence", "export quick set --sequence"),
        ("export-model quick 3f9a m.npz --interpolate 1e-6", "export quick 3f9a m.npz --tolerance 1e-6"),
        ("export-model quick 3f9a m.npz --c", "export quick 3f9a m.c"),
        ("export-vtu quick 3f9a -1,2 --out f.vtu", "export quick 3f9a f.vtu --mu -1,2"),
        ("export-vtu quick 3f9a 1 --at m=x", "export quick 3f9a 3f9a.vtu --mu 1 --at m=x"),
    ):
        assert (renamed(old.split()), renamed(new.split())) == (new.split(), None)
    run = str(quick_run)
    assert main("diff", run, run)[:2] == main("compare", run, run, "--table", "changes", "--strict")[:2]
    line = main("diff", run, run)[2]
    assert line.startswith("vibench: `vibench diff` will go; write `vibench compare ")
    assert line.count("\n") == 1


def test_options_replace_axes_and_sizes_are_said_where_asked_for(main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    listed: list[Any] = []
    monkeypatch.setattr("vibench.study.matrix.expand", lambda study: listed.append(expand(study)) or listed[-1])
    for options, look, values in (
        ("--dual cpg", lambda cell: cell.dual.name, {"cpg"}),
        ("--solver piqp --solver daqp", lambda cell: cell.solver, {"piqp", "daqp"}),
        ("--primal offline-pga --primal-tol 0.3", lambda cell: cell.primal_tol, {0.3}),
        ("--pod-tol 0.01", lambda cell: cell.pod.tolerance, {0.01}),
        ("--dual-tol 0.1", lambda cell: cell.cone.tolerance, {0.1}),
        ("--problem obstacle", lambda cell: cell.problem.name, {"obstacle"}),
    ):
        assert main("run", "quick", "--dry-run", *options.split())[0] == 0
        assert {look(cell) for cell in listed[-1]} == values
    known = registry.registered(PluginKind.PROBLEM)
    few = {name: known[name] for name in ("radial-obstacle", "pack")}
    monkeypatch.setattr(registry, "registered", lambda kind: few if kind is PluginKind.PROBLEM else {})
    _, out, _ = main("list", "problems", "--sizes")
    text, problem = " ".join(out.split()), known["radial-obstacle"].load()()
    assert f"n = {problem.V.dim} unknowns, m = {problem.W.dim} constraints" in text
    assert "its size depends on path" in text
    refused(main("list", "solvers", "--sizes"), "--sizes is for `vibench list problems`")
