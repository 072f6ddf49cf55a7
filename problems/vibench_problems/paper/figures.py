"""Figures 3 to 15 of Niakh et al. (2022), drawn again from runs, and the page that compares them with the paper."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vibench import RequestError, Run
from vibench.report import CaptionedFigure, ProblemTables, problem_tables, save, styled
from vibench_problems.paper import constants, discs, membrane, offline
from vibench_problems.paper.evidence import Evidence
from vibench_problems.paper.published import PROBLEMS, PUBLICATION

PAGE = "paper-figures.md"


def drawings(tables: ProblemTables) -> Mapping[int, Callable[[], CaptionedFigure | None]]:
    """Functions that draw the figures of one of the two problems, by number; empty for any other problem.

    Pairs of spaces are found by the tolerances or sizes of the paper. A function returns `None` if the run has none.
    """
    paper, options = PROBLEMS.get(tables.problem_name), tables.problem_options
    # These options add a parameter, which the problems of the paper do not have.
    if paper is None or options.get("bulge") is True or options.get("approach") == "parameter":
        return {}
    drawn = (offline.projection_errors, offline.orthogonality, offline.greedy, constants.comparison)
    figures: dict[int, Callable[[Evidence], CaptionedFigure | None]] = dict(zip(paper.figures, drawn, strict=True))
    if tables.problem_name == "obstacle":
        figures |= {3: membrane.aspect_ratios, 4: membrane.solution}
    else:
        figures |= {9: discs.configuration, 10: discs.solution, 13: constants.without_enrichment}
    evidence = Evidence(tables)
    return {number: partial(figures[number], evidence) for number in sorted(figures)}


@dataclass(frozen=True)
class Redrawn:
    """A figure of the paper that a run may have data for."""

    number: int
    name: str
    draw: Callable[[], CaptionedFigure | None]
    run: str
    tables: ProblemTables

    @property
    def origin(self) -> str:
        """The run and the problem from which it is drawn, with the options that are not at their default."""
        options = ", ".join(f"{name} = {value}" for name, value in self.tables.problem_options.items())
        return f"Run {self.run}, problem {self.tables.problem}{f': {options}' * bool(options)}."


def draw_again(
    runs: Sequence[Run], folder: Path, formats: Sequence[str], note: Callable[[str], None] = lambda _: None
) -> list[Path]:
    """Draw the figures for which runs have data, and write the page `PAGE`; returns the files of figures.

    Figures of the same names and the page are replaced in the folder; the page shows the first of the formats, "png",
    "svg" or "pdf", that a browser can. `note` is called with a line for every figure without data.

    Raises a `RequestError` if none of the runs has a problem of the paper.
    """
    redrawn = sorted(_redrawn(runs), key=lambda one: (one.number, one.name))
    if not redrawn:
        names = ", ".join(_name(run) for run in runs)
        raise RequestError(f"no problem of the paper in {names}; run paper-obstacle, paper-hertz or hertz-direct")
    files: list[Path] = []
    drawn: list[tuple[Redrawn, CaptionedFigure]] = []
    folder.mkdir(parents=True, exist_ok=True)
    for one in redrawn:
        with styled():
            figure = one.draw()
            if figure is None:
                note(f"{one.name}: {one.run} has no data for it")
                continue
            files += save(figure, folder, one.name, formats)
        drawn.append((one, figure))
    shown = next((form for form in formats if form != "pdf"), formats[0])
    (folder / PAGE).write_text(_page(drawn, runs, shown), encoding="utf-8")
    return files


def _name(run: Run) -> str:
    return run.path.parent.name


def _redrawn(runs: Sequence[Run]) -> Iterator[Redrawn]:
    """The figures of some runs; of one that several runs have, each after the first is named after its run."""
    seen: list[int] = []
    for run in runs:
        for _, tables in problem_tables(run.path):
            for number, draw in drawings(tables).items():
                seen.append(number)
                count = seen.count(number)
                name = f"figure-{number}" + f"-{_name(run)}" * (count > 1) + f"-{count}" * (count > 2)
                yield Redrawn(number, name, draw, _name(run), tables)


def _page(drawn: Sequence[tuple[Redrawn, CaptionedFigure]], runs: Sequence[Run], form: str) -> str:
    """The page in Markdown."""
    names = " ".join(map(_name, runs))
    studies = dict.fromkeys(_code(str(run.study["name"])) for run in runs)
    machines = dict.fromkeys(one.tables.machine for one, _ in drawn)
    parts = [
        "# Figures of a publication, drawn again",
        f"{_text(PUBLICATION)}.",
        f"Drawn by `python -m vibench_problems.paper {_code(names)}` from runs of the studies "
        f"{', '.join(f'`{study}`' for study in studies)}, measured on {_text('; '.join(machines))}. Below each "
        "figure: its caption, what the publication says of it in text, captions and tables, and what agrees and what "
        "differs, computed from the run. No curve was read off a published figure.",
    ]
    for one, figure in drawn:
        parts += [
            f"## {_text(one.name.replace('-', ' ').capitalize())}",
            f"![{_text(figure.alternative)}]({one.name}.{form})",
            f"{_text(figure.caption)} {_text(one.origin)}",
            f"**Published.** {_text(figure.published)}",
            f"**Here.** {_text(figure.compared)}",
        ]
    return "\n\n".join(parts) + "\n"


def _text(text: str) -> str:
    """Text from others in Markdown: one line, in which no character acts."""
    return re.sub(r"([\\`*_\[\]|#])", r"\\\1", html.escape(" ".join(text.split()), quote=False))


def _code(text: str) -> str:
    """Text from others inside backticks."""
    return " ".join(text.split()).replace("`", "'")
