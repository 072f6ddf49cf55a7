import ctypes
import re
import shutil
import subprocess
import warnings
from collections.abc import Callable
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg
from samples import pga_reduction, small_study, with_ways

import vibench
from vibench import AffineProblem, Output, export_model
from vibench.library import reduced_model
from vibench.library.reduced_model import Model as Exported
from vibench.model.certificates import contact_correction as complementarity
from vibench.model.certificates.base import Guarantee
from vibench.model.chebyshev import AffinePolynomial
from vibench.offline import c_source
from vibench.qp.exact import exact_solution
from vibench.qp.verification import infeasibility_certificate, kkt_residuals
from vibench_problems.american_put import Put
from vibench_problems.hertz import Hertz

COMPILER = shutil.which("cc") or shutil.which("gcc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="NO C COMPILER (cc, gcc): exported C sources are not tested")

Answer = tuple[int, np.ndarray, np.ndarray, np.ndarray]
Solve = Callable[[np.ndarray], Answer]
POINTER = ctypes.POINTER(ctypes.c_double)
Patch = pytest.MonkeyPatch
# A compiler has this dialect, or a later one, without options: its math.h declares more names.
PLAIN = ("-std=gnu99", "-pedantic", "-Wall", "-Wextra", "-Wshadow", "-Wstrict-prototypes", "-Werror")
STRICT = ("-std=c99", *PLAIN[1:], "-O2")
"""An optimising compiler sees more, and takes three times as long: once for every part of a source."""


def library(file: Path, strict: tuple[str, ...] = STRICT) -> ctypes.CDLL:
    command = [str(COMPILER), *strict, "-shared", "-fPIC", "-o", file.with_suffix(".so"), file, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(file.with_suffix(".so")))


def pointers(*arrays: np.ndarray) -> list[Any]:
    return [array.ctypes.data_as(POINTER) for array in arrays]


def compiled(file: Path, unknowns: int, constraints: int, strict: tuple[str, ...] = PLAIN) -> Solve:
    function = getattr(library(file, strict), f"{file.stem}_solve")

    def solve(mu: np.ndarray) -> Answer:
        arrays = [np.ascontiguousarray(mu), np.zeros(unknowns), np.zeros(constraints), np.zeros(3)]
        return (function(*pointers(*arrays)), *arrays[1:])

    return solve


PROBLEMS = ["radial-obstacle", pytest.param("obstacle", marks=pytest.mark.long)]


@pytest.fixture(scope="module", params=[*PROBLEMS, "american-put"])
def model(request: pytest.FixtureRequest, small_run: vibench.Run) -> vibench.Model:
    if request.param == "american-put":
        return reduced_from(Put(100), "offline-pga", training=None)
    return model_of(small_run, request.param, "reduced")


def model_of(run: vibench.Run, problem: str, assembly: str) -> vibench.Model:
    cells = with_ways(run.cells).set_index(["primal", "problem", "assembly"])
    return run.model(str(cells.loc[("decorrelated", problem, assembly), "cell"]))


def test_a_c_source_gives_the_answers_of_the_model(model: vibench.Model, tmp_path: Path) -> None:
    export_model(model, tmp_path / "model.npz", tolerance=1e-11, c=True)
    script = Exported(tmp_path / "model.npz")
    A, _, _, g, _ = script.program(script.lower)
    solve = compiled(tmp_path / "model.c", len(A), len(g), STRICT)
    for mu in model.parameters.sample(100, seed=3):
        code, x, alpha, residuals = solve(mu)
        assert code == 0
        assert residuals.max() <= 1e-12
        exact = exact_solution(model.reduced.assemble(mu).program)
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
    if model.certificate is not None:
        certified, *_ = certify(model, tmp_path / "certified" / "model.npz", tolerance=1e-13)
        assert_certified_alike(model, certified, (2e-9,) * 4, 1e-9, bounded=True)


Certify = Callable[[np.ndarray, bool], tuple[int, np.ndarray, np.ndarray, np.ndarray]]


def certify(model: vibench.Model, file: Path, tolerance: float) -> tuple[Certify, Any, ctypes.CDLL]:
    """The C source of a model: the code, u, λ and four bounds at a parameter, corrected or not; what it is made of."""
    whole = export_model(model, file, tolerance=tolerance, evaluations=6000, c=True)
    arrays, found = whole.arrays, library(file.with_suffix(".c"), PLAIN)
    rows, basis, loads = len(arrays["generators"]), arrays["basis"], arrays["certificate_lift"].shape[1]
    found.model_of_contact.restype = ctypes.c_double

    def certified(mu: np.ndarray, corrected: bool) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
        x, alpha, residuals = np.zeros(basis.shape[1]), np.zeros(arrays["generators"].shape[1]), np.zeros(3)
        lam, shift, bounds = np.full(rows, np.nan), np.full(loads, np.nan), np.full(3, np.nan)
        assert found.model_solve(*pointers(mu, x, alpha, residuals)) in {0, 16}
        code = found.model_certify(*pointers(mu, x, alpha), int(corrected), *pointers(lam, shift, bounds))
        bounds = np.append(bounds, found.model_of_contact(*pointers(mu, alpha, lam, bounds)))
        return code, basis @ x - arrays["certificate_lift"] @ shift, lam, bounds

    return certified, whole, found


def assert_bounded(model: vibench.Model, mu: np.ndarray, u: np.ndarray, lam: np.ndarray, bounds: np.ndarray) -> None:
    exact, vi = model.high_fidelity(mu), model.problem.assemble(mu)
    away, force = exact.u - u, vi.B.T @ (exact.lam - lam)
    assert float(away @ (vi.A @ away)) <= bounds[0] ** 2
    assert float(force @ scipy.sparse.linalg.spsolve(vi.A.tocsc(), force)) <= bounds[1] ** 2


def test_errors_of_polynomials_are_in_the_bounds(tmp_path: Path) -> None:
    """A model whose own error is smaller than what its coarse polynomials miss."""
    problem = [{"name": "obstacle", "options": {"resolution": 150}}]
    tolerances = [{"pod": [1e-6], "dual": [1e-4]}]
    study = small_study("tight", problem, assembly=["reduced"], bounds=[True], tolerances=tolerances)
    model = model_of(vibench.run(study, tmp_path / "run", progress=False, jobs=1), "obstacle", "certified")
    certified, whole, _ = certify(model, tmp_path / "model.npz", tolerance=1e-2)
    arrays = whole.arrays
    assert arrays["certificate_energy_error"] > 0.0
    assert arrays["certificate_load_error"] > model.certificate.base.load_error
    assert arrays["certificate_stiffness_error"] > model.certificate.base.stiffness_error
    for mu in model.parameters.sample(20, seed=5):
        code, u, lam, bounds = certified(mu, False)
        assert code == 0
        assert_bounded(model, mu, u, lam, bounds)
        assert bounds[2] < 10.0


class Expressed(AffineProblem):
    """A string whose members are sums with expressions: no code of the problem is needed at a parameter."""

    parameters = vibench.ParameterBox(("a", "b"), np.array([0.5, -1.0]), np.array([2.0, 1.0]), ("1", "1"))

    def __init__(self) -> None:
        n, rng = 24, np.random.default_rng(3)
        K = sp.diags_array([-np.ones(n - 1), 2.0 * np.ones(n), -np.ones(n - 1)], offsets=(-1, 0, 1)) * (n + 1.0)
        M = sp.eye_array(n) / (n + 1.0)
        self.V = vibench.InnerProduct(sp.csc_array(K + M))
        self.W = vibench.InnerProduct(sp.eye_array(6, format="csc"))
        B = np.zeros((6, n))
        B[np.arange(6), np.arange(9, 15)] = -1.0
        B = B + 0.1 * np.abs(rng.standard_normal(B.shape)) * (B != 0.0)
        f, g = np.full(n, -3.0 / (n + 1.0)), np.full(6, 0.02)
        self.declare(
            A=[("1 + max(0.1, abs(b)) * a**1.5", K), ("sqrt(a) + atan2(b, 2 * a)", M)],
            f=[("exp(-a) * cos(pi * b) + 2", f), (0.5, f)],
            B=[("1 + sin(a * b)**2", B)],
            g=[("log(2 + a)", g), ("-min(0, b, a - 1) / e", g)],
        )

    def training_set(self) -> np.ndarray:
        return self.parameters.grid(4, 4)


def assert_certified_alike(
    model: vibench.Model, certified: Certify, tolerances: tuple[float, ...], of_u: float, bounded: bool = False
) -> None:
    """The C source has the bounds and the pair of the model, corrected or not; `bounded` compares with the truth."""
    for mu, corrected in product(model.parameters.sample(20, seed=5), (False, True)):
        own = model.solve(mu, accuracy=1e-13, corrected=corrected)
        assert own.answer.is_corrected is corrected
        code, u, lam, bounds = certified(mu, corrected)
        assert code == 0
        assert np.linalg.norm(u - own.u) <= of_u * np.linalg.norm(own.u)
        assert np.linalg.norm(lam - own.lam) <= 1e-9 * np.linalg.norm(own.lam)
        beside = model.solve(mu, accuracy=1e-13, corrected=corrected, of="contact").bound.relative
        proved = own.bound.u_energy, own.bound.lambda_natural, own.bound.relative, beside
        for number, (bound, expected, rel) in enumerate(zip(bounds, proved, tolerances, strict=True)):
            assert bound == pytest.approx(expected, rel=rel), number
        if bounded:
            assert_bounded(model, mu, u, lam, bounds)


def test_expressions_are_exact_in_c_and_bounds_are_certified(tmp_path: Path) -> None:
    """The same numbers as those of vibench to round-off, though no polynomial of the file reaches that."""
    model = pga_reduction(Expressed(), 1e-1, 1e-1, tolerance=0.3, assembly="reduced", bounds=True).model
    assert model.certificate.base.guarantee is Guarantee.CERTIFIED
    certified, whole, _ = certify(model, tmp_path / "model.npz", tolerance=1e-2)
    assert set(whole.exact) == {*"AfBg", "theta_A", "theta_f", "theta_B", "theta_g"}
    assert whole.about["certificate"] == "certified"
    assert whole.error > 1e-8
    assert "the bounds are\n * certified" in (tmp_path / "model.h").read_text()
    assert_certified_alike(model, certified, (1e-7,) * 4, 1e-10, bounded=True)


@pytest.mark.parametrize("problem", PROBLEMS)
def test_a_c_source_has_its_bounds(problem: str, small_run: vibench.Run, tmp_path: Path, monkeypatch: Patch) -> None:
    model = model_of(small_run, problem, "certified")
    rng, sizes = np.random.default_rng(0), (model.problem.V.dim, model.problem.W.dim)
    outputs = (
        Output("load", "N", u=rng.random(sizes[0])),
        Output("squared", "1", function=lambda _mu, u, _lam: float(u @ u)),
        Output("force */", "N", lam=model.problem.W.apply(np.ones(sizes[1]))),
        Output("both", "1", u=rng.standard_normal(sizes[0]), lam=rng.standard_normal(sizes[1])),
    )
    monkeypatch.setattr(type(model.problem), "outputs", outputs)
    certified, whole, found = certify(model, tmp_path / "model.npz", tolerance=2e-13)
    # The last two bounds have the error of sizes, too.
    assert_certified_alike(model, certified, (1e-9, 1e-9, 2e-9, 2e-9), 1e-9)
    assert certified(model.parameters.upper, corrected=True)[0] == 0
    code, u, lam, bounds = certified(model.parameters.upper * 1.001, corrected=True)
    assert code == 4
    assert np.all(bounds == np.inf)
    assert np.all(np.isfinite(u))
    assert lam.min() >= 0.0
    data, written = whole.arrays, whole.about["outputs"]
    assert written["left_out"] == ["squared"]
    names = [output["name"] for output in written["linear"]]
    assert names == ["load", "force */", "both"]
    script = Exported(tmp_path / "model.npz")
    x, alpha, residuals = np.zeros(data["basis"].shape[1]), np.zeros(data["generators"].shape[1]), np.zeros(3)
    lam, shift = (np.zeros(len(data[name])) for name in ("generators", "certificate_rows"))
    bounds, values, errors, plain = (np.zeros(3) for _ in range(4))
    for mu in model.parameters.sample(10, seed=5):
        exact = model.high_fidelity(mu)
        truth = [float(one.values(mu[None], exact.u[:, None], exact.lam[:, None])[0]) for one in outputs]
        for corrected in (False, True):
            own = model.solve(mu, accuracy=1e-13, corrected=corrected)
            assert own.output_bounds["squared"] == np.inf
            assert own.outputs["squared"] == pytest.approx(own.u @ own.u)
            expected = np.array([own.outputs[name] for name in names])
            proved = np.array([own.output_bounds[name] for name in names])
            assert np.all(np.abs(expected - np.delete(truth, 1)) <= proved)
            assert np.all(proved < np.inf)
            found.model_solve(*pointers(mu, x, alpha, residuals))
            assert found.model_certify(*pointers(mu, x, alpha), int(corrected), *pointers(lam, shift, bounds)) == 0
            found.model_certified_outputs(*pointers(mu, x, lam, shift, bounds, values, errors))
            scale = np.abs(expected).max()
            assert values == pytest.approx(expected, rel=1e-9, abs=1e-9 * scale)
            assert errors == pytest.approx(proved, rel=1e-9)
            if not corrected:
                found.model_outputs(*pointers(x, alpha, plain))
                assert plain == pytest.approx(values, rel=1e-12, abs=1e-12 * scale)
                answer = script.solve(mu).outputs
                assert list(answer) == names
                assert list(answer.values()) == pytest.approx(plain, abs=1e-12 * scale)
    outside = script.lower - 1.0
    assert found.model_certify(*pointers(outside, x, alpha), 0, *pointers(lam, shift, bounds)) == 4
    found.model_certified_outputs(*pointers(outside, x, lam, shift, bounds, values, errors))
    assert np.all(errors == np.inf)


def test_either_a_certificate_or_outputs(small_run: vibench.Run, tmp_path: Path, monkeypatch: Patch) -> None:
    for assembly in ("certified", "reduced"):
        model = model_of(small_run, "radial-obstacle", assembly)
        outputs = (Output("s", "1", u=np.ones(model.problem.V.dim)),) if assembly == "reduced" else ()
        monkeypatch.setattr(type(model.problem), "outputs", outputs)
        folder = tmp_path / assembly
        found = export_model(model, folder / "model.npz", c=True)
        library(folder / "model.c")
        text = (folder / "model.h").read_text()
        assert ("model_outputs(" in text, "model_certify(" in text) == (bool(outputs), not outputs)
        solution = model.solve(model.parameters.lower)
        assert solution.output_bounds == dict.fromkeys([one.name for one in outputs], np.inf)
        assert Exported(folder / "model.npz").solve(model.parameters.lower).outputs == pytest.approx(solution.outputs)
        assert ("outputs_x" in found.arrays) == bool(outputs)


@pytest.mark.parametrize("steps", [30, 0])  # after these sets change by one number at a time
def test_the_correction_in_c_is_that_of_vibench(steps: int, tmp_path: Path) -> None:
    size, zeros = 8, np.zeros(8)
    folder = files("vibench.offline") / "templates"
    text = (folder / "reduced_model_certificate.c.template").read_text(encoding="utf-8")
    basic = (folder / "reduced_model.c.template").read_text(encoding="utf-8")
    parts = [
        f"#include <float.h>\n#include <math.h>\n#include <string.h>\nenum {{ LARGEST = {size}, STEPS = {steps} }};\n",
        basic[basic.index("#define SUM(") : basic.index("/* Whether all numbers are finite")],
        text[text.index("/* out of M_kk") : text.index("/* A w with B w >= s")].replace("static", ""),
    ]
    (tmp_path / "part.c").write_text("".join(parts), encoding="utf-8")
    found = library(tmp_path / "part.c", strict=())
    flag = ctypes.POINTER(ctypes.c_int)
    found.complement.argtypes = [POINTER, POINTER, ctypes.c_int, ctypes.c_double, POINTER, POINTER, flag, POINTER]
    for seed in range(80):
        rng = np.random.default_rng(seed)
        Q = np.linalg.qr(rng.standard_normal((size, size)))[0]
        M, excess = Q @ np.diag(np.geomspace(1.0, 1e3, size)) @ Q.T, rng.standard_normal(size)
        M = 0.5 * (M + M.T)
        compliance, fixed, nu = np.linalg.inv(M), M @ excess, np.zeros(size)
        expected = complementarity.complementary(fixed, M.__getitem__, excess <= 0.0)
        for start, inverse in product((excess <= 0.0, np.zeros(size), np.ones(size)), (pointers(M)[0], None)):
            flags = (ctypes.c_int * size)(*map(int, start))
            assert found.complement(
                inverse, *pointers(compliance), size, 1.0, *pointers(excess, zeros), flags, *pointers(nu)
            )
            assert nu == pytest.approx(expected, abs=1e-9 * np.abs(fixed).max())


PRIMAL = {"offline-pga": 0.5, "online-supremizers": None}
"""Strategies of a fixed space, and of another one at every parameter, and their tolerances."""


def reduced_from(problem: vibench.Problem, primal: str, **others: Any) -> vibench.Model:
    few = vibench.create("sampling strategy", "random", {"size": 12, "seed": 1})
    given = {"tolerance": PRIMAL[primal], "training": few, "assembly": "reduced", "bounds": True} | others
    return pga_reduction(problem, 1e-1, 1e-2, primal=primal, **given).model


@pytest.mark.parametrize("primal", PRIMAL)
def test_constraints_in_the_code_of_a_problem_have_c_programs_with_bounds(primal: str, tmp_path: Path) -> None:
    model = reduced_from(Hertz(300), primal)
    certified, whole, found = certify(model, tmp_path / "model.npz", tolerance=1e-11)
    assert (whole.about["certificate"], set(whole.members)) == ("certified", {"A", "f"})
    assert not (tmp_path / "reduced_model.py").exists()
    with pytest.raises(ValueError, match="is no vibench reduced model 1"):
        Exported(tmp_path / "model.npz")
    assert_certified_alike(model, certified, (2e-9,) * 4, 1e-9)
    arrays = whole.arrays
    x, alpha, residuals = np.zeros(arrays["basis"].shape[1]), np.zeros(arrays["generators"].shape[1]), np.zeros(3)
    shift = np.zeros(arrays["certificate_lift"].shape[1])
    lam, bounds = np.zeros(model.problem.W.dim), np.zeros(3)
    names = [output["name"] for output in whole.about["outputs"]["linear"]]
    values, errors = np.zeros((2, len(names)))
    for mu, corrected in product(model.parameters.sample(10, seed=3), (False, True)):
        own = model.solve(mu, accuracy=1e-13, corrected=corrected)
        assert found.model_solve(*pointers(mu, x, alpha, residuals)) == 0
        assert residuals.max() <= 1e-12
        assert found.model_certify(*pointers(mu, x, alpha), int(corrected), *pointers(lam, shift, bounds)) == 0
        found.model_certified_outputs(*pointers(mu, x, lam, shift, bounds, values, errors))
        assert values == pytest.approx([own.outputs[name] for name in names], rel=1e-9)
        assert errors == pytest.approx([own.output_bounds[name] for name in names], rel=2e-9)
    for wrong in (np.nan, np.inf, 1e-3):  # at the last one the body is too small
        mu[0] = wrong
        assert found.model_solve(*pointers(mu, x, alpha, residuals)) == 19
        assert np.isnan([*x, *alpha, *residuals]).all()
        given = pointers(mu, np.ones_like(x), np.ones_like(alpha))
        assert found.model_certify(*given, 0, *pointers(lam, shift, bounds)) == 4
        assert np.all(bounds == np.inf)


class Turning(Expressed):
    """The same with a B of two terms, whose supremizers span another space at every parameter."""

    def __init__(self) -> None:
        super().__init__()
        B = self.affine["B"].terms[0]
        members = {**self.affine, "B": [("1 + a", B), ("b", sp.csr_array(np.roll(B.toarray(), 1, axis=1)))]}
        self.declare(**members)


def test_spaces_that_change_with_the_parameter_have_c_programs(tmp_path: Path) -> None:
    model = pga_reduction(Turning(), 1e-1, 1e-1, primal="online-supremizers", tolerance=None, assembly="reduced").model
    assert model.reduced.space is not None
    arrays = export_model(model, tmp_path / "model.npz", c=True, tolerance=1e-2).arrays
    solve = compiled(tmp_path / "model.c", arrays["basis"].shape[1], arrays["generators"].shape[1])
    for mu in model.parameters.sample(20, seed=3):
        code, x, alpha, residuals = solve(mu)
        reduced = model.reduced.assemble(mu)
        exact = exact_solution(reduced.program)
        u = reduced.reconstruct(exact.x[:, None])[:, 0]
        assert (code, residuals.max() <= 1e-12) == (0, True)
        assert np.linalg.norm(arrays["basis"] @ x - u) <= 1e-9 * np.linalg.norm(u)
        assert np.linalg.norm(alpha - exact.alpha) <= 1e-9 * np.linalg.norm(exact.alpha)


def linear(constant: np.ndarray, factors: dict[int, int], dimension: int) -> AffinePolynomial:
    """A constant, plus mu_k in the entry of every k: entry, on the box [−1, 1]^dimension."""
    indices, terms = [np.zeros(dimension, np.intp)], [constant.ravel()]
    for k, entry in factors.items():
        indices.append(np.eye(dimension, dtype=np.intp)[k])
        terms.append(np.eye(constant.size)[entry])
    return AffinePolynomial(np.array(indices), np.eye(len(terms)), np.array(terms), 0.0, 1.0)


DEPENDENT = {
    "independent": np.array([[1.0, 0.2, 0.0], [0.0, -1.0, 0.4], [0.3, 0.0, 1.0]]),
    "more constraints than unknowns": np.random.default_rng(5).standard_normal((9, 3)),
    "repeated and scaled": np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1e3, 1e3, 0.0], [0.0, 1e-4, 1.0]]),
    "equalities": np.array([[1.0, 0.5, 0.0], [-1.0, -0.5, 0.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]]),
    "a sum of two others": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [2.0, 1.0, 0.0]]),
    "a row of zeros": np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]),
}


