"""Packages that meddle with their process, or take the names of others: it costs their own cells, and is told."""

from pathlib import Path

import fake_plugins
import meddling
import pytest
from running import Vibench, rows, run_wire, without_seconds
from samples import FAKES, ROUNDS, install, wire_study, write_study


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = install(tmp_path_factory.mktemp("site") / "both", fake_plugins, FAKES)
    return add(folder, tmp_path_factory, meddling.MEMBERS)


def add(folder: Path, temporary: pytest.TempPathFactory, members: dict[str, dict[str, str]]) -> Path:
    for part in install(temporary.mktemp("apart") / "site", meddling, members).iterdir():
        part.rename(folder / part.name)
    return folder


@pytest.mark.long
def test_a_package_that_meddles_with_its_process_costs_no_other(vibench: Vibench, both: Path, tmp_path: Path) -> None:
    """One worker process would serve them all; the rounds of the solvers are interleaved."""
    write_study(tmp_path, wire_study(problem=["wire-meddles", "wire"], solvers=["meddling", "roughly", "piqp"]))
    write_study(tmp_path, wire_study(), "alone.toml")
    done = vibench(tmp_path, "run", "study.toml", "--jobs", "1", "--out", "both", plugins=both)
    assert (done.returncode, done.stderr) == (0, "")
    assert vibench(tmp_path, "run", "alone.toml", "--jobs", "1", "--out", "alone", plugins=both).returncode == 0
    found = {(row["problem"], row["solver"]): row for row in rows(tmp_path / "both")}
    (expected,) = rows(tmp_path / "alone")
    for key in [key for key in found if key[0] == "wire-meddles"]:
        assert found[key]["status"] == "error"
        assert "File too large; a plugin limits or closes the files of its process" in found[key]["reason"]
    good, bad, rough = (found["wire", solver] for solver in ("piqp", "meddling", "roughly"))
    ignored = {"rowid", "study", "study_hash"}
    for name in without_seconds(expected).keys() - ignored:
        assert good[name] == expected[name], name
    for row in (good, bad):
        assert (row["status"], row["timing_rounds"], row["timing_reason"]) == ("ok", ROUNDS, "")
        assert row["online_s"] > 0.0
    assert rough["status"] == "ok"
    assert "in other units of the unknowns" in rough["timing_reason"]
    assert "does the solver remember answers?" in rough["timing_reason"]


@pytest.mark.long
def test_a_name_of_two_packages(vibench: Vibench, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    site = add(install(tmp_path / "site", fake_plugins, FAKES), tmp_path_factory, meddling.TAKEN)
    study = wire_study(dual=["cpg", "mcpg"], solvers=["piqp", "careful", "osqp", "counts"])
    found = {(row["dual"], row["solver"]): row for row in run_wire(vibench, tmp_path, study=study, plugins=site)[1]}
    ok = {key for key, row in found.items() if row["status"] == "ok"}
    assert ok == {("mcpg", "piqp"), ("mcpg", "counts")}
    assert {row["status"] for key, row in found.items() if key not in ok} == {"unavailable"}
    reason = found["cpg", "piqp"]["reason"]
    assert reason.startswith("two packages provide the dual strategy 'cpg', so that none is used: ")
    assert "meddling 1.0 (meddling:Meddles)" in reason
    assert "(vibench_strategies.cpg:CPG)" in reason
    assert "fake-plugins 1.0 (fake_plugins:careful)" in found["mcpg", "careful"]["reason"]
    assert "'osqp', so that none is used: qpsolvers, meddling 1.0" in found["mcpg", "osqp"]["reason"]
    listed = vibench(tmp_path, "list", plugins=site)
    assert (listed.returncode, listed.stderr) == (0, "")
    words = " ".join(listed.stdout.split())
    for name in ("'cpg'", "'careful'", "'osqp'"):
        assert f"{name}, so that none" in words or name in words
