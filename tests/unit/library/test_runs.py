import builtins
import signal
from html import escape
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import matplotlib.figure
import pandas as pd
import pytest
from rich import jupyter

import vibench
from vibench.execution import run as execution
from vibench.execution.run import Agenda, Observer
from vibench.library.progress import ProgressDisplay
from vibench.report import figures
from vibench.results import formats, show

SETTINGS: dict[str, Any] = {
    "name": "small", "problem": [{"name": "radial-obstacle", "options": {"resolution": 200}}], "dual": ["cpg", "mcpg"],
    "primal": ["decorrelated"], "solvers": ["piqp"], "validation": 2, "timing_rounds": 2,
    "tolerances": [{"pod": [1e-2], "dual": [1e-1]}],
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> vibench.Run:
    return vibench.run(vibench.Study(**SETTINGS), tmp_path_factory.mktemp("library") / "run", progress=False, jobs=1)


def following(**calls: Any) -> Mock:
    return Mock(spec=Observer, **calls)


def test_a_run_has_its_tables(run: vibench.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(run.cells) == 2
    assert set(run.cells["status"]) == {"ok"}
    assert len(run.queries) == 4
    assert set(run.histories["dual"].dropna()) == {"cpg", "mcpg"}
    assert len(run.thresholds)
    pd.testing.assert_frame_equal(run.summary, formats.summary(run.cells))
    assert run.study == {"name": "small", "seed": 0, "validation": 2}
    shown = run._repr_html_()
    assert run.study["name"] in shown
    assert shown.count("<tr") == len(run.summary) + 1
    assert all(f"<th>{escape(heading)}</th>" in shown for heading in run.summary.columns)
    # it is opened where it is
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "small").symlink_to(run.path.parent)
    for place in (run.path, str(run.path.parent), "small"):
        pd.testing.assert_frame_equal(vibench.open_run(place).cells, run.cells)
    with pytest.raises(vibench.RequestError, match="no results in 'large'"):
        vibench.open_run("large")


def test_a_run_is_continued_and_followed(run: vibench.Run, capsys: pytest.CaptureFixture[str]) -> None:
    observer = following()
    vibench.run(vibench.Study(**SETTINGS), run.path.parent, observer=observer)
    ((agenda,), _) = observer.start.call_args
    assert (agenda.to_run, observer.cell.call_count) == (0, 0)
    assert not capsys.readouterr().out
    vibench.run(vibench.Study(**SETTINGS), run.path.parent)
    assert "2 cells, 0 to run" in capsys.readouterr().out


def test_what_was_not_installed_is_run_once_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = vibench.Study(**SETTINGS | {"solvers": ["piqp", "daqp"]})
    with monkeypatch.context() as patch:
        patch.setattr(execution, "installed_solvers", lambda registered: ["piqp"])
        patch.setattr(execution.provenance, "solver_version", lambda solver: None)
        before = vibench.run(study, tmp_path, progress=False, jobs=1).cells
    assert dict(before.groupby("solver")["status"].agg(set)) == {"piqp": {"ok"}, "daqp": {"unavailable"}}
    observer = following()
    after = vibench.run(study, tmp_path, observer=observer, jobs=1).cells
    assert set(after["status"]) == {"ok"}
    assert observer.start.call_args[0][0].to_run == 2


def test_figures_and_findings_are_there_and_wrong_requests_one_line(run: vibench.Run) -> None:
    figure = run.figure("answer")
    assert isinstance(figure, matplotlib.figure.Figure)
    assert figure.axes
    assert run.findings[0].startswith("2 cells, 2 with every query ok")
    assert [one.problem for one in run.verdict] == ["radial-obstacle"]
    for kind, options, line in (
        ("anwser", {}, "no figure is called 'anwser'; did you mean 'answer'"),
        ("convergence", {"problem": "hertz"}, "no problem is called 'hertz'"),
        ("dimension", {}, "no figure is called 'dimension'"),
    ):
        with pytest.raises(vibench.RequestError, match=line):
            run.figure(kind, **options)
    for changes, line in (
        ({"problem": ["radial-obstacel"]}, "did you mean 'radial-obstacle'"),
        ({"validatoin": 3}, "no key is called 'validatoin'; did you mean 'validation'"),
        ({"validation": 0}, "validation: .*(found 0)"),
        ({"name": "../up"}, "name: letters, digits"),
        ({"primal": ["offline-pga"]}, "gives nothing for 'offline-pga'"),
    ):
        with pytest.raises(vibench.RequestError, match=line) as caught:
            vibench.Study(**SETTINGS | changes)
        assert "\n" not in str(caught.value)
    with pytest.raises(vibench.RequestError, match="no table is called 'cell'; did you mean 'cells'"):
        run.table("cell")
    with pytest.raises(vibench.RequestError, match="jobs is -1"):
        vibench.run(vibench.Study(**SETTINGS), jobs=-1)


def test_progress_in_a_notebook_is_lines(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    shell = type("ZMQInteractiveShell", (), {})
    monkeypatch.setattr(builtins, "get_ipython", shell, raising=False)
    shown: list[str] = []
    monkeypatch.setattr(jupyter, "display", lambda segments, text: shown.append(text))
    with ProgressDisplay() as display:
        display.start(Agenda(cells=2, to_run=2, unavailable=0, stages=(), workers=1))
        display.note("a line with <b> and [red]")
    assert [line.rstrip() for line in shown] == ["2 cells, 2 to run, 0 stages on 1 worker", "a line with <b> and [red]"]
    assert capsys.readouterr().out == ""  # a cell would show it again


def test_what_a_run_writes(run: vibench.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "KINDS", {"answer": figures.KINDS["answer"]})
    assert {file.name for file in run.write_tables(tmp_path / "tables")} == set(show.exported_files())
    drawn = run.write_figures(tmp_path / "figures")
    assert {file.suffix for file in drawn} == {".png", ".svg"}
    assert all(file.stat().st_size for file in drawn)
    for shown in (True, False):
        page = run.report(tmp_path / "page.html", figures=shown).read_text(encoding="utf-8")
        assert "radial-obstacle" in page
        assert ("<img" in page) == shown


def test_ctrl_c_raises_and_the_next_call_continues(tmp_path: Path) -> None:
    interrupting = following(**{"cell.side_effect": KeyboardInterrupt})
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="1 cells have no row yet"):
        vibench.run(vibench.Study(**SETTINGS), tmp_path, observer=interrupting, jobs=1)
    assert signal.getsignal(signal.SIGINT) is handler
    again = following()
    assert len(vibench.run(vibench.Study(**SETTINGS), tmp_path, observer=again).cells) == 2
    assert again.cell.call_count == 1
