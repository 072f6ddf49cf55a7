"""Findings: every sentence says what the tables say, and nothing is said that they do not support."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from running import DECIDED, Changed

from vibench.report.figures.data import problem_tables
from vibench.report.findings import Finding, Weight, all_findings, findings, leading
from vibench.results import formats
from vibench.results.read import read_table
from vibench.results.schema import TABLES
from vibench.results.sqlite import FILE


@pytest.fixture
def said(changed: Changed) -> Callable[..., dict[str, list[str]]]:
    """Function that gives the findings of a changed copy of a real run, by what they are about."""

    return lambda *statements: findings(changed(*statements))


Said = Callable[..., dict[str, list[str]]]


def test_a_whole_run_is_called_whole_and_what_fell_short_is_counted(said: Said) -> None:
    whole = said()[""]
    assert whole[0].startswith("36 cells, 36 with every query ok; 576 of 576 queries")
    assert "hold in all 576 queries" in whole[1]
    assert whole[2].startswith("Solvers that were ok on the same reduced problem agree")
    ruined = "UPDATE cells SET status = 'inaccurate', queries_ok = 10 WHERE solver = 'osqp'"
    assert said(ruined)[""][0].startswith("36 cells, 24 with every query ok; 504 of 576 queries")


def test_cells_whose_solver_or_assembly_makes_the_error_are_counted_and_left_out(said: Said) -> None:
    texts = said("UPDATE cells SET solver_share_mean = 0.2 WHERE solver = 'osqp' OR primal = 'online-supremizers'")
    assert any(text.startswith("20 cells are not compared with others") for text in texts[""])
    of_model = [text for subject, found in texts.items() if "(N, R)" in subject for text in found]
    assert of_model
    assert not [text for text in of_model if "online-supremizers" in text]
    texts = said("UPDATE cells SET assembly_share_mean = 0.2 WHERE solver = 'osqp'")
    assert any(text.startswith("12 cells are not compared with others: reduced assembly makes") for text in texts[""])


def test_zero_solutions_are_counted_and_measured_by_the_training_set(said: Said) -> None:
    mine = "problem = 'hertz' AND query IN (2, 5)"
    texts = said(
        f"UPDATE queries SET zero_lambda = 1, error_lambda = NULL, error_lambda_scaled = 1e-11 WHERE {mine}",
        f"UPDATE queries SET error_lambda_scaled = 0.25 WHERE {mine} AND query = 5 AND solver = 'piqp'"
        " AND dual = 'mcpg' AND primal = 'decorrelated'",
    )
    zero, worst = texts["hertz, zero solutions"]
    assert zero.startswith("λ is zero, at most 1e-08 of the largest of the training set, at 2 of 16 validation")
    at_most = "at most 0.25 of the largest of the training set there (decorrelated, mcpg, piqp), in the median 1e-11"
    assert at_most in worst
    assert "obstacle, zero solutions" not in texts
    texts = said("UPDATE queries SET zero_lambda = 1, error_lambda = NULL", "UPDATE cells SET error_lambda_mean = NULL")
    assert not [text for found in texts.values() for text in found if "nan" in text]


def test_errors_of_strategies_are_those_on_common_queries(said: Said, quick_run: Path) -> None:
    """The easy queries alone would flatter a strategy that failed in the others; of few, errors are left out."""
    mine = "problem = 'obstacle' AND dual = 'mcpg' AND primal = 'decorrelated'"

    def about(failed: int, ok: int) -> tuple[list[str], list[str]]:
        texts = said(
            f"UPDATE queries SET status = 'inaccurate' WHERE {mine} AND query < {failed}",
            f"UPDATE cells SET queries_ok = {ok} WHERE {mine}",
        )
        (found,) = [found for subject, found in texts.items() if subject.startswith("obstacle, mcpg, (N, R)")]
        return found, texts[""]

    queries, (found, _) = read_table(quick_run / FILE, "queries"), about(6, 10)
    rows = queries[(queries["problem"] == "obstacle") & (queries["dual"] == "mcpg") & (queries["query"] >= 6)]
    for primal, beginning in (("decorrelated", "Without enrichment"), ("offline-pga", "offline-pga")):
        of_primal = rows[rows["primal"] == primal].groupby("solver")["error_lambda"].mean()
        means = {f"is {mean:.3g} over the 10 of 16 queries that all solved." for mean in of_primal}
        (text,) = [text for text in found if text.startswith(beginning)]
        assert any(text.endswith(mean) for mean in means), text
    found, whole = about(9, 7)
    assert any(text.startswith("3 cells have fewer than half of the queries ok") for text in whole)
    assert ["error of λ" in text for text in found[:2]] == [False, True]
    assert not [text for text in found if "that all solved" in text]


def test_solvers_are_compared_on_common_programs(said: Said, quick_run: Path) -> None:
    texts = said("UPDATE queries SET status = 'inaccurate' WHERE solver = 'osqp' AND problem = 'hertz' AND query < 4")
    queries = read_table(quick_run / FILE, "queries")
    mine = queries[(queries["problem"] == "hertz") & (queries["query"] >= 4)]
    for solver, found in mine.groupby("solver"):
        median = f"with a median of {1e3 * found['solve_s'].median():.3g} ms over the 72 programs that all solved."
        count = 72 if solver == "osqp" else 96
        assert f"{solver} solved {count} of 96 programs, {median}" in texts["hertz, solvers"]
        errors = f"{solver} {found['error_u'].mean():.3g} and {found['error_lambda'].mean():.3g}"
        assert errors in texts["hertz, solvers"][-1]
    assert not [text for text in texts["obstacle, solvers"] if "over the" in text]
    failed = "UPDATE queries SET status = 'failed', solve_s = NULL WHERE solver = 'osqp' AND problem = 'hertz'"
    assert "osqp solved 0 of 96 programs." in said(failed)["hertz, solvers"]  # without a median
    assert "No two solvers were ok on the same reduced problem." in said("DELETE FROM disagreements")[""]


def test_a_violated_invariant_is_not_hidden(said: Said) -> None:
    broken = "UPDATE queries SET beta_span = 9 WHERE query = 3 AND problem = 'hertz' AND solver = 'piqp'"
    assert any("of the inf-sup constants" in text and "violated" in text for text in said(broken)[""])


def test_stability_and_cost_are_those_of_the_tables(said: Said, quick_run: Path) -> None:
    cells = read_table(quick_run / FILE, "cells")
    mine = cells[(cells["problem"] == "obstacle") & (cells["dual"] == "mcpg")]
    size = mine.iloc[0]
    others_are_slow = "UPDATE cells SET online_s = 99 * online_s WHERE solver != 'piqp'"
    texts = said(*DECIDED, others_are_slow)[f"obstacle, mcpg, (N, R) = ({size['N']:.0f}, {size['R']:.0f})"]
    assert texts[0].startswith("Without enrichment, min β over the span is zero")
    of_solver = mine[mine["solver"] == "piqp"].set_index("primal")
    pga = of_solver.loc["offline-pga"]
    share = f"at least {100.0 * pga['share_validation']:.0f} % of the constant"
    assert any(f"adds {pga['enrichment']:.0f} vectors" in text and share in text for text in texts)
    best = of_solver.loc[of_solver["online_s"].idxmin()]
    assert any(f"{1e3 * best['online_s']:.3g} ms" in text and text.startswith("The fastest query") for text in texts)
    number = (best["offline_s"] - 0.001) / (0.1 - best["online_s"])
    (against,) = [text for text in texts if text.startswith("Break-even")]
    assert f"from {number:.0f} queries, 95 % interval {0.9 * number:.0f}–{1.1 * number:.0f}." in against


def test_a_break_even_is_the_same_number_in_findings_and_tables(said: Said, changed: Changed) -> None:
    """203.4 queries were "from 204" in the findings and "from 203" in the table."""
    number = "benefit_threshold = 203.4, threshold_low = 202.9, threshold_high = 204.6, meaning = 'from'"
    undecided = "benefit_threshold = NULL, threshold_high = NULL, meaning = 'undecided', threshold_low = 7"
    for values, end in (
        (number, "from 203 queries, 95 % interval 203–205."),
        (undecided, "undecided, 95 % interval ≥ 7."),
    ):
        texts = said(f"UPDATE thresholds SET {values}").values()
        against = [text for found in texts for text in found if text.startswith("Break-even")]
        assert against
        assert all(text.endswith(end) for text in against)
    benefits = formats.break_even_table(read_table(changed(f"UPDATE thresholds SET {number}"), "thresholds"))
    assert set(benefits["break-even"]) == {"from 203"}
    assert set(benefits["interval"]) == {"203–205"}


def test_a_share_that_does_not_hold_off_the_training_set_is_said(said: Said) -> None:
    """σ bounds the share on the training set alone (0.8 of 0.839 there, 0.837 against a bound of 0.917 off it)."""
    mine = "problem = 'hertz' AND primal = 'offline-pga'"
    shares = "share_training = 0.92, share_guaranteed = 0.917"
    texts = said(
        f"UPDATE cells SET {shares}, share_validation = 0.93 WHERE {mine}",
        f"UPDATE cells SET share_validation = 0.837 WHERE {mine} AND dual = 'mcpg'",
    )["hertz, enrichments"]
    assert "in 1 of 2 fixed enrichments, at worst 0.837 against 0.920 (offline-pga, δ = 0.5, mcpg)" in texts[0]
    assert "is not reached at a validation parameter in 1 of 2" in texts[1]


def test_with_bounds_of_declarations_their_tests_are_counted(said: Said) -> None:
    """With 16 random parameters a share of 0.17 of the box would be met at 95 %; 3/16 is above that."""
    (text,) = said("UPDATE cells SET certificate = 'certified' WHERE problem = 'hertz'")["hertz, declarations"]
    assert text.startswith("Declarations agree with the assembly at all 16 validation parameters")
    assert text.endswith("a declaration is false in at most 0.19 of the box, at 95 %.")
    assert "obstacle, declarations" not in said()


def test_of_one_solver_no_agreement_is_told_and_without_a_plain_basis_nothing_is_said_of_it(said: Said) -> None:
    one = [f"DELETE FROM {table} WHERE solver != 'piqp'" for table in ("queries", "cells")]
    whole = said(*one, "DELETE FROM disagreements")[""]
    assert whole[0].startswith("12 cells, 12 with every query ok")
    assert not [text for text in whole if "solvers" in text]
    gone = [f"DELETE FROM {table} WHERE primal = 'decorrelated'" for table in ("queries", "cells")]
    everything = [text for texts in said(*gone).values() for text in texts]
    assert not [text for text in everything if text.startswith("Without enrichment")]


def test_training_that_takes_longer_to_choose_than_to_solve_is_said_to(said: Said) -> None:
    """The choice of 10 parameters costs as much as 30 solutions, or as 9."""
    chosen = "update cells set snapshots = 10, hf_s = 0.5, offline_selection_s = {}"
    assert said(chosen.format(15.0))["obstacle, training"] == [
        "Choosing 10 training parameters by own took 15 s, as long as 30 more solutions: it can pay only where a "
        "given training set would need 40."
    ]
    assert "obstacle, training" not in said(chosen.format(4.5))
    assert "obstacle, training" not in said()


def test_cells_are_called_disturbed_where_some_are(said: Said) -> None:
    calm = "UPDATE cells SET disturbed = 0"
    assert not [text for text in said(calm)[""] if "disturbed" in text]
    one = f"{calm} WHERE rowid > 1"
    (told,) = [text for text in said(one, "UPDATE cells SET disturbed = 1 WHERE rowid = 1")[""] if "disturbed" in text]
    assert told.startswith("1 of 36 timed cells was timed while other processes slowed the machine down")


def test_a_model_that_is_too_inexact_is_praised_nowhere(said: Said) -> None:
    """It answers fastest by far; within a per cent it is praised in all of these sentences, whatever its β is."""
    fastest = (
        "UPDATE cells SET online_s = 1e-9, beta_span_min = {}, error_lambda_mean = {} WHERE primal = 'decorrelated'"
    )

    def praised(beta: float, error: float) -> list[str]:
        texts = [text for found in said(fastest.format(beta, error)).values() for text in found]
        praising = [text for text in texts if "fastest query" in text or text.startswith("Break-even")]
        assert len(praising) > 6
        return [text for text in praising if "decorrelated" in text]

    assert praised(0.0, 0.2) == praised(0.1, 0.2) == []
    assert len(praised(0.1, 1e-3)) == len(praised(0.0, 1e-3)) > 6


def test_findings_that_say_most_come_first_and_every_subject_has_a_turn(quick_run: Path) -> None:
    read = {name: read_table(quick_run / FILE, name) for name in TABLES}
    found = list(all_findings(read, problem_tables(quick_run / FILE, read)))
    first = leading(found, 10)
    assert len(first) == 10 < len(found)
    assert [one.weight for one in first] == sorted(one.weight for one in first)
    answer = Weight.COMPARISON
    others = [Finding("a", "3", answer), Finding("b", "4", answer), Finding("", "5", Weight.ALARM)]
    made = [Finding("a", "1", Weight.DETAIL), Finding("a", "2", answer), *others]
    assert [one.text for one in leading(made, 10)] == ["5", "2", "4", "3", "1"]
    assert [one.text for one in leading(made, 2)] == ["5", "2"]