def about(names: list[str], **cell: str) -> dict[str, Any]:
    of_cell, source = dict.fromkeys(("problem", "dual", "primal", "cell"), "") | cell, ("distribution", "licence")
    words = {"parameters": {"names": names, "units": ["1"] * len(names)}, "cell": of_cell, "exported_by": "a test"}
    return words | {"source": dict.fromkeys(source, "MIT"), "accuracy": 1e-9}


@pytest.mark.parametrize("scale", [1e-6, pytest.param(1e6, marks=pytest.mark.long)])
@pytest.mark.parametrize("case", DEPENDENT)
def test_any_constraints(case: str, scale: float, tmp_path: Path) -> None:
    """One source solves many programs, degenerate and contradictory ones among them: f and g are the parameters."""
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
    words = about(["*/ evil \\"] * dimension, problem="*/", dual="??/", primal="é")
    arrays = {"lower": -np.ones(dimension), "upper": np.ones(dimension)}
    (tmp_path / "case.c").write_text(c_source.source(members, arrays, words, "case")[0], encoding="utf-8")
    solve = compiled(tmp_path / "case.c", n, count)
    random, codes = np.random.default_rng(2), []
    for trial in range(200):
        mu = random.uniform(-1.0, 1.0, dimension)
        mu[random.random(dimension) < 0.2] = 0.0
        if trial % 2:  # a point satisfies all constraints, many of them as equations
            mu[n:] = np.clip(B @ random.uniform(-1e-4, 1e-4, n) + random.choice([0.0, 0.05], count), -1.0, 1.0)
        code, x, alpha, residuals = solve(mu)
        codes.append(code)
        program = vibench.VariationalInequality(A, mu[:n], B, mu[n:])
        exact = exact_solution(program)
        if exact is None:
            assert code == 2 or infeasibility_certificate(program) is None
        else:
            assert code == 0
            assert residuals.max() <= 1e-9
            assert np.linalg.norm(x - exact.x) <= 1e-9 * max(np.linalg.norm(exact.x), np.linalg.norm(mu[:n]) / scale)
            assert np.min(alpha, initial=0.0) >= 0.0
            assert np.allclose(B.T @ alpha, B.T @ exact.alpha, rtol=0.0, atol=1e-8 * (1.0 + scale))
    assert codes.count(0) > 67
    assert set(codes) <= {0, 2}


