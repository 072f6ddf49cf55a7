"""A made-up run: columns are filled, a cell failed, and values are missing."""

import json
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from vibench import Kind
from vibench.results.break_even import break_even_rows
from vibench.results.database import ResultsDatabase
from vibench.results.schema import STORED, Column, SqlType
from vibench.results.sqlite import FILE

QUERIES_PER_CELL, ROUNDS, STEPS = 5, 8, 6

PROBLEMS = ("membrane", "plate")

PRIMALS = (("none", None, Kind.NONE), ("at-every-query", None, Kind.PER_PARAMETER), ("fixed", 0.5, Kind.FIXED))

STUDY = {"name": "sample", "seed": 0, "validation": QUERIES_PER_CELL}

Row = dict[str, Any]


def write_sample_run(folder: Path, *, empty: bool = False) -> Path:
    """Write the results of the made-up run, the same ones at every call, or of one without cells; returns the file."""
    database = ResultsDatabase(folder, STUDY)
    try:
        if not empty:
            _fill(database)
    finally:
        database.close()
    return folder / FILE


def _fill(database: ResultsDatabase) -> None:
    rng = np.random.default_rng(0)
    cells, timings = list[Row](), list[Row]()
    for k, (problem, dual, (primal, tolerance, kind)) in enumerate(product(PROBLEMS, ("wide", "narrow"), PRIMALS)):
        keys = _keys(problem, dual, primal, tolerance)
        failed = k == len(PRIMALS)
        cell = _cell(f"{k:016x}", keys, kind, rng, failed=failed)
        queries = [] if failed else [_query(cell["cell"], keys, q, rng) for q in range(QUERIES_PER_CELL)]
        output = {"cell": cell["cell"], "output": "force", "unit": "N"}
        outputs = [] if failed else [_row(STORED["outputs"], rng) | keys | output]
        database.write_cell(cell, queries, (), outputs)
        cells.append(cell)
        own = keys | {"cell": cell["cell"]}
        rounds = [] if failed else [_row(STORED["timings"], rng) | own | {"round": number} for number in range(ROUNDS)]
        database.replace("timings", rounds, cell=cell["cell"])
        timings += rounds
        database.write_histories([_history(keys, stage, name, k) for stage, name in HISTORIES if not failed])
    database.replace("thresholds", break_even_rows(cells, timings))


HISTORIES = (
    ("pod", "error"), ("cone", "error"), ("cone", "e_orth"), ("enrichment", "sigma"), ("enrichment", "beta_span_min"),
)  # fmt: skip


def _keys(problem: str, dual: str, primal: str, tolerance: float | None) -> Row:
    options = {f"{axis}_options": "{}" for axis in ("problem", "training", "formulation", "dual", "primal")}
    own = {"problem": problem, "training": "own", "dual": dual, "primal": primal, "primal_tol": tolerance}
    own["formulation"] = "mixed"
    stops = {"pod_tol": 1e-3, "pod_size": None, "dual_tol": 1e-2, "dual_size": None}
    own |= {"solver": "piqp", "accuracy": 1e-8, "assembly": "full", "bounds": 0, "correction": "none"}
    return options | own | stops


def _cell(key: str, keys: Row, kind: Kind, rng: np.random.Generator, *, failed: bool) -> Row:
    plugins = {axis: {"name": keys[axis]} for axis in ("problem", "dual", "primal")}
    plugins["formulation"] = {"kind": "formulation", "name": "mixed", "options": "{}", "code": "test"}
    named = {"cell": key, "machine": "sample", "validation": "own", "versions": "{}", "definition": json.dumps(plugins)}
    row = _row(STORED["cells"], rng) | keys | named | {"status": "ok", "reason": "", "enrichment_kind": kind.value}
    row |= {"queries": QUERIES_PER_CELL, "queries_ok": QUERIES_PER_CELL, "timing_rounds": ROUNDS, "disturbed": 0}
    row |= {"solver_share_mean": 1e-3, "assembly_share_mean": 1e-3, "bound_online_violations": None}
    if not failed:
        return row
    kept = {*keys, *named, "validation_options", "threads", "seed", "study_hash", "code", "queries"}
    lost = {"status": "crashed", "reason": "the process died", "queries_ok": 0}
    return {name: value if name in kept else None for name, value in row.items()} | lost


def _query(cell: str, keys: Row, number: int, rng: np.random.Generator) -> Row:
    """A query; at the first one there is no contact, so that errors of λ are missing."""
    row = _row(STORED["queries"], rng) | keys | {"cell": cell, "query": number, "status": "ok"}
    row |= {"reason": "", "outputs": "[]"}
    row |= {"mu_1": 0.1 * number, "mu_2": 1.0 + 0.2 * (number % 3), "zero_u": 0, "zero_lambda": int(number == 0)}
    return row | ({"error_lambda": None, "error_lambda_natural": None} if number == 0 else {})


def _history(keys: Row, stage: str, quantity: str, number: int) -> list[Row]:
    named = {name: keys[name] for name in keys if name in STORED["histories"]}
    row = named | {"artefact": f"{stage}-{number}", "stage": stage, "quantity": quantity}
    return [row | {"step": step, "value": 10.0 ** (-0.5 * step)} for step in range(1, STEPS + 1)]


def _row(columns: Mapping[str, Column], rng: np.random.Generator) -> Row:
    """A row with a positive number in every column of numbers, and no text."""
    made: dict[str, Callable[[], Any]] = {
        SqlType.INTEGER: lambda: int(rng.integers(2, 9)),
        SqlType.REAL: lambda: float(rng.uniform(0.01, 0.1)),
        SqlType.TEXT: str,
    }
    return {name: made[column.kind.split()[0]]() for name, column in columns.items()}
