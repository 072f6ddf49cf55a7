"""Plugins that do all they can to their neighbours, beside honest ones of their package."""

import os
import signal
import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache

import numpy as np
import pandas as pd
import pytest
from fake_plugins import Wire
from hostile import ANYWHERE, CHANGED, KINDS, Honest, HonestCone, HonestNearest, HonestSpace, HostileSampling
from running import MEASURED

from vibench import RequestError, Run, Study, run

FEW = {"solvers": ["piqp"], "dual": ["cpg"], "primal": ["decorrelated"], "tolerances": [{"pod": [0.1], "dual": [0.1]}]}

EXPECTED = {
    kind: {f"{phase}-{how}": said for phase, acts in phases.items() for how, (said, _) in acts.items()}
    for kind, (_, phases) in KINDS.items()
}

# Some hundred acts of formulations take minutes, and the acts of strategies pass the same border as those of problems.
EVERY = pytest.mark.parametrize(
    "kind", ["problem", *(pytest.param(kind, marks=pytest.mark.long) for kind in KINDS if kind != "problem")]
)
Beside = Callable[..., Run]


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Beside:
    """Function that runs the honest ones after hostile plugins of a kind, all of them or some, or alone."""
    fair = [Honest, HonestNearest]
    honest = {"problem": [Wire], "dual": [HonestCone], "primal": [HonestSpace], "formulation": fair}

    @cache
    def of(kind: str, *some: str) -> Run:
        axes = honest | {"formulation": fair if kind in ("", "formulation") else [Honest]}
        # Last those that would make the honest ones wrong in silence.
        for how in sorted(some or EXPECTED.get(kind, ()), key=lambda how: EXPECTED[kind][how] == CHANGED, reverse=True):
            axes[kind] = [{"name": KINDS[kind][0], "label": how, "options": {"how": how}}, *axes[kind]]
        study = Study(
            name="borders", seed=3, validation=2, solvers=["piqp"], timing_rounds=1, limits={"query_seconds": 1.0},
            tolerances=[{"pod": [1e-3], "dual": [1e-2]}], **axes,
        )  # fmt: skip
        return run(study, tmp_path_factory.mktemp("borders"), jobs=1, fresh=True, progress=False)

    return of


def honest(found: Run, table: str, formulations: list[str]) -> pd.DataFrame:
    rows = found.table(table)
    fair = {"problem": ["Wire"], "dual": ["HonestCone", "–"], "primal": ["HonestSpace", "–"]}
    for axis, names in (fair | {"formulation": formulations}).items():
        rows = rows[rows[axis].isin(names)]
    return rows[[name for name in rows if not name.endswith((*MEASURED, "study_hash"))]].reset_index(drop=True)


@EVERY
def test_honest_rows_are_those_of_a_run_alone(beside: Beside, kind: str) -> None:
    names = ["Honest", "HonestNearest"][: 2 if kind == "formulation" else 1]
    for table in ("cells", "queries"):
        alone, found = (honest(beside(one), table, names) for one in ("", kind))
        assert len(alone) >= len(names)
        assert set(alone["status"]) == {"ok"}
        pd.testing.assert_frame_equal(found, alone, check_exact=True, check_dtype=False)


@EVERY
def test_what_misbehaves_says_so_in_its_own_rows(beside: Beside, kind: str) -> None:
    wrong, cells = {}, beside(kind).table("cells").set_index(kind)
    for how, said in EXPECTED[kind].items():
        (status, _, words), found = said.partition(": "), cells.loc[how]
        if found["status"] != status or words not in found["reason"] or "\n" in found["reason"]:
            wrong[how] = found["status"], found["reason"]
    assert wrong == {}


def test_what_a_sampling_does_to_the_process_of_the_command_is_undone() -> None:
    for how, (said, _) in ANYWHERE.items():
        if how not in ("exits", "dies"):
            sampling = {"name": HostileSampling, "options": {"how": f"build-{how}"}}
            before = sys.path[:], np.geterr(), signal.getsignal(signal.SIGTERM), os.environ.copy()
            with pytest.raises(RequestError, match=said[7:]) if said.startswith("error") else nullcontext():
                Study(name="borders", validation=2, problem=[{"name": Wire, "training": sampling}], **FEW)
            assert before == (sys.path, np.geterr(), signal.getsignal(signal.SIGTERM), os.environ), how


def test_buffers_are_judged_by_what_they_held_and_work_in_reconstruct_is_of_the_query(beside: Beside) -> None:
    cells = beside("formulation", "pair-buffer", "reconstruct-solves").table("cells").set_index("formulation")
    for name in ("error_u_mean", "error_lambda_mean"):
        assert cells.loc["pair-buffer", name] == cells.loc["Honest", name]
    cheat, fair = cells.loc["reconstruct-solves"], cells.loc["Honest"]
    assert cheat["error_u_mean"] < 1e-10
    assert cheat["online_solve_s"] > cheat["online_reconstruct_s"] > 0.0
    assert fair["online_reconstruct_s"] > 0.0
