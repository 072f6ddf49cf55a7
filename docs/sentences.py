"""Parts of sentences that are rendered from the tables under `results/` whenever the documentation is built.

On a page such a part stands between `<!-- NAME NUMBER -->` and `<!-- -->`, as it was rendered last; NAME is a function
of this module that returns all parts of its topic, and NUMBER counts them. `python docs/sentences.py` renders the pages
themselves. The functions assert what a sentence claims beside its numbers, so that the build fails where a claim is no
longer true. Other numbers come from the commands that the pages name beside them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

ROOT = Path(__file__).parents[1]
MODEL = ["problem", "dual", "primal", "primal_options", "pod_tol", "pod_size", "dual_tol", "dual_size", "primal_tol"]
BARE, ONLINE, OFFLINE = "decorrelated", "online-supremizers", "offline-pga"
PLACE = re.compile(r"<!-- (\w+) (\d+) -->.*?<!-- -->", re.DOTALL)


def result(page: str, table: str = "cells") -> pd.DataFrame:
    """A table of a page of results."""
    return pd.read_csv(ROOT / "results" / page / f"{table}.csv")


def cells(study: str) -> pd.DataFrame:
    """The cells of a study, with the solver of the pages."""
    return result(study)[lambda table: table["solver"] == "piqp"]


def cones() -> Sequence[str]:
    """What the page of comparisons says of cones: sizes, errors, conditioning."""
    table = cells("field")
    chosen = table[(table["assembly"] == "full") & (table["pod_tol"] == 1e-3)]
    by, bare = (
        {key: rows.iloc[0] for key, rows in chosen[chosen["primal"] == primal].groupby(["problem", "dual"])}
        for primal in (ONLINE, BARE)
    )
    greedy = ("cpg", "mcpg", "enlarged-cpg", "angle-greedy")
    assert {by["hertz", dual]["R"] for dual in greedy} == {9}
    assert by["obstacle", "nmf"]["offline_cone_s"] == max(row["offline_cone_s"] for row in by.values())
    size = {dual: by["obstacle", dual]["R"] for _, dual in by}
    error = {key: row["error_lambda_mean"] for key, row in by.items()}
    condition = {key: row["gram_condition"] for key, row in by.items()}
    assert error["obstacle", "mcpg"] < error["obstacle", "cpg"]
    assert error["hertz", "cpg"] < error["hertz", "mcpg"]
    assert error["obstacle", "nmf"] < error["obstacle", "dictionary"]
    assert error["obstacle", "enlarged-cpg"] < 0.6 * error["obstacle", "cpg"]
    assert condition["hertz", "enlarged-cpg"] == min(condition["hertz", dual] for dual in greedy)
    assert size["orthant"] < 1.1 * size["mcpg"]
    assert size["angle-greedy"] > size["cpg"]
    rows = []
    for dual in sorted(size):
        name, _, what = dual.partition(" ")
        rows.append([f"`{name}` {what}".strip()])
        for problem in ("obstacle", "hertz"):
            one = by[problem, dual]
            dependent = one["rank"] < one["R"]
            errors = (row["error_lambda_mean"] for row in (one, bare[problem, dual]))
            rows[-1] += [
                f"{one['R']} ({one['rank']})" if dependent else str(one["R"]),
                "dependent" if dependent else f"{one['gram_condition']:.2g}",
                *(
                    f"{float(f'{100.0 * each:.2g}'):g} %" if each < 10.0 else f"{float(f'{each:.2g}'):g} times"
                    for each in errors
                ),
            ]
    return (
        f"it has {size['mcpg']} generators, where `cpg` needs {size['cpg']}",
        f"{error['obstacle', 'mcpg'] / error['obstacle', 'nmf']:.0f} times smaller",
        f"it needs {by['hertz', 'orthant']['R']} directions",
        table_rows(rows),
    )


def misses(study: str, problem: str) -> tuple[int, pd.DataFrame]:
    """How many enrichments of a problem record a guarantee, and those that miss it at a validation parameter."""
    table = cells(study)
    recorded = table[(table["problem"] == problem) & table["share_guaranteed"].notna()].drop_duplicates(MODEL)
    below = recorded["share_validation"] < recorded["share_guaranteed"] * (1.0 - 1e-9)
    return len(recorded), recorded[below]


def guarantees() -> Sequence[str]:
    """What the page of comparisons says of shares off the training set."""
    rows = []
    for study, problems in (("field", ("hertz", "obstacle")), ("paper-hertz", ("hertz",)),
                            ("paper-obstacle", ("obstacle",))):  # fmt: skip
        found = [misses(study, problem) for problem in problems]
        missed = pd.concat([below for _, below in found])
        worst = missed.loc[(missed["share_validation"] / missed["share_guaranteed"]).idxmin()] if len(missed) else None
        ends = "–" if worst is None else f"{worst['share_validation']:.3f} in place of {worst['share_guaranteed']:.3f}"
        rows.append([f"`{study}`", "guaranteed by σ", sum(count for count, _ in found), len(missed), ends])
    assert [row[3] == 0 for row in rows] == [True, False, True]
    table = cells("field")
    stops = table["primal"].isin(["infsup-greedy", "offline-pga (stop on β)"])
    prescribed = table[stops].drop_duplicates(MODEL)
    short = prescribed[prescribed["share_validation"] < prescribed["primal_tol"] * (1.0 - 1e-9)]
    worst = short.loc[(short["share_validation"] / short["primal_tol"]).idxmin()]
    assert set(short["problem"]) == {"hertz"}
    assert set(short["dual"]) == {"orthant", "dictionary"}
    ends = f"{worst['share_validation']:.3f} in place of {worst['primal_tol']:g}"
    rows.append(["`field`", "prescribed", len(prescribed), len(short), ends])
    return (table_rows(rows),)


def slowest() -> Sequence[str]:
    """What it says of the enrichment with the slowest queries."""
    table = cells("field")
    table = table[~table["dual"].str.startswith("pod-dual")]
    slowest = table.loc[table.groupby(["problem", "assembly", "pod_tol", "dual"])["online_s"].idxmax()]
    others = slowest[slowest["primal"] != ONLINE]
    assert set(others["problem"]) == {"hertz"}
    return ("has the slowest queries on the obstacle",)


def setting() -> Sequence[str]:
    """What it says of the meshes, and of Gram matrices whose generators are linearly dependent."""
    table = cells("field")
    assert set(table["queries"]) == {32}
    size = {name: rows[["dim_V", "dim_W", "snapshots"]].iloc[0] for name, rows in table.groupby("problem")}
    dependent = table["rank"] < table["R"]
    condition = table["gram_condition"]
    assert size["hertz"]["snapshots"] == 81
    assert condition[dependent].min() > 1e36
    assert condition[~dependent].max() < 1e11
    return (table_rows([name.capitalize(), f"{one['dim_V']:,}", one["dim_W"]] for name, one in reversed(size.items())),)


def tight(table: pd.DataFrame, *, control: bool = False) -> pd.DataFrame:
    """The cells of `field` in full at the tighter tolerances, with cones in W⁺ or those of the negative control."""
    of_control = table["dual"].str.startswith("pod-dual")
    return table[(table["assembly"] == "full") & (table["pod_tol"] == 1e-3) & (of_control == control)]


def percent(values: pd.Series, digits: int = 2) -> list[str]:
    """The smallest and the largest of some shares in per cent."""
    return [f"{float(f'{100.0 * end:.{digits}g}'):g}" for end in (values.min(), values.max())]


def cones_and_controls() -> Sequence[str]:
    """What it says of the best and the worst cones, and of cells without enrichment."""
    table = cells("field")
    chosen = tight(table)
    online = chosen[chosen["primal"] == ONLINE].set_index(["problem", "dual"])
    for problem, rows in online.groupby("problem"):
        assert rows["gram_condition"].idxmin() == (problem, "orthant")
    assert online.loc["obstacle", "error_lambda_mean"].idxmin() == "orthant"
    assert online.loc["obstacle", "R"].idxmin() == "nmf"
    assert online.loc["hertz", "error_lambda_mean"].idxmin() == "dictionary"
    assert online.loc[("hertz", "dictionary"), "R"] == 9 * online.loc[("hertz", "cpg"), "R"]
    assert online.loc[("obstacle", "mcpg"), "rank"] == online.loc[("obstacle", "mcpg"), "R"]
    control = tight(table, control=True)
    assert control["error_lambda_mean"][control["primal"] != BARE].min() > 0.15
    bare = chosen[chosen["primal"] == BARE].set_index(["problem", "dual"])
    snapshots = ["angle-greedy", "cpg", "dictionary"]  # generators that are snapshots
    cone, error = bare["beta_cone_lower_min"], bare["error_lambda_mean"]
    enriched = chosen[chosen["primal"] != BARE].groupby(["problem", "dual"])["beta_cone_lower_min"].min()
    assert cone.loc["hertz"].loc[snapshots].nunique() == 1
    assert cone.loc["obstacle"].idxmin() == "orthant"
    assert cone.loc["obstacle"].min() > 0.0
    assert (cone < 0.25 * enriched).loc["obstacle"].all()
    low, high = percent(error.loc["obstacle"])
    return (
        f"min β over the cone on Hertz is {cone['hertz', 'cpg']:.2f}, and the mean error of λ is "
        f"{percent(error.loc['hertz'].loc[snapshots])[1]} % at most",
        f"between {low} % and {high} %",
    )


def enrichments() -> Sequence[str]:
    """What it says of vectors and shares with the cone of mCPG, and of prescribed shares that are missed."""
    table = cells("field")
    mine = tight(table)[lambda rows: rows["dual"] == "mcpg"].set_index(["problem", "primal", "primal_tol"])
    hertz, obstacle = mine.loc["hertz"], mine.loc["obstacle"]
    assert hertz["offline_enrichment_s"].idxmax()[0] == "pod-supremizers"
    numbers = result("field", "vectors")
    numbers = numbers[(numbers["problem"] == "hertz") & (numbers["pod_tol"] == 1e-3)]
    ways = ("infsup-greedy", "offline-pga", "offline-pga (stop on β)", "pod-supremizers")
    for row in numbers.to_dict("records"):  # a share of 0.3, 0.5, 0.7 and 0.9
        *loose, last = zip(*([int(word) for word in row[way].split(" / ")] for way in ways), strict=True)
        assert all(min(share) == share[-1] for share in loose)
        assert (min(last), max(last)) == (last[0], last[-1])
    greedy = [rows.loc[("infsup-greedy", 0.7), "enrichment"] for rows in (hertz, obstacle)]
    pga = hertz.loc[("offline-pga", 0.6)]
    loose, fine = hertz.loc[("pod-supremizers", 0.1)], obstacle.loc[("pod-supremizers", 0.01)]
    online = tight(table)[lambda rows: (rows["primal"] == ONLINE) & (rows["dual"] == "mcpg")].set_index("problem")
    above = [
        rows[name] / online.loc[problem, name] - 1.0
        for problem, rows in (("hertz", loose), ("obstacle", fine))
        for name in ("error_u_mean", "error_lambda_mean")
    ]
    assert loose["enrichment"] == fine["enrichment"] == 59
    assert f"{100.0 * max(above):.1f}" == "0.1"
    return (
        f"it has {loose['enrichment']} vectors and a share of {loose['share_training']:.2f}",
        f"with 0.7 it stops at {greedy[0]} vectors on Hertz and at {greedy[1]} on the obstacle",
        f"its {pga['enrichment']} vectors reach {pga['share_training']:.2f} over the training set and "
        f"{pga['share_validation']:.2f} over the validation set",
        f"With {fine['R']} generators and {fine['N']} modes",
        f"such as {fine['enrichment']} of `pod-supremizers`, have errors that are at most {100.0 * max(above):.1f} %",
    )


def span(values: pd.Series) -> str:
    """The range of some numbers, to two digits."""
    ends = (values.min(), values.max())
    return " to ".join(dict.fromkeys(whole(end) if 99.5 <= end < 1e4 else f"{end:.2g}" for end in ends))


def formulation_name(name: str) -> str:
    """A formulation and its variant, as tables of the pages write it."""
    word, _, variant = name.partition(" ")
    return f"`{word}` {variant}".strip()


def formulations() -> Sequence[str]:
    """What it says of formulations: times and errors beside those of `mixed`, and less training."""
    table = result("formulations")
    assert (table["queries_ok"] == table["queries"]).all()
    key = ["problem", "dual", "pod_tol", "training"]
    mixed = table[table["formulation"] == "mixed"].set_index(key)
    ratios = {}
    for column in ("online_s", "error_lambda_mean", "offline_s", "violation_max"):
        pairs = table.merge(mixed[column].rename(f"{column} of mixed"), left_on=key, right_index=True)
        ratios[column] = pairs[column] / pairs[f"{column} of mixed"]
    own, of = table["training"] == "own", table["formulation"]
    mcpg = table["dual"] == "mcpg"
    beside = []
    for name in sorted(set(of) - {"mixed"}):
        mine = own & (of == name)
        parts = [(column, mine & cone) for column in ("online_s", "error_lambda_mean") for cone in (mcpg, ~mcpg)]
        parts += [("offline_s", mine), ("violation_max", mine)]
        beside.append([formulation_name(name), *(span(ratios[column][chosen]) for column, chosen in parts)])
    same = own & of.isin(["penalty", "proximal", "sparse-dictionary"])
    assert ratios["error_lambda_mean"][same & mcpg].max() < 1.15
    assert ratios["offline_s"][same].max() < 1.0025
    assert ratios["online_s"][own & of.str.startswith("hyper-reduced")].min() > 0.8
    fastest = table[own].loc[table[own].groupby("problem")["online_s"].idxmin()].set_index("problem")
    assert set(fastest["formulation"]) == {"regression (radial)"}
    errors_of = table.pivot_table(index=["formulation", "problem", "dual", "pod_tol"], columns="training",
                                  values="error_lambda_mean")  # fmt: skip
    grown = np.log(errors_of[["half", "inner"]].div(errors_of["own"], axis=0))
    growth = np.exp(grown.groupby(level=["formulation", "problem"]).mean()).reset_index("problem", drop=True)
    kinds, told = growth.groupby(growth.index.str.split().str[0]), ("mixed", "local", "regression")
    meaning = result("formulations", "thresholds").groupby("formulation_b")["meaning"]
    assert set(meaning.get_group("regression (radial)")) == {"at once"}
    assert set(meaning.get_group("proximal")) == {"never"}
    compiled = result("formulations", "compiled")
    best = result("formulations", "levels").groupby("problem").last()
    problems = {"obstacle": "obstacle", "hertz": "Hertz", "bearing": "bearing", "american-put": "American put"}
    return (
        table_rows(
            [
                label,
                f"{100.0 * fastest['error_lambda_mean'][problem]:.2g} %",
                f"{formulation_name(best['formulation'][problem])}, `{best['dual'][problem]}`",
                f"{100.0 * best['smallest error'][problem]:.2g} %",
            ]
            for problem, label in problems.items()
        ),
        f"{span(pd.to_numeric(compiled['query / compiled']).dropna())} times as fast",
        f"{of.str.split().str[0].nunique()} formulations and {len(table)} cells".replace("7 ", "seven "),
        table_rows(beside),
        table_rows([f"`{name}`", *map(span, (some["inner"], some["half"]))] for name, some in kinds if name in told),
        f"in {table['queries'].sum():,} queries",
    )


def certified() -> Sequence[str]:
    """What it says of certified models: effectivities, corrections, certificates and greedy training."""
    medians, largest, costs, corrected = (
        result("certified", name) for name in ("medians", "effectivities", "costs", "corrections")
    )
    norms = ("u in the energy norm", "u in V", "λ in the natural norm", "λ in W")
    kinds = {"(ii)": "with the best correction", "(ii) online": "at online cost",
             "HSW": "Haasdonk, Salomon and Wohlmuth"}  # fmt: skip
    assert (medians["violations"] == 0).all()
    assert len(medians) == 24
    effectivities = [
        [label, *(f"{medians[name].min():.3g} to {medians[name].max():.3g} ({largest[name].max():.3g})"
                  if name in medians else "–" for name in (f"{norm}, {kind}" for norm in norms))]
        for kind, label in kinds.items()
    ]  # fmt: skip
    share = (costs["certificates offline [s]"] / costs["offline without [s]"]).groupby(
        [costs["training"], costs["problem"]]
    )
    takes = {key: span(some) for key, some in share}
    gains = ["λ without / with online", "λ without / with in full"]
    of_obstacle = corrected[corrected["problem"] == "obstacle"]
    least = of_obstacle[["error λ", "error λ online"]].min()
    training = result("certified", "training")
    equal = training[training["largest ratio of errors"] <= 1.0]
    missed = training[training["largest ratio of errors"] > 1.0]
    assert set(missed["paper"]) == {"no"}
    assert set(missed["problem"]) == {"hertz"}
    (orthant,) = [rows for key, rows in equal.groupby(["problem", "pod_tol", "dual_tol"]) if key[1:] == (1e-4, 1e-3)]
    assert set(equal["greedy dual"][(equal["paper"] == "yes") & ~equal.index.isin(orthant.index)]) == {"mcpg"}
    assert set(orthant["greedy dual"]) == {"orthant"}
    slower = orthant["greedy query [ms]"] / orthant["fixed query [ms]"]
    return (
        table_rows(effectivities),
        table_rows([name, *(takes[how, name.lower()] for how in ("own", "greedy"))] for name in ("obstacle", "Hertz")),
        *(
            f"| {100.0 * rows['ω > ρ online'].min():.0f} to {100.0 * rows['ω > ρ online'].max():.0f} % | "
            f"{' | '.join(f'{rows[name].min():.3g} to {rows[name].max():.3g}' for name in gains)} |"
            for rows in (of_obstacle, corrected[corrected["problem"] == "hertz"])
        ),
        f"{least['error λ']:.2e} without correction and {least['error λ online']:.2e} with".replace("e-0", "e-"),
        f"{orthant['greedy R'].max()} generators instead of {orthant['fixed R'].max()}. Queries take "
        f"{slower.mean():.1f} times as long",
    )


def unseen_parameters() -> Sequence[str]:
    """What it says of random parameters that no training set has."""
    table = result("certified", "unseen")
    assert (table["violations"] == 0).all()
    assert (table["without a bound"] == 0).all()
    effectivities = []
    for name in ("obstacle", "Hertz"):
        values = table[table["problem"] == name.lower()]
        effectivities.append([name])
        for vector in ("u", "λ"):
            middle, least = values[f"median effectivity of {vector}"], values[f"least effectivity of {vector}"]
            effectivities[-1] += [f"{middle.min():.2f} to {middle.max():.2f}", f"{least.min():.4g}"]
    return (
        f"in the {table['parameters'].sum():,} queries of the {len(table)} models",
        table_rows(effectivities),
    )


def ladder(rows: pd.DataFrame, column: str, dual: str, primal: str, digits: int = 2) -> str:
    """A column at both tolerances of a model, the looser one first."""
    equal = rows[(rows["pod_tol"] == rows["dual_tol"]) & (rows["dual"] == dual) & (rows["primal"] == primal)]
    by = equal.groupby("pod_tol")[column].first()
    return f"{by[1e-2]:.{digits}g}, {by[1e-3]:.{digits}g}"


def of_models(rows: pd.DataFrame) -> dict[str, str]:
    """What the table on three dimensions says of the models on one mesh, or of those of the plane."""
    enriched = rows.loc[(rows["primal"] != BARE) & (rows["pod_tol"] == rows["dual_tol"]), "beta_span_min"]
    errors = {
        f"error of λ, `{dual}`, {name}": ladder(rows, "error_lambda_mean", dual, primal)
        for dual in ("cpg", "mcpg") for name, primal in (("not enriched", BARE), ("offline PGA", OFFLINE))
    }  # fmt: skip
    return {
        "N": ladder(rows, "N", "cpg", BARE, 3),
        "generators of `cpg`": ladder(rows, "R", "cpg", BARE, 3),
        "generators of `mcpg`": ladder(rows, "R", "mcpg", BARE, 3),
        "vectors of offline PGA, `mcpg`": ladder(rows, "enrichment", "mcpg", OFFLINE, 3),
        "β over the span, enriched": span(enriched),
        "error of u, `mcpg`, offline PGA": ladder(rows, "error_u_mean", "mcpg", OFFLINE),
        **errors,
    }


def of_costs(rows: pd.DataFrame, pairs: pd.DataFrame) -> dict[str, str]:
    """What it says of seconds and bounds of the models on one mesh, and of their break-even."""
    kinds = {kind: rows[rows["assembly"] == kind] for kind in ("reduced", "certified")}
    certified = kinds["certified"]
    mine = pairs[(pairs["problem"] == rows["problem"].iloc[0]) & (pairs["in place of"] == "high-fidelity")]
    from_on = mine["pays, in queries"].str.removeprefix("from ").astype(int).groupby(mine["assembly"])
    each = {
        kind: {
            f"{kind} query [ms]": span(1e3 * some["online_s"]),
            f"{kind}: pays from, queries": f"{from_on.min()[kind]} to {from_on.max()[kind]}",
        }
        for kind, some in kinds.items()
    }
    return {
        "high-fidelity solution [s]": span(rows["hf_s"]),
        **each["reduced"],
        **each["certified"],
        "effectivity of u, online": span(certified["effectivity_online_u_energy_median"]),
        "effectivity of λ, online": span(certified["effectivity_online_lambda_natural_median"]),
    }


def elliptic_contact() -> Sequence[str]:
    """What the gallery says of differences from Hertz's contact."""
    table = result("three-dimensions", "theory")
    table["axes"] = table[["a", "b"]].abs().max(axis=1)
    largest = table.groupby("unknowns").agg(dict.fromkeys(["force", "peak", "axes"], lambda each: each.abs().max()))
    assert (largest[largest.index > 20_000] < [0.02, 0.01, 0.01]).all(axis=None)
    rows = table.groupby("unknowns")[["mesh", "multipliers"]].first().join(largest)
    seconds = table.groupby("unknowns")["seconds"].median()
    return (
        table_rows(
            [
                f"`{one['mesh']}`",
                f"{n:,.0f}",
                f"{one['multipliers']:.0f}",
                *(f"{100.0 * one[of]:.3g} %" for of in largest),
                f"{seconds[n]:.2g}",
            ]
            for n, one in rows.iterrows()
        ),
    )


