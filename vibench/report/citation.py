"""Citation of a site as CITATION.cff and BibTeX, and the file of requirements that installs the versions of a run."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date

from vibench.errors import RequestError
from vibench.provenance import distribution_version, solver_distribution
from vibench.qp.settings import SETTINGS
from vibench.results.formats import to_latex_text
from vibench.text import unbroken


@dataclass(frozen=True)
class Citation:
    """Citation of a site; raises a `RequestError` if the DOI or the date is none."""

    title: str
    authors: tuple[str, ...] = ()  # "Family, Given" for persons; without a comma the name of a group
    doi: str = ""  # of the deposit, "" if there is none yet
    url: str = ""
    date: str = ""  # of publication, "2026-11-26" or only the year; "" if it is unknown

    def __post_init__(self) -> None:
        # Without a resolver before it (DOI Handbook, section 2.2); braces would end a field of BibTeX.
        if self.doi and (not re.fullmatch(r"10\.\d{4,9}/[!-~]+", self.doi) or set("{}") & {*self.doi}):
            raise RequestError(f"'{unbroken(self.doi)}' is no DOI, expected such as 10.5281/zenodo.1234567")
        if self.date and not _is_date(self.date):
            raise RequestError(f"'{unbroken(self.date)}' is no date, expected a year or such as 2026-11-26")

    def cff(self) -> str:
        """The file CITATION.cff (Citation File Format 1.2.0)."""
        authors = list[str]()
        for author in self.authors or ("unnamed",):
            family, comma, given = map(str.strip, author.partition(","))
            names = {"family-names": family, "given-names": given} if comma else {"name": family}
            authors.append("  - " + "\n    ".join(f"{key}: {_yaml(text)}" for key, text in names.items()))
        lines = [
            "cff-version: 1.2.0",
            'message: "If you use these results, please cite them, and vibench, which computed them."',
            "type: dataset",
            f"title: {_yaml(self.title)}",
            "authors:",
            *authors,
            f"doi: {_yaml(self.doi)}" if self.doi else "# doi: 10.…/…   of the deposit, once it has one",
            *([f"url: {_yaml(self.url)}"] if self.url else []),
            *([f"date-released: {_yaml(self.date)}"] if "-" in self.date else []),
            "references:",
            "  - type: software",
            '    title: "vibench: a benchmark framework for reduced-order models of parametrised variational '
            'inequalities"',
            "    authors:",
            '      - name: "The vibench developers"',
            f"    version: {_yaml(distribution_version('vibench'))}",
        ]
        return "\n".join(lines) + "\n"

    def bibtex(self) -> str:
        """An entry of BibTeX, without empty fields."""
        names = [_in_braces(author) for author in self.authors or ("unnamed",)]
        fields = {
            "title": f"{{{_in_braces(self.title)}}}",
            "author": " and ".join(name if "," in name else f"{{{name}}}" for name in names),
            "year": self.date.partition("-")[0], "doi": self.doi,
            "url": unbroken(self.url).replace("{", "%7B").replace("}", "%7D"),
            "note": f"Computed by vibench {distribution_version('vibench')}",
        }  # fmt: skip
        lines = (f"  {name} = {{{value}}}," for name, value in fields.items() if value)
        return "@misc{vibench-results,\n" + "\n".join(lines) + "\n}\n"


def _is_date(text: str) -> bool:
    """Whether a text is a year, or a day of the calendar (ISO 8601)."""
    if not re.fullmatch(r"\d{4}(-\d{2}-\d{2})?", text) or not text.isascii():
        return False
    try:
        date.fromisoformat(text if "-" in text else f"{text}-01-01")
    except ValueError:
        return False
    return True


def _in_braces(text: str) -> str:
    """A text in a field of BibTeX."""
    # BibTeX counts escaped braces, too: they become commands.
    escaped = to_latex_text(unbroken(text))
    return escaped.replace("\\{", "\\textbraceleft{}").replace("\\}", "\\textbraceright{}")


def _yaml(text: str) -> str:
    """A string of YAML: JSON's strings are a subset of its double-quoted ones."""
    return json.dumps(unbroken(text), ensure_ascii=False)


def requirements(versions: Mapping[str, str], code: str) -> str:
    """The file of requirements with which pip installs the versions that a run was computed with.

    Versions are by name of distribution or solver, as the cells record them; several versions of one, separated by
    ", ", become a comment, and so do the hashes of the code: a vibench under development has no release.
    """
    # Without distributions that are neither installed here nor those of QP solvers that vibench has settings for: the
    # author of a results file could make others install anything.
    uninstalled, solvers = {"protocol", "python"}, {*map(solver_distribution, SETTINGS)}
    lines = [f"# versions recorded in the results file; code of the cells: {unbroken(code)}"]
    distributions = {name: solver_distribution(name) for name in versions}
    known = {
        name: one
        for name, one in distributions.items()
        if name in uninstalled or one in solvers or distribution_version(one)
    }
    if unknown := len(versions) - len(known):
        lines.append(f"# left out: {unknown} that the machine which published this does not know")
    for name, distribution in sorted(known.items()):
        version = versions[name]
        if name in uninstalled:
            lines.append(f"# {name} {unbroken(version)}")
        elif not version:
            lines.append(f"# {unbroken(distribution)} was not installed")
        # Anything else could be an option of pip.
        elif re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", distribution) and re.fullmatch(r"[A-Za-z0-9.!+_-]+", version):
            lines.append(f"{distribution}=={version}")
        else:
            lines.append(f"# {unbroken(distribution)}: {unbroken(version)}")
    return "\n".join(lines) + "\n"
