"""Two runs side by side: what got worse is found, and nothing else is."""

from __future__ import annotations

from pathlib import Path

import pytest
from running import DECIDED, Changed

from vibench.cli.result_commands import compare_runs
from vibench.errors import RequestError
from vibench.report.compare import Verdict, compare
from vibench.results.database import FILE

ONE = "solver = 'piqp' AND problem = 'hertz' AND dual = 'mcpg' AND primal = 'offline-pga'"


def test_a_run_does_not_differ_from_itself(quick_run: Path) -> None:
    found = compare(quick_run / FILE, quick_run / FILE, 1.0)
    assert found.changes.empty
    assert found.regressions == 0


@pytest.mark.parametrize(
    ("statement", "what", "verdict"),
    [
        (f"UPDATE cells SET queries_ok = queries_ok - 1 WHERE {ONE}", "queries ok", Verdict.WORSE),
        (f"UPDATE cells SET error_lambda_mean = 2 * error_lambda_mean WHERE {ONE}", "error_lambda_mean", Verdict.WORSE),
        (f"UPDATE cells SET error_u_max = 0.5 * error_u_max WHERE {ONE}", "error_u_max", Verdict.BETTER),
        (f"UPDATE cells SET beta_span_min = 0.5 * beta_span_min WHERE {ONE}", "beta_span_min", Verdict.WORSE),
        (f"UPDATE cells SET online_s = 2 * online_s WHERE {ONE}", "online_s", Verdict.WORSE),
        (f"UPDATE cells SET offline_s = 0.5 * offline_s WHERE {ONE}", "offline_s", Verdict.BETTER),
        (f"UPDATE cells SET enrichment = 2 * enrichment WHERE {ONE}", "enrichment", Verdict.WORSE),
        (f"UPDATE cells SET enrichment = enrichment + 1 WHERE {ONE}", "enrichment", Verdict.CHANGED),
        (f"UPDATE cells SET error_u_mean = NULL WHERE {ONE}", "error_u_mean", Verdict.WORSE),
        (f"UPDATE cells SET beta_span_min = NULL WHERE {ONE}", "beta_span_min", Verdict.WORSE),
        (f"UPDATE cells SET status = 'crashed' WHERE {ONE}", "status", Verdict.WORSE),
        (f"DELETE FROM cells WHERE {ONE}", "cell", Verdict.WORSE),
    ],
)
def test_a_change_of_one_cell_is_told_with_its_meaning(
    statement: str, what: str, verdict: Verdict, changed: Changed, quick_run: Path
) -> None:
    found = compare(quick_run / FILE, changed(statement), 1.25)
    (row,) = found.changes.to_dict("records")
    assert (row["what"], row["verdict"]) == (what, verdict.value)
    assert (row["problem"], row["dual"], row["primal"], row["solver"]) == ("hertz", "mcpg", "offline-pga", "piqp")


def test_errors_are_compared_on_the_queries_that_are_ok_in_both_runs(changed: Changed, quick_run: Path) -> None:
    """A run that fails in the hard queries is not better for it."""
    after = changed(
        f"UPDATE queries SET status = 'inaccurate' WHERE {ONE} AND query > 3",
        f"UPDATE cells SET queries_ok = 4, error_u_mean = 1e-3 * error_u_mean, error_u_max = 1e-3 * error_u_max,"
        f" error_lambda_mean = 1e-3 * error_lambda_mean WHERE {ONE}",
    )
    found = compare(quick_run / FILE, after, 1.25)
    assert list(found.changes["what"]) == ["queries ok"]
    assert "errors of 1 of them are compared on the queries that are ok in both" in found.notes
    worse = changed(
        f"UPDATE queries SET status = 'inaccurate' WHERE {ONE} AND query > 3",
        f"UPDATE queries SET error_u = 2 * error_u WHERE {ONE} AND query < 4",
        f"UPDATE cells SET queries_ok = 4 WHERE {ONE}",
    )
    assert set(compare(quick_run / FILE, worse, 1.25).changes["what"]) == {"queries ok", "error_u_mean", "error_u_max"}


def test_changes_within_the_limit_are_not_told(changed: Changed, quick_run: Path) -> None:
    after = changed("UPDATE cells SET online_s = 1.2 * online_s, error_u_mean = 1.2 * error_u_mean")
    assert compare(quick_run / FILE, after, 1.25).changes.empty
    assert compare(quick_run / FILE, after, 1.1).regressions == 2 * 36


def test_errors_of_round_off_are_not_compared(changed: Changed, tmp_path: Path) -> None:
    before = changed("UPDATE cells SET error_u_mean = 1e-14").rename(tmp_path / "before.sqlite")
    after = changed("UPDATE cells SET error_u_mean = 9e-14")
    assert compare(before, after, 1.25).changes.empty


