import contextlib
import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from browsing import FORMULA, PATIENCE, complaints, look, prefer
from many_cells import write_many
from selenium.common.exceptions import TimeoutException
from selenium.webdriver import ActionChains, Chrome
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from vibench.report import html
from vibench.results import formats
from vibench.results.read import in_order, read_table
from vibench.results.sqlite import FILE

MATTERS = {"cell", "problem", "dual", "primal", "δ", "solver", "error λ", "error u", "online [ms]", "offline [s]"}
"""Columns that are seen at 1280 pixels without scrolling."""

GEOMETRY = """
const outside = [], wide = document.documentElement.scrollWidth;
for (const one of document.querySelectorAll("main *, header *")) {
  const box = one.getBoundingClientRect();
  if (!box.width || one.closest(".wide, .picker div, .panels, figure:not(.screen)")) continue;
  if (box.right > innerWidth + 0.5 || box.left < -0.5) outside.push(one.outerHTML.slice(0, 80));
}
const wrapped = [...document.querySelectorAll("td.number, .n")].filter(one => {
  const range = document.createRange();
  range.selectNodeContents(one);
  return new Set([...range.getClientRects()].filter(r => r.width).map(r => Math.round(r.top / 8))).size > 1;
}).map(one => one.textContent);
const cut = [...document.querySelectorAll("td, th, .legend button, option, li, p")].filter(one =>
  one.offsetWidth && one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).overflowX === "hidden").length;
return { wide, outside, wrapped, cut, paper: getComputedStyle(document.body).backgroundColor };
"""

POINT = """
const view = [...Bokeh.index.roots].find(view => view.el.closest("#" + arguments[0]));
const shown = view.model.renderers.filter(one => one.visible);
const { data } = shown[arguments[1]].data_source;
const box = view.canvas_view.el.getBoundingClientRect();
const [x, y] = [view.frame.x_scale.compute(data.x[0]), view.frame.y_scale.compute(data.y[0])];
return { x: box.left + x, y: box.top + y, cell: data.cell[0], error: data.y_text[0], series: shown.length };
"""

TOOLTIP = """
const texts = [];
const visit = node => {
  for (const one of node.querySelectorAll("*")) if (one.shadowRoot) visit(one.shadowRoot);
  const values = [...node.querySelectorAll(".bk-tooltip-row-value")].filter(one => one.getClientRects().length);
  texts.push(...values.map(one => one.textContent.trim()));
};
visit(document);
return texts;
"""


@pytest.fixture(scope="module")
def cells(reported: Path) -> pd.DataFrame:
    return in_order(read_table(reported / FILE, "cells"))


def awaited(browser: Chrome, condition: Callable[[Chrome], Any]) -> Any:
    return WebDriverWait(browser, PATIENCE, 0.1).until(condition)


def shown_rows(browser: Chrome, table: str = "summary") -> list[dict[str, str]]:
    read = """
    const table = document.querySelector(`[data-table="${arguments[0]}"] table`);
    const texts = row => [...row.cells].map(cell => cell.textContent);
    return [texts(table.tHead.rows[0]), [...table.tBodies[0].rows].map(texts)];
    """
    headings, found = browser.execute_script(read, table)
    return [dict(zip(headings, row, strict=True)) for row in found]


def choose(browser: Chrome, axis: str, value: str) -> None:
    labels = browser.find_elements(By.CSS_SELECTOR, '[data-table="summary"] .tools label')
    (label,) = [one for one in labels if one.text.split("\n")[0].split(" all")[0].strip() == axis]
    label.find_element(By.XPATH, f".//option[normalize-space(.)='{value}']").click()


