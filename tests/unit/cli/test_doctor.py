"""What the doctor says, and when something counts as broken."""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from running import Main, Register

from vibench import provenance
from vibench.cli import doctor
from vibench.cli.doctor import Diagnosis, Health
from vibench.errors import RequestError
from vibench.execution.isolated import Trial
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers
from vibench.qp.status import Status
from vibench.qp.verification import Residuals
from vibench.stages.artefacts import CACHE_VARIABLE, Store, default_folder
from vibench.timing import NO_TIME, Seconds, Stopwatch

FINE = Trial(Status.OK, "", residuals=Residuals(0.0, 2e-9, 0.0))


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> dict[str, Trial]:
    """What trials are to end with, by solver; the others are fine, and nothing is solved."""
    found: dict[str, Trial] = {}
    monkeypatch.setattr(doctor, "solver_trials", lambda _, __, names: {name: found.get(name, FINE) for name in names})
    return found


REQUIRED = {"osqp", "piqp", "proxqp"}
"""Solvers that vibench depends on."""


def by_subject(findings: list[Diagnosis]) -> dict[str, Diagnosis]:
    return {finding.subject: finding for finding in findings}


def test_where_all_is_well_the_exit_code_is_zero(main: Main) -> None:
    code, out, err = main("doctor")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[-1] == "nothing is broken"
    for title in ("versions", "QP solvers", "plugins", "machine", "disk", "timings"):
        assert title in lines
    for solver in installed_solvers():
        line = next(line for line in lines if line.split()[1:2] == [solver])
        assert line.startswith("ok" if solver in REQUIRED else ("ok", "note"))
        assert provenance.solver_version(solver) in line
        assert "residual" in line
    assert str(Path("runs").absolute()) in out
    assert str(default_folder()) in out
    assert list(Path.cwd().iterdir()) == []


def test_what_is_broken_is_named_at_the_end_and_in_the_exit_code(main: Main, trials: dict[str, Trial]) -> None:
    trials["piqp"] = Trial(Status.INACCURATE, "dual residual 3.0e-02 above 1e-07: solved")
    code, out, _ = main("doctor")
    assert code == 1
    assert out.splitlines()[-1] == "broken: piqp"
    line = next(line for line in out.splitlines() if line.split()[1:2] == ["piqp"])
    assert line.startswith("broken")
    assert "dual residual 3.0e-02" in line


def test_a_solver_of_an_extra_that_is_inaccurate_is_a_note(main: Main, trials: dict[str, Trial]) -> None:
    (solver, *_) = sorted(set(installed_solvers()) - REQUIRED) or [""]
    if not solver:
        pytest.skip("no solver of an extra is installed")
    trials[solver] = Trial(Status.INACCURATE, "dual residual 1.7e-07 above 1e-07: found")
    code, out, _ = main("doctor")
    assert (code, out.splitlines()[-1]) == (0, "nothing is broken")
    (line,) = (line for line in out.splitlines() if line.split()[1:2] == [solver])
    assert line.startswith("note")
    assert "1.7e-07 above 1e-07" in line


