"""Figures of a run, drawn from its results file alone."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench import tables
from vibench.strategy import Kind

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, told apart by colour-blind readers; lines differ in style too."""

STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
MARKERS = "os^vDPX"
BLACK = 6
"""Index of the style kept for the high-fidelity pair."""
PANEL = (4.2, 3.3)

PAIR = ["pod_tol", "pod_size", "dual_tol", "dual_size"]

STYLE: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "savefig.dpi": 150,
}


def draw_all(path: Path, folder: Path) -> list[Path]:
    """Draw what a results file has data for; returns the files written.

    Parameters
    ----------
    path
        Results file.
    folder
        Where the PNG files go.
    """
    histories = tables.in_order(tables.read(path, "histories"))
    queries = tables.in_order(tables.read(path, "queries"))
    cells = tables.read(path, "cells").set_index("cell")
    if queries.empty:
        return []
    queries["enrichment_kind"] = queries["cell"].map(cells["enrichment_kind"])
    folder.mkdir(parents=True, exist_ok=True)
    drawn = []
    with mpl.rc_context(STYLE):
        for name, figure in _figures(histories, queries, cells):
            for axes in figure.axes:
                axes.minorticks_off()  # on logarithmic axes they take a third of the time
            target = folder / f"{name}.png"
            figure.savefig(target)
            drawn.append(target)
    return drawn


def _figures(histories: pd.DataFrame, queries: pd.DataFrame, cells: pd.DataFrame) -> Iterator[tuple[str, Figure]]:
    groups = list(queries.groupby(["problem", "problem_options"]))
    names = _file_names([str(problem) for (problem, _), _ in groups])
    for name, ((problem, options), group) in zip(names, groups, strict=True):
        mine = histories[(histories["problem"] == problem) & (histories["problem_options"] == options)]
        sizes = cells[(cells["problem"] == problem) & (cells["problem_options"] == options)]
        yield f"{name}-errors", projection_errors(mine)
        yield f"{name}-orthogonality", orthogonality(mine)
        duals = list(group.groupby("dual"))
        for dual, (label, of_dual) in zip(_file_names([str(label) for label, _ in duals]), duals, strict=True):
            if (of_dual["enrichment_kind"] == Kind.FIXED).any():
                yield f"{name}-{dual}-enrichment", enrichment(mine[mine["dual"] == label], of_dual, sizes)
            yield f"{name}-{dual}-inf-sup", inf_sup(of_dual, sizes)


def projection_errors(histories: pd.DataFrame) -> Figure:
    """Relative projection errors of the POD and of the cones over their size (paper, Figure 5)."""
    figure, (left, right) = _panels(1, 2)
    pod = _longest(histories[(histories["stage"] == "pod") & (histories["quantity"] == "error")], [])
    for _, line in pod:
        shown = line[line["value"] > 1e-12]  # the tail beyond is round-off
        left.semilogy(shown["step"], shown["value"], color=COLOURS[0])
    left.set(xlabel="number of modes N", ylabel="relative error $e_{POD}$", title="POD")
    cones = histories[(histories["stage"] == "cone") & (histories["quantity"] == "error")]
    for k, (label, line) in enumerate(_longest(cones, ["dual"])):
        right.semilogy(line["step"], line["value"], label=label[0], **_style(k))
    right.set(xlabel="number of generators R", ylabel="largest relative error e(R)", title="cones")
    _legend(right)
    return figure


def orthogonality(histories: pd.DataFrame) -> Figure:
    """Distance of every generator from the cone of those before it (paper, Figure 6)."""
    figure, (axes,) = _panels(1, 1)
    lines = histories[(histories["stage"] == "cone") & (histories["quantity"] == "e_orth")]
    for k, (label, line) in enumerate(_longest(lines, ["dual"])):
        axes.semilogy(line["step"], line["value"], marker=MARKERS[k % len(MARKERS)], ms=3, label=label[0], **_style(k))
    axes.set(xlabel="generators before, r", ylabel="$e_{orth}(r)$")
    _legend(axes)
    return figure


def enrichment(histories: pd.DataFrame, queries: pd.DataFrame, cells: pd.DataFrame) -> Figure:
    """σ and min β over the steps of the tightest fixed enrichments, β over the validation set (paper, Figure 7)."""
    fixed = queries[queries["enrichment_kind"] == Kind.FIXED]
    pairs = _pairs(fixed)
    figure, grid = _panels(len(pairs), 3)
    for row, (pair, group) in enumerate(pairs):
        axes = grid[3 * row : 3 * row + 3]
        steps = histories[(histories["stage"] == "enrichment") & _same(histories, pair)]
        tight = steps[steps["primal_tol"].isna() | (steps["primal_tol"] == steps["primal_tol"].min())]
        for quantity, where, label in (
            ("sigma", axes[0], "σ, largest over the training set"),
            ("beta_span_min", axes[1], "min β over the span, training set"),
        ):
            for k, (key, line) in enumerate(tight[tight["quantity"] == quantity].groupby("primal")):
                shown = line[line["value"] > 1e-14]
                where.semilogy(shown["step"], shown["value"], marker=".", ms=4, label=key, **_style(k))
            where.set(xlabel="vectors added", ylabel=label, title=_pair_title(pair, queries, cells))
            where.set_xlim(left=0)
        for k, (key, line) in enumerate(_one_solver(group).groupby(["primal", "primal_tol"], dropna=False)):
            values = np.sort(line["beta_span"].to_numpy())
            axes[2].plot(values, label=_label(*key), **_style(k))
        axes[2].set(xlabel="validation parameters, sorted", ylabel="β over the span")
        for panel in axes:
            if len(panel.get_lines()) > 1 or panel is axes[2]:
                _legend(panel)
    return figure


