import subprocess
import sys
import tomllib
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from forking import run_pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from running import Main, Vibench, refused, rows, succeeded
from samples import wire_study, write_study

from vibench import HighFidelitySolver, RequestError, create
from vibench.cli import scaffold
from vibench.plugins.kinds import CHECKED, PluginKind
from vibench.plugins.registry import registered
from vibench.testing.checks import case_of

NAMES = {
    "problem": "my-rope", "primal": "tied", "dual": "cone", "solver": "for-rope", "sampling": "strata",
    "formulation": "program",
}  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    parent = tmp_path_factory.mktemp("new")
    return {kind: scaffold.write_package(CHECKED[kind], name, parent) for kind, name in NAMES.items()}


@pytest.fixture(scope="module")
def site(written: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the new packages are installed, and not their sources but their wheels."""
    folder = tmp_path_factory.mktemp("site")
    pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index", "--no-deps"]
    build = [*pip, "--no-build-isolation", "--target", str(folder), *map(str, written.values())]
    subprocess.run([sys.executable, *build], check=True, capture_output=True, text=True)
    return folder


@pytest.mark.long
def test_the_tests_of_new_packages_are_green(written: dict[str, Path], site: Path, tmp_path: Path) -> None:
    tests = [str(folder / "tests") for folder in written.values()]
    done = run_pytest(tmp_path, site, "-q", "-p", "no:cacheprovider", "-W", "error", *tests)
    assert done.returncode == 0, done.stdout
    checks = sum(len(case_of(kind).checks) for kind in NAMES)
    assert f"{checks + len(NAMES)} passed" in done.stdout  # every package has one more test


@pytest.mark.long
def test_new_plugins_pass_their_checks_and_give_rows_as_they_are(vibench: Vibench, site: Path, tmp_path: Path) -> None:
    # one by the command; the tests of the packages above run the checks of all of them
    done = vibench(tmp_path, "check", "my-rope", plugins=site)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert "problem 'my-rope'" in done.stdout
    assert "passed, 0 failed, 0 skipped" in done.stdout
    axes = {axis: [NAMES[kind]] for axis, kind in (("problem", "problem"), ("dual", "dual"), ("primal", "primal"))}
    axes |= {"solvers": [NAMES["solver"]], "formulation": [NAMES["formulation"]]}
    study = wire_study(**axes, tolerances=[{"pod": [1e-3], "dual": [1e-2], "primal": {"tied": [0.5]}}])
    done = vibench(tmp_path, "run", write_study(tmp_path, study), "--out", "out", "--jobs", "1", plugins=site)
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = rows(tmp_path / "out")
    assert (row["status"], row["queries_ok"]) == ("ok", row["queries"])
    assert row["error_u_mean"] < 0.01
    assert row["enrichment"] > 0


def test_new_packages_register_their_plugin_and_keep_to_ruff(written: dict[str, Path]) -> None:
    for kind, folder in written.items():
        project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
        assert list(project["entry-points"]) == [CHECKED[kind].entry_points]
        ((name, value),) = project["entry-points"][CHECKED[kind].entry_points].items()
        assert folder.name == project["name"] == f"vibench-{name}" == f"vibench-{NAMES[kind]}"
        module, cls = value.split(":")
        source = scaffold.module_file(folder, CHECKED[kind], name)
        assert source == folder / "src" / f"{module.replace('.', '/')}.py"
        assert f"{'def' if kind == 'solver' else 'class'} {cls}(" in source.read_text()
    rules = ["--isolated", "--no-cache", "--line-length", "110", "--select", "E,F,W,I,UP,B"]
    for folder in written.values():
        command = [sys.executable, "-m", "ruff", "check", *rules, "."]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


def test_the_command_says_what_to_do_next(main: Main) -> None:
    out = succeeded(main("new", "dual", "my-cone", "--out", "below/here"))
    folder = Path("below/here/vibench-my-cone")
    assert folder.is_dir()
    assert f"pip install -e {folder}\n" in out
    assert "vibench check dual:my-cone\n" in out
    assert str(folder / "src/vibench_my_cone/strategy.py") in out


BAD = ["", "Rope", "1rope", "rope_1", "rope-", "-rope", "my--rope", "ro pe", "../rope", "röpe", "rope\n", "a" * 41]


@given(st.from_regex(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", fullmatch=True) | st.text(max_size=12))
@settings(max_examples=8)
def test_a_name_that_is_accepted_is_good_everywhere(name: str) -> None:
    try:
        scaffold.check_name(PluginKind.DUAL, name)
    except RequestError:
        return
    assert f"vibench_{name.replace('-', '_')}".isidentifier()
    assert name == name.lower() == name.strip()
    assert name.isascii()


def test_names_and_places_that_are_taken_are_refused_and_kept(main: Main, tmp_path: Path) -> None:
    taken = next(iter(registered(PluginKind.PROBLEM)))
    refused(main("new", "problem", taken), f"there is a problem '{taken}' already", "choose another name")
    refused(main("new", "solver", "piqp"), "there is a QP solver 'piqp' already", "choose another name")
    refused(main("new", "primal", "strategies"), "vibench itself has a package of that name")
    refused(main("new", "stage", "rope"), "stage", "problem")
    for name in BAD:
        refused(main("new", "problem", "--", name), "cannot be the name of a plugin", "such as 'my-problem'")
    assert list(Path.cwd().iterdir()) == []
    assert main("new", "dual", taken)[0] == 0
    Path("vibench-rope").mkdir()
    Path("vibench-rope/notes.txt").write_text("precious")
    refused(main("new", "problem", "rope"), "'vibench-rope' exists already", "--out")
    assert Path("vibench-rope/notes.txt").read_text() == "precious"
    Path("file").touch()
    refused(main("new", "problem", "rope", "--out", "file"), "'file' is a file; expected a folder")
    refused(main("new", "problem", "rope", "--out", "file/below"), "'file/below' cannot be made")
    assert {path.name for path in Path.cwd().iterdir()} == {"vibench-rope", "file", f"vibench-{taken}"}
    into = ("--out", str(tmp_path / "out"))
    for what in ("study", "pack"):
        assert main("new", what, "mine", *into)[0] == 0
        refused(main("new", what, "mine", *into), "exists already")
        refused(main("new", what, "Not a name", *into), "lower case letters", f"'my-{what}'")
    refused(main("new", "study", "quick", *into), "there is a study 'quick' already")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"mine", "mine.toml"}


def test_nothing_is_left_of_a_package_that_could_not_be_written(main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    full = [None, None, OSError(28, "No space left on device")]
    monkeypatch.setattr(Path, "write_text", Mock(side_effect=full))
    code, out, err = main("new", "problem", "rope")
    assert (code, out, err) == (1, "", "vibench: 'vibench-rope' cannot be written: No space left on device\n")
    assert list(Path.cwd().iterdir()) == []


def test_new_studies_have_cells_and_scripts_of_new_packs_write_them(main: Main) -> None:
    assert succeeded(main("new", "study", "my-study")).splitlines()[1] == "  vibench run my-study.toml --dry-run"
    assert succeeded(main("run", "my-study.toml", "--dry-run")).splitlines()[-1] == "12 cells"
    _, out, _ = main("new", "pack", "my-model")
    script, check = (line.split()[1:] for line in out.splitlines()[1:])
    assert check == ["pack", "my-model"]
    subprocess.run([sys.executable, "-W", "error", *script], check=True, timeout=300)
    assert succeeded(main("pack", "my-model")).splitlines()[0] == "my-model"
    pack = create("problem", "pack", {"path": "my-model"})
    assert HighFidelitySolver(pack).solve(np.array([4.0, 0.1])).lam.any()
    assert [output.name for output in pack.outputs] == ["mean deflection"]
