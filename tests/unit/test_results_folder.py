"""The folder `results/` is light: it holds pages, their scripts, and the files that pages show or link."""

import csv
import importlib
import inspect
import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from running import Changed

from vibench.execution.recorded_cell import recorded_study
from vibench.report import Sheet, html, site, styled
from vibench.report.citation import Citation
from vibench.results.read import read_table
from vibench.results.sqlite import FILE
from vibench.study.matrix import expand

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
SCRIPTS = RESULTS / "scripts"
FILES = sorted(path for path in RESULTS.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
PAGES = [path for path in FILES if path.suffix == ".md"]


NAMES = ("benefit", "field", "hertz-quadrature", "meshes", "paper-hertz", "paper-obstacle", "solvers")

LINK = re.compile(r"\]\(([^)\s#]+)(?:#[^)]*)?\)")


def linked(page: Path) -> set[Path]:
    targets = LINK.findall(page.read_text(encoding="utf-8"))
    return {(page.parent / target).resolve() for target in targets if "://" not in target}


def test_the_folder_is_light_and_pages_name_files_and_commands_that_exist() -> None:
    assert sum(path.stat().st_size for path in FILES) <= 10_000_000
    assert {path for path in FILES if path.suffix == ".py"} == {path for path in FILES if SCRIPTS in path.parents}
    pages = {*PAGES, ROOT / "README.md", *(ROOT / "docs").rglob("*.md")}
    shown = set().union(*map(linked, pages))
    assert [path for path in FILES if path.suffix not in {".md", ".py"} and path not in shown] == []
    targets = {page: linked(page) for page in [*PAGES, ROOT / "README.md"]}
    assert [(page, path) for page, paths in targets.items() for path in paths if not path.exists()] == []
    overview = RESULTS / "README.md"
    assert {page for page in PAGES if page != overview} <= linked(overview)
    for path in sorted({*SCRIPTS.glob("*.py")} - {SCRIPTS / "page.py"}):
        script = importlib.import_module(path.stem)
        (command,) = re.findall(rf"python results/scripts/{path.name}((?: [^>\s]+)*)", script.__doc__ or "")
        assert len(command.split()) == len(inspect.signature(script.main).parameters), path
    for name in NAMES:
        text = (RESULTS / name / "README.md").read_text(encoding="utf-8")
        assert f"`vibench run {name}` leaves the tables of all queries and histories under `runs/{name}/tables`" in text


@pytest.fixture(autouse=True)
def scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(SCRIPTS))


@pytest.mark.usefixtures("scripts")
def test_one_command_makes_every_page_that_the_overview_lists() -> None:
    everything = importlib.import_module("everything")
    listed = everything.LINK.findall((RESULTS / "README.md").read_text(encoding="utf-8"))
    folders = {Path(page).parent.name for page in listed}
    assert len(folders) > 15
    said = "\n".join(everything.commands())
    assert [folder for folder in folders if f"results/{folder}" not in said] == []


def rows_of(study: str, **equal: str) -> Iterator[dict[str, str]]:
    with (RESULTS / study / "cells.csv").open(encoding="utf-8", newline="") as file:
        yield from (row for row in csv.DictReader(file) if all(row[name] == text for name, text in equal.items()))


