import json
import re
import subprocess
import sys
import warnings
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from enriching import reduced_from
from numerics import Varying
from running import Main, refused, succeeded
from samples import with_ways

import vibench
from vibench import export_model
from vibench.library import reduced_model
from vibench.library.reduced_model import Model as Exported
from vibench.model.affine import affine_decomposition
from vibench.model.certificates.base import Guarantee
from vibench.model.hyperreduced import HyperReducedModel, hyper_reduce
from vibench.offline import exported as offline_exported
from vibench.offline import polynomials
from vibench.offline.exported import exported as exported_model
from vibench.qp.exact import exact_solution

FILES = {"model.npz", "reduced_model.py"}


@pytest.fixture(scope="module")
def run(small_run: vibench.Run) -> vibench.Run:
    return small_run


def model_of(run: vibench.Run, problem: str, primal: str = "offline-pga", assembly: str = "reduced") -> vibench.Model:
    rows = with_ways(run.cells).set_index(["problem", "primal", "assembly"])
    return run.model(str(rows.loc[(problem, primal, assembly), "cell"]))


class Rotating(Varying):
    """The string whose constraints rotate, by two matrices in proportions that vary smoothly with the parameter."""

    entrywise = frozenset(vibench.MEMBERS)

    def __init__(self) -> None:
        super().__init__(30, 8, 9)
        self._two = [super(Rotating, self).assemble(np.array([t])).B for t in (0.0, 1.0)]

    def assemble(self, mu: vibench.Array) -> vibench.VariationalInequality:
        found = super().assemble(np.zeros(1))
        B = sp.csr_array(self._two[0] + np.sin(3.0 * mu[0]) * self._two[1])
        return vibench.VariationalInequality(found.A * (1.0 + mu[0]), found.f, B, found.g * np.exp(-mu[0]))

    def sampler(self, wanted: Any) -> vibench.Sampler:
        def dense(vi: vibench.VariationalInequality) -> dict[str, vibench.Array]:
            return {"A": vi.A.toarray(), "f": vi.f[:, None], "B": vi.B.toarray(), "g": vi.g[:, None]}

        return lambda mu: {name: dense(self.assemble(mu))[name][places] for name, places in wanted.items()}


class Declared(Rotating):
    """The same with its sums declared; assemblies are counted."""

    constant = frozenset({"f"})
    entrywise = frozenset()
    most: int | None = None
    """Assemblies after which it refuses another one."""

    def __init__(self) -> None:
        super().__init__()
        self._first = super().assemble(np.zeros(1))

    def assemble(self, mu: vibench.Array) -> vibench.VariationalInequality:
        if self.most is not None:
            assert self.most > 0
            self.most -= 1
        return super().assemble(mu)

    @property
    def affine(self) -> Mapping[str, vibench.AffineSum]:
        first, (one, other) = self._first, self._two
        return {
            "A": vibench.AffineSum.of([("1 + angle", first.A)], self.parameters.names),
            "B": vibench.AffineSum.of([(1.0, one), ("sin(3 * angle)", other)], self.parameters.names),
            "g": vibench.AffineSum.of([("exp(-angle)", first.g)], self.parameters.names),
        }


class PartlyDeclared(Declared):
    """Its bound is not declared."""

    @property
    def affine(self) -> Mapping[str, vibench.AffineSum]:
        return {name: found for name, found in super().affine.items() if name != "g"}


def assembled_in_full(template: vibench.Model, problem: vibench.Problem, kind: vibench.Kind) -> vibench.Model:
    """A model of a problem whose queries assemble high-fidelity matrices, with the row of a real cell."""
    return with_row(template, reduced_from(problem, kind, 4, 3))


def with_row(template: vibench.Model, queried: Any) -> vibench.Model:
    offline = vibench.Reduction(queried.problem, None, None, None, None).given(assembled=queried)
    return replace(template, offline=offline, certificate=None)


def assert_exported_alike(model: vibench.Model, file: Path) -> None:
    exported = Exported(file)
    assert max(largest_errors(model, lambda mu: (exported.solve(mu).u, exported.solve(mu).lam), 30)) <= 1e-9