def test_times_of_another_machine_are_left_out(changed: Changed, quick_run: Path) -> None:
    found = compare(quick_run / FILE, changed("UPDATE cells SET machine = 'other', online_s = 9 * online_s"), 1.25)
    assert found.changes.empty
    assert any("different machines" in note for note in found.notes)


THRESHOLD = "WHERE solver = 'piqp' AND problem = 'obstacle' AND dual = 'cpg' AND primal_a = 'high-fidelity'"

NUMBERS = ("benefit_threshold", "threshold_low", "threshold_high")
LATER = ", ".join(f"{name} = 30 * {name}" for name in NUMBERS)


@pytest.fixture
def decided(changed: Changed, tmp_path: Path) -> Path:
    """A run whose break-evens against the high-fidelity model are decided."""
    return changed(*DECIDED).rename(tmp_path / "decided.sqlite")


def test_a_threshold_within_the_interval_of_the_other_is_no_change(changed: Changed, decided: Path) -> None:
    moved = "benefit_threshold = threshold_high, threshold_high = 3 * threshold_high, offline_b_s = 3 * offline_b_s"
    after = changed(*DECIDED, f"UPDATE thresholds SET {moved} WHERE primal_a = 'high-fidelity'")
    assert compare(decided, after, 1.0 + 1e-9).changes.empty


def test_a_threshold_is_worse_where_its_own_side_got_slower(changed: Changed, decided: Path) -> None:
    later = f"{LATER}, offline_b_s = 3 * offline_b_s"
    never = "benefit_threshold = NULL, threshold_low = NULL, threshold_high = NULL, meaning = 'never'"
    found = compare(
        decided,
        changed(
            *DECIDED,
            f"UPDATE thresholds SET {later} {THRESHOLD} AND primal_b = 'decorrelated'",
            f"UPDATE thresholds SET {never}, online_b_s = 9 * online_b_s {THRESHOLD} AND primal_b = 'offline-pga'",
        ),
        1.25,
    )
    assert set(found.changes["primal"]) == {"decorrelated", "offline-pga"}
    assert set(found.changes["what"]) == {"break-even against high-fidelity"}
    assert found.regressions == 2


def test_a_competitor_that_got_quicker_is_no_regression(changed: Changed, decided: Path) -> None:
    later = f"{LATER}, online_a_s = online_a_s / 3"
    found = compare(decided, changed(*DECIDED, f"UPDATE thresholds SET {later} {THRESHOLD}"), 1.25)
    assert len(found.changes) == 3
    assert found.regressions == 0


def test_what_was_missing_and_is_there_is_no_regression(changed: Changed, quick_run: Path) -> None:
    before = changed(f"UPDATE cells SET beta_span_min = NULL, beta_cone_lower_min = NULL WHERE {ONE}")
    assert compare(before, quick_run / FILE, 1.25).regressions == 0


def test_constants_of_round_off_are_not_compared(changed: Changed, tmp_path: Path) -> None:
    before = changed("UPDATE cells SET beta_span_min = 9e-17").rename(tmp_path / "before.sqlite")
    assert compare(before, changed("UPDATE cells SET beta_span_min = 1e-17"), 1.25).changes.empty


def test_columns_without_any_value_are_no_obstacle(changed: Changed, quick_run: Path) -> None:
    emptied = changed(
        "UPDATE thresholds SET primal_tol_b = NULL, dual_tol = NULL", "UPDATE cells SET primal_tol = NULL"
    )
    compare(quick_run / FILE, emptied, 1.25)


def test_a_new_cell_is_no_regression(changed: Changed, quick_run: Path) -> None:
    found = compare(changed(f"DELETE FROM cells WHERE {ONE}"), quick_run / FILE, 1.25)
    (row,) = found.changes.to_dict("records")
    assert (row["after"], row["verdict"]) == ("new", Verdict.CHANGED.value)


def test_the_command_ends_with_one_where_something_got_worse(
    changed: Changed, quick_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    after = changed(f"UPDATE cells SET online_s = 2 * online_s WHERE {ONE}")
    with pytest.raises(Exception, match="1") as ended:
        compare_runs(str(quick_run), str(after), 1.25, "terminal")
    assert getattr(ended.value, "exit_code", None) == 1
    assert "1 for the worse" in capsys.readouterr().out
    compare_runs(str(quick_run), str(quick_run), 1.25, "csv")
    assert capsys.readouterr().out.startswith("problem,dual,primal,asked")
    with pytest.raises(RequestError, match="no results in 'nowhere'"):
        compare_runs(str(quick_run), "nowhere")