@pytest.mark.parametrize("share", [1.0, 0.99, 0.0])  # of the forces of contact
def test_loaded_ties_hide_no_contact_from_c_and_scripts(share: float, tmp_path: Path) -> None:
    """A body in contact beside one that opposite rows hold against 1e4 times its load, in a common basis."""
    rng = np.random.default_rng(0)
    Q = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    A = sp.block_diag([[[2.0, -1.0], [-1.0, 3.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.5], [0.0, 0.5, 2.0]]]).toarray()
    B = np.array([[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, 1, 2], [0, 0, 0, -2, -4], [0, 0, 1, 0, 0]]) @ Q.T
    A, f, g = Q @ A @ Q.T, Q @ np.array([1.0, 1.0, -1.0, 1e4, -2e4]), np.array([0.1, 0.2, 1e3, -2e3, 0.0])
    A = 0.5 * (A + A.T)
    members = {"A": linear(A[np.triu_indices(5)], {}, 1), "f": linear(f, {}, 1), "B": linear(B, {}, 1)}
    members["g"] = linear(g, {}, 1)
    text = c_source.source(members, {"lower": np.zeros(1), "upper": np.ones(1)}, about(["t"]), "case")[0]
    judged = "        status = verify(p"
    spoilt = text.replace(judged, f"    alpha[0] *= {share};\n    alpha[1] *= {share};\n{judged}")
    (tmp_path / "case.c").write_text(spoilt, encoding="utf-8")
    code, x, alpha, found = compiled(tmp_path / "case.c", 5, 5)(np.zeros(1))
    expected = kkt_residuals(vibench.VariationalInequality(A, f, B, g), x, alpha, accuracy=1e-9)
    assert expected.unit < 10.0
    assert (code == 0) == (expected.worst <= 1e-9) == (share == 1.0)
    assert found == pytest.approx((expected.primal, expected.dual, expected.gap), abs=1e-10)
    of, rows, free = reduced_model._Matrices(A, B), np.linalg.norm(B, axis=1), np.linalg.solve(A, f)
    noise, none = of.round_off * (of.sizes @ abs(free) + abs(g / rows)), 0.0 * f
    script = reduced_model.residuals(of, none, g / rows - of.B @ free, x - free, rows * alpha, noise)
    assert script == pytest.approx(found, abs=1e-10)
    for load in (f, none):  # without a load other scales count
        x, alpha = rng.standard_normal(5), rng.random(5)
        expected = kkt_residuals(vibench.VariationalInequality(A, load, B, g), x, alpha)
        script = reduced_model.residuals(of, load, g / rows, x, rows * alpha, none)
        assert script == pytest.approx((expected.primal, expected.dual, expected.gap), rel=1e-9)


