"""Winners of the leaderboard and of `best`: found by brute force, and again from raw rows of runs by other code.

The run of the suite is one of the study `quick`; `VIBENCH_RUNS` may name more, as a list of folders like PATH.
"""

import json
import math
import os
import sqlite3
from collections import defaultdict
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import cells_of, row_of

from vibench import RequestError, open_run
from vibench.results import formats, ranking
from vibench.results.paired_timing import PairedTiming
from vibench.results.ranking import Criterion, Standings, cheapest, fastest, leaderboard


def won(standings: Standings, criterion: Criterion) -> list[tuple[float, str]]:
    found = [(band.error, band.winner(criterion)) for band in standings.bands]
    return [(error, str(winner.cell["cell"])) for error, winner in found if winner is not None]


def test_the_fastest_query_wins_its_band_or_the_high_fidelity_model_which_paces_machines() -> None:
    rows = row_of("a", 0.05, 0.1), row_of("b", 0.06, 0.2), row_of("c", 4e-3, 0.3), row_of("d", 3e-3, 0.25)
    (found,) = leaderboard(cells_of(*rows))
    assert won(found, Criterion.QUERY) == [(0.1, "a"), (0.01, "d")]
    assert [band.cells for band in found.bands] == [4, 2]
    assert won(found, Criterion.ERROR) == [(0.1, "d"), (0.01, "d")]
    (found,) = leaderboard(cells_of(row_of("a", 0.05, 0.4, hf_s=0.5), row_of("b", 1e-3, 0.6, hf_s=0.5)))
    assert won(found, Criterion.QUERY) == [(0.1, "a"), (1e-3, "")]
    winner = found.bands[-1].winner(Criterion.QUERY)
    assert (winner.cell["primal"], winner.value) == ("high-fidelity", pytest.approx(0.5))
    (found,) = leaderboard(cells_of(row_of("a", 0.05, 0.3, hf_s=1.0), row_of("b", 0.05, 0.2, hf_s=0.5)))
    assert won(found, Criterion.QUERY) == [(0.1, "a")]
    rows = row_of("a", 0.05, 0.2), row_of("b", 0.05, 0.1, problem="bar"), row_of("c", 0.5, 0.1, problem="c")
    found = leaderboard(cells_of(*rows))
    assert [(one.problem, won(one, Criterion.QUERY)) for one in found] == [
        ("box", [(0.1, "a")]), ("bar", [(0.1, "b")]), ("c", []),
    ]  # fmt: skip
    assert leaderboard(cells_of()) == ()


def test_what_wins_nothing_is_counted_and_constants_exclude_nobody() -> None:
    """β over the span may vanish at a parameter although λ is unique in the queries: their errors are what counts."""
    unstable = row_of("unstable", 1e-8, 1e-6, beta_span_min=1e-17, offline_s=1e-3)
    inexact = row_of("inexact", 0.11, 1e-7, offline_s=1e-4)
    (found,) = leaderboard(cells_of(row_of("right", 0.1, 0.4), unstable, inexact))
    assert {name for criterion in Criterion for _, name in won(found, criterion)} == {"unstable"}
    assert (found.cells, found.unstable, found.inexact, found.incomplete) == (3, 1, 1, 0)
    (found,) = leaderboard(
        cells_of(
            row_of("failed", 1e-9, 1e-9, status="inaccurate"), row_of("loose", 1e-3, 1e-9, solver_share_mean=0.5),
            row_of("interpolated", 1e-3, 1e-9, assembly_share_mean=0.5),
            row_of("unknown", None, 1e-9, error_u_mean=None), row_of("untimed", 1e-4, None),
        )
    )  # fmt: skip
    assert (won(found, Criterion.QUERY), won(found, Criterion.ERROR)) == ([], [(1e-4, "untimed")])
    assert (found.incomplete, found.loose, found.interpolated, found.inexact) == (1, 1, 1, 1)
    (found,) = leaderboard(cells_of(row_of("a", 1e-3, 0.1, beta_span_min=None)))
    assert won(found, Criterion.QUERY) == [(1e-3, "a")]


