"""Figures of plugins: loaded, drawn, and reported in a line where that fails."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import NoReturn

from matplotlib.figure import Figure

from vibench.errors import VibenchError, in_a_line
from vibench.interfaces.figures import Drawing, FigurePlugin
from vibench.plugins.kinds import FIGURE
from vibench.plugins.registry import registered
from vibench.report.figures.data import Data, file_names
from vibench.report.figures.style import set_caption
from vibench.results.plugin_columns import loaded


class FigureError(VibenchError):
    """A figure of a plugin that cannot be drawn."""


DrawPages = Callable[[Data], Iterable[Figure]]
"""Draws the pages of a figure: none where there is nothing to draw."""


def of_plugins(data: Data, taken: set[str]) -> dict[str, DrawPages]:
    """The figures that plugins have for a problem, by the end of their file names, publications left out.

    A plugin that cannot be loaded, or whose name is `taken` by a figure of vibench, has one figure, whose drawing
    raises `FigureError` with the reason.
    """
    by_name: dict[str, DrawPages] = {}
    for name in registered(FIGURE):
        reason = f"{FIGURE} '{name}' has the name of a figure of vibench, and needs another" if name in taken else ""
        try:
            plugin = None if reason else loaded(name)
            if plugin is not None and not plugin.publication:
                kinds = dict(named(name, plugin, data))
                by_name |= {
                    f"{name}-{kind}" if kind else name: partial(_page_of_plugin, name, kind, draw)
                    for kind, draw in kinds.items()
                }
        except VibenchError as error:
            reason = str(error)
        if reason:
            by_name[name] = partial(_refused, reason)
    return by_name


def named(name: str, plugin: FigurePlugin, data: Data) -> Iterator[tuple[str, Drawing]]:
    """The drawings of a plugin for a problem, by names that are part of a file name.

    Raises
    ------
    FigureError
        If the plugin raises, or returns something else.
    """
    try:
        drawings = plugin.drawings(data)
    except (Exception, SystemExit) as error:  # noqa: BLE001  third-party code
        raise FigureError(f"{FIGURE} '{name}' has no figures of {data.problem}: {in_a_line(error)}") from None
    if not isinstance(drawings, Mapping) or not all(isinstance(k, str) and callable(f) for k, f in drawings.items()):
        raise FigureError(f"{FIGURE} '{name}' returned {type(drawings).__name__}, expected functions by their names")
    files = file_names([kind or "unnamed" for kind in drawings])
    yield from ((file if kind else "", draw) for (kind, draw), file in zip(drawings.items(), files, strict=True))


def draw_guarded(name: str, kind: str, draw: Drawing) -> Figure | None:
    """A figure of a plugin with its caption.

    Raises a `FigureError` if it cannot be drawn or rendered, or is no figure.
    """
    try:
        figure = draw()
        if isinstance(figure, Figure):
            figure.draw_without_rendering()
    except (Exception, SystemExit) as error:  # noqa: BLE001  third-party code
        raise FigureError(f"figure '{kind}' of {FIGURE} '{name}' cannot be drawn: {in_a_line(error)}") from None
    if figure is not None and not isinstance(figure, Figure):
        returned = type(figure).__name__
        raise FigureError(f"figure '{kind}' of {FIGURE} '{name}' is a {returned}, expected a matplotlib Figure or None")
    if figure is not None:
        described = draw.func if isinstance(draw, partial) else draw
        set_caption(figure, inspect.getdoc(described) or "")
    return figure


def _page_of_plugin(name: str, kind: str, draw: Drawing, _: Data) -> list[Figure]:
    figure = draw_guarded(name, kind, draw)
    return [] if figure is None else [figure]


def _refused(reason: str, _: Data) -> NoReturn:
    raise FigureError(reason)
