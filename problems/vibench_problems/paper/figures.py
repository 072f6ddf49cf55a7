"""The figure plugin that draws Figures 3 to 15 of Niakh et al. (2022) again, from runs of its two problems."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from vibench import FigurePlugin, ProblemTables
from vibench_problems.paper.published import PROBLEMS, PUBLICATION

if TYPE_CHECKING:  # tables ask every plugin for columns: this module loads no matplotlib
    from vibench.report import CaptionedFigure

Redrawn = Callable[[], "CaptionedFigure | None"]

NOT_IN_THE_PAPER = {"bulge": True, "approach": "parameter"}
"""Options that add a parameter which the problems of the paper do not have."""


class PaperFigures(FigurePlugin):
    """Figures 3 to 8 from a run of the obstacle problem, 9 to 15 from one of Hertz contact.

    Pairs of spaces are found by the tolerances or sizes of the paper; a run without them has fewer figures.
    """

    publication: ClassVar[str] = PUBLICATION

    def drawings(self, tables: ProblemTables) -> Mapping[str, Redrawn]:
        """The figures of one of the two problems, none of any other."""
        paper = PROBLEMS.get(tables.problem_name)
        if paper is None or any(tables.problem_options.get(name) == value for name, value in NOT_IN_THE_PAPER.items()):
            return {}
        from vibench_problems.paper import constants, discs, membrane, offline  # noqa: PLC0415
        from vibench_problems.paper.evidence import Evidence  # noqa: PLC0415

        drawn = (offline.projection_errors, offline.orthogonality, offline.greedy, constants.comparison)
        figures: dict[int, Callable[[Evidence], CaptionedFigure | None]] = dict(zip(paper.figures, drawn, strict=True))
        if tables.problem_name == "obstacle":
            figures |= {3: membrane.aspect_ratios, 4: membrane.solution}
        else:
            figures |= {9: discs.configuration, 10: discs.solution, 13: constants.without_enrichment}
        evidence = Evidence(tables)
        return {f"figure-{number}": partial(figures[number], evidence) for number in sorted(figures)}