@pytest.mark.usefixtures("trials")
class TestSolvers:
    def test_one_that_is_not_installed_is_a_note_with_the_extra_that_brings_it(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self._without("ecos", "", monkeypatch)
        found = by_subject(list(doctor.check_solvers()))
        assert set(found) >= set(SETTINGS)
        assert found["ecos"].health is Health.NOTE
        assert "'vibench[solvers]'" in found["ecos"].text

    def test_one_that_vibench_needs_is_broken_without_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._without("osqp", "", monkeypatch)
        assert by_subject(list(doctor.check_solvers()))["osqp"].health is Health.BROKEN

    def test_one_that_cannot_be_imported_is_broken_with_the_reason(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        (tmp_path / "ecos.py").write_text("raise ImportError('built for another NumPy')\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, "ecos", raising=False)
        self._without("ecos", "2.0.14", monkeypatch)
        found = by_subject(list(doctor.check_solvers()))["ecos"]
        assert found.health is Health.BROKEN
        assert "ImportError: built for another NumPy" in found.text

    @staticmethod
    def _without(solver: str, version: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """The solver cannot be run; its distribution is there in this version, or not at all."""
        installed, known = installed_solvers, provenance.solver_version
        monkeypatch.setattr(doctor, "installed_solvers", lambda extra=(): [n for n in installed(extra) if n != solver])
        monkeypatch.setattr(provenance, "solver_version", lambda name: version if name == solver else known(name))


def test_what_vibench_needs_and_what_is_for_extras_is_read_from_its_metadata() -> None:
    found = doctor.required_distributions()
    assert found["numpy"] == found["qpsolvers"] == []
    assert found["daqp"] == ["solvers"]
    assert found["cvxopt"] == ["solvers", "test"]


def test_a_library_that_is_missing_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    known = provenance.distribution_version
    monkeypatch.setattr(provenance, "distribution_version", lambda name: "" if name == "scipy" else known(name))
    found = by_subject(list(doctor.check_versions()))
    assert found["scipy"].health is Health.BROKEN
    assert f"numpy {importlib.metadata.version('numpy')}" in found["libraries"].text


def test_every_plugin_that_does_not_load_has_a_line_with_the_reason(register: Register, tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text("name = 3\n")
    register(
        ("vibench.problems", "fine", "vibench_problems.obstacle:Obstacle"),
        ("vibench.problems", "gone", "no_such_module:Problem"),
        ("vibench.problems", "no-problem", "pathlib:Path"),
        ("vibench.studies", "wrong", "test_doctor:WRONG"),
    )
    globals()["WRONG"] = tmp_path / "wrong.toml"
    found = by_subject(list(doctor.check_plugins()))
    assert found["problem"] == Diagnosis("problem", "fine")
    broken = {subject: finding.text for subject, finding in found.items() if finding.health is Health.BROKEN}
    assert set(broken) == {"problem 'gone'", "problem 'no-problem'", "study 'wrong'"}
    assert "no_such_module" in broken["problem 'gone'"]
    assert "not a subclass" in broken["problem 'no-problem'"]
    assert "name" in broken["study 'wrong'"]


@pytest.mark.usefixtures("trials")
def test_the_error_of_a_plugin_is_no_markup_and_no_escape_sequence(
    main: Main, register: Register, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "odd_module.py").write_text("raise ImportError('[/b] [red]:warning: \\x1b[2J\\ud800')\n")
    monkeypatch.syspath_prepend(tmp_path)
    register(("vibench.problems", "[/i]\x1b[31m", "odd_module:Problem"))
    code, out, err = main("doctor")
    assert (code, err) == (1, "")
    assert all(line.isprintable() for line in out.splitlines())
    assert r"problem '[/i]\u001b[31m'" in out
    assert r"ImportError: [/b] [red]:warning: \u001b[2J\ud800" in " ".join(out.split())


def test_a_name_that_two_packages_register_is_broken_and_stops_nothing(register: Register) -> None:
    register(("vibench.qp_solvers", "mine", "one:solve"), ("vibench.qp_solvers", "mine", "other:solve"))
    found = by_subject(list(doctor.check_plugins()))
    assert found["QP solver 'mine'"].health is Health.BROKEN
    assert "two packages" in found["QP solver 'mine'"].text
    assert "problem" in found


class TestDisk:
    def test_a_place_that_cannot_be_written_is_broken(self, main: Main, trials: dict[str, Trial]) -> None:
        Path("taken").touch()
        code, out, _ = main("doctor", "--out", "taken/below")
        assert code == 1
        assert out.splitlines()[-1] == "broken: runs"
        assert "taken/below: cannot be used: Not a directory" in out

    def test_a_folder_that_takes_no_locks_is_broken(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        def locked(path: Path, **_: object) -> None:
            raise RequestError(f"'{path}' cannot be locked: No locks available")

        monkeypatch.setattr(doctor, "locked", locked)
        found = by_subject(list(doctor.check_disk(tmp_path)))["runs"]
        assert found.health is Health.BROKEN
        assert "No locks available" in found.text

    def test_little_room_is_a_note(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=2**28))
        assert by_subject(list(doctor.check_disk(tmp_path / "new")))["runs"] == Diagnosis(
            "runs", f"{tmp_path / 'new'}: 0.2 GiB free", Health.NOTE
        )

    def test_artefacts_are_counted_where_the_variable_puts_them(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
        Store(default_folder()).put("pod-1", "x" * 2**20, NO_TIME, ())
        found = by_subject(list(doctor.check_disk(tmp_path)))
        assert found["stored"].text.startswith("1 artefacts, 1.0 MiB")
        assert CACHE_VARIABLE in found["artefact folder"].text
        assert str(tmp_path / "cache" / "artefacts") in found["artefacts"].text


class TestTimings:
    @pytest.mark.parametrize(
        ("others", "slowdown", "doubts"),
        [(0.0, 1.0, []), (3.0, 1.0, ["other load"]), (0.0, 1.4, ["slowdown"]), (3.0, 2.0, ["other load", "slowdown"])],
    )
    def test_load_and_an_unsteady_calculation_are_doubts(
        self, others: float, slowdown: float, doubts: list[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(doctor, "_busy_seconds", iter([100.0, 101.0 + others]).__next__)
        monkeypatch.setattr(doctor, "Stopwatch", _SecondOfWork)
        monkeypatch.setattr("os.cpu_count", lambda: 2)
        monkeypatch.setattr(doctor.Calibration, "slowdown", lambda _: slowdown)
        found = by_subject(list(doctor.check_timings()))
        assert [subject for subject in found if found[subject].health is Health.NOTE][:-1] == doubts
        assert f"{others:.1f} of 2 cores" in found["other load"].text
        assert ("can be trusted" in found["verdict"].text) is not bool(doubts)

    def test_the_machine_that_works_is_seen_to_work(self) -> None:
        before = doctor._busy_seconds()
        if before == 0.0:
            pytest.skip("the system does not tell")
        watch = Stopwatch()
        while watch.seconds().cpu < 0.1:
            pass
        assert doctor._busy_seconds() - before >= 0.05


class _SecondOfWork:
    """A watch that always says one second."""

    def seconds(self) -> Seconds:
        return Seconds(1.0, 1.0)
