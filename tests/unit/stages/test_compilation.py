import shutil
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from samples import pga_reduction, small_study

import vibench
from vibench import MEMBERS, Status, UnsupportedError, VariationalInequality
from vibench.model.chebyshev import AffinePolynomial
from vibench.offline import compiled, polynomials
from vibench.offline.compiled import CompiledModel, compiler
from vibench.offline.polynomials import InaccurateError
from vibench.qp import verify
from vibench.report.figures.data import of_solvers
from vibench.stages.query import ModelQuery
from vibench.timing import timed
from vibench_problems.hertz import Hertz

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")

STUDY = small_study(
    "compiled", [{"name": "radial-obstacle", "options": {"resolution": 150}}], assembly=["reduced"],
    formulation=["mixed", "compiled"], solvers=["piqp", "osqp"], accuracy=1e-7, validation=4,
)  # fmt: skip


def script(folder: Path, text: str) -> str:
    """An executable file of the shell, which takes the place of the compiler."""
    path = folder / "compiler"
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(0o755)
    return str(path)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> vibench.Run:
    return vibench.run(STUDY, tmp_path_factory.mktemp("compiled") / "run", progress=False, jobs=1)


@pytest.mark.long
def test_compiled_cells_have_the_rows_of_reduced_ones_and_are_no_solver(run: vibench.Run) -> None:
    cells = run.cells.set_index(["formulation", "solver"]).sort_index()
    assert list(cells.index) == [("compiled", "–"), ("mixed", "osqp"), ("mixed", "piqp")]
    mine, other = cells.loc[("compiled", "–")], cells.loc[("mixed", "piqp")]
    assert mine["status"] == other["status"] == "ok"
    assert mine["assembly"] == other["assembly"] == "reduced"
    assert mine["online_assemble_s"] == 0.0 < mine["online_solve_s"]
    assert mine["offline_formulation_s"] > other["offline_formulation_s"] == 0.0
    queries = run.table("queries").set_index(["cell", "query"])
    for cell, form in ((mine, "formulation"), (other, "primal")):
        assert set(queries.loc[cell["cell"], "form"]) == {form}
    rows, expected = (queries.loc[cell["cell"]] for cell in (mine, other))
    assert (rows["repeatable"] == 1).all()
    assert (rows[["primal_residual", "dual_residual", "gap"]] <= 1e-9).all(axis=None)
    for name in ("error_u", "error_lambda", "bound_u_energy"):
        assert np.allclose(rows[name], expected[name], rtol=1e-3, atol=1e-7)  # PIQP solves to 1e-7
    queries = run.table("queries")
    kept = set(of_solvers(queries)["cell"])
    assert kept == set(run.cells[run.cells["formulation"] == "mixed"]["cell"]) < set(queries["cell"])
    compared = run.table("disagreements")
    assert len(compared) > 0
    assert (compared["solver_a"] != compared["solver_b"]).all()


@pytest.mark.long
def test_a_crash_costs_its_query_alone(run: vibench.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heights = run.table("queries").groupby("query")["mu_1"].first().sort_values()
    crash = f"if (mu[0] > {heights.iloc[-2]:.17g}) __builtin_trap();"
    edit = rf"sed -i '/^int model_solve_counting/,$ s/    Program p;/    Program p; {crash}/' model.c"
    monkeypatch.setenv("CC", script(tmp_path, f'{edit}\nexec cc "$@"'))
    study = small_study("compiled", STUDY.problem, formulation=["compiled"], accuracy=1e-7, validation=4)
    queries = vibench.run(study, tmp_path / "run", progress=False, jobs=1).table("queries").set_index("query")
    assert queries.loc[heights.index[-1], "status"] == "crashed"
    assert set(queries.drop(heights.index[-1])["status"]) == {"ok"}


def test_compilers_are_found_by_name_missed_or_quoted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler -O2")
    other = [{"name": "radial-obstacle", "options": {"resolution": 140}}]  # whose formulation nobody has built
    study = small_study("without", other, formulation=["mixed", "compiled"], assembly=["reduced"], validation=1)
    cells = vibench.run(study, tmp_path / "run", progress=False, jobs=1).cells.set_index("formulation")
    assert cells.loc["compiled", "status"] == "unavailable"
    reason = "in formulation: the environment variable CC names the C compiler 'no-such-compiler', which is not found"
    assert (cells.loc["compiled", "reason"], cells.loc["mixed", "status"]) == (reason, "ok")
    monkeypatch.setenv("CC", f"{shutil.which('cc')} -g")
    assert compiler() == [shutil.which("cc"), "-g"]
    monkeypatch.delenv("CC")
    assert compiler() == ["cc"]
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UnsupportedError, match="none of cc, gcc, clang is on the PATH; install one, or name it in"):
        compiler()