@pytest.mark.parametrize(
    ("width", "themes"), [pytest.param(1280, ("light", "dark"), marks=pytest.mark.long), (390, ("dark", "light"))]
)
def test_nothing_is_cut_or_wrapped_in_numbers(width: int, themes: tuple[str, str], browser: Chrome, made: Path) -> None:
    """In the scheme in which the page is opened, and in the other one, to which it changes with the user."""
    look(browser, made, width=width, theme=themes[0])
    browser.execute_script("for (const figure of document.querySelectorAll('[data-plot]')) drawPlot(figure);")
    ready = "return [...Bokeh.index.roots].filter(view => view.model.type === 'Figure').length === drawn.length"
    awaited(browser, lambda b: b.execute_script(ready))
    assert browser.execute_script("return drawn.length") >= 4
    for theme in themes:
        prefer(browser, theme)
        awaited(browser, lambda b: b.execute_script(ready))
        seen = browser.execute_script(GEOMETRY)
        assert complaints(browser) == []
        assert seen["wide"] <= width
        assert seen["outside"] == []
        assert seen["wrapped"] == []
        assert seen["cut"] == 0
        red = int(seen["paper"].split("(")[1].split(",")[0])
        assert red > 240 if theme == "light" else red < 40
    eager = "return [...document.images].map(image => { image.loading = 'eager'; return image.alt.length; })"
    pictures = browser.execute_script(eager)
    assert min(pictures) > 30
    awaited(browser, lambda b: b.execute_script("return [...document.images].every(image => image.naturalWidth > 100)"))


def test_columns_that_matter_and_flags_are_seen_and_sort(browser: Chrome, made: Path, cells: pd.DataFrame) -> None:
    """Rows of a disturbed machine are flagged; numbers are sorted as numbers, and missing ones come last."""
    look(browser, made)
    seen = browser.execute_script(
        """
        const frame = document.querySelector('[data-table="summary"] .wide');
        const right = one => one.getBoundingClientRect().right;
        const heads = [...frame.querySelectorAll("th")].filter(head => right(head) <= right(frame));
        return heads.map(head => head.textContent);
        """
    )
    assert seen[0] == "cell"
    assert set(seen) >= MATTERS
    assert "accuracy" not in seen, "a column with one value in all rows is hidden at first"
    sides = """
        const side = one => getComputedStyle(one).textAlign;
        const { tHead, tBodies } = document.querySelector('[data-table="summary"] table');
        return [...tHead.rows[0].cells].map((head, k) => [side(head), side(tBodies[0].rows[0].cells[k])]);
        """
    found = browser.execute_script(sides)
    assert {tuple(one) for one in found} == {("left", "left"), ("right", "right")}
    flagged = [row["cell"].split()[0] for row in shown_rows(browser) if "⚑" in row["cell"]]
    expected = cells["cell"][cells["disturbed"] == 1]
    assert len(flagged) == len(expected) == 2
    assert all(key.startswith(short) for key, short in zip(expected, flagged, strict=True))

    # The switch changes the theme, and back.
    paper = "return getComputedStyle(document.body).backgroundColor"
    light = browser.execute_script(paper)
    browser.find_element(By.ID, "theme").click()
    assert browser.execute_script(paper) != light
    browser.find_element(By.ID, "theme").click()
    assert browser.execute_script(paper) == light

    heads = "[...document.querySelectorAll('[data-table=summary] th button')]"
    sort = f"{heads}.find(head => head.textContent === 'online [ms]').click()"
    for falling in (False, True):
        browser.execute_script(sort)
        known = (1e3 * cells["online_s"]).sort_values(ascending=not falling, na_position="last", kind="stable")
        assert [row["online [ms]"] for row in shown_rows(browser)] == [formats.cell_text(value) for value in known]

    # A winner of the leaderboard is a link to its row.
    link = browser.find_element(By.CSS_SELECTOR, ".board a")
    key = link.text
    link.click()
    awaited(browser, lambda b: len(shown_rows(b)) == 1)
    assert shown_rows(browser)[0]["cell"].startswith(key)


def test_the_filter_filters_and_its_address_brings_it_back(browser: Chrome, made: Path, cells: pd.DataFrame) -> None:
    look(browser, made)
    assert len(shown_rows(browser)) == len(cells)
    choose(browser, "problem", "obstacle")
    choose(browser, "solver", "piqp")
    found = shown_rows(browser)
    expected = cells[(cells["problem"] == "obstacle") & (cells["solver"] == "piqp")]
    assert [row["error λ"] for row in found] == [formats.cell_text(error) for error in expected["error_lambda_mean"]]
    assert {row["problem"] for row in found} == {"obstacle"}
    search = browser.find_element(By.CSS_SELECTOR, '[data-table="summary"] input[type=search]')
    search.send_keys("pga mcpg")
    (row,) = shown_rows(browser)
    assert (row["primal"], row["dual"]) == ("offline-pga", "mcpg")
    fragment = browser.execute_script("return location.hash")
    look(browser, made, fragment=fragment)
    assert shown_rows(browser) == [row]
    browser.find_element(By.CSS_SELECTOR, '[data-table="summary"] .reset').click()
    assert len(shown_rows(browser)) == len(cells)
    assert browser.execute_script("return location.hash") == "#summary"


