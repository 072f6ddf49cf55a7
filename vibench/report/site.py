"""A static site of some runs: pages and data with relative links, for any host of files and for none."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import shlex
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment

from vibench.errors import RequestError
from vibench.files import scratch, write_atomically
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import default_formulation, registered
from vibench.provenance import distribution_version
from vibench.report import html
from vibench.report.citation import Citation, requirements
from vibench.report.comparison import compare
from vibench.report.differences import ComparedRun, compared_runs, numbered
from vibench.report.figures.data import way
from vibench.report.identifying import cleaned, left
from vibench.results import formats
from vibench.results.formats import asked, cell_text, solver_text
from vibench.results.paired_timing import PairedTiming
from vibench.results.ranking import Criterion, Standings, leaderboard
from vibench.results.read import in_order, read_table, whole_numbers
from vibench.results.sqlite import FILE, open_read_only
from vibench.text import parsed_json


def check(site: Path) -> None:
    """Refuse a folder that is a file, or holds files and is no site, or whose list of files cannot be read."""
    if site.is_dir():
        if any(site.iterdir()):
            _written(site)
    elif site.exists() or site.is_symlink():
        raise RequestError(f"'{site}' is not a folder; choose another for the site")


def write(site: Path, fill: Callable[[Path], None]) -> None:
    """Write a site: a new one appears whole, the files of an earlier one are replaced one by one, its first page last.

    The callback `fill` writes the files into a new folder. Raises a `RequestError`, with nothing changed, if the folder
    holds files of others under names of the site, or cannot be written.
    """
    check(site)
    try:
        site.parent.mkdir(parents=True, exist_ok=True)
        with scratch(site.parent) as folder:
            new = folder / "site"
            new.mkdir()
            fill(new)
            written = (path for path in sorted(new.rglob("*")) if path.is_file())
            files = {path.relative_to(new).as_posix(): _digest(path) for path in written}
            _write_catalogue(new, {name: [digest] for name, digest in files.items()})
            if site.is_dir() and any(site.iterdir()):
                _replace_files(site, new, files)
            else:
                new.replace(site)
    except (OSError, sqlite3.Error) as error:
        why = getattr(error, "strerror", None) or error
        raise RequestError(f"'{site}' cannot be written: {why}") from None


def _replace_files(site: Path, new: Path, files: Mapping[str, str]) -> None:
    """Replace the files of a site, remove those it has no more, and keep all others."""
    before = _written(site)
    for name in (*files, *before):
        _refuse_links(site, name)
    for name in files:
        if (site / name).exists() and _digest(site / name) not in (*before.get(name, ()), files[name]):
            raise RequestError(f"'{site / name}' was not written by vibench, or changed since; move it elsewhere")
    # An interruption of the next steps leaves no file that is not in the catalogue.
    both = {name: [*before.get(name, ()), *([files[name]] if name in files else [])] for name in {**before, **files}}
    _write_catalogue(site, both)
    for name in sorted(files, key=lambda name: name == "index.html"):
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (new / name).replace(site / name)
    for name, digests in before.items():
        if name not in files and (site / name).is_file() and _digest(site / name) in digests:
            (site / name).unlink()
            folder = (site / name).parent
            while folder != site and not any(folder.iterdir()):
                folder.rmdir()
                folder = folder.parent
    _write_catalogue(site, {name: [digest] for name, digest in files.items()})


def _refuse_links(site: Path, name: str) -> None:
    """Refuse names that lead out of the site, by themselves or through links."""
    parts = Path(name).parts
    if not parts or ".." in parts or Path(name).is_absolute():
        raise RequestError(f"'{catalogue(site)}' lists '{name}', which is not in the site; move the file elsewhere")
    for depth in range(1, len(parts) + 1):
        if site.joinpath(*parts[:depth]).is_symlink():
            raise RequestError(f"'{site.joinpath(*parts[:depth])}' is a symbolic link; move it elsewhere")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def catalogue(site: Path) -> Path:
    """The list of the files of a site with their digests: a later `vibench publish` may replace these."""
    return site / "vibench-site.json"


def _write_catalogue(site: Path, files: Mapping[str, Sequence[str]]) -> None:
    content = {"format": "vibench-site 1", "files": dict(sorted(files.items()))}
    write_atomically(catalogue(site), f"{json.dumps(content, indent=1, ensure_ascii=False)}\n".encode())


def _written(site: Path) -> dict[str, list[str]]:
    """Files that vibench has written into a site, with the digests of what it wrote."""
    if not catalogue(site).is_file():
        raise RequestError(f"'{site}' is not empty and was not written by `vibench publish`; choose another folder")
    try:
        files = parsed_json(catalogue(site).read_text(encoding="utf-8"))["files"]
        return {str(name): [str(digest) for digest in digests] for name, digests in dict(files).items()}
    except (OSError, ValueError, KeyError, TypeError):
        raise RequestError(f"'{catalogue(site)}' cannot be read as the list of the files of a site") from None


@dataclass(frozen=True, eq=False)
class PublishedRun:
    """A run on the site, with a remark on the origin of its file."""

    run: ComparedRun
    folder: str  # name of its folder below `runs/`: letters, digits, "-", "_" and "." only
    note: str

    @cached_property
    def values(self) -> dict[str, list[str]]:
        """Values by which the list of runs is filtered."""
        names = ("problem", "dual", "primal", "solver")
        axes = {axis: sorted({str(row[axis]) for row in self.run.cells.values()}) for axis in names}
        versions = self.run.versions.get("vibench", "")
        study = str(self.run.identity["study"])
        return {"study": [study], **axes, "machine": self.run.machines, "vibench": versions.split(", ")}

    @property
    def facts(self) -> Iterator[tuple[str, str]]:
        yield from self.run.facts
        if self.note:
            yield "note", self.note

    @property
    def provenance(self) -> dict[str, Any]:
        return {
            **self.run.identity, "cells": len(self.run.cells), "ok": self.run.ok, "machines": self.run.machines,
            "versions": self.run.versions, "code": self.run.code.split(", "), "values": self.values, "note": self.note,
        }  # fmt: skip

    @property
    def commands(self) -> list[tuple[str, str]]:
        """Commands in the folder of the results file, each with its effect."""
        study = str(self.run.identity["study"])
        commands = [("pip install -r requirements.txt", "the versions that computed it")]
        if study in registered(PluginKind.STUDY):
            commands.append((f"vibench run {shlex.quote(study)}", "the whole study, on your machine"))
        commands.append((f"vibench compare {FILE} YOUR-RUN", "your run beside this one"))
        return commands

    def cells(self, columns: Sequence[str]) -> list[dict[str, Any]]:
        """The cells of the run with some columns, and with the commands that compute them again."""
        return [
            {
                "key": key,
                "axes": [
                    str(row["problem"]), str(row["dual"]), _model(row),
                    f"{asked(row, 'pod')}, {asked(row, 'dual')}", solver_text(row),
                    way(row["assembly"], row["bounds"], row["correction"]) or "full",
                ],
                "status": str(row["status"]),
                "numbers": [cell_text(row[name]) for name in columns],
                "command": f"vibench run {FILE} --cell {shlex.quote(key)} --out again",
            }
            for key, row in self.run.cells.items()
        ]  # fmt: skip


def _model(row: Mapping[str, Any]) -> str:
    formulation = "" if row["formulation"] == default_formulation() else f"{row['formulation']}: "
    return f"{formulation}{row['primal']}" + ("" if pd.isna(row["primal_tol"]) else f" {row['primal_tol']:g}")


def folder_names(names: Sequence[str]) -> list[str]:
    """Names of folders for runs of these names: they need no escapes in links, and differ in more than case."""
    return numbered((re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "run" for name in names), "{}-{}")


def publish(
    paths: Sequence[Path], site: Path, citation: Citation, notes: Mapping[Path, str] = {}, *, figures: bool = True,
    ask: Callable[[Iterator[str]], None] = lambda _: None,
) -> Path:  # fmt: skip
    """Write the site of some results files; the same files give the same site.

    The folder is new, empty, or was written by this function: then its files are replaced. Notes are remarks on results
    files for the pages of their runs; with `figures` reports have pictures. Paths and the names of user and host are
    removed; `ask` gets lines on what could still identify somebody, before anything is written.

    Returns the first page. Raises a `RequestError` if a results file cannot be read, or the folder holds files of
    others or cannot be written.
    """
    check(site)
    with scratch() as folder:
        # The last folder or the file alone, since other folders could identify somebody.
        names = numbered((one.absolute().parent.name if one.name == FILE else one.stem for one in paths), "{} ({})")
        copies = [folder / name / FILE for name in names]
        for path, copy in zip(paths, copies, strict=True):
            cleaned(path, copy)
        runs = compared_runs(copies)
        names = [run.name for run in runs]
        ask(left(copies, names, citation.authors))
        remarks = [notes.get(path, "") for path in paths]
        published = list(map(PublishedRun, runs, folder_names(names), remarks))
        write(site, lambda new: _fill(new, published, citation, figures=figures))
    return site / "index.html"


def _fill(site: Path, runs: Sequence[PublishedRun], citation: Citation, *, figures: bool) -> None:
    pages = html.environment("templates/site")
    pages.filters["number"] = formats.cell_text
    pages.globals |= {"citation": citation, "vibench": distribution_version("vibench"), "criteria": list(Criterion)}
    limit = 1.25
    comparisons = {study: compare([run.run.path for run in group], limit) for study, group in _comparable(runs)}
    for run in runs:
        _write_run(site / "runs" / run.folder, run, pages, figures)
    # Every run has a leaderboard: seconds of other runs may come from a busier machine, or from other parameters.
    boards: list[tuple[PublishedRun, tuple[Standings, ...]]] = []
    for run in runs:
        timings = PairedTiming(read_table(run.run.path, "timings").to_dict("records"))
        boards.append((run, leaderboard(in_order(read_table(run.run.path, "cells")), timings)))
    links = {run.run.name: f"runs/{run.folder}/index.html" for run in runs}
    _write_page(pages, site / "leaderboard.html", "leaderboard", "", boards=boards, links=links, way=html.way)
    sections = []
    for number, (study, made) in enumerate(comparisons.items(), start=1):
        file, changes = f"comparison-{number}.csv", made.changes
        _write(site / file, formats.to_csv(changes))
        frames = {"runs": made.by_run, "cells by column": made.by_column, "changes": changes.head(500)}
        sections.append({"study": study, "file": file, "notes": made.notes, "count": len(changes), "tables": frames})
    _write_page(pages, site / "comparison.html", "comparison", "", sections=sections, limit=limit)
    filters = {name: sorted({value for run in runs for value in run.values[name]}) for name in runs[0].values}
    _write_page(pages, site / "index.html", "index", "", runs=runs, filters=filters)
    # What publishes the same site once more, from its results files.
    asked = {"names": [run.run.name for run in runs], "notes": [run.note for run in runs], "figures": figures}
    asked |= {"citation": dataclasses.asdict(citation), "vibench": distribution_version("vibench")}
    _write(site / "publication.json", json.dumps(asked, indent=1, sort_keys=True) + "\n")
    _write(site / "CITATION.cff", citation.cff())
    _write(site / "citation.bib", citation.bibtex())


def _write_run(own: Path, run: PublishedRun, pages: Environment, figures: bool) -> None:
    """Write the folder of one run: its page and report, its data, and a file of requirements."""
    (own / "tables").mkdir(parents=True)
    with open_read_only(run.run.path) as db:
        db.execute("VACUUM INTO ?", (str((own / FILE).absolute()),))
    _write(own / "report.html", html.page(run.run.path, figures=figures))
    # The results file has all tables; these are the ones that people read.
    published = ("cells", "thresholds", "disagreements")
    for name in published:
        rows = whole_numbers(in_order(read_table(run.run.path, name)))
        _write(own / "tables" / f"{name}.csv", formats.to_csv(rows))
    _write(own / "requirements.txt", requirements(run.run.versions, run.run.code))
    _write(own / "provenance.json", json.dumps(run.provenance, indent=1, ensure_ascii=True, sort_keys=True) + "\n")
    columns = ("N", "R", "enrichment", "error_u_mean", "error_lambda_mean", "online_s", "offline_s")
    shown = {"cells": run.cells(columns), "columns": columns, "tables": published}
    _write_page(pages, own / "index.html", "run", "../../", run=run, **shown)


def _comparable(runs: Sequence[PublishedRun]) -> Iterator[tuple[str, list[PublishedRun]]]:
    """Runs that have cells in common with the first one of their study, by the name of the study."""
    by_study: dict[str, list[PublishedRun]] = {}
    for run in runs:
        by_study.setdefault(str(run.run.identity["study"]), []).append(run)
    for study, group in by_study.items():
        first = group[0].run.cells.keys()
        comparable = [run for run in group if run.run.cells.keys() & first]
        if len(comparable) > 1:
            yield study, comparable


def _write_page(pages: Environment, path: Path, name: str, root: str, **content: Any) -> None:
    """Write a page of the template of that name; `root` leads from it to the folder of the site."""
    _write(path, pages.get_template(f"{name}.html.j2").render(**content, root=root, page=name))


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")