def test_differences_within_their_interval_or_the_work_of_solvers_are_ties() -> None:
    cells = cells_of(*(row_of(name, 0.05, online, hf_s=1.0) for name, online in (("a", 0.2), ("b", 0.201), ("c", 0.3))))
    rng, timings = np.random.default_rng(0), []
    for row in cells.to_dict("records"):
        for k in range(12):
            seconds = {"total_s": row["online_s"] * np.exp(0.02 * rng.standard_normal()), "hf_s": 1.0, "pace": 1.0}
            timings.append({"cell": row["cell"], "block": str(k // 3)} | seconds)
    (found,) = leaderboard(cells, PairedTiming(timings))
    ties = {one.criterion: one.ties for one in found.bands[0].winners}
    assert ties[Criterion.QUERY] == ("b",)
    # errors are equal, and so are offline seconds, of which all phases are the same
    assert ties[Criterion.ERROR] == ties[Criterion.OFFLINE] == ("b", "c")
    (found,) = leaderboard(cells)
    assert found.bands[0].winners[0].ties == ()  # nothing is known of the rounds
    parts = {"solver_error_u_max": 1e-9, "solver_error_lambda_max": 1e-5}
    rows = [row_of(name, error, 0.1, **parts) for name, error in (("a", 1.001e-2), ("b", 1e-2), ("c", 1.1e-2))]
    (found,) = leaderboard(cells_of(*rows))
    winner = found.bands[0].winner(Criterion.ERROR)
    assert (winner.cell["cell"], winner.ties) == ("b", ("a",))


some = st.floats(1e-6, 0.49)
"""Numbers below the seconds of a high-fidelity solution, 0.5 in all rows."""


@given(st.lists(st.tuples(some, some, some, st.sampled_from([0.0, 0.3])), min_size=1, max_size=8))
def test_nobody_in_a_band_is_better_than_its_winner(found: list[tuple[float, float, float, float]]) -> None:
    rows = [row_of(str(k), *one[:2], offline_s=one[2], beta_span_min=one[3]) for k, one in enumerate(found)]
    (standings,) = leaderboard(cells_of(*rows))
    for band in standings.bands:
        mine = [one for one in found if one[0] <= band.error * (1 + 1e-12)]
        assert len(mine) == band.cells
        for criterion, place in ((Criterion.ERROR, 0), (Criterion.QUERY, 1), (Criterion.OFFLINE, 2)):
            winner = band.winner(criterion)
            assert winner.value == pytest.approx(min(one[place] for one in mine))
            assert found[int(winner.cell["cell"])][place] == winner.value
        assert band.error <= ranking.LARGEST_BAND * (1 + 1e-12)
    taken = [one for one in found if one[0] <= ranking.LARGEST_BAND]
    assert bool(standings.bands) == bool(taken)


TOO_MUCH = 0.1
"""Errors, and shares of the solver and of assembly in them, from which a model wins nothing."""


class Raw:
    """The raw rows of a run: what SQLite gives, and nothing of vibench."""

    def __init__(self, file: Path) -> None:
        with sqlite3.connect(file) as db:
            db.row_factory = sqlite3.Row
            self.cells = [dict(row) for row in db.execute("SELECT * FROM cells")]
            self.queries = [dict(row) for row in db.execute("SELECT cell, status, error_u, error_lambda FROM queries")]
            self.timings = [dict(row) for row in db.execute("SELECT * FROM timings")]

    def error(self, cell: str) -> float:
        """The larger one of the mean errors of u and λ over the ok queries."""
        mine = [row for row in self.queries if row["cell"] == cell and row["status"] == "ok"]
        columns = [[row[name] for row in mine if row[name] is not None] for name in ("error_u", "error_lambda")]
        return max(fmean(values) for values in columns if values)

    def gain(self, cell: str) -> float:
        """Seconds of a high-fidelity solution over those of a query beside it: medians of blocks, and their mean."""
        blocks: dict[str, list[float]] = defaultdict(list)
        for row in self.timings:
            if row["cell"] == cell:
                blocks[row["block"]].append(math.log(row["hf_s"] / row["total_s"]))
        return math.exp(fmean(map(median, blocks.values())))

    def takes_part(self, cell: dict[str, Any]) -> bool:
        shares = [cell[f"{source}_share_mean"] or 0.0 for source in ("solver", "assembly")]
        return cell["status"] == "ok" and max(shares) < TOO_MUCH and self.error(cell["cell"]) <= TOO_MUCH

    def problems(self) -> dict[str, list[dict[str, Any]]]:
        mine: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for cell in self.cells:
            if self.takes_part(cell):
                mine[cell["problem"]].append(cell)
        return mine


RUNS = [Path(name) for name in os.environ.get("VIBENCH_RUNS", "").split(os.pathsep) if name]


@pytest.fixture(scope="module", params=[None, *RUNS], ids=str)
def folder(request: pytest.FixtureRequest, quick_run: Path) -> Path:
    return quick_run if request.param is None else Path(request.param)


@pytest.fixture(scope="module")
def raw(folder: Path) -> Raw:
    return Raw(folder / "results.sqlite")


def test_the_winners_of_the_leaderboard_are_those_of_the_raw_rows(raw: Raw, folder: Path) -> None:
    run = open_run(folder)
    checked = 0
    for standings in leaderboard(run.cells):
        mine = raw.problems()[standings.problem]
        for band in standings.bands:
            within = [cell for cell in mine if raw.error(cell["cell"]) <= band.error * (1.0 + 1e-9)]
            assert len(within) == band.cells
            best = max(within, key=lambda cell: raw.gain(cell["cell"]))
            winner = band.winner(Criterion.QUERY)
            assert winner.cell["cell"] == (best["cell"] if raw.gain(best["cell"]) >= 1.0 else "")
            offline = band.winner(Criterion.OFFLINE)
            assert offline.value == min(cell["offline_s"] for cell in within)
            # the same model with another solver has the same offline seconds: no solver wins them
            models = {cell["cell"] for cell in within if cell["model"] == offline.cell["model"]}
            assert models <= {offline.cell["cell"], *offline.ties}
            checked += 1
    assert checked >= 2


@pytest.mark.parametrize("queries", [1, 100, 10**6])
def test_the_cheapest_models_are_those_of_the_raw_rows(raw: Raw, folder: Path, queries: int) -> None:
    found = open_run(folder).best(queries=queries, error=0.05)
    assert len(found) == len(raw.problems())
    for row in found.to_dict("records"):
        mine = [cell for cell in raw.cells if cell["problem"] == row["problem"] and raw.takes_part(cell)]
        solution = math.exp(fmean(math.log(cell["hf_s"]) for cell in mine))
        setup = median(cell["hf_setup_s"] for cell in mine)
        totals = {"": setup + queries * solution}
        for cell in mine:
            if raw.error(cell["cell"]) <= 0.05:
                totals[cell["cell"]] = cell["offline_s"] + queries * solution / raw.gain(cell["cell"])
        assert row["cell"] == min(totals, key=totals.__getitem__)
        assert row["total_s"] == pytest.approx(min(totals.values()))
        if row["cell"]:
            assert row["total_low_s"] <= row["total_s"] <= row["total_high_s"]
        else:  # the unit of all totals
            assert pd.isna([row["total_low_s"], row["total_high_s"]]).all()
        assert row["cheapest_from"] <= queries <= row["cheapest_until"]
        assert 0.0 < row["probability"] <= 1.0


def timed(cells: pd.DataFrame, noise: float = 0.0) -> PairedTiming:
    rng = np.random.default_rng(0)
    rows = cells.to_dict("records")
    return PairedTiming(
        {"cell": row["cell"], "block": str(k // 3), "hf_s": row["hf_s"], "pace": 1.0}
        | {"total_s": row["online_s"] * float(np.exp(noise * rng.standard_normal()))}
        for row in rows
        for k in range(12)
    )


def model(name: str, offline: float, online: float, error: float = 1e-3) -> dict[str, Any]:
    phases = {f"offline_{phase}_s": 0.0 for phase in ("snapshots", "pod", "cone", "enrichment", "assembly")}
    seconds = dict.fromkeys(("offline_s", "offline_low_s", "offline_high_s"), offline)
    return row_of(name, error, online, machine="m", hf_setup_s=0.0, hf_s=1.0, **phases, **seconds)


def test_the_lower_envelope_of_total_costs_and_models_that_may_be_as_cheap() -> None:
    """Until 10 queries the high-fidelity model is the cheapest, from 12 on a, from 101 on b, at small errors."""
    cells = cells_of(model("a", 10.0, 0.1), model("b", 18.04, 0.02), model("c", 1.0, 0.01, error=0.05))
    for queries, cell, begin, end in ((5, "", 0, 11), (50, "a", 12, 100), (500, "b", 101, math.inf)):
        (row,) = cheapest(cells, timed(cells), queries, within=1e-2).to_dict("records")
        assert (row["cell"], row["cheapest_from"], row["cheapest_until"]) == (cell, begin, end)
        assert (row["probability"], row["ties"]) == (1.0, 0)
    rows = cheapest(cells, timed(cells), 500)
    assert list(zip(rows["error_below"], rows["cell"], strict=True)) == [(0.1, "c"), (1e-3, "b")]
    cells = cells_of(model("a", 10.0, 0.1), model("b", 10.0, 0.1001), model("c", 30.0, 0.1))
    (row,) = cheapest(cells, timed(cells, 0.05), 1000, within=1e-2).to_dict("records")
    assert row["cell"] in ("a", "b")
    assert row["ties"] == 1
    assert 0.3 < row["probability"] < 0.98


def test_certified_errors_are_means_of_bounds_of_the_model_itself() -> None:
    both = {"status": "ok", "error_lambda_natural": 0.5, "error_lambda_natural_absolute": 1.0}
    both |= {"error_u_energy": 0.1, "error_u_energy_absolute": 1.0}
    rows = [
        {"cell": "a", **both, "bound_online_u_energy": 5.0, "bound_online_lambda_natural": 1.0},
        {"cell": "a", **both, "bound_online_u_energy": 7.0, "bound_online_lambda_natural": 1.0},
        {"cell": "b", **both, "bound_online_u_energy": None, "bound_online_lambda_natural": None},
        {"cell": "c", **both, "bound_online_u_energy": 5.0, "bound_online_lambda_natural": 1.0},
    ]
    frame = pd.DataFrame(rows).assign(certificate=["certified", "certified", "none", "refuted"])
    found = ranking.certified_errors(frame)
    assert "c" not in found
    assert found["a"] == pytest.approx(0.6)  # of ‖u‖ = 10, beside 0.5 of ‖λ‖ = 2
    assert np.isnan(found["b"])
    # Not of the same model with another solver or corrected, whose solutions are others.
    plain = model("reduced", 10.0, 0.1) | {"model": "m1"}
    certified = model("certified", 12.0, 0.2) | {"model": "m1"}
    others = [
        model("corrected", 12.0, 0.2) | {"model": "m1", "correction": "feasible"},
        model("loose", 12.0, 0.2) | {"model": "m1", "accuracy": 1e-3},
        model("another", 12.0, 0.2) | {"model": "m2"},
    ]
    cells = cells_of(plain, certified, *others)
    bounds = pd.Series({"certified": 0.02, "corrected": 0.3, "loose": 0.4, "another": 0.5})
    (row,) = cheapest(cells, timed(cells), 1000, within=1e-2, certified=bounds).to_dict("records")
    assert (row["cell"], row["certified_error"]) == ("reduced", 0.02)
    (row,) = cheapest(cells, timed(cells), 1000, within=1e-2, certified=bounds.drop("certified")).to_dict("records")
    assert pd.isna(row["certified_error"])


def test_best_is_json_for_programs_and_refuses_what_cannot_be_asked(quick_run: Path, vibench: Any) -> None:
    for asked, message in (
        ({"queries": -1}, "queries of Run.best is -1, expected a positive"),
        ({"queries": 10, "error": 0.0}, "error of Run.best is 0.0, expected a positive"),
        ({"error": 0.1}, "--within is for tables of break-even points, and for the table best with --queries"),
    ):
        with pytest.raises(RequestError, match=message):
            open_run(quick_run).best(**asked)  # type: ignore[arg-type]
    done = vibench(quick_run.parent, "show", str(quick_run), "--table", "best", "--queries", "1000", "--format", "json")
    assert {"total_s", "probability", "cell"} <= set(json.loads(done.stdout)[0])


def test_every_error_that_is_reached_has_its_fastest_cell() -> None:
    """An exact cell that is the fastest stands alone, problems are apart, and an error of zero is one."""
    first = row_of("a", 0.05, 0.1)
    found = fastest(cells_of(first, row_of("b", 0.06, 0.2), row_of("c", 0.004, 0.3), row_of("d", 0.003, 0.25)))
    assert list(zip(found["cell"], found["error_below"], strict=True)) == [("a", 0.1), ("d", 0.01)]
    assert list(fastest(cells_of(row_of("a", 0.05, 0.2), row_of("b", 1e-5, 0.1)))["cell"]) == ["b"]
    found = fastest(cells_of(first, row_of("b", 0.0, 0.2, problem="zero", error_u_mean=0.0)))
    assert list(found["cell"]) == ["a", "b"]
    assert "error ≤" in formats.under_headings(found, ["problem", "error_below"], ranking.fastest_columns())
    # cells that no leaderboard names take no part
    others = (
        row_of("b", 1e-5, 0.1, status="inaccurate"), row_of("c", 1e-5, None), row_of("d", None, 0.1, error_u_mean=None),
        row_of("f", 1e-5, 0.1, solver_share_mean=0.5), row_of("g", 0.11, 0.01),
    )  # fmt: skip
    assert list(fastest(cells_of(row_of("a", 0.05, 0.2), *others))["cell"]) == ["a"]
    assert fastest(cells_of(*others)).empty
    assert fastest(cells_of()).empty