def test_the_tables_of_readme_and_conclusions_are_those_of_committed_cells() -> None:
    """Recomputed without the scripts: errors, gain over the next full solution, and from how many queries it pays."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| (.+?) \| (.+?) \| (.+?) \| (.+?) \| (.+?)(?:<!-- -->)? \|$", text, re.MULTILINE)
    benefit = {"assembly": "reduced", "solver": "piqp", "dual_tol": "0.01"}
    regression = {"training": "own", "dual": "mcpg", "dual_tol": "0.01"}
    sources = {
        "no enrichment": ("benefit", benefit | {"primal": "decorrelated"}),
        "enriched offline": ("benefit", benefit | {"primal": "offline-pga", "primal_tol": "0.5"}),
        "enriched at every": ("benefit", benefit | {"primal": "online-supremizers"}),
        "penalty": ("formulations", regression | {"formulation": "penalty"}),
        "regression": ("formulations", regression | {"formulation": "regression (radial)"}),
    }
    for name, (study, equal) in sources.items():
        (shown,) = (row[1:] for row in table if name in row[0])
        for k, problem in enumerate(("obstacle", "hertz")):
            (row,) = rows_of(study, problem=problem, **equal)
            u, error, online, full, offline, setup = (
                float(row[column])
                for column in ("error_u_mean", "error_lambda_mean", "online_s", "hf_s", "offline_s", "hf_setup_s")
            )
            pays = (offline - setup) / (full - online)
            expected = (100 * u, 100 * error, full / online, pays)
            found = (float(cell.split(", ")[k].removesuffix(" %")) for cell in shown)
            assert [*found] == pytest.approx(expected, rel=0.06), (name, problem)
    # Those without a solver compete, too: seconds of the fastest within 1.5 times the errors of `mixed`.
    text = (ROOT / "docs" / "what-to-use.md").read_text(encoding="utf-8")
    every = list(rows_of("formulations", training="own"))
    ranked = text.split("## Which formulation?")[1].split("##")[0]
    for name in {row["formulation"] for row in every}:
        word, _, kind = name.partition(" ")
        title = f"`{word}` {kind}".strip()
        fastest, exact = re.findall(
            rf"^\| (?:<!-- \w+ \d -->)?{re.escape(title)} \| (.+?)(?:<!-- -->)? \|$", ranked, re.M
        )
        assert len(exact.split(" | ")) == 4
        for problem, shown in zip(("obstacle", "hertz", "bearing", "american-put"), fastest.split(" | "), strict=True):
            usual = {"formulation": "mixed", "dual": "mcpg", "pod_tol": "0.001"}
            (mixed,) = rows_of("formulations", training="own", problem=problem, **usual)
            mine = [row for row in every if (row["problem"], row["formulation"]) == (problem, name)]
            for one in ("error_u_mean", "error_lambda_mean"):
                mine = [row for row in mine if float(row[one]) <= 1.5 * float(mixed[one])]
            near = [1e3 * float(row["online_s"]) for row in mine]
            assert shown == "–" if not near else float(shown) == pytest.approx(min(near), rel=0.06)


def test_no_assembly_of_a_study_is_left_out_of_when_models_pay() -> None:
    text = (ROOT / "docs" / "what-to-use.md").read_text(encoding="utf-8").split("## When should I not reduce")[1]
    shown = set(re.findall(r"^\| (?:<!-- \w+ \d -->)?([\w-]+) \| (\w+) \|", text, re.M))
    assert {(row["problem"], row["assembly"]) for row in rows_of("benefit")} <= shown


def test_the_rule_for_enriching_is_that_of_committed_cells_on_five_problems() -> None:
    """Recomputed without the scripts: every enriched model beside the same cone and modes without enrichment."""
    text = (ROOT / "docs" / "what-to-use.md").read_text(encoding="utf-8").split("## Which cone?")[0]
    factors: dict[tuple[str, bool], list[float]] = {}
    for study, how in (("paper-obstacle", "full"), ("paper-hertz", "full"), ("enriching", "reduced")):
        plain, same = {}, ("problem", "dual", "pod_tol", "pod_size", "dual_tol", "dual_size")
        for row in sorted(rows_of(study, assembly=how, solver="piqp"), key=lambda row: row["primal"] != "decorrelated"):
            if row["primal"] == "decorrelated":
                plain[tuple(row[name] for name in same)] = row
            elif row["error_lambda_mean"]:
                bare = plain[tuple(row[name] for name in same)]
                few = factors.setdefault((row["problem"], int(bare["N"]) < int(bare["R"])), [])
                few.append(float(bare["error_lambda_mean"]) / float(row["error_lambda_mean"]))
    for (problem, few), mine in factors.items():
        (shown,) = re.findall(rf"^\| (?:<!-- \w+ \d -->)?{problem} \| (.+?) \| (.+?)(?:<!-- -->)? \|$", text, re.M)
        expected = np.median(mine), min(mine), max(mine), len(mine)
        found = [float(number) for number in re.findall(r"[\d.]+(?:e[+-]\d+)?", shown[0 if few else 1])]
        assert found == pytest.approx(expected, rel=0.06), (problem, few)


def test_sentences_are_made_from_the_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    sentences = importlib.import_module("sentences")
    page = (ROOT / "docs" / "compared.md").read_text(encoding="utf-8")
    (place,) = (found[0] for found in sentences.PLACE.finditer(page) if "it has 57 generators" in found[0])
    assert sentences.rendered(place.replace("57 generators", "58 generators")) == sentences.rendered(place)
    assert "it has 57 generators" in sentences.rendered(place)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert sentences.rendered(readme) == readme
    pages = [readme, *(path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md"))]
    named = {name for text in pages for name, _ in sentences.PLACE.findall(text)}
    assert named == set(sentences.TOPICS)


def test_a_page_made_anew_is_as_light(changed: Changed, tmp_path: Path) -> None:
    run = changed("DELETE FROM cells WHERE problem = 'hertz'").parent
    folder = tmp_path / "benefit"
    importlib.import_module("study").main(str(run), str(folder))
    written, page = set(folder.iterdir()), folder / "README.md"
    assert written == {page, *linked(page)}
    assert {one.name for one in written if one.suffix == ".csv"} == {"cells.csv", "thresholds.csv", "disagreements.csv"}
    pictures = [path for path in written if path.suffix == ".png"]
    assert {path.stem for path in pictures} == {"obstacle-answer"}
    assert all(path.stat().st_size < 150_000 for path in pictures)
    text = page.read_text(encoding="utf-8")
    assert "`vibench run benefit` leaves the tables of all queries and histories under `runs/benefit/tables`" in text
    assert "## Break-even of fixed enrichments" in text


@pytest.mark.long
def test_results_and_their_hashes_are_published_by_one_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All cells of a study have one hash of it, and pandas reads a column of such as numbers."""
    cells = pd.read_csv(RESULTS / "benefit" / "cells.csv").head(2).assign(study_hash="9369049480579e14")
    cells.to_csv(tmp_path / "cells.csv", index=False)
    script = importlib.import_module("publish")
    rows = script.rows(tmp_path / "cells.csv")
    assert [row["study_hash"] for row in rows] == ["9369049480579e14"] * 2
    restored, publish, of_table = set[str](), site.publish, script.rows

    def sampled(rows: Any) -> Any:
        return rows[:: len(rows) // 40 + 1]

    def publish_two(runs: list[Path], folder: Path, citation: Citation, notes: dict[Path, str]) -> Path:
        """All results are restored, from some rows of each; the site is of one study, on two machines."""
        for path in runs:
            name, place = path.parent.name, path.relative_to(Path(os.path.commonpath(runs))).parent
            restored.add(str(place))
            committed, read = sampled(pd.read_csv(RESULTS / place / "cells.csv")), read_table(path, "cells")
            assert set(committed["cell"]) == set(read["cell"])
            both = committed.merge(read, on="cell")
            assert both["online_s_x"].equals(both["online_s_y"])
            assert f"`vibench run {name}` makes all of it" in notes[path]
            key = committed["cell"].iloc[0]
            (cell,) = expand(recorded_study(str(path), key))  # its key may be another one in this version
            row = both[both["cell"] == key].iloc[0]
            assert cell.labels == (row["problem_x"], row["dual_x"], row["primal_x"])
        return publish([path for path in runs if path.parent.name == "benefit"], folder, citation, notes)

    monkeypatch.setattr(html, "page", lambda *_, **__: "<!doctype html>")
    monkeypatch.setattr(script, "publish", publish_two)
    monkeypatch.setattr(script, "rows", lambda table: sampled(of_table(table)))
    script.main(str(tmp_path / "site"))
    assert restored == {str(table.parent.relative_to(RESULTS)) for table in RESULTS.rglob("cells.csv")} > {*NAMES}
    index = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    published = {path.parent.name: path for path in (tmp_path / "site" / "runs").glob(f"*/{FILE}")}
    for name, path in published.items():
        assert f'href="runs/{name}/index.html"' in index
        page, cells = path.with_name("index.html").read_text(encoding="utf-8"), read_table(path, "cells")
        assert "`vibench run benefit` makes all of it" in page
        assert f"vibench run results.sqlite --cell {cells['cell'].iloc[0]} --out again" in page
    assert len({read_table(path, "cells")["machine"].iloc[0] for path in published.values()}) == 2


def test_pictures_have_plain_numbers_and_are_described_in_a_sentence(tmp_path: Path) -> None:
    page = importlib.import_module("page")
    figure = Sheet(1, 1).finish("Errors at δ = 0.5 of [all] models. More of it.")
    file = page.write_figure(figure, tmp_path, "errors")
    with Image.open(file) as picture:
        assert picture.text["Description"] == "Errors at δ = 0.5 of [all] models. More of it."
    assert page.alternative(figure, "errors") == "Errors at δ = 0.5 of (all) models."  # without labels at its axes
    sheet = Sheet(1, 2)
    for panel in sheet.panels:
        panel.set(xlabel="seconds", ylabel="error [1]")
        panel.plot([1.0, 2.0], [3.0, 4.0], label="a model")
    sheet.figure.legend()
    assert page.alternative(sheet.figure, "errors") == "2 panels show error (1) over seconds, for a model."
    grid = Sheet(2, 2)
    for place, panel in enumerate(grid.panels):  # a label for a row on its left, for a column below it
        panel.set(xlabel="seconds" if place > 1 else "", ylabel=("error", "", "gain", "")[place])
    shown = page.alternative(grid.figure, "errors")
    assert shown == "4 panels show error over seconds; gain over seconds."
    # Figures show texts as they are: Matplotlib's own powers of ten would be its commands for them.
    script, rows = importlib.import_module("scaling"), pd.read_csv(RESULTS / "scaling" / "rows.csv")
    with styled():
        figure = script.draw(rows[rows["over"] == "mesh"], "n")
        figure.draw_without_rendering()
        labels = [text.get_text() for ax in figure.axes for text in (*ax.get_xticklabels(), *ax.get_yticklabels())]
    assert "10³" in labels
    assert not [label for label in labels if "$" in label]


def test_other_machines_are_compared_row_by_row(tmp_path: Path) -> None:
    here, there = tmp_path / "benefit", tmp_path / "machines" / "other" / "benefit"
    for folder in (here, there):
        folder.mkdir(parents=True)
        for name in ("cells", "thresholds"):
            shutil.copy(RESULTS / "benefit" / f"{name}.csv", folder)
    cells, rows = (pd.read_csv(there / f"{name}.csv") for name in ("cells", "thresholds"))
    cells["error_u_mean"] *= 1.0 + 1e-3
    (first, *_) = rows.index[(rows["meaning"] == "from") & (rows["primal_a"] == "high-fidelity")]
    rows.loc[first, "meaning"] = "never"
    rows["gain"] /= 2.0
    cells.to_csv(there / "cells.csv", index=False)
    rows.to_csv(there / "thresholds.csv", index=False)

    def lines() -> list[list[str]]:
        importlib.import_module("machines").main(str(tmp_path), str(tmp_path / "machines"))
        page = (tmp_path / "machines" / "README.md").read_text(encoding="utf-8").splitlines()
        return [[part.strip() for part in line.split("|")[1:-1]] for line in page if line.startswith("| benefit")]

    verdicts, apart = lines()
    assert verdicts[:3] == ["benefit", "other", str(len(rows))]
    assert verdicts[4] == "1"  # the one that is contradicted
    assert verdicts[6:] == ["2.00 (2.00–2.00)"] * 2
    assert apart[3:] == ["0.0e+00"] * 4 + ["1.0e-03", "0.0e+00"]
    # seconds of the high-fidelity model are not those of an earlier protocol
    cells["versions"] = cells["versions"].str.replace(r'"protocol": "\d+"', '"protocol": "0"', regex=True)
    cells.to_csv(there / "cells.csv", index=False)
    verdicts, *_ = lines()
    assert verdicts[2] == str(int((rows["primal_a"] != "high-fidelity").sum()))
    assert verdicts[4] == "0"
    assert verdicts[6:] == ["–", "2.00 (2.00–2.00)"]


def test_citations_and_the_lock_file_agree_with_the_project() -> None:
    """Title, author, version and year on the page of the benchmark and in CITATION.cff."""
    entry = re.compile(r"^@software\{vibench,\n.*?^\}$", re.MULTILINE | re.DOTALL)
    (first,) = entry.findall((ROOT / "docs" / "publishing.md").read_text(encoding="utf-8"))
    fields = {name: value.strip("{}") for name, value in re.findall(r"^  (\w+) = \{(.*)\},$", first, re.MULTILINE)}
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert text.count(f'title: "{fields["title"]}"') == 2
    assert text.count(f'- name: "{fields["author"]}"') == 2
    assert text.count(f"version: {fields['version']}\n") == 2
    assert f"  year: {fields['year']}\n" in text
    deposit = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    assert (deposit["title"], deposit["creators"][0]["name"]) == (fields["title"], fields["author"])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert fields["version"] == project["version"]
    text = (ROOT / "requirements.lock").read_text()
    locked = set(re.findall(r"^([\w.-]+)==\S+ \\\n +--hash=sha256:[0-9a-f]{64}$", text, re.MULTILINE))
    extras = [line for name in ("solvers", "nmf", "hdf5", "mesh") for line in project["optional-dependencies"][name]]
    needed = {re.split(r"[^\w.-]", line)[0].lower() for line in [*project["dependencies"], *extras, "hatchling"]}
    assert needed - locked == set()
