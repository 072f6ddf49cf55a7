from collections.abc import Iterator

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench import VariationalInequality, solve_qp
from vibench.qp import verification
from vibench.qp.verification import Slack, allowed, slack
from vibench.results import consistency
from vibench.results.consistency import Recorded, compare, disagreement_rows, solution_row, violations
from vibench.results.schema import KEYS, STORED


def program(seed: int, n: int = 6, m: int = 4) -> VariationalInequality:
    rng = np.random.default_rng(seed)
    A, f, B = spd(n, rng), rng.standard_normal(n), rng.standard_normal((m, n))
    return VariationalInequality(A, f, B, rng.standard_normal(m) + 0.5)


def random_answer(vi: VariationalInequality, rng: np.random.Generator, size: float) -> tuple[np.ndarray, np.ndarray]:
    exact = solve_qp(vi, "piqp", 1e-12)
    x = exact.x * (1.0 + size * rng.standard_normal(len(vi.f)))
    return x, np.maximum(exact.alpha * (1.0 + size * rng.standard_normal(len(vi.g))), 0.0)


@given(st.integers(0, 300), st.sampled_from([1e-8, 1e-4, 1e-2]))
def test_no_two_points_with_small_residuals_are_farther_apart_than_allowed(seed: int, size: float) -> None:
    """The accuracy is the largest residual of the two: what the theorem needs, and no more."""
    vi, rng = program(seed), np.random.default_rng(seed)
    first, second = random_answer(vi, rng, size), random_answer(vi, rng, size)
    residuals = [verification.kkt_residuals(vi, *answer) for answer in (first, second)]
    accuracy = max(one.worst for one in residuals)
    limit = allowed(slack(vi, first[1], residuals[0], accuracy), slack(vi, second[1], residuals[1], accuracy))
    assert np.linalg.norm(first[0] - second[0]) <= limit * (1.0 + 1e-9) + 1e-12


def test_what_is_allowed_shrinks_with_the_accuracy() -> None:
    vi = program(1)
    x, alpha = random_answer(vi, np.random.default_rng(0), 0.0)
    residuals = verification.kkt_residuals(vi, x, alpha)
    limits = [allowed(*[slack(vi, alpha, residuals, accuracy)] * 2) for accuracy in (1e-4, 1e-6, 1e-8)]
    assert limits[0] > 5.0 * limits[1] > 25.0 * limits[2] > 0.0
    flat = VariationalInequality(np.zeros((6, 6)), vi.f, vi.B, vi.g)
    assert slack(flat, alpha, residuals, 1e-6) == Slack(np.inf, np.inf)


def answer(solver: str, query: int, *x: float) -> Recorded:
    return Recorded(solver, query, np.array(x), Slack(0.01, 0.0))


def test_two_solvers_far_apart_are_flagged_and_only_ok_answers_of_one_model_compared() -> None:
    answers = [answer("b", 0, 1.0, 0.0), answer("b", 3, 0.0, 2.0), answer("b", 4, 1.0, 1.0)]
    answers += [answer("a", 0, 1.0, 0.01), answer("a", 3, 0.0, 2.5), answer("a", 9, 5.0, 5.0)]
    (row,) = compare(answers)
    assert (row["solver_a"], row["solver_b"], row["queries"]) == ("a", "b", 2)
    assert (row["flagged"], row["query_flagged"], row["query_worst"]) == (1, 3, 3)
    assert row["difference_max"] == pytest.approx(0.5 / 2.5)
    assert row["allowed_worst"] == pytest.approx(0.02 / 2.5)

    def cell(key: str, solver: str, model: str | None) -> dict[str, object]:
        names = {"cell": key, "solver": solver, "model": model, "dual": f"of {model}", "accuracy": 1e-7}
        names["formulation"] = "mixed"
        return dict.fromkeys(KEYS) | names

    cells = [cell("1", "a", "m"), cell("2", "b", "m"), cell("3", "b", "other"), cell("4", "c", None)]
    cells.append(cell("5", "b", "m") | {"accuracy": 1e-3})  # allowed to be farther away
    queries = [{"cell": str(c), "query": q, "status": "ok"} for c in (1, 2, 3, 5) for q in (0, 1)]
    queries[3]["status"] = "inaccurate"  # cell 2, query 1
    x = np.array([1.0, 2.0])
    solutions = [{"cell": q["cell"], "query": q["query"], **solution_row(x, x, Slack(0.0, 0.0))} for q in queries]
    asked: list[str] = []

    def fine_solutions(cell: str) -> Iterator[dict[str, object]]:
        asked.append(cell)
        fine = {q["query"] for q in queries if q["cell"] == cell and q["status"] == "ok"}
        return (one for one in solutions if one["cell"] == cell and one["query"] in fine)

    (row,) = disagreement_rows(cells, fine_solutions)
    assert asked == ["1", "2"]  # of one solver alone there is nothing to read
    assert (row["dual"], row["queries"], row["flagged"], row["difference_max"]) == ("of m", 1, 0, 0.0)