def test_the_csv_is_what_is_shown(browser: Chrome, made: Path, downloads: Path, cells: pd.DataFrame) -> None:
    look(browser, made, fragment="#summary?is+problem=hertz&sort=-error+u&hide=N")
    browser.find_element(By.CSS_SELECTOR, '[data-table="summary"] .download').click()
    file = downloads / "summary.csv"
    text = awaited(browser, lambda _: file.exists() and file.read_text(encoding="utf-8"))
    rows = list(csv.DictReader(io.StringIO(text)))
    shown = shown_rows(browser)
    assert list(rows[0]) == [*shown[0], "disturbed"]
    assert "N" not in rows[0]
    assert len(rows) == len(shown) == (cells["problem"] == "hertz").sum()
    assert [row["disturbed"] for row in rows] == ["1" if "⚑" in row["cell"] else "0" for row in shown]
    plain = {f"'{FORMULA}": FORMULA}
    assert [plain.get(row["primal"], row["primal"]) for row in rows] == [row["primal"] for row in shown]
    assert f"'{FORMULA}" in text
    assert f",{FORMULA}" not in text
    written, seen = ([float(row["error u"] or "nan") for row in some] for some in (rows, shown))
    assert written == pytest.approx(seen, rel=1e-2, nan_ok=True)


INTO_VIEW = "document.getElementById(arguments[0]).scrollIntoView()"


def move(browser: Chrome, *places: tuple[float, float]) -> None:
    actions = ActionChains(browser)
    for x, y in places:
        actions.w3c_actions.pointer_action.move_to_location(round(x), round(y))
    actions.perform()


def hover(browser: Chrome, name: str, series: int) -> dict[str, Any]:
    """Hover over the first point of a series until it says which cell it is; returns where and what it is.

    What is above the plot may still take its place: page and pointer are moved again to where the point is then.
    """

    def point(browser: Chrome) -> dict[str, Any] | None:
        browser.execute_script(INTO_VIEW, name)
        found: dict[str, Any] = browser.execute_script(POINT, name, series)
        move(browser, (2, 2), (found["x"], found["y"]))
        with contextlib.suppress(TimeoutException):
            WebDriverWait(browser, 3, 0.1).until(lambda b: found["cell"] in b.execute_script(TOOLTIP))
            return found
        return None

    return awaited(browser, point)


def show_plot(browser: Chrome, name: str) -> None:
    browser.execute_script(INTO_VIEW, name)
    ready = "return [...Bokeh.index.roots].some(v => v.el.closest('#' + arguments[0]) && v.frame.x_range.start)"
    awaited(browser, lambda b: b.execute_script(ready, name))