def space() -> Sequence[str]:
    """What it says of contact in space, by mesh and beside the plane."""
    table = result("three-dimensions")
    assert (table["queries_ok"] == table["queries"]).all()
    assert (table["bound_online_violations"].fillna(0.0) == 0.0).all()
    assert (table.loc[table["primal"] == BARE, "beta_span_min"] == 0.0).all()
    pairs = result("three-dimensions", "break-even")
    plane = cells("paper-hertz")
    plane = plane[(plane["primal_tol"].isna() | (plane["primal_tol"] == 0.5)) & (plane["assembly"] == "full")]
    meshes = [rows for _, rows in sorted(table.groupby("dim_V"), key=lambda one: one[0])]
    columns = [of_models(rows[rows["assembly"] == "reduced"]) | of_costs(rows, pairs) for rows in meshes]
    columns.append(of_models(plane))
    for rows, smaller in ((table, True), (plane, False)):  # than the number of generators
        added = rows[(rows["primal"] == OFFLINE) & (rows["dual"] == "mcpg") & (rows["pod_tol"] == rows["dual_tol"])]
        assert ((added["enrichment"] < added["R"]) == smaller).all()
    short = table[["offline_pod_s", "offline_cone_s", "offline_enrichment_s"]].sum(axis=1).groupby(table["dim_V"]).max()
    sized = table.set_index(["dual", "primal", "pod_tol", "dual_tol", "assembly", "N", "R", "enrichment"])
    finer, coarser = (
        sized.loc[sized["dim_V"] == edge, "online_s"] for edge in (table["dim_V"].max(), table["dim_V"].min())
    )
    ratios = (finer / coarser).dropna()
    pays = pairs[pairs["in place of"] == ONLINE].groupby("assembly")["pays, in queries"].value_counts()
    assert pays["reduced"].to_dict() == {"at once": len(meshes) * 4}
    assert set(pays["certified"].index) <= {"undecided", "as fast", "at once"}
    certified = pays["certified"].rename({"at once": "cheaper at once"})
    counts = ", ".join(f"{count} are {meaning}" for meaning, count in certified.items())
    return [
        f"of {pays['certified'].sum()} pairs of certified ones {counts}",
        table_rows([name, *(one.get(name, "–") for one in columns)] for name in columns[0]),
        f"take at most {short.iloc[0]:.2g} s at `medium` and {short.iloc[-1]:.2g} s at `paper`",
        span(ratios.xs("certified", level="assembly")),
    ]


