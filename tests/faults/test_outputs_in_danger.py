"""Sites and reports that find a full disk, links in a circle, or folders of another user."""

import os
import random
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from running import Main, Vibench, rows
from sample_run import write_sample_run
from samples import wire_study, write_study

from vibench.results.sqlite import FILE


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_sample_run(tmp_path / "run").parent


@pytest.mark.long
def test_sites_on_full_disks_are_not_there(run: Path, vibench: Vibench, tmp_path: Path) -> None:
    for kib in (20, 600):
        done = vibench(tmp_path, "publish", str(run), str(tmp_path / "site"), "--no-figures", "--yes", file_kib=kib)
        assert done.returncode == 2, done.stderr
        assert done.stderr.startswith("vibench: ")
        assert "cannot be written" in done.stderr
        assert done.stderr.count("\n") == 1
        assert {path.name for path in tmp_path.iterdir()} == {"run"}


LOOPS = (
    "show loop", "publish --yes run loop", "publish --yes run loop/site", "run loop", "run study.toml --out loop/x",
    "pack loop", "export run loop/x", "export run 0 loop/m.npz", "bench --read loop", "run loop/study.toml",
    "report run --out loop/x --no-figures",
)  # fmt: skip


def test_links_in_a_circle_are_replaced(run: Path, main: Main, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(run.parent)
    write_study(tmp_path, wire_study())
    Path("loop").symlink_to("again")
    Path("again").symlink_to("loop")
    for arguments in LOOPS:
        code, _, err = main(*arguments.split())
        assert (code, err.count("\n")) == (2, 1), (arguments, err)
    assert main("report", "run", "--out", "loop", "--no-figures")[0] == 0
    assert not Path("loop").is_symlink()


@contextmanager
def of_another_user(path: Path) -> Iterator[None]:
    """A folder that the user of this process may not use; root becomes nobody meanwhile."""
    user = os.geteuid()
    path.chmod(0o000)
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)
        path.chmod(0o755)


@pytest.mark.long
def test_odd_folders_and_clocks(run: Path, main: Main, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for line in ("show theirs", "publish --yes theirs theirs/site --no-figures", "report theirs --no-figures"):
        shutil.copytree(run, tmp_path / "theirs")
        assert main(*line.split())[0] == 0  # what is imported late may be in a folder that nobody may read
        shutil.rmtree(tmp_path / "theirs")
        shutil.copytree(run, tmp_path / "theirs")
        with of_another_user(tmp_path / "theirs"):
            code, out, err = main(*line.split())
        shutil.rmtree(tmp_path / "theirs")
        assert (code, out, err.count("\n")) == (2, "", 1), err
    jumps, undisturbed = random.Random(1), time.time
    monkeypatch.setattr(time, "time", lambda: undisturbed() + jumps.choice([-1e6, 0.0, 1e6]))
    coarse = {"name": "radial-obstacle", "options": {"resolution": "coarse"}}
    write_study(tmp_path, wire_study(problem=[coarse], solvers=["piqp"]))
    code, _, err = main("run", f"{tmp_path}/study.toml", "--out", f"{tmp_path}/out", "--jobs", "1", "--no-figures")
    assert (code, err) == (0, "")
    assert {row["status"] for row in rows(tmp_path / "out")} == {"ok"}
    assert (tmp_path / "out" / FILE).is_file()
