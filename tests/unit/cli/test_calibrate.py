"""`vibench calibrate`: from data to a posterior, continued where it was stopped, and one line for what is wrong."""

import json
import os
import signal
import tomllib
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from running import Main, refusal, refused

from vibench.calibration import Metropolis
from vibench.calibration.data import read_data
from vibench.calibration.metropolis import arviz
from vibench_problems.hertz import Hertz
from vibench_problems.radial import Radial

COMMAND = ("calibrate", "radial-obstacle", "data.toml", "--option", "resolution=200", "--steps", "60")
SYNTHETIC = ("--synthetic", "0.17,0.1", "--noise", "2%")


def states(folder: str) -> np.ndarray:
    with np.load(Path(folder) / "chain.npz") as saved:
        return np.asarray(saved["states"])


def test_a_posterior_in_one_command_which_continues_what_was_stopped(
    main: Main, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, err = main(*COMMAND, *SYNTHETIC)
    assert (code, err) == (0, ""), err
    for words in ("height", "curvature", "exact: every decision is that of the high-fidelity model", "seconds: "):
        assert words in out
    folder = Path("calibrations/data")
    assert {file.name for file in folder.iterdir()} == {"chain.npz", "posterior.csv", "posterior.nc", "posterior.png"}
    whole, table = states("calibrations/data"), pd.read_csv(folder / "posterior.csv")
    assert table["mean"].tolist() == pytest.approx(whole[13:].mean(axis=0).tolist())
    found = arviz().from_netcdf(str(folder / "posterior.nc"))
    np.testing.assert_array_equal(found.posterior["height"], [whole[13:, 0]])
    np.testing.assert_array_equal(found.warmup_posterior["curvature"], [whole[1:13, 1]])
    assert found.sample_stats["accepted"].shape == (1, 48)
    assert found.observed_data["outer deflection"].shape == (1,)
    data = tomllib.loads(Path("data.toml").read_text())["sensors"]
    assert data["outer deflection"]["noise"] == pytest.approx(0.02 * 0.0977, rel=1e-3)

    step = Metropolis.step

    def stopped(chain: Metropolis) -> None:
        step(chain)
        if chain.steps == 25:
            os.kill(os.getpid(), signal.SIGINT)

    # Where the tests run in the background, Ctrl-C is ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(Metropolis, "step", stopped)
    code, out, err = main(*COMMAND, *SYNTHETIC, "--out", "again")
    signal.signal(signal.SIGINT, before)
    assert (code, err) == (130, "")
    assert "interrupted after 25 of 60 steps; the same command continues" in out
    monkeypatch.setattr(Metropolis, "step", step)
    assert main(*COMMAND, "--out", "again")[0] == 0
    assert np.array_equal(states("again"), whole)
    refused(main(*COMMAND, "--out", "again", "--seed", "7"), "a chain with other data or settings; --fresh replaces it")
    Path("again/chain.npz").write_bytes(b"no chain")
    refused(main(*COMMAND, "--out", "again"), "no chain that can be continued")
    refused(main(*COMMAND, *SYNTHETIC, "--seed", "8"), "'data.toml' exists with other data; leave out --synthetic")


def test_wrong_requests_get_a_line(main: Main) -> None:
    for words, said in (
        ("--synthetic 1,x", "--synthetic is '1,x', expected numbers separated by commas"),
        ("--synthetic 0.17", "mu is [0.17], expected finite numbers (height, curvature)"),
        ("--synthetic 0.17,0.1 --noise 0%", "'0%' is no positive percentage, such as 1%"),
        ("--synthetic 0.17,0.1 --noise 2", "'2' is no positive percentage, such as 1%"),
        ("", "data.toml: cannot be read as text"),
    ):
        refused(main(*COMMAND, *words.split()), said)
    assert not list(Path().iterdir())
    Path("data.toml").write_text('[sensors."outer deflection"]\nvalue = 74.2\nnoise = 0.1\n')
    refused(main(*COMMAND), "'outer deflection' is 74.2, and the parameter box gives", "is the unit right?")


OUTER = "outer deflection"
RIGHT: dict[str, Any] = {"value": -0.07, "noise": 0.001}


@pytest.mark.parametrize(
    ("sensors", "rest", "said"),
    [
        ({"outer": RIGHT}, "", "no linear output of the problem is called 'outer' (known: inner deflection"),
        ({OUTER: {**RIGHT, "unit": "mm"}}, "", f"sensors.{OUTER}.unit is 'mm', the output has 'm'"),
        ({OUTER: {"value": 1.0}}, "", f"sensors.{OUTER}.noise: expected a standard deviation"),
        ({OUTER: {"value": 0.0, "noise": "1%"}}, "", "a share of a value that is not 0"),
        ({OUTER: {"value": 1.0, "noise": "one"}}, "", "'one' is no positive percentage"),
        ({OUTER: {"value": 1.0, "noise": -0.1}}, "", f"sensors.{OUTER}.noise: expected a standard deviation"),
        ({OUTER: {"value": "x", "noise": 0.1}}, "", f"sensors.{OUTER}.value: Input should be a valid number"),
        ({OUTER: {**RIGHT, "sd": 1.0}}, "", "no key is called 'sd'"),
        ({}, "", "sensors"),
        ({OUTER: {"value": 1.0}}, "covariance = [[1.0, 0.0]]", "covariance has not the shape (1, 1) of the sensors"),
        ({OUTER: RIGHT}, "covariance = [[1.0]]", "with a covariance the sensors have no noise of their own"),
        ({OUTER: {"value": 1.0}}, "covariance = [[-1.0]]", "the covariance of the noise is not positive definite"),
        ({OUTER: RIGHT}, "[prior]\ndepth = { mean = 0.1, sd = 0.1 }", "no parameter is called 'depth'"),
        ({OUTER: RIGHT}, "[prior]\nheight = { mean = 0.1, sd = 0.0 }", "prior.height.sd: Input should be greater"),
        ({OUTER: RIGHT}, "x = ", "not valid TOML"),
    ],
)
def test_faults_of_a_data_file_are_named(sensors: dict[str, Any], rest: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "data.toml"
    tables = "\n".join(f"[sensors.{json.dumps(name)}]\n" + _lines(values) for name, values in sensors.items())
    file.write_text((rest + "\n" + tables) if rest.startswith("cov") else (tables + "\n" + rest), encoding="utf-8")
    line = refusal(read_data, file, Radial("coarse"))
    assert line.startswith(str(file))
    assert said in line


@pytest.mark.parametrize(
    ("problem", "sensor", "said"),
    [
        (
            "hertz",
            "contact half-width",
            "no linear output of the problem is called 'contact half-width' (known: contact force, ",
        ),
        ("tresca", "tangential force", "tresca: decisions are proved for λ ≥ 0 alone, and K has intervals"),
    ],
)
def test_what_has_no_bound_is_refused_before_a_model_is_trained(
    problem: str, sensor: str, said: str, main: Main, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = Mock()
    monkeypatch.setattr("vibench.execution.recorded_cell.cell_model", training)
    Path("data.toml").write_text(f'[sensors."{sensor}"]\nvalue = 0.1\nnoise = 0.01\n')
    refused(main("calibrate", problem, "data.toml", "--option", "resolution=coarse"), said)
    assert training.call_count == 0


def _lines(values: dict[str, Any]) -> str:
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())


def test_data_with_a_covariance_and_a_prior_are_read(tmp_path: Path) -> None:
    file = tmp_path / "data.toml"
    file.write_text(
        'covariance = [[4.0, 1.0], [1.0, 9.0]]\n[sensors."contact force"]\nvalue = 1.1\nunit = "N/m"\n'
        "[sensors.indentation]\nvalue = 0.09\n[prior]\nradius = { mean = 1.0, sd = 0.2 }\n"
    )
    data, prior = read_data(file, Hertz("coarse"))
    assert data.sensors == ("contact force", "indentation")
    assert data.covariance.tolist() == [[4.0, 1.0], [1.0, 9.0]]
    assert (prior.mean.tolist(), prior.sd.tolist()) == ([1.0], [0.2])