def test_numbers_of_a_source_that_are_not_finite_are_a_failure(tmp_path: Path) -> None:
    """Those of a damaged or forged source, table by table."""
    members = {name: linear(np.ones(1), {0: 0}, 1) for name in "AfBg"}
    arrays = {"lower": -np.ones(1), "upper": np.ones(1), "start_factor": np.ones(1)}
    text = c_source.source(members, arrays, about(["t"]), "model")[0]
    (tmp_path / "model.c").write_text(re.sub("static const (?=double|float)", "", text), encoding="utf-8")
    solve = compiled(tmp_path / "model.c", 1, 1)
    tables = ctypes.CDLL(str(tmp_path / "model.so"))
    for table in (*(f"{name}_single_terms" for name in "AfBg"), "factor"):
        right = (number := (ctypes.c_double if table == "factor" else ctypes.c_float).in_dll(tables, table)).value
        for wrong in (np.nan, np.inf, -np.inf):
            assert solve(np.zeros(1))[0] == 0
            number.value = wrong
            code, *numbers = solve(np.zeros(1))
            assert code == 3, (table, wrong)
            assert np.isnan(np.concatenate(numbers)).all()
            number.value = right


def test_matrices_that_are_not_positive_definite_and_numbers_that_are_not_finite_fail(tmp_path: Path) -> None:
    """No constraint seems violated where its bound is NaN, and `fmin` hides a parameter that is NaN or infinite."""
    members = {name: linear(np.zeros(1), {k: 0}, 4) for k, name in enumerate("AfBg")}
    arrays, hidden = {"lower": -np.ones(4), "upper": np.ones(4)}, c_source.ExactMember(("fmin(mu[2], 1.0)",), np.eye(1))
    text = c_source.source(members, arrays, about(["t"] * 4), "9-lives", exact={"B": hidden})[0]
    (tmp_path / "model_9_lives.c").write_text(text, encoding="utf-8")
    solve = compiled(tmp_path / "model_9_lives.c", 1, 1)
    wrong = ((k, value, 19) for k in range(4) for value in (np.nan, np.inf, -np.inf))
    for k, value, expected in ((1, 0.5, 0), (0, -1.0, 3), *wrong):
        mu = np.full(4, 0.5)
        mu[k] = value
        code, *numbers = solve(mu)
        assert code == expected
        assert np.isnan(np.concatenate(numbers)).all() == (code > 0)
