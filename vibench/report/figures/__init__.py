"""Figures of a run, drawn from its results file alone."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from vibench.errors import RequestError, foreign, in_a_line, unknown_name
from vibench.files import read_regular, write_atomically
from vibench.text import json_object

with foreign("matplotlib"):
    from matplotlib.figure import Figure

    from vibench.report.figures.answer_sheet import answer
    from vibench.report.figures.data import ProblemTables, file_names, problem_tables
    from vibench.report.figures.effectivity import bounds
    from vibench.report.figures.qp_solvers import solvers
    from vibench.report.figures.solutions import solutions
    from vibench.report.figures.spaces import convergence, inf_sup
    from vibench.report.figures.style import CaptionedFigure, caption_of, save, styled

Draw = Callable[[ProblemTables], CaptionedFigure | None]

# Figures by the end of their file names, and whether every dual strategy of a problem has one.
KINDS: dict[str, tuple[Draw, bool]] = {
    "answer": (answer, False), "solutions": (solutions, False), "convergence": (convergence, False),
    "bounds": (bounds, False), "solvers": (solvers, False), "inf-sup": (inf_sup, True),
}  # fmt: skip

# A figure to be drawn: name of its file, function that draws it, and its data.
FigureTask = tuple[str, Draw, ProblemTables]
Made = TypeVar("Made")
Progress = Callable[[str, int, int], None]


def drawings(problems: Iterable[tuple[str, ProblemTables]], kinds: Collection[str]) -> Iterator[FigureTask]:
    """Every figure of some kinds that problems may have; names begin with that of their problem."""
    for name, data in problems:
        chosen = {kind: KINDS[kind] for kind in KINDS if kind in kinds}
        yield from ((f"{name}-{kind}", draw, data) for kind, (draw, of_dual) in chosen.items() if not of_dual)
        of_duals = {kind: draw for kind, (draw, of_dual) in chosen.items() if of_dual}
        for dual, file in zip(data.duals, file_names(data.duals), strict=True) if of_duals else ():
            of_cone = data.restrict_to_dual(dual)
            yield from ((f"{name}-{file}-{kind}", draw, of_cone) for kind, draw in of_duals.items())


def draw(path: Path, kind: str, problem: str | None = None, dual: str | None = None) -> Figure:
    """One figure of a results file.

    Its kind is a key of `KINDS`. The problem is given by its label ("LABEL, TRAINING" where it has several training
    sets), the dual strategy for a kind that every one has by its own; `None` is for the only one.

    Raises a `RequestError` if there is no such figure, or nothing to draw in it.
    """
    by_problem = {data.problem: data for _, data in problem_tables(path)}
    if kind not in KINDS:
        raise unknown_name("figure", kind, KINDS)
    data, (drawn, of_dual) = _only("problem", by_problem, problem), KINDS[kind]
    if of_dual:
        data = _only("dual strategy", {name: data.restrict_to_dual(name) for name in data.duals}, dual)
    elif dual is not None and dual not in data.duals:
        raise unknown_name("dual strategy", dual, data.duals)
    with styled():
        figure = drawn(data)
    if figure is None:
        raise RequestError(f"the run has no data for the figure '{kind}' of {data.problem}")
    return figure


def _only(noun: str, by_label: Mapping[str, ProblemTables], label: str | None) -> ProblemTables:
    if label is None:
        if len(by_label) != 1:
            hint = f"name one of {', '.join(by_label)}" if by_label else "the run has none with queries"
            raise RequestError(f"the figure is of one {noun}: {hint}")
        return next(iter(by_label.values()))
    if label not in by_label:
        raise unknown_name(noun, label, by_label)
    return by_label[label]


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
