"""Figures of a run, drawn from its results file alone."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from vibench.errors import RequestError, foreign, in_a_line, unknown_name
from vibench.files import read_regular, write_atomically
from vibench.text import json_object

with foreign("matplotlib cannot be used"):
    from matplotlib.figure import Figure

    from vibench.report.figures.answer_sheet import answer
    from vibench.report.figures.data import ProblemTables, problem_tables
    from vibench.report.figures.effectivity import bounds
    from vibench.report.figures.qp_solvers import solvers
    from vibench.report.figures.solutions import solutions
    from vibench.report.figures.spaces import convergence
    from vibench.report.figures.style import CaptionedFigure, caption_of, save, styled

Draw = Callable[[ProblemTables], CaptionedFigure | None]

# Figures by the end of their file names.
KINDS: dict[str, Draw] = {
    "answer": answer, "solutions": solutions, "convergence": convergence, "bounds": bounds, "solvers": solvers,
}  # fmt: skip

# A figure to be drawn: name of its file, function that draws it, and its data.
FigureTask = tuple[str, Draw, ProblemTables]
Made = TypeVar("Made")
Progress = Callable[[str, int, int], None]


def drawings(problems: Iterable[tuple[str, ProblemTables]], kinds: Collection[str]) -> Iterator[FigureTask]:
    """Every figure of some kinds that problems may have; names begin with that of their problem."""
    for name, data in problems:
        yield from ((f"{name}-{kind}", KINDS[kind], data) for kind in KINDS if kind in kinds)


def draw(path: Path, kind: str, problem: str | None = None) -> Figure:
    """One figure of a results file.

    Its kind is a key of `KINDS`. The problem is given by its label ("LABEL, TRAINING" where it has several training
    sets); `None` is for the only one.

    Raises a `RequestError` if there is no such figure, or nothing to draw in it.
    """
    by_label = {data.problem: data for _, data in problem_tables(path)}
    if kind not in KINDS:
        raise unknown_name("figure", kind, KINDS)
    if problem is None and len(by_label) != 1:
        hint = f"name one of {', '.join(by_label)}" if by_label else "the run has none with queries"
        raise RequestError(f"the figure is of one problem: {hint}")
    if problem is not None and problem not in by_label:
        raise unknown_name("problem", problem, by_label)
    data = by_label[problem] if problem is not None else next(iter(by_label.values()))
    with styled():
        figure = KINDS[kind](data)
    if figure is None:
        raise RequestError(f"the run has no data for the figure '{kind}' of {data.problem}")
    return figure


def remove(folder: Path) -> None:
    """Remove the figures that an earlier call of `draw_all` may have left in a folder; other files stay."""
    own = re.compile(rf".*-({'|'.join(map(re.escape, KINDS))})(-\d+)?\.(png|svg|pdf)")
    captioned = {f"{name}.{form}" for name in read_captions(folder) for form in ("png", "svg", "pdf")}
    for file in folder.glob("*"):
        if file.is_file() and (file.name in captioned or file.name == "captions.json" or own.fullmatch(file.name)):
            file.unlink()


def read_captions(folder: Path) -> dict[str, str]:
    """The captions beside the figures of a folder, by the names of the figures; empty where there are none."""
    try:
        captions = json_object(read_regular(folder / "captions.json").decode())
    except (OSError, UnicodeDecodeError):
        return {}
    return {name: str(text) for name, text in (captions or {}).items()}


def draw_all(
    path: Path,
    folder: Path,
    formats: tuple[str, ...],
    progress: Progress = lambda *_: None,
    kinds: Collection[str] | None = None,
) -> tuple[list[Path], list[str]]:
    """Draw every figure that a results file has data for, or those of some kinds, in every format.

    Returns the files written to the folder, and a line for every figure that could not be drawn. Beside them is
    `captions.json`, with the caption of every figure by the name of its files.

    Formats are "png", "svg" and "pdf". `progress` is called before a figure is drawn, with its name, the number of
    those done, and that of all there may be.
    """

    def write(name: str, figure: Figure) -> tuple[str, str, list[Path]]:
        folder.mkdir(parents=True, exist_ok=True)
        return name, caption_of(figure), save(figure, folder, name, formats)

    made, failures = render(list(drawings(problem_tables(path), KINDS if kinds is None else kinds)), write, progress)
    if made:
        captions = read_captions(folder) | {name: caption for name, caption, _ in made}
        text = json.dumps(captions, ensure_ascii=False, indent=1) + "\n"
        write_atomically(folder / "captions.json", text.encode("utf-8"))
    return [file for *_, files in made for file in files], failures


def render(
    tasks: Sequence[FigureTask], finish: Callable[[str, Figure], Made], progress: Progress = lambda *_: None
) -> tuple[list[Made], list[str]]:
    """Draw figures; returns the results of `finish(name, figure)` of all of them, and a line for each that fails."""
    rendered: list[Made] = []
    failures: list[str] = []
    for k, (name, drawn, data) in enumerate(tasks):
        progress(name, k, len(tasks))
        with styled():
            try:
                if (figure := drawn(data)) is not None:
                    rendered.append(finish(name, figure))
            except OSError:
                raise
            except Exception as error:  # noqa: BLE001  results nobody thought of cost their figure, not the run
                failures.append(f"the figure '{name}' could not be drawn: {in_a_line(error)}")
    progress("", len(tasks), len(tasks))
    return rendered, failures