def whole(number: float) -> str:
    """A number of queries, to two digits."""
    return f"{float(f'{number:.2g}'):.0f}"


def break_even(cell: pd.DataFrame | pd.Series) -> pd.Series:
    """From how many queries a cell, or each of some, is cheaper than full solutions with their set-up."""
    return (cell["offline_s"] - cell["hf_setup_s"]) / (cell["hf_s"] - cell["online_s"])


def pays(values: pd.Series) -> str:
    """The range of some numbers of queries, to two digits."""
    return " to ".join(dict.fromkeys(whole(end) for end in (values.min(), values.max())))


def table_rows(rows: Iterable[Sequence[object]]) -> str:
    """Rows of a Markdown table, without the bars at both ends."""
    return " |\n| ".join(" | ".join(map(str, row)) for row in rows)


def factors_of_enriching() -> pd.DataFrame:
    """Of every enriched model of three studies its problem, whether N < R, and the factor of the error of λ."""
    every = pd.concat([cells(study) for study in ("paper-obstacle", "paper-hertz", "enriching")])
    cone = ["problem", "dual", "pod_tol", "pod_size", "dual_tol", "dual_size"]
    # Errors in full assembly are those in reduced assembly, which `enriching` has alone.
    every = every[(every["assembly"] == "full") | ~every["problem"].isin(["obstacle", "hertz"])].set_index(cone)
    plain, enriched = every[every["primal"] == BARE], every[every["primal"] != BARE]
    factor = plain["error_lambda_mean"].reindex(enriched.index) / enriched["error_lambda_mean"]
    few = (plain["N"] < plain["R"]).reindex(enriched.index)
    return pd.DataFrame({"few": few, "factor": factor}).reset_index("problem")


