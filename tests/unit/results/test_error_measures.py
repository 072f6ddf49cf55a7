import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from running import Main, refused, succeeded
from samples import cell_row

import vibench
from vibench import Kind, RequestError
from vibench.results.break_even import break_even_rows
from vibench.results.database import FILE, ResultsDatabase
from vibench.results.ranking import errors_of, fastest, measures, with_errors, within
from vibench.results.schema import KEYS, STORED

MODELS = {
    # offline seconds, seconds of a query, errors of u, of λ, of the force, and of the area
    "a": (Kind.PER_PARAMETER, 4.0, 3.0, 0.001, 0.03, 0.004, None),
    "b": (Kind.FIXED, 10.0, 1.0, 0.002, 0.02, 0.008, 0.05),
    "c": (Kind.FIXED, 20.0, 0.5, 0.0005, 0.05, 0.0002, 0.2),
}
HIGH_FIDELITY = (1.0, 6.0)
"""Seconds of the set-up, and of a solution."""


def cell(name: str) -> dict[str, Any]:
    kind, offline, online, error_u, error_lam, _, _ = MODELS[name]
    axes = {key: "x" for key in KEYS if key not in {"primal", "primal_tol", "pod_size", "dual_size", "accuracy"}}
    seconds = {"offline_s": offline, "online_s": online, "hf_setup_s": HIGH_FIDELITY[0], "hf_s": HIGH_FIDELITY[1]}
    phases = {f"offline_{phase}_s": 0.0 for phase in ("snapshots", "pod", "cone", "enrichment", "assembly")}
    row = cell_row(name, **axes | seconds | phases) | {"pod_tol": 0.1, "dual_tol": 0.1, "accuracy": 1e-8}
    row |= {"offline_low_s": offline, "offline_high_s": offline, "assembly": "full", "solver": "piqp", "machine": "m"}
    row |= {"error_u_mean": error_u, "error_lambda_mean": error_lam, "enrichment_kind": kind.value, "primal": name}
    row |= {
        "primal_tol": None, "beta_span_min": 0.1, "solver_share_mean": 1e-6, "assembly_share_mean": None,
        "definition": "{}", "bounds": 0, "disturbed": 0,
    }  # fmt: skip
    return row | {f"{name}_options": "{}" for name in ("problem", "training", "dual", "primal")}


def outputs_of(name: str) -> list[dict[str, Any]]:
    keys = {key: value for key, value in cell(name).items() if key in KEYS}
    return [
        dict.fromkeys(STORED["outputs"]) | keys | {"cell": name, "output": output, "unit": "N", "error_mean": error}
        for output, error in zip(("contact force", "area"), MODELS[name][-2:], strict=True)
    ]


