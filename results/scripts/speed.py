"""Writes the page of seconds beside the published algorithms, from the tables of `tests/benchmarks/as_published.py`.

python results/scripts/speed.py results/speed
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from page import Page, start

PROBLEMS = ("obstacle", "hertz")
ABOUT = (
    "The transcription is ours: the algorithms of Niakh, Drouet, Ehrlacher and Ern (2022) around cvxopt "
    "(`tests/benchmarks/published.py`). The paper can be read in two ways: PGA as printed projects every S_R(µ) at "
    "every step, an implementer keeps its residuals between the steps. Medians in CPU seconds; the first commands fail "
    "unless models have equal sizes and errors."
)
QUERY = (
    "A query is all from µ to the coefficients x and α. That of the transcription assembles on the mesh and enriches "
    "at µ (online) or not (offline); cvxopt solves it to the accuracy of the row. Ours is the reduced offline query."
)


def main(target: str) -> None:
    tables = {name: pd.read_csv(Path(target) / f"as-published-{name}.csv") for name in PROBLEMS}
    runs = [f"python tests/benchmarks/as_published.py {name} --out {target}" for name in PROBLEMS]
    command = " && ".join([*runs, f"python results/scripts/speed.py {target}"])
    of = {name: table.set_index("stage") for name, table in tables.items()}
    where = "; ".join(dict.fromkeys(table["machine"].iloc[0] for table in tables.values()))
    page = Page(target, "How fast is vibench beside the published algorithms?", command, ABOUT, QUERY, machine=where)
    asked, phases = queries(of), offline(of)
    kept = phases.set_index("stage").loc["offline, PGA with residuals kept"]
    ratios = asked.groupby("problem")["online over DAQP"].median()
    page.answer(
        f"Offline {kept['ratio']:.3g} times on the obstacle and {kept['ratio ']:.3g} times on Hertz, where residuals "
        f"of PGA are kept. A published online query takes "
        f"{' and '.join(f'{each:.2g} times ours on {name}' for name, each in ratios.items())}, in reduced assembly.",
        asked[["problem", "accuracy", "published online [ms]", "ours, DAQP [ms]", "in C [ms]", "online over DAQP",
               "over C"]],
    )  # fmt: skip
    page.file("stages", "offline stages of both sides, and their ratios", phases)
    page.file("queries", "queries of both sides, online and offline, by DAQP, PIQP and in C", asked)
    for name in PROBLEMS:
        page.also(f"[as-published-{name}.csv](as-published-{name}.csv)", f"all stages and queries of {name}")
    page.write()


def offline(of: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Stages and totals of both problems: seconds of the transcription, ours, and their ratio."""
    stages = [name for name in of[PROBLEMS[0]].index if not name.startswith("query")]
    frame = pd.DataFrame({"stage": stages})
    for name, table in of.items():
        frame[f"{name}: published [s]"] = table.loc[stages, "transcription [s]"].to_numpy()
        frame["ours [s]" + " " * (name == "hertz")] = table.loc[stages, "ours [s]"].to_numpy()
        frame["ratio" + " " * (name == "hertz")] = table.loc[stages, "transcription / ours"].to_numpy()
    return frame


def queries(of: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """A row for each problem and accuracy of cvxopt: milliseconds, and published queries over ours."""
    rows = []
    for name, table in of.items():
        for stage in (one for one in table.index if one.startswith("query online") and one.count(",") == 1):
            way = stage.replace("online", "offline")
            online, fixed = table.loc[stage, "transcription [s]"], table.loc[way, "transcription [s]"]
            daqp, piqp, varying = table.loc[[way, f"{way}, piqp", stage], "ours [s]"]
            compiled = table["ours [s]"].get("query offline, compiled", float("nan"))
            rows.append(
                {
                    "problem": name, "accuracy": stage.split(", ")[1],
                    "published online [ms]": 1e3 * online, "offline [ms]": 1e3 * fixed,
                    "ours, DAQP [ms]": 1e3 * daqp, "PIQP [ms]": 1e3 * piqp, "in C [ms]": 1e3 * compiled,
                    "online over DAQP": online / daqp, "over PIQP": online / piqp, "over C": online / compiled,
                    "offline over DAQP": fixed / daqp, "online over our online": online / varying,
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


if __name__ == "__main__":
    start(main)
