import shlex
from pathlib import Path
from typing import Any

import pytest
import typer.main
from running import Main, succeeded
from samples import cell_row

from vibench.cli.console import run_argument
from vibench.cli.main import app
from vibench.cli.run_command import failures, next_steps, print_summary
from vibench.results.database import ResultsDatabase
from vibench.results.ranking import no_best_cell
from vibench.results.sqlite import FILE

Captured = pytest.CaptureFixture[str]


def row(cell: str, reason: str, status: str = "inaccurate", **more: Any) -> dict[str, Any]:
    own = {"problem": "box", "dual": "cpg", "primal": "pga", "primal_tol": 0.5, "pod_tol": 1e-3, "dual_size": 4,
           "solver": "osqp", "accuracy": 1e-8, "assembly": "reduced", "correction": "none", "queries": 16,
           "queries_ok": 15}  # fmt: skip
    return cell_row(**own | {"pod_size": None, "cell": cell, "reason": reason, "status": status} | more)


def test_every_reason_has_a_line_and_what_to_do_next_is_a_command(capsys: Captured) -> None:
    """Reasons that differ in their numbers alone are one; there are never more lines than reasons that matter."""
    rows = [row(f"c{k}", f"{k} of 16 queries, first mu=({k}.5, -1e-0{k}): gap residual {k}.1e-07") for k in range(1, 9)]
    line, other = failures([row("c0", "broke"), *rows], "runs/a")
    assert line.startswith("8 cells inaccurate: the first is c1, ")
    assert other.startswith("inaccurate: c0, ")  # the reason of most cells comes first
    (line,) = failures([row("c1", "broke", "error")], "runs/a")
    axes = "box (text) · cpg · pga 0.5 · 0.001, R=4 · osqp 1e-08 · reduced"
    assert line == f"error: c1, {axes}: 15 of 16 queries ok; broke"
    missing = "the QP solver 'ecos' is not installed: `pip install ecos`"
    (line,) = failures([row(f"c{k}", missing, "unavailable") for k in range(24)], "runs/a")
    assert line == f"24 cells unavailable: {missing}"
    lines = list(failures([row(f"c{k}", "a" * k, "error") for k in range(1000)], "runs/a"))
    assert len(lines) == 11
    assert lines[-1] == "990 cells not ok for 990 other reasons"
    missed = row("c1", "dual residual 3.5e-09", model="m")
    others = [
        row("c2", "", "ok", model="m", solver="quadprog"), row("c3", "", "ok", model="m", solver="proxqp"),
        row("c4", "", "ok", model="other", solver="piqp"), row("c5", "", "ok", model="m", solver="scs", accuracy=1e-3),
    ]  # fmt: skip
    (line,) = failures([missed, *others], "runs/a")
    assert line.endswith("dual residual 3.5e-09; ok with proxqp, quadprog")
    (line,) = failures([missed, *others[2:]], "runs/a")
    assert line.endswith("dual residual 3.5e-09; `vibench replay runs/a c1` tries other solvers")
    group: Any = typer.main.get_command(app)
    next_steps(Path("a folder's"), all_ok=True)
    next_steps(Path("a folder's"), all_ok=False)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  vibench ")]
    assert len(lines) == 4
    for line in lines:
        program, command, *arguments = shlex.split(line.strip().split("  ")[0])
        assert program == "vibench"
        context = group.get_command(None, command).make_context(command, arguments)
        assert "a folder's" in (context.params.get("run"), *context.params.get("names", ()))
    assert run_argument(Path("runs/quick")) == "quick"
    assert run_argument(Path("other/quick")) == "other/quick"
    for length in range(1, 27):  # fits 80 columns; a command alone may be longer: it stays one line to copy
        next_steps(Path("r" * length), all_ok=False)
        lines = capsys.readouterr().out.splitlines()
        assert max(len(line) for line in lines if not line.endswith("\"status != 'ok'\"")) <= 80
        assert [line.strip() for line in lines].count("what is not ok") == 1


def end_of_run(folder: Path, rows: list[dict[str, Any]]) -> None:
    made = ResultsDatabase(folder, {"name": "sample"})
    for one in rows:
        made.write_cell(one, [])
    made.close()
    print_summary(folder / FILE, rows)


def test_a_run_of_which_no_cell_is_the_best_says_why(tmp_path: Path, main: Main, capsys: Captured) -> None:
    end_of_run(tmp_path / "run", [row(f"c{k}", "broke", fallbacks="one; two" * (k == 3)) for k in range(21)])
    said, *_, noted, counted = capsys.readouterr().out.splitlines()
    assert noted == "1 of 21 cells deviate from their algorithm (column fallbacks): one; two"
    assert "No model of this run takes part" in said
    assert counted == "21 cells, 0 ok, 21 not ok"
    out = succeeded(main("show", str(tmp_path / "run"), "--table", "best"))
    assert out.splitlines() == ["run: best: no rows", no_best_cell()]
    for table in ("summary", "best"):
        _, out, _ = main("show", str(tmp_path / "run"), "--table", table, "--where", "problem = 'none'")
        assert out.splitlines() == [f"run: {table}: no rows"]


def test_rows_that_differ_in_options_alone_say_which(tmp_path: Path, main: Main) -> None:
    """Options that have one value for a name are not said, nor are those of a name that tells its rows apart."""
    options = ('{"tolerance": 0.1, "size": 9}', '{"tolerance": 0.01, "size": 9}', '{"size": 9}')
    fine = {"status": "ok", "queries_ok": 16, "training": "greedy", "dual": "cpg", "dual_options": '{"k": 2}'}
    rows = [row(f"c{k}", "", training_options=text, **fine) for k, text in enumerate(options)]
    rows.append(row("c4", "", **fine | {"training": "random", "training_options": '{"size": 3}'}))
    rows.append(row("c5", "", **fine | {"problem": "rope", "problem_options": "{}", "training": "y"}))
    rows.append(row("c6", "", **fine | {"problem": "rope", "problem_options": '{"mesh": "fine"}', "training": "x"}))
    end_of_run(tmp_path / "run", rows)
    _, shown, _ = main("show", str(tmp_path / "run"))
    assert all(f"greedy{more}" in shown for more in (" tolerance 0.1 ", " tolerance 0.01 ", "   "))
    assert "rope mesh fine" in shown
    assert not {"size", "k"} & set(shown.split())
    _, out, _ = main("show", str(tmp_path / "run"), "--limit", "1", "--where", "training_options like '%0.01%'")
    assert "training greedy tolerance 0.01" in out
    _, out, _ = main("show", str(tmp_path / "run"), "--format", "csv", "--columns", "training")
    assert set(out.split()) == {"training", "greedy", "random", "x", "y"}
