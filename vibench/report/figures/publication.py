"""The figures of publications, drawn again from runs: a page with each figure, what is published, and a comparison."""

from __future__ import annotations

import html
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from vibench.errors import RequestError
from vibench.files import write_atomically
from vibench.interfaces.figures import Drawing
from vibench.plugins.kinds import FIGURE
from vibench.plugins.registry import registered
from vibench.report.figures.data import Data, file_names, problems
from vibench.report.figures.plugins import FigureError, draw_guarded, named
from vibench.report.figures.style import FORMATS, caption_of, first_sentence, save, styled
from vibench.results.plugin_columns import loaded
from vibench.results.sqlite import read_meta, study_of
from vibench.text import unbroken

PAGE = "paper-figures.md"
"""File with the page."""

MARKDOWN = re.compile(r"([\\`*_\[\]|#])")


@dataclass(frozen=True)
class Redrawn:
    """A figure of a publication that can be drawn from a run."""

    publication: str
    name: str
    draw: Drawing
    run: str
    data: Data

    @property
    def origin(self) -> str:
        """The run and the problem from which it is drawn, with the options that are not at their default."""
        options = ", ".join(f"{name} = {value}" for name, value in self.data.problem_options.items())
        return f"Run {self.run}, problem {self.data.problem}{f': {options}' * bool(options)}."


def draw_published(
    paths: Sequence[Path],
    folder: Path,
    formats: Sequence[str] = FORMATS,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    note: Callable[[str], None] = lambda _: None,
) -> list[Path]:
    """Draw the figures of publications for which runs have data, and write a page that compares them: `PAGE`.

    Figures of the same names and the page are replaced in the folder; the page shows the first of the formats, keys of
    `style.WRITTEN`, that a browser can. `progress` is called before a figure is drawn, with its name, the number of
    those done, and that of all, `note` with a line for every figure that could not be drawn, or that has no data.

    Raises a `RequestError` if no plugin draws figures of these runs' problems, or a figure plugin cannot be loaded.
    """
    redrawn = sorted(_redrawn(paths, note), key=lambda one: (one.publication, _natural(one.name)))
    if not redrawn:
        named_runs = ", ".join(unbroken(path.parent.name) for path in paths)
        raise RequestError(f"no installed plugin draws figures of a publication from {named_runs}")
    files: list[Path] = []
    drawn: list[tuple[Redrawn, Figure]] = []
    folder.mkdir(parents=True, exist_ok=True)
    for k, one in enumerate(redrawn):
        progress(one.name, k, len(redrawn))
        with styled():
            try:
                figure = one.draw()
            except FigureError as error:
                note(str(error))
                continue
            if figure is None:
                note(f"{one.name}: {one.run} has no data for it")
                continue
            files += save(figure, folder, one.name, formats)
        drawn.append((one, figure))
    shown = next((form for form in formats if form != "pdf"), formats[0])  # no page shows a PDF
    write_atomically(folder / PAGE, _page(drawn, paths, shown).encode("utf-8"))
    return files


def _redrawn(paths: Sequence[Path], note: Callable[[str], None]) -> Iterator[Redrawn]:
    """What can be drawn; of figures that several runs have, each after the first is named after its run."""
    seen = Counter[str]()
    plugins = {name: loaded(name) for name in registered(FIGURE)}  # one that cannot be loaded may be asked for
    for path in paths:
        (run,) = file_names([path.parent.name])
        for _, data in problems(path, note=note):
            for plugin_name, plugin in plugins.items():
                try:
                    kinds = list(named(plugin_name, plugin, data)) if plugin.publication else []
                except FigureError as error:
                    note(str(error))
                    continue
                for kind, draw in kinds:
                    seen[kind] += 1
                    name = kind + f"-{run}" * (seen[kind] > 1) + f"-{seen[kind]}" * (seen[kind] > 2)
                    drawn = partial(draw_guarded, plugin_name, name, draw)
                    yield Redrawn(plugin.publication, name, drawn, path.parent.name, data)


def _page(drawn: Sequence[tuple[Redrawn, Figure]], paths: Sequence[Path], form: str) -> str:
    """The page in Markdown."""
    runs = [path.parent.name for path in paths]
    studies = list(dict.fromkeys(str(study_of(path, read_meta(path)).get("name", "")) for path in paths))
    machines = list(dict.fromkeys(one.data.machine for one, _ in drawn))
    parts = ["# Figures of a publication, drawn again"]
    parts += [f"{_text(publication)}." for publication in dict.fromkeys(one.publication for one, _ in drawn)]
    parts.append(
        f"Drawn by `vibench figures {_code(' '.join(runs))} --paper` from runs of the studies "
        f"{', '.join(f'`{_code(study)}`' for study in studies)}, measured on {_text('; '.join(machines))}. Below each "
        "figure: its caption, what the publication says of it in text, captions and tables, and what agrees and what "
        "differs, computed from the run. No curve was read off a published figure."
    )
    for one, figure in drawn:
        published, compared = (getattr(figure, name, "") for name in ("published", "compared"))
        title = one.name.replace("-", " ").capitalize()
        parts += [
            f"## {_text(title)}",
            f"![{_text(first_sentence(caption_of(figure)))}]({one.name}.{form})",
            f"{_text(caption_of(figure))} {_text(one.origin)}",
            *([f"**Published.** {_text(published)}"] if published else []),
            *([f"**Here.** {_text(compared)}"] if compared else []),
        ]
    return "\n\n".join(parts) + "\n"


def _text(text: str) -> str:
    """Text from others in Markdown: one line, in which no character acts."""
    return MARKDOWN.sub(r"\\\1", html.escape(unbroken(text), quote=False))


def _code(text: str) -> str:
    """Text from others inside backticks."""
    return unbroken(text).replace("`", "'")


def _natural(name: str) -> list[tuple[int, str]]:
    """A name for sorting: numbers by value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