def enriching() -> Sequence[str]:
    """What enriching does to the error of λ, with fewer modes than generators and with more."""
    table, rows = factors_of_enriching(), []
    for problem in dict.fromkeys(table["problem"]):
        parts = [table["factor"][(table["problem"] == problem) & (table["few"] == few)] for few in (True, False)]
        texts = (f"{one.median():.2g} ({span(one)}; {len(one)} models)" if len(one) else "no model" for one in parts)
        rows.append([problem, *texts])
    return (table_rows(rows),)


def chosen_cone() -> Sequence[str]:
    """Every cone at the tighter tolerance of the study `field`."""
    table = cells("field")
    kept = (table["primal"] == ONLINE) & (table["assembly"] == "reduced") & ~table["dual"].str.contains("control")
    tight = table[kept & (table["pod_tol"] == table["pod_tol"].min())]
    rows = []
    for dual, mine in tight.groupby("dual"):
        rows.append([f"`{dual}`"])
        for problem in ("obstacle", "hertz"):
            one = mine[mine["problem"] == problem].iloc[0]
            rows[-1] += [str(one["R"]), f"{one['error_lambda_mean']:.2g}", f"{one['offline_cone_s']:.2g}"]
    return (table_rows(rows),)


def chosen_solver() -> Sequence[str]:
    """Every QP solver: seconds relative to the fastest one of a model, and models that it solves."""
    table = result("solvers")
    least = table.groupby([*MODEL, "accuracy"], dropna=False)["online_solve_s"].transform("min")
    table = table.assign(ratio=(table["online_solve_s"] / least).where(table["status"] == "ok"))
    rows = []
    for solver, mine in table.groupby("solver"):
        texts, means = [f"`{solver}`"], []
        for accuracy in (1e-4, 1e-7, 1e-10):
            one = mine[mine["accuracy"] == accuracy]
            fine = int((one["status"] == "ok").sum())
            means.append(float(np.exp(np.log(one["ratio"]).mean())) if fine == len(one) else np.inf)
            texts.append(f"{means[-1]:.2g}" if fine == len(one) else f"– ({fine} of {len(one)})")
        rows.append((sorted(means, reverse=True), texts))
    assert min(rows)[1][0] == "`daqp`"
    return (table_rows(texts for _, texts in sorted(rows)),)


