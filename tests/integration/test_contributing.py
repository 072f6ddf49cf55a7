"""The map of the code in CONTRIBUTING is that of the code."""

import importlib
import re
import tomllib
from pathlib import Path

import vibench

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PACKAGES = re.findall(r"^    (\w+)/ ", TEXT, re.MULTILINE)
WALK = re.findall(r"^\d\. `vibench\.([\w.]+)`", TEXT.partition("From `vibench run STUDY`")[2], re.MULTILINE)
LAYERS = [
    name.strip()
    for layer in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    for name in layer.split("|")
]


def test_the_map_names_every_package_in_the_order_of_the_layers() -> None:
    package = Path(str(vibench.__file__)).parent
    assert set(PACKAGES) == {path.parent.name for path in package.glob("*/__init__.py")}
    assert [layer for layer in LAYERS if layer in PACKAGES] == PACKAGES


def test_the_walk_from_a_study_to_a_row_leads_through_seven_modules_each_once_and_downwards() -> None:
    modules, places = [], []
    for name in WALK:
        parts = name.split(".")
        depth = next(k for k in (3, 2) if (ROOT / "vibench" / ("/".join(parts[:k]) + ".py")).is_file())
        place = importlib.import_module("vibench." + ".".join(parts[:depth]))
        modules.append(place.__name__)
        for part in parts[depth:]:
            place = getattr(place, part)
        assert callable(place), name
        places.append(LAYERS.index(parts[0]))
    assert len(modules) == len(set(modules)) == 7
    assert places == sorted(places)
