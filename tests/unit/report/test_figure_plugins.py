"""Figures of plugins: drawn with a run, refused or reported in a line, and never the end of a run or a report."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
from matplotlib.figure import Figure
from running import Changed, Main, Register

import vibench
from vibench.errors import RequestError
from vibench.interfaces.figures import FigurePlugin, ProblemTables
from vibench.plugins import registry
from vibench.plugins.kinds import FIGURE
from vibench.report import CaptionedFigure, Looks, Series, Sheet, figures, html, scatter
from vibench.report.figures import publication
from vibench.report.figures.plugins import FigureError

GROUP, HERE = "vibench.figures", __name__


class Sizes(FigurePlugin):
    """A figure with a caption of its own, and one that has nothing to show."""

    def drawings(self, tables: ProblemTables) -> Mapping[str, Callable[..., Figure | None]]:
        if tables.problem_name != "obstacle":
            return {}

        def sizes() -> Figure:
            """Sizes of the reduced spaces."""
            figure = Figure()
            figure.subplots().plot(tables.cells["N"], tables.cells["R"], "o")
            return figure

        def captioned() -> Figure:
            sheet = Sheet(1, 1, "sizes")
            name = str(tables.cells["primal"].iloc[0])
            scatter(sheet.panels[0], [1.0], [2.0], Looks([Series(name)])[Series(name)])
            return sheet.finish("A caption of its own.")

        return {"": partial(sizes), "captioned": captioned, "none": lambda: None}


class Twins(Sizes):
    """The same as figures of a publication."""

    publication: ClassVar[str] = "Author, Title with_underscores & <tags>, 2020"

    def drawings(self, tables: ProblemTables) -> Mapping[str, Callable[[], Figure | None]]:
        found = super().drawings(tables)

        def twin() -> Figure:
            figure = CaptionedFigure()
            figure.subplots().plot([0.0, 1.0], [0.0, 1.0])
            figure.caption, figure.published = "What is [shown].", "N = 19."
            figure.compared = f"Differs: N = {tables.cells['N'].iloc[0]:.0f}."
            return figure

        return {"figure-10": twin, "figure-9": found["captioned"], "figure-11": found["none"]} if found else {}


class Raises(FigurePlugin):
    """Raises when it is asked what it draws."""

    def drawings(self, tables: ProblemTables) -> Mapping[str, Callable[[], Figure | None]]:
        raise ValueError("no\nidea")


class Mute(Raises):
    """The same of a publication."""

    publication: ClassVar[str] = "Another"


class Fails(FigurePlugin):
    """Raises when it draws, and draws what is no figure, or cannot be rendered."""

    def drawings(self, tables: ProblemTables) -> Mapping[str, Any]:
        def divided() -> Figure:
            raise ZeroDivisionError("by zero")

        def unrendered() -> Figure:
            figure = Figure()
            figure.suptitle("$x^{$")
            figure.texts[0].set_parse_math(True)
            return figure

        return {"divided": divided, "text": lambda: "no figure", "unrendered": unrendered}


class Wrong(FigurePlugin):
    """Returns a list."""

    def drawings(self, tables: ProblemTables) -> Any:
        return [1]


class Needy(Sizes):
    """Needs what is not installed."""

    requires = ("no-such-distribution",)


class Unready(Sizes):
    """Cannot be created."""

    def __init__(self) -> None:
        raise OSError("no file")


def plain() -> None:
    """No class."""


BROKEN = {
    "raises": "figure plugin 'raises' has no figures of obstacle: ValueError: no idea",
    "wrong": "figure plugin 'wrong' returned list, expected functions by their names",
    "needy": "figure plugin 'needy' needs no-such-distribution, which is not installed",
    "unready": "figure plugin 'unready' cannot be created: OSError: no file",
    "plain": f"figure plugin 'plain' ({HERE}:plain) is not a subclass of FigurePlugin",
    "missing": f"figure plugin 'missing' ({HERE}:Missing) cannot be loaded: AttributeError",
    "inf-sup": "figure plugin 'inf-sup' has the name of a figure of vibench, and needs another",
    "twice": "two packages provide the figure plugin 'twice', so that none is used",
}


@pytest.fixture(scope="module")
def results(quick_run: Path) -> Path:
    return quick_run / "results.sqlite"


def registered(register: Register, *names: str) -> None:
    members = {name: name.capitalize() for name in names} | {"plain": "plain", "inf-sup": "Sizes"}
    entries = [(GROUP, name, f"{HERE}:{members[name]}") for name in names if name != "twice"]
    if "twice" in names:
        entries += [(GROUP, "twice", f"{HERE}:Sizes"), (GROUP, "twice", f"{HERE}:Twins")]
    register(*entries)


def of_plugins(results: Path) -> dict[str, Any]:
    """Figures of plugins, or why they cannot be drawn, by the names of their files."""
    found: dict[str, Any] = {}
    for name, draw, data in figures.drawings(results):
        if draw not in {*figures.OF_PROBLEM.values(), *figures.OF_DUAL.values()}:
            try:
                found[name] = next(iter(draw(data)), None)
            except FigureError as error:
                found[name] = str(error)
    return found


def test_a_plugin_adds_its_figures_with_captions(register: Register, results: Path) -> None:
    registered(register, "sizes")
    found = of_plugins(results)
    assert set(found) == {"obstacle-sizes", "obstacle-sizes-captioned", "obstacle-sizes-none"}
    assert found["obstacle-sizes-none"] is None
    assert figures.caption_of(found["obstacle-sizes"]) == "Sizes of the reduced spaces."
    assert figures.caption_of(found["obstacle-sizes-captioned"]) == "A caption of its own."


@pytest.mark.parametrize(("name", "line"), BROKEN.items())
def test_what_cannot_be_used_is_a_line(name: str, line: str, register: Register, results: Path) -> None:
    registered(register, name)
    found = of_plugins(results)
    assert set(found) == {f"obstacle-{name}", f"hertz-{name}"}
    assert found[f"obstacle-{name}"].startswith(line)
    assert "\n" not in found[f"obstacle-{name}"]


def test_figures_that_fail_are_reported_and_the_others_are_drawn(
    register: Register, changed: Changed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered(register, "fails", "sizes")
    monkeypatch.setattr(figures, "OF_PROBLEM", {kind: figures.OF_PROBLEM[kind] for kind in ("errors", "outputs")})
    path = changed("DELETE FROM queries WHERE problem = 'hertz' OR dual = 'cpg'")
    lines: list[str] = []
    files = figures.draw_all(path, tmp_path / "figures", ("svg",), note=lines.append)
    assert [line.partition(":")[0] for line in lines] == [
        "figure 'divided' of figure plugin 'fails' cannot be drawn",
        "figure 'text' of figure plugin 'fails' is a str, expected a matplotlib Figure or None",
        "figure 'unrendered' of figure plugin 'fails' cannot be drawn",
    ]
    names = {path.stem for path in files}
    assert {"obstacle-sizes", "obstacle-sizes-captioned", "obstacle-errors"} <= names
    captions = figures.read_captions(tmp_path / "figures")
    assert captions["obstacle-sizes"] == "Sizes of the reduced spaces."
    assert not [name for name in captions if "fails" in name]
    figures.remove(tmp_path / "figures")
    assert list((tmp_path / "figures").iterdir()) == []


def test_a_report_has_the_figures_of_plugins_and_says_which_failed(
    register: Register, changed: Changed, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered(register, "fails", "sizes")
    path = changed("DELETE FROM queries WHERE problem = 'hertz' OR dual = 'cpg'")
    monkeypatch.setattr(figures, "OF_PROBLEM", {})
    monkeypatch.setattr(figures, "OF_DUAL", {})
    text = html.page(path)
    line = "figure &#39;divided&#39; of figure plugin &#39;fails&#39; cannot be drawn: ZeroDivisionError: by zero"
    assert line in text
    assert "A caption of its own." in text


def test_one_figure_of_a_plugin_is_drawn_from_python(register: Register, results: Path) -> None:
    registered(register, "sizes", "fails")
    run = vibench.Run(results)
    assert run.figure("sizes", problem="obstacle").axes
    with pytest.raises(RequestError, match="no data for the figure 'sizes-none'"):
        run.figure("sizes-none", problem="obstacle")
    with pytest.raises(vibench.VibenchError, match="by zero"):
        run.figure("fails-divided", problem="hertz")
    with pytest.raises(RequestError, match="did you mean 'sizes'"):
        run.figure("size", problem="obstacle")


def test_figures_of_a_publication_are_drawn_on_request_alone(register: Register, results: Path, tmp_path: Path) -> None:
    registered(register, "twins", "sizes")
    assert not [name for name in of_plugins(results) if "twins" in name or "figure-10" in name]
    lines: list[str] = []
    files = publication.draw_published([results], tmp_path / "twins", ("png", "pdf"), note=lines.append)
    assert [file.name for file in files] == ["figure-9.png", "figure-9.pdf", "figure-10.png", "figure-10.pdf"]
    assert lines == ["figure-11: quick has no data for it"]
    text = (tmp_path / "twins" / publication.PAGE).read_text(encoding="utf-8")
    assert "Author, Title with\\_underscores &amp; &lt;tags&gt;, 2020." in text
    assert text.index("## Figure 9") < text.index("## Figure 10")
    assert "What is \\[shown\\]. Run quick, problem obstacle: resolution = coarse.\n\n**Published.** N = 19." in text
    assert "**Here.** Differs: N = " in text
    assert "![What is \\[shown\\].](figure-10.png)" in text  # its alternative text is the first sentence of the caption


def test_a_publication_that_raises_is_a_line_and_the_others_are_drawn(
    register: Register, results: Path, tmp_path: Path
) -> None:
    registered(register, "mute", "twins")
    lines: list[str] = []
    files = publication.draw_published([results], tmp_path, ("png",), note=lines.append)
    assert [file.stem for file in files] == ["figure-9", "figure-10"]
    assert "figure plugin 'mute' has no figures of obstacle: ValueError: no idea" in lines


def test_several_runs_have_figures_of_their_own(register: Register, results: Path, tmp_path: Path) -> None:
    registered(register, "twins")
    files = publication.draw_published([results, results], tmp_path, ("png",))
    assert [file.stem for file in files] == ["figure-9", "figure-9-quick", "figure-10", "figure-10-quick"]


@pytest.mark.parametrize("names", [(), ("sizes",)])
def test_without_a_publication_a_run_has_no_twins(names: tuple[str, ...], register: Register, results: Path) -> None:
    registered(register, *names)
    with pytest.raises(RequestError, match="no installed plugin draws figures of a publication from quick"):
        publication.draw_published([results], Path("nowhere"))
    assert not Path("nowhere").exists()


def test_a_publication_that_cannot_be_loaded_is_a_refusal(register: Register, results: Path, tmp_path: Path) -> None:
    registered(register, "twins", "unready")
    with pytest.raises(RequestError, match="cannot be created: OSError: no file"):
        publication.draw_published([results], tmp_path / "twins")
    assert not (tmp_path / "twins").exists()


def test_the_command_draws_in_the_formats_that_are_asked_for(
    register: Register, results: Path, tmp_path: Path, main: Main, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered(register, "twins", "sizes")
    kinds = {"errors": figures.OF_PROBLEM["errors"]}
    monkeypatch.setattr(figures, "OF_PROBLEM", kinds)
    monkeypatch.setattr(figures, "OF_DUAL", {})
    folder = str(results.parent)
    code, printed, _ = main("figures", folder, "--format", "pdf", "--out", str(tmp_path / "own"), "-j", "1")
    assert code == 0
    assert {path.name for path in (tmp_path / "own").glob("*.pdf")} == {
        "obstacle-errors.pdf", "hertz-errors.pdf", "obstacle-sizes.pdf", "obstacle-sizes-captioned.pdf",
    }  # fmt: skip
    assert not list((tmp_path / "own").glob("*.svg"))
    code, printed, _ = main("figures", folder, "--paper", "--format", "svg", "--out", str(tmp_path / "twins"))
    assert code == 0
    assert f"page: {tmp_path / 'twins' / publication.PAGE}" in printed
    again = shutil.copytree(results.parent, tmp_path / "again", ignore=lambda *_: {"figures", "tables"})
    code, _, line = main("figures", folder, str(again), "--out", str(tmp_path / "both"))
    assert code == 2
    assert "--out is for the figures of one run" in line
    assert not (tmp_path / "both").exists()
    code, _, line = main("figures", folder, "--format", "eps")
    assert code == 2
    assert "'eps' is not one of 'png', 'svg', 'pdf'" in line


def test_the_plugins_that_are_shipped_load() -> None:
    for name in registry.registered(FIGURE):
        assert issubclass(registry.find(FIGURE, name).load(), FigurePlugin)
        assert (registry.find(FIGURE, name).load().__doc__ or "").strip()
