"""docs/reproduction.md and the table beside it: the paper claim by claim, against runs of its two problems.

python results/scripts/reproduction.py docs runs/paper-obstacle runs/paper-hertz runs/hertz-direct

Every number of ours comes from the results files of the runs, or is computed from the problem classes; the seconds of
the published algorithms in our transcription come from `results/speed`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import pandas as pd
from page import start

from vibench.report.figures.data import ProblemTables, problem_tables
from vibench.results.read import results_file
from vibench_problems.paper.claims import DIMENSION, MESH, ORDER, RATIO, WIDEST, Agreement, Claim, typeset
from vibench_problems.paper.evidence import Evidence
from vibench_problems.paper.published import HERTZ
from vibench_problems.paper.sections import sections
from vibench_problems.paper.tables import columns

RESULTS = Path(__file__).parents[1]
SPEED = RESULTS / "speed"

INTRODUCTION = """# Reproduction of the paper

Niakh, Drouet, Ehrlacher and Ern, *Stable model reduction for linear variational inequalities with parameter-dependent constraints* (2022, [doi](https://doi.org/10.1051/m2an/2022077)), claim by claim: every row of both tables, every figure, every sentence with a number. [All claims are in a table](reproduction.csv): what the paper says, what vibench finds, the verdict and its reason. Page and table are made by

```
vibench run paper-obstacle && vibench run paper-hertz && vibench run hertz-direct
python results/scripts/reproduction.py docs runs/paper-obstacle runs/paper-hertz runs/hertz-direct
```

Seconds were measured on {machine}.{disturbed} Equations, sections and figures are those of the paper. *On* and *off* are its online and offline enrichment; our numbers are those of the cone of mCPG, PIQP and assembly in full, unless a row says otherwise. Curves are not read off the figures; of a figure, the page compares the statements of text and caption.

The verdict is computed from the numbers. Dimensions agree within {dimension:.0f} %, sizes of meshes within {mesh:.0f} %, ratios of seconds within {ratio:.0f} %, orders of magnitude within a factor {order:.2g}. A benefit threshold n\\* agrees if the value of the paper lies in our [95 % interval](measurement.md#seconds) and the ends of this are at most a factor {widest:g} apart; a wider interval that contains it is inconclusive. An inequality agrees if it holds at every step and parameter. Observations of the paper on a figure are judged at the parameters and tolerances of that figure, and constants over the cone by the bound from which a conclusion follows. Seconds on different machines cannot be compared, nor can quantities that the paper does not give or gives only in a figure, nor those that a run does not reach. Agreement *by construction* is not a result: inputs copied from the paper, sizes that a study prescribes, arithmetic on numbers that the paper prints. `python -m vibench_problems.paper` judges by the same rules below each figure.
"""  # noqa: E501

FIGURE = """![Figure 8 of the paper, drawn from our runs: β over the span and over the cone at the validation parameters of the obstacle.](../results/paper-figures/figure-8.png)

*Figure 8 of the paper from our runs.* Offline enrichment keeps nearly all of β; without enrichment β over the span is zero. [All figures](../results/paper-figures/paper-figures.md)."""  # noqa: E501

CAUSES = """## Causes of differences

- **Two definitions of β.** The paper defines β over the cone and states what holds over the span ([Mathematics](mathematics.md#inf-sup-constants)).
- **What is not published.** The norm of V and the map h of the obstacle, the quadrature and the master mesh of Hertz contact. The reduced bases of the paper contain the oscillations that direct projection causes. With one of {count} variants of a direct projection N and R come close to the published ones; it was chosen for this reason.
- **Proportional constraints.** For the obstacle all parameters share one space of supremizers. PGA makes use of this, so that the offline enrichment adds little to the offline time.
- **Assembly in full.** Every query projects matrices of mesh size, for Hertz contact also A, although it is constant. Queries in a larger space are slower. [Reduced assembly](mathematics.md#reduced-assembly) does not have this cost.
- **Statements about greedy algorithms.** The errors of two greedy algorithms that select different snapshots are not ordered, neither along the steps nor at other parameters.
- **Signs and misprints.** They are listed under [Differences from the paper](mathematics.md#differences-from-the-paper).
"""  # noqa: E501

FIT = """## Direct projection is a fit

The claims on Hertz contact with direct projection are a fit and no independent confirmation: of the {count} variants of a direct projection in [`hertz-quadrature`](../results/hertz-quadrature/README.md) (one to three Gauss points, meshes that differ in their triangulation and in the fineness of the master surface) the run has the one whose N and R come closest to the published ones. Over all variants N for δ_POD = 0.001 goes from {low} to {high}, published are {published}; R of mCPG for δ = 0.01 goes from {fewest} to {most}, published are {generators}."""  # noqa: E501

DEVIATIONS = """## Deviations from the published procedure

- *Assembly in full* means, as in the paper, that the matrices are assembled on the mesh and projected at every query. Online supremizers, however, are orthonormalised in coordinates on the contact unknowns and not on the mesh; the space is the same.
- PGA treats parameters with proportional B(µ) once, keeps the bounds of σ from earlier steps, and works in coordinates on the contact unknowns. CPG and mCPG keep the bounds of distances from earlier steps. The selected vectors are the same.
- The high-fidelity solver is a primal–dual active set method that starts from the contact set at the nearest parameter solved before. A constant A is factorised once.
- Seconds are CPU seconds of one thread, measured in rounds ([How things are measured](measurement.md)).
"""  # noqa: E501


def main(folder: str, paper_obstacle: str, paper_hertz: str, hertz_direct: str) -> None:
    runs = [the_problem_of(run) for run in (paper_obstacle, paper_hertz, hertz_direct)]
    transcriptions = {
        # the first column has the seconds of the transcription
        file.stem.rpartition("-")[2]: pd.read_csv(file).set_index("stage").iloc[:, 0]
        for file in SPEED.glob("as-published-*.csv")
    }
    timed = [column for run in runs[:2] for column in columns(Evidence(run))]
    disturbed = sum(int(cell["disturbed"] == 1) for column in timed for cell in (column.on, column.off))
    machine = " and ".join(sorted({run.machine for run in runs[:2]}))
    claims = sections(*runs, transcriptions)
    text = page(claims, machine, disturbed, variants())
    (Path(folder) / "reproduction.md").write_text(f"{text}\n", encoding="utf-8")
    table(claims).to_csv(Path(folder) / "reproduction.csv", index=False)


def variants() -> dict[str, int]:
    """The variants of a direct projection that were tried: how many, and the dimensions that they lead to."""
    cells = pd.read_csv(RESULTS / "hertz-quadrature" / "cells.csv")
    # with exact quadrature the option is absent, or a word
    direct = cells[cells["problem_options"].map(lambda text: isinstance(json.loads(text).get("quadrature"), int))]
    modified = direct[direct["dual"] == "mcpg"]
    modes = direct.loc[direct["pod_tol"] == 1e-3, "N"]
    generators = modified.loc[modified["dual_tol"] == 1e-2, "R"]
    return {
        "count": direct["problem"].nunique(),
        "low": modes.min(),
        "high": modes.max(),
        "published": HERTZ.modes[1e-3],
        "fewest": generators.min(),
        "most": generators.max(),
        "generators": HERTZ.generators[1e-2],
    }


def the_problem_of(run: str) -> ProblemTables:
    """The tables of the only problem of a run."""
    ((_, data),) = problem_tables(results_file(run))
    return data


def page(claims: Mapping[str, Sequence[Claim]], machine: str, disturbed: int, fit: Mapping[str, int]) -> str:
    """The page in Markdown; `fit` has the numbers of `variants`."""
    introduction = INTRODUCTION.format(
        machine=machine,
        disturbed=f" {disturbed} of the 12 cells of the tables are marked as disturbed: the machine was slower than "
        "at its best by more than a factor of 1.3." * bool(disturbed),
        dimension=100 * DIMENSION,
        mesh=100 * MESH,
        ratio=100 * RATIO,
        order=ORDER,
        widest=WIDEST,
    )
    parts = [introduction, "## Summary", summary(claims), FIGURE, CAUSES.format(**fit), FIT.format(**fit), DEVIATIONS]
    return "\n\n".join(part.strip() for part in parts)


def table(claims: Mapping[str, Sequence[Claim]]) -> pd.DataFrame:
    """A row for every claim."""
    rows = [
        [typeset(cell) for cell in (section, row.name, row.paper, row.ours, row.verdict.value, row.why)]
        for section, found in claims.items()
        for row in found
    ]
    return pd.DataFrame(rows, columns=["section", "claim", "paper", "vibench", "verdict", "why"])


def summary(claims: Mapping[str, Sequence[Claim]]) -> str:
    """Number of verdicts of each kind, by section and in all."""
    counts = {title: Counter(row.verdict for row in rows) for title, rows in claims.items()}
    counts["all"] = sum(counts.values(), Counter())
    rows = ([title, *(str(count[verdict]) for verdict in Agreement)] for title, count in counts.items())
    return markdown(("section", *(verdict.value for verdict in Agreement)), rows)


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table without padding; characters with a meaning in Markdown are escaped."""
    lines = [header, ["---"] * len(header), *([_escaped(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _escaped(cell: str) -> str:
    return typeset(cell).replace("|", "\\|").replace("*", "\\*")


if __name__ == "__main__":
    start(main)