@pytest.mark.parametrize("kind", [vibench.Kind.NONE, vibench.Kind.PER_PARAMETER])
def test_declared_sums_are_exported_whatever_the_assembly(run: vibench.Run, kind: vibench.Kind, tmp_path: Path) -> None:
    """Without an assembly beyond those that check the declarations, and with the θ of these terms alone."""
    problem = Declared()
    model = assembled_in_full(model_of(run, "radial-obstacle"), problem, kind)
    problem.most = 4
    found = export_model(model, tmp_path / "model.npz")
    problem.most = None
    assert {name: len(member.terms) for name, member in found.members.items()} == {"A": 1, "f": 1, "B": 2, "g": 1}
    assert found.members["A"].degrees == (1,)
    assert_exported_alike(model, tmp_path / "model.npz")


def test_sums_that_are_declared_keep_their_terms_beside_members_that_are_not(run: vibench.Run, tmp_path: Path) -> None:
    template = model_of(run, "radial-obstacle")
    problem = PartlyDeclared()
    model = assembled_in_full(template, problem, vibench.Kind.NONE)
    found = export_model(model, tmp_path / "model.npz")
    assert {name: len(found.members[name].terms) for name in "AB"} == {"A": 1, "B": 2}
    assert_exported_alike(model, tmp_path / "model.npz")
    with pytest.raises(vibench.RequestError, match="does not declare all members constant or affine; export the same"):
        export_model(assembled_in_full(template, PartlyDeclared(), vibench.Kind.PER_PARAMETER), tmp_path / "other.npz")
    # The declaration is false from now on: the sweep of its model would have refused it.
    problem._first = problem.assemble(np.ones(1))
    with pytest.raises(vibench.RequestError, match="the affine sum declared for A differs from the assembled A"):
        export_model(model, tmp_path / "other.npz")
    assert {file.name for file in tmp_path.iterdir()} == FILES


def per_parameter(template: vibench.Model) -> vibench.Model:
    """A model whose supremizers are added at every parameter, on another problem, with the row of a real cell."""
    problem = Rotating()
    reduced = reduced_from(problem, vibench.Kind.PER_PARAMETER, 2, 3)
    decomposed = affine_decomposition(problem, problem.training_set(), 1e-12)
    return with_row(template, HyperReducedModel(reduced, hyper_reduce(reduced, decomposed)))


def largest_errors(model: vibench.Model, answers: Any, count: int) -> tuple[float, float]:
    """Largest relative errors of u and λ, against the reduced programs that vibench assembles, solved to round-off."""
    errors, V, W, unique = [], model.problem.V, model.problem.W, 0
    for mu in model.parameters.sample(count, seed=7):
        reduced = model.reduced.assemble(mu)
        exact = exact_solution(reduced.program)
        u, lam = reduced.reconstruct(exact.x[:, None])[:, 0], model.reduced.generators @ exact.alpha
        found_u, found_lam = answers(mu)
        unique += exact.unique
        errors.append((V.norm(found_u - u) / V.norm(u), exact.unique * W.norm(found_lam - lam) / W.norm(lam)))
    assert unique > 0.9 * count
    return tuple(np.max(errors, axis=0).tolist())


