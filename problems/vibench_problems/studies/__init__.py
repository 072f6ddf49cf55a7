"""The studies that vibench ships; each entry point names the path of a study file."""

from pathlib import Path

globals().update({file.stem.replace("-", "_"): file for file in Path(__file__).parent.glob("*.toml")})
