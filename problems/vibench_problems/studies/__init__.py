"""The studies that vibench ships; each entry point names the path of a study file."""

from __future__ import annotations

from pathlib import Path

benefit = Path(__file__).with_name("benefit.toml")
calibration = Path(__file__).with_name("calibration.toml")
certified = Path(__file__).with_name("certified.toml")
default = Path(__file__).with_name("default.toml")
field = Path(__file__).with_name("field.toml")
friction = Path(__file__).with_name("friction.toml")
formulations = Path(__file__).with_name("formulations.toml")
formulations_compiled = Path(__file__).with_name("formulations-compiled.toml")
quick = Path(__file__).with_name("quick.toml")
hertz_quadrature = Path(__file__).with_name("hertz-quadrature.toml")
meshes = Path(__file__).with_name("meshes.toml")
hertz_direct = Path(__file__).with_name("hertz-direct.toml")
paper_hertz = Path(__file__).with_name("paper-hertz.toml")
sequences = Path(__file__).with_name("sequences.toml")
sequences_warm = Path(__file__).with_name("sequences-warm.toml")
solvers = Path(__file__).with_name("solvers.toml")
paper_obstacle = Path(__file__).with_name("paper-obstacle.toml")
training = Path(__file__).with_name("training.toml")
three_dimensions = Path(__file__).with_name("three-dimensions.toml")
