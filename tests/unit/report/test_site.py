import json
import re
import shutil
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from urllib.parse import unquote

import pandas as pd
import pytest
from browsing import observed
from outputs import Links, clean, elements
from running import Changed, Main, execute, refused, succeeded
from selenium.webdriver import Chrome

from vibench import RequestError
from vibench.report import html
from vibench.report import site as folder
from vibench.report.citation import Citation, requirements
from vibench.report.site import folder_names, publish
from vibench.results.paired_timing import PairedTiming
from vibench.results.ranking import leaderboard
from vibench.results.read import in_order, read_table
from vibench.results.sqlite import FILE

CITATION = Citation("Tests & <trials>", ("Doe, Jane", "The {team}"), "10.5281/zenodo.1234567")


@pytest.fixture(scope="module")
def three(quick_run: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three runs of two machines, with one cone: as it was run, of another one with fewer cells, with failures."""
    base = tmp_path_factory.mktemp("runs")
    server = "UPDATE cells SET machine = 'a server, 64 cores', online_s = 0.5 * online_s"
    failed = "UPDATE cells SET status = 'failed', reason = 'why <not>', queries_ok = 0 WHERE problem = 'hertz'"
    later = (failed, "UPDATE cells SET error_u_mean = 3 * error_u_mean")
    changes = {"here": (), "server #1": (server, "DELETE FROM cells WHERE solver = 'osqp'"), "later": later}
    for name, statements in changes.items():
        (base / name).mkdir()
        shutil.copy(quick_run / FILE, base / name / FILE)
        one_cone = (f"DELETE FROM {table} WHERE dual = 'cpg'" for table in ("cells", "histories", "thresholds"))
        execute(base / name, *one_cone, *statements)
    return [base / name / FILE for name in changes]


REPORT = "<!doctype html><html><body>report</body></html>"


@pytest.fixture(scope="module", autouse=True)
def _no_reports() -> Iterator[None]:
    """Reports have tests of their own, and take long to draw."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(html, "page", lambda *_, **__: REPORT)
        yield


@pytest.fixture(scope="module")
def site(three: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("site") / "site"
    publish(three, made, CITATION, {three[1]: "measured on a <server>"})
    return made


def test_every_link_of_every_page_leads_to_a_file_of_the_site_and_to_its_anchor(site: Path) -> None:
    pages = {page: Links(page.read_text(encoding="utf-8")) for page in site.rglob("*.html")}
    assert len(pages) == 3 + 2 * 3
    reached = {site / "index.html"}
    for page, found in pages.items():
        for target in found.sources + found.targets:
            if target.startswith(("data:", "https://doi.org/10.5281/")):
                continue
            assert not target.startswith("/"), target
            path, _, anchor = target.partition("#")
            linked = (page.parent / unquote(path)).resolve() if path else page
            assert linked.is_file(), (page, target)
            assert linked.is_relative_to(site)
            assert not anchor or anchor in pages[linked].ids, (page, target)
            reached.add(linked)
    assert {path for path in site.rglob("*") if path.is_file()} - reached == {folder.catalogue(site)}


OBSERVE = """
  return {
    wide: document.documentElement.scrollWidth, window: innerWidth,
    links: [...document.links].map(link => link.href),
    rows: [...document.querySelectorAll("table")].map(table => table.tBodies[0].rows.length),
  };
"""


@pytest.mark.long
def test_a_browser_shows_every_page_and_filters_without_an_error(site: Path, browser: Chrome) -> None:
    pages = ("index.html", "leaderboard.html", "comparison.html", "runs/server-1/index.html")
    for page, width in product(pages, (1280, 500)):
        seen = observed(browser, site / page, OBSERVE, width=width)
        assert seen["wide"] <= seen["window"], page  # tables scroll inside themselves
        assert min(seen["rows"]) > 0, page
        local = [link for link in seen["links"] if not link.startswith("https://doi.org/")]
        assert all(link.startswith(site.as_uri()) for link in local), page
    seen = observed(browser, site / "index.html", FILTER)
    everything = ["here", "server #1", "later"]
    assert (seen["start"], seen["said"]) == (everything, "3 of 3")
    assert seen["osqp"] == ["here", "later"]
    assert seen["both"] == seen["none"] == []
    assert seen["machine"] == seen["text"] == ["server #1"]
    assert seen["count"] == "0 of 3"
    again = observed(browser, site / "index.html", FILTER, fragment=seen["hash"])
    assert again["start"] == ["server #1"]  # the address keeps what was asked for
    seen = observed(browser, site / "runs" / "later" / "index.html", FILTER.replace("SERVER", "proxqp OFFLINE"))
    cells = read_table(site / "runs" / "later" / FILE, "cells")
    chosen = cells[(cells["solver"] == "proxqp") & (cells["primal"] == "offline-pga")]
    assert len(seen["start"]) == 18
    assert sorted(seen["text"]) == sorted(key[:8] for key in chosen["cell"])


FILTER = """
  const form = document.querySelector("form.filters"), table = document.getElementById(form.dataset.table);
  const rows = [...table.tBodies[0].rows];
  const shown = () => rows.filter(row => row.offsetHeight > 0).map(row => row.cells[0].textContent);
  const found = { start: shown(), said: form.querySelector("output").textContent };
  const set = (name, value) => {
    form.elements[name].value = value;
    form.elements[name].dispatchEvent(new Event("input", { bubbles: true }));
  };
  if (form.elements.solver) {
    set("solver", "osqp"); found.osqp = shown();
    set("machine", "a server, 64 cores"); found.both = shown();
    set("solver", ""); found.machine = shown(); found.hash = location.hash;
    set("machine", "");
  }
  set("text", "SERVER"); found.text = shown();
  set("text", "no such words"); found.none = shown(); found.count = form.querySelector("output").textContent;
  return found;
"""


def test_runs_have_data_commands(site: Path, three: list[Path], main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    own = site / "runs" / "server-1"
    assert (own / "report.html").read_text(encoding="utf-8") == REPORT
    for name in ("cells", "queries", "thresholds", "timings", "solutions", "pictures"):
        pd.testing.assert_frame_equal(read_table(own / FILE, name), read_table(three[1], name))
    page = (own / "index.html").read_text(encoding="utf-8")
    row = read_table(three[1], "cells").iloc[0]
    for text in ("measured on a &lt;server&gt;", "a server, 64 cores", row["code"], row["study_hash"]):
        assert text in page
    known = json.loads((own / "provenance.json").read_text())
    assert (known["cells"], known["seed"], known["machines"]) == (12, 2022, ["a server, 64 cores"])
    assert known["versions"]["numpy"] in json.loads(row["versions"]).values()
    assert len(pd.read_csv(own / "tables" / "cells.csv")) == 12
    text = (site / "runs" / "here" / "requirements.txt").read_text()
    versions = json.loads(read_table(three[0], "cells")["versions"].iloc[0])
    assert f"numpy=={versions['numpy']}\n" in text
    assert {"piqp", "osqp", "proxsuite"} <= {line.split("==")[0] for line in text.splitlines()}
    evil = {"numpy": "1.0 --index-url http://x", "-r /etc/passwd": "1", "scipy": "1\n-e .", "piqp": "1.0, 2.0", "a": ""}
    evil |= {"python": "3.12", "protocol": "1", "evil-package": "6.6.6"}
    lines = requirements(evil, "code\n--pre").splitlines()
    assert all(line.startswith("#") for line in lines)
    assert not any("evil" in line or "passwd" in line for line in lines)
    assert any(line.startswith("# left out: 3 that") for line in lines)
    assert "osqp==1.0\n" in requirements({"osqp": "1.0"}, "")
    commands = re.findall(r"<code>vibench (run results.sqlite --cell (\w+) --out again)</code>", page)
    assert [key for _, key in commands] == list(in_order(read_table(own / FILE, "cells"))["cell"])
    monkeypatch.chdir(own)
    command, key = commands[5]
    out = succeeded(main(*command.split(), "--dry-run"))
    assert out.startswith(f"{key}  ")


def test_leaderboards_have_ties_and_runs_of_one_study_are_compared(site: Path, three: list[Path]) -> None:
    """Seconds of several runs are not compared: other work on the machine would win."""
    page = (site / "leaderboard.html").read_text(encoding="utf-8")
    sections = page.split("<section>")[1:]
    assert len(sections) == len(three)
    for section, path in zip(sections, three, strict=True):
        (folder,) = set(re.findall(r'href="runs/([^/"]+)/index.html', section))  # of this run alone
        cells = pd.read_csv(site / "runs" / folder / "tables" / "cells.csv")
        linked = set(re.findall(r'index.html#(\w+)"', section))
        assert linked
        assert linked <= set(cells["cell"])
        timings, rows = (read_table(path, name) for name in ("timings", "cells"))
        boards = leaderboard(in_order(rows), PairedTiming(timings.to_dict("records")))
        ties = [len(winner.ties) for one in boards for band in one.bands for winner in band.winners]
        shown = re.findall(r'<td class="number">(\d+)</td><td>(?:<a|</td>)', section)
        assert [int(text) for text in shown] == ties
        assert "<td>fastest query</td>" in section
        assert "<td>mixed</td>" in section
    page = (site / "comparison.html").read_text(encoding="utf-8")
    changes = pd.read_csv(site / "comparison-1.csv")
    assert {"server #1", "later"} == set(changes["run"])
    assert f"{len(changes)} changes" in page
    errors = changes[(changes["run"] == "later") & (changes["what"] == "error_u_mean")]
    assert len(errors) > 0
    assert (errors["ratio"] > 2.9).all()


def of_yaml(text: str) -> dict[str, str]:
    """Keys and values at the top of a file of YAML that has strings in double quotes, which are JSON's."""
    lines = (line.partition(": ") for line in text.splitlines() if line[:1].isalpha() and ": " in line)
    return {key: json.loads(value) if value.startswith('"') else value for key, _, value in lines}


@pytest.mark.parametrize("title", ["plain", "an { open brace", "100 % \\ of } it", "{}{", "a \\{ b", "#1 & ~ ^ $ _"])
def test_bibtex_has_balanced_braces_and_no_empty_field(title: str) -> None:
    bib = Citation(title, ("Doe, {Jane", "A group"), url="https://example.org/{a}_b", date="2026").bibtex()
    depth = 0
    for at, character in enumerate(bib):
        depth += {"{": 1, "}": -1}.get(character, 0)
        assert depth > 0 or at < len("@misc") or at >= len(bib.rstrip()) - 1
    assert depth == 0
    fields = re.findall(r"^  (\w+) = \{(.*)\},$", bib, re.MULTILINE)
    assert [name for name, _ in fields] == ["title", "author", "year", "url", "note"]  # there is no DOI
    assert all(value for _, value in fields)


def test_a_citation_is_valid_and_its_texts_are_data(site: Path) -> None:
    text = (site / "CITATION.cff").read_text(encoding="utf-8")
    known = of_yaml(text)
    assert (known["cff-version"], known["type"]) == ("1.2.0", "dataset")
    assert (known["title"], known["doi"]) == (CITATION.title, CITATION.doi)
    assert '  - family-names: "Doe"\n    given-names: "Jane"\n  - name: "The {team}"\n' in text
    bib = (site / "citation.bib").read_text(encoding="utf-8")
    assert "author = {Doe, Jane and {The \\textbraceleft{}team\\textbraceright{}}}," in bib
    assert f"doi = {{{CITATION.doi}}}," in bib
    without = Citation('a "title": #1\n- b', ()).cff()
    assert of_yaml(without)["title"] == 'a "title": #1 - b'
    assert "doi" not in of_yaml(without)
    assert "# doi:" in without
    assert "date-released" not in of_yaml(Citation("a", date="2026").cff())  # it would need a day
    for text in ("https://doi.org/10.5281/zenodo.1", "10.5281/zenodo.{1}"):
        with pytest.raises(RequestError, match="is no DOI, expected such as"):
            Citation("a", doi=text)
    for text in ("26", "2026-02-30", "2026-1-1", "2026-11", "0000", "20261126", "٢٠٢٦", "soon"):
        with pytest.raises(RequestError, match="is no date, expected a year or such as 2026-11-26"):
            Citation("a", date=text)


def test_a_label_is_no_markup(site: Path, changed: Changed, tmp_path: Path) -> None:
    label = "</script><script>alert(1)</script><img src=x onerror=alert(1)>' onclick='x"
    quoted = label.replace("'", "''") + "' || char(27) || '"
    axes = ("problem", "dual", "primal", "solver", "machine", "code", "study_hash")
    broken = changed(*(f"UPDATE cells SET {axis} = '{quoted}'" for axis in axes))
    publish([broken, broken], tmp_path / "out", Citation(label, (label,)))
    for page in ("index.html", "leaderboard.html", "comparison.html", "runs/changed/index.html"):
        text = (tmp_path / "out" / page).read_text(encoding="utf-8")
        like = page.replace("changed", "here")
        assert elements(text) <= elements((site / like).read_text(encoding="utf-8")) | {"td.class"}, page
        assert text.count("<script") == text.count("</script") == 1
        assert clean(text)


@pytest.fixture
def small(three: list[Path], tmp_path: Path) -> Path:
    return publish(three[:1], tmp_path / "small", CITATION).parent


def test_a_site_is_replaced_and_files_of_others_stay(small: Path, three: list[Path]) -> None:
    (small / "CNAME").write_text("results.example")
    (small / "runs" / "here" / "notes.txt").write_text("mine")
    publish(three[1:], small, CITATION)
    assert (small / "CNAME").read_text() == "results.example"
    assert [path.name for path in (small / "runs" / "here").iterdir()] == ["notes.txt"]
    assert {path.name for path in (small / "runs").iterdir()} == {"here", "server-1", "later"}
    assert "server #1" in (small / "index.html").read_text(encoding="utf-8")
    assert not list(small.parent.glob("vibench-*"))
    publish(three[:1], small, CITATION)  # once more


def test_a_file_that_somebody_changed_or_put_there_is_not_replaced(small: Path, three: list[Path]) -> None:
    before = (small / "CITATION.cff").read_bytes()
    (small / "index.html").write_text("my own")
    with pytest.raises(RequestError, match=r"index.html' was not written by vibench, or changed since"):
        publish(three[1:], small, Citation("other"))
    assert (small / "index.html").read_text() == "my own"
    assert (small / "CITATION.cff").read_bytes() == before
    assert not (small / "runs" / "later").exists()


def test_links_and_lists_that_cannot_be_trusted_are_refused(small: Path, three: list[Path], tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (small / "runs" / "later").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RequestError, match="later' is a symbolic link"):
        publish(three, small, CITATION)
    assert list((tmp_path / "elsewhere").iterdir()) == []
    outside = ('{"files": {"../../outside": ["x"]}}', '{"files": {"/etc/hostname": []}}')
    for catalogue in ("", "[]", '{"files": 3}', *outside):
        folder.catalogue(small).write_text(catalogue)
        with pytest.raises(RequestError, match=r"vibench-site.json' (cannot be read|lists)"):
            publish(three[:1], small, CITATION)


def test_a_command_writes_sites(three: list[Path], main: Main, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("all of it")
    refused(main("publish", "--yes", str(three[0]), str(tmp_path / "mine")), "mine", "not written by `vibench publish`")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]
    refused(main("publish", "--yes", str(three[0]), str(tmp_path / "mine" / "thesis.tex")), "is not a folder")
    refused(main("publish", "--yes", "nowhere", str(tmp_path / "new")), "no results in 'nowhere'")
    refused(main("publish", "--yes", str(three[0]), str(tmp_path / "new"), "--doi", "abc"), "no DOI")
    assert not (tmp_path / "new").exists()
    arguments = ("--title", "Ours", "--author", "Doe, Jane", "--url", "https://example.org/", "--date", "2026-11-26")
    out = succeeded(main("publish", "--yes", *map(str, three[:2]), str(tmp_path / "new" / "site"), *arguments))
    assert out == f"site of 2 runs: {tmp_path / 'new' / 'site' / 'index.html'}\n"
    known = of_yaml((tmp_path / "new" / "site" / "CITATION.cff").read_text())
    assert (known["url"], known["date-released"]) == ("https://example.org/", "2026-11-26")
    assert "  year = {2026},\n" in (tmp_path / "new" / "site" / "citation.bib").read_text()


def test_folders_have_names_that_a_link_needs_no_escapes_for() -> None:
    expected = ["a-b", "a-b-2", "n-code", "run", "A-B-3", "run-2"]
    assert folder_names(["a/b", "a b", "ünïcode?", "..", "A-B", ""]) == expected
