import io
from itertools import combinations, product
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure

from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import registered
from vibench.report import Layout, Looks, Series, Sheet, plot, styled
from vibench.report.figures.data import file_names
from vibench.report.figures.style import COLOURS, caption_of, look_of, write_figure
from vibench.text import printable

SOLVERS = ("piqp", "proxqp", "osqp", "clarabel", "daqp", "quadprog", "highs", "scs", "cvxopt", "ecos")

LABELS = [
    "$", "$x$", "$x^{ $", r"$\frac{", r"\$ $a", "_hidden", "__", "_", "漢字 שלום नमस्ते", "-->", "]]>", "<b>&amp;",
    "50 % #1 ~^\\", "", " ", "a  b", "x" * 4000, "{}{0}%s%(x)s",
]  # fmt: skip


def sheet(text: str) -> Figure:
    """A figure with a text wherever one from others may stand."""
    made = Sheet(1, 1, text)
    for panel in made.panels:
        plot(panel, [1.0, 2.0], [1.0, 10.0], look_of(text), text)
        panel.set(xlabel=text, ylabel=text, title=text, yscale="log")
    return made.finish(text)


def drawn(text: str, form: str = "svg") -> tuple[Figure, bytes]:
    stream = io.BytesIO()
    with styled():
        figure = sheet(text)
        write_figure(figure, stream, form)
    return figure, stream.getvalue()


@pytest.mark.long
def test_a_label_is_drawn_as_it_is_whatever_the_settings_of_the_user() -> None:
    for text in LABELS:
        figure, svg = drawn(text)
        ElementTree.fromstring(svg)
        for panel in figure.axes:
            assert panel.get_xlabel() == panel.get_ylabel() == panel.get_title() == text
        shown = [found.get_text() for legend in figure.legends for found in legend.get_texts()]
        assert shown == [f" {text}" if text.startswith("_") else text] * bool(text)
    assert all(drawn(text, "png")[1].startswith(b"\x89PNG") for text in ("$x^{ $", "漢字"))
    with mpl.rc_context({"text.usetex": True, "axes.formatter.use_mathtext": True, "text.parse_math": True}):
        drawn("$x^{ $")


@settings(max_examples=10)
@given(st.text(st.characters(), max_size=60))
@example("$$")
@example("\\$_^{$")
def test_any_label_can_be_drawn(text: str) -> None:
    _, svg = drawn(printable(text))
    ElementTree.fromstring(svg)
    assert all(line.isprintable() for line in svg.decode("utf-8").split("\n"))


@given(st.lists(st.text(st.characters()) | st.sampled_from(["a", "a-1", "a-2", "[a]", "漢" * 80]), max_size=6))
def test_labels_have_different_file_names_that_a_file_system_takes(labels: list[str]) -> None:
    names = file_names(labels)
    assert len(set(names)) == len(labels)
    assert all(0 < len(name.encode()) <= 100 and "/" not in name and not name.startswith(".") for name in names)
    expected = ["obstacle", "a-b-1", "a-b-2", "unnamed", "δ-=-0.1"]
    assert file_names(["obstacle", "a b", "a/b", "$", "δ = 0.1"]) == expected


NAMES = st.lists(st.text(max_size=12), min_size=1, max_size=10, unique=True)


@given(NAMES, NAMES)
def test_a_strategy_looks_the_same_where_no_other_has_its_colour(one: list[str], other: list[str]) -> None:
    """Whatever else a run compares, in whatever order, and at whatever tolerances."""
    alone, among = Looks([Series(one[0])]), Looks([Series(name, 0.5) for name in [*reversed(other), one[0]]])
    first, second = alone[Series(one[0])], among[Series(one[0], 0.5)]
    rivals = {look_of(name).colour for name in other if name != one[0]}
    assert first.colour in rivals or (first.colour, first.marker) == (second.colour, second.marker)


@given(st.lists(st.text(max_size=12), min_size=2, max_size=20, unique=True))
def test_up_to_eight_names_of_a_figure_have_eight_colours_and_more_have_markers(names: list[str]) -> None:
    looks = Looks(map(Series, names))
    found = [(looks[Series(name)].colour, looks[Series(name)].marker) for name in names]
    assert len(set(found)) == len(names)
    assert len({colour for colour, _ in found}) == min(len(names), len(COLOURS))


def test_line_styles_mean_the_assembly() -> None:
    ways = ("", "reduced", "reduced with bounds", "compiled", "corrected")
    looks = Looks([Series(name, tolerance, way) for name in "ab" for tolerance in ("", 0.1) for way in ways])
    of = {way: {str(looks[Series(n, t, way)].dashes) for n in "ab" for t in ("", 0.1)} for way in ways}
    assert all(len(styles) == 1 for styles in of.values())
    assert len({*map(str, of.values())}) == len(ways)
    assert of[""] == {"-"}


