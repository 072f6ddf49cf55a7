"""Results files of any size, made of a small run: its cells again and again under other names, with other numbers."""

import hashlib
import random
import shutil
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd
from running import seal

from vibench.results.break_even import HIGH_FIDELITY
from vibench.results.sqlite import FILE

CLONED = ("cells", "queries", "histories", "thresholds")
"""Tables whose rows are cloned; the others keep theirs, or those of cells that are there no more are removed."""

KEYS = ("cell", "cell_a", "cell_b", "artefact", "model")

SCALED = ("error_u", "error_lambda", "error_u_mean", "error_lambda_mean", "online_s", "solve_s", "offline_s")


def write_many(run: Path, folder: Path, cells: int) -> Path:
    """A results file with a number of cells, all of one solver, whose first queries are kept.

    Clones differ as the cells of a large study do: in the label of the dual strategy, of which there are four times as
    many, in the pair of tolerances, of which there are two, then in the label of the primal strategy. Returns its path.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FILE
    shutil.copy(run / FILE, path)
    with closing(sqlite3.connect(path)) as db:
        db.row_factory = sqlite3.Row
        known = {table: [dict(row) for row in db.execute(f"SELECT * FROM {table}")] for table in CLONED}
        for table in (*CLONED, "timings", "solutions", "disagreements"):
            db.execute(f"DELETE FROM {table}")
        for table, rows in known.items():
            known[table] = [row for row in rows if row.get("solver", "piqp") == "piqp" and not row.get("query")]
        for clone in range(-(-cells // len(known["cells"]))):
            left = {row["cell"] for row in known["cells"][: cells - clone * len(known["cells"])]}
            for table, rows in known.items():
                mine = [row for row in rows if {row.get("cell"), row.get("cell_b")} & left or table == "histories"]
                frame = pd.DataFrame([_cloned(row, clone) for row in mine], dtype=object)
                frame.to_sql(table, db, if_exists="append", index=False)
        seal(db)
        db.commit()
    return path


def _cloned(row: Mapping[str, Any], clone: int) -> dict[str, Any]:
    """A row under other names: clone 0 is the row itself, but for the number of its queries."""
    made = dict(row) | ({"queries": 1, "queries_ok": 1} if "queries_ok" in row else {})
    if not clone:
        return made
    for name in KEYS:
        if made.get(name):
            made[name] = hashlib.sha256(f"{made[name]} {clone}".encode()).hexdigest()[: len(made[name])]
    if made.get("dual"):
        made["dual"] = f"{made['dual']} {clone % 4 + 1}"
    for name in ("pod_tol", "dual_tol"):
        if made.get(name) is not None:
            made[name] /= 10.0 ** (clone // 4 % 2)
    for name in ("primal", "primal_a", "primal_b"):
        if made.get(name) not in {None, HIGH_FIDELITY}:
            made[name] = f"{made[name]} {clone // 8 + 1}"
    factor = random.Random(clone).uniform(0.5, 2.0)
    return made | {name: made[name] * factor for name in SCALED if made.get(name) is not None}