def polynomial(value: np.ndarray, slope: float = 0.0) -> AffinePolynomial:
    """A polynomial of two parameters: a value times 1 + slope · t in the second one, t from −1 to 1."""
    return AffinePolynomial(np.array([[0, 0], [0, 1]]), np.array([[1.0], [slope]]), value.reshape(1, -1), 0.0, 1.0)


LIMITS = np.array([[1.0, 0.0], [0.0, -1.0]])


def small_model(**members: np.ndarray) -> CompiledModel:
    """Min ½|x|² − x₁ subject to x₁ ≤ ¼, x₂ ≥ −1, and limits that grow by a fifth to the end of the box."""
    values = {"A": np.array([1.0, 0.0, 1.0]), "f": np.array([1.0, 0.0]), "B": LIMITS, "g": np.array([0.25, 1.0])}
    values |= members
    polynomials = {name: polynomial(values[name], 0.2 if name == "g" else 0.0) for name in MEMBERS}
    return CompiledModel(polynomials, {"lower": np.zeros(2), "upper": np.ones(2)}, 1e-9)


def test_programs_answer_say_what_they_cannot_and_are_repeated_near_by() -> None:
    program, strided = small_model().program(), np.array([[0.3, 9.0], [0.5, 9.0], [1.0, 9.0], [7.0, 9.0]])[:, 0]
    for mu, limit in ((strided[:2], 0.25), (strided[1:3], 0.3), (strided[[3, 1]], 0.25)):  # the last one is outside
        found = program(mu)
        assert (found.solver_status, found.x) == ("solved", pytest.approx([limit, 0.0]))
        assert found.alpha == pytest.approx([1.0 - limit, 0.0])
        vi = VariationalInequality(np.eye(2), np.array([1.0, 0.0]), LIMITS, limit * np.array([1.0, 4.0]))
        assert verify(vi, found, 1e-9)[0] is Status.OK
    middle = np.full(2, 0.5)
    found = small_model(B=np.array([[1.0, 0.0], [-1.0, 0.0]]), g=-np.ones(2)).program()(middle)
    assert (found.x, found.alpha, found.solver_status) == (None, None, "the constraints contradict each other")
    found = small_model(A=np.array([1.0, 2.0, 1.0])).program()(middle)
    assert (found.x, found.solver_status) == (None, "not solved")
    vi = VariationalInequality(np.eye(2), np.array([1.0, 0.0]), LIMITS, np.array([0.25, 1.0]))
    program = small_model().program()
    online = SimpleNamespace(program=lambda mu: SimpleNamespace(program=(mu, vi)))
    answers = {"settings": lambda _: (None, None), "answered": lambda mu, _: timed(lambda: program(mu))}
    model = SimpleNamespace(online=online, **answers)
    query = ModelQuery(model, np.full(2, 0.5), lambda *seed: np.array([0.5, 0.5 + 1e-10 * seed[0]]), vi)  # type: ignore[arg-type]
    other = query.repeated(3, 1)
    assert other.mu[1] == other.program[0][1] == 0.5 + 3e-10  # type: ignore[index]
    for one, limit in ((query, 0.25), (other, 0.25 * (1.0 + 1.2e-10))):
        answer, seconds = one.prepare(nullcontext)()
        assert answer.x[0] == pytest.approx(limit, rel=1e-14)
        assert seconds.cpu > 0.0


def test_constraints_in_the_code_of_a_problem_are_in_the_program() -> None:
    few = vibench.create("sampling strategy", "random", {"size": 8, "seed": 1})
    form = vibench.create("formulation", "compiled")
    model = pga_reduction(Hertz(300), 1e-1, 1e-2, formulation=form, training=few, assembly="reduced").model
    assert set(model.built["polynomials"].members) == {"A", "f"}
    for mu in model.parameters.sample(3, seed=1):
        found = model.solve(mu)
        assert (found.status, found.reason, found.residuals.worst < 1e-12) == (Status.OK, "", True)


def test_models_too_large_or_rough_have_no_program(small_run: vibench.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    cells = small_run.cells.set_index("assembly")["cell"]
    reduced = small_run.model(str(cells["reduced"].iloc[0])).reduced

    def interpolated(*_: object, **__: object) -> None:
        raise AssertionError("a model that is too large was interpolated before it was refused")

    with monkeypatch.context() as patched:
        large = VariationalInequality(np.eye(400), np.ones(400), np.eye(400), np.ones(400))
        patched.setattr(polynomials, "members_of", lambda *_: large)
        patched.setattr(polynomials, "interpolate_on_box", interpolated)
        with pytest.raises(UnsupportedError, match=r"400 constraints has 8\.5 MiB of arrays on the stack"):
            CompiledModel.of(reduced, 1e-9)

    def inaccurate(*_: object, **__: object) -> None:
        raise InaccurateError("B is not smooth", 0.1)

    monkeypatch.setattr(compiled, "member_polynomials", inaccurate)
    with pytest.raises(UnsupportedError, match="the model cannot be exported to C: B is not smooth"):
        CompiledModel.of(reduced, 1e-9)
