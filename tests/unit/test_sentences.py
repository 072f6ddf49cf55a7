"""Sentences of README and documentation that sum up tables under `results/`: they are written here from the tables.

The first page and "What to use" are made whole by their scripts. Numbers that no committed table has are not
checked here: those of the pages on export, limits, packs, reports, and what
is said of runs whose queries are not committed. The commands beside them print them.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]
MODEL = ["problem", "dual", "primal", "primal_options", "pod_tol", "pod_size", "dual_tol", "dual_size", "primal_tol"]


def cells(study: str) -> pd.DataFrame:
    """The cells of a study, with the solver of the pages."""
    table = pd.read_csv(ROOT / "results" / study / "cells.csv")
    return table[table["solver"] == "piqp"]


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


@pytest.mark.parametrize(
    ("page", "sentences"),
    [("docs/field.md", of_guarantees)],
)
def test_a_page_says_what_the_tables_say(page: str, sentences: object) -> None:
    assert callable(sentences)
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    assert [sentence for sentence in sentences() if sentence not in text] == []


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "results" / "scripts"))


@pytest.mark.usefixtures("scripts")
def test_the_results_on_the_first_page_are_made_from_the_tables() -> None:
    committed, first_page = map(importlib.import_module, ("committed", "first_page"))
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    assert first_page.PLACE.search(page)
    assert first_page.filled(page, committed.Results(ROOT / "results")) == page


@pytest.mark.usefixtures("scripts")
def test_the_page_what_to_use_is_made_from_the_tables() -> None:
    committed, what_to_use = map(importlib.import_module, ("committed", "what_to_use"))
    page = (ROOT / "docs" / "what-to-use.md").read_text(encoding="utf-8")
    assert what_to_use.what_to_use(committed.Results(ROOT / "results")) == page
