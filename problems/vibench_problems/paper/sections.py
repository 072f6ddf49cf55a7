"""Every claim of the paper, judged by runs of its two problems, in the sections of a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from vibench.report import ProblemTables
from vibench_problems.paper import constants, discs, membrane, method, offline, tables
from vibench_problems.paper.claims import Claim
from vibench_problems.paper.evidence import Evidence


def sections(
    obstacle: ProblemTables,
    hertz: ProblemTables,
    direct: ProblemTables,
    transcriptions: Mapping[str, Mapping[str, float]],
) -> dict[str, list[Claim]]:
    """All claims, by the title of a section.

    Parameters
    ----------
    obstacle, hertz, direct
        Runs of the obstacle, of Hertz contact, and of Hertz contact with integration points projected directly.
    transcriptions
        Seconds of the published algorithms in a transcription, by problem and stage; nothing where there are none.

    Raises
    ------
    ValueError
        If a run lacks a pair of spaces of the paper; one with direct projection needs the last one only.
    """
    membranes, exact, projected = map(Evidence, (obstacle, hertz, direct))
    for evidence, first in ((membranes, 0), (exact, 0), (projected, 2)):
        missing = [pair.name for pair in evidence.paper.pairs[first:] if pair not in evidence.pairs]
        if missing:
            raise ValueError(f"the run of {evidence.tables.problem} has no models for {', '.join(missing)}")
    return {
        "Problem data": [*membrane.data(membranes), *discs.data(exact)],
        "Table 1: obstacle": list(tables.table(membranes, transcriptions.get("obstacle"))),
        "Table 2: Hertz contact": list(tables.table(exact, transcriptions.get("hertz"))),
        "Obstacle: figures and sentences": [*figure_claims(membranes), *offline.without_symmetry()],
        "Hertz contact: figures and sentences": list(figure_claims(exact)),
        "Hertz contact with direct projection: figures and sentences": [
            replace(claim, statement=f"{claim.statement}, direct projection")
            for claim in (*discs.configuration_claims(projected), *figure_claims(projected))
        ],
        "Statements of the method": [
            *method.statements(membranes),
            *method.statements(exact),
            *method.software([membranes, exact]),
        ],
    }


def figure_claims(evidence: Evidence) -> Iterator[Claim]:
    """The claims of the figures of a problem and of the sentences about them, besides those of its data."""
    of_discs = evidence.tables.problem_name == "hertz"
    if of_discs:
        yield from discs.solution_claims(evidence, discs.pressed(evidence.problem))
    else:
        yield from membrane.aspect_ratio_claims(evidence)
        yield from membrane.solution_claims(evidence, membrane.membrane_solution(evidence))
    yield from offline.projection_error_claims(evidence)
    yield from offline.orthogonality_claims(evidence)
    if of_discs and evidence.paper.pairs[-1] in evidence.pairs:
        yield from constants.without_enrichment_claims(evidence)
    if evidence.pairs:
        yield from offline.greedy_claims(evidence)
        yield from constants.comparison_claims(evidence)
