"""The style of figures: labels are text of others and are drawn as they are."""

from __future__ import annotations

import io
from xml.etree import ElementTree

import matplotlib as mpl
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from vibench.report.figures.data import file_names
from vibench.report.figures.style import Sheet, plot, styled, write_figure
from vibench.text import printable

LABELS = [
    "$", "$x$", "$x^{ $", r"$\frac{", r"\$ $a", "_hidden", "__", "_", "漢字 שלום नमस्ते", "-->", "]]>", "<b>&amp;",
    "50 % #1 ~^\\", "", " ", "a  b", "x" * 4000, "{}{0}%s%(x)s",
]  # fmt: skip


def sheet(text: str) -> Figure:
    """A figure with a text wherever one from others may stand."""
    made = Sheet(1, 2, text)
    for panel in made.panels:
        plot(panel, [1.0, 2.0], [1.0, 10.0], 0, text)
        panel.set(xlabel=text, ylabel=text, title=text, yscale="log")
    return made.finish()


def drawn(text: str, form: str = "svg") -> tuple[Figure, bytes]:
    stream = io.BytesIO()
    with styled():
        figure = sheet(text)
        write_figure(figure, stream, form)
    return figure, stream.getvalue()


@pytest.mark.parametrize("text", LABELS)
def test_a_label_is_drawn_as_it_is(text: str) -> None:
    figure, svg = drawn(text)
    ElementTree.fromstring(svg)
    for panel in figure.axes:
        assert panel.get_xlabel() == panel.get_ylabel() == panel.get_title() == text
    shown = [found.get_text() for legend in figure.legends for found in legend.get_texts()]
    assert shown == [f" {text}" if text.startswith("_") else text] * bool(text)


@pytest.mark.parametrize("text", ["$x^{ $", "漢字"])
def test_a_label_is_drawn_in_a_picture_of_dots(text: str) -> None:
    assert drawn(text, "png")[1].startswith(b"\x89PNG")


@settings(max_examples=30)
@given(st.text(st.characters(), max_size=60))
@example("$$")
@example("\\$_^{$")
def test_any_label_can_be_drawn(text: str) -> None:
    _, svg = drawn(printable(text))
    ElementTree.fromstring(svg)
    assert all(line.isprintable() for line in svg.decode("utf-8").split("\n"))


def test_the_settings_of_the_user_make_no_formula_of_a_label(monkeypatch: pytest.MonkeyPatch) -> None:
    with mpl.rc_context({"text.usetex": True, "axes.formatter.use_mathtext": True, "text.parse_math": True}):
        drawn("$x^{ $")


@given(st.lists(st.text(st.characters()) | st.sampled_from(["a", "a-1", "a-2", "[a]", "漢" * 80]), max_size=6))
def test_labels_have_different_file_names_that_a_file_system_takes(labels: list[str]) -> None:
    names = file_names(labels)
    assert len(set(names)) == len(labels)
    assert all(0 < len(name.encode()) <= 100 and "/" not in name and not name.startswith(".") for name in names)


def test_file_names_are_the_labels_where_they_can_be() -> None:
    assert file_names(["obstacle", "a b", "a/b", "$", "δ = 0.1"]) == [
        "obstacle",
        "a-b-1",
        "a-b-2",
        "unnamed",
        "δ-=-0.1",
    ]
