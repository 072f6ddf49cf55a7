"""The report: whole, self-contained, and alive in a real browser at desktop and phone width."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from markupsafe import escape
from outputs import clean, elements
from running import Changed

from vibench.report import html
from vibench.report.figures import drawings
from vibench.report.findings import findings
from vibench.results import tables
from vibench.results.columns import TABLES
from vibench.results.database import FILE
from vibench.text import brief

REQUIRED = "VIBENCH_NEEDS_BROWSER"
"""Where this is set, a missing browser is a failure."""

PROBE = """
<script>
  window.seen = [];
  addEventListener("error", event => window.seen.push(String(event.message)), true);
</script>
"""

OBSERVE = """
<script>
addEventListener("load", () => {
  const table = document.querySelector("#summary table"), column = [...table.tHead.rows[0].cells]
    .findIndex(cell => cell.textContent.trim() === "error u");
  const values = () => [...table.tBodies[0].rows].map(row => Number(row.cells[column].dataset.value));
  const sorts = [];
  for (let k = 0; k < 2; k++) {
    table.tHead.rows[0].cells[column].querySelector("button").click();
    sorts.push(values());
  }
  const out = document.createElement("pre");
  out.id = "observed";
  out.textContent = JSON.stringify({
    errors: window.seen, sorts, wide: document.documentElement.scrollWidth, window: innerWidth,
    figures: [...document.images].map(image => [image.closest("figure").id, image.naturalWidth, image.width]),
    sections: [...document.querySelectorAll("section")].map(section => [section.id, section.offsetHeight]),
  });
  document.body.append(out);
});
</script>
"""


@pytest.fixture(scope="module")
def made(quick_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a real run."""
    return html.write(quick_run / FILE, tmp_path_factory.mktemp("report") / "report.html")


@pytest.fixture
def browser() -> str:
    """A Chromium on this machine."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        reason = "no Chromium is installed, which Debian's package 'chromium' provides"
        if os.environ.get(REQUIRED):
            pytest.fail(reason)
        pytest.skip(reason)
    return found


@pytest.mark.parametrize("width", [1280, 500])
def test_a_browser_shows_all_of_it_without_an_error(
    width: int, browser: str, made: Path, quick_run: Path, tmp_path: Path
) -> None:
    page = made.read_text(encoding="utf-8")
    probed = tmp_path / "report.html"
    probed.write_text(page.replace("<head>", "<head>" + PROBE).replace("</body>", OBSERVE + "</body>"), "utf-8")
    command = [
        browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
        f"--window-size={width},900", f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=10000",
        "--host-resolver-rules=MAP * ~NOTFOUND", probed.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert not [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    found = re.search(r'<pre id="observed">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, "the page's load event never came"
    seen = json.loads(found[1].replace("&gt;", ">").replace("&lt;", "<").replace("&amp;", "&"))
    assert seen["errors"] == []
    assert seen["wide"] <= seen["window"]  # nothing but tables and figures scrolls, inside themselves
    drawn = [name for name, _, _ in drawings(quick_run / FILE) if (quick_run / "figures" / f"{name}.svg").exists()]
    assert [name for name, _, _ in seen["figures"]] == drawn
    assert all(natural > 100 and shown > 100 for _, natural, shown in seen["figures"])
    rising, falling = seen["sorts"]
    assert rising == sorted(rising) != falling
    assert falling == sorted(falling, reverse=True)
    assert all(height > 0 for _, height in seen["sections"])


class Links(HTMLParser):
    """Everything that a page would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.targets: list[str] = []
        self.ids: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "src" or (name == "href" and tag == "link"):
                self.sources.append(str(value))
            elif name == "href":
                self.targets.append(str(value))
            elif name == "id":
                self.ids.append(str(value))


def test_it_needs_nothing_but_itself(made: Path) -> None:
    page = made.read_text(encoding="utf-8")
    links = Links()
    links.feed(page)
    assert links.sources
    assert all(source.startswith("data:") for source in links.sources)
    assert all(target.startswith("#") and target[1:] in links.ids for target in links.targets)
    assert "@import" not in page
    assert "url(" not in page.split("</style>")[0]


