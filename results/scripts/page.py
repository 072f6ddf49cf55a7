"""The template of the pages under `results/`: question, answer, picture, files, what made it and on what machine."""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, PngImagePlugin

from vibench import provenance
from vibench.report.figures.style import caption_of, first_sentence, save
from vibench.results import formats
from vibench.results.read import in_order, read_table, results_file

ONE_MACHINE = "All seconds were measured on one machine."

LIMITATIONS = {
    "paper-obstacle": f"{ONE_MACHINE} The norm of V and the map of the mesh are not published; ours may differ. With full assembly, every query projects matrices of mesh size in Python.",  # noqa: E501
    "paper-hertz": f"{ONE_MACHINE} Quadrature and master mesh of the paper are not published; N and R depend on them (page hertz-quadrature). Full assembly does not make use of A being constant.",  # noqa: E501
    "benefit": f"{ONE_MACHINE} One cone (mCPG), two pairs of dimensions and one solver for each problem. Gains are those of models with different errors: compare rows with equal errors.",  # noqa: E501
    "field": f"{ONE_MACHINE} One mesh of medium size for each problem, one solver, 32 validation parameters. Strategies of others are our implementations, with their default options.",  # noqa: E501
    "enriching": f"{ONE_MACHINE} Three problems, two cones and one enrichment. The pack has one mesh, and PIQP solves all programs.",  # noqa: E501
    "certified": f"{ONE_MACHINE} One cone (mCPG) in `certified`. Effectivities are those at 64 parameters; bounds of the obstacle rely on interpolation errors that were measured at other parameters. Greedy training chooses among bounds that are nearly equal: on another processor, with other round-off, it may choose others.",  # noqa: E501
    "calibration": f"{ONE_MACHINE} One seed, and one set of synthetic data for each level of noise.",
    "calibrations": f"{ONE_MACHINE} It was busy: seconds are to be compared within a row. One tolerance of the cone.",
    "formulations": f"{ONE_MACHINE} Formulations are our implementations of published methods on assembled operators, with their default options and one accuracy; methods of their authors may differ in what they integrate and solve.",  # noqa: E501
    "hertz-quadrature": "One problem; eight validation parameters. Variants that are not in the table, such as other pairings, were not tried.",  # noqa: E501
    "meshes": "Two obstacle meshes and three of Hertz contact, all of one size: what holds on finer ones is not shown.",
    "solvers": f"{ONE_MACHINE} Solvers have their default options but for the accuracy, and solve small dense programs; larger or sparse ones may order them differently.",  # noqa: E501
    "sequences": f"{ONE_MACHINE} One path, one cone and one enrichment for each problem; programs are small and dense. Starts are those that qpsolvers passes on.",  # noqa: E501
    "scaling": "Each mesh was measured once, on one machine. Exponents between two sizes contain the noise of both measurements.",  # noqa: E501
    "speed": f"{ONE_MACHINE} The transcription is ours and not the code of the authors.",
    "stability-per-vector": "One mesh and one pair of N and R for each problem; the counts are those of the training set.",  # noqa: E501
    "three-dimensions": f"{ONE_MACHINE} One problem, a convex contact without friction, on the meshes named above; one factorisation.",  # noqa: E501
    "machines": "Two machines, both virtual with two cores; a host that is disturbed changes ratios of seconds, too. Tables of an earlier protocol stay until they are measured again.",  # noqa: E501
    "paper-figures": "Curves of the paper were not digitised: its statements are compared with our curves. Meshes and quadrature of the paper are not published, so that N, R and constants differ.",  # noqa: E501
    "friction": f"{ONE_MACHINE} One problem on a mesh of medium size, with a closed form, and A constant. Discs, second-order cones and Coulomb's law have no models; corrected pairs of the dual program are made by this script and not by a study.",  # noqa: E501
    "exact-answers": "The problem has radial symmetry and a circular contact; rates of other problems are not shown.",
    "hertz-theory": "The theory assumes small deformations and half-planes, whereas the problem has discs of finite size: deviations of some per cent are due to the difference of the models, and not to the discretisation alone.",  # noqa: E501
}
"""What a page does not show, by its folder; it is said at its end."""

NAMED = 6
"""Curves whose names the alternative text of a figure gives."""