def chosen_assembly() -> Sequence[str]:
    """Gains of the models of `benefit` in every assembly."""
    table = cells("benefit")
    gain = (table["hf_s"] / table["online_s"]).groupby([table["assembly"], table["problem"]])
    ranges = {key: span(values.dropna()) if values.notna().any() else "no program" for key, values in gain}
    names = {"full": "full", "reduced": "reduced", "certified": "reduced, with bounds", "compiled": "compiled to C"}
    return (table_rows([name, ranges[how, "obstacle"], ranges[how, "hertz"]] for how, name in names.items()),)


def chosen_formulation() -> Sequence[str]:
    """All formulations at equal error and at equal cost, on four problems."""
    table = result("formulations")
    own, fastest, exact = table[table["training"] == "own"], [], []
    for name in dict.fromkeys(["mixed", *sorted(own["formulation"].unique())]):
        word, _, kind = name.partition(" ")
        ms, errors = [f"`{word}` {kind}".strip()], [f"`{word}` {kind}".strip()]
        for problem in ("obstacle", "hertz", "bearing", "american-put"):
            mine = own[own["problem"] == problem]
            is_usual = (mine["formulation"] == "mixed") & (mine["dual"] == "mcpg") & (mine["pod_tol"] == 1e-3)
            usual = mine[is_usual].iloc[0]
            of = mine[mine["formulation"] == name]
            near = [of[column] <= 1.5 * usual[column] for column in ("error_u_mean", "error_lambda_mean")]
            equal, cheap = of[near[0] & near[1]], of[of["online_s"] <= 1.25 * usual["online_s"]]
            ms.append(f"{1e3 * equal['online_s'].min():.2g}" if len(equal) else "–")
            errors.append("–")
            if len(cheap):
                best = cheap.loc[cheap["error_lambda_mean"].idxmin()]
                errors[-1] = f"{100 * best['error_lambda_mean']:.2g} %, {100 * best['error_u_mean']:.2g} %"
        fastest.append(ms)
        exact.append(errors)
    return table_rows(fastest), table_rows(exact)