@given(NAMES, st.lists(st.floats(0.0, 1.0), max_size=6, unique=True))
def test_no_two_series_of_a_figure_look_the_same(names: list[str], tolerances: list[float]) -> None:
    series = [Series(*one) for one in product(names, ("", *tolerances), ("", "reduced"))][:10]
    looks = Looks(series)
    assert len({looks[one] for one in series}) == len(series)
    lines = [looks[one].line(9) for one in series]
    keys = ("color", "marker", "linestyle", "markerfacecolor", "markeredgewidth")
    assert len({tuple(str(line[key]) for key in keys) for line in lines}) == len(series)


def test_what_is_shipped_has_colours_and_markers_of_its_own() -> None:
    for names in (registered(PluginKind.PRIMAL), registered(PluginKind.DUAL), SOLVERS):
        looks = [look_of(name) for name in names]
        assert len(set(looks)) == len(looks)
        if len(names) <= len(COLOURS):
            assert len({look.colour for look in looks}) == len(looks)


def test_names_beside_the_ends_of_lines_do_not_overlap_nor_leave_the_panel() -> None:
    sheet = Sheet(1, 1, layout=Layout(1.9, 1.7, "every"))
    (panel,) = sheet.panels
    names = ["high-fidelity", "online-supremizers", "offline-pga", "decorrelated", "a strategy, reduced with bounds"]
    for name in names:
        plot(panel, [1.0, 2.0], [1.0, 1.0], look_of(name), name)
    sheet.label_ends(panel)
    figure = sheet.finish()
    assert not figure.legends
    assert [text.get_text().replace("\n", " ").replace("- ", "-") for text in panel.texts] == names
    boxes = [text.get_window_extent(RendererAgg(10, 10, figure.dpi)) for text in panel.texts]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    width, height = figure.get_size_inches() * figure.dpi
    assert all(0 <= box.x0 <= box.x1 <= width + 1 and 0 <= box.y0 <= box.y1 <= height for box in boxes)


LINEAR_TO_XYZ = np.array(
    [(0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041)]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
DEFICIENCIES = {
    "none": (1, 0, 0, 0, 1, 0, 0, 0, 1),
    "protan": (0.152286, 1.052583, -0.204868, 0.114503, 0.786281, 0.099216, -0.003882, -0.048116, 1.051998),
    "deutan": (0.367322, 0.860646, -0.227968, 0.280085, 0.672501, 0.047413, -0.011820, 0.042940, 0.968881),
    "tritan": (1.255528, -0.076749, -0.178779, -0.078411, 0.930809, 0.147602, 0.004733, 0.691367, 0.303900),
}
"""Complete deficiencies of colour vision on linear RGB (Machado, Oliveira and Fernandes 2009)."""


def cielab(colour: str, seen: tuple[float, ...]) -> np.ndarray:
    """L*, a*, b* of a colour "#RRGGBB" under D65, as it is seen."""
    stored = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    xyz = LINEAR_TO_XYZ @ np.clip(np.reshape(seen, (3, 3)) @ linear, 0.0, 1.0) / WHITE
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_colours_differ_in_grey_and_for_the_colour_blind() -> None:
    lightness = [cielab(colour, DEFICIENCIES["none"])[0] for colour in COLOURS]
    assert np.diff(lightness).min() > 7.5
    assert cielab("#FFFFFF", np.eye(3))[0] == pytest.approx(100.0, abs=0.01)
    assert lightness[-1] < 80.0  # visible on white paper
    for seen in DEFICIENCIES.values():
        places = [cielab(colour, seen) for colour in COLOURS]
        # Ten times what is just noticeable (2.3).
        assert min(np.linalg.norm(one - other) for one, other in combinations(places, 2)) > 23.0


@pytest.mark.parametrize("form", ["png", "svg", "pdf"])
def test_a_file_has_its_caption_and_no_date(form: str) -> None:
    text = "A caption with δ = 0.1, <b> & (parentheses)."
    (figure, file), (_, again) = drawn(text, form), drawn(text, form)
    assert caption_of(figure) == text
    assert file == again
    expected = {
        "png": [text.encode(), b"Description"],
        "svg": [b"A caption with \xce\xb4 = 0.1, &lt;b&gt; &amp; (parentheses)."],
        "pdf": [b"/Subject", text.encode("utf-16-be").replace(b"(", b"\\(").replace(b")", b"\\)")],
    }
    assert all(part in file for part in expected[form])
    assert b"CreationDate" not in file
    assert b"<dc:date>" not in file


def test_panels_that_are_left_over_are_hidden() -> None:
    assert [one.axison for one in Sheet.with_panels(7, "seven").panels] == [True] * 7 + [False] * 2
