"""The command line: what is wrong with a request is one line and exit code 2, and nothing is started."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from running import Main, Register, refused
from samples import STUDY, changed, write_study

from vibench.cli.main import renamed
from vibench.cli.plugin_commands import LISTS
from vibench.plugins import kinds, registry
from vibench.plugins.kinds import DUAL, PROBLEM
from vibench.plugins.registry import find, registered
from vibench.qp.settings import SETTINGS
from vibench.qp.status import Status
from vibench.report.differences import ChangeKind
from vibench.results.break_even import Meaning
from vibench.results.ranking import added_columns
from vibench.results.read import read_table
from vibench.results.schema import STORED, TABLES
from vibench.results.sqlite import FILE
from vibench.study.entries import ProblemEntry
from vibench.study.matrix import expand, read_study
from vibench.study.spec import Study
from vibench.text import printable


@pytest.fixture
def _nothing_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    def started(*_: object, **__: object) -> None:
        raise AssertionError("a stage was run")

    monkeypatch.setattr("vibench.execution.run._Run.execute", started)


RUN = {
    "unknown study": (["qick"], ["no study is called 'qick'", "did you mean 'quick'"]),
    "missing file": (["no.toml"], ["no.toml", "does not exist"]),
    "unknown option": (["--sovler", "piqp"], ["--sovler"]),
    "option without value": (["--dual"], ["--dual"]),
    "one study too many": (["quick", "quick"], ["quick"]),
    "jobs no number": (["--jobs", "many"], ["--jobs"]),
    "jobs negative": (["--jobs", "-1"], ["--jobs"]),
    "jobs no integer": (["--jobs", "1.5"], ["--jobs"]),
    "tolerance no number": (["--pod-tol", "small"], ["--pod-tol"]),
    "tolerance zero": (["--pod-tol", "0"], ["pod", "greater than 0"]),
    "tolerance nan": (["--dual-tol", "nan"], ["dual", "finite"]),
    "tolerance inf": (["--primal-tol", "inf"], ["primal", "finite"]),
    "tolerance above one": (["--primal-tol", "2"], ["primal", "less than 1"]),
    "unknown problem": (["--problem", "obstcale"], ["did you mean 'obstacle'"]),
    "unknown dual strategy": (["--dual", "mcgp"], ["did you mean 'mcpg'"]),
    "unknown primal strategy": (["--primal", "decorelated"], ["did you mean 'decorrelated'"]),
    "unknown solver": (["--solver", "oqsp"], ["did you mean 'osqp'"]),
}


@pytest.mark.usefixtures("_nothing_starts")
@pytest.mark.parametrize("case", RUN)
def test_a_wrong_run_is_refused_in_one_line(case: str, main: Main) -> None:
    arguments, words = RUN[case]
    refused(main("run", *arguments), *words)
    assert list(Path.cwd().iterdir()) == []


OTHER = {
    "unknown command": (["rnu"], ["rnu"]),
    "unknown global option": (["--colour"], ["--colour"]),
    "unknown list": (["list", "problem"], ["did you mean 'problems'"]),
    "run of nothing": (["show", "nothing"], ["no results in 'nothing'", FILE]),
    "show without run": (["show"], ["RUN"]),
}


@pytest.mark.parametrize("case", OTHER)
def test_other_wrong_requests_are_refused_in_one_line(case: str, main: Main) -> None:
    arguments, words = OTHER[case]
    refused(main(*arguments), *words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--table", "summray"], ["did you mean 'summary'"]),
        (["--format", "xml"], ["--format", "xml", "markdown"]),
        (["--tabel", "cells"], ["--tabel"]),
    ],
)
def test_a_table_that_is_not_there_is_refused(
    arguments: list[str], words: list[str], main: Main, quick_run: Path
) -> None:
    refused(main("show", str(quick_run), *arguments), *words)


def test_a_wrong_study_file_is_refused(main: Main, tmp_path: Path) -> None:
    path = write_study(tmp_path, changed(STUDY, "sed", to=3))
    refused(main("run", path), path, "did you mean 'seed'")


def test_a_wrong_key_of_two_lines_is_refused_in_one(main: Main, tmp_path: Path) -> None:
    refused(main("run", write_study(tmp_path, changed(STUDY, "see\nd", to=3))), "did you mean")


def test_a_missing_tolerance_is_refused(main: Main, tmp_path: Path) -> None:
    path = write_study(tmp_path, changed(STUDY, "tolerances", 0, "primal", to={}))
    refused(main("run", path), "tolerances.primal", "offline-pga")


@pytest.mark.usefixtures("_nothing_starts")
class TestOutputFolder:
    def test_a_file_is_refused(self, main: Main) -> None:
        Path("taken").touch()
        refused(main("run", "--out", "taken"), "'taken'", "is a file")

    def test_a_place_below_a_file_is_refused(self, main: Main) -> None:
        Path("taken").touch()
        refused(main("run", "--out", "taken/below"), "taken/below", "cannot be written")

    @pytest.mark.parametrize("fresh", [[], ["--fresh"]])
    def test_a_folder_with_other_things_is_refused(self, fresh: list[str], main: Main) -> None:
        Path("full").mkdir()
        Path("full/notes.txt").write_text("precious")
        refused(main("run", "--out", "full", *fresh), "'full'", "not empty")
        assert Path("full/notes.txt").read_text() == "precious"

    @pytest.mark.parametrize("content", ["hello", "SQLite format 3\0 and then nothing"])
    def test_a_foreign_results_file_is_refused_and_kept(self, content: str, main: Main) -> None:
        Path("foreign").mkdir()
        Path("foreign", FILE).write_text(content)
        Path("foreign/notes.txt").write_text("precious")
        refused(main("run", "--out", "foreign"), "foreign", FILE)
        assert Path("foreign", FILE).read_text() == content
        assert Path("foreign/notes.txt").read_text() == "precious"

    @pytest.mark.parametrize("fresh", [[], ["--fresh"]])
    def test_results_of_another_study_are_refused_and_kept(
        self, fresh: list[str], main: Main, quick_run: Path, tmp_path: Path
    ) -> None:
        shutil.copytree(quick_run, "other")
        refused(main("run", write_study(tmp_path), "--out", "other", *fresh), "other", "study", "quick", "sample")
        assert len(read_table(Path("other", FILE), "cells")) == len(expand(read_study("quick")))

    def test_another_seed_is_another_study(self, main: Main, quick_run: Path, tmp_path: Path) -> None:
        shutil.copytree(quick_run, "other")
        text = Path(find(kinds.STUDY, "quick").load()).read_text(encoding="utf-8")
        path = tmp_path / "seeded.toml"
        path.write_text(text.replace("seed = 2022", "seed = 2023"), encoding="utf-8")
        refused(main("run", str(path), "--out", "other"), "seed 2022 instead of 2023")

    @pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder nobody can write to")
    def test_a_folder_that_cannot_be_made_is_refused(self, main: Main) -> None:
        refused(main("run", "--out", "/proc/vibench"), "/proc/vibench", "cannot be written")

    def test_a_name_too_long_is_refused(self, main: Main) -> None:
        refused(main("run", "--out", "a" * 300), "output folder")

    def test_the_folder_of_the_study_is_checked_too(self, main: Main) -> None:
        Path("runs").mkdir()
        Path("runs/quick").touch()
        refused(main("run"), "runs/quick", "is a file")


@pytest.mark.usefixtures("_nothing_starts")
@pytest.mark.parametrize(("option", "group"), [("--problem", "problems"), ("--solver", "qp_solvers")])
def test_a_plugin_that_cannot_be_loaded_is_refused(option: str, group: str, main: Main, register: Register) -> None:
    ours = [
        (entry.group, entry.name, entry.value)
        for entry in importlib.metadata.distribution("vibench").entry_points
        if entry.group.startswith("vibench.")
    ]
    register(*ours, (f"vibench.{group}", "broken", "no_such_module:member"))
    refused(main("run", option, "broken"), "'broken'", "no_such_module")


def test_one_broken_plugin_does_not_hide_the_others_from_the_list(main: Main, register: Register) -> None:
    ours = [
        (entry.group, entry.name, entry.value)
        for entry in importlib.metadata.distribution("vibench").entry_points
        if entry.group == "vibench.problems"
    ]
    register(*ours, ("vibench.problems", "broken", "no_such_module:Problem"))
    code, out, _ = main("list", "problems")
    assert code == 0
    assert "obstacle" in out
    assert "broken" in out
    assert "no_such_module" in out


def test_without_arguments_the_help_is_printed(main: Main) -> None:
    _, out, err = main()
    assert len((out + err).splitlines()) > 10
    for command in ("run", "list", "show"):
        assert f"\n  {command} " in out + err


@pytest.mark.parametrize("command", [[], ["run"], ["list"], ["show"]])
def test_help_is_no_error(command: list[str], main: Main) -> None:
    code, out, err = main(*command, "--help")
    assert (code, err) == (0, "")
    assert "Usage: " in out
    assert "--help" in out


def test_help_names_every_option_of_run(main: Main) -> None:
    _, out, _ = main("run", "--help")
    options = ("problem", "dual", "primal", "solver", "pod-tol", "dual-tol", "primal-tol", "out", "jobs")
    for option in (*options, "dry-run", "fresh", "retry", "strict"):
        assert f"--{option}" in out


@pytest.mark.usefixtures("_nothing_starts")
def test_a_dry_run_lists_the_matrix_and_does_nothing_else(main: Main) -> None:
    code, out, err = main("run", "quick", "--dry-run")
    assert (code, err) == (0, "")
    cells = expand(read_study("quick"))
    *lines, last = out.splitlines()
    assert lines == [f"{cell.key}  {cell}" for cell in cells]
    assert last == f"{len(cells)} cells"
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.usefixtures("_nothing_starts")
def test_a_dry_run_leaves_earlier_results_alone(main: Main, quick_run: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in quick_run.rglob("*") if path.is_file()}
    assert main("run", "quick", "--dry-run", "--fresh", "--out", str(quick_run))[0] == 0
    assert {path: path.stat().st_mtime_ns for path in quick_run.rglob("*") if path.is_file()} == before


REPLACED: dict[str, tuple[list[str], Callable[[Any], Any], Any]] = {
    # what is replaced: (options, what is looked at, its only value)
    "dual": (["--dual", "cpg"], lambda cell: cell.dual.name, "cpg"),
    "solver": (["--solver", "daqp"], lambda cell: cell.solver, "daqp"),
    "primal": (["--primal", "offline-pga", "--primal-tol", "0.3"], lambda cell: cell.primal_tol, 0.3),
    "pod": (["--pod-tol", "0.01"], lambda cell: cell.pod.tolerance, 0.01),
    "cone": (["--dual-tol", "0.1"], lambda cell: cell.cone.tolerance, 0.1),
    "problem": (["--problem", "obstacle"], lambda cell: cell.problem.name, "obstacle"),
}


@pytest.mark.parametrize("axis", REPLACED)
def test_options_replace_axes(axis: str, main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    listed: list[Any] = []

    def recorded(study: Any) -> list[Any]:
        listed.extend(expand(study))
        return listed

    monkeypatch.setattr("vibench.study.matrix.expand", recorded)
    options, look, value = REPLACED[axis]
    assert main("run", "quick", "--dry-run", *options)[0] == 0
    assert {look(cell) for cell in listed} == {value}


def test_options_may_be_repeated(main: Main) -> None:
    _, out, _ = main("run", "quick", "--dry-run", "--solver", "piqp", "--solver", "daqp", "--dual", "cpg")
    assert {line.split(" · ")[-1] for line in out.splitlines()[:-1]} == {"piqp 1e-08", "daqp 1e-08"}


def test_list_shows_every_plugin_and_its_options(main: Main) -> None:
    code, out, err = main("list")
    assert (code, err) == (0, "")
    for kind in LISTS.values():
        for name in registered(kind):
            assert name in out
    options = find(kinds.PROBLEM, "obstacle").options.values()
    assert ", ".join(option.name for option in options) in out
    _, out, _ = main("list", "problems")
    for option in options:
        assert f"{option.name}: " in out
    assert "'coarse', 'medium'" in out


@pytest.mark.parametrize("arguments", [["--version"], ["-h"], ["run", "-h"]])
def test_short_options_and_the_version(arguments: list[str], main: Main) -> None:
    code, out, err = main(*arguments)
    assert (code, err) == (0, "")
    assert out.startswith(f"vibench {importlib.metadata.version('vibench')}" if "-h" not in arguments else "Usage: ")


def test_ctrl_c_while_drawing_says_what_is_there(main: Main, quick_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vibench.report.figures.draw_all", interrupted)
    code, out, _ = main("figures", str(quick_run), "--out", "pictures")
    assert code == 130
    assert "interrupted while drawing: results and tables are complete" in out
    assert f"`vibench figures {quick_run}`" in out


@pytest.mark.parametrize(("what", "kind"), LISTS.items())
def test_one_list_shows_only_its_own(what: str, kind: str, main: Main) -> None:
    code, out, _ = main("list", what)
    assert code == 0
    assert out.startswith(what)
    assert all(name in out for name in registered(kind))
    others = [title for title in LISTS if title != what]
    assert [title for title in others if re.search(rf"^{title}(,|$)", out, re.MULTILINE)] == []


def test_the_list_of_solvers_says_which_are_installed(main: Main) -> None:
    _, out, _ = main("list", "solvers")
    rows = {line.split()[0]: line for line in out.splitlines() if line.split()}
    assert set(SETTINGS) <= set(rows)
    for name in ("piqp", "proxqp", "osqp"):
        assert "not installed" not in rows[name]


def test_the_list_of_studies_counts_their_cells(main: Main) -> None:
    _, out, _ = main("list", "studies")
    assert f"{len(expand(read_study('quick')))} cells" in out


def test_show_prints_the_summary(main: Main, quick_run: Path) -> None:
    code, out, err = main("show", str(quick_run))
    assert (code, err) == (0, "")
    frame = read_table(quick_run / FILE, "cells")
    lines = [line for line in out.splitlines() if any(solver in line for solver in frame["solver"].unique())]
    assert len(lines) == len(frame)
    assert "…" not in out


def test_a_run_ends_with_the_summary_and_says_where_things_are(quick_run: Path) -> None:
    printed = (quick_run / "printed.txt").read_text(encoding="utf-8")
    fine = read_table(quick_run / FILE, "cells")["status"] == "ok"
    assert f"{len(fine)} cells, {fine.sum()} ok, {len(fine) - fine.sum()} not ok" in printed
    assert str(quick_run / FILE) in printed
    assert "next:\n  vibench show " in printed
    assert len(printed.splitlines()) < 100
    assert "\x1b" not in printed


@pytest.mark.parametrize("form", ["markdown", "latex", "json"])
def test_a_condition_holds_in_every_format(form: str, main: Main, quick_run: Path) -> None:
    _, out, _ = main("show", str(quick_run), "--where", "solver = 'osqp'", "--format", form)
    assert "osqp" in out
    assert "piqp" not in out


@pytest.mark.parametrize("table", ["summary", "benefits", *TABLES])
def test_show_prints_every_table_as_csv(table: str, main: Main, quick_run: Path) -> None:
    code, out, err = main("show", str(quick_run), "--table", table, "--format", "csv")
    assert (code, err) == (0, "")
    rows = list(csv.DictReader(io.StringIO(out)))
    source = {"summary": "cells", "benefits": "thresholds"}.get(table, table)
    assert len(rows) == len(read_table(quick_run / FILE, source)) > 0
    if table == source:
        assert [name for name in rows[0] if not name.startswith("mu_")] == list(STORED[table])


@pytest.mark.parametrize("table", ["summary", "benefits", "cells"])
def test_show_prints_markdown(table: str, main: Main, quick_run: Path) -> None:
    code, out, _ = main("show", str(quick_run), "--table", table, "--format", "markdown")
    assert code == 0
    lines = out.splitlines()
    assert all(line.startswith("|") and line.endswith("|") for line in lines)
    assert len({line.count("|") for line in lines}) == 1


@pytest.mark.parametrize("table", ["summary", "benefits", "histories"])
def test_show_prints_on_a_terminal(table: str, main: Main, quick_run: Path) -> None:
    code, out, _ = main("show", str(quick_run), "--table", table)
    assert code == 0
    assert out.startswith(f"{quick_run.name}: {table}")


def test_show_finds_a_run_by_its_name(main: Main, quick_run: Path) -> None:
    Path("runs").mkdir()
    Path("runs/quick").symlink_to(quick_run)
    code, out, _ = main("show", "quick", "--format", "csv")
    assert code == 0
    assert len(out.splitlines()) == 1 + len(read_table(quick_run / FILE, "cells"))


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
        code, out, err = main("show", run)
        assert (code, err) == (0, "")
        assert out.startswith(f"{printable(name)}: summary")
        assert all(line.isprintable() for line in out.splitlines())


@pytest.mark.usefixtures("_nothing_starts")
def test_a_label_of_several_lines_makes_no_lines_of_its_own(main: Main, tmp_path: Path) -> None:
    path = write_study(tmp_path, changed(STUDY, "problem", 0, "label", to="a\n0 cells\x1b[2J"))
    code, out, _ = main("run", path, "--dry-run")
    cells = expand(read_study(path))
    assert code == 0
    *lines, last = out.splitlines()
    assert [line.split()[0] for line in lines] == [cell.key for cell in cells]
    assert all(r"a\n0 cells\u001b[2J · " in line for line in lines)
    assert last == f"{len(cells)} cells"


def test_an_error_that_nobody_foresaw_is_not_hidden(main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("vibench.study.matrix.read_study", broken)
    with pytest.raises(ZeroDivisionError):
        main("run")


def test_help_on_a_command_is_its_own(main: Main) -> None:
    assert main("help", "show") == main("show", "--help")
    assert main("help")[1] == main("--help")[1]


@pytest.mark.parametrize("name", ["online_s", "online [ms]"])
def test_help_on_a_column_is_what_it_means(name: str, main: Main) -> None:
    code, out, _ = main("help", name)
    assert code == 0
    assert f"online_s [s], in cells: {STORED['cells']['online_s'].meaning}" in out.splitlines()


@pytest.mark.parametrize(
    "name", ["total_s", "total [s]", "total", "certified error", "cheapest_until", "until", "sure"]
)
def test_help_on_a_column_of_a_computed_table_is_its_meaning_there(name: str, main: Main) -> None:
    code, out, _ = main("help", name)
    assert code == 0
    names = {"total [s]": "total_s", "total": "total_s", "until": "cheapest_until", "sure": "probability"}
    column = names.get(name, name.replace(" ", "_"))
    unit = f" [{added_columns()[column].unit}]" * bool(added_columns()[column].unit)
    assert f"{column}{unit}, in best: {added_columns()[column].meaning}" in out.splitlines()


def test_help_on_a_key_of_study_files_is_what_it_means_wherever_it_stands(main: Main) -> None:
    code, out, _ = main("help", "training")
    assert code == 0
    meanings = [model.model_fields["training"].description for model in (Study, ProblemEntry)]
    of_file, of_entry, columns, of_study = out.splitlines()
    assert of_file.startswith('training, in a study file (list of table, default ["own"]): ')
    assert of_entry.startswith("training, in problem of a study file (")
    assert [line.partition("): ")[2] for line in (of_file, of_entry)] == meanings
    in_all = [table for table, described in STORED.items() if "training" in described]
    assert of_study.startswith("training, a study of vibench")
    assert columns == (f"training, in {', '.join(in_all)}: {STORED['cells']['training'].meaning}")


def test_help_on_nothing_there_is_refused(main: Main) -> None:
    refused(
        main("help", "shwo"), "no command, key, column, status, plugin or term is called 'shwo'; did you mean 'show'?"
    )


WORDS = {
    "supremizer": "Supremizer: T(µ)η, the displacement",
    "as fast": "Break-even: ",
    "certified": "Certificate: certified, v",
    "mcpg": "mcpg, a dual strategy of vibench",
    "piqp": "piqp, a QP solver",
    "quick": "quick, a study of vibench",
    "best": "best, a table of a run: `vibench show RUN --table best`",
    "feasible": "Correction: ",
    "κ": "ρ, ω, κ: residual",
    "diff": "`vibench diff` is now `vibench compare --table changes --strict`",
}


def test_help_knows_every_word_that_people_see(main: Main) -> None:
    for word, said in WORDS.items():
        assert any(line.startswith(said) for line in main("help", word)[1].splitlines()), word
    for word in [*Status, *ChangeKind, *Meaning, *registered(DUAL), *TABLES]:
        assert main("help", word)[0] == 0, word


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("diff a b --limit 2", "compare a b --limit 2 --table changes --strict"),
        ("import my-model", "pack my-model"),
        ("cones my-model --dual cpg", "pack my-model --dual cpg --cones"),
        ("export-qps quick set --sequence", "export quick set --sequence"),
        ("export-model quick 3f9a m.npz --interpolate 1e-6", "export quick 3f9a m.npz --tolerance 1e-6"),
        ("export-model quick 3f9a m.npz --c", "export quick 3f9a m.c"),
        ("export-vtu quick 3f9a -1,2 --out f.vtu", "export quick 3f9a f.vtu --mu -1,2"),
        ("export-vtu quick 3f9a 1 --at m=x", "export quick 3f9a 3f9a.vtu --mu 1 --at m=x"),
    ],
)
def test_a_command_of_before_says_what_to_write_now(old: str, new: str) -> None:
    assert renamed(old.split()) == new.split()
    assert renamed(new.split()) is None


def test_a_command_of_before_still_works(main: Main, quick_run: Path) -> None:
    run = str(quick_run)
    assert main("diff", run, run)[:2] == main("compare", run, run, "--table", "changes", "--strict")[:2]
    line = main("diff", run, run)[2]
    assert line.startswith("vibench: `vibench diff` will go; write `vibench compare ")
    assert line.count("\n") == 1


def test_problems_are_listed_with_their_parameters(main: Main) -> None:
    _, out, _ = main("list", "problems")
    text = " ".join(out.split())
    assert "mu_1: radius from 0.7 to 1.3 m" in text
    assert "mu_1: scale from 0.8 to 1.2 mu_2: centre_x from -0.05 to 0.05 m" in text
    assert "unknowns" not in text


def test_sizes_of_problems_are_said_where_they_are_asked_for(main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    known = registry.registered(PROBLEM)
    few = {name: known[name] for name in ("radial-obstacle", "pack")}
    monkeypatch.setattr(registry, "registered", lambda kind: few if kind is PROBLEM else {})
    _, out, _ = main("list", "problems", "--sizes")
    text, problem = " ".join(out.split()), known["radial-obstacle"].load()()
    assert f"n = {problem.V.dim} unknowns, m = {problem.W.dim} constraints" in text
    assert "its size depends on path" in text
    refused(main("list", "solvers", "--sizes"), "--sizes is for `vibench list problems`")


def test_a_table_of_tolerances_in_place_of_a_list_is_named(main: Main, tmp_path: Path) -> None:
    file = write_study(tmp_path, STUDY | {"tolerances": {"pod": [0.01], "dual": [0.1]}})
    refused(main("run", file), "tolerances: expected a list of tables: write [[tolerances]] in place of")


def test_a_wrong_column_has_the_heading_that_was_meant(main: Main, quick_run: Path) -> None:
    refused(main("show", str(quick_run), "--columns", "online ms"), "did you mean 'online [ms]'?")
