import importlib.metadata
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from running import Main, Register, succeeded

from vibench import RequestError, Status, provenance
from vibench.cli import doctor
from vibench.cli.doctor import Diagnosis, Health
from vibench.execution.isolated import Trial
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers
from vibench.qp.verification import Residuals
from vibench.stages.artefacts import Store, default_folder
from vibench.timing import NO_TIME, Seconds, Stopwatch

FINE = Trial(Status.OK, "", residuals=Residuals(0.0, 2e-9, 0.0, 1.0))


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> dict[str, Trial]:
    """What trials are to end with, by solver; the others are fine, and nothing is solved."""
    found: dict[str, Trial] = {}
    monkeypatch.setattr(doctor, "solver_trials", lambda _, __, names, ___: {n: found.get(n, FINE) for n in names})
    return found


REQUIRED = {"osqp", "piqp", "proxqp"}
"""Solvers that vibench depends on."""


def by_subject(findings: list[Diagnosis]) -> dict[str, Diagnosis]:
    return {finding.subject: finding for finding in findings}


def test_where_all_is_well_the_exit_code_is_zero(main: Main) -> None:
    out = succeeded(main("doctor"))
    lines = out.splitlines()
    assert lines[-1] == "nothing is broken"
    assert {"versions", "QP solvers", "plugins", "machine", "disk", "timings"} <= set(lines)
    for solver in installed_solvers():
        line = next(line for line in lines if line.split()[1:2] == [solver])
        assert line.startswith("ok" if solver in REQUIRED else ("ok", "note"))
        assert provenance.solver_version(solver) in line
        assert "residual" in line
    assert str(Path("runs").absolute()) in out
    assert str(default_folder()) in out
    assert list(Path.cwd().iterdir()) == []


def test_an_inaccurate_solver_is_broken_if_required_and_else_a_note(main: Main, trials: dict[str, Trial]) -> None:
    cases = [("piqp", (1, "broken: piqp"), "broken")]
    cases += [(name, (0, "nothing is broken"), "note") for name in sorted({*installed_solvers()} - REQUIRED)[:1]]
    for solver, ends, health in cases:
        trials.clear()
        trials[solver] = Trial(Status.INACCURATE, "dual residual 1.7e-07 above 1e-07: found")
        code, out, _ = main("doctor")
        assert (code, out.splitlines()[-1]) == ends
        line = next(line for line in out.splitlines() if line.split()[1:2] == [solver])
        assert line.startswith(health)
        assert "dual residual 1.7e-07 above 1e-07" in line


@pytest.mark.usefixtures("trials")
def test_solvers_that_cannot_be_run(monkeypatch: pytest.MonkeyPatch) -> None:
    installed, known = installed_solvers, provenance.solver_version

    def found_without(solver: str, version: str) -> Diagnosis:
        """The solver cannot be run; its distribution is there in this version, or not at all."""
        monkeypatch.setattr(doctor, "installed_solvers", lambda extra=(): [n for n in installed(extra) if n != solver])
        monkeypatch.setattr(provenance, "solver_version", lambda name: version if name == solver else known(name))
        found = by_subject(list(doctor.check_solvers()))
        assert set(found) >= set(SETTINGS)
        return found[solver]

    assert found_without("osqp", "").health is Health.BROKEN  # vibench needs it
    missing = found_without("ecos", "")
    assert missing.health is Health.NOTE
    assert "'vibench[solvers]'" in missing.text
    monkeypatch.setattr(doctor, "load_qpsolvers", lambda: (None, {"ecos": "ImportError: built for another NumPy"}))
    wrong = found_without("ecos", "2.0.14")
    assert wrong.health is Health.BROKEN
    assert "ImportError: built for another NumPy" in wrong.text