CERTIFIED = "certified"
"""Assembly of queries with bounds, in committed tables."""

SECONDS = "Seconds are CPU seconds on one thread."


class Page:
    """A page of a folder under `results/`, at most a screen: question, answer, a picture, a table, files and limits.

    Parameters
    ----------
    target
        Folder; it is made if there is none.
    question
        Heading.
    command
        What makes the page, as `made_by` gives it.
    *about
        Sentences after the command.
    machine
        Where seconds were measured and by which versions; "" if the page has none: it says the commit alone.
    """

    def __init__(self, target: str | Path, question: str, command: str, *about: str, machine: str = "") -> None:
        self.folder, self._question = Path(target), question
        self.folder.mkdir(parents=True, exist_ok=True)
        where = f"on {machine}" if machine else f"with vibench {provenance.versions(None)['vibench']}"
        self._made = " ".join(" ".join([f"Generated by `{command}` {where}.", *about]).split())
        self._answer, self._files = list[str](), list[str]()

    def answer(self, *parts: str | pd.DataFrame) -> None:
        """What the page has found: sentences, and at most one short table."""
        for part in parts:
            shown = formats.to_markdown(part).strip() if isinstance(part, pd.DataFrame) else " ".join(part.split())
            self._answer.append(shown)

    def draw(self, name: str, figure: Figure) -> None:
        """A picture, written beside the page, and the first sentence of its caption; later ones are links."""
        file, caption = write_figure(figure, self.folder, name), escaped(first_sentence(caption_of(figure)))
        if any(part.startswith("![") for part in self._answer):
            self.also(f"[{file.name}]({file.name})", caption)
        else:
            self.answer(f"![{alternative(figure, name)}]({file.name})", caption)

    def file(self, name: str, about: str, frame: pd.DataFrame) -> None:
        """A table, written beside the page as CSV with six digits, and what it holds."""
        frame.to_csv(self.folder / f"{name}.csv", index=False, float_format="%.6g")
        self.also(f"[{name}.csv]({name}.csv)", about)

    def also(self, link: str, about: str) -> None:
        """A link to what is beside the page, and what it holds."""
        self._files.append(f"- {link}: {' '.join(about.split())}")

    @property
    def text(self) -> str:
        """The page in Markdown."""
        files = ["## Tables", "\n".join(self._files)] if self._files else []
        return "\n\n".join([f"# {self._question}", *self._answer, *files, "## How it was made", self._made]) + "\n"

    def write(self) -> None:
        """Write the page."""
        (self.folder / "README.md").write_text(self.text + limitations(self.folder), encoding="utf-8")


def limitations(folder: Path) -> str:
    """The end of a page of a folder: what it does not show; "" where nothing is said of it."""
    limits = LIMITATIONS.get(folder.name)
    return f"\n## Limitations\n\n{limits}\n" if limits else ""


def span(values: pd.Series) -> str:
    """The range of some numbers."""
    return formats.decimal_interval(values.min(), values.max())


def alternative(figure: Figure, name: str) -> str:
    """A sentence that stands where a figure is not shown: what its panels have on their axes, and who is in them.

    Of a figure without labels at its axes it is the first one of the caption, or what its name says.
    """
    panels = [axes for axes in figure.axes if axes.get_visible()]
    across, up = _labels(panels, Axes.get_xlabel, "colspan"), _labels(panels, Axes.get_ylabel, "rowspan")
    labels = [(x, y) for x, y in zip(across, up, strict=True) if x and y]
    if not labels:
        return _in_brackets(first_sentence(caption_of(figure)) or f"Figure {name}.")
    shown = dict.fromkeys(f"{y} over {x}" for x, y in labels)
    legends = [*figure.legends, *filter(None, (axes.get_legend() for axes in panels))]
    named = list(dict.fromkeys(text.get_text() for legend in legends for text in legend.get_texts()))
    more = f" and {len(named) - NAMED} others" if len(named) > NAMED else ""
    whom = f", for {'; '.join(named[:NAMED])}{more}" if named else ""
    number = "One panel shows" if len(labels) == 1 else f"{len(labels)} panels show"
    return _in_brackets(" ".join(f"{number} {'; '.join(shown)}{whom}.".split()))


