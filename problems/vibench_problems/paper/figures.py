"""The figure plugin that draws Figures 3 to 15 of Niakh et al. (2022) again, from runs of its two problems."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from vibench import FigurePlugin, ProblemTables
from vibench_problems.paper.published import PROBLEMS, PUBLICATION

if TYPE_CHECKING:  # tables ask every plugin for columns: this module loads no matplotlib
    from vibench.report import CaptionedFigure

Twin = Callable[[], "CaptionedFigure | None"]

RADIUS = "radius µ [m]"
NOT_IN_THE_PAPER = {"bulge": True, "approach": "parameter"}
"""Options that add a parameter which the problems of the paper do not have."""


class PaperFigures(FigurePlugin):
    """Figures 3 to 8 from a run of the obstacle problem, 9 to 15 from one of Hertz contact.

    Pairs of spaces are found by the tolerances or sizes of the paper; a run without them has fewer figures.
    """

    publication: ClassVar[str] = PUBLICATION

    def drawings(self, tables: ProblemTables) -> Mapping[str, Twin]:
        """The figures of one of the two problems, none of any other."""
        paper = PROBLEMS.get(tables.problem_name)
        if paper is None or any(tables.problem_options.get(name) == value for name, value in NOT_IN_THE_PAPER.items()):
            return {}
        from vibench_problems.paper import constants, discs, membrane, offline  # noqa: PLC0415
        from vibench_problems.paper.curves import Curves  # noqa: PLC0415

        curves, parameter = Curves(tables), RADIUS if tables.problem_name == "hertz" else ""
        errors, angles, greedy, comparison = paper.figures
        found: dict[int, Twin] = {
            errors: partial(offline.projection_errors, curves, paper),
            angles: partial(offline.orthogonality, curves, paper),
            greedy: partial(offline.greedy, curves, paper, parameter),
            comparison: partial(constants.comparison, curves, paper, parameter),
        }
        if tables.problem_name == "obstacle":
            found |= {3: partial(membrane.aspect_ratios, tables), 4: partial(membrane.solution, tables)}
        else:
            found |= {
                9: partial(discs.configuration, tables),
                10: partial(discs.solution, tables),
                13: partial(constants.without_enrichment, curves, paper, parameter),
            }
        return {f"figure-{number}": found[number] for number in sorted(found)}