def test_libraries_that_are_missing_and_unsteady_machines_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    needed, known = doctor.required_distributions(), provenance.distribution_version
    assert needed["numpy"] == needed["qpsolvers"] == needed["daqp"] == []
    assert (needed["ecos"], needed["cvxopt"]) == (["solvers"], ["fast", "solvers", "test"])
    monkeypatch.setattr(provenance, "distribution_version", lambda name: "" if name == "scipy" else known(name))
    found = by_subject(list(doctor.check_versions()))
    assert found["scipy"].health is Health.BROKEN
    assert f"numpy {importlib.metadata.version('numpy')}" in found["libraries"].text
    monkeypatch.setattr(doctor, "Stopwatch", lambda: SimpleNamespace(seconds=lambda: Seconds(1.0, 1.0)))
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    for others, slowdown, doubts in (
        (0.0, 1.0, []), (3.0, 1.0, ["other load"]), (0.0, 1.4, ["slowdown"]),
        (3.0, 2.0, ["other load", "slowdown"]),
    ):  # fmt: skip
        monkeypatch.setattr(doctor, "_busy_seconds", iter([100.0, 101.0 + others]).__next__)
        monkeypatch.setattr(doctor.Calibration, "slowdown", lambda _, slowdown=slowdown: slowdown)
        found = by_subject(list(doctor.check_timings()))
        assert [subject for subject in found if found[subject].health is Health.NOTE][:-1] == doubts
        assert f"{others:.1f} of 2 cores" in found["other load"].text
        assert ("can be trusted" in found["verdict"].text) is not bool(doubts)


def test_every_plugin_that_does_not_load_has_a_line_with_the_reason(register: Register, tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text("name = 3\n")
    register(
        ("vibench.problems", "fine", "vibench_problems.obstacle:Obstacle"),
        ("vibench.problems", "gone", "no_such_module:Problem"),
        ("vibench.problems", "no-problem", "pathlib:Path"),
        ("vibench.studies", "wrong", "test_doctor:WRONG"),
        *(("vibench.qp_solvers", "mine", f"{module}:solve") for module in ("one", "other")),
    )
    globals()["WRONG"] = tmp_path / "wrong.toml"
    found = by_subject(list(doctor.check_plugins()))
    assert found["problem"] == Diagnosis("problem", "fine")
    broken = {subject: finding.text for subject, finding in found.items() if finding.health is Health.BROKEN}
    reasons = {
        "problem 'gone'": "no_such_module", "problem 'no-problem'": "not a subclass", "study 'wrong'": "name",
        "QP solver 'mine'": "two packages",
    }  # fmt: skip
    assert set(broken) == set(reasons)
    assert [subject for subject, reason in reasons.items() if reason not in broken[subject]] == []


@pytest.mark.usefixtures("trials")
def test_the_error_of_a_plugin_is_no_markup(main: Main, register: Register, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("odd_module.py").write_text("raise ImportError('[/b] [red]:warning: \\x1b[2J\\ud800')\n")
    monkeypatch.syspath_prepend(Path.cwd())
    register(("vibench.problems", "[/i]\x1b[31m", "odd_module:Problem"))
    code, out, err = main("doctor")
    assert (code, err) == (1, "")
    assert all(line.isprintable() for line in out.splitlines())
    assert r"problem '[/i]\u001b[31m'" in out
    assert r"ImportError: [/b] [red]:warning: \u001b[2J\ud800" in " ".join(out.split())


def test_unusable_places(main: Main, trials: dict[str, Trial], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    Path("taken").touch()
    code, out, _ = main("doctor", "--out", "taken/below")
    assert code == 1
    assert out.splitlines()[-1] == "broken: runs"
    assert "taken/below: cannot be used: Not a directory" in out
    monkeypatch.setenv("VIBENCH_CACHE", str(tmp_path / "cache"))
    Store(default_folder()).put("pod-1", "x" * 2**20, NO_TIME, ())
    (killed := tmp_path / "vibench-1.part").mkdir()
    found = by_subject(list(doctor.check_disk(tmp_path)))
    assert not killed.exists()
    assert found["stored"].text.startswith("1 artefacts, 1.0 MiB")
    assert "VIBENCH_CACHE" in found["artefact folder"].text
    assert str(tmp_path / "cache" / "artefacts") in found["artefacts"].text
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=2**28))
    found = by_subject(list(doctor.check_disk(tmp_path / "new")))["runs"]
    assert found == Diagnosis("runs", f"{tmp_path / 'new'}: 0.2 GiB free", Health.NOTE)
    monkeypatch.setattr(doctor, "locked", Mock(side_effect=RequestError("cannot be locked: No locks available")))
    found = by_subject(list(doctor.check_disk(tmp_path)))["runs"]
    assert found.health is Health.BROKEN
    assert "No locks available" in found.text


def test_the_machine_that_works_is_seen_to_work() -> None:
    before = doctor._busy_seconds()
    if before == 0.0:
        pytest.skip("the system does not tell")
    watch = Stopwatch()
    while watch.seconds().cpu < 0.1:
        pass
    assert doctor._busy_seconds() - before >= 0.05