def chosen_training() -> Sequence[str]:
    """Greedy training against fixed training where no error is larger."""
    table = result("certified", "training")
    rows = []
    for problem, mine in table[table["largest ratio of errors"] <= 1.0].groupby("problem"):
        solutions = float((mine["greedy snapshots"] / mine["fixed snapshots"]).median())
        rows.append([problem, f"{solutions:.2g}", span(mine["greedy offline_s"] / mine["fixed offline_s"])])
    return (table_rows(rows),)


def when_not() -> Sequence[str]:
    """From how many queries models pay, by problem and assembly, and regression beside them."""
    rows, studies = [], ("benefit", "paper-obstacle", "paper-hertz")
    tables = [result(study, "thresholds") for study in studies]
    # C programs are solved by no solver.
    every = pd.concat([table[table["cell_a"].isna() & table["solver"].isin(["piqp", "–"])] for table in tables])
    for (problem, how), mine in every.groupby(["problem", "assembly_b"]):
        begins = mine["benefit_threshold"][mine["meaning"] == "from"]
        if len(begins):
            rows.append([problem, how, len(mine), pays(begins), int(mine["meaning"].isin(["never", "until"]).sum())])
    table = result("formulations")
    radial = table[(table["formulation"] == "regression (radial)") & (table["training"] == "own")]
    for problem, mine in radial.groupby("problem"):
        faster = mine[mine["online_s"] < mine["hf_s"]]
        rows.append([problem, "regression", len(mine), pays(break_even(faster)), len(mine) - len(faster)])
    return (table_rows(rows),)


