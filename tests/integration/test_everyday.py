"""Everyday tasks of a new user, an author of a model and an engineer: a few commands at 80 columns each."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.cells import cell_len
from running import Main, Shared, refused, rows, succeeded

import vibench
from vibench.results.schema import STORED

STUDY = """
name = "mine"
seed = 1
validation = 4
accuracy = 1e-8
timing_rounds = 1
solvers = ["piqp"]
dual = ["mcpg"]
primal = ["decorrelated", "offline-pga"]
assembly = ["reduced"]
bounds = [false, true]
correction = ["none", "feasible"]

[[problem]]
name = "pack"
label = "my string"
options = { path = "my-model" }

[[tolerances]]
pod = [1e-3]
dual = [1e-2]
primal = { offline-pga = [0.5] }
"""


@pytest.fixture
def narrow(main: Main, monkeypatch: pytest.MonkeyPatch) -> Main:
    """The command line at 80 columns, which no line is wider than."""
    monkeypatch.setenv("COLUMNS", "80")

    def call(*arguments: str) -> tuple[int, str, str]:
        code, out, err = main(*arguments)
        if arguments[0] in {"show", "list", "help"}:
            assert max(map(cell_len, out.splitlines()), default=0) <= 80
        return code, out, err

    return call


@pytest.fixture
def home(main: Main, shared: Shared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of somebody who has made a pack, a study and a run, and works in it."""

    def make(folder: Path) -> None:
        folder.mkdir()
        monkeypatch.chdir(folder)
        assert main("new", "pack", "my-model")[0] == 0
        subprocess.run([sys.executable, "my-model/write.py"], check=True, timeout=300)
        (folder / "study.toml").write_text(STUDY)
        succeeded(main("run", "study.toml", "--jobs", "1", "--no-figures"))

    copy = shutil.copytree(shared("everyday", make), tmp_path / "home")
    monkeypatch.chdir(copy)
    return copy


def key(home: Path, **wanted: str) -> str:
    (cell,) = (row["cell"] for row in rows(home / "runs" / "mine") if wanted.items() <= row.items())
    return str(cell)


CERTIFIED = {"primal": "offline-pga", "bounds": 1, "correction": "none"}


class TestNewUser:
    def test_begin_a_study_of_a_problem_and_see_what_it_would_run(self, narrow: Main) -> None:
        _, out, _ = narrow("list", "problems")
        assert "radius from 0.7 to 1.3 m" in " ".join(out.split())
        _, out, _ = narrow("new", "study", "first")
        for step in out.splitlines()[1:2]:
            code, listed, _ = narrow(*step.split()[1:])
            assert (code, listed.splitlines()[-1]) == (0, "12 cells")

    def test_mend_a_study_file_by_what_is_said_of_it(self, narrow: Main) -> None:
        Path("study.toml").write_text(STUDY.replace("[[tolerances]]", "[tolerances]").replace("my-model", "none"))
        line = refused(narrow("run", "study.toml", "--dry-run"))
        wrong, right = line.split("write ")[1].strip().split(" in place of ")[::-1]
        Path("study.toml").write_text(Path("study.toml").read_text().replace(wrong, right))
        assert "none" in refused(narrow("run", "study.toml", "--dry-run"))  # the next mistake

    def test_which_model_is_which_in_a_table(self, home: Path, narrow: Main) -> None:
        _, out, _ = narrow("show", "mine")
        table = out.split("not shown")[0]
        assert all(table.count(word) >= 4 for word in ("feasible", "offline-pga", "decorrelated"))
        assert "bounds" in table
        assert "error λ" in table.replace("\n", " ")
        assert "offline" in table
        for row in rows(home / "runs" / "mine"):
            assert f"{row['error_lambda_mean']:.3g}" in table

    def test_what_a_column_means_and_all_of_one_row(self, home: Path, narrow: Main) -> None:
        cell = key(home, **CERTIFIED)
        _, out, _ = narrow("help", "error λ")
        assert STORED["cells"]["error_lambda_mean"].meaning in " ".join(out.split())
        _, out, _ = narrow("show", "mine", cell[:6])
        assert out.startswith(f"cell {cell} of mine\n")
        assert "beta_cone_lower_min" in out

    def test_read_the_report_without_javascript(self, home: Path, narrow: Main) -> None:
        assert narrow("report", "mine", "--no-figures")[0] == 0
        page = (home / "runs" / "mine" / "report.html").read_text(encoding="utf-8")
        plain = "".join(re.findall("<noscript>(.*?)</noscript>", page, re.DOTALL))
        assert all(row["cell"][:4] in plain for row in rows(home / "runs" / "mine"))
        assert f'title="{STORED["cells"]["error_lambda_mean"].meaning} [1]"' in plain


