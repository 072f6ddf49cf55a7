"""The command that writes a static site of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from vibench.cli.completion import runs
from vibench.errors import RequestError
from vibench.terminal.output import echo, warn


def publish_runs(
    run: Annotated[
        list[str], Argument(metavar="RUN", help="Run folders, results files, or names in runs/.", autocompletion=runs)
    ],
    site: Annotated[Path, Argument(metavar="SITE", help="A new folder, or one that this command wrote.")],
    title: Annotated[str, Option(help="Title of the site.")] = "Benchmark results",
    author: Annotated[
        list[str] | None, Option(metavar="NAME", help='"Family, Given", or a group (repeatable).')
    ] = None,
    doi: Annotated[str, Option(help="DOI of the deposit, such as 10.5281/zenodo.1234567.")] = "",
    url: Annotated[str, Option(help="Address of the site.")] = "",
    figures: Annotated[bool, Option("--figures/--no-figures", help="Add pictures to the reports.")] = True,
) -> None:
    """Write a static site of runs: reports, data, leaderboard.

    Links are relative: the site can be opened from a disk and served by any host of static files.
    """
    from vibench.report.site.citation import Citation
    from vibench.report.site.publish import publish
    from vibench.results import tables

    if not title.strip():
        raise RequestError("--title is empty; a site needs one to be cited")
    citation = Citation(title, tuple(author or ()), doi, url)
    page = publish([tables.results_file(one) for one in run], site, citation, warn=warn, figures=figures)
    echo(f"site of {len(run)} run{'s' * (len(run) > 1)}: {page}")
