import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markupsafe import escape
from outputs import Links, clean, elements
from running import Changed, Main

from vibench import Run
from vibench.report import html
from vibench.report.findings import findings
from vibench.report.plots import short
from vibench.results.formats import cell_text
from vibench.results.read import in_order, read_table
from vibench.results.schema import STORED, TABLES
from vibench.results.sqlite import FILE
from vibench.text import brief

FEW = "DELETE FROM cells WHERE problem = 'hertz' OR dual = 'cpg'"


def test_it_needs_nothing_but_itself_and_says_what_headings_and_pictures_mean(made: Path) -> None:
    page = made.read_text(encoding="utf-8")
    links = Links(page)
    tables_of_cells = [target for target in links.targets if target.startswith("#summary?q=")]
    assert len(tables_of_cells) >= len({*tables_of_cells}) > 2
    assert links.sources
    assert all(source.startswith("data:") for source in links.sources)
    assert all(target.startswith("#") and target[1:].split("?")[0] in links.ids for target in links.targets)
    assert "@import" not in page
    assert "url(" not in page.split("</style>")[0]
    grids = data(page, "table-data").values()
    meant = {column["name"]: column["meaning"] for grid in grids for column in grid["columns"]}
    assert {name for name, meaning in meant.items() if not meaning} == set()
    assert meant["error λ"].startswith(f"{STORED['cells']['error_lambda_mean'].meaning} [1]")
    (caption,) = re.findall(r'href="#obstacle-answer">#</a> (.+?)</figcaption>', page)
    (alternative,) = re.findall(r'<figure id="obstacle-answer".*?<img [^>]*alt="([^"]+)"', page, re.DOTALL)
    assert len(alternative) > 40
    assert caption.startswith(alternative)
    assert caption != alternative


@given(st.floats(1e-9, 1e9))
@example(3.3049998)
@example(123456.4)
def test_numbers_of_the_page_are_those_of_other_tables_though_they_are_rounded_twice(value: float) -> None:
    for digits in (4, 6):
        shown = short(value, digits)
        assert isinstance(shown, float | int)
        assert cell_text(float(shown)) == cell_text(value)


def data(page: str, name: str) -> Any:
    return json.loads(page.split(f'id="{name}">')[1].split("</script>", maxsplit=1)[0])


def test_findings_tables_and_facts_are_in_it_and_first_rows_without_javascript(made: Path, reported: Path) -> None:
    page = made.read_text(encoding="utf-8")
    verdicts = [str(one) for one in Run(reported / FILE).verdict]
    assert len(verdicts) == 2
    assert [text for text in [*findings(reported / FILE), *verdicts] if text not in page] == []
    places = [page.index(f'id="{name}"') for name in ("verdict", "leaderboard", "findings", "summary")]
    assert places == sorted(places)
    cells = read_table(reported / FILE, "cells")
    assert cells["machine"].iloc[0] in page
    embedded = data(page, "table-data")["summary"]
    assert embedded["rows"] == len(cells)
    break_even = data(page, "table-data")["model"]
    assert {"break-even", "interval"} <= {column["name"] for column in break_even["columns"]}
    assert {"problem", "solver"} <= {*break_even["axes"]}
    assert {"break-even", "interval"}.isdisjoint(break_even["axes"]), "results, not axes of the study"
    whole = {column["name"]: column for column in embedded["columns"]}
    assert whole["error λ"]["numbers"] == pytest.approx(in_order(cells)["error_lambda_mean"].tolist(), rel=1e-5)
    assert "None: every query of every cell is ok." in page
    (table,) = re.findall(r'data-table="summary"></div>\n<noscript>(.*?)</noscript>', page, re.DOTALL)
    assert table.count("<tr>") == 1 + min(len(cells), 50)
    assert "error λ</th>" in table
    assert all(f"<td>{value:.3g}</td>" in table for value in cells["error_lambda_mean"][:50])
    assert len(re.findall("<noscript>.*?<table>.*?</noscript>", page, re.DOTALL)) == page.count("data-table=")


def test_without_pictures_all_else_is_in_it(made: Path, reported: Path, tmp_path: Path, main: Main) -> None:
    target = tmp_path / "plain.html"
    code, printed, _ = main("report", str(reported), "--no-figures", "--out", str(target))
    assert (code, printed) == (0, f"report: {target}\n")
    whole, page = (file.read_text(encoding="utf-8") for file in (made, target))
    assert "<img" in whole
    assert "<img" not in page
    assert "The pictures were left out; <code>vibench figures</code> draws them as files." in page
    for name in ("table-data", "plot-data"):
        assert data(page, name) == data(whole, name)
    assert page.count("data-plot=") == len(data(page, "plot-data")) == 2
    assert page.split('<section id="overview">')[1] == whole.split('<section id="overview">')[1]