def first_page() -> Sequence[str]:
    """The answer of README for the two problems of the paper: a table of models, and what holds beyond it."""
    names = ("obstacle", "hertz")
    benefit, others = cells("benefit"), result("formulations")
    own = others[(others["training"] == "own") & (others["dual"] == "mcpg") & (others["dual_tol"] == 1e-2)]
    # The models of the pair with more generators than modes on the obstacle, where enrichment decides.
    pair = benefit[(benefit["assembly"] == "reduced") & (benefit["dual_tol"] == 1e-2)]
    weakest = pair[pair["primal_tol"].isna() | (pair["primal_tol"] == 0.5)]
    models = {
        "no enrichment": weakest[weakest["primal"] == BARE],
        "enriched offline (`offline-pga`)": weakest[weakest["primal"] == OFFLINE],
        "enriched at every query": weakest[weakest["primal"] == ONLINE],
        "penalty for the constraint ¹": own[own["formulation"] == "penalty"],
        "regression on the parameter ¹": own[own["formulation"] == "regression (radial)"],
    }
    rows, numbers = [], []
    for model, table in models.items():
        of = [table[table["problem"] == name].iloc[0] for name in names]
        numbers += [break_even(one) for one in of]
        rows.append([
            model,
            ", ".join(f"{100 * one['error_u_mean']:.2g} %" for one in of),
            ", ".join(f"{100 * one['error_lambda_mean']:.2g} %" for one in of),
            ", ".join(f"{one['hf_s'] / one['online_s']:.0f}" for one in of),
            ", ".join(whole(break_even(one)) for one in of),
        ])  # fmt: skip
    factors = factors_of_enriching()

    def divided(few: bool, problem: str) -> str:
        return f"{factors['factor'][(factors['few'] == few) & (factors['problem'] == problem)].median():.2g}"

    tally = re.search(r"^\| all \| (\d+) \| (\d+) \| (\d+) \|", (ROOT / "docs" / "reproduction.md").read_text(), re.M)
    assert tally
    return (
        table_rows(rows),
        f"Below {np.floor(min(numbers) / 10) * 10:.0f} queries, no. Above {np.ceil(max(numbers) / 10) * 10:.0f}, yes,",
        f"by {divided(True, 'obstacle')} on the obstacle and by {divided(True, 'hertz')} on Hertz, in the median",
        f"by {divided(False, 'obstacle')} and {divided(False, 'hertz')}",
        f"{tally[1]} agree with ours and {tally[2]} differ",
    )


TOPICS: dict[str, Callable[[], Sequence[str]]] = {
    topic.__name__: topic
    for topic in (
        cones, guarantees, slowest, setting, cones_and_controls, enrichments, formulations,
        certified, unseen_parameters, elliptic_contact, space, first_page, enriching, chosen_cone,
        chosen_solver, chosen_assembly, chosen_formulation, chosen_training, when_not,
    )
}  # fmt: skip


def rendered(page: str) -> str:
    """The text of a page with its parts as the tables have them today."""
    parts = {name: TOPICS[name]() for name, _ in PLACE.findall(page)}

    def part(place: re.Match[str]) -> str:
        return f"<!-- {place[1]} {place[2]} -->{parts[place[1]][int(place[2])].strip('| ')}<!-- -->"

    return PLACE.sub(part, page)


def main() -> None:
    """Render the parts of all pages."""
    for path in [ROOT / "README.md", *sorted(Path(__file__).parent.glob("*.md"))]:
        text = path.read_text(encoding="utf-8")
        if (made := rendered(text)) != text:
            path.write_text(made, encoding="utf-8")


if __name__ == "__main__":
    main()