def _labels(panels: Sequence[Axes], get: Callable[[Axes], str], span: str) -> list[str]:
    """The labels at one axis of panels; of a panel that has none, the one in its column or row of the grid."""
    spans = [getattr(axes.get_subplotspec(), span, None) for axes in panels]
    there = {place: label for axes, place in zip(panels, spans, strict=True) if place and (label := get(axes))}
    return [get(axes) or there.get(place, "") for axes, place in zip(panels, spans, strict=True)]


def _in_brackets(text: str) -> str:
    """A text that may stand in the square brackets of a picture."""
    return escaped(text).replace("[", "(").replace("]", ")")


def escaped(text: str) -> str:
    """A text in which Markdown finds no markup."""
    return re.sub(r"([\\`*_|<])", r"\\\1", text)


def write_figure(figure: Figure, folder: Path, name: str) -> Path:
    """A PNG file of a figure, with a palette."""
    (file,) = save(figure, folder, name, ("png",))
    use_palette(file)
    return file


def use_palette(path: Path) -> None:
    """Replace a PNG file by one with a palette of 256 colours, a third of its size."""
    with Image.open(path) as picture:
        described = PngImagePlugin.PngInfo()
        for key, text in getattr(picture, "text", {}).items():  # the caption: an image of a palette loses it otherwise
            described.add_itxt(key, str(text))
        reduced = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)  # dithering would double the size
    reduced.save(path, optimize=True, pnginfo=described)


def made_by(script: str, target: str, *studies: str, options: str = "") -> str:
    """The command that makes a page: runs of studies, then a script that gets their folders and that of the page."""
    runs = [f"vibench run {study}{options}" for study in studies]
    folders = [*(f"runs/{study}" for study in studies), f"results/{target}"]
    return " && ".join([*runs, f"python results/scripts/{script}.py {' '.join(folders)}"])


def read(run: str | Path, table: str) -> pd.DataFrame:
    """A table of a run, its rows in the order of the axes, in the words of the tables that are committed.

    There the assembly of queries with bounds is "certified", and that of the formulation `compiled` is "compiled".
    """
    frame = in_order(read_table(results_file(str(run)), table))
    for side in ("", "_a", "_b"):
        if (name := f"assembly{side}") not in frame:
            continue
        compiled = frame[f"formulation{side}"] == "compiled"
        ways = frame[name].mask(frame[f"bounds{side}"] == 1, CERTIFIED).mask(compiled, "compiled")
        frame[name], frame[f"formulation{side}"] = ways, frame[f"formulation{side}"].mask(compiled, "mixed")
        if not side and compiled.any() and frame["solver"].nunique() == 2:
            frame["solver"] = frame["solver"].mask(compiled, next(one for one in frame["solver"] if one != "–"))
    return frame.drop(columns=["bounds", "bounds_a", "bounds_b"], errors="ignore")


def origin(*cells: pd.DataFrame) -> str:
    """The machines that measured the cells of some runs, the libraries that computed them, and the commit.

    In the end the share of the timed cells whose machine was disturbed meanwhile.
    """
    every = pd.concat(cells)
    named: dict[str, set[str]] = {}
    for row in every["versions"].dropna().unique():
        for name, text in json.loads(row).items():
            named.setdefault(name, set()).add(text)
    versions = ", ".join(f"{name} {' and '.join(sorted(texts))}" for name, texts in named.items())
    timed, disturbed = int(every["disturbed"].notna().sum()), int((every["disturbed"] == 1).sum())
    share = f"{disturbed} of {timed} timed cells marked as disturbed"
    return "; ".join([*every["machine"].dropna().unique(), versions, share])


def protocols(cells: pd.DataFrame) -> set[str]:
    """The versions of the protocol by which cells were measured."""
    return {json.loads(versions)["protocol"] for versions in cells["versions"].dropna().unique()}


def start(main: Callable[..., None]) -> None:
    """Call the function of a script with the arguments of the command line, one for each of its parameters."""
    names, given = list(inspect.signature(main).parameters), sys.argv[1:]
    if len(given) != len(names):
        sys.exit(f"usage: python {sys.argv[0]} {' '.join(name.upper() for name in names)}")
    main(*given)
