"""Checks a site that `vibench publish` wrote, as it comes with a submission of results: what is wrong, line by line.

python results/scripts/check_submission.py SITE

The site is published once more from its results files, and every file compared; `MAY_DIFFER` says what need not be the
same. Everything is read as data; nothing that the site contains is run. The exit code is 1 if anything is wrong.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from page import start

from vibench.errors import RequestError, in_a_line
from vibench.files import read_regular
from vibench.provenance import PROTOCOL, distribution_version
from vibench.qp.status import Status
from vibench.report.citation import Citation
from vibench.report.site import catalogue, folder_names, publish
from vibench.results import consistency
from vibench.results.read import read_table
from vibench.results.sqlite import FILE
from vibench.text import brief, parsed_json

MAY_DIFFER = {
    FILE: rb"(?s)(?<=\A.{24}).{4}|(?<=\A.{40}).{4}|(?<=\A.{92}).{8}",
    "report.html": rb"data:image/webp;base64,[A-Za-z0-9+/=]*\" width=\"\d+\" height=\"\d+",
}
"""What may differ in a file of a name: three counters of copies, and the version of the SQLite library; pictures,
which depend on Matplotlib, FreeType and the processor. The catalogue must have the digests of the site's own files."""


def main(site: str) -> None:
    lines = list(faults(Path(site)))
    for line in lines:
        print(line)
    if lines:
        sys.exit(1)
    print(f"{site}: nothing is wrong")


def faults(site: Path) -> Iterator[str]:
    """A line for everything that is wrong."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            yield from differences(site, published_again(site, Path(folder)))
            for path in sorted(Path(folder, "site").glob(f"runs/*/{FILE}")):
                yield from (f"{path.parent.name}: {line}" for line in of_run(path))
        except Exception as error:  # noqa: BLE001  files of others may make anything raise anything
            yield brief(str(error)) if isinstance(error, RequestError) else in_a_line(error)


def published_again(site: Path, folder: Path) -> Path:
    """The site that its results files give, in a folder."""
    asked = parsed_json(read_regular(site / "publication.json"))
    if asked["vibench"] != (here := distribution_version("vibench")):
        raise RequestError(f"it was published by vibench {asked['vibench']}, expected {here}: publish it again")
    names, notes = list(map(str, asked["names"])), list(map(str, asked["notes"]))
    if any(name != Path(name).name for name in names):
        raise RequestError(f"publication.json has names of runs that are paths: {names}")
    copies = [folder / "runs" / name / FILE for name in names]
    for copy, own in zip(copies, folder_names(names), strict=True):
        copy.parent.mkdir(parents=True)
        copy.write_bytes(read_regular(site / "runs" / own / FILE))
    texts = {name: str(asked["citation"][name]) for name in ("title", "doi", "url", "date")}
    citation = Citation(authors=tuple(map(str, asked["citation"]["authors"])), **texts)
    remarks = dict(zip(copies, notes, strict=True))
    return publish(copies, folder / "site", citation, remarks, figures=asked["figures"] is True).parent


def differences(site: Path, again: Path) -> Iterator[str]:
    """A line for every file that is not the one of the site that was published again."""
    ours, expected = contents(site), contents(again)
    yield from (f"{name} is missing" for name in expected.keys() - ours.keys())
    yield from (f"{name} is no file of the site" for name in ours.keys() - expected.keys())
    listed = catalogue(site).name
    for name in sorted(ours.keys() & expected.keys() - {listed}):
        both, pattern = [ours[name], expected[name]], MAY_DIFFER.get(Path(name).name)
        if both[0] != both[1] and not (pattern and len({re.sub(pattern, b"", one) for one in both}) == 1):
            yield f"{name} is not what the results files give"
    if listed in ours:
        digests = {name: [hashlib.sha256(ours[name]).hexdigest()] for name in ours if name != listed}
        if parsed_json(ours[listed]) != {"format": "vibench-site 1", "files": digests}:
            yield f"{listed} has other digests than the files"


def contents(site: Path) -> Mapping[str, bytes]:
    """The files of a site by their names; a link has no content."""
    paths = (path for path in site.rglob("*") if path.is_symlink() or not path.is_dir())
    return {path.relative_to(site).as_posix(): b"" if path.is_symlink() else read_regular(path) for path in paths}


def of_run(path: Path) -> Iterator[str]:
    """What is wrong with the rows of a results file."""
    cells, queries = read_table(path, "cells"), read_table(path, "queries")
    yield from of_cells(cells)
    yield from of_queries(queries, cells.set_index("cell")["enrichment_kind"])


def of_cells(cells: pd.DataFrame) -> Iterator[str]:
    """Machine, versions, code and rounds of the cells."""
    if not len(cells):
        yield "it has no cells"
    measured = cells[cells["status"] != Status.UNAVAILABLE]
    for name in ("machine", "versions", "code", "definition", "seed"):
        if measured[name].isna().any():
            yield f"{int(measured[name].isna().sum())} cells have no {name}"
    protocols = {json.loads(text).get("protocol", "none") for text in measured["versions"].dropna()}
    if protocols - {PROTOCOL}:
        yield f"it was measured by protocol {', '.join(sorted(protocols))}, expected {PROTOCOL}"
    ok = measured[measured["status"] == Status.OK]
    if (ok["timing_rounds"].fillna(0) == 0).any():
        yield f"{int((ok['timing_rounds'].fillna(0) == 0).sum())} cells that are ok were never timed"


def of_queries(queries: pd.DataFrame, kinds: pd.Series[Any]) -> Iterator[str]:
    """Residuals of what is ok, and the invariants of the constants and the error bounds."""
    ok = queries[queries["status"] == Status.OK]
    for name in ("primal_residual", "dual_residual", "gap"):
        above = ok[~(ok[name] <= ok["accuracy"])]
        if len(above):
            yield f"{len(above)} queries are ok with a {name} above the accuracy"
    yield from map(str, consistency.violations(queries, kinds))


if __name__ == "__main__":
    start(main)
