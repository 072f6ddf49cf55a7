import os
import shlex
import subprocess
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest
import typer
from running import Main, Register, succeeded

from vibench.cli import completion
from vibench.cli.main import app
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import find, first_sentence, registered
from vibench.qp.settings import SETTINGS
from vibench.results.ranking import columns_of_measures
from vibench.results.read import read_table
from vibench.results.schema import STORED, TABLES
from vibench.results.show import VIEWS
from vibench.results.sqlite import FILE

GROUP: Any = typer.main.get_command(app)
COMMANDS = tuple(GROUP.commands)


@pytest.fixture(autouse=True)
def _no_other_package(register: Register) -> None:
    """The plugins are those of vibench, whatever else is installed."""
    register(*((entry.group, entry.name, entry.value) for entry in distribution("vibench").entry_points))


def completed(line: str) -> list[str]:
    """What the last word of a command line may become, asked as bash asks."""
    *before, last = line.split(" ")[1:]
    command, words = GROUP, list(before)
    context = command.make_context("vibench", [], resilient_parsing=True)
    if words:
        command = command.get_command(context, words.pop(0))
        context = command.make_context(command.name, words, parent=context, resilient_parsing=True)
    option = next((p for p in command.params if before and before[-1] in p.opts), None)
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    arguments = [p for p in arguments if context.params.get(p.name) is None or p.nargs == -1]
    return [item.value for item in (option or arguments[0]).shell_complete(context, last)]


def test_values_are_completed_with_what_there_is_once(register: Register) -> None:
    """The command then refuses it and names both packages; a prompt is no place for that."""
    for line, *words in (
        ("run quick --problem ob", "obstacle"),
        ("run quick --dual ", *registered(PluginKind.DUAL)),
        ("run quick --primal o", "offline-pga", "online-supremizers"), ("run quick --solver ", *sorted(SETTINGS)),
        ("run quick --correction ", "auto", "feasible", "none"),
        ("check o", "obstacle", "offline-pga", "online-supremizers", "orthant"), ("check sol", "solver:"),
        ("check solver:p", "solver:piqp", "solver:proxqp"), ("check dual:c", "dual:cpg"), ("check pri", "primal:"),
        ("check primal:o", "primal:offline-pga", "primal:online-supremizers"),
        ("check obstacle --option res", "resolution="),
        ("check problem:radial-obstacle --option ", "length=", "resolution="),
        ("show quick --columns cell,beta_span", "cell,beta_span_min"),
        ("show quick --table thresholds --sort -threshold_l", "-threshold_low"),
        ("show quick --table best --columns error_b", "error_below"),
        ("show quick --table benefits --columns error_", "error_a", "error_b"),
        ("show quick --error ", "lambda", "output:", "solution", "u"),
        ("compare a b --column onl", *(name for name in sorted(STORED["cells"]) if name.startswith("onl"))),
        ("list s", "sampling", "solvers", "studies"), ("show quick --table th", "thresholds"),
        ("show quick --table s", "summary"),
    ):  # fmt: skip
        assert completed(f"vibench {line}") == words, line
    assert set(completion.lists("")) == {kind.plural for kind in PluginKind}
    assert set(completion.table_names("")) == set(VIEWS) > set(TABLES)
    assert set(completion.error_measures("")) == {*columns_of_measures(), "output:"}
    register(*(("vibench.problems", "mine", f"{module}:Problem") for module in ("one", "other")))
    assert completed("vibench run quick --problem ") == ["mine"]


def test_studies_runs_and_cells_are_there(quick_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("papers").mkdir()
    for name in ("paper-mine.toml", "paper-notes.txt", "papers/radial.toml"):
        Path(name).touch()
    assert completion.studies("paper-") == ["paper-hertz", "paper-mine.toml", "paper-obstacle"]
    assert completion.studies("papers/") == ["papers/radial.toml"]
    assert completion.studies(f"{Path.cwd()}/papers/r") == [f"{Path.cwd()}/papers/radial.toml"]
    assert completion.studies("nowhere/") == []
    for name in ("mine", "more", "other", "m\x1b[2J", "m\nrm"):  # a prompt would obey the last two
        Path("runs", name).mkdir(parents=True)
        if name != "more":
            Path("runs", name, FILE).touch()
    assert completed("vibench show ") == ["mine", "other"]
    assert completed("vibench replay m") == completed("vibench report m") == ["mine"]
    assert completed("vibench compare mine o") == ["other"]
    Path("runs/quick").symlink_to(quick_run)
    keys = sorted(read_table(quick_run / FILE, "cells")["cell"])
    assert completed("vibench replay quick ") == keys
    assert completed(f"vibench replay quick {keys[0][:6]}") == [keys[0]]
    assert completed("vibench replay nothing ") == []
    Path("runs/broken").mkdir()
    Path("runs/broken", FILE).write_text("no database")
    assert completed("vibench replay broken ") == []


def test_the_installed_command_completes_for_bash(command: str, tmp_path: Path) -> None:
    """Words that bash breaks are completed after the break; other packages may have further ones."""
    for words, expected in (
        (["run", "paper-"], ["paper-hertz", "paper-obstacle"]),
        (["check", "primal", ":", "of"], ["offline-pga"]),
        (["check", "dual", ":"], ["angle-greedy", "cpg"]),
        (["check", "obstacle", "--option", "reso"], ["resolution="]),
        (["run", "--fr"], ["--fresh"]),
    ):
        asked = {"_VIBENCH_COMPLETE": "complete_bash", "COMP_WORDS": "\n".join(["vibench", *words])}
        environment = os.environ | asked | {"COMP_CWORD": str(len(words))}
        done = subprocess.run([command], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert (done.stdout.split()[: len(expected)], done.stderr) == (expected, "")
        assert words != ["run", "paper-"] or all(word.startswith("paper-") for word in done.stdout.split())


def test_overviews_fit_80_columns_and_help_ends_with_examples(main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without importing any plugin."""
    for kind in ("problems", "primal", "dual", "sampling"):
        for plugin in registered(next(one for one in PluginKind if one.plural == kind)).values():
            assert plugin.names_of_options == list(plugin.options)
            assert plugin.summary == (plugin.load().__doc__ or "").split("\n")[0]
    assert find(PluginKind.STUDY, "benefit").summary.endswith("of Niakh et al. (2022)")
    assert first_sentence("A. of B et al. (2022), i.e. this. More. And") == "A. of B et al. (2022), i.e. this"
    assert first_sentence("All of it.") == "All of it"
    monkeypatch.setenv("COLUMNS", "80")
    assert max(map(len, main("list")[1].splitlines())) <= 80
    lines = {line.split()[0]: line for line in main("--help")[1].splitlines() if line.startswith("  ")}
    assert [name for name in COMMANDS if lines[name].endswith("...")] == []
    for name in COMMANDS:
        out = succeeded(main(name, "--help"))
        examples = [line.strip() for line in completion.examples(name).splitlines()[2:]]
        assert examples
        assert [line.strip() for line in out.splitlines()[-len(examples) - 1 :]] == ["Examples:", *examples]
        assert max(map(len, out.splitlines())) <= 80
        for example in examples:
            program, command, *arguments = shlex.split(example)
            assert (program, command) == ("vibench", name)
            GROUP.get_command(None, name).make_context(name, arguments)
