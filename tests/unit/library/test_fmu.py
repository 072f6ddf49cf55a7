import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from samples import pga_reduction

import vibench
from vibench import AffineProblem, Output, RequestError, export_model
from vibench.model.bound_terms import CorrectionMode

fmpy = pytest.importorskip("fmpy")
validation = pytest.importorskip("fmpy.validation")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="NO C COMPILER (cc): FMUs are not tested")

ModelOf = Callable[[bool], vibench.Model]


class String(AffineProblem):
    """A string above an obstacle, whose members are expressions; one of its outputs is code."""

    parameters = vibench.ParameterBox(("load", "depth"), np.array([0.5, 0.01]), np.array([2.0, 0.09]), ("N", "m"))
    outputs = (
        Output("deflection <mean>", "m", u=np.full(24, 1.0 / 24.0)),
        Output("squared", "1", function=lambda _mu, u, _lam: float(u @ u)),
        Output("force", "N", lam=np.ones(6)),
    )

    def __init__(self) -> None:
        n, m = 24, 6
        K = sp.diags_array([-np.ones(n - 1), 2.0 * np.ones(n), -np.ones(n - 1)], offsets=(-1, 0, 1)) * (n + 1.0)
        self.V, self.W = vibench.InnerProduct(sp.csc_array(K)), vibench.InnerProduct(sp.eye_array(m, format="csc"))
        B = sp.csr_array((-np.ones(m), (np.arange(m), np.arange(9, 15))), shape=(m, n))
        bent, load = np.linspace(1.0, 2.0, m), np.full(n, 1.0 / (n + 1.0))
        self.declare(A=K, f=[("-load", load)], B=B, g=[("depth", bent), ("0.02 * load**2", bent[::-1])])

    def training_set(self) -> np.ndarray:
        return self.parameters.grid(2, 3)


@pytest.fixture(scope="module")
def model_of() -> ModelOf:
    """The model of the string with or without bounds, coarse enough to have errors."""
    stops, given = (vibench.Stop(size=2), vibench.Stop(size=1)), {"tolerance": 0.3, "assembly": "reduced"}
    return cache(lambda bounds: pga_reduction(String(), *stops, bounds=bounds, **given).model)


def simulated(file: Path, mu: np.ndarray) -> dict[str, float]:
    start = dict(zip(String.parameters.names, mu.tolist(), strict=True))
    rows = fmpy.simulate_fmu(str(file), start_values=start, stop_time=1.0, step_size=1.0)
    return dict(zip(rows.dtype.names, rows[-1].tolist(), strict=True))


def test_an_fmu_has_the_answers_and_bounds_of_the_model(model_of: ModelOf, tmp_path: Path) -> None:
    """Corrected or not, as the cell chooses for each parameter."""
    model, file, kinds = replace(model_of(True), correction=CorrectionMode.AUTO), tmp_path / "a string.fmu", set[bool]()
    export_model(model, file)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]
    assert validation.validate_fmu(str(file)) == []
    for mu in model.parameters.sample(4, seed=1):
        own, found = model.solve(mu, accuracy=1e-13), simulated(file, mu)
        kinds.add(own.answer.is_corrected)
        bounds = {"u_energy": own.bound.u_energy, "lambda_natural": own.bound.lambda_natural}
        expected = {name: own.outputs[name] for name in ("deflection <mean>", "force")}
        expected |= {f"bound:{name}": own.output_bounds[name] for name in expected}
        expected |= {f"bound_{name}": bound for name, bound in bounds.items()}
        expected |= {"bound_u_relative": own.bound.relative, "time": 1.0, "status": 0}
        assert found == pytest.approx(expected, 1e-9)
        assert 0.0 < found["bound_u_energy"] < np.inf
    assert kinds == {False, True}
    outside = simulated(file, 1.5 * model.parameters.upper)
    assert outside["status"] == 16
    assert {value for name, value in outside.items() if name.startswith("bound")} == {np.inf}


def test_an_fmu_without_bounds_says_so(model_of: ModelOf, tmp_path: Path) -> None:
    model, file = model_of(False), tmp_path / "string.fmu"
    export_model(model, file)
    assert validation.validate_fmu(str(file)) == []
    described = fmpy.read_model_description(str(file))
    assert "no bounds" in described.description
    variables = {one.name: (one.causality, one.unit, one.start, one.min, one.max) for one in described.modelVariables}
    box = model.parameters
    numbers = np.array([0.5 * (box.lower + box.upper), box.lower, box.upper]).T.tolist()
    for name, unit, texts in zip(box.names, box.units, numbers, strict=True):
        assert variables.pop(name) == ("input", unit, *map(repr, texts))
    assert list(variables) == ["deflection <mean>", "force", "status"]
    mu = np.array([1.0, 0.013])
    found, own = simulated(file, mu), model.solve(mu, accuracy=1e-13)
    expected = {"deflection <mean>": own.outputs["deflection <mean>"], "force": own.outputs["force"]}
    assert found == pytest.approx(expected | {"time": 1.0, "status": 0.0}, rel=1e-9)


def test_what_no_fmu_can_hold_is_refused(model_of: ModelOf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, linear = String.outputs[1], Output("load", "N", lam=np.ones(6))
    for outputs, mode, said in (
        ((code,), CorrectionMode.NONE, "the problem has no linear outputs"),
        ((linear,), CorrectionMode.NONE, "two variables of the FMU would have the name 'load'"),
        (String.outputs, CorrectionMode.AUTO, "the cell corrects its answers at high-fidelity cost"),
    ):
        monkeypatch.setattr(String, "outputs", outputs)
        with pytest.raises(RequestError, match=said):
            export_model(replace(model_of(False), correction=mode), tmp_path / "model.fmu")
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(vibench.VibenchError, match="names the C compiler 'no-such-compiler', which is not found"):
        export_model(model_of(False), tmp_path / "model.fmu")
    assert list(tmp_path.iterdir()) == []