def test_findings_tables_and_facts_are_in_it(made: Path, quick_run: Path) -> None:
    page = made.read_text(encoding="utf-8")
    for texts in findings(quick_run / FILE).values():
        assert [text for text in texts if text not in page] == []
    cells = tables.read(quick_run / FILE, "cells")
    assert cells["machine"].iloc[0] in page
    assert page.count("<tr>") > len(cells)
    assert "None: every query of every cell is ok." in page


def test_every_failure_has_its_reason_and_nothing_is_markup(changed: Changed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(html, "drawings", lambda _: iter(()))
    reason = "<script>alert(''the solver said & did nothing'')</script>"
    results = changed(
        f"UPDATE cells SET status = 'failed', reason = '{reason}' WHERE solver = 'osqp'",
        "UPDATE queries SET status = 'failed', reason = 'one of many' WHERE solver = 'osqp' AND query = 5",
        "INSERT INTO pictures (problem, problem_options, number, reason) VALUES ('wire', '{}', 0, 'no <mesh>')",
    )
    failed = int((tables.read(results, "cells")["solver"] == "osqp").sum())
    page = html.page(results)
    assert page.count("&lt;script&gt;alert(&#39;the solver said &amp; did nothing&#39;)&lt;/script&gt;") >= failed
    assert "<script>alert" not in page
    assert f"{failed} cells are not ok." in page
    assert page.count("one of many") >= failed
    assert page.count("no picture of ") == 1
    assert "no picture of wire: no &lt;mesh&gt;" in page


@pytest.mark.parametrize(
    "label", ["</script><script>alert(1)</script>", "<img src=x onerror=alert(1)>", '" onclick="x']
)
def test_a_label_is_no_markup_wherever_it_stands(label: str, changed: Changed, monkeypatch: pytest.MonkeyPatch) -> None:
    """In tables, attributes, findings and facts, those that come from JSON included."""
    monkeypatch.setattr(html, "drawings", lambda _: iter(()))
    plain = elements(html.page(changed()))
    label += "\x1b[31m\n\ud800"
    known = json.dumps({"name": label, "seed": label})
    axes = [
        f"UPDATE {table} SET {axis} = '{brief(label)}'"
        for table in ("cells", "queries", "histories", "thresholds", "disagreements")
        for axis in ("problem", "dual", "primal", "solver")
        if axis in TABLES[table]
    ]
    results = changed(
        *axes,
        f"UPDATE meta SET value = '{known}' WHERE key = 'study'",
        f"UPDATE cells SET versions = '{known}', reason = 'a' || char(27) || char(7), status = 'failed'",
    )
    page = html.page(results)
    assert elements(page) <= plain | {"td.class", "p.class", "h3"}
    assert page.count("<script") == page.count("</script") == 1
    assert clean(page)
    assert escape(brief(label)) in page


def test_a_run_without_any_query_has_a_report(changed: Changed) -> None:
    emptied = [f"DELETE FROM {name}" for name in ("queries", "thresholds", "disagreements", "histories", "pictures")]
    lost = "UPDATE cells SET status = 'unavailable', reason = 'not installed', queries_ok = 0, online_s = NULL"
    page = html.page(changed(*emptied, lost))
    assert "There is nothing to draw" in page
    assert "0 with every query ok" in page


def test_a_strategy_that_is_labelled_high_fidelity_is_no_high_fidelity_model(changed: Changed) -> None:
    path = changed("UPDATE thresholds SET primal_a = 'high-fidelity'")
    thresholds = tables.read(path, "thresholds")
    found = {name: len(rows) for name, _, _, rows in html._tables(path, tables.read(path, "cells"))}
    assert found["enrichments"] == thresholds["cell_a"].notna().sum() > 0
    assert found["model"] == thresholds["cell_a"].isna().sum() > 0
