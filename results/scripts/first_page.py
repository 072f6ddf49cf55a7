"""The results on the first page: a table of both problems, and what holds over all models of the studies.

python results/scripts/first_page.py results README.md

Everything is computed from the tables that are committed below `results/`. Of README the part between the marks
`<!-- generated: results -->` and `<!-- end: results -->` is replaced.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
from committed import (
    ASSEMBLIES,
    MODEL,
    PROBLEMS,
    Results,
    enriched,
    interval,
    number,
    of,
    span,
    surely_above_one,
    unavailable,
    when,
)
from page import start

from vibench.report.figures.data import label
from vibench.results import formats

PLACE = re.compile(r"(<!-- generated: results -->\n).*?(<!-- end: results -->)", re.DOTALL)

RATIO = "o[fn]+line time, o[fn]+ / o[fn]+"
"""What a ratio of seconds is called in the tables of `docs/reproduction.md`, as a regular expression."""


def factors(results: Results) -> Iterator[str]:
    """Factors by which enrichments reduce the error of λ, by problem and cone."""
    for problem, cells in results.full.items():
        for dual, mine in cells.groupby("dual"):
            lambdas, us = enriched(mine, "error_lambda_mean"), enriched(mine, "error_u_mean")
            yield (
                f"{problem}, {dual}: {span(lambdas)} for λ ({of(int((lambdas > 1.1).sum()), len(lambdas))} above 1.1), "
                f"{span(us)} for u"
            )


def models(results: Results) -> pd.DataFrame:
    """One row per model of `benefit`: errors, bounds, gains in every assembly, break-even in reduced assembly."""
    bounds = results.table("benefit", "bounds").set_index("cell")
    rows = []
    for key, mine in _in_order(results.gains).groupby(MODEL, dropna=False, sort=False):
        by = mine.set_index("assembly")
        named = dict(zip(MODEL, key, strict=True))
        reduced, bound = by.loc["reduced"], bounds.loc[by.loc["certified", "cell"]]
        gains = {
            f"gain, {how}": interval(*by.loc[how, ["gain", "gain_low", "gain_high"]].astype(float))
            for how in ASSEMBLIES
        }
        rows.append(
            {
                "problem": named["problem"], "N, R": f"{reduced['N']:.0f}, {reduced['R']:.0f}",
                "enrichment": label(named["primal"], named["primal_tol"]),
                "error of u, bound": _bounded(bound, "u_energy"),
                "error of λ, bound": _bounded(bound, "lambda_natural"), **gains, "cheaper": when(reduced),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def _in_order(gains: pd.DataFrame) -> pd.DataFrame:
    """The models of the first problem of the paper first, the smallest N first, the largest enrichment last."""
    problem, primal = gains["problem"].map(PROBLEMS.index), gains["primal"].map(list(gains["primal"].unique()).index)
    order = pd.concat([problem, gains["N"], primal, -gains["primal_tol"]], axis=1, keys=range(4))
    return gains.loc[order.sort_values([0, 1, 2, 3], kind="stable").index]


def _bounded(bound: pd.Series, name: str) -> str:
    return f"{number(bound[f'error_{name}_mean'])}, {number(bound[f'bound_{name}_mean'])}"


def first_page(results: Results) -> str:
    """What README says of results."""
    gains, bounds = results.gains, results.table("benefit", "bounds")
    effectivities = results.table("certified", "effectivities")
    tally = re.findall(r"^\| all \| (\d+) \| (\d+) \| (\d+) \|", _reproduction(results), re.MULTILINE)[0]
    certified = gains[gains["assembly"] == "certified"]
    enriched = certified[certified["primal"] != "decorrelated"]
    decorrelated = {p: cells[cells["primal"] == "decorrelated"] for p, cells in results.full.items()}
    supplied = {p: cells[cells["primal"] != "decorrelated"] for p, cells in results.full.items()}
    lines = [
        "Two problems at the size of the paper, mCPG, PIQP; means over 64 validation parameters. Errors are relative, "
        "of u in the energy norm and of λ in the natural one, as the bounds at online cost beside them, which are "
        f"{certificates(gains)}. A *gain* is the "
        "seconds of a high-fidelity solution that starts from the nearest contact set over those of a query, with the "
        "95 % interval of what another run would measure, from three cold processes. The last column says from how "
        "many queries on a model in reduced assembly is cheaper than high-fidelity solutions, with its offline phase.",
        formats.to_markdown(models(results)).strip(),
        "What holds over all models of `benefit`, the table above, and of `paper-obstacle` and `paper-hertz`, and what "
        "does not:",
        "\n".join(
            [
                "- **Gains** (`benefit`), and how many models are faster than high-fidelity solutions: "
                + "; ".join(f"{how} {', '.join(_gain(gains, how, p) for p in PROBLEMS)}" for how in ASSEMBLIES)
                + ".",
                "- **Enrichment** divides the errors of λ in the norm of W and of u in that of V by these factors: "
                + "; ".join(factors(results))
                + ".",
                "- **β over the span** is at most "
                + ", ".join(f"{number(mine['beta_span_min'].max())} ({p})" for p, mine in decorrelated.items())
                + " without enrichment, and "
                + ", ".join(f"{span(mine['beta_span_min'])} ({p})" for p, mine in supplied.items())
                + " with one; **over the cone** it is "
                + ", ".join(
                    f"{span(decorrelated[p]['beta_cone_lower_min'])} without and "
                    f"{span(supplied[p]['beta_cone_lower_min'])} with one ({p})"
                    for p in PROBLEMS
                )
                + ".",
                f"- **Bounds** are violated in {of(int(bounds['violations'].sum()), int(bounds['queries'].sum()))} "
                f"queries of `benefit`. Its models have median effectivities at online cost of "
                f"{span(certified['effectivity_online_u_energy_median'])} for u and "
                f"{span(certified['effectivity_online_lambda_natural_median'])} for λ, in the norms of the table. "
                "The bound of u is of the sum with λ, whose error is the larger one without enrichment; "
                f"enriched models have at most {number(enriched['effectivity_online_u_energy_median'].max())} for u. "
                f"The largest of a model of `certified`, all of which are enriched, are "
                f"{span(effectivities['u in the energy norm, (ii) online'])} and "
                f"{span(effectivities['λ in the natural norm, (ii) online'])}.",
                f"- **Of the paper** {tally[0]} claims agree with our runs, {tally[1]} differ, and {tally[2]} "
                f"cannot be compared; of its tables, {_agreement(results, 'benefit threshold')} benefit thresholds and "
                f"{_agreement(results, RATIO)} ratios of seconds agree: [claim by claim](docs/reproduction.md).",
            ]
        ),
        "Text and table are made by `python results/scripts/first_page.py results README.md` from "
        "tables that name their commands and the machine.",
    ]
    return "\n\n".join(lines)


def _gain(gains: pd.DataFrame, assembly: str, problem: str) -> str:
    mine = gains[(gains["assembly"] == assembly) & (gains["problem"] == problem)]
    if mine["gain"].isna().all():
        return f"none ({problem}: {unavailable(mine)})"
    return f"{span(mine['gain'])} ({problem}, {surely_above_one(mine)} faster)"


def certificates(gains: pd.DataFrame) -> str:
    """What the bounds at online cost rely on, by problem."""
    kinds = gains[gains["assembly"] == "certified"].groupby("problem")["certificate"].unique()
    return " and ".join(f"{', '.join(kinds[problem])} ({problem})" for problem in PROBLEMS)


def _agreement(results: Results, quantity: str) -> str:
    """How many of the rows of both tables of the paper that have a quantity agree; seconds alone are not compared."""
    rows = re.findall(
        rf"^\| Table [12], \([^|]*: {quantity} \|[^|]*\|[^|]*\| (agrees|differs) ",
        _reproduction(results),
        re.MULTILINE,
    )
    return of(rows.count("agrees"), len(rows))


def _reproduction(results: Results) -> str:
    return (results.folder.parent / "docs" / "reproduction.md").read_text(encoding="utf-8")


def filled(text: str, results: Results) -> str:
    """A page with its generated part as it is made from the tables."""
    return PLACE.sub(lambda place: f"{place[1]}\n{first_page(results)}\n\n{place[2]}", text)


def main(results: str, readme: str) -> None:
    path = Path(readme)
    path.write_text(filled(path.read_text(encoding="utf-8"), Results(results)), encoding="utf-8")


if __name__ == "__main__":
    start(main)