TIMINGS = [
    {"cell": name, "round": k, "block": str(k // 4), "total_s": model[2], "hf_s": HIGH_FIDELITY[1], "pace": 1.0}
    for name, model in MODELS.items()
    for k in range(8)
]
"""The same seconds in every round: nothing is undecided."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    database = ResultsDatabase(tmp_path / "run", {"name": "sample", "seed": 1, "validation": 1})
    for name in MODELS:
        database.write_cell(cell(name), [], (), outputs_of(name))
    database.replace("thresholds", break_even_rows(map(cell, MODELS), TIMINGS))
    database.close()
    return tmp_path / "run" / FILE


BY_HAND = {
    # (T_b − T_a) / (t_a − t_b), with the errors of the force of a and of b
    (None, "a"): ((4.0 - 1.0) / (6.0 - 3.0), 0.0, 0.004),
    (None, "b"): ((10.0 - 1.0) / (6.0 - 1.0), 0.0, 0.008),
    (None, "c"): ((20.0 - 1.0) / (6.0 - 0.5), 0.0, 0.0002),
    ("a", "b"): ((10.0 - 4.0) / (3.0 - 1.0), 0.004, 0.008),
    ("a", "c"): ((20.0 - 4.0) / (3.0 - 0.5), 0.004, 0.0002),
}


def test_break_even_is_beside_the_errors_of_an_output_and_of_sums(path: Path) -> None:
    found = vibench.open_run(path).break_even("output:contact force")
    numbers = found[["benefit_threshold", "error_a", "error_b"]].itertuples(index=False, name=None)
    rows = dict(zip(pairs_of(found), numbers, strict=True))
    assert rows.keys() == BY_HAND.keys()
    for pair, expected in BY_HAND.items():
        np.testing.assert_allclose(rows[pair], expected, rtol=1e-12)
    columns = {name: column.meaning for table in STORED.values() for name, column in table.items()}
    meanings = [columns[name] for name in columns if re.fullmatch(r"effectivity_(online_)?u(_energy)?(_median)?", name)]
    assert ["of the sum with λ" in meaning for meaning in meanings] == [True] * 6


def pairs_of(found: pd.DataFrame) -> list[tuple[str | None, str]]:
    """The cells that are compared; `None` for the high-fidelity model."""
    first = [cell if isinstance(cell, str) else None for cell in found["cell_a"]]
    return list(zip(first, found["cell_b"], strict=True))


def test_only_models_that_are_accurate_enough_are_compared(path: Path, main: Main) -> None:
    for measure, largest, pairs in (
        ("output:contact force", 0.005, {(None, "a"), (None, "c"), ("a", "c")}),
        ("output:contact force", 0.008, set(BY_HAND)),  # the limit itself is within
        ("output:area", 0.1, {(None, "b")}),  # the area of a is zero at all queries: nobody knows its relative error
        ("lambda", 0.03, {(None, "a"), (None, "b"), ("a", "b")}),
        ("u", 0.001, {(None, "a"), (None, "c"), ("a", "c")}),
        ("solution", 0.025, {(None, "b")}),
    ):
        found = vibench.open_run(path).break_even(measure, within=largest)
        assert set(pairs_of(found)) == pairs
        chosen = ("--error", measure, "--within", str(largest), "--format", "csv", "--columns", "primal_a,primal_b")
        out = succeeded(main("show", str(path.parent), "--table", "benefits", *chosen))
        shown = {(a or "high-fidelity", b) for a, b in pairs}
        assert {tuple(line.split(",")) for line in out.splitlines()[1:]} == shown


def test_the_table_and_the_fastest_cells_are_those_of_the_measure(path: Path, main: Main) -> None:
    asked = ("show", str(path.parent), "--table", "benefits", "--error", "output:contact force")
    _, out, _ = main(*asked, "--format", "markdown")
    assert "error a" in out
    assert "error b" in out
    chosen = ("--where", "error_b < 0.001", "--sort", "-error_a", "--columns", "primal_a,error_b", "--format", "csv")
    assert main(*asked, *chosen) == (0, "primal_a,error_b\na,0.0002\nhigh-fidelity,0.0002\n", "")
    _, out, _ = main("show", str(path.parent), "--table", "benefits", "--format", "csv")
    assert "error_b" not in out
    cells = pd.DataFrame([cell(name) for name in MODELS], columns=list(STORED["cells"]))
    outputs = pd.DataFrame([row for name in MODELS for row in outputs_of(name)])
    found = fastest(cells, errors_of(cells, outputs, "output:contact force"))
    assert list(zip(found["cell"], found["error_below"], strict=True)) == [("c", 1e-3)]
    found = fastest(cells, errors_of(cells, outputs, "output:area"))
    assert list(zip(found["cell"], found["error_below"], strict=True)) == [("b", 0.1)]  # 20 % are no answer
    asked = ("show", str(path.parent), "--table", "best", "--error", "output:area", "--columns", "cell")
    assert succeeded(main(*asked, "--format", "csv")) == "cell\nb\n"


def test_no_measure_is_refused_and_a_pair_without_an_error_has_none(path: Path, main: Main) -> None:
    run = str(path.parent)
    assert measures(pd.DataFrame({"output": ["force"]})) == ["solution", "u", "lambda", "output:force"]
    refused(main("show", run, "--table", "benefits", "--error", "output:contact forse"), "did you mean 'output:contact")
    refused(main("show", run, "--error", "u"), "the table summary compares no models by an error", "best, benefits")
    refused(main("show", run, "--table", "best", "--within", "0.1"), "--within is for tables of break-even points")
    refused(main("show", run, "--table", "benefits", "--within", "0"), "the largest error is 0, expected a positive")
    with pytest.raises(RequestError, match="expected a positive number"):
        within(pd.DataFrame({"error_a": [], "error_b": []}), float("nan"))
    thresholds = pd.DataFrame({"cell_a": [None, "a"], "cell_b": ["b", "b"]})
    cells = pd.DataFrame({"cell": ["a", "b"]})
    found = with_errors(thresholds, cells, pd.Series([np.nan, 0.5]))
    np.testing.assert_array_equal(found[["error_a", "error_b"]], [[0.0, 0.5], [np.nan, 0.5]])
    assert list(within(found, 0.5).index) == [0]
