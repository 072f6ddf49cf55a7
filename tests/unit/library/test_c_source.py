"""Exported C sources, compiled: they answer as the models do, whatever the constraints are like."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from samples import small_study

import vibench
from vibench.library import c_source
from vibench.library.export import export_model, exported
from vibench.library.reduced_model import Model as Exported
from vibench.model.chebyshev import AffinePolynomial, products
from vibench.qp.exact import exact_solution
from vibench.qp.verification import infeasibility_certificate

COMPILER = shutil.which("cc") or shutil.which("gcc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="NO C COMPILER (cc, gcc): exported C sources are not tested")

Answer = tuple[int, np.ndarray, np.ndarray, np.ndarray]
Solve = Callable[[np.ndarray], Answer]
STRICT = ("-std=c99", "-pedantic", "-O2", "-Wall", "-Wextra", "-Wshadow", "-Wstrict-prototypes", "-Werror")


def compiled(file: Path, unknowns: int, constraints: int) -> Solve:
    """The function of a C source: its code, x, α, residuals."""
    library = file.with_suffix(".so")
    done = subprocess.run(
        [str(COMPILER), *STRICT, "-shared", "-fPIC", "-o", library, file, "-lm"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    function = getattr(ctypes.CDLL(str(library)), f"{file.stem}_solve")
    pointer = ctypes.POINTER(ctypes.c_double)

    def solve(mu: np.ndarray) -> Answer:
        arrays = [np.ascontiguousarray(mu), np.zeros(unknowns), np.zeros(constraints), np.zeros(3)]
        return (function(*(array.ctypes.data_as(pointer) for array in arrays)), *arrays[1:])

    return solve


PROBLEMS = ["radial-obstacle", "obstacle"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> vibench.Run:
    problems = [{"name": name, "options": {"resolution": 150}} for name in PROBLEMS]
    study = small_study("small", problems, tolerances=[{"pod": [5e-2], "dual": [2e-1]}])
    return vibench.run(study, tmp_path_factory.mktemp("c") / "run", progress=False, jobs=1)


@pytest.fixture(scope="module", params=PROBLEMS)
def model(request: pytest.FixtureRequest, run: vibench.Run) -> vibench.Model:
    return run.model(run.cells.set_index("problem").loc[request.param, "cell"])


def test_a_c_source_gives_the_answers_of_the_model(model: vibench.Model, tmp_path: Path) -> None:
    export_model(model, tmp_path / "model.npz", tolerance=1e-11, c=True)
    script = Exported(tmp_path / "model.npz")
    A, _, _, g, _ = script.program(script.lower)
    solve = compiled(tmp_path / "model.c", len(A), len(g))
    for mu in model.parameters.sample(100, seed=3):
        code, x, alpha, residuals = solve(mu)
        assert code == 0
        assert residuals.max() <= 1e-12
        exact = exact_solution(model.reduced.assemble(mu).program)
        assert exact is not None
        assert np.linalg.norm(x - exact.x) <= 1e-9 * np.linalg.norm(exact.x)
        if exact.unique:
            assert np.linalg.norm(alpha - exact.alpha) <= 1e-9 * np.linalg.norm(exact.alpha)
        assert np.allclose(x, script.solve(mu).x, rtol=0.0, atol=1e-11 * np.abs(x).max())
    width = script.upper - script.lower
    assert [solve(mu)[0] & 16 for mu in (script.upper, script.upper + width, script.lower - width)] == [0, 16, 16]
    says = {0: "ok", 1: "inaccurate", 16: "outside", 17: "inaccurate", 18: "inaccurate", 19: "failed"}
    for far in (0.0, 0.1, 1.0, 1e3, 1e200):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert says[solve(script.upper + far * width)[0]] == script.solve(script.upper + far * width).status


def test_terms_that_a_problem_declares_are_exported_as_they_are(model: vibench.Model) -> None:
    found, declared = exported(model, bases=False), model.problem.affine
    assert set(declared) == ({"g"} if "B" in model.problem.constant else {"B", "g"})
    mu = model.parameters.sample(1, seed=5)[0]
    theta = {name: member.coefficients(mu) for name, member in declared.items()}
    unit = (mu - model.parameters.lower) / (model.parameters.upper - model.parameters.lower)
    for name in declared:
        terms = found.members[name].terms
        assert len(terms) == len(declared[name].terms)
        for q, term in enumerate(declared[name].terms):
            projected = model.reduced.generators.T @ (term if name == "g" else term @ model.reduced.basis)
            assert np.allclose(terms[q], np.ravel(projected), rtol=1e-12, atol=1e-15)
        assert np.allclose(
            products(found.members[name].indices, unit[None]) @ found.members[name].coefficients, theta[name]
        )


def linear(constant: np.ndarray, factors: dict[int, int], dimension: int) -> AffinePolynomial:
    """A constant, plus mu_k in the entry of every k: entry, on the box [−1, 1]^dimension."""
    indices, terms = [np.zeros(dimension, np.intp)], [constant.ravel()]
    for k, entry in factors.items():
        indices.append(np.eye(dimension, dtype=np.intp)[k])
        terms.append(np.eye(constant.size)[entry])
    return AffinePolynomial(np.array(indices), np.eye(len(terms)), np.array(terms), 0.0)


DEPENDENT = {
    "independent": np.array([[1.0, 0.2, 0.0], [0.0, -1.0, 0.4], [0.3, 0.0, 1.0]]),
    "more constraints than unknowns": np.random.default_rng(5).standard_normal((9, 3)),
    "repeated and scaled": np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1e3, 1e3, 0.0], [0.0, 1e-4, 1.0]]),
    "equalities": np.array([[1.0, 0.5, 0.0], [-1.0, -0.5, 0.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]]),
    "a sum of two others": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [2.0, 1.0, 0.0]]),
    "a row of zeros": np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]),
}


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
@pytest.mark.parametrize("case", DEPENDENT)
def test_any_constraints(case: str, scale: float, tmp_path: Path) -> None:
    """f and g are the parameters: one source solves many programs, degenerate and contradictory ones among them."""
    B = DEPENDENT[case]
    count, n = B.shape
    factor = np.random.default_rng(1).standard_normal((n, n))
    A = scale * (factor @ factor.T + 0.1 * np.eye(n))
    dimension = n + count
    members = {
        "A": linear(A[np.triu_indices(n)], {}, dimension),
        "f": linear(np.zeros(n), {k: k for k in range(n)}, dimension),
        "B": linear(B, {}, dimension),
        "g": linear(np.zeros(count), {n + k: k for k in range(count)}, dimension),
    }
    about = {
        "parameters": {"names": ["*/ evil \\"] * dimension, "units": ["1"] * dimension},
        "cell": {"problem": "*/", "dual": "??/", "primal": "é", "cell": "0"},
        "source": {"distribution": "none", "licence": "MIT"},
        "exported_by": "a test",
        "accuracy": 1e-9,
    }
    arrays = {"lower": -np.ones(dimension), "upper": np.ones(dimension)}
    (tmp_path / "case.c").write_text(c_source.source(members, arrays, about, "case"), encoding="utf-8")
    solve = compiled(tmp_path / "case.c", n, count)
    random = np.random.default_rng(2)
    codes = []
    for trial in range(300):
        mu = random.uniform(-1.0, 1.0, dimension)
        mu[random.random(dimension) < 0.2] = 0.0
        if trial % 2:  # a point satisfies all constraints, many of them as equations
            mu[n:] = np.clip(B @ random.uniform(-1e-4, 1e-4, n) + random.choice([0.0, 0.05], count), -1.0, 1.0)
        code, x, alpha, residuals = solve(mu)
        codes.append(code)
        program = vibench.VariationalInequality(A, mu[:n], B, mu[n:])
        exact = exact_solution(program)
        if infeasibility_certificate(program) is not None:
            assert code == 2
        elif exact is not None:
            assert code == 0
            assert residuals.max() <= 1e-9
            assert np.linalg.norm(x - exact.x) <= 1e-9 * max(np.linalg.norm(exact.x), np.linalg.norm(mu[:n]) / scale)
            assert np.min(alpha, initial=0.0) >= 0.0
            assert np.allclose(B.T @ alpha, B.T @ exact.alpha, rtol=0.0, atol=1e-8 * (1.0 + scale))
    assert codes.count(0) > 100
    assert set(codes) <= {0, 2}


def test_matrices_that_are_not_positive_definite_fail(tmp_path: Path) -> None:
    one = {name: linear(np.array([value]), {}, 1) for name, value in zip("AfBg", (-1.0, 1.0, 1.0, 1.0), strict=True)}
    about = {
        "parameters": {"names": ["t"], "units": ["1"]},
        "cell": dict.fromkeys(("problem", "dual", "primal", "cell"), ""),
        "source": {"distribution": "", "licence": ""}, "exported_by": "", "accuracy": 1e-9,
    }  # fmt: skip
    text = c_source.source(one, {"lower": np.zeros(1), "upper": np.ones(1)}, about, "9-lives")
    (tmp_path / "model_9_lives.c").write_text(text, encoding="utf-8")
    assert compiled(tmp_path / "model_9_lives.c", 1, 1)(np.array([0.5]))[0] == 3
