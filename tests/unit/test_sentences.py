"""Sentences of README and documentation that sum up tables under `results/`: they are written here from the tables.

Numbers that no committed table has are not checked here: those of the pages on export, limits, packs, reports, and what
is said of runs whose queries are not committed. The commands beside them print them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]
MODEL = ["problem", "dual", "primal", "primal_options", "pod_tol", "pod_size", "dual_tol", "dual_size", "primal_tol"]
CONE = ["dual", "pod_tol", "pod_size", "dual_tol", "dual_size"]


def cells(study: str) -> pd.DataFrame:
    """The cells of a study, with the solver of the pages."""
    table = pd.read_csv(ROOT / "results" / study / "cells.csv")
    return table[table["solver"] == "piqp"]


def span(values: pd.Series, digits: int = 2) -> tuple[str, str]:
    low, high = (f"{float(f'{value:.{digits}g}'):g}" for value in (values.min(), values.max()))
    return low, high


def one(value: float) -> str:
    """A factor with one digit after the point, with none from twenty on."""
    return f"{value:.0f}" if value >= 20.0 else f"{value:.1f}"


def gains(study: str, dual: str) -> pd.Series:
    """The mean error of λ without enrichment over that with one, for every enriched model of a cone."""
    table = cells(study)
    table = table[(table["dual"] == dual) & (table["assembly"] == "full")]
    plain = table[table["primal"] == "decorrelated"].set_index(CONE)["error_lambda_mean"]
    enriched = table[table["primal"] != "decorrelated"].set_index(CONE)["error_lambda_mean"]
    return plain.reindex(enriched.index) / enriched


def misses(study: str, problem: str) -> tuple[int, pd.DataFrame]:
    """How many enrichments of a problem record a guarantee, and those that miss it at a validation parameter."""
    table = cells(study)
    recorded = table[(table["problem"] == problem) & table["share_guaranteed"].notna()].drop_duplicates(MODEL)
    below = recorded["share_validation"] < recorded["share_guaranteed"] * (1.0 - 1e-9)
    return len(recorded), recorded[below]


def of_guarantees() -> Sequence[str]:
    """What the page on the study `field` says of shares off the training set."""
    in_field = [misses("field", problem) for problem in ("hertz", "obstacle")]
    assert [len(missed) for _, missed in in_field] == [0, 0]
    (count, missed), (others, none) = misses("paper-hertz", "hertz"), misses("paper-obstacle", "obstacle")
    assert len(none) == 0
    worst = missed.loc[(missed["share_validation"] / missed["share_guaranteed"]).idxmin()]
    return (
        f"none of the {sum(number for number, _ in in_field)} enrichments that record σ",
        f"{len(missed)} of the {count} enrichments of Hertz do (`results/paper-hertz`), the worst with "
        f"{worst['share_validation']:.3f} where {worst['share_guaranteed']:.3f} is guaranteed",
        f"none of the {others} of the obstacle",
    )


def of_enrichments() -> Sequence[str]:
    """What README says of errors with and without enrichment."""
    cpg, mcpg = (gains("paper-obstacle", dual) for dual in ("cpg", "mcpg"))
    plain, modified = (gains("paper-hertz", dual) for dual in ("cpg", "mcpg"))
    return (
        f"by a factor of {one(mcpg.max())}, with N = 87 by a factor of {one(mcpg.min())}",
        f"Over all {len(cpg) + len(mcpg)} enriched models of the study the error of λ becomes smaller by factors of "
        f"{one(cpg.min())} to {one(cpg.max())} with CPG and of {one(mcpg.min())} to {one(mcpg.max())} with mCPG; over "
        f"the {len(plain) + len(modified)} of the same study for Hertz contact, {one(plain.min())} to "
        f"{one(plain.max())} and {one(modified.min())} to {one(modified.max())}.",
    )


def of_queries() -> Sequence[str]:
    """What README says of the seconds of a query against those of a high-fidelity solution."""
    table = cells("benefit").assign(gain=lambda rows: rows["hf_s"] / rows["online_s"])
    ends = {assembly: span(rows["gain"]) for assembly, rows in table.groupby("assembly")}
    return (
        f"Over the {len(table)} models of the study `benefit` a query gains a factor of "
        f"{' to '.join(ends['reduced'])} with reduced assembly, and of {' to '.join(ends['full'])} with full assembly",
    )


@pytest.mark.parametrize(
    ("page", "sentences"),
    [("README.md", of_enrichments), ("README.md", of_queries), ("docs/field.md", of_guarantees)],
)
def test_a_page_says_what_the_tables_say(page: str, sentences: object) -> None:
    assert callable(sentences)
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    assert [sentence for sentence in sentences() if sentence not in text] == []
