"""Error bounds of queries against their errors."""

from __future__ import annotations

from vibench.report.figures.data import ProblemTables, leading
from vibench.report.figures.style import CaptionedFigure, Looks, Series, Sheet, scatter
from vibench.results.ranking import relative_bounds


def bounds(data: ProblemTables) -> CaptionedFigure | None:
    """Bounds at online cost against errors, a point for every query; none lies below the line of equal values."""
    relative = relative_bounds(data.queries)
    rows = data.queries[relative.notna().any(axis=1)]
    names, part = leading(list(map(str, rows["primal"].unique())), 4, "strategies")
    if not names:
        return None
    sheet, looks = Sheet(1, 2, f"{data.problem}: error bounds of queries"), Looks(map(Series, names))
    norms = {"u_energy": "u, energy norm", "lambda_natural": "λ, natural norm"}
    for panel, (column, norm) in zip(sheet.panels, norms.items(), strict=True):
        for name in names:
            mine = rows[rows["primal"] == name]
            scatter(panel, mine[f"error_{column}"], relative[column][mine.index], looks[Series(name)], name)
        panel.set(xscale="log", yscale="log", xlabel=f"relative error of {norm}", ylabel=f"its bound ({norm})")
        panel.axline((1e-6, 1e-6), (1e-3, 1e-3), color="black", linewidth=0.8)
    return sheet.finish(
        f"Relative bounds at online cost of u (left) and λ (right) against the relative errors of {data.problem}, a "
        "point for every query with bounds. The line is where a bound equals its error: a proved bound is above it.",
        part,
    )