def test_hover_tells_cells_legends_hide_them_a_box_zooms(browser: Chrome, made: Path, cells: pd.DataFrame) -> None:
    name = "obstacle-overview"
    look(browser, made)
    show_plot(browser, name)
    found = hover(browser, name, 1)
    told = browser.execute_script(TOOLTIP)
    assert found["cell"] in told
    assert found["error"] in told
    (row,) = [row for _, row in cells.iterrows() if row["cell"].startswith(found["cell"])]
    model = next(text for text in told if row["dual"] in text)
    assert row["primal"] in model
    assert row["problem"] in model
    assert formats.cell_text(max(row["error_u_mean"], row["error_lambda_mean"])) == found["error"]

    buttons = browser.find_elements(By.CSS_SELECTOR, f"#{name} .legend button")
    (button,) = [one for one in buttons if one.text == row["primal"]]
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    left = browser.execute_script(POINT, name, 0)
    assert left["series"] == found["series"] - 1
    assert hover(browser, name, 0)["cell"] == left["cell"]
    move(browser, (found["x"], found["y"]))
    awaited(browser, lambda b: found["cell"] not in b.execute_script(TOOLTIP))
    button.click()
    assert browser.execute_script(POINT, name, 1)["series"] == found["series"]

    # Ticks between powers of ten are what they are called.
    ticks = np.random.default_rng(4).uniform(1.0, 10.0, 1000) * 10.0 ** np.arange(-7, 7).repeat(72)[:1000]
    called = """
    const { model } = [...Bokeh.index.roots].find(view => view.el.closest("#" + arguments[0]));
    return [...model.below, ...model.left].map(axis => axis.formatter.doFormat(arguments[1], { loc: 0 }));
    """
    for labels in browser.execute_script(called, name, ticks.tolist()):
        np.testing.assert_allclose([float(label) for label in labels], ticks, rtol=6e-3)

    # A plot zooms where a box is drawn.
    limits = """
    const { x_range } = [...Bokeh.index.roots].find(view => view.el.closest("#" + arguments[0])).model;
    return x_range.end - x_range.start;
    """
    before = browser.execute_script(limits, name)
    panel = browser.find_element(By.CSS_SELECTOR, f"#{name} .panels > div")

    def zoomed(browser: Chrome) -> bool:
        drag = ActionChains(browser).move_to_element_with_offset(panel, -60, -60)
        drag.click_and_hold().move_by_offset(80, 80).release().perform()
        with contextlib.suppress(TimeoutException):
            return WebDriverWait(browser, 3, 0.1).until(lambda b: b.execute_script(limits, name) < 0.7 * before)
        return False

    assert awaited(browser, zoomed)

    # On paper are pictures, and no plots.
    shown = """
    const shown = name => document.querySelector(name).getClientRects().length > 0;
    return ["#obstacle-answer img", "#obstacle-overview"].map(shown);
    """
    assert browser.execute_script(shown) == [True, True]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert browser.execute_script(shown) == [True, False]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


@pytest.mark.long
def test_a_page_of_many_cells_shows_some_rows_at_a_time(browser: Chrome, quick_run: Path, tmp_path: Path) -> None:
    path = write_many(quick_run, tmp_path / "many", 60)
    page = html.write(path, tmp_path / "many.html", figures=False)
    look(browser, page)
    count = '[data-table="summary"] .count'
    first = shown_rows(browser)
    assert len(first) == 50
    assert browser.find_element(By.CSS_SELECTOR, count).text == "rows 1–50 of 60"
    browser.find_element(By.CSS_SELECTOR, '[data-table="summary"] [aria-label="next rows"]').click()
    assert browser.find_element(By.CSS_SELECTOR, count).text == "rows 51–60 of 60"
    assert {row["cell"] for row in first}.isdisjoint(row["cell"] for row in shown_rows(browser))
    # a value that all rows have is in the page once
    look(browser, page, fragment="#summary?show=solver&show=accuracy&page=2")
    accuracy = formats.cell_text(read_table(tmp_path / "many" / FILE, "cells")["accuracy"].iloc[0])
    assert [(row["solver"], row["accuracy"]) for row in shown_rows(browser)] == [("piqp", accuracy)] * 10
    assert complaints(browser) == []


OVERVIEW = """
const views = [...Bokeh.index.roots].filter(view => view.el.closest("[data-plot$=overview]") && view.model.renderers);
const lines = view => view.model.renderers.filter(one => one.glyph.type === "Line");
const named = views.filter(view => lines(view).some(one => one.data_source.data.name));
if (!named.length) return null;
const points = views[0].model.renderers.filter(one => one.data_source.data.cell && one.data_source.data.cell[0]);
const { selected, data } = points[0].data_source;
selected.indices = [0];
const curves = lines(named[0]).map(one => one.data_source.data.name[0]);
const top = id => document.getElementById(id).getBoundingClientRect().top + scrollY;
const places = { verdict: top("verdict"), tables: top("summary") };
return { cell: data.cell[0], lines: lines(views[0]).length, curves, hash: location.hash, ...places };
"""


def test_the_verdict_comes_first_and_plots_say_which_model_for_how_many_queries(browser: Chrome, made: Path) -> None:
    """Points with the high-fidelity model as a line, total costs with bands; a selected point leads to its row."""
    look(browser, made)
    show_plot(browser, "hertz-overview")
    found = awaited(browser, lambda b: b.execute_script(OVERVIEW))
    assert found["lines"] == 1
    assert found["curves"][0] == "high-fidelity"
    assert len(found["curves"]) > 1
    assert found["verdict"] < 300
    assert found["tables"] < 6000
    assert found["hash"] == f"#summary?q={found['cell']}"
    assert complaints(browser) == []