def inf_sup(queries: pd.DataFrame, cells: pd.DataFrame) -> Figure:
    """β of every primal strategy and of the high-fidelity pair over the validation set (paper, Figure 8).

    Over the span in the first row, over the cone in the second (bands where the bounds differ); parameters sorted by
    the constant of the loosest fixed enrichment.
    """
    pairs = _pairs(queries)
    figure, grid = _panels(2, len(pairs))
    for column, (pair, of_pair) in enumerate(pairs):
        group = _one_solver(of_pair)
        fixed = group[group["enrichment_kind"] == Kind.FIXED]
        loosest = fixed[fixed["primal_tol"].isna() | (fixed["primal_tol"] == fixed["primal_tol"].max())]
        first = loosest if len(loosest) else group
        order = first[first["cell"] == first["cell"].iloc[0]].sort_values("beta_span", kind="stable")["query"]
        kept = group[(group["enrichment_kind"] != Kind.FIXED) | group["cell"].isin(loosest["cell"])]
        top, below = grid[column], grid[len(pairs) + column]
        for k, (key, line) in enumerate(kept.groupby(["primal", "primal_tol"], dropna=False)):
            ordered = line.set_index("query").loc[order]
            _constants((top, below), ordered, "beta_", k=k, label=_label(*key))
            if k == 0:
                _constants((top, below), ordered, "beta_hf_", k=BLACK, label="high-fidelity")
        top.set(yscale="log", ylabel="β over the span", title=_pair_title(pair, queries, cells))
        below.set(yscale="log", ylabel="β over the cone", xlabel="validation parameters, sorted")
    _legend(grid[0])
    return figure


def _constants(axes: tuple[Axes, Axes], line: pd.DataFrame, prefix: str, *, k: int, label: str) -> None:
    """One strategy's span constants, and its cone interval as a line with a band."""
    top, below = axes
    x = np.arange(len(line))
    span = line[f"{prefix}span"].to_numpy()
    vanishes = bool(np.all(span < 1e-12))
    top.plot(x, np.where(span < 1e-12, np.nan, span), label=f"{label} (0)" if vanishes else label, **_style(k))
    lower, upper = line[f"{prefix}cone_lower"].to_numpy(), line[f"{prefix}cone_upper"].to_numpy()
    below.plot(x, upper, **_style(k))
    below.fill_between(x, lower, upper, color=_style(k)["color"], alpha=0.2)


def _pairs(queries: pd.DataFrame) -> list[tuple[Any, pd.DataFrame]]:
    """Queries by pair of tolerances, in the order of the tables."""
    return list(queries.groupby(PAIR, dropna=False, sort=False))


def _style(k: int) -> dict[str, Any]:
    """Colour and line of the k-th thing in a panel; lines change when the colours have run out."""
    return {"color": COLOURS[k % len(COLOURS)], "linestyle": STYLES[(k + k // len(COLOURS)) % len(STYLES)]}


def _label(name: Any, tolerance: Any) -> str:
    return str(name) if pd.isna(tolerance) else f"{name}, δ = {tolerance:g}"


def _legend(axes: Axes) -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=7)


def _panels(rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(PANEL[0] * columns, PANEL[1] * rows), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def _longest(lines: pd.DataFrame, by: list[str]) -> list[tuple[tuple[Any, ...], pd.DataFrame]]:
    """The longest history of each group: a tolerance's history is the beginning of a tighter one's."""
    found = []
    for key, group in lines.groupby(by) if by else [((), lines)]:
        if group.empty:
            continue
        longest = group.groupby("artefact")["step"].max().idxmax()
        found.append((key, group[group["artefact"] == longest]))
    return found


def _one_solver(queries: pd.DataFrame) -> pd.DataFrame:
    """One row per strategy, tolerance and query: inf-sup constants do not depend on the solver."""
    return queries.drop_duplicates(["primal", "primal_options", "primal_tol", "query"])


def _same(frame: pd.DataFrame, pair: tuple[Any, ...]) -> pd.Series:
    mask = pd.Series(True, index=frame.index)
    for name, value in zip(PAIR, pair, strict=True):
        mask &= frame[name].isna() if pd.isna(value) else frame[name] == value
    return mask


def _pair_title(pair: tuple[Any, ...], queries: pd.DataFrame, cells: pd.DataFrame) -> str:
    of_pair = cells.loc[queries[_same(queries, pair)]["cell"].unique()]
    return f"(N, R) = ({of_pair['N'].iloc[0]:.0f}, {of_pair['R'].iloc[0]:.0f})"


def _file_name(label: str, number: int, count: int) -> str:
    """A label as part of a file name: numbered where several share it, or look the same once signs are gone."""
    plain = re.sub(r"[^\w.=-]+", "-", label).strip("-.")[:60] or "unnamed"
    return plain if count == 1 else f"{plain}-{number + 1}"


def _file_names(labels: list[str]) -> list[str]:
    """File names for labels, in their order, all different."""
    plain = [_file_name(label, 0, 1) for label in labels]
    return [_file_name(label, plain[:k].count(plain[k]), plain.count(plain[k])) for k, label in enumerate(labels)]