def test_the_audit_in_a_line_which_says_nothing_of_one_solver() -> None:
    row = {"queries": 5, "difference_max": 1e-4, "solver_a": "x", "solver_b": "y", "flagged": 0}
    assert consistency.agreement_sentence(pd.DataFrame(), 1) == ""
    for rows, words in (
        ([], "no two solvers"), ([row], "agree in all 5 comparisons: u differs by at most 1.0e-04 (x and y)"),
        ([row | {"flagged": 2}], "more than the accuracy allows in 2 of 5"),
    ):  # fmt: skip
        assert words in consistency.agreement_sentence(pd.DataFrame(rows), 2)


CONSTANTS = [name for name in STORED["queries"] if name.startswith("beta_") and "energy" not in name]
GOOD: dict[str, float | str] = dict.fromkeys(CONSTANTS, 0.1) | dict.fromkeys(
    [name for name in STORED["queries"] if name.startswith("effectivity_")], 1.0
)
GOOD |= {f"beta_full_{what}": 0.2 for what in ("span", "cone_lower", "cone_upper")}
GOOD |= {"beta_bounds": "L0/U0"}
KINDS = pd.Series({"a": "fixed", "b": "per-parameter"})


def rows(**changed: float | str | None) -> pd.DataFrame:
    online = GOOD | {f"beta_{what}": 0.2 for what in ("span", "cone_lower", "cone_upper")}
    return pd.DataFrame([{"cell": "a", **GOOD, **changed}, {"cell": "b", **online}])


def test_constants_are_judged_by_what_their_cells_have() -> None:
    assert violations(rows(), KINDS) == []
    assert violations(rows(beta_plain_span=0.1 * (1.0 + 5e-9)), KINDS) == []
    assert violations(rows(effectivity_u=np.nan, effectivity_lambda=40.0), KINDS) == []
    assert violations(rows(effectivity_lambda_natural=1.0 - 1e-11), KINDS) == []
    assert violations(rows(beta_span=np.inf, beta_full_span=np.inf, beta_cone_upper=np.inf), KINDS) == []
    frame = rows()
    frame.loc[1, "beta_span"] = 0.19
    found = violations(frame, KINDS)
    assert [str(v) for v in found] == ["beta_span ≥ beta_full_span is violated in 1 rows, by up to 1.0e-02"]
    without = dict.fromkeys(name for name in CONSTANTS if "hf" not in name)
    assert violations(rows(**without, bounds=None), KINDS) == []
    found = violations(rows(**without, bounds=None, effectivity_u=0.999), KINDS)
    assert [violation.invariant for violation in found] == ["effectivity_u ≥ 1"]
    above = {"beta_hf_cone_lower": 0.3, "beta_hf_cone_upper": 0.3}
    assert [v.invariant for v in violations(rows(**above), KINDS)] == ["beta_full_cone_upper ≥ beta_hf_cone_lower"]
    assert violations(rows(**above, beta_bounds="span/span"), KINDS) == []
    found = violations(rows(**above, beta_bounds="span/U1", beta_hf_span=0.25), KINDS)
    assert [v.invariant for v in found] == ["beta_full_span ≥ beta_hf_span"]


def test_every_violation_is_found_and_named_and_those_of_parts_are_those_of_the_whole() -> None:
    for changed, names in (
        ({"beta_span": 0.05, "beta_plain_span": 0.06}, "beta_span ≥ beta_plain_span"),
        ({"beta_hf_span": 0.21, "beta_hf_cone_upper": 0.3}, "beta_full_span ≥ beta_hf_span"),
        ({"beta_plain_cone_upper": 0.09}, "beta_plain_cone_upper ≥ beta_plain_span"),
        ({"beta_cone_lower": 0.11}, "beta_cone_upper ≥ beta_cone_lower"),
        ({"beta_span": np.nan}, "beta_span ≥ beta_plain_span"),
        ({"effectivity_u": 0.999}, "effectivity_u ≥ 1"),
        ({"effectivity_lambda_natural": 1.0 - 1e-9}, "effectivity_lambda_natural ≥ 1"),
        ({"effectivity_lambda": 0.5}, "effectivity_lambda ≥ 1"),
    ):
        found = violations(rows(**changed), KINDS)
        assert names in [violation.invariant for violation in found]
        assert all(violation.rows == 1 for violation in found)
    parts = [rows(beta_cone_lower=0.11), rows(), rows(beta_cone_lower=0.13, effectivity_u=0.5), rows(beta_span=np.nan)]
    whole = {str(one) for one in violations(pd.concat(parts, ignore_index=True), KINDS)}
    assert {str(one) for one in consistency.added_up(one for part in parts for one in violations(part, KINDS))} == whole