@pytest.mark.parametrize(
    "way",
    [
        "radial-obstacle reduced 200",
        "radial-obstacle full 20",
        "string - 100",
        pytest.param("obstacle reduced 40", marks=pytest.mark.long),
    ],
)
def test_an_exported_model_reproduces_random_queries(run: vibench.Run, way: str, tmp_path: Path) -> None:
    problem, assembly, count = way.split()
    string = problem == "string"
    model = per_parameter(model_of(run, "radial-obstacle")) if string else model_of(run, problem, assembly=assembly)
    found = export_model(model, tmp_path / "model.npz", tolerance=1e-11)
    exported = Exported(tmp_path / "model.npz")

    def answers(mu: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
        solution = exported.solve(mu)
        assert solution.status == "ok"
        assert max(solution.residuals) <= 1e-12
        return solution.u, solution.lam

    assert max(largest_errors(model, answers, int(count))) <= 1e-9
    assert found.error <= 1e-11
    assert {file.name for file in tmp_path.iterdir()} == FILES


def per_file(model: vibench.Model, folder: Path, solver: str = "") -> Exported:
    file = folder / "model.npz"
    if not file.exists():
        export_model(model, file, tolerance=1e-8)
    return Exported(file, solver)


ALONE = """
import sys, warnings
sys.path[:0] = [{runtime!r}, {site!r}]
import numpy as np
from reduced_model import Model
model = Model({file!r})
expected = np.load({values!r})
for mu, u, lam in zip(expected["mus"], expected["u"], expected["lam"]):
    solution = model.solve(mu)
    assert solution.status == "ok"
    assert np.abs(solution.u - u).max() <= 1e-9 * np.abs(u).max()
    assert np.abs(solution.lam - lam).max() <= 1e-9 * np.abs(lam).max()
for name in ("vibench", "scipy", "qpsolvers", "proxsuite"):
    try:
        __import__(name)
    except ImportError:
        continue
    raise AssertionError(f"{{name}} can be imported")
print(len(expected["mus"]))
"""


def test_the_runtime_needs_numpy_and_one_solver_alone(run: vibench.Run, tmp_path: Path) -> None:
    site = tmp_path / "site"
    site.mkdir()
    for name in ("numpy", "piqp"):
        for part in {Path(file).parts[0] for file in distribution(name).files or [] if ".." not in Path(file).parts}:
            (site / part).symlink_to(str(distribution(name).locate_file(part)))
    model = model_of(run, "radial-obstacle")
    export_model(model, tmp_path / "out" / "model.npz")
    solutions = []
    for mu in (mus := model.parameters.sample(20, seed=1)):
        reduced = model.reduced.assemble(mu)
        exact = exact_solution(reduced.program)
        solutions.append((reduced.reconstruct(exact.x), model.reduced.generators @ exact.alpha))
    u, lam = (np.stack(part) for part in zip(*solutions, strict=True))
    np.savez(tmp_path / "values.npz", mus=mus, u=u, lam=lam)
    script = ALONE.format(
        runtime=str(tmp_path / "out"), site=str(site), file=str(tmp_path / "out" / "model.npz"),
        values=str(tmp_path / "values.npz"),
    )  # fmt: skip
    done = subprocess.run([sys.executable, "-I", "-S", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "20\n"


def test_wrong_solvers_are_not_believed(run: vibench.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of them is the one that is asked for, which its answer, polished to round-off, does not show."""
    model, called = model_of(run, "obstacle"), list[str]()
    one, other = per_file(model, tmp_path, "piqp"), per_file(model, tmp_path, "proxqp")

    def counted(name: str, solve: Any) -> Any:
        return lambda *given: called.append(name) or solve(*given)

    for name, solve in list(reduced_model.SOLVERS.items()):
        monkeypatch.setitem(reduced_model.SOLVERS, name, counted(name, solve))
    for mu in model.parameters.sample(10, seed=2):
        assert np.allclose(one.solve(mu).x, other.solve(mu).x, rtol=0.0, atol=1e-12)
    assert called == ["piqp", "proxqp"] * 10
    with pytest.raises(ValueError, match="the solver is 'osqp', expected one of piqp, proxqp"):
        Exported(tmp_path / "model.npz", "osqp")
    assert one.solve(mu).status == "ok"
    for place in range(3):  # Python takes the larger of 0 and NaN for 0
        found = np.where(np.arange(3) == place, np.nan, 0.0).tolist()
        with monkeypatch.context() as patched:
            patched.setattr(reduced_model, "residuals", lambda *_, found=found: tuple(found))
            assert one.solve(mu).status == "inaccurate"
    no_numbers = lambda A, f, B, g, _: (np.full(len(f), np.nan), np.full(len(g), np.inf))  # noqa: E731
    monkeypatch.setitem(reduced_model.SOLVERS, "piqp", no_numbers)
    monkeypatch.setattr(reduced_model, "_polished", lambda of, g, _: (np.zeros(len(of.A)), np.zeros(len(g))))
    assert one.solve(mu).status == "inaccurate"


def test_polishing_ends_where_changes_of_all_rows_at_once_cycle() -> None:
    """Rows that are dependent up to 1e-8 have huge multipliers of both signs while all of them are active."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rows = rng.random((8, 12))
        mixed = rng.random((3, 8)) @ rows
        B = np.vstack([rows, mixed + 1e-8 * rng.standard_normal(mixed.shape)])
        g = np.append(0.2 * rng.random(8) - 0.1, np.zeros(3))
        B /= np.linalg.norm(B, axis=1)[:, None]
        g[8:] = B[8:] @ np.linalg.lstsq(B[:8], g[:8], rcond=None)[0]
        A, f = np.eye(12), 3.0 * rng.random(12)
        of, g = reduced_model._Matrices(A, B), g - B @ f  # of x − A⁻¹f
        found = reduced_model.residuals(of, 0.0 * f, g, *reduced_model._polished(of, g, np.ones(11, bool)), 0.0 * g)
        assert max(found) <= 1e-12


@pytest.mark.parametrize("primal", ["offline-pga", "online-supremizers"])
def test_far_from_the_box_a_query_is_never_ok(primal: str, run: vibench.Run, tmp_path: Path) -> None:
    """Polynomials grow: A is not positive definite, or overflows."""
    export_model(model_of(run, "obstacle", primal), tmp_path / "model.npz", tolerance=1e-4)
    exported = Exported(tmp_path / "model.npz")
    for far in (1.0, 10.0, 1e3, 1e20, 1e200):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = exported.solve(exported.upper + far * (exported.upper - exported.lower))
        assert found.status in {"outside", "inaccurate", "failed"}
        assert (found.status == "failed") == bool(np.isnan(found.x).any()) == np.isnan(found.energy)
    assert found.status == "failed"


def test_parameters_outside_the_box_are_warned_of_and_wrong_ones_refused(run: vibench.Run, tmp_path: Path) -> None:
    model = model_of(run, "radial-obstacle")
    exported = per_file(model, tmp_path)
    outside = [0.17, 0.3]
    with pytest.warns(UserWarning, match="outside the box"):
        solution = exported.solve(outside)
    assert solution.status == "outside"
    assert max(solution.residuals) <= 1e-12
    with pytest.warns(UserWarning, match="outside the parameter domain"):
        assert np.allclose(solution.x, model.solve(outside, accuracy=1e-12).x, rtol=0.0, atol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exported.solve(exported.upper)
    for wrong in ([0.17], [0.17, float("nan")]):
        with pytest.raises(ValueError, match="expected height, curvature"):
            exported.solve(wrong)


def test_what_a_file_says(run: vibench.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of(run, "obstacle")
    export_model(model, tmp_path / "model.npz", tolerance=1e-6, bases=False)
    exported = Exported(tmp_path / "model.npz")
    about = exported.about
    assert about["parameters"] == {"names": ["scale", "centre_x", "centre_y"], "units": ["1", "m", "m"]}
    assert all(about["cell"][name] == model.row[name] for name in ("cell", "error_u_mean"))
    assert json.loads(about["cell"]["definition"])["problem"]["name"] == "obstacle"
    assert about["source"] == {"distribution": f"vibench {distribution('vibench').version}", "licence": "MIT"}
    assert 0.0 < about["members"]["A"]["error"] <= 1e-6
    solution = exported.solve([1.0, 0.0, 0.0])
    assert (solution.u, solution.lam) == (None, None)
    with np.load(tmp_path / "model.npz", allow_pickle=False) as data:
        assert not {"basis", "generators"} & set(data.files)
    monkeypatch.setattr(type(model.problem), "licence", "CC-BY-4.0")  # a problem with data of its own
    export_model(model, tmp_path / "other.npz", tolerance=1e-6, bases=False)
    assert Exported(tmp_path / "other.npz").about["source"]["licence"] == "CC-BY-4.0"


def test_files_that_are_no_models_or_damaged_are_refused(tmp_path: Path, run: vibench.Run) -> None:
    np.savez(tmp_path / "other.npz", format=np.array("something else"))
    np.savez(tmp_path / "objects.npz", format=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=r"other\.npz' is no vibench reduced model 1"):
        Exported(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="Object arrays cannot be loaded"):
        Exported(tmp_path / "objects.npz")
    for other in (tmp_path, Path("/dev/zero")):
        with pytest.raises(ValueError, match="is no regular file"):
            Exported(other)
    per_file(model_of(run, "radial-obstacle"), tmp_path)
    with np.load(tmp_path / "model.npz") as data:
        arrays = dict(data)
    for name, alter in (
        ("A_indices", lambda indices: -1 - indices), ("B_indices", lambda indices: indices + 2**40),
        ("g_indices", lambda indices: indices.astype(np.uint64) + np.uint64(2**63)),
        ("f_indices", lambda indices: indices + 0.5), ("f_indices", lambda indices: indices[:, :0]),
        ("A_coefficients", lambda values: values[:-1]), ("A_terms", lambda values: values[:, 0]),
        *((name, lambda values: values / 0.0) for name in ("generators", "basis", "g_terms", "lower")),
    ):  # fmt: skip
        with np.errstate(all="ignore"):
            np.savez(tmp_path / "other.npz", **arrays | {name: alter(arrays[name])})
        reasons = f"the arrays of {name[0]} are no polynomial in|the array {name} does not consist of finite numbers"
        with pytest.raises(ValueError, match=rf"other\.npz' is damaged: ({reasons})"):
            Exported(tmp_path / "other.npz")


def test_models_without_an_export_are_refused_and_nothing_is_left_behind(run: vibench.Run, tmp_path: Path) -> None:
    for present in ("old.npz", "taken.c"):
        (tmp_path / present).write_text("precious")
    for name, options, line in (
        ("model.txt", {}, "whose name must end in .npz"),
        ("model.npz", {"tolerance": 0.0}, "tolerance of export_model is 0.0, expected a number between 0 and 1"),
        ("old.npz", {}, "old.npz' exists; remove it"),
        ("old.npz/model.npz", {}, "old.npz' is no folder"),
        ("taken.npz", {"c": True}, "taken.c' exists; remove it"),
        ("model.npz", {"tolerance": 1e-13, "evaluations": 30}, r"A depends on mu .* `--tolerance \d"),
    ):
        with pytest.raises(vibench.RequestError, match=line) as caught:
            export_model(model_of(run, "obstacle"), tmp_path / name, **options)
        assert "\n" not in str(caught.value)
        left = {file.name: file.read_text() for file in tmp_path.iterdir()}
        assert left == {"old.npz": "precious", "taken.c": "precious"}
    model = model_of(run, "obstacle")
    with pytest.raises(vibench.RequestError, match="exports this approximation") as caught:
        export_model(model, tmp_path / "model.npz", tolerance=1e-13, evaluations=200)
    offered = float(str(caught.value).split("`--tolerance ")[1].split("`")[0])
    found = export_model(model, tmp_path / "model.npz", tolerance=offered, evaluations=200)
    assert 1e-13 < found.error <= offered
    mu = model.parameters.sample(1, seed=1)[0]
    assert Exported(tmp_path / "model.npz").solve(mu).u == pytest.approx(model.solve(mu).u, abs=10.0 * offered)


def test_models_without_export_are_refused(run: vibench.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of(run, "radial-obstacle")
    with pytest.raises(vibench.RequestError, match='export the same cell with assembly = "reduced"'):
        export_model(model_of(run, "obstacle", "online-supremizers", "full"), tmp_path / "model.npz")
    (tmp_path / "reduced_model.py").write_text("precious")
    with pytest.raises(vibench.RequestError, match="is not the runtime of this version"):
        export_model(model, tmp_path / "model.npz")
    assert [file.name for file in tmp_path.iterdir()] == ["reduced_model.py"]
    monkeypatch.setattr(type(model.reduced), "members", lambda self, mu, samples: {}["mu is not in the list"])
    with pytest.raises(vibench.RequestError, match="cannot be evaluated in the whole parameter box: KeyError"):
        export_model(model, tmp_path / "deep" / "model.npz")


def test_constant_members_are_not_sampled_coefficients_once(run: vibench.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thousands of copies of a constant A of 281 unknowns took 6 GiB."""
    reduced, sampled, points = model_of(run, "radial-obstacle").reduced, [], []
    interpolate, coefficients = polynomials.interpolate_on_box, reduced.coefficients

    def sizes(evaluate: Any, lower: np.ndarray, *given: Any, **named: Any) -> Any:
        points.clear()
        sampled.append({name: array.size for name, array in evaluate(lower).items()})
        assert len(points) == 1
        return interpolate(evaluate, lower, *given, **named)

    monkeypatch.setattr(reduced, "coefficients", lambda at: points.append(at) or coefficients(at))
    monkeypatch.setattr(polynomials, "interpolate_on_box", sizes)
    found = polynomials.member_polynomials(reduced, 1e-11, 4096)
    assert reduced.problem.constant
    assert {sampled[0][name] for name in reduced.problem.constant} == {1}
    (mu,) = reduced.problem.parameters.sample(1, seed=5)
    box, program = reduced.problem.parameters, reduced.assemble(mu).program
    unit = ((mu - box.lower) / (box.upper - box.lower))[None, :]
    for name in reduced.problem.constant:
        expected = np.asarray(getattr(program, name))
        packed = expected[np.triu_indices(len(expected))] if name == "A" else expected.ravel()
        assert found[name].evaluate(unit)[0] == pytest.approx(packed, abs=1e-12 * np.abs(packed).max())


@pytest.mark.parametrize("certified", [False, True])
def test_the_command(run: vibench.Run, certified: bool, main: Main, tmp_path: Path) -> None:
    cell = str((certified_model(run) if certified else model_of(run, "obstacle")).row["cell"])
    file, options = tmp_path / "out" / "model.c", () if certified else ("--tolerance", "1e-4")
    asked = ("export", str(run.path.parent), cell, str(file))
    out = succeeded(main(*asked, *options))
    assert f"`from reduced_model import Model`, then `Model('{file.with_suffix('.npz')}').solve(mu)" in out
    assert re.search(r"^a query takes \S+ ms; the high-fidelity solution \S+ ms$", out, re.MULTILINE)
    assert {file.name for file in (tmp_path / "out").iterdir()} == FILES | {"model.c", "model.h"}
    if certified:
        assert "\nerror bounds in C: certified\n" in out
        header = file.with_suffix(".h").read_text()
        assert "int model_certify(" in header
        assert "the bounds are\n * certified" in header
        with np.load(file.with_suffix(".npz")) as data:
            assert {name for name in data.files if name.startswith("certificate")} == {"certificate_lift"}
    else:
        assert "B: 1 term, polynomials of degree (2, 0, 0)" in out
        assert "no error bounds: its cell has no bounds" in out
        held = "outputs: deflection, left deflection, lower deflection"
        assert f"{held}; code that the file cannot hold computes contact force, contact area\n" in out
        refused(main(*asked), "model.npz' exists; remove it")
        refused(main(*asked[:-1], str(tmp_path / "b.npz"), "--tolerance", "1e-14"), "A depends on mu", "evaluations")


def certified_model(run: vibench.Run, problem: str = "radial-obstacle") -> vibench.Model:
    return model_of(run, problem, "decorrelated", "certified")


def test_exported_members_and_their_certificate(run: vibench.Run) -> None:
    obstacle, model = certified_model(run, "obstacle"), certified_model(run)
    # A needs fewer products in its own terms than its certificate
    found = exported_model(obstacle, bases=False, c=True)
    A, theta = found.members["A"], found.thetas["theta_A"]
    assert len(A.indices) < len(theta.indices)
    assert max(A.error, theta.error) <= 1e-11
    # a file without bounds says why
    for exported, c, why in (
        (model_of(run, "radial-obstacle"), True, "bounds = true"),
        (model, False, "only C programs have them"),
        (model, True, ""),
    ):
        found = exported_model(exported, c=c)
        assert why in found.about["no_bounds"]
        assert (found.about["certificate"] == "none") == bool(found.about["no_bounds"]) == bool(why)
        assert bool(found.thetas) == (not why)
    # However well polynomials agree at random parameters, only constant members and expressions are exact.
    assert model.certificate.base.guarantee is Guarantee.CERTIFIED
    assert found.exact.keys() == {"g", "theta_g"}  # the others are constant
    assert found.about["certificate"] == "certified"
    assert exported_model(obstacle, c=True).about["certificate"] == "verified"
    for exact, worth in (("Af", "verified"), ("AfB", "verified"), ("AfBg", "certified")):
        assert offline_exported.guarantee(model.certificate, set(exact)).value == worth


def test_the_code_of_the_page_runs(run: vibench.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export_model(certified_model(run), tmp_path / "membrane.npz")
    export_model(certified_model(run, "obstacle"), tmp_path / "membrane.fmu")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    page = (Path(__file__).parents[3] / "docs" / "export.md").read_text(encoding="utf-8")
    found: dict[str, Any] = {}
    for code in re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL):
        if "umbridge" not in code:  # a client of a server, which the tests of servers have
            exec(code, found)
    assert found["solution"].status == "ok"
    monkeypatch.delitem(sys.modules, "reduced_model")


def test_a_model_of_no_run_is_exported_with_the_name_of_its_problem_alone(run: vibench.Run, tmp_path: Path) -> None:
    export_model(replace(model_of(run, "radial-obstacle"), row={}), tmp_path / "model.npz", c=True)
    about = Exported(tmp_path / "model.npz").about
    assert about["cell"] == {"problem": "Radial"}
    assert about["source"] == {"distribution": "", "licence": "unknown"}
    assert ": Radial.\n * Licence of the problem: unknown.\n" in (tmp_path / "model.h").read_text()
