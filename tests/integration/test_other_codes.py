"""Models of other codes: the examples are exported by these codes' own programs, where they are installed."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from samples import pga_reduction

import vibench
from vibench_problems.elliptic_contact import elliptic_contact

EXAMPLES = Path(__file__).parents[2] / "examples"
PYTHON = "/usr/bin/python3"

SIZE = 677
"""Number of nodes of vibench's own mesh, about that of FreeFEM's."""


def skip_without(code: str, there: bool) -> None:
    if not there:
        assert "VIBENCH_NEEDS_OTHER_CODES" not in os.environ, f"{code} is not installed"
        pytest.skip(f"{code} is not installed")


def exported(folder: Path, example: str, *command: str) -> Path:
    """A copy of an example, in which its script has written the arrays of the pack."""
    shutil.copytree(EXAMPLES / example, folder / example)
    subprocess.run(command, cwd=folder / example, check=True, capture_output=True, timeout=300)
    return folder / example


@pytest.fixture(scope="module")
def freefem(tmp_path_factory: pytest.TempPathFactory) -> Path:
    skip_without("FreeFEM", shutil.which("FreeFem++") is not None)
    command = ("FreeFem++", "-nw", "obstacle.edp", "obstacle", "6")
    return exported(tmp_path_factory.mktemp("freefem"), "freefem", *command)


@pytest.fixture(scope="module")
def getfem(tmp_path_factory: pytest.TempPathFactory) -> Path:
    there = subprocess.run([PYTHON, "-c", "import getfem"], capture_output=True, check=False).returncode == 0
    skip_without("GetFEM", there)
    return exported(tmp_path_factory.mktemp("getfem"), "getfem", PYTHON, "hertz.py", "hertz", "80")


def export_from_freefem(folder: Path, model: str, size: str) -> None:
    command = ["FreeFem++", "-nw", f"{model}.edp", model, size]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=300)


def certified_model(pack: vibench.Problem) -> vibench.Model:
    return pga_reduction(pack, 1e-2, 1e-2, assembly="reduced", bounds=True).model


def run(example: Path, monkeypatch: pytest.MonkeyPatch) -> vibench.Run:
    monkeypatch.chdir(example)
    text = (EXAMPLES / example.name / "study.toml").read_text(encoding="utf-8")
    fewer = {"resolution = 1189": f"resolution = {SIZE}", '"cpg", "mcpg"': '"mcpg"', '"online-supremizers", ': ""}
    for whole, part in fewer.items():
        text = text.replace(whole, part)
    (example / "study.toml").write_text(f"timing_rounds = 1\n{text}", encoding="utf-8")
    return vibench.run(vibench.read_study("study.toml"), progress=False, jobs=1)


def test_freefem_and_the_built_in_problem_have_the_same_solutions(freefem: Path) -> None:
    """Up to what two meshes of this width differ by."""
    pack = vibench.create("problem", "pack", {"path": str(freefem / "obstacle")})
    ours = vibench.create("problem", "obstacle", {"resolution": SIZE})
    for mu in pack.validation_set(4, 0):
        found = [vibench.HighFidelitySolver(problem).solve(mu) for problem in (pack, ours)]
        energy = [solution.u @ (p.assemble(mu).A @ solution.u) for p, solution in zip((pack, ours), found, strict=True)]
        force = [p.multiplier_integrals() @ solution.lam for p, solution in zip((pack, ours), found, strict=True)]
        assert energy[0] == pytest.approx(energy[1], rel=0.02)
        assert force[0] == pytest.approx(force[1], rel=0.05)


@pytest.mark.long
def test_the_model_of_freefem_runs_through_the_matrix(freefem: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = run(freefem, monkeypatch)
    cells = found.cells
    assert len(cells) == 4
    assert set(cells["status"]) == {"ok"}
    theirs, ours = (cells[cells["problem"] == label].set_index(["dual", "primal"]) for label in ("FreeFEM", "vibench"))
    assert (abs(theirs["N"] - ours["N"]) <= 2).all()
    # Generators are snapshots themselves; a mesh without any symmetry needs more of them than a perturbed one.
    assert (theirs["R"] / ours["R"]).between(0.5, 2.0).all()
    constants = found.queries.groupby("problem")["beta_hf_span"].min()
    assert constants["FreeFEM"] == pytest.approx(constants["vibench"], rel=0.1)


@pytest.mark.long
def test_the_signorini_problem_of_freefem_has_a_certified_model(freefem: Path) -> None:
    """All of its members are declared: bounds rest on nothing else, of the solution and of the corrected pair."""
    export_from_freefem(freefem, "signorini", "8")  # fmt: skip
    pack = vibench.create("problem", "pack", {"path": str(freefem / "signorini")})
    model = certified_model(pack)
    solver, in_contact = vibench.HighFidelitySolver(pack), 0
    for mu in pack.parameters.sample(12, 7):
        exact, A = solver.solve(mu), pack.assemble(mu).A
        in_contact += bool(exact.lam.any())
        for corrected in (False, True):
            found = model.solve(mu, corrected=corrected)
            assert found.bound.guarantee == "certified"
            error = np.sqrt((exact.u - found.u) @ (A @ (exact.u - found.u)))
            assert 1e-6 * np.sqrt(exact.u @ (A @ exact.u)) < error <= found.bound.u_energy
    assert in_contact >= 6


@pytest.mark.long
def test_a_block_in_space_of_freefem_has_the_pressure_of_uniform_compression(freefem: Path) -> None:
    """On a flat foundation that is E times depth over height, whatever Poisson's ratio; a curved one leaves the block.

    Its models are certified, as all members are declared.
    """
    export_from_freefem(freefem, "block", "3")
    pack = vibench.create("problem", "pack", {"path": str(freefem / "block")})
    solver = vibench.HighFidelitySolver(pack)
    for poisson in (0.2, 0.4):
        np.testing.assert_allclose(solver.solve(np.array([poisson, 0.015, 0.0, 0.0])).lam, 0.015, rtol=1e-10)
    curved = solver.solve(np.array([0.3, 0.015, 0.05, 0.02]))
    assert 0 < np.count_nonzero(curved.lam) < len(curved.lam)
    model = certified_model(pack)
    for mu in pack.parameters.sample(4, 7):
        exact, A, found = solver.solve(mu), pack.assemble(mu).A, model.solve(mu)
        assert found.bound.guarantee == "certified"
        assert np.sqrt((exact.u - found.u) @ (A @ (exact.u - found.u))) <= found.bound.u_energy


def test_friction_of_freefem_is_that_of_uniform_shear(freefem: Path) -> None:
    """Where its bound is even, the traction is the shear modulus times the shift, or that bound; else parts slip."""
    export_from_freefem(freefem, "tresca", "6")
    pack = vibench.create("problem", "pack", {"path": str(freefem / "tresca")})
    solver = vibench.HighFidelitySolver(pack)
    for shift, bound in ((0.6, 1.2), (0.6, 0.8), (1.3, 0.9)):
        lam = solver.solve(np.array([shift, bound, 0.0])).lam
        np.testing.assert_allclose(lam, -min(shift / bound, 1.0), rtol=1e-10)
    partly = solver.solve(np.array([0.9, 1.0, 0.4])).lam
    assert 0 < np.count_nonzero(partly == -1.0) < len(partly)
    # A study names nothing else: its strategies serve the friction.
    section = vibench.create("dual strategy", "pod-dual"), vibench.create("primal strategy", "online-supremizers")
    model = vibench.Reduction(pack, *section, vibench.Stop(1e-4), vibench.Stop(1e-3)).model
    for mu in pack.parameters.sample(4, 7):
        exact, found = solver.solve(mu), model.solve(mu)
        assert pack.W.norm(exact.lam - found.lam) <= 0.02 * pack.W.norm(exact.lam)


@pytest.mark.long
def test_a_half_space_of_getfem_agrees_with_hertz(getfem: Path) -> None:
    """The force of an elliptic contact, up to what four cells along the zone and far faces that do not move cost."""
    subprocess.run([PYTHON, "paraboloid.py", "paraboloid", "4"], cwd=getfem, check=True, timeout=300)
    pack = vibench.create("problem", "pack", {"path": str(getfem / "paraboloid")})
    solver = vibench.HighFidelitySolver(pack)
    for mu in np.array([[1.0, 1.0, 0.00125, 0.3], [1.3, 0.8, 0.0014, 0.25]]):
        force = 4.0 * pack.multiplier_integrals() @ solver.solve(mu).lam
        assert force == pytest.approx(elliptic_contact(*mu[:3], 1.0 / (1.0 - mu[3] ** 2)).force, rel=0.07)


@pytest.mark.long
def test_the_model_of_getfem_agrees_with_hertz(getfem: Path) -> None:
    """Half-width a = √(4PR*/(πE*)) and peak 2P/(πa) of a line contact, by a fit of p² against x² in the contact."""
    pack = vibench.create("problem", "pack", {"path": str(getfem / "hertz")})
    x, solver = np.load(getfem / "hertz" / "vectors.npz")["x"], vibench.HighFidelitySolver(pack)
    for radius in (0.7, 1.0, 1.3):
        pressure = solver.solve(np.array([radius, 0.02])).lam
        force = 2.0 * pack.multiplier_integrals() @ pressure
        half_width = np.sqrt(4.0 * force / (1.0 + 1.0 / radius) / (np.pi * 15.0 / (1.0 - 0.35**2)))
        inside = x < 0.85 * half_width
        slope, peak = np.polyfit(x[inside] ** 2, pressure[inside] ** 2, 1)
        assert np.sqrt(peak) == pytest.approx(2.0 * force / (np.pi * half_width), rel=0.02)
        assert np.sqrt(-peak / slope) == pytest.approx(half_width, rel=0.03)


@pytest.mark.long
def test_the_model_of_getfem_runs_through_the_matrix(getfem: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cells = run(getfem, monkeypatch).cells
    assert len(cells) == 2
    assert set(cells["status"]) == {"ok"}
    assert (cells[cells["primal"] != "decorrelated"]["error_lambda_mean"] < 0.05).all()
