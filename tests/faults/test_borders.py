"""Formulations that do all they can to their neighbours, beside two honest ones of their package."""

import pandas as pd
import pytest
from fake_plugins import Wire
from hostile import CHANGED, PHASES, Honest, HonestNearest, Hostile
from running import MEASURED

from vibench import Run, Study, run

EXPECTED = {f"{phase}-{how}": said for phase, acts in PHASES.items() for how, (said, _) in acts.items()}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    """The honest ones alone, and right after those that would make them wrong in silence."""
    hows = sorted(EXPECTED, key=lambda how: EXPECTED[how] == CHANGED)
    hostile = [{"name": Hostile, "label": how, "options": {"how": how}} for how in hows]
    found, fair = [], [Honest, HonestNearest]
    for number, formulations in enumerate((fair, [*hostile, *fair])):
        study = Study(
            name="borders", seed=3, validation=2, problem=[Wire], formulation=formulations, dual=["cpg"],
            primal=["decorrelated"], solvers=["piqp"], timing_rounds=1, limits={"query_seconds": 1.0},
            tolerances=[{"pod": [1e-3], "dual": [1e-2]}],
        )  # fmt: skip
        found.append(run(study, tmp_path_factory.mktemp(f"borders{number}"), jobs=1, fresh=True, progress=False))
    return found[0], found[1]


@pytest.fixture(scope="module")
def cells(runs: tuple[Run, Run]) -> pd.DataFrame:
    return runs[1].table("cells").set_index("formulation")


def honest(found: Run, table: str) -> pd.DataFrame:
    rows = found.table(table)
    mine = rows[rows["formulation"].isin(["Honest", "HonestNearest"])].reset_index(drop=True)
    return mine[[name for name in mine if not name.endswith((*MEASURED, "study_hash"))]]


def test_honest_rows_are_those_of_a_run_alone(runs: tuple[Run, Run]) -> None:
    for table in ("cells", "queries"):
        alone, beside = (honest(found, table) for found in runs)
        assert len(alone) >= 2
        assert set(alone["status"]) == {"ok"}
        pd.testing.assert_frame_equal(beside, alone, check_exact=True, check_dtype=False)


def test_what_misbehaves_says_so_in_its_own_rows(cells: pd.DataFrame) -> None:
    assert len(EXPECTED) >= 60
    wrong = {}
    for how, said in EXPECTED.items():
        (status, _, words), found = said.partition(": "), cells.loc[how]
        if found["status"] != status or words not in found["reason"] or "\n" in found["reason"]:
            wrong[how] = found["status"], found["reason"]
    assert wrong == {}


def test_a_buffer_that_is_filled_again_is_judged_by_what_it_held(cells: pd.DataFrame) -> None:
    for name in ("error_u_mean", "error_lambda_mean"):
        assert cells.loc["pair-buffer", name] == cells.loc["Honest", name]


def test_work_in_reconstruct_is_a_part_of_the_query(cells: pd.DataFrame) -> None:
    cheat, fair = cells.loc["reconstruct-solves"], cells.loc["Honest"]
    assert cheat["error_u_mean"] < 1e-10
    assert cheat["online_solve_s"] > cheat["online_reconstruct_s"] > 0.0
    assert fair["online_reconstruct_s"] > 0.0