def test_every_failure_has_its_reason_and_a_run_without_queries_a_report(changed: Changed) -> None:
    reason = "<script>alert(''the solver said & did nothing'')</script>"
    results = changed(
        FEW,
        f"UPDATE cells SET status = 'failed', reason = '{reason}' WHERE solver = 'osqp'",
        "UPDATE queries SET status = 'failed', reason = 'one of many' WHERE solver = 'osqp' AND query = 5",
        "INSERT INTO pictures (problem, problem_options, number, reason) VALUES ('wire', '{}', 0, 'no <mesh>')",
    )
    failed = int((read_table(results, "cells")["solver"] == "osqp").sum())
    page = html.page(results, figures=False)
    assert "<script>alert" not in page
    embedded = data(page, "table-data")
    (column,) = [column for column in embedded["failed"]["columns"] if column["name"] == "reason"]
    assert embedded["failed"]["rows"] == failed
    assert {*column["levels"]} == {reason.replace("''", "'")}
    assert f"{failed} cells are not ok." in page
    assert embedded["failed-queries"]["rows"] >= failed
    assert "one of many" in str(embedded["failed-queries"])
    assert page.count("no picture of ") == 1
    assert "no picture of wire: no &lt;mesh&gt;" in page
    emptied = [f"DELETE FROM {name}" for name in ("queries", "thresholds", "disagreements", "histories", "pictures")]
    lost = "UPDATE cells SET status = 'unavailable', reason = 'not installed', queries_ok = 0, online_s = NULL"
    page = html.page(changed(*emptied, lost))
    assert "<img" not in page
    assert "0 with every query ok" in page
    assert page.count("No cell of this problem has every query ok") == 2
    assert data(page, "plot-data") == {}


def test_a_label_is_no_markup_wherever_it_stands(changed: Changed) -> None:
    """In tables, attributes, findings and facts, those that come from JSON included."""
    plain = elements(html.page(changed(FEW), figures=False))
    label = '</script><script>alert(1)</script><img src=x onerror=alert(1)>" onclick="x\x1b[31m\n\ud800'
    known = json.dumps({"name": label, "seed": label})
    tables = ("cells", "queries", "histories", "thresholds", "disagreements")
    axes = [(table, axis) for table in tables for axis in ("problem", "dual", "primal", "solver")]
    axes = [f"UPDATE {table} SET {axis} = '{brief(label)}'" for table, axis in axes if axis in STORED[table]]
    failed = f"UPDATE cells SET versions = '{known}', reason = 'a' || char(27) || char(7), status = 'failed'"
    results = changed(FEW, *axes, f"UPDATE meta SET value = '{known}' WHERE key = 'study'", failed)
    page = html.page(results, figures=False)
    assert elements(page) <= plain | {"td.class", "p.class", "h3", "h3.id"}
    assert page.count("<script") == page.count("</script") == 4
    assert clean(page)
    assert brief(label) in data(page, "table-data")["failed"]["columns"][1]["levels"]
    assert escape(brief(label)) in page


def test_a_label_that_names_the_high_fidelity_model_is_no_model(changed: Changed) -> None:
    path = changed("UPDATE thresholds SET primal_a = 'high-fidelity'")
    read = {name: read_table(path, name) for name in TABLES}
    thresholds = read["thresholds"]
    found = {grid.name: len(grid.frame) for grid in html._grids(read)}
    assert found["enrichments"] == thresholds["cell_a"].notna().sum() > 0
    assert found["model"] == thresholds["cell_a"].isna().sum() > 0


def test_only_rows_of_a_disturbed_machine_are_marked_and_undecided_answers_are_shown(changed: Changed) -> None:
    calm = (FEW, "UPDATE cells SET disturbed = 0")
    undecided = "UPDATE thresholds SET meaning = 'undecided', benefit_threshold = NULL, threshold_low = 7"
    page = html.page(changed(*calm, undecided), figures=False)
    assert "break-even" not in data(page, "table-data")["model"]["hidden"], "an interval would read like a result"
    assert "marks rows" not in page
    assert data(page, "table-data")["summary"]["disturbed"] == []
    path = changed(*calm, "UPDATE cells SET disturbed = 1 WHERE rowid IN (SELECT rowid FROM cells LIMIT 2)")
    page = html.page(path, figures=False)
    keys = in_order(read_table(path, "cells"))
    embedded = data(page, "table-data")
    assert embedded["summary"]["disturbed"] == list(keys.index[keys["disturbed"] == 1])
    assert len(embedded["summary"]["disturbed"]) == 2
    assert page.count("marks rows") == sum(bool(table["disturbed"]) for table in embedded.values())
