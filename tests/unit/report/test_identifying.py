"""A published site tells neither in whose home nor on which host runs were made, and installs nothing of strangers."""

import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
import typer
from packs import write_cable
from running import Main, Shared, execute, refused, rows, succeeded
from samples import toml

from vibench.report import identifying
from vibench.report.citation import Citation
from vibench.report.site import publish
from vibench.results.read import read_table
from vibench.results.sqlite import FILE

STUDY: dict[str, Any] = {
    "name": "cables", "validation": {"name": "file", "path": "points.csv"}, "solvers": ["piqp"], "dual": ["mcpg"],
    "primal": ["decorrelated"], "timing_rounds": 1, "tolerances": [{"N": [2], "R": [2]}],
    "problem": [{"name": "pack", "options": {"path": "packs/cable"}}, {"name": "pack", "options": {"path": "../sag"}}],
}  # fmt: skip
WORDS = (b"somebody", b"secret", b"a-host-of-hers")


@pytest.fixture
def made(main: Main, shared: Shared, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run under somebody/secret, whose texts name it, its user and the host."""

    def make(folder: Path) -> None:
        home = folder / "home" / "somebody" / "secret work"
        write_cable(home / "packs" / "cable")
        write_cable(home.parent / "sag")
        (home / "points.csv").write_text("load,depth\n4.5,0.2\n7.5,0.3\n")
        (home / "study.toml").write_text(toml(STUDY))
        succeeded(main("run", str(home / "study.toml"), "--out", str(home / "run"), "--jobs", "1", "--no-figures"))
        noted = (
            f"somebody''s pack ''{home}/packs/cable'' at {home}/main.py:3 or /home/somebody/secret, on a-host-of-hers"
        )
        execute(
            home / "run",
            f"UPDATE cells SET reason = '{noted}', timing_reason = 'vibench check --option=path={home}/packs/cable'",
            f"UPDATE cells SET fallbacks = '{home}' WHERE rowid = 1",
            f"UPDATE queries SET reason = 'no file \"{home}/x.npz\" or /root/secret/b'",
            "UPDATE cells SET machine = machine || ' a-host-of-hers'",
        )

    monkeypatch.setattr(identifying.platform, "node", lambda: "a-host-of-hers")
    monkeypatch.setenv("LOGNAME", "somebody")
    monkeypatch.setenv("HOME", "/home/somebody")
    return shared("identifying", make) / "home" / "somebody" / "secret work" / "run"


def test_a_site_names_neither_home_nor_user_nor_host(made: Path, main: Main, tmp_path: Path) -> None:
    site = tmp_path / "site"
    before = (made / FILE).read_bytes()
    succeeded(main("publish", "--yes", str(made), str(site), "--no-figures"))
    files = [path for path in site.rglob("*") if path.is_file()]
    assert {path.name for path in files} >= {FILE, "report.html", "provenance.json", "cells.csv"}
    for path in files:
        assert [word for word in WORDS if word in path.read_bytes()] == [], path
    assert (made / FILE).read_bytes() == before
    (published,) = site.rglob(FILE)
    (row, other) = rows(published.parent)
    assert row["problem_options"] == '{"path": "packs/cable"}'
    assert other["problem_options"] == '{"path": "sag"}'
    assert row["validation_options"] == '{"path": "points.csv"}'
    assert row["cell"] == rows(made)[0]["cell"]
    assert row["reason"] == "…'s pack '…/cable' at …/main.py:3 or …, on …"
    assert len(read_table(published, "queries")) == 4  # its digests fit
    again = ("run", str(published), "--cell", row["cell"], "--dry-run")
    assert "somebody" not in refused(main(*again), "--at packs/cable=PATH")
    at = (word for place in ("packs/cable", "points.csv") for word in ("--at", f"{place}={made.parent / place}"))
    assert succeeded(main(*again, *at)).split()[0] == row["cell"]


@pytest.mark.long
def test_damage_is_found_and_runs_of_one_name_do_not_tell_their_folders(made: Path, main: Main, tmp_path: Path) -> None:
    shutil.copytree(made, tmp_path / "run")
    with sqlite3.connect(tmp_path / "run" / FILE) as db:
        db.execute("UPDATE queries SET error_u = 2 * error_u WHERE rowid = 1")
    db.close()
    refused(main("publish", "--yes", str(tmp_path / "run"), str(tmp_path / "site")), "is damaged")
    shutil.copytree(made, tmp_path / "secret" / "run")
    runs = (str(made), str(tmp_path / "secret" / "run"))
    succeeded(main("publish", "--yes", *runs, str(tmp_path / "s"), "--no-figures"))
    assert sorted(path.name for path in (tmp_path / "s" / "runs").iterdir()) == ["run", "run-2"]
    assert b"secret" not in (tmp_path / "s" / "index.html").read_bytes()


def test_what_could_identify_somebody_is_said_before_a_site_is_written(made: Path, main: Main, tmp_path: Path) -> None:
    refused(main("publish", str(made), str(tmp_path / "site")), "nothing was published", "--yes")
    said: list[str] = []

    def ask(lines: Any) -> None:
        said.extend(lines)
        raise typer.Abort

    execute(shutil.copytree(made, tmp_path / "run"), "UPDATE cells SET dual = 'the cone of somebody'")
    with pytest.raises(typer.Abort):
        publish([tmp_path / "run" / FILE], tmp_path / "site", Citation("x", ("Doe, Jane",)), ask=ask)
    assert not (tmp_path / "site").exists()
    assert said[:2] == ["names of runs: run", "authors: Doe, Jane"]
    assert any(line.startswith("labels: ") and "the cone of somebody" in line for line in said)
    assert any('"packs/cable"' in line for line in said)
    assert "the user's name 'somebody', in a name or an option" in said