class TestAuthor:
    def test_what_can_be_done_with_a_pack(self, home: Path, narrow: Main) -> None:
        _, out, _ = narrow("pack", "my-model")
        text = " ".join(out.split())
        assert "mean deflection" in text
        assert "interpolates" not in text  # all members are declared

    def test_put_the_pack_elsewhere(self, home: Path, narrow: Main) -> None:
        elsewhere, cell = home.parent / "strings", key(home, **CERTIFIED)
        (home / "my-model").rename(elsewhere)
        out = succeeded(narrow("replay", "mine", cell, "--at", f"my-model={elsewhere}"))
        assert "piqp" in out
        manifest = elsewhere / "pack.toml"
        manifest.write_text(manifest.read_text().replace("upper = [4.0, 0.1]", "upper = [4.0, 0.2]"))
        assert narrow("replay", "mine", cell, "--at", f"my-model={elsewhere}")[0] == 2

    def test_a_model_in_a_notebook(self, home: Path) -> None:
        model = vibench.open_run("mine").model(key(home, **CERTIFIED))
        assert re.search(r"0x[0-9a-f]{6}", repr(model)) is None
        box = model.problem.parameters
        solution = model.solve(box.lower)
        assert solution.verdict is None or solution.verdict
        assert float(solution.assembly) > 0.0
        assert "<" in solution._repr_html_()
        table = model.solve_all(np.array([box.lower, box.upper]))
        assert len(table) == 2


class TestEngineer:
    @pytest.fixture
    def exported(self, home: Path, narrow: Main) -> Path:
        (home / "out").mkdir()
        out = succeeded(narrow("export", "mine", key(home, **CERTIFIED)[:8], "out/string.c"))
        assert re.search(r"query.*\bms\b", out, re.DOTALL)  # what it costs
        return home / "out"

    def test_the_script_answers_without_vibench(self, home: Path, exported: Path) -> None:
        model = vibench.open_run("mine").model(key(home, **CERTIFIED))
        mu = [3.0, 0.05]
        code = "import json, sys; sys.modules['vibench'] = None\nfrom reduced_model import Model\n"
        code += f"one = Model('string.npz').solve({mu})\nprint(json.dumps([one.status, one.outputs]))"
        done = subprocess.run([sys.executable, "-c", code], cwd=exported, capture_output=True, text=True, check=True)
        status, values = json.loads(done.stdout)
        assert status == "ok"
        expected = model.solve(np.array(mu)).outputs
        assert values == pytest.approx(expected, rel=1e-9)

    def test_the_licence_the_header_and_the_source_are_there_for_others_to_read(self, exported: Path) -> None:
        about = json.loads(str(np.load(exported / "string.npz")["about"]))
        assert about["source"]["licence"] == "unknown"
        assert {"string.npz", "string.c", "string.h", "reduced_model.py"} <= {path.name for path in exported.iterdir()}
        umask = os.umask(0o022)
        os.umask(umask)
        assert {(exported / name).stat().st_mode & 0o777 for name in ("string.npz", "string.c")} == {0o666 & ~umask}
