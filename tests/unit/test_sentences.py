"""Sentences of README and documentation that sum up tables under `results/`: they are written here from the tables.

The first page and "What to use" are made whole by their scripts. Numbers that no committed table has are not
checked here: those of the pages on export, limits, packs, reports, and what
is said of runs whose queries are not committed. The commands beside them print them.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]
MODEL = ["problem", "dual", "primal", "primal_options", "pod_tol", "pod_size", "dual_tol", "dual_size", "primal_tol"]


def cells(study: str) -> pd.DataFrame:
    """The cells of a study, with the solver of the pages."""
    table = pd.read_csv(ROOT / "results" / study / "cells.csv")
    return table[table["solver"] == "piqp"]


def of_cones() -> Sequence[str]:
    """What the page on the study `field` says of cones: sizes, errors, conditioning."""
    table = cells("field")
    chosen = table[
        (table["primal"] == "online-supremizers") & (table["assembly"] == "full") & (table["pod_tol"] == 1e-3)
    ]
    by = {key: rows.iloc[0] for key, rows in chosen.groupby(["problem", "dual"])}

    def error(problem: str, dual: str, digits: int = 3) -> str:
        return f"{by[problem, dual]['error_lambda_mean']:.{digits}g}"

    greedy = ("cpg", "mcpg", "enlarged-cpg", "angle-greedy")
    assert {by["hertz", dual]["R"] for dual in greedy} == {9}
    assert by["obstacle", "nmf"]["offline_cone_s"] == max(row["offline_cone_s"] for row in by.values())
    size = {dual: by["obstacle", dual]["R"] for _, dual in by}
    return (
        f"it has {size['mcpg']} generators, where `cpg` needs {size['cpg']} that span no more than "
        f"{by['obstacle', 'cpg']['rank']} dimensions; the errors of λ are {error('obstacle', 'mcpg')} and "
        f"{error('obstacle', 'cpg')}",
        f"{error('hertz', 'cpg', 2)} where `mcpg` has {error('hertz', 'mcpg', 2)}",
        f"with {size['nmf']} generators there, and its error of {error('obstacle', 'nmf', 2)} is "
        f"{float(error('obstacle', 'mcpg')) / float(error('obstacle', 'nmf')):.0f} times smaller",
        f"{size['orthant']} single coordinates are hardly more than the {size['mcpg']} generators of `mcpg` and give "
        f"an error of {error('obstacle', 'orthant', 2)}, "
        f"{float(error('obstacle', 'nmf')) / float(error('obstacle', 'orthant')):.0f} times smaller "
        f"than that of `nmf`. On Hertz it needs {by['hertz', 'orthant']['R']} directions",
        ", compared with ".join(f"{by['hertz', dual]['gram_condition']:.3g}" for dual in ("enlarged-cpg", "mcpg"))
        + f" for `mcpg` and {by['hertz', 'cpg']['gram_condition']:.2g} for `cpg`",
        f"from {error('obstacle', 'cpg')} to {by['obstacle', 'enlarged-cpg']['error_lambda_mean']:.4f}",
        f"All {by['hertz', 'dictionary']['R']} snapshots give the smallest error on Hertz, "
        f"{error('hertz', 'dictionary', 2)}",
        f"{size['dictionary']} snapshots, with an error of {error('obstacle', 'dictionary', 2)}, are less accurate",
        f"{size['angle-greedy']} and {size['cpg']}",
    )


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


def span(values: pd.Series) -> str:
    """The range of some numbers, to two digits."""
    return f"{values.min():.2g} to {values.max():.2g}"


def of_formulations() -> Sequence[str]:
    """What the page on formulations says of times and errors beside those of `mixed`, and of less training."""
    table = pd.read_csv(ROOT / "results" / "formulations" / "cells.csv")
    assert (table["queries_ok"] == table["queries"]).all()
    key = ["problem", "dual", "pod_tol", "training"]
    mixed = table[table["formulation"] == "mixed"].set_index(key)
    ratios = {}
    for column in ("online_s", "error_lambda_mean", "offline_s", "violation_max"):
        pairs = table.merge(mixed[column].rename(f"{column} of mixed"), left_on=key, right_index=True)
        ratios[column] = pairs[column] / pairs[f"{column} of mixed"]
    own, of = table["training"] == "own", table["formulation"]
    mcpg, kind = table["dual"] == "mcpg", of.str.split().str[0]

    def times(name: str, chosen: pd.Series | bool = True) -> str:
        return span(ratios["online_s"][own & (kind == name) & chosen])

    def errors(names: Sequence[str], chosen: pd.Series) -> str:
        return span(ratios["error_lambda_mean"][own & kind.isin(names) & chosen])

    def beside(column: str, *names: str) -> str:
        return span(ratios[column][own & (kind.isin(names) | of.isin(names))])

    same = ("penalty", "proximal", "sparse-dictionary")
    added = ratios["offline_s"][own & kind.isin(same)].max() - 1.0
    fastest = table[own].loc[table[own].groupby("problem")["online_s"].idxmin()]
    assert set(fastest["formulation"]) == {"regression (radial)"}
    errors_of = table.pivot_table(index=["formulation", "problem", "dual", "pod_tol"], columns="training",
                                  values="error_lambda_mean")  # fmt: skip
    grown = np.log(errors_of[["half", "inner"]].div(errors_of["own"], axis=0))
    growth = np.exp(grown.groupby(level=["formulation", "problem"]).mean()).reset_index("problem", drop=True)
    regression = growth[growth.index.str.startswith("regression")]
    return (
        f"{of.str.split().str[0].nunique()} formulations, {len(table)} cells".replace("7 ", "seven "),
        f"has the fastest queries on all four problems, with errors of λ of {span(fastest['error_lambda_mean'])}",
        f"have {errors(same, mcpg)} times the errors of λ of `mixed` with `mcpg`, and {errors(same, ~mcpg)} times with",
        f"take {times(same[0])}, {times(same[1])} and, with `mcpg`, {times(same[2], mcpg)} times as long",
        f"`sparse-dictionary` takes {times(same[2], ~mcpg)} times as long",
        f"`local` takes {times('local')} times as long as `mixed` in the same cell, with "
        f"{errors(['local'], mcpg | ~mcpg)} times its errors",
        f"`hyper-reduced` has {errors(['hyper-reduced'], mcpg)} times its errors of λ with `mcpg`, "
        f"{errors(['hyper-reduced'], ~mcpg)} times with a dictionary, and takes {times('hyper-reduced')} times as long",
        f"grow by factors of {span(growth.loc['mixed', 'inner'])}, those of `regression` of "
        f"{span(regression['inner'])}; with half",
        f"with half of the solutions, of {span(growth.loc['mixed', 'half'])} and {span(regression['half'])}",
        f"in {table['queries'].sum():,} queries",
        f"radial basis functions {beside('offline_s', 'regression (radial)')} times, with Gaussian processes "
        f"{span(ratios['offline_s'][own & (of == 'regression')])}; `local` {beside('offline_s', 'local')}, "
        f"`hyper-reduced` {beside('offline_s', 'hyper-reduced')}; the others add at most {100 * added:.1g} %",
        f"`hyper-reduced` {beside('violation_max', 'hyper-reduced')} times that of `mixed`, `local` "
        f"{beside('violation_max', 'local')}, `regression` {beside('violation_max', 'regression')}, the others "
        f"{beside('violation_max', *same)}",
    )


def of_break_evens() -> Sequence[str]:
    """What the page on formulations says of when they are cheaper than `mixed`."""
    table = pd.read_csv(ROOT / "results" / "formulations" / "thresholds.csv")
    assert (table["formulation_a"] == "mixed").all()
    assert set(table.groupby("formulation_b").size()) == {16}
    of, meaning, kind = table["formulation_b"], table["meaning"], table["formulation_b"].str.split().str[0]

    def some(chosen: pd.Series, name: str) -> int:
        return int((chosen & (meaning == name)).sum())

    def number(chosen: pd.Series, name: str) -> str:
        numbers = table["benefit_threshold"][chosen & (meaning == name)]
        return f"{numbers.min():.0f} to {numbers.max():.0f} queries"

    processes, contact = of == "regression", of == "local (contact sets)"
    sparse, hyper, undecided = of == "sparse-dictionary", kind == "hyper-reduced", meaning == "undecided"
    assert {some(of == name, "never") for name in ("penalty", "proximal")} == {16}
    local = (kind == "local") & (table["dual"] == "mcpg")
    assert some(local, "never") > local.sum() / 2
    assert set(table["dual"][sparse & (meaning == "never")]) == {"mcpg"}
    return (
        f"radial basis functions is cheaper at once in {some(of == 'regression (radial)', 'at once')} of 16;",
        f"at once in {some(processes, 'at once')} and from {number(processes, 'from')} on in {some(processes, 'from')}",
        f"is cheaper from {number(of == 'local', 'from')} on in {some(of == 'local', 'from')}, with contact sets from "
        f"{number(contact, 'from').removesuffix(' queries')} in {some(contact, 'from')}",
        f"from at most {table['benefit_threshold'][sparse].max():.0f} queries on in {some(sparse, 'from')}, never in "
        f"{some(sparse, 'never')}",
        f"in {some(hyper, 'until')} of {hyper.sum()}, and is cheaper there until {number(hyper, 'until')} only",
        f"{undecided.sum()} of the {len(table)} pairs are undecided, {(undecided & hyper).sum()} of them of `hyper",
    )


def of_space() -> Sequence[str]:
    """What the page on three dimensions says of dimensions, constants, errors and seconds, there and in the plane."""
    table = pd.read_csv(ROOT / "results" / "three-dimensions" / "cells.csv")
    assert (table["queries_ok"] == table["queries"]).all()
    assert (table["bound_online_violations"].fillna(0.0) == 0.0).all()
    key = ["dual", "primal", "pod_tol", "dual_tol"]
    plane = cells("paper-hertz")
    plane = plane[plane["primal_tol"].isna() | (plane["primal_tol"] == 0.5)]
    space_, plane_ = (
        rows[rows["pod_tol"] == rows["dual_tol"]].drop_duplicates(key).set_index(key).sort_index()
        for rows in (table[table["assembly"] == "reduced"], plane[plane["assembly"] == "full"])
    )

    def at(rows: pd.DataFrame, column: str, dual: str, primal: str, tolerance: float) -> float:
        return float(rows.loc[(dual, primal, tolerance, tolerance), column])

    def ladder(rows: pd.DataFrame, column: str, dual: str, primal: str, digits: int = 2) -> str:
        return " and ".join(f"{at(rows, column, dual, primal, each):.{digits}g}" for each in (1e-2, 1e-3))

    bare, online, offline = "decorrelated", "online-supremizers", "offline-pga"
    assert (table["beta_span_min"][table["primal"] == bare] == 0.0).all()
    sizes = {
        (where, name): [ladder(rows, name, dual, bare, 3) for dual in ("cpg", "mcpg")]
        for where, rows in (("space", space_), ("plane", plane_)) for name in ("N", "R")
    }  # fmt: skip
    enriched = table[table["primal"] != bare]
    reduced, certified = table[table["assembly"] == "reduced"], table[table["assembly"] == "certified"]
    share = 100.0 * table["offline_snapshots_s"] / table["offline_s"]
    shares = [f"{share[rows.index].min():.0f} to {share[rows.index].max():.0f} %" for rows in (reduced, certified)]
    gains = {
        kind: span(rows[rows["primal"] == online].set_index(["dual", "pod_tol"])["online_s"]
                   / rows[rows["primal"] == offline].set_index(["dual", "pod_tol"])["online_s"])
        for kind, rows in (("reduced", reduced), ("certified", certified))
    }  # fmt: skip
    page = (ROOT / "results" / "three-dimensions" / "README.md").read_text(encoding="utf-8")
    starts: dict[str, list[int]] = {"reduced": [], "certified": []}
    for kind, start in re.findall(r"\| high-fidelity +\|[^|]+\| (reduced|certified) +\|[^|]+\| from (\d+)", page):
        starts[kind].append(int(start))
    pays = {kind: f"{min(values)} to {max(values)}" for kind, values in starts.items()}
    return (
        f"N is {sizes['space', 'N'][0]} at 1e-2 and 1e-3",
        f"`cpg` has {sizes['space', 'R'][0]} generators and `mcpg` {sizes['space', 'R'][1]}",
        f"N is {sizes['plane', 'N'][0]}, R {sizes['plane', 'R'][0]} and {sizes['plane', 'R'][1]}",
        f"by {ladder(space_, 'enrichment', 'mcpg', offline)} vectors with `mcpg`",
        f"in the plane by {ladder(plane_, 'enrichment', 'mcpg', offline, 3)}, more",
        f"β over the span is then {span(enriched['beta_span_min'])}",
        f"β over the cone is {ladder(space_, 'beta_cone_lower_min', 'cpg', bare)} with `cpg` and "
        f"{ladder(space_, 'beta_cone_lower_min', 'mcpg', bare)} with `mcpg` without enrichment, "
        f"{ladder(space_, 'beta_cone_lower_min', 'cpg', offline)} and "
        f"{ladder(space_, 'beta_cone_lower_min', 'mcpg', offline)} with",
        f"of λ fall from {ladder(space_, 'error_lambda_mean', 'mcpg', bare)} to "
        f"{ladder(space_, 'error_lambda_mean', 'mcpg', offline)} with `mcpg`",
        f"in the plane from {ladder(plane_, 'error_lambda_mean', 'mcpg', bare)} to "
        f"{ladder(plane_, 'error_lambda_mean', 'mcpg', offline)}",
        f"With `cpg` they stay at {ladder(space_, 'error_lambda_mean', 'cpg', offline)}",
        f"{gains['reduced']} times as long as those with offline PGA, certified ones {gains['certified']} times",
        f"takes {span(1e3 * reduced['online_s'])} ms, a certified one {span(1e3 * certified['online_s'])} ms",
        f"a high-fidelity solution {1e3 * table['hf_s'].min():.0f} to {1e3 * table['hf_s'].max():.0f} ms",
        f"Snapshots are {shares[0]} of the offline seconds, {shares[1]} with certificates",
        f"certificates take {certified['offline_certificate_s'].min():.0f} to "
        f"{certified['offline_certificate_s'].max():.0f} s",
        f"{span(certified['effectivity_online_u_energy_median'])} for u and "
        f"{span(certified['effectivity_online_lambda_natural_median'])} for λ",
        f"up to {certified['effectivity_u_energy_median'].max():.2g} times the error of u",
        f"from {pays['reduced']} queries on, with certificates from {pays['certified']} on",
    )


@pytest.mark.parametrize(
    ("page", "sentences"),
    [
        ("docs/field.md", of_cones),
        ("docs/field.md", of_guarantees),
        ("docs/formulations.md", of_formulations),
        ("docs/formulations.md", of_break_evens),
        ("docs/three-dimensions.md", of_space),
    ],
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
