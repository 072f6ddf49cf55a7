"""Machines with odd limits, and odd things beside a study."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from running import Main, by_solver, refused, started
from samples import wire_study, write_study

from vibench.provenance import cores, solver_version


def test_more_jobs_than_a_machine_can_bear_are_refused(main: Main, tmp_path: Path) -> None:
    study = write_study(tmp_path, wire_study(problem=["obstacle"]))
    line = refused(main("run", study, "--jobs", "1000000000"), "--jobs 1000000000")
    assert f"expected 1 to {16 * cores()} worker processes" in line
    assert list(Path.cwd().iterdir()) == []


def test_dask_without_open_files_ends_with_a_line(command: str, tmp_path: Path) -> None:
    study = write_study(tmp_path, wire_study(problem=["obstacle"]))
    limited = ["bash", "-c", 'ulimit -n 32; exec "$0" "$@"', command, "run", study, "--executor", "dask", "--jobs", "2"]
    done = subprocess.run(limited, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == (
        "vibench: the executor 'dask' needs 96 open files, the limit is 32: raise it (`ulimit -n 96`), "
        "ask for fewer --jobs, or use the executor 'local'\n"
    )


@pytest.mark.skipif(solver_version("daqp") != "", reason="daqp is installed")
def test_folders_called_like_a_library_are_not_taken_for_it(
    command: str, plugins_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`PYTHONPATH=FOLDER:$PYTHONPATH` has an empty entry, the working directory, where the variable was not set."""
    (tmp_path / "daqp").mkdir()  # can be imported
    (tmp_path / "piqp").mkdir()
    (tmp_path / "piqp" / "__init__.py").write_text("raise OSError('not the solver')")
    write_study(tmp_path, wire_study(solvers=["piqp", "daqp", "careful"]))
    with started(
        [command, "run", "study.toml", "--jobs", "1", "--no-figures"], tmp_path, Path(f"{plugins_folder}:")
    ) as process:
        _, errors = process.communicate(timeout=120)
    assert (process.returncode, errors) == (0, "")
    found = {solver: row["status"] for solver, row in by_solver(tmp_path / "runs" / "wire").items()}
    assert found == {"piqp": "ok", "careful": "ok", "daqp": "unavailable"}
