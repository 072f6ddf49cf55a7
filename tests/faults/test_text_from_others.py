"""Text from others is data: whatever plugins, solvers, studies and results files say, a run ends and nothing acts."""

import shutil
from pathlib import Path
from typing import Any

import fake_plugins
import odd_plugins
import pytest
from odd_plugins import LABEL, ODD
from outputs import clean, elements
from running import Vibench, rows
from samples import install, wire_study, write_study

from vibench.results import pictures
from vibench.results.sqlite import FILE
from vibench.text import LONGEST, printable

PLUGINS = {
    "vibench.problems": {"odd-wire": "OddWire"},
    "vibench.dual_strategies": {"odd-cone": "OddCone"},
    "vibench.primal_strategies": {"odd-enrichment": "OddEnrichment"},
    "vibench.qp_solvers": {
        "odd-raises": "raises", "odd-unreadable": "raises_unreadably", "odd-gives-up": "gives_up",
        "odd-counts": "counts_far",
    },
}  # fmt: skip

STUDY = wire_study(
    problem=[{"name": "odd-wire", "label": LABEL}], dual=["odd-cone", {"name": "cpg", "label": f"@{LABEL}"}],
    primal=[{"name": "odd-enrichment", "label": f"_{LABEL}"}, "decorrelated"],
    solvers=[*PLUGINS["vibench.qp_solvers"], "piqp"], accuracy=1e-10, timing_rounds=2,
)  # fmt: skip
"""What goes wrong comes first; the solver has no part in errors, or figures would leave all cells out."""


@pytest.fixture(scope="module")
def plugins_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the third-party package is installed; the plugins it is derived from are not registered."""
    folder = install(tmp_path_factory.mktemp("third-party") / "site", odd_plugins, PLUGINS)
    shutil.copy(str(fake_plugins.__file__), folder)
    return folder


@pytest.fixture(scope="module")
def ended(vibench: Vibench, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("odd")
    done = vibench(folder, "run", write_study(folder, STUDY), "--jobs", "1", "--out", "run", figures=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    return folder, done.stdout


def by_strategies(run: Path, table: str) -> dict[tuple[str, str, str], list[dict[str, Any]]]:
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows(run, table):
        found.setdefault((row["dual"], row["primal"], row["solver"]), []).append(row)
    return found


@pytest.mark.long
def test_the_run_ends_with_a_row_for_every_cell_and_printable_names(ended: tuple[Path, str]) -> None:
    cells = {key: found for key, (found,) in by_strategies(ended[0] / "run", "cells").items()}
    cpg, own = printable(f"@{LABEL}"), printable(f"_{LABEL}")
    assert len(cells) == 20
    assert {row["problem"] for row in cells.values()} == {printable(LABEL)}
    for (dual, primal, solver), row in cells.items():
        if dual != cpg:
            expected = (
                "error",
                f"in cone: the dual strategy 'odd-cone' raised OddError: {printable(' '.join(ODD.split()))}xxx",
            )
        else:
            expected = {
                "odd-raises": ("failed", "3 of 3 queries, first mu="),
                "odd-unreadable": ("failed", "3 of 3 queries, first mu="),
                "odd-gives-up": ("failed", "3 of 3 queries, first mu="),
            }.get(solver, ("ok", ""))
        assert (row["status"], row["reason"][: len(expected[1])]) == expected, (dual, primal, solver)
        assert len(row["reason"]) <= 2 * LONGEST
        if row["status"] == "ok" and primal == own:
            assert row["fallbacks"].startswith(printable(ODD))
            assert len(row["fallbacks"]) == 2 * LONGEST
    unreadable = cells[cpg, "decorrelated", "odd-unreadable"]
    assert unreadable["reason"].endswith("UnreadableError: its message cannot be read")
    queries = by_strategies(ended[0] / "run", "queries")
    # Iterations that are no number of them are missing, and nothing else is.
    pairs = zip(queries[cpg, "decorrelated", "odd-counts"], queries[cpg, "decorrelated", "piqp"], strict=True)
    for odd, plain in pairs:
        assert (odd["status"], odd["iterations"]) == ("ok", None)
        assert odd["solver_status"] == printable(" ".join(ODD.split()))
        assert plain["iterations"] > 0
        assert odd["error_u"] == pytest.approx(plain["error_u"], rel=1e-3)
    run = ended[0] / "run"
    known = {row["quantity"]: row["value"] for row in rows(run, "histories") if row["step"] == 0}
    quantity = printable(" ".join(ODD.split()))
    assert known[quantity] in (float(2**70), float(2**80))
    assert known["-"] == 0.0
    shown = list(pictures.read(run / FILE))
    assert {one.reason for one in shown} == {""}
    assert {one.picture.name for one in shown if one.picture is not None} == {quantity}
    assert len(shown) == 3


@pytest.mark.long
def test_whatever_is_printed_and_written_is_printable_and_resumed(ended: tuple[Path, str], vibench: Vibench) -> None:
    folder, printed = ended
    run = folder / "run"
    before = rows(run)
    done = vibench(folder, "run", "study.toml", "--jobs", "1", "--out", "run")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("20 cells, 0 to run, 0 stages\n")
    assert rows(run) == before
    written = [*(run / "tables").iterdir(), *(run / "figures").glob("*.svg")]
    assert len(list((run / "figures").glob("*.png"))) == 1
    texts = [printed, *(path.read_text(encoding="utf-8") for path in written)]
    assert (run / FILE).stat().st_size < 5_000_000
    cell = next(row["cell"] for row in rows(run) if (row["solver"], row["status"]) == ("odd-counts", "ok"))
    commands = [["report", "run"], ["compare", "run", "run"], ["replay", "run", cell]]
    commands += [["run", "study.toml", "--dry-run"]]
    commands += [["show", "run", "--table", table] for table in ("benefits", "queries")]
    commands += [["show", "run", "--format", form] for form in ("markdown", "csv", "latex", "json")]
    for command in commands:
        done = vibench(folder, *command)
        assert (done.returncode, done.stderr) == (0, ""), command
        texts.append(done.stdout)
    assert [text for text in texts if not clean(text)] == []
    page = (run / "report.html").read_text(encoding="utf-8")
    assert clean(page)
    assert {"img.onerror", "b"} & elements(page) == set()
    assert page.count("<script") == page.count("</script") == 4
