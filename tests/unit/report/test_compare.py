import json
import re
import shutil
from pathlib import Path

import pandas as pd
import pytest
from running import DECIDED, Changed, Main, execute, succeeded

from vibench import RequestError
from vibench.cli.result_commands import compare_runs
from vibench.provenance import PROTOCOL
from vibench.report.comparison import Comparison, compare
from vibench.report.differences import ChangeKind, agreement, compared_runs
from vibench.results.sqlite import FILE

STEADY = (
    "UPDATE cells SET offline_low_s = offline_s, offline_high_s = offline_s, disturbed = 0",
    "UPDATE timings SET total_s = (SELECT online_s FROM cells WHERE cells.cell = timings.cell)",
)
"""Statements after which the same seconds were measured in every round, however busy the machine was."""

DECISIVE = (*DECIDED, *STEADY)

ONE = "solver = 'piqp' AND problem = 'hertz' AND dual = 'mcpg' AND primal = 'offline-pga'"


@pytest.fixture(scope="module")
def quick_run(quick_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A third of the run, with one cone and two solvers: its 12 cells show all that comparisons are about."""
    folder = tmp_path_factory.mktemp("third") / "quick"
    shutil.copytree(quick_run, folder)
    others = "dual = 'cpg' OR solver = 'proxqp'"
    execute(folder, *(f"DELETE FROM {table} WHERE {others}" for table in ("cells", "thresholds")))
    return folder


@pytest.fixture
def steady(changed: Changed, tmp_path: Path) -> Path:
    return changed(*STEADY).rename(tmp_path / "steady.sqlite")


WORSE, BETTER, CHANGED = ChangeKind.WORSE, ChangeKind.BETTER, ChangeKind.CHANGED


@pytest.mark.parametrize(
    ("change", "what", "verdict"),
    [
        ("queries_ok = queries_ok - 1", "queries_ok", WORSE),
        ("error_lambda_mean = 2 * error_lambda_mean", "error_lambda_mean", WORSE),
        ("error_u_max = 0.5 * error_u_max", "error_u_max", BETTER),
        ("beta_span_min = 0.5 * beta_span_min", "beta_span_min", WORSE),
        ("online_s = 2 * online_s", "online_s", WORSE), ("offline_s = 0.5 * offline_s", "offline_s", BETTER),
        ("enrichment = 2 * enrichment", "enrichment", WORSE), ("enrichment = enrichment + 1", "enrichment", CHANGED),
        ("error_u_mean = NULL", "error_u_mean", WORSE), ("beta_span_min = NULL", "beta_span_min", WORSE),
        ("status = 'crashed'", "status", WORSE), ("", "cell", WORSE),
    ],
)  # fmt: skip
def test_what_changed_in_a_cell(change: str, what: str, verdict: ChangeKind, changed: Changed, steady: Path) -> None:
    statement = f"UPDATE cells SET {change} WHERE {ONE}" if change else f"DELETE FROM cells WHERE {ONE}"
    found = compare([steady, changed(statement, *STEADY)], 1.25)
    (row,) = found.changes.to_dict("records")
    assert (row["what"], row["verdict"]) == (what, verdict.value)
    assert (row["problem"], row["dual"], row["primal"], row["solver"]) == ("hertz", "mcpg", "offline-pga", "piqp")


def test_errors_are_compared_on_common_queries_and_times_on_one_machine(changed: Changed, quick_run: Path) -> None:
    """A run that fails in the hard queries is not better for it."""
    after = changed(
        f"UPDATE queries SET status = 'inaccurate' WHERE {ONE} AND query > 3",
        f"UPDATE cells SET queries_ok = 4, error_u_mean = 1e-3 * error_u_mean, error_u_max = 1e-3 * error_u_max,"
        f" error_lambda_mean = 1e-3 * error_lambda_mean WHERE {ONE}",
    )
    found = compare([quick_run / FILE, after], 1.25)
    assert list(found.changes["what"]) == ["queries_ok"]
    assert "errors of 1 of them are compared on the queries that are ok in both" in found.notes
    worse = changed(
        f"UPDATE queries SET status = 'inaccurate' WHERE {ONE} AND query > 3",
        f"UPDATE queries SET error_u = 2 * error_u WHERE {ONE} AND query < 4",
        f"UPDATE cells SET queries_ok = 4 WHERE {ONE}",
    )
    of_errors = set(compare([quick_run / FILE, worse], 1.25).changes["what"])
    assert of_errors == {"queries_ok", "error_u_mean", "error_u_max"}
    version = f'versions = replace(versions, \'"protocol": "{PROTOCOL}"\', \'"protocol": "0"\')'
    for other in ("machine = 'other'", version):
        found = compare([quick_run / FILE, changed(f"UPDATE cells SET {other}, online_s = 9 * online_s")], 1.25)
        assert found.changes.empty
        assert any("different machines or protocols" in note for note in found.notes)


def test_changes_within_the_limit_or_of_solvers_are_not_told(changed: Changed, steady: Path, tmp_path: Path) -> None:
    after = changed("UPDATE cells SET online_s = 1.2 * online_s, error_u_mean = 1.2 * error_u_mean", *STEADY)
    assert compare([steady, after], 1.25).changes.empty
    assert compare([steady, after], 1.1).regressions == 2 * 12
    before = changed("UPDATE cells SET error_u_mean = 1e-6, solver_error_u_max = 2e-6").rename(tmp_path / "a.sqlite")
    for moved, verdict in ((4.9e-6, ChangeKind.WITHIN_ACCURACY), (5.1e-6, ChangeKind.WORSE)):
        after = changed(f"UPDATE cells SET error_u_mean = {moved}, solver_error_u_max = 2e-6")
        columns = compare([before, after], 1.25).by_column.set_index("what")
        assert columns.loc["error_u_mean", verdict.value] == 12


ROUNDS = "UPDATE timings SET total_s = {} * (SELECT online_s FROM cells WHERE cells.cell = timings.cell)"


def test_seconds_have_changed_where_the_rounds_tell_by_their_interval(changed: Changed, tmp_path: Path) -> None:
    """Medians that differ by half, each of rounds as far apart: the interval of their ratio contains 1."""
    noisy = ROUNDS.format("(0.3 + 0.13 * round)")
    before = changed(noisy).rename(tmp_path / "a.sqlite")
    after = changed("UPDATE cells SET online_s = 1.5 * online_s", noisy)
    columns = compare([before, after], 1.25).by_column.set_index("what")
    assert columns.loc["online_s", ChangeKind.UNDECIDED.value] == 12
    assert columns.loc["online_s", "ratio"] == pytest.approx(1.5)
    slower = "UPDATE cells SET online_s = 9 * online_s"
    for reason in ("UPDATE cells SET disturbed = 1", "DELETE FROM timings WHERE round >= 5"):
        columns = compare([before, changed(slower, *STEADY, reason)], 1.25).by_column.set_index("what")
        assert columns.loc["online_s", ChangeKind.UNDECIDED.value] == 12
    rounds = (ROUNDS.format("(0.95 + 0.01 * (round % 11))"), "UPDATE cells SET disturbed = 0")
    before = changed(*rounds).rename(tmp_path / "a.sqlite")
    after = changed("UPDATE cells SET online_s = 2 * online_s", *rounds)
    rows = compare([before, after], 1.25).changes
    online = rows[rows["what"] == "online_s"]
    assert len(online) == 12
    assert ((online["ratio_low"] > 1.8) & (online["ratio_low"] < 2.0)).all()
    assert ((online["ratio_high"] < 2.2) & (online["ratio_high"] > 2.0)).all()


def test_what_is_equal_round_off_or_new_is_no_regression(changed: Changed, tmp_path: Path) -> None:
    """Nor are columns without any value an obstacle."""
    empty = ("UPDATE thresholds SET primal_tol_b = NULL, dual_tol = NULL", "UPDATE cells SET primal_tol = NULL")
    for before, after, changes in (
        ((), (), 0), (empty, (), None), ((), empty, None),
        (["UPDATE cells SET error_u_mean = 1e-14"], ["UPDATE cells SET error_u_mean = 9e-14"], 0),
        (["UPDATE cells SET beta_span_min = 9e-17"], ["UPDATE cells SET beta_span_min = 1e-17"], 0),
        ([f"UPDATE cells SET beta_span_min = NULL, beta_cone_lower_min = NULL WHERE {ONE}"], (), 2),
        ([f"DELETE FROM cells WHERE {ONE}"], (), 1),
    ):  # fmt: skip
        found = compare([changed(*before).rename(tmp_path / "before.sqlite"), changed(*after)], 1.0)
        assert changes is None or (len(found.changes), found.regressions) == (changes, 0), before
    (row,) = found.changes.to_dict("records")
    assert (row["after"], row["verdict"]) == ("new", ChangeKind.CHANGED.value)


THRESHOLD = "WHERE solver = 'piqp' AND problem = 'obstacle' AND dual = 'mcpg' AND primal_a = 'high-fidelity'"

NUMBERS = ("benefit_threshold", "threshold_low", "threshold_high")
LATER = ", ".join(f"{name} = 30 * {name}" for name in NUMBERS)


def test_a_break_even_is_worse_where_its_own_side_got_slower(changed: Changed, tmp_path: Path) -> None:
    """Not where it stays within the interval of the other run, or its competitor got quicker."""
    before = changed(*DECISIVE).rename(tmp_path / "decided.sqlite")

    def after(*statements: str, limit: float = 1.25) -> Comparison:
        return compare([before, changed(*DECISIVE, *(f"UPDATE thresholds SET {one}" for one in statements))], limit)

    moved = "benefit_threshold = threshold_high, threshold_high = 3 * threshold_high, offline_b_s = 3 * offline_b_s"
    assert after(f"{moved} WHERE primal_a = 'high-fidelity'", limit=1.0 + 1e-9).changes.empty
    never = "benefit_threshold = NULL, threshold_low = NULL, threshold_high = NULL, meaning = 'never'"
    found = after(
        f"{LATER}, offline_b_s = 3 * offline_b_s {THRESHOLD} AND primal_b = 'decorrelated'",
        f"{never}, online_b_s = 9 * online_b_s {THRESHOLD} AND primal_b = 'offline-pga'",
    )
    assert set(found.changes["primal"]) == {"decorrelated", "offline-pga"}
    assert set(found.changes["what"]) == {"break-even against high-fidelity"}
    assert found.regressions == 2
    quicker = after(f"{LATER}, online_a_s = online_a_s / 3 {THRESHOLD}")
    assert (len(quicker.changes), quicker.regressions) == (3, 0)


def test_strict_fails(changed: Changed, steady: Path, quick_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    after = changed(f"UPDATE cells SET online_s = 2 * online_s WHERE {ONE}", *STEADY)
    with pytest.raises(Exception, match="1") as ended:
        compare_runs([str(steady), str(after)], strict=True)
    assert getattr(ended.value, "exit_code", None) == 1
    assert "1 for the worse" in capsys.readouterr().out
    compare_runs([str(after), str(steady)], strict=True)  # an improvement
    assert "0 for the worse" in capsys.readouterr().out
    compare_runs([str(quick_run), str(quick_run)], strict=True, form="csv")
    assert capsys.readouterr().out.startswith("run,against,problem,formulation,dual,primal,asked")
    wrong = ([str(quick_run), "nowhere"], "no results in 'nowhere'"), ([str(after)], "expected two or more")
    for runs, said in wrong:
        with pytest.raises(RequestError, match=said):
            compare_runs(runs)


@pytest.fixture
def three(changed: Changed, steady: Path, tmp_path: Path) -> list[Path]:
    """Three runs: on one machine, on another, where one cell failed, and on this one again, slower and less exact."""
    there = changed(
        "UPDATE cells SET machine = 'server', online_s = 0.1 * online_s",
        f"UPDATE cells SET status = 'crashed' WHERE {ONE}",
        *STEADY,
    ).rename(tmp_path / "server.sqlite")
    later = changed(
        f"UPDATE cells SET machine = 'server', online_s = 0.3 * online_s, error_u_mean = 4 * error_u_mean WHERE {ONE}",
        f"UPDATE cells SET online_s = 3 * online_s WHERE NOT ({ONE})",
        "DELETE FROM cells WHERE solver = 'osqp'",
        *STEADY,
    ).rename(tmp_path / "later.sqlite")
    return [steady, there, later]


def test_what_many_runs_have_is_told_in_every_table_and_format(three: list[Path], main: Main) -> None:
    found = compare(three, 1.25)
    runs = found.by_run.set_index("run")
    assert list(runs["cells"]) == [12, 12, 6]
    assert set(runs["in all runs"]) == {6}
    assert list(runs["same code"]) == [12, 12, 6]
    assert found.present[["steady", "server", "later"]].drop_duplicates().to_numpy().tolist() == [["yes", "yes", "no"]]
    assert len(found.present) == 6
    values = found.values("online_s")
    assert len(values) == 12
    assert values["later"].isna().sum() == 6
    assert (values["server"] / values["steady"]).to_list() == pytest.approx([0.1] * 12)
    with pytest.raises(RequestError, match="did you mean 'online_s'"):
        found.values("online")
    # What `diff` lists of the first run and any other one is what `compare` lists of all, but for other machines.
    everything = found.changes
    for path in three[1:]:
        alone = compare([three[0], path], 1.25).changes
        of_it = everything[(everything["run"] == path.stem) & (everything["against"] == "steady")]
        assert len(alone) > 0
        pd.testing.assert_frame_equal(alone, of_it.reset_index(drop=True))
    seconds = found.changes[found.changes["what"] == "online_s"].set_index(["run", "against"])
    assert set(seconds.index) == {("later", "steady"), ("later", "server")}
    assert len(seconds.loc[[("later", "steady")]]) == 5
    assert seconds.loc[("later", "steady"), "ratio"].to_list() == pytest.approx([3.0] * 5)
    (row,) = seconds.loc[[("later", "server")]].to_dict("records")
    assert row["ratio"] == pytest.approx(3.0)
    numbers = found.changes[~found.changes["what"].isin(["online_s", "offline_s"])]
    assert set(numbers["against"]) == {"steady"}
    assert "server: times and break-even of different machines or protocols are not compared" in found.notes
    assert not any(note.startswith("later: times") for note in found.notes)
    paths = list(map(str, three))
    pair, asked = paths[::2], ("--table", "changes", "--strict")
    code, listed, _ = main("compare", *pair, *asked, "--format", "csv")
    assert code == 1
    assert main("compare", *pair, "--format", "csv") == (0, listed, "")
    assert main("compare", *pair)[1].endswith(main("compare", *pair, *asked)[1])
    for table, rows in (("changes", 14), ("runs", 3), ("cells", 6)):
        text = succeeded(main("compare", *paths, "--table", table, "--format", "json"))
        assert len(json.loads(text)) == rows
    assert main("compare", *paths, "--table", "runs", "--format", "markdown")[1].startswith("|")
    columns = json.loads(main("compare", *paths, "--table", "columns", "--format", "json")[1])
    about = ("error_u_mean", "later", "steady")
    (found,) = (row for row in columns if (row["what"], row["run"], row["against"]) == about)
    assert (found["cells"], found["equal"], found["worse"], found["ratio"]) == (6, 5, 1, 1.0)
    assert found["farthest_ratio"] == pytest.approx(4.0)
    text = succeeded(main("compare", *paths, "--column", "N", "--format", "csv"))
    assert text.splitlines()[0].endswith(",cell,steady,server,later")


def test_a_comparison_fits_the_terminal_and_what_it_is_about_is_shown(
    quick_run: Path, three: list[Path], changed: Changed, main: Main, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The values of the runs, what changed to what, and which cells only one has; axes make room for them."""
    for width in (200, 80):
        monkeypatch.setenv("COLUMNS", str(width))
        shown = succeeded(main("compare", *map(str, three)))
        tables = [line for line in shown.splitlines() if not line.startswith("not shown at")]
        assert max(map(len, tables)) <= width
        assert {"server", "later", "online_s"} <= set(shown.split())
        assert len(shown.splitlines()) < 120
    other = changed(f"UPDATE cells SET status = 'error', queries_ok = 0 WHERE {ONE}", "DELETE FROM cells WHERE N = 13")
    _, shown, _ = main("compare", *[str(quick_run)] * 3, "--column", "online_s")
    below = shown.split("─\n")[1].split("not shown")[0].splitlines()
    assert all(re.search(r"( [0-9][0-9.e-]*){3}$", re.sub(" +", " ", line)) for line in below)
    for asked in (("--table", "changes"), ()):
        _, shown, _ = main("compare", str(quick_run), str(other), *asked)
        assert all(re.search(words, shown) for words in (r"before +after", r"present +gone", r"ok +error"))
    _, shown, _ = main("compare", str(quick_run), str(other), "--table", "cells")
    assert re.search(r"yes +no|quick yes, .* no", shown)


def test_runs_of_folders_with_the_same_name_are_told_apart(tmp_path: Path) -> None:
    paths = [tmp_path / "a" / "quick" / FILE, tmp_path / "b" / "quick" / FILE, tmp_path / "c" / "other.sqlite"]
    expected = {
        (0, 1, 2): ["a/quick", "b/quick", "c/other"],
        (0, 2): ["quick", "other"],
        (0, 0): ["quick", "quick (2)"],
    }
    for chosen, names in expected.items():
        assert [run.name for run in compared_runs([paths[k] for k in chosen])] == names


def threshold(meaning: str, gain: float, low: float, high: float) -> pd.DataFrame:
    number = 9.0 if meaning == "from" else None
    row = {"cell_a": "a", "cell_b": "b", "meaning": meaning, "gain": gain, "gain_low": low, "gain_high": high}
    return pd.DataFrame([row | dict.fromkeys(NUMBERS, number)])


def test_break_evens_contradict_each_other_where_at_most_one_is_right() -> None:
    """Queries that are as fast in one run may be a little faster in another; a run that is undecided says nothing."""
    for one, two, opposite in (
        (("from", 1.5, 1.4, 1.6), ("from", 1.3, 1.2, 1.39), False),
        (("from", 1.1, 1.01, 1.2), ("never", 0.9, 0.8, 0.99), True),
        (("from", 1.1, 1.01, 1.2), ("at once", 1.1, 1.01, 1.2), True),
        (("from", 1.1, 1.01, 1.2), ("as fast", 1.0, 0.9, 1.1), False),
        (("from", 1.5, 1.4, 1.6), ("as fast", 1.0, 0.9, 1.1), True),
        (("never", 0.7, 0.6, 0.8), ("as fast", 1.0, 0.9, 1.1), True),
        (("as fast", 1.0, 0.9, 1.1), ("as fast", 0.98, 0.9, 1.05), False),
    ):
        runs, both = (threshold(*one), threshold(*two)), int(one[0] == two[0] == "from")
        assert agreement(*runs) == agreement(*runs[::-1]) == (both, both, opposite, 1)
        undecided = runs[1].assign(meaning="undecided", benefit_threshold=None)
        assert agreement(runs[0], undecided) == (0, 0, 0, 0)
